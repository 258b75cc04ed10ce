"""Random and jittered meshes, to measure accuracy on irregular meshes; the same seed gives the same mesh."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import ConvexHull

from .._base.arguments import at_least, not_negative
from .checks import FEWEST_VERTICES
from .lattices import grid_faces, icosahedral_lattice, torus_points
from .mesh import Mesh
from .report import vertex_normals

# Two neighbours that both move by half their spacing can meet.
_LARGEST_SHIFT = 0.5


def random_sphere(num_vertices: int = 2562, seed: int = 0) -> Mesh:
    """A mesh of uniform random points on the unit sphere.

    The faces are those of the convex hull, which is the Delaunay triangulation of the sphere.

    Args:
        num_vertices: number of points, at least 6.
        seed: seed of the random numbers.
    """
    num_vertices = at_least("num_vertices", num_vertices, FEWEST_VERTICES)
    return _hull_sphere(np.random.default_rng(seed).normal(size=(num_vertices, 3)))


def jittered_sphere(subdivisions: int = 4, amount: float | int = 0.5, seed: int = 0) -> Mesh:
    """The unit icosphere with its vertices moved at random along the sphere.

    The faces are those of the convex hull of the moved vertices.

    Args:
        subdivisions: number of subdivisions of the icosphere, 0 to 10.
        amount: largest displacement, as a multiple of the mean edge length.
        seed: seed of the random numbers.
    """
    directions, faces = icosahedral_lattice(subdivisions)
    reach = not_negative("amount", amount) * Mesh(directions, faces).mesh_size
    return _hull_sphere(directions + _random_tangents(directions, reach, np.random.default_rng(seed)))


def jittered_torus(
    n_major: int = 96,
    n_minor: int = 48,
    amount: float | int = 0.3,
    seed: int = 0,
    major: float | int = 2.0,
    minor: float | int = 1.0,
) -> Mesh:
    """The torus of `shapes.torus` with both angles of every vertex changed at random and the same faces.

    Args:
        n_major: number of vertices around the axis, at least 3.
        n_minor: number of vertices around the tube, at least 3.
        amount: largest change, as a multiple of the spacing of the angles; below 0.5.
        seed: seed of the random numbers.
        major: distance of the tube's centre from the axis.
        minor: radius of the tube.
    """
    n_major, n_minor = at_least("n_major", n_major, 3), at_least("n_minor", n_minor, 3)
    if not_negative("amount", amount) >= _LARGEST_SHIFT:
        raise ValueError(f"amount must be below {_LARGEST_SHIFT}, found {amount}: neighbouring vertices could meet.")
    shift_x, shift_y = np.random.default_rng(seed).uniform(-amount, amount, size=(2, n_major * n_minor))
    y = 2 * np.pi * (np.repeat(np.arange(n_major), n_minor) + shift_y) / n_major
    x = 2 * np.pi * (np.tile(np.arange(n_minor), n_major) + shift_x) / n_minor
    vertices, normals = torus_points(x, y, major, minor)
    return Mesh(vertices, grid_faces(n_major, n_minor, wrap_rows=True, wrap_columns=True), normals=normals)


def jittered(
    mesh: Mesh, amount: float | int = 0.25, seed: int = 0, project: Callable[[np.ndarray], np.ndarray] | None = None
) -> Mesh:
    """The mesh with every inner vertex moved at random in its tangent plane, and the same faces and boundary.

    Args:
        mesh: the mesh.
        amount: largest displacement, as a multiple of the mean edge length. Above about 0.3, faces may fold over.
        seed: seed of the random numbers.
        project: function that maps positions (N, 3) back onto the surface, such as ``lambda x: x / norm(x)``. Without
            it, the vertices stay in the tangent planes, which is right for plane shapes.
    """
    normals = mesh.normals if mesh.normals is not None else vertex_normals(mesh.vertices, mesh.faces)
    inner = np.flatnonzero(~mesh.boundary_vertices)
    reach = not_negative("amount", amount) * mesh.mesh_size
    moved = mesh.vertices[inner] + _random_tangents(normals[inner], reach, np.random.default_rng(seed))
    vertices = mesh.vertices.copy()
    vertices[inner] = moved if project is None else project(moved)
    return Mesh(vertices, mesh.faces)


def _random_tangents(normals: np.ndarray, reach: float, random: np.random.Generator) -> np.ndarray:
    """Vectors (N, 3) orthogonal to the unit normals (N, 3), uniform in discs of radius ``reach``."""
    # The cross product with the least aligned axis never degenerates.
    axis = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    first = np.cross(normals, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    # The square root makes the distribution uniform in area.
    radius = reach * np.sqrt(random.uniform(size=len(normals)))
    angle = random.uniform(0, 2 * np.pi, size=len(normals))
    return (radius * np.cos(angle))[:, None] * first + (radius * np.sin(angle))[:, None] * second


def _hull_sphere(points: np.ndarray) -> Mesh:
    """The convex hull of the directions of the points (N, 3), facing outwards."""
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    faces = ConvexHull(directions).simplices.astype(np.int64)
    first, second, third = directions[faces[:, 0]], directions[faces[:, 1]], directions[faces[:, 2]]
    faces_inwards = np.sum(first * np.cross(second, third), axis=1) < 0
    faces[faces_inwards] = faces[faces_inwards][:, [0, 2, 1]]
    return Mesh(directions, faces, normals=directions)
