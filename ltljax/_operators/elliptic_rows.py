"""The rows of a general second-order operator: the moment conditions of each row, and weights that satisfy them.

What enters: a diffusion tensor and a drift, a table of neighbours and their layout. What leaves: non-negative weights,
residuals and flux weights. Pure functions, on the host in NumPy and in JAX alike, except where marked (host).
"""

import numpy as np

from .._lifting import support
from .._lifting.intrinsic import CotangentRows, Paths, cotangent_weights, with_columns
from .._lifting.jets import operator_weights
from .._lifting.layout import PerBlock, Places, block_paths, rows_last
from .._lifting.weighing import Geometry, Topology, conormals_in_frame, flux_weights
from .._tables import AnyArray, Table, build_table, slot_sum, slot_values

# Factor by which the first-moment (drift) conditions count more than the second moments if not all can be met.
EMPHASIS = 1e2


def operator_targets(frames: AnyArray, diffusion: AnyArray | float, drift: AnyArray | None) -> AnyArray:
    """The operator applied to x, y, xy, x^2 and y^2 in the frame of each vertex, (1, 5, V)."""
    xp = frames.__array_namespace__()
    coefficient = xp.asarray(diffusion, dtype=frames.dtype)
    if coefficient.ndim == 3:
        tensor = xp.einsum("vac,vcd,vbd->abv", frames, coefficient, frames)
        xx, xy, yy = tensor[0, 0], tensor[0, 1], tensor[1, 1]
    else:
        xx = yy = xp.broadcast_to(coefficient, frames.shape[:1])
        xy = xp.zeros_like(xx)
    b = xp.zeros((2, frames.shape[0]), dtype=frames.dtype)
    if drift is not None:
        b = xp.einsum("vac,vc->av", frames, xp.asarray(drift, dtype=frames.dtype))
    return xp.stack([b[0], b[1], 2 * xy, 2 * xx, 2 * yy])[None]


def mean_diffusion(targets: AnyArray) -> AnyArray:
    """Half the trace of D in the tangent plane, averaged over the vertices."""
    return targets.__array_namespace__().asarray((targets[0, 3] + targets[0, 4]).mean() / 4)


def largest_advection(targets: AnyArray) -> AnyArray:
    """The largest b . D^-1 b over the surface, infinite if there is drift without diffusion.

    For a divergence-free drift b and any u of norm one, <u, b . grad u> is imaginary, and its squared magnitude is at
    most b . D^-1 b times the real number <grad u, D grad u>.
    """
    xp = targets.__array_namespace__()
    x, y, cross, xx, yy = targets[0, 0], targets[0, 1], targets[0, 2] / 2, targets[0, 3] / 2, targets[0, 4] / 2
    with np.errstate(over="ignore"):  # overflows to infinity if there is hardly any diffusion
        # Scale D to the trace 2, so that no product leaves the range of the float type.
        unit = (xx + yy) / 2
        unit = xp.where(unit > 0, unit, 1)
        xx, yy, cross, x, y = xx / unit, yy / unit, cross / unit, x / xp.sqrt(unit), y / xp.sqrt(unit)
        determinant = xx * yy - cross**2
        is_regular = determinant > 4 * xp.finfo(targets.dtype).eps
        across = xp.maximum(yy * x**2 - 2 * cross * x * y + xx * y**2, 0)
        ratio = xp.where(is_regular, across / xp.where(is_regular, determinant, 1), xp.inf)
    return xp.asarray(xp.max(xp.where((x != 0) | (y != 0), ratio, 0)))


def rows_width(table: Table, weights: PerBlock, advection: AnyArray, measured: float | None = None) -> AnyArray:
    """The spectral width of rows.

    It is ``(sqrt(w) + sqrt(a))^2``, with w the width without drift, measured or estimated, and a the largest advection,
    but at most ``2 max(row sums)``.
    """
    xp = advection.__array_namespace__()
    sums = slot_sum(table, weights)
    if measured is None:
        # The mean row sum, weighted by the row sums themselves, so that a few active rows count.
        share = sums / xp.maximum(xp.sum(sums), xp.finfo(sums.dtype).tiny)
        measured = xp.sum(share * sums)
    return xp.asarray(xp.minimum(2 * xp.max(sums), (xp.sqrt(measured) + xp.sqrt(advection)) ** 2))


def rows_table(rows: support.Rows, topology: Topology, layout: Places) -> tuple[Table, tuple[Paths, ...] | None]:
    """The table of rows, and their paths if rows are laid out in charts (host)."""
    table = build_table(rows.offsets, rows.members)
    if layout.directions is None:
        return table, None
    no_half_edge = layout.directions.no_half_edge
    return table, block_paths(table, rows.offsets, rows.paths, no_half_edge, topology.is_extrinsic)


def weigh_rows(
    layout: Places,
    kinds: AnyArray,
    targets: AnyArray,
    table: Table,
    paths: tuple[Paths, ...] | None,
    cotangent_rows: tuple[CotangentRows, ...] | None,
) -> tuple[PerBlock, AnyArray, AnyArray]:
    """The weights, the residual of every row, and the excess (V, 2) of the first moments over the drift."""

    def weigh_block(block, lifted):
        xp = lifted.__array_namespace__()
        lifted = xp.moveaxis(lifted, -1, 1)
        block_targets = block.centre(targets[0].T).T[None]
        c, residual = operator_weights(lifted, block.centre(kinds), block_targets, nonnegative=True, emphasis=EMPHASIS)
        excess = xp.einsum("kn,kna->an", c[0], lifted) - block_targets[0, :2]
        return c[0], residual[0], excess

    weights, residuals, excesses = zip(*table.each(weigh_block, rows_last(layout.lifted(table, paths))), strict=True)
    excess = table.rows_from([part.T for part in excesses])
    if cotangent_rows is None or layout.directions is None:
        return weights, table.rows_from(list(residuals)), excess
    blocks = []
    half_trace = (targets[0, 3] + targets[0, 4]) / 4
    for block, row, weight, residual in zip(table.blocks, cotangent_rows, weights, residuals, strict=True):
        cotangent, area = cotangent_weights(layout.directions, row)
        scaled = cotangent * block.part(row.columns).centre(half_trace)[None]
        exact = with_columns(residual[None], row.columns, 0 * area[None])[0]
        blocks.append((with_columns(weight, row.columns, scaled), exact))
    weights, residuals = zip(*blocks, strict=True)
    return weights, table.rows_from(list(residuals)), excess


def boundary_flux_weights(
    topology: Topology,
    geometry: Geometry,
    targets: AnyArray,
    excess: AnyArray,
    table: Table,
    cotangent_rows: tuple[CotangentRows, ...] | None,
) -> AnyArray:
    """The change of the operator per unit flux through both sides of each boundary vertex, (B, 2).

    It follows from the excess of the first moments over the drift. If a row is a multiple of the Laplacian's row, its
    flux weights are the same multiple.
    """
    conormals = conormals_in_frame(topology, geometry.frames, geometry.conormals, geometry.directions)
    weights = flux_weights(excess[topology.boundary], conormals)
    if cotangent_rows is None or geometry.flux_weights is None:
        return weights
    xp = weights.__array_namespace__()
    marks = [
        with_columns(
            0 * block.centre(targets[0, 0])[None], rows.columns, xp.ones((1, *rows.columns.shape), weights.dtype)
        )[0]
        for block, rows in zip(table.blocks, cotangent_rows, strict=True)
    ]
    is_cotangent = table.rows_from(marks)[topology.boundary] > 0
    half_trace = ((targets[0, 3] + targets[0, 4]) / 4)[topology.boundary]
    return xp.where(is_cotangent[:, None], half_trace[:, None] * geometry.flux_weights, weights)


def is_isotropic(targets: np.ndarray) -> np.ndarray:
    """Whether the operator is a multiple of the Laplacian at each vertex, (V,) bool (host)."""
    x, y, xy, xx, yy = np.abs(targets[0])
    small = 1e-12 * (xx + yy)
    return (x <= small) & (y <= small) & (xy <= small) & (np.abs(targets[0, 3] - targets[0, 4]) <= small)


def cotangent_vertices(topology: Topology) -> np.ndarray:
    """Whether the Laplacian row of each vertex is a cotangent row, (V,) bool (host)."""
    is_cotangent = np.zeros(len(topology.kinds), bool)
    if topology.cotangent_rows is not None and topology.diffusion is not None:
        for block, rows in zip(topology.diffusion.blocks, topology.cotangent_rows, strict=True):
            is_cotangent[block.part(rows.columns).centre(np.arange(len(is_cotangent)))] = True
    return is_cotangent


def with_cotangent_rows(
    rows: support.Rows, topology: Topology, which: np.ndarray
) -> tuple[support.Rows, tuple[CotangentRows, ...] | None]:
    """The rows, with those of the marked vertices replaced by the cotangent rows of the Laplacian (host)."""
    if topology.cotangent_rows is None or topology.diffusion is None or topology.diffusion_paths is None:
        return rows, None
    no_edge = len(topology.triangulation.ends) if topology.triangulation is not None else 0
    owners, members, paths = [], [], []
    for block, laid, row in zip(
        topology.diffusion.blocks, topology.diffusion_paths, topology.cotangent_rows, strict=True
    ):
        part = block.part(row.columns)
        own = np.broadcast_to(part.centre(np.arange(len(which))), part.indices.shape)
        used = (part.indices != own) & which[own]
        path = np.full((used.sum(), rows.paths.shape[1]), 2 * no_edge)
        path[:, 0] = laid.first[:, row.columns][used]
        owners.append(own[used])
        members.append(part.indices[used])
        # Append the edges of the cotangents to the paths, so that both are reordered together.
        paths.append(np.concatenate([path, row.edges[:, used].T], axis=1))
    wide = support.Rows(
        rows.offsets, rows.members, np.concatenate([rows.paths, np.full((len(rows.members), 5), no_edge)], axis=1)
    )
    entries = (np.concatenate(parts) for parts in (owners, members, paths))
    wide = wide.replaced(*entries, which=np.flatnonzero(which))
    edges = zip(*(slot_values(wide.offsets, column, no_edge) for column in wide.paths[:, -5:].T), strict=True)
    blocks = []
    for block in edges:
        columns = np.flatnonzero((block[0] != no_edge).any(axis=0))
        blocks.append(CotangentRows(columns.astype(np.int32), np.stack(block)[:, :, columns].astype(np.int32)))
    return support.Rows(wide.offsets, wide.members, wide.paths[:, :-5]), tuple(blocks)
