"""The neighbours of a vertex within a few edges, laid out in its chart (host).

What enters: the half-edges of the intrinsic Delaunay triangulation and their directions. What leaves: rows of
neighbours, the half-edges along which each is reached, and their places in the chart.
"""

import dataclasses

import numpy as np

from .intrinsic import Directions, edge_turn
from .jets import INTERIOR

# No path leads through a vertex whose angle sum differs from that of the plane by more than this, in radians.
_SHARPEST_CONE = 0.5


@dataclasses.dataclass(frozen=True)
class Neighbourhood:
    """Neighbours of some vertices.

    Attributes:
        offsets: (N + 1,) where the entries of each vertex begin.
        members: (n,) the neighbours.
        lifted: (n, 2) their places in the plane of the vertex.
        paths: (n, R) the half-edges that lead to them; of length zero behind the end of a path, and for neighbours that
            are laid out in space.
    """

    offsets: np.ndarray
    members: np.ndarray
    lifted: np.ndarray
    paths: np.ndarray

    @classmethod
    def gather(cls, owners: np.ndarray, count: int, members, lifted, paths) -> "Neighbourhood":
        """The neighbourhoods of ``count`` vertices from entries in any order, each with the number of its owner."""
        order = np.argsort(owners, kind="stable")
        offsets = np.concatenate([[0], np.cumsum(np.bincount(owners, minlength=count))])
        return cls(offsets, members[order], lifted[order], paths[order])

    @property
    def owners(self) -> np.ndarray:
        """For each entry the number of its vertex, (n,)."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))


class Charts:
    """The charts of all vertices: `around` lays out the neighbours of some of them."""

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
            tails: (H,) the vertex at which each half-edge begins.
            kinds: (V,) which vertices lie on a boundary.
            directions: the lengths and directions of the half-edges.
            is_closed_to_paths: (V,) vertices through which no path may lead.
            longest_path: the number of half-edges that a path may have.
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
        """All vertices within ``rings`` edges of each of the given ones.

        Of several paths to a neighbour those with the fewest edges count, and among these the one that is the
        straightest and passes the least curvature.
        """
        num_vertices = len(self._cone)
        none = self._directions.no_half_edge
        owner = np.arange(len(vertices))
        at = np.asarray(vertices, np.int64)
        place, turn = np.zeros(len(at), complex), np.zeros(len(at))
        path = np.full((len(at), self.longest_path), none, np.int32)
        known = np.sort(owner * num_vertices + at)
        reached = []
        for ring in range(rings):
            parent, half_edge = self._leaving(at)
            head, length = self._heads[half_edge], self._directions.lengths[half_edge >> 1]
            to = place[parent] + length * np.exp(1j * (self._directions.angles[half_edge] + turn[parent]))
            bend = np.abs(place[parent]) + length - np.abs(to)
            bend += self._cone[at[parent]] * np.minimum(np.abs(place[parent]), length)
            # At the first ring the bend is zero, and of two edges to the same neighbour the shorter one counts.
            key = owner[parent] * num_vertices + head
            is_new = known[np.minimum(np.searchsorted(known, key), len(known) - 1)] != key
            order = np.flatnonzero(is_new)
            order = order[np.lexsort((length[order] if ring == 0 else bend[order], key[order]))]
            order = order[np.diff(key[order], prepend=-1) > 0]
            path = path[parent[order]]
            path[:, ring] = half_edge[order]
            turn = turn[parent[order]] + self._turns[half_edge[order]]
            owner, at, place = owner[parent[order]], head[order], to[order]
            known = np.sort(np.concatenate([known, key[order]]))
            reached.append((owner, at, np.stack([place.real, place.imag], axis=1), path))
            goes_on = self._is_open[at]
            # If every neighbour is blocked, allow paths through all of them.
            goes_on |= np.bincount(owner, goes_on, minlength=len(vertices))[owner] == 0
            owner, at, place, turn, path = owner[goes_on], at[goes_on], place[goes_on], turn[goes_on], path[goes_on]
        owners, members, lifted, paths = map(np.concatenate, zip(*reached, strict=True))
        return Neighbourhood.gather(owners, len(vertices), members.astype(np.int32), lifted, paths)

    def edges(self, vertices: np.ndarray) -> Neighbourhood:
        """All edges at each of the given vertices except self-loops. A neighbour may appear twice."""
        owner, half_edge = self._leaving(np.asarray(vertices, np.int64))
        keep = self._heads[half_edge] != np.asarray(vertices)[owner]
        owner, half_edge = owner[keep], half_edge[keep]
        place = self._directions.lengths[half_edge >> 1] * np.exp(1j * self._directions.angles[half_edge])
        paths = np.full((len(owner), self.longest_path), self._directions.no_half_edge, np.int32)
        paths[:, 0] = half_edge
        lifted = np.stack([place.real, place.imag], axis=1)
        return Neighbourhood.gather(owner, len(vertices), self._heads[half_edge].astype(np.int32), lifted, paths)

    def _leaving(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The half-edges that leave vertices (N,): for each the position of its vertex, and its number."""
        counts = np.diff(self._starts)[vertices]
        parent = np.repeat(np.arange(len(vertices)), counts)
        within = np.arange(len(parent)) - np.repeat(np.cumsum(counts) - counts, counts)
        return parent, self._order[self._starts[vertices[parent]] + within]
