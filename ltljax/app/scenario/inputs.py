"""Files that a scenario names, which may come from anybody: their contents are checked before they are unpacked.

What enters: a path. What leaves: arrays, or an error that says what is wrong.
"""

import io
import json
import zipfile
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from ..._mesh import MeshError
from ..._mesh.columns import read_columns


def check_self_contained(path: Path) -> None:
    """Raise if a mesh file refers to other files: it could refer to any file, and a copy of it would be incomplete."""
    references: list[Any] = []
    try:
        if path.suffix.lower() == ".gii":
            parser = expat.ParserCreate()
            parser.StartElementHandler = lambda _, values: references.append(values.get("ExternalFileName"))
            parser.Parse(path.read_bytes(), True)
        elif path.suffix.lower() in (".gltf", ".glb"):
            data = path.read_bytes()
            text = data[20 : 20 + int.from_bytes(data[12:16], "little")] if data[:4] == b"glTF" else data
            references += [buffer.get("uri") for buffer in json.loads(text)["buffers"]]
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError, expat.ExpatError):
        pass  # The file is damaged, which is reported when it is read.
    for reference in references:
        if reference and not str(reference).startswith("data:"):
            raise MeshError(
                f"{path.name}: expected a file that holds all of its data, found one that refers to "
                f"{str(reference)[:60]!r}. Export it as one file, such as GLB, OBJ or PLY."
            )


def arrays(path: Path, names: tuple[str, ...], size: int) -> list[np.ndarray]:
    """The columns (V,) of a CSV file, or the arrays of an .npz file, whose headers are checked before unpacking.

    Source: numpy.lib.format.

    Raises:
        ValueError: a column is absent, or has another size or type.
    """
    if path.suffix.lower() == ".csv":
        table = read_columns(path)
        if absent := [name for name in names if name not in table]:
            raise ValueError(f"expected the column {absent[0]}, found {', '.join(table)[:200]}")
        columns = [table[name].astype(np.float64) for name in names]
        if len(columns[0]) != size:
            raise ValueError(f"expected {size} rows of numbers, found {len(columns[0])}")
        return columns
    columns = []
    # A number has at most sixteen bytes, and the header is short.
    longest = 16 * size + 4096
    with zipfile.ZipFile(path) as archive:
        for name in names:
            with archive.open(f"{name}.npy") as file:
                data = io.BytesIO(file.read(longest))
            version = np.lib.format.read_magic(data)
            read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
            shape, _, dtype = read[version](data)
            if shape != (size,) or dtype.kind not in "fiu":
                raise ValueError(f"expected numbers of shape ({size},) for {name}, found {dtype} of shape {shape}")
            columns.append(np.frombuffer(data.read(size * dtype.itemsize), dtype, size).astype(np.float64))
    return columns
