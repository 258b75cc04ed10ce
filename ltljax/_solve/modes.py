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

from .._equations import boundary as bounds
from .._operators import laplacian, laplacian_matrix
from .._surface import Surface, on_surface

# Below this size all eigenvalues are computed at once.
_DENSE = 300
# How many modes beyond those asked for are computed.
_MORE = 6


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


@on_surface
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
    if isinstance(k, bool) or not isinstance(k, int | np.integer):
        raise ValueError(f"Expected a whole number of modes, found {k!r}.")
    if not 1 <= k <= size - 2:
        raise ValueError(f"Expected a number of modes from 1 to {size - 2}, found {k}.")
    conditions = bounds.as_tuple(boundary)
    if any(condition.species is not None for condition in conditions):
        raise ValueError("A condition for some species belongs to a state of several; modes are of one field.")
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
    size = matrix.shape[0]
    values, right, left = np.zeros(0), np.zeros((size, 0)), np.zeros((size, 0))
    # The iteration starts from one vector. If an eigenvalue has several modes, that vector has only one combination of
    # them, and the others appear by rounding alone. The iteration is therefore repeated on the complement of the modes
    # found so far, until the eigenvalues of that complement are larger than the k wanted ones.
    count = min(k + _MORE, size - 2)
    while count > 0:
        inverse = _Deflated(factors, shift, values, right, left)
        further, more_right = _real(*_iterated(matrix, inverse, count, shift, "N"))
        _, more_left = _real(*_iterated(matrix, inverse, count, shift, "T"))
        # Each side leaves out the last one if its partner was not computed.
        complete = min(more_right.shape[1], more_left.shape[1])
        further, more_right, more_left = further[:complete], more_right[:, :complete], more_left[:, :complete]
        more_left = more_left @ np.linalg.inv(more_right.T @ more_left)
        is_missing = further < (values[k - 1] if len(values) >= k else np.inf)
        right, left = np.hstack([right, more_right]), np.hstack([left, more_left])
        values = np.concatenate([values, further])
        order = np.argsort(values, kind="stable")
        values, right, left = values[order], right[:, order], left[:, order]
        count = min(_MORE, size - len(values) - 2) if is_missing.any() else 0
    return values[:k], right[:, :k], left[:, :k]


class _Deflated:
    """The inverse of a matrix less a shift, on the complement of the modes that were found.

    Args:
        factors: the sparse LU factors of the matrix less the shift.
        shift: what was subtracted.
        values: (n,) found eigenvalues.
        right: (V, n) their vectors.
        left: (V, n) those of the transposed matrix, with ``left.T @ right`` the identity.
    """

    def __init__(self, factors: Any, shift: float, values: np.ndarray, right: np.ndarray, left: np.ndarray):
        self.factors, self.right, self.left = factors, right, left
        self.inverse = 1 / (values - shift)

    def __call__(self, v: np.ndarray, side: str) -> np.ndarray:
        """The product with a vector, for the side ``"T"`` of the transposed inverse."""
        v = np.ascontiguousarray(v).ravel()
        right, left = (self.right, self.left) if side == "N" else (self.left, self.right)
        return self.factors.solve(v, trans=side) - right @ (self.inverse * (left.T @ v))


def _iterated(matrix: Any, inverse: _Deflated, count: int, shift: float, side: str) -> Any:
    """The eigenvalues next to the shift, and their vectors, by Arnoldi iteration."""
    operator: Any = scipy.sparse.linalg.LinearOperator
    start = np.random.default_rng(0).normal(size=matrix.shape[0])
    options: Any = dict(
        k=count, sigma=shift, v0=start, ncv=min(max(2 * count + 1, 20), matrix.shape[0]),
        OPinv=operator(matrix.shape, matvec=lambda v: inverse(v, side), dtype=np.float64),
    )  # fmt: skip
    return scipy.sparse.linalg.eigs(scipy.sparse.csc_array(matrix if side == "N" else matrix.T), **options)


def _real(values: Any, vectors: Any) -> tuple[np.ndarray, np.ndarray]:
    """Real eigenvalues in ascending order, with real vectors that span the same spaces.

    Discretisation can turn two real eigenvalues that nearly coincide into a complex pair. The two vectors of such a
    pair are replaced by the real and the imaginary part of one of them. The last vector that was computed can lack its
    partner: alone it spans no such space, and is left out.
    """
    out, is_free, is_whole = vectors.real.copy(), values.imag < 0, values.imag == 0
    for i in np.flatnonzero(values.imag > 0):
        distance = np.where(is_free, np.abs(values - values[i].conj()), np.inf)
        partner = int(np.argmin(distance))
        if distance[partner] <= 1e-6 * np.abs(values[i]):
            out[:, partner], is_free[partner] = vectors[:, i].imag, False
            is_whole[[i, partner]] = True
    order = np.flatnonzero(is_whole)[np.argsort(values.real[is_whole], kind="stable")]
    return values.real[order], (out / np.linalg.norm(out, axis=0))[:, order]
