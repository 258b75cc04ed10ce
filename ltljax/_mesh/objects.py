"""Meshes of other packages become a `Mesh`.

What enters: an object that holds vertices and triangles. What leaves: a `Mesh`, or a `MeshError` that says what was
expected. None of these packages is imported: an object is known by its type's name and its attributes.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from .errors import MeshError
from .mesh import Mesh
from .polygons import triangulated

_KNOWN = "a mesh of trimesh, PyVista, meshio or Open3D, a pair (vertices, faces), or a mapping with these two names"


def as_mesh(source: Any, *, repair: bool = False, weld: bool | float = True) -> Mesh:
    """The checked mesh of another package's mesh, or of a pair (vertices, faces).

    Takes ``trimesh.Trimesh``, ``pyvista.PolyData``, ``meshio.Mesh``, ``open3d.geometry.TriangleMesh`` and
    ``open3d.t.geometry.TriangleMesh``, and pairs of arrays as libigl, potpourri3d and geometry-central hand them over.
    Quadrangles and polygons are split into triangles. Data on the vertices come along with `vertex_data`.

    Args:
        source: the mesh.
        repair: repair the mesh where possible instead of raising; see `Mesh`.
        weld: merge vertices at the same position, up to rounding; see `Mesh`.

    Raises:
        MeshError: the object is of another kind, or its arrays are not a surface.

    Example:
        >>> import trimesh
        >>> import ltljax as ltl
        >>> ltl.as_mesh(trimesh.creation.icosphere(subdivisions=2)).num_vertices
        162
    """
    if isinstance(source, Mesh):
        return source
    vertices, faces = _arrays(source)
    return Mesh(vertices, faces, repair=repair, weld=weld)


def vertex_data(source: Any, mesh: Mesh) -> dict[str, np.ndarray]:
    """The data on the vertices of another package's mesh, by name, in the order of a `Mesh` made from it.

    Args:
        source: what `as_mesh` was given; a pair of arrays has no data.
        mesh: what it returned.

    Raises:
        MeshError: the data do not fit the mesh.

    Example:
        >>> import trimesh
        >>> import ltljax as ltl
        >>> ball = trimesh.creation.icosphere(subdivisions=2)
        >>> ball.vertex_attributes["height"] = ball.vertices[:, 2]
        >>> mesh = ltl.as_mesh(ball)
        >>> ltl.io.vertex_data(ball, mesh)["height"].shape
        (162,)
    """
    fields: Any = {}
    for name in ("vertex_attributes", "point_data"):  # of trimesh; of PyVista and meshio
        fields = getattr(source, name, fields)
    arrays = {str(name): np.asarray(fields[name]) for name in fields.keys()}  # noqa: SIM118 (PyVista's is no Mapping)
    if hasattr(source, "vertex") and hasattr(source, "triangle"):  # the tensors of Open3D
        arrays = {str(name): source.vertex[name].numpy() for name in source.vertex if name != "positions"}
    for name, values in arrays.items():
        if len(values) != len(mesh.welded_index):
            raise MeshError(
                f"Expected {name!r} with {len(mesh.welded_index)} rows, one for each vertex that the mesh was made "
                f"from, found {len(values)}."
            )
    return {name: mesh.pull(values) for name, values in arrays.items()}


def _arrays(source: Any) -> tuple[Any, Any]:
    """Vertices (V, 3) and triangles (F, 3), not yet checked."""
    if isinstance(source, Mapping):
        if not {"vertices", "faces"} <= source.keys():
            raise MeshError(f"Expected {_KNOWN}; found one with {', '.join(map(str, source)) or 'nothing'}.")
        return source["vertices"], source["faces"]
    if isinstance(source, tuple | list):
        if len(source) != 2:
            raise MeshError(f"Expected {_KNOWN}; found {len(source)} items.")
        vertices, faces = source[0], np.asanyarray(source[1])
        is_of_quads = faces.ndim == 2 and faces.shape[1] > 3 and faces.dtype.kind in "iu"
        return _of_polygons(np.asarray(vertices), faces.tolist()) if is_of_quads else (vertices, faces)
    if hasattr(source, "regular_faces") and hasattr(source, "points"):
        return _of_pyvista(source)
    if hasattr(source, "extract_surface"):
        raise MeshError(f"Expected a surface, found {type(source).__name__}. Take source.extract_surface() first.")
    if hasattr(source, "cells") and hasattr(source, "points"):
        return _of_blocks(np.asarray(source.points), [(block.type, block.data) for block in source.cells])
    if hasattr(source, "vertices") and hasattr(source, "faces"):
        return source.vertices, source.faces
    if hasattr(source, "vertices") and hasattr(source, "triangles"):
        return source.vertices, source.triangles
    if hasattr(source, "vertex") and hasattr(source, "triangle"):  # the tensors of Open3D
        return source.vertex["positions"].numpy(), source.triangle["indices"].numpy()
    raise MeshError(f"Expected {_KNOWN}; found {type(source).__name__}. From a file: load_mesh(path).")


def _of_pyvista(source: Any) -> tuple[np.ndarray, np.ndarray]:
    source = source.triangulate() if source.n_strips else source
    points, counted = np.asarray(source.points), np.asarray(source.faces).tolist()
    polygons, place = [], 0
    while place < len(counted):  # the number of corners, and the corners
        polygons.append(counted[place + 1 : place + 1 + counted[place]])
        place += 1 + counted[place]
    return _of_polygons(points, polygons)


def _of_blocks(points: np.ndarray, blocks: list[tuple[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
    polygons = [
        list(cell)[: {"triangle": 3, "quad": 4}.get(kind.rstrip("0123456789"))]
        for kind, cells in blocks
        if kind.rstrip("0123456789") in ("triangle", "quad", "polygon")
        for cell in np.asarray(cells).tolist()
    ]
    if points.ndim == 2 and points.shape[1] == 2:
        points = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    return _of_polygons(points, polygons)


def _of_polygons(points: np.ndarray, polygons: list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([corner for polygon in polygons for corner in polygon], np.int64)
    return points, corners[triangulated(points, corners, [len(polygon) for polygon in polygons])]
