"""Time steppers, linear solvers and preconditioners, stationary problems, spectra, and linear stability."""

from ._show import plot_dispersion
from ._solve import (
    RKL1,
    RKL2,
    SBDF2,
    TRBDF2,
    BackwardEuler,
    CrankNicolson,
    Dispersion,
    Eigenmodes,
    Explanation,
    Factorized,
    Multigrid,
    Solution,
    Steady,
    dispersion,
    eigenmodes,
    explain,
    factorized,
    geodesic_distance,
    multigrid,
    poisson,
    screened_poisson,
    solve,
    steady_state,
)

__all__ = [
    "RKL1",
    "RKL2",
    "SBDF2",
    "TRBDF2",
    "BackwardEuler",
    "CrankNicolson",
    "Dispersion",
    "Eigenmodes",
    "Explanation",
    "Factorized",
    "Multigrid",
    "Solution",
    "Steady",
    "dispersion",
    "eigenmodes",
    "explain",
    "factorized",
    "geodesic_distance",
    "multigrid",
    "plot_dispersion",
    "poisson",
    "screened_poisson",
    "solve",
    "steady_state",
]


def __dir__() -> list[str]:
    return sorted(__all__)
