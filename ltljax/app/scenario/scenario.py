"""A scenario: everything that a run needs."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import diffrax
import numpy as np

from ..._base.progress import noted
from ..._equations import Equation
from ..._lifting.schemes import Monotone, Paper, Polynomial, Scheme
from ..._mesh import Mesh
from ..._surface import FarFromOriginWarning, Surface
from .measurements import FitTask

# Number of vertices above which a progress bar is shown while the surface is built.
_LARGE_MESH = 100_000


@dataclasses.dataclass(frozen=True)
class Settings:
    """How a scenario is solved and shown.

    Attributes:
        scheme: ``"monotone"``, ``"polynomial"`` or ``"paper"``.
        degree: degree of the scheme ``"polynomial"``; None for the other schemes.
        dtype: ``"float32"`` or ``"float64"``.
        solver: solver for `solve`; None for the default of `solve`.
        rtol: relative tolerance.
        atol: absolute tolerance; None for the default of `solve`.
        dt: length of fixed steps; None for adaptive steps.
        show: species that pictures show.
        colormap: name of the colour map of pictures.
        view: side from which pictures are taken, one of `ltljax._output.pictures.VIEWS`.
        texture: width and height of the texture in pixels, if the mesh has a UV map.
        displacement: height of the relief of ``show``, which is written as a further surface; zero for none.
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

    def make_scheme(self) -> Scheme:
        """The scheme of the operators."""
        if self.scheme == "polynomial":
            return Polynomial(self.degree or 4)
        return Paper() if self.scheme == "paper" else Monotone()


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A mesh, an equation on it, an initial state, and how to solve and show it.

    Attributes:
        name: name of the scenario, with which the names of its results begin.
        title: title of the scenario.
        mesh: mesh; a mesh file is scaled as ``notes`` says.
        make_equation: ``surface -> equation``; a second argument, a dictionary with dotted keys, replaces numbers of
            the scenario file.
        u0: (V, S) initial state.
        t1: end time of the run.
        frames: number of states that are recorded after the initial one, unless the command line changes it.
        species: names of the columns of the state.
        settings: how the scenario is solved and shown.
        tables: every value of the scenario file, defaults included.
        files: files that the scenario file names, by dotted key.
        exact: ``t -> state`` (V, S), where the solution is known.
        exact_is: exact solution in words.
        notes: what a reader of the results should know.
        fit_task: unknowns and measurements of the table ``[fit]``; None if the file has no such table.
    """

    name: str
    title: str
    mesh: Mesh
    make_equation: Callable[..., Equation]
    u0: np.ndarray
    t1: float
    frames: int
    species: tuple[str, ...]
    settings: Settings
    tables: dict[str, Any]
    files: Mapping[str, Path]
    exact: Callable[[float], np.ndarray] | None = None
    exact_is: str = ""
    notes: tuple[str, ...] = ()
    fit_task: FitTask | None = None

    def make_surface(self) -> Surface:
        """The surface of the mesh, with a progress bar if building it takes long."""
        is_large = self.mesh.num_vertices > _LARGE_MESH
        # Results are written at the positions of the mesh, whatever the origin of the surface.
        with noted(FarFromOriginWarning):
            return Surface.from_mesh(self.mesh, self.settings.make_scheme(), self.settings.dtype, progress=is_large)

    @property
    def shown(self) -> int:
        """The column of the state that pictures show."""
        return self.species.index(self.settings.show)

    @property
    def where(self) -> str:
        """The mesh in one word: the name of its file or its shape."""
        mesh = self.tables["mesh"]
        return mesh.get("file") or mesh["shape"]
