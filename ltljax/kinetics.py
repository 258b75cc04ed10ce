"""Reaction kinetics: how species change each other at a point, ``((u, v), params) -> (du, dv)``.

Patterns: `turing`, `gray_scott`, `schnakenberg`, `brusselator`, `barrio`, `gierer_meinhardt`, `meinhardt`. Fronts,
waves and spirals: `barkley`, `fitzhugh_nagumo`, `allen_cahn`, `ginzburg_landau`, `fisher_kpp`, `lotka_volterra`.
"""

from ._base.deprecated import deprecated_alias
from ._equations.kinetics import (
    Kinetics,
    allen_cahn,
    barkley,
    barrio,
    brusselator,
    fisher_kpp,
    fitzhugh_nagumo,
    gierer_meinhardt,
    ginzburg_landau,
    gray_scott,
    lotka_volterra,
    meinhardt,
    schnakenberg,
    turing,
)

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


# Turing's system by its name in version 0.1.
turk = deprecated_alias("ltljax.kinetics.turk", turing)


def __dir__() -> list[str]:
    return sorted(__all__)
