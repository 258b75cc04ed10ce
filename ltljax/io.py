"""Meshes and fields to and from files and the objects of other packages."""

from ._mesh import as_mesh, load_mesh, vertex_data
from ._output.colors import COLORMAPS
from ._output.load import load_fields
from ._output.save import save

__all__ = [
    "COLORMAPS",
    "as_mesh",
    "load_fields",
    "load_mesh",
    "save",
    "vertex_data",
]


def __dir__() -> list[str]:
    return sorted(__all__)
