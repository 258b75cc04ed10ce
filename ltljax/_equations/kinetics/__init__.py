"""Reactions: how species change each other at a point, ``((u, v), params) -> (du, dv)``.

Patterns: `turing`, `gray_scott`, `schnakenberg`, `brusselator`, `barrio`, `gierer_meinhardt`, `meinhardt`. Fronts,
waves and spirals: `barkley`, `fitzhugh_nagumo`, `allen_cahn`, `ginzburg_landau`, `fisher_kpp`, `lotka_volterra`.
"""

from .kinetics import Kinetics
from .patterns import barrio, brusselator, gierer_meinhardt, gray_scott, meinhardt, schnakenberg, turing
from .waves import allen_cahn, barkley, fisher_kpp, fitzhugh_nagumo, ginzburg_landau, lotka_volterra

__all__ = [
    "Kinetics",
    "allen_cahn",
    "barkley",
    "barrio",
    "brusselator",
    "fisher_kpp",
    "fitzhugh_nagumo",
    "gierer_meinhardt",
    "ginzburg_landau",
    "gray_scott",
    "lotka_volterra",
    "meinhardt",
    "schnakenberg",
    "turing",
]
