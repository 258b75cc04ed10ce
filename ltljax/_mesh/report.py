"""The measurements of a mesh: the report of `mesh.report` and `ltljax info`, and the functions that measure."""

import dataclasses
from typing import Any

import numpy as np

# A shape is far from the origin if its distance exceeds this multiple of its size.
_FAR = 2


@dataclasses.dataclass(frozen=True)
class MeshReport:
    """The measurements of a mesh, and the changes made to it while it was loaded and checked.

    Attributes:
        vertices: number of vertices.
        faces: number of triangles.
        edges: number of edges.
        components: number of connected components.
        boundary_loops: length in edges of each boundary loop.
        boundary_edges: number of edges with a single face.
        euler_number: vertices - edges + faces.
        genus: number of handles of all components together.
        is_closed: whether the surface has no boundary.
        area: total area.
        mesh_size: mean edge length.
        min_edge: shortest edge length.
        max_edge: longest edge length.
        min_angle: smallest corner angle, degrees.
        max_angle: largest corner angle, degrees.
        min_valence: smallest number of edges at a vertex.
        max_valence: largest number of edges at a vertex.
        mean_valence: mean number of edges at a vertex.
        vertices_in_file: number of vertices in the source, a file or an array.
        faces_in_file: number of triangles in the source, after splitting larger faces.
        welded_vertices: number of vertices merged into another at the same position up to rounding.
        dropped_vertices: number of vertices without a face.
        reoriented_faces: number of faces reversed so that neighbours agree and closed components face outwards.
        repairs: one phrase for each repair.
    """

    vertices: int
    faces: int
    edges: int
    components: int
    boundary_loops: tuple[int, ...]
    boundary_edges: int
    euler_number: int
    genus: int
    is_closed: bool
    area: float
    mesh_size: float
    min_edge: float
    max_edge: float
    min_angle: float
    max_angle: float
    min_valence: int
    max_valence: int
    mean_valence: float
    vertices_in_file: int
    faces_in_file: int
    welded_vertices: int
    dropped_vertices: int
    reoriented_faces: int
    repairs: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """The report as plain Python values, ready for JSON."""
        values = dataclasses.asdict(self)
        return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}

    def __str__(self) -> str:
        if self.is_closed:
            boundary = "none (closed)"
        else:
            loops = ", ".join(str(length) for length in self.boundary_loops[:8])
            more = ", ..." if len(self.boundary_loops) > 8 else ""
            noun = "loop" if len(self.boundary_loops) == 1 else "loops"
            boundary = f"{len(self.boundary_loops)} {noun} of {loops}{more} edges"
        rows = [
            ("vertices", f"{self.vertices:,}"),
            ("faces", f"{self.faces:,}"),
            ("edges", f"{self.edges:,}"),
            ("components", f"{self.components:,}"),
            ("boundary", boundary),
            ("Euler number", f"{self.euler_number} (genus {self.genus})"),
            ("area", f"{self.area:.6g}"),
            ("edge length", f"{self.mesh_size:.4g} on average, {self.min_edge:.4g} to {self.max_edge:.4g}"),
            ("corner angles", f"{self.min_angle:.4g} to {self.max_angle:.4g} degrees"),
            ("valence", f"{self.mean_valence:.4g} on average, {self.min_valence} to {self.max_valence}"),
            ("in the source", f"{self.vertices_in_file:,} vertices, {self.faces_in_file:,} faces"),
            ("welded vertices", f"{self.welded_vertices:,}"),
            ("dropped vertices", f"{self.dropped_vertices:,}"),
            ("re-oriented faces", f"{self.reoriented_faces:,}"),
            ("repairs", self.repairs[0] if self.repairs else "none"),
            *(("", repair) for repair in self.repairs[1:]),
        ]
        width = max(len(name) for name, _ in rows)
        return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)


def corner_angles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The angle at each corner of each face, (F, 3), in radians."""
    corners = vertices[faces]
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, -2, axis=1) - corners
    # Near 0 and pi, atan2 is accurate, whereas arccos loses half the digits.
    return np.arctan2(np.linalg.norm(np.cross(ahead, behind), axis=2), np.sum(ahead * behind, axis=2))


def far_middle(vertices: np.ndarray) -> np.ndarray:
    """The middle of the bounding box if it is farther from the origin than twice the size of the box, else zero.

    So far away, float32 loses the details of a shape unless positions are relative to the middle.
    """
    low, high = (np.asarray(end, np.float64) for end in (vertices.min(axis=0), vertices.max(axis=0)))
    middle = (low + high) / 2
    # `hypot` neither overflows nor underflows. Positions that are NaN give zero.
    return middle if np.hypot.reduce(middle) > _FAR * np.hypot.reduce(high - low) else np.zeros(3)


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The area of each face, (F,)."""
    first, second, third = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    return np.linalg.norm(np.cross(second - first, third - first), axis=1) / 2


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals of the vertices, (V, 3): area-weighted means of face normals; zero for vertices without faces."""
    first, second, third = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    normals = np.zeros_like(vertices)
    np.add.at(normals, faces, np.cross(second - first, third - first)[:, None])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)


def face_edge_lengths(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The lengths of the edges of each face, (F, 3), from corner 0 to 1, 1 to 2 and 2 to 0."""
    corners = vertices[faces]
    return np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
