"""How does a surface bend? As a smooth surface by fits, or as the polyhedron it is by its angles.

What enters: a surface. What leaves: its curvature at every vertex, in inverse lengths (mean) and inverse areas (Gauss).
docs/curvature.md says which of the two is right when.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._lifting.jets import INTERIOR, height_jet, jet_weights
from .._lifting.ring import RingTopology, angle_sums, lifted_ring, offsets, take_slots
from .._lifting.schemes import Monotone
from .._surface.building import CREASE
from .._surface.surface import Surface, on_device, on_surface
from .._tables import AnyArray, Block, Table
from .scalar import second_derivatives


class Curvature(eqx.Module):
    """How a surface bends. Positive where it bends away from the normal: a sphere of radius R has 1 / R.

    Attributes:
        shape_operator: (V, 3, 3) the derivative of the normal, symmetric and tangent, in ambient coordinates.
        mean: (V,) H, half its trace.
        gauss: (V,) K, its determinant in the tangent plane.
        principal: (V, 2) its eigenvalues, the larger first.
        directions: (V, 2, 3) the unit tangent vectors they belong to.
    """

    shape_operator: Float[Array, "V 3 3"]
    mean: Float[Array, " V"]
    gauss: Float[Array, " V"]
    principal: Float[Array, "V 2"]
    directions: Float[Array, "V 2 3"]


@on_surface
def curvature(surface: Surface) -> Curvature:
    """The curvature of a smooth surface, from the second derivatives of its height over each tangent plane.

    The result is of first order for ``Monotone`` on irregular meshes, and of order degree - 1 for ``Polynomial``.
    ``Monotone`` fits in the tangent plane with chord lengths, whatever its lift, and is nearly exact on spheres. The
    fits are made in float64 on the host, once for each surface; while a JAX transformation is tracing the surface they
    are made in the widest float that is switched on, and in float32 they lose their accuracy at vertices whose edges
    differ in length by more than three hundred times. Differentiable in the vertices, but for the principal directions
    where both curvatures are equal. At a crease or a corner the curvature of the surface is not a number but a measure,
    and the fit gives values that grow as the mesh is refined: take `polyhedral_curvature` there, and where the integral
    has to be exact.

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
    # Where both curvatures are equal the root has no derivative and the angle no value: any will do.
    is_umbilic = squared == 0
    root = jnp.where(is_umbilic, 0, jnp.sqrt(jnp.where(is_umbilic, 1, squared)))
    angle = jnp.arctan2(jnp.where(is_umbilic, 0, xy), jnp.where(is_umbilic, 1, half)) / 2
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    turned = jnp.stack([jnp.stack([cosine, sine], axis=-1), jnp.stack([-sine, cosine], axis=-1)], axis=1)
    components = jnp.stack([jnp.stack([xx, xy]), jnp.stack([xy, yy])])
    return Curvature(
        shape_operator=jnp.einsum("abv,vac,vbd->vcd", components, frames, frames),
        mean=mean,
        gauss=gauss,
        principal=jnp.stack([mean + root, mean - root], axis=-1),
        directions=jnp.einsum("vpa,vac->vpc", turned, frames),
    )


def _bending(surface: Surface) -> Float[Array, "3 V"]:
    """The second fundamental form xx, xy, yy in the frames."""
    if not isinstance(surface.scheme, Monotone):
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
    """From quadratic fits of heights over chord lengths. Exact on a sphere if the normals are."""

    def bending(block):
        seen = offsets(vertices, block)
        weights = jet_weights(lifted_ring(seen, block.centre(frames), "chord"), 2)
        return -height_jet(seen, block.centre(normals), weights)[2:].T

    return table.map(bending).T


def _bending_of_positions(surface: Surface) -> Float[Array, "3 V"]:
    """The second fundamental form xx, xy, yy in the frames, from the scheme's own second derivatives."""
    parts = jnp.stack(second_derivatives(surface, surface.vertices))
    return -jnp.sum(parts * surface.normals[None], axis=-1)


class PolyhedralCurvature(eqx.Module):
    """The curvature of a polyhedron, which lies in its vertices and edges, spread over the vertex areas.

    Attributes:
        gauss: (V,) K, the angle defect 2 pi - T over the vertex area, T the sum of the angles of the faces at the
            vertex; zero on the boundary.
        mean: (V,) H, a quarter of the sum over edges of length times dihedral angle, over the vertex area. Positive
            where the surface is convex, 1 / R on a sphere of radius R.
        crease_mean: (V,) the part of ``mean`` that lies in creases, edges that turn by more than 40 degrees. It grows
            as the mesh is refined; the rest converges.
        turning: (V,) the angle pi - T by which a boundary turns at a vertex; zero inside. An angle, not a density.
    """

    gauss: Float[Array, " V"]
    mean: Float[Array, " V"]
    crease_mean: Float[Array, " V"]
    turning: Float[Array, " V"]


@on_device
def polyhedral_curvature(surface: Surface) -> PolyhedralCurvature:
    """The curvature of a surface as the polyhedron it is, by angle defects and dihedral angles.

    Integrals are exact (Gauss and Bonnet): ``integrate(surface, gauss) + sum(turning)`` is 2 pi times the Euler
    characteristic, whatever the mesh, and integrals over a region converge to those of the smooth surface. Values at
    single vertices do not converge on irregular meshes, where `curvature` does. Differentiable in the vertices.

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

    def edges(block, topology):
        length, turn = _dihedral(block, topology, surface.vertices)
        bent = length * turn / 4
        creased = jnp.where(jnp.abs(turn) > np.radians(CREASE), bent, 0)
        return jnp.stack([jnp.sum(bent, axis=0), jnp.sum(creased, axis=0)], axis=-1)

    total = ring.map(sums, ring_blocks)
    mean, crease = jnp.moveaxis(ring.map(edges, ring_blocks), -1, 0)
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
    """The length of the edge in every slot, and the angle between its two faces, zero where it has not two."""
    seen = offsets(vertices, block)
    slots = seen.shape[0]
    following, preceding = topology.following(slots), topology.preceding(slots)
    slot = jnp.arange(slots, dtype=following.dtype)[:, None]
    has_two = (following != slot) & ~(topology.is_boundary[None] & (slot == 0))
    left = jnp.cross(seen, take_slots(seen, following))
    right = jnp.cross(take_slots(seen, preceding), seen)
    squared = jnp.sum(seen**2, axis=-1)
    has_two &= (squared > 0) & (jnp.sum(left**2, axis=-1) > 0) & (jnp.sum(right**2, axis=-1) > 0)
    length = jnp.sqrt(jnp.where(has_two, squared, 1))
    # The sine is that of the turn about the edge, which is positive where the faces bend away from the normals.
    sine = jnp.sum(jnp.cross(left, right) * seen, axis=-1) / length
    turn = jnp.arctan2(jnp.where(has_two, sine, 0), jnp.where(has_two, jnp.sum(left * right, axis=-1), 1))
    return jnp.where(has_two, length, 0), jnp.where(has_two, turn, 0)
