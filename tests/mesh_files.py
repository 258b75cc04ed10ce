"""Mesh files for the tests: good ones in every format, and ways to damage them."""

from collections.abc import Callable

import numpy as np
import trimesh


def obj_text(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """The mesh as OBJ, all digits kept."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += ["f " + " ".join(str(corner + 1) for corner in face) for face in faces.tolist()]
    return ("\n".join(lines) + "\n").encode()


def _export(kind: str, **options) -> Callable[[np.ndarray, np.ndarray], bytes]:
    def write(vertices: np.ndarray, faces: np.ndarray) -> bytes:
        data = trimesh.Trimesh(vertices, faces, process=False).export(file_type=kind, **options)
        return data if isinstance(data, bytes) else str(data).encode()

    return write


# By name: the ending, and what writes the file.
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
    """The file with a few bytes, lines or numbers changed, or cut off."""
    way = random.integers(6)
    if way == 0:  # bytes flipped
        changed = bytearray(data)
        for place in random.integers(len(data), size=random.integers(1, 6)):
            changed[place] ^= 1 << int(random.integers(8))
        return bytes(changed)
    if way == 1:  # the head, where counts and types are, flipped
        changed = bytearray(data)
        for place in random.integers(min(300, len(data)), size=random.integers(1, 3)):
            changed[place] = int(random.integers(256))
        return bytes(changed)
    if way == 2:  # truncated
        return data[: int(random.integers(len(data)))]
    if way == 3:  # lines dropped
        lines = data.split(b"\n")
        for _ in range(random.integers(1, 4)):
            del lines[int(random.integers(len(lines)))]
            if not lines:
                break
        return b"\n".join(lines)
    if way == 4:  # numbers exchanged
        words = data.split(b" ")
        for place in random.integers(len(words), size=random.integers(1, 3)):
            words[place] = _NUMBERS[int(random.integers(len(_NUMBERS)))]
        return b" ".join(words)
    start, stop = np.sort(random.integers(len(data), size=2))  # a piece doubled, after which nothing is in its place
    return data[:stop] + data[start : min(stop, start + 200)] + data[stop:]
