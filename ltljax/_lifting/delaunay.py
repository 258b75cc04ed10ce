"""The edge flips that make a triangulation intrinsically Delaunay, chosen once on the host.

Inputs: the faces, the table of one-rings and the positions. Outputs: the flips that lead to the intrinsic Delaunay
triangulation, and the connectivity of its half-edges (`HalfEdges`).

Source: Bobenko and Springborn (2007), A discrete Laplace-Beltrami operator for simplicial surfaces,
doi:10.1007/s00454-007-9006-1.
"""

import dataclasses

import numpy as np

from .._tables import Table
from .intrinsic import Flips, RingAngles, Triangulation, corner_angle, flip, flipped, ring_angles
from .ring import RingTopology

# An edge is flipped only if its opposite angles exceed pi by more than this, so that rounding never flips the diagonal
# of a square.
_TIE = 1e-9


@dataclasses.dataclass(frozen=True)
class HalfEdges:
    """The half-edges of a triangulation (host).

    Attributes:
        following: (H,) next half-edge of the same face; -1 if there is no face.
        tails: (H,) vertex at which each half-edge begins.
        lengths: (E,) lengths of the edges.
        angles: (H,) angle between the first half-edge of the tail and this half-edge, in radians, before the angles of
            the chart are rescaled.
    """

    following: np.ndarray
    tails: np.ndarray
    lengths: np.ndarray
    angles: np.ndarray


def delaunay_triangulation(
    faces: np.ndarray,
    vertices: np.ndarray,
    ring: Table,
    ring_blocks: tuple[RingTopology, ...],
    is_near_fold: np.ndarray,
) -> tuple[Triangulation, HalfEdges, RingAngles]:
    """The intrinsic Delaunay triangulation of a mesh, its half-edges, and the angles of the mesh itself.

    Every round flips a set of edges that do not share a face, and then checks the edges around them. Edges whose
    opposite angles exceed pi the most are flipped first.

    An edge between two vertices marked in ``is_near_fold`` is never flipped, so that no new edge leads through a folded
    face. All edges at other vertices become Delaunay, which keeps the cotangent weights there non-negative.

    Args:
        faces: (F, 3) the triangles.
        vertices: (V, 3) positions.
        ring: the one-rings.
        ring_blocks: for every block of ``ring``, which slots hold neighbours and faces.
        is_near_fold: (V,) mask of the corners of faces that are folded over, and of their neighbours.
    """
    ends, following = _connectivity(faces, len(vertices))
    tails = ends.ravel().copy()
    flipless = Triangulation(ends, _ring_slots(ring, tails, len(vertices)), _in_levels([], len(tails)), tails)
    mesh_angles = ring_angles(vertices, flipless, ring, ring_blocks)
    lengths, angles = flipped(mesh_angles, flipless)
    face_of = np.full(len(tails), -1)
    corner = np.flatnonzero(following >= 0)
    face_of[corner] = np.minimum(corner, np.minimum(following[corner], following[following[corner]]))
    levels, candidates = [], np.arange(len(ends))
    while len(candidates):
        is_frozen = is_near_fold[tails[2 * candidates]] & is_near_fold[tails[2 * candidates + 1]]
        candidates = candidates[~is_frozen]
        excess = _excess(candidates, following, face_of, lengths)
        violating, excess = candidates[excess > _TIE], excess[excess > _TIE]
        h = 2 * violating[_independent(violating, excess, face_of)]
        if not len(h):
            break
        h1, t1 = following[h], following[h ^ 1]
        h2, t2 = following[h1], following[t1]
        levels.append(np.stack([h, h1, h2, t1, t2]))
        lengths, angles = flip(lengths, angles, h, levels[-1][1:])
        tails[h], tails[h ^ 1] = tails[t2], tails[h2]
        following[h], following[h2], following[t1] = h2, t1, h
        following[h ^ 1], following[t2], following[h1] = t2, h1, h ^ 1
        face_of[t1], face_of[h1] = face_of[h], face_of[h ^ 1]
        candidates = np.union1d(violating, np.concatenate([h1, h2, t1, t2]) >> 1)
    triangulation = Triangulation(ends, flipless.slots, _in_levels(levels, len(tails)), tails.astype(np.int32))
    return triangulation, HalfEdges(following, tails, lengths, angles), mesh_angles


def _in_levels(levels: list[np.ndarray], fill: int) -> Flips:
    """The flips of all levels, each (5, N), padded to a common width with ``fill``."""
    width = max((level.shape[1] for level in levels), default=0)
    padded = np.full((len(levels), 5, width), fill, np.int32)
    for row, level in zip(padded, levels, strict=True):
        row[:, : level.shape[1]] = level
    return Flips(padded[:, 0], padded[:, 1:])


def _connectivity(faces: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """The ends (E, 2) of each edge, lower vertex first, and the half-edge that follows each half-edge in its face."""
    tail = faces.astype(np.int64)
    head = np.roll(tail, -1, axis=1)
    keys = np.minimum(tail, head) * num_vertices + np.maximum(tail, head)
    order = np.argsort(keys, axis=None)
    is_first = np.diff(keys.ravel()[order], prepend=-1) > 0
    edge = np.empty(keys.size, np.int64)
    edge[order] = np.cumsum(is_first) - 1
    half_edge = 2 * edge.reshape(keys.shape) + (tail > head)
    unique = keys.ravel()[order][is_first]
    following = np.full(2 * len(unique), -1)
    following[half_edge] = np.roll(half_edge, -1, axis=1)
    return np.stack([unique // num_vertices, unique % num_vertices], axis=1).astype(np.int32), following


def _ring_slots(ring: Table, tails: np.ndarray, num_vertices: int) -> np.ndarray:
    """The position of each half-edge of the mesh in the table of one-rings, its blocks concatenated."""
    keys, positions, start = [], [], 0
    for block in ring.blocks:
        row = np.broadcast_to(block.centre(np.arange(num_vertices)), block.indices.shape)
        used = np.flatnonzero(block.is_used)
        keys.append((row * num_vertices + block.indices).ravel()[used])
        positions.append(start + used)
        start += block.indices.size
    keys, positions = np.concatenate(keys), np.concatenate(positions)
    order = np.argsort(keys)
    heads = tails.reshape(-1, 2)[:, ::-1].ravel()
    ranks = np.searchsorted(keys[order], tails.astype(np.int64) * num_vertices + heads)
    return positions[order[ranks]].astype(np.int32)


def _excess(edges: np.ndarray, following: np.ndarray, face_of: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """The sum of the two angles opposite each edge minus pi; -pi for an edge without two distinct faces."""
    h = 2 * edges
    has_two_faces = (following[h] >= 0) & (following[h ^ 1] >= 0) & (face_of[h] != face_of[h ^ 1])
    excess = np.full(len(edges), -np.pi)
    own = lengths[edges[has_two_faces]]
    total = -np.pi
    for side in (h[has_two_faces], h[has_two_faces] ^ 1):
        ahead = following[side]
        total = total + corner_angle(own, lengths[ahead >> 1], lengths[following[ahead] >> 1])
    excess[has_two_faces] = total
    return excess


def _independent(edges: np.ndarray, excess: np.ndarray, face_of: np.ndarray) -> np.ndarray:
    """Which edges can be flipped together: those with the largest excess in both of their faces."""
    rank = np.empty(len(edges), np.int64)
    rank[np.argsort(-excess, kind="stable")] = np.arange(len(edges))
    sides = face_of[2 * edges], face_of[2 * edges + 1]
    first = np.full(len(face_of), len(edges))
    for side in sides:
        np.minimum.at(first, side, rank)
    return (first[sides[0]] == rank) & (first[sides[1]] == rank)


def opposite_edges(half_edges: HalfEdges, which: np.ndarray, no_edge: int) -> np.ndarray:
    """The edges of the two faces beside each half-edge, (5, N).

    The first row is the edge of the half-edge itself. Then follow the other two edges of the face on its left and of
    the face on its right; ``no_edge`` where there is no face.
    """
    edges = [which >> 1]
    for side in (which, which ^ 1):
        ahead = half_edges.following[side]
        has_face = ahead >= 0
        edges += [
            np.where(has_face, ahead >> 1, no_edge),
            np.where(has_face, half_edges.following[ahead] >> 1, no_edge),
        ]
    return np.stack(edges)
