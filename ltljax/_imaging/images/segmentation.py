"""Which part of a surface does an image show? Two regions with a smooth border between them.

What enters: a surface and an image. What leaves: a phase field near 1 in one region and -1 in the other, and the mean
of the image in each.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from ..._operators import laplacian
from ..._solve.implicit import Jacobi
from ..._solve.krylov import linear_solve
from ..._surface import Surface, on_surface
from ..._tables import AnyArray
from .signals import check, number, signal

# Each linear system is solved to this share of its right side, which is small itself near the end.
_SHARE = 1e-4
_EXACT = {jnp.dtype("float64"): 1e-10, jnp.dtype("float32"): 1e-5}
_TOLERANCE = {jnp.dtype("float64"): 1e-8, jnp.dtype("float32"): 1e-5}
# Of the mean length of the edges, which resolves fronts, and of the width.
_WIDTH, _SCALE = 1.0, 0.5


class Segmentation(eqx.Module):
    """Two regions of an image.

    Attributes:
        phi: (V,) the phase field, between -1 and 1: positive in the region that is brighter.
        means: (2,) or (2, C) the mean of the image where phi is positive, and where it is negative.
    """

    phi: Float[Array, " V"]
    means: Float[Array, "2 *C"]

    @property
    def is_inside(self) -> Bool[Array, " V"]:
        """Which vertices belong to the region that is brighter."""
        return self.phi > 0


@on_surface
def segment(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    width: float | AnyArray | None = None,
    scale: float | AnyArray | None = None,
    *,
    tolerance: float | None = None,
    max_steps: int = 2000,
    throw: bool = True,
) -> Segmentation:
    """The two regions in each of which an image is nearest to constant, with a short border: Chan and Vese's model.

    The border is the zero level of a phase field phi, relaxed by the Allen-Cahn equation down the energy

        int width / 2 |grad phi|^2 + (1 - phi^2)^2 / (4 width)
            + ((1 + phi)^2 |u - c1|^2 + (1 - phi)^2 |u - c2|^2) / (4 scale |c1 - c2|^2)

    while c1 and c2 are the means of u with the weights (1 + phi)^2 and (1 - phi)^2. The first two terms are 0.94 times
    the length of the border. Steps are implicit, with a convex part split off so that phi stays between -1 and 1. It
    begins with phi by the brightness of u (of colours the direction in which they differ most) against its mean, and
    finds a least energy nearby. Differentiable in both modes by the implicit function theorem.

    Args:
        surface: the surface.
        u: (V,) or (V, C).
        width: of the border; by default the mean length of the edges.
        scale: spots of a radius below about twice this are counted to what surrounds them, and fluctuations of u below
            this size average out; by default half the width.
        tolerance: it ends with a step that changes phi by at most this anywhere; by default 1e-8 for float64 and 1e-5
            for float32.
        max_steps: after which it has failed.
        throw: whether to raise then, outside of jit, where the result is NaN.

    Raises:
        SolveError: it did not converge.
        ValueError: u does not fit the surface, is not finite or is constant, or a length is not positive.

    Source: Chan and Vese (2001), doi:10.1109/83.902291; by a phase field Esedoglu and Tsai (2006),
    doi:10.1016/j.jcp.2005.05.027.
    """
    u = signal(surface, u)
    if not isinstance(u, Tracer) and not np.ptp(np.asarray(u).reshape(len(u), -1), axis=0).max() > 0:
        raise ValueError("The image is constant, so that there are no two regions to be told apart.")
    wide = _WIDTH * surface.mesh_size if width is None else number(surface, "width", width)
    least = _SCALE * wide if scale is None else number(surface, "scale", scale)
    enough = jnp.asarray(_TOLERANCE[jnp.dtype(u.dtype)] if tolerance is None else tolerance, u.dtype)
    phi, means, found = _segmented(surface, u.reshape(len(u), -1), wide, least, enough, max_steps)
    if throw:
        check("two regions", found)
    return Segmentation(phi, means.reshape(2, *u.shape[1:]))


@eqx.filter_jit
def _segmented(
    surface: Surface, u: Array, width: Array, scale: Array, tolerance: Array, max_steps: int
) -> tuple[Array, Array, Array]:
    def means(phi: Array) -> Array:
        weights = surface.vertex_areas[None] * jnp.stack([1 + phi, 1 - phi]) ** 2
        return (weights @ u) / jnp.maximum(jnp.sum(weights, axis=1, keepdims=True), jnp.finfo(u.dtype).tiny)

    def misfits(phi: Array) -> Array:
        """What tells against either region, (2, V), relative to what tells the regions apart."""
        c = means(phi)
        apart = jnp.sum((c[0] - c[1]) ** 2)
        return jnp.sum((u[None] - c[:, None]) ** 2, axis=-1) / (2 * scale * jnp.maximum(apart, jnp.finfo(u.dtype).tiny))

    def slope(phi: Array) -> Array:
        against = misfits(phi)
        wells = (phi**3 - phi) / width
        return wells + (1 + phi) * against[0] - (1 - phi) * against[1] - width * laplacian(surface, phi)

    def convexity(phi: Array) -> Array:
        """What the slope without the Laplacian rises by at most: added on both sides, it makes steps monotone."""
        return 2 / width + jnp.sum(misfits(phi), axis=0)

    def inverse(stiffness: Array) -> Jacobi:
        return Jacobi(1 / (stiffness - width * surface.laplacian_stencil.diagonal())[:, None])

    def step(carry):
        phi, _, steps = carry
        stiffness = convexity(phi)
        found = linear_solve(
            lambda d: stiffness * d - width * laplacian(surface, d), -slope(phi), inverse(stiffness), _SHARE
        )
        after = jnp.clip(phi + found.value, -1, 1)
        return after, jnp.max(jnp.abs(after - phi)), steps + 1

    def goes_on(carry):
        _, change, steps = carry
        return (change > tolerance) & (steps < max_steps)

    def tangent_solve(apply: Any, b: Array) -> Array:
        return linear_solve(apply, b, preconditioner, _EXACT[jnp.dtype(u.dtype)], persists=True).value

    start = jax.lax.stop_gradient(_first(surface, u))
    fixed = (start, jnp.full((), jnp.inf, u.dtype), jnp.zeros((), jnp.int32))
    phi, change, _ = jax.lax.stop_gradient(jax.lax.while_loop(goes_on, step, fixed))
    preconditioner = jax.lax.stop_gradient(inverse(convexity(phi)))
    found = change <= tolerance
    phi = jax.lax.custom_root(slope, phi, lambda _, phi: phi, tangent_solve)
    return jnp.where(found, phi, jnp.nan), jnp.where(found, means(phi), jnp.nan), found


def _first(surface: Surface, u: Array) -> Array:
    """A phase field by the brightness of the image, relative to its mean."""
    shares = surface.vertex_areas / jnp.sum(surface.vertex_areas)
    rest = u - (shares @ u)[None]
    _, axes = jnp.linalg.eigh(jnp.einsum("v,vc,vd->cd", shares, rest, rest))
    along = axes[:, -1] * jnp.where(jnp.sum(axes[:, -1]) < 0, -1, 1)
    brightness = rest @ along
    size = jnp.sqrt(shares @ brightness**2)
    return jnp.tanh(brightness / jnp.maximum(size, jnp.finfo(u.dtype).tiny))
