"""What a run is made of, and what a user can choose about it."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import diffrax
import numpy as np

from ..._equations import Equation
from ..._mesh import Mesh
from .observed import Wanted


@dataclasses.dataclass(frozen=True)
class Settings:
    """How a scenario is solved and shown.

    Attributes:
        scheme: ``"monotone"``, ``"polynomial"`` or ``"paper"``.
        degree: of the scheme ``"polynomial"``.
        dtype: ``"float32"`` or ``"float64"``.
        solver: as of `solve`; None for its default.
        rtol: relative tolerance.
        atol: absolute tolerance; None for what `solve` takes by itself.
        dt: the length of fixed steps; None for adaptive ones.
        show: the species that pictures show.
        colormap: the name of their colours.
        view: from where pictures look, one of `ltljax._output.pictures.VIEWS`.
        texture: pixels of an edge of the image that the mesh's UV map leads to.
        displacement: how far the largest value of ``show`` is raised above the least in a surface written for that;
            zero for none.
    """

    scheme: str = "monotone"
    degree: int | None = None
    dtype: str = "float64"
    solver: diffrax.AbstractSolver | None = None
    rtol: float = 1e-4
    atol: float | None = None
    dt: float | None = None
    show: str = "u"
    colormap: str = "viridis"
    view: str = "aslant"
    texture: int = 1024
    displacement: float = 0.0


@dataclasses.dataclass(frozen=True)
class Options:
    """What a user can choose about a scenario.

    Attributes:
        mesh: one of `BUILT_IN` or the path of a mesh file.
        source: of `heat` on the torus, one of `SOURCES`.
        boundary: of `heat` on an open mesh, conditions as `parse_condition` reads them.
        as_published: of `turing`, the paper's parameters in place of those that make a pattern.
        keep_scale: leave a mesh file's length scale alone.
        repair: mend a mesh file that is not acceptable.
        seed: of the random numbers.
        t1: the end of the run; None for the scenario's own.
        scale: of `turing`, how many times as large its pattern is.
    """

    mesh: str = "sphere"
    source: str | None = None
    boundary: tuple[str, ...] = ()
    as_published: bool = False
    keep_scale: bool = False
    repair: bool = False
    seed: int = 0
    t1: float | None = None
    scale: float = 1.0


@dataclasses.dataclass(frozen=True)
class Scenario:
    """An example, ready to be solved.

    Attributes:
        name: its name.
        mesh: where; for files scaled as ``notes`` says.
        make_equation: the equation, from the surface of the mesh; with a second argument, numbers by dotted key that
            replace those of a scenario file.
        u0: the initial state.
        t1: the end of the run.
        parameters: every parameter, for the record.
        species: the names of the state's columns.
        shown: the column that pictures show.
        exact: ``t -> state``, where the solution is known.
        exact_is: what ``exact`` is, in words.
        notes: what a reader of the results should know.
        title: what it is called in words.
        frames: how many states are kept besides the first, unless the command line says otherwise.
        settings: how it is solved and shown.
        resolved: of a scenario file, all its tables with every value, defaults too.
        files: of a scenario file, the files it names, by the dotted key that does.
        wanted: of a scenario file with a table ``[fit]``, what is to be found from what was seen.
    """

    name: str
    mesh: Mesh
    make_equation: Callable[..., Equation]
    u0: np.ndarray
    t1: float
    parameters: dict[str, Any]
    species: tuple[str, ...]
    shown: int = 0
    exact: Callable[[float], np.ndarray] | None = None
    exact_is: str = ""
    notes: tuple[str, ...] = ()
    title: str = ""
    frames: int = 60
    settings: Settings = Settings()
    resolved: dict[str, Any] | None = None
    files: Mapping[str, Path] = dataclasses.field(default_factory=dict)
    wanted: Wanted | None = None


def scaled_to_unit_area(mesh: Mesh) -> tuple[Mesh, str]:
    """The mesh with the area of the unit sphere, and a note that says so."""
    factor = math.sqrt(4 * math.pi / mesh.area)
    return mesh.scaled(factor), f"The mesh is scaled by {factor:.6g}, so that its area is that of the unit sphere."
