"""Streamlines of a vector field on a mesh, and the checks of fields and seeds.

What enters: a surface, a tangent field on its vertices, and seeds. What leaves: points along the field lines.
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
from ..._tables import AnyArray, take
from .walking import CORNERS, faces_along, start, walk

# Extra edges that a line may cross in one step, around a vertex or where faces are small.
_EXTRA_CROSSINGS = 32
# Edges crossed per edge length; on equilateral faces there are at most 2.31.
_PER_EDGE = 2.5
# Percentile of the edge lengths that defines a short edge.
_SHORT = 5

Points = tuple[Int[AnyArray, " N"], Float[AnyArray, "N 3"]]


class Streamlines(eqx.Module):
    """Field lines as points at equal distances.

    Attributes:
        points: (N, steps + 1, 3) positions along each line, beginning with the seed.
        is_valid: (N, steps + 1) False after a line has ended, at a boundary or a zero of the field or because it
            crossed too many edges in one step. The points after the end repeat the last one.
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
    """The `Streamlines` of X from given seeds: points at equal distances along the field lines, second order accurate.

    Lines are integrated face by face with the midpoint rule, and continue in the next face from the point where they
    cross the edge. Use -X to go against the field. Differentiable in X for a fixed sequence of edges crossed.

    The number of edges crossed in one step is limited, to 32 plus 2.5 times the step over the length of a short edge.
    The short edge is the fifth percentile of all edges; if the surface is traced, it is taken as long as the step. A
    line that would cross more edges ends there. This can happen with long steps through the finest part of a graded
    mesh, and shorter steps avoid it.

    Args:
        surface: the surface.
        X: (V, 3) tangent field; only its direction matters.
        seeds: indices of vertices (N,), or faces (N,) and barycentric weights (N, 3).
        length: length of the lines.
        step: distance of the points; by default about half the mean edge length. It is shortened to divide the length.
        is_directed: False if X and -X mean the same, as for principal directions of curvature. A line then takes the
            sign that continues its own direction.

    Raises:
        ValueError: X does not fit the surface or is not tangent, a seed is not on the surface, or the length or the
            step is not positive.

    Source: Polthier and Schmies (1998), Straightest geodesics on polyhedral surfaces, doi:10.1007/978-3-662-03567-2_11,
    for integration over faces.
    """
    X = tangent_field(surface, X)
    face, weights = checked_points(surface, seeds)
    step = mean_edge(surface) / 2 if step is None else step
    if not length > 0 or not step > 0:
        raise ValueError(f"Expected a positive length and step, found {length} and {step}.")
    steps = int(np.ceil(float(length) / float(step) - 1e-9))
    segments = _EXTRA_CROSSINGS + most_crossings(surface, length / steps, step)
    return _streamlines(
        surface, X, face, weights, jnp.asarray(length / steps, surface.dtype), steps, segments, is_directed
    )


@eqx.filter_jit
def _streamlines(
    surface: Surface, X: Array, face: Array, weights: Array, step: Array, steps: int, segments: int, is_directed: bool
) -> Streamlines:
    faces = faces_along(surface, X)

    def advance(walkers, _):
        def segment(carry, _):
            def walk_on(carry):
                walkers, remaining = carry
                walkers, length, _ = walk(faces, walkers, remaining, 1.0, is_directed)
                return walkers, jnp.where(walkers.is_walking, remaining - length, remaining)

            walkers, remaining = carry
            is_unfinished = jnp.any(walkers.is_walking & (remaining > 0))
            return jax.lax.cond(is_unfinished, walk_on, lambda carry: carry, carry), None

        full = jnp.full(walkers.face.shape, step)
        (walkers, remaining), _ = jax.lax.scan(segment, (walkers, full), length=segments)
        arrived = walkers.is_walking & (remaining <= 0)
        walkers = eqx.tree_at(lambda w: w.is_walking, walkers, arrived)
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
    """The tangent field X in the surface's float type.

    Raises:
        ValueError: X does not have the shape (V, 3), or a vector is NaN, infinite or not tangent.
    """
    if jnp.shape(X) != (surface.num_vertices, 3):
        raise ValueError(
            f"Expected a vector field with one row per vertex, ({surface.num_vertices}, 3), found shape {jnp.shape(X)}."
        )
    X = jnp.asarray(X, surface.dtype)
    check_tangent(surface, X)
    return X


def checked_points(surface: Surface, seeds: AnyArray | Points) -> tuple[Int[Array, " N"], Float[Array, "N 3"]]:
    """The faces (N,) and barycentric weights (N, 3) of points, which are given in this form or as vertices.

    Raises:
        ValueError: a point is not on the surface.
    """
    faces, num_faces = surface.faces, len(surface.faces)
    if not isinstance(seeds, tuple):
        vertices = jnp.asarray(seeds, jnp.int32)
        if vertices.ndim != 1:
            raise ValueError(f"Expected seeds as vertices (N,) or as faces (N,) and weights, found {vertices.shape}.")
        _check_range(vertices, surface.num_vertices, "a seed", "vertex")
        # Any face at the vertex will do, because a walker goes around the vertex to where the field leads.
        slots = jnp.zeros(surface.num_vertices, jnp.int32)
        slots = slots.at[faces.reshape(-1)].max(jnp.arange(3 * num_faces, dtype=jnp.int32))[vertices]
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
    """The number of edges that a line of some length may cross (host).

    Assumes that all edges are short; if the surface is traced, as long as the step.
    """
    is_unknown = surface.is_traced or isinstance(surface.faces, Tracer)
    short = step if is_unknown else np.percentile(_edges(surface), _SHORT)
    return int(np.ceil(_PER_EDGE * float(length) / max(float(short), 1e-3 * float(step))))


def mean_edge(surface: Surface) -> float:
    """The mesh size as a number (host)."""
    if surface.is_traced or isinstance(surface.faces, Tracer):
        raise ValueError(
            "The default lengths are chosen on the host, but the surface is being traced by a JAX transformation. Give "
            "step= and length= as numbers."
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
