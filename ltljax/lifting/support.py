"""Which neighbours a row uses: chosen once, on the host, from the positions; frozen afterwards.

What enters: the rings, laid into the tangent planes. What leaves: rows of neighbours (offsets and indices), for the
gradient's fit and for the non-negative Laplacian, and a record of how each Laplacian row was found.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.optimize import nnls

from .quadratic import moment_matrix, ring_moments
from .ring import Lift, lifted_ring

# A ring determines a quadratic when the least eigenvalue of its moment matrix is this large against the mean one; a
# regular hexagon has 0.33, a ring of four none.
_WELL_PLACED = 0.01
# Relative moment residual below which a row counts as consistent.
CONSISTENT = 1e-8
# Rings beyond the third reach so far that a row would no longer be local.
_LARGEST_RING = 3

Rows = tuple[np.ndarray, np.ndarray]
# All vertices within k edges of each of the given vertices, as rows.
KRing = Callable[[np.ndarray, int], Rows]
# Lifted coordinates (n, 2) of the given neighbours of one vertex.
LiftAt = Callable[[int, np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True)
class SupportRecord:
    """How the Laplacian's rows were found: for every vertex the ring they use, and whether they are consistent.

    Attributes:
        rings: (V,) the number of rings the row was chosen from, 1 to 3.
        residual: (V,) the relative moment residual of the row; a consistent one has zero to rounding.
    """

    rings: np.ndarray
    residual: np.ndarray

    @property
    def inconsistent(self) -> np.ndarray:
        """The vertices without a consistent non-negative row."""
        return np.flatnonzero(~(self.residual <= CONSISTENT))


def lift_onto(vertices: np.ndarray, frames: np.ndarray, lift: Lift) -> LiftAt:
    """The lift of any neighbours of a vertex into its tangent plane."""

    def lift_at(vertex: int, neighbours: np.ndarray) -> np.ndarray:
        offsets = vertices[neighbours] - vertices[vertex]
        return lifted_ring(offsets[:, None], frames[vertex][None], lift)[:, 0]

    return lift_at


def merge_rows(rows: Rows, replaced: dict[int, np.ndarray]) -> Rows:
    """The rows with those of some vertices replaced."""
    offsets, indices = rows
    lengths = np.diff(offsets)
    pieces, start = [], 0
    for vertex in sorted(replaced):
        lengths[vertex] = len(replaced[vertex])
        pieces += [indices[start : offsets[vertex]], replaced[vertex]]
        start = offsets[vertex + 1]
    pieces.append(indices[start:])
    return np.concatenate([[0], np.cumsum(lengths)]), np.concatenate(pieces).astype(indices.dtype)


def split_rows(rows: Rows) -> list[np.ndarray]:
    """The rows as a list of arrays."""
    offsets, indices = rows
    return np.split(indices, offsets[1:-1])


def fit_support(rings: Rows, is_well_placed: np.ndarray, k_ring: KRing, lift_at: LiftAt) -> Rows:
    """Rows that determine a quadratic fit: the one-ring where it does, else two rings, else three.

    Args:
        rings: the one-rings.
        is_well_placed: (V,) whether the one-ring determines a quadratic, see `determines_quadratic`.
        k_ring: the wider rings.
        lift_at: the lifted coordinates of neighbours.
    """
    wanting = np.flatnonzero(~is_well_placed)
    chosen: dict[int, np.ndarray] = {}
    for ring in range(2, _LARGEST_RING + 1):
        if not len(wanting):
            break
        chosen.update(zip(wanting.tolist(), split_rows(k_ring(wanting, ring)), strict=True))
        wanting = np.array(
            [v for v in wanting.tolist() if not determines_quadratic(lift_at(v, chosen[v])[:, None])[0]], np.int64
        )
    return merge_rows(rings, chosen)


def determines_quadratic(lifted: np.ndarray) -> np.ndarray:
    """Whether each lifted ring (K, N, 2) holds five neighbours in general position, (N,)."""
    moments, weights, _ = ring_moments(lifted, np.zeros(lifted.shape[1], bool))
    eigenvalues = np.linalg.eigvalsh(np.moveaxis(moment_matrix(moments, weights), -1, 0))
    return eigenvalues[:, 0] > _WELL_PLACED * eigenvalues.mean(axis=1)


def nonnegative_support(
    rings: Rows,
    one_ring_is_good: np.ndarray,
    is_boundary: np.ndarray,
    k_ring: KRing,
    lift_at: LiftAt,
) -> tuple[Rows, SupportRecord]:
    """Rows on which Laplacian weights are non-negative: the one-ring, else what least squares picks from wider rings.

    For a vertex whose one-ring has a negative weight, non-negative least squares solves the five moment conditions on
    two rings, then on three, with columns scaled by r^-4 so that near neighbours win. It uses at most five neighbours.
    Where no ring has a consistent row, the row of least residual is kept: it is not consistent, but it is stable.

    Args:
        rings: the one-rings.
        one_ring_is_good: (V,) whether the one-ring's weights are non-negative and consistent.
        is_boundary: (V,) where the condition along the conormal is dropped.
        k_ring: the wider rings.
        lift_at: the lifted coordinates of neighbours.
    """
    num_vertices = len(one_ring_is_good)
    used_rings = np.ones(num_vertices, np.int8)
    residual = np.zeros(num_vertices)
    best: dict[int, np.ndarray] = {}
    wanting = np.flatnonzero(~one_ring_is_good)
    for ring in range(2, _LARGEST_RING + 1):
        if not len(wanting):
            break
        for vertex, candidates in zip(wanting.tolist(), split_rows(k_ring(wanting, ring)), strict=True):
            picked, found = _nonnegative_row(lift_at(vertex, candidates), bool(is_boundary[vertex]))
            if vertex not in best or found < residual[vertex]:
                best[vertex] = candidates[picked]
                residual[vertex], used_rings[vertex] = found, ring
        wanting = wanting[~(residual[wanting] <= CONSISTENT)]
    return merge_rows(rings, best), SupportRecord(used_rings, residual)


def _nonnegative_row(lifted: np.ndarray, is_boundary: bool) -> tuple[np.ndarray, float]:
    """The neighbours least squares picks from the lifted candidates (n, 2), and the relative moment residual."""
    target = np.array([0, 0, 0, 2.0, 2.0])
    picked = np.flatnonzero(np.sum(lifted**2, axis=-1) > 0)
    found = 1.0
    # The moments are scaled by the radius of the row, which is known only once it is picked. Where the row is exact the
    # scale is of no account and one pass is enough; elsewhere the passes settle on the row that the weights recompute.
    for _ in range(_LARGEST_RING):
        if not len(picked):
            return picked, found
        moments, weights, _ = ring_moments(lifted[picked][:, None], np.array([is_boundary]))
        columns = weights[:, 0] ** 2
        try:
            c, _ = nnls(moments[:, :, 0] * columns, target)
        except RuntimeError:  # no convergence: the candidates as they are cannot be worse than nothing
            return picked[:0], found
        found = float(np.abs(moments[:, :, 0] @ (columns * c) - target).max() / 2)
        if np.all(c > 0):
            break
        picked = picked[c > 0]
        if found <= CONSISTENT:
            break
    return picked, found
