"""Checks and repairs that turn arbitrary arrays into a manifold, consistently oriented mesh with finite geometry.

The checks use the numbering of the arrays passed in, so that messages name indices the user knows. Vertices are
renumbered once, at the end.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from .errors import MeshError
from .orientation import conflicting_edges, reversed_faces
from .report import face_areas, face_edge_lengths
from .topology import components, half_edges, shared_edges, undirected_keys, used_vertices
from .welding import welded_vertices

# Weights scale with the fourth power of lengths. In this range the weights and products of two of them stay finite in
# float64.
LARGEST_LENGTH, SMALLEST_LENGTH = 1e60, 1e-60
# If the area of a face, divided by the square of its longest edge, is below this bound, its normal is rounding error.
THINNEST_FACE = 1e-14
# Second derivatives at a vertex need five neighbours.
FEWEST_VERTICES = 6


@dataclasses.dataclass(frozen=True, eq=False)
class Checked:
    """The arrays of a mesh that passed all checks, and a record of its repairs.

    Attributes:
        vertices: (V, 3) float64 positions.
        faces: (F, 3) int32 vertex indices.
        original_index: (V,) first input vertex that was merged into each vertex.
        welded_index: (V_original,) vertex that each input vertex became, or -1.
        original_corner: (F, 3) input corner of each corner of a face; corner j of input face f has the number 3 f + j.
        faces_in_file: number of input faces.
        welded_vertices: number of vertices merged into another.
        reoriented_faces: number of faces whose orientation was reversed.
        repairs: one phrase for each repair.
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
        repair: repair the mesh where possible instead of raising.
        weld: True merges vertices that coincide up to rounding; a distance merges all vertices within it.

    Raises:
        MeshError: a check fails; the message describes the first failure.
    """
    vertices, faces = _as_arrays(vertices, faces)
    checker = _Checker(vertices, faces, repair)
    checker.check_indices()
    checker.check_positions()
    representative = checker.merge_vertices(weld)
    checker.check_faces()
    checker.cut_where_one_sided()
    checker.check_components()
    reoriented = checker.orient()
    if repair and checker.repairs:
        # A repaired mesh must pass the checks too. This fails only if a repair is wrong.
        recheck = _Checker(checker.vertices, checker.faces, repair=False)
        recheck.check_faces()
        recheck.check_components()
    used = used_vertices(checker.faces, len(checker.vertices))
    new_index = np.full(len(checker.vertices), -1, dtype=np.int64)
    new_index[used] = np.arange(len(used))
    welded_index = np.where(representative >= 0, new_index[representative], -1)
    return Checked(
        vertices=checker.vertices[used],
        faces=new_index[checker.faces].astype(np.int32),
        original_index=checker.origin[used],
        welded_index=welded_index,
        original_corner=checker.corners,
        faces_in_file=len(faces),
        welded_vertices=int(np.sum((representative >= 0) & (representative != np.arange(len(representative))))),
        reoriented_faces=reoriented,
        repairs=tuple(checker.repairs),
    )


def _as_arrays(vertices: Any, faces: Any) -> tuple[np.ndarray, np.ndarray]:
    """The arguments as float64 (V, 3) and int64 (F, 3)."""
    for name, array in (("vertices", vertices), ("faces", faces)):
        if isinstance(array, np.ma.MaskedArray):
            raise MeshError(
                f"Expected {name} as a plain array, found a masked array, whose mask would be lost. Leave out the "
                "masked entries and the faces that use them."
            )
    try:
        vertices, faces = np.asarray(vertices), np.asarray(faces)
    except (TypeError, ValueError) as error:
        raise MeshError(f"Vertices and faces must be arrays of numbers, (V, 3) and (F, 3), but: {error}") from error
    if vertices.dtype.kind not in "fiu":
        raise MeshError(f"Vertices must be real numbers, found {vertices.dtype}. Convert them to float64.")
    if faces.size == 0:
        raise MeshError(
            f"The mesh has no faces (and {len(vertices) if vertices.ndim else 0} vertices). Pass triangles as faces "
            "(F, 3), or triangulate the points first."
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
        faces = np.minimum(faces, np.iinfo(np.int64).max)  # so that check_indices reports it instead of wrapping around
    with np.errstate(over="ignore", invalid="ignore"):  # a long double can overflow; check_positions reports it
        return vertices.astype(np.float64), faces.astype(np.int64)


def _counted(count: int, noun: str, nouns: str) -> str:
    return f"{count} {noun if count == 1 else nouns}"


class _Checker:
    """The mesh being checked: arrays that the repairs replace, and the list of repairs.

    Attributes:
        vertices: (V, 3) positions.
        faces: (F, 3) vertex indices.
        corners: (F, 3) input corners of the faces, as in `Checked.original_corner`.
        repair: whether to repair instead of raising.
        repairs: one phrase for each repair.
        origin: (V,) input vertex that each vertex is a copy of.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, repair: bool):
        self.vertices = vertices
        self.faces = faces
        self.corners = np.arange(faces.size).reshape(-1, 3)
        self.repair = repair
        self.repairs: list[str] = []
        self.origin = np.arange(len(vertices))

    def _drop(self, is_bad: np.ndarray, message: Callable[[int], str], what: str) -> None:
        """Drop the bad faces, or raise the message for the first of them if repair is off."""
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
        """Check that every face refers to vertices that exist."""
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
        """Check that the positions in use are finite, and small enough for their powers to be finite."""
        is_finite = np.all(np.isfinite(self.vertices), axis=1)

        def not_finite(face: int) -> str:
            # The message names the first vertex rather than the first face, because the vertex is the cause.
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
        # Adding zero turns -0.0 into 0.0, so that welding by sorting sees a single position.
        self.vertices = self.vertices + 0.0

    def merge_vertices(self, weld: bool | float) -> np.ndarray:
        """Merge vertices as `weld` asks; returns the vertex that stands for each, or -1 if unused, (V,)."""
        representative = welded_vertices(self.vertices, self.faces, weld)
        self.faces = representative[self.faces]
        return representative

    def check_faces(self) -> None:
        """Check that every face has an area, and that the faces form a manifold."""
        self.check_degenerate()
        self.check_duplicates()
        self.check_edges()
        self.check_fans()

    def check_degenerate(self) -> None:
        """Check that every face has three different vertices and an area."""
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

        # A face whose corners coincide is reported below as a face without area.
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
        """Check that no two faces have the same three vertices."""
        corners = np.sort(self.faces, axis=1)
        # The sort is stable, so the first of equal faces stays. A single key for two corners sorts faster than two.
        order = np.lexsort((corners[:, 2], corners[:, 0] * len(self.vertices) + corners[:, 1]))
        repeats = np.zeros(len(order), bool)
        repeats[order[1:]] = np.all(corners[order[1:]] == corners[order[:-1]], axis=1)

        def message(face: int) -> str:
            twin = int(np.flatnonzero(np.all(corners == corners[face], axis=1))[0])
            return (
                f"Faces {twin} and {face} have the same corners {tuple(corners[face].tolist())}. "
                "Remove either of them, or use repair=True to drop duplicates."
            )

        self._drop(repeats, message, "that duplicated another")

    def check_edges(self) -> None:
        """Check that no edge belongs to more than two faces."""
        keys = undirected_keys(half_edges(self.faces), len(self.vertices))
        in_order = np.sort(keys)
        if not np.any(in_order[2:] == in_order[:-2]):
            return
        face = np.tile(np.arange(len(self.faces)), 3)
        # Rank the faces at each edge by area, the largest first.
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
        """Check that the faces at each vertex form a single fan; the repair gives every other fan its own vertex."""
        split = self._split_fans(np.zeros(0, bool))
        if split:
            self.repairs.append(f"split {_counted(split, 'vertex', 'vertices')} where separate fans touched")

    def cut_where_one_sided(self) -> None:
        """Cut components that are not orientable open if repair is on, along the curves where their faces conflict."""
        if not self.repair:
            return
        is_cut = conflicting_edges(self.faces, len(self.vertices))
        if is_cut.any():
            self._split_fans(is_cut)
            edges = _counted(int(is_cut.sum()), "edge", "edges")
            self.repairs.append(
                f"cut along {edges} where the surface was one-sided (if you save the mesh, load it with weld=False; "
                "welding would close the cut)"
            )

    def _split_fans(self, is_cut: np.ndarray) -> int:
        """Give all fans at a vertex but the first a vertex of their own; returns the number of vertices split.

        Args:
            is_cut: (P,) whether fans end at each edge of `shared_edges`; empty if they end at none.
        """
        corners, fans = self.faces.ravel(), self._fan_labels(is_cut)
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
        new_vertices = fan_vertices.copy()
        new_vertices[is_further] = len(self.vertices) + np.arange(is_further.sum())
        new_corners = np.empty_like(corners)
        new_corners[order] = new_vertices[np.cumsum(begins) - 1]
        self.faces = new_corners.reshape(-1, 3)
        self.vertices = np.concatenate([self.vertices, self.vertices[fan_vertices[is_further]]])
        self.origin = np.concatenate([self.origin, self.origin[fan_vertices[is_further]]])
        return len(split)

    def _fan_labels(self, is_cut: np.ndarray) -> np.ndarray:
        """The label (3F,) of the fan of every corner; corner j of face f has the number 3 f + j."""
        num_faces = len(self.faces)
        first, second, same_direction = shared_edges(self.faces, len(self.vertices))
        if is_cut.size:
            first, second, same_direction = first[~is_cut], second[~is_cut], same_direction[~is_cut]

        def ends(half_edge: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            # A half-edge of block j runs from corner j to corner j + 1 of its face.
            block, face = np.divmod(half_edge, num_faces)
            return 3 * face + block, 3 * face + (block + 1) % 3

        (begin, end), (other_begin, other_end) = ends(first), ends(second)
        beside_begin = np.where(same_direction, other_begin, other_end)
        beside_end = np.where(same_direction, other_end, other_begin)
        return components(np.concatenate([begin, end]), np.concatenate([beside_begin, beside_end]), count=3 * num_faces)

    def check_components(self) -> None:
        """Check that every connected component has enough vertices."""
        edges = half_edges(self.faces)
        labels = components(edges[:, 0], edges[:, 1], len(self.vertices))
        used = used_vertices(self.faces, len(self.vertices))
        sizes = np.bincount(labels[used], minlength=labels.max() + 1)
        face_sizes = sizes[labels[self.faces[:, 0]]]

        def message(face: int) -> str:
            return (
                f"The connected component of vertex {self.faces[face].min()} has {face_sizes[face]} vertices; at least "
                f"{FEWEST_VERTICES} are needed, because second derivatives at a vertex need five neighbours. "
                "Subdivide it, or use repair=True to drop such components."
            )

        self._drop(face_sizes < FEWEST_VERTICES, message, "of components too small to differentiate on")

    def orient(self) -> int:
        """Reverse faces until neighbours agree and closed components face outwards; returns the number of faces."""
        is_reversed = reversed_faces(self.vertices, self.faces)
        self.faces, self.corners = (
            np.where(is_reversed[:, None], rows[:, [0, 2, 1]], rows) for rows in (self.faces, self.corners)
        )
        return int(is_reversed.sum())
