"""Reactions that make fronts, waves and spirals, and domains that grow.

Each is `Kinetics` for `ReactionDiffusion`. What is said of non-negative species in the patterns' room holds here where
a docstring says so.
"""

import jax.numpy as jnp
from jaxtyping import Array

from .kinetics import Kinetics, with_params

Number = float | Array


def barkley(a: Number = 0.75, b: Number = 0.02, epsilon: Number = 0.02) -> Kinetics:
    """du/dt = u (1 - u) (u - (v + b) / a) / eps, dv/dt = u - v: an excitable medium, FitzHugh-Nagumo made cheap.

    Steady state: (0, 0), stable; a push beyond the threshold u = b / a starts a wave, and a wave that is cut curls
    into spirals: from u = (1 + tanh(2 x + y)) / 2, v = (1 - tanh(3 z)) / 2 on the unit sphere, diffusivities (.03, 0).
    u stays between 0 and 1, v too, where they start so.

    Args:
        a: makes waves longer.
        b: raises the threshold.
        epsilon: how much faster u is than v.

    Source: Barkley (1991), doi:10.1016/0167-2789(91)90194-E.
    """
    return with_params(_barkley, ("u", "v"), lambda p: (0 * p["a"], 0 * p["a"]), a=a, b=b, epsilon=epsilon)


def _barkley(species, p):
    u, v = species
    return u * (1 - u) * (u - (v + p["b"]) / p["a"]) / p["epsilon"], u - v


def fitzhugh_nagumo(epsilon: Number = 10.0, slope: Number = 0.9, offset: Number = 0.0) -> Kinetics:
    """du/dt = u - u^3 - v, dv/dt = eps (u - a v - c): a nerve's pulse, reduced to two species of either sign.

    The steady state is unique where a < 1, and (0, 0) for c = 0. Labyrinths of stripes form where v diffuses more than
    eps (1 + sqrt(1 - a))^2 times as fast as u (17 for the defaults), such as with diffusivities (3e-4, 3e-2) on a
    square; c turns them into spots. With a small eps the medium is excitable or oscillates.

    Args:
        epsilon: the speed of v relative to u.
        slope: a, below one.
        offset: c.

    Source: FitzHugh (1961), doi:10.1016/S0006-3495(61)86902-6; Nagumo, Arimoto and Yoshizawa (1962),
    doi:10.1109/JRPROC.1962.288235.
    """
    return with_params(
        _fitzhugh_nagumo, ("u", "v"), _fitzhugh_nagumo_at_rest, epsilon=epsilon, slope=slope, offset=offset
    )


def _fitzhugh_nagumo(species, p):
    u, v = species
    return u - u**3 - v, p["epsilon"] * (u - p["slope"] * v - p["offset"])


def _fitzhugh_nagumo_at_rest(p):
    # The real root of u^3 + 3 s^2 u = c / a, where 3 s^2 = (1 - a) / a.
    s = jnp.sqrt((1 - p["slope"]) / (3 * p["slope"]))
    u = 2 * s * jnp.sinh(jnp.arcsinh(p["offset"] / (2 * p["slope"] * s**3)) / 3)
    return u, (u - p["offset"]) / p["slope"]


def allen_cahn(rate: Number = 1.0) -> Kinetics:
    """du/dt = r (u - u^3): two phases, -1 and 1, that separate; their domains coarsen, driven by curvature.

    With diffusivity D a front is sqrt(2 D / r) wide and moves with D times its geodesic curvature. u stays within
    [-1, 1] where it starts so. The state (0) is steady and unstable. State (V, 1).

    Args:
        rate: r.

    Source: Allen and Cahn (1979), doi:10.1016/0001-6160(79)90196-2.
    """
    return with_params(_allen_cahn, ("u",), lambda p: (0 * p["rate"],), rate=rate)


def _allen_cahn(species, p):
    (u,) = species
    return (p["rate"] * (u - u**3),)


def ginzburg_landau(imaginary: Number = 1.5, growth: Number = 1.0) -> Kinetics:
    """dw/dt = mu w - (1 + i b) w |w|^2 for w = u + i v: oscillations that order into spirals.

    The state (0, 0) is steady and unstable; w = sqrt(mu) exp(-i b mu t) is the uniform oscillation. Equal
    diffusivities, such as (1e-3, 1e-3) on the unit sphere, from small noise. Species of either sign.

    Args:
        imaginary: b, how the frequency falls with the amplitude.
        growth: mu.

    Source: Aranson and Kramer (2002), doi:10.1103/RevModPhys.74.99, equation 1 with a real diffusivity.
    """
    return with_params(
        _ginzburg_landau, ("u", "v"), lambda p: (0 * p["growth"], 0 * p["growth"]), imaginary=imaginary, growth=growth
    )


def _ginzburg_landau(species, p):
    u, v = species
    square = u**2 + v**2
    return (
        p["growth"] * u - square * (u - p["imaginary"] * v),
        p["growth"] * v - square * (v + p["imaginary"] * u),
    )


def fisher_kpp(rate: Number = 1.0, capacity: Number = 1.0) -> Kinetics:
    """du/dt = r u (1 - u / K): a population that grows and spreads; fronts move at 2 sqrt(D r).

    Steady states: K, stable, and 0, unstable. u stays within [0, K] where it starts so. State (V, 1).

    Args:
        rate: r.
        capacity: K.

    Source: Fisher (1937), doi:10.1111/j.1469-1809.1937.tb02153.x; Kolmogorov, Petrovsky and Piskunov (1937).
    """
    return with_params(_fisher_kpp, ("u",), lambda p: (p["capacity"],), rate=rate, capacity=capacity)


def _fisher_kpp(species, p):
    (u,) = species
    return (p["rate"] * u * (1 - u / p["capacity"]),)


def lotka_volterra(
    growth: Number = 1.0, predation: Number = 1.0, death: Number = 1.0, conversion: Number = 1.0
) -> Kinetics:
    """du/dt = u (a - b v), dv/dt = v (d u - c): prey and predators, whose numbers chase one another over the surface.

    Steady state: u = c / d, v = a / b, a centre: every orbit at a point is closed, and diffusion synchronises them.
    Both species stay non-negative.

    Args:
        growth: a, of the prey u.
        predation: b.
        death: c, of the predators v.
        conversion: d, of prey into predators.

    Source: Lotka (1920), doi:10.1073/pnas.6.7.410; Volterra (1926), doi:10.1038/118558a0.
    """
    return with_params(
        _lotka_volterra,
        ("u", "v"),
        lambda p: (p["death"] / p["conversion"], p["growth"] / p["predation"]),
        growth=growth,
        predation=predation,
        death=death,
        conversion=conversion,
    )


def _lotka_volterra(species, p):
    u, v = species
    return u * (p["growth"] - p["predation"] * v), v * (p["conversion"] * u - p["death"])
