"""Parser of PLY files, text and binary.

trimesh reads PLY too, but it assumes that all faces have as many corners as the first. It rejects or misreads a binary
file of triangles and quadrangles.
"""

from typing import NamedTuple

import numpy as np

from .errors import MeshError
from .polygons import triangulated
from .text_formats import Polygons, coordinates, expect_end, next_rows, polygon_rows

_CODES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


class _Property(NamedTuple):
    """A column of an element; `size_code` is the type of the length of a list, or None for a scalar."""

    name: str
    code: str
    size_code: str | None


class _Element(NamedTuple):
    """A table of the file, such as its vertices or its faces."""

    name: str
    rows: int
    properties: list[_Property]


def parse_ply(data: bytes) -> Polygons:
    """The geometry of a PLY file."""
    kind, elements, body = _parts(data)
    if kind == "ascii":
        return _parse_text(body.decode("utf-8", errors="replace"), elements)
    return _parse_binary(body, elements, _BYTE_ORDERS[kind])


def vertex_properties(data: bytes) -> dict[str, np.ndarray]:
    """The vertex properties of a PLY file by name, including the coordinates, with the types of the file."""
    kind, elements, body = _parts(data)
    if not elements or elements[0].name != "vertex" or any(item.size_code for item in elements[0].properties):
        raise MeshError("expected the vertices to come first and to have no lists. Export the file again.")
    element = elements[0]
    if kind == "ascii":
        lines = [words for line in body.decode("utf-8", errors="replace").splitlines() if (words := line.split())]
        values = np.array(next_rows(lines, 0, element.rows, element.name), dtype=np.float64)
        columns = zip(element.properties, values.T, strict=True)
        return {item.name: column.astype(item.code) for item, column in columns}
    dtype = np.dtype([(item.name, _BYTE_ORDERS[kind] + item.code) for item in element.properties])
    _expect(body, 0, element.rows * dtype.itemsize, element)
    rows = np.frombuffer(body, dtype, element.rows)
    return {item.name: rows[item.name].astype(item.code) for item in element.properties}


def _parts(data: bytes) -> tuple[str, list[_Element], bytes]:
    """The format of a file, its elements, and the bytes after its header."""
    header, end, body = data.partition(b"end_header")
    if not header.startswith(b"ply") or not end:
        raise MeshError("expected a header from 'ply' to 'end_header'. The file is damaged or not PLY.")
    kind, elements = _parse_header(header.decode("utf-8", errors="replace"))
    if kind != "ascii" and kind not in _BYTE_ORDERS:
        raise MeshError(f"the format {kind!r} is not known. Export as ascii or binary_little_endian.")
    # The header ends with a single line break. The next byte is data, even if it looks like another line break.
    return kind, elements, body[2:] if body[:2] == b"\r\n" else body[1:]


def _parse_header(header: str) -> tuple[str, list[_Element]]:
    kind, elements = "", []
    for words in map(str.split, header.splitlines()):
        if words[:1] == ["property"]:  # some programs write the types in upper case
            words = [*(word.lower() for word in words[:-1]), words[-1]]
        match words:
            case ["format", name, *_]:
                kind = name
            case ["element", name, count]:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", size_type, type_, name]:
                elements[-1].properties.append(_Property(name, _code(type_), _code(size_type)))
            case ["property", type_, name]:
                elements[-1].properties.append(_Property(name, _code(type_), None))
            case _:  # a comment
                pass
    return kind, elements


def _code(kind: str) -> str:
    if kind not in _CODES:
        raise MeshError(f"the type {kind[:20]!r} is not one of PLY's. Export the file again.")
    return _CODES[kind]


def _corner_list(element: _Element) -> int | None:
    """The index of the property that lists the corners of a face: the list of that name, else the first list."""
    lists = [index for index, item in enumerate(element.properties) if item.size_code]
    named = [index for index in lists if element.properties[index].name in ("vertex_indices", "vertex_index")]
    return (named or lists or [None])[0]


def _parse_text(body: str, elements: list[_Element]) -> Polygons:
    rows = [words for line in body.splitlines() if (words := line.split())]
    vertices, start = np.zeros((0, 3)), 0
    face_rows, num_words_before, strips = [], 0, []
    for element in elements:
        element_rows = next_rows(rows, start, element.rows, element.name)
        start += element.rows
        names = [item.name for item in element.properties]
        index = _corner_list(element)
        before = element.properties[:index]
        if any(item.size_code for item in before) and element.name in ("vertex", "face"):
            name = before[0].name
            raise MeshError(f"the list {name!r} comes before the coordinates or corners. Export the file without it.")
        if element.name == "vertex":
            vertices = coordinates(element_rows, [names.index(axis) for axis in "xyz"])
        elif element.name == "face" and index is not None:
            face_rows, num_words_before = element_rows, index
        elif element.name == "tristrips" and index is not None:
            # The number of entries comes before the entries of a strip, as it does for faces.
            entries = [row[index + 1 : index + 1 + int(row[index])] for row in element_rows]
            strips.append(_strip_triangles(np.array([int(word) for strip in entries for word in (*strip, "-1")], int)))
    expect_end(rows, start)
    triangles = polygon_rows(vertices, face_rows, num_words_before)
    return Polygons(vertices, np.concatenate([triangles, *strips]))


def _parse_binary(body: bytes, elements: list[_Element], order: str) -> Polygons:
    vertices, offset = np.zeros((0, 3)), 0
    lists, strips = (np.zeros(0, np.int64), np.zeros(0, np.int64)), []
    for element in elements:
        index = _corner_list(element)
        if index is None:
            dtype = np.dtype([(item.name, order + item.code) for item in element.properties])
            _expect(body, offset, element.rows * dtype.itemsize, element)
            rows = np.frombuffer(body, dtype, element.rows, offset)
            offset += element.rows * dtype.itemsize
            if element.name == "vertex":
                vertices = np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1)
        else:
            corners, sizes, offset = _list_rows(body, element, order, offset, index)
            if element.name == "face":
                lists = corners, sizes
            elif element.name == "tristrips":
                # A negative number separates the lists, because each is a strip.
                strips.append(_strip_triangles(np.insert(corners, np.cumsum(sizes), -1)))
    if elements and offset < len(body.rstrip(b"\r\n\0 ")):
        raise MeshError(
            f"the file holds {len(body) - offset} bytes beyond the rows that its header announces. Correct the numbers "
            "in the header, or export the file again."
        )
    corners, sizes = lists
    triangles = corners[triangulated(vertices, corners, sizes)]
    return Polygons(vertices, np.concatenate([triangles, *strips]))


def _strip_triangles(strips: np.ndarray) -> np.ndarray:
    """The triangles (F, 3) of triangle strips; a negative number ends a strip.

    Every second triangle of a strip is reversed, so that all have the same orientation.
    """
    triples = np.stack([strips[:-2], strips[1:-1], strips[2:]], axis=1)
    ends = np.flatnonzero(strips < 0)
    begins = np.concatenate([[0], ends + 1])
    position = np.arange(len(triples))
    is_reversed = (position - begins[np.searchsorted(ends, position)]) % 2 == 1
    triples[is_reversed] = triples[is_reversed][:, [1, 0, 2]]
    a, b, c = triples.T
    # Programs repeat corners to join strips; the triangles there have no area.
    return triples[(triples >= 0).all(axis=1) & (a != b) & (b != c) & (a != c)]


def _list_rows(
    body: bytes, element: _Element, order: str, offset: int, index: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """The entries of the list property ``index`` of all rows, their numbers, and the offset of the next element."""
    if element.rows <= 0:
        _expect(body, offset, element.rows, element)
        return np.zeros(0, np.int64), np.zeros(0, np.int64), offset
    # In most files, all rows have the same layout as the first. They are then read as a single array.
    spans, stop = _row(body, element, order, offset)
    fields = []
    for i, (item, (_, size)) in enumerate(zip(element.properties, spans, strict=True)):
        if item.size_code:
            fields.append((f"size {i}", order + item.size_code))
        fields.append((f"data {i}", order + item.code, (size,)))
    dtype = np.dtype(fields)
    if offset + element.rows * dtype.itemsize <= len(body):
        rows = np.frombuffer(body, dtype, element.rows, offset)
        lists = [i for i, item in enumerate(element.properties) if item.size_code]
        if all(np.all(rows[f"size {i}"] == spans[i][1]) for i in lists):
            corners = rows[f"data {index}"].astype(np.int64).ravel()
            sizes = np.full(element.rows, spans[index][1])
            return corners, sizes, offset + element.rows * dtype.itemsize
    pieces, sizes = [], []
    code = order + element.properties[index].code
    for _ in range(element.rows):
        spans, stop = _row(body, element, order, offset)
        start, size = spans[index]
        pieces.append(np.frombuffer(body, code, size, start))
        sizes.append(size)
        offset = stop
    return np.concatenate(pieces).astype(np.int64), np.array(sizes), offset


def _row(body: bytes, element: _Element, order: str, offset: int) -> tuple[list[tuple[int, int]], int]:
    """The offset and the number of entries of each property of a row, and the offset of the next row."""
    spans = []
    for item in element.properties:
        size = 1
        if item.size_code:
            length = int(item.size_code[1])
            _expect(body, offset, length, element)
            size = int(np.frombuffer(body, order + item.size_code, 1, offset)[0])
            offset += length
        spans.append((offset, size))
        _expect(body, offset, size * int(item.code[1]), element)
        offset += size * int(item.code[1])
    return spans, offset


def _expect(body: bytes, offset: int, length: int, element: _Element) -> None:
    """Raise if the file ends before the ``length`` bytes that its header announces."""
    if length < 0 or offset + length > len(body):
        raise MeshError(
            f"the file announces {element.rows} rows of {element.name}, but its {len(body)} bytes of data end before "
            "them. It may be truncated: export or download it again."
        )
