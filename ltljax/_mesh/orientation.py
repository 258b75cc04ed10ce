"""Which faces look the wrong way, and is there a right way at all?

What enters: positions and faces of a manifold mesh. What leaves: the faces to turn over, or a `MeshError` that names an
edge of a one-sided surface.
"""

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from .errors import MeshError
from .topology import components, shared_edges


def turned_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The faces (F,) bool to turn over, so that neighbours agree and closed components face out.

    On a component with a boundary, which has no outside, the majority decides.

    Args:
        vertices: (V, 3).
        faces: (F, 3), at most two at an edge.

    Raises:
        MeshError: if a component is not orientable.
    """
    one, other, same_way = shared_edges(faces, len(vertices))
    f, g = one % len(faces), other % len(faces)
    given, turned = _double_cover(f, g, same_way, len(faces))
    if np.any(given == turned):
        fails = int(np.flatnonzero(disagreeing(faces, len(vertices)))[0])
        edge = np.intersect1d(faces[f[fails]], faces[g[fails]])[:2]
        raise MeshError(
            f"The surface is not orientable: however the faces are turned, the two at edge {tuple(edge.tolist())} "
            "disagree, or two elsewhere (as in a Moebius strip or a Klein bottle). Cut it along a curve through that "
            "edge, or use repair=True to do so."
        )
    _, component = np.unique(np.minimum(given, turned), return_inverse=True)
    num_faces = np.bincount(component)
    is_turned = given > turned
    minority = 2 * np.bincount(component, is_turned) > num_faces
    is_turned ^= minority[component]
    # Where every edge is shared, three half-edges per face make two per edge.
    is_closed = 2 * np.bincount(component[f], minlength=len(num_faces)) == 3 * num_faces
    faces_in = is_closed & (_volumes(vertices[faces], component, is_turned) < 0)
    return is_turned ^ faces_in[component]


def _double_cover(f: np.ndarray, g: np.ndarray, same_way: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The orientation double cover's component labels of every face as given and turned over, (F,) each.

    Every face is there twice. Neighbours that agree are linked as they are, others crosswise. A component is orientable
    when its two copies stay apart; then either is a consistent choice.
    """
    crossed = np.where(same_way, count, 0)
    labels = components(np.concatenate([f, f + count]), np.concatenate([g + crossed, g + count - crossed]), 2 * count)
    return labels[:count], labels[count:]


def _volumes(corners: np.ndarray, component: np.ndarray, is_turned: np.ndarray) -> np.ndarray:
    """Six times the signed volume of each component, with some of its faces (F, 3, 3) turned over."""
    counts = np.bincount(component)
    # About the component's own middle: a far away origin would cancel the digits.
    middle = np.stack([np.bincount(component, x) for x in corners.mean(axis=1).T], axis=1) / counts[:, None]
    first, second, third = np.moveaxis(corners - middle[component, None], 1, 0)
    volumes = np.sum(first * np.cross(second, third), axis=1)
    return np.bincount(component, np.where(is_turned, -volumes, volumes))


def disagreeing(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """The shared edges at which two faces disagree, whichever way the faces are turned: (P,) bool.

    They are in the order of `shared_edges`, and only on components that are not orientable. There, orientation is
    propagated breadth-first from one face; the edges where the fronts disagree form curves that are closed or end on
    the boundary. Cut along them, the surface is orientable.

    Args:
        faces: (F, 3), at most two at an edge.
        num_vertices: number of vertices.
    """
    one, other, same_way = shared_edges(faces, num_vertices)
    count = len(faces)
    f, g = one % count, other % count
    given, turned = _double_cover(f, g, same_way, count)
    is_bad = given == turned
    # Two faces can share two edges; the first is enough for the tree.
    _, first = np.unique(np.minimum(f, g) * count + np.maximum(f, g), return_index=True)
    ends = np.concatenate([f[first], g[first]]), np.concatenate([g[first], f[first]])
    links = sparse.coo_array((np.tile(first + 1, 2), ends), shape=(count, count)).tocsr()
    tree = []
    for label in np.unique(given[is_bad]):
        root = int(np.flatnonzero(given == label)[0])
        order, parent = csgraph.breadth_first_order(links, root, directed=False)
        tree.append(np.asarray(links[parent[order[1:]], order[1:]]).ravel() - 1)
    steps = np.concatenate([np.zeros(0, np.int64), *tree])
    given, turned = _double_cover(f[steps], g[steps], same_way[steps], count)
    is_turned = given > turned
    return is_bad[f] & (same_way ^ is_turned[f] ^ is_turned[g])
