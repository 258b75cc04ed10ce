"""Eigenmodes of the Laplacian (host), and their eigenvalues as differentiable functions of the surface.

What enters: a surface. What leaves: the lowest eigenvalues of -Delta with their modes, by shift-invert Arnoldi
iteration for a nonsymmetric matrix.
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

# Up to this size the whole spectrum of the dense matrix is computed.
_DENSE = 300
# Number of modes that are computed beyond those asked for.
_EXTRA = 6


class Eigenmodes(eqx.Module):
    """The lowest modes of -Delta; unpacks as ``values, vectors``.

    Attributes:
        values: (k,) eigenvalues in ascending order.
        vectors: (V, k) modes with ``integrate(surface, vectors[:, i] ** 2) = 1``.
        left: (V, k) modes of the transposed operator, with ``left.T @ vectors`` the identity.
        residuals: (k,) norms of ``Delta vector + value vector`` relative to ``value vector``, or for small eigenvalues
            to ``vector / area``.
    """

    values: Float[Array, " k"]
    vectors: Float[Array, "V k"]
    left: Float[Array, "V k"]
    residuals: np.ndarray

    def __iter__(self):
        return iter((self.values, self.vectors))

    def values_on(self, surface: Surface) -> Float[Array, " k"]:
        """The eigenvalues as a differentiable function of the surface.

        Values and first derivatives are exact on the surface of the modes. On another surface the result is the
        two-sided Rayleigh quotient, whose error is of second order in the change. Equal eigenvalues are not
        differentiable one by one, but their sum is.
        """
        acted = laplacian(surface, self.vectors)
        return -jnp.sum(self.left * acted, axis=0) / jnp.sum(self.left * self.vectors, axis=0)


@on_surface
def eigenmodes(surface: Surface, k: int = 12, boundary: bounds.Conditions | None = None) -> Eigenmodes:
    """The k lowest eigenvalues of -Delta and their modes (host): second order with ``Monotone``.

    Args:
        surface: surface of any scheme. `Paper` has spurious eigenvalues.
        k: number of modes; on a closed surface the first eigenvalue is zero.
        boundary: `Dirichlet` or `Robin` conditions, whose data are taken as zero. By default the normal derivative
            vanishes. `Eigenmodes.values_on` supports this default only.

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
    operator, free = _free_operator(surface, boundary)
    areas = np.asarray(surface.vertex_areas, np.float64)
    values, right, left = _lowest(operator, k, 1 / areas.sum())
    residuals = np.linalg.norm(operator @ right - right * values, axis=0)
    residuals = residuals / (np.maximum(np.abs(values), 1 / areas.sum()) * np.linalg.norm(right, axis=0))
    norms = np.sqrt((areas[free, None] * right**2).sum(axis=0))
    # The sign of a mode makes its entry of largest magnitude positive.
    signs = np.sign(right[np.abs(right).argmax(axis=0), np.arange(k)])
    vectors = np.zeros((2, size, k))
    vectors[:, free] = right / norms * signs, left * norms * signs
    cast = lambda a: jnp.asarray(a, surface.dtype)  # noqa: E731
    return Eigenmodes(cast(values), cast(vectors[0]), cast(vectors[1]), residuals)


def _free_operator(surface: Surface, boundary: bounds.Conditions | None) -> tuple[scipy.sparse.csc_array, np.ndarray]:
    """The matrix of -Delta with what conditions absorb, on the vertices that are not held, and these vertices."""
    conditions = bounds.as_tuple(boundary)
    if any(condition.species is not None for condition in conditions):
        raise ValueError(
            "A boundary condition with species=... applies to a state of several species, but a mode is one field. "
            "Leave species out."
        )
    size = surface.num_vertices
    operator = -laplacian_matrix(surface).astype(np.float64)
    if conditions:
        time, like = jnp.zeros((), surface.dtype), jnp.zeros(size, surface.dtype)
        absorption = np.asarray(bounds.absorption(surface, conditions, time, like), np.float64)
        operator = operator + scipy.sparse.diags_array(absorption)
    free = np.flatnonzero(~np.asarray(bounds.held_vertices(surface, conditions)))
    return scipy.sparse.csc_array(scipy.sparse.csr_array(operator)[free][:, free]), free


def _lowest(matrix: Any, k: int, scale: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The k eigenvalues nearest to zero with right and left vectors, real and biorthonormal."""
    size = matrix.shape[0]
    if size <= _DENSE:
        values, right = _real(*np.linalg.eig(matrix.toarray()))
        return values[:k], right[:, :k], np.linalg.inv(right).T[:, :k]
    shift = -scale
    factors = scipy.sparse.linalg.splu(scipy.sparse.csc_matrix(matrix - shift * scipy.sparse.eye_array(size)))
    values, right, left = np.zeros(0), np.zeros((size, 0)), np.zeros((size, 0))
    # The iteration starts from one vector. If an eigenvalue has several modes, that vector contains only one
    # combination of them, and the others appear by rounding alone. The iteration is therefore repeated on the
    # complement of the modes known so far, until the eigenvalues of that complement exceed the k-th one.
    count = min(k + _EXTRA, size - 2)
    while count > 0:
        inverse = _DeflatedInverse(factors, shift, values, right, left)
        new_values, new_right = _real(*_arnoldi(matrix, inverse, count, shift, "N"))
        _, new_left = _real(*_arnoldi(matrix, inverse, count, shift, "T"))
        # Each side omits its last vector if the conjugate partner was not computed.
        complete = min(new_right.shape[1], new_left.shape[1])
        new_values, new_right, new_left = new_values[:complete], new_right[:, :complete], new_left[:, :complete]
        new_left = new_left @ np.linalg.inv(new_right.T @ new_left)
        is_lower = new_values < (values[k - 1] if len(values) >= k else np.inf)
        values = np.concatenate([values, new_values])
        order = np.argsort(values, kind="stable")
        values, right = values[order], np.hstack([right, new_right])[:, order]
        left = np.hstack([left, new_left])[:, order]
        count = min(_EXTRA, size - len(values) - 2) if is_lower.any() else 0
    return values[:k], right[:, :k], left[:, :k]


class _DeflatedInverse:
    """The inverse of a matrix minus a shift, on the complement of the known modes.

    Args:
        factors: sparse LU factors of the matrix minus the shift.
        shift: number that was subtracted from the diagonal.
        values: (n,) known eigenvalues.
        right: (V, n) their eigenvectors.
        left: (V, n) eigenvectors of the transposed matrix, with ``left.T @ right`` the identity.
    """

    def __init__(self, factors: Any, shift: float, values: np.ndarray, right: np.ndarray, left: np.ndarray):
        self.factors, self.right, self.left = factors, right, left
        self.inverse = 1 / (values - shift)

    def __call__(self, v: np.ndarray, side: str) -> np.ndarray:
        """The product with a vector; side ``"T"`` is the product of the transposed inverse."""
        v = np.ascontiguousarray(v).ravel()
        right, left = (self.right, self.left) if side == "N" else (self.left, self.right)
        return self.factors.solve(v, trans=side) - right @ (self.inverse * (left.T @ v))


def _arnoldi(matrix: Any, inverse: _DeflatedInverse, count: int, shift: float, side: str) -> Any:
    """The eigenvalues nearest to the shift and their vectors, by Arnoldi iteration."""
    operator: Any = scipy.sparse.linalg.LinearOperator
    start = np.random.default_rng(0).normal(size=matrix.shape[0])
    options: Any = dict(
        k=count, sigma=shift, v0=start, ncv=min(max(2 * count + 1, 20), matrix.shape[0]),
        OPinv=operator(matrix.shape, matvec=lambda v: inverse(v, side), dtype=np.float64),
    )  # fmt: skip
    return scipy.sparse.linalg.eigs(scipy.sparse.csc_array(matrix if side == "N" else matrix.T), **options)


def _real(values: Any, vectors: Any) -> tuple[np.ndarray, np.ndarray]:
    """Real eigenvalues in ascending order, with real vectors that span the same spaces.

    Discretisation can turn two real eigenvalues that nearly coincide into a complex pair. The two vectors of a pair are
    replaced by the real and the imaginary part of one of them. The last computed vector can lack its partner; it spans
    no real space by itself and is omitted.
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
