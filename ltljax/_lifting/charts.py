"""The neighbours of a vertex within a few edges, laid out in its chart (host).

Inputs: the half-edges of the intrinsic Delaunay triangulation and their directions. Outputs: rows of neighbours, the
half-edges along which each neighbour is reached, and the position of each neighbour in the chart.
"""

import dataclasses

import numpy as np

from .intrinsic import Directions, edge_turn
from .jets import INTERIOR

# Paths avoid vertices whose angle sum differs from the flat angle sum by more than this, in radians.
_SHARPEST_CONE = 0.5


@dataclasses.dataclass(frozen=True)
class Neighbourhood:
    """The neighbours of a set of vertices.

    Attributes:
        offsets: (N + 1,) index of the first entry of each vertex.
        members: (n,) the neighbours.
        lifted: (n, 2) positions of the neighbours in the plane of the vertex.
        paths: (n, R) half-edges that lead to the neighbours, padded with the half-edge of length zero. Neighbours laid
            out in space have no other half-edges than these.
    """

    offsets: np.ndarray
    members: np.ndarray
    lifted: np.ndarray
    paths: np.ndarray

    @classmethod
    def gather(cls, owners: np.ndarray, count: int, members, lifted, paths) -> "Neighbourhood":
        """The neighbourhoods of ``count`` vertices, from entries in any order and the index of each entry's owner."""
        order = np.argsort(owners, kind="stable")
        offsets = np.concatenate([[0], np.cumsum(np.bincount(owners, minlength=count))])
        return cls(offsets, members[order], lifted[order], paths[order])

    @property
    def owners(self) -> np.ndarray:
        """Index of the vertex to which each entry belongs, (n,)."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))


class Charts:
    """The charts of all vertices. `around` lays out the neighbours of the vertices it is given."""

    def __init__(
        self,
        tails: np.ndarray,
        kinds: np.ndarray,
        directions: Directions,
        is_closed_to_paths: np.ndarray,
        longest_path: int,
    ):
        """Sorts the half-edges by their tails.

        Args:
            tails: (H,) vertex at which each half-edge begins.
            kinds: (V,) kind of each vertex, see `jets`.
            directions: lengths and directions of the half-edges.
            is_closed_to_paths: (V,) mask of the vertices that no path may pass through.
            longest_path: largest number of half-edges in a path.
        """
        self._heads = np.asarray(tails).reshape(-1, 2)[:, ::-1].ravel()
        self._order = np.argsort(tails, kind="stable")
        self._starts = np.concatenate([[0], np.cumsum(np.bincount(tails, minlength=len(kinds)))])
        self._directions = directions
        self._turns = edge_turn(directions, np.arange(len(tails)))
        self._cone = np.abs(np.where(kinds == INTERIOR, 2 * np.pi, np.pi) - directions.angle_sums)
        self._is_open = (self._cone <= _SHARPEST_CONE) & ~is_closed_to_paths
        self.longest_path = longest_path

    def around(self, vertices: np.ndarray, rings: int) -> Neighbourhood:
        """All vertices within ``rings`` edges of each given vertex.

        A neighbour may be reached along several paths. The path with the fewest edges is taken, and among paths of
        equally many edges the straightest one that passes the least curvature.
        """
        num_vertices = len(self._cone)
        owner = np.arange(len(vertices))
        at = np.asarray(vertices, np.int64)
        position, turn = np.zeros(len(at), complex), np.zeros(len(at))
        path = np.full((len(at), self.longest_path), self._directions.no_half_edge, np.int32)
        known = np.sort(owner * num_vertices + at)
        reached = []
        for ring in range(rings):
            parent, half_edge = self._leaving(at)
            head, length = self._heads[half_edge], self._directions.lengths[half_edge >> 1]
            head_position = position[parent] + length * np.exp(1j * (self._directions.angles[half_edge] + turn[parent]))
            bend = np.abs(position[parent]) + length - np.abs(head_position)
            bend += self._cone[at[parent]] * np.minimum(np.abs(position[parent]), length)
            # In the first ring the bend is zero, so the shorter of two edges to the same neighbour is taken.
            key = owner[parent] * num_vertices + head
            is_new = known[np.minimum(np.searchsorted(known, key), len(known) - 1)] != key
            order = np.flatnonzero(is_new)
            order = order[np.lexsort((length[order] if ring == 0 else bend[order], key[order]))]
            order = order[np.diff(key[order], prepend=-1) > 0]
            path = path[parent[order]]
            path[:, ring] = half_edge[order]
            turn = turn[parent[order]] + self._turns[half_edge[order]]
            owner, at, position = owner[parent[order]], head[order], head_position[order]
            known = np.sort(np.concatenate([known, key[order]]))
            reached.append((owner, at, np.stack([position.real, position.imag], axis=1), path))
            is_open = self._is_open[at]
            # If every neighbour is closed to paths, allow paths through all of them.
            is_open |= np.bincount(owner, is_open, minlength=len(vertices))[owner] == 0
            owner, at, path = owner[is_open], at[is_open], path[is_open]
            position, turn = position[is_open], turn[is_open]
        owners, members, lifted, paths = map(np.concatenate, zip(*reached, strict=True))
        return Neighbourhood.gather(owners, len(vertices), members.astype(np.int32), lifted, paths)

    def edges(self, vertices: np.ndarray) -> Neighbourhood:
        """All edges at each given vertex except self-loops. A neighbour may appear twice."""
        owner, half_edge = self._leaving(np.asarray(vertices, np.int64))
        is_edge = self._heads[half_edge] != np.asarray(vertices)[owner]
        owner, half_edge = owner[is_edge], half_edge[is_edge]
        position = self._directions.lengths[half_edge >> 1] * np.exp(1j * self._directions.angles[half_edge])
        paths = np.full((len(owner), self.longest_path), self._directions.no_half_edge, np.int32)
        paths[:, 0] = half_edge
        lifted = np.stack([position.real, position.imag], axis=1)
        return Neighbourhood.gather(owner, len(vertices), self._heads[half_edge].astype(np.int32), lifted, paths)

    def _leaving(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The half-edges that leave vertices (N,), after the index of the tail of each in ``vertices``."""
        counts = np.diff(self._starts)[vertices]
        parent = np.repeat(np.arange(len(vertices)), counts)
        within = np.arange(len(parent)) - np.repeat(np.cumsum(counts) - counts, counts)
        return parent, self._order[self._starts[vertices[parent]] + within]
