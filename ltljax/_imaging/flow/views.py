"""The point of a mesh that each pixel shows, from an orthographic depth buffer on the host.

What enters: vertices, faces and a view direction. What leaves: a face and barycentric weights for every pixel that
shows the mesh.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

# Margin around the mesh, relative to the size of the picture.
_MARGIN = 0.04
# Triangles per batch, which bounds memory even if each of them covers many pixels.
_BATCH = 4096


@dataclasses.dataclass(frozen=True)
class View:
    """The points of a mesh that are visible in a picture.

    Attributes:
        mask: (H, W) bool, True at the N pixels that show the mesh; the arrays below list them in reading order.
        face: (N,) visible face.
        weights: (N, 3) barycentric weights of the visible point.
        pixel: width of a pixel, in units of the vertices.
        axes: (3, 3) unit vectors as rows: to the right, upwards, and towards the viewer.
    """

    mask: np.ndarray
    face: np.ndarray
    weights: np.ndarray
    pixel: float
    axes: np.ndarray

    @property
    def towards(self) -> np.ndarray:
        """The direction towards the viewer, (3,)."""
        return self.axes[2]


def look(
    vertices: np.ndarray,
    faces: np.ndarray,
    view: Sequence[float | int],
    up: Sequence[float | int],
    resolution: int,
) -> View:
    """The view of a mesh from a direction, scaled to fill a square picture; faces are visible from both sides.

    Args:
        vertices: (V, 3) positions.
        faces: (F, 3) faces.
        view: direction from the mesh to the viewer.
        up: upward direction in the picture.
        resolution: height and width of the picture in pixels.

    Raises:
        ValueError: the view is along ``up``, or the resolution is not positive.
    """
    axes = axes_of(view, up)
    if resolution < 1:
        raise ValueError(f"Expected a positive resolution, found {resolution}.")
    placed = vertices @ axes.T
    low, high = placed.min(axis=0), placed.max(axis=0)
    pixel = float((high - low)[:2].max()) / (resolution * (1 - 2 * _MARGIN))
    middle = (low + high)[:2] / 2
    # The centre of pixel (row, column) is at (x, y) = (column, row), and rows run downwards.
    x = (placed[:, 0] - middle[0]) / pixel + (resolution - 1) / 2
    y = (middle[1] - placed[:, 1]) / pixel + (resolution - 1) / 2
    corners = np.stack([x, y, placed[:, 2]], axis=1)[faces]
    depth = np.full(resolution**2, -np.inf)
    face, weights = np.zeros(resolution**2, np.int32), np.zeros((resolution**2, 3))
    for begin in range(0, len(faces), _BATCH):
        pixels, triangles, barycentric, height = _covered(corners[begin : begin + _BATCH], resolution)
        # Sorted by pixel and then height, the last candidate of each pixel is the nearest to the viewer.
        order = np.lexsort((height, pixels))
        is_last = np.append(pixels[order][1:] != pixels[order][:-1], True)[: len(order)]
        best = order[is_last]
        best = best[height[best] > depth[pixels[best]]]
        at = pixels[best]
        depth[at], face[at], weights[at] = height[best], begin + triangles[best], barycentric[best]
    mask = np.isfinite(depth)
    return View(mask.reshape(resolution, resolution), face[mask], weights[mask], pixel, axes)


def axes_of(view: Sequence[float | int], up: Sequence[float | int]) -> np.ndarray:
    """The directions to the right, upwards and towards the viewer, as the rows of a (3, 3) array.

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
    """The pixels whose centres lie in triangles (F, 3, 3): pixel, triangle, weights and height of each such pair."""
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
    offset = np.stack([column, row], axis=1) - a[which]
    # Triangles seen edge-on cover no pixels.
    safe = np.where(np.abs(doubled) > 1e-12, doubled, np.inf)[which]
    second, third = _cross(offset, (c - a)[which]) / safe, _cross((b - a)[which], offset) / safe
    weights = np.stack([1 - second - third, second, third], axis=1)
    is_in = (weights >= -1e-9).all(axis=1) & np.isfinite(safe)
    weights, which = np.maximum(weights[is_in], 0), which[is_in]
    weights /= weights.sum(axis=1, keepdims=True)
    height = np.einsum("nk,nk->n", weights, corners[which, :, 2])
    return (row * resolution + column)[is_in], which, weights, height


def _cross(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
