"""The exceptions and warnings of ltljax."""

from ._base.folder import OutputError
from ._fit import FitError
from ._mesh import MeshError
from ._solve.evolve import GrowingModesWarning, SolveError
from ._solve.restart import RestartError
from ._solve.stationary import IncompatibleSourceWarning
from ._surface.building import CoarseMeshWarning, InconsistentRowsWarning
from ._surface.surface import FarFromOriginWarning

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
