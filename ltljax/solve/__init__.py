"""How it is solved: time stepping through diffrax, the steppers diffrax lacks, linear systems,
multigrid, eigenmodes, and what linear theory says before a run."""

from .direct import Factorized, factorized
from .distance import geodesic_distance
from .evolve import GrowingModesWarning, Solution, SolveError, Steady, solve
from .implicit import SBDF2, TRBDF2, BackwardEuler, CrankNicolson
from .modes import Eigenmodes, eigenmodes
from .multigrid import Multigrid, multigrid
from .restart import RestartError
from .stabilised import RKL1, RKL2
from .stability import Dispersion, Explanation, dispersion, explain
from .stationary import IncompatibleSourceWarning, poisson, screened_poisson, steady_state

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
    "GrowingModesWarning",
    "IncompatibleSourceWarning",
    "Multigrid",
    "RestartError",
    "Solution",
    "SolveError",
    "Steady",
    "dispersion",
    "eigenmodes",
    "explain",
    "factorized",
    "geodesic_distance",
    "multigrid",
    "poisson",
    "screened_poisson",
    "solve",
    "steady_state",
]
