"""The mesh that a command works on, and the values that files hold for its vertices.

What enters: names of files. What leaves: a `Subject`, and values in the order of its vertices.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..._base.progress import noted
from ..._lifting.schemes import Monotone
from ..._mesh import Mesh, load_mesh, shapes
from ..._surface import FarFromOriginWarning, Surface

# Number of vertices above which a progress bar is shown while the surface is built.
_LARGE_MESH = 100_000


@dataclasses.dataclass(frozen=True)
class Subject:
    """A mesh and its surface.

    Attributes:
        name: name of the shape or of the file.
        path: mesh file; None for a built-in shape.
        mesh: mesh, in an order that keeps neighbours together.
        surface: surface of the mesh.
        mean_edge: mean length of the edges.
    """

    name: str
    path: Path | None
    mesh: Mesh
    surface: Surface
    mean_edge: float

    def in_file_order(self, values: np.ndarray) -> np.ndarray:
        """Values at the vertices, from the order of the mesh to that of the file."""
        return np.asarray(values)[self.mesh.source_order]

    def from_file_order(self, values: np.ndarray, source: str) -> np.ndarray:
        """Values at the vertices, from the order of the file to that of the mesh.

        Args:
            values: one value for each vertex of the file, or for each vertex of the mesh after merging, in the order
                in which results are written.
            source: where the values come from, for messages.

        Raises:
            ValueError: the number of values is neither.
        """
        mesh = self.mesh
        num_in_file = len(mesh.welded_index)
        if len(values) == num_in_file:
            return mesh.pull(values)
        if len(values) == mesh.num_vertices:
            ordered = np.empty_like(values)
            ordered[mesh.source_order] = values
            return ordered
        merged = f" (or {mesh.num_vertices}, the number after merging)" if num_in_file != mesh.num_vertices else ""
        raise ValueError(
            f"{source}: expected {num_in_file} values, one for each vertex of {self.name}{merged}, found {len(values)}."
        )

    def vertices_of_file(self, numbers: list[int]) -> np.ndarray:
        """The vertices of the mesh with these numbers in its file.

        Raises:
            ValueError: the file has no such vertex, or the vertex belongs to no face.
        """
        count = len(self.mesh.welded_index)
        for number in numbers:
            if not 0 <= number < count:
                raise ValueError(f"Expected vertices of {self.name}, from 0 to {count - 1}, found {number}.")
            if self.mesh.welded_index[number] < 0:
                raise ValueError(f"Vertex {number} of {self.name} belongs to no face. Name another vertex.")
        return self.mesh.welded_index[numbers]


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Raise if an option is none of its choices."""
    if value not in choices:
        raise ValueError(f"Expected as {name} one of {', '.join(choices)}, found {value!r}.")


def check_positive(**options: float | int | None) -> None:
    """Raise if one of the options is given and is not positive and finite."""
    for name, value in options.items():
        if value is not None and not 0 < value < np.inf:
            raise ValueError(f"Expected {name} to be positive and finite, found {value}. Leave it out for the default.")


def load(name: str, repair: bool) -> Subject:
    """The subject of a name: ``sphere``, ``torus``, ``disk``, ``box`` or a mesh file, whose scale is kept.

    Raises:
        MeshError: the file is not an acceptable mesh.
    """
    built_in = {
        "sphere": lambda: shapes.icosphere(subdivisions=4),
        "torus": lambda: shapes.torus(major=2.0, minor=1.0, n_major=96, n_minor=48),
        "disk": lambda: shapes.disk(rings=40),
        "box": lambda: shapes.box(n=40),
    }
    path = None if name in built_in else Path(name)
    mesh = built_in[name]() if path is None else load_mesh(path, repair=repair).reordered()
    with noted(FarFromOriginWarning):
        surface = Surface.from_mesh(mesh, Monotone(), "float64", progress=mesh.num_vertices > _LARGE_MESH)
    return Subject(name if path is None else path.name, path, mesh, surface, mesh.mesh_size)
