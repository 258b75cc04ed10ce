"""Triangle meshes, from a file, from arrays or from a built-in shape.

A `Mesh` is checked when it is built, so every error that a mesh can cause is raised here. The package also provides the
mesh report and the index arrays of the topology. It runs on the host only.
"""

from . import shapes
from .errors import MeshError
from .files import load_mesh
from .mesh import Mesh
from .objects import as_mesh, vertex_data
from .report import MeshReport, corner_angles, far_middle, vertex_normals
from .topology import OneRings, half_edges, k_ring, one_rings, shared_edges

__all__ = [
    "Mesh",
    "MeshError",
    "MeshReport",
    "OneRings",
    "as_mesh",
    "corner_angles",
    "far_middle",
    "half_edges",
    "k_ring",
    "load_mesh",
    "one_rings",
    "shapes",
    "shared_edges",
    "vertex_data",
    "vertex_normals",
]
