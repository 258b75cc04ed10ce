"""Total variation denoising: the image of least total variation that is close to a noisy one.

What enters: a surface, a noisy image, and either the weight of the total variation or the size of the noise. What
leaves: the denoised image, with derivatives. `minimiser` defines the functional and minimises it.
"""

from typing import Any

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
from .minimiser import Functional, HatGradients, minimise

# Tolerance of Newton's last step, relative to the standard deviation of the image.
_RTOL = {jnp.dtype("float64"): 1e-8, jnp.dtype("float32"): 1e-5}
# Tolerance of the logarithm of the residual's mean square over that of the noise.
_MATCH = {jnp.dtype("float64"): 1e-6, jnp.dtype("float32"): 1e-3}
_MAX_ITERATIONS, _MAX_TRIALS = 100, 60
# Largest change of the logarithm of the strength from one trial to the next.
_STRIDE = 2.0
# Tolerance of the image of a trial, relative to the noise times the mismatch of the trial before.
_SLACK = 1e-3


@renamed_arguments(f="u", tolerance="rtol", max_steps="max_iterations")
@on_surface
def denoise(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    *,
    strength: float | AnyArray | None = None,
    noise: float | AnyArray | None = None,
    rounding: float | AnyArray = 1e-2,
    rtol: float | None = None,
    max_iterations: int = _MAX_ITERATIONS,
    throw: bool = True,
) -> Float[Array, "V *C"]:
    """The image v that minimises ``1/2 int |v - u|^2 + strength TV(v)``: u with its noise removed and its edges kept.

    The total variation ``TV(v) = int |grad v|`` is that of the image interpolated linearly on each face. A colour image
    has the single slope ``sqrt(sum_c |grad v_c|^2)``, so its colours share their edges. An edge costs its height, no
    matter how sharp it is. A patch vanishes if half its height times its radius is below the strength.

    The primal-dual Newton method runs until it converges. Differentiable in both modes by the implicit function
    theorem, in u, in the strength or the noise, and in the vertices. Inside jit, an image that did not converge is NaN.

    Args:
        surface: the surface, built with any scheme.
        u: noisy image, (V,) or (V, C).
        strength: weight of the total variation, in units of u times a length.
        noise: standard deviation of the noise in each value, instead of a strength. The strength is then chosen such
            that the mean of (v - u)^2 over the area and colours is noise^2 (the discrepancy principle).
        rounding: slopes well below this times the standard deviation of u over the root of the area count as flat,
            which makes the functional smooth.
        rtol: tolerance of the root mean square of Newton's last step, relative to the standard deviation of u; by
            default 1e-8 for float64 and 1e-5 for float32.
        max_iterations: number of Newton iterations after which the method has failed.
        throw: whether to raise on failure. Inside jit nothing is raised.

    Raises:
        SolveError: the method did not converge.
        ValueError: u does not fit the surface or is NaN or infinite, neither or both of strength and noise are given,
            the strength is negative, the noise is not positive, or the noise is at least the standard deviation of u.

    Source: Rudin, Osher and Fatemi (1992), doi:10.1016/0167-2789(92)90242-F; for colours, Bresson and Chan (2008),
    doi:10.3934/ipi.2008.2.455; for the choice of the strength, Morozov (1966).
    """
    u = signal(surface, u)
    if (strength is None) == (noise is None):
        raise ValueError(
            f"Expected one of strength and noise, found {'neither' if noise is None else 'both'}. Give the strength of "
            "the total variation, or the standard deviation of the noise, from which the strength is chosen."
        )
    if strength is not None:
        strength = number(surface, "strength", strength, may_be_zero=True)
    if noise is not None:
        noise = number(surface, "noise", noise)
        _check_noise(surface, u, noise)
    rounding = number(surface, "rounding", rounding)
    rtol = _RTOL[jnp.dtype(u.dtype)] if rtol is None else rtol
    # As arrays, so that other limits need no compiling.
    limits = jnp.asarray(rtol, u.dtype), jnp.asarray(max_iterations, jnp.int32)
    v, _, is_converged = _denoise(surface, u, strength, noise, rounding, *limits)
    if throw:
        check("the least total variation", is_converged)
    return v


@renamed_arguments(f="u")
@on_surface
def noise_strength(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    noise: float | AnyArray,
    *,
    rounding: float | AnyArray = 1e-2,
    throw: bool = True,
) -> Float[Array, ""]:
    """The strength for which the residual of `denoise` has the size of the noise.

    Args:
        surface: the surface.
        u: noisy image, (V,) or (V, C).
        noise: standard deviation of the noise in each value.
        rounding: as in `denoise`.
        throw: whether to raise on failure. Inside jit nothing is raised, and the strength is NaN.

    Raises:
        SolveError: no such strength was found.
        ValueError: u does not fit the surface or is NaN or infinite, or the noise is not positive or is at least the
            standard deviation of u.
    """
    u = signal(surface, u)
    noise = number(surface, "noise", noise)
    _check_noise(surface, u, noise)
    limits = jnp.asarray(_RTOL[jnp.dtype(u.dtype)], u.dtype), jnp.asarray(_MAX_ITERATIONS, jnp.int32)
    _, strength, is_converged = _denoise(surface, u, None, noise, number(surface, "rounding", rounding), *limits)
    if throw:
        check("the strength of the total variation", is_converged)
    return strength


def deviation(surface: Surface, u: Float[Array, "V C"]) -> Float[Array, ""]:
    """The standard deviation of an image over the area, about the mean of each colour; smooth even at constants."""
    shares = surface.vertex_areas / jnp.sum(surface.vertex_areas)
    mean = shares @ u
    variance = jnp.sum(shares[:, None] * (u - mean[None]) ** 2) / u.shape[1]
    return jnp.sqrt(variance + 1e-10 * jnp.mean(mean**2) + jnp.finfo(u.dtype).tiny ** 0.5)


def flatness(surface: Surface, u: Float[Array, "V C"], rounding: Float[Array, ""]) -> Float[Array, ""]:
    """The slope below which an image counts as flat."""
    return rounding * deviation(surface, u) / jnp.sqrt(jnp.sum(surface.vertex_areas))


def _check_noise(surface: Surface, u: Array, noise: Array) -> None:
    if isinstance(u, Tracer) or isinstance(noise, Tracer) or surface.is_traced:
        return
    largest = float(deviation(surface, u.reshape(len(u), -1)))
    if float(noise) >= largest:
        raise ValueError(
            f"Expected noise below the standard deviation of u, which is {largest:.4g}, found {float(noise):.4g}. "
            "Noise of that size explains all of u, and only its mean would remain. Give less noise, or a strength."
        )


@eqx.filter_jit
def _denoise(
    surface: Surface, u: Array, strength: Array | None, noise: Array | None, rounding: Array, rtol: Array,
    max_iterations: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """The image, the strength, and whether both converged; NaN if not."""
    columns = u.reshape(len(u), -1)
    faces, areas = HatGradients.from_surface(surface), surface.vertex_areas
    is_free = jnp.ones_like(areas)
    flat = flatness(surface, columns, rounding)
    tolerance = jax.lax.stop_gradient(rtol * deviation(surface, columns))

    def minimiser(strength, start, tolerance):
        return minimise(Functional(faces, areas, is_free, columns, strength, flat), start, tolerance, max_iterations)

    start, is_matched = columns, jnp.array(True)
    if strength is None:
        assert noise is not None
        total, explained = jnp.sum(areas) * columns.shape[1], noise**2

        def excess(log_strength, start, slack):
            """The logarithm of the residual's mean square over that of the noise."""
            v, is_converged, _ = minimiser(jnp.exp(log_strength), start, jnp.maximum(tolerance, slack * noise))
            mean_square = jnp.sum(areas[:, None] * (v - columns) ** 2) / total
            return jnp.log(jnp.maximum(mean_square, jnp.finfo(u.dtype).tiny) / explained), v, is_converged

        guess = jnp.log(noise * surface.mesh_size)
        log_strength, start, is_matched = jax.lax.stop_gradient(
            _root(excess, guess, columns, _MATCH[jnp.dtype(u.dtype)])
        )
        log_strength = jax.lax.custom_root(
            lambda log_strength: excess(log_strength, start, jnp.zeros_like(log_strength))[0],
            log_strength,
            lambda _, log_strength: log_strength,
            lambda slope, b: b / slope(jnp.ones_like(b)),
        )
        strength = jnp.exp(log_strength)
    v, is_converged, _ = minimiser(strength, start, tolerance)
    is_converged = is_converged & is_matched
    return (
        jnp.where(is_converged, v, jnp.nan).reshape(u.shape),
        jnp.where(is_converged, strength, jnp.nan),
        is_converged,
    )


def _root(excess: Any, guess: Array, start: Array, match: float) -> tuple[Array, Array, Array]:
    """The root of an increasing scalar function that also returns a field, from which the next trial starts."""

    def is_unfinished(carry):
        _, _, value, *_, trials, is_converged = carry
        return (jnp.abs(value) > match) & (trials < _MAX_TRIALS) & is_converged

    def trial(carry):
        x, field, value, previous, previous_value, low, high, trials, _ = carry
        # Secant method. Without a secant, or if it decreases, use slope 1, which is exact where all of u is noise.
        rise = (value - previous_value) / jnp.where(x == previous, 1, x - previous)
        slope = jnp.where((trials > 1) & (rise > 0), rise, 1)
        next_x = x + jnp.clip(-value / slope, -_STRIDE, _STRIDE)
        is_inside = (next_x > low) & (next_x < high)
        middle = jnp.where(jnp.isfinite(low) & jnp.isfinite(high), (low + high) / 2, next_x)
        next_x = jnp.where(trials == 0, x, jnp.where(is_inside, next_x, middle))
        # A trial far from the root need not be exact.
        next_value, field, is_converged = excess(next_x, field, _SLACK * jnp.minimum(jnp.abs(value), 1))
        low, high = jnp.where(next_value < 0, next_x, low), jnp.where(next_value < 0, high, next_x)
        return next_x, field, next_value, x, value, low, high, trials + 1, is_converged

    huge = jnp.full((), np.inf, guess.dtype)
    begin = (guess, start, huge, guess, huge, -huge, huge, jnp.zeros((), jnp.int32), jnp.array(True))
    x, field, value, *_, is_converged = jax.lax.while_loop(is_unfinished, trial, begin)
    return x, field, is_converged & (jnp.abs(value) <= match)
