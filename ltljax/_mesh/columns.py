"""The numbers that a file has for the vertices of a mesh, by name.

What enters: the path of a CSV, NPZ, PLY or VTP file, or of a mesh file with colours. What leaves: arrays, one row for
each vertex of the file, or an error that says what was expected of it.
"""

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .errors import MeshError
from .ply import vertex_properties

# Bytes of the arrays in a file of data: ten million vertices with ten species.
_LARGEST = 1_000_000_000
_CHANNELS = ("red", "green", "blue")


class DataError(ValueError):
    """A file of data that is not what it should be.

    Attributes:
        expected: what it should be.
    """

    def __init__(self, path: Path, expected: str):
        super().__init__(f"{path.name}: expected {expected}.")
        self.expected = expected


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file by name; of a PLY without the positions, of a VTP without the vectors.

    They have the types of the file; columns of a CSV are of integers where they hold nothing else.

    Raises:
        DataError: there is no such file, its ending is not known, or it is damaged or too large.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise DataError(path, f"a file that ends in {', '.join(_READERS)}")
    if not path.is_file():
        raise DataError(path, f"a file, and there is none at {path}")
    try:
        return {name: _numbers(name, values) for name, values in reader(path).items()}
    except ImportError:
        raise DataError(path, 'a file that can be read without the extra "viz" (pip install "ltljax[viz]")') from None
    except Exception as error:
        raise DataError(path, f"a sound file ({' '.join(str(error).split())[:200]})") from None


def read_colors(path: Path) -> np.ndarray | None:
    """The colours (V, 3), from 0 to 1, of the vertices of a PLY or OBJ file; None where it has none."""
    kind = path.suffix.lower()
    if kind == ".ply":
        try:
            found = vertex_properties(path.read_bytes())
        except MeshError:
            return None
        return colors_of(found)
    if kind != ".obj":
        return None
    lines = (line.split() for line in path.read_text(encoding="utf-8", errors="replace").splitlines())
    rows = [words for words in lines if words[:1] == ["v"]]
    # Six numbers are a position and a colour; a fourth alone is a weight.
    if not rows or any(len(words) < 7 for words in rows):
        return None
    try:
        return from_zero_to_one(_integers(np.array([[float(word) for word in words[4:7]] for words in rows])))
    except ValueError:
        return None


def colors_of(columns: dict[str, np.ndarray]) -> np.ndarray | None:
    """The colours (V, 3), from 0 to 1, where red, green and blue are among the columns."""
    if not set(_CHANNELS) <= columns.keys():
        return None
    return from_zero_to_one(np.stack([columns[name] for name in _CHANNELS], axis=1))


def from_zero_to_one(colors: np.ndarray) -> np.ndarray:
    """Colours as float64: unsigned integers over their largest, other integers over 255 if they can only be bytes.

    Floating-point numbers stay as they are, those above 1 too: noise makes such.
    """
    kind, size = colors.dtype.kind, colors.dtype.itemsize
    most = 1
    if kind == "u" and size <= 2:
        most = np.iinfo(colors.dtype).max
    elif kind in "iu" and colors.size and colors.min() >= 0 and 1 < colors.max() <= 255:
        most = 255
    return colors.astype(np.float64) / most


def _numbers(name: str, values: Any) -> np.ndarray:
    values = np.asarray(values)
    if values.dtype.kind not in "biuf":
        raise ValueError(f"expected numbers as {name}, found {values.dtype}")
    return values


def _integers(values: np.ndarray) -> np.ndarray:
    """Numbers of a text, as integers if all are whole."""
    # Beyond 2^53 not all of them are told apart.
    return values.astype(np.int64) if np.all((values == np.floor(values)) & (np.abs(values) < 2**53)) else values


def _npz(path: Path) -> dict[str, Any]:
    # A small archive can hold large arrays.
    with zipfile.ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
    if size > _LARGEST:
        raise ValueError(f"expected arrays of at most {_LARGEST} bytes, found {size}")
    with np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _csv(path: Path) -> dict[str, Any]:
    lines = path.read_text(encoding="utf-8-sig").splitlines()  # spreadsheets begin with a mark
    names = [name.strip() for name in lines[0].split(",")]
    # An empty entry is a missing value.
    rows = [line.split(",") for line in lines[1:] if line.strip()]
    values = np.array([[float(entry) if entry.strip() else np.nan for entry in row] for row in rows])
    if values.ndim != 2 or values.shape[1] != len(names):
        raise ValueError(f"expected rows of {len(names)} numbers below the names")
    return {name: _integers(column) for name, column in zip(names, values.T, strict=True)}


def _ply(path: Path) -> dict[str, Any]:
    positions = {"x", "y", "z"}
    return {name: values for name, values in vertex_properties(path.read_bytes()).items() if name not in positions}


def _vtp(path: Path) -> dict[str, Any]:
    import pyvista

    return {name: values for name, values in pyvista.read(path).point_data.items() if values.ndim == 1}


_READERS: dict[str, Callable[[Path], dict[str, Any]]] = {".npz": _npz, ".csv": _csv, ".ply": _ply, ".vtp": _vtp}
