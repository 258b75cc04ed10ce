"""Directions are smoothed and stay directions: unit vectors of any dimension, such as normals or the hues of colours.

What enters: a surface and unit vectors (V, N). What leaves: unit vectors (V, N).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..._surface import Surface, on_surface
from ..._tables import AnyArray
from .signals import check, number, signal
from .smoothing import mean_after
from .variation import denoise

# How far from one a length may be to be that of a unit vector.
_UNIT = {jnp.dtype("float64"): 1e-6, jnp.dtype("float32"): 1e-4}


@on_surface
def diffuse_directions(
    surface: Surface, d: Float[AnyArray, "V *N"], time: float | AnyArray, steps: int = 8
) -> Float[Array, "V N"]:
    """The unit vectors after the harmonic map heat flow into the sphere, d_t = Delta d + |grad d|^2 d.

    Each step is one implicit step of diffusion, after which every vector is given its length of one again: of first
    order in time, and for any length of steps each vector is the direction of a mean of those around it, with
    non-negative weights: within a half space that holds all of them they stay within it. N is any dimension; the
    vectors need not be tangent, nor have to do with the surface.

    Args:
        surface: the surface.
        d: (V, N) of length one.
        time: in units of a length squared.
        steps: their number.

    Raises:
        ValueError: d does not fit the surface, is not finite or not of length one, or the time is negative.

    Source: Tang, Sapiro and Caselles (2000), Diffusion of general data on non-flat manifolds via harmonic maps theory,
    doi:10.1023/A:1008152115986.
    """
    d = signal(surface, d, "d")
    if d.ndim != 2:
        raise ValueError(f"Expected directions of shape ({surface.num_vertices}, N), found {d.shape}.")
    if not isinstance(d, Tracer):
        lengths = np.linalg.norm(np.asarray(d), axis=1)
        if (is_bad := np.abs(lengths - 1) > _UNIT[jnp.dtype(d.dtype)]).any():
            first = int(np.flatnonzero(is_bad)[0])
            raise ValueError(
                f"Expected directions of length one, found the length {lengths[first]:.6g} at vertex {first}. Divide "
                "each by its length, or use ltl.imaging.diffuse for vectors of other lengths."
            )
    if steps < 1:
        raise ValueError(f"Expected at least one step, found {steps}.")
    found, converged = _diffused(surface, d, number(surface, "time", time, may_be_zero=True), steps)
    check("the diffusion of directions", converged)
    return found


@on_surface
def denoise_chromaticity(
    surface: Surface,
    colours: Float[AnyArray, "V *C"],
    time: float | AnyArray,
    brightness_strength: float | AnyArray | None = None,
    steps: int = 8,
) -> Float[Array, "V C"]:
    """The colours with hues that are smoothed as directions, and brightness that is denoised by itself.

    Of a colour c the brightness is |c| and the chromaticity c / |c|. Noise is seen in hues more than in brightness, and
    a mean of hues on either side of an edge is not grey.

    Args:
        surface: the surface.
        colours: (V, C), as a rule red, green and blue. Where all are zero the hue is taken for grey.
        time: for which chromaticity diffuses, in units of a length squared.
        brightness_strength: of the total variation with which the brightness is denoised; by default it stays.
        steps: of `diffuse_directions`.

    Raises:
        SolveError: the iteration for the brightness did not converge.
        ValueError: colours do not fit the surface or are not finite, or a number is negative.

    Source: Tang, Sapiro and Caselles (2001), Color image enhancement via chromaticity diffusion,
    doi:10.1109/83.918563.
    """
    colours = signal(surface, colours, "colours")
    if colours.ndim != 2:
        raise ValueError(f"Expected colours of shape ({surface.num_vertices}, C), found {colours.shape}.")
    brightness, chromaticity = _parts(colours)
    if brightness_strength is not None:
        brightness = denoise(surface, brightness, strength=brightness_strength)
    return brightness[:, None] * diffuse_directions(surface, chromaticity, time, steps)


@eqx.filter_jit
def _parts(colours: Array) -> tuple[Array, Array]:
    squared = jnp.sum(colours**2, axis=1, keepdims=True)
    is_black = squared <= jnp.finfo(colours.dtype).tiny
    length = jnp.sqrt(jnp.where(is_black, 1, squared))
    grey = jnp.asarray(colours.shape[1] ** -0.5, colours.dtype)
    return jnp.where(is_black, 0, length)[:, 0], jnp.where(is_black, grey, colours / length)


@eqx.filter_jit
def _diffused(surface: Surface, d: Array, time: Array, steps: int) -> tuple[Array, Array]:
    def step(d, _):
        mean, found = mean_after(surface, d, time / steps)
        squared = jnp.sum(mean**2, axis=1, keepdims=True)
        # Opposite directions may cancel; what has no direction keeps the one it had.
        has_none = squared <= jnp.finfo(d.dtype).eps ** 2
        return jnp.where(has_none, d, mean / jnp.sqrt(jnp.where(has_none, 1, squared))), found

    d, found = jax.lax.scan(step, d / jnp.linalg.norm(d, axis=1, keepdims=True), length=steps)
    return d, jnp.all(found)
