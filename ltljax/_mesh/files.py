"""A mesh file becomes a checked mesh.

What enters: a path. What leaves: a `Mesh`, or a `MeshError` that begins with the file's name. The formats themselves
are read in `readers`; here their failures are turned into sentences.
"""

import contextlib
import gzip
import tempfile
from collections.abc import Iterator
from os import PathLike
from pathlib import Path

import numpy as np

from .errors import MeshError, UnreadableError, in_one_line
from .mesh import Mesh
from .readers import READERS
from .text_formats import Polygons

# A packed file is unpacked in pieces of so many bytes, up to so many in all.
_PIECE, _MOST_UNPACKED = 1 << 20, 4_000_000_000


def load_mesh(path: str | PathLike[str], *, repair: bool = False, weld: bool | float = True) -> Mesh:
    """The mesh in a file, welded by position and checked; ``mesh.report`` says what was found and done.

    Reads OBJ, PLY, STL, OFF, GLB and glTF; with the extra ``io`` also VTK, VTU, Gmsh, GIfTI and FreeSurfer's surfaces
    (``lh.pial``, ``.white``, ``.asc``), with ``viz`` also VTP; each of them packed (``.gz``) too.
    Faces with more than three corners are split into triangles, convex or not. The parts of a scene are joined, with
    their transforms applied. ``mesh.original_index`` refers to the vertices in the order of the file.

    Args:
        path: the file; its ending names the format.
        repair: mend what can be mended, instead of raising; see `Mesh`.
        weld: merge vertices at the same position, up to rounding; see `Mesh`. Formats without shared vertices (STL), or
            with seams in their textures, fall apart into pieces without it.

    Raises:
        MeshError: if there is no such file, its format is unknown, it is damaged, or it holds no surface.
    """
    if not isinstance(path, str | PathLike):
        advice = " Use it as it is." if isinstance(path, Mesh) else " For meshes of other packages use ltl.as_mesh."
        raise TypeError(f"Expected the path of a file, found a {type(path).__name__}.{advice}")
    path = Path(path)
    try:
        polygons = _read(path)
        return Mesh(polygons.vertices, polygons.faces, repair=repair, weld=weld, uv=polygons.uv)
    except MeshError as error:
        raise MeshError(in_one_line(f"{path.name}: {error}")) from error.__cause__


def _read(path: Path) -> Polygons:
    """The vertices and triangles of the file."""
    kind = (path.with_suffix("") if path.suffix.lower() == ".gz" else path).suffix.lower().removeprefix(".")
    try:
        # Only regular files: a pipe or a device may never end.
        if path.is_dir():
            raise MeshError(f"expected a mesh file, but {path} is a directory. Name a file in it.")
        if not path.is_file():
            raise MeshError(f"there is no file at {path}. Check the path; relative ones start at {Path.cwd()}.")
        size = path.stat().st_size
    except (OSError, ValueError) as error:
        if isinstance(error, MeshError):
            raise
        raise MeshError(f"the file at {path!r} cannot be reached ({error}). Check the path.") from error
    if kind not in READERS:
        known = ", ".join(f".{name}" for name in READERS)
        raise MeshError(f"the kind '.{kind}' is not known. Convert the file to one of {known}.")
    if size == 0:
        raise MeshError("the file is empty. Export or download it again.")
    try:
        # What numbers beyond the range become, the checks of the mesh report.
        with np.errstate(all="ignore"), _unpacked(path) as unpacked:
            return READERS[kind](unpacked)
    except MeshError:
        raise
    # Readers meet damaged files with any exception there is. This is the one place where all of them mean the same: the
    # file cannot be read.
    except Exception as error:
        said = str(error) if isinstance(error, UnreadableError) else f"{type(error).__name__}: {error}"
        reason = said[:200].rstrip(": ")
        raise MeshError(
            f"the file could not be read as {kind.upper()} ({reason}). "
            "It may be truncated or damaged: export or download it again, or convert it to OBJ or PLY."
        ) from error


@contextlib.contextmanager
def _unpacked(path: Path) -> Iterator[Path]:
    """The file itself, or for a packed one (``.gz``) a copy without the packing, as long as it is read."""
    if path.suffix.lower() != ".gz":
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.with_suffix("").name
        with gzip.open(path, "rb") as packed, open(copy, "wb") as file:
            while piece := packed.read(_PIECE):
                if file.tell() + len(piece) > _MOST_UNPACKED:
                    raise MeshError(f"it unpacks to more than {_MOST_UNPACKED / 1e9:.0f} GB. Unpack it first.")
                file.write(piece)
        yield copy
