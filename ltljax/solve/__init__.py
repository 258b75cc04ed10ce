"""How it is solved: time stepping through diffrax, and the steppers diffrax lacks."""

from .chebyshev import RKC2
from .evolve import GrowingModesWarning, Solution, SolveError, solve

__all__ = ["RKC2", "GrowingModesWarning", "Solution", "SolveError", "solve"]
