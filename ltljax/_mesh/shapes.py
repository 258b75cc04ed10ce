"""Built-in shapes, whose geometry is known by formula.

Meshes are oriented outwards (plane ones upwards), and smooth shapes have the exact unit normals of the surface.
Irregular meshes are defined in `irregular` and are also available here.
"""

import numpy as np

from .._base.arguments import at_least, positive
from .irregular import jittered, jittered_sphere, jittered_torus, random_sphere
from .lattices import alternating_faces, disk_lattice, grid_faces, icosahedral_lattice, torus_points
from .mesh import Mesh

__all__ = [
    "box",
    "cylinder",
    "disk",
    "ellipsoid",
    "hemisphere",
    "icosphere",
    "jittered",
    "jittered_sphere",
    "jittered_torus",
    "random_sphere",
    "square",
    "torus",
]


def icosphere(subdivisions: int = 4, radius: float | int = 1.0) -> Mesh:
    """A sphere about the origin: an icosahedron whose faces are subdivided and projected onto the sphere.

    It has 10 * 4^n + 2 vertices: 162, 642, 2562, 10242 for n = 2 to 5 subdivisions.

    Args:
        subdivisions: number of subdivisions, 0 to 10.
        radius: radius of the sphere.
    """
    directions, faces = icosahedral_lattice(subdivisions)
    return Mesh(positive("radius", radius) * directions, faces, normals=directions)


def ellipsoid(axes: tuple[float | int, float | int, float | int] = (1.0, 1.0, 1.0), subdivisions: int = 4) -> Mesh:
    """An ellipsoid about the origin, x^2/a^2 + y^2/b^2 + z^2/c^2 = 1: a stretched icosphere.

    Args:
        axes: semi-axes a, b, c.
        subdivisions: number of subdivisions of the icosphere, 0 to 10.
    """
    if np.shape(axes) != (3,):
        raise ValueError(f"axes must be three semi-axes such as (1.0, 1.0, 0.5), found shape {np.shape(axes)}.")
    half_axes = np.array([positive("each of the axes", axis) for axis in axes])
    directions, faces = icosahedral_lattice(subdivisions)
    gradients = directions / half_axes  # half the gradient of x^2/a^2 + y^2/b^2 + z^2/c^2
    normals = gradients / np.linalg.norm(gradients, axis=1, keepdims=True)
    return Mesh(half_axes * directions, faces, normals=normals)


def torus(major: float | int = 2.0, minor: float | int = 1.0, n_major: int = 96, n_minor: int = 48) -> Mesh:
    """A torus about the z axis: ((a + r cos x) cos y, (a + r cos x) sin y, r sin x).

    Vertex ``i * n_minor + j`` is at y = 2 pi i / n_major, x = 2 pi j / n_minor. All cells are cut along the same
    diagonal, so every vertex has six neighbours.

    Args:
        major: distance a of the tube's centre from the axis; larger than r.
        minor: radius r of the tube.
        n_major: number of vertices around the axis, at least 3.
        n_minor: number of vertices around the tube, at least 3.
    """
    n_major, n_minor = at_least("n_major", n_major, 3), at_least("n_minor", n_minor, 3)
    y = np.repeat(2 * np.pi * np.arange(n_major) / n_major, n_minor)
    x = np.tile(2 * np.pi * np.arange(n_minor) / n_minor, n_major)
    vertices, normals = torus_points(x, y, major, minor)
    return Mesh(vertices, grid_faces(n_major, n_minor, wrap_rows=True, wrap_columns=True), normals=normals)


def disk(radius: float | int = 1.0, rings: int = 16) -> Mesh:
    """A plane disk about the origin in z = 0, facing upwards; ring j has 6 j evenly spaced vertices.

    It has 1 + 3 rings (rings + 1) vertices; the last ring lies on the circle.

    Args:
        radius: radius of the disk.
        rings: number of concentric rings, at least 1.
    """
    distance, angle, faces = disk_lattice(rings)
    vertices = positive("radius", radius) * np.stack(
        [distance * np.cos(angle), distance * np.sin(angle), np.zeros_like(angle)], axis=1
    )
    return Mesh(vertices, faces, normals=np.tile([0.0, 0.0, 1.0], (len(vertices), 1)))


def hemisphere(radius: float | int = 1.0, rings: int = 16) -> Mesh:
    """The upper half of a sphere about the origin; the boundary is the equator, exactly in z = 0.

    Args:
        radius: radius of the sphere.
        rings: number of rings from the pole to the equator, at least 1; ring j has 6 j vertices.
    """
    distance, angle, faces = disk_lattice(rings)
    polar = distance * np.pi / 2
    height = np.where(distance == 1, 0.0, np.cos(polar))
    directions = np.stack([np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle), height], axis=1)
    return Mesh(positive("radius", radius) * directions, faces, normals=directions)


def square(side: float | int = 1.0, n: int = 32) -> Mesh:
    """The plane square [0, side]^2 in z = 0, facing upwards, of n by n cells cut along the same diagonal.

    Vertex ``i * (n + 1) + j`` is at (side j / n, side i / n, 0).

    Args:
        side: length of a side.
        n: number of cells along a side, at least 2.
    """
    n = at_least("n", n, 2)
    side = positive("side", side)
    y, x = np.repeat(np.arange(n + 1) / n, n + 1), np.tile(np.arange(n + 1) / n, n + 1)
    vertices = side * np.stack([x, y, np.zeros_like(x)], axis=1)
    # The rows run along y, so the faces have to be reversed to face upwards.
    faces = grid_faces(n + 1, n + 1, wrap_rows=False, wrap_columns=False)[:, [0, 2, 1]]
    return Mesh(vertices, faces, normals=np.tile([0.0, 0.0, 1.0], (len(vertices), 1)))


def cylinder(radius: float | int = 1.0, height: float | int = 2.0, n_around: int = 64, n_along: int = 20) -> Mesh:
    """The lateral surface of a cylinder about the z axis, -height / 2 <= z <= height / 2, open at both ends.

    Vertex ``i * (n_along + 1) + j`` is at the angle 2 pi i / n_around and the height -height / 2 + j height / n_along.

    Args:
        radius: radius of the cylinder.
        height: height of the cylinder.
        n_around: number of vertices around the axis, at least 3.
        n_along: number of cells along the axis, at least 1.
    """
    n_around, n_along = at_least("n_around", n_around, 3), at_least("n_along", n_along, 1)
    angle = np.repeat(2 * np.pi * np.arange(n_around) / n_around, n_along + 1)
    z = positive("height", height) * np.tile(np.arange(n_along + 1) / n_along - 0.5, n_around)
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    vertices = positive("radius", radius) * normals
    vertices[:, 2] = z
    return Mesh(vertices, grid_faces(n_around, n_along + 1, wrap_rows=True, wrap_columns=False), normals=normals)


def box(sides: tuple[float | int, float | int, float | int] = (1.0, 1.0, 1.0), n: int = 16) -> Mesh:
    """The surface of the box [0, a] x [0, b] x [0, c], of nearly square cells whose diagonals alternate.

    Args:
        sides: lengths a, b, c of the sides.
        n: number of cells along the longest side, at least 2. The other sides have cells of about the same length, at
            least 2.
    """
    if np.shape(sides) != (3,):
        raise ValueError(f"sides must be three lengths such as (1.0, 1.0, 2.0), found shape {np.shape(sides)}.")
    n, lengths = at_least("n", n, 2), np.array([positive("each of the sides", side) for side in sides])
    counts = np.maximum(np.round(n * lengths / lengths.max()).astype(int), 2)
    vertices, faces, start = [], [], 0
    for axis in range(3):
        rows, columns = int(counts[(axis + 1) % 3]), int(counts[(axis + 2) % 3])
        lattice = np.indices((rows + 1, columns + 1)).reshape(2, -1)
        upwards = alternating_faces(rows + 1, columns + 1)
        for level, side_faces in ((0, upwards[:, ::-1]), (counts[axis], upwards)):
            positions = np.empty((lattice.shape[1], 3))
            positions[:, axis], positions[:, (axis + 1) % 3], positions[:, (axis + 2) % 3] = level, *lattice
            vertices.append(positions)
            faces.append(side_faces + start)
            start += len(positions)
    return Mesh(np.concatenate(vertices) / counts * lengths, np.concatenate(faces), weld=True)
