"""What a closed mesh encloses, and how moved vertices are given it back.

What enters: vertices and the volumes wanted. What leaves: volumes, and vertices shifted along their normals.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..._surface import Surface
from ..._tables import AnyArray

# Newton's method on a cubic that is nearly straight: each step doubles the digits.
_NEWTON = 4


def enclosed_volume(vertices: Float[AnyArray, "V 3"], faces: Int[AnyArray, "F 3"]) -> Float[Array, ""]:
    """The volume that a closed mesh encloses, positive where its normals point outwards.

    The sum of det(a, b, c) / 6 over the faces: exact for the mesh, second order for the surface it stands for.

    Args:
        vertices: (V, 3).
        faces: (F, 3), of a closed mesh.
    """
    vertices = jnp.asarray(vertices)
    # From a point near by, so that a shape far from the origin does not cancel.
    return jnp.sum(_cones(vertices - jnp.mean(vertices, axis=0)[None], faces))


def _cones(vertices: Array, faces: AnyArray) -> Array:
    """The signed volume between the origin and each face, (F,)."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return jnp.sum(a * jnp.cross(b, c), axis=1) / 6


def volumes(surface: Surface, vertices: Array) -> Array:
    """What each component encloses, (C,)."""
    topology = surface.topology
    cones = _cones(vertices - jnp.mean(vertices, axis=0)[None], topology.faces)
    component = topology.components[topology.faces[:, 0]]
    return jax.ops.segment_sum(cones, component, num_segments=topology.num_components)


def with_volumes(surface: Surface, vertices: Array, wanted: Array) -> Array:
    """The vertices shifted along their normals, equally on each component, so that it encloses a given volume."""
    normals = jax.grad(lambda x: jnp.sum(volumes(surface, x)))(vertices)
    normals = normals / jnp.sqrt(jnp.maximum(jnp.sum(normals**2, axis=1, keepdims=True), jnp.finfo(normals.dtype).tiny))

    def shifted(shift):
        return vertices + shift[surface.topology.components][:, None] * normals

    shift = jnp.zeros_like(wanted)
    for _ in range(_NEWTON):
        now, slope = jax.jvp(lambda shift: volumes(surface, shifted(shift)), (shift,), (jnp.ones_like(shift),))
        shift = shift + (wanted - now) / slope
    return shifted(shift)


def check_volume(surface: Surface, keep_volume: bool) -> None:
    """Raise where volume is to be kept and there is none."""
    loops = surface.topology.num_loops
    if keep_volume and loops:
        raise ValueError(
            f"Expected a closed surface to keep the volume of, found {loops} boundary loop{'s' * (loops > 1)}, and so "
            "none that it encloses. Leave keep_volume out, or close the holes."
        )
