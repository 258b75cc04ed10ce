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
        raise MeshError(_one_sided(faces, f, g, same_way, given == turned))
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


def _one_sided(faces: np.ndarray, f: np.ndarray, g: np.ndarray, same_way: np.ndarray, is_bad: np.ndarray) -> str:
    """The message, with an edge whose faces disagree once all faces agree along a spanning tree."""
    count = len(faces)
    # Two faces of a closed surface can share two edges; the first is enough for the tree.
    _, first = np.unique(f * count + g, return_index=True)
    links = sparse.coo_array((first + 1.0, (f[first], g[first])), shape=(count, count))
    tree = csgraph.minimum_spanning_tree(links.tocsr()).data.astype(np.int64) - 1
    given, turned = _double_cover(f[tree], g[tree], same_way[tree], count)
    is_turned = given > turned
    fails = int(np.flatnonzero(is_bad[f] & (same_way ^ is_turned[f] ^ is_turned[g]))[0])
    edge = np.intersect1d(faces[f[fails]], faces[g[fails]])[:2]
    return (
        f"The surface is not orientable: once the other faces agree, those at edge {tuple(edge.tolist())} do not "
        "(as in a Moebius strip or a Klein bottle). Cut it along a curve through that edge; repair=True cannot."
    )
