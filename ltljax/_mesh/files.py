"""`load_mesh`: a checked mesh from a file.

The formats are parsed in `readers`. This module turns their failures into messages that begin with the file's name.
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

# Compressed files are decompressed in pieces of this many bytes, up to a largest total size.
_PIECE, _MOST_DECOMPRESSED = 1 << 20, 4_000_000_000


def load_mesh(path: str | PathLike[str], *, repair: bool = False, weld: bool | float = True) -> Mesh:
    """The mesh in a file, welded by position and checked; ``mesh.report`` lists its measurements and repairs.

    Reads OBJ, PLY, STL, OFF, GLB, glTF and text FreeSurfer surfaces (``.asc``). The extra ``io`` adds VTK, VTU, Gmsh,
    GIfTI and binary FreeSurfer surfaces (``lh.pial``, ``.white``), and the extra ``viz`` adds VTP. Each format may be
    compressed (``.gz``). Faces with more than three corners, convex or not, are split into triangles. The parts of a
    scene are joined, with their transforms applied. ``mesh.original_index`` refers to the vertices in the order of the
    file.

    Args:
        path: path of the file; its suffix determines the format.
        repair: repair the mesh where possible instead of raising; see `Mesh`.
        weld: merge vertices at the same position up to rounding; see `Mesh`. Without it, the faces of formats without
            shared vertices (STL) are disconnected, and so are the sides of texture seams.

    Raises:
        MeshError: there is no such file, its format is unknown, it is damaged, or it holds no surface.
    """
    if not isinstance(path, str | PathLike):
        advice = "It needs no loading." if isinstance(path, Mesh) else "For meshes of other packages, use ltl.as_mesh."
        raise TypeError(f"Expected the path of a file, found a {type(path).__name__}. {advice}")
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
        # Only regular files are read, because a pipe or a device may never end.
        if path.is_dir():
            raise MeshError(f"expected a mesh file, but {path} is a directory. Name a file in it.")
        if not path.is_file():
            raise MeshError(f"there is no file at {path}. Check the path; relative paths start at {Path.cwd()}.")
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
        # The checks of the mesh report numbers that overflow.
        with np.errstate(all="ignore"), _decompressed(path) as decompressed:
            return READERS[kind](decompressed)
    except MeshError:
        raise
    # Readers raise arbitrary exceptions on damaged files. All of them mean that the file cannot be read.
    except Exception as error:
        message = str(error) if isinstance(error, UnreadableError) else f"{type(error).__name__}: {error}"
        reason = message[:200].rstrip(": ")
        raise MeshError(
            f"the file could not be read as {kind.upper()} ({reason}). "
            "It may be truncated or damaged: export or download it again, or convert it to OBJ or PLY."
        ) from error


@contextlib.contextmanager
def _decompressed(path: Path) -> Iterator[Path]:
    """The path of the file, or, for a compressed file (``.gz``), of a temporary decompressed copy."""
    if path.suffix.lower() != ".gz":
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / path.with_suffix("").name
        with gzip.open(path, "rb") as compressed, open(copy, "wb") as file:
            while piece := compressed.read(_PIECE):
                if file.tell() + len(piece) > _MOST_DECOMPRESSED:
                    limit = f"{_MOST_DECOMPRESSED / 1e9:.0f} GB"
                    raise MeshError(f"it decompresses to more than {limit}. Decompress it first.")
                file.write(piece)
        yield copy
