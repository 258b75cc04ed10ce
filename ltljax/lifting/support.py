"""Which neighbours a row uses: chosen once, on the host, from the positions; frozen afterwards.

What enters: the one-rings, and how to lay neighbours into tangent planes. What leaves: rows of neighbours (offsets and
indices), for the fit of a polynomial and for non-negative operators, and a record of how the latter were found.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from scipy.optimize import nnls

from .jets import conditions, moment_matrix, num_monomials, relative_residual, ring_moments, scaled_targets
from .ring import Lift, lifted_ring

# A ring determines a polynomial well when the least eigenvalue of its moment matrix, scaled to unit diagonal, is this
# large.
# A regular hexagon has 0.29 for a quadratic; neighbours on a conic have none.
_WELL_PLACED = {2: 0.02, 3: 0.003, 4: 0.001}
# Below this it determines none.
_PLACED = 1e-8
# Relative moment residual below which a row counts as consistent.
CONSISTENT = 1e-8
# Rings beyond the third reach so far that a row would no longer be local.
LARGEST_RING = 3
# Vertices at once.
_BATCH = 1 << 13

Rows = tuple[np.ndarray, np.ndarray]
# All vertices within k edges of each of the given vertices, as rows.
KRing = Callable[[np.ndarray, int], Rows]
# Lifted coordinates (K, N, 2) of neighbours (K, N) of vertices (N,).
LiftAt = Callable[[np.ndarray, np.ndarray], np.ndarray]
# Hands on the batches it is given, and may show how far they are.
Watch = Callable[[list[np.ndarray]], Iterable[np.ndarray]]


@dataclasses.dataclass(frozen=True)
class SupportRecord:
    """How the rows of a non-negative operator were found.

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

    def lift_at(rows: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
        return lifted_ring(vertices[neighbours] - vertices[rows][None], frames[rows], lift)

    return lift_at


def fit_support(
    rings: Rows, degree: int, k_ring: KRing, lift_at: LiftAt, watch: Watch
) -> tuple[Rows, np.ndarray, np.ndarray]:
    """Rows that determine a polynomial fit.

    A quadratic is fitted on the one-ring where that determines it, else on two rings, else on three. Higher degrees
    use the nearest of three rings, twice as many as a fit needs, and all of them where those do not determine it; near
    the corners of a boundary four or five rings.

    Returns:
        The rows, the vertices for which the first choice was not enough, and those for which no choice was.
    """
    choices = (
        [(1, None), (2, None), (3, None)]
        if degree == 2
        else [(3, 2 * num_monomials(degree)), (3, None), (4, None), (5, None)]
    )
    rows, wanting = rings, np.arange(len(rings[0]) - 1)
    wide = wanting
    for attempt, (ring, nearest) in enumerate(choices):
        found = _Found()
        for batch, candidates in _candidates(wanting, rings, ring, k_ring, watch):
            lifted = lift_at(batch, candidates)
            is_used = candidates != batch[None]
            if nearest is not None and nearest < len(candidates):
                distance = np.where(is_used, np.sum(lifted**2, axis=-1), np.inf)
                is_used &= distance <= np.partition(distance, nearest - 1, axis=0)[nearest - 1]
                lifted = np.where(is_used[..., None], lifted, 0)
            is_last = attempt == len(choices) - 1
            enough = _PLACED if is_last else _WELL_PLACED[degree]
            found.add(batch, candidates, is_used, fit_quality(lifted, degree) > enough)
        rows = found.replace(rows)
        wanting = found.wanting()
        if attempt == 0:
            wide = wanting
    return rows, wide, wanting


def fit_quality(lifted: np.ndarray, degree: int) -> np.ndarray:
    """How well each lifted ring (K, N, 2) determines a polynomial of the degree, (N,); zero where it does not."""
    moments, weights, _ = ring_moments(lifted, np.zeros(lifted.shape[1], np.int8), degree)
    matrix = np.moveaxis(moment_matrix(moments, weights), -1, 0)
    diagonal = np.einsum("nii->ni", matrix)
    unscaled = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1))
    return np.linalg.eigvalsh(matrix * unscaled[:, :, None] * unscaled[:, None])[:, 0]


def nonnegative_support(
    rings: Rows,
    is_good: np.ndarray,
    kinds: np.ndarray,
    targets: np.ndarray,
    k_ring: KRing,
    lift_at: LiftAt,
    watch: Watch,
    emphasis: float = 1.0,
) -> tuple[Rows, SupportRecord]:
    """Rows on which the weights of an operator are non-negative: the one-ring, else what least squares picks.

    For a vertex whose one-ring has a negative weight, non-negative least squares solves the moment conditions on two
    rings, then on three, with columns scaled by r^-4 so that near neighbours win. It uses at most five neighbours.
    Where no ring has a consistent row, the row of least residual is kept: it is not consistent, but it is stable.

    Args:
        rings: the one-rings.
        is_good: (V,) whether the one-ring's weights are non-negative and consistent.
        kinds: (V,) which conditions a vertex keeps.
        targets: (5, V) or (5, 1) what the operator makes of x, y, xy, x^2, y^2.
        k_ring: the wider rings.
        lift_at: the lifted coordinates of neighbours.
        watch: shows how far the choice has come.
        emphasis: as in `jets.operator_weights`.
    """
    num_vertices = len(is_good)
    rows = rings
    record = SupportRecord(np.ones(num_vertices, np.int8), np.where(is_good, 0, np.inf))
    targets = np.broadcast_to(targets, (5, num_vertices))
    wanting = np.flatnonzero(~is_good)
    for ring in range(2, LARGEST_RING + 1):
        found = _Found()
        for batch, candidates in _candidates(wanting, rings, ring, k_ring, watch):
            lifted = lift_at(batch, candidates)
            is_picked, residual = _nonnegative_rows(lifted, kinds[batch], targets[:, batch], emphasis)
            is_better = residual < record.residual[batch]
            here = batch[is_better]
            record.rings[here], record.residual[here] = ring, residual[is_better]
            found.add(here, candidates[:, is_better], is_picked[:, is_better], np.ones(len(here), bool))
        rows = found.replace(rows)
        wanting = wanting[~(record.residual[wanting] <= CONSISTENT)]
    return rows, record


def _nonnegative_rows(
    lifted: np.ndarray, kinds: np.ndarray, targets: np.ndarray, emphasis: float
) -> tuple[np.ndarray, np.ndarray]:
    """The neighbours least squares picks from lifted candidates (K, N, 2), as a mask (K, N), and the residuals (N,)."""
    is_picked = np.sum(lifted**2, axis=-1) > 0
    residual = np.ones(len(kinds))
    # The moments are scaled by the radius of the row, which is known only once it is picked. Where the row is exact the
    # scale is of no account and one pass is enough; elsewhere the passes settle on the row that the weights recompute.
    todo = np.flatnonzero(is_picked.any(axis=0))
    for _ in range(LARGEST_RING):
        moments, weights, scale = ring_moments(
            np.where(is_picked[..., None], lifted, 0)[:, todo], kinds[todo], 2, emphasis
        )
        target = conditions(scaled_targets(targets[None, :, todo], scale, emphasis), kinds[todo], 1)[0]
        matrices = np.ascontiguousarray(np.moveaxis(moments * weights[None], -1, 0))
        c = np.zeros(weights.shape)
        for i, (matrix, right) in enumerate(zip(matrices, np.ascontiguousarray(target.T), strict=True)):
            c[:, i] = nnls(matrix, right)[0]
        reached = np.einsum("ikn,kn->in", moments, weights * c)
        residual[todo] = relative_residual(target[None], reached[None], emphasis)[0]
        changed = np.any(is_picked[:, todo] != (c > 0), axis=0) & np.any(c > 0, axis=0)
        is_picked[:, todo] = c > 0
        todo = todo[changed & ~(residual[todo] <= CONSISTENT)]
        if not len(todo):
            break
    return is_picked, residual


def _candidates(
    vertices: np.ndarray, rings: Rows, ring: int, k_ring: KRing, watch: Watch
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The rings of some vertices, a batch at a time: vertices (N,) and neighbours (K, N), padded with the vertex."""
    lengths = np.diff(rings[0])[vertices]
    # Rings of about the same size together, so that a pole of valence 500 pads only its like.
    vertices = vertices[np.argsort(lengths, kind="stable")]
    batches = [vertices[start : start + _BATCH] for start in range(0, len(vertices), _BATCH)]
    for batch in watch(batches):
        offsets, members = _rows_at(rings, batch) if ring == 1 else k_ring(batch, ring)
        sizes = np.diff(offsets)
        # A long row must not pad the whole batch.
        by_size = np.argsort(sizes, kind="stable")
        cuts = np.flatnonzero(np.diff(np.ceil(np.log2(np.maximum(sizes[by_size], 16))))) + 1
        for part in np.split(by_size, cuts):
            slot = np.arange(sizes[part].max(initial=0))[:, None]
            position = np.minimum(offsets[part] + slot, max(len(members) - 1, 0))
            own = batch[part]
            yield own, np.where(slot < sizes[part], members[position] if len(members) else own, own)


def _rows_at(rows: Rows, vertices: np.ndarray) -> Rows:
    """The rows of some vertices."""
    offsets, members = rows
    sizes = np.diff(offsets)[vertices]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    position = np.arange(starts[-1]) + np.repeat(offsets[vertices] - starts[:-1], sizes)
    return starts, members[position]


class _Found:
    """Rows found for some of the vertices, batch by batch."""

    def __init__(self):
        none = np.zeros(0, np.int64)
        self._vertices, self._owners, self._members, self._is_good = [none], [none], [none], [np.zeros(0, bool)]

    def add(self, vertices: np.ndarray, candidates: np.ndarray, is_used: np.ndarray, is_good: np.ndarray) -> None:
        """The used ones of the candidates (K, N) of vertices (N,), and whether each row will do."""
        column, slot = np.nonzero(is_used.T)
        self._vertices.append(vertices)
        self._owners.append(vertices[column])
        self._members.append(candidates[slot, column])
        self._is_good.append(is_good)

    def wanting(self) -> np.ndarray:
        """The vertices whose row will not do."""
        return np.sort(np.concatenate(self._vertices)[~np.concatenate(self._is_good)])

    def replace(self, rows: Rows) -> Rows:
        """All rows, with those of these vertices replaced."""
        offsets, members = rows
        is_kept = np.ones(len(offsets) - 1, bool)
        is_kept[np.concatenate(self._vertices)] = False
        owners = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
        stays = is_kept[owners]
        owners = np.concatenate([owners[stays], *self._owners])
        members = np.concatenate([members[stays], *self._members])
        order = np.argsort(owners, kind="stable")
        sizes = np.bincount(owners, minlength=len(offsets) - 1)
        return np.concatenate([[0], np.cumsum(sizes)]), members[order].astype(rows[1].dtype)
