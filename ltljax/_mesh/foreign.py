"""Mesh formats that other packages read, each file in a process of its own.

What enters, on the command line: the name of a reader, a file, and where to write the result. What leaves: an NPZ file
of arrays, and a text file beside it that says by which names, or why there are none. Of a mesh these are vertices
(V, 3), the corners of all polygons one after the other, and their sizes; of a file of fields its fields.

A damaged file can make these packages print, end the process, take all memory or never return, and a crafted one can
make them read other files. None of this affects the calling program. This file is run as a script and imports nothing
of ltljax, which would start JAX.
"""

import importlib
import json
import os
import sys
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

if __name__ == "__main__":  # NumPy may lie where the calling program found it, too
    sys.path[:] = json.loads(sys.argv[6])

import numpy as np


class Refused(Exception):
    """Why a readable file is refused, as a sentence."""


class Read(NamedTuple):
    """Vertices (V, 3), the corners of all polygons, and the number of corners of each."""

    vertices: np.ndarray
    corners: np.ndarray
    sizes: np.ndarray


def read_meshio(path: Path) -> Read:
    """VTK, VTU and Gmsh: triangles, quadrangles and polygons. Curved elements are reduced to their corners."""
    import meshio

    grid = meshio.read(path)
    num_corners = {"triangle": 3, "quad": 4, "polygon": None}
    polygons: list[list[int]] = []
    for block in grid.cells:
        name = block.type.rstrip("0123456789")
        if name in num_corners:
            polygons += [list(cell)[: num_corners[name]] for cell in np.asarray(block.data).tolist()]
    if not polygons:
        kinds = ", ".join(sorted({block.type for block in grid.cells})) or "nothing"
        raise Refused(f"expected triangles, found {kinds}. Extract the surface first, e.g. with pyvista or Gmsh.")
    corners = [corner for polygon in polygons for corner in polygon]
    return Read(_in_space(np.asarray(grid.points)), np.array(corners), np.array([len(cell) for cell in polygons]))


def read_vtk(path: Path) -> Read:
    """VTK surfaces (POLYDATA), text, binary or XML."""
    import pyvista

    surface: Any = pyvista.read(path)
    if not isinstance(surface, pyvista.PolyData):
        kind = type(surface).__name__
        raise Refused(f"expected a VTK surface (PolyData), found {kind}. Extract the surface or export it again.")
    triangles = np.reshape(surface.triangulate().faces, (-1, 4))[:, 1:]
    return _of_triangles(surface.points, triangles)


def read_gifti(path: Path) -> Read:
    """GIfTI surfaces, as brain atlases use them, in the space that their transform leads to."""
    import nibabel

    image: Any = nibabel.load(path)
    points = image.get_arrays_from_intent("NIFTI_INTENT_POINTSET")
    triangles = image.get_arrays_from_intent("NIFTI_INTENT_TRIANGLE")
    if not points or not triangles:
        raise Refused("expected a surface, found no points or no triangles. Choose the file that holds the geometry.")
    vertices = np.asarray(points[0].data, np.float64)
    if points[0].coordsys is not None:
        transform = np.asarray(points[0].coordsys.xform, np.float64)
        vertices = vertices @ transform[:3, :3].T + transform[:3, 3]
    return _of_triangles(vertices, triangles[0].data)


def read_freesurfer(path: Path) -> Read:
    """FreeSurfer's binary surfaces, such as ``lh.pial``."""
    from nibabel.freesurfer.io import read_geometry

    points, triangles = read_geometry(path)[:2]
    return _of_triangles(points, triangles)


def read_vtk_fields(path: Path) -> dict[str, Any]:
    """The arrays that a VTK file holds for its points."""
    import pyvista

    mesh: Any = pyvista.read(path)
    if not mesh.n_points:
        raise Refused("expected fields on points, found no points. The file is damaged, or empty.")
    return {str(name): np.asarray(values) for name, values in mesh.point_data.items()}


def read_gifti_fields(path: Path) -> dict[str, Any]:
    """The arrays of a GIfTI file that are no geometry; those of the same name stacked, as of a series."""
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
    """The numbers of a FreeSurfer file such as ``lh.curv``, by its ending."""
    from nibabel.freesurfer.io import read_morph_data

    return {path.suffix.removeprefix("."): np.asarray(read_morph_data(path), np.float64)}


READERS: dict[str, Callable[[Path], Any]] = {
    "meshio": lambda path: read_meshio(path)._asdict(),
    "vtk": lambda path: read_vtk(path)._asdict(),
    "gifti": lambda path: read_gifti(path)._asdict(),
    "freesurfer": lambda path: read_freesurfer(path)._asdict(),
    "vtk fields": read_vtk_fields,
    "gifti fields": read_gifti_fields,
    "freesurfer fields": read_freesurfer_fields,
}


# The package that each of them needs.
PACKAGES = {
    "meshio": "meshio",
    "vtk": "pyvista",
    "gifti": "nibabel",
    "freesurfer": "nibabel",
    "vtk fields": "pyvista",
    "gifti fields": "nibabel",
    "freesurfer fields": "nibabel",
}


def _in_space(points: np.ndarray) -> np.ndarray:
    """Points (V, 3), with zeros added to plane ones (V, 2)."""
    if points.ndim == 2 and points.shape[1] == 2:
        return np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    return points


def _of_triangles(vertices: Any, triangles: Any) -> Read:
    corners = np.asarray(triangles, np.int64).reshape(-1, 3)
    return Read(np.asarray(vertices, np.float64), corners.ravel(), np.full(len(corners), 3))


def _limit(memory: float, seconds: float) -> None:
    """Bound what this process may take, where the operating system can."""
    try:
        import resource
    except ImportError:  # Windows
        return
    for kind, most in ((resource.RLIMIT_AS, memory), (resource.RLIMIT_CPU, seconds)):
        try:
            resource.setrlimit(kind, (int(most), int(most)))
        except (ValueError, OSError):  # a lower bound is in force, or the system knows none
            continue


def _open_nothing_but(path: Path, folders: Iterable[str]) -> None:
    """Forbid this process to open files other than this one and those of Python's own folders."""
    allowed = [os.path.realpath(folder) + os.sep for folder in folders]
    own = os.path.realpath(path)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event != "open" or not isinstance(arguments[0], str | bytes | os.PathLike):
            return
        name = os.path.realpath(os.fsdecode(arguments[0]))
        if name != own and not name.startswith(tuple(allowed)):
            raise Refused("it refers to another file, which is not read. Export it with the numbers inside.")

    sys.addaudithook(hook)


def _reason(error: BaseException, package: str) -> str:
    if isinstance(error, SystemExit):  # its number says nothing
        return f"{package} gave up"
    if isinstance(error, MemoryError):
        return "MemoryError: it asks for far more memory than a file of its size should"
    return f"{type(error).__name__}: {error}".rstrip(": ")


def main(reader: str, path: Path, target: Path, memory: float, seconds: float) -> None:
    """Read a file and save what it holds, or why it cannot be read."""
    _limit(memory, seconds)
    importlib.import_module(PACKAGES[reader])
    packages = [folder for folder in sys.path if folder.rstrip("/\\").endswith(("site-packages", "dist-packages"))]
    warnings.simplefilter("ignore")
    said: dict[str, Any] = {}
    # Opened before other files are forbidden.
    with open(target, "wb") as file, open(target.with_suffix(".json"), "w", encoding="utf-8") as report:
        _open_nothing_but(path, [*packages, sys.prefix, sys.base_prefix])
        try:
            arrays = READERS[reader](path)
            said["names"] = list(arrays)
            np.savez(file, **{f"array_{index}": array for index, array in enumerate(arrays.values())})
        except Refused as error:
            said["refused"] = str(error)
        # Readers of other projects meet damaged files with any exception there is, some even by leaving the program.
        # They mean the same: the file cannot be read.
        except (Exception, SystemExit) as error:
            said["failed"] = _reason(error, PACKAGES[reader])
        json.dump(said, report)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), float(sys.argv[4]), float(sys.argv[5]))
