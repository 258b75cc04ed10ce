"""Diffusion of the species of a state, each by a number, a field over the surface or a stencil.

What enters: diffusivities in any of these forms, and a state. What leaves: the rate of change by diffusion, including
boundary fluxes, and bounds of its eigenvalues.
"""

from collections.abc import Callable
from typing import Any, cast

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._operators import EllipticStencil, add_flux, spectral_bound, spectral_width, weighted_laplacian
from .._surface import Surface
from . import boundary as bounds
from .boundary import Conditions

# The diffusion of one species: a number D for D Delta u, a field (V,) for div(D grad u), or a stencil.
Spread = Float[Array, "..."] | EllipticStencil
# The diffusion of a state: one spread for all species, numbers (S,), or a tuple with one spread per species.
Spreads = Spread | tuple[Spread, ...]


def as_spreads(diffusivity: Any) -> Spreads:
    """Diffusivities as arrays; numbers for several species become one array (S,)."""
    if isinstance(diffusivity, EllipticStencil):
        return diffusivity
    if not isinstance(diffusivity, tuple | list):
        return jnp.asarray(diffusivity, jnp.result_type(float))
    each = tuple(d if isinstance(d, EllipticStencil) else jnp.asarray(d, jnp.result_type(float)) for d in diffusivity)
    is_numbers = all(not isinstance(d, EllipticStencil) and d.ndim == 0 for d in each)
    return jnp.stack(cast(tuple[Array, ...], each)) if is_numbers else each


def are_numbers(spreads: Spreads, u: Float[Array, "V *S"]) -> bool:
    """Whether the diffusivity of every species is a number."""
    return not isinstance(spreads, tuple | EllipticStencil) and jnp.shape(spreads) in ((), u.shape[1:])


def of_each(spreads: Spreads, u: Float[Array, "V *S"]) -> tuple[Spread, ...]:
    """One spread for each species of a state.

    Raises:
        ValueError: the spreads do not fit the state.
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
                f"shape {shape}. Use a tuple to give each species its own diffusivity."
            )
    return each


def spread_rate(
    surface: Surface, spreads: Spreads, conditions: Conditions, t: Float[Array, ""], u: Float[Array, "V *S"]
) -> Float[Array, "V *S"]:
    """The rate of change by diffusion of a state that satisfies the conditions, including their fluxes."""
    if are_numbers(spreads, u):
        numbers = jnp.broadcast_to(jnp.asarray(spreads, u.dtype), u.shape[1:])
        return numbers[None] * bounds.bounded_laplacian(surface, conditions, t, u)
    columns, flux = u.reshape(len(u), -1), bounds.fluxes(surface, conditions, t, u)
    rates = []
    for column, spread in enumerate(of_each(spreads, u)):
        rate = _species_rate(surface, spread, columns[:, column])
        if flux is not None:
            through = flux.reshape(*flux.shape[:2], -1)[..., column]
            rate = add_flux(surface, rate, through, _flux_weights(surface, spread))
        rates.append(rate)
    return jnp.stack(rates, axis=1).reshape(u.shape)


def mean_diffusivities(spreads: Spreads, u: Float[Array, "V *S"]) -> Float[Array, "*S"]:
    """One diffusivity per species, averaged if it varies over the surface."""
    means = [d.mean_diffusion if isinstance(d, EllipticStencil) else jnp.mean(d) for d in of_each(spreads, u)]
    return jnp.stack([mean.astype(u.dtype) for mean in means]).reshape(u.shape[1:])


def spread_bound(
    surface: Surface, spreads: Spreads, conditions: Conditions, t: Float[Array, ""], u: Float[Array, "V *S"]
) -> Float[Array, ""]:
    """A bound of the magnitudes of the eigenvalues of `spread_rate`."""

    def bound(spread: Spread) -> Array:
        interior = spread.spectral_bound() if isinstance(spread, EllipticStencil) else _largest(spread) * laplacian
        return interior.astype(u.dtype) + bounds.stiffness(surface, conditions, t, u, _flux_weights(surface, spread))

    laplacian = spectral_bound(surface)
    if are_numbers(spreads, u):
        stiffness = bounds.stiffness(surface, conditions, t, u)
        return _largest(jnp.asarray(spreads, u.dtype)) * (laplacian + stiffness)
    return _maximum(bound, of_each(spreads, u))


def spread_width(surface: Surface, spreads: Spreads, u: Float[Array, "V *S"]) -> Float[Array, ""]:
    """The extent of the eigenvalues of `spread_rate` off the real axis, as in `ltl.operators.spectral_width`."""

    def width(spread: Spread) -> Array:
        is_stencil = isinstance(spread, EllipticStencil)
        return (spread.spectral_width() if is_stencil else _largest(spread) * laplacian_width).astype(u.dtype)

    laplacian_width = spectral_width(surface)
    return _maximum(width, of_each(spreads, u))


def _species_rate(surface: Surface, spread: Spread, u: Float[Array, " V"]) -> Float[Array, " V"]:
    if isinstance(spread, EllipticStencil):
        return spread(u)
    diffusivity = jnp.broadcast_to(spread.astype(u.dtype), u.shape)
    return weighted_laplacian(surface, diffusivity, u, surface.laplacian_stencil.means[-1])


def _flux_weights(surface: Surface, spread: Spread) -> Float[Array, "B 2"] | None:
    """The rate at a boundary vertex caused by a unit flux through each of its two sides."""
    if isinstance(spread, EllipticStencil):
        return spread.flux_weights
    weights = surface.geometry.flux_weights
    at_boundary = jnp.broadcast_to(spread, (surface.num_vertices,))[surface.topology.boundary]
    return None if weights is None else at_boundary.astype(weights.dtype)[:, None] * weights


def _largest(numbers: Array) -> Array:
    return jnp.max(jnp.abs(numbers))


def _maximum(function: Callable[[Spread], Array], each: tuple[Spread, ...]) -> Array:
    """The largest value of a function over all species."""
    return jnp.max(jnp.stack([function(spread) for spread in each]))
