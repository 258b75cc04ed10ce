"""A script that reads a file with another package, in a process of its own.

A damaged file can make these packages print, exit, run out of memory or never return, and a malicious file can make
them read other files. The separate process protects the calling program from this. The script imports nothing from
ltljax, because that would import JAX.

Its arguments are the name of a reader, the file, and the path of the result. The result is an NPZ file of arrays, and
beside it a JSON file with their names or the reason of a failure. A mesh gives vertices (V, 3), the corners of all
polygons, concatenated, and the number of corners of each polygon; a file of fields gives its fields.
"""

import importlib
import json
import os
import sys
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

if __name__ == "__main__":  # use the import path of the calling program
    sys.path[:] = json.loads(sys.argv[6])

import numpy as np


class Refused(Exception):
    """Raised for a readable file that is not accepted; the message says why."""


class PolygonSoup(NamedTuple):
    """Vertices (V, 3), the corners of all polygons, concatenated, and the number of corners of each polygon."""

    vertices: np.ndarray
    corners: np.ndarray
    sizes: np.ndarray


def polygons_of_cells(points: np.ndarray, cells: Iterable[tuple[str, Any]]) -> PolygonSoup:
    """The triangles, quadrangles and polygons among cells as meshio describes them.

    Curved elements are reduced to their corners, and plane points (V, 2) get a third coordinate of zero.

    Args:
        points: (V, 2) or (V, 3).
        cells: the type of each block of cells, such as ``triangle6``, and its vertex indices.
    """
    num_corners = {"triangle": 3, "quad": 4, "polygon": None}
    polygons: list[list[int]] = []
    for kind, indices in cells:
        name = kind.rstrip("0123456789")
        if name in num_corners:
            polygons += [list(cell)[: num_corners[name]] for cell in np.asarray(indices).tolist()]
    if points.ndim == 2 and points.shape[1] == 2:
        points = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    return polygon_soup(points, polygons)


def polygon_soup(points: np.ndarray, polygons: list[list[int]]) -> PolygonSoup:
    """The `PolygonSoup` of polygons that are lists of vertex indices."""
    corners = np.array([corner for polygon in polygons for corner in polygon], np.int64)
    return PolygonSoup(points, corners, np.array([len(polygon) for polygon in polygons], np.int64))


def read_meshio(path: Path) -> PolygonSoup:
    """The surface in a VTK, VTU or Gmsh file."""
    import meshio

    grid = meshio.read(path)
    surface = polygons_of_cells(np.asarray(grid.points), [(block.type, block.data) for block in grid.cells])
    if not surface.sizes.size:
        kinds = ", ".join(sorted({block.type for block in grid.cells})) or "nothing"
        raise Refused(f"expected triangles, found {kinds}. Extract the surface first, e.g. with pyvista or Gmsh.")
    return surface


def read_vtk(path: Path) -> PolygonSoup:
    """A VTK surface (POLYDATA), text, binary or XML."""
    import pyvista

    surface: Any = pyvista.read(path)
    if not isinstance(surface, pyvista.PolyData):
        kind = type(surface).__name__
        raise Refused(f"expected a VTK surface (PolyData), found {kind}. Extract the surface or export it again.")
    triangles = np.reshape(surface.triangulate().faces, (-1, 4))[:, 1:]
    return _triangle_soup(surface.points, triangles)


def read_gifti(path: Path) -> PolygonSoup:
    """A GIfTI surface with its coordinate transform applied; brain atlases use this format."""
    import nibabel

    image: Any = nibabel.load(path)
    points = image.get_arrays_from_intent("NIFTI_INTENT_POINTSET")
    triangles = image.get_arrays_from_intent("NIFTI_INTENT_TRIANGLE")
    if not points or not triangles:
        raise Refused("expected a surface, found no points or no triangles. Use the file that contains the geometry.")
    vertices = np.asarray(points[0].data, np.float64)
    if points[0].coordsys is not None:
        transform = np.asarray(points[0].coordsys.xform, np.float64)
        vertices = vertices @ transform[:3, :3].T + transform[:3, 3]
    return _triangle_soup(vertices, triangles[0].data)


def read_freesurfer(path: Path) -> PolygonSoup:
    """A binary FreeSurfer surface, such as ``lh.pial``."""
    from nibabel.freesurfer.io import read_geometry

    points, triangles = read_geometry(path)[:2]
    return _triangle_soup(points, triangles)


def read_vtk_fields(path: Path) -> dict[str, Any]:
    """The point data of a VTK file by name."""
    import pyvista

    mesh: Any = pyvista.read(path)
    if not mesh.n_points:
        raise Refused("expected fields on points, found no points. The file is damaged or empty.")
    return {str(name): np.asarray(values) for name, values in mesh.point_data.items()}


def read_gifti_fields(path: Path) -> dict[str, Any]:
    """The data arrays of a GIfTI file by name; arrays of the same name are stacked, because they form a series."""
    import nibabel
    from nibabel import nifti1

    image: Any = nibabel.load(path)
    geometry = {nifti1.intent_codes[f"NIFTI_INTENT_{name}"] for name in ("POINTSET", "TRIANGLE")}
    frames: dict[str, list[np.ndarray]] = {}
    for index, part in enumerate(image.darrays):
        if part.intent not in geometry:
            frames.setdefault(part.meta.get("Name") or f"array {index}", []).append(np.asarray(part.data))
    return {name: parts[0] if len(parts) == 1 else np.stack(parts) for name, parts in frames.items()}


def read_freesurfer_fields(path: Path) -> dict[str, Any]:
    """The values of a FreeSurfer file such as ``lh.curv``, named by its suffix."""
    from nibabel.freesurfer.io import read_morph_data

    return {path.suffix.removeprefix("."): np.asarray(read_morph_data(path), np.float64)}


PACKAGE_READERS: dict[str, Callable[[Path], Any]] = {
    "meshio": lambda path: read_meshio(path)._asdict(),
    "vtk": lambda path: read_vtk(path)._asdict(),
    "gifti": lambda path: read_gifti(path)._asdict(),
    "freesurfer": lambda path: read_freesurfer(path)._asdict(),
    "vtk fields": read_vtk_fields,
    "gifti fields": read_gifti_fields,
    "freesurfer fields": read_freesurfer_fields,
}


# The package that each reader needs.
PACKAGES = {
    "meshio": "meshio",
    "vtk": "pyvista",
    "gifti": "nibabel",
    "freesurfer": "nibabel",
    "vtk fields": "pyvista",
    "gifti fields": "nibabel",
    "freesurfer fields": "nibabel",
}


def _triangle_soup(vertices: Any, triangles: Any) -> PolygonSoup:
    corners = np.asarray(triangles, np.int64).reshape(-1, 3)
    return PolygonSoup(np.asarray(vertices, np.float64), corners.ravel(), np.full(len(corners), 3))


def _limit(memory: float, seconds: float) -> None:
    """Limit the memory and computing time of this process, if the operating system supports it."""
    try:
        import resource
    except ImportError:  # Windows
        return
    for kind, limit in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, seconds)):
        try:
            resource.setrlimit(kind, (int(limit), int(limit)))
        except (ValueError, OSError):  # a lower limit is in force, or the system has no such limit
            continue


def _forbid_other_files(path: Path, folders: Iterable[str]) -> None:
    """Let this process open only the file and the files in the folders of Python."""
    allowed = tuple(os.path.realpath(folder) + os.sep for folder in folders)
    own = os.path.realpath(path)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event != "open" or not isinstance(arguments[0], str | bytes | os.PathLike):
            return
        name = os.path.realpath(os.fsdecode(arguments[0]))
        if name != own and not name.startswith(allowed):
            raise Refused("it refers to another file, which is not read. Export it with all data inside.")

    sys.addaudithook(hook)


def _reason(error: BaseException, package: str) -> str:
    if isinstance(error, SystemExit):  # its exit code is meaningless
        return f"{package} gave up"
    if isinstance(error, MemoryError):
        return "MemoryError: it asks for far more memory than a file of its size should"
    return f"{type(error).__name__}: {error}".rstrip(": ")


def main(reader: str, path: Path, target: Path, memory: float, seconds: float) -> None:
    """Read a file and save its arrays, or the reason why it cannot be read."""
    _limit(memory, seconds)
    importlib.import_module(PACKAGES[reader])
    packages = [folder for folder in sys.path if folder.rstrip("/\\").endswith(("site-packages", "dist-packages"))]
    warnings.simplefilter("ignore")
    report: dict[str, Any] = {}
    # The results must be opened before other files are forbidden.
    with open(target, "wb") as file, open(target.with_suffix(".json"), "w", encoding="utf-8") as report_file:
        _forbid_other_files(path, [*packages, sys.prefix, sys.base_prefix])
        try:
            arrays = PACKAGE_READERS[reader](path)
            report["names"] = list(arrays)
            np.savez(file, **{f"array_{index}": array for index, array in enumerate(arrays.values())})
        except Refused as error:
            report["refused"] = str(error)
        # These packages raise arbitrary exceptions on damaged files, and some even exit. All of them mean that the file
        # cannot be read.
        except (Exception, SystemExit) as error:
            report["failed"] = _reason(error, PACKAGES[reader])
        json.dump(report, report_file)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), float(sys.argv[4]), float(sys.argv[5]))
