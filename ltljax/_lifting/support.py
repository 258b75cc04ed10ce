"""The choice of the neighbours that each row uses: made once on the host from the positions, and frozen afterwards.

Inputs: for any vertices, their neighbours within a few edges and the positions of these in the plane. Outputs: rows of
neighbours for polynomial fits and for non-negative operators, and a record of how the latter were chosen.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from scipy.optimize import nnls

from .charts import Charts, Neighbourhood
from .jets import conditions, moment_matrix, num_monomials, relative_residual, ring_moments, scaled_targets
from .ring import Lift, lifted_ring

# A ring determines a polynomial of a degree well if the smallest eigenvalue of its moment matrix, scaled to unit
# diagonal, exceeds this. For quadratics it is 0.29 on a regular hexagon, and 0 for neighbours on a conic through the
# vertex.
_WELL_CONDITIONED = {2: 0.02, 3: 0.003, 4: 0.001}
# Below this eigenvalue a ring does not determine a polynomial at all.
_DETERMINED = 1e-8
# Relative moment residual below which a row counts as consistent.
CONSISTENT = 1e-8
# Largest number of rings from which a non-negative row is chosen, so that operators stay local.
LARGEST_RING = 3
# Largest number of rings from which the row of a fit is chosen, by degree.
LARGEST_FIT = {2: 3, 3: 5, 4: 5}
# Largest number of passes in which a non-negative row is selected.
_MAX_PASSES = 3
# Vertices per batch.
_BATCH = 1 << 13

# Returns the neighbourhoods of vertices (N,) within k edges.
Reach = Callable[[np.ndarray, int], Neighbourhood]
# Yields the given batches and may report progress.
Watch = Callable[[list[np.ndarray]], Iterable[np.ndarray]]


@dataclasses.dataclass(frozen=True)
class Rows:
    """The neighbours that an operator uses at every vertex.

    Attributes:
        offsets: (V + 1,) index of the first entry of each vertex.
        members: (n,) the neighbours.
        paths: (n, R) half-edges that lead to the neighbours, see `Neighbourhood`.
    """

    offsets: np.ndarray
    members: np.ndarray
    paths: np.ndarray

    @classmethod
    def all_of(cls, neighbourhood: Neighbourhood) -> "Rows":
        """Rows that hold the whole neighbourhood of every vertex."""
        return cls(neighbourhood.offsets, neighbourhood.members, neighbourhood.paths)

    def replaced(self, owners: np.ndarray, members: np.ndarray, paths: np.ndarray, which: np.ndarray) -> "Rows":
        """Copies of the rows in which the rows of the vertices ``which`` are replaced by entries (n,) with owners."""
        is_unchanged = np.ones(len(self.offsets) - 1, bool)
        is_unchanged[which] = False
        own = np.repeat(np.arange(len(is_unchanged)), np.diff(self.offsets))
        stays = is_unchanged[own]
        owners = np.concatenate([own[stays], owners])
        order = np.argsort(owners, kind="stable")
        return Rows(
            np.concatenate([[0], np.cumsum(np.bincount(owners, minlength=len(is_unchanged)))]),
            np.concatenate([self.members[stays], members])[order].astype(self.members.dtype),
            np.concatenate([self.paths[stays], paths])[order].astype(np.int32),
        )


@dataclasses.dataclass(frozen=True)
class SupportRecord:
    """How the rows of a non-negative operator were chosen.

    Attributes:
        rings: (V,) number of rings from which the row was chosen, 1 to 3.
        residual: (V,) relative moment residual of the row; zero up to rounding for a consistent row.
    """

    rings: np.ndarray
    residual: np.ndarray

    @property
    def inconsistent(self) -> np.ndarray:
        """The vertices without a consistent non-negative row."""
        return np.flatnonzero(~(self.residual <= CONSISTENT))


def reach_in_space(
    vertices: np.ndarray,
    frames: np.ndarray,
    lift: Lift,
    k_ring: Callable[[np.ndarray, int], tuple[np.ndarray, np.ndarray]],
    longest_path: int = 0,
    no_half_edge: int = 0,
) -> Reach:
    """A function that finds neighbourhoods along the edges of the mesh and lifts them to the tangent planes.

    Args:
        vertices: (V, 3) positions.
        frames: (V, 2, 3) bases of the tangent planes.
        lift: map from space to the tangent planes.
        k_ring: function that returns the vertices within k edges of each given vertex, as offsets and members.
        longest_path: largest number of half-edges in a path.
        no_half_edge: the half-edge of length zero.
    """

    def reach(which: np.ndarray, rings: int) -> Neighbourhood:
        offsets, members = k_ring(which, rings)
        own = np.repeat(which, np.diff(offsets))
        lifted = lifted_ring((vertices[members] - vertices[own])[None], frames[own], lift)[0]
        return Neighbourhood(offsets, members, lifted, np.full((len(members), longest_path), no_half_edge, np.int32))

    return reach


def reach_in_charts(charts: Charts, in_space: Reach, is_extrinsic: np.ndarray | None) -> Reach:
    """A function that finds neighbourhoods in the charts of the vertices, or in space where ``is_extrinsic``."""
    if is_extrinsic is None:
        return charts.around

    def reach(which: np.ndarray, rings: int) -> Neighbourhood:
        outside = is_extrinsic[which]
        if not outside.any():
            return charts.around(which, rings)
        choices = [(outside, in_space), (~outside, charts.around)]
        parts = [(np.flatnonzero(mask), find(which[mask], rings)) for mask, find in choices]
        return Neighbourhood.gather(
            np.concatenate([index[part.owners] for index, part in parts]),
            len(which),
            *(np.concatenate([getattr(part, name) for _, part in parts]) for name in ("members", "lifted", "paths")),
        )

    return reach


def fit_support(rings: Rows, degree: int, reach: Reach, watch: Watch) -> tuple[Rows, np.ndarray, np.ndarray]:
    """Rows that determine a polynomial fit.

    A quadratic is fitted on one ring if that determines it, otherwise on two rings, otherwise on three. Higher degrees
    use the nearest neighbours in three rings, twice as many as a fit needs. If these do not determine the fit, all
    neighbours in three rings are used, and then four or five rings, as happens near corners of a boundary.

    Args:
        rings: the one-rings.
        degree: degree of the polynomial.
        reach: finds wider rings.
        watch: shows progress.

    Returns:
        The rows, the vertices where the first choice did not determine the fit, and the vertices where no choice did.
    """
    choices = (
        [(1, None), (2, None), (3, None)]
        if degree == 2
        else [(3, 2 * num_monomials(degree)), (3, None), (4, None), (LARGEST_FIT[degree], None)]
    )
    rows, remaining = rings, np.arange(len(rings.offsets) - 1)
    wide = remaining
    for attempt, (ring, num_nearest) in enumerate(choices):
        chosen = _Chosen()
        for batch, candidates, lifted, paths in _candidates(remaining, rings, ring, reach, watch):
            is_used = candidates != batch[None]
            if num_nearest is not None and num_nearest < len(candidates):
                distance = np.where(is_used, np.sum(lifted**2, axis=-1), np.inf)
                is_used &= distance <= np.partition(distance, num_nearest - 1, axis=0)[num_nearest - 1]
                lifted = np.where(is_used[..., None], lifted, 0)
            is_last = attempt == len(choices) - 1
            threshold = _DETERMINED if is_last else _WELL_CONDITIONED[degree]
            chosen.add(batch, candidates, paths, is_used, fit_quality(lifted, degree) > threshold)
        rows = chosen.replace(rows)
        remaining = chosen.insufficient()
        if attempt == 0:
            wide = remaining
    return rows, wide, remaining


def fit_quality(lifted: np.ndarray, degree: int) -> np.ndarray:
    """The smallest eigenvalue (N,) of the scaled moment matrix of each lifted ring (K, N, 2)."""
    moments, weights, _ = ring_moments(lifted, np.zeros(lifted.shape[1], np.int8), degree)
    matrix = np.moveaxis(moment_matrix(moments, weights), -1, 0)
    diagonal = np.einsum("nii->ni", matrix)
    inverse_root = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1))
    return np.linalg.eigvalsh(matrix * inverse_root[:, :, None] * inverse_root[:, None])[:, 0]


def nonnegative_support(
    rings: Rows,
    is_good: np.ndarray,
    kinds: np.ndarray,
    targets: np.ndarray,
    reach: Reach,
    watch: Watch,
    emphasis: float = 1.0,
) -> tuple[Rows, SupportRecord]:
    """Rows on which the weights of an operator are non-negative, and a record of how they were chosen.

    The one-ring is used where its weights are non-negative. Elsewhere, non-negative least squares solves the moment
    conditions on two rings, then on three. Its columns are scaled by r^-4 to favour near neighbours, and at most five
    neighbours get a positive weight. If no ring has a consistent row, the row with the smallest residual is used, which
    is stable although it is not consistent.

    Args:
        rings: the one-rings.
        is_good: (V,) whether the weights on the one-ring are non-negative and consistent.
        kinds: (V,) kind of each vertex, which selects its conditions.
        targets: (5, V) or (5, 1) values of the operator on x, y, xy, x^2, y^2.
        reach: finds wider rings.
        watch: shows progress.
        emphasis: see `jets.operator_weights`.
    """
    num_vertices = len(is_good)
    rows = rings
    record = SupportRecord(np.ones(num_vertices, np.int8), np.where(is_good, 0, np.inf))
    targets = np.broadcast_to(targets, (5, num_vertices))
    remaining = np.flatnonzero(~is_good)
    for ring in range(2, LARGEST_RING + 1):
        chosen = _Chosen()
        for batch, candidates, lifted, paths in _candidates(remaining, rings, ring, reach, watch):
            is_picked, residual = _nonnegative_rows(lifted, kinds[batch], targets[:, batch], emphasis)
            is_better = residual < record.residual[batch]
            better = batch[is_better]
            record.rings[better], record.residual[better] = ring, residual[is_better]
            columns = np.flatnonzero(is_better)
            chosen.add(
                better, candidates[:, columns], paths[:, columns], is_picked[:, columns], np.ones(len(better), bool)
            )
        rows = chosen.replace(rows)
        remaining = remaining[~(record.residual[remaining] <= CONSISTENT)]
    return rows, record


def _nonnegative_rows(
    lifted: np.ndarray, kinds: np.ndarray, targets: np.ndarray, emphasis: float
) -> tuple[np.ndarray, np.ndarray]:
    """The neighbours that least squares selects from lifted candidates (K, N, 2), as a mask, and the residuals (N,)."""
    is_picked = np.sum(lifted**2, axis=-1) > 0
    residual = np.ones(len(kinds))
    # The moments are scaled by the radius of the row, which depends on the selection. If the row is exact, the scale
    # does not matter and one pass suffices. Otherwise repeat until the selection agrees with the scale that
    # `operator_weights` computes from it.
    unsettled = np.flatnonzero(is_picked.any(axis=0))
    for _ in range(_MAX_PASSES):
        moments, weights, scale = ring_moments(
            np.where(is_picked[..., None], lifted, 0)[:, unsettled], kinds[unsettled], 2, emphasis
        )
        target = conditions(scaled_targets(targets[None, :, unsettled], scale, emphasis), kinds[unsettled], 1)[0]
        matrices = np.ascontiguousarray(np.moveaxis(moments * weights[None], -1, 0))
        c, has_failed = np.zeros(weights.shape), np.zeros(len(unsettled), bool)
        for i, (matrix, right_hand_side) in enumerate(zip(matrices, np.ascontiguousarray(target.T), strict=True)):
            try:
                c[:, i] = nnls(matrix, right_hand_side)[0]
            except RuntimeError:  # SciPy's iteration did not converge
                has_failed[i] = True
        reached = np.einsum("ikn,kn->in", moments, weights * c)
        residual[unsettled] = relative_residual(target[None], reached[None], emphasis)[0]
        residual[unsettled[has_failed]] = np.inf
        changed = np.any(is_picked[:, unsettled] != (c > 0), axis=0) & np.any(c > 0, axis=0)
        is_picked[:, unsettled] = c > 0
        unsettled = unsettled[changed & ~(residual[unsettled] <= CONSISTENT)]
        if not len(unsettled):
            break
    return is_picked, residual


def _candidates(
    vertices: np.ndarray, rings: Rows, ring: int, reach: Reach, watch: Watch
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """The rings of some vertices, one batch at a time.

    Yields:
        The vertices (N,), their neighbours (K, N), padded with the vertex itself, the positions of the neighbours
        (K, N, 2), padded with zeros, and the paths to them (K, N, R).
    """
    lengths = np.diff(rings.offsets)[vertices]
    # Group rings of similar size, so that a pole of valence 500 pads only rows of its own size.
    vertices = vertices[np.argsort(lengths, kind="stable")]
    batches = [vertices[start : start + _BATCH] for start in range(0, len(vertices), _BATCH)]
    for batch in watch(batches):
        neighbourhood = reach(batch, ring)
        sizes = np.diff(neighbourhood.offsets)
        # Split the batch by size, so that a long row does not pad all of it.
        by_size = np.argsort(sizes, kind="stable")
        cuts = np.flatnonzero(np.diff(np.ceil(np.log2(np.maximum(sizes[by_size], 16))))) + 1
        # Empty slots read one additional entry at the end.
        positions = np.append(neighbourhood.lifted, np.zeros((1, 2)), axis=0)
        no_path = np.zeros((1, neighbourhood.paths.shape[1]), np.int32)
        paths = np.append(neighbourhood.paths, no_path, axis=0)
        for part in np.split(by_size, cuts):
            slot = np.arange(sizes[part].max(initial=0))[:, None]
            is_used = slot < sizes[part]
            entry = np.where(is_used, neighbourhood.offsets[part] + slot, len(neighbourhood.members))
            own = batch[part]
            yield (
                own,
                np.where(is_used, np.append(neighbourhood.members, 0)[entry], own),
                positions[entry],
                paths[entry],
            )


class _Chosen:
    """Rows chosen for some vertices, collected batch by batch."""

    def __init__(self):
        self._vertices, self._entries, self._is_good = [], [], []

    def add(
        self, vertices: np.ndarray, candidates: np.ndarray, paths: np.ndarray, is_used: np.ndarray, is_good: np.ndarray
    ) -> None:
        """Adds the used candidates (K, N) of vertices (N,), with their paths, and whether each row is sufficient."""
        column, slot = np.nonzero(is_used.T)
        self._vertices.append(vertices)
        self._entries.append((vertices[column], candidates[slot, column], paths[slot, column]))
        self._is_good.append(is_good)

    def insufficient(self) -> np.ndarray:
        """The vertices whose rows are not sufficient."""
        if not self._vertices:
            return np.zeros(0, np.int64)
        return np.sort(np.concatenate(self._vertices)[~np.concatenate(self._is_good)])

    def replace(self, rows: Rows) -> Rows:
        """All rows, with the chosen ones replaced."""
        if not self._vertices:
            return rows
        owners, members, paths = map(np.concatenate, zip(*self._entries, strict=True))
        return rows.replaced(owners, members, paths, np.concatenate(self._vertices))
