"""How the species of a state diffuse: by a number, by a field over the surface, or by an operator of their own.

What enters: diffusivities as they are given, and a state. What leaves: the rate of change by diffusion, with the fluxes
that boundary conditions let through, and bounds of its eigenvalues.
"""

from collections.abc import Callable
from typing import Any, cast

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._operators import EllipticStencil, add_flux, spectral_bound, spectral_width, weighted_laplacian
from .._surface import Surface
from . import boundary as bounds
from .boundary import Conditions

# How one species spreads: a number D for D Delta u, a field (V,) for div(D grad u), or an operator.
Spread = Float[Array, "..."] | EllipticStencil
# Of a state: one of these for all species, numbers (S,), or a tuple with one for each species.
Spreads = Spread | tuple[Spread, ...]


def as_spreads(given: Any) -> Spreads:
    """Diffusivities as arrays, and numbers of several species as one array (S,)."""
    if isinstance(given, EllipticStencil):
        return given
    if not isinstance(given, tuple | list):
        return jnp.asarray(given, jnp.result_type(float))
    each = tuple(d if isinstance(d, EllipticStencil) else jnp.asarray(d, jnp.result_type(float)) for d in given)
    is_numbers = all(not isinstance(d, EllipticStencil) and d.ndim == 0 for d in each)
    return jnp.stack(cast(tuple[Array, ...], each)) if is_numbers else each


def are_numbers(spreads: Spreads, u: Float[Array, "V *S"]) -> bool:
    """Whether every species has a number as its diffusivity."""
    return not isinstance(spreads, tuple | EllipticStencil) and jnp.shape(spreads) in ((), u.shape[1:])


def of_each(spreads: Spreads, u: Float[Array, "V *S"]) -> tuple[Spread, ...]:
    """One spread for each species of a state.

    Raises:
        ValueError: they do not fit the state.
    """
    size, count = u.shape[0], u[0].size
    if are_numbers(spreads, u):
        return tuple(jnp.broadcast_to(jnp.asarray(spreads, u.dtype), (count,)))
    each = spreads if isinstance(spreads, tuple) else (spreads,) * count
    if len(each) != count:
        raise ValueError(f"Expected one diffusivity for each of {count} species, found {len(each)}.")
    for spread in each:
        shape = (size,) if isinstance(spread, EllipticStencil) else spread.shape
        if shape not in ((), (size,)):
            numbers = f" or {u.shape[1:]}" * (u.ndim > 1)
            raise ValueError(
                f"Expected a diffusivity that is a number, of shape ({size},){numbers}, or an EllipticStencil, found "
                f"shape {shape}. A tuple gives each species its own."
            )
    return each


def spread_rate(
    surface: Surface, spreads: Spreads, conditions: Conditions, t: Float[Array, ""], u: Float[Array, "V *S"]
) -> Float[Array, "V *S"]:
    """The rate of change by diffusion of a state that keeps the conditions, with the fluxes they let through."""
    if are_numbers(spreads, u):
        numbers = jnp.broadcast_to(jnp.asarray(spreads, u.dtype), u.shape[1:])
        return numbers[None] * bounds.bounded_laplacian(surface, conditions, t, u)
    columns, flux = u.reshape(len(u), -1), bounds.fluxes(surface, conditions, t, u)
    rates = []
    for column, spread in enumerate(of_each(spreads, u)):
        rate = _rate_of_one(surface, spread, columns[:, column])
        if flux is not None:
            through = flux.reshape(*flux.shape[:2], -1)[..., column]
            rate = add_flux(surface, rate, through, _flux_weights(surface, spread))
        rates.append(rate)
    return jnp.stack(rates, axis=1).reshape(u.shape)


def mean_diffusivities(spreads: Spreads, u: Float[Array, "V *S"]) -> Float[Array, "*S"]:
    """One number for each species; of what varies, the mean."""
    means = [d.mean_diffusion if isinstance(d, EllipticStencil) else jnp.mean(d) for d in of_each(spreads, u)]
    return jnp.stack([mean.astype(u.dtype) for mean in means]).reshape(u.shape[1:])


def spread_bound(
    surface: Surface, spreads: Spreads, conditions: Conditions, t: Float[Array, ""], u: Float[Array, "V *S"]
) -> Float[Array, ""]:
    """A bound of the magnitude of the eigenvalues of `spread_rate`."""

    def bound(spread: Spread) -> Array:
        own = spread.spectral_bound() if isinstance(spread, EllipticStencil) else _largest(spread) * laplacian
        return own.astype(u.dtype) + bounds.stiffness(surface, conditions, t, u, _flux_weights(surface, spread))

    laplacian = spectral_bound(surface)
    if are_numbers(spreads, u):
        stiffness = bounds.stiffness(surface, conditions, t, u)
        return _largest(jnp.asarray(spreads, u.dtype)) * (laplacian + stiffness)
    return _most(bound, of_each(spreads, u))


def spread_width(surface: Surface, spreads: Spreads, u: Float[Array, "V *S"]) -> Float[Array, ""]:
    """How far the eigenvalues of `spread_rate` lie off the real axis, as `ltl.operators.spectral_width` has it."""

    def width(spread: Spread) -> Array:
        own = spread.spectral_width() if isinstance(spread, EllipticStencil) else _largest(spread) * laplacian
        return own.astype(u.dtype)

    laplacian = spectral_width(surface)
    return _most(width, of_each(spreads, u))


def _rate_of_one(surface: Surface, spread: Spread, u: Float[Array, " V"]) -> Float[Array, " V"]:
    if isinstance(spread, EllipticStencil):
        return spread(u)
    # The harmonic mean is one of two neighbours, which only a scheme with weights of its own for them has.
    mean = "arithmetic" if surface.topology.diffusion is None else "harmonic"
    return weighted_laplacian(surface, jnp.broadcast_to(spread.astype(u.dtype), u.shape), u, mean)


def _flux_weights(surface: Surface, spread: Spread) -> Float[Array, "B 2"] | None:
    """What a unit flux through each side of a boundary vertex adds to the rate there."""
    if isinstance(spread, EllipticStencil):
        return spread.flux_weights
    weights = surface.geometry.flux_weights
    at_boundary = jnp.broadcast_to(spread, (surface.num_vertices,))[surface.topology.boundary]
    return None if weights is None else at_boundary.astype(weights.dtype)[:, None] * weights


def _largest(numbers: Array) -> Array:
    return jnp.max(jnp.abs(numbers))


def _most(of_one: Callable[[Spread], Array], each: tuple[Spread, ...]) -> Array:
    """The largest of a number of every species."""
    return jnp.max(jnp.stack([of_one(spread) for spread in each]))
