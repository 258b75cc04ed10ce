"""Conversion of the meshes of other packages.

None of these packages is imported: their objects are recognised by their attributes.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from .errors import MeshError
from .mesh import Mesh
from .package_readers import PolygonSoup, polygon_soup, polygons_of_cells
from .polygons import triangulated

_KNOWN = "a mesh of trimesh, PyVista, meshio or Open3D, a pair (vertices, faces), or a mapping with these two keys"


def as_mesh(source: Any, *, repair: bool = False, weld: bool | float = True) -> Mesh:
    """The checked mesh of another package's mesh, or of a pair (vertices, faces).

    Accepts ``trimesh.Trimesh``, ``pyvista.PolyData``, ``meshio.Mesh``, ``open3d.geometry.TriangleMesh`` and
    ``open3d.t.geometry.TriangleMesh``, and pairs of arrays as libigl, potpourri3d and geometry-central return them.
    Quadrangles and polygons are split into triangles. `vertex_data` converts data on the vertices.

    Args:
        source: the mesh, or a pair or mapping of ``vertices`` and ``faces``.
        repair: repair the mesh where possible instead of raising; see `Mesh`.
        weld: merge vertices at the same position up to rounding; see `Mesh`.

    Raises:
        MeshError: the object is none of these, or its arrays are not a surface.

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
    """The data on the vertices of another package's mesh by name, in the order of the `Mesh` made from it.

    Args:
        source: the argument of `as_mesh`; a pair of arrays has no data.
        mesh: the result of `as_mesh`.

    Raises:
        MeshError: the data do not match the mesh.

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
    for name in ("vertex_attributes", "point_data"):  # trimesh; PyVista and meshio
        fields = getattr(source, name, fields)
    arrays = {str(name): np.asarray(fields[name]) for name in fields.keys()}  # noqa: SIM118 (PyVista's is no Mapping)
    if hasattr(source, "vertex") and hasattr(source, "triangle"):  # Open3D's tensor mesh
        arrays = {str(name): source.vertex[name].numpy() for name in source.vertex if name != "positions"}
    for name, values in arrays.items():
        if len(values) != len(mesh.welded_index):
            raise MeshError(
                f"Expected {name!r} with {len(mesh.welded_index)} rows, one for each vertex of the source of the mesh, "
                f"found {len(values)}. Pass the mesh that was made from this source."
            )
    return {name: mesh.pull(values) for name, values in arrays.items()}


def _arrays(source: Any) -> tuple[Any, Any]:
    """The unchecked vertices (V, 3) and triangles (F, 3)."""
    if isinstance(source, Mapping):
        if not {"vertices", "faces"} <= source.keys():
            keys = ", ".join(map(str, source)) or "no keys"
            raise MeshError(f"Expected {_KNOWN}; found a mapping with {keys}.")
        return source["vertices"], source["faces"]
    if isinstance(source, tuple | list):
        if len(source) != 2:
            raise MeshError(f"Expected {_KNOWN}; found {len(source)} items.")
        vertices, faces = source[0], np.asanyarray(source[1])
        are_polygons = faces.ndim == 2 and faces.shape[1] > 3 and faces.dtype.kind in "iu"
        return _triangles(polygon_soup(np.asarray(vertices), faces.tolist())) if are_polygons else (vertices, faces)
    if hasattr(source, "regular_faces") and hasattr(source, "points"):
        return _triangles(_pyvista_polygons(source))
    if hasattr(source, "extract_surface"):
        raise MeshError(f"Expected a surface, found {type(source).__name__}. Call its extract_surface() first.")
    if hasattr(source, "cells") and hasattr(source, "points"):
        cells = [(block.type, block.data) for block in source.cells]
        return _triangles(polygons_of_cells(np.asarray(source.points), cells))
    if hasattr(source, "vertices") and hasattr(source, "faces"):
        return source.vertices, source.faces
    if hasattr(source, "vertices") and hasattr(source, "triangles"):
        return source.vertices, source.triangles
    if hasattr(source, "vertex") and hasattr(source, "triangle"):  # Open3D's tensor mesh
        return source.vertex["positions"].numpy(), source.triangle["indices"].numpy()
    raise MeshError(f"Expected {_KNOWN}; found {type(source).__name__}. To load a file, use load_mesh(path).")


def _pyvista_polygons(source: Any) -> PolygonSoup:
    source = source.triangulate() if source.n_strips else source
    entries = np.asarray(source.faces).tolist()  # for each polygon, the number of corners and the corners
    polygons, start = [], 0
    while start < len(entries):
        stop = start + 1 + entries[start]
        polygons.append(entries[start + 1 : stop])
        start = stop
    return polygon_soup(np.asarray(source.points), polygons)


def _triangles(soup: PolygonSoup) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and triangles (F, 3) of polygons."""
    return soup.vertices, soup.corners[triangulated(*soup)]
