"""The operators of calculus on scalar fields: ``(surface, field) -> field``.

Fields live on vertices: (V,), or (V, S) for S species at once. Vector fields are tangent, in ambient coordinates. Every
operator is compiled, linear in the field, and differentiable in the field and (through `Surface.with_vertices`) in the
vertices.
"""

import jax.numpy as jnp
import scipy.sparse
from jaxtyping import Array, Float

from .._surface import Surface, on_device, on_surface
from .._tables import AnyArray, Mean


@on_device
def gradient(surface: Surface, u: Float[AnyArray, "V *S"]) -> Float[Array, "V *S 3"]:
    """The surface gradient of u, a tangent field in ambient coordinates.

    ``Monotone`` differentiates the quadratic fit on the lifted ring, which is second order. ``Polynomial`` uses the fit
    of its degree and has that order. ``Paper`` averages affine gradients over the faces, which is first order on
    irregular meshes and second order on symmetric rings.

    Args:
        surface: the surface.
        u: (V,) or (V, S).

    Returns:
        (V, 3) or (V, S, 3).

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 2.
    """
    _check_rows(surface, u, "u")
    components = jnp.stack([stencil(u) for stencil in surface.gradient_stencils])
    return jnp.einsum("av...,vac->v...c", components, surface.geometry.frames)


@on_device
def divergence(surface: Surface, X: Float[AnyArray, "V *C"]) -> Float[Array, "V *S"]:
    """The surface divergence of a tangent vector field, positive where the field spreads out.

    The neighbours' vectors are transported into the tangent plane of the vertex and differentiated there with the
    weights of the gradient; the divergence is the trace. The normal part of X is ignored. It has the order of the
    gradient.

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
    along_x, along_y = surface.divergence_stencils
    return along_x(components[0]) + along_y(components[1])


@on_device
def laplacian(
    surface: Surface, u: Float[AnyArray, "V *S"], flux: Float[AnyArray, "..."] | None = None
) -> Float[Array, "V *S"]:
    """The Laplace-Beltrami operator, Delta u = div grad u: on the unit sphere ``laplacian(x1) = -2 x1``.

    ``Monotone`` sums differences with non-negative weights: pointwise first order on irregular meshes and second order
    on symmetric rings, and second order in solved problems. ``Polynomial`` has one order less than its degree; in
    solved problems it is of order 2 (degree 3) or 4 (degree 4), and its weights have both signs. On a boundary, both
    assume that the normal derivative vanishes unless a flux is given. ``Paper`` composes divergence and gradient, which
    does not converge pointwise on irregular meshes, and supports no flux.

    Args:
        surface: the surface.
        u: (V,) or (V, S).
        flux: the derivative of u along the outward conormal of the boundary, (V,) or (V, S); or the gradient of u,
            (V, 3) or (V, S, 3), which gives the flux on both sides of a corner. It is used at boundary vertices only
            and zero by default.

    Returns:
        The shape of u.

    Raises:
        ValueError: a flux was given for `Paper`, or does not fit u.

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 2; Wu, Chen and Chi, arXiv 1310.4807, for the configuration
    equation behind ``Monotone``.
    """
    _check_rows(surface, u, "u")
    rate = surface.laplacian_stencil(u)
    return rate if flux is None else add_flux(surface, rate, through_sides(surface, jnp.asarray(flux, u.dtype), u))


def through_sides(surface: Surface, flux: Float[Array, "V *C"], u: Float[AnyArray, "V *S"]) -> Float[Array, "2 B *S"]:
    """The flux of u through both sides of every boundary vertex, given a flux or a gradient as for `laplacian`."""
    at_boundary = flux[surface.topology.boundary]
    if flux.shape == u.shape:
        return jnp.broadcast_to(at_boundary[None], (2, *at_boundary.shape))
    if flux.shape != (*u.shape, 3):
        raise ValueError(f"Expected a flux of shape {u.shape}, or {(*u.shape, 3)} for a gradient, found {flux.shape}.")
    return jnp.einsum("b...c,bsc->sb...", at_boundary, surface.geometry.conormals)


def add_flux(
    surface: Surface,
    rate: Float[Array, "V *S"],
    through: Float[Array, "2 B *S"],
    weights: Float[Array, "B 2"] | None = None,
) -> Float[Array, "V *S"]:
    """The rate of an operator plus the contribution of fluxes through the sides of boundary vertices.

    Args:
        surface: the surface.
        rate: the operator applied to a field, without flux.
        through: (2, B) or (2, B, S), the fluxes.
        weights: (B, 2) the flux weights of the operator; those of the Laplacian by default.
    """
    weights = surface.geometry.flux_weights if weights is None else weights
    if weights is None:
        raise ValueError("Paper() supports no flux through a boundary. Use ltl.Monotone() or ltl.Polynomial().")
    added = jnp.einsum("sb...,bs->b...", through, weights)
    return rate.at[surface.topology.boundary].add(added, unique_indices=True)


@on_device
def weighted_laplacian(
    surface: Surface,
    conductivity: Float[AnyArray, " V"],
    u: Float[AnyArray, "V *S"],
    mean: Mean = "arithmetic",
) -> Float[Array, "V *S"]:
    """div(g grad u) for a conductivity g: ``sum_k c[k] m[k] (u_k - u_v)``.

    Here c are the weights of the Laplacian, and m[k] is the mean of g at the vertex and at neighbour k. The arithmetic
    mean is for a smooth g. The harmonic mean, ``2 g_k g_v / (g_k + g_v)``, is for a g that jumps: it is the
    conductivity of two conductors in series, so nothing flows to vertices where g is zero. A wall of such vertices
    separates its two sides if it is two vertices wide. A few rows that use two rings reach through a wall one vertex
    wide (none on icospheres, 2 of 1,182 beside a wall on a jittered sphere). In the harmonic mean a g that is zero or
    negative counts as zero and has no derivative.

    The operator has the order of the Laplacian if g is smooth. With ``Monotone`` and g >= 0 the weights are
    non-negative and the maximum principle holds. On a boundary the normal derivative of u is assumed to vanish. g may
    depend on u, which makes diffusion nonlinear.

    Args:
        surface: the surface.
        conductivity: g, (V,).
        u: (V,) or (V, S).
        mean: ``"arithmetic"`` or ``"harmonic"``; `Paper` supports only the first.

    Returns:
        The shape of u.
    """
    _check_rows(surface, u, "u")
    _check_rows(surface, conductivity, "conductivity")
    if mean not in ("arithmetic", "harmonic"):
        raise ValueError(f'Expected the mean "arithmetic" or "harmonic", found {mean!r}.')
    return surface.laplacian_stencil.with_conductivity(conductivity, mean)(u)


@on_device
def hessian(surface: Surface, u: Float[AnyArray, "V *S"]) -> Float[Array, "V *S 3 3"]:
    """The covariant second derivative of u, symmetric and tangent, in ambient coordinates.

    It comes from the same fit as the gradient, and its trace is the Laplacian wherever both use the same neighbours.
    ``Monotone`` is first order on irregular meshes and second order on symmetric rings; ``Polynomial`` has one order
    less than its degree on irregular meshes, and the next even order on symmetric rings.

    Args:
        surface: the surface.
        u: (V,) or (V, S).

    Returns:
        (V, 3, 3) or (V, S, 3, 3).

    Raises:
        ValueError: `Paper` has no second derivatives of its own.
    """
    _check_rows(surface, u, "u")
    xx, xy, yy = (stencil(u) for stencil in surface.hessian_stencils)
    components = jnp.stack([jnp.stack([xx, xy]), jnp.stack([xy, yy])])
    frames = surface.geometry.frames
    return jnp.einsum("abv...,vac,vbd->v...cd", components, frames, frames)


@on_device
def integrate(
    surface: Surface, u: Float[AnyArray, "V *S"], measure: Float[AnyArray, " V"] | None = None
) -> Float[Array, "*S"]:
    """The integral of u over the surface, second order.

    Args:
        surface: the surface.
        u: (V,) or (V, S).
        measure: the weight of each vertex, (V,); the vertex areas by default. With ``surface.mass`` the integral is
            constant while u diffuses.

    Returns:
        A scalar, or (S,).
    """
    _check_rows(surface, u, "u")
    weights = surface.vertex_areas if measure is None else measure
    _check_rows(surface, weights, "measure")
    return jnp.tensordot(weights, u, axes=1)


@on_surface
def laplacian_matrix(surface: Surface) -> scipy.sparse.csr_array:
    """The Laplacian as a SciPy sparse matrix (V, V), for solvers of other packages (host)."""
    return surface.laplacian_stencil.matrix()


def _check_rows(surface: Surface, field: AnyArray, name: str) -> None:
    if field.ndim == 0 or field.shape[0] != surface.num_vertices:
        raise ValueError(
            f"Expected {name} with one row per vertex, ({surface.num_vertices}, ...), found shape {field.shape}."
        )
