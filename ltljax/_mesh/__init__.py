"""Meshes: a file or arrays become a checked surface.

What enters: a mesh file, arrays, or the sizes of a built-in shape. What leaves: a `Mesh`, its report, and the index
arrays of its topology. Every error that a mesh can cause is raised here. Nothing in this room runs on a device.
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
