"""How each file format spells vertices and faces.

What enters: the path of an existing file. What leaves: `Polygons`, unchecked. Readers may raise anything; `files` turns
it into a `MeshError`. A reader raises one itself where it knows better what is wrong.

Other packages are imported where they are used: who computes on a built-in shape need not wait for them.
"""

import importlib.util
import io
import json
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from .errors import MeshError
from .ply import parse_ply
from .text_formats import Polygons, fan, parse_obj, parse_off


def read_obj(path: Path) -> Polygons:
    """Wavefront OBJ."""
    return parse_obj(path.read_bytes())


def read_off(path: Path) -> Polygons:
    """OFF."""
    return parse_off(path.read_bytes())


def read_ply(path: Path) -> Polygons:
    """PLY, text or binary."""
    return parse_ply(path.read_bytes())


def read_stl(path: Path) -> Polygons:
    """STL, text or binary; every triangle brings its own three vertices."""
    from trimesh.exchange.stl import load_stl_ascii, load_stl_binary

    data = path.read_bytes()
    announced = struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else 0
    # Binary files may begin with "solid" like those in text, so the length decides.
    if len(data) == 84 + 50 * announced:
        return _polygons(load_stl_binary(io.BytesIO(data)))
    if b"facet" in data[:2000].lower():
        if b"endsolid" not in data[-2000:].lower():
            raise MeshError("the file ends without 'endsolid': it is truncated. Export or download it again.")
        return _polygons(load_stl_ascii(io.BytesIO(data)))
    raise MeshError(
        f"the file announces {announced} triangles, which take {84 + 50 * announced} bytes, but has {len(data)}. "
        "It may be truncated: export or download it again."
    )


def read_glb(path: Path) -> Polygons:
    """Binary glTF."""
    from trimesh.exchange.gltf import load_glb

    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    _check_gltf(json.loads(data[20 : 20 + length].decode("utf-8")), path)
    return _scene(load_glb(io.BytesIO(data), resolver=_resolver(path), skip_materials=True))


def read_gltf(path: Path) -> Polygons:
    """Text glTF, with its buffers inside or beside it."""
    from trimesh.exchange.gltf import load_gltf

    header = json.loads(path.read_bytes().decode("utf-8"))
    _check_gltf(header, path)
    for buffer in header.get("buffers", []):
        # A file beside it is named as in a web address, with %20 for a space.
        if not buffer["uri"].startswith("data:"):
            buffer["uri"] = unquote(buffer["uri"])
    checked = io.BytesIO(json.dumps(header).encode())
    return _scene(load_gltf(checked, resolver=_resolver(path), skip_materials=True))


def read_meshio(path: Path) -> Polygons:
    """VTK, VTU and Gmsh: their triangles, quadrangles and polygons; of curved elements the corners."""
    _require("meshio", "io")
    import meshio

    try:
        grid = meshio.read(path)
    except (Exception, SystemExit):
        # Surfaces in legacy VTK files are mostly of the kind POLYDATA, which meshio does not read.
        if path.suffix.lower() == ".vtk" and b"POLYDATA" in path.read_bytes()[:1000]:
            return read_vtk(path)
        raise
    corners = {"triangle": 3, "quad": 4, "polygon": 0}
    pieces = []
    for block in grid.cells:
        name = block.type.rstrip("0123456789")
        if name in corners:
            cells = [list(cell)[: corners[name] or None] for cell in np.asarray(block.data).tolist()]
            pieces.append(fan([corner for cell in cells for corner in cell], [len(cell) for cell in cells]))
    if not pieces:
        found = ", ".join(sorted({block.type for block in grid.cells})) or "nothing"
        raise MeshError(f"expected triangles, found {found}. Extract the surface first, e.g. with pyvista or Gmsh.")
    return Polygons(_in_space(np.asarray(grid.points)), np.concatenate(pieces))


# Run by a child process: reads a file and saves the arrays, or says what the file holds instead.
_READ_VTK = """
import sys, numpy, pyvista
surface = pyvista.read(sys.argv[1])
if not isinstance(surface, pyvista.PolyData):
    sys.exit(type(surface).__name__)
triangles = surface.triangulate()
numpy.savez(sys.argv[2], points=triangles.points, faces=numpy.reshape(triangles.faces, (-1, 4))[:, 1:])
"""


def read_vtk(path: Path) -> Polygons:
    """VTK surfaces (POLYDATA), text, binary or XML.

    In a process of its own: on damaged files VTK ends the process that reads them, and a notebook with it.
    """
    _require("pyvista", "viz")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "surface.npz"
        command = [sys.executable, "-c", _READ_VTK, str(path.absolute()), str(target)]
        done = subprocess.run(command, capture_output=True, timeout=600, check=False)
        if not target.exists():
            lines = done.stderr.decode("utf-8", errors="replace").strip().splitlines()
            reason = lines[-1][:200] if lines else f"the reader ended with code {done.returncode}"
            raise MeshError(
                f"expected a VTK surface (PolyData), found: {reason}. Extract the surface or export it again."
            )
        with np.load(target) as arrays:
            return Polygons(arrays["points"], arrays["faces"])


def read_gifti(path: Path) -> Polygons:
    """GIfTI surfaces, as brain atlases use them."""
    _require("nibabel", "io")
    import nibabel

    image: Any = nibabel.load(path)
    points = image.get_arrays_from_intent("NIFTI_INTENT_POINTSET")
    triangles = image.get_arrays_from_intent("NIFTI_INTENT_TRIANGLE")
    if not points or not triangles:
        raise MeshError("expected a surface, found no points or no triangles. Choose the file that holds the geometry.")
    return Polygons(np.asarray(points[0].data), np.asarray(triangles[0].data))


READERS: dict[str, Callable[[Path], Polygons]] = {
    "obj": read_obj,
    "ply": read_ply,
    "stl": read_stl,
    "off": read_off,
    "glb": read_glb,
    "gltf": read_gltf,
    "vtk": read_meshio,
    "vtu": read_meshio,
    "msh": read_meshio,
    "vtp": read_vtk,
    "gii": read_gifti,
}


def _resolver(path: Path) -> Any:
    from trimesh.resolvers import FilePathResolver

    return FilePathResolver(str(path))


def _require(module: str, extra: str) -> None:
    """Raises an error that names the extra to install, where the optional module is missing."""
    if importlib.util.find_spec(module) is None:
        raise MeshError(f'reading this kind of file needs {module}. Run: pip install "ltljax[{extra}]"')


def _in_space(points: np.ndarray) -> np.ndarray:
    """Points (V, 3), with zeros added to plane ones (V, 2)."""
    if points.ndim == 2 and points.shape[1] == 2:
        return np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    return points


def _polygons(loaded: dict[str, Any]) -> Polygons:
    """The geometry in what a trimesh reader returns: one mesh, or several by name."""
    if "geometry" in loaded:
        return _joined([_polygons(part) for part in loaded["geometry"].values()])
    faces = loaded.get("faces")
    if faces is None:
        faces = np.zeros((0, 3), np.int64)
    faces = np.asarray(faces)
    if faces.ndim == 2 and faces.shape[1] != 3:
        faces = fan(faces.ravel().tolist(), [faces.shape[1]] * len(faces))
    return Polygons(np.asarray(loaded["vertices"]), faces)


def _joined(parts: list[Polygons]) -> Polygons:
    """All parts in one numbering."""
    if not parts:
        return Polygons(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    counts = np.array([len(part.vertices) for part in parts])
    faces = []
    for part, count, shift in zip(parts, counts, np.cumsum(counts) - counts, strict=True):
        indices = part.faces.astype(np.int64)
        # An index beyond its own part must not reach into the next one.
        faces.append(np.where((indices >= 0) & (indices < count), indices + shift, counts.sum()))
    return Polygons(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


def _check_gltf(header: dict[str, Any], path: Path) -> None:
    """Refuses what would be read wrongly, or at a size that the file does not back."""
    for index, accessor in enumerate(header.get("accessors", [])):
        if "bufferView" not in accessor or "sparse" in accessor:
            raise MeshError(f"accessor {index} is compressed or sparse. Export the file without compression.")
    for buffer in header.get("buffers", []):
        uri = buffer.get("uri", "data:")
        if not uri.startswith("data:") and not (path.parent / unquote(uri)).is_file():
            raise MeshError(f"the buffer {uri[:80]!r} is missing. Put it beside the file, or export to GLB.")


def _scene(loaded: dict[str, Any]) -> Polygons:
    """The parts of a scene, each instance with its transform, in the order of the scene's nodes."""
    geometry = loaded["geometry"]
    nodes = {node["frame_to"]: node for node in loaded["graph"]}
    placed = [node for node in loaded["graph"] if "faces" in geometry.get(node.get("geometry"), {})]
    parts = []
    for node in placed:
        matrix, parent, depth = np.asarray(node["matrix"]), node["frame_from"], 0
        while parent in nodes:
            matrix, parent, depth = np.asarray(nodes[parent]["matrix"]) @ matrix, nodes[parent]["frame_from"], depth + 1
            if depth > len(nodes):
                raise MeshError("the scene's nodes contain each other in a circle. Export the file again.")
        part = _polygons(geometry[node["geometry"]])
        vertices = np.asarray(part.vertices, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        # A mirrored instance turns its faces inside out.
        faces = part.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else part.faces
        parts.append(Polygons(vertices, faces))
    if not parts:  # a file without a scene: its meshes as they are
        return _joined([_polygons(part) for part in geometry.values() if "faces" in part])
    return _joined(parts)
