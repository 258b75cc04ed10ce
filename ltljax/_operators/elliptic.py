"""General second-order operators on a surface, by the same moments as the Laplacian, with non-negative weights.

What enters: a surface, a diffusion tensor and a drift. What leaves: an `EllipticStencil`, which applies
``D : Hess u + b . grad u`` and whose weights are pure functions of D and b for fixed neighbours.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.progress import watched
from .._lifting import support
from .._lifting.intrinsic import CotangentRows, Paths
from .._lifting.layout import Places
from .._lifting.weighing import Topology, places
from .._mesh import one_rings
from .._surface import Surface, on_surface
from .._surface.neighbours import charts_of, reach_along
from .._tables import AnyArray, Stencil, difference_matrix, reverse_weights, reversible
from .elliptic_rows import (
    EMPHASIS,
    boundary_flux_weights,
    cotangent_vertices,
    is_isotropic,
    largest_advection,
    mean_diffusion,
    operator_targets,
    rows_table,
    rows_width,
    weigh_rows,
    with_cotangent_rows,
)
from .scalar import gradient
from .spectra import MOST_MEASURED, measured_width


class EllipticStencil(Stencil):
    """The operator D : Hess u + b . grad u on a surface, as a `Stencil` with non-negative weights.

    Attributes:
        paths: for each block of the table, the half-edges that lead to its neighbours; None if all rows are laid out in
            space.
        cotangent_rows: for each block, the rows that are half the trace of D times a row of the cotangent Laplacian;
            None if there are none.
        residual: (V,) the largest relative error of a moment of each row, zero up to rounding if the row is consistent.
        flux_weights: (B, 2) the change of the operator per unit flux through each side of a boundary vertex.
        mean_diffusion: half the trace of D in the tangent plane, averaged over the vertices.
        width: the spectral width; see `spectral_width`.
    """

    paths: tuple[Paths, ...] | None = eqx.field(kw_only=True)
    cotangent_rows: tuple[CotangentRows, ...] | None = eqx.field(kw_only=True)
    residual: Float[AnyArray, " V"] = eqx.field(kw_only=True)
    flux_weights: Float[AnyArray, "B 2"] = eqx.field(kw_only=True)
    mean_diffusion: Float[AnyArray, ""] = eqx.field(kw_only=True)
    width: Float[AnyArray, ""] = eqx.field(kw_only=True)

    def spectral_width(self) -> Float[Array, ""]:
        """How far the eigenvalues lie from the real axis, as in `ltl.operators.spectral_width`; without derivatives.

        It is an estimate, at most the spectral bound, which always suffices. The part that comes from rows that are not
        symmetric is measured when the stencil is built, and estimated from the row sums for other coefficients; the
        part that comes from the drift is the largest value of b . D^-1 b.
        """
        return jnp.asarray(self.width)

    def with_coefficients(
        self,
        surface: Surface,
        diffusion: AnyArray | float,
        drift: AnyArray | None = None,
        divergence_form: bool = False,
    ) -> "EllipticStencil":
        """The stencil of other coefficients, or of a moved surface, for the same neighbours: pure and differentiable.

        The fixed neighbours may not suit the new coefficients; ``residual`` shows how well they do.
        """
        frames = surface.geometry.frames
        advection = largest_advection(operator_targets(frames, diffusion, drift))
        if divergence_form:
            drift = _with_divergence(surface, diffusion, drift)
        targets = operator_targets(frames, diffusion, drift)
        layout = places(surface.scheme, surface.topology, surface.geometry)
        weights, residual, excess = weigh_rows(
            layout, surface.topology.kinds, targets, self.table, self.paths, self.cotangent_rows
        )
        flux = boundary_flux_weights(
            surface.topology, surface.geometry, targets, excess, self.table, self.cotangent_rows
        )
        # The square root has no derivative at zero.
        width = jax.lax.stop_gradient(rows_width(self.table, weights, advection))
        arrays = (weights, reverse_weights(self.table, weights), residual, flux, mean_diffusion(targets), width)
        weights, reverse, residual, flux, mean, width = jax.tree.map(lambda leaf: leaf.astype(surface.dtype), arrays)
        return EllipticStencil(
            self.table, weights, reverse, paths=self.paths, cotangent_rows=self.cotangent_rows, residual=residual,
            flux_weights=flux, mean_diffusion=mean, width=width,
        )  # fmt: skip


@on_surface
def elliptic_stencil(
    surface: Surface,
    diffusion: Float[AnyArray, "..."] | float,
    drift: Float[AnyArray, "V 3"] | None = None,
    progress: bool = False,
    divergence_form: bool = False,
) -> EllipticStencil:
    """Non-negative weights for the operator D : Hess u + b . grad u, or div(D grad u) + b . grad u (host).

    A row uses the one-ring if its weights are non-negative, and otherwise the neighbours that non-negative least
    squares selects from two or three rings. The operator is pointwise first order, like the Laplacian. If drift
    dominates (|b| h > 2 D), no non-negative row meets both; then the row is upwind: it meets the drift and adds as
    little diffusion as possible, of the order |b| h. If D is so anisotropic that three rings contain no consistent row,
    the row of least error is used. Both cases show in the residual. The operator has a maximum principle and no growing
    modes. On a boundary the normal derivative is assumed to vanish; equations add the fluxes of `Neumann` and `Robin`
    conditions.

    An isotropic operator without drift uses D times the cotangent row wherever the Laplacian has a cotangent row (see
    `SurfaceReport`). Other operators have no such rows; if no row is consistent, the residual shows it.

    The divergence form div(D grad u) is D : Hess u + (div D) . grad u: the divergence of D, computed with the surface's
    gradient, is added to the drift. It is for a smooth D; for a scalar D that jumps, use `weighted_laplacian`.

    Args:
        surface: the surface.
        diffusion: D, a number, (V,), or symmetric non-negative tensors (V, 3, 3), of which only the tangent part
            matters.
        drift: b, (V, 3), of which only the tangent part matters.
        progress: whether to show the progress of the choice of neighbours.
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
    layout, kinds = places(surface.scheme, topology, geometry), topology.kinds
    tensor, frames = _checked(diffusion, geometry.frames), geometry.frames
    drift = None if drift is None else np.asarray(drift, np.float64)
    advection = largest_advection(operator_targets(frames, tensor, drift))
    if divergence_form:
        drift = np.asarray(_with_divergence(surface, diffusion, drift), np.float64)
    targets = operator_targets(frames, tensor, drift)
    rows = _choose_rows(surface, topology, layout, targets, progress)
    rows, cotangent_rows = with_cotangent_rows(rows, topology, is_isotropic(targets) & cotangent_vertices(topology))
    table, paths = rows_table(rows, topology, layout)
    table = reversible(table)
    weights, residual, excess = weigh_rows(layout, kinds, targets, table, paths, cotangent_rows)
    flux = boundary_flux_weights(topology, geometry, targets, excess, table, cotangent_rows)
    measured = None
    if surface.num_vertices <= MOST_MEASURED:
        measured = measured_width(difference_matrix(table, weights), np.asarray(geometry.vertex_areas))
    width = rows_width(table, weights, advection, measured)
    arrays = (weights, reverse_weights(table, weights), residual, flux, mean_diffusion(targets), width)
    arrays = jax.tree.map(lambda leaf: jnp.asarray(leaf, surface.dtype), arrays)
    weights, reverse, residual, flux, mean, width = arrays
    table, paths, cotangent_rows = jax.tree.map(jnp.asarray, (table, paths, cotangent_rows))
    return EllipticStencil(
        table, weights, reverse, paths=paths, cotangent_rows=cotangent_rows, residual=residual, flux_weights=flux,
        mean_diffusion=mean, width=width,
    )  # fmt: skip


def _choose_rows(
    surface: Surface, topology: Topology, layout: Places, targets: np.ndarray, progress: bool
) -> support.Rows:
    """The neighbours of every row (host)."""
    reach = reach_along(
        one_rings(topology.faces, surface.num_vertices),
        layout,
        charts_of(surface.scheme, topology, layout),
        topology.is_extrinsic,
    )
    rows = support.Rows.all_of(reach(np.arange(surface.num_vertices), 1))
    _, residual, _ = weigh_rows(layout, topology.kinds, targets, *rows_table(rows, topology, layout), None)
    is_cotangent = is_isotropic(targets) & cotangent_vertices(topology)
    # The first pass finds rows that meet every condition; the second emphasises the drift in the other rows.
    for emphasis in (1.0, EMPHASIS):
        is_settled = (residual <= support.CONSISTENT) | is_cotangent
        rows, record = support.nonnegative_support(
            rows,
            is_settled,
            topology.kinds,
            targets[0],
            reach,
            watched("choosing the neighbours of the stencil", progress=progress),
            emphasis,
        )
        residual = record.residual
    return rows


@on_surface
def direction_tensor(
    surface: Surface, direction: Float[AnyArray, "V 3"], along: float | AnyArray, across: float | AnyArray
) -> Float[Array, "V 3 3"]:
    """A diffusion tensor for `elliptic_stencil`: diffusivity ``along`` in a direction and ``across`` normal to it.

    Only the tangent part of the direction matters, not its length or sign. Where that part vanishes the tensor is
    isotropic with the mean of both values. Principal directions of curvature give stripes that follow the shape.

    Args:
        surface: the surface.
        direction: (V, 3).
        along: the diffusivity in the direction, a number or (V,).
        across: the diffusivity normal to it, a number or (V,).
    """
    normals = surface.normals
    tangent = direction - jnp.sum(direction * normals, axis=1, keepdims=True) * normals
    squared = jnp.sum(tangent**2, axis=1)[:, None, None]
    plane = jnp.eye(3, dtype=normals.dtype)[None] - normals[:, :, None] * normals[:, None, :]
    is_zero = squared <= jnp.finfo(normals.dtype).tiny
    projection = jnp.where(
        is_zero, plane / 2, tangent[:, :, None] * tangent[:, None, :] / jnp.where(is_zero, 1, squared)
    )
    along, across = (jnp.asarray(value, normals.dtype).reshape(-1, 1, 1) for value in (along, across))
    return across * plane + (along - across) * projection


def _with_divergence(surface: Surface, diffusion: AnyArray | float, drift: AnyArray | None) -> Float[Array, "V 3"]:
    """The drift plus the divergence of a diffusion, which is a number, (V,) or (V, 3, 3)."""
    coefficient, normals = jnp.asarray(diffusion, surface.dtype), surface.normals
    if coefficient.ndim < 3:
        divergence = gradient(surface, jnp.broadcast_to(coefficient, (surface.num_vertices,)))
    else:
        # Differentiate the tangent part of the tensor in ambient coordinates; the normal part of the sum is ignored.
        projection = jnp.eye(3, dtype=normals.dtype)[None] - normals[:, :, None] * normals[:, None, :]
        tensor = projection @ coefficient @ projection
        derivatives = gradient(surface, tensor.reshape(-1, 9)).reshape(-1, 3, 3, 3)
        divergence = jnp.einsum("viji->vj", derivatives)
    return divergence if drift is None else divergence + jnp.asarray(drift, surface.dtype)


def _checked(diffusion, frames: np.ndarray) -> np.ndarray:
    """The diffusion as a float64 array, checked to be symmetric and non-negative in the tangent planes."""
    tensor = np.asarray(diffusion, np.float64)
    size = len(frames)
    if tensor.shape not in ((), (size,), (size, 3, 3)):
        raise ValueError(f"Expected a diffusion as a number, ({size},) or ({size}, 3, 3), found {tensor.shape}.")
    if tensor.ndim == 3:
        skew = np.abs(tensor - np.swapaxes(tensor, 1, 2)).max(axis=(1, 2)) > 1e-8 * np.abs(tensor).max()
        if skew.any():
            raise ValueError(
                f"Expected a symmetric diffusion tensor, found an asymmetric one at vertex {np.flatnonzero(skew)[0]}."
            )
        least = np.linalg.eigvalsh(np.einsum("vac,vcd,vbd->vab", frames, tensor, frames))[:, 0]
    else:
        least = np.broadcast_to(tensor, size)
    is_bad = ~(least >= -1e-10 * max(np.abs(tensor).max(), 1e-300))
    if is_bad.any():
        first = int(np.flatnonzero(is_bad)[0])
        raise ValueError(
            f"Expected a diffusion that is not negative in any tangent direction, found {least[first]:.3g} at vertex "
            f"{first}."
        )
    return tensor


def _on_host(leaf: AnyArray) -> np.ndarray:
    """The array in NumPy, with floats as float64."""
    array = np.asarray(leaf)
    return array.astype(np.float64) if array.dtype.kind == "f" else array
