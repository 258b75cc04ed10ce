"""Reactions: how species change one another at a point, ``((u, v), params) -> (du, dv)``."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Rates = Callable[[tuple[Array, ...], Any], tuple[Array, ...]]


class Kinetics(eqx.Module):
    """A reaction with its parameters.

    Attributes:
        rates: ``(species, params) -> rates of change``, written for one point.
        params: a pytree of scalars, or of fields (V,) over the surface.
    """

    rates: Rates = eqx.field(static=True)
    params: Any = None

    def __call__(self, u: Float[Array, "V S"]) -> Float[Array, "V S"]:
        """The rates of change of all species at every vertex."""
        return _together(self.rates, u, self.params)


# In reverse mode only u is kept for every evaluation, and not each product the rates are made of.
@functools.partial(jax.checkpoint, prevent_cse=False, static_argnums=0)
def _together(rates: Rates, u: Array, params: Any) -> Array:
    return jnp.stack(rates(tuple(u[:, s] for s in range(u.shape[1])), params), axis=1)


def turk(
    rate: float | Array = 10.0, feed: float | Array = 16.0, decay: float | Array = 12.0, floor: float = 0.05
) -> Kinetics:
    """du/dt = s (alpha - u v), dv/dt = s (u v - v - beta): Turing's system in Turk's form, with v kept from negative.

    As published v can turn negative, and then both species overflow. Here the sink beta acts in full where v is at
    least ``floor``, fades linearly below, and a negative v is no reagent and returns to zero: v stays non-negative and
    the rates stay Lipschitz.

    Steady state: u = (alpha) / (alpha - beta), v = alpha - beta; (4, 4) for the defaults, where patterns form when
    the diffusivity of u is more than 4 times that of v.

    Args:
        rate: s, speed of the reaction.
        feed: alpha, the inflow of u.
        decay: beta, the sink of v; random variation over the vertices seeds the pattern.
        floor: v below which the sink fades.

    Source: Turk (1991), doi:10.1145/127719.122749; Chen, Chi and Wu, arXiv 0907.1817, section 4, print
    s (u1 u2 - u2 - gamma) for the second rate.
    """
    return Kinetics(
        _turk, dict(rate=jnp.asarray(rate), feed=jnp.asarray(feed), decay=jnp.asarray(decay), floor=jnp.asarray(floor))
    )


def _turk(species, p):
    u, v = species
    present = jnp.maximum(v, 0)
    sink = p["decay"] * jnp.clip(v / p["floor"], 0, 1)
    return p["rate"] * (p["feed"] - u * present), p["rate"] * (u * present - v - sink)


def gray_scott(feed: float | Array = 0.04, kill: float | Array = 0.06) -> Kinetics:
    """du/dt = -u v^2 + F (1 - u), dv/dt = u v^2 - (F + k) v: autocatalysis fed from a reservoir (Gray and Scott 1984).

    The state (1, 0) is steady and stable; a finite push starts a pattern. Both species stay non-negative.

    Args:
        feed: F, the rate at which u flows in.
        kill: k, the rate at which v is removed beyond the outflow.

    Source: Pearson (1993), doi:10.1126/science.261.5118.189.
    """
    return Kinetics(_gray_scott, dict(feed=jnp.asarray(feed), kill=jnp.asarray(kill)))


def _gray_scott(species, p):
    u, v = species
    reaction = u * v**2
    return -reaction + p["feed"] * (1 - u), reaction - (p["feed"] + p["kill"]) * v
