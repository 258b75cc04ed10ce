"""From a mesh to the tables of a surface: everything about it that is chosen once, on the host, and then frozen.

What enters: a checked `Mesh` and a scheme. What leaves: the `Topology`, whose rows of neighbours were chosen from the
positions, and a report of what was found.
"""

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from .._base.progress import Laps
from .._lifting import support
from .._lifting.charts import Charts, Neighbourhood
from .._lifting.delaunay import HalfEdges, delaunay_triangulation, opposite_edges
from .._lifting.frames import tangent_frames
from .._lifting.intrinsic import CotangentRows, Directions, RingAngles, directions
from .._lifting.jets import INTERIOR, LAPLACIAN, OTHER_CORNER, RIGHT_CORNER, SMOOTH
from .._lifting.layout import Places, block_paths
from .._lifting.paper import dropped_faces
from .._lifting.ring import RingTopology, angle_sums, lifted_ring, offsets
from .._lifting.schemes import (
    Monotone,
    Paper,
    Polynomial,
    Scheme,
    Topology,
    diffusion_rows,
    places_in,
    ring_normals,
    surface_normals,
    vertex_frames,
)
from .._mesh import Mesh, OneRings, corner_angles, half_edges, k_ring, one_rings, shared_edges
from .._tables import Table, build_table, reversible

# A boundary that turns by more than this many degrees at a vertex has a corner there, and within so many degrees of a
# right angle it counts as one.
_CORNER, _RIGHT = 40, 20
# An edge is a crease where its two faces turn from one another by more than this many degrees. No height fit crosses a
# crease: this affects normals, how vectors are transported, `hodge_laplacian`, `crease_mean`, and where `Polynomial`
# uses charts.
CREASE = 40
# The normal of a face with an angle beyond this says little about the surface, and its edges are no creases.
_FLATTEST = 150

# How many times as long as its shortest edge a vertex's longest may be, for a quadratic to be fitted to its ring.
_LARGEST_RATIO = 1e5

Watching = Callable[[str], support.Watch]


# Where at a twentieth of the vertices the normals turn by more radians than this between a vertex and the farthest
# neighbour of its fit, `Monotone` is as accurate as `Polynomial(4)` for Poisson's equation, on round and bumpy tori.
_COARSE, _COARSE_SHARE = 0.95, 0.05


class CoarseMeshWarning(UserWarning):
    """The mesh is too coarse against the curvature of its surface for a polynomial fit to pay."""


class InconsistentRowsWarning(UserWarning):
    """Some vertices have no consistent row of weights, so that the Laplacian is not accurate there."""


@dataclasses.dataclass(frozen=True, eq=False)
class SurfaceReport:
    """What the construction of a surface found.

    Attributes:
        dropped_faces: (V,) for `Paper`, the number of faces at each vertex that its lift makes degenerate, which have
            no part in the mean; else None.
        wide_gradient_rows: vertices whose one-ring (for `Polynomial`, whose nearest neighbours) does not determine the
            fit, so that the gradient uses more; None for `Paper`.
        undetermined: vertices where no choice of neighbours determines the fit. The gradient loses its order there, and
            for `Polynomial` so does the Laplacian.
        rings: (V,) for `Monotone`, the number of rings each Laplacian row was chosen from; else None.
        residual: (V,) for `Monotone`, the relative moment residual of each Laplacian row; else None.
        cotangent: vertices whose Laplacian row is the cotangent row of the intrinsic Delaunay triangulation: those
            without a consistent non-negative row, obtuse corners of the boundary, where fields are not smooth, and
            vertices whose edges are so uneven that a fit would be lost in rounding. It is right in the weak sense:
            solutions converge, and the Laplacian of a field at the vertex itself need not.
        inconsistent: vertices without a consistent non-negative row, the cotangent rows aside. Diffusion is stable
            there, but not accurate.
        extrinsic: vertices at faces that are folded over, and their neighbours. Their rows are laid out in space.
        creased: vertices whose neighbours lie across a crease, so that no height fit is made there.
        flips: the number of edge flips that lead to the intrinsic Delaunay triangulation.
        seconds: how long each part of the construction took.
    """

    dropped_faces: np.ndarray | None = None
    wide_gradient_rows: np.ndarray | None = None
    undetermined: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    rings: np.ndarray | None = None
    residual: np.ndarray | None = None
    cotangent: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    inconsistent: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    extrinsic: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    creased: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    flips: int = 0
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)

    # A report decides no computation, so surfaces that differ only in it share compiled code.
    def __eq__(self, other):
        return isinstance(other, SurfaceReport)

    def __hash__(self):
        return hash(SurfaceReport)

    def __str__(self):
        lines = []
        if self.dropped_faces is not None:
            lines.append(("degenerate lifted faces", f"{self.dropped_faces.sum()}"))
        if self.wide_gradient_rows is not None:
            lines.append(("gradient rows wider than usual", f"{len(self.wide_gradient_rows)}"))
        if len(self.undetermined):
            lines.append(("gradient rows not determined", f"{len(self.undetermined)}"))
        if self.rings is not None and self.residual is not None:
            is_fitted = np.ones(len(self.rings), bool)
            is_fitted[np.concatenate([self.cotangent, self.inconsistent]).astype(int)] = False
            lines += [
                (f"Laplacian rows from {n} ring{'s' * (n > 1)}", f"{np.sum(is_fitted & (self.rings == n))}")
                for n in (1, 2, 3)
            ]
            lines.append(("cotangent Laplacian rows", f"{len(self.cotangent)}"))
            lines.append(("inconsistent Laplacian rows", f"{len(self.inconsistent)}"))
            if len(self.inconsistent):
                lines.append(("worst moment residual", f"{self.residual[self.inconsistent].max():.2g}"))
        counts = (
            ("rows laid out in space at folded faces", len(self.extrinsic)),
            ("vertices at creases", len(self.creased)),
            ("edges flipped to intrinsic Delaunay", self.flips),
        )
        lines += [(name, f"{count}") for name, count in counts if count]
        lines += [(f"seconds for {part}", f"{seconds:.2f}") for part, seconds in self.seconds.items()]
        return "\n".join(f"{name:<40}{value}" for name, value in lines)


def freeze(
    mesh: Mesh, scheme: Scheme, watch: Watching, laps: Laps
) -> tuple[Topology, RingAngles | None, SurfaceReport]:
    """The topology of a mesh under a scheme, in NumPy: the rings, and the neighbours chosen from the positions.

    Args:
        mesh: the mesh.
        scheme: what the rows are for.
        watch: gives, for the name of a piece of work, what shows how far it has come.
        laps: the stopwatch of the construction.

    Returns:
        The topology; the angles of the rings, or None where no row is laid out in a chart; and the report.
    """
    rings = one_rings(mesh.faces, mesh.num_vertices)
    ring = build_table(rings.offsets, rings.neighbours)
    ring_blocks = _ring_blocks(ring, rings.valences, mesh.boundary_vertices)
    loops = mesh.boundary_loops
    topology = Topology(
        faces=mesh.faces.astype(np.int32),
        ring=ring,
        ring_blocks=ring_blocks,
        kinds=_kinds(mesh, ring, ring_blocks),
        boundary=np.concatenate([np.zeros(0, np.int32), *loops]),
        loops=np.repeat(np.arange(len(loops), dtype=np.int32), [len(loop) for loop in loops]),
        jet=ring,
        diffusion=None,
        components=mesh.components,
        num_loops=len(loops),
        num_components=int(mesh.components.max()) + 1,
    )
    laps.end("rings")
    if isinstance(scheme, Paper):
        return topology, None, SurfaceReport(dropped_faces=_dropped_faces(mesh, topology))
    return _choose_neighbours(mesh, rings, topology, scheme, watch, laps)


def with_reverse(topology: Topology) -> Topology:
    """The topology with the reverse of the tables that operators sum over."""
    jet, diffusion = topology.jet, topology.diffusion
    reverse = reversible(jet)
    return dataclasses.replace(
        topology,
        jet=reverse,
        diffusion=diffusion if diffusion is None else reverse if diffusion is jet else reversible(diffusion),
    )


def warn_of_rows(report: SurfaceReport, scheme: Scheme, stacklevel: int) -> None:
    """Warn where some rows are not consistent, or not determined."""
    if len(report.inconsistent):
        residual = np.asarray(report.residual)
        worst = report.inconsistent[np.argmax(residual[report.inconsistent])]
        warnings.warn(
            f"{len(report.inconsistent)} of {len(residual)} vertices have no consistent non-negative row, the worst "
            f"being vertex {worst}. Diffusion stays stable there, but is not accurate. Causes are spikes, folds and "
            "slivers: see surface.report.inconsistent, and remesh around them.",
            InconsistentRowsWarning,
            stacklevel=stacklevel + 1,
        )
    elif isinstance(scheme, Polynomial) and len(report.undetermined):
        warnings.warn(
            f"At {len(report.undetermined)} vertices, the first being vertex {report.undetermined[0]}, no five rings "
            f"of neighbours determine a polynomial of degree {scheme.degree}. The mesh is too coarse or too thin "
            "there: subdivide it, or use ltl.Monotone().",
            InconsistentRowsWarning,
            stacklevel=stacklevel + 1,
        )


def warn_of_coarse_mesh(topology: Topology, normals: np.ndarray, scheme: Scheme, stacklevel: int) -> None:
    """Warn where the neighbours of a polynomial fit see too much of the curvature."""
    if not isinstance(scheme, Polynomial):
        return

    def apart(block):
        return np.linalg.norm(block.neighbours(normals) - block.centre(normals)[None], axis=2).max(axis=0)

    turn = 2 * np.arcsin(np.minimum(topology.jet.map(apart) / 2, 1))
    # Across a crease a turn says nothing about the smooth sides.
    smooth = turn if topology.is_creased is None else turn[~topology.is_creased]
    if smooth.size and (most := np.quantile(smooth, 1 - _COARSE_SHARE)) > _COARSE:
        warnings.warn(
            f"The mesh is coarse against its curvature: at {_COARSE_SHARE:.0%} of the vertices normals turn by more "
            f"than {np.degrees(most):.0f} degrees over the neighbours of one fit. Beyond {np.degrees(_COARSE):.0f} "
            "degrees ltl.Monotone() was as accurate or more for Poisson's equation: use it, or subdivide the mesh.",
            CoarseMeshWarning,
            stacklevel=stacklevel + 1,
        )


def _choose_neighbours(
    mesh: Mesh, rings: OneRings, topology: Topology, scheme: Monotone | Polynomial, watch: Watching, laps: Laps
) -> tuple[Topology, RingAngles | None, SurfaceReport]:
    """The topology with the rows of the gradient and of the Laplacian, the angles of the rings if there are charts, and
    the report."""
    vertices = mesh.vertices
    normals = ring_normals(scheme, vertices, topology.ring, topology.ring_blocks)
    is_intrinsic = isinstance(scheme, Monotone) and scheme.lift == "intrinsic"
    on_crease, is_folded = None, _at_folded_faces(mesh, normals)
    if is_intrinsic or isinstance(scheme, Polynomial):
        on_crease = _creased_vertices(mesh) & ~is_folded
    topology, chart = _lay_charts(mesh, topology, scheme, is_folded, on_crease)

    laps.end("charts")
    angles, chart_directions, charts = None, None, None
    if chart is not None:
        angles, chart_directions, charts = chart.angles, chart.directions, chart.charts
    around = Places(vertices, normals, tangent_frames(normals), chart_directions, None, "projection")

    def reach_of(is_extrinsic: np.ndarray | None) -> support.Reach:
        return reach_along(rings, around, charts, is_extrinsic)

    nearest = reach_of(topology.is_extrinsic)(np.arange(mesh.num_vertices), 1)
    watch_gradient = watch("choosing the neighbours of the gradient")
    topology, report = _choose_gradient(
        scheme, topology, reach_of, nearest, chart, on_crease, is_folded, watch_gradient
    )
    laps.end("gradient rows")
    if isinstance(scheme, Polynomial):
        topology = dataclasses.replace(topology, diffusion=topology.jet, diffusion_paths=topology.jet_paths)
        return topology, angles, report

    places, reach = around, reach_of(topology.is_extrinsic)
    if chart is None or topology.is_extrinsic is not None:
        # Rows in space are chosen in the tangent planes they will be weighed in.
        normals = surface_normals(scheme, vertices, topology)
        frames, _ = vertex_frames(vertices, normals, topology)
        places = places_in(scheme, topology, vertices, normals, frames, chart_directions)
        reach = reach_along(rings, places, charts, topology.is_extrinsic)
        nearest = reach(np.arange(mesh.num_vertices), 1)
    topology, report = _choose_diffusion(
        scheme,
        topology,
        places,
        reach,
        nearest,
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
    nearest: Neighbourhood,
    chart: "_Chart | None",
    on_crease: np.ndarray | None,
    is_folded: np.ndarray,
    watch: support.Watch,
) -> tuple[Topology, SurfaceReport]:
    """The rows of the gradient. ``reach_of(is_extrinsic)`` finds wider neighbourhoods, in space for the marked
    vertices; ``nearest`` holds the one-rings, already laid out."""
    one_ring = support.Rows.all_of(nearest)
    report = SurfaceReport(flips=0 if chart is None else chart.num_flips)
    jet, wide, undetermined = support.fit_support(one_ring, scheme.degree, reach_of(topology.is_extrinsic), watch)
    if on_crease is not None:
        is_wide = np.full(len(on_crease), isinstance(scheme, Polynomial))
        is_wide[wide] = True
        is_creased = (on_crease | (is_wide & _meets(jet, on_crease))) & ~is_folded
        if is_creased.any():
            topology = dataclasses.replace(topology, is_creased=is_creased)
            report = dataclasses.replace(report, creased=np.flatnonzero(is_creased))
            if isinstance(scheme, Polynomial):
                # Those rows are laid out in charts, and chosen again.
                topology = dataclasses.replace(topology, is_extrinsic=~is_creased)
                jet, wide, undetermined = support.fit_support(one_ring, scheme.degree, reach_of(~is_creased), watch)
    topology = dataclasses.replace(topology, **_table_of("jet", jet, topology, chart))
    return topology, dataclasses.replace(report, wide_gradient_rows=wide, undetermined=undetermined)


def _choose_diffusion(
    scheme: Monotone,
    topology: Topology,
    places: Places,
    reach: support.Reach,
    nearest: Neighbourhood,
    chart: "_Chart | None",
    watch: support.Watch,
    report: SurfaceReport,
) -> tuple[Topology, SurfaceReport]:
    """The rows of the Laplacian of `Monotone`. ``reach`` finds wider neighbourhoods; ``nearest`` holds the one-rings,
    already laid out."""
    one_ring = support.Rows.all_of(nearest)
    narrow = dataclasses.replace(topology, **_table_of("diffusion", one_ring, topology, chart))
    _, residual, _, _ = diffusion_rows(scheme, places, narrow)
    is_good = residual <= support.CONSISTENT
    is_cotangent = np.zeros(len(is_good), bool)
    if chart is not None:
        is_cotangent = _singular_corners(topology.kinds, chart.angles.sums, one_ring) | _is_uneven(nearest)
        if topology.is_extrinsic is not None:
            is_cotangent &= ~topology.is_extrinsic
    rows, record = support.nonnegative_support(
        one_ring, is_good | is_cotangent, topology.kinds, LAPLACIAN.T, reach, watch
    )
    if chart is not None:
        has_none = np.isin(np.arange(len(is_good)), record.inconsistent)
        is_cotangent |= has_none if topology.is_extrinsic is None else has_none & ~topology.is_extrinsic
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
    """What lays out neighbours by edge lengths, on the host."""

    half_edges: HalfEdges
    angles: RingAngles
    directions: Directions
    charts: Charts
    num_flips: int


def _lay_charts(
    mesh: Mesh, topology: Topology, scheme: Monotone | Polynomial, is_folded: np.ndarray, on_crease: np.ndarray | None
) -> tuple[Topology, _Chart | None]:
    """The topology with its triangulation and the rows that are laid out in space, where any row is laid out in a
    chart: all rows of the intrinsic `Monotone` but those at folded faces, and of `Polynomial` those at creases."""
    if on_crease is None or (isinstance(scheme, Polynomial) and not on_crease.any()):
        return topology, None
    triangulation, half_edges, angles = delaunay_triangulation(
        mesh.faces, mesh.vertices, topology.ring, topology.ring_blocks, is_folded
    )
    chart_directions = directions(angles, triangulation, topology.kinds)
    charts = Charts(
        triangulation.tails,
        topology.kinds,
        chart_directions,
        _surrounded(topology.ring, is_folded),
        support.LARGEST_FIT[scheme.degree],
    )
    is_extrinsic = is_folded if isinstance(scheme, Monotone) else np.ones_like(is_folded)
    topology = dataclasses.replace(
        topology, triangulation=triangulation, is_extrinsic=is_extrinsic if is_extrinsic.any() else None
    )
    num_flips = int(np.sum(triangulation.flips.flipped < len(triangulation.tails)))
    return topology, _Chart(half_edges, angles, chart_directions, charts, num_flips)


def _singular_corners(kinds: np.ndarray, angle_sums: np.ndarray, one_ring: support.Rows) -> np.ndarray:
    """The corners of the boundary near which fields without flux are not smooth, (V,).

    At an obtuse corner such fields have no second derivatives, at a re-entrant one not even a gradient, so that no row
    can be consistent with them. The same holds at a corner next to such a corner.
    """
    is_corner, is_right = kinds >= RIGHT_CORNER, kinds == RIGHT_CORNER
    is_singular = is_corner & (angle_sums > np.where(is_right, np.pi, np.pi / 2))
    return is_singular | (is_corner & _meets(one_ring, is_singular))


def _is_uneven(around: Neighbourhood) -> np.ndarray:
    """Which vertices have edges whose ratio of lengths is too large to fit in double precision, (V,)."""
    squared = np.sum(around.lifted**2, axis=1)
    shortest, longest = (reduce.reduceat(squared, around.offsets[:-1]) for reduce in (np.minimum, np.maximum))
    return shortest * _LARGEST_RATIO**2 < longest


def reach_along(
    rings: OneRings, places: Places, charts: Charts | None, is_extrinsic: np.ndarray | None
) -> support.Reach:
    """What finds the neighbours within a few edges of any vertices, and lays them out: in charts, but in space without
    charts and for the vertices that are marked."""

    def around(which: np.ndarray, rings_wide: int) -> tuple[np.ndarray, np.ndarray]:
        return k_ring(rings, len(places.vertices), which, rings_wide)

    if charts is None or places.directions is None:
        return support.reach_in_space(places.vertices, places.frames, places.lift, around)
    no_half_edge = places.directions.no_half_edge
    in_space = support.reach_in_space(
        places.vertices, places.frames, places.lift, around, charts.longest_path, no_half_edge
    )
    return support.reach_in_charts(charts, in_space, is_extrinsic)


def charts_of(scheme: Scheme, topology: Topology, places: Places) -> Charts | None:
    """The charts of a surface (host); None where all rows are laid out in space."""
    if topology.triangulation is None or places.directions is None:
        return None
    is_closed = np.zeros(len(topology.kinds), bool)
    if isinstance(scheme, Monotone) and topology.is_extrinsic is not None:
        is_closed = _surrounded(topology.ring, np.asarray(topology.is_extrinsic))
    longest = support.LARGEST_FIT.get(getattr(scheme, "degree", 2), support.LARGEST_RING)
    return Charts(topology.triangulation.tails, topology.kinds, places.directions, is_closed, longest)


def _surrounded(ring: Table, is_folded: np.ndarray) -> np.ndarray:
    """Of the marked vertices those with marked neighbours only, (V,). If corners of folded faces and their neighbours
    are marked, every such corner is among them; no path may lead through them."""
    return is_folded & ring.map(lambda block: block.neighbours(is_folded).all(axis=0))


def _table_of(name: str, rows: support.Rows, topology: Topology, chart: _Chart | None) -> dict[str, Any]:
    """The table of rows and, where they are laid out in charts, their paths, as fields of a `Topology`."""
    table, paths = build_table(rows.offsets, rows.members), None
    if chart is not None:
        none = chart.directions.no_half_edge
        paths = block_paths(table, rows.offsets, rows.paths, none, topology.is_extrinsic)
    return {name: table, f"{name}_paths": paths}


def _cotangent_rows(topology: Topology, is_cotangent: np.ndarray, chart: _Chart) -> tuple[CotangentRows, ...]:
    """For each block of the Laplacian's table its rows that belong to the marked vertices."""
    none = chart.directions.no_half_edge
    blocks = []
    assert topology.diffusion is not None
    assert topology.diffusion_paths is not None
    for block, paths in zip(topology.diffusion.blocks, topology.diffusion_paths, strict=True):
        columns = np.flatnonzero(block.centre(is_cotangent) & (paths.first != none).any(axis=0))
        half_edges = paths.first[:, columns]
        edges = opposite_edges(chart.half_edges, np.minimum(half_edges, none - 1), none >> 1)
        edges = np.where(half_edges == none, none >> 1, edges)
        blocks.append(CotangentRows(columns.astype(np.int32), edges.astype(np.int32)))
    return tuple(blocks)


def _creased_vertices(mesh: Mesh) -> np.ndarray:
    """Which vertices are the end of a crease, (V,)."""
    one, other, _ = shared_edges(mesh.faces, mesh.num_vertices)
    normals = _face_normals(mesh)
    size = np.linalg.norm(normals, axis=1)
    is_reliable = (corner_angles(mesh.vertices, mesh.faces).max(axis=1) < np.radians(_FLATTEST)) & (size > 0)
    one_face, other_face = one % len(mesh.faces), other % len(mesh.faces)
    cosine = np.sum(normals[one_face] * normals[other_face], axis=1)
    is_crease = cosine < np.cos(np.radians(CREASE)) * size[one_face] * size[other_face]
    is_crease &= is_reliable[one_face] & is_reliable[other_face]
    on_crease = np.zeros(mesh.num_vertices, bool)
    on_crease[half_edges(mesh.faces)[one[is_crease]]] = True
    return on_crease


def _at_folded_faces(mesh: Mesh, normals: np.ndarray) -> np.ndarray:
    """Which vertices belong to a face that is folded over, or are neighbours of one that does, (V,).

    The normal of such a face points away from the normals of the rings at all three of its corners.
    """
    face_normals = _face_normals(mesh)
    cosine = np.einsum("fkc,fc->fk", normals[mesh.faces], face_normals)
    is_folded = (cosine < 0).all(axis=1)
    is_at = np.zeros(mesh.num_vertices, bool)
    is_at[mesh.faces[is_folded]] = True
    is_beside = is_at[mesh.faces].any(axis=1)
    is_at[mesh.faces[is_beside]] = True
    return is_at


def _face_normals(mesh: Mesh) -> np.ndarray:
    """The normals of the faces, (F, 3), as long as their areas doubled."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return np.cross(b - a, c - a)


def _meets(rows: support.Rows, mask: np.ndarray) -> np.ndarray:
    """Which rows have a neighbour in a mask, (V,)."""
    owners = np.repeat(np.arange(len(mask)), np.diff(rows.offsets))
    return np.bincount(owners, mask[rows.members], minlength=len(mask)) > 0


def _dropped_faces(mesh: Mesh, topology: Topology) -> np.ndarray:
    """How many faces at each vertex the lift of `Paper` makes degenerate, (V,)."""
    frames = tangent_frames(ring_normals(Paper(), mesh.vertices, topology.ring, topology.ring_blocks))

    def dropped(block, ring):
        lifted = lifted_ring(offsets(mesh.vertices, block), block.centre(frames), "projection")
        return dropped_faces(lifted, ring)

    return topology.ring.map(dropped, topology.ring_blocks)


def _kinds(mesh: Mesh, ring: Table, ring_blocks: tuple[RingTopology, ...]) -> np.ndarray:
    """Which vertices lie inside, on a smooth boundary, or at a corner of it, (V,) int8: by their inner angles."""
    sums = ring.map(lambda block, rings: angle_sums(offsets(mesh.vertices, block), rings), ring_blocks)
    turn = np.abs(np.degrees(sums) - 180)
    kinds = np.full(mesh.num_vertices, INTERIOR, np.int8)
    boundary = np.concatenate([np.zeros(0, np.int32), *mesh.boundary_loops])
    is_corner, is_right = turn > _CORNER, np.abs(turn - 90) < _RIGHT
    kinds[boundary] = np.where(is_corner, np.where(is_right, RIGHT_CORNER, OTHER_CORNER), SMOOTH)[boundary]
    return kinds


def _ring_blocks(ring: Table, valences: np.ndarray, is_boundary: np.ndarray) -> tuple[RingTopology, ...]:
    """The ring topology of every block; rows that live in the tail are empty in the bulk."""
    blocks = []
    for block in ring.blocks:
        rows = np.arange(len(valences)) if block.rows is None else block.rows
        own = np.where(valences[rows] <= block.indices.shape[0], valences[rows], 0)
        blocks.append(RingTopology(own.astype(np.int32), is_boundary[rows]))
    return tuple(blocks)
