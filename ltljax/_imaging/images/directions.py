"""Diffusion of unit vectors of any dimension, such as normals or the hues of colours.

What enters: a surface and unit vectors (V, N). What leaves: unit vectors (V, N).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..._base.deprecated import renamed_arguments
from ..._surface import Surface, on_surface
from ..._tables import AnyArray
from .checks import check, number, signal
from .diffusion import implicit_step
from .total_variation import denoise

# Tolerance of the length of a unit vector.
_UNIT = {jnp.dtype("float64"): 1e-6, jnp.dtype("float32"): 1e-4}


@on_surface
def diffuse_directions(
    surface: Surface, d: Float[AnyArray, "V *N"], time: float | AnyArray, steps: int = 8
) -> Float[Array, "V N"]:
    """The unit vectors after the harmonic map heat flow into the sphere, d_t = Delta d + |grad d|^2 d.

    Each step is one implicit step of diffusion, followed by normalisation, which is first order in time. Whatever the
    step size, each new vector is a normalised mean of the old ones with non-negative weights, so vectors that all lie
    in one half space stay in it. The dimension N is arbitrary, and the vectors need not be tangent to the surface.

    Args:
        surface: the surface.
        d: (V, N) unit vectors.
        time: duration, in units of length squared.
        steps: number of time steps.

    Raises:
        SolveError: a step was not solved.
        ValueError: d does not fit the surface, is NaN or infinite or not of length one, or the time is negative.

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
                f"Expected directions of length one, found the length {lengths[first]:.6g} at vertex {first}. "
                "Normalise them, or use ltl.imaging.diffuse for vectors of other lengths."
            )
    if steps < 1:
        raise ValueError(f"Expected at least one step, found {steps}.")
    diffused, is_converged = _diffused(surface, d, number(surface, "time", time, may_be_zero=True), steps)
    check("the diffusion of directions", is_converged)
    return diffused


@renamed_arguments(colours="u")
@on_surface
def denoise_chromaticity(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    time: float | AnyArray,
    brightness_strength: float | AnyArray | None = None,
    steps: int = 8,
) -> Float[Array, "V C"]:
    """The colour image with its hues diffused as directions, and its brightness denoised separately.

    A colour u has the brightness |u| and the chromaticity u / |u|. Noise is more visible in hues than in brightness,
    and diffusing hues as directions keeps a mean across an edge from turning grey.

    Args:
        surface: the surface.
        u: (V, C) colours, usually red, green and blue. The hue of black is taken to be grey.
        time: duration of the diffusion of the chromaticity, in units of length squared.
        brightness_strength: weight of the total variation with which the brightness is denoised; by default the
            brightness is unchanged.
        steps: number of time steps, as in `diffuse_directions`.

    Raises:
        SolveError: the iteration for the brightness or for the hues did not converge.
        ValueError: u does not fit the surface or is NaN or infinite, or a number is negative.

    Source: Tang, Sapiro and Caselles (2001), Color image enhancement via chromaticity diffusion,
    doi:10.1109/83.918563.
    """
    u = signal(surface, u)
    if u.ndim != 2:
        raise ValueError(f"Expected colours u of shape ({surface.num_vertices}, C), found {u.shape}.")
    brightness, chromaticity = _brightness_and_chromaticity(u)
    if brightness_strength is not None:
        brightness = denoise(surface, brightness, strength=brightness_strength)
    return brightness[:, None] * diffuse_directions(surface, chromaticity, time, steps)


@eqx.filter_jit
def _brightness_and_chromaticity(u: Array) -> tuple[Array, Array]:
    squared = jnp.sum(u**2, axis=1, keepdims=True)
    is_black = squared <= jnp.finfo(u.dtype).tiny
    length = jnp.sqrt(jnp.where(is_black, 1, squared))
    grey = jnp.asarray(u.shape[1] ** -0.5, u.dtype)
    return jnp.where(is_black, 0, length)[:, 0], jnp.where(is_black, grey, u / length)


@eqx.filter_jit
def _diffused(surface: Surface, d: Array, time: Array, steps: int) -> tuple[Array, Array]:
    def step(d, _):
        mean, is_solved = implicit_step(surface, d, time / steps)
        squared = jnp.sum(mean**2, axis=1, keepdims=True)
        # Opposite directions may cancel; such a vertex keeps its previous direction.
        is_zero = squared <= jnp.finfo(d.dtype).eps ** 2
        return jnp.where(is_zero, d, mean / jnp.sqrt(jnp.where(is_zero, 1, squared))), is_solved

    d, are_solved = jax.lax.scan(step, d / jnp.linalg.norm(d, axis=1, keepdims=True), length=steps)
    return d, jnp.all(are_solved)
