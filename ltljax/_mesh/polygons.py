"""Polygons become triangles.

What enters: positions, and the corners of all polygons one after the other. What leaves: triangles that cover each
polygon once and have its corners and no others, so that neighbouring faces still share their edges.
"""

from collections.abc import Sequence

import numpy as np

from .errors import MeshError

# Pairs of sides that are looked at together.
_PAIRS = 1_000_000
# Areas below this share of the polygon's own are rounding.
_FLAT = 1e-12


def triangulated(
    vertices: np.ndarray, corners: Sequence[int] | np.ndarray, sizes: Sequence[int] | np.ndarray
) -> np.ndarray:
    """Triangles (F, 3) as places in the list of corners.

    A polygon is split into a fan from its first corner where that covers it once, as it does a convex one, and
    otherwise by repeatedly cutting off its best ear. It is projected along its Newell normal, since it need not be
    planar.

    Args:
        vertices: (V, 3).
        corners: the corners of all polygons, one after the other.
        sizes: the number of corners of each polygon.

    Raises:
        MeshError: a polygon has fewer than three corners, or crosses itself.
    """
    flat, counts = np.asarray(corners, dtype=np.int64), np.asarray(sizes, dtype=np.int64)
    vertices = np.asarray(vertices, np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        vertices = np.zeros((0, 3))  # which the checks of the mesh refuse
    if np.any(counts < 3):
        first = int(np.flatnonzero(counts < 3)[0])
        raise MeshError(f"face {first} has {counts[first]} corners; it needs at least three. Correct or remove it.")
    begins = np.cumsum(counts) - counts
    start = np.repeat(begins, counts - 2)
    step = np.arange(len(start)) - np.repeat(np.cumsum(counts - 2) - (counts - 2), counts - 2)
    triangles = np.stack([start, start + step + 1, start + step + 2], axis=1)
    first_triangle = np.cumsum(counts - 2) - (counts - 2)
    for size in np.unique(counts[counts > 3]):
        which = np.flatnonzero(counts == size)
        places = begins[which, None] + np.arange(size)
        for face in which[_needs_ears(vertices, flat[places])] if len(vertices) else ():
            ears = _ears(_seen_from_its_normal(vertices[flat[begins[face] + np.arange(size)]]))
            if ears is None:
                raise MeshError(f"face {face} crosses itself. Correct it, or split it into triangles.")
            triangles[first_triangle[face] + np.arange(size - 2)] = begins[face] + ears
    return triangles


def _needs_ears(vertices: np.ndarray, polygons: np.ndarray) -> np.ndarray:
    """Which of the polygons (N, K) a fan from the first corner would not cover exactly once, with triangles of some
    area."""
    is_known = np.all((polygons >= 0) & (polygons < len(vertices)), axis=1)
    points = vertices[np.where(is_known[:, None], polygons, 0)]
    with np.errstate(over="ignore", invalid="ignore"):
        spokes = points[:, 1:] - points[:, :1]
        areas = np.cross(spokes[:, :-1], spokes[:, 1:])
        normals = areas.sum(axis=1, keepdims=True)
        square = (normals**2).sum(axis=2)
        is_bad = ((areas * normals).sum(axis=2) <= _FLAT * square).any(axis=1)
        # A fan may also wind around its first corner more than once.
        along = (spokes[:, :-1] * spokes[:, 1:]).sum(axis=2)
        is_bad |= np.arctan2(np.linalg.norm(areas, axis=2), along).sum(axis=1) >= 2 * np.pi
        # Polygons without an area or with infinite corners are left to the checks of the mesh, which name them.
        return is_bad & is_known & np.isfinite(square[:, 0]) & (square[:, 0] > 0)


def _seen_from_its_normal(points: np.ndarray) -> np.ndarray:
    """A polygon (K, 3) in the plane (K,), as complex numbers, turning to the left."""
    points = points - points[0]
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    normal = normal / np.linalg.norm(normal)
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across = across / np.linalg.norm(across)
    return points @ across + 1j * (points @ np.cross(normal, across))


def _ears(points: np.ndarray) -> np.ndarray | None:
    """The triangles (K - 2, 3) of a polygon (K,) that turns to the left; None where it crosses itself."""
    least = _FLAT * abs(np.imag(np.conj(points) * np.roll(points, -1)).sum())
    if _crosses_itself(points, least):
        return None
    size = len(points)
    before, after = np.roll(np.arange(size), 1), np.roll(np.arange(size), -1)
    is_left = np.ones(size, bool)
    turns = np.array([_shape(points[[before[v], v, after[v]]])[0] for v in range(size)])

    def quality(corner: int) -> float:
        """How well shaped the ear at a corner is; zero where there is none."""
        ear = np.array([before[corner], corner, after[corner]])
        area, shape = _shape(points[ear])
        if not area > least:
            return 0.0
        # If a corner lies in the ear, one where the polygon turns to the right, or not at all, does.
        blocking = np.flatnonzero(is_left & (turns <= least))
        return 0.0 if _holds_any(points[ear], points[blocking[~np.isin(blocking, ear)]]) else shape

    qualities = np.array([quality(corner) for corner in range(size)])
    triangles = []
    for _ in range(size - 3):
        best = int(np.argmax(qualities))
        if not qualities[best] > 0:  # corners that blocked others may have been cut off since
            left = np.flatnonzero(is_left)
            qualities[left] = [quality(corner) for corner in left.tolist()]
            best = int(np.argmax(qualities))
            if not qualities[best] > 0:
                # Where sides have no length, or run along one another, only triangles without area are left to cut off,
                # which the checks of the mesh name.
                flat = left[np.abs(turns[left]) <= least]
                if not len(flat):
                    return None
                best = int(flat[0])
        triangles.append([before[best], best, after[best]])
        is_left[best], qualities[best] = False, -1.0
        after[before[best]], before[after[best]] = after[best], before[best]
        neighbours = (int(before[best]), int(after[best]))
        for corner in neighbours:
            turns[corner] = _shape(points[[before[corner], corner, after[corner]]])[0]
        for corner in neighbours:
            qualities[corner] = quality(corner)
    last = np.flatnonzero(is_left)
    return None if _shape(points[last])[0] < -least else np.array([*triangles, last])


def _shape(triangle: np.ndarray) -> tuple[float, float]:
    """Twice the signed area, and that over the sum of the squared sides."""
    sides = np.roll(triangle, -1) - triangle
    area = float(np.imag(np.conj(sides[0]) * sides[1]))
    square = float((np.abs(sides) ** 2).sum())
    return area, area / square if square > 0 else 0.0


def _holds_any(triangle: np.ndarray, points: np.ndarray) -> bool:
    """Whether any of the points is in the triangle or on its rim, other than at its corners."""
    sides = np.roll(triangle, -1) - triangle
    beside = np.imag(np.conj(sides)[:, None] * (points[None] - triangle[:, None]))
    slack = _FLAT * (np.abs(sides) ** 2).sum()
    is_corner = (np.abs(points[None] - triangle[:, None]) == 0).any(axis=0)
    return bool(((beside >= -slack).all(axis=0) & ~is_corner).any())


def _crosses_itself(points: np.ndarray, least: float) -> bool:
    """Whether two sides that share no corner cross; areas up to ``least`` are rounding."""
    begin, end, size = points, np.roll(points, -1), len(points)

    def are_on_two_sides(a, b, p, q):
        one, other = (np.imag(np.conj(b - a) * (point - a)) for point in (p, q))
        return (np.minimum(one, other) < -least) & (np.maximum(one, other) > least)

    rows = max(1, _PAIRS // size)
    for start in range(0, size, rows):
        first = np.arange(start, min(start + rows, size))[:, None]
        second = np.arange(size)[None]
        is_pair = (second > first + 1) & ~((first == 0) & (second == size - 1))
        a, b, c, d = begin[first], end[first], begin[second], end[second]
        if (are_on_two_sides(a, b, c, d) & are_on_two_sides(c, d, a, b) & is_pair).any():
            return True
    return False
