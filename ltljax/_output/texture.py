"""Textures: a field as an image in texture coordinates, and an OBJ with a texture (which needs the extra `viz`)."""

from pathlib import Path

import numpy as np

from .files import write_obj

# Triangles are rasterised in groups. This is about the number of pixels in the bounding boxes of a group.
_PIXELS = 4_000_000
# A map is tiled if the area of its faces exceeds this multiple of the area of the image.
_OVERLAPS = 8
# Number of pixels by which every chart is widened, so that no seams appear when the image is scaled down.
_MARGIN = 4


def bake(uv: np.ndarray | None, faces: np.ndarray, values: np.ndarray, size: int = 1024) -> np.ndarray:
    """The field as an image (size, size), with the first row at the top and NaN outside the faces.

    The field is interpolated linearly inside each face, and charts are widened by a few pixels.

    Args:
        uv: (F, 3, 2) texture coordinates as in `Mesh.uv`, from 0 to 1 with v upwards; the image is periodic.
        faces: (F, 3) vertex indices.
        values: (V,), or (V, C) for an image (size, size, C).
        size: width and height of the image in pixels.

    Raises:
        ValueError: there is no UV map, the map is tiled or not finite, or the shapes do not match.
    """
    if uv is None:
        raise ValueError(
            "The mesh has no UV map, because its file has no texture coordinates. Unwrap it first, for example in "
            "Blender."
        )
    _check_map(uv, faces)
    if values.ndim not in (1, 2) or faces.max() >= len(values):
        raise ValueError(f"Expected values of shape ({faces.max() + 1},) or more, found {values.shape}.")
    columns = values.reshape(len(values), -1).astype(np.float64)
    # Whole periods are removed, so that the pixels of a face begin within the image.
    periods: np.ndarray = np.floor(uv.min(axis=1, keepdims=True))
    uv = uv - periods
    # Pixel centres have integer coordinates.
    corners = uv * [size, -size] + [-0.5, size - 0.5]
    low = np.ceil(corners.min(axis=1)).astype(int)
    spans = np.maximum(np.floor(corners.max(axis=1)).astype(int) - low + 1, 0)
    counts = spans[:, 0] * spans[:, 1]
    image = np.full((size * size, columns.shape[1]), np.nan)
    for group in np.split(np.arange(len(faces)), np.flatnonzero(np.diff(np.cumsum(counts) // _PIXELS)) + 1):
        face = np.repeat(group, counts[group])
        within = np.arange(len(face)) - np.repeat(np.cumsum(counts[group]) - counts[group], counts[group])
        pixel = np.stack([within % spans[face, 0], within // spans[face, 0]], axis=1) + low[face]
        weights = _barycentric(corners[face], pixel)
        is_inside = (weights >= -1e-9).all(axis=1)
        pixel, weights, face = pixel[is_inside] % size, weights[is_inside], face[is_inside]
        image[pixel[:, 1] * size + pixel[:, 0]] = np.einsum("pj,pjc->pc", weights, columns[faces[face]])
    image = _widened(image.reshape(size, size, -1))
    return image[..., 0] if values.ndim == 1 else image


def _check_map(uv: np.ndarray, faces: np.ndarray) -> None:
    """Raise if texture coordinates do not match the faces, are not finite, or are tiled."""
    if uv.shape != (*faces.shape, 2):
        raise ValueError(f"Expected uv of shape {(*faces.shape, 2)}, found {uv.shape}.")
    if not np.isfinite(uv).all():
        face = int(np.argmin(np.isfinite(uv).all(axis=(1, 2))))
        raise ValueError(f"Expected finite texture coordinates, found others in face {face}. Unwrap the mesh again.")
    extents = np.ptp(uv, axis=1)
    area = 0.5 * extents.prod(axis=1).sum()
    if (extents > 1).any() or area > _OVERLAPS:
        raise ValueError(
            f"Expected a UV map that covers the image at most {_OVERLAPS} times, with no face larger than the image; "
            f"found faces up to {extents.max():.3g} images wide, and {area:.3g} images in all. The map is tiled: "
            "unwrap the mesh again, without repetition."
        )


def write_textured_obj(
    path: Path, vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, image: np.ndarray
) -> list[Path]:
    """Write an OBJ, and an MTL and a PNG beside it; returns the paths.

    Args:
        path: path of the OBJ.
        vertices: (V, 3) positions.
        faces: (F, 3) vertex indices.
        uv: (F, 3, 2) texture coordinates of the corners.
        image: (height, width, 3) texture, unsigned bytes.
    """
    from .pictures import write_png

    # Programs differ in how they decode names in OBJ and MTL files, so these are ASCII.
    stem = path.stem if path.stem.isascii() else "surface"
    material, picture = path.with_name(f"{stem}.mtl"), path.with_name(f"{stem}.png")
    write_obj(path, vertices, faces, uv, material.name)
    material.write_text(f"newmtl surface\nKd 1 1 1\nKs 0 0 0\nmap_Kd {picture.name}\n", encoding="ascii")
    write_png(picture, image)
    return [path, material, picture]


def displaced(vertices: np.ndarray, normals: np.ndarray, values: np.ndarray, amount: float) -> np.ndarray:
    """The vertices moved along the normals, from 0 at the smallest value to ``amount`` at the largest."""
    span = np.ptp(values)
    height = (values - values.min()) / (span if span > 0 else 1)
    return vertices + amount * height[:, None] * normals


def _barycentric(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The barycentric coordinates (P, 3) of points (P, 2) in triangles (P, 3, 2); NaN in triangles without area."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]

    def cross(p, q):
        return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]

    with np.errstate(divide="ignore", invalid="ignore"):
        total = cross(b - a, c - a)
        second, third = cross(points - a, c - a) / total, cross(b - a, points - a) / total
    return np.stack([1 - second - third, second, third], axis=1)


def _widened(image: np.ndarray) -> np.ndarray:
    """The image with its charts widened: empty pixels beside a chart get the mean of their neighbours."""
    for _ in range(_MARGIN):
        is_empty = np.isnan(image[..., 0])
        padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
        size = image.shape[0]
        neighbours = np.stack(
            [padded[1 + i : 1 + i + size, 1 + j : 1 + j + size] for i, j in ((0, 1), (0, -1), (1, 0), (-1, 0))]
        )
        has_value = ~np.isnan(neighbours[..., :1])
        count = has_value.sum(axis=0)
        mean = np.where(has_value, neighbours, 0).sum(axis=0) / np.maximum(count, 1)
        image = np.where(is_empty[..., None] & (count > 0), mean, image)
    return image
