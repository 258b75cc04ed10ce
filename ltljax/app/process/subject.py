"""What a command works on: a mesh file or a built-in shape, and the numbers that files have for its vertices.

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

# Vertices from which on building a surface takes long enough to be watched.
_LONG_BUILD = 100_000


@dataclasses.dataclass(frozen=True)
class Subject:
    """A mesh and its surface.

    Attributes:
        name: as it was given.
        path: of the file; None for a built-in shape.
        mesh: in an order that keeps neighbours together.
        surface: of it.
        edge: the mean length of its edges.
    """

    name: str
    path: Path | None
    mesh: Mesh
    surface: Surface
    edge: float

    def in_file_order(self, values: np.ndarray) -> np.ndarray:
        """Values of the vertices in the order in which they are written: that of the file."""
        return np.asarray(values)[self.mesh.source_order]

    def pulled(self, values: np.ndarray, what: str) -> np.ndarray:
        """Values of the vertices from values in the order of the file, or of what is written.

        Raises:
            ValueError: they are as many as neither.
        """
        mesh = self.mesh
        if len(values) == len(mesh.welded_index):
            return mesh.pull(values)
        if len(values) == mesh.num_vertices:
            ordered = np.empty_like(values)
            ordered[mesh.source_order] = values
            return ordered
        of_file = len(mesh.welded_index)
        merged = f" (or {mesh.num_vertices}, those left after merging)" if of_file != mesh.num_vertices else ""
        raise ValueError(
            f"{what}: expected {of_file} values, one for each vertex of {self.name}{merged}, found {len(values)}."
        )

    def vertices_of_file(self, numbers: list[int]) -> np.ndarray:
        """Vertices of the mesh, from their numbers in its file.

        Raises:
            ValueError: the file has no such vertex, or no face has it.
        """
        count = len(self.mesh.welded_index)
        for number in numbers:
            if not 0 <= number < count:
                raise ValueError(f"Expected vertices from 0 to {count - 1}, those of {self.name}, found {number}.")
            if self.mesh.welded_index[number] < 0:
                raise ValueError(f"Vertex {number} of {self.name} belongs to no face. Name another.")
        return self.mesh.welded_index[numbers]


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Raise where an option is none of its choices."""
    if value not in choices:
        raise ValueError(f"Expected as {name} one of {', '.join(choices)}, found {value!r}.")


def check_positive(**options: float | None) -> None:
    """Raise where one of the options that are given is not positive and finite."""
    for name, value in options.items():
        if value is not None and not 0 < value < np.inf:
            raise ValueError(
                f"Expected {name} to be positive and finite, found {value}. Leave it away for the default."
            )


def load(name: str, repair: bool) -> Subject:
    """The subject of a name: ``sphere``, ``torus``, ``disk``, ``box`` or a mesh file, which keeps its scale.

    Raises:
        MeshError: the file is no acceptable mesh.
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
        surface = Surface.from_mesh(mesh, Monotone(), "float64", progress=mesh.num_vertices > _LONG_BUILD)
    return Subject(name if path is None else path.name, path, mesh, surface, mesh.mesh_size)
