"""Geodesic distance by the heat method: a little diffusion, its direction, and the potential with that gradient."""

import functools
import math
import warnings
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Array, Float, Int

from ..operators import gradient, laplacian, laplacian_matrix
from ..surface import Surface
from ..tables import AnyArray
from .stationary import IncompatibleSourceWarning, poisson

# The heat at a distance d is about exp(-d / sqrt(time)); over the size of the surface it must not leave float64.
_DECAY = 500
# Times the slope of the logarithm of heat, 1 / sqrt(time): below it a descent is what rounding left where two shortest
# paths meet, and has no direction.
_NO_DIRECTION = 1e-3


def geodesic_distance(
    surface: Surface, sources: Int[AnyArray, " n"] | Sequence[int] | int, time: float | None = None
) -> Float[Array, " V"]:
    """The distance along the surface of every vertex from the nearest of some source vertices (host): first order.

    One backward Euler step of heat from the sources, whose gradient points to them; the distance is the potential whose
    gradient has that direction and length one. The heat is found by sparse elimination: with non-negative weights that
    keeps its relative accuracy where it is tiny, which an iteration does not.

    Args:
        surface: a `Monotone` surface. On a component without a source the distance is infinite.
        sources: indices of vertices.
        time: of the step; by default the square of the mean distance of neighbours.

    Raises:
        SolveError: the potential was not found.
        ValueError: there are no sources, or not on the surface, the time is not positive, or the surface is being
            traced.

    Source: Crane, Weischedel and Wardetzky (2013), Geodesics in heat, doi:10.1145/2516971.2516977.
    """
    if surface.is_traced:
        raise ValueError(
            "The distance is computed on the host, but the surface is being traced by a JAX transformation."
        )
    sources = checked_sources(surface, sources)
    if time is not None and not time > 0:
        raise ValueError(f"Expected a positive time, found {time}.")
    here = np.zeros(surface.num_vertices)
    here[sources] = 1
    step = shortest_step(surface) if time is None else time
    stepped = scipy.sparse.eye_array(len(here)) - step * laplacian_matrix(surface).astype(np.float64)
    # Without pivoting, so that nothing is ever subtracted.
    factors = scipy.sparse.linalg.splu(scipy.sparse.csc_matrix(stepped), diag_pivot_thresh=0.0)
    heat = np.maximum(factors.solve(here), np.finfo(np.float64).tiny)
    # Of the logarithm, so that what is tiny stays in range in float32; the direction is the same.
    descent = -gradient(surface, jnp.asarray(np.log(heat), surface.dtype))
    is_source = jnp.asarray(here, surface.dtype)
    with warnings.catch_warnings():
        # Where the distance has kinks the mean is not that of a divergence.
        warnings.simplefilter("ignore", IncompatibleSourceWarning)
        distance = poisson(surface, _divergence(surface, math.sqrt(step) * descent, is_source))
    # A potential is known up to a constant on every component.
    components = np.asarray(surface.topology.components)
    nearest = np.full(surface.topology.num_components, -np.inf)
    for component in np.unique(components[sources]):
        nearest[component] = np.asarray(distance)[sources[components[sources] == component]].min()
    return distance - jnp.asarray(nearest[components], surface.dtype)


def checked_sources(surface: Surface, sources: Any) -> np.ndarray:
    """Source vertices as an array.

    Raises:
        ValueError: there are none, or they are not on the surface.
    """
    sources = np.atleast_1d(np.asarray(sources))
    if sources.size == 0 or sources.min() < 0 or sources.max() >= surface.num_vertices:
        raise ValueError(f"Expected source vertices from 0 to {surface.num_vertices - 1}, found {sources}.")
    return sources


def shortest_step(surface: Surface) -> float:
    """The time of a step of heat that tells shortest paths (host): the squared mesh size, or what float64 can hold."""
    diameter = float(np.linalg.norm(np.ptp(np.asarray(surface.vertices, np.float64), axis=0)))
    return max(float(surface.mesh_size), 2 * diameter / _DECAY) ** 2


@eqx.filter_jit
def _divergence(surface: Surface, descent: Array, here: Array) -> Array:
    """What the Laplacian makes of a potential that rises along edges as a unit field X in the direction of descent.

    The descent is about one long where one shortest path arrives, and X is zero where it is almost none. That is
    sum_k c_k (X_v + X_k) / 2 . (x_k - x_v); at the sources, where X has no direction, that of the other end of an edge
    counts for both.
    """
    x, L = surface.vertices, functools.partial(laplacian, surface)
    size = jnp.sqrt(jnp.sum(descent**2, axis=-1, keepdims=True) + _NO_DIRECTION**2)
    X = jnp.where(here[:, None] > 0, 0, descent / size)
    rises = (jnp.sum(X * L(x), axis=-1) + L(jnp.sum(X * x, axis=-1)) - jnp.sum(L(X) * x, axis=-1)) / 2
    to_source = jnp.sum(X * (L(here[:, None] * x) - L(here)[:, None] * x), axis=-1) / 2
    return jnp.where(here > 0, 2 * rises, rises + to_source)
