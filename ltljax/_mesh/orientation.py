"""Consistent orientation of the faces of a manifold mesh."""

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from .errors import MeshError
from .topology import components, shared_edges


def reversed_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether to reverse each face, (F,) bool, so that neighbours agree and closed components face outwards.

    A component with a boundary has no outside; there, the orientation of the majority of faces stays.

    Args:
        vertices: (V, 3).
        faces: (F, 3), at most two at an edge.

    Raises:
        MeshError: a component is not orientable.
    """
    first, second, same_direction = shared_edges(faces, len(vertices))
    f, g = first % len(faces), second % len(faces)
    label, label_reversed = _double_cover(f, g, same_direction, len(faces))
    if np.any(label == label_reversed):
        conflict = int(np.flatnonzero(conflicting_edges(faces, len(vertices)))[0])
        edge = np.intersect1d(faces[f[conflict]], faces[g[conflict]])[:2]
        raise MeshError(
            "The surface is not orientable (like a Moebius strip or a Klein bottle): no orientation of the faces is "
            f"consistent along a curve through edge {tuple(edge.tolist())}. Cut the surface along this curve, or use "
            "repair=True to do so."
        )
    _, component = np.unique(np.minimum(label, label_reversed), return_inverse=True)
    num_faces = np.bincount(component)
    is_reversed = label > label_reversed
    is_majority = 2 * np.bincount(component, is_reversed) > num_faces
    is_reversed ^= is_majority[component]
    # In a closed component, every edge is shared by two of the three half-edges per face.
    is_closed = 2 * np.bincount(component[f], minlength=len(num_faces)) == 3 * num_faces
    faces_inwards = is_closed & (_volumes(vertices[faces], component, is_reversed) < 0)
    return is_reversed ^ faces_inwards[component]


def _double_cover(
    f: np.ndarray, g: np.ndarray, same_direction: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """The component labels, in the orientation double cover, of every face and of its reversed copy, (F,) each.

    Neighbours with consistent orientations are linked copy to copy, all others crosswise. A component is orientable if
    its two copies are not connected; then each of them is a consistent orientation.
    """
    crossed = np.where(same_direction, count, 0)
    labels = components(np.concatenate([f, f + count]), np.concatenate([g + crossed, g + count - crossed]), 2 * count)
    return labels[:count], labels[count:]


def _volumes(corners: np.ndarray, component: np.ndarray, is_reversed: np.ndarray) -> np.ndarray:
    """Six times the signed volume of each component, with some of its faces (F, 3, 3) reversed."""
    counts = np.bincount(component)
    # Positions are relative to the centre of the component, so that a distant origin causes no cancellation.
    centre = np.stack([np.bincount(component, x) for x in corners.mean(axis=1).T], axis=1) / counts[:, None]
    first, second, third = np.moveaxis(corners - centre[component, None], 1, 0)
    volumes = np.sum(first * np.cross(second, third), axis=1)
    return np.bincount(component, np.where(is_reversed, -volumes, volumes))


def conflicting_edges(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """Whether two faces conflict at each of the `shared_edges`, however the faces are oriented: (P,) bool.

    Only components that are not orientable have conflicts. There, the orientation is propagated breadth-first from a
    face; the edges where the fronts conflict form curves that are closed or end on the boundary. The surface becomes
    orientable when it is cut along them.

    Args:
        faces: (F, 3), at most two at an edge.
        num_vertices: number of vertices.
    """
    half_edge, opposite, same_direction = shared_edges(faces, num_vertices)
    count = len(faces)
    f, g = half_edge % count, opposite % count
    label, label_reversed = _double_cover(f, g, same_direction, count)
    is_bad = label == label_reversed
    # Two faces can share two edges, of which the tree needs the first.
    _, first = np.unique(np.minimum(f, g) * count + np.maximum(f, g), return_index=True)
    ends = np.concatenate([f[first], g[first]]), np.concatenate([g[first], f[first]])
    links = sparse.coo_array((np.tile(first + 1, 2), ends), shape=(count, count)).tocsr()
    tree = []
    for component in np.unique(label[is_bad]):
        root = int(np.flatnonzero(label == component)[0])
        order, parent = csgraph.breadth_first_order(links, root, directed=False)
        tree.append(np.asarray(links[parent[order[1:]], order[1:]]).ravel() - 1)
    steps = np.concatenate([np.zeros(0, np.int64), *tree])
    label, label_reversed = _double_cover(f[steps], g[steps], same_direction[steps], count)
    is_reversed = label > label_reversed
    return is_bad[f] & (same_direction ^ is_reversed[f] ^ is_reversed[g])
