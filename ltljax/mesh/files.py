"""A mesh file becomes a checked mesh.

What enters: a path. What leaves: a `Mesh`, or a `MeshError` that begins with the file's name. The formats themselves
are read in `readers`; here their failures are turned into sentences.
"""

import contextlib
import io
import warnings
from collections.abc import Iterator
from os import PathLike
from pathlib import Path

from .errors import MeshError
from .mesh import Mesh
from .readers import READERS
from .text_formats import Polygons


def load_mesh(path: str | PathLike[str], *, repair: bool = False, weld: bool = True) -> Mesh:
    """The mesh in a file, welded by position and checked; ``mesh.report`` says what was found and done.

    Reads OBJ, PLY, STL, OFF, GLB and glTF; with the extra ``io`` also VTK, VTU, Gmsh and GIfTI, with ``viz`` also VTP.
    Faces with more than three corners are split into a fan of triangles. The parts of a scene are joined, with their
    transforms applied. ``mesh.original_index`` refers to the vertices in the order of the file.

    Args:
        path: the file; its ending names the format.
        repair: mend what can be mended, instead of raising; see `Mesh`.
        weld: merge vertices at exactly the same position. Formats without shared vertices (STL), or with seams in their
            textures, fall apart into pieces without it.

    Raises:
        MeshError: if there is no such file, its format is unknown, it is damaged, or it holds no surface.
    """
    path = Path(path)
    try:
        polygons = _read(path)
        return Mesh(polygons.vertices, polygons.faces, repair=repair, weld=weld, uv=polygons.uv)
    except MeshError as error:
        raise MeshError(f"{path.name}: {error}") from error.__cause__


def _read(path: Path) -> Polygons:
    """The vertices and triangles of the file."""
    kind = path.suffix.lower().removeprefix(".")
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
        with _contained():
            return READERS[kind](path)
    except MeshError:
        raise
    # Readers of other projects meet damaged files with any exception there is, some even by leaving the program. This
    # is the one place where all of them mean the same: the file cannot be read.
    except (Exception, SystemExit) as error:
        reason = f"{type(error).__name__}: {str(error)[:200]}".rstrip(": ")
        raise MeshError(
            f"the file could not be read as {kind.upper()} ({reason}). "
            "It may be truncated or damaged: export or download it again, or convert it to OBJ or PLY."
        ) from error


@contextlib.contextmanager
def _contained() -> Iterator[None]:
    """Keeps what readers say about damaged files, as warnings or on the console, from the user: they get an error."""
    silence = io.StringIO()
    with warnings.catch_warnings(), contextlib.redirect_stdout(silence), contextlib.redirect_stderr(silence):
        warnings.simplefilter("ignore")
        # Numbers cut short are no reason to warn but to stop.
        warnings.filterwarnings("error", message="string or file could not be read")
        yield
