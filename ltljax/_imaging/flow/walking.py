"""How a walker goes along a vector field over the faces of a mesh: one straight stretch at a time, to the next edge.

What enters: a surface and a tangent field on its vertices, and walkers. What leaves: the walkers after a stretch.

A walker knows its face and its barycentric weights there, and directions are rates of these weights: nothing but edge
lengths is needed to measure them, and a step over an edge is a permutation. Inside a face the field is interpolated
from the corners, its part in the plane of the face taken, and its length left out.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._surface import Surface
from ..._tables.table import take

# Shorter than this share of the longest vector a vector has no direction.
VANISHES = 1e-6
CORNERS = np.arange(3, dtype=np.int32)[None]


class Faces(eqx.Module):
    """The faces as a walker sees them. Edge i is opposite to corner i.

    Attributes:
        rates: (F, 3, 3) how fast the weight of corner i changes along the vector at corner k, at [face, k, i].
        squares: (F, 3) the squared length of edge i.
        behind: (F, 3) of the face g behind edge i and the corner j that is opposite there, 3 g + j; on a boundary the
            edge itself, 3 f + i.
        apexes: (F, 3, 3) the weights in this face of that corner, with the face g unfolded into the plane.
    """

    rates: Float[Array, "F 3 3"]
    squares: Float[Array, "F 3"]
    behind: Int[Array, "F 3"]
    apexes: Float[Array, "F 3 3"]


class Walkers(eqx.Module):
    """Where walkers are.

    Attributes:
        face: (N,).
        weights: (N, 3) barycentric.
        heading: (N, 3) the rates of the weights along the last stretch.
        entered: (N,) the edge they came in by, 3 if none.
        walks: (N,) false once they have met a boundary, or a zero of the field.
    """

    face: Int[Array, " N"]
    weights: Float[Array, "N 3"]
    heading: Float[Array, "N 3"]
    entered: Int[Array, " N"]
    walks: Bool[Array, " N"]


def faces_along(surface: Surface, X: Float[Array, "V 3"]) -> Faces:
    """The faces of a surface with a field on them."""
    faces = surface.faces
    largest = jnp.max(jnp.sum(X**2, axis=1))
    X = X / jnp.sqrt(jnp.where(largest > 0, largest, 1))
    corners = take(surface.vertices, faces)
    edges = jnp.roll(corners, -2, axis=1) - jnp.roll(corners, -1, axis=1)
    across = jnp.cross(edges[:, 0], edges[:, 1])
    doubled = jnp.sqrt(jnp.maximum(jnp.sum(across**2, axis=1), jnp.finfo(X.dtype).tiny))
    unit = across / doubled[:, None]
    slopes = jnp.cross(unit[:, None], edges) / doubled[:, None, None]
    squares = jnp.sum(edges**2, axis=2)
    behind = _behind(faces)
    # Along edge i, from corner i + 1: where the corners opposite to it on either side have their feet.
    feet = jnp.sum((corners - jnp.roll(corners, -1, axis=1)) * edges, axis=2) / squares
    opposite = corners.reshape(-1, 3)[behind]
    other_feet = jnp.sum((opposite - jnp.roll(corners, -1, axis=1)) * edges, axis=2) / squares
    own = -doubled[behind // 3] / doubled[:, None]
    second = other_feet - own * feet
    by_offset = jnp.stack([own, 1 - own - second, second], axis=2)
    offsets = (CORNERS[0][None, :] - CORNERS[0][:, None]) % 3
    apexes = jnp.take_along_axis(by_offset, jnp.broadcast_to(offsets[None], by_offset.shape), axis=2)
    return Faces(jnp.einsum("fic,fkc->fki", slopes, take(X, faces)), squares, behind, apexes)


def start(faces: Faces, face: Array, weights: Array, sense: float | Array) -> Walkers:
    """Walkers at points of faces, ready to go along the field (sense 1) or against it (-1)."""
    nearest = jnp.argmax(weights, axis=1)
    heading = sense * faces.rates[face, nearest]
    # Off vertices and edges, so that every way out of the face is through the inside of one edge.
    weights = _inside(weights, jnp.full(face.shape, 3, jnp.int32))
    return Walkers(face, weights, heading, jnp.full(face.shape, 3, jnp.int32), jnp.ones(face.shape, bool))


def walk(
    faces: Faces, walkers: Walkers, room: Array, sense: float | Array, is_directed: bool
) -> tuple[Walkers, Array, tuple[Array, Array]]:
    """A straight stretch of each walker inside its face, at most ``room`` long: the walkers after it, how far they
    went, and the face and weights of its middle."""
    face, weights = walkers.face, walkers.weights
    rates, squares = faces.rates[face], faces.squares[face]

    def along(at: Array, heading: Array) -> tuple[Array, Array]:
        corners = rates
        if not is_directed:
            turned = _product(corners, heading[:, None], squares[:, None]) < 0
            corners = jnp.where(turned[:, :, None], -corners, corners)
        direction = jnp.sum(at[:, :, None] * corners, axis=1) * (sense if is_directed else 1.0)
        direction = _kept_inside(direction, squares, walkers.entered)
        squared = _product(direction, direction, squares)
        has_one = squared > VANISHES**2
        return direction / jnp.sqrt(jnp.where(has_one, squared, 1))[:, None], has_one

    direction, has_one = along(weights, walkers.heading)
    reach = jnp.min(_reach(weights, direction, walkers.entered), axis=1)
    half = jnp.minimum(room, reach)[:, None] / 2
    direction, has_still = along(weights + half * direction, direction)
    reach = _reach(weights, direction, walkers.entered)
    goes = walkers.walks & has_one & has_still & (room > 0)
    out = jnp.argmin(reach, axis=1).astype(jnp.int32)
    nearest = jnp.min(reach, axis=1)
    crosses = goes & (nearest <= room)
    gone = jnp.where(goes, jnp.minimum(room, nearest), 0)
    after = jnp.maximum(weights + gone[:, None] * direction, 0)
    middle = (weights + after) / 2

    slot = jnp.take_along_axis(faces.behind[face], out[:, None], axis=1)[:, 0]
    is_rim = slot == 3 * face + out
    over = crosses & ~is_rim
    j = slot % 3
    after = jnp.where(crosses[:, None] & (out[:, None] == CORNERS), 0, after)
    after = after / jnp.sum(after, axis=1, keepdims=True)
    order = (out[:, None] + j[:, None] - CORNERS) % 3
    heading = direction
    if not is_directed:
        apex = jnp.take_along_axis(faces.apexes[face, out], order, axis=1)
        turned = jnp.take_along_axis(direction, order, axis=1)
        at_j = j[:, None] == CORNERS
        share = jnp.sum(jnp.where(at_j, turned / apex, 0), axis=1, keepdims=True)
        heading = jnp.where(over[:, None], jnp.where(at_j, share, turned - share * apex), direction)
    after = jnp.where(over[:, None], _inside(jnp.take_along_axis(after, order, axis=1), j), after)
    entered = jnp.where(over, j, jnp.where(goes, 3, walkers.entered))
    walks = walkers.walks & has_one & has_still & ~(crosses & is_rim)
    moved = Walkers(
        jnp.where(over, slot // 3, face),
        jnp.where(goes[:, None], after, weights),
        jnp.where(goes[:, None], heading, walkers.heading),
        entered,
        walks | (walkers.walks & (room <= 0)),
    )
    return moved, gone, (face, middle)


def _behind(faces: Array) -> Int[Array, "F 3"]:
    one, other = jnp.roll(faces, -1, axis=1).reshape(-1), jnp.roll(faces, -2, axis=1).reshape(-1)
    low, high = jnp.minimum(one, other), jnp.maximum(one, other)
    order = jnp.lexsort((high, low)).astype(jnp.int32)
    low, high = low[order], high[order]
    is_pair = (low[1:] == low[:-1]) & (high[1:] == high[:-1])
    none = jnp.zeros(1, bool)
    before, after = jnp.concatenate([none, is_pair]), jnp.concatenate([is_pair, none])
    partner = jnp.where(after, jnp.roll(order, -1), jnp.where(before, jnp.roll(order, 1), order))
    return jnp.zeros_like(order).at[order].set(partner, unique_indices=True).reshape(faces.shape)


def _product(p: Array, q: Array, squares: Array) -> Array:
    """The scalar product of two directions given as rates, whose sums are zero."""
    mixed = p * jnp.roll(q, -1, axis=-1) + jnp.roll(p, -1, axis=-1) * q
    return -jnp.sum(mixed * jnp.roll(squares, -2, axis=-1), axis=-1) / 2


def _kept_inside(direction: Array, squares: Array, entered: Array) -> Array:
    """The direction, or where it leads back over the edge just crossed its part along that edge.

    There the field leads to the edge from both sides, as into a valley.
    """
    order = (entered[:, None] + CORNERS) % 3
    inwards, _, second = (jnp.take_along_axis(direction, order[:, k : k + 1], axis=1)[:, 0] for k in range(3))
    own, to_second, to_first = (jnp.take_along_axis(squares, order[:, k : k + 1], axis=1)[:, 0] for k in range(3))
    # From the first corner of the edge to its second, in units of the edge.
    slide = second + inwards * (to_first + own - to_second) / (2 * own)
    along = jnp.stack([jnp.zeros_like(slide), -slide, slide], axis=1)
    back = jnp.take_along_axis(along, (CORNERS - entered[:, None]) % 3, axis=1)
    return jnp.where(((entered < 3) & (inwards < 0))[:, None], back, direction)


def _reach(weights: Array, direction: Array, entered: Array) -> Array:
    """How far it is to each edge."""
    falls = (direction < 0) & (entered[:, None] != CORNERS)
    return jnp.where(falls, -weights / jnp.where(falls, direction, 1), jnp.inf)


def _inside(weights: Array, entered: Array) -> Array:
    """The weights a little away from every edge but the one entered by."""
    least = jnp.finfo(weights.dtype).eps ** (2 / 3)
    kept = jnp.where(entered[:, None] == CORNERS, 0, jnp.maximum(weights, least))
    return kept / jnp.sum(kept, axis=1, keepdims=True)
