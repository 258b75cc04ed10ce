"""The volume that a closed mesh encloses, and a shift of its vertices that restores it.

What enters: vertices and target volumes. What leaves: volumes, and vertices shifted along their normals.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..._surface import Surface
from ..._tables import AnyArray

# The volume is nearly linear in the shift, so a few iterations reach rounding error.
_NEWTON_ITERATIONS = 4


def enclosed_volume(vertices: Float[AnyArray, "V 3"], faces: Int[AnyArray, "F 3"]) -> Float[Array, ""]:
    """The volume that a closed mesh encloses, positive where its normals point outwards.

    The sum of det(a, b, c) / 6 over the faces is exact for the mesh, and second order accurate for the smooth surface
    that the mesh approximates.

    Args:
        vertices: (V, 3) positions.
        faces: (F, 3) faces of a closed mesh.
    """
    vertices = jnp.asarray(vertices)
    # Cones from a nearby point avoid cancellation if the shape is far from the origin.
    return jnp.sum(_cones(vertices - jnp.mean(vertices, axis=0)[None], faces))


def _cones(vertices: Array, faces: AnyArray) -> Array:
    """The signed volume between the origin and each face, (F,)."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return jnp.sum(a * jnp.cross(b, c), axis=1) / 6


def volumes(surface: Surface, vertices: Array) -> Array:
    """The volume that each connected component encloses, (C,)."""
    topology = surface.topology
    cones = _cones(vertices - jnp.mean(vertices, axis=0)[None], topology.faces)
    component = topology.components[topology.faces[:, 0]]
    return jax.ops.segment_sum(cones, component, num_segments=topology.num_components)


def with_volumes(surface: Surface, vertices: Array, targets: Array) -> Array:
    """The vertices shifted along their normals, by one distance per component, so that each has its target volume."""
    normals = jax.grad(lambda x: jnp.sum(volumes(surface, x)))(vertices)
    normals = normals / jnp.sqrt(jnp.maximum(jnp.sum(normals**2, axis=1, keepdims=True), jnp.finfo(normals.dtype).tiny))

    def shifted(shift):
        return vertices + shift[surface.topology.components][:, None] * normals

    shift = jnp.zeros_like(targets)
    for _ in range(_NEWTON_ITERATIONS):
        volume, slope = jax.jvp(lambda shift: volumes(surface, shifted(shift)), (shift,), (jnp.ones_like(shift),))
        shift = shift + (targets - volume) / slope
    return shifted(shift)


def check_volume(surface: Surface, keep_volume: bool) -> None:
    """Raise if volume is to be kept but the surface is not closed."""
    loops = surface.topology.num_loops
    if keep_volume and loops:
        raise ValueError(
            f"Expected a closed surface for keep_volume=True, found {loops} boundary loop{'s' * (loops > 1)}, so it "
            "encloses no volume. Leave keep_volume out, or close the holes."
        )
