"""The readers of the file formats: each takes the path of an existing file and returns unchecked `Polygons`.

A reader raises a `MeshError` if it knows what is wrong. `files` turns all other exceptions into one.
"""

import importlib.util
import io
import json
import logging
import os
import signal
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from . import package_readers
from .errors import MeshError, UnreadableError
from .ply import parse_ply
from .polygons import triangulated
from .text_formats import Polygons, next_rows, parse_obj, parse_off, parse_stl, separate_triangles

# Limits on the memory (bytes) and computing time (seconds) of a reader of another package.
_MEMORY, _MEMORY_PER_BYTE = 3e9, 100
_SECONDS, _SECONDS_PER_BYTE = 15, 1e-6
# Largest ratio of the elapsed time, which includes waiting for the disk, to the computing time.
_PATIENCE = 4

# trimesh logs problems of damaged files. Without a handler, they would be printed.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


def read_obj(path: Path) -> Polygons:
    """The geometry of a Wavefront OBJ file."""
    return parse_obj(path.read_bytes())


def read_off(path: Path) -> Polygons:
    """The geometry of an OFF file."""
    return parse_off(path.read_bytes())


def read_ply(path: Path) -> Polygons:
    """The geometry of a PLY file, text or binary."""
    return parse_ply(path.read_bytes())


def read_stl(path: Path) -> Polygons:
    """The geometry of an STL file, text or binary; every triangle has its own three vertices."""
    data = path.read_bytes()
    announced = struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else 0
    # Binary files too may begin with "solid", so the length decides.
    if len(data) == 84 + 50 * announced:
        record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        return separate_triangles(np.frombuffer(data, record, offset=84)["corners"])
    if b"facet" in data[:2000].lower():
        return parse_stl(data)
    raise MeshError(
        f"the file announces {announced} triangles, which take {84 + 50 * announced} bytes, but has {len(data)}. "
        "It may be truncated: export or download it again."
    )


def read_glb(path: Path) -> Polygons:
    """The geometry of a binary glTF file."""
    from trimesh.exchange.gltf import load_glb

    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    _check_gltf(json.loads(data[20 : 20 + length].decode("utf-8")), path)
    return _scene(load_glb(io.BytesIO(data), resolver=_resolver(path), skip_materials=True))


def read_gltf(path: Path) -> Polygons:
    """The geometry of a text glTF file, with its buffers inside or beside it."""
    from trimesh.exchange.gltf import load_gltf

    header = json.loads(path.read_bytes().decode("utf-8"))
    _check_gltf(header, path)
    for buffer in header.get("buffers", []):
        # The names of files are URL-encoded.
        if not buffer["uri"].startswith("data:"):
            buffer["uri"] = unquote(buffer["uri"])
    checked = io.BytesIO(json.dumps(header).encode())
    return _scene(load_gltf(checked, resolver=_resolver(path), skip_materials=True))


def read_freesurfer_text(path: Path) -> Polygons:
    """The geometry of a text FreeSurfer surface (``.asc``)."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    words = [row for line in lines if (row := line.partition("#")[0].split())]
    num_vertices, num_faces = int(words[0][0]), int(words[0][1])
    points = np.array([row[:3] for row in next_rows(words, 1, num_vertices, "vertices")], np.float64)
    faces = next_rows(words, 1 + num_vertices, num_faces, "faces")
    return Polygons(points.reshape(-1, 3), np.array([row[:3] for row in faces], np.int64).reshape(-1, 3))


def read_elsewhere(reader: str, path: Path) -> dict[str, np.ndarray]:
    """The arrays by name that a reader of another package returns for a file.

    The reader runs in a process of its own, with limits on its memory and time; see `package_readers`.

    Args:
        reader: a key of `package_readers.PACKAGE_READERS`.
        path: the file.

    Raises:
        MeshError: the package is not installed, it does not accept the file, or reading takes too long.
        UnreadableError: the file is damaged, or reading it takes too much memory.
    """
    package = package_readers.PACKAGES[reader]
    if importlib.util.find_spec(package) is None:
        extra = "viz" if package == "pyvista" else "io"
        raise MeshError(f'reading this kind of file needs {package}. Run: pip install "ltljax[{extra}]"')
    size = path.stat().st_size
    memory, seconds = _MEMORY + _MEMORY_PER_BYTE * size, _SECONDS + _SECONDS_PER_BYTE * size
    # A single thread, because the libraries below NumPy reserve memory for each thread.
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "arrays.npz"
        arguments = [reader, path.absolute(), target, memory, seconds, json.dumps([*map(str, sys.path)])]
        command = [sys.executable, "-I", package_readers.__file__, *map(str, arguments)]
        try:
            process = subprocess.run(
                command, capture_output=True, timeout=_PATIENCE * seconds, check=False, env=environment
            )
        except subprocess.TimeoutExpired:
            limit = f"{_PATIENCE * seconds:.0f} s"
            raise MeshError(f"{package} did not end within {limit}. Convert the file to PLY.") from None
        report_file = target.with_suffix(".json")
        text = report_file.read_text(encoding="utf-8") if report_file.exists() else ""
        if not text:
            raise UnreadableError(_crash_reason(process, package, seconds))
        report = json.loads(text)
        if "refused" in report:
            raise MeshError(report["refused"])
        if "failed" in report:
            raise UnreadableError(report["failed"])
        with np.load(target) as arrays:
            return {name: arrays[f"array_{index}"] for index, name in enumerate(report["names"])}


def _package_reader(reader: str) -> Callable[[Path], Polygons]:
    """The function that reads a mesh with a reader of another package."""

    def read(path: Path) -> Polygons:
        arrays = read_elsewhere(reader, path)
        vertices, corners = arrays["vertices"], arrays["corners"]
        return Polygons(vertices, corners[triangulated(vertices, corners, arrays["sizes"])])

    return read


def _crash_reason(process: subprocess.CompletedProcess[bytes], package: str, seconds: float) -> str:
    """Why a process ended without a report."""
    if hasattr(signal, "SIGXCPU") and process.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        return f"{package} was stopped after {seconds:.0f} s of computing, or because it ran out of memory"
    lines = process.stderr.decode("utf-8", errors="replace").strip().splitlines()
    return f"{package} ended with code {process.returncode}" + (f": {lines[-1]}" if lines else "")


def read_legacy_vtk(path: Path) -> Polygons:
    """The geometry of a legacy VTK file. meshio does not read POLYDATA, which most of these files contain."""
    with open(path, "rb") as file:
        is_surface = b"POLYDATA" in file.read(1000)
    return _package_reader("vtk" if is_surface else "meshio")(path)


READERS: dict[str, Callable[[Path], Polygons]] = {
    "obj": read_obj,
    "ply": read_ply,
    "stl": read_stl,
    "off": read_off,
    "glb": read_glb,
    "gltf": read_gltf,
    "vtk": read_legacy_vtk,
    "vtu": _package_reader("meshio"),
    "msh": _package_reader("meshio"),
    "vtp": _package_reader("vtk"),
    "gii": _package_reader("gifti"),
    "asc": read_freesurfer_text,
    **dict.fromkeys(("pial", "white", "inflated", "orig", "smoothwm", "sphere"), _package_reader("freesurfer")),
}


def _resolver(path: Path) -> Any:
    from trimesh.resolvers import FilePathResolver

    return FilePathResolver(str(path))


def _polygons(loaded: dict[str, Any]) -> Polygons:
    """The geometry in the result of a trimesh reader, which is a mesh or several meshes by name."""
    if "geometry" in loaded:
        return _joined([_polygons(part) for part in loaded["geometry"].values()])
    faces = loaded.get("faces")
    if faces is None:
        faces = np.zeros((0, 3), np.int64)
    return Polygons(np.asarray(loaded["vertices"]), np.asarray(faces))


def _joined(parts: list[Polygons]) -> Polygons:
    """All parts as a single mesh."""
    if not parts:
        return Polygons(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    counts = np.array([len(part.vertices) for part in parts])
    faces = []
    for part, count, first in zip(parts, counts, np.cumsum(counts) - counts, strict=True):
        indices = part.faces.astype(np.int64)
        # An index out of range must stay so, and not refer to a vertex of another part.
        faces.append(np.where((indices >= 0) & (indices < count), indices + first, counts.sum()))
    return Polygons(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


def _check_gltf(header: dict[str, Any], path: Path) -> None:
    """Raise for features that trimesh reads wrongly, and for buffers that are missing or outside the file's folder."""
    for index, accessor in enumerate(header.get("accessors", [])):
        if "bufferView" not in accessor or "sparse" in accessor:
            raise MeshError(f"accessor {index} is compressed or sparse. Export the file without compression.")
    for buffer in header.get("buffers", []):
        uri = buffer.get("uri", "data:")
        if uri.startswith("data:"):
            continue
        buffer_file = (path.parent / unquote(uri)).resolve()
        if not buffer_file.is_relative_to(path.parent.resolve()):
            raise MeshError(f"the buffer {uri[:80]!r} lies outside the file's own folder. Export to GLB.")
        if not buffer_file.is_file():
            raise MeshError(f"the buffer {uri[:80]!r} is missing. Put it beside the file, or export to GLB.")


def _scene(loaded: dict[str, Any]) -> Polygons:
    """The geometry of a scene: each instance with its transform, in the order of the scene's nodes."""
    geometry = loaded["geometry"]
    nodes = {node["frame_to"]: node for node in loaded["graph"]}
    instances = [node for node in loaded["graph"] if "faces" in geometry.get(node.get("geometry"), {})]
    parts = []
    for node in instances:
        matrix, parent, depth = np.asarray(node["matrix"]), node["frame_from"], 0
        while parent in nodes:
            matrix, parent, depth = np.asarray(nodes[parent]["matrix"]) @ matrix, nodes[parent]["frame_from"], depth + 1
            if depth > len(nodes):
                raise MeshError("the scene's nodes contain each other in a cycle. Export the file again.")
        part = _polygons(geometry[node["geometry"]])
        vertices = np.asarray(part.vertices, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        # A reflection would turn the faces inside out.
        faces = part.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else part.faces
        parts.append(Polygons(vertices, faces))
    if not parts:  # a file without a scene: its meshes without transforms
        return _joined([_polygons(part) for part in geometry.values() if "faces" in part])
    return _joined(parts)
