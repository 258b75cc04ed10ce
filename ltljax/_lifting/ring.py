"""The one-ring of a vertex: its faces, its normal, and its image in the tangent plane.

The lifts here map positions in space: "projection" and "chord". The lift in charts, by edge lengths alone, is in
`intrinsic`.

Rings are slot-major: ``offsets[k, v]`` is the position of neighbour k of vertex v relative to v. Neighbours are in
counter-clockwise order, and an empty slot holds zero. Face k lies between slots k and k + 1. The ring of an interior
vertex is closed; the ring of a boundary vertex is open.
"""

from typing import Literal

import equinox as eqx
from jaxtyping import Bool, Float, Int

from .._tables import AnyArray, Block
from .frames import unit

Lift = Literal["projection", "chord"]

# A face is dropped when its area, or the distance from the vertex to its centroid, is below this fraction of its edges.
DEGENERATE = 1e-12


class RingTopology(eqx.Module):
    """Which slots of a block of rings hold neighbours, and which pairs of consecutive slots bound a face.

    Attributes:
        valences: number of neighbours of each vertex.
        is_boundary: whether each vertex lies on a boundary.
    """

    valences: Int[AnyArray, " N"]
    is_boundary: Bool[AnyArray, " N"]

    def following(self, num_slots: int) -> Int[AnyArray, "K N"]:
        """The slot after each slot, or the slot itself where no face follows: the missing face then has zero area."""
        xp = self.valences.__array_namespace__()
        slot = xp.arange(num_slots, dtype=self.valences.dtype)[:, None]
        valences = self.valences[None]
        wrapped = xp.where(self.is_boundary[None], slot, 0)
        return xp.where(slot + 1 < valences, slot + 1, xp.where(slot < valences, wrapped, slot))

    def preceding(self, num_slots: int) -> Int[AnyArray, "K N"]:
        """The slot before each slot, cyclically. An empty slot is its own predecessor."""
        xp = self.valences.__array_namespace__()
        slot = xp.arange(num_slots, dtype=self.valences.dtype)[:, None]
        valences = self.valences[None]
        return xp.where(slot < valences, xp.where(slot > 0, slot - 1, valences - 1), slot)


def offsets(vertices: Float[AnyArray, "V 3"], block: Block) -> Float[AnyArray, "K N 3"]:
    """Positions of the neighbours relative to the vertex of their row; exactly zero in an empty slot.

    If positions are computed in the same jit, XLA may recompute them for each operand of the difference and round
    differently. A nearly empty slot would then count as a neighbour.
    """
    relative = block.neighbours(vertices) - block.centre(vertices)[None]
    return relative.__array_namespace__().where(block.is_used[..., None], relative, 0)


def take_slots(values: Float[AnyArray, "K N *C"], slots: Int[AnyArray, "J N"]) -> Float[AnyArray, "J N *C"]:
    """The values of each row, reordered by ``slots``."""
    index = slots.reshape(*slots.shape, *(1,) * (values.ndim - 2))
    return values.__array_namespace__().take_along_axis(values, index, axis=0)


def last_slot(values: Float[AnyArray, "K N C"], topology: RingTopology) -> Float[AnyArray, "N C"]:
    """The value in the last used slot of each row."""
    last = (topology.valences - 1).clip(0)
    return take_slots(values, last[None])[0]


def centroid_normals(offsets: Float[AnyArray, "K N 3"], topology: RingTopology) -> Float[AnyArray, "N 3"]:
    """Unit normals: the mean of the face normals with weights |G - v|^-2, where G is the centroid of the face.

    First order in the mesh size on irregular meshes, second order where rings are symmetric. Faces of zero area are
    left out of the mean.

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 2 (centroid weights).
    """
    xp = offsets.__array_namespace__()
    following = take_slots(offsets, topology.following(offsets.shape[0]))
    face_normals = xp.cross(offsets, following)
    squared_area = xp.sum(face_normals**2, axis=-1)
    squared_edges = xp.sum(offsets**2, axis=-1) * xp.sum(following**2, axis=-1)
    squared_distance = xp.sum((offsets + following) ** 2, axis=-1) / 9
    has_face = squared_area > DEGENERATE**2 * squared_edges
    weight = 1 / xp.where(has_face, xp.sqrt(xp.where(has_face, squared_area, 1)) * squared_distance, 1)
    return unit(xp.sum(xp.where(has_face, weight, 0)[..., None] * face_normals, axis=0))


def inverted_normals(offsets: Float[AnyArray, "K N 3"], topology: RingTopology) -> Float[AnyArray, "N 3"]:
    """Unit normals: the sum over faces of a x b / (|a|^2 |b|^2), where a and b are the edges at the vertex.

    First order in the mesh size, and exact where the vertex and its ring lie on a sphere. The sign is chosen to agree
    with the vector area of the ring, the sum of a x b. For a closed ring this sum does not depend on the vertex, so the
    sign stays correct when some faces are folded over.

    Source: Max (1999), Weights for computing vertex normals from facet normals, doi:10.1080/10867651.1999.10487501.
    """
    xp = offsets.__array_namespace__()
    squared = xp.sum(offsets**2, axis=-1, keepdims=True)
    largest = xp.max(squared, axis=0)[None]
    inverted = offsets * xp.where(squared > 0, largest / xp.where(squared > 0, squared, 1), 0)
    following = take_slots(inverted, topology.following(offsets.shape[0]))
    normals = unit(xp.sum(xp.cross(inverted, following), axis=0))
    area = xp.sum(xp.cross(offsets, take_slots(offsets, topology.following(offsets.shape[0]))), axis=0)
    return normals * xp.where(xp.sum(normals * area, axis=-1, keepdims=True) < 0, -1, 1).astype(normals.dtype)


def angle_weighted_normals(offsets: Float[AnyArray, "K N 3"], topology: RingTopology) -> Float[AnyArray, "N 3"]:
    """Unit normals: the mean of the face normals, weighted by the angle of each face at the vertex.

    First order in the mesh size on smooth surfaces. The result does not depend on how planar regions are triangulated:
    on a crease between two planes it bisects the angle between their normals.

    Source: Thurmer and Wuthrich (1998), Computing vertex normals from polygonal facets,
    doi:10.1080/10867651.1998.10487487.
    """
    xp = offsets.__array_namespace__()
    following = take_slots(offsets, topology.following(offsets.shape[0]))
    face_normals = xp.cross(offsets, following)
    squared = xp.sum(face_normals**2, axis=-1)
    has_face = squared > 0
    sine = xp.sqrt(xp.where(has_face, squared, 1))
    angle = xp.arctan2(sine, xp.sum(offsets * following, axis=-1))
    return unit(xp.sum(xp.where(has_face, angle / sine, 0)[..., None] * face_normals, axis=0))


def angle_sums(offsets: Float[AnyArray, "K N 3"], topology: RingTopology) -> Float[AnyArray, " N"]:
    """The sum of the face angles at each vertex, in radians."""
    xp = offsets.__array_namespace__()
    following = take_slots(offsets, topology.following(offsets.shape[0]))
    squared = xp.sum(xp.cross(offsets, following) ** 2, axis=-1)
    has_face = squared > 0
    angle = xp.arctan2(xp.sqrt(xp.where(has_face, squared, 1)), xp.sum(offsets * following, axis=-1))
    return xp.sum(xp.where(has_face, angle, 0), axis=0)


def lifted_ring(
    offsets: Float[AnyArray, "K N 3"], frames: Float[AnyArray, "N 2 3"], lift: Lift
) -> Float[AnyArray, "K N 2"]:
    """The ring in the tangent plane, in the coordinates of the frame.

    ``"projection"`` drops the normal component, as in the paper; lengths shrink. ``"chord"`` keeps the projected
    direction and the length |v_i - v|, which is closer to the distance along the surface.
    """
    xp = offsets.__array_namespace__()
    projected = xp.einsum("knc,nac->kna", offsets, frames)
    if lift == "projection":
        return projected
    squared = xp.sum(projected**2, axis=-1, keepdims=True)
    chord = xp.sum(offsets**2, axis=-1, keepdims=True)
    # A neighbour straight above the vertex has no direction, so it is lifted to the origin, where its weight is zero.
    has_direction = squared > DEGENERATE**2 * chord
    ratio = xp.sqrt(xp.where(has_direction, chord, 1) / xp.where(has_direction, squared, 1))
    return xp.where(has_direction, projected * ratio, 0)
