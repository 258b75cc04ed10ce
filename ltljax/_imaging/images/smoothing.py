"""An image is smoothed, with or without respect for its edges, or sharpened.

What enters: a surface, an image, and how far. What leaves: the image. Weights are those of the Laplacian: with
``Monotone`` they are not negative, so that values stay within those of the image.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Bool, Float

from ..._equations import Diffusion, Equation
from ..._operators import gradient, laplacian, spectral_bound, weighted_laplacian
from ..._solve.evolve import solve
from ..._solve.implicit import Jacobi
from ..._solve.krylov import linear_solve
from ..._solve.stabilised import RKL1
from ..._surface import Surface, on_surface
from ..._tables import AnyArray
from .signals import check, number, signal

_EXACT = {jnp.dtype("float64"): 1e-10, jnp.dtype("float32"): 1e-5}
_MAX_ITERATIONS = 1000


@on_surface
def smoothed(surface: Surface, u: Float[AnyArray, "V *C"], scale: float | AnyArray) -> Float[Array, "V *C"]:
    """The image averaged over a window of a given radius.

    One implicit step of diffusion, ``u_s - scale^2 / 2 Delta u_s = u``: a mean with non-negative weights whose standard
    deviation along each axis is ``scale``, as of a Gaussian window, but with a heavier tail. Differentiable; inside jit
    what did not converge is NaN.

    Args:
        surface: the surface.
        u: (V,) or (V, C).
        scale: a length.

    Raises:
        SolveError: the linear system was not solved.
        ValueError: u does not fit the surface or is not finite, or the scale is negative.
    """
    averaged, found = mean_over_windows(surface, signal(surface, u), number(surface, "scale", scale, may_be_zero=True))
    check("a mean over windows", found)
    return averaged


@eqx.filter_jit
def mean_over_windows(
    surface: Surface, u: Float[Array, "V *C"], scale: Float[Array, ""]
) -> tuple[Float[Array, "V *C"], Bool[Array, ""]]:
    """What `smoothed` returns, and whether it was found."""
    return mean_after(surface, u, jnp.asarray(scale, u.dtype) ** 2 / 2)


@eqx.filter_jit
def mean_after(
    surface: Surface, u: Float[Array, "V *C"], time: Float[Array, ""]
) -> tuple[Float[Array, "V *C"], Bool[Array, ""]]:
    """The image after one implicit step of diffusion over a time, half the square of a window's radius, and whether
    it was found."""
    half = jnp.asarray(time, u.dtype)
    inverse = Jacobi(1 / (1 - half * surface.laplacian_stencil.diagonal()[:, None]))
    share = _EXACT[jnp.dtype(u.dtype)]
    # For what is added to u, so that constants stay as they are, to the last digit.
    change = half * laplacian(surface, u)
    found = linear_solve(lambda d: d - half * laplacian(surface, d), change, inverse, share, _MAX_ITERATIONS)
    is_found = found.result == lx.RESULTS.successful
    return jnp.where(is_found, u + found.value, jnp.nan), is_found


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
        u: (V,) or (V, C).
        time: in units of a length squared.
        solver: as of `solve`; by default `RKL1`, with which values stay within those of u.
        rtol: relative tolerance of a step.

    Raises:
        ValueError: u does not fit the surface or is not finite, or the time is negative.
    """
    return evolved(Diffusion(), surface, signal(surface, u), time, solver, rtol)


class PeronaMalik(Equation):
    """u_t = div(g(|grad u_s|) grad u) with g = 1 / (1 + (s / contrast)^2): diffusion that stops at edges.

    Slopes of the image well below the contrast are smoothed, those well above stay. They are taken of u_s, the image
    averaged over a window of radius ``scale``: without it noise counts as edges and the equation is not well posed. The
    columns of a state (V, C) are colours of one image and share one g, of the slope sqrt(sum_c |grad u_c|^2).

    With ``Monotone`` the weights of neighbours are not negative, whatever g is: values stay within those at the start.
    In divergence form, so that flat fields stay and what diffusion conserves is conserved up to discretisation.

    Attributes:
        contrast: a slope, in units of u over a length.
        scale: a length.

    Source: Perona and Malik (1990), doi:10.1109/34.56205; with u_s, Catte, Lions, Morel and Coll (1992),
    doi:10.1137/0729012.
    """

    contrast: Float[Array, ""] | float
    scale: Float[Array, ""] | float

    def conductivity(self, surface: Surface, u: Float[Array, "V *C"]) -> Float[Array, " V"]:
        """g, between 0 and 1."""
        averaged, _ = mean_over_windows(surface, u, jnp.asarray(self.scale, u.dtype))
        slopes = gradient(surface, averaged).reshape(len(u), -1)
        return 1 / (1 + jnp.sum(slopes**2, axis=1) / jnp.asarray(self.contrast, u.dtype) ** 2)

    def rate(self, t, surface: Surface, u):
        """The time derivative."""
        del t
        return weighted_laplacian(surface, self.conductivity(surface, u), u)

    def spectral_bound(self, t, surface: Surface, u):
        """That of the Laplacian, as g is at most 1."""
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
        u: (V,) or (V, C); colours have their edges in common.
        time: in units of a length squared: where the image is flat it is blurred by a Gaussian of sqrt(2 time).
        contrast: slopes well below it are smoothed, those above stay.
        scale: the radius of the window that slopes are taken of; by default the mean length of the edges.
        solver: as of `solve`; by default `RKL1`.
        rtol: relative tolerance of a step.

    Raises:
        ValueError: u does not fit the surface or is not finite, or a number is negative.
    """
    u = signal(surface, u)
    scale = surface.mesh_size if scale is None else number(surface, "scale", scale, may_be_zero=True)
    equation = PeronaMalik(number(surface, "contrast", contrast), scale)
    return evolved(equation, surface, u, time, solver, rtol)


@on_surface
def sharpen(
    surface: Surface, u: Float[AnyArray, "V *C"], amount: float | AnyArray, scale: float | AnyArray
) -> Float[Array, "V *C"]:
    """The image with its details enlarged: u + amount (u - u_s), u_s its mean over a window of radius ``scale``.

    Unsharp masking. To first order in amount it is diffusion backwards in time, but stable: no wave is enlarged more
    than ``1 + amount`` times, however short. Overshoots at edges are not cut off.

    Args:
        surface: the surface.
        u: (V,) or (V, C).
        amount: 0 for the image itself.
        scale: a length; details well above it stay as they are.

    Raises:
        ValueError: u does not fit the surface or is not finite, or a number is negative.
    """
    u = signal(surface, u)
    return u + number(surface, "amount", amount, may_be_zero=True) * (u - smoothed(surface, u, scale))


def evolved(
    equation: Equation, surface: Surface, u: Array, time: Any, solver: diffrax.AbstractSolver | None, rtol: float
) -> Array:
    """The image after a time, by steps that keep the maximum principle where none are named."""
    time = number(surface, "time", time, may_be_zero=True)
    solver = RKL1() if solver is None else solver
    return solve(equation, surface, u, time, solver=solver, rtol=rtol, atol=1e-3 * rtol).us[-1]
