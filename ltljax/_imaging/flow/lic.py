"""Pictures of vector fields by line integral convolution: a noise, smeared along the field lines.

What enters: a surface, a tangent field and a noise. What leaves: its mean along the line through every vertex, or
through any points, linear in the noise; or a picture of that, a line for every pixel.
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
from ..._tables import AnyArray
from ..._tables.table import take
from .noise import SolidNoise, solid_noise
from .tracing import Points, checked_points, mean_edge, most_crossings, positions, tangent_field
from .views import View, look
from .walking import Faces, Walkers, faces_along, start, walk

# Of the lines, in grains of the noise, to either side.
_LENGTH = 24
# Edges a line may cross beside those of its length: to get away from a vertex.
_AROUND = 8
# Lines at once: what belongs to so many stays in the cache.
_BATCH = 1 << 13
# Of the grey values of a picture, in standard deviations from black to white.
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
    """The mean of a noise along the field line through every vertex, or through points, to both sides.

    Nearly the same on one line and unlike on its neighbours, so that a picture of it shows the lines. Linear in the
    noise, and differentiable in it in both modes.

    So that every loop ends, a line crosses at most 2.5 edges for each short edge in its length (shorter are 5 % of the
    edges; where the surface is traced, an edge as long as the step). Where it would cross more, as in a part of a mesh
    much finer than that, or to and fro around a vertex, it ends early, and its mean is that of the part walked.

    Args:
        surface: the surface.
        X: (V, 3), tangent; its length does not count.
        length: of the line to either side; by default 48 steps. At its end the window vanishes; at a
            boundary or a zero of the field the line ends before, as where it crosses too many edges.
        noise: (V,), interpolated between vertices, or a `SolidNoise`; by default uniform between 0 and 1 on the
            vertices, or at points a solid noise whose grain is a step.
        key: of the random numbers of the default noise; by default of seed 0.
        points: faces (N,) and barycentric weights (N, 3); by default the vertices.
        step: the longest stretch taken at once; by default half the mean edge length.
        window: ``"hann"``, which tapers off, or ``"box"``.
        is_directed: false where X and -X mean the same, as principal directions of curvature do.

    Returns:
        (V,), or (N,) at points.

    Raises:
        ValueError: X or the noise does not fit, X is not tangent, a point is not on the surface, or length or step is
            not positive.

    Source: Cabral and Leedom (1993), Imaging vector fields using line integral convolution, doi:10.1145/166117.166151.
    """
    X = tangent_field(surface, X)
    here = jnp.arange(surface.num_vertices, dtype=jnp.int32) if points is None else points
    face, weights = checked_points(surface, here)
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
            raise ValueError(f"Expected a noise of shape ({surface.num_vertices},), found {noise.shape}.")
    stretches = int(np.ceil(length / step)) + most_crossings(surface, length, step) + _AROUND
    faces, (most, each) = faces_along(surface, X), jnp.asarray([length, step], surface.dtype)
    return convolved(surface, faces, face, weights, noise, most, each, stretches, window, is_directed)


@eqx.filter_jit
def convolved(
    surface: Surface,
    faces: Faces,
    face: Array,
    weights: Array,
    noise: Array | SolidNoise,
    length: Array,
    step: Array,
    stretches: int,
    window: Window,
    is_directed: bool,
) -> Float[Array, " N"]:
    """The mean of a noise along the field lines through points, of so many stretches at most to either side."""
    sample = _sampler(surface, noise)
    # Where a line is no longer than nothing, the noise at its point.
    least = 1e-6 * length
    total, weight = least * sample(face, weights), jnp.full(face.shape, least)

    def one_way(carry, sense):
        def stretch(carry, _):
            def further(carry):
                walkers, total, weight, gone = carry
                room = jnp.minimum(step, length - gone)
                walkers, more, (where, middle) = walk(faces, walkers, room, sense, is_directed)
                share = more * _window((gone + more / 2) / length, window)
                return walkers, total + share * sample(where, middle), weight + share, gone + more

            goes_on = jnp.any(carry[0].walks & (carry[3] < length))
            return jax.lax.cond(goes_on, further, lambda carry: carry, carry), None

        walkers: Walkers = start(faces, face, weights, sense)
        carry = (walkers, *carry, jnp.zeros_like(weight))
        (_, total, summed, _), _ = jax.lax.scan(stretch, carry, length=stretches)
        return (total, summed), None

    (total, weight), _ = jax.lax.scan(one_way, (total, weight), jnp.asarray([1.0, -1.0], weights.dtype))
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
    """A picture of a vector field: line integral convolution at every pixel that shows the surface (host).

    Args:
        surface: the surface.
        X: (V, 3), tangent; its length does not count.
        path: of a PNG file to write; none by default.
        view: from where to look, as a direction; without perspective.
        up: what points upwards in the picture.
        resolution: pixels of its height and width.
        length: of the lines to either side; by default 24 grains of the noise, which are two pixels each. Lines may
            end before as those of `line_integral_convolution`.
        key: of the random numbers; by default of seed 0.
        shading: how much the light counts, from 0 to 1.
        is_directed: false where X and -X mean the same, as principal directions of curvature do.

    Returns:
        The picture (H, W) of unsigned bytes, white where the surface is not, and where it is (H, W) bool.

    Raises:
        ValueError: X does not fit or is not tangent, the length is not positive, the view is along ``up``, or the
            surface is being traced.

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
            "function outside."
        )
    seen = look(np.asarray(surface.vertices, np.float64), np.asarray(surface.faces), view, up, resolution)
    grain = 2 * seen.pixel
    length = _LENGTH * grain if length is None else length
    key = jax.random.key(0) if key is None else key
    noise = solid_noise(key, grain, surface.dtype)
    faces = faces_along(surface, X)
    stretches = int(np.ceil(length / grain)) + most_crossings(surface, length, grain) + _AROUND
    most, each = jnp.asarray([length, grain], surface.dtype)

    def lines(face: np.ndarray, weights: np.ndarray) -> Array:
        at = jnp.asarray(face), jnp.asarray(weights, surface.dtype)
        return convolved(surface, faces, *at, noise, most, each, stretches, "hann", is_directed)

    values = _in_batches(lines, seen.face, seen.weights)
    grey = np.clip(0.5 + (values - values.mean()) / (_CONTRAST * max(float(values.std()), 1e-12)), 0, 1)
    image = np.full(seen.mask.shape, 255, np.uint8)
    image[seen.mask] = np.round(255 * grey * (1 - shading + shading * _light(surface, seen)))
    if path is not None:
        from ..._output.pictures import write_png

        write_png(Path(path), image)
    return image, seen.mask


def _sampler(surface: Surface, noise: Array | SolidNoise) -> Callable[[Array, Array], Array]:
    if isinstance(noise, SolidNoise):
        return lambda face, weights: noise(positions(surface, face, weights))
    corners = take(noise, surface.faces)
    return lambda face, weights: jnp.sum(weights * take(corners, face), axis=1)


def _window(share: Array, window: Window) -> Array:
    return jnp.ones_like(share) if window == "box" else (1 + jnp.cos(np.pi * share)) / 2


def _light(surface: Surface, seen: View) -> np.ndarray:
    """How much each pixel is lit from the eye, 0 to 1."""
    normals = np.asarray(surface.normals, np.float64)[np.asarray(surface.faces)[seen.face]]
    normals = np.einsum("nk,nkc->nc", seen.weights, normals)
    return np.abs(normals @ seen.towards) / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)


def _in_batches(function: Callable[[np.ndarray, np.ndarray], Array], face: np.ndarray, weights: np.ndarray):
    """A function of points, taken of equally many at once, so that it is compiled once for all pictures."""
    count = len(face)
    padding = -count % _BATCH
    face, weights = (np.concatenate([a, np.repeat(a[:1], padding, axis=0)]) for a in (face, weights))
    parts = [
        function(face[begin : begin + _BATCH], weights[begin : begin + _BATCH]) for begin in range(0, len(face), _BATCH)
    ]
    return np.concatenate([np.asarray(part, np.float64) for part in parts])[:count]
