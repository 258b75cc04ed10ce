"""Triangulation of polygons.

The triangles cover each polygon once and use its corners only, so that neighbouring faces still share their edges.
"""

from collections.abc import Sequence

import numpy as np

from .errors import MeshError

# Number of pairs of sides that are tested at a time.
_PAIRS = 1_000_000
# Areas below this share of the polygon's area are rounding errors.
_FLAT = 1e-12


def triangulated(
    vertices: np.ndarray, corners: Sequence[int] | np.ndarray, sizes: Sequence[int] | np.ndarray
) -> np.ndarray:
    """Triangles (F, 3) as indices into the list of corners.

    A polygon is split into a fan from its first corner if the fan covers it once, as it does for convex polygons.
    Otherwise, its best-shaped ear is cut off repeatedly. A polygon need not be planar: it is projected along its Newell
    normal.

    Args:
        vertices: (V, 3).
        corners: corners of all polygons, concatenated.
        sizes: number of corners of each polygon.

    Raises:
        MeshError: a polygon has fewer than three corners, or crosses itself.
    """
    flat, counts = np.asarray(corners, dtype=np.int64), np.asarray(sizes, dtype=np.int64)
    vertices = np.asarray(vertices, np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        vertices = np.zeros((0, 3))  # the checks of the mesh report the shape
    if np.any(counts < 3):
        first = int(np.flatnonzero(counts < 3)[0])
        raise MeshError(f"face {first} has {counts[first]} corners; it needs at least three. Correct or remove it.")
    begins = np.cumsum(counts) - counts
    start = np.repeat(begins, counts - 2)
    step = np.arange(len(start)) - np.repeat(np.cumsum(counts - 2) - (counts - 2), counts - 2)
    triangles = np.stack([start, start + step + 1, start + step + 2], axis=1)
    first_triangle = np.cumsum(counts - 2) - (counts - 2)
    for size in np.unique(counts[counts > 3]):
        polygons = np.flatnonzero(counts == size)
        places = begins[polygons, None] + np.arange(size)
        for face in polygons[_needs_ears(vertices, flat[places])] if len(vertices) else ():
            ears = _ears(_projected(vertices[flat[begins[face] + np.arange(size)]]))
            if ears is None:
                raise MeshError(f"face {face} crosses itself. Correct it, or split it into triangles.")
            triangles[first_triangle[face] + np.arange(size - 2)] = begins[face] + ears
    return triangles


def _needs_ears(vertices: np.ndarray, polygons: np.ndarray) -> np.ndarray:
    """Whether the fan from the first corner fails for each polygon (N, K).

    It fails if it covers a part of the polygon twice, or has a triangle without area.
    """
    is_known = np.all((polygons >= 0) & (polygons < len(vertices)), axis=1)
    points = vertices[np.where(is_known[:, None], polygons, 0)]
    with np.errstate(over="ignore", invalid="ignore"):
        spokes = points[:, 1:] - points[:, :1]
        areas = np.cross(spokes[:, :-1], spokes[:, 1:])
        normals = areas.sum(axis=1, keepdims=True)
        square = (normals**2).sum(axis=2)
        is_bad = ((areas * normals).sum(axis=2) <= _FLAT * square).any(axis=1)
        # The fan may also wind around its first corner more than once.
        along = (spokes[:, :-1] * spokes[:, 1:]).sum(axis=2)
        is_bad |= np.arctan2(np.linalg.norm(areas, axis=2), along).sum(axis=1) >= 2 * np.pi
        # The checks of the mesh report polygons without area and polygons with infinite corners.
        return is_bad & is_known & np.isfinite(square[:, 0]) & (square[:, 0] > 0)


def _projected(points: np.ndarray) -> np.ndarray:
    """A polygon (K, 3) projected along its Newell normal, as complex numbers (K,) in counter-clockwise order."""
    points = points - points[0]
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    normal = normal / np.linalg.norm(normal)
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across = across / np.linalg.norm(across)
    return points @ across + 1j * (points @ np.cross(normal, across))


def _ears(points: np.ndarray) -> np.ndarray | None:
    """The triangles (K - 2, 3) of a counter-clockwise polygon (K,); None if it crosses itself."""
    tolerance = _FLAT * abs(np.imag(np.conj(points) * np.roll(points, -1)).sum())
    if _crosses_itself(points, tolerance):
        return None
    size = len(points)
    before, after = np.roll(np.arange(size), 1), np.roll(np.arange(size), -1)
    is_uncut = np.ones(size, bool)
    turns = np.array([_area_and_shape(points[[before[v], v, after[v]]])[0] for v in range(size)])

    def quality(corner: int) -> float:
        """The shape of the ear at a corner; zero if the corner is no ear."""
        ear = np.array([before[corner], corner, after[corner]])
        area, shape = _area_and_shape(points[ear])
        if not area > tolerance:
            return 0.0
        # Only corners that are not convex need testing: if any corner lies in the ear, such a corner does too.
        blocking = np.flatnonzero(is_uncut & (turns <= tolerance))
        return 0.0 if _contains_any(points[ear], points[blocking[~np.isin(blocking, ear)]]) else shape

    qualities = np.array([quality(corner) for corner in range(size)])
    triangles = []
    for _ in range(size - 3):
        best = int(np.argmax(qualities))
        if not qualities[best] > 0:  # corners that blocked others may have been cut off since
            uncut = np.flatnonzero(is_uncut)
            qualities[uncut] = [quality(corner) for corner in uncut.tolist()]
            best = int(np.argmax(qualities))
            if not qualities[best] > 0:
                # If sides have no length or overlap, only triangles without area remain. The checks of the mesh report
                # them.
                flat = uncut[np.abs(turns[uncut]) <= tolerance]
                if not len(flat):
                    return None
                best = int(flat[0])
        triangles.append([before[best], best, after[best]])
        is_uncut[best], qualities[best] = False, -1.0
        after[before[best]], before[after[best]] = after[best], before[best]
        neighbours = (int(before[best]), int(after[best]))
        for corner in neighbours:
            turns[corner] = _area_and_shape(points[[before[corner], corner, after[corner]]])[0]
        for corner in neighbours:
            qualities[corner] = quality(corner)
    last = np.flatnonzero(is_uncut)
    return None if _area_and_shape(points[last])[0] < -tolerance else np.array([*triangles, last])


def _area_and_shape(triangle: np.ndarray) -> tuple[float, float]:
    """Twice the signed area of a triangle (3,), and its ratio to the sum of the squared sides."""
    sides = np.roll(triangle, -1) - triangle
    area = float(np.imag(np.conj(sides[0]) * sides[1]))
    square = float((np.abs(sides) ** 2).sum())
    return area, area / square if square > 0 else 0.0


def _contains_any(triangle: np.ndarray, points: np.ndarray) -> bool:
    """Whether the triangle contains any of the points, in its interior or on a side but not at a corner."""
    sides = np.roll(triangle, -1) - triangle
    areas = np.imag(np.conj(sides)[:, None] * (points[None] - triangle[:, None]))
    tolerance = _FLAT * (np.abs(sides) ** 2).sum()
    is_corner = (np.abs(points[None] - triangle[:, None]) == 0).any(axis=0)
    return bool(((areas >= -tolerance).all(axis=0) & ~is_corner).any())


def _crosses_itself(points: np.ndarray, tolerance: float) -> bool:
    """Whether two sides that share no corner cross; areas up to ``tolerance`` are rounding errors."""
    begin, end, size = points, np.roll(points, -1), len(points)

    def separates(a, b, p, q):
        """Whether p and q lie on different sides of the line through a and b."""
        area_p, area_q = (np.imag(np.conj(b - a) * (point - a)) for point in (p, q))
        return (np.minimum(area_p, area_q) < -tolerance) & (np.maximum(area_p, area_q) > tolerance)

    rows = max(1, _PAIRS // size)
    for start in range(0, size, rows):
        first = np.arange(start, min(start + rows, size))[:, None]
        second = np.arange(size)[None]
        is_pair = (second > first + 1) & ~((first == 0) & (second == size - 1))
        a, b, c, d = begin[first], end[first], begin[second], end[second]
        if (separates(a, b, c, d) & separates(c, d, a, b) & is_pair).any():
            return True
    return False
