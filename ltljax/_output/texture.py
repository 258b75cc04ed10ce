"""A field painted into the image that a mesh's UV map leads to, and the mesh with that image as OBJ.

What enters: NumPy arrays. What leaves: pixels; an OBJ with its MTL and PNG (with the extra `viz`).
"""

from pathlib import Path

import numpy as np

from .files import write_obj

# Triangles are painted in groups whose boxes have at most this many pixels together.
_PIXELS = 4_000_000
# A map whose faces have more pixels than this many images is tiled: each pixel would stand for many places.
_OVERLAPS = 8
# By how many pixels every chart is widened, so that no seam shows where an image is drawn smaller.
_MARGIN = 4


def bake(uv: np.ndarray | None, faces: np.ndarray, values: np.ndarray, size: int = 1024) -> np.ndarray:
    """The field as an image (size, size), the first row at the top, NaN where no face lies.

    Linear inside each face; charts are widened by a few pixels.

    Args:
        uv: (F, 3, 2), as `Mesh.uv`, from 0 to 1 with v upwards; what lies outside is repeated.
        faces: (F, 3).
        values: (V,) or (V, C), then the image is (size, size, C).
        size: of the image in pixels.

    Raises:
        ValueError: there is no UV map, it is tiled or not finite, or shapes do not fit.
    """
    if uv is None:
        raise ValueError(
            "The mesh has no UV map: its file names no texture coordinates. Unwrap it first, in Blender say."
        )
    if uv.shape != (*faces.shape, 2):
        raise ValueError(f"Expected uv of shape {(*faces.shape, 2)}, found {uv.shape}.")
    if values.ndim not in (1, 2) or faces.max() >= len(values):
        raise ValueError(f"Expected values of shape ({faces.max() + 1},) or more, found {values.shape}.")
    columns = values.reshape(len(values), -1).astype(np.float64)
    if not np.isfinite(uv).all():
        face = int(np.argmin(np.isfinite(uv).all(axis=(1, 2))))
        raise ValueError(f"Expected a UV map of finite numbers, found others in face {face}. Unwrap the mesh anew.")
    extents = np.ptp(uv, axis=1)
    if (extents > 1).any() or 0.5 * extents.prod(axis=1).sum() > _OVERLAPS:
        raise ValueError(
            f"Expected a UV map that covers the image at most {_OVERLAPS} times, with faces no larger than it; found "
            f"faces as large as {extents.max():.3g} images, {0.5 * extents.prod(axis=1).sum():.3g} images in all. The "
            "map is tiled: unwrap the mesh anew, without repetition."
        )
    # What lies far outside is repeated, so whole turns may be left out.
    turns: np.ndarray = np.floor(uv.min(axis=1, keepdims=True))
    uv = uv - turns
    # Pixel centres lie at whole numbers.
    corners = uv * [size, -size] + [-0.5, size - 0.5]
    low = np.ceil(corners.min(axis=1)).astype(int)
    spans = np.maximum(np.floor(corners.max(axis=1)).astype(int) - low + 1, 0)
    counts = spans[:, 0] * spans[:, 1]
    image = np.full((size * size, columns.shape[1]), np.nan)
    for group in np.split(np.arange(len(faces)), np.flatnonzero(np.diff(np.cumsum(counts) // _PIXELS)) + 1):
        face = np.repeat(group, counts[group])
        within = np.arange(len(face)) - np.repeat(np.cumsum(counts[group]) - counts[group], counts[group])
        pixel = np.stack([within % spans[face, 0], within // spans[face, 0]], axis=1) + low[face]
        share = _barycentric(corners[face], pixel)
        inside = (share >= -1e-9).all(axis=1)
        pixel, share, face = pixel[inside] % size, share[inside], face[inside]
        image[pixel[:, 1] * size + pixel[:, 0]] = np.einsum("pj,pjc->pc", share, columns[faces[face]])
    image = _widened(image.reshape(size, size, -1))
    return image[..., 0] if values.ndim == 1 else image


def write_textured_obj(
    path: Path, vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, image: np.ndarray
) -> list[Path]:
    """Write an OBJ with its MTL and PNG beside it; returns the files.

    Args:
        path: of the OBJ.
        vertices: (V, 3).
        faces: (F, 3).
        uv: (F, 3, 2).
        image: (height, width, 3) of unsigned bytes.
    """
    from .pictures import write_png

    # Readers of OBJ files disagree about letters beyond ASCII in names: those of these two files have none.
    stem = path.stem if path.stem.isascii() else "surface"
    material, picture = path.with_name(f"{stem}.mtl"), path.with_name(f"{stem}.png")
    write_obj(path, vertices, faces, uv, material.name)
    material.write_text(f"newmtl surface\nKd 1 1 1\nKs 0 0 0\nmap_Kd {picture.name}\n", encoding="ascii")
    write_png(picture, image)
    return [path, material, picture]


def displaced(vertices: np.ndarray, normals: np.ndarray, values: np.ndarray, amount: float) -> np.ndarray:
    """The vertices moved along the normals, by nothing at the least value and by ``amount`` at the largest."""
    span = np.ptp(values)
    share = (values - values.min()) / (span if span > 0 else 1)
    return vertices + amount * share[:, None] * normals


def _barycentric(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The shares (P, 3) of the corners (P, 3, 2) in the points (P, 2); NaN in triangles without area."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]

    def cross(p, q):
        return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]

    with np.errstate(divide="ignore", invalid="ignore"):
        total = cross(b - a, c - a)
        second, third = cross(points - a, c - a) / total, cross(b - a, points - a) / total
    return np.stack([1 - second - third, second, third], axis=1)


def _widened(image: np.ndarray) -> np.ndarray:
    """The image with empty pixels beside others filled with the mean of those, as often as the margin is wide."""
    for _ in range(_MARGIN):
        empty = np.isnan(image[..., 0])
        padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
        size = image.shape[0]
        beside = np.stack(
            [padded[1 + i : 1 + i + size, 1 + j : 1 + j + size] for i, j in ((0, 1), (0, -1), (1, 0), (-1, 0))]
        )
        known = ~np.isnan(beside[..., :1])
        count = known.sum(axis=0)
        mean = np.where(known, beside, 0).sum(axis=0) / np.maximum(count, 1)
        image = np.where(empty[..., None] & (count > 0), mean, image)
    return image
