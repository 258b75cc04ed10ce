"""The PLY format, text and binary.

What enters: the bytes of a file. What leaves: `Polygons`, unchecked.

trimesh reads PLY too, but takes the number of corners of the first face for that of all: a binary file of triangles and
quadrangles is refused, or misread where the lengths happen to agree.
"""

from typing import NamedTuple

import numpy as np

from .errors import MeshError
from .polygons import triangulated
from .text_formats import Polygons, coordinates, next_rows, nothing_more, polygon_rows

_CODES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


class _Property(NamedTuple):
    name: str
    code: str
    size_code: str | None  # of a list, the type of its length


class _Element(NamedTuple):
    name: str
    rows: int
    properties: list[_Property]


def parse_ply(data: bytes) -> Polygons:
    """PLY, text or binary."""
    kind, elements, body = _parts(data)
    if kind == "ascii":
        return _parse_text(body.decode("utf-8", errors="replace"), elements)
    return _parse_binary(body, elements, _BYTE_ORDERS[kind])


def vertex_properties(data: bytes) -> dict[str, np.ndarray]:
    """What a PLY file has at its vertices, by name and of the types it states, coordinates included."""
    kind, elements, body = _parts(data)
    if not elements or elements[0].name != "vertex" or any(item.size_code for item in elements[0].properties):
        raise MeshError("expected vertices first, without lists.")
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
    """The format of a file, its elements, and what follows its head."""
    head, end, body = data.partition(b"end_header")
    if not head.startswith(b"ply") or not end:
        raise MeshError("expected a head from 'ply' to 'end_header'. The file is damaged or not PLY.")
    kind, elements = _parse_head(head.decode("utf-8", errors="replace"))
    if kind != "ascii" and kind not in _BYTE_ORDERS:
        raise MeshError(f"the format {kind!r} is not known. Export as ascii or binary_little_endian.")
    # One line end belongs to the head; the next byte is data, even if it looks like another.
    return kind, elements, body[2:] if body[:2] == b"\r\n" else body[1:]


def _parse_head(head: str) -> tuple[str, list[_Element]]:
    kind, elements = "", []
    for words in map(str.split, head.splitlines()):
        if words[:1] == ["property"]:  # some programs shout
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
            case _:  # comments
                pass
    return kind, elements


def _code(kind: str) -> str:
    if kind not in _CODES:
        raise MeshError(f"the type {kind[:20]!r} is not one of PLY's. Export the file again.")
    return _CODES[kind]


def _corner_list(element: _Element) -> int | None:
    """Which property holds the corners of a face: the list of that name, else the first list."""
    lists = [index for index, item in enumerate(element.properties) if item.size_code]
    named = [index for index in lists if element.properties[index].name in ("vertex_indices", "vertex_index")]
    return (named or lists or [None])[0]


def _parse_text(body: str, elements: list[_Element]) -> Polygons:
    rows = [words for line in body.splitlines() if (words := line.split())]
    vertices, position = np.zeros((0, 3)), 0
    rows_of_faces, lead_of_faces, strips = [], 0, []
    for element in elements:
        here = next_rows(rows, position, element.rows, element.name)
        position += element.rows
        names = [item.name for item in element.properties]
        which = _corner_list(element)
        lead = element.properties[:which]
        if any(item.size_code for item in lead) and element.name in ("vertex", "face"):
            raise MeshError(f"the list {lead[0].name!r} stands before the numbers of interest. Export without it.")
        if element.name == "vertex":
            vertices = coordinates(here, [names.index(axis) for axis in "xyz"])
        elif element.name == "face" and which is not None:
            rows_of_faces, lead_of_faces = here, which
        elif element.name == "tristrips" and which is not None:
            # Their entries follow the number of entries, like the corners of faces.
            numbers = [int(word) for row in here for word in (*row[which + 1 : which + 1 + int(row[which])], "-1")]
            strips.append(_strip_triangles(np.array(numbers, np.int64)))
    nothing_more(rows, position)
    triangles = polygon_rows(vertices, rows_of_faces, lead_of_faces)
    return Polygons(vertices, np.concatenate([triangles, *strips]))


def _parse_binary(body: bytes, elements: list[_Element], order: str) -> Polygons:
    vertices, offset = np.zeros((0, 3)), 0
    lists, strips = (np.zeros(0, np.int64), np.zeros(0, np.int64)), []
    for element in elements:
        which = _corner_list(element)
        if which is None:
            dtype = np.dtype([(item.name, order + item.code) for item in element.properties])
            _expect(body, offset, element.rows * dtype.itemsize, element)
            rows = np.frombuffer(body, dtype, element.rows, offset)
            offset += element.rows * dtype.itemsize
            if element.name == "vertex":
                vertices = np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1)
        else:
            corners, sizes, offset = _list_rows(body, element, order, offset, which)
            if element.name == "face":
                lists = corners, sizes
            elif element.name == "tristrips":
                # Each list is a strip of its own.
                strips.append(_strip_triangles(np.insert(corners, np.cumsum(sizes), -1)))
    if elements and offset < len(body.rstrip(b"\r\n\0 ")):
        raise MeshError(
            f"the file holds {len(body) - offset} bytes beyond the rows that its head announces. Correct the numbers "
            "in the head, or export the file again."
        )
    corners, sizes = lists
    triangles = corners[triangulated(vertices, corners, sizes)]
    return Polygons(vertices, np.concatenate([triangles, *strips]))


def _strip_triangles(strips: np.ndarray) -> np.ndarray:
    """The triangles (F, 3) of strips, of which every other one is turned over; a negative number ends a strip."""
    triples = np.stack([strips[:-2], strips[1:-1], strips[2:]], axis=1)
    ends = np.flatnonzero(strips < 0)
    begins = np.concatenate([[0], ends + 1])
    place = np.arange(len(triples))
    is_turned = (place - begins[np.searchsorted(ends, place)]) % 2 == 1
    triples[is_turned] = triples[is_turned][:, [1, 0, 2]]
    is_there = (triples >= 0).all(axis=1)
    # A corner given twice leads to the next strip.
    is_there &= (triples[:, 0] != triples[:, 1]) & (triples[:, 1] != triples[:, 2]) & (triples[:, 0] != triples[:, 2])
    return triples[is_there]


def _list_rows(
    body: bytes, element: _Element, order: str, offset: int, which: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """The entries of one list of all rows, their numbers, and where the next element begins."""
    if element.rows <= 0:
        _expect(body, offset, element.rows, element)
        return np.zeros(0, np.int64), np.zeros(0, np.int64), offset
    # Mostly all rows are alike: then they are one array.
    spans, stop = _row(body, element, order, offset)
    fields = []
    for index, (item, (_, size)) in enumerate(zip(element.properties, spans, strict=True)):
        if item.size_code:
            fields.append((f"size {index}", order + item.size_code))
        fields.append((f"data {index}", order + item.code, (size,)))
    dtype = np.dtype(fields)
    if offset + element.rows * dtype.itemsize <= len(body):
        rows = np.frombuffer(body, dtype, element.rows, offset)
        lists = [index for index, item in enumerate(element.properties) if item.size_code]
        if all(np.all(rows[f"size {index}"] == spans[index][1]) for index in lists):
            corners = rows[f"data {which}"].astype(np.int64).ravel()
            sizes = np.full(element.rows, spans[which][1])
            return corners, sizes, offset + element.rows * dtype.itemsize
    pieces, numbers = [], []
    code = order + element.properties[which].code
    for _ in range(element.rows):
        spans, stop = _row(body, element, order, offset)
        start, size = spans[which]
        pieces.append(np.frombuffer(body, code, size, start))
        numbers.append(size)
        offset = stop
    return np.concatenate(pieces).astype(np.int64), np.array(numbers), offset


def _row(body: bytes, element: _Element, order: str, offset: int) -> tuple[list[tuple[int, int]], int]:
    """Where each property of one row begins and how many entries it has, and where the next row begins."""
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
    """Raises where the file does not hold what its head announces."""
    if length < 0 or offset + length > len(body):
        raise MeshError(
            f"the file announces {element.rows} rows of {element.name}, but its {len(body)} bytes of data end before "
            "them. It may be truncated: export or download it again."
        )
