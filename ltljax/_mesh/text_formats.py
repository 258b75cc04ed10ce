"""Parsers of the text formats OBJ, OFF and STL, and helpers that the text form of PLY shares with them.

trimesh reads these formats for rendering: it splits the vertices of an OBJ at texture seams, drops vertices without a
face and regroups faces by material. This loses the order of the file, in which per-vertex data come. It also accepts
truncated OFF files.
"""

import re
from typing import NamedTuple

import numpy as np

from .errors import MeshError
from .polygons import triangulated


class Polygons(NamedTuple):
    """The unchecked geometry of a file.

    Attributes:
        vertices: (V, 3) positions in the order of the file.
        faces: (F, 3) triangles.
        uv: (F, 3, 2) texture coordinates of the corners, or None.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None


def parse_obj(data: bytes) -> Polygons:
    """The geometry of a Wavefront OBJ file: its ``v``, ``vt`` and ``f`` lines."""
    text = data.decode("utf-8", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
    # The lists are flat: with a million small lists, garbage collection would take longer than parsing.
    coordinates: list[float] = []
    texture_coordinates: list[float] = []
    corners: list[int] = []
    texture_indices: list[int] = []  # for each corner; -1 if it has no texture coordinates
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
                texture_coordinates += (float(words[1]), float(words[2]) if len(words) > 2 else 0.0)
            elif words[0] == "f":
                # 7/1/3 is vertex 7 with texture coordinates 1 and normal 3. Negative indices count back from the latest
                # vertex.
                indices = [int(word.partition("/")[0]) for word in words[1:]]
                latest = len(coordinates) // 3
                corners += [index - 1 if index >= 0 else latest + index for index in indices]
                sizes.append(len(indices))
                for word in words[1:]:
                    second = word.split("/")[1] if "/" in word else ""
                    index = int(second) if second else 0
                    texture_indices.append(index - 1 if index >= 0 else len(texture_coordinates) // 2 + index)
        except ValueError:
            raise MeshError(f"line {number} is not readable: {line.strip()[:60]!r}. Correct or remove it.") from None
    vertices, uv = np.array(coordinates, dtype=np.float64).reshape(-1, 3), None
    triangles = triangulated(vertices, corners, sizes)
    if texture_indices and min(texture_indices) >= 0 and max(texture_indices) < len(texture_coordinates) // 2:
        uv = np.array(texture_coordinates, dtype=np.float64).reshape(-1, 2)[np.array(texture_indices)[triangles]]
    return Polygons(vertices, np.array(corners, np.int64)[triangles], uv)


def parse_off(data: bytes) -> Polygons:
    """The geometry of an OFF file: a header, the counts, a line for each vertex and each face; comments begin with #.

    Accepts the variants that programs write: a header in lower case, followed by the counts, or absent, and numbers
    with arbitrary line breaks.
    """
    text = data.decode("utf-8-sig", errors="replace")
    rows = [words for line in text.splitlines() if (words := line.partition("#")[0].split())]
    # A header such as CNOFF announces colours and normals, which follow the three coordinates.
    header = re.match(r"(?:ST)?C?N?OFF", rows[0][0].upper()) if rows else None
    if header is not None:
        rest = rows[0][0][header.end() :]
        rows[0] = [rest, *rows[0][1:]] if rest else rows[0][1:]
    first_word = rows[0][0] if rows and rows[0] else ""
    rows = [row for row in rows if row]
    if header is None and not first_word.isdecimal():
        raise MeshError(
            f"expected the header OFF, found {first_word[:20]!r}. Check that the file is in the OFF format."
        )
    numbers = [word for row in rows[:2] for word in row][:2]
    if len(numbers) < 2 or not all(word.lstrip("-").isdecimal() for word in numbers):
        raise MeshError(
            "expected the numbers of vertices and faces after the header. Export or download the file again."
        )
    num_vertices, num_faces = map(int, numbers)
    if num_vertices > 0 and not _is_in_lines(rows, num_vertices, num_faces):
        words = [word for row in rows for word in row][3:]
        rows_of_words = _off_rows(words, num_vertices, num_faces, "" if header is None else header.group())
        rows = rows if rows_of_words is None else [rows[0], *rows_of_words]
    vertex_rows = next_rows(rows, 1, num_vertices, "vertices")
    face_rows = next_rows(rows, 1 + num_vertices, num_faces, "faces")
    expect_end(rows, 1 + num_vertices + num_faces)
    vertices = coordinates(vertex_rows, [0, 1, 2])
    return Polygons(vertices, polygon_rows(vertices, face_rows, 0))


def parse_stl(data: bytes) -> Polygons:
    """The geometry of a text STL file: three ``vertex`` lines for each triangle."""
    text = data.decode("utf-8", errors="replace").lower()
    if "endsolid" not in text[-2000:]:
        raise MeshError("the file ends without 'endsolid', so it is truncated. Export or download it again.")
    corners = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if words and words[0] == "vertex":
            try:
                x, y, z = words[1:]
                corners.append((float(x), float(y), float(z)))
            except ValueError:
                raise MeshError(
                    f"line {number} is not readable: {line.strip()[:60]!r}. Correct or remove it."
                ) from None
    if len(corners) % 3:
        raise MeshError(
            f"the file holds {len(corners)} corners, which is not a multiple of three. Export or download it again."
        )
    return separate_triangles(np.array(corners).reshape(-1, 3, 3))


def separate_triangles(corners: np.ndarray) -> Polygons:
    """The geometry of triangles (F, 3, 3) that share no vertices."""
    return Polygons(corners.reshape(-1, 3).astype(np.float64), np.arange(3 * len(corners)).reshape(-1, 3))


def _is_in_lines(rows: list[list[str]], num_vertices: int, num_faces: int) -> bool:
    """Whether each vertex and each face of an OFF file has a line of its own."""
    faces = rows[1 + num_vertices : 1 + num_vertices + num_faces]
    return (
        len(rows) >= 1 + num_vertices + num_faces
        and len(rows[0]) >= 2
        and all(len(row) >= 3 for row in rows[1 : 1 + num_vertices])
        and all(row[0].isdecimal() and len(row) >= 1 + int(row[0]) for row in faces)
    )


def _off_rows(words: list[str], num_vertices: int, num_faces: int, header: str) -> list[list[str]] | None:
    """The rows of vertices and faces of an OFF file with arbitrary line breaks; None if the numbers do not fit.

    The header announces what follows the coordinates of a vertex: a normal (N), a colour of three or four numbers (C)
    and texture coordinates (ST).
    """
    extra = 3 * ("N" in header) + 2 * ("ST" in header)
    for count in (3 + extra + color for color in ((4, 3) if "C" in header else (0,))):
        rows = [words[count * index : count * (index + 1)] for index in range(num_vertices)]
        start = count * num_vertices
        while start < len(words) and len(rows) < num_vertices + num_faces and words[start].isdecimal():
            stop = start + 1 + int(words[start])
            rows.append(words[start:stop])
            start = stop
        if len(rows) == num_vertices + num_faces and start == len(words):
            return rows
    return None


def expect_end(rows: list[list[str]], expected: int) -> None:
    """Raise if the file holds more rows than its header announces."""
    excess = len(rows) - expected
    if excess > 0:
        raise MeshError(
            f"the file has {excess} {'row' if excess == 1 else 'rows'} more than its header announces. Correct the "
            "numbers in the header, or export the file again."
        )


def next_rows(rows: list[list[str]], start: int, count: int, what: str) -> list[list[str]]:
    """The ``count`` rows from ``start`` on; raises if the file ends before."""
    selected = rows[start : start + count] if count > 0 else []
    if len(selected) != count:
        raise MeshError(
            f"the file announces {count} rows of {what}, but holds {len(selected)}. "
            "It may be truncated: export or download it again."
        )
    return selected


def coordinates(rows: list[list[str]], columns: list[int]) -> np.ndarray:
    """The positions (V, 3) in three columns of the rows."""
    if any(len(row) <= max(columns) for row in rows):
        first = next(index for index, row in enumerate(rows) if len(row) <= max(columns))
        raise MeshError(f"vertex {first} has fewer than three coordinates. Export or download the file again.")
    x, y, z = columns
    return np.array([(float(row[x]), float(row[y]), float(row[z])) for row in rows]).reshape(-1, 3)


def polygon_rows(vertices: np.ndarray, rows: list[list[str]], lead: int) -> np.ndarray:
    """The triangles of rows of ``lead`` other words, the number of corners, and the corners."""
    corners: list[int] = []
    sizes: list[int] = []
    for index, row in enumerate(rows):
        size = int(row[lead]) if len(row) > lead else 0
        words = row[lead + 1 : lead + 1 + size]
        if len(words) != size:
            raise MeshError(f"face {index} announces {size} corners, but has {len(words)}. Download the file again.")
        corners += map(int, words)
        sizes.append(size)
    return np.array(corners, np.int64)[triangulated(vertices, corners, sizes)]
