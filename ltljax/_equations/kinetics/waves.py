"""Reactions that form fronts, waves, spirals and coarsening domains.

Each function returns `Kinetics` for `ReactionDiffusion`. Species stay non-negative only where the docstring says so.
"""

import jax.numpy as jnp
from jaxtyping import Array

from .kinetics import Kinetics, with_params

Number = float | Array


def barkley(a: Number = 0.75, b: Number = 0.02, epsilon: Number = 0.02) -> Kinetics:
    """du/dt = u (1 - u) (u - (v + b) / a) / eps, dv/dt = u - v: an excitable medium, a cheap FitzHugh-Nagumo model.

    The steady state (0, 0) is stable. A perturbation beyond the threshold u = b / a starts a wave, and a broken wave
    curls into spirals: for example from u = (1 + tanh(2 x + y)) / 2, v = (1 - tanh(3 z)) / 2 on the unit sphere with
    diffusivities (.03, 0). If u and v start between 0 and 1, they stay there.

    Args:
        a: larger values make waves longer.
        b: larger values raise the threshold.
        epsilon: time scale of u relative to v; small values make u fast.

    Source: Barkley (1991), doi:10.1016/0167-2789(91)90194-E.
    """
    return with_params(_barkley, ("u", "v"), lambda p: (0 * p["a"], 0 * p["a"]), a=a, b=b, epsilon=epsilon)


def _barkley(species, p):
    u, v = species
    return u * (1 - u) * (u - (v + p["b"]) / p["a"]) / p["epsilon"], u - v


def fitzhugh_nagumo(epsilon: Number = 10.0, slope: Number = 0.9, offset: Number = 0.0) -> Kinetics:
    """du/dt = u - u^3 - v, dv/dt = eps (u - a v - c): a nerve pulse, reduced to two species of either sign.

    The steady state is unique if a < 1, and is (0, 0) if c = 0. Labyrinths of stripes form if v diffuses more than
    eps (1 + sqrt(1 - a))^2 times as fast as u (17 for the defaults), for example with diffusivities (3e-4, 3e-2) on a
    square. A nonzero c turns them into spots. With a small eps the medium is excitable or oscillates.

    Args:
        epsilon: speed of v relative to u.
        slope: a, below one.
        offset: c, offset of the line on which dv/dt vanishes.

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
    """du/dt = r (u - u^3): two phases, -1 and 1, that separate into domains, which coarsen by curvature.

    With diffusivity D, a front is sqrt(2 D / r) wide and moves with D times its geodesic curvature. If u starts in
    [-1, 1], it stays there. The steady state (0) is unstable. The state is (V, 1).

    Args:
        rate: r, speed of the reaction.

    Source: Allen and Cahn (1979), doi:10.1016/0001-6160(79)90196-2.
    """
    return with_params(_allen_cahn, ("u",), lambda p: (0 * p["rate"],), rate=rate)


def _allen_cahn(species, p):
    (u,) = species
    return (p["rate"] * (u - u**3),)


def ginzburg_landau(imaginary: Number = 1.5, growth: Number = 1.0) -> Kinetics:
    """dw/dt = mu w - (1 + i b) w |w|^2 for w = u + i v: oscillations that organise into spirals.

    The steady state (0, 0) is unstable, and w = sqrt(mu) exp(-i b mu t) is the uniform oscillation. Use equal
    diffusivities, such as (1e-3, 1e-3) on the unit sphere, and start from small noise. u and v have either sign.

    Args:
        imaginary: b, decrease of the frequency with the squared amplitude.
        growth: mu, growth rate of small oscillations.

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
    """du/dt = r u (1 - u / K): a population that grows and spreads, with fronts that move at 2 sqrt(D r).

    The steady state K is stable, and 0 is unstable. If u starts in [0, K], it stays there. The state is (V, 1).

    Args:
        rate: r, growth rate.
        capacity: K, carrying capacity.

    Source: Fisher (1937), doi:10.1111/j.1469-1809.1937.tb02153.x; Kolmogorov, Petrovsky and Piskunov (1937).
    """
    return with_params(_fisher_kpp, ("u",), lambda p: (p["capacity"],), rate=rate, capacity=capacity)


def _fisher_kpp(species, p):
    (u,) = species
    return (p["rate"] * u * (1 - u / p["capacity"]),)


def lotka_volterra(
    growth: Number = 1.0, predation: Number = 1.0, death: Number = 1.0, conversion: Number = 1.0
) -> Kinetics:
    """du/dt = u (a - b v), dv/dt = v (d u - c): prey and predators, whose populations oscillate.

    The steady state u = c / d, v = a / b is a centre: every orbit at a point is closed, and diffusion synchronises the
    points. Both species stay non-negative.

    Args:
        growth: a, growth rate of the prey u.
        predation: b, rate of predation.
        death: c, death rate of the predators v.
        conversion: d, conversion rate of prey into predators.

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
