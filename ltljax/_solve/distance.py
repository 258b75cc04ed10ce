"""Distances along a surface: a front that advances over unfolded triangles (host).

What enters: a surface and source vertices. What leaves: the distance of every vertex from the nearest source. It
depends only on the edge lengths of the intrinsic Delaunay triangulation, and not on how the surface bends in space.
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

# A distance is updated where it falls by more than this share, which is rounding error.
_ROUNDING = 1e-12
# Two paths are taken to start at one point if the cosine of the angle between them exceeds this.
_ALIKE = 0.5
# Angles (in radians) and lengths (relative) that differ by less than this are equal.
_SLACK = 1e-9
# Stands for the angle sum at a boundary vertex, where no rotation leads all the way around; larger than any angle.
_NEVER_AROUND = 1e3


@on_surface
def geodesic_distance(
    surface: Surface,
    sources: Int[AnyArray, " n"] | Sequence[int] | int,
    method: Literal["marching", "exact"] = "marching",
) -> Float[Array, " V"]:
    """The distance along the surface from every vertex to the nearest source vertex (host).

    With ``"marching"`` a front advances from vertex to vertex. Two neighbours and their distances, unfolded into the
    plane, determine the point that their paths come from (a source or a bend) and thereby the distance of a third
    vertex beyond them. If the paths of the two neighbours come from different sources, each path is continued by
    itself, in the direction in which the front arrived.

    The distance from one source is exact to rounding where the surface unfolds into a plane and shortest paths are
    straight there, as on strips and rolled sheets. On the meshes tested, the error there was at most a tenth of an edge
    with several sources, and a third of an edge where paths bend, at holes and corners. On curved surfaces the mean
    error is of first order; it is a third of the heat method's error on spheres and a tenth of it on scans.

    With ``"exact"`` libigl (``pip install libigl``) computes the shortest paths on the polyhedron of the mesh. This
    takes several times as long on 10,000 vertices, and still more on larger meshes.

    Args:
        surface: surface of any scheme. The distance is infinite on a component without a source.
        sources: (n,) indices of vertices, or one index.
        method: ``"marching"`` or ``"exact"``.

    Raises:
        ValueError: there are no sources, a source is not on the surface, the surface is being traced, or the method is
            unknown.
        ImportError: the method is ``"exact"`` and libigl is not installed.

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
            "The distance is computed on the host, but the surface is being traced by a JAX transformation. Compute it "
            "outside."
        )
    sources = checked_sources(surface, sources)
    if method == "exact":
        distance = _polyhedral_distance(surface, sources)
    elif method == "marching":
        windows = surface.remembered("windows", lambda: _windows(surface))
        distance = _front_distance(windows, sources, surface.num_vertices)
    else:
        raise ValueError(f'Expected the method "marching" or "exact", found {method!r}.')
    return jnp.asarray(distance, surface.dtype)


def checked_sources(surface: Surface, sources: Any) -> np.ndarray:
    """Source vertices as an array.

    Raises:
        ValueError: there are no sources, or a source is not on the surface.
    """
    sources = np.atleast_1d(np.asarray(sources))
    if sources.dtype.kind not in "iu":
        raise ValueError(f"Expected the indices of source vertices as integers, found {sources!r:.80}.")
    if sources.size == 0 or sources.min() < 0 or sources.max() >= surface.num_vertices:
        raise ValueError(f"Expected source vertices from 0 to {surface.num_vertices - 1}, found {sources}.")
    return sources


class _Windows(NamedTuple):
    """W windows: pairs of vertices through which the front reaches a third vertex, the target.

    The triangles of a window are unfolded into a plane with the target at zero. Points of this plane are complex
    numbers.

    Attributes:
        targets: (W,) vertex that is reached.
        ends: (2, W) the two vertices of the pair.
        places: (2, W) points of the two vertices.
        gap: (2, W) end points of the edge that a path to the target has to cross: the two vertices themselves, or the
            vertices of the edge opposite the target. The first one lies in the direction 1.
        arrival: (W,) angle at the target from its first half-edge to the first point of the gap.
        facing: (2, W) angle at each vertex of the pair from its first half-edge to the other vertex.
        angle_sums: (V,) sum of the face angles at each vertex, in radians.
        order: (2 W,) windows sorted by the vertices of their pairs.
        starts: (V + 1,) position in ``order`` of the first window of each vertex.
        mean_length: mean edge length.
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

    def beginning_at(self, vertices: np.ndarray) -> np.ndarray:
        """The windows whose pair contains one of some vertices, each window once."""
        counts = self.starts[vertices + 1] - self.starts[vertices]
        first = np.repeat(self.starts[vertices] - np.cumsum(counts) + counts, counts)
        return np.unique(self.order[first + np.arange(len(first))])


def _windows(surface: Surface) -> _Windows:
    """The windows of a surface.

    Each corner of a triangle is the target of three windows: one whose pair is the opposite edge, and two whose pairs
    are the other edges of the triangle behind that edge.
    """
    topology, vertices = jax.device_get((surface.topology, surface.vertices))
    is_near_fold = np.zeros(len(vertices), bool) if topology.is_extrinsic is None else topology.is_extrinsic
    _, half_edges, mesh_angles = delaunay_triangulation(
        topology.faces, vertices.astype(np.float64), topology.ring, topology.ring_blocks, is_near_fold
    )
    corners, places, opposite, last = _corners(half_edges)
    has_neighbour = half_edges.following[opposite ^ 1] >= 0
    inner, gap, behind = corners[:, has_neighbour], places[:, has_neighbour], opposite[has_neighbour] ^ 1
    apex, apex_place, right, left = _triangles_behind(half_edges, behind, gap)
    targets = np.concatenate([corners[2], inner[2], inner[2]])
    ends = np.concatenate([corners[:2], [inner[0], apex], [apex, inner[1]]], axis=1)
    end_places = np.concatenate([places, [gap[0], apex_place], [apex_place, gap[1]]], axis=1)
    arrival = half_edges.angles[np.concatenate([last, last[has_neighbour], last[has_neighbour]])]
    between = np.concatenate([opposite, right, left])
    order = np.argsort(ends.ravel(), kind="stable")
    starts = np.searchsorted(ends.ravel()[order], np.arange(surface.num_vertices + 1))
    return _Windows(
        targets, ends, end_places, np.concatenate([places, gap, gap], axis=1), arrival,
        half_edges.angles[np.stack([between, between ^ 1])],
        np.where(topology.kinds == INTERIOR, mesh_angles.sums, _NEVER_AROUND),
        order % len(targets), starts, float(half_edges.lengths.mean()),
    )  # fmt: skip


def _corners(half_edges: HalfEdges) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The N corners of all triangles, each unfolded with its own vertex at zero.

    Returns:
        (3, N) the two other vertices of the triangle and the corner's own; (2, N) the points of the two others; (N,)
        the half-edge between these; (N,) the half-edge from the corner's vertex to the first of them.
    """
    following, tails, lengths = half_edges.following, half_edges.tails, half_edges.lengths
    opposite = np.flatnonzero(following >= 0)
    ahead = following[opposite]
    last = following[ahead]
    base, right, left = lengths[opposite >> 1], lengths[last >> 1], lengths[ahead >> 1]
    cosine = np.clip((left**2 + right**2 - base**2) / (2 * left * right), -1, 1)
    places = np.stack([right.astype(complex), left * np.exp(1j * np.arccos(cosine))])
    return np.stack([tails[opposite], tails[ahead], tails[last]]), places, opposite, last


def _triangles_behind(
    half_edges: HalfEdges, h: np.ndarray, gap: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The third vertices of the triangles at half-edges that lead from ``gap[1]`` to ``gap[0]``.

    Returns:
        The vertices, their points, and the half-edges to and from them.
    """
    ahead = half_edges.following[h]
    last = half_edges.following[ahead]
    from_first, from_second = half_edges.lengths[ahead >> 1], half_edges.lengths[last >> 1]
    return half_edges.tails[last], _apex(gap, from_first, from_second)[0], ahead, last


def _apex(places: np.ndarray, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The point with given distances from two points, on the side away from zero, and whether it exists."""
    edge = places[1] - places[0]
    length = np.maximum(np.abs(edge), np.finfo(float).tiny)
    along = (first**2 - second**2 + length**2) / (2 * length)
    square = first**2 - along**2
    across = 1j * edge / length
    side = np.where(_cross(edge, -places[0]) > 0, -1, 1)
    return places[0] + edge / length * along + side * across * np.sqrt(np.maximum(square, 0)), square >= 0


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The cross product of complex numbers as vectors of the plane."""
    return np.imag(np.conj(a) * b)


def _is_between(point: np.ndarray, pair: np.ndarray, slack: float = 0.0) -> Bool[np.ndarray, " N"]:
    """Whether a point lies, as seen from zero, between the two points of a pair."""
    sign = np.sign(_cross(pair[0], pair[1]))
    least = -slack * np.abs(point) * np.abs(pair)
    return (_cross(pair[0], point) * sign >= least[0]) & (_cross(point, pair[1]) * sign >= least[1])


class _Front(NamedTuple):
    """The shortest known path from each of N vertices to a source.

    Attributes:
        distance: (N,) length of the path, infinite where no path is known.
        source: (N,) source that the path leads to.
        pivot: (N,) first vertex at which the path bends, or the source if the path is straight.
        beyond: (N,) length of the path beyond the pivot.
        direction: (N,) angle from the vertex's first half-edge in which the path leaves the vertex.
    """

    distance: Float[np.ndarray, " N"]
    source: Int[np.ndarray, " N"]
    pivot: Int[np.ndarray, " N"]
    beyond: Float[np.ndarray, " N"]
    direction: Float[np.ndarray, " N"]


def _front_distance(windows: _Windows, sources: np.ndarray, num_vertices: int) -> np.ndarray:
    """The distances after the front has advanced over all windows.

    Nearer vertices come first, and a vertex whose distance falls later is processed again.
    """
    own, zero = np.arange(num_vertices), np.zeros(num_vertices)
    front = _Front(np.full(num_vertices, np.inf), own, own.copy(), zero, zero.copy())
    front.distance[sources] = 0
    is_waiting = np.zeros(num_vertices, bool)
    is_waiting[sources] = True
    while is_waiting.any():
        waiting = np.flatnonzero(is_waiting)
        leading = waiting[front.distance[waiting] <= front.distance[waiting].min() + windows.mean_length]
        is_waiting[leading] = False
        which = windows.beginning_at(leading)
        # No path through two vertices is shorter than the path of the nearer one.
        is_ahead = front.distance[windows.targets[which]] > front.distance[windows.ends[:, which]].min(axis=0)
        which = which[is_ahead]
        targets = windows.targets[which]
        arrivals = _arrivals(windows, which, front)
        shortest = np.full(num_vertices, np.inf)
        np.minimum.at(shortest, targets, arrivals.distance)
        is_nearer = shortest < front.distance * (1 - _ROUNDING)
        best = np.flatnonzero((arrivals.distance == shortest[targets]) & is_nearer[targets])
        front.distance[is_nearer] = shortest[is_nearer]
        for current, arriving in zip(front[1:], arrivals[1:], strict=True):
            current[targets[best]] = arriving[best]
        is_waiting |= is_nearer
    return front.distance


class _Pairs(NamedTuple):
    """The pairs of N windows with the shortest known paths of their vertices.

    Attributes:
        ends: (2, N) vertices.
        places: (2, N) points of the vertices.
        gap: (2, N) end points of the edge that a path to the target has to cross.
        is_known: (2, N) whether a path of the vertex is known.
        distance: (2, N) lengths of the paths, zero where none is known.
        source: (2, N) as in `_Front`.
        pivot: (2, N) as in `_Front`.
        beyond: (2, N) as in `_Front`.
        backward: (2, N) unit vectors in which the paths leave the vertices, zero on the target's side.
        is_common: (N,) whether both paths come from the same point.
    """

    ends: Int[np.ndarray, "2 N"]
    places: Complex[np.ndarray, "2 N"]
    gap: Complex[np.ndarray, "2 N"]
    is_known: Bool[np.ndarray, "2 N"]
    distance: Float[np.ndarray, "2 N"]
    source: Int[np.ndarray, "2 N"]
    pivot: Int[np.ndarray, "2 N"]
    beyond: Float[np.ndarray, "2 N"]
    backward: Complex[np.ndarray, "2 N"]
    is_common: Bool[np.ndarray, " N"]


class _Candidates(NamedTuple):
    """P paths to the target of each of N windows.

    Attributes:
        origin: (P, N) point at which the last straight part of the path begins.
        source: (P, N) as in `_Front`.
        pivot: (P, N) as in `_Front`.
        beyond: (P, N) as in `_Front`.
        is_open: (P, N) whether the path exists.
    """

    origin: Complex[np.ndarray, "P N"]
    source: Int[np.ndarray, "P N"]
    pivot: Int[np.ndarray, "P N"]
    beyond: Float[np.ndarray, "P N"]
    is_open: Bool[np.ndarray, "P N"]


def _arrivals(windows: _Windows, which: np.ndarray, front: _Front) -> _Front:
    """The shortest path that each of some windows gives its target."""
    pairs = _pairs(windows, which, front)
    kinds = (_from_common_origin(pairs), _from_own_origins(pairs), _along_edges(pairs))
    origin, source, pivot, beyond, is_open = map(np.concatenate, zip(*kinds, strict=True))
    length = np.where(is_open, beyond + np.abs(origin), np.inf)
    best = np.argmin(length, axis=0), np.arange(len(which))
    direction = windows.arrival[which] + np.angle(origin[best])
    return _Front(length[best], source[best], pivot[best], beyond[best], direction)


def _pairs(windows: _Windows, which: np.ndarray, front: _Front) -> _Pairs:
    ends = windows.ends[:, which]
    is_known = np.isfinite(front.distance[ends])
    distance = np.where(is_known, front.distance[ends], 0.0)
    source, pivot, beyond = front.source[ends], front.pivot[ends], front.beyond[ends]
    backward = _backward(windows, which, front)
    is_common = is_known.all(axis=0) & (source[0] == source[1])
    is_common &= (np.real(np.conj(backward[0]) * backward[1]) > _ALIKE) | (distance == beyond).any(axis=0)
    places, gap = windows.places[:, which], windows.gap[:, which]
    return _Pairs(ends, places, gap, is_known, distance, source, pivot, beyond, backward, is_common)


def _backward(windows: _Windows, which: np.ndarray, front: _Front) -> Complex[np.ndarray, "2 N"]:
    """The unit vectors in which the shortest paths leave the vertices of some pairs.

    A vector is zero where the path leaves on the target's side.
    """
    ends, places, facing = windows.ends[:, which], windows.places[:, which], windows.facing[:, which]
    along = places[1] - places[0]
    along = along / np.maximum(np.abs(along), np.finfo(float).tiny)
    # The slack keeps rounding from turning a path along the edge of the pair by a full rotation.
    angle = np.mod((facing - front.direction[ends]) * np.array([[1], [-1]]) + _SLACK, windows.angle_sums[ends]) - _SLACK
    return np.where(angle < np.pi, np.stack([along * np.exp(-1j * angle[0]), -along * np.exp(1j * angle[1])]), 0)


def _from_common_origin(pairs: _Pairs) -> _Candidates:
    """The straight paths from the points that the paths of both vertices come from."""
    # Paths that bend at different vertices are treated as straight from the source.
    has_pivot = (pairs.pivot[0] == pairs.pivot[1]) & (pairs.beyond[0] == pairs.beyond[1])
    beyond = np.where(has_pivot, pairs.beyond[0], 0)
    origin, exists = _apex(pairs.places, *(pairs.distance - beyond))
    is_open = pairs.is_common & exists & _is_between(origin, pairs.places) & _is_between(origin, pairs.gap)
    pivot = np.where(has_pivot, pairs.pivot[0], pairs.source[0])
    return _Candidates(origin[None], pairs.source[:1], pivot[None], beyond[None], is_open[None])


def _from_own_origins(pairs: _Pairs) -> _Candidates:
    """The straight continuations of the path of either vertex, where the two paths come from different points."""
    origin = pairs.places + (pairs.distance - pairs.beyond) * pairs.backward
    # If the other vertex is nearer than its straight distance from this origin, a corner shadows the space between.
    straight = pairs.beyond + np.abs(origin - pairs.places[::-1])
    other_distance = np.where(pairs.is_known, pairs.distance, np.inf)[::-1]
    is_visible = (other_distance <= straight * (1 + _SLACK)) & (pairs.backward != 0)
    is_inside = [_is_between(point, pairs.places) & _is_between(point, pairs.gap) for point in origin]
    is_open = pairs.is_known & ~pairs.is_common & is_visible & is_inside
    return _Candidates(origin, pairs.source, pairs.pivot, pairs.beyond, is_open)


def _along_edges(pairs: _Pairs) -> _Candidates:
    """The paths that bend at either vertex and lead straight from it to the target."""
    is_inside = [_is_between(place, pairs.gap, _ROUNDING) for place in pairs.places]
    return _Candidates(pairs.places, pairs.source, pairs.ends, pairs.distance, pairs.is_known & is_inside)


def _polyhedral_distance(surface: Surface, sources: np.ndarray) -> np.ndarray:
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
        component_sources = sources[components[sources] == component]
        distance[targets] = np.ravel(igl.exact_geodesic(vertices, faces, VS=component_sources, VT=targets))
    return distance
