"""The formats that are lines of text: OBJ, OFF and STL, and what the text form of PLY shares with them.

What enters: the bytes of a file. What leaves: `Polygons`, unchecked.

trimesh reads these too, but with the eye of a renderer. It splits the vertices of an OBJ at texture seams, drops those
without a face and regroups by material, so that the order of the file, which per-vertex data follow, is lost; and it
takes an OFF that ends too early for a complete one.
"""

import re
from typing import NamedTuple

import numpy as np

from .errors import MeshError
from .polygons import triangulated


class Polygons(NamedTuple):
    """Vertices (V, 3) in the order of the file, triangles (F, 3), and places of their corners in an image (F, 3, 2)."""

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None


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
    triangles = triangulated(vertices, corners, sizes)
    if placed and min(placed) >= 0 and max(placed) < len(places) // 2:
        uv = np.array(places, dtype=np.float64).reshape(-1, 2)[np.array(placed)[triangles]]
    return Polygons(vertices, np.array(corners, np.int64)[triangles], uv)


def parse_off(data: bytes) -> Polygons:
    """OFF: a head, the counts, a line for each vertex and each face; comments begin with #.

    Also as programs write it: the head in small letters, with the counts behind it or absent, and numbers that go on
    from line to line.
    """
    text = data.decode("utf-8-sig", errors="replace")
    rows = [words for line in text.splitlines() if (words := line.partition("#")[0].split())]
    # A head such as CNOFF announces colours and normals, which follow the three coordinates.
    found = re.match(r"(?:ST)?C?N?OFF", rows[0][0].upper()) if rows else None
    if found is not None:
        rest = rows[0][0][found.end() :]
        rows[0] = [rest, *rows[0][1:]] if rest else rows[0][1:]
    head = rows[0][0] if rows and rows[0] else ""
    rows = [row for row in rows if row]
    if found is None and not head.isdecimal():
        raise MeshError(f"expected the head OFF, found {head[:20]!r}. Check that the file is in the OFF format.")
    numbers = [word for row in rows[:2] for word in row][:2]
    if len(numbers) < 2 or not all(word.lstrip("-").isdecimal() for word in numbers):
        raise MeshError("expected the numbers of vertices and faces after the head. Export or download the file again.")
    num_vertices, num_faces = map(int, numbers)
    if num_vertices > 0 and not _is_in_lines(rows, num_vertices, num_faces):
        head_letters = "" if found is None else found.group()
        words = [word for row in rows for word in row][3:]
        flowing = _off_rows(words, num_vertices, num_faces, head_letters)
        rows = rows if flowing is None else [rows[0], *flowing]
    vertex_rows = next_rows(rows, 1, num_vertices, "vertices")
    face_rows = next_rows(rows, 1 + num_vertices, num_faces, "faces")
    nothing_more(rows, 1 + num_vertices + num_faces)
    vertices = coordinates(vertex_rows, [0, 1, 2])
    return Polygons(vertices, polygon_rows(vertices, face_rows, 0))


def parse_stl(data: bytes) -> Polygons:
    """STL as text: three ``vertex`` lines for each triangle."""
    text = data.decode("utf-8", errors="replace").lower()
    if "endsolid" not in text[-2000:]:
        raise MeshError("the file ends without 'endsolid': it is truncated. Export or download it again.")
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
        raise MeshError(f"the file holds {len(corners)} corners, no multiple of three. Export or download it again.")
    return separate_triangles(np.array(corners).reshape(-1, 3, 3))


def separate_triangles(corners: np.ndarray) -> Polygons:
    """Triangles (F, 3, 3) that share no vertices."""
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


def _off_rows(words: list[str], num_vertices: int, num_faces: int, head: str) -> list[list[str]] | None:
    """The rows of vertices and faces of an OFF file whose lines end anywhere; None where the numbers do not fit.

    Behind the coordinates of a vertex the head announces a normal (N), a colour of three or four numbers (C) and a
    place in an image (ST).
    """
    others = 3 * ("N" in head) + 2 * ("ST" in head)
    for count in (3 + others + color for color in ((4, 3) if "C" in head else (0,))):
        rows = [words[count * index : count * (index + 1)] for index in range(num_vertices)]
        place = count * num_vertices
        while place < len(words) and len(rows) < num_vertices + num_faces and words[place].isdecimal():
            stop = place + 1 + int(words[place])
            rows.append(words[place:stop])
            place = stop
        if len(rows) == num_vertices + num_faces and place == len(words):
            return rows
    return None


def nothing_more(rows: list[list[str]], expected: int) -> None:
    """Raises where a file holds more rows than its head announces."""
    if len(rows) > expected:
        raise MeshError(
            f"the file has more rows than its head announces, by {len(rows) - expected}. Correct the numbers in "
            "the head, or export the file again."
        )


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


def polygon_rows(vertices: np.ndarray, rows: list[list[str]], lead: int) -> np.ndarray:
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
    return np.array(corners, np.int64)[triangulated(vertices, corners, sizes)]
