"""Where the eigenvalues of an operator lie: how fast they are, how far from the real axis, and whether any grows."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Array, Float

from .._surface import Surface, on_device, on_surface
from .scalar import laplacian_matrix

# All eigenvalues are computed at once if there are at most this many.
_DENSE = 300

# The number of products from which the rim of a spectrum is estimated, and the safety factor of the estimate.
_PRODUCTS = 60
_MARGIN = 1.5
# Row sums are limited to these multiples of the median row sum, one after another.
_LIMITS = (30.0, 5.0, 2.0)
# On larger surfaces the vectors of the iteration would take more memory than the tables.
MOST_MEASURED = 250_000


@on_surface
def growth_rate(surface: Surface) -> float:
    """The largest real part of the Laplacian's eigenvalues (host).

    It is positive if diffusion has growing modes, which never happens with ``Monotone``; otherwise it is zero, the
    eigenvalue of constant fields. Computed by Arnoldi iteration to about a percent: growing modes are well separated
    and converge within a few dozen products.
    """
    matrix: Any = laplacian_matrix(surface)
    if surface.num_vertices <= _DENSE:
        values: Any = np.linalg.eigvals(matrix.todense())
        return float(values.real.max())
    start = np.random.default_rng(0).normal(size=surface.num_vertices)
    try:
        options: Any = dict(ncv=40, maxiter=100, tol=1e-2, v0=start)
        values = scipy.sparse.linalg.eigs(matrix, k=1, which="LR", return_eigenvectors=False, **options)
    except scipy.sparse.linalg.ArpackNoConvergence as error:
        # No eigenvalue is separated from the many near zero.
        values = np.append(error.eigenvalues, 0)
    return float(values.real.max())


@on_device
def spectral_bound(surface: Surface) -> Float[Array, ""]:
    """An upper bound of the magnitude of the Laplacian's eigenvalues, from Gershgorin's discs.

    For the non-negative rows of ``Monotone`` it is twice the largest row sum, and every eigenvalue lies in the disc
    between minus the bound and zero. For ``Paper`` it is the product of bounds of divergence and gradient.
    """
    return surface.laplacian_stencil.spectral_bound()


@on_surface
def spectral_width(surface: Surface) -> Float[Array, ""]:
    """How far the Laplacian's eigenvalues lie from the real axis.

    The width is a number chi, per unit time at diffusivity 1, such that each eigenvalue of negative real part satisfies
    ``|Im|^2 <= chi |Re|``. Rows of the Laplacian are not symmetric on irregular meshes. Explicit steps of length dt
    must be stable inside this parabola, so their number of stages depends on ``dt * chi`` too.

    The width is an estimate and not a bound. It is measured once per surface by Arnoldi iteration (host), whose first
    eigenvalues are those at the rim of the spectrum, and multiplied by 1.5. On a surface of more than 250,000 vertices,
    and if a JAX transformation is tracing a surface that was not measured before, it is half the mean row sum, several
    times what random points need.
    """
    if surface.geometry.spectral_width is not None:
        return surface.geometry.spectral_width
    if not surface.is_traced and surface.num_vertices <= MOST_MEASURED:
        with jax.ensure_compile_time_eval():
            width = surface.remembered(
                "spectral width", lambda: measured_width(laplacian_matrix(surface), np.asarray(surface.vertex_areas))
            )
        return jnp.asarray(width, surface.dtype)
    return surface.laplacian_stencil.rough_spectral_width()


def measured_width(operator: scipy.sparse.csr_array, vertex_areas: np.ndarray) -> float:
    """The spectral width of a matrix (V, V) on a surface with vertex areas (V,), as in `spectral_width` (host)."""
    # In the inner product of the areas, eigenvectors are nearly orthogonal.
    scale, sums = np.sqrt(vertex_areas.astype(np.float64)), np.abs(operator.diagonal())
    matrix: Any = scipy.sparse.diags_array(scale) @ operator @ scipy.sparse.diags_array(1 / scale)
    if not sums.any():
        return 0.0
    # If a few rows are far faster than most, the iteration finds hardly any other eigenvalues. Slowing these rows down
    # nearly preserves the other modes, in which such vertices follow their neighbours anyway.
    median = np.median(sums[sums > 0])
    positive_sums = np.where(sums > 0, sums, median)
    limits = (np.inf, *(multiple * median for multiple in _LIMITS))
    factors = [np.minimum(positive_sums, limit) / positive_sums for limit in limits]
    return max(
        _rim(scipy.sparse.diags_array(factor) @ matrix)
        for factor in factors
        if factor is factors[0] or factor.min() < 1
    )


def _rim(matrix: Any) -> float:
    """The largest ``|Im|^2 / |Re|`` among the eigenvalues at the rim of a spectrum, times the safety factor."""
    size = matrix.shape[0]
    count = min(_PRODUCTS, size)
    basis, hessenberg = np.zeros((count + 1, size)), np.zeros((count + 1, count))
    start = np.random.default_rng(0).normal(size=size)
    basis[0] = start / np.linalg.norm(start)
    for k in range(count):
        new = matrix @ basis[k]
        length = np.linalg.norm(new)
        for _ in range(2):  # the second pass removes rounding errors of the first
            along = basis[: k + 1] @ new
            hessenberg[: k + 1, k] += along
            new -= along @ basis[: k + 1]
        hessenberg[k + 1, k] = np.linalg.norm(new)
        if hessenberg[k + 1, k] <= 1e-12 * length:
            count = k + 1
            break
        basis[k + 1] = new / hessenberg[k + 1, k]
    values = np.linalg.eigvals(hessenberg[:count, :count])
    values = values[values.real < -1e-12 * np.abs(values).max()]
    return _MARGIN * float(np.max(values.imag**2 / -values.real, initial=0))
