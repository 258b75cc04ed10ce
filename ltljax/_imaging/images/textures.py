"""Images come onto a surface and leave it: through a UV map, or projected from one side (host).

What enters: a mesh and pixels, or values on its vertices. What leaves: values on its vertices, or pixels.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from ..._mesh import Mesh
from ..flow.views import axes_of

# As near to the rim of the image, in its size, a place counts as on it.
_RIM = 1e-4


def from_texture(mesh: Mesh, image: np.ndarray) -> Float[np.ndarray, "V *C"]:
    """The values of an image at the vertices, through the UV map (host).

    Bilinear between the centres of pixels at the place of every corner, then the mean over the corners of each vertex,
    which differ where two charts meet. What the map places outside the image is repeated; within 1e-4 of the rim it
    counts as on it, as what rounding has moved across would be read on the other side.

    Args:
        mesh: a mesh with a UV map, v upwards.
        image: (H, W) or (H, W, C), the first row at the top: unsigned integers, of which the largest counts as 1, or
            floats.

    Returns:
        (V,) or (V, C); of unsigned integers from 0 to 1.

    Raises:
        ValueError: the mesh has no UV map, or not of finite numbers, or the image is no image.
    """
    pixels = _pixels(image)
    if mesh.uv is None:
        raise ValueError(
            "The mesh has no UV map: its file names no texture coordinates. Use ltl.imaging.project_image, or unwrap "
            "the mesh first, in Blender say."
        )
    if not np.isfinite(mesh.uv).all():
        face = int(np.argmin(np.isfinite(mesh.uv).all(axis=(1, 2))))
        raise ValueError(f"Expected a UV map of finite numbers, found others in face {face}. Unwrap the mesh anew.")
    rim = np.round(mesh.uv)
    uv = np.where(np.abs(mesh.uv - rim) <= _RIM, rim, mesh.uv)
    # What lies far outside is repeated, so whole turns may be left out.
    places = (uv - np.floor(uv.min(axis=1, keepdims=True))).reshape(-1, 2)
    values = _bilinear(pixels, places)
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
    """The values of an image that is projected from one side, and the vertices that face that side (host).

    Without perspective; the image covers the shape's bounding box seen from there. Vertices that face the side get
    their values even where something stands before them.

    Args:
        shape: a mesh; or positions (V, 3) alone, all of which then count as facing.
        image: (H, W) or (H, W, C), as of `from_texture`.
        direction: from where.
        up: what points upwards in the image.

    Returns:
        Values (V,) or (V, C), and a mask (V,).

    Raises:
        ValueError: the direction is along ``up``, or the image is no image.
    """
    pixels, axes = _pixels(image), axes_of(direction, up)
    vertices = shape.vertices if isinstance(shape, Mesh) else np.asarray(shape, np.float64)
    seen = vertices @ axes[:2].T
    low, span = seen.min(axis=0), np.ptp(seen, axis=0)
    values = _bilinear(pixels, (seen - low) / np.where(span > 0, span, 1))
    if not isinstance(shape, Mesh):
        return values, np.ones(len(vertices), bool)
    a, b, c = np.moveaxis(vertices[shape.faces], 1, 0)
    # Twice the area of each face as seen from there, negative from behind.
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
    """The image in which the UV map finds the values again, (size, size) or (size, size, C) (host).

    Linear inside each face; charts are widened by a few pixels.

    Args:
        mesh: a mesh with a UV map, v upwards.
        u: (V,) or (V, C).
        size: of the image in pixels.
        fill: the value or colour where no face lies.
        as_bytes: whether values from 0 to 1 become unsigned bytes; by default they stay floats.

    Raises:
        ValueError: there is no UV map, it is tiled or not finite, or shapes do not fit.
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


def _bilinear(pixels: np.ndarray, places: np.ndarray) -> np.ndarray:
    """The values (N,) or (N, C) at places (N, 2), v upwards: from 0 to 1 inside the image, which repeats beyond."""
    height, width = pixels.shape[:2]
    values = 0.0
    x, y = _between(places[:, 0], width), _between(1 - places[:, 1], height)
    for row, by_row in y:
        for column, by_column in x:
            share = (by_row * by_column).reshape(-1, *[1] * (pixels.ndim - 2))
            values = values + share * pixels[row, column]
    return np.asarray(values)


def _between(place: np.ndarray, count: int) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """The two pixels of so many between whose centres a place lies, and their shares."""
    # Pixel centres lie at whole numbers.
    at = place * count - 0.5
    low = np.floor(at)
    share = at - low
    # Half a pixel inside the rim of the image there is no other side; beyond it there is.
    is_inside = (place >= 0) & (place <= 1)
    first, second = (
        np.where(is_inside, np.clip(index, 0, count - 1), index % count).astype(np.int64) for index in (low, low + 1)
    )
    return (first, 1 - share), (second, share)
