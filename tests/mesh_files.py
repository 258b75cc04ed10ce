"""Mesh files for the tests: intact files in every format, and ways to damage them."""

import base64
import gzip
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from ltljax._mesh import shapes


def obj_text(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """The mesh as an OBJ with all digits."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += ["f " + " ".join(str(corner + 1) for corner in face) for face in faces.tolist()]
    return ("\n".join(lines) + "\n").encode()


def _export(kind: str, **options) -> Callable[[np.ndarray, np.ndarray], bytes]:
    def write(vertices: np.ndarray, faces: np.ndarray) -> bytes:
        data = trimesh.Trimesh(vertices, faces, process=False).export(file_type=kind, **options)
        return data if isinstance(data, bytes) else str(data).encode()

    return write


# The suffix and the writer of each format.
WRITERS: dict[str, tuple[str, Callable[[np.ndarray, np.ndarray], bytes]]] = {
    "obj": ("obj", obj_text),
    "ply text": ("ply", _export("ply", encoding="ascii")),
    "ply binary": ("ply", _export("ply")),
    "stl": ("stl", _export("stl")),
    "stl text": ("stl", _export("stl_ascii")),
    "off": ("off", _export("off", digits=17)),
    "glb": ("glb", _export("glb")),
}

_NUMBERS = [
    b"-1",
    b"0",
    b"1000000000000",
    b"99999999999999999999999",
    b"1e400",
    b"-1e308",
    b"nan",
    b"inf",
    b"1e-320",
    b"x",
    b"",
]


def damaged(data: bytes, random: np.random.Generator) -> bytes:
    """The file with changed bytes, lines or numbers, or a part of it."""
    kind = random.integers(6)
    if kind == 0:  # flip bits
        changed = bytearray(data)
        for position in random.integers(len(data), size=random.integers(1, 6)):
            changed[position] ^= 1 << int(random.integers(8))
        return bytes(changed)
    if kind == 1:  # change bytes of the header, which contains counts and types
        changed = bytearray(data)
        for position in random.integers(min(300, len(data)), size=random.integers(1, 3)):
            changed[position] = int(random.integers(256))
        return bytes(changed)
    if kind == 2:  # truncate
        return data[: int(random.integers(len(data)))]
    if kind == 3:  # drop lines
        lines = data.split(b"\n")
        for _ in range(random.integers(1, 4)):
            del lines[int(random.integers(len(lines)))]
            if not lines:
                break
        return b"\n".join(lines)
    if kind == 4:  # replace numbers
        words = data.split(b" ")
        for position in random.integers(len(words), size=random.integers(1, 3)):
            words[position] = _NUMBERS[int(random.integers(len(_NUMBERS)))]
        return b" ".join(words)
    start, stop = np.sort(random.integers(len(data), size=2))  # repeat a piece, which shifts all data after it
    return data[:stop] + data[start : min(stop, start + 200)] + data[stop:]


def written(folder: Path, name: str, data: bytes | str) -> Path:
    """The path of a new file with this content."""
    path = folder / name
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


def gltf(uri: str, change=None) -> str:
    """An icosphere of 42 vertices and 80 faces as text glTF, with its buffer at ``uri``."""
    tree = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 42 * 12 + 80 * 12, "uri": uri}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 42 * 12},
            {"buffer": 0, "byteOffset": 42 * 12, "byteLength": 80 * 12},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 42, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 80 * 3, "type": "SCALAR"},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "nodes": [{"mesh": 0, "children": []}],
        "scenes": [{"nodes": [0]}],
    }
    if change:
        change(tree)
    return json.dumps(tree)


def gltf_buffer() -> bytes:
    """The buffer of `gltf`."""
    ball = shapes.icosphere(1)
    return ball.vertices.astype("<f4").tobytes() + ball.faces.astype("<u4").tobytes()


def in_every_format(shape, folder):
    """The suffix and the content of a file of the shape in every format that can be read."""
    pyvista, meshio, nibabel = (pytest.importorskip(name) for name in ("pyvista", "meshio", "nibabel"))
    for name in ("a.vtk", "a.vtu"):
        meshio.Mesh(shape.vertices, [("triangle", shape.faces)]).write(folder / name)
    meshio.Mesh(shape.vertices, [("triangle", shape.faces)]).write(folder / "a.msh", file_format="gmsh22")
    surface = pyvista.PolyData.from_regular_faces(shape.vertices, shape.faces)
    for name in ("b.vtk", "a.vtp"):
        surface.save(str(folder / name))
    arrays = [
        nibabel.gifti.GiftiDataArray(shape.vertices.astype(np.float32), intent="NIFTI_INTENT_POINTSET"),
        nibabel.gifti.GiftiDataArray(shape.faces.astype(np.int32), intent="NIFTI_INTENT_TRIANGLE"),
    ]
    nibabel.save(nibabel.gifti.GiftiImage(darrays=arrays), folder / "a.gii")
    nibabel.freesurfer.write_geometry(folder / "lh.pial", shape.vertices, shape.faces)
    rows = [f"{x} {y} {z} 0" for x, y, z in shape.vertices] + [f"{a} {b} {c} 0" for a, b, c in shape.faces]
    written(folder, "a.asc", f"#!ascii\n{shape.num_vertices} {shape.num_faces}\n" + "\n".join(rows) + "\n")
    inside = "data:application/octet-stream;base64," + base64.b64encode(gltf_buffer()).decode()
    written(folder, "a.gltf", gltf(inside))
    written(folder, "a.obj.gz", gzip.compress(WRITERS["obj"][1](shape.vertices, shape.faces)))
    files = [(path.name.split(".", 1)[1], path.read_bytes()) for path in folder.iterdir()]
    return files + [(suffix, write(shape.vertices, shape.faces)) for suffix, write in WRITERS.values()]
