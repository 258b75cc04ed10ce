"""Noise is taken off and edges stay: the image of least total variation that is close to a noisy one.

What enters: a surface, a noisy image, and how much the total variation weighs or how large the noise is. What leaves:
the image, with derivatives; `minimiser` has the functional and how it is made least.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..._surface import Surface, on_surface
from ..._tables import AnyArray
from .minimiser import Faces, Functional, minimise
from .signals import check, number, signal

# Of the last step of Newton's method, relative to the standard deviation of the image; and of the mean square that the
# noise is to explain, relative.
_TOLERANCE = {jnp.dtype("float64"): 1e-8, jnp.dtype("float32"): 1e-5}
_MATCH = {jnp.dtype("float64"): 1e-6, jnp.dtype("float32"): 1e-3}
_MAX_TRIALS = 60
# The most that the logarithm of the strength changes from one trial to the next.
_STRIDE = 2.0
# Of the image of a trial, relative to the noise and the logarithm.
_SLACK = 1e-3


@on_surface
def denoise(
    surface: Surface,
    f: Float[AnyArray, "V *C"],
    *,
    strength: float | AnyArray | None = None,
    noise: float | AnyArray | None = None,
    rounding: float | AnyArray = 1e-2,
    tolerance: float | None = None,
    max_steps: int = 100,
    throw: bool = True,
) -> Float[Array, "V *C"]:
    """The image u that makes ``1/2 int |u - f|^2 + strength TV(u)`` least: what is left of f without noise.

    The total variation ``int |grad u|`` is that of the piecewise linear image over the faces, and a colour image has
    one slope at a point, ``sqrt(sum_c |grad u_c|^2)``: edges cost by their height alone, however sharp they are, and
    those of all colours coincide. A patch vanishes where half its height times its radius is below the strength.

    Found by the primal-dual Newton method, to the end and not in so many steps. Differentiable in both modes by the
    implicit function theorem, in f, strength or noise, and the vertices; inside jit what did not converge is NaN.

    Args:
        surface: the surface, of any scheme.
        f: the noisy image, (V,) or (V, C).
        strength: of the total variation, in units of f times a length.
        noise: in its place, the standard deviation of the noise in each value: the strength is then chosen so that the
            mean of (u - f)^2 over the area and colours is its square (the discrepancy principle).
        rounding: slopes well below this times the standard deviation of f over the root of the area count as flat,
            which makes the functional smooth.
        tolerance: Newton's method ends with a step whose root mean square is this times the standard deviation of f; by
            default 1e-8 for float64 and 1e-5 for float32.
        max_steps: after which it has failed.
        throw: whether to raise then, outside of jit.

    Raises:
        SolveError: the minimiser was not found.
        ValueError: f does not fit the surface or is not finite, both or none of strength and noise are given or one is
            not positive, or the noise is as large as f itself varies.

    Source: Rudin, Osher and Fatemi (1992), doi:10.1016/0167-2789(92)90242-F; of colours Bresson and Chan (2008),
    doi:10.3934/ipi.2008.2.455; the choice of strength, Morozov (1966).
    """
    f = signal(surface, f, "f")
    if (strength is None) == (noise is None):
        raise ValueError(
            f"Expected one of strength and noise, found {'neither' if noise is None else 'both'}: give the strength of "
            "the total variation, or the standard deviation of the noise, by which it is then chosen."
        )
    if strength is not None:
        strength = number(surface, "strength", strength, may_be_zero=True)
    if noise is not None:
        noise = number(surface, "noise", noise)
        _is_explained(surface, f, noise)
    rounding = number(surface, "rounding", rounding)
    tolerance = _TOLERANCE[jnp.dtype(f.dtype)] if tolerance is None else tolerance
    u, _, found = _denoise(surface, f, strength, noise, rounding, jnp.asarray(tolerance, f.dtype), max_steps)
    if throw:
        check("the least total variation", found)
    return u


@on_surface
def noise_strength(
    surface: Surface,
    f: Float[AnyArray, "V *C"],
    noise: float | AnyArray,
    *,
    rounding: float | AnyArray = 1e-2,
    throw: bool = True,
) -> Float[Array, ""]:
    """The strength with which `denoise` leaves a residual of the size of the noise: see there."""
    f = signal(surface, f, "f")
    noise = number(surface, "noise", noise)
    _is_explained(surface, f, noise)
    tolerance = jnp.asarray(_TOLERANCE[jnp.dtype(f.dtype)], f.dtype)
    _, strength, found = _denoise(surface, f, None, noise, number(surface, "rounding", rounding), tolerance, 100)
    if throw:
        check("the strength of the total variation", found)
    return strength


def deviation(surface: Surface, f: Float[Array, "V C"]) -> Float[Array, ""]:
    """The standard deviation of an image over the area, about the mean of each colour; smooth where that is none."""
    shares = surface.vertex_areas / jnp.sum(surface.vertex_areas)
    mean = shares @ f
    variance = jnp.sum(shares[:, None] * (f - mean[None]) ** 2) / f.shape[1]
    return jnp.sqrt(variance + 1e-10 * jnp.mean(mean**2) + jnp.finfo(f.dtype).tiny ** 0.5)


def flatness(surface: Surface, f: Float[Array, "V C"], rounding: Float[Array, ""]) -> Float[Array, ""]:
    """The slope below which an image counts as flat."""
    return rounding * deviation(surface, f) / jnp.sqrt(jnp.sum(surface.vertex_areas))


def _is_explained(surface: Surface, f: Array, noise: Array) -> None:
    if isinstance(f, Tracer) or isinstance(noise, Tracer) or surface.is_traced:
        return
    most = float(deviation(surface, f.reshape(len(f), -1)))
    if float(noise) >= most:
        raise ValueError(
            f"Expected noise below the standard deviation of f, which is {most:.4g}, found {float(noise):.4g}: such "
            "noise explains all of f and would leave its mean. Give less noise, or a strength."
        )


@eqx.filter_jit
def _denoise(
    surface: Surface, f: Array, strength: Array | None, noise: Array | None, rounding: Array, tolerance: Array,
    max_steps: int,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """The image, the strength, and whether they were found; NaN where not."""
    columns = f.reshape(len(f), -1)
    faces, areas = Faces.of(surface), surface.vertex_areas
    is_free = jnp.ones_like(areas)
    flat = flatness(surface, columns, rounding)
    enough = jax.lax.stop_gradient(tolerance * deviation(surface, columns))

    def least(strength, start, enough):
        return minimise(Functional(faces, areas, is_free, columns, strength, flat), start, enough, max_steps)

    start, is_matched = columns, jnp.array(True)
    if strength is None:
        assert noise is not None
        total, explained = jnp.sum(areas) * columns.shape[1], noise**2

        def excess(log_strength, start, slack):
            """The logarithm of the mean square of the residual over that of the noise."""
            u, found, _ = least(jnp.exp(log_strength), start, jnp.maximum(enough, slack * noise))
            mean_square = jnp.sum(areas[:, None] * (u - columns) ** 2) / total
            return jnp.log(jnp.maximum(mean_square, jnp.finfo(f.dtype).tiny) / explained), u, found

        guess = jnp.log(noise * surface.mesh_size)
        log_strength, start, is_matched = jax.lax.stop_gradient(
            _root(excess, guess, columns, _MATCH[jnp.dtype(f.dtype)])
        )
        log_strength = jax.lax.custom_root(
            lambda at: excess(at, start, jnp.zeros_like(at))[0],
            log_strength,
            lambda _, at: at,
            lambda slope, b: b / slope(jnp.ones_like(b)),
        )
        strength = jnp.exp(log_strength)
    u, found, _ = least(strength, start, enough)
    found = found & is_matched
    return jnp.where(found, u, jnp.nan).reshape(f.shape), jnp.where(found, strength, jnp.nan), found


def _root(excess: Any, guess: Array, start: Array, match: float) -> tuple[Array, Array, Array]:
    """Where a rising function of one number vanishes, each trial beginning with the field that the last one found."""

    def goes_on(carry):
        _, _, value, *_, trials, fine = carry
        return (jnp.abs(value) > match) & (trials < _MAX_TRIALS) & fine

    def trial(carry):
        at, u, value, before, value_before, low, high, trials, _ = carry
        # By the secant; where there is none yet, or it points the wrong way, by the slope where all is noise.
        rise = (value - value_before) / jnp.where(at == before, 1, at - before)
        slope = jnp.where((trials > 1) & (rise > 0), rise, 1)
        to = at + jnp.clip(-value / slope, -_STRIDE, _STRIDE)
        is_inside = (to > low) & (to < high)
        middle = jnp.where(jnp.isfinite(low) & jnp.isfinite(high), (low + high) / 2, to)
        to = jnp.where(trials == 0, at, jnp.where(is_inside, to, middle))
        # Far from the end a trial need not be exact.
        found, u, fine = excess(to, u, _SLACK * jnp.minimum(jnp.abs(value), 1))
        low, high = jnp.where(found < 0, to, low), jnp.where(found < 0, high, to)
        return to, u, found, at, value, low, high, trials + 1, fine

    huge = jnp.full((), np.inf, guess.dtype)
    begin = (guess, start, huge, guess, huge, -huge, huge, jnp.zeros((), jnp.int32), jnp.array(True))
    at, u, value, *_, fine = jax.lax.while_loop(goes_on, trial, begin)
    return at, u, fine & (jnp.abs(value) <= match)
