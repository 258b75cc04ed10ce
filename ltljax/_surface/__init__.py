"""The surface: the pytree, and how a mesh becomes one.

What enters: a checked `Mesh` and a scheme. What leaves: a `Surface`, whose tables were chosen once on the host and
whose weights are pure functions of the positions.
"""

from .building import FarFromOriginWarning
from .decorators import on_device, on_surface
from .report import CoarseMeshWarning, InconsistentRowsWarning, SurfaceReport
from .surface import Surface

__all__ = [
    "CoarseMeshWarning",
    "FarFromOriginWarning",
    "InconsistentRowsWarning",
    "Surface",
    "SurfaceReport",
    "on_device",
    "on_surface",
]
