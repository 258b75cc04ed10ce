"""The table `[mesh]` of a scenario file becomes a `Mesh`."""

import dataclasses
import inspect
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..._mesh import Mesh, MeshError, load_mesh, shapes
from .inputs import check_self_contained
from .tables import Table

# The built-in shapes, with the default and the maximum of every number that sets their resolution.
SHAPES: dict[str, tuple[Callable[..., Mesh], dict[str, tuple[int, int]]]] = {
    "sphere": (shapes.icosphere, {"subdivisions": (5, 8)}),
    "ellipsoid": (shapes.ellipsoid, {"subdivisions": (5, 8)}),
    "torus": (shapes.torus, {"n_major": (144, 2000), "n_minor": (72, 2000)}),
    "disk": (shapes.disk, {"rings": (60, 500)}),
    "hemisphere": (shapes.hemisphere, {"rings": (50, 500)}),
    "square": (shapes.square, {"n": (100, 1500)}),
    "cylinder": (shapes.cylinder, {"n_around": (120, 2000), "n_along": (80, 2000)}),
    "box": (shapes.box, {"n": (40, 500)}),
}
_TRIPLES = {"axes": (2.0, 1.0, 1.5), "sides": (1.0, 1.0, 1.0)}


@dataclasses.dataclass(frozen=True)
class ScenarioMesh:
    """The mesh of a scenario.

    Attributes:
        mesh: mesh, in an order that keeps neighbours together.
        path: mesh file; None for a built-in shape.
        factor: factor from the coordinates of the file to those of the mesh.
        notes: what was done to the file's mesh, in words.
    """

    mesh: Mesh
    path: Path | None = None
    factor: float = 1.0
    notes: tuple[str, ...] = ()


def read_mesh(table: Table, folder: Path, mesh_file: Path | None = None) -> ScenarioMesh:
    """The mesh that a table describes.

    Args:
        table: `[mesh]`.
        folder: the only folder whose files the table may name.
        mesh_file: the mesh file that the command line names; it may lie anywhere.

    Raises:
        ScenarioError: the table has a mistake, or its file is not an acceptable mesh.
    """
    if "file" not in table:
        return ScenarioMesh(_shape(table))
    if mesh_file is not None and table.text("file") == mesh_file.name:
        path = mesh_file
    else:
        path = table.file("file", folder if mesh_file is None else mesh_file.parent)
    repair = table.flag("repair", False)
    scale = table.choice("scale", ("unit", "keep"), "unit")
    table.finish()
    try:
        check_self_contained(path)
        mesh = load_mesh(path, repair=repair).reordered()
    except MeshError as error:
        raise error if path is mesh_file else table.refused("file", error) from None
    if scale == "keep":
        return ScenarioMesh(mesh, path, notes=(f"The mesh keeps its scale: area {mesh.area:.6g}.",))
    factor = math.sqrt(4 * math.pi / mesh.area)
    note = f"The mesh is scaled by {factor:.6g}, so that its area is that of the unit sphere."
    return ScenarioMesh(mesh.scaled(factor), path, factor, (note,))


def _shape(table: Table) -> Mesh:
    make, resolutions = SHAPES[table.choice("shape", tuple(SHAPES), "sphere")]
    arguments: dict[str, Any] = {
        key: table.count(key, default, 0 if key == "subdivisions" else 3, most)
        for key, (default, most) in resolutions.items()
    }
    for key, parameter in inspect.signature(make).parameters.items():
        if key in _TRIPLES:
            arguments[key] = tuple(table.numbers(key, _TRIPLES[key], 1e-3, 1e3))
        elif key not in resolutions:
            arguments[key] = table.number(key, float(parameter.default), 1e-3, 1e3)
    table.finish()
    return make(**arguments)
