"""How close is an image to another? Errors over the area, and how much structure they share.

What enters: a surface and two images, of the same shape. What leaves: one number.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from ..._surface import Surface, on_surface
from ..._tables import AnyArray
from .signals import number, same_shape, signal
from .smoothing import smoothed

# The window of Wang et al. has a standard deviation of one and a half pixels, and these keep quotients from zero.
_RADIUS = 1.5
_LUMINANCE, _CONTRAST = 0.01, 0.03


@on_surface
def mse(surface: Surface, u: Float[AnyArray, "V *C"], reference: Float[AnyArray, "..."]) -> Float[Array, ""]:
    """The mean of (u - reference)^2 over the area and the colours.

    Args:
        surface: the surface.
        u: (V,) or (V, C).
        reference: of the same shape.

    Raises:
        ValueError: the shapes do not fit, or something is not finite.
    """
    return _mse(surface, *_pair(surface, u, reference))


@on_surface
def psnr(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    reference: Float[AnyArray, "..."],
    peak: float | AnyArray | None = None,
) -> Float[Array, ""]:
    """The peak signal-to-noise ratio in decibels, 10 log10(peak^2 / mse): infinite for the reference itself.

    Args:
        surface: the surface.
        u: (V,) or (V, C).
        reference: of the same shape.
        peak: the largest difference of values; by default that of the reference.

    Raises:
        ValueError: the shapes do not fit, something is not finite, or the peak is not positive.
    """
    u, reference = _pair(surface, u, reference)
    return 10 * jnp.log10(_peak(surface, reference, peak) ** 2 / _mse(surface, u, reference))


@on_surface
def ssim(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    reference: Float[AnyArray, "..."],
    radius: float | AnyArray | None = None,
    peak: float | AnyArray | None = None,
) -> Float[Array, ""]:
    """The structural similarity of two images, its mean over the area and the colours: 1 where they are equal.

    Local means, variances and covariances are those over a window made by diffusion (`smoothed`), in place of the
    Gaussian one of pixels.

    Args:
        surface: the surface.
        u: (V,) or (V, C).
        reference: of the same shape.
        radius: the standard deviation of the window; by default one and a half times the mean length of the edges.
        peak: the largest difference of values; by default that of the reference.

    Raises:
        ValueError: the shapes do not fit, something is not finite, or a number is not positive.

    Source: Wang, Bovik, Sheikh and Simoncelli (2004), doi:10.1109/TIP.2003.819861.
    """
    u, reference = _pair(surface, u, reference)
    peak = _peak(surface, reference, peak)
    radius = _RADIUS * surface.mesh_size if radius is None else number(surface, "radius", radius)
    x, y = (image.reshape(len(image), -1) for image in (u, reference))
    # Variances do not know of a constant, and rounding does.
    middle = jnp.mean(y)
    x, y = x - middle, y - middle
    means = smoothed(surface, jnp.concatenate([x, y, x**2, y**2, x * y], axis=1), radius)
    mean_x, mean_y, xx, yy, xy = jnp.split(means, 5, axis=1)
    var_x, var_y, both = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    mean_x, mean_y = mean_x + middle, mean_y + middle
    c1, c2 = (_LUMINANCE * peak) ** 2, (_CONTRAST * peak) ** 2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * both + c2) / (var_x + var_y + c2)
    return _mean(surface, luminance * structure)


def _pair(surface: Surface, u: AnyArray, reference: AnyArray) -> tuple[Array, Array]:
    u, reference = signal(surface, u), signal(surface, reference, "reference")
    same_shape(u, reference, "a reference")
    return u, reference


def _peak(surface: Surface, reference: Array, peak: float | AnyArray | None) -> Array:
    if peak is not None:
        return number(surface, "peak", peak)
    found = jnp.max(reference) - jnp.min(reference)
    if not isinstance(found, Tracer) and not found > 0:
        raise ValueError("The reference is constant, so that its range is no peak to compare with: give a peak.")
    return found


def _mean(surface: Surface, values: Array) -> Array:
    return jnp.sum(surface.vertex_areas @ values) / (jnp.sum(surface.vertex_areas) * values.shape[1])


@eqx.filter_jit
def _mse(surface: Surface, u: Array, reference: Array) -> Array:
    return _mean(surface, ((u - reference) ** 2).reshape(len(u), -1))
