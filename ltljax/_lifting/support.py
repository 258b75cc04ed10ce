"""Which neighbours a row uses: chosen once, on the host, from the positions; frozen afterwards.

What enters: for any vertices, their neighbours within a few edges and where these lie in the plane. What leaves: rows
of neighbours, for the fit of a polynomial and for non-negative operators, and a record of how the latter were found.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from scipy.optimize import nnls

from .charts import Charts, Neighbourhood
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
# The widest rings of a fit, by its degree.
LARGEST_FIT = {2: 3, 3: 5, 4: 5}
# Vertices at once.
_BATCH = 1 << 13

# The neighbourhood of vertices (N,) within k edges.
Reach = Callable[[np.ndarray, int], Neighbourhood]
# Hands on the batches it is given, and may show how far they are.
Watch = Callable[[list[np.ndarray]], Iterable[np.ndarray]]


@dataclasses.dataclass(frozen=True)
class Rows:
    """The neighbours of every vertex that an operator uses.

    Attributes:
        offsets: (V + 1,) where the entries of each vertex begin.
        members: (n,) the neighbours.
        paths: (n, R) the half-edges that lead to them, as of `Neighbourhood`.
    """

    offsets: np.ndarray
    members: np.ndarray
    paths: np.ndarray

    @classmethod
    def all_of(cls, around: Neighbourhood) -> "Rows":
        """The rows that hold whole neighbourhoods, one for every vertex."""
        return cls(around.offsets, around.members, around.paths)

    def replaced(self, owners: np.ndarray, members: np.ndarray, paths: np.ndarray, which: np.ndarray) -> "Rows":
        """The rows with those of the vertices ``which`` replaced by entries (n,) that name their owners."""
        is_kept = np.ones(len(self.offsets) - 1, bool)
        is_kept[which] = False
        own = np.repeat(np.arange(len(is_kept)), np.diff(self.offsets))
        stays = is_kept[own]
        owners = np.concatenate([own[stays], owners])
        order = np.argsort(owners, kind="stable")
        return Rows(
            np.concatenate([[0], np.cumsum(np.bincount(owners, minlength=len(is_kept)))]),
            np.concatenate([self.members[stays], members])[order].astype(self.members.dtype),
            np.concatenate([self.paths[stays], paths])[order].astype(np.int32),
        )


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


def reach_in_space(
    vertices: np.ndarray,
    frames: np.ndarray,
    lift: Lift,
    k_ring: Callable[[np.ndarray, int], tuple[np.ndarray, np.ndarray]],
    longest_path: int = 0,
    no_half_edge: int = 0,
) -> Reach:
    """Neighbourhoods along the edges of the mesh, laid into the tangent planes.

    Args:
        vertices: (V, 3) positions.
        frames: (V, 2, 3) the bases of the tangent planes.
        lift: how neighbours are laid into them.
        k_ring: the vertices within k edges of each of the given ones, as offsets and members.
        longest_path: the number of half-edges that paths have room for.
        no_half_edge: the half-edge of length zero.
    """

    def reach(which: np.ndarray, rings: int) -> Neighbourhood:
        offsets, members = k_ring(which, rings)
        own = np.repeat(which, np.diff(offsets))
        lifted = lifted_ring((vertices[members] - vertices[own])[None], frames[own], lift)[0]
        return Neighbourhood(offsets, members, lifted, np.full((len(members), longest_path), no_half_edge, np.int32))

    return reach


def reach_in_charts(charts: Charts, in_space: Reach, is_extrinsic: np.ndarray | None) -> Reach:
    """Neighbourhoods in the charts of the vertices, but in space for those that are marked."""
    if is_extrinsic is None:
        return charts.around

    def reach(which: np.ndarray, rings: int) -> Neighbourhood:
        outside = is_extrinsic[which]
        if not outside.any():
            return charts.around(which, rings)
        parts = [(outside, in_space), (~outside, charts.around)]
        found = [(np.flatnonzero(mask), find(which[mask], rings)) for mask, find in parts]
        return Neighbourhood.gather(
            np.concatenate([where[part.owners] for where, part in found]),
            len(which),
            *(np.concatenate([getattr(part, name) for _, part in found]) for name in ("members", "lifted", "paths")),
        )

    return reach


def fit_support(rings: Rows, degree: int, reach: Reach, watch: Watch) -> tuple[Rows, np.ndarray, np.ndarray]:
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
        else [(3, 2 * num_monomials(degree)), (3, None), (4, None), (LARGEST_FIT[degree], None)]
    )
    rows, remaining = rings, np.arange(len(rings.offsets) - 1)
    wide = remaining
    for attempt, (ring, nearest) in enumerate(choices):
        chosen = _Chosen()
        for batch, candidates, lifted, paths in _candidates(remaining, rings, ring, reach, watch):
            is_used = candidates != batch[None]
            if nearest is not None and nearest < len(candidates):
                distance = np.where(is_used, np.sum(lifted**2, axis=-1), np.inf)
                is_used &= distance <= np.partition(distance, nearest - 1, axis=0)[nearest - 1]
                lifted = np.where(is_used[..., None], lifted, 0)
            is_last = attempt == len(choices) - 1
            enough = _PLACED if is_last else _WELL_PLACED[degree]
            chosen.add(batch, candidates, paths, is_used, fit_quality(lifted, degree) > enough)
        rows = chosen.replace(rows)
        remaining = chosen.insufficient()
        if attempt == 0:
            wide = remaining
    return rows, wide, remaining


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
    reach: Reach,
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
        reach: the wider rings.
        watch: shows how far the choice has come.
        emphasis: as in `jets.operator_weights`.
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
        c, has_failed = np.zeros(weights.shape), np.zeros(len(todo), bool)
        for i, (matrix, right) in enumerate(zip(matrices, np.ascontiguousarray(target.T), strict=True)):
            try:
                c[:, i] = nnls(matrix, right)[0]
            except RuntimeError:  # SciPy's iteration did not end
                has_failed[i] = True
        reached = np.einsum("ikn,kn->in", moments, weights * c)
        residual[todo] = relative_residual(target[None], reached[None], emphasis)[0]
        residual[todo[has_failed]] = np.inf
        changed = np.any(is_picked[:, todo] != (c > 0), axis=0) & np.any(c > 0, axis=0)
        is_picked[:, todo] = c > 0
        todo = todo[changed & ~(residual[todo] <= CONSISTENT)]
        if not len(todo):
            break
    return is_picked, residual


def _candidates(
    vertices: np.ndarray, rings: Rows, ring: int, reach: Reach, watch: Watch
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """The rings of some vertices, a batch at a time: vertices (N,), neighbours (K, N), padded with the vertex, their
    places (K, N, 2), padded with zeros, and their paths (K, N, R)."""
    lengths = np.diff(rings.offsets)[vertices]
    # Rings of about the same size together, so that a pole of valence 500 pads only rows of its own size.
    vertices = vertices[np.argsort(lengths, kind="stable")]
    batches = [vertices[start : start + _BATCH] for start in range(0, len(vertices), _BATCH)]
    for batch in watch(batches):
        around = reach(batch, ring)
        sizes = np.diff(around.offsets)
        # A long row must not pad the whole batch.
        by_size = np.argsort(sizes, kind="stable")
        cuts = np.flatnonzero(np.diff(np.ceil(np.log2(np.maximum(sizes[by_size], 16))))) + 1
        # An empty slot reads one more entry, behind the last.
        places = np.append(around.lifted, np.zeros((1, 2)), axis=0)
        paths = np.append(around.paths, np.zeros((1, around.paths.shape[1]), np.int32), axis=0)
        for part in np.split(by_size, cuts):
            slot = np.arange(sizes[part].max(initial=0))[:, None]
            is_used = slot < sizes[part]
            entry = np.where(is_used, around.offsets[part] + slot, len(around.members))
            own = batch[part]
            yield own, np.where(is_used, np.append(around.members, 0)[entry], own), places[entry], paths[entry]


class _Chosen:
    """Rows chosen for some of the vertices, batch by batch."""

    def __init__(self):
        self._vertices, self._entries, self._is_good = [], [], []

    def add(
        self, vertices: np.ndarray, candidates: np.ndarray, paths: np.ndarray, is_used: np.ndarray, is_good: np.ndarray
    ) -> None:
        """The used ones of the candidates (K, N) of vertices (N,), their paths, and whether each row suffices."""
        column, slot = np.nonzero(is_used.T)
        self._vertices.append(vertices)
        self._entries.append((vertices[column], candidates[slot, column], paths[slot, column]))
        self._is_good.append(is_good)

    def insufficient(self) -> np.ndarray:
        """The vertices whose row does not suffice."""
        if not self._vertices:
            return np.zeros(0, np.int64)
        return np.sort(np.concatenate(self._vertices)[~np.concatenate(self._is_good)])

    def replace(self, rows: Rows) -> Rows:
        """All rows, with those of these vertices replaced."""
        if not self._vertices:
            return rows
        owners, members, paths = map(np.concatenate, zip(*self._entries, strict=True))
        return rows.replaced(owners, members, paths, np.concatenate(self._vertices))
