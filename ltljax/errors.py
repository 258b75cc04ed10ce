"""The exceptions and warnings of ltljax, to catch or filter by name."""

from ._base.owned_folder import OutputError
from ._fit import FitError
from ._mesh import MeshError
from ._solve.evolve import GrowingModesWarning
from ._solve.poisson_equation import IncompatibleSourceWarning
from ._solve.restart import RestartError
from ._solve.solution import SolveError
from ._surface import CoarseMeshWarning, FarFromOriginWarning, InconsistentRowsWarning

__all__ = [
    "CoarseMeshWarning",
    "FarFromOriginWarning",
    "FitError",
    "GrowingModesWarning",
    "IncompatibleSourceWarning",
    "InconsistentRowsWarning",
    "MeshError",
    "OutputError",
    "RestartError",
    "SolveError",
]


def __dir__() -> list[str]:
    return sorted(__all__)
