"""How it is solved: time stepping through diffrax, the steppers diffrax lacks, linear systems and multigrid."""

from .evolve import GrowingModesWarning, Solution, SolveError, Steady, solve
from .implicit import SBDF2, TRBDF2, BackwardEuler, CrankNicolson
from .multigrid import Multigrid, multigrid
from .stabilised import RKC2, RKL1

__all__ = [
    "RKC2",
    "RKL1",
    "SBDF2",
    "TRBDF2",
    "BackwardEuler",
    "CrankNicolson",
    "GrowingModesWarning",
    "Multigrid",
    "Solution",
    "SolveError",
    "Steady",
    "multigrid",
    "solve",
]
