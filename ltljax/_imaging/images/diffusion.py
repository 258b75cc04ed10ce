"""Local means, diffusion and sharpening of images.

What enters: a surface, an image, and a length or time. What leaves: the filtered image. All filters use the weights of
the Laplacian. With ``Monotone`` these are non-negative, so means and diffusion keep values within those of the image.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Bool, Float

from ..._base.deprecated import deprecated_alias
from ..._equations import Diffusion, Equation
from ..._operators import gradient, laplacian, spectral_bound, weighted_laplacian
from ..._solve.evolve import solve
from ..._solve.krylov import Jacobi, linear_solve
from ..._solve.stabilised import RKL1
from ..._surface import Surface, on_surface
from ..._tables import AnyArray
from .checks import check, number, signal

_EXACT = {jnp.dtype("float64"): 1e-10, jnp.dtype("float32"): 1e-5}
_MAX_ITERATIONS = 1000


@on_surface
def local_mean(surface: Surface, u: Float[AnyArray, "V *C"], scale: float | AnyArray) -> Float[Array, "V *C"]:
    """The mean of the image over a window around each vertex.

    Takes one implicit step of diffusion, ``u_s - scale^2 / 2 Delta u_s = u``. The window has non-negative weights and
    the standard deviation ``scale`` along each axis, like a Gaussian window, but a heavier tail. Differentiable. Inside
    jit, a mean that did not converge is NaN.

    Args:
        surface: the surface.
        u: image, (V,) or (V, C).
        scale: standard deviation of the window, a length.

    Raises:
        SolveError: the linear system was not solved.
        ValueError: u does not fit the surface or is NaN or infinite, or the scale is negative.
    """
    mean, is_converged = try_local_mean(surface, signal(surface, u), number(surface, "scale", scale, may_be_zero=True))
    check("a local mean", is_converged)
    return mean


smoothed = deprecated_alias("ltljax.imaging.smoothed", local_mean)


@eqx.filter_jit
def try_local_mean(
    surface: Surface, u: Float[Array, "V *C"], scale: Float[Array, ""]
) -> tuple[Float[Array, "V *C"], Bool[Array, ""]]:
    """The `local_mean`, and whether it converged; NaN if not."""
    return implicit_step(surface, u, jnp.asarray(scale, u.dtype) ** 2 / 2)


@eqx.filter_jit
def implicit_step(
    surface: Surface, u: Float[Array, "V *C"], time: Float[Array, ""]
) -> tuple[Float[Array, "V *C"], Bool[Array, ""]]:
    """The image after one implicit Euler step of diffusion, and whether the system was solved; NaN if not."""
    time = jnp.asarray(time, u.dtype)
    inverse = Jacobi(1 - time * surface.laplacian_stencil.diagonal()[:, None])
    tolerance = _EXACT[jnp.dtype(u.dtype)]
    # Solving for the change of u leaves constants unchanged to the last digit.
    right = time * laplacian(surface, u)
    change = linear_solve(lambda d: d - time * laplacian(surface, d), right, inverse, tolerance, _MAX_ITERATIONS)
    is_solved = change.result == lx.RESULTS.successful
    return jnp.where(is_solved, u + change.value, jnp.nan), is_solved


@on_surface
def diffuse(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    time: float | AnyArray,
    *,
    solver: diffrax.AbstractSolver | None = None,
    rtol: float = 1e-3,
) -> Float[Array, "V *C"]:
    """The image after linear diffusion, u_t = Delta u: blurred by a Gaussian of standard deviation sqrt(2 time).

    Args:
        surface: the surface.
        u: image, (V,) or (V, C).
        time: duration, in units of length squared.
        solver: time stepper, as in `solve`; by default `RKL1`, which keeps values within those of u.
        rtol: relative tolerance of a time step.

    Raises:
        ValueError: u does not fit the surface or is NaN or infinite, or the time is negative.
    """
    return evolved(Diffusion(), surface, signal(surface, u), time, solver, rtol)


class PeronaMalik(Equation):
    """u_t = div(g(|grad u_s|) grad u) with g = 1 / (1 + (s / contrast)^2): diffusion that stops at edges.

    Slopes of the image well below the contrast are smoothed, and slopes well above it are kept. Slopes are those of
    u_s, the `local_mean` of the image over windows of the given scale; without it, noise would count as edges, and the
    equation would not be well posed. The columns of a state (V, C) are the colours of one image and share one g, which
    depends on the slope sqrt(sum_c |grad u_c|^2).

    With ``Monotone`` all neighbour weights are non-negative whatever g is, so values stay within those at the start.
    The equation is in divergence form: constants stay constant, and the integral of u is conserved up to the error of
    the discretisation.

    Attributes:
        contrast: threshold of the slope, in units of u over a length.
        scale: standard deviation of the window, a length.

    Source: Perona and Malik (1990), doi:10.1109/34.56205; with u_s, Catte, Lions, Morel and Coll (1992),
    doi:10.1137/0729012.
    """

    contrast: Float[Array, ""] | float
    scale: Float[Array, ""] | float

    def conductivity(self, surface: Surface, u: Float[Array, "V *C"]) -> Float[Array, " V"]:
        """The conductivity g, between 0 and 1."""
        mean, _ = try_local_mean(surface, u, jnp.asarray(self.scale, u.dtype))
        slopes = gradient(surface, mean).reshape(len(u), -1)
        return 1 / (1 + jnp.sum(slopes**2, axis=1) / jnp.asarray(self.contrast, u.dtype) ** 2)

    def rate(self, t, surface: Surface, u):
        """The time derivative."""
        del t
        return weighted_laplacian(surface, self.conductivity(surface, u), u)

    def spectral_bound(self, t, surface: Surface, u):
        """The bound of the Laplacian's eigenvalues, because g is at most 1."""
        del t
        return spectral_bound(surface).astype(u.dtype)


@on_surface
def perona_malik(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    time: float | AnyArray,
    contrast: float | AnyArray,
    scale: float | AnyArray | None = None,
    *,
    solver: diffrax.AbstractSolver | None = None,
    rtol: float = 1e-3,
) -> Float[Array, "V *C"]:
    """The image after diffusion that stops at edges: see `PeronaMalik`.

    Args:
        surface: the surface.
        u: image, (V,) or (V, C); its colours share their edges.
        time: duration, in units of length squared. Where the image is flat, it is blurred by a Gaussian of standard
            deviation sqrt(2 time).
        contrast: slopes well below this are smoothed, and slopes well above it are kept.
        scale: standard deviation of the window over which slopes are averaged; by default the mean edge length.
        solver: time stepper, as in `solve`; by default `RKL1`.
        rtol: relative tolerance of a time step.

    Raises:
        ValueError: u does not fit the surface or is NaN or infinite, the time or the scale is negative, or the contrast
            is not positive.
    """
    u = signal(surface, u)
    scale = surface.mesh_size if scale is None else number(surface, "scale", scale, may_be_zero=True)
    equation = PeronaMalik(number(surface, "contrast", contrast), scale)
    return evolved(equation, surface, u, time, solver, rtol)


@on_surface
def sharpen(
    surface: Surface, u: Float[AnyArray, "V *C"], amount: float | AnyArray, scale: float | AnyArray
) -> Float[Array, "V *C"]:
    """The image with its details amplified: ``u + amount (u - u_s)``, with u_s the `local_mean` of u.

    This is unsharp masking. To first order in the scale squared it is diffusion backwards in time, but it is stable: no
    wave is amplified by more than ``1 + amount``, however short it is. Overshoots at edges are not clipped.

    Args:
        surface: the surface.
        u: image, (V,) or (V, C).
        amount: gain of the details; 0 returns the image itself.
        scale: standard deviation of the window, a length; details well above it are kept as they are.

    Raises:
        ValueError: u does not fit the surface or is NaN or infinite, or the amount or the scale is negative.
    """
    u = signal(surface, u)
    return u + number(surface, "amount", amount, may_be_zero=True) * (u - local_mean(surface, u, scale))


def evolved(
    equation: Equation, surface: Surface, u: Array, time: Any, solver: diffrax.AbstractSolver | None, rtol: float
) -> Array:
    """The image at the end of a run; the default solver keeps the maximum principle."""
    time = number(surface, "time", time, may_be_zero=True)
    solver = RKL1() if solver is None else solver
    return solve(equation, surface, u, time, solver=solver, rtol=rtol, atol=1e-3 * rtol).us[-1]
