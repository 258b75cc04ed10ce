"""Meshes, fields and pictures in files, and the meshes of other packages.

- `load_mesh` reads a mesh file, and `as_mesh` converts a mesh of trimesh, PyVista, meshio or Open3D.
- `vertex_data` converts the data on the vertices of such a mesh.
- `save` writes a mesh with fields on its vertices, and `load_fields` reads the fields back.
- `Picture` draws a field on a surface, and `COLORMAPS` contains the samples of the colour maps by name.

    mesh = ltl.io.load_mesh("spot.obj")
    ltl.io.save("height.vtp", mesh, {"height": mesh.vertices[:, 1]})
    height = ltl.io.load_fields("height.vtp")["height"]
"""

from ._mesh import as_mesh, load_mesh, vertex_data
from ._output.colors import COLORMAPS
from ._output.load import load_fields
from ._output.pictures import Picture
from ._output.save import save

__all__ = [
    "COLORMAPS",
    "Picture",
    "as_mesh",
    "load_fields",
    "load_mesh",
    "save",
    "vertex_data",
]


def __dir__() -> list[str]:
    return sorted(__all__)
