"""The choice of neighbours: which vertices each row of the gradient and of the Laplacian uses (host).

What enters: a mesh, its one-rings and a scheme. What leaves: the `Topology` with its tables of neighbours, chosen from
the positions, and a report of the choice.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from .._base.progress import Laps
from .._lifting import support
from .._lifting.charts import Charts, Neighbourhood
from .._lifting.delaunay import HalfEdges, delaunay_triangulation, opposite_edges
from .._lifting.frames import tangent_frames
from .._lifting.intrinsic import CotangentRows, Directions, RingAngles, directions
from .._lifting.jets import LAPLACIAN, RIGHT_CORNER
from .._lifting.layout import Places, block_paths
from .._lifting.schemes import Monotone, Paper, Polynomial, Scheme
from .._lifting.weighing import (
    Topology,
    diffusion_rows,
    places_in,
    ring_normals,
    surface_normals,
    vertex_frames,
)
from .._mesh import Mesh, OneRings, k_ring
from .._tables import Table, build_table
from .creases import at_folded_faces, creased_vertices
from .report import SurfaceReport

# A quadratic is not fitted to a ring whose longest edge is more than this many times as long as the shortest.
_LARGEST_RATIO = 1e5

Watching = Callable[[str], support.Watch]


def choose_neighbours(
    mesh: Mesh, rings: OneRings, topology: Topology, scheme: Monotone | Polynomial, watch: Watching, laps: Laps
) -> tuple[Topology, RingAngles | None, SurfaceReport]:
    """The topology with the neighbours of the gradient and of the Laplacian.

    Returns:
        The topology; the ring angles, or None if no row is laid out in a chart; and the report.
    """
    vertices = mesh.vertices
    normals = ring_normals(scheme, vertices, topology.ring, topology.ring_blocks)
    is_intrinsic = isinstance(scheme, Monotone) and scheme.lift == "intrinsic"
    on_crease, is_near_fold = None, at_folded_faces(mesh, normals)
    if is_intrinsic or isinstance(scheme, Polynomial):
        on_crease = creased_vertices(mesh) & ~is_near_fold
    topology, chart = _lay_charts(mesh, topology, scheme, is_near_fold, on_crease)

    laps.end("charts")
    angles, chart_directions, charts = None, None, None
    if chart is not None:
        angles, chart_directions, charts = chart.angles, chart.directions, chart.charts
    layout = Places(vertices, normals, tangent_frames(normals), chart_directions, None, "projection")

    def reach_of(is_extrinsic: np.ndarray | None) -> support.Reach:
        return reach_along(rings, layout, charts, is_extrinsic)

    one_rings = reach_of(topology.is_extrinsic)(np.arange(mesh.num_vertices), 1)
    watch_gradient = watch("choosing the neighbours of the gradient")
    topology, report = _choose_gradient(
        scheme, topology, reach_of, one_rings, chart, on_crease, is_near_fold, watch_gradient
    )
    laps.end("gradient rows")
    if isinstance(scheme, Polynomial):
        topology = dataclasses.replace(topology, diffusion=topology.jet, diffusion_paths=topology.jet_paths)
        return topology, angles, report

    diffusion_layout, reach = layout, reach_of(topology.is_extrinsic)
    if chart is None or topology.is_extrinsic is not None:
        # Choose rows in space in the same tangent planes in which they will be weighed.
        normals = surface_normals(scheme, vertices, topology)
        frames, _ = vertex_frames(vertices, normals, topology)
        diffusion_layout = places_in(scheme, topology, vertices, normals, frames, chart_directions)
        reach = reach_along(rings, diffusion_layout, charts, topology.is_extrinsic)
        one_rings = reach(np.arange(mesh.num_vertices), 1)
    topology, report = _choose_diffusion(
        scheme,
        topology,
        diffusion_layout,
        reach,
        one_rings,
        chart,
        watch("choosing the neighbours of the Laplacian"),
        report,
    )
    laps.end("Laplacian rows")
    return topology, angles, report


def _choose_gradient(
    scheme: Monotone | Polynomial,
    topology: Topology,
    reach_of: Callable[[np.ndarray | None], support.Reach],
    one_rings: Neighbourhood,
    chart: "_Chart | None",
    on_crease: np.ndarray | None,
    is_near_fold: np.ndarray,
    watch: support.Watch,
) -> tuple[Topology, SurfaceReport]:
    """The neighbours of the gradient.

    ``reach_of(is_extrinsic)`` finds wider neighbourhoods and lays those of the marked vertices out in space;
    ``one_rings`` are already laid out.
    """
    one_ring_rows = support.Rows.all_of(one_rings)
    report = SurfaceReport(flips=0 if chart is None else chart.num_flips)
    jet, wide, undetermined = support.fit_support(one_ring_rows, scheme.degree, reach_of(topology.is_extrinsic), watch)
    if on_crease is not None:
        is_wide = np.full(len(on_crease), isinstance(scheme, Polynomial))
        is_wide[wide] = True
        is_creased = (on_crease | (is_wide & _meets(jet, on_crease))) & ~is_near_fold
        if is_creased.any():
            topology = dataclasses.replace(topology, is_creased=is_creased)
            report = dataclasses.replace(report, creased=np.flatnonzero(is_creased))
            if isinstance(scheme, Polynomial):
                # Choose the creased rows again, now laid out in charts.
                topology = dataclasses.replace(topology, is_extrinsic=~is_creased)
                jet, wide, undetermined = support.fit_support(
                    one_ring_rows, scheme.degree, reach_of(~is_creased), watch
                )
    topology = dataclasses.replace(topology, **_table_of("jet", jet, topology, chart))
    return topology, dataclasses.replace(report, wide_gradient_rows=wide, undetermined=undetermined)


def _choose_diffusion(
    scheme: Monotone,
    topology: Topology,
    layout: Places,
    reach: support.Reach,
    one_rings: Neighbourhood,
    chart: "_Chart | None",
    watch: support.Watch,
    report: SurfaceReport,
) -> tuple[Topology, SurfaceReport]:
    """The neighbours of the Laplacian of `Monotone`.

    ``reach`` finds wider neighbourhoods; ``one_rings`` are already laid out.
    """
    one_ring_rows = support.Rows.all_of(one_rings)
    narrow = dataclasses.replace(topology, **_table_of("diffusion", one_ring_rows, topology, chart))
    _, residual, _, _ = diffusion_rows(scheme, layout, narrow)
    is_consistent = residual <= support.CONSISTENT
    is_cotangent = np.zeros(len(is_consistent), bool)
    if chart is not None:
        is_cotangent = _singular_corners(topology.kinds, chart.angles.sums, one_ring_rows) | _is_uneven(one_rings)
        if topology.is_extrinsic is not None:
            is_cotangent &= ~topology.is_extrinsic
    rows, record = support.nonnegative_support(
        one_ring_rows, is_consistent | is_cotangent, topology.kinds, LAPLACIAN.T, reach, watch
    )
    if chart is not None:
        is_inconsistent = np.isin(np.arange(len(is_consistent)), record.inconsistent)
        if topology.is_extrinsic is not None:
            is_inconsistent &= ~topology.is_extrinsic
        is_cotangent |= is_inconsistent
        edges = chart.charts.edges(np.flatnonzero(is_cotangent))
        owners = np.flatnonzero(is_cotangent)[edges.owners]
        rows = rows.replaced(owners, edges.members, edges.paths, np.flatnonzero(is_cotangent))
    topology = dataclasses.replace(topology, **_table_of("diffusion", rows, topology, chart))
    if is_cotangent.any() and chart is not None:
        topology = dataclasses.replace(topology, cotangent_rows=_cotangent_rows(topology, is_cotangent, chart))
    report = dataclasses.replace(
        report,
        rings=record.rings,
        residual=record.residual,
        cotangent=np.flatnonzero(is_cotangent),
        inconsistent=record.inconsistent[~is_cotangent[record.inconsistent]],
        extrinsic=report.extrinsic if topology.is_extrinsic is None else np.flatnonzero(topology.is_extrinsic),
    )
    return topology, report


@dataclasses.dataclass(frozen=True)
class _Chart:
    """The intrinsic triangulation and its charts, which lay out neighbours by edge lengths."""

    half_edges: HalfEdges
    angles: RingAngles
    directions: Directions
    charts: Charts
    num_flips: int


def _lay_charts(
    mesh: Mesh,
    topology: Topology,
    scheme: Monotone | Polynomial,
    is_near_fold: np.ndarray,
    on_crease: np.ndarray | None,
) -> tuple[Topology, _Chart | None]:
    """The topology with its intrinsic triangulation, and the charts; or no charts if all rows are laid out in space.

    The intrinsic `Monotone` lays out all rows in charts except those at or beside folded faces; `Polynomial` lays out
    only the rows at creases in charts.
    """
    if on_crease is None or (isinstance(scheme, Polynomial) and not on_crease.any()):
        return topology, None
    triangulation, half_edges, angles = delaunay_triangulation(
        mesh.faces, mesh.vertices, topology.ring, topology.ring_blocks, is_near_fold
    )
    chart_directions = directions(angles, triangulation, topology.kinds)
    charts = Charts(
        triangulation.tails,
        topology.kinds,
        chart_directions,
        _surrounded(topology.ring, is_near_fold),
        longest_path_of(scheme),
    )
    is_extrinsic = is_near_fold if isinstance(scheme, Monotone) else np.ones_like(is_near_fold)
    topology = dataclasses.replace(
        topology, triangulation=triangulation, is_extrinsic=is_extrinsic if is_extrinsic.any() else None
    )
    num_flips = int(np.sum(triangulation.flips.flipped < len(triangulation.tails)))
    return topology, _Chart(half_edges, angles, chart_directions, charts, num_flips)


def _singular_corners(kinds: np.ndarray, angle_sums: np.ndarray, one_ring: support.Rows) -> np.ndarray:
    """Whether each vertex is a boundary corner near which fields without flux are not smooth, (V,) bool.

    Such fields have no second derivatives at an obtuse corner and no gradient at a re-entrant one, so no row can be
    consistent with them. The same holds at a corner next to such a corner.
    """
    is_corner, is_right = kinds >= RIGHT_CORNER, kinds == RIGHT_CORNER
    is_singular = is_corner & (angle_sums > np.where(is_right, np.pi, np.pi / 2))
    return is_singular | (is_corner & _meets(one_ring, is_singular))


def _is_uneven(one_rings: Neighbourhood) -> np.ndarray:
    """Whether the edge lengths at each vertex differ too much for a fit in double precision, (V,) bool."""
    squared = np.sum(one_rings.lifted**2, axis=1)
    shortest, longest = (reduce.reduceat(squared, one_rings.offsets[:-1]) for reduce in (np.minimum, np.maximum))
    return shortest * _LARGEST_RATIO**2 < longest


def reach_along(
    rings: OneRings, layout: Places, charts: Charts | None, is_extrinsic: np.ndarray | None
) -> support.Reach:
    """A function that finds the neighbours within a few edges of given vertices and lays them out.

    They are laid out in charts; without charts, and for the vertices marked in ``is_extrinsic``, in space.
    """

    def k_ring_of(which: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        return k_ring(rings, len(layout.vertices), which, k)

    if charts is None or layout.directions is None:
        return support.reach_in_space(layout.vertices, layout.frames, layout.lift, k_ring_of)
    no_half_edge = layout.directions.no_half_edge
    in_space = support.reach_in_space(
        layout.vertices, layout.frames, layout.lift, k_ring_of, charts.longest_path, no_half_edge
    )
    return support.reach_in_charts(charts, in_space, is_extrinsic)


def charts_of(scheme: Scheme, topology: Topology, layout: Places) -> Charts | None:
    """The charts of a surface (host); None if all rows are laid out in space."""
    if topology.triangulation is None or layout.directions is None:
        return None
    is_closed_to_paths = np.zeros(len(topology.kinds), bool)
    if isinstance(scheme, Monotone) and topology.is_extrinsic is not None:
        is_closed_to_paths = _surrounded(topology.ring, np.asarray(topology.is_extrinsic))
    tails = topology.triangulation.tails
    return Charts(tails, topology.kinds, layout.directions, is_closed_to_paths, longest_path_of(scheme))


def longest_path_of(scheme: Scheme) -> int:
    """The largest number of half-edges in a path, which is the largest number of rings of a fit."""
    return support.LARGEST_RING if isinstance(scheme, Paper) else support.LARGEST_FIT[scheme.degree]


def _surrounded(ring: Table, is_marked: np.ndarray) -> np.ndarray:
    """Whether each vertex and all of its neighbours are marked, (V,) bool.

    For the mask of `at_folded_faces`, which also marks the neighbours of the corners, the result contains every corner
    of a folded face. `Charts` sends no path through these vertices.
    """
    return is_marked & ring.map(lambda block: block.neighbours(is_marked).all(axis=0))


def _table_of(name: str, rows: support.Rows, topology: Topology, chart: _Chart | None) -> dict[str, Any]:
    """The table of rows and their paths (None if they are laid out in space), as fields of a `Topology`."""
    table, paths = build_table(rows.offsets, rows.members), None
    if chart is not None:
        no_half_edge = chart.directions.no_half_edge
        paths = block_paths(table, rows.offsets, rows.paths, no_half_edge, topology.is_extrinsic)
    return {name: table, f"{name}_paths": paths}


def _cotangent_rows(topology: Topology, is_cotangent: np.ndarray, chart: _Chart) -> tuple[CotangentRows, ...]:
    """The rows of the marked vertices, for each block of the Laplacian's table."""
    no_half_edge = chart.directions.no_half_edge
    no_edge = no_half_edge >> 1
    blocks = []
    assert topology.diffusion is not None
    assert topology.diffusion_paths is not None
    for block, paths in zip(topology.diffusion.blocks, topology.diffusion_paths, strict=True):
        columns = np.flatnonzero(block.centre(is_cotangent) & (paths.first != no_half_edge).any(axis=0))
        half_edges = paths.first[:, columns]
        # Half-edge h belongs to edge h >> 1. Clip, so that padding does not read out of range.
        edges = opposite_edges(chart.half_edges, np.minimum(half_edges, no_half_edge - 1), no_edge)
        edges = np.where(half_edges == no_half_edge, no_edge, edges)
        blocks.append(CotangentRows(columns.astype(np.int32), edges.astype(np.int32)))
    return tuple(blocks)


def _meets(rows: support.Rows, mask: np.ndarray) -> np.ndarray:
    """Whether each row has a neighbour that is marked, (V,) bool."""
    owners = np.repeat(np.arange(len(mask)), np.diff(rows.offsets))
    return np.bincount(owners, mask[rows.members], minlength=len(mask)) > 0
