"""Which vertices of a mesh are to be merged into one."""

import numpy as np
import scipy.sparse.csgraph
from scipy.spatial import KDTree

from .._base.arguments import not_negative
from .errors import MeshError
from .report import face_edge_lengths
from .topology import half_edges, undirected_keys, used_vertices

# Vertices closer than this fraction of the shortest edge at either of them are taken as a vertex split by rounding.
_ROUNDING = 1e-4


def welded_vertices(vertices: np.ndarray, faces: np.ndarray, weld: bool | float) -> np.ndarray:
    """The vertex that stands for each vertex (V,) after merging, or -1 for vertices that no face uses.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        weld: True merges vertices that coincide up to rounding; a distance merges all vertices within it; False merges
            none.

    Raises:
        MeshError: `weld` is neither a boolean nor a distance.
    """
    used = used_vertices(faces, len(vertices))
    representative = np.full(len(vertices), -1, dtype=np.int64)
    representative[used] = used
    if isinstance(weld, bool | np.bool_):
        distance = None
    elif isinstance(weld, int | str) or weld is None:
        raise MeshError(f"Expected weld as True, False or a distance such as 1e-6, found {weld!r}.")
    else:
        distance = not_negative("weld", weld)
    if weld is False or weld is np.False_:
        return representative
    positions = vertices[used]
    order = np.lexsort(positions.T)  # stable, so the lowest index of equal positions comes first
    is_new = np.ones(len(order), bool)
    is_new[1:] = np.any(positions[order[1:]] != positions[order[:-1]], axis=1)
    representative[used[order]] = used[order[is_new]][np.cumsum(is_new) - 1]
    nearest = _merged_within(vertices, representative[faces], distance)
    if nearest is not None:
        representative[used] = nearest[representative[used]]
    return representative


def _merged_within(vertices: np.ndarray, faces: np.ndarray, distance: float | None) -> np.ndarray | None:
    """The lowest vertex of each cluster of vertices within a distance of one another; None if there is no cluster.

    Rounding opens edges that two faces shared. Without a distance, only the ends of edges of a single face are merged,
    so that the two sides of a thin wall stay apart.

    Args:
        vertices: (V, 3).
        faces: (F, 3), which determine the vertices in use.
        distance: by default a ten-thousandth of the shortest edge at either vertex.
    """
    if not len(faces):
        return None
    used = used_vertices(faces, len(vertices)) if distance is not None else _open_vertices(faces, len(vertices))
    if not len(used):
        return None
    reach = np.full(len(used), distance) if distance is not None else _ROUNDING * _shortest_edges(vertices, faces)[used]
    largest = float(reach.max())
    if not 0 < largest < np.inf:
        return None
    tree, points = KDTree(vertices[used]), vertices[used]
    # Each vertex searches within its own reach: the reach of a coarse region would cover all of a fine one.
    crowded = np.flatnonzero(tree.query_ball_point(points, reach, return_length=True) > 1)
    near = tree.query_ball_point(points[crowded], reach[crowded])
    counts = np.array([len(neighbours) for neighbours in near], np.int64)
    neighbours = np.array([neighbour for neighbours in near for neighbour in neighbours], np.int64)
    pairs = np.stack([np.repeat(crowded, counts), neighbours], axis=1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    distances = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    pairs = pairs[distances <= reach[pairs].min(axis=1)]
    if not len(pairs):
        return None
    graph = scipy.sparse.coo_array((np.ones(len(pairs)), pairs.T), shape=(len(used), len(used)))
    cluster = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    lowest = np.full(cluster.max() + 1, len(vertices))
    np.minimum.at(lowest, cluster, used)
    merged = np.arange(len(vertices))
    merged[used] = lowest[cluster]
    return merged


def _shortest_edges(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The length of the shortest edge at each vertex, (V,); infinite without an edge."""
    lengths = face_edge_lengths(vertices, faces)
    shortest = np.full(len(vertices), np.inf)
    for corner in range(3):
        for edge in (corner, (corner - 1) % 3):  # the two edges at the corner
            np.minimum.at(shortest, faces[:, corner], lengths[:, edge])
    return shortest


def _open_vertices(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """The ends of edges that belong to a single face, in ascending order."""
    directed = half_edges(faces)
    _, edge, count = np.unique(undirected_keys(directed, num_vertices), return_inverse=True, return_counts=True)
    return np.unique(directed[count[edge] == 1])
