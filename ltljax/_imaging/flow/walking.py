"""Walkers that follow a vector field across the faces of a mesh, one straight segment at a time.

What enters: a surface, a tangent field on its vertices, and walkers. What leaves: the walkers after one segment, which
ends at the next edge or earlier.

A walker is a face and barycentric weights there, and a direction is the rate of change of these weights. Measuring
directions then takes edge lengths alone, and crossing an edge is a permutation. Inside a face the field is interpolated
from the corners, projected to the plane of the face and normalised.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._surface import Surface
from ..._tables import take

# Vectors shorter than this, relative to the longest one, count as zeros of the field.
VANISHES = 1e-6
CORNERS = np.arange(3, dtype=np.int32)[None]


class WalkFaces(eqx.Module):
    """The faces of a mesh with a vector field, as walkers need them. Edge i is opposite to corner i.

    Attributes:
        rates: (F, 3, 3) rate of change of the weight of corner i along the vector at corner k, at [face, k, i].
        squares: (F, 3) squared length of edge i.
        opposite_slot: (F, 3) index 3 g + j: corner j of the neighbouring face g, opposite the shared edge i. On a
            boundary, the index 3 f + i of corner i of this face f.
        unfolded_opposite: (F, 3, 3) weights of that corner in this face, at [face, i], when face g is unfolded into the
            plane of this face.
    """

    rates: Float[Array, "F 3 3"]
    squares: Float[Array, "F 3"]
    opposite_slot: Int[Array, "F 3"]
    unfolded_opposite: Float[Array, "F 3 3"]


class Walkers(eqx.Module):
    """Positions and directions of walkers.

    Attributes:
        face: (N,) face.
        weights: (N, 3) barycentric weights.
        heading: (N, 3) rates of the weights along the last segment.
        entered: (N,) edge through which the walker entered the face, or 3.
        is_walking: (N,) False once the walker has reached a boundary or a zero of the field.
    """

    face: Int[Array, " N"]
    weights: Float[Array, "N 3"]
    heading: Float[Array, "N 3"]
    entered: Int[Array, " N"]
    is_walking: Bool[Array, " N"]


def faces_along(surface: Surface, X: Float[Array, "V 3"]) -> WalkFaces:
    """The faces of a surface with the field X."""
    faces = surface.faces
    largest = jnp.max(jnp.sum(X**2, axis=1))
    X = X / jnp.sqrt(jnp.where(largest > 0, largest, 1))
    corners = take(surface.vertices, faces)
    edges = jnp.roll(corners, -2, axis=1) - jnp.roll(corners, -1, axis=1)
    cross = jnp.cross(edges[:, 0], edges[:, 1])
    doubled_areas = jnp.sqrt(jnp.maximum(jnp.sum(cross**2, axis=1), jnp.finfo(X.dtype).tiny))
    normals = cross / doubled_areas[:, None]
    slopes = jnp.cross(normals[:, None], edges) / doubled_areas[:, None, None]
    squares = jnp.sum(edges**2, axis=2)
    opposite_slot = _opposite_slots(faces)
    # Feet of the perpendiculars to edge i from the two opposite corners, as fractions of the edge from corner i + 1.
    feet = jnp.sum((corners - jnp.roll(corners, -1, axis=1)) * edges, axis=2) / squares
    opposite = corners.reshape(-1, 3)[opposite_slot]
    other_feet = jnp.sum((opposite - jnp.roll(corners, -1, axis=1)) * edges, axis=2) / squares
    first = -doubled_areas[opposite_slot // 3] / doubled_areas[:, None]
    third = other_feet - first * feet
    by_offset = jnp.stack([first, 1 - first - third, third], axis=2)
    offsets = (CORNERS[0][None, :] - CORNERS[0][:, None]) % 3
    unfolded = jnp.take_along_axis(by_offset, jnp.broadcast_to(offsets[None], by_offset.shape), axis=2)
    return WalkFaces(jnp.einsum("fic,fkc->fki", slopes, take(X, faces)), squares, opposite_slot, unfolded)


def start(faces: WalkFaces, face: Array, weights: Array, sign: float | Array) -> Walkers:
    """Walkers at points of faces, which will follow the field (sign 1) or go against it (-1)."""
    nearest = jnp.argmax(weights, axis=1)
    heading = sign * faces.rates[face, nearest]
    # Move starting points off vertices and edges, so that each walker leaves its face through the interior of an edge.
    weights = _inside(weights, jnp.full(face.shape, 3, jnp.int32))
    return Walkers(face, weights, heading, jnp.full(face.shape, 3, jnp.int32), jnp.ones(face.shape, bool))


def walk(
    faces: WalkFaces, walkers: Walkers, max_length: Array, sign: float | Array, is_directed: bool
) -> tuple[Walkers, Array, tuple[Array, Array]]:
    """One straight segment of each walker inside its face, by the midpoint rule, of at most ``max_length``.

    Returns:
        The walkers after the segment, the lengths they went, and the faces and weights of the segments' midpoints.
    """
    face, weights = walkers.face, walkers.weights
    rates, squares = faces.rates[face], faces.squares[face]

    def direction_at(weights: Array, heading: Array) -> tuple[Array, Array]:
        """The unit direction of the field, and whether it has one."""
        vectors = rates
        if not is_directed:
            is_opposite = _product(vectors, heading[:, None], squares[:, None]) < 0
            vectors = jnp.where(is_opposite[:, :, None], -vectors, vectors)
        direction = jnp.sum(weights[:, :, None] * vectors, axis=1) * (sign if is_directed else 1.0)
        direction = _kept_inside(direction, squares, walkers.entered)
        squared = _product(direction, direction, squares)
        is_nonzero = squared > VANISHES**2
        return direction / jnp.sqrt(jnp.where(is_nonzero, squared, 1))[:, None], is_nonzero

    direction, has_direction_at_start = direction_at(weights, walkers.heading)
    nearest = jnp.min(_distances(weights, direction, walkers.entered), axis=1)
    half = jnp.minimum(max_length, nearest)[:, None] / 2
    direction, has_direction_at_midpoint = direction_at(weights + half * direction, direction)
    distances = _distances(weights, direction, walkers.entered)
    edge = jnp.argmin(distances, axis=1).astype(jnp.int32)
    nearest = jnp.min(distances, axis=1)
    has_direction = walkers.is_walking & has_direction_at_start & has_direction_at_midpoint
    moves = has_direction & (max_length > 0)
    length = jnp.where(moves, jnp.minimum(max_length, nearest), 0)
    end = jnp.maximum(weights + length[:, None] * direction, 0)

    reaches_edge = moves & (nearest <= max_length)
    slot = jnp.take_along_axis(faces.opposite_slot[face], edge[:, None], axis=1)[:, 0]
    is_boundary = slot == 3 * face + edge
    crosses = reaches_edge & ~is_boundary
    on_edge = jnp.where(reaches_edge[:, None] & (edge[:, None] == CORNERS), 0, end)
    on_edge = on_edge / jnp.sum(on_edge, axis=1, keepdims=True)
    next_weights, next_heading = _across(faces, face, edge, slot % 3, on_edge, direction, is_directed)
    next_weights = jnp.where(crosses[:, None], next_weights, on_edge)
    next_heading = jnp.where(crosses[:, None], next_heading, direction)
    moved = Walkers(
        jnp.where(crosses, slot // 3, face),
        jnp.where(moves[:, None], next_weights, weights),
        jnp.where(moves[:, None], next_heading, walkers.heading),
        jnp.where(crosses, slot % 3, jnp.where(moves, 3, walkers.entered)),
        (has_direction & ~(reaches_edge & is_boundary)) | (walkers.is_walking & (max_length <= 0)),
    )
    return moved, length, (face, (weights + end) / 2)


def _across(
    faces: WalkFaces, face: Array, edge: Array, j: Array, weights: Array, direction: Array, is_directed: bool
) -> tuple[Array, Array]:
    """Weights and direction in the corners of the neighbouring face, whose corner j is opposite the edge crossed.

    For a field without sign, the direction is unfolded into the next face. A directed field does not use it.
    """
    order = (edge[:, None] + j[:, None] - CORNERS) % 3
    next_weights = _inside(jnp.take_along_axis(weights, order, axis=1), j)
    if is_directed:
        return next_weights, direction
    opposite = jnp.take_along_axis(faces.unfolded_opposite[face, edge], order, axis=1)
    permuted = jnp.take_along_axis(direction, order, axis=1)
    is_j = j[:, None] == CORNERS
    rate_of_j = jnp.sum(jnp.where(is_j, permuted / opposite, 0), axis=1, keepdims=True)
    return next_weights, jnp.where(is_j, rate_of_j, permuted - rate_of_j * opposite)


def _opposite_slots(faces: Array) -> Int[Array, "F 3"]:
    """The corner opposite each edge in the neighbouring face, as in `WalkFaces.opposite_slot`."""
    first, second = jnp.roll(faces, -1, axis=1).reshape(-1), jnp.roll(faces, -2, axis=1).reshape(-1)
    low, high = jnp.minimum(first, second), jnp.maximum(first, second)
    order = jnp.lexsort((high, low)).astype(jnp.int32)
    low, high = low[order], high[order]
    is_pair = (low[1:] == low[:-1]) & (high[1:] == high[:-1])
    false = jnp.zeros(1, bool)
    is_second, is_first = jnp.concatenate([false, is_pair]), jnp.concatenate([is_pair, false])
    partner = jnp.where(is_first, jnp.roll(order, -1), jnp.where(is_second, jnp.roll(order, 1), order))
    return jnp.zeros_like(order).at[order].set(partner, unique_indices=True).reshape(faces.shape)


def _product(p: Array, q: Array, squares: Array) -> Array:
    """The scalar product of two directions, given as rates of barycentric weights, which sum to zero."""
    mixed = p * jnp.roll(q, -1, axis=-1) + jnp.roll(p, -1, axis=-1) * q
    return -jnp.sum(mixed * jnp.roll(squares, -2, axis=-1), axis=-1) / 2


def _kept_inside(direction: Array, squares: Array, entered: Array) -> Array:
    """The direction; if it points back across the edge just crossed, its part along that edge.

    This happens where the fields of both faces point towards the edge.
    """
    order = (entered[:, None] + CORNERS) % 3
    inwards, _, second = (jnp.take_along_axis(direction, order[:, k : k + 1], axis=1)[:, 0] for k in range(3))
    edge, to_second, to_first = (jnp.take_along_axis(squares, order[:, k : k + 1], axis=1)[:, 0] for k in range(3))
    # The rate from the first corner of the edge to its second, in units of the edge.
    slide = second + inwards * (to_first + edge - to_second) / (2 * edge)
    tangential = jnp.stack([jnp.zeros_like(slide), -slide, slide], axis=1)
    tangential = jnp.take_along_axis(tangential, (CORNERS - entered[:, None]) % 3, axis=1)
    return jnp.where(((entered < 3) & (inwards < 0))[:, None], tangential, direction)


def _distances(weights: Array, direction: Array, entered: Array) -> Array:
    """The distance to each edge along a direction; infinite for edges that it does not approach."""
    approaches = (direction < 0) & (entered[:, None] != CORNERS)
    return jnp.where(approaches, -weights / jnp.where(approaches, direction, 1), jnp.inf)


def _inside(weights: Array, entered: Array) -> Array:
    """The weights moved slightly away from every edge except the one just crossed."""
    least = jnp.finfo(weights.dtype).eps ** (2 / 3)
    moved = jnp.where(entered[:, None] == CORNERS, 0, jnp.maximum(weights, least))
    return moved / jnp.sum(moved, axis=1, keepdims=True)
