"""How it is solved: time stepping through diffrax, the steppers diffrax lacks, linear systems,
multigrid, eigenmodes, and what linear theory says before a run."""

from .direct import Factorized, factorized
from .distance import geodesic_distance
from .evolve import GrowingModesWarning, solve
from .hodge import HarmonicFields, HodgeParts, harmonic_fields, helmholtz_hodge
from .implicit import SBDF2, TRBDF2, BackwardEuler, CrankNicolson
from .modes import Eigenmodes, eigenmodes
from .multigrid import Multigrid, multigrid
from .poisson_equation import IncompatibleSourceWarning, poisson, screened_poisson
from .restart import Checkpoints, RestartError
from .solution import Solution, SolveError, Steady
from .stabilised import RKL1, RKL2
from .stability import Dispersion, Explanation, dispersion, explain
from .stationary import steady_state
from .stepping import Adaptive, Fixed
from .vector_heat import connection_matrix, direction_field, transport_vectors

__all__ = [
    "RKL1",
    "RKL2",
    "SBDF2",
    "TRBDF2",
    "Adaptive",
    "BackwardEuler",
    "Checkpoints",
    "CrankNicolson",
    "Dispersion",
    "Eigenmodes",
    "Explanation",
    "Factorized",
    "Fixed",
    "GrowingModesWarning",
    "HarmonicFields",
    "HodgeParts",
    "IncompatibleSourceWarning",
    "Multigrid",
    "RestartError",
    "Solution",
    "SolveError",
    "Steady",
    "connection_matrix",
    "direction_field",
    "dispersion",
    "eigenmodes",
    "explain",
    "factorized",
    "geodesic_distance",
    "harmonic_fields",
    "helmholtz_hodge",
    "multigrid",
    "poisson",
    "screened_poisson",
    "solve",
    "steady_state",
    "transport_vectors",
]
