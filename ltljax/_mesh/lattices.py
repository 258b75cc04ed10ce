"""The regular lattices that the built-in shapes are made of: parameters or unit positions, and faces (F, 3)."""

import numpy as np

from .._base.arguments import at_least, positive

# Ten subdivisions give ten million vertices. A larger number is most likely a mistake.
_MOST_SUBDIVISIONS = 10


def grid_faces(num_rows: int, num_columns: int, *, wrap_rows: bool, wrap_columns: bool) -> np.ndarray:
    """The triangles of a lattice whose vertex (i, j) has the index ``i * num_columns + j``.

    Each cell is cut along the diagonal from (i, j) to (i + 1, j + 1). Triangles are oriented from the direction of
    increasing i to the direction of increasing j.

    Args:
        num_rows: number of rows.
        num_columns: number of columns.
        wrap_rows: whether the last row is joined to the first.
        wrap_columns: whether the last column is joined to the first.
    """
    i = np.arange(num_rows if wrap_rows else num_rows - 1)[:, None]
    j = np.arange(num_columns if wrap_columns else num_columns - 1)[None, :]
    below, right = (i + 1) % num_rows, (j + 1) % num_columns
    corner, down = i * num_columns + j, below * num_columns + j
    across, side = below * num_columns + right, i * num_columns + right
    return np.stack([corner, down, across, corner, across, side], axis=-1).reshape(-1, 3)


def alternating_faces(num_rows: int, num_columns: int) -> np.ndarray:
    """The triangles of a lattice as in `grid_faces`, but with diagonals that alternate between neighbouring cells."""
    faces = grid_faces(num_rows, num_columns, wrap_rows=False, wrap_columns=False).reshape(-1, 6)
    corner, down, across, _, _, side = faces.T
    other_diagonal = np.stack([corner, down, side, down, across, side], axis=1)
    is_odd = np.indices((num_rows - 1, num_columns - 1)).sum(axis=0).reshape(-1, 1) % 2 == 1
    return np.where(is_odd, other_diagonal, faces).reshape(-1, 3)


def torus_points(x: np.ndarray, y: np.ndarray, major: float | int, minor: float | int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and unit normals (V, 3) of a torus.

    Args:
        x: (V,) angles around the tube.
        y: (V,) angles around the axis.
        major: distance of the tube's centre from the axis.
        minor: radius of the tube.
    """
    major, minor = positive("major", major), positive("minor", minor)
    if minor >= major:
        raise ValueError(
            f"minor must be smaller than major, found {minor} and {major}: the torus would intersect itself."
        )
    normals = np.stack([np.cos(x) * np.cos(y), np.cos(x) * np.sin(y), np.sin(x)], axis=1)
    centres = major * np.stack([np.cos(y), np.sin(y), np.zeros_like(y)], axis=1)
    return centres + minor * normals, normals


def disk_lattice(rings: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances (V,) up to 1, angles (V,) and faces (F, 3) of a disk: a centre and rings of 6, 12, 18, ... vertices."""
    rings = at_least("rings", rings, 1)
    ring = np.repeat(np.arange(rings + 1), np.maximum(6 * np.arange(rings + 1), 1))
    first = np.concatenate([[0], 1 + 3 * np.arange(rings + 1) * np.arange(1, rings + 2)])  # first vertex of each ring
    place = np.arange(len(ring)) - first[ring]
    angle = 2 * np.pi * place / np.maximum(6 * ring, 1)
    faces = []
    for inner in range(rings):
        outer = inner + 1
        # In each of the six sectors, outer edge i faces inner vertex i, and inner edge i faces outer vertex i + 1.
        sector, i = (index.ravel() for index in np.indices((6, outer)))
        out = first[outer] + sector * outer + i
        out_next = first[outer] + (sector * outer + i + 1) % (6 * outer)
        around = max(6 * inner, 1)
        apex = first[inner] + (sector * inner + i) % around
        apex_next = first[inner] + (sector * inner + i + 1) % around
        is_inner_edge = i < inner
        faces.append(np.stack([out, out_next, apex], axis=1))
        faces.append(np.stack([apex, out_next, apex_next], axis=1)[is_inner_edge])
    return ring / rings, angle, np.concatenate(faces)


def icosahedral_lattice(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (V, 3) and outward-facing faces (F, 3) of the subdivided icosahedron."""
    subdivisions = at_least("subdivisions", subdivisions, 0, _MOST_SUBDIVISIONS)
    # The north pole, an upper and a lower ring of five vertices (the lower rotated by 36 degrees), and the south pole.
    angle = 2 * np.pi * np.arange(5) / 5
    z, rho = 1 / np.sqrt(5), 2 / np.sqrt(5)
    upper = np.stack([rho * np.cos(angle), rho * np.sin(angle), np.full(5, z)], axis=1)
    lower = np.stack([rho * np.cos(angle + np.pi / 5), rho * np.sin(angle + np.pi / 5), np.full(5, -z)], axis=1)
    directions = np.concatenate([[[0, 0, 1]], upper, lower, [[0, 0, -1]]])
    i, after = np.arange(5), (np.arange(5) + 1) % 5
    faces = np.concatenate(
        [
            np.stack([np.zeros(5, int), 1 + i, 1 + after], axis=1),
            np.stack([1 + i, 6 + i, 1 + after], axis=1),
            np.stack([1 + after, 6 + i, 6 + after], axis=1),
            np.stack([np.full(5, 11), 6 + after, 6 + i], axis=1),
        ]
    )
    for _ in range(subdivisions):
        directions, faces = _subdivided(directions, faces)
    return directions, faces


def _subdivided(directions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every face split into four at the midpoints of its edges, which are projected onto the unit sphere."""
    ahead = np.roll(faces, -1, axis=1)
    low, high = np.minimum(faces, ahead), np.maximum(faces, ahead)
    keys, inverse = np.unique(low * len(directions) + high, return_inverse=True)
    ends = directions[keys // len(directions)], directions[keys % len(directions)]
    midpoints = ends[0] + ends[1]
    midpoints /= np.linalg.norm(midpoints, axis=1, keepdims=True)
    midpoint = len(directions) + inverse.reshape(-1, 3)
    (a, b, c), (ab, bc, ca) = faces.T, midpoint.T
    corners = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    finer = np.stack([np.stack(face, axis=1) for face in corners], axis=1).reshape(-1, 3)
    return np.concatenate([directions, midpoints]), finer
