"""Where a mesh is not smooth: creases, folded faces, and corners of the boundary (host)."""

import numpy as np

from .._lifting.jets import INTERIOR, OTHER_CORNER, RIGHT_CORNER, SMOOTH
from .._lifting.ring import RingTopology, angle_sums, offsets
from .._mesh import Mesh, corner_angles, half_edges, shared_edges
from .._tables import Table

# The boundary has a corner at a vertex where it turns by more than this many degrees, and the corner counts as a right
# angle if it is within this many degrees of one.
_CORNER, _RIGHT = 40, 20
# An edge is a crease if the normals of its two faces differ by more than this many degrees. No height fit crosses a
# crease: this affects normals, the transport of vectors, `hodge_laplacian`, `crease_mean`, and where `Polynomial` uses
# charts.
CREASE = 40
# The normal of a face with a larger angle than this says little about the surface, and its edges are not creases.
_FLATTEST = 150


def creased_vertices(mesh: Mesh) -> np.ndarray:
    """Whether each vertex is an end of an edge that is a crease, (V,) bool."""
    edge, opposite, _ = shared_edges(mesh.faces, mesh.num_vertices)
    normals = _face_normals(mesh)
    size = np.linalg.norm(normals, axis=1)
    is_reliable = (corner_angles(mesh.vertices, mesh.faces).max(axis=1) < np.radians(_FLATTEST)) & (size > 0)
    left, right = edge % len(mesh.faces), opposite % len(mesh.faces)
    cosine = np.sum(normals[left] * normals[right], axis=1)
    is_crease = cosine < np.cos(np.radians(CREASE)) * size[left] * size[right]
    is_crease &= is_reliable[left] & is_reliable[right]
    on_crease = np.zeros(mesh.num_vertices, bool)
    on_crease[half_edges(mesh.faces)[edge[is_crease]]] = True
    return on_crease


def at_folded_faces(mesh: Mesh, normals: np.ndarray) -> np.ndarray:
    """Whether each vertex is a corner of a folded face, or a neighbour of such a corner, (V,) bool.

    A face is folded if its normal points away from the ring normals at all three of its corners.
    """
    face_normals = _face_normals(mesh)
    cosine = np.einsum("fkc,fc->fk", normals[mesh.faces], face_normals)
    is_folded = (cosine < 0).all(axis=1)
    is_marked = np.zeros(mesh.num_vertices, bool)
    is_marked[mesh.faces[is_folded]] = True
    is_adjacent = is_marked[mesh.faces].any(axis=1)
    is_marked[mesh.faces[is_adjacent]] = True
    return is_marked


def _face_normals(mesh: Mesh) -> np.ndarray:
    """Face normals, (F, 3), with twice the area of the face as their length."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return np.cross(b - a, c - a)


def boundary_kinds(mesh: Mesh, ring: Table, ring_blocks: tuple[RingTopology, ...]) -> np.ndarray:
    """The kind of each vertex, (V,) int8: in the interior, on a smooth boundary, or at a corner, by its inner angle."""
    sums = ring.map(lambda block, rings: angle_sums(offsets(mesh.vertices, block), rings), ring_blocks)
    turn = np.abs(np.degrees(sums) - 180)
    kinds = np.full(mesh.num_vertices, INTERIOR, np.int8)
    boundary = np.concatenate([np.zeros(0, np.int32), *mesh.boundary_loops])
    is_corner, is_right = turn > _CORNER, np.abs(turn - 90) < _RIGHT
    kinds[boundary] = np.where(is_corner, np.where(is_right, RIGHT_CORNER, OTHER_CORNER), SMOOTH)[boundary]
    return kinds
