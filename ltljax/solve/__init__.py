"""How it is solved: time stepping through diffrax, and the steppers diffrax lacks."""

from .chebyshev import RKC2
from .evolve import Solution, SolveError, solve

__all__ = ["RKC2", "Solution", "SolveError", "solve"]
