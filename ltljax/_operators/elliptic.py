"""General second-order operators on a surface, by the same moments as the Laplacian, with non-negative weights.

What enters: a surface, a tensor of diffusion and a field of drift. What leaves: an `EllipticStencil`, which applies
``D : Hess u + b . grad u``, and whose weights are pure functions of D and b on frozen neighbours.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float

from .._base.progress import watched
from .._lifting import support
from .._lifting.intrinsic import CotangentRows, Paths, cotangent_weights, with_columns
from .._lifting.jets import operator_weights
from .._lifting.layout import PerBlock, Places, block_paths, rows_last
from .._lifting.schemes import Geometry, Topology, conormals_in_frame, flux_weights, places
from .._mesh import one_rings
from .._surface.building import charts_of, reach_along
from .._surface.surface import Surface, on_device, on_surface
from .._tables import (
    AnyArray,
    ReverseWeights,
    Table,
    build_table,
    difference_matrix,
    difference_sum,
    reverse_weights,
    reversible,
    slot_sum,
    slot_values,
)
from .scalar import MOST_MEASURED, gradient, measured_width

# Where not every condition can be met the drift is to be exact, and the excess of diffusion the least.
_EMPHASIS = 1e2


class EllipticStencil(eqx.Module):
    """The operator D : Hess u + b . grad u on a surface; call it on a field, (V,) or (V, S).

    Attributes:
        table: the neighbours.
        paths: for each block the half-edges that lead to them; None where all rows are laid out in space.
        cotangent_rows: for each block the rows that are those of the cotangent Laplacian times half the trace of D.
        weights: one array (K, N) per block of the table, non-negative.
        reverse: the same weights in the order of the table's reverse, for derivatives in reverse mode.
        residual: (V,) the largest error of a moment of each row, relative, zero to rounding where it is consistent.
        flux_weights: (B, 2) what a unit flux through each side of a boundary vertex adds to the operator there.
        mean_diffusion: half the trace of D in the tangent plane, its mean over the vertices.
        width: the spectral width, see `spectral_width`.
    """

    table: Table
    paths: tuple[Paths, ...] | None
    cotangent_rows: tuple[CotangentRows, ...] | None
    weights: PerBlock
    reverse: ReverseWeights | None
    residual: Float[AnyArray, " V"]
    flux_weights: Float[AnyArray, "B 2"]
    mean_diffusion: Float[AnyArray, ""]
    width: Float[AnyArray, ""]

    def __call__(self, u: Float[AnyArray, "V *S"]) -> Float[Array, "V *S"]:
        """The operator applied to u."""
        return _apply(self, u)

    def matrix(self) -> scipy.sparse.csr_array:
        """The operator as a SciPy sparse matrix (V, V) (host)."""
        return difference_matrix(self.table, self.weights)

    def spectral_bound(self) -> Float[Array, ""]:
        """An upper bound of the magnitude of the eigenvalues, by Gershgorin's discs."""
        return 2 * jnp.max(slot_sum(self.table, self.weights))

    def spectral_width(self) -> Float[Array, ""]:
        """How far eigenvalues lie off the real axis, in the sense of `ltl.operators.spectral_width`.

        An estimate, and at most the spectral bound, which always suffices. What rows that are not symmetric contribute
        is measured when the stencil is chosen, as for the Laplacian, and estimated from the row sums for other
        coefficients; the drift contributes the largest value of b . D^-1 b. It has no derivatives.
        """
        return jnp.asarray(self.width)

    def with_coefficients(
        self,
        surface: Surface,
        diffusion: AnyArray | float,
        drift: AnyArray | None = None,
        divergence_form: bool = False,
    ) -> "EllipticStencil":
        """The stencil of other coefficients, or of a moved surface, on the same neighbours: pure and differentiable.

        As good as the neighbours suit the new coefficients; ``residual`` tells.
        """
        frames = surface.geometry.frames
        advection = _largest_advection(_targets(frames, diffusion, drift))
        if divergence_form:
            drift = _with_divergence(surface, diffusion, drift)
        targets = _targets(frames, diffusion, drift)
        around = places(surface.scheme, surface.topology, surface.geometry)
        weights, residual, left = _rows(
            around, surface.topology.kinds, targets, self.table, self.paths, self.cotangent_rows
        )
        flux = _flux_weights(surface.topology, surface.geometry, targets, left, self.table, self.cotangent_rows)
        # The square root has no derivative at zero.
        width = jax.lax.stop_gradient(_spectral_width(self.table, weights, advection))
        numbers = (weights, reverse_weights(self.table, weights), residual, flux, _mean_diffusion(targets), width)
        numbers = jax.tree.map(lambda leaf: leaf.astype(surface.dtype), numbers)
        return EllipticStencil(self.table, self.paths, self.cotangent_rows, *numbers)


@on_surface
def elliptic_stencil(
    surface: Surface,
    diffusion: Float[AnyArray, "..."] | float,
    drift: Float[AnyArray, "V 3"] | None = None,
    progress: bool = False,
    divergence_form: bool = False,
) -> EllipticStencil:
    """Non-negative weights for the operator D : Hess u + b . grad u, or div(D grad u) + b . grad u (host).

    Each row is the one-ring's where its weights are non-negative, else what non-negative least squares picks from two
    and three rings. Pointwise first order, like the Laplacian. Where drift dominates (|b| h > 2 D) no non-negative row
    meets both; then the drift is met and as little diffusion as possible is added, of the order |b| h: the row is
    upwind. Where D is so anisotropic that three rings hold no consistent row, the row of least error is taken. Both
    show in the residual. Such an operator has a maximum principle and no growing modes. On a boundary it is for fields
    whose normal derivative vanishes; equations add the fluxes of `Neumann` and `Robin` conditions.

    Where the Laplacian has a cotangent row (see `SurfaceReport`), so has an isotropic operator without drift: D times
    that row. Other operators have no row of that kind, and where none is consistent the residual says so.

    The divergence form div(D grad u) is D : Hess u + (div D) . grad u: the divergence of D, by the surface's gradient,
    is added to the drift. It is for a D that is smooth; a scalar D that jumps is for `weighted_laplacian`.

    Args:
        surface: the surface.
        diffusion: D, a number, (V,), or symmetric non-negative tensors (V, 3, 3), of which the tangent part counts.
        drift: b, (V, 3), of which the tangent part counts.
        progress: whether to show how far the choice of neighbours is.
        divergence_form: whether the operator is div(D grad u) + b . grad u.

    Raises:
        ValueError: D is not symmetric or not non-negative, a shape does not fit, or the surface is being traced.
    """
    if surface.is_traced:
        raise ValueError(
            "The neighbours of a stencil are chosen on the host, but the surface is being traced by a JAX "
            "transformation. Build the stencil outside, and use its `with_coefficients` inside."
        )
    topology, geometry = jax.tree.map(_on_host, (surface.topology, surface.geometry))
    around, kinds = places(surface.scheme, topology, geometry), topology.kinds
    tensor, frames = _checked(diffusion, geometry.frames), geometry.frames
    drift = None if drift is None else np.asarray(drift, np.float64)
    advection = _largest_advection(_targets(frames, tensor, drift))
    if divergence_form:
        drift = np.asarray(_with_divergence(surface, diffusion, drift), np.float64)
    targets = _targets(frames, tensor, drift)
    reach = reach_along(
        one_rings(topology.faces, surface.num_vertices),
        around,
        charts_of(surface.scheme, topology, around),
        topology.is_extrinsic,
    )
    rows = support.Rows.all_of(reach(np.arange(surface.num_vertices), 1))
    _, residual, _ = _rows(around, kinds, targets, *_table(rows, topology, around), None)
    # Where the Laplacian has a cotangent row, so has an isotropic operator without drift.
    is_cotangent = _is_isotropic(targets) & _cotangent_vertices(topology)
    # Where some row meets every condition there is nothing to emphasise.
    for emphasis in (1.0, _EMPHASIS):
        rows, record = support.nonnegative_support(
            rows,
            (residual <= support.CONSISTENT) | is_cotangent,
            kinds,
            targets[0],
            reach,
            watched("choosing the neighbours of the stencil", progress=progress),
            emphasis,
        )
        residual = record.residual
    rows, cotangent_rows = _with_cotangent_rows(rows, topology, is_cotangent)
    table, paths = _table(rows, topology, around)
    table = reversible(table)
    weights, residual, left = _rows(around, kinds, targets, table, paths, cotangent_rows)
    flux = _flux_weights(topology, geometry, targets, left, table, cotangent_rows)
    measured = None
    if surface.num_vertices <= MOST_MEASURED:
        measured = measured_width(difference_matrix(table, weights), np.asarray(geometry.vertex_areas))
    width = _spectral_width(table, weights, advection, measured)
    numbers = (weights, reverse_weights(table, weights), residual, flux, _mean_diffusion(targets), width)
    numbers = jax.tree.map(lambda leaf: jnp.asarray(leaf, surface.dtype), numbers)
    table, paths, cotangent_rows = jax.tree.map(jnp.asarray, (table, paths, cotangent_rows))
    return EllipticStencil(table, paths, cotangent_rows, *numbers)


@on_surface
def direction_tensor(
    surface: Surface, direction: Float[AnyArray, "V 3"], along: float | AnyArray, across: float | AnyArray
) -> Float[Array, "V 3 3"]:
    """A diffusion tensor for `elliptic_stencil`: ``along`` in a direction, ``across`` at right angles to it.

    Of the direction the tangent part counts, its length and sign do not; where that part vanishes the tensor is
    isotropic, the mean of both. Principal directions of curvature make stripes that follow a shape.

    Args:
        surface: the surface.
        direction: (V, 3).
        along: a number or (V,).
        across: a number or (V,).
    """
    normals = surface.normals
    tangent = direction - jnp.sum(direction * normals, axis=1, keepdims=True) * normals
    squared = jnp.sum(tangent**2, axis=1)[:, None, None]
    plane = jnp.eye(3, dtype=normals.dtype)[None] - normals[:, :, None] * normals[:, None, :]
    has_none = squared <= jnp.finfo(normals.dtype).tiny
    onto = jnp.where(has_none, plane / 2, tangent[:, :, None] * tangent[:, None, :] / jnp.where(has_none, 1, squared))
    along, across = (jnp.asarray(value, normals.dtype).reshape(-1, 1, 1) for value in (along, across))
    return across * plane + (along - across) * onto


def _with_divergence(surface: Surface, diffusion: AnyArray | float, drift: AnyArray | None) -> Float[Array, "V 3"]:
    """The drift with the divergence of a diffusion, a number, (V,) or (V, 3, 3), added to it."""
    coefficient, normals = jnp.asarray(diffusion, surface.dtype), surface.normals
    if coefficient.ndim < 3:
        own = gradient(surface, jnp.broadcast_to(coefficient, (surface.num_vertices,)))
    else:
        # In ambient coordinates, of the tangent part of the tensor. The normal part of the sum does not count.
        onto = jnp.eye(3, dtype=normals.dtype)[None] - normals[:, :, None] * normals[:, None, :]
        tensor = onto @ coefficient @ onto
        changes = gradient(surface, tensor.reshape(-1, 9)).reshape(-1, 3, 3, 3)
        own = jnp.einsum("viji->vj", changes)
    return own if drift is None else own + jnp.asarray(drift, surface.dtype)


@on_device
def _apply(stencil: EllipticStencil, u: AnyArray) -> Array:
    return difference_sum(stencil.table, stencil.weights, u, stencil.reverse)


def _checked(diffusion, frames: np.ndarray) -> np.ndarray:
    tensor = np.asarray(diffusion, np.float64)
    size = len(frames)
    if tensor.shape not in ((), (size,), (size, 3, 3)):
        raise ValueError(f"Expected a diffusion as a number, ({size},) or ({size}, 3, 3), found {tensor.shape}.")
    if tensor.ndim == 3:
        skew = np.abs(tensor - np.swapaxes(tensor, 1, 2)).max(axis=(1, 2)) > 1e-8 * np.abs(tensor).max()
        if skew.any():
            raise ValueError(f"The diffusion must be symmetric, but at vertex {np.flatnonzero(skew)[0]} it is not.")
        least = np.linalg.eigvalsh(np.einsum("vac,vcd,vbd->vab", frames, tensor, frames))[:, 0]
    else:
        least = np.broadcast_to(tensor, size)
    is_bad = ~(least >= -1e-10 * max(np.abs(tensor).max(), 1e-300))
    if is_bad.any():
        first = int(np.flatnonzero(is_bad)[0])
        raise ValueError(
            f"The diffusion must not be negative in any tangent direction, but at vertex {first} it is "
            f"{least[first]:.3g}."
        )
    return tensor


def _targets(frames: AnyArray, diffusion: AnyArray | float, drift: AnyArray | None) -> AnyArray:
    """What the operator makes of x, y, xy, x^2 and y^2 in the frame of each vertex, (1, 5, V)."""
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


def _mean_diffusion(targets: AnyArray) -> AnyArray:
    return targets.__array_namespace__().asarray((targets[0, 3] + targets[0, 4]).mean() / 4)


def _largest_advection(targets: AnyArray) -> AnyArray:
    """The largest b . D^-1 b over the surface, infinite where there is drift without diffusion.

    For a drift b without divergence, <u, b . grad u> is imaginary and its square at most b . D^-1 b times the real
    number <grad u, D grad u>, for any u of norm one.
    """
    xp = targets.__array_namespace__()
    x, y, cross, xx, yy = targets[0, 0], targets[0, 1], targets[0, 2] / 2, targets[0, 3] / 2, targets[0, 4] / 2
    with np.errstate(over="ignore"):  # to infinity, where there is next to no diffusion
        # In units in which D has the trace 2, so that no product leaves the range of the float type.
        unit = (xx + yy) / 2
        unit = xp.where(unit > 0, unit, 1)
        xx, yy, cross, x, y = xx / unit, yy / unit, cross / unit, x / xp.sqrt(unit), y / xp.sqrt(unit)
        determinant = xx * yy - cross**2
        is_regular = determinant > 4 * xp.finfo(targets.dtype).eps
        across = xp.maximum(yy * x**2 - 2 * cross * x * y + xx * y**2, 0)
        ratio = xp.where(is_regular, across / xp.where(is_regular, determinant, 1), xp.inf)
    return xp.asarray(xp.max(xp.where((x != 0) | (y != 0), ratio, 0)))


def _spectral_width(table: Table, weights: PerBlock, advection: AnyArray, measured: float | None = None) -> AnyArray:
    xp = advection.__array_namespace__()
    sums = slot_sum(table, weights)
    if measured is None:
        # The mean row sum, rows being weighted by their sums: where few rows are active they count.
        share = sums / xp.maximum(xp.sum(sums), xp.finfo(sums.dtype).tiny)
        measured = xp.sum(share * sums)
    return xp.asarray(xp.minimum(2 * xp.max(sums), (xp.sqrt(measured) + xp.sqrt(advection)) ** 2))


def _on_host(leaf: AnyArray) -> np.ndarray:
    """The array in NumPy, numbers in float64."""
    array = np.asarray(leaf)
    return array.astype(np.float64) if array.dtype.kind == "f" else array


def _table(rows: support.Rows, topology: Topology, around: Places) -> tuple[Table, tuple[Paths, ...] | None]:
    """The table of rows, and their paths where rows are laid out in charts (host)."""
    table = build_table(rows.offsets, rows.members)
    if around.directions is None:
        return table, None
    none = around.directions.no_half_edge
    return table, block_paths(table, rows.offsets, rows.paths, none, topology.is_extrinsic)


def _rows(
    around: Places,
    kinds: AnyArray,
    targets: AnyArray,
    table: Table,
    paths: tuple[Paths, ...] | None,
    cotangent_rows: tuple[CotangentRows, ...] | None,
) -> tuple[PerBlock, AnyArray, AnyArray]:
    """The weights on the neighbours, the residual of every row, and its first moments (V, 2) beyond the drift."""

    def rows(block, lifted):
        xp = lifted.__array_namespace__()
        lifted = xp.moveaxis(lifted, -1, 1)
        wanted = block.centre(targets[0].T).T[None]
        c, residual = operator_weights(lifted, block.centre(kinds), wanted, nonnegative=True, emphasis=_EMPHASIS)
        left = xp.einsum("kn,kna->an", c[0], lifted) - wanted[0, :2]
        return c[0], residual[0], left

    weights, residuals, left = zip(*table.each(rows, rows_last(around.lifted(table, paths))), strict=True)
    beyond = table.rows_from([part.T for part in left])
    if cotangent_rows is None or around.directions is None:
        return weights, table.rows_from(list(residuals)), beyond
    blocks = []
    half_trace = (targets[0, 3] + targets[0, 4]) / 4
    for block, row, weight, residual in zip(table.blocks, cotangent_rows, weights, residuals, strict=True):
        cotangent, area = cotangent_weights(around.directions, row)
        scaled = cotangent * block.part(row.columns).centre(half_trace)[None]
        exact = with_columns(residual[None], row.columns, 0 * area[None])[0]
        blocks.append((with_columns(weight, row.columns, scaled), exact))
    weights, residuals = zip(*blocks, strict=True)
    return weights, table.rows_from(list(residuals)), beyond


def _flux_weights(
    topology: Topology,
    geometry: Geometry,
    targets: AnyArray,
    left: AnyArray,
    table: Table,
    cotangent_rows: tuple[CotangentRows, ...] | None,
) -> AnyArray:
    """What unit fluxes through both sides of each boundary vertex add to the operator, (B, 2), from what rows leave of
    the first moments; of a row that is a multiple of the Laplacian's, that multiple."""
    conormals = conormals_in_frame(topology, geometry.frames, geometry.conormals, geometry.directions)
    weights = flux_weights(left[topology.boundary], conormals)
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


def _is_isotropic(targets: np.ndarray) -> np.ndarray:
    """Where the operator is a multiple of the Laplacian, (V,)."""
    x, y, xy, xx, yy = np.abs(targets[0])
    small = 1e-12 * (xx + yy)
    return (x <= small) & (y <= small) & (xy <= small) & (np.abs(targets[0, 3] - targets[0, 4]) <= small)


def _cotangent_vertices(topology: Topology) -> np.ndarray:
    """The vertices whose Laplacian row is a cotangent row, (V,)."""
    is_cotangent = np.zeros(len(topology.kinds), bool)
    if topology.cotangent_rows is not None and topology.diffusion is not None:
        for block, rows in zip(topology.diffusion.blocks, topology.cotangent_rows, strict=True):
            is_cotangent[block.part(rows.columns).centre(np.arange(len(is_cotangent)))] = True
    return is_cotangent


def _with_cotangent_rows(
    rows: support.Rows, topology: Topology, which: np.ndarray
) -> tuple[support.Rows, tuple[CotangentRows, ...] | None]:
    """The rows with those of the marked vertices replaced by the Laplacian's cotangent rows (host)."""
    if topology.cotangent_rows is None or topology.diffusion is None or topology.diffusion_paths is None:
        return rows, None
    none = len(topology.triangulation.ends) if topology.triangulation is not None else 0
    owners, members, paths = [], [], []
    for block, laid, row in zip(
        topology.diffusion.blocks, topology.diffusion_paths, topology.cotangent_rows, strict=True
    ):
        part = block.part(row.columns)
        own = np.broadcast_to(part.centre(np.arange(len(which))), part.indices.shape)
        used = (part.indices != own) & which[own]
        path = np.full((used.sum(), rows.paths.shape[1]), 2 * none)
        path[:, 0] = laid.first[:, row.columns][used]
        owners.append(own[used])
        members.append(part.indices[used])
        # The edges of the cotangents travel beside the paths.
        paths.append(np.concatenate([path, row.edges[:, used].T], axis=1))
    wide = support.Rows(
        rows.offsets, rows.members, np.concatenate([rows.paths, np.full((len(rows.members), 5), none)], axis=1)
    )
    entries = (np.concatenate(parts) for parts in (owners, members, paths))
    wide = wide.replaced(*entries, which=np.flatnonzero(which))
    edges = zip(*(slot_values(wide.offsets, column, none) for column in wide.paths[:, -5:].T), strict=True)
    blocks = []
    for block in edges:
        columns = np.flatnonzero((block[0] != none).any(axis=0))
        blocks.append(CotangentRows(columns.astype(np.int32), np.stack(block)[:, :, columns].astype(np.int32)))
    return support.Rows(wide.offsets, wide.members, wide.paths[:, :-5]), tuple(blocks)
