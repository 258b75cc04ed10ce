"""Distances along a surface: fronts that are carried over unfolded triangles (host).

What enters: a surface and source vertices. What leaves: the distance of every vertex from the nearest of them. Only
lengths of edges are seen, of the intrinsic Delaunay triangulation; how the surface bends in space plays no part.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from ..lifting.delaunay import HalfEdges, delaunay_triangulation
from ..surface import Surface
from ..tables import AnyArray

# A distance is corrected where it falls by more than this share, which is rounding.
_ROUNDING = 1e-12


def geodesic_distance(
    surface: Surface,
    sources: Int[AnyArray, " n"] | Sequence[int] | int,
    method: Literal["marching", "exact"] = "marching",
) -> Float[Array, " V"]:
    """The distance along the surface of every vertex from the nearest of some source vertices (host).

    With ``"marching"`` a front moves on from vertex to vertex: two neighbours and their distances, unfolded into the
    plane, show where the front came from as if from a single point, and so the distance of a third one beyond them.
    Exact on what unfolds into a plane, such as strips, boxes between their corners, and rolled sheets; of first order
    in the mean on curved surfaces, with an error a third of that of the heat method on spheres and a tenth on scans.

    With ``"exact"`` the shortest paths on the polyhedron of the mesh, by libigl (``pip install libigl``), which takes
    about ten times as long on 10,000 vertices, and more on larger meshes.

    Args:
        surface: a surface with any scheme. On a component without a source the distance is infinite.
        sources: indices of vertices.
        method: ``"marching"`` or ``"exact"``.

    Raises:
        ValueError: there are no sources, or not on the surface, or the surface is being traced, or the method is not
            known.
        ImportError: ``"exact"`` without libigl.

    Example:
        >>> import ltljax as ltl
        >>> surface = ltl.Surface.from_mesh(ltl.shapes.square(n=8))
        >>> round(float(ltl.geodesic_distance(surface, 0)[-1]), 6)  # from corner to corner
        1.414214

    Source: Novotni and Klein (2002), Computing geodesic distances on triangular meshes, WSCG; for ``"exact"`` Mitchell,
    Mount and Papadimitriou (1987), The discrete geodesic problem, doi:10.1137/0216045.
    """
    if surface.is_traced:
        raise ValueError(
            "The distance is computed on the host, but the surface is being traced by a JAX transformation."
        )
    sources = checked_sources(surface, sources)
    if method == "exact":
        distance = _on_the_polyhedron(surface, sources)
    elif method == "marching":
        distance = _march(surface.remembered("windows", lambda: _windows(surface)), sources, surface.num_vertices)
    else:
        raise ValueError(f'Expected the method "marching" or "exact", found {method!r}.')
    return jnp.asarray(distance, surface.dtype)


def checked_sources(surface: Surface, sources: Any) -> np.ndarray:
    """Source vertices as an array.

    Raises:
        ValueError: there are none, or they are not on the surface.
    """
    sources = np.atleast_1d(np.asarray(sources))
    if sources.size == 0 or sources.min() < 0 or sources.max() >= surface.num_vertices:
        raise ValueError(f"Expected source vertices from 0 to {surface.num_vertices - 1}, found {sources}.")
    return sources


class _Windows(NamedTuple):
    """Pairs of vertices through which a front reaches a third one, W in all.

    Places are in a plane in which the triangles between are unfolded and the vertex that is reached is at zero.

    Attributes:
        targets: (W,) the vertex that is reached.
        ends: (2, W) the two vertices.
        places: (2, W) where these are.
        gap: (2, W) the ends of the edge that a path has to cross on its way; the two vertices themselves, or those of
            the edge opposite the target.
        order: (2 W,) the windows, sorted by the vertices they begin at; and ``starts`` (V + 1,) where each has its own.
        mean_length: of the edges.
    """

    targets: Int[np.ndarray, " W"]
    ends: Int[np.ndarray, "2 W"]
    places: Complex[np.ndarray, "2 W"]
    gap: Complex[np.ndarray, "2 W"]
    order: Int[np.ndarray, " N"]
    starts: Int[np.ndarray, " M"]
    mean_length: float

    def of(self, vertices: np.ndarray) -> np.ndarray:
        """The windows that begin at some vertices, each once."""
        counts = self.starts[vertices + 1] - self.starts[vertices]
        first = np.repeat(self.starts[vertices] - np.cumsum(counts) + counts, counts)
        return np.unique(self.order[first + np.arange(len(first))])


def _windows(surface: Surface) -> _Windows:
    """The windows of a surface: the edge opposite a vertex in each of its triangles, and the two edges behind that."""
    topology, vertices = jax.device_get((surface.topology, surface.vertices))
    is_folded = np.zeros(len(vertices), bool) if topology.is_extrinsic is None else topology.is_extrinsic
    _, half_edges, _ = delaunay_triangulation(
        topology.faces, vertices.astype(np.float64), topology.ring, topology.ring_blocks, is_folded
    )
    near, places, h = _opposite(half_edges)
    across = h ^ 1
    has_more = half_edges.following[across] >= 0
    seen, gap, behind = near[:, has_more], places[:, has_more], across[has_more]
    third, beyond = _beyond(half_edges, behind, gap)
    targets = np.concatenate([near[2], seen[2], seen[2]])
    ends = np.concatenate([near[:2], [seen[0], third], [third, seen[1]]], axis=1)
    spots = np.concatenate([places, [gap[0], beyond], [beyond, gap[1]]], axis=1)
    order = np.argsort(ends.ravel(), kind="stable")
    starts = np.searchsorted(ends.ravel()[order], np.arange(surface.num_vertices + 1))
    return _Windows(
        targets, ends, spots, np.concatenate([places, gap, gap], axis=1), order % len(targets), starts,
        float(half_edges.lengths.mean()),
    )  # fmt: skip


def _opposite(half_edges: HalfEdges) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For every corner of a triangle the two other vertices and its own (3, N), where the two are with its own at zero
    (2, N), and the half-edge between them (N,)."""
    following, tails, lengths = half_edges.following, half_edges.tails, half_edges.lengths
    h = np.flatnonzero(following >= 0)
    ahead = following[h]
    last = following[ahead]
    opposite, right, left = lengths[h >> 1], lengths[last >> 1], lengths[ahead >> 1]
    cosine = np.clip((left**2 + right**2 - opposite**2) / (2 * left * right), -1, 1)
    places = np.stack([right.astype(complex), left * np.exp(1j * np.arccos(cosine))])
    return np.stack([tails[h], tails[ahead], tails[last]]), places, h


def _beyond(half_edges: HalfEdges, h: np.ndarray, gap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The third vertex of the triangles of half-edges that lead from ``gap[1]`` to ``gap[0]``, and where it is."""
    ahead = half_edges.following[h]
    last = half_edges.following[ahead]
    from_first, from_second = half_edges.lengths[ahead >> 1], half_edges.lengths[last >> 1]
    return half_edges.tails[last], _apex(gap, from_first, from_second)[0]


def _apex(places: np.ndarray, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The point at such distances from two places, on the side of them away from zero; and whether there is one."""
    edge = places[1] - places[0]
    length = np.maximum(np.abs(edge), np.finfo(float).tiny)
    along = (first**2 - second**2 + length**2) / (2 * length)
    square = first**2 - along**2
    across = 1j * edge / length
    side = np.where(_turn(edge, -places[0]) > 0, -1, 1)
    return places[0] + edge / length * along + side * across * np.sqrt(np.maximum(square, 0)), square >= 0


def _turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The cross product of complex numbers as vectors of the plane."""
    return np.imag(np.conj(a) * b)


def _is_between(point: np.ndarray, pair: np.ndarray, slack: float = 0.0) -> Bool[np.ndarray, " N"]:
    """Whether zero sees a point between the two of a pair."""
    sign = np.sign(_turn(pair[0], pair[1]))
    least = -slack * np.abs(point) * np.abs(pair)
    return (_turn(pair[0], point) * sign >= least[0]) & (_turn(point, pair[1]) * sign >= least[1])


def _march(windows: _Windows, sources: np.ndarray, num_vertices: int) -> np.ndarray:
    """The distances, those of nearer vertices first; what a shorter path lowers is looked at once more."""
    distance, waits = np.full(num_vertices, np.inf), np.zeros(num_vertices, bool)
    distance[sources], waits[sources] = 0, True
    while waits.any():
        waiting = np.flatnonzero(waits)
        front = waiting[distance[waiting] <= distance[waiting].min() + windows.mean_length]
        waits[front] = False
        which = windows.of(front)
        found = np.full(num_vertices, np.inf)
        np.minimum.at(found, windows.targets[which], _arrivals(windows, which, distance))
        is_nearer = found < distance * (1 - _ROUNDING)
        distance[is_nearer] = found[is_nearer]
        waits |= is_nearer
    return distance


def _arrivals(windows: _Windows, which: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """The distances of the targets of some windows by way of these."""
    places, gap, known = windows.places[:, which], windows.gap[:, which], distance[windows.ends[:, which]]
    is_known = np.isfinite(known)
    reached = np.where(is_known, known, 0.0)
    # As if from one point; and where its light does not fall through the gap, along an edge.
    origin, exists = _apex(places, *reached)
    is_lit = is_known.all(axis=0) & exists & _is_between(origin, places) & _is_between(origin, gap)
    found = np.where(is_lit, np.abs(origin), np.inf)
    for place, there, is_there in zip(places, reached, is_known, strict=True):
        is_seen = is_there & _is_between(place, gap, _ROUNDING)
        found = np.where(is_seen, np.minimum(found, there + np.abs(place)), found)
    return found


def _on_the_polyhedron(surface: Surface, sources: np.ndarray) -> np.ndarray:
    """The distances along the triangles of the mesh itself."""
    try:
        import igl
    except ImportError as error:
        raise ImportError('The method "exact" needs libigl: pip install libigl, or ltljax[bench].') from error
    vertices, faces = np.asarray(surface.vertices, np.float64), np.asarray(surface.faces, np.int64)
    components = np.asarray(surface.topology.components)
    distance = np.full(surface.num_vertices, np.inf)
    for component in np.unique(components[sources]):
        targets = np.flatnonzero(components == component)
        own = sources[components[sources] == component]
        distance[targets] = np.ravel(igl.exact_geodesic(vertices, faces, VS=own, VT=targets))
    return distance
