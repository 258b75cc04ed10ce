"""Segmentation of an image into two regions with a short border between them.

What enters: a surface and an image. What leaves: a phase field near 1 in one region and near -1 in the other, and the
mean of the image in each region.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from ..._base.deprecated import renamed_arguments
from ..._operators import laplacian
from ..._solve.krylov import Jacobi, linear_solve
from ..._surface import Surface, on_surface
from ..._tables import AnyArray
from .checks import check, number, signal

# Relative residual tolerance of each step; the right-hand side itself becomes small near the end.
_STEP_RTOL = 1e-4
_EXACT = {jnp.dtype("float64"): 1e-10, jnp.dtype("float32"): 1e-5}
_RTOL = {jnp.dtype("float64"): 1e-8, jnp.dtype("float32"): 1e-5}
# Default width in mean edge lengths, which resolves the border, and default scale in widths.
_WIDTH, _SCALE = 1.0, 0.5


class Segmentation(eqx.Module):
    """Two regions of an image.

    Attributes:
        phi: (V,) phase field between -1 and 1, positive in the brighter region.
        means: (2,) or (2, C) mean of the image in the region of positive phi, then of negative phi.
    """

    phi: Float[Array, " V"]
    means: Float[Array, "2 *C"]

    @property
    def is_inside(self) -> Bool[Array, " V"]:
        """Which vertices belong to the brighter region."""
        return self.phi > 0


@renamed_arguments(tolerance="rtol", max_steps="max_iterations")
@on_surface
def segment(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    width: float | AnyArray | None = None,
    scale: float | AnyArray | None = None,
    *,
    rtol: float | None = None,
    max_iterations: int = 2000,
    throw: bool = True,
) -> Segmentation:
    """Two regions in which the image is close to constant, with a short border between them: Chan and Vese's model.

    The border is the zero level set of a phase field phi, which the Allen-Cahn equation relaxes down the energy

        int width / 2 |grad phi|^2 + (1 - phi^2)^2 / (4 width)
            + ((1 + phi)^2 |u - c1|^2 + (1 - phi)^2 |u - c2|^2) / (4 scale |c1 - c2|^2)

    where c1 and c2 are the means of u with the weights (1 + phi)^2 and (1 - phi)^2. The first two terms are 0.94 times
    the length of the border. Steps are implicit with a convex splitting, so phi stays between -1 and 1. The iteration
    starts from the brightness of u relative to its mean (for colours, along their principal axis) and converges to a
    nearby local minimum. Differentiable in both modes by the implicit function theorem.

    Args:
        surface: the surface.
        u: image, (V,) or (V, C).
        width: width of the border; by default the mean edge length.
        scale: spots with a radius below about twice this join the region around them, and fluctuations of u below this
            size average out; by default half the width.
        rtol: the iteration stops when no value of phi, which is between -1 and 1, changes by more than this; by
            default 1e-8 for float64 and 1e-5 for float32.
        max_iterations: number of iterations after which the method has failed.
        throw: whether to raise on failure. Inside jit nothing is raised, and the result is NaN.

    Raises:
        SolveError: the iteration did not converge.
        ValueError: u does not fit the surface, is NaN or infinite, or is constant, or a length is not positive.

    Source: Chan and Vese (2001), doi:10.1109/83.902291; with a phase field, Esedoglu and Tsai (2006),
    doi:10.1016/j.jcp.2005.05.027.
    """
    u = signal(surface, u)
    if not isinstance(u, Tracer) and not np.ptp(np.asarray(u).reshape(len(u), -1), axis=0).max() > 0:
        raise ValueError("Expected an image with two regions, found a constant image.")
    width = number(surface, "width", _WIDTH * surface.mesh_size if width is None else width)
    scale = number(surface, "scale", _SCALE * width if scale is None else scale)
    # As arrays, so that other limits need no compiling.
    tolerance = jnp.asarray(_RTOL[jnp.dtype(u.dtype)] if rtol is None else rtol, u.dtype)
    limits = tolerance, jnp.asarray(max_iterations, jnp.int32)
    phi, means, is_converged = _segmented(surface, u.reshape(len(u), -1), width, scale, *limits)
    if throw:
        check("two regions", is_converged)
    return Segmentation(phi, means.reshape(2, *u.shape[1:]))


@eqx.filter_jit
def _segmented(
    surface: Surface, u: Array, width: Array, scale: Array, tolerance: Array, max_iterations: Array
) -> tuple[Array, Array, Array]:
    def means(phi: Array) -> Array:
        weights = surface.vertex_areas[None] * jnp.stack([1 + phi, 1 - phi]) ** 2
        return (weights @ u) / jnp.maximum(jnp.sum(weights, axis=1, keepdims=True), jnp.finfo(u.dtype).tiny)

    def misfits(phi: Array) -> Array:
        """The data term of each region, (2, V): |u - c|^2 relative to the squared distance of the two means."""
        c = means(phi)
        distance = jnp.maximum(jnp.sum((c[0] - c[1]) ** 2), jnp.finfo(u.dtype).tiny)
        return jnp.sum((u[None] - c[:, None]) ** 2, axis=-1) / (2 * scale * distance)

    def slope(phi: Array) -> Array:
        first, second = misfits(phi)
        wells = (phi**3 - phi) / width
        return wells + (1 + phi) * first - (1 - phi) * second - width * laplacian(surface, phi)

    def convexity(phi: Array) -> Array:
        """The largest derivative of the slope without the Laplacian: treated implicitly, it makes steps monotone."""
        return 2 / width + jnp.sum(misfits(phi), axis=0)

    def inverse(stiffness: Array) -> Jacobi:
        return Jacobi((stiffness - width * surface.laplacian_stencil.diagonal())[:, None])

    def step(carry):
        phi, _, iterations = carry
        stiffness = convexity(phi)
        change = linear_solve(
            lambda d: stiffness * d - width * laplacian(surface, d), -slope(phi), inverse(stiffness), _STEP_RTOL
        )
        next_phi = jnp.clip(phi + change.value, -1, 1)
        return next_phi, jnp.max(jnp.abs(next_phi - phi)), iterations + 1

    def is_unfinished(carry):
        _, change, iterations = carry
        return (change > tolerance) & (iterations < max_iterations)

    def tangent_solve(apply: Any, b: Array) -> Array:
        return linear_solve(apply, b, preconditioner, _EXACT[jnp.dtype(u.dtype)], persists=True).value

    start = jax.lax.stop_gradient(_initial_phase(surface, u))
    begin = (start, jnp.full((), jnp.inf, u.dtype), jnp.zeros((), jnp.int32))
    phi, change, _ = jax.lax.stop_gradient(jax.lax.while_loop(is_unfinished, step, begin))
    preconditioner = jax.lax.stop_gradient(inverse(convexity(phi)))
    is_converged = change <= tolerance
    phi = jax.lax.custom_root(slope, phi, lambda _, phi: phi, tangent_solve)
    return jnp.where(is_converged, phi, jnp.nan), jnp.where(is_converged, means(phi), jnp.nan), is_converged


def _initial_phase(surface: Surface, u: Array) -> Array:
    """A phase field from the brightness of the image relative to its mean."""
    shares = surface.vertex_areas / jnp.sum(surface.vertex_areas)
    centred = u - (shares @ u)[None]
    _, axes = jnp.linalg.eigh(jnp.einsum("v,vc,vd->cd", shares, centred, centred))
    principal_axis = axes[:, -1] * jnp.where(jnp.sum(axes[:, -1]) < 0, -1, 1)
    brightness = centred @ principal_axis
    size = jnp.sqrt(shares @ brightness**2)
    return jnp.tanh(brightness / jnp.maximum(size, jnp.finfo(u.dtype).tiny))
