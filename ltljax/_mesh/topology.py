"""The topology of a mesh: its edges, one-rings, boundary loops and components.

All functions take the faces (F, 3) of a manifold, consistently oriented mesh and return index arrays; no positions are
involved. Apart from boundary loops, Python loops run over valences and not over vertices, so a million vertices take
seconds.
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
    its ring begins with the neighbour along the boundary from which the faces run counter-clockwise. Its last slot has
    no face, and there the successor is v itself.

    Attributes:
        offsets: (V + 1,) int64, the first slot of each vertex.
        neighbours: (S,) int32, the neighbour in each slot.
        successors: (S,) int32, the third vertex of each slot's face, or the vertex itself if there is no face.
    """

    offsets: np.ndarray
    neighbours: np.ndarray
    successors: np.ndarray

    @property
    def valences(self) -> np.ndarray:
        """The number of neighbours of each vertex, (V,)."""
        return np.diff(self.offsets)


def half_edges(faces: np.ndarray) -> np.ndarray:
    """The directed edges (3F, 2): those from corner 0 to 1 of all faces, then from 1 to 2, then from 2 to 0."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def unique_edges(faces: np.ndarray) -> np.ndarray:
    """The undirected edges (E, 2), int32, lower vertex first, sorted."""
    num_vertices = int(faces.max(initial=-1)) + 1
    # Since NumPy 2.3, np.unique hashes integers, which takes five times as long as sorting them.
    keys = np.sort(undirected_keys(half_edges(faces), num_vertices))
    keys = keys[np.diff(keys, prepend=-1) > 0]
    return np.stack([keys // max(num_vertices, 1), keys % max(num_vertices, 1)], axis=1).astype(np.int32)


def used_vertices(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """The vertices that belong to a face, sorted."""
    is_used = np.zeros(num_vertices, bool)
    is_used[faces] = True
    return np.flatnonzero(is_used)


def undirected_keys(edges: np.ndarray, num_vertices: int) -> np.ndarray:
    """An int64 key (N,) for each edge (N, 2), equal for both directions and ordered like the edges."""
    return edges.min(axis=1).astype(np.int64) * num_vertices + edges.max(axis=1)


def shared_edges(faces: np.ndarray, num_vertices: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The two `half_edges` at each shared edge, (P,) each, and whether both have the same direction, (P,) bool.

    Half-edges of faces with consistent orientations have opposite directions.
    """
    directed = half_edges(faces)
    keys = undirected_keys(directed, num_vertices)
    order = np.argsort(keys, kind="stable")
    pairs = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    first, second = order[pairs], order[pairs + 1]
    return first, second, directed[first, 0] == directed[second, 0]


def components(begin: np.ndarray, end: np.ndarray, count: int) -> np.ndarray:
    """The component label (count,) of every node of a graph whose links join ``begin`` (N,) to ``end`` (N,)."""
    graph = sparse.coo_array((np.ones(len(begin), np.int8), (begin, end)), shape=(count, count))
    return csgraph.connected_components(graph.tocsr(), directed=False)[1]


def boundary_half_edges(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """The directed edges (B, 2) that belong to a single face, in the direction of that face."""
    directed = half_edges(faces)
    keys = undirected_keys(directed, num_vertices)
    order = np.argsort(keys)
    differs = np.diff(keys[order], prepend=-1, append=-1) != 0
    return directed[order[differs[1:] & differs[:-1]]]


def boundary_loops(faces: np.ndarray, num_vertices: int) -> list[np.ndarray]:
    """The closed boundary curves, each an int32 array of vertices with the surface on the left.

    A loop begins at its lowest vertex, and the loops are sorted by that vertex.
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
    """The vertices (V,), int32, in the reverse Cuthill-McKee order, which puts neighbours close to one another."""
    ends = half_edges(faces)
    adjacency = sparse.csr_array((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(num_vertices,) * 2)
    return csgraph.reverse_cuthill_mckee((adjacency + adjacency.T).tocsr(), symmetric_mode=True)


def vertex_components(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """The connected component (V,), int32, of every vertex; components are numbered by their first vertices."""
    edges = half_edges(faces)
    labels = components(edges[:, 0], edges[:, 1], num_vertices)
    first = np.full(labels.max(initial=-1) + 1, num_vertices)
    np.minimum.at(first, labels, np.arange(num_vertices))
    return np.argsort(np.argsort(first))[labels].astype(np.int32)


def one_rings(faces: np.ndarray, num_vertices: int) -> OneRings:
    """The neighbours of every vertex in cyclic order, with the third vertex of each face.

    Args:
        faces: (F, 3) of a manifold, consistently oriented mesh without unreferenced vertices.
        num_vertices: number of vertices.

    Raises:
        ValueError: the faces around a vertex do not form a single fan, so its neighbours have no cyclic order.
    """
    # Each corner of a face is a slot of its vertex: the edge to `ahead`, and the face between `ahead` and `third`.
    faces = np.asarray(faces, dtype=np.int64)
    vertex = faces.ravel()
    ahead = np.roll(faces, -1, axis=1).ravel()
    third = np.roll(faces, -2, axis=1).ravel()
    keys = vertex * num_vertices + ahead
    order = np.argsort(keys)
    keys, vertex, ahead, third = keys[order], vertex[order], ahead[order], third[order]

    # The next slot around the vertex begins where this slot's face ends. At a boundary there is no next slot.
    next_keys = vertex * num_vertices + third
    following = np.minimum(np.searchsorted(keys, next_keys), len(keys) - 1)
    is_last = keys[following] != next_keys if len(keys) else np.zeros(0, bool)
    has_predecessor = np.zeros(len(keys), bool)
    has_predecessor[following[~is_last]] = True

    num_faces = np.bincount(vertex, minlength=num_vertices)
    valences = num_faces + np.bincount(vertex[is_last], minlength=num_vertices)
    offsets = np.concatenate([[0], np.cumsum(valences)])
    start = np.cumsum(num_faces) - num_faces  # the slot of the lowest neighbour; on the boundary it is replaced below
    first_slots = np.flatnonzero(~has_predecessor)
    start[vertex[first_slots]] = first_slots

    neighbours = np.full(offsets[-1], -1, dtype=np.int32)
    successors = np.full(offsets[-1], -1, dtype=np.int32)
    # Step around the rings of all vertices at once, dropping those that have returned to their first slot.
    active = np.flatnonzero(num_faces)
    slot = start[active]
    for step in range(int(num_faces.max(initial=0))):
        position = offsets[active] + step
        neighbours[position], successors[position] = ahead[slot], third[slot]
        ends = is_last[slot]
        neighbours[position[ends] + 1] = third[slot[ends]]
        successors[position[ends] + 1] = active[ends]
        continues = ~ends & (following[slot] != start[active])
        active, slot = active[continues], following[slot[continues]]
        if not len(active):
            break
    if np.any(neighbours < 0) or len(active):
        broken = int(np.searchsorted(offsets, np.flatnonzero(neighbours < 0)[:1], side="right")[0]) - 1
        raise ValueError(
            f"The faces around vertex {broken} do not form a single fan, so its neighbours have no cyclic order. "
            "Build the mesh with ltljax.Mesh, which checks this, and use repair=True to split the vertex."
        )
    return OneRings(offsets, neighbours, successors)


def k_ring(
    faces: np.ndarray | OneRings, num_vertices: int, vertices: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """The vertices within k edges of each given vertex, without the vertex itself, as rows ``(offsets, indices)``.

    Row i belongs to ``vertices[i]`` and is ``indices[offsets[i] : offsets[i + 1]]``, int32, sorted.

    Args:
        faces: (F, 3), or the `OneRings` of the mesh if they are available.
        num_vertices: number of vertices.
        vertices: (N,) centres of the rings.
        k: largest distance in edges, at least 1.
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
    """The boolean adjacency matrix (V, V)."""
    edges = half_edges(np.asarray(faces))
    row, column = np.concatenate([edges, edges[:, ::-1]]).T
    # Duplicate entries are added, which in a boolean matrix leaves them True.
    return sparse.csr_array((np.ones(len(row), bool), (row, column)), shape=(num_vertices, num_vertices))
