"""`Mesh`: an immutable, checked triangle mesh.

Its faces form a manifold, consistently oriented surface, so that code that takes a `Mesh` need not check this again.
"""

import dataclasses
from functools import cached_property
from typing import Any

import numpy as np

from . import topology
from .checks import LARGEST_LENGTH, SMALLEST_LENGTH, Checked, check
from .errors import MeshError
from .report import MeshReport, corner_angles, face_areas, face_edge_lengths


@dataclasses.dataclass(frozen=True, eq=False, init=False, repr=False)
class Mesh:
    """A checked triangle mesh: manifold, consistently oriented (outwards if closed), with finite geometry.

    Faces that are oriented against their neighbours are reversed, and vertices without a face are dropped; the report
    counts both. All arrays are read-only.

    Attributes:
        vertices: (V, 3) float64 positions.
        faces: (F, 3) int32 vertex indices, counter-clockwise seen from outside.
        original_index: (V,) int64, the first vertex of the source (the file or arrays) that was merged into each
            vertex.
        welded_index: (V_original,) int64, the vertex that each vertex of the source became, or -1 if it was dropped.
        normals: (V, 3) float64 exact unit outward normals if the shape is known by formula, else None.
        uv: (F, 3, 2) float64 texture coordinates of the corners of every face, or None if there are none.
        source_order: (V,) int32, the vertices in the order of the source: ``data[mesh.source_order]`` undoes
            `reordered`. It is 0, 1, 2, ... in a mesh that was not reordered.
    """

    vertices: np.ndarray
    faces: np.ndarray
    original_index: np.ndarray
    welded_index: np.ndarray
    normals: np.ndarray | None
    uv: np.ndarray | None
    source_order: np.ndarray
    _checked: Checked

    def __init__(
        self,
        vertices: Any,
        faces: Any,
        *,
        repair: bool = False,
        weld: bool | float = False,
        normals: Any | None = None,
        uv: Any | None = None,
    ):
        """Check the arrays.

        Args:
            vertices: (V, 3) positions.
            faces: (F, 3) vertex indices, counted from 0.
            repair: repair the mesh where possible instead of raising: drop degenerate, duplicate and invalid faces,
                extra faces at an edge with more than two, and components that are too small; split vertices where
                separate fans touch; cut surfaces that are not orientable. The report lists each repair.
            weld: True merges vertices that coincide up to rounding: vertices at the same position, and ends of edges
                with a single face that are closer than a ten-thousandth of the shortest edge at either. A distance
                merges all vertices within it.
            normals: (V, 3) exact unit outward normals, if the surface is known by formula.
            uv: (F, 3, 2) texture coordinates of the corners of every face, v upwards.

        Raises:
            MeshError: the arrays are not a surface; the message names the first offending index.
        """
        checked = check(vertices, faces, repair=repair, weld=weld)
        unit_normals = None
        if normals is not None:
            unit_normals = np.array(normals, dtype=np.float64)
            expected = (len(checked.welded_index), 3)
            if unit_normals.shape != expected:
                raise MeshError(f"Normals must have the shape of the vertices, {expected}, found {unit_normals.shape}.")
            unit_normals = unit_normals[checked.original_index]
            is_bad = ~(np.abs(np.linalg.norm(unit_normals, axis=1) - 1) < 1e-6)
            if is_bad.any():
                first = int(checked.original_index[np.flatnonzero(is_bad)[0]])
                length = float(np.linalg.norm(unit_normals[is_bad][0]))
                raise MeshError(
                    f"Normals must have length 1, found length {length:g} at vertex {first}. Normalise them."
                )
        texture_coordinates = None
        if uv is not None:
            texture_coordinates = np.asarray(uv, dtype=np.float64)
            if texture_coordinates.shape != (checked.faces_in_file, 3, 2):
                raise MeshError(
                    f"Expected uv of shape {(checked.faces_in_file, 3, 2)}, found {texture_coordinates.shape}."
                )
            texture_coordinates = texture_coordinates.reshape(-1, 2)[checked.original_corner]
        self._fill(checked, unit_normals, texture_coordinates, np.arange(len(checked.vertices), dtype=np.int32))

    def _fill(
        self, checked: Checked, normals: np.ndarray | None, uv: np.ndarray | None, source_order: np.ndarray
    ) -> None:
        """Set the fields and make their arrays read-only."""
        fields = {
            "vertices": checked.vertices,
            "faces": checked.faces,
            "original_index": checked.original_index,
            "welded_index": checked.welded_index,
            "normals": normals,
            "uv": uv,
            "source_order": source_order,
            "_checked": checked,
        }
        for name, value in fields.items():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
            object.__setattr__(self, name, value)

    @property
    def num_vertices(self) -> int:
        """The number of vertices."""
        return len(self.vertices)

    @property
    def num_faces(self) -> int:
        """The number of faces."""
        return len(self.faces)

    @cached_property
    def edges(self) -> np.ndarray:
        """The edges (E, 2), int32, lower vertex first, sorted."""
        return _frozen(topology.unique_edges(self.faces))

    @cached_property
    def boundary_loops(self) -> list[np.ndarray]:
        """The boundary curves, each an int32 array of vertices with the surface on the left.

        A loop begins at the vertex that comes first in the source, and the loops are sorted by that vertex.
        """
        rank = np.argsort(self.source_order)
        loops = topology.boundary_loops(self.faces, self.num_vertices)
        loops = [np.roll(loop, -int(np.argmin(rank[loop]))) for loop in loops]
        return [_frozen(loop) for loop in sorted(loops, key=lambda loop: rank[loop[0]])]

    @cached_property
    def boundary_vertices(self) -> np.ndarray:
        """Whether each vertex lies on the boundary, (V,) bool."""
        is_boundary = np.zeros(self.num_vertices, bool)
        for loop in self.boundary_loops:
            is_boundary[loop] = True
        return _frozen(is_boundary)

    @property
    def is_closed(self) -> bool:
        """Whether the surface has no boundary."""
        return not self.boundary_loops

    @cached_property
    def components(self) -> np.ndarray:
        """The connected component of each vertex, (V,) int32, counted from 0 in the order of their first vertices."""
        return _frozen(topology.vertex_components(self.faces, self.num_vertices))

    @cached_property
    def edge_lengths(self) -> np.ndarray:
        """The length of each of the `edges`, (E,)."""
        ends = self.vertices[self.edges]
        return _frozen(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1))

    @property
    def mesh_size(self) -> float:
        """The mean edge length."""
        return float(self.edge_lengths.mean())

    @cached_property
    def area(self) -> float:
        """The total area."""
        return float(face_areas(self.vertices, self.faces).sum())

    @cached_property
    def report(self) -> MeshReport:
        """The measurements and repairs of the mesh; prints as a table."""
        checked, lengths = self._checked, self.edge_lengths
        angles = np.degrees(corner_angles(self.vertices, self.faces))
        valences = np.bincount(self.edges.ravel(), minlength=self.num_vertices)
        loops = tuple(len(loop) for loop in self.boundary_loops)
        components = int(self.components.max()) + 1
        euler_number = self.num_vertices - len(self.edges) + self.num_faces
        return MeshReport(
            vertices=self.num_vertices,
            faces=self.num_faces,
            edges=len(self.edges),
            components=components,
            boundary_loops=loops,
            boundary_edges=sum(loops),
            euler_number=euler_number,
            genus=(2 * components - len(loops) - euler_number) // 2,
            is_closed=self.is_closed,
            area=self.area,
            mesh_size=self.mesh_size,
            min_edge=float(lengths.min()),
            max_edge=float(lengths.max()),
            min_angle=float(angles.min()),
            max_angle=float(angles.max()),
            min_valence=int(valences.min()),
            max_valence=int(valences.max()),
            mean_valence=float(valences.mean()),
            vertices_in_file=len(self.welded_index),
            faces_in_file=checked.faces_in_file,
            welded_vertices=checked.welded_vertices,
            dropped_vertices=int(np.sum(self.welded_index < 0)),
            reoriented_faces=checked.reoriented_faces,
            repairs=checked.repairs,
        )

    def pull(self, original_data: Any) -> np.ndarray:
        """Data on the vertices of this mesh (V, ...) from data on the vertices of the source (V_original, ...)."""
        data = np.asarray(original_data)
        self._expect_rows(data, len(self.welded_index), "vertices in the source")
        return data[self.original_index]

    def push(self, data: Any, fill: Any = np.nan) -> np.ndarray:
        """Data on the vertices of the source (V_original, ...) from data on the vertices of this mesh (V, ...).

        Args:
            data: (V, ...) an entry for each vertex of this mesh.
            fill: value at vertices that were dropped.
        """
        data = np.asarray(data)
        self._expect_rows(data, self.num_vertices, "vertices")
        pushed = data[self.welded_index].astype(np.result_type(data.dtype, fill))
        pushed[self.welded_index < 0] = fill
        return pushed

    @staticmethod
    def _expect_rows(data: np.ndarray, count: int, what: str) -> None:
        if data.ndim == 0 or len(data) != count:
            raise ValueError(f"The data must have one entry for each of {count} {what}, found shape {data.shape}.")

    def scaled(self, factor: float | int) -> "Mesh":
        """The mesh with all positions multiplied by a positive factor; faces, indices and normals do not change.

        Raises:
            MeshError: the factor is not positive, or the result would be too large or too small to compute with.
        """
        factor = float(factor)
        if not 0 < factor < np.inf:
            raise MeshError(
                f"The factor must be positive and finite, found {factor}. A negative factor would turn the mesh inside "
                "out."
            )
        with np.errstate(over="ignore"):
            vertices = self.vertices * factor
            smallest = float(face_edge_lengths(self.vertices, self.faces).max(axis=1).min()) * factor
        largest = float(np.abs(vertices).max())
        if not (largest <= LARGEST_LENGTH and smallest >= SMALLEST_LENGTH):
            raise MeshError(
                f"Scaling by {factor:g} makes faces of size {smallest:g} and positions of size {largest:g}; areas and "
                f"weights need sizes from {SMALLEST_LENGTH:g} to {LARGEST_LENGTH:g}. Use a factor closer to 1."
            )
        mesh = object.__new__(Mesh)
        mesh._fill(dataclasses.replace(self._checked, vertices=vertices), self.normals, self.uv, self.source_order)
        return mesh

    def reordered(self) -> "Mesh":
        """The mesh with its vertices renumbered so that neighbours are close to one another in memory.

        Operators on a scan with an arbitrary vertex order run up to five times faster on the reordered mesh. The order
        of faces and the numbers of boundary loops do not change; the numbers of components may. `pull` and `push` still
        map from and to data in the order of the source. If ``mesh`` is the result, ``data[mesh.source_order]`` puts
        data on it back into the original order.
        """
        order = topology.locality_order(self.faces, self.num_vertices)
        new_index = np.empty(self.num_vertices, np.int32)
        new_index[order] = np.arange(self.num_vertices, dtype=np.int32)
        checked = dataclasses.replace(
            self._checked,
            vertices=self.vertices[order],
            faces=new_index[self.faces],
            original_index=self.original_index[order],
            welded_index=np.where(self.welded_index < 0, -1, new_index[self.welded_index]).astype(np.int64),
        )
        mesh = object.__new__(Mesh)
        normals = None if self.normals is None else self.normals[order]
        mesh._fill(checked, normals, self.uv, new_index[self.source_order])
        return mesh

    def __repr__(self) -> str:
        boundary = "closed" if self.is_closed else f"{len(self.boundary_loops)} boundary loops"
        return f"Mesh({self.num_vertices} vertices, {self.num_faces} faces, {boundary})"


def _frozen(array: np.ndarray) -> np.ndarray:
    """The array, read-only."""
    array.setflags(write=False)
    return array
