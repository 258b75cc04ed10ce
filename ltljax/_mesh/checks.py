"""Is this a surface, and if not, can it become one? Checks, welding, orientation and repair.

What enters: arrays as a user or a file gives them. What leaves: arrays of a manifold, consistently oriented triangle
mesh with finite geometry, and a record of everything that was done; or a `MeshError`.

The steps work in the numbering of the arrays handed in, so that messages name indices their reader knows. Vertices are
renumbered once, at the end.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse.csgraph
from scipy.spatial import KDTree

from .._base.arguments import not_negative
from .errors import MeshError
from .orientation import disagreeing, turned_faces
from .report import face_areas, face_edge_lengths
from .topology import components, half_edges, shared_edges, undirected_keys, used_vertices

# Weights go with the fourth power of lengths; within this range they, and products of two, stay finite in float64.
LARGEST_LENGTH, SMALLEST_LENGTH = 1e60, 1e-60
# A face this thin, area against the square of its longest edge, has no normal that rounding has not made up.
THINNEST_FACE = 1e-14
# Vertices closer than this fraction of the shortest edge at either one are taken as a single vertex split by rounding.
_TWIN = 1e-4
# Second derivatives take five neighbours, so every connected piece needs five vertices beside the one in question.
FEWEST_VERTICES = 6


@dataclasses.dataclass(frozen=True, eq=False)
class Checked:
    """A mesh that passed, and what was done to it.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3) int32.
        original_index: (V,) for each vertex, the first vertex handed in that it came from.
        welded_index: (V_original,) for each vertex handed in, the vertex it became, or -1.
        original_corner: (F, 3) for each corner of a face, 3 f + j of corner j of the face f handed in.
        faces_in_file: number of faces handed in.
        welded_vertices: vertices merged into another.
        reoriented_faces: faces turned over.
        repairs: what was mended, one sentence each.
    """

    vertices: np.ndarray
    faces: np.ndarray
    original_index: np.ndarray
    welded_index: np.ndarray
    original_corner: np.ndarray
    faces_in_file: int
    welded_vertices: int
    reoriented_faces: int
    repairs: tuple[str, ...]


def check(vertices: Any, faces: Any, *, repair: bool, weld: bool | float) -> Checked:
    """The checked mesh of arbitrary arrays.

    Args:
        vertices: (V, 3) positions.
        faces: (F, 3) vertex indices.
        repair: mend what can be mended, instead of raising.
        weld: True merges vertices that coincide up to rounding; a distance merges all vertices within it.

    Raises:
        MeshError: with the first thing found wrong.
    """
    vertices, faces = _as_arrays(vertices, faces)
    work = _Workpiece(vertices, faces, repair)
    work.check_indices()
    work.check_positions()
    representative = work.merge_vertices(weld)
    work.check_degenerate()
    work.check_duplicates()
    work.check_edges()
    work.check_fans()
    work.cut_where_one_sided()
    work.check_components()
    reoriented = work.orient()
    if repair and work.repairs:
        # What was mended has to pass like anything else. It does unless a repair above is wrong.
        again = _Workpiece(work.vertices, work.faces, repair=False)
        again.check_degenerate()
        again.check_duplicates()
        again.check_edges()
        again.check_fans()
        again.check_components()
    used = used_vertices(work.faces, len(work.vertices))
    new_index = np.full(len(work.vertices), -1, dtype=np.int64)
    new_index[used] = np.arange(len(used))
    welded_index = np.where(representative >= 0, new_index[representative], -1)
    return Checked(
        vertices=work.vertices[used],
        faces=new_index[work.faces].astype(np.int32),
        original_index=work.origin[used],
        welded_index=welded_index,
        original_corner=work.corners,
        faces_in_file=len(faces),
        welded_vertices=int(np.sum((representative >= 0) & (representative != np.arange(len(representative))))),
        reoriented_faces=reoriented,
        repairs=tuple(work.repairs),
    )


def _as_arrays(vertices: Any, faces: Any) -> tuple[np.ndarray, np.ndarray]:
    """The arguments as float64 (V, 3) and int64 (F, 3)."""
    for name, array in (("vertices", vertices), ("faces", faces)):
        if isinstance(array, np.ma.MaskedArray):
            raise MeshError(
                f"Expected {name} as a plain array, found a masked one, whose mask would be lost. Leave out what is "
                "masked, and the faces there."
            )
    try:
        vertices, faces = np.asarray(vertices), np.asarray(faces)
    except (TypeError, ValueError) as error:
        raise MeshError(f"Vertices and faces must be arrays of numbers, (V, 3) and (F, 3), but: {error}") from error
    if vertices.dtype.kind not in "fiu":
        raise MeshError(f"Vertices must be real numbers, found {vertices.dtype}. Convert them to float64.")
    if faces.size == 0:
        raise MeshError(
            f"The mesh has no faces (and {len(vertices) if vertices.ndim else 0} vertices). A surface is made of "
            "triangles: hand in faces (F, 3), or triangulate the points first."
        )
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise MeshError(
            f"Vertices must have the shape (V, 3), found {vertices.shape}. "
            "A plane mesh needs a third coordinate of zeros."
        )
    if faces.dtype.kind not in "iu":
        raise MeshError(f"Faces must be integers, found {faces.dtype}. Convert them with faces.astype(int).")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise MeshError(f"Faces must have the shape (F, 3), found {faces.shape}. Split larger faces into triangles.")
    if faces.dtype.kind == "u":
        faces = np.minimum(faces, np.iinfo(np.int64).max)  # an index this large is reported below, not wrapped around
    with np.errstate(over="ignore", invalid="ignore"):  # long double may not fit; that is reported as infinite
        return vertices.astype(np.float64), faces.astype(np.int64)


def _first_of_twins(vertices: np.ndarray, faces: np.ndarray, distance: float | None) -> np.ndarray | None:
    """For every vertex the first one that lies within a distance of it; None where no two do.

    Rounding opens edges that two faces shared, so where no distance is given only the ends of edges of a single face
    are merged. The two sides of a thin wall stay apart.

    Args:
        vertices: (V, 3).
        faces: (F, 3), whose vertices count.
        distance: by default a ten-thousandth of the shortest edge at either of the two.
    """
    if not len(faces):
        return None
    used = used_vertices(faces, len(vertices)) if distance is not None else _open_vertices(faces, len(vertices))
    if not len(used):
        return None
    lengths = face_edge_lengths(vertices, faces)
    reach = np.full(len(vertices), np.inf)
    for corner in range(3):  # both edges of a corner
        for edge in (corner, (corner - 1) % 3):
            np.minimum.at(reach, faces[:, corner], lengths[:, edge])
    reach = reach[used] * _TWIN if distance is None else np.full(len(used), distance)
    largest = float(reach.max())
    if not 0 < largest < np.inf:
        return None
    tree, points = KDTree(vertices[used]), vertices[used]
    # Each vertex looks as far as its own reach: one coarse part must not make a fine one look at all of itself.
    crowded = np.flatnonzero(tree.query_ball_point(points, reach, return_length=True) > 1)
    near = tree.query_ball_point(points[crowded], reach[crowded])
    counts = np.array([len(others) for others in near], np.int64)
    others = np.array([other for each in near for other in each], np.int64)
    pairs = np.stack([np.repeat(crowded, counts), others], axis=1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    apart = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    pairs = pairs[apart <= reach[pairs].min(axis=1)]
    if not len(pairs):
        return None
    graph = scipy.sparse.coo_array((np.ones(len(pairs)), pairs.T), shape=(len(used), len(used)))
    group = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    lowest = np.full(group.max() + 1, len(vertices))
    np.minimum.at(lowest, group, used)
    first = np.arange(len(vertices))
    first[used] = lowest[group]
    return first


def _open_vertices(faces: np.ndarray, num_vertices: int) -> np.ndarray:
    """The vertices at edges that belong to one face only, ascending."""
    directed = half_edges(faces)
    _, edge, count = np.unique(undirected_keys(directed, num_vertices), return_inverse=True, return_counts=True)
    return np.unique(directed[count[edge] == 1])


def _counted(count: int, noun: str, nouns: str) -> str:
    return f"{count} {noun if count == 1 else nouns}"


class _Workpiece:
    """The mesh under inspection: arrays that the checks replace, and the list of repairs."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, repair: bool):
        self.vertices = vertices
        self.faces = faces
        self.corners = np.arange(faces.size).reshape(-1, 3)
        self.repair = repair
        self.repairs: list[str] = []
        self.origin = np.arange(len(vertices))

    def _drop(self, is_bad: np.ndarray, message: Callable[[int], str], what: str) -> None:
        """Drops the bad faces where repair is wanted, and raises the message for the first one where it is not."""
        count = int(is_bad.sum())
        if not count:
            return
        if not self.repair:
            raise MeshError(message(int(np.flatnonzero(is_bad)[0])))
        self.faces, self.corners = self.faces[~is_bad], self.corners[~is_bad]
        self.repairs.append(f"dropped {_counted(count, 'face', 'faces')} {what}")
        if not len(self.faces):
            raise MeshError(f"Repair left no faces: {'; '.join(self.repairs)}. The source holds no usable surface.")

    def check_indices(self) -> None:
        """Every face refers to vertices that exist."""
        num_vertices = len(self.vertices)

        def message(face: int) -> str:
            corners = self.faces[face]
            index = corners[(corners < 0) | (corners >= num_vertices)][0]
            return (
                f"Face {face} refers to vertex {index}, but there are {num_vertices} vertices, counted from 0. "
                "Correct the index (subtract 1 if the source counts from 1), or use repair=True to drop such faces."
            )

        is_bad = np.any((self.faces < 0) | (self.faces >= num_vertices), axis=1)
        self._drop(is_bad, message, "that referred to missing vertices")

    def check_positions(self) -> None:
        """The positions in use are finite, and of a size whose powers are finite too."""
        is_finite = np.all(np.isfinite(self.vertices), axis=1)

        def not_finite(face: int) -> str:
            # The first vertex is named, not the first face, since that is what must be corrected.
            vertex = int(np.unique(self.faces[~is_finite[self.faces]])[0])
            position = ", ".join(f"{x:g}" for x in self.vertices[vertex])
            return (
                f"Vertex {vertex} has the position ({position}), which is not finite. "
                "Correct it, or use repair=True to drop the faces around it."
            )

        self._drop(~np.all(is_finite[self.faces], axis=1), not_finite, "with a position that is not finite")
        with np.errstate(invalid="ignore"):
            is_moderate = np.all(np.abs(self.vertices) <= LARGEST_LENGTH, axis=1)

        def too_large(face: int) -> str:
            vertex = int(np.unique(self.faces[~is_moderate[self.faces]])[0])
            value = float(np.abs(self.vertices[vertex]).max())
            return (
                f"Vertex {vertex} has a coordinate of size {value:g}; beyond {LARGEST_LENGTH:g} areas and weights "
                "overflow. Scale the mesh, or use repair=True to drop the faces around it."
            )

        self._drop(~np.all(is_moderate[self.faces], axis=1), too_large, "with a position too large to compute with")
        # Minus zero and zero are one position.
        self.vertices = self.vertices + 0.0

    def merge_vertices(self, weld: bool | float) -> np.ndarray:
        """Lets faces refer to the first of the vertices at each position; returns it, or -1 where unused, (V,)."""
        used = used_vertices(self.faces, len(self.vertices))
        representative = np.full(len(self.vertices), -1, dtype=np.int64)
        representative[used] = used
        if isinstance(weld, bool | np.bool_):
            distance = None
        elif isinstance(weld, int | str) or weld is None:
            raise MeshError(f"Expected weld as True, False or a distance such as 1e-6, found {weld!r}.")
        else:
            distance = not_negative("weld", weld)
        if weld is False or weld is np.False_:
            return representative
        positions = self.vertices[used]
        order = np.lexsort(positions.T)  # stable, so the first of equals comes first
        is_new = np.ones(len(order), bool)
        is_new[1:] = np.any(positions[order[1:]] != positions[order[:-1]], axis=1)
        representative[used[order]] = used[order[is_new]][np.cumsum(is_new) - 1]
        self.faces = representative[self.faces]
        first = _first_of_twins(self.vertices, self.faces, distance)
        if first is not None:
            representative[used] = first[representative[used]]
            self.faces = first[self.faces]
        return representative

    def check_degenerate(self) -> None:
        """Every face has three different vertices and an area."""
        first, second, third = self.faces.T
        repeats = (first == second) | (second == third) | (third == first)

        def repeated(face: int) -> str:
            return (
                f"Face {face} names a vertex twice: {tuple(self.faces[face].tolist())}. A triangle has three different "
                "corners. Remove it, or use repair=True to drop such faces."
            )

        self._drop(repeats, repeated, "with fewer than three different corners")
        longest = face_edge_lengths(self.vertices, self.faces).max(axis=1)

        def too_small(face: int) -> str:
            return (
                f"Face {face} has a longest edge of {longest[face]:g}; below {SMALLEST_LENGTH:g} areas and weights "
                "underflow. Scale the mesh, or use repair=True to drop such faces."
            )

        # A face with three corners at one place is thin rather than small.
        is_small = (longest < SMALLEST_LENGTH) & (longest > 0)
        self._drop(is_small, too_small, "too small to compute with")
        longest = face_edge_lengths(self.vertices, self.faces).max(axis=1)
        areas = face_areas(self.vertices, self.faces)

        def no_area(face: int) -> str:
            return (
                f"Face {face} {tuple(self.faces[face].tolist())} has no area: {areas[face]:.3g} with a longest edge of "
                f"{longest[face]:.3g}. Remove it or remesh, or use repair=True to drop such faces."
            )

        self._drop(~(areas > THINNEST_FACE * longest**2), no_area, "without area")

    def check_duplicates(self) -> None:
        """No two faces have the same three vertices."""
        corners = np.sort(self.faces, axis=1)
        # Stable, so of equal faces the first comes first. One key for two corners sorts faster than two.
        order = np.lexsort((corners[:, 2], corners[:, 0] * len(self.vertices) + corners[:, 1]))
        repeats = np.zeros(len(order), bool)
        repeats[order[1:]] = np.all(corners[order[1:]] == corners[order[:-1]], axis=1)

        def message(face: int) -> str:
            twin = int(np.flatnonzero(np.all(corners == corners[face], axis=1))[0])
            return (
                f"Faces {twin} and {face} have the same corners {tuple(corners[face].tolist())}. "
                "A surface has one face there. Remove the other, or use repair=True to drop duplicates."
            )

        self._drop(repeats, message, "that duplicated another")

    def check_edges(self) -> None:
        """No edge belongs to more than two faces."""
        keys = undirected_keys(half_edges(self.faces), len(self.vertices))
        in_order = np.sort(keys)
        if not np.any(in_order[2:] == in_order[:-2]):
            return
        face = np.tile(np.arange(len(self.faces)), 3)
        # Sorted by edge, and within an edge from the largest face to the smallest: the rank within the edge.
        order = np.lexsort((face, -face_areas(self.vertices, self.faces)[face], keys))
        begins = np.ones(len(order), bool)
        begins[1:] = keys[order[1:]] != keys[order[:-1]]
        starts = np.flatnonzero(begins)
        rank = np.arange(len(order)) - starts[np.cumsum(begins) - 1]
        is_bad = np.zeros(len(self.faces), bool)
        is_bad[face[order[rank > 1]]] = True

        def message(_: int) -> str:
            key = int(keys[order[rank > 1]].min())
            edge = divmod(key, len(self.vertices))
            return (
                f"Edge {edge} belongs to {int(np.sum(keys == key))} faces, so the surface is not a manifold there. "
                "Separate the sheets, or load with repair=True to drop the extra faces."
            )

        self._drop(is_bad, message, "at edges that had more than two (the two largest stay)")

    def check_fans(self) -> None:
        """The faces at each vertex form one fan; splitting gives every further fan a vertex of its own."""
        split = self._fans(np.zeros(0, bool))
        if split:
            self.repairs.append(f"split {_counted(split, 'vertex', 'vertices')} where separate fans touched")

    def cut_where_one_sided(self) -> None:
        """Repair cuts components that are not orientable open, along curves where their faces disagree."""
        if not self.repair:
            return
        is_cut = disagreeing(self.faces, len(self.vertices))
        if is_cut.any():
            self._fans(is_cut)
            edges = _counted(int(is_cut.sum()), "edge", "edges")
            self.repairs.append(
                f"cut along {edges} where the surface was one-sided (if you save it, load it with weld=False, or the "
                "cut closes again)"
            )

    def _fans(self, is_cut: np.ndarray) -> int:
        """Give every further fan at a vertex a vertex of its own, where repair is wanted; returns how many were split.

        Args:
            is_cut: the edges, in the order of `shared_edges`, across which fans do not go on; empty for none.
        """
        num_faces = len(self.faces)
        one, other, same_way = shared_edges(self.faces, len(self.vertices))
        if is_cut.size:
            one, other, same_way = one[~is_cut], other[~is_cut], same_way[~is_cut]
        # Corner j of face f is 3 f + j. A half-edge of block j runs from corner j to corner j + 1 of its face.
        begin, end = 3 * (one % num_faces) + one // num_faces, 3 * (one % num_faces) + (one // num_faces + 1) % 3
        first = 3 * (other % num_faces) + other // num_faces
        last = 3 * (other % num_faces) + (other // num_faces + 1) % 3
        across = np.concatenate([np.where(same_way, first, last), np.where(same_way, last, first)])
        fans = components(np.concatenate([begin, end]), across, 3 * num_faces)
        corners = self.faces.ravel()
        order = np.lexsort((fans, corners))
        begins = np.ones(len(order), bool)
        begins[1:] = (corners[order[1:]] != corners[order[:-1]]) | (fans[order[1:]] != fans[order[:-1]])
        fan_vertices = corners[order[begins]]
        is_further = np.zeros(len(fan_vertices), bool)
        is_further[1:] = fan_vertices[1:] == fan_vertices[:-1]
        if not is_further.any():
            return 0
        split = np.unique(fan_vertices[is_further])
        if not self.repair:
            count = int(np.sum(fan_vertices == split[0]))
            raise MeshError(
                f"The faces at vertex {split[0]} form {count} fans that touch only there, so the surface is not a "
                "manifold at it. Give each fan a vertex of its own, or use repair=True to split it."
            )
        names = fan_vertices.copy()
        names[is_further] = len(self.vertices) + np.arange(is_further.sum())
        renamed = np.empty_like(corners)
        renamed[order] = names[np.cumsum(begins) - 1]
        self.faces = renamed.reshape(-1, 3)
        self.vertices = np.concatenate([self.vertices, self.vertices[fan_vertices[is_further]]])
        self.origin = np.concatenate([self.origin, self.origin[fan_vertices[is_further]]])
        return len(split)

    def check_components(self) -> None:
        """Every connected component has enough vertices."""
        edges = half_edges(self.faces)
        labels = components(edges[:, 0], edges[:, 1], len(self.vertices))
        used = used_vertices(self.faces, len(self.vertices))
        sizes = np.bincount(labels[used], minlength=labels.max() + 1)
        face_sizes = sizes[labels[self.faces[:, 0]]]

        def message(face: int) -> str:
            return (
                f"The connected component of vertex {self.faces[face].min()} has {face_sizes[face]} vertices; at least "
                f"{FEWEST_VERTICES} are needed, since second derivatives at a vertex take five neighbours. "
                "Subdivide it, or use repair=True to drop such components."
            )

        self._drop(face_sizes < FEWEST_VERTICES, message, "of components too small to differentiate on")

    def orient(self) -> int:
        """Turns faces over until all agree with their neighbours and closed components face out; returns how many."""
        is_turned = turned_faces(self.vertices, self.faces)
        self.faces, self.corners = (
            np.where(is_turned[:, None], rows[:, [0, 2, 1]], rows) for rows in (self.faces, self.corners)
        )
        return int(is_turned.sum())
