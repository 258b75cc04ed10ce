"""The curvature of a surface: of the smooth surface, from fits, or of the polyhedron, from its angles.

What enters: a surface. What leaves: its curvature at every vertex, in inverse lengths (mean) and inverse areas (Gauss).
docs/curvature.md says when to use which.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._lifting.jets import INTERIOR, height_jet, jet_weights
from .._lifting.ring import RingTopology, angle_sums, lifted_ring, offsets, take_slots
from .._surface import Surface, on_device, on_surface
from .._surface.creases import CREASE
from .._tables import AnyArray, Block, Table


class Curvature(eqx.Module):
    """The curvature of a smooth surface, positive where it bends away from the normal: 1 / R on a sphere of radius R.

    Attributes:
        shape_operator: (V, 3, 3) the derivative of the normal, symmetric and tangent, in ambient coordinates.
        mean: (V,) the mean curvature H, half the trace of the shape operator.
        gauss: (V,) the Gauss curvature K, the determinant of the shape operator in the tangent plane.
        principal: (V, 2) the principal curvatures, the larger first.
        directions: (V, 2, 3) the principal directions, as unit tangent vectors.
    """

    shape_operator: Float[Array, "V 3 3"]
    mean: Float[Array, " V"]
    gauss: Float[Array, " V"]
    principal: Float[Array, "V 2"]
    directions: Float[Array, "V 2 3"]


@on_surface
def curvature(surface: Surface) -> Curvature:
    """The curvature of a smooth surface, from the second derivatives of its height over each tangent plane.

    ``Monotone`` is first order on irregular meshes, ``Polynomial`` has order degree - 1. ``Monotone`` fits in the
    tangent plane with chord lengths under every lift, and is nearly exact on spheres. The fits are computed in float64
    on the host, once per surface. While a JAX transformation is tracing the surface they are computed in the widest
    float type that is switched on; in float32 they lose their accuracy at vertices whose edge lengths differ by a
    factor of more than three hundred. The result is differentiable in the vertices, except for the principal directions
    where both curvatures are equal. At a crease or a corner the curvature is a measure and not a function, and the
    fitted values grow as the mesh is refined: use `polyhedral_curvature` there, or if the integral must be exact.

    Args:
        surface: a `Monotone` or `Polynomial` surface.

    Raises:
        ValueError: `Paper` has no second derivatives of its own.
    """
    return _curvature(surface, _bending(surface))


@eqx.filter_jit
def _curvature(surface: Surface, bending: Float[Array, "3 V"]) -> Curvature:
    frames, (xx, xy, yy) = surface.geometry.frames, bending
    mean, gauss = (xx + yy) / 2, xx * yy - xy**2
    half, squared = (xx - yy) / 2, ((xx - yy) / 2) ** 2 + xy**2
    # If both curvatures are equal, the root has no derivative and the angle is arbitrary.
    is_umbilic = squared == 0
    root = jnp.where(is_umbilic, 0, jnp.sqrt(jnp.where(is_umbilic, 1, squared)))
    angle = jnp.arctan2(jnp.where(is_umbilic, 0, xy), jnp.where(is_umbilic, 1, half)) / 2
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    directions = jnp.stack([jnp.stack([cosine, sine], axis=-1), jnp.stack([-sine, cosine], axis=-1)], axis=1)
    components = jnp.stack([jnp.stack([xx, xy]), jnp.stack([xy, yy])])
    return Curvature(
        shape_operator=jnp.einsum("abv,vac,vbd->vcd", components, frames, frames),
        mean=mean,
        gauss=gauss,
        principal=jnp.stack([mean + root, mean - root], axis=-1),
        directions=jnp.einsum("vpa,vac->vpc", directions, frames),
    )


def _bending(surface: Surface) -> Float[Array, "3 V"]:
    """The second fundamental form xx, xy, yy in the frames."""
    if not surface.scheme.is_monotone:
        return _bending_of_positions(surface)
    table, places = surface.topology.jet, (surface.vertices, surface.normals, surface.geometry.frames)
    if surface.is_traced:
        wide = jnp.promote_types(jnp.result_type(float), surface.dtype)
        return _bending_of_heights(table, *(x.astype(wide) for x in places)).astype(surface.dtype)

    def on_the_host():
        host, *numbers = jax.device_get((table, *places))
        return _bending_of_heights(host, *(x.astype(np.float64) for x in numbers))

    return jnp.asarray(surface.remembered("bending", on_the_host), surface.dtype)


def _bending_of_heights(
    table: Table, vertices: Float[AnyArray, "V 3"], normals: Float[AnyArray, "V 3"], frames: Float[AnyArray, "V 2 3"]
) -> Float[AnyArray, "3 V"]:
    """The second fundamental form from quadratic fits of heights, exact on a sphere if the normals are exact."""

    def bending(block):
        edges = offsets(vertices, block)
        weights = jet_weights(lifted_ring(edges, block.centre(frames), "chord"), 2)
        return -height_jet(edges, block.centre(normals), weights)[2:].T

    return table.map(bending).T


def _bending_of_positions(surface: Surface) -> Float[Array, "3 V"]:
    """The second fundamental form xx, xy, yy in the frames, from the scheme's own second derivatives."""
    parts = jnp.stack([stencil(surface.vertices) for stencil in surface.hessian_stencils])
    return -jnp.sum(parts * surface.normals[None], axis=-1)


class PolyhedralCurvature(eqx.Module):
    """The curvature of a polyhedron, which is concentrated in its vertices and edges, divided by the vertex areas.

    Attributes:
        gauss: (V,) the angle defect 2 pi - T over the vertex area, where T is the sum of the face angles at the vertex;
            zero on the boundary.
        mean: (V,) a quarter of the sum over edges of length times dihedral angle, over the vertex area. Positive where
            the surface is convex, and 1 / R on a sphere of radius R.
        crease_mean: (V,) the part of ``mean`` that comes from creases, edges with a dihedral angle of more than 40
            degrees. This part grows as the mesh is refined; the remainder converges.
        turning: (V,) the angle pi - T by which the boundary turns at a vertex, zero in the interior. It is an angle,
            not a density.
    """

    gauss: Float[Array, " V"]
    mean: Float[Array, " V"]
    crease_mean: Float[Array, " V"]
    turning: Float[Array, " V"]


@on_device
def polyhedral_curvature(surface: Surface) -> PolyhedralCurvature:
    """The curvature of the mesh as a polyhedron, from angle defects and dihedral angles.

    Integrals are exact (Gauss and Bonnet): ``integrate(surface, gauss) + sum(turning)`` is 2 pi times the Euler
    characteristic on every mesh, and integrals over a region converge to those of the smooth surface. Values at single
    vertices do not converge on irregular meshes; those of `curvature` do. The result is differentiable in the vertices.

    Args:
        surface: a surface of any scheme.

    Example:
        >>> import ltljax as ltl
        >>> surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(3))
        >>> round(float(ltl.integrate(surface, ltl.operators.polyhedral_curvature(surface).gauss)), 3)  # 4 pi
        12.566

    Source: Cohen-Steiner and Morvan (2003), Restricted Delaunay triangulations and normal cycle,
    doi:10.1145/777792.777839.
    """
    ring, ring_blocks, areas = surface.topology.ring, surface.topology.ring_blocks, surface.vertex_areas

    def sums(block, topology):
        return angle_sums(offsets(surface.vertices, block), topology)

    def edge_sums(block, topology):
        length, angle = _dihedral(block, topology, surface.vertices)
        share = length * angle / 4
        creased = jnp.where(jnp.abs(angle) > np.radians(CREASE), share, 0)
        return jnp.stack([jnp.sum(share, axis=0), jnp.sum(creased, axis=0)], axis=-1)

    total = ring.map(sums, ring_blocks)
    mean, crease = jnp.moveaxis(ring.map(edge_sums, ring_blocks), -1, 0)
    is_boundary = surface.topology.kinds != INTERIOR
    return PolyhedralCurvature(
        gauss=jnp.where(is_boundary, 0, 2 * jnp.pi - total) / areas,
        mean=mean / areas,
        crease_mean=crease / areas,
        turning=jnp.where(is_boundary, jnp.pi - total, 0),
    )


def _dihedral(
    block: Block, topology: RingTopology, vertices: Float[AnyArray, "V 3"]
) -> tuple[Float[Array, "K N"], Float[Array, "K N"]]:
    """The length and the dihedral angle of the edge in every slot, both zero for edges without two proper faces."""
    edges = offsets(vertices, block)
    slots = edges.shape[0]
    following, preceding = topology.following(slots), topology.preceding(slots)
    slot = jnp.arange(slots, dtype=following.dtype)[:, None]
    is_interior = (following != slot) & ~(topology.is_boundary[None] & (slot == 0))
    left = jnp.cross(edges, take_slots(edges, following))
    right = jnp.cross(take_slots(edges, preceding), edges)
    squared = jnp.sum(edges**2, axis=-1)
    is_interior &= (squared > 0) & (jnp.sum(left**2, axis=-1) > 0) & (jnp.sum(right**2, axis=-1) > 0)
    length = jnp.sqrt(jnp.where(is_interior, squared, 1))
    # The sign of the angle: positive where the faces bend away from the normals.
    sine = jnp.sum(jnp.cross(left, right) * edges, axis=-1) / length
    angle = jnp.arctan2(jnp.where(is_interior, sine, 0), jnp.where(is_interior, jnp.sum(left * right, axis=-1), 1))
    return jnp.where(is_interior, length, 0), jnp.where(is_interior, angle, 0)
