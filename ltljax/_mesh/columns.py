"""Data files with a row for each vertex of a mesh, and the vertex colours of mesh files."""

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .errors import MeshError
from .ply import vertex_properties
from .readers import read_elsewhere

# Largest size in bytes of the arrays in a file: ten million vertices with ten species.
_LARGEST = 1_000_000_000
_CHANNELS = ("red", "green", "blue")


class DataError(ValueError):
    """Raised for a data file that is missing, of another kind, or damaged.

    Attributes:
        expected: description of the file that was expected.
    """

    def __init__(self, path: Path, expected: str):
        super().__init__(f"{path.name}: expected {expected}.")
        self.expected = expected


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """The arrays in a CSV, NPZ, PLY or VTP file by name, without the positions of a PLY and the vectors of a VTP.

    The arrays have the types of the file. Columns of a CSV are integers if all their entries are.

    Raises:
        DataError: there is no such file, its suffix is not known, it is damaged or too large, or reading it needs an
            extra that is not installed.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise DataError(path, f"a file that ends in {', '.join(_READERS)}")
    if not path.is_file():
        raise DataError(path, f"a file, but there is none at {path}")
    try:
        return {name: _numbers(name, values) for name, values in reader(path).items()}
    # Readers raise arbitrary exceptions on damaged files.
    except Exception as error:
        raise DataError(path, f"an intact file ({' '.join(str(error).split())[:200]})") from None


def read_colors(path: Path) -> np.ndarray | None:
    """The vertex colours (V, 3), from 0 to 1, of a PLY or OBJ file; None if it has no colours."""
    kind = path.suffix.lower()
    if kind == ".ply":
        try:
            properties = vertex_properties(path.read_bytes())
        except MeshError:
            return None
        return colors_of(properties)
    if kind != ".obj":
        return None
    lines = (line.split() for line in path.read_text(encoding="utf-8", errors="replace").splitlines())
    rows = [words for words in lines if words[:1] == ["v"]]
    # Six numbers are a position and a colour; four are a position and a weight.
    if not rows or any(len(words) < 7 for words in rows):
        return None
    try:
        return from_zero_to_one(_integers(np.array([[float(word) for word in words[4:7]] for words in rows])))
    except ValueError:
        return None


def colors_of(columns: dict[str, np.ndarray]) -> np.ndarray | None:
    """The colours (V, 3), from 0 to 1, in the columns red, green and blue; None if a column is missing."""
    if not set(_CHANNELS) <= columns.keys():
        return None
    return from_zero_to_one(np.stack([columns[name] for name in _CHANNELS], axis=1))


def from_zero_to_one(colors: np.ndarray) -> np.ndarray:
    """Colours as float64 from 0 to 1.

    Unsigned integers of one or two bytes are divided by the largest value of their type. Other integers are divided by
    255 if they are in the range of bytes. Floating-point values are not changed, because values above 1 can be noise.
    """
    kind, size = colors.dtype.kind, colors.dtype.itemsize
    scale = 1
    if kind == "u" and size <= 2:
        scale = np.iinfo(colors.dtype).max
    elif kind in "iu" and colors.size and colors.min() >= 0 and 1 < colors.max() <= 255:
        scale = 255
    return colors.astype(np.float64) / scale


def _numbers(name: str, values: Any) -> np.ndarray:
    values = np.asarray(values)
    if values.dtype.kind not in "biuf":
        raise ValueError(f"expected numbers as {name}, found {values.dtype}")
    return values


def _integers(values: np.ndarray) -> np.ndarray:
    """The values, as integers if all of them are whole numbers."""
    # Beyond 2^53, float64 does not represent all integers.
    return values.astype(np.int64) if np.all((values == np.floor(values)) & (np.abs(values) < 2**53)) else values


def _npz(path: Path) -> dict[str, Any]:
    # A small archive can decompress to large arrays.
    with zipfile.ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
    if size > _LARGEST:
        raise ValueError(f"expected arrays of at most {_LARGEST} bytes, found {size} bytes")
    with np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _csv(path: Path) -> dict[str, Any]:
    lines = path.read_text(encoding="utf-8-sig").splitlines()  # spreadsheets write a byte order mark
    names = [name.strip() for name in lines[0].split(",")]
    # An empty entry is a missing value.
    rows = [line.split(",") for line in lines[1:] if line.strip()]
    values = np.array([[float(entry) if entry.strip() else np.nan for entry in row] for row in rows])
    if values.ndim != 2 or values.shape[1] != len(names):
        raise ValueError(f"expected rows of {len(names)} numbers below the row of names")
    return {name: _integers(column) for name, column in zip(names, values.T, strict=True)}


def _ply(path: Path) -> dict[str, Any]:
    positions = {"x", "y", "z"}
    return {name: values for name, values in vertex_properties(path.read_bytes()).items() if name not in positions}


def _vtp(path: Path) -> dict[str, Any]:
    return {name: values for name, values in read_elsewhere("vtk fields", path).items() if values.ndim == 1}


_READERS: dict[str, Callable[[Path], dict[str, Any]]] = {".npz": _npz, ".csv": _csv, ".ply": _ply, ".vtp": _vtp}
