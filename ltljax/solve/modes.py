"""Eigenmodes of the Laplacian (host), and their eigenvalues as differentiable functions of the surface.

What enters: a surface. What leaves: the lowest eigenvalues of -Delta with their modes, by shift-invert Arnoldi
iteration for a matrix that is not symmetric.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Array, Float

from ..equations import boundary as bounds
from ..operators import laplacian, laplacian_matrix
from ..surface import Surface

# Below this size all eigenvalues are computed at once.
_DENSE = 300


class Eigenmodes(eqx.Module):
    """The lowest modes of -Delta: unpacks as ``values, vectors``.

    Attributes:
        values: (k,) ascending.
        vectors: (V, k) with ``integrate(surface, vectors[:, i] ** 2) = 1``.
        left: (V, k) of the transposed operator, with ``left.T @ vectors`` the identity.
        residuals: (k,) the size of ``Delta vector + value vector`` relative to that of the operator's action.
    """

    values: Float[Array, " k"]
    vectors: Float[Array, "V k"]
    left: Float[Array, "V k"]
    residuals: np.ndarray

    def __iter__(self):
        return iter((self.values, self.vectors))

    def values_on(self, surface: Surface) -> Float[Array, " k"]:
        """The eigenvalues as a differentiable function of the surface: exact, and with exact first derivatives, on the
        surface of the modes; elsewhere the two-sided Rayleigh quotient, whose error is of second order in the change.

        Eigenvalues that are equal do not have derivatives one by one; their sum does.
        """
        acted = laplacian(surface, self.vectors)
        return -jnp.sum(self.left * acted, axis=0) / jnp.sum(self.left * self.vectors, axis=0)


def eigenmodes(surface: Surface, k: int = 12, boundary: bounds.Conditions | None = None) -> Eigenmodes:
    """The k lowest eigenvalues of -Delta and their modes (host): second order with ``Monotone``.

    Args:
        surface: the surface; any scheme, though `Paper` has eigenvalues that are not the surface's.
        k: how many; on a closed surface the first is zero.
        boundary: `Dirichlet` or `Robin` conditions, their data taken as zero; without any the normal derivative
            vanishes. `Eigenmodes.values_on` is for surfaces without.

    Raises:
        ValueError: the surface is being traced, or has too few vertices.
    """
    if surface.is_traced:
        raise ValueError(
            "Eigenmodes are computed on the host, but the surface is being traced by a JAX transformation. Compute "
            "them outside, and use modes.values_on(surface) inside."
        )
    size = surface.num_vertices
    if not 1 <= k <= size - 2:
        raise ValueError(f"Expected a number of modes from 1 to {size - 2}, found {k}.")
    conditions = bounds.as_tuple(boundary)
    zero = jnp.zeros(size, surface.dtype)
    held = np.asarray(bounds.held_vertices(surface, conditions))
    lost = np.asarray(bounds.absorption(surface, conditions, jnp.zeros((), surface.dtype), zero)) if conditions else 0
    operator = -laplacian_matrix(surface).astype(np.float64) + scipy.sparse.diags_array(np.zeros(size) + lost)
    free = np.flatnonzero(~held)
    inner = scipy.sparse.csc_array(scipy.sparse.csr_array(operator)[free][:, free])
    areas = np.asarray(surface.vertex_areas, np.float64)
    values, right, left = _lowest(inner, k, 1 / areas.sum())
    residuals = np.linalg.norm(inner @ right - right * values, axis=0)
    residuals = residuals / (np.maximum(np.abs(values), 1 / areas.sum()) * np.linalg.norm(right, axis=0))
    size_of = np.sqrt((areas[free, None] * right**2).sum(axis=0))
    right, left = right / size_of, left * size_of
    # The sign with which the largest entry is positive.
    sign = np.sign(right[np.abs(right).argmax(axis=0), np.arange(k)])
    spread = np.zeros((2, size, k))
    spread[:, free] = right * sign, left * sign
    cast = lambda a: jnp.asarray(a, surface.dtype)  # noqa: E731
    return Eigenmodes(cast(values), cast(spread[0]), cast(spread[1]), residuals)


def _lowest(matrix: Any, k: int, scale: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The k eigenvalues next to zero with right and left vectors, real, biorthonormal."""
    values: Any
    if matrix.shape[0] <= _DENSE:
        values, vectors = np.linalg.eig(matrix.toarray())
        values, right = _real(values, vectors)
        return values[:k], right[:, :k], np.linalg.inv(right).T[:, :k]
    shift = -scale
    factors = scipy.sparse.linalg.splu(
        scipy.sparse.csc_matrix(matrix - shift * scipy.sparse.eye_array(matrix.shape[0]))
    )
    start = np.random.default_rng(0).normal(size=matrix.shape[0])
    # Somewhat more than asked for, so that no member of a multiplet is missed.
    count = min(k + 6, matrix.shape[0] - 2)
    found = []
    for side, transposed in (("N", matrix), ("T", matrix.T)):
        operator: Any = scipy.sparse.linalg.LinearOperator
        inverse = operator(
            matrix.shape, matvec=lambda v, side=side: factors.solve(np.ascontiguousarray(v).ravel(), trans=side),
            dtype=np.float64,
        )  # fmt: skip
        options: Any = dict(k=count, sigma=shift, OPinv=inverse, v0=start, ncv=max(2 * count + 1, 20))
        pairs: Any = scipy.sparse.linalg.eigs(scipy.sparse.csc_array(transposed), **options)
        found.append(_real(*pairs))
    (values, right), (_, left) = found
    left = left @ np.linalg.inv(right.T @ left)
    return values[:k], right[:, :k], left[:, :k]


def _real(values: Any, vectors: Any) -> tuple[np.ndarray, np.ndarray]:
    """Real eigenvalues in ascending order, with real vectors that span the same spaces.

    Discretisation can turn two real eigenvalues that nearly coincide into a complex pair. The two vectors of such a
    pair are replaced by the real and the imaginary part of one of them.
    """
    out, is_free = vectors.real.copy(), values.imag < 0
    for i in np.flatnonzero(values.imag > 0):
        distance = np.where(is_free, np.abs(values - values[i].conj()), np.inf)
        partner = int(np.argmin(distance))
        # The last of the computed vectors can lack its partner: its real part is kept alone.
        if distance[partner] <= 1e-6 * np.abs(values[i]):
            out[:, partner], is_free[partner] = vectors[:, i].imag, False
    order = np.argsort(values.real, kind="stable")
    return values.real[order], (out / np.linalg.norm(out, axis=0))[:, order]
