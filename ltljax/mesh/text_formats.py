"""The formats that are lines of text: OBJ and OFF, and what the text form of PLY shares with them.

What enters: the bytes of a file. What leaves: `Polygons`, unchecked.

trimesh reads these too, but with the eye of a renderer. It splits the vertices of an OBJ at texture seams, drops those
without a face and regroups by material, so that the order of the file, which per-vertex data follow, is lost; and it
takes an OFF that ends too early for a complete one.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .errors import MeshError


class Polygons(NamedTuple):
    """Vertices (V, 3) in the order of the file, triangles (F, 3), and places of their corners in an image (F, 3, 2)."""

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None


def fan(corners: Sequence[int] | np.ndarray, sizes: Sequence[int] | np.ndarray) -> np.ndarray:
    """Triangles (F, 3) that fan out from the first corner of each polygon.

    Args:
        corners: the corners of all polygons, one after the other.
        sizes: the number of corners of each polygon.
    """
    flat, counts = np.asarray(corners, dtype=np.int64), np.asarray(sizes, dtype=np.int64)
    if np.any(counts < 3):
        first = int(np.flatnonzero(counts < 3)[0])
        raise MeshError(f"face {first} has {counts[first]} corners; it needs at least three. Correct or remove it.")
    start = np.repeat(np.cumsum(counts) - counts, counts - 2)
    step = np.arange(len(start)) - np.repeat(np.cumsum(counts - 2) - (counts - 2), counts - 2)
    return np.stack([flat[start], flat[start + step + 1], flat[start + step + 2]], axis=1)


def parse_obj(data: bytes) -> Polygons:
    """Wavefront OBJ: the ``v``, ``vt`` and ``f`` lines."""
    text = data.decode("utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
    # Flat lists: a million small ones would keep the garbage collector busy for longer than the reading takes.
    coordinates: list[float] = []
    places: list[float] = []
    corners: list[int] = []
    # The entry of `places` for each corner, or -1 where there is none.
    placed: list[int] = []
    sizes: list[int] = []
    for number, line in enumerate(text.split("\n"), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            if words[0] == "v":
                x, y, z = words[1:4]
                coordinates += (float(x), float(y), float(z))
            elif words[0] == "vt":
                places += (float(words[1]), float(words[2]) if len(words) > 2 else 0.0)
            elif words[0] == "f":
                # 7/1/3 is vertex 7 with a texture and a normal. Negative numbers count back from the latest vertex.
                indices = [int(word.partition("/")[0]) for word in words[1:]]
                latest = len(coordinates) // 3
                corners += [index - 1 if index >= 0 else latest + index for index in indices]
                sizes.append(len(indices))
                for word in words[1:]:
                    second = word.split("/")[1] if "/" in word else ""
                    index = int(second) if second else 0
                    placed.append(index - 1 if index >= 0 else len(places) // 2 + index)
        except ValueError:
            raise MeshError(f"line {number} is not readable: {line.strip()[:60]!r}. Correct or remove it.") from None
    vertices, uv = np.array(coordinates, dtype=np.float64).reshape(-1, 3), None
    if placed and min(placed) >= 0 and max(placed) < len(places) // 2:
        uv = np.array(places, dtype=np.float64).reshape(-1, 2)[fan(placed, sizes)]
    return Polygons(vertices, fan(corners, sizes), uv)


def parse_off(data: bytes) -> Polygons:
    """OFF: a head, the counts, a line for each vertex and each face; comments begin with #."""
    text = data.decode("utf-8", errors="replace")
    rows = [words for line in text.splitlines() if (words := line.partition("#")[0].split())]
    head = rows[0].pop(0) if rows else ""
    # A head such as CNOFF announces colours and normals, which follow the three coordinates.
    if head not in ("OFF", "COFF", "NOFF", "CNOFF", "STOFF"):
        raise MeshError(f"expected the head OFF, found {head[:20]!r}. Check that the file is in the OFF format.")
    rows = [row for row in rows if row]
    if not rows or len(rows[0]) < 2:
        raise MeshError("expected the numbers of vertices and faces after the head. Export or download the file again.")
    num_vertices, num_faces = int(rows[0][0]), int(rows[0][1])
    vertex_rows = next_rows(rows, 1, num_vertices, "vertices")
    face_rows = next_rows(rows, 1 + num_vertices, num_faces, "faces")
    return Polygons(coordinates(vertex_rows, [0, 1, 2]), polygon_rows(face_rows, 0))


def next_rows(rows: list[list[str]], start: int, count: int, what: str) -> list[list[str]]:
    """The next ``count`` rows, all of them."""
    found = rows[start : start + count] if count > 0 else []
    if len(found) != count:
        raise MeshError(
            f"the file announces {count} rows of {what}, but holds {len(found)}. "
            "It may be truncated: export or download it again."
        )
    return found


def coordinates(rows: list[list[str]], columns: list[int]) -> np.ndarray:
    """The positions (V, 3) in three columns of the rows."""
    if any(len(row) <= max(columns) for row in rows):
        first = next(index for index, row in enumerate(rows) if len(row) <= max(columns))
        raise MeshError(f"vertex {first} has fewer than three coordinates. Export or download the file again.")
    x, y, z = columns
    return np.array([(float(row[x]), float(row[y]), float(row[z])) for row in rows]).reshape(-1, 3)


def polygon_rows(rows: list[list[str]], lead: int) -> np.ndarray:
    """The triangles of rows that hold, after ``lead`` other words, the number of corners and the corners."""
    corners: list[int] = []
    sizes: list[int] = []
    for index, row in enumerate(rows):
        size = int(row[lead]) if len(row) > lead else 0
        found = row[lead + 1 : lead + 1 + size]
        if len(found) != size:
            raise MeshError(f"face {index} announces {size} corners, but has {len(found)}. Download the file again.")
        corners += map(int, found)
        sizes.append(size)
    return fan(corners, sizes)
