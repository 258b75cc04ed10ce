"""Transfer of images between pixels and vertices, through a UV map or by projection from one side (host).

What enters: a mesh and pixels, or values on its vertices. What leaves: values on its vertices, or pixels.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from ..._mesh import Mesh
from ..flow.views import axes_of

# Points of the UV map within this distance of the rim of the image, relative to its size, count as on the rim.
_RIM = 1e-4


def from_texture(mesh: Mesh, image: np.ndarray) -> Float[np.ndarray, "V *C"]:
    """The values of an image at the vertices, through the UV map (host).

    The image is interpolated bilinearly between pixel centres at every face corner, then averaged over the corners of
    each vertex, which differ where two charts meet. Outside the unit square the image repeats. Points within 1e-4 of
    the rim count as on it: rounding could otherwise move them across, to the opposite side of the image.

    Args:
        mesh: a mesh with a UV map, v upwards.
        image: (H, W) or (H, W, C), first row at the top. Floats, or unsigned integers, whose largest value becomes 1.

    Returns:
        Values (V,) or (V, C); from 0 to 1 if the image has unsigned integers.

    Raises:
        ValueError: the mesh has no UV map, the map is NaN or infinite somewhere, or the image has a wrong shape or
            type.
    """
    pixels = _pixels(image)
    if mesh.uv is None:
        raise ValueError(
            "The mesh has no UV map, because its file has no texture coordinates. Use ltl.imaging.project_image, or "
            "unwrap the mesh first, for example in Blender."
        )
    if not np.isfinite(mesh.uv).all():
        face = int(np.argmin(np.isfinite(mesh.uv).all(axis=(1, 2))))
        raise ValueError(
            f"Expected a finite UV map, found NaN or infinite coordinates in face {face}. Unwrap the mesh again."
        )
    rim = np.round(mesh.uv)
    uv = np.where(np.abs(mesh.uv - rim) <= _RIM, rim, mesh.uv)
    # The image repeats, so whole periods are removed.
    points = (uv - np.floor(uv.min(axis=1, keepdims=True))).reshape(-1, 2)
    values = _bilinear(pixels, points)
    vertex, count = mesh.faces.ravel(), np.bincount(mesh.faces.ravel(), minlength=mesh.num_vertices)
    columns = values.reshape(len(values), -1).T
    sums = np.stack([np.bincount(vertex, column, mesh.num_vertices) for column in columns], axis=1)
    return (sums / count[:, None]).reshape(mesh.num_vertices, *pixels.shape[2:])


def project_image(
    shape: Mesh | Float[np.ndarray, "V 3"],
    image: np.ndarray,
    direction: Sequence[float | int] = (0, 0, 1),
    up: Sequence[float | int] = (0, 1, 0),
) -> tuple[Float[np.ndarray, "V *C"], Bool[np.ndarray, " V"]]:
    """The values of an image projected onto the vertices from one side, and the vertices that face that side (host).

    The projection is orthographic, and the image covers the bounding box of the shape seen from that side. Occlusion is
    ignored: vertices behind other parts of the shape get values, too.

    Args:
        shape: a mesh; or positions (V, 3) alone, all of which then count as facing the image.
        image: (H, W) or (H, W, C), as in `from_texture`.
        direction: direction from the shape towards the image.
        up: upward direction in the image.

    Returns:
        Values (V,) or (V, C), and a mask (V,) of the vertices that face the image.

    Raises:
        ValueError: the direction is along ``up``, or the image has a wrong shape or type.
    """
    pixels, axes = _pixels(image), axes_of(direction, up)
    vertices = shape.vertices if isinstance(shape, Mesh) else np.asarray(shape, np.float64)
    seen = vertices @ axes[:2].T
    low, span = seen.min(axis=0), np.ptp(seen, axis=0)
    values = _bilinear(pixels, (seen - low) / np.where(span > 0, span, 1))
    if not isinstance(shape, Mesh):
        return values, np.ones(len(vertices), bool)
    a, b, c = np.moveaxis(vertices[shape.faces], 1, 0)
    # Twice the projected area of each face, negative if it faces away.
    towards = np.repeat(np.cross(b - a, c - a) @ axes[2], 3)
    return values, np.bincount(shape.faces.ravel(), towards, len(vertices)) > 0


def to_texture(
    mesh: Mesh,
    u: Float[np.ndarray, "V *C"],
    size: int = 1024,
    fill: float | Sequence[float | int] = 0.0,
    *,
    as_bytes: bool = False,
) -> np.ndarray:
    """The image that shows a field through the UV map, (size, size) or (size, size, C) (host).

    Values are linear on each face; charts are extended by a few pixels, so that interpolation at their rims is safe.

    Args:
        mesh: a mesh with a UV map, v upwards.
        u: field, (V,) or (V, C).
        size: width and height of the image in pixels.
        fill: value or colour of pixels that no face covers.
        as_bytes: whether to convert values from 0 to 1 to unsigned bytes; by default the image has floats.

    Raises:
        ValueError: there is no UV map, it is tiled or NaN or infinite somewhere, or u does not fit the mesh.
    """
    from ..._output.texture import bake

    u = np.asarray(u)
    if u.ndim not in (1, 2) or len(u) != mesh.num_vertices:
        raise ValueError(f"Expected u of shape ({mesh.num_vertices},) or ({mesh.num_vertices}, C), found {u.shape}.")
    image = bake(mesh.uv, mesh.faces, u, size)
    image = np.where(np.isnan(image), np.asarray(fill, image.dtype), image)
    return np.round(255 * np.clip(image, 0, 1)).astype(np.uint8) if as_bytes else image


def _pixels(image: np.ndarray) -> np.ndarray:
    image = np.asarray(image)
    if image.ndim not in (2, 3) or 0 in image.shape:
        raise ValueError(f"Expected an image of shape (H, W) or (H, W, C), found {image.shape}.")
    if image.dtype.kind == "u":
        return image / np.iinfo(image.dtype).max
    if image.dtype.kind != "f":
        raise ValueError(f"Expected pixels that are unsigned integers or floats, found {image.dtype}. Convert them.")
    return image.astype(np.float64)


def _bilinear(pixels: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The values (N,) or (N, C) at points (N, 2), v upwards; the image covers the unit square and repeats outside."""
    height, width = pixels.shape[:2]
    values = 0.0
    x, y = _between(points[:, 0], width), _between(1 - points[:, 1], height)
    for row, by_row in y:
        for column, by_column in x:
            weight = (by_row * by_column).reshape(-1, *[1] * (pixels.ndim - 2))
            values = values + weight * pixels[row, column]
    return np.asarray(values)


def _between(x: np.ndarray, count: int) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """The two of ``count`` pixels between whose centres a coordinate lies, each with its interpolation weight."""
    # In this coordinate, pixel centres are integers.
    position = x * count - 0.5
    low = np.floor(position)
    share = position - low
    # Inside the image, indices are clipped at the rim; outside, the image repeats.
    is_inside = (x >= 0) & (x <= 1)
    first, second = (
        np.where(is_inside, np.clip(index, 0, count - 1), index % count).astype(np.int64) for index in (low, low + 1)
    )
    return (first, 1 - share), (second, share)
