"""Measures of how close an image is to a reference: errors over the area, and structural similarity.

What enters: a surface and two images of the same shape. What leaves: one number.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from ..._base.deprecated import renamed_arguments
from ..._surface import Surface, on_surface
from ..._tables import AnyArray
from .checks import number, same_shape, signal
from .diffusion import local_mean

# The constants of Wang et al.: the standard deviation of the window in pixels, and two that bound the denominators.
_SCALE = 1.5
_LUMINANCE, _CONTRAST = 0.01, 0.03


@on_surface
def mse(surface: Surface, u: Float[AnyArray, "V *C"], reference: Float[AnyArray, "..."]) -> Float[Array, ""]:
    """The mean of (u - reference)^2 over the area and the colours.

    Args:
        surface: the surface.
        u: image, (V,) or (V, C).
        reference: image of the same shape.

    Raises:
        ValueError: the shapes do not fit, or a value is NaN or infinite.
    """
    return _mse(surface, *_pair(surface, u, reference))


@on_surface
def psnr(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    reference: Float[AnyArray, "..."],
    peak: float | AnyArray | None = None,
) -> Float[Array, ""]:
    """The peak signal-to-noise ratio in decibels, 10 log10(peak^2 / mse); infinite if u equals the reference.

    Args:
        surface: the surface.
        u: image, (V,) or (V, C).
        reference: image of the same shape.
        peak: largest difference of values; by default the range of the reference.

    Raises:
        ValueError: the shapes do not fit, a value is NaN or infinite, the peak is not positive, or the reference is
            constant and no peak is given.
    """
    u, reference = _pair(surface, u, reference)
    return 10 * jnp.log10(_peak(surface, reference, peak) ** 2 / _mse(surface, u, reference))


@renamed_arguments(radius="scale")
@on_surface
def ssim(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    reference: Float[AnyArray, "..."],
    scale: float | AnyArray | None = None,
    peak: float | AnyArray | None = None,
) -> Float[Array, ""]:
    """The structural similarity of two images, averaged over the area and the colours; 1 if they are equal.

    Means, variances and covariances are each a `local_mean`, which replaces the Gaussian window used on pixels.

    Args:
        surface: the surface.
        u: image, (V,) or (V, C).
        reference: image of the same shape.
        scale: standard deviation of the window; by default one and a half times the mean edge length.
        peak: largest difference of values; by default the range of the reference.

    Raises:
        ValueError: the shapes do not fit, a value is NaN or infinite, the scale or the peak is not positive, or the
            reference is constant and no peak is given.

    Source: Wang, Bovik, Sheikh and Simoncelli (2004), doi:10.1109/TIP.2003.819861.
    """
    u, reference = _pair(surface, u, reference)
    peak = _peak(surface, reference, peak)
    scale = _SCALE * surface.mesh_size if scale is None else number(surface, "scale", scale)
    x, y = (image.reshape(len(image), -1) for image in (u, reference))
    # Shifting both images does not change their variances and reduces cancellation.
    middle = jnp.mean(y)
    x, y = x - middle, y - middle
    means = local_mean(surface, jnp.concatenate([x, y, x**2, y**2, x * y], axis=1), scale)
    mean_x, mean_y, xx, yy, xy = jnp.split(means, 5, axis=1)
    var_x, var_y, covariance = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    mean_x, mean_y = mean_x + middle, mean_y + middle
    c1, c2 = (_LUMINANCE * peak) ** 2, (_CONTRAST * peak) ** 2
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * covariance + c2) / (var_x + var_y + c2)
    return _mean(surface, luminance * structure)


def _pair(surface: Surface, u: AnyArray, reference: AnyArray) -> tuple[Array, Array]:
    u, reference = signal(surface, u), signal(surface, reference, "reference")
    same_shape(u, reference, "a reference")
    return u, reference


def _peak(surface: Surface, reference: Array, peak: float | AnyArray | None) -> Array:
    if peak is not None:
        return number(surface, "peak", peak)
    value_range = jnp.max(reference) - jnp.min(reference)
    if not isinstance(value_range, Tracer) and not value_range > 0:
        raise ValueError("Expected a reference whose range can serve as the peak, found a constant one. Give a peak.")
    return value_range


def _mean(surface: Surface, values: Array) -> Array:
    return jnp.sum(surface.vertex_areas @ values) / (jnp.sum(surface.vertex_areas) * values.shape[1])


@eqx.filter_jit
def _mse(surface: Surface, u: Array, reference: Array) -> Array:
    return _mean(surface, ((u - reference) ** 2).reshape(len(u), -1))
