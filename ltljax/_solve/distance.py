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

from .._lifting.delaunay import HalfEdges, delaunay_triangulation
from .._lifting.jets import INTERIOR
from .._surface import Surface, on_surface
from .._tables import AnyArray

# A distance is corrected where it falls by more than this share, which is rounding.
_ROUNDING = 1e-12
# Two paths count as coming from one point if the cosine of the angle between them exceeds this.
_ALIKE = 0.5
# Angles in radians, and lengths in proportion, that differ by less are the same.
_SLACK = 1e-9
# Stands for the angle sum at a boundary vertex, where no turn goes all the way around; larger than any angle.
_NEVER_AROUND = 1e3


@on_surface
def geodesic_distance(
    surface: Surface,
    sources: Int[AnyArray, " n"] | Sequence[int] | int,
    method: Literal["marching", "exact"] = "marching",
) -> Float[Array, " V"]:
    """The distance along the surface of every vertex from the nearest of some source vertices (host).

    With ``"marching"`` a front moves on from vertex to vertex. Two neighbours and their distances, unfolded into the
    plane, show where their paths come from, a source or a bend, and so the distance of a third vertex beyond them.
    Where the paths of the two come from different sources, each is continued by itself, in the direction from which the
    front arrived.

    From one source it is exact to rounding where the surface unfolds into a plane and shortest paths are straight
    there, such as on strips and rolled sheets. With several sources the error there was at most a tenth of an edge on
    the meshes tried, and where paths bend, at holes and corners, a third of an edge. On curved surfaces it is of first
    order in the mean, with an error a third of that of the heat method on spheres and a tenth on scans.

    With ``"exact"`` the shortest paths on the polyhedron of the mesh, by libigl (``pip install libigl``), which takes
    several times as long on 10,000 vertices, and more on larger meshes.

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
    if sources.dtype.kind not in "iu":
        raise ValueError(f"Expected the numbers of source vertices, found {sources!r:.80}.")
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
            the edge opposite the target. The first is in the direction 1.
        arrival: (W,) the angle at the target of the first end of the gap, from the target's first half-edge.
        facing: (2, W) the angle at each of the two vertices of the other one, from its own first half-edge.
        angle_sums: (V,) of the faces at each vertex, in radians.
        order: (2 W,) the windows, sorted by the vertices they begin at; and ``starts`` (V + 1,) where each has its own.
        mean_length: of the edges.
    """

    targets: Int[np.ndarray, " W"]
    ends: Int[np.ndarray, "2 W"]
    places: Complex[np.ndarray, "2 W"]
    gap: Complex[np.ndarray, "2 W"]
    arrival: Float[np.ndarray, " W"]
    facing: Float[np.ndarray, "2 W"]
    angle_sums: Float[np.ndarray, " V"]
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
    _, half_edges, mesh_angles = delaunay_triangulation(
        topology.faces, vertices.astype(np.float64), topology.ring, topology.ring_blocks, is_folded
    )
    near, places, h, last = _opposite(half_edges)
    has_more = half_edges.following[h ^ 1] >= 0
    seen, gap, behind = near[:, has_more], places[:, has_more], h[has_more] ^ 1
    third, beyond, right, left = _beyond(half_edges, behind, gap)
    targets = np.concatenate([near[2], seen[2], seen[2]])
    ends = np.concatenate([near[:2], [seen[0], third], [third, seen[1]]], axis=1)
    spots = np.concatenate([places, [gap[0], beyond], [beyond, gap[1]]], axis=1)
    arrival = half_edges.angles[np.concatenate([last, last[has_more], last[has_more]])]
    between = np.concatenate([h, right, left])
    order = np.argsort(ends.ravel(), kind="stable")
    starts = np.searchsorted(ends.ravel()[order], np.arange(surface.num_vertices + 1))
    return _Windows(
        targets, ends, spots, np.concatenate([places, gap, gap], axis=1), arrival,
        half_edges.angles[np.stack([between, between ^ 1])],
        np.where(topology.kinds == INTERIOR, mesh_angles.sums, _NEVER_AROUND),
        order % len(targets), starts, float(half_edges.lengths.mean()),
    )  # fmt: skip


def _opposite(half_edges: HalfEdges) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """For every corner of a triangle the two other vertices and its own (3, N), where the two are with its own at zero
    (2, N), the half-edge between them (N,), and the one from its own vertex to the first of them (N,)."""
    following, tails, lengths = half_edges.following, half_edges.tails, half_edges.lengths
    h = np.flatnonzero(following >= 0)
    ahead = following[h]
    last = following[ahead]
    opposite, right, left = lengths[h >> 1], lengths[last >> 1], lengths[ahead >> 1]
    cosine = np.clip((left**2 + right**2 - opposite**2) / (2 * left * right), -1, 1)
    places = np.stack([right.astype(complex), left * np.exp(1j * np.arccos(cosine))])
    return np.stack([tails[h], tails[ahead], tails[last]]), places, h, last


def _beyond(
    half_edges: HalfEdges, h: np.ndarray, gap: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The third vertex of the triangles of half-edges that lead from ``gap[1]`` to ``gap[0]``, where it is, and the
    half-edges to it and from it."""
    ahead = half_edges.following[h]
    last = half_edges.following[ahead]
    from_first, from_second = half_edges.lengths[ahead >> 1], half_edges.lengths[last >> 1]
    return half_edges.tails[last], _apex(gap, from_first, from_second)[0], ahead, last


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


class _Front(NamedTuple):
    """What is known of the shortest path from every vertex to the sources.

    Attributes:
        distance: (V,) its length; infinite where no path is known.
        source: (V,) the source it leads to.
        pivot: (V,) the first vertex at which it bends, or the source if it is straight.
        beyond: (V,) the length of what lies beyond the pivot.
        direction: (V,) the angle in which it leaves, from the vertex's first half-edge.
    """

    distance: Float[np.ndarray, " V"]
    source: Int[np.ndarray, " V"]
    pivot: Int[np.ndarray, " V"]
    beyond: Float[np.ndarray, " V"]
    direction: Float[np.ndarray, " V"]


def _march(windows: _Windows, sources: np.ndarray, num_vertices: int) -> np.ndarray:
    """The distances, those of nearer vertices first; what a shorter path lowers is looked at once more."""
    own, zero = np.arange(num_vertices), np.zeros(num_vertices)
    front = _Front(np.full(num_vertices, np.inf), own, own.copy(), zero, zero.copy())
    front.distance[sources] = 0
    waits = np.zeros(num_vertices, bool)
    waits[sources] = True
    while waits.any():
        waiting = np.flatnonzero(waits)
        leading = waiting[front.distance[waiting] <= front.distance[waiting].min() + windows.mean_length]
        waits[leading] = False
        which = windows.of(leading)
        # No path through two vertices is shorter than that to the nearer one.
        is_ahead = front.distance[windows.targets[which]] > front.distance[windows.ends[:, which]].min(axis=0)
        which = which[is_ahead]
        targets = windows.targets[which]
        lengths, *path = _arrivals(windows, which, front)
        shortest = np.full(num_vertices, np.inf)
        np.minimum.at(shortest, targets, lengths)
        is_nearer = shortest < front.distance * (1 - _ROUNDING)
        best = np.flatnonzero((lengths == shortest[targets]) & is_nearer[targets])
        front.distance[is_nearer] = shortest[is_nearer]
        for kept, new in zip(front[1:], path, strict=True):
            kept[targets[best]] = new[best]
        waits |= is_nearer
    return front.distance


def _arrivals(windows: _Windows, which: np.ndarray, front: _Front) -> tuple[np.ndarray, ...]:
    """What the front is at the targets of some windows if it comes through these."""
    ends, places, gap = windows.ends[:, which], windows.places[:, which], windows.gap[:, which]
    is_known = np.isfinite(front.distance[ends])
    distance = np.where(is_known, front.distance[ends], 0.0)
    source, pivot, beyond = (part[ends] for part in (front.source, front.pivot, front.beyond))
    backward = _backward(windows, which, front)
    is_common = is_known.all(axis=0) & (source[0] == source[1])
    is_common &= (np.real(np.conj(backward[0]) * backward[1]) > _ALIKE) | (distance == beyond).any(axis=0)
    # Paths that bend at different vertices are treated as if each were straight from the source.
    has_pivot = (pivot[0] == pivot[1]) & (beyond[0] == beyond[1])
    common_beyond = np.where(has_pivot, beyond[0], 0)
    common, exists = _apex(places, *(distance - common_beyond))
    # Five ways on: straight from the point that both paths come from, or from that of either; and along either edge.
    origins = np.stack([common, *(places + (distance - beyond) * backward), *places])
    is_open = [is_common & exists & _is_between(common, places) & _is_between(common, gap)]
    for end, origin in enumerate(origins[1:3]):
        # Where the other vertex does not see this origin, a corner casts its shadow between the two.
        straight = beyond[end] + np.abs(origin - places[1 - end])
        is_seen = front.distance[ends[1 - end]] <= straight * (1 + _SLACK)
        is_lit = is_seen & (backward[end] != 0) & _is_between(origin, places) & _is_between(origin, gap)
        is_open.append(is_known[end] & ~is_common & is_lit)
    for known, place in zip(is_known, places, strict=True):
        is_open.append(known & _is_between(place, gap, _ROUNDING))
    pivots = np.stack([np.where(has_pivot, pivot[0], source[0]), *pivot, *ends])
    lengths_beyond = np.stack([common_beyond, *beyond, *distance])
    lengths = np.where(is_open, lengths_beyond + np.abs(origins), np.inf)
    best = np.argmin(lengths, axis=0), np.arange(len(which))
    sources = np.stack([source[0], *source, *source])
    direction = windows.arrival[which] + np.angle(origins[best])
    return lengths[best], sources[best], pivots[best], lengths_beyond[best], direction


def _backward(windows: _Windows, which: np.ndarray, front: _Front) -> Complex[np.ndarray, "2 N"]:
    """The directions, in the planes of some windows, in which the shortest paths leave their two vertices; zero where
    a path leaves on the target's side."""
    ends, places, facing = windows.ends[:, which], windows.places[:, which], windows.facing[:, which]
    along = places[1] - places[0]
    along = along / np.maximum(np.abs(along), np.finfo(float).tiny)
    # A path along the edge between the two turns by nothing, and not by rounding less than once around.
    turn = np.mod((facing - front.direction[ends]) * np.array([[1], [-1]]) + _SLACK, windows.angle_sums[ends]) - _SLACK
    return np.where(turn < np.pi, np.stack([along * np.exp(-1j * turn[0]), -along * np.exp(1j * turn[1])]), 0)


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
