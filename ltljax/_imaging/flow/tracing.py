"""Field lines of a vector field on a mesh, and where on it they may start.

What enters: a surface, a tangent field on its vertices, and seeds. What leaves: points along the field lines. Here too
is what is wrong with a field or with seeds before anyone walks.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from ..._operators import check_tangent
from ..._surface import Surface, on_surface
from ..._tables import AnyArray
from ..._tables.table import take
from .walking import CORNERS, faces_along, start, walk

# Edges that a line may cross in one step beside those of its length: around a vertex, and where faces are small.
_AROUND = 32
# Edges crossed in the length of an edge: at most 2.31 where all faces are equilateral.
_PER_EDGE = 2.5
# The share of edges, in percent, that are shorter than what counts as a short one.
_SHORT = 5

Points = tuple[Int[AnyArray, " N"], Float[AnyArray, "N 3"]]


class Streamlines(eqx.Module):
    """Field lines as points at equal distances.

    Attributes:
        points: (N, steps + 1, 3) the positions, the first the seed.
        is_valid: (N, steps + 1) false from where a line has ended at a boundary or a zero of the field, or has crossed
            too many edges in one step; its points stay there.
    """

    points: Float[Array, "N T 3"]
    is_valid: Bool[Array, "N T"]


@on_surface
def streamlines(
    surface: Surface,
    X: Float[AnyArray, "V 3"],
    seeds: Int[AnyArray, " N"] | Points,
    length: float | int,
    step: float | int | None = None,
    *,
    is_directed: bool = True,
) -> Streamlines:
    """The field lines of X from some seeds, as points at equal distances along them: second order.

    Inside every face the midpoint rule; a line that leaves a face goes on in the next from the point where it crosses
    the edge. Against the field with -X. Differentiable in X, but for which edges are crossed.

    So that every loop ends, a step crosses at most 32 edges and 2.5 for each short edge in its length (shorter are 5 %
    of the edges; where the surface is traced, an edge as long as the step). A line that would cross more in one step,
    as with a long step through the finest part of a graded mesh, ends there: shorter steps take it further.

    Args:
        surface: the surface.
        X: (V, 3), tangent; its length does not count.
        seeds: indices of vertices (N,), or faces (N,) and barycentric weights (N, 3).
        length: of the lines.
        step: the distance of the points; about half the mean edge length by default, and shortened to divide the
            length.
        is_directed: false where X and -X mean the same, as principal directions of curvature do: each line then goes on
            the way it came.

    Returns:
        The `Streamlines`.

    Raises:
        ValueError: X does not fit or is not tangent, a seed is not on the surface, or length or step is not positive.

    Source: Polthier and Schmies (1998), Straightest geodesics on polyhedral surfaces, doi:10.1007/978-3-662-03567-2_11,
    for integration over faces.
    """
    X = tangent_field(surface, X)
    face, weights = checked_points(surface, seeds)
    step = mean_edge(surface) / 2 if step is None else step
    if not length > 0 or not step > 0:
        raise ValueError(f"Expected a positive length and step, found {length} and {step}.")
    steps = int(np.ceil(float(length) / float(step) - 1e-9))
    most, each = _AROUND + most_crossings(surface, length / steps, step), jnp.asarray(length / steps, surface.dtype)
    return _streamlines(surface, X, face, weights, each, steps, most, is_directed)


@eqx.filter_jit
def _streamlines(surface, X, face, weights, step, steps, most, is_directed) -> Streamlines:
    faces = faces_along(surface, X)

    def advance(walkers, _):
        def stretch(carry, _):
            def further(carry):
                walkers, room = carry
                walkers, gone, _ = walk(faces, walkers, room, 1.0, is_directed)
                return walkers, jnp.where(walkers.walks, room - gone, room)

            walkers, room = carry
            return jax.lax.cond(jnp.any(walkers.walks & (room > 0)), further, lambda carry: carry, carry), None

        full = jnp.full(walkers.face.shape, step)
        (walkers, room), _ = jax.lax.scan(stretch, (walkers, full), length=most)
        arrived = walkers.walks & (room <= 0)
        walkers = eqx.tree_at(lambda w: w.walks, walkers, arrived)
        return walkers, (positions(surface, walkers.face, walkers.weights), arrived)

    walkers = start(faces, face, weights, 1.0)
    _, (points, arrived) = jax.lax.scan(advance, walkers, length=steps)
    points = jnp.concatenate([positions(surface, walkers.face, walkers.weights)[None], points])
    arrived = jnp.concatenate([jnp.ones((1, len(face)), bool), arrived])
    return Streamlines(jnp.swapaxes(points, 0, 1), jnp.swapaxes(arrived, 0, 1))


def positions(surface: Surface, face: Array, weights: Array) -> Float[Array, "N 3"]:
    """The points with barycentric weights on faces."""
    return jnp.sum(weights[:, :, None] * take(surface.vertices, take(surface.faces, face)), axis=1)


def tangent_field(surface: Surface, X: AnyArray) -> Float[Array, "V 3"]:
    """X in the surface's float type, once it has been found to be a tangent field.

    Raises:
        ValueError: it has not the shape (V, 3), or vectors that are not finite or not tangent.
    """
    if jnp.shape(X) != (surface.num_vertices, 3):
        raise ValueError(
            f"Expected a vector field with one row per vertex, ({surface.num_vertices}, 3), found shape {jnp.shape(X)}."
        )
    X = jnp.asarray(X, surface.dtype)
    check_tangent(surface, X)
    return X


def checked_points(surface: Surface, seeds: AnyArray | Points) -> tuple[Int[Array, " N"], Float[Array, "N 3"]]:
    """Faces and barycentric weights of points that are given so or as vertices.

    Raises:
        ValueError: a point is not on the surface.
    """
    faces, num_faces = surface.faces, len(surface.faces)
    if not isinstance(seeds, tuple):
        at = jnp.asarray(seeds, jnp.int32)
        if at.ndim != 1:
            raise ValueError(f"Expected seeds as vertices (N,) or as faces (N,) and weights, found {at.shape}.")
        _check_range(at, surface.num_vertices, "a seed", "vertex")
        # Any face at the vertex will do: a walker goes around it to where the field leads.
        slots = jnp.zeros(surface.num_vertices, jnp.int32)
        slots = slots.at[faces.reshape(-1)].max(jnp.arange(3 * num_faces, dtype=jnp.int32))[at]
        return slots // 3, (slots[:, None] % 3 == CORNERS).astype(surface.dtype)
    face, weights = jnp.asarray(seeds[0], jnp.int32), jnp.asarray(seeds[1], surface.dtype)
    if face.ndim != 1 or weights.shape != (len(face), 3):
        raise ValueError(f"Expected faces (N,) and barycentric weights (N, 3), found {face.shape} and {weights.shape}.")
    _check_range(face, num_faces, "a point", "face")
    if not isinstance(weights, Tracer):
        values = np.asarray(weights, np.float64)
        is_bad = ~((values >= -1e-4).all(axis=1) & (np.abs(values.sum(axis=1) - 1) <= 1e-4))
        if is_bad.any():
            first = int(np.argmax(is_bad))
            raise ValueError(
                f"Expected barycentric weights that are not negative and sum to one, found {values[first]} at point "
                f"{first}."
            )
    return face, weights


def most_crossings(surface: Surface, length: float, step: float) -> int:
    """How many edges a line of some length may cross (host).

    As many as in a mesh of short edges; where the surface is traced these count as long as the step.
    """
    is_unknown = surface.is_traced or isinstance(surface.faces, Tracer)
    short = step if is_unknown else np.percentile(_edges(surface), _SHORT)
    return int(np.ceil(_PER_EDGE * float(length) / max(float(short), 1e-3 * float(step))))


def mean_edge(surface: Surface) -> float:
    """The mesh size as a number (host)."""
    if surface.is_traced or isinstance(surface.faces, Tracer):
        raise ValueError(
            "Lengths are chosen on the host, but the surface is being traced by a JAX transformation. Give step= and "
            "length= as numbers."
        )
    return float(surface.mesh_size)


def _edges(surface: Surface) -> np.ndarray:
    vertices, faces = np.asarray(surface.vertices, np.float64), np.asarray(surface.faces)
    return np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=-1)


def _check_range(indices: Any, count: int, what: str, kind: str) -> None:
    if isinstance(indices, Tracer):
        return
    values = np.asarray(indices)
    is_bad = (values < 0) | (values >= count)
    if is_bad.any():
        first = int(np.argmax(is_bad))
        raise ValueError(
            f"Expected {what} at a {kind} from 0 to {count - 1}, found {kind} {values[first]} at index {first}."
        )
