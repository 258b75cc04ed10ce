"""Which point of a mesh a pixel sees: a depth buffer without perspective, on the host.

What enters: vertices, faces, and where to look from. What leaves: for every pixel that shows the mesh a face and
barycentric weights.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

# Around the mesh, as a share of the picture.
_MARGIN = 0.04
# Triangles at once, so that memory stays small however large they are in the picture.
_BATCH = 4096


@dataclasses.dataclass(frozen=True)
class View:
    """What a picture shows.

    Attributes:
        mask: (H, W) bool, where the mesh is; N pixels in reading order.
        face: (N,) the face seen there.
        weights: (N, 3) barycentric, of the point seen.
        pixel: the width of a pixel, in units of the vertices.
        axes: (3, 3) rows: to the right, upwards, and towards the eye.
    """

    mask: np.ndarray
    face: np.ndarray
    weights: np.ndarray
    pixel: float
    axes: np.ndarray

    @property
    def towards(self) -> np.ndarray:
        """The direction towards the eye, (3,)."""
        return self.axes[2]


def look(
    vertices: np.ndarray,
    faces: np.ndarray,
    view: Sequence[float | int],
    up: Sequence[float | int],
    resolution: int,
) -> View:
    """The mesh seen from a direction, filling a square picture; both sides of faces are seen.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        view: from where.
        up: what points upwards in the picture.
        resolution: pixels of its height and width.

    Raises:
        ValueError: the view is along ``up``, or there are no pixels.
    """
    axes = axes_of(view, up)
    if resolution < 1:
        raise ValueError(f"Expected a positive resolution, found {resolution}.")
    placed = vertices @ axes.T
    low, high = placed.min(axis=0), placed.max(axis=0)
    pixel = float((high - low)[:2].max()) / (resolution * (1 - 2 * _MARGIN))
    middle = (low + high)[:2] / 2
    # Pixel (row, column) has its centre at (column, row): rows run downwards.
    x = (placed[:, 0] - middle[0]) / pixel + (resolution - 1) / 2
    y = (middle[1] - placed[:, 1]) / pixel + (resolution - 1) / 2
    corners = np.stack([x, y, placed[:, 2]], axis=1)[faces]
    depth = np.full(resolution**2, -np.inf)
    face, weights = np.zeros(resolution**2, np.int32), np.zeros((resolution**2, 3))
    for begin in range(0, len(faces), _BATCH):
        where, which, share, height = _covered(corners[begin : begin + _BATCH], resolution)
        # The nearest of a pixel's candidates comes last, and of equal indices the last is kept.
        order = np.lexsort((height, where))
        last = np.append(where[order][1:] != where[order][:-1], True)[: len(order)]
        best = order[last]
        best = best[height[best] > depth[where[best]]]
        depth[where[best]], face[where[best]], weights[where[best]] = height[best], begin + which[best], share[best]
    mask = np.isfinite(depth)
    return View(mask.reshape(resolution, resolution), face[mask], weights[mask], pixel, axes)


def axes_of(view: Sequence[float | int], up: Sequence[float | int]) -> np.ndarray:
    """What points right, up and towards the eye, unit vectors as rows (3, 3).

    Raises:
        ValueError: the view is along ``up``.
    """
    towards, upwards = np.asarray(view, np.float64), np.asarray(up, np.float64)
    right = np.cross(upwards, towards)
    if not np.linalg.norm(right) > 1e-8 * np.linalg.norm(towards) * np.linalg.norm(upwards):
        raise ValueError(f"Expected a view that is not along up, found the view {view} and up {up}.")
    right, towards = right / np.linalg.norm(right), towards / np.linalg.norm(towards)
    return np.stack([right, np.cross(towards, right), towards])


def _covered(corners: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The pixels whose centres lie in triangles (F, 3, 3): pixel, triangle, weights and height of each meeting."""
    low = np.clip(np.ceil(corners[:, :, :2].min(axis=1)), 0, resolution).astype(np.int64)
    high = np.clip(np.floor(corners[:, :, :2].max(axis=1)), -1, resolution - 1).astype(np.int64)
    size = np.maximum(high - low + 1, 0)
    count = size[:, 0] * size[:, 1]
    which = np.repeat(np.arange(len(corners)), count)
    number = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    column = low[which, 0] + number % size[which, 0]
    row = low[which, 1] + number // size[which, 0]
    a, b, c = np.moveaxis(corners[:, :, :2], 1, 0)
    doubled = _cross(b - a, c - a)
    at = np.stack([column, row], axis=1) - a[which]
    # Triangles seen from their edge cover nothing.
    safe = np.where(np.abs(doubled) > 1e-12, doubled, np.inf)[which]
    second, third = _cross(at, (c - a)[which]) / safe, _cross((b - a)[which], at) / safe
    weights = np.stack([1 - second - third, second, third], axis=1)
    is_in = (weights >= -1e-9).all(axis=1) & np.isfinite(safe)
    weights, which = np.maximum(weights[is_in], 0), which[is_in]
    weights /= weights.sum(axis=1, keepdims=True)
    height = np.einsum("nk,nk->n", weights, corners[which, :, 2])
    return (row * resolution + column)[is_in], which, weights, height


def _cross(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
