"""The operators of calculus on a surface: ``(surface, field) -> field``.

Fields live on vertices: ``(V,)``, or ``(V, S)`` for S species at once. Vector fields are tangent, in ambient
coordinates. Every operator is jit-compiled, linear in the field, and differentiable in the field and (through
`Surface.with_vertices`) in the vertices.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float

from .surface import Surface
from .tables import AnyArray, coordinates, difference_sum, slot_sum


@eqx.filter_jit
def gradient(surface: Surface, u: Float[AnyArray, "V *S"]) -> Float[Array, "V *S 3"]:
    """The surface gradient of u, tangent, in ambient coordinates.

    ``Monotone``: the quadratic fit on the lifted ring, second order. ``Paper``: the mean of affine gradients over the
    faces, first order on irregular meshes and second on symmetric rings.

    Args:
        surface: the surface.
        u: (V,) or (V, S).

    Returns:
        (V, 3) or (V, S, 3).

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 2.
    """
    _check_rows(surface, u, "u")
    return _to_ambient(surface, *_gradient_in_frame(surface, u))


@eqx.filter_jit
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


@eqx.filter_jit
def laplacian(surface: Surface, u: Float[AnyArray, "V *S"]) -> Float[Array, "V *S"]:
    """The Laplace-Beltrami operator, Delta u = div grad u: on the unit sphere ``laplacian(x1) = -2 x1``.

    ``Monotone``: one sum over non-negative weights; pointwise first order on irregular meshes and second on symmetric
    rings, second order in solved problems; on a boundary, for fields whose normal derivative vanishes. ``Paper``: the
    divergence of the gradient, which does not converge pointwise on irregular meshes.

    Args:
        surface: the surface.
        u: (V,) or (V, S).

    Returns:
        The same shape.

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 2; Wu, Chen and Chi, arXiv 1310.4807, for the configuration
    equation behind ``Monotone``.
    """
    _check_rows(surface, u, "u")
    table, weights = surface.topology.diffusion, surface.geometry.laplacian_weights
    if table is None or weights is None:
        return _divergence_in_frame(surface, *_gradient_in_frame(surface, u))
    return difference_sum(table, weights, u)


@eqx.filter_jit
def integrate(surface: Surface, u: Float[AnyArray, "V *S"]) -> Float[Array, "*S"]:
    """The integral of u over the surface, with the vertex areas as quadrature: second order.

    Args:
        surface: the surface.
        u: (V,) or (V, S).

    Returns:
        A scalar, or (S,).
    """
    _check_rows(surface, u, "u")
    return jnp.tensordot(surface.vertex_areas, u, axes=1)


def laplacian_matrix(surface: Surface) -> scipy.sparse.csr_array:
    """The Laplacian as a SciPy sparse matrix (V, V), for other people's solvers (host)."""
    geometry, topology = surface.geometry, surface.topology
    if topology.diffusion is not None:
        return _difference_matrix(topology.diffusion, geometry.laplacian_weights)
    centre = np.asarray(geometry.divergence_centre)
    parts = [
        (_difference_matrix(topology.jet, divergence) + scipy.sparse.diags_array(centre[:, axis]))
        @ _difference_matrix(topology.jet, geometry.gradient_weights[axis])
        for axis, divergence in enumerate(geometry.divergence_weights)
    ]
    return scipy.sparse.csr_array(parts[0] + parts[1])


@eqx.filter_jit
def spectral_bound(surface: Surface) -> Float[Array, ""]:
    """An upper bound of the magnitude of the Laplacian's eigenvalues, by Gershgorin's discs.

    For the non-negative rows of ``Monotone`` it is twice the largest row sum, and every eigenvalue lies in the disc
    between its negative and zero. For ``Paper`` it bounds the product of divergence and gradient.
    """
    geometry, topology = surface.geometry, surface.topology
    if topology.diffusion is not None and geometry.laplacian_weights is not None:
        return 2 * jnp.max(slot_sum(topology.diffusion, geometry.laplacian_weights))
    size = functools.partial(jax.tree.map, jnp.abs)
    steep = sum(slot_sum(topology.jet, size(weights)) for weights in geometry.gradient_weights)
    spread = sum(slot_sum(topology.jet, size(weights)) for weights in geometry.divergence_weights)
    return (2 * jnp.max(spread) + jnp.max(jnp.abs(geometry.divergence_centre))) * 2 * jnp.max(steep)


def _gradient_in_frame(surface: Surface, u: Array) -> tuple[Array, Array]:
    along_e1, along_e2 = surface.geometry.gradient_weights
    table = surface.topology.jet
    return difference_sum(table, along_e1, u), difference_sum(table, along_e2, u)


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


def _difference_matrix(table, weights) -> scipy.sparse.csr_array:
    rows, columns, values = coordinates(table, weights)
    size = table.num_vertices
    neighbours = scipy.sparse.csr_array((values, (rows, columns)), shape=(size, size))
    return scipy.sparse.csr_array(neighbours - scipy.sparse.diags_array(np.asarray(slot_sum(table, weights))))
