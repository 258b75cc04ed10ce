"""How the triangles hang together: edges, rings, loops and components.

What enters: faces (F, 3) of a manifold, consistently oriented mesh and the number of its vertices; no positions. What
leaves: flat index arrays. No loop here runs once per vertex, so a million vertices take seconds.
"""

import dataclasses

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph


@dataclasses.dataclass(frozen=True, eq=False)
class OneRings:
    """The neighbours of every vertex in cyclic order, counter-clockwise seen from outside.

    Slot k of vertex v is entry ``offsets[v] + k`` of the flat arrays; the face on its counter-clockwise side is
    ``(v, neighbours[slot], successors[slot])``. An inner vertex of valence n has n faces. A boundary vertex has n - 1:
    its ring begins with the neighbour along the boundary from which the faces run counter-clockwise, and its last slot,
    which has no face, holds v itself as the successor.

    Attributes:
        offsets: (V + 1,) where each vertex's slots begin, int64.
        neighbours: (S,) the neighbours, int32.
        successors: (S,) the third vertex of each slot's face, or the vertex itself, int32.
    """

    offsets: np.ndarray
    neighbours: np.ndarray
    successors: np.ndarray

    @property
    def valences(self) -> np.ndarray:
        """The number of neighbours of each vertex, (V,)."""
        return np.diff(self.offsets)


def half_edges(faces: np.ndarray) -> np.ndarray:
    """The directed edges (3F, 2) of faces (F, 3): first all from corner 0 to 1, then 1 to 2, then 2 to 0."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def unique_edges(faces: np.ndarray) -> np.ndarray:
    """The undirected edges (E, 2), int32, lower vertex first, sorted."""
    num_vertices = int(faces.max(initial=-1)) + 1
    # Sorting by hand: since NumPy 2.3 np.unique hashes integers, at five times the cost.
    keys = np.sort(undirected_keys(half_edges(faces), num_vertices))
    keys = keys[np.diff(keys, prepend=-1) > 0]
    return np.stack([keys // max(num_vertices, 1), keys % max(num_vertices, 1)], axis=1).astype(np.int32)


def used_vertices(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """The vertices that some face refers to, sorted."""
    is_used = np.zeros(num_vertices, bool)
    is_used[faces] = True
    return np.flatnonzero(is_used)


def undirected_keys(edges: np.ndarray, num_vertices: int) -> np.ndarray:
    """One int64 number per edge (N, 2), the same for both directions, that sorts as the edges do."""
    return edges.min(axis=1).astype(np.int64) * num_vertices + edges.max(axis=1)


def shared_edges(faces: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pairs of `half_edges` that share an edge, (N,) each, and whether both run the same way, (N,) bool.

    They run opposite ways where the two faces agree in orientation.
    """
    directed = half_edges(faces)
    keys = undirected_keys(directed, num_vertices)
    order = np.argsort(keys, kind="stable")
    pairs = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    one, other = order[pairs], order[pairs + 1]
    return one, other, directed[one, 0] == directed[other, 0]


def components(one: np.ndarray, other: np.ndarray, count: int) -> np.ndarray:
    """The component label of each of ``count`` nodes that are linked in pairs (N,), (N,)."""
    graph = sparse.coo_array((np.ones(len(one), np.int8), (one, other)), shape=(count, count))
    return csgraph.connected_components(graph.tocsr(), directed=False)[1]


def boundary_half_edges(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """The directed edges (B, 2) that belong to one face only, in that face's direction."""
    directed = half_edges(faces)
    keys = undirected_keys(directed, num_vertices)
    order = np.argsort(keys)
    differs = np.diff(keys[order], prepend=-1, append=-1) != 0
    return directed[order[differs[1:] & differs[:-1]]]


def boundary_loops(faces: np.ndarray, num_vertices: int) -> list[np.ndarray]:
    """The closed curves that bound the surface, each an int32 array of vertices with the surface on the left.

    A loop begins at its smallest vertex, and the loops are sorted by that vertex.
    """
    edges = boundary_half_edges(faces, num_vertices)
    follows = dict(zip(edges[:, 0].tolist(), edges[:, 1].tolist(), strict=True))
    loops = []
    for start in sorted(follows):
        loop, vertex = [], start
        while vertex in follows:
            loop.append(vertex)
            vertex = follows.pop(vertex)
        if loop:
            loops.append(np.array(loop, dtype=np.int32))
    return loops


def locality_order(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """The vertices (V,), int32, in an order that puts neighbours near one another (reverse Cuthill and McKee)."""
    ends = half_edges(faces)
    adjacency = sparse.csr_array((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(num_vertices,) * 2)
    return csgraph.reverse_cuthill_mckee((adjacency + adjacency.T).tocsr(), symmetric_mode=True)


def vertex_components(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """The label (V,), int32, of the connected component of every vertex, numbered by their first vertices."""
    edges = half_edges(faces)
    labels = components(edges[:, 0], edges[:, 1], num_vertices)
    first = np.full(labels.max(initial=-1) + 1, num_vertices)
    np.minimum.at(first, labels, np.arange(num_vertices))
    return np.argsort(np.argsort(first))[labels].astype(np.int32)


def one_rings(faces: np.ndarray, num_vertices: int) -> OneRings:
    """The neighbours of every vertex in cyclic order, with the third vertex of each face.

    Args:
        faces: (F, 3) of a manifold, consistently oriented mesh without unreferenced vertices.
        num_vertices: the number of vertices.

    Raises:
        ValueError: where the faces around a vertex do not form one fan, so that no cyclic order exists.
    """
    # A corner of a face is a slot: seen from its vertex, the edge to `ahead`, and the face between `ahead` and `third`.
    faces = np.asarray(faces, dtype=np.int64)
    vertex = faces.ravel()
    ahead = np.roll(faces, -1, axis=1).ravel()
    third = np.roll(faces, -2, axis=1).ravel()
    keys = vertex * num_vertices + ahead
    order = np.argsort(keys)
    keys, vertex, ahead, third = keys[order], vertex[order], ahead[order], third[order]

    # The next slot around the vertex begins where this slot's face ends. At a boundary there is none.
    wanted = vertex * num_vertices + third
    following = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    is_last = keys[following] != wanted if len(keys) else np.zeros(0, bool)
    has_predecessor = np.zeros(len(keys), bool)
    has_predecessor[following[~is_last]] = True

    num_faces = np.bincount(vertex, minlength=num_vertices)
    valences = num_faces + np.bincount(vertex[is_last], minlength=num_vertices)
    offsets = np.concatenate([[0], np.cumsum(valences)])
    start = np.cumsum(num_faces) - num_faces  # the smallest neighbour, unless a boundary says otherwise
    first_slots = np.flatnonzero(~has_predecessor)
    start[vertex[first_slots]] = first_slots

    neighbours = np.full(offsets[-1], -1, dtype=np.int32)
    successors = np.full(offsets[-1], -1, dtype=np.int32)
    # All vertices walk around their rings at once; each round drops those that have come full circle.
    walking = np.flatnonzero(num_faces)
    slot = start[walking]
    for step in range(int(num_faces.max(initial=0))):
        position = offsets[walking] + step
        neighbours[position], successors[position] = ahead[slot], third[slot]
        ends = is_last[slot]
        neighbours[position[ends] + 1] = third[slot[ends]]
        successors[position[ends] + 1] = walking[ends]
        goes_on = ~ends & (following[slot] != start[walking])
        walking, slot = walking[goes_on], following[slot[goes_on]]
        if not len(walking):
            break
    if np.any(neighbours < 0) or len(walking):
        broken = int(np.searchsorted(offsets, np.flatnonzero(neighbours < 0)[:1], side="right")[0]) - 1
        raise ValueError(
            f"The faces around vertex {broken} do not form one fan, so its neighbours have no cyclic order. "
            "Build the mesh with ltljax.Mesh, which checks this and mends it with repair=True."
        )
    return OneRings(offsets, neighbours, successors)


def k_ring(
    faces: np.ndarray | OneRings, num_vertices: int, vertices: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """All vertices within k edges of each given vertex, without the vertex itself, as rows ``(offsets, indices)``.

    Row i belongs to ``vertices[i]`` and is ``indices[offsets[i] : offsets[i + 1]]``, int32, sorted.

    Args:
        faces: (F, 3), or the `OneRings` of the mesh where they are at hand.
        num_vertices: the number of vertices.
        vertices: (N,) the vertices asked for.
        k: the largest distance in edges, at least 1.
    """
    vertices = np.asarray(vertices, dtype=np.int64)
    if isinstance(faces, OneRings):
        ones = np.ones(len(faces.neighbours), bool)
        adjacency = sparse.csr_array((ones, faces.neighbours, faces.offsets), shape=(num_vertices, num_vertices))
    else:
        adjacency = _adjacency(faces, num_vertices)
    count = len(vertices)
    rows = np.arange(count)
    reached = sparse.csr_array((np.ones(count, bool), (rows, vertices)), shape=(count, num_vertices))
    for _ in range(k):
        reached = reached + reached @ adjacency
    row, column = reached.nonzero()
    is_other = column != vertices[row]
    row, column = row[is_other], column[is_other]
    order = np.argsort(row * np.int64(num_vertices) + column)
    lengths = np.bincount(row, minlength=count)
    return np.concatenate([[0], np.cumsum(lengths)]), column[order].astype(np.int32)


def _adjacency(faces: np.ndarray, num_vertices: int) -> sparse.csr_array:
    """The boolean matrix (V, V) of which vertices share an edge."""
    edges = half_edges(np.asarray(faces))
    row, column = np.concatenate([edges, edges[:, ::-1]]).T
    # A sum over duplicates would count; a boolean matrix only remembers that there is an edge.
    return sparse.csr_array((np.ones(len(row), bool), (row, column)), shape=(num_vertices, num_vertices))
