"""Line integral convolution: noise averaged along field lines, which makes the lines visible.

What enters: a surface, a tangent field and noise. What leaves: the mean of the noise along the line through every
vertex or given point, or a picture with one line per pixel.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ..._surface import Surface, on_surface
from ..._tables import AnyArray, take
from .noise import SolidNoise, solid_noise
from .tracing import Points, checked_points, mean_edge, most_crossings, positions, tangent_field
from .views import View, look
from .walking import Walkers, WalkFaces, faces_along, start, walk

# Default length of a line to either side, in grains of the noise.
_LENGTH = 24
# Extra edges that a line may cross, to get away from a vertex.
_EXTRA_CROSSINGS = 8
# Lines per batch, few enough for their data to stay in the cache.
_BATCH = 1 << 13
# Range from black to white in standard deviations of the grey values.
_CONTRAST = 4.5

Window = Literal["hann", "box"]


@on_surface
def line_integral_convolution(
    surface: Surface,
    X: Float[AnyArray, "V 3"],
    *,
    length: float | int | None = None,
    noise: Float[AnyArray, "..."] | SolidNoise | None = None,
    key: Array | None = None,
    points: Points | None = None,
    step: float | int | None = None,
    window: Window = "hann",
    is_directed: bool = True,
) -> Float[Array, " N"]:
    """The mean of noise along the field line through every vertex or given point, to both sides.

    The mean is nearly constant along a line and differs between neighbouring lines, so a picture of it shows the lines.
    It is linear in the noise, and differentiable in it in both modes.

    The number of edges that a line crosses is limited, to about 2.5 times its length over the length of a short edge.
    The short edge is the fifth percentile of all edges; if the surface is traced, it is taken as long as the step. A
    line that would cross more edges, in a much finer part of the mesh or back and forth around a vertex, ends early,
    and the mean is taken over the part that was walked.

    Args:
        surface: the surface.
        X: (V, 3) tangent field; only its direction matters.
        length: length of the line to either side, at whose end the Hann window vanishes; by default 48 steps. A line
            ends earlier at a boundary, at a zero of the field, or if it crosses too many edges.
        noise: (V,) noise on the vertices, interpolated between them, or a `SolidNoise`. By default uniform between 0
            and 1 on the vertices; with ``points``, solid noise whose grain is one step.
        key: random key of the default noise; by default from seed 0.
        points: faces (N,) and barycentric weights (N, 3); by default the vertices.
        step: length of the longest straight segment; by default half the mean edge length.
        window: ``"hann"``, which tapers off, or ``"box"``.
        is_directed: False if X and -X mean the same, as for principal directions of curvature.

    Returns:
        Means (V,), or (N,) at the points.

    Raises:
        ValueError: X or the noise does not fit the surface, X is not tangent, a point is not on the surface, or the
            length or the step is not positive.

    Source: Cabral and Leedom (1993), Imaging vector fields using line integral convolution, doi:10.1145/166117.166151.
    """
    X = tangent_field(surface, X)
    seeds = jnp.arange(surface.num_vertices, dtype=jnp.int32) if points is None else points
    face, weights = checked_points(surface, seeds)
    if window not in ("hann", "box"):
        raise ValueError(f'Expected the window "hann" or "box", found {window!r}.')
    step = mean_edge(surface) / 2 if step is None else step
    length = 2 * _LENGTH * step if length is None else length
    if not length > 0 or not step > 0:
        raise ValueError(f"Expected a positive length and step, found {length} and {step}.")
    key = jax.random.key(0) if key is None else key
    if noise is None and points is not None:
        noise = solid_noise(key, step, surface.dtype)
    elif noise is None:
        noise = jax.random.uniform(key, (surface.num_vertices,), surface.dtype)
    if not isinstance(noise, SolidNoise):
        noise = jnp.asarray(noise, surface.dtype)
        if noise.shape != (surface.num_vertices,):
            raise ValueError(f"Expected noise of shape ({surface.num_vertices},), found {noise.shape}.")
    segments = int(np.ceil(length / step)) + most_crossings(surface, length, step) + _EXTRA_CROSSINGS
    longest, step_size = jnp.asarray([length, step], surface.dtype)
    faces = faces_along(surface, X)
    return _convolved(surface, faces, face, weights, noise, longest, step_size, segments, window, is_directed)


@eqx.filter_jit
def _convolved(
    surface: Surface,
    faces: WalkFaces,
    face: Array,
    weights: Array,
    noise: Array | SolidNoise,
    length: Array,
    step: Array,
    segments: int,
    window: Window,
    is_directed: bool,
) -> Float[Array, " N"]:
    """The mean of noise along the field lines through points, with at most ``segments`` segments to either side."""
    sample = _sampler(surface, noise)
    # A small weight of the point itself gives lines of length zero a mean.
    smallest = 1e-6 * length
    total, weight = smallest * sample(face, weights), jnp.full(face.shape, smallest)

    def walk_one_side(carry, sign):
        def segment(carry, _):
            def walk_on(carry):
                walkers, total, weight, distance = carry
                max_length = jnp.minimum(step, length - distance)
                walkers, walked, midpoints = walk(faces, walkers, max_length, sign, is_directed)
                added = walked * _window((distance + walked / 2) / length, window)
                return walkers, total + added * sample(*midpoints), weight + added, distance + walked

            is_unfinished = jnp.any(carry[0].is_walking & (carry[3] < length))
            return jax.lax.cond(is_unfinished, walk_on, lambda carry: carry, carry), None

        walkers: Walkers = start(faces, face, weights, sign)
        carry = (walkers, *carry, jnp.zeros_like(weight))
        (_, total, summed, _), _ = jax.lax.scan(segment, carry, length=segments)
        return (total, summed), None

    (total, weight), _ = jax.lax.scan(walk_one_side, (total, weight), jnp.asarray([1.0, -1.0], weights.dtype))
    return total / weight


@on_surface
def lic_picture(
    surface: Surface,
    X: Float[AnyArray, "V 3"],
    path: str | Path | None = None,
    *,
    view: Sequence[float | int] = (0.55, 0.35, 1.0),
    up: Sequence[float | int] = (0.0, 1.0, 0.0),
    resolution: int = 600,
    length: float | int | None = None,
    key: Array | None = None,
    shading: float | int = 0.35,
    is_directed: bool = True,
) -> tuple[UInt8[np.ndarray, "H W"], np.ndarray]:
    """A picture of a vector field, by line integral convolution at every pixel that shows the surface (host).

    Args:
        surface: the surface.
        X: (V, 3) tangent field; only its direction matters.
        path: PNG file to write; by default none.
        view: direction from the surface to the viewer; the projection is orthographic.
        up: upward direction in the picture.
        resolution: height and width of the picture in pixels.
        length: length of the lines to either side; by default 24 grains of the noise, of two pixels each. Lines may
            end earlier, as in `line_integral_convolution`.
        key: random key of the noise; by default from seed 0.
        shading: weight of the lighting, from 0 to 1.
        is_directed: False if X and -X mean the same, as for principal directions of curvature.

    Returns:
        The picture (H, W) in unsigned bytes, white outside the surface, and the mask (H, W) of the surface.

    Raises:
        ValueError: X does not fit the surface or is not tangent, the length is not positive, the view is along ``up``,
            or the surface is being traced.

    Source: Cabral and Leedom (1993), doi:10.1145/166117.166151.
    """
    X = tangent_field(surface, X)
    if not 0 <= shading <= 1:
        raise ValueError(f"Expected a shading from 0 to 1, found {shading}.")
    if length is not None and not length > 0:
        raise ValueError(f"Expected a positive length of the lines, found {length}.")
    if surface.is_traced:
        raise ValueError(
            "A picture is drawn on the host, but the surface is being traced by a JAX transformation. Call this "
            "function outside the transformation."
        )
    visible = look(np.asarray(surface.vertices, np.float64), np.asarray(surface.faces), view, up, resolution)
    grain = 2 * visible.pixel
    length = _LENGTH * grain if length is None else length
    key = jax.random.key(0) if key is None else key
    noise = solid_noise(key, grain, surface.dtype)
    faces = faces_along(surface, X)
    segments = int(np.ceil(length / grain)) + most_crossings(surface, length, grain) + _EXTRA_CROSSINGS
    longest, step = jnp.asarray([length, grain], surface.dtype)

    def lines(face: np.ndarray, weights: np.ndarray) -> Array:
        points = jnp.asarray(face), jnp.asarray(weights, surface.dtype)
        return _convolved(surface, faces, *points, noise, longest, step, segments, "hann", is_directed)

    values = _in_batches(lines, visible.face, visible.weights)
    grey = np.clip(0.5 + (values - values.mean()) / (_CONTRAST * max(float(values.std()), 1e-12)), 0, 1)
    image = np.full(visible.mask.shape, 255, np.uint8)
    image[visible.mask] = np.round(255 * grey * (1 - shading + shading * _light(surface, visible)))
    if path is not None:
        from ..._output.pictures import write_png

        write_png(Path(path), image)
    return image, visible.mask


def _sampler(surface: Surface, noise: Array | SolidNoise) -> Callable[[Array, Array], Array]:
    if isinstance(noise, SolidNoise):
        return lambda face, weights: noise(positions(surface, face, weights))
    corners = take(noise, surface.faces)
    return lambda face, weights: jnp.sum(weights * take(corners, face), axis=1)


def _window(fraction: Array, window: Window) -> Array:
    return jnp.ones_like(fraction) if window == "box" else (1 + jnp.cos(np.pi * fraction)) / 2


def _light(surface: Surface, visible: View) -> np.ndarray:
    """The brightness of each pixel under light from the viewer, from 0 to 1."""
    normals = np.asarray(surface.normals, np.float64)[np.asarray(surface.faces)[visible.face]]
    normals = np.einsum("nk,nkc->nc", visible.weights, normals)
    return np.abs(normals @ visible.towards) / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)


def _in_batches(function: Callable[[np.ndarray, np.ndarray], Array], face: np.ndarray, weights: np.ndarray):
    """A function applied to points in batches of one size, so it is compiled once for all pictures."""
    count = len(face)
    padding = -count % _BATCH
    face, weights = (np.concatenate([a, np.repeat(a[:1], padding, axis=0)]) for a in (face, weights))
    parts = [
        function(face[begin : begin + _BATCH], weights[begin : begin + _BATCH]) for begin in range(0, len(face), _BATCH)
    ]
    return np.concatenate([np.asarray(part, np.float64) for part in parts])[:count]
