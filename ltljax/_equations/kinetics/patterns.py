"""Reactions that form stationary patterns when one species diffuses faster than another (Turing 1952).

Each function returns `Kinetics` for `ReactionDiffusion`. Species that start non-negative stay non-negative, unless the
docstring says otherwise: at zero their rate is not negative, and diffusion with `Monotone` does not lower the minimum.
"""

import jax.numpy as jnp
from jaxtyping import Array

from .kinetics import Kinetics, with_params

Number = float | Array


def turing(rate: Number = 10.0, feed: Number = 16.0, decay: Number = 12.0, floor: Number = 0.05) -> Kinetics:
    """du/dt = s (alpha - u v), dv/dt = s (u v - v - beta): Turing's system in Turk's form, with v kept from negative.

    As published v can turn negative, and then both species overflow. Here the sink beta acts in full where v is at
    least ``floor``, fades linearly below, and a negative v is no reagent and returns to zero: v stays non-negative and
    the rates stay Lipschitz.

    Steady state: u = alpha / (alpha - beta), v = alpha - beta; (4, 4) for the defaults, where patterns form when
    the diffusivity of u is more than 4 times that of v. On the unit sphere diffusivities (0.8, 0.1) give some forty
    spots.

    Args:
        rate: s, speed of the reaction.
        feed: alpha, the inflow of u.
        decay: beta, the sink of v; random variation over the vertices seeds the pattern.
        floor: v below which the sink fades.

    Source: Turk (1991), doi:10.1145/127719.122749; Chen, Chi and Wu, arXiv 0907.1817, section 4, print
    s (u1 u2 - u2 - gamma) for the second rate.
    """
    return with_params(_turing, ("u", "v"), _turing_at_rest, rate=rate, feed=feed, decay=decay, floor=floor)


def _turing(species, p):
    u, v = species
    present = jnp.maximum(v, 0)
    sink = p["decay"] * jnp.clip(v / p["floor"], 0, 1)
    return p["rate"] * (p["feed"] - u * present), p["rate"] * (u * present - v - sink)


def _turing_at_rest(p):
    v = p["feed"] - p["decay"]
    return p["feed"] / v, v


def gray_scott(feed: Number = 0.04, kill: Number = 0.06) -> Kinetics:
    """du/dt = -u v^2 + F (1 - u), dv/dt = u v^2 - (F + k) v: autocatalysis fed from a reservoir (Gray and Scott 1984).

    The steady state (1, 0) is stable, so a pattern needs a finite perturbation: spots that divide, stripes or waves.
    Diffusivities of (2e-5, 1e-5) suit a unit square, or a unit sphere with many spots.

    Args:
        feed: F, inflow rate of u.
        kill: k, removal rate of v beyond the outflow.

    Source: Pearson (1993), doi:10.1126/science.261.5118.189.
    """
    return with_params(_gray_scott, ("u", "v"), lambda p: (1 + 0 * p["feed"], 0 * p["feed"]), feed=feed, kill=kill)


def _gray_scott(species, p):
    u, v = species
    reaction = u * v**2
    return -reaction + p["feed"] * (1 - u), reaction - (p["feed"] + p["kill"]) * v


def schnakenberg(a: Number = 0.1, b: Number = 0.9, rate: Number = 100.0) -> Kinetics:
    """du/dt = gamma (a - u + u^2 v), dv/dt = gamma (b - u^2 v): an activator that depletes its substrate.

    Steady state: u = a + b, v = b / (a + b)^2. For (a, b) = (.1, .9) patterns form when v diffuses more than 8.6 times
    as fast as u. With diffusivities (1, 10) their wavelength is about 2 pi / sqrt(0.3 gamma).

    Args:
        a: inflow of u.
        b: inflow of v.
        rate: gamma, the speed of the reaction; larger values make finer patterns.

    Source: Schnakenberg (1979), doi:10.1016/0022-5193(79)90042-0.
    """
    return with_params(_schnakenberg, ("u", "v"), _schnakenberg_at_rest, a=a, b=b, rate=rate)


def _schnakenberg(species, p):
    u, v = species
    reaction = u**2 * v
    return p["rate"] * (p["a"] - u + reaction), p["rate"] * (p["b"] - reaction)


def _schnakenberg_at_rest(p):
    u = p["a"] + p["b"]
    return u, p["b"] / u**2


def brusselator(a: Number = 3.0, b: Number = 10.2) -> Kinetics:
    """du/dt = a - (b + 1) u + u^2 v, dv/dt = b u - u^2 v: the Brusselator.

    Steady state: u = a, v = b / a. It oscillates if b > 1 + a^2. Below that, spots, stripes and holes form if u
    diffuses slowly enough. The ratio of the diffusivities selects the pattern: for (a, b) = (3, 10.2) and 10 / S for v,
    u gives stripes with 3.8 / S, spots with 2.5 / S and holes with 5 / S.

    Args:
        a: inflow of u.
        b: conversion rate of u to v.

    Source: Prigogine and Lefever (1968), doi:10.1063/1.1668896.
    """
    return with_params(_brusselator, ("u", "v"), lambda p: (p["a"], p["b"] / p["a"]), a=a, b=b)


def _brusselator(species, p):
    u, v = species
    reaction = u**2 * v
    return p["a"] - (p["b"] + 1) * u + reaction, p["b"] * u - reaction


def barrio(
    alpha: Number = 0.899, beta: Number = -0.91, gamma: Number = -0.899, cubic: Number = 0.02, quadratic: Number = 0.2
) -> Kinetics:
    """du/dt = alpha u (1 - r1 v^2) + v (1 - r2 u), dv/dt = beta v (1 + (alpha r1 / beta) u v) + u (gamma + r2 v).

    In the model of Barrio, Varea, Aragon and Maini, the balance of quadratic and cubic terms selects spots or stripes.
    Steady state: (0, 0); u and v are deviations from it, of either sign. Spots: diffusivities 0.516 D and D with
    D = 0.0045 on the unit sphere, cubic 0.02, quadratic 0.2. Stripes: D = 0.0021, cubic 3.5, quadratic 0; they take
    twenty times as long.

    Args:
        alpha: growth of u.
        beta: decay of v.
        gamma: inhibition of v by u; if gamma = -alpha, (0, 0) is the only uniform steady state.
        cubic: r1, coefficient of the cubic terms.
        quadratic: r2, coefficient of the quadratic terms.

    Source: Barrio, Varea, Aragon and Maini (1999), doi:10.1006/bulm.1998.0093, equation 5.
    """
    return with_params(
        _barrio,
        ("u", "v"),
        lambda p: (0 * p["alpha"], 0 * p["alpha"]),
        alpha=alpha,
        beta=beta,
        gamma=gamma,
        cubic=cubic,
        quadratic=quadratic,
    )


def _barrio(species, p):
    u, v = species
    # This form of beta v (1 + (alpha r1 / beta) u v) allows beta = 0.
    du = p["alpha"] * u * (1 - p["cubic"] * v**2) + v * (1 - p["quadratic"] * u)
    dv = p["beta"] * v + p["alpha"] * p["cubic"] * u * v**2 + u * (p["gamma"] + p["quadratic"] * v)
    return du, dv


def gierer_meinhardt(
    decay: Number = 1.0, inhibitor_decay: Number = 1.0, source: Number = 0.0, floor: Number = 1e-3
) -> Kinetics:
    """du/dt = u^2 / v - mu u + sigma, dv/dt = u^2 - nu v: an activator and its inhibitor.

    Steady state: u = (nu + sigma) / mu, v = u^2 / nu. Spots form if v diffuses much faster than u, for example with
    diffusivities (4e-3, 4e-2) on the unit sphere. The quotient uses max(v, floor), which keeps the rate finite.

    Args:
        decay: mu, decay rate of the activator u.
        inhibitor_decay: nu, decay rate of the inhibitor v.
        source: sigma, basic production of u; without it u can die out.
        floor: smallest v in the quotient.

    Source: Gierer and Meinhardt (1972), doi:10.1007/BF00289234.
    """
    return with_params(
        _gierer_meinhardt,
        ("u", "v"),
        _gierer_meinhardt_at_rest,
        decay=decay,
        inhibitor_decay=inhibitor_decay,
        source=source,
        floor=floor,
    )


def _gierer_meinhardt(species, p):
    u, v = species
    du = u**2 / jnp.maximum(v, p["floor"]) - p["decay"] * u + p["source"]
    return du, u**2 - p["inhibitor_decay"] * v


def _gierer_meinhardt_at_rest(p):
    u = (p["inhibitor_decay"] + p["source"]) / p["decay"]
    return u, u**2 / p["inhibitor_decay"]


def meinhardt(
    production: Number = 0.04, decay: Number = 0.06, inhibitor_decay: Number = 0.06, relay: Number = 0.04,
    source: Number = 0.01, floor: Number = 1e-3,
) -> Kinetics:  # fmt: skip
    """Five species that form stripes: two activators that exclude each other locally and support each other nearby.

    dg/dt = c q g^2 / r - a g + s
    dh/dt = c p h^2 / r - a h + s
    dr/dt = c q g^2 + c p h^2 - b r
    dp/dt = k (g - p)
    dq/dt = k (h - q)

    The two activators g and h share the repressor r, so one of them wins at each point. Their support spreads through p
    and q, so each needs the other nearby, which makes stripes. Diffusivities: small for g, h and r, and about twenty
    times larger for p and q, such as (.009, .009, 0, .2, .2) on a grid of unit spacing; scale all of them for a
    surface. Steady state: g = h = p = q = (b / 2 + s) / a, r = 2 c g^3 / b. The quotients use max(r, floor).

    Args:
        production: c, production rate of the activators.
        decay: a, decay rate of the activators; random variation over the vertices seeds the pattern.
        inhibitor_decay: b, decay rate of the repressor.
        relay: k, rate at which p and q follow g and h.
        source: s, basic production of the activators; without it a species does not come back after it has vanished,
            and both may die out.
        floor: smallest r in the quotients.

    Source: Meinhardt (1982), Models of Biological Pattern Formation, section 12; Turk (1991),
    doi:10.1145/127719.122749, appendix.
    """
    return with_params(
        _meinhardt,
        ("g", "h", "r", "p", "q"),
        _meinhardt_at_rest,
        production=production,
        decay=decay,
        inhibitor_decay=inhibitor_decay,
        relay=relay,
        source=source,
        floor=floor,
    )


def _meinhardt(species, k):
    g, h, r, p, q = species
    made_g, made_h = k["production"] * q * g**2, k["production"] * p * h**2
    repressor = jnp.maximum(r, k["floor"])
    return (
        made_g / repressor - k["decay"] * g + k["source"],
        made_h / repressor - k["decay"] * h + k["source"],
        made_g + made_h - k["inhibitor_decay"] * r,
        k["relay"] * (g - p),
        k["relay"] * (h - q),
    )


def _meinhardt_at_rest(k):
    g = (k["inhibitor_decay"] / 2 + k["source"]) / k["decay"]
    return g, g, 2 * k["production"] * g**3 / k["inhibitor_decay"], g, g
