"""The operators of calculus on a surface: ``(surface, field) -> field``.

Fields live on vertices: ``(V,)``, or ``(V, S)`` for S species at once. Vector fields are tangent, in ambient
coordinates. Every operator is jit-compiled, linear in the field, and differentiable in the field and (through
`Surface.with_vertices`) in the vertices.
"""

import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Array, Float

from .._surface.surface import Surface, on_device, on_surface
from .._tables import AnyArray, difference_matrix, difference_sum, differences, slot_sum

# Below this size all eigenvalues are computed at once.
_DENSE = 300

# Products from which the rim of a spectrum is estimated, and what the estimate is multiplied with.
_PRODUCTS = 60
# Rows are slowed down to so many times the median row.
_SLOWED = (30.0, 5.0, 2.0)
_MARGIN = 1.5
# On larger surfaces the vectors of the products would take more memory than the tables do.
MOST_MEASURED = 250_000


@on_device
def gradient(surface: Surface, u: Float[AnyArray, "V *S"]) -> Float[Array, "V *S 3"]:
    """The surface gradient of u, tangent, in ambient coordinates.

    ``Monotone``: the quadratic fit on the lifted ring, second order. ``Polynomial``: the fit of its degree, of that
    order. ``Paper``: the mean of affine gradients over the faces, first order on irregular meshes and second on
    symmetric rings.

    Args:
        surface: the surface.
        u: (V,) or (V, S).

    Returns:
        (V, 3) or (V, S, 3).

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 2.
    """
    _check_rows(surface, u, "u")
    return _to_ambient(surface, *_gradient_in_frame(surface, u))


@on_device
def divergence(surface: Surface, X: Float[AnyArray, "V *C"]) -> Float[Array, "V *S"]:
    """The surface divergence of a tangent vector field, positive where the field spreads out.

    The neighbours' vectors are transported into the vertex's tangent plane and differentiated there with the weights
    of the gradient; the divergence is the trace. A normal part of X is left out. Same order as the gradient.

    Args:
        surface: the surface.
        X: (V, 3) or (V, S, 3), in ambient coordinates.

    Returns:
        (V,) or (V, S).

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 2.
    """
    _check_rows(surface, X, "X")
    if X.ndim < 2 or X.shape[-1] != 3:
        raise ValueError(f"Expected a vector field of shape (V, 3) or (V, S, 3), found {X.shape}.")
    components = jnp.einsum("v...c,vac->av...", X, surface.geometry.frames)
    return _divergence_in_frame(surface, components[0], components[1])


@on_device
def laplacian(
    surface: Surface, u: Float[AnyArray, "V *S"], flux: Float[AnyArray, "..."] | None = None
) -> Float[Array, "V *S"]:
    """The Laplace-Beltrami operator, Delta u = div grad u: on the unit sphere ``laplacian(x1) = -2 x1``.

    ``Monotone``: one sum over non-negative weights; pointwise first order on irregular meshes and second on symmetric
    rings, second order in solved problems. ``Polynomial``: one order less than its degree, in solved problems of order
    2 (degree 3) and 4 (degree 4); weights of both signs. On a boundary both are for fields whose normal derivative
    vanishes, unless a flux is given. ``Paper``: the divergence of the gradient, which does not converge pointwise on
    irregular meshes and knows of no flux.

    Args:
        surface: the surface.
        u: (V,) or (V, S).
        flux: the derivative of u along the outward conormal of the boundary, (V,) or (V, S), or the gradient it is the
            part of, (V, 3) or (V, S, 3), which serves both sides of a corner; used at boundary vertices only. Zero by
            default.

    Returns:
        The same shape.

    Raises:
        ValueError: a flux was given to `Paper`, or does not fit u.

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 2; Wu, Chen and Chi, arXiv 1310.4807, for the configuration
    equation behind ``Monotone``.
    """
    _check_rows(surface, u, "u")
    table, weights = surface.topology.diffusion, surface.geometry.laplacian_weights
    if table is None or weights is None:
        rate = _divergence_in_frame(surface, *_gradient_in_frame(surface, u))
    else:
        rate = difference_sum(table, weights, u, surface.geometry.laplacian_reverse)
    return rate if flux is None else add_flux(surface, rate, through_sides(surface, jnp.asarray(flux, u.dtype), u))


def through_sides(surface: Surface, flux: Float[Array, "V *C"], u: Float[AnyArray, "V *S"]) -> Float[Array, "2 B *S"]:
    """The flux of u through both sides of every boundary vertex, from one flux or from a gradient: see `laplacian`."""
    here = flux[surface.topology.boundary]
    if flux.shape == u.shape:
        return jnp.broadcast_to(here[None], (2, *here.shape))
    if flux.shape != (*u.shape, 3):
        raise ValueError(f"Expected a flux of shape {u.shape}, or {(*u.shape, 3)} for a gradient, found {flux.shape}.")
    return jnp.einsum("b...c,bsc->sb...", here, surface.geometry.conormals)


def add_flux(
    surface: Surface,
    rate: Float[Array, "V *S"],
    through: Float[Array, "2 B *S"],
    weights: Float[Array, "B 2"] | None = None,
) -> Float[Array, "V *S"]:
    """The Laplacian, or another operator with flux weights of its own, with what fluxes through the sides of boundary
    vertices add to it."""
    weights = surface.geometry.flux_weights if weights is None else weights
    if weights is None:
        raise ValueError("Paper() knows of no flux through a boundary. Use ltl.Monotone() or ltl.Polynomial().")
    added = jnp.einsum("sb...,bs->b...", through, weights)
    return rate.at[surface.topology.boundary].add(added, unique_indices=True)


@on_device
def weighted_laplacian(
    surface: Surface,
    conductivity: Float[AnyArray, " V"],
    u: Float[AnyArray, "V *S"],
    mean: Literal["arithmetic", "harmonic"] = "arithmetic",
) -> Float[Array, "V *S"]:
    """div(g grad u) for a conductivity g, as sum_k c[k] g[k] (u_k - u_v) over the Laplacian's weights c, g[k] the mean
    of the conductivities at both ends.

    The arithmetic mean serves a smooth g. The harmonic mean, ``2 g_k g_v / (g_k + g_v)``, serves a g that jumps. It is
    that of two conductors in a row, so that nothing flows to where g is zero: a wall of such vertices keeps its two
    sides apart if it is two vertices wide. A few rows that use two rings reach through a wall one vertex wide (none on
    icospheres, 2 of 1,182 beside a wall on a jittered sphere).

    A g that is zero or less counts as zero in the harmonic mean, and has no derivative there.

    Of the Laplacian's order where g is smooth; with ``Monotone`` and g >= 0 the weights stay non-negative and the
    maximum principle holds. On a boundary, for fields whose normal derivative vanishes. g may depend on u, which makes
    diffusion nonlinear.

    Args:
        surface: the surface.
        conductivity: g, (V,).
        u: (V,) or (V, S).
        mean: ``"arithmetic"`` or ``"harmonic"``; the latter for `Monotone` only.

    Returns:
        The same shape as u.
    """
    _check_rows(surface, u, "u")
    _check_rows(surface, conductivity, "conductivity")
    if mean not in ("arithmetic", "harmonic"):
        raise ValueError(f'Expected the mean "arithmetic" or "harmonic", found {mean!r}.')
    if mean == "harmonic" and surface.topology.diffusion is None:
        raise ValueError(f"The harmonic mean is one of two neighbours, which {surface.scheme} has no weights for.")
    table, weights = surface.topology.diffusion, surface.geometry.laplacian_weights
    if table is None or weights is None:
        x, y = _gradient_in_frame(surface, u)
        g = conductivity.reshape(-1, *(1,) * (u.ndim - 1))
        return _divergence_in_frame(surface, g * x, g * y)
    rises = differences(table, conductivity)
    of_ends = _harmonic if mean == "harmonic" else lambda first, rise: first + rise / 2
    means = table.each(lambda block, rise: of_ends(block.centre(conductivity)[None], rise), rises)
    return difference_sum(table, tuple(w * g for w, g in zip(weights, means, strict=True)), u)


def _harmonic(first: Array, rise: Array) -> Array:
    """The harmonic mean of two numbers, the second larger by the rise; zero where either is zero or less."""
    second = first + rise
    are_positive = (first > 0) & (second > 0)
    total = jnp.where(are_positive, first + second, 1)
    return jnp.where(are_positive, 2 * (first / total) * second, 0)


@on_device
def hessian(surface: Surface, u: Float[AnyArray, "V *S"]) -> Float[Array, "V *S 3 3"]:
    """The covariant second derivative of u, symmetric and tangent, in ambient coordinates.

    From the same fit as the gradient; its trace is the Laplacian wherever that is taken on the same neighbours. First
    order on irregular meshes and second on symmetric rings for ``Monotone``, one less than the degree and the next
    even number for ``Polynomial``.

    Args:
        surface: the surface.
        u: (V,) or (V, S).

    Returns:
        (V, 3, 3) or (V, S, 3, 3).

    Raises:
        ValueError: `Paper` has no second derivatives of its own.
    """
    _check_rows(surface, u, "u")
    xx, xy, yy = second_derivatives(surface, u)
    components = jnp.stack([jnp.stack([xx, xy]), jnp.stack([xy, yy])])
    frames = surface.geometry.frames
    return jnp.einsum("abv...,vac,vbd->v...cd", components, frames, frames)


@on_device
def integrate(
    surface: Surface, u: Float[AnyArray, "V *S"], measure: Float[AnyArray, " V"] | None = None
) -> Float[Array, "*S"]:
    """The integral of u over the surface: second order.

    Args:
        surface: the surface.
        u: (V,) or (V, S).
        measure: the weight of each vertex, (V,); by default the vertex areas. With ``surface.mass`` the integral does
            not change while u diffuses.

    Returns:
        A scalar, or (S,).
    """
    _check_rows(surface, u, "u")
    weights = surface.vertex_areas if measure is None else measure
    _check_rows(surface, weights, "measure")
    return jnp.tensordot(weights, u, axes=1)


@on_surface
def laplacian_matrix(surface: Surface) -> scipy.sparse.csr_array:
    """The Laplacian as a SciPy sparse matrix (V, V), for other people's solvers (host)."""
    geometry, topology = surface.geometry, surface.topology
    if topology.diffusion is not None and geometry.laplacian_weights is not None:
        return difference_matrix(topology.diffusion, geometry.laplacian_weights)
    centre = np.asarray(geometry.divergence_centre)
    parts = [
        (difference_matrix(topology.jet, divergence) + scipy.sparse.diags_array(centre[:, axis]))
        @ difference_matrix(topology.jet, geometry.gradient_weights[axis])
        for axis, divergence in enumerate(geometry.divergence_weights)
    ]
    return scipy.sparse.csr_array(parts[0] + parts[1])


def diagonal(surface: Surface) -> Float[Array, " V"]:
    """What the Laplacian multiplies u with at the vertex itself; of `Paper`, whose matrix is not at hand, a bound."""
    table, weights = surface.topology.diffusion, surface.geometry.laplacian_weights
    if table is not None and weights is not None:
        return -slot_sum(table, weights)
    return jnp.full(surface.num_vertices, -spectral_bound(surface) / 2)


@on_surface
def growth_rate(surface: Surface) -> float:
    """The largest real part among the Laplacian's eigenvalues, the constant field's zero aside where it is the largest
    (host). Positive where diffusion has growing modes; never with ``Monotone``.

    By Arnoldi iteration, to about a percent: growing modes stand apart and are found within a few dozen products.
    """
    matrix: Any = laplacian_matrix(surface)
    if surface.num_vertices <= _DENSE:
        values: Any = np.linalg.eigvals(matrix.todense())
        return float(values.real.max())
    start = np.random.default_rng(0).normal(size=surface.num_vertices)
    try:
        options: Any = dict(ncv=40, maxiter=100, tol=1e-2, v0=start)
        found: Any = scipy.sparse.linalg.eigs(matrix, k=1, which="LR", return_eigenvectors=False, **options)
    except scipy.sparse.linalg.ArpackNoConvergence as error:
        # Nothing stands apart from the crowd near zero.
        found = np.append(error.eigenvalues, 0)
    return float(found.real.max())


@on_device
def spectral_bound(surface: Surface) -> Float[Array, ""]:
    """An upper bound of the magnitude of the Laplacian's eigenvalues, by Gershgorin's discs.

    For the non-negative rows of ``Monotone`` it is twice the largest row sum, and every eigenvalue lies in the disc
    between its negative and zero. For ``Paper`` it bounds the product of divergence and gradient.
    """
    geometry, topology = surface.geometry, surface.topology
    size = functools.partial(jax.tree.map, jnp.abs)
    if topology.diffusion is not None and geometry.laplacian_weights is not None:
        return 2 * jnp.max(slot_sum(topology.diffusion, size(geometry.laplacian_weights)))
    steep = sum(slot_sum(topology.jet, size(weights)) for weights in geometry.gradient_weights)
    spread = sum(slot_sum(topology.jet, size(weights)) for weights in geometry.divergence_weights)
    return (2 * jnp.max(spread) + jnp.max(jnp.abs(geometry.divergence_centre))) * 2 * jnp.max(steep)


@on_surface
def spectral_width(surface: Surface) -> Float[Array, ""]:
    """How far the Laplacian's eigenvalues lie off the real axis: a number chi, per unit time at diffusivity 1, such
    that each eigenvalue of negative real part has ``|Im|^2 <= chi |Re|``.

    Rows of the Laplacian are not symmetric where a mesh is not. Explicit steps of length dt have to be stable inside
    this parabola, so that the number of their stages follows from ``dt * chi`` too.

    It is an estimate, no bound: measured once for each surface (host) by Arnoldi iteration, whose first eigenvalues are
    those at the rim of the spectrum, with half as much again added. On a surface of more than 250,000 vertices, and
    where a JAX transformation is tracing a surface that was not measured before, it is half the mean row sum, which is
    several times what random points need.
    """
    if surface.geometry.spectral_width is not None:
        return surface.geometry.spectral_width
    if not surface.is_traced and surface.num_vertices <= MOST_MEASURED:
        with jax.ensure_compile_time_eval():
            width = surface.remembered(
                "spectral width", lambda: measured_width(laplacian_matrix(surface), np.asarray(surface.vertex_areas))
            )
        return jnp.asarray(width, surface.dtype)
    weights = surface.geometry.laplacian_weights
    if surface.topology.diffusion is None or weights is None:
        return spectral_bound(surface) / 2
    return jnp.mean(slot_sum(surface.topology.diffusion, weights)) / 2


def measured_width(operator: scipy.sparse.csr_array, vertex_areas: np.ndarray) -> float:
    """The spectral width, as of `spectral_width`, of a matrix (V, V) on a surface with vertex areas (V,) (host)."""
    # In the inner product of the areas eigenvectors are nearly orthogonal.
    scale, sums = np.sqrt(vertex_areas.astype(np.float64)), np.abs(operator.diagonal())
    matrix: Any = scipy.sparse.diags_array(scale) @ operator @ scipy.sparse.diags_array(1 / scale)
    # The iteration sees little beyond the fastest rows where these are far faster than most. Slowed down they leave the
    # other modes nearly as they are, as their vertices follow the neighbours anyway.
    if not sums.any():
        return 0.0
    # Rows of zeros stay as they are.
    median = np.median(sums[sums > 0])
    active = np.where(sums > 0, sums, median)
    slowed = [np.minimum(active, limit) / active for limit in (np.inf, *(times * median for times in _SLOWED))]
    return max(
        _rim(scipy.sparse.diags_array(share) @ matrix) for share in slowed if share.min() < 1 or share is slowed[0]
    )


def _rim(matrix: Any) -> float:
    """The largest square of an imaginary part over the real part, among the eigenvalues at the rim of a spectrum."""
    size = matrix.shape[0]
    count = min(_PRODUCTS, size)
    basis, hessenberg = np.zeros((count + 1, size)), np.zeros((count + 1, count))
    start = np.random.default_rng(0).normal(size=size)
    basis[0] = start / np.linalg.norm(start)
    for k in range(count):
        new = matrix @ basis[k]
        length = np.linalg.norm(new)
        for _ in range(2):  # the second time for rounding
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


def _gradient_in_frame(surface: Surface, u: Array) -> tuple[Array, Array]:
    along_e1, along_e2 = surface.geometry.gradient_weights
    table = surface.topology.jet
    return difference_sum(table, along_e1, u), difference_sum(table, along_e2, u)


def second_derivatives(surface: Surface, u: Array) -> tuple[Array, Array, Array]:
    """The second derivatives xx, xy and yy of u in the frames of the vertices."""
    weights = surface.geometry.hessian_weights
    if weights is None:
        raise ValueError("Paper() has no second derivatives of its own. Use ltl.Monotone() or ltl.Polynomial().")
    xx, xy, yy = (difference_sum(surface.topology.jet, w, u) for w in weights)
    return xx, xy, yy


def _divergence_in_frame(surface: Surface, x: Array, y: Array) -> Array:
    along_e1, along_e2 = surface.geometry.divergence_weights
    table, centre = surface.topology.jet, surface.geometry.divergence_centre
    trailing = (1,) * (x.ndim - 1)
    here = centre[:, 0].reshape(-1, *trailing) * x + centre[:, 1].reshape(-1, *trailing) * y
    return difference_sum(table, along_e1, x) + difference_sum(table, along_e2, y) + here


def _to_ambient(surface: Surface, x: Array, y: Array) -> Array:
    return jnp.einsum("av...,vac->v...c", jnp.stack([x, y]), surface.geometry.frames)


def _check_rows(surface: Surface, field: AnyArray, name: str) -> None:
    if field.ndim == 0 or field.shape[0] != surface.num_vertices:
        raise ValueError(
            f"Expected {name} with one row per vertex, ({surface.num_vertices}, ...), found shape {field.shape}."
        )
