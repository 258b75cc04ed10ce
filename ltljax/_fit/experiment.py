"""`Experiment`: the run that is to reproduce the data, as a function of the unknowns."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from .._equations import Equation
from .._solve import Multigrid, Solution, solve
from .._surface import Surface
from .._tables import AnyArray


class Experiment(eqx.Module):
    """A run as a function of its unknowns: ``experiment(params, times)`` is its `Solution`.

    Attributes:
        equation: ``params -> Equation``.
        surface: the surface.
        u0: initial state, or ``params -> state``.
        t1: end of the run; by default the last time observed.
        t0: beginning of the run.
        vertices: ``params -> (V, 3)`` if the shape is unknown too.
        solver: solver, as of `solve`.
        dt: time step, as of `solve`.
        rtol: relative tolerance of the time steps, as of `solve`.
        atol: absolute tolerance of the time steps, as of `solve`.
        max_steps: largest number of time steps; a run of more steps counts as diverged.
        preconditioner: preconditioner, as of `solve`.
    """

    equation: Callable[[Any], Equation]
    surface: Surface
    u0: Float[AnyArray, "V *S"] | Callable[[Any], Float[AnyArray, "V *S"]]
    t1: float | None = None
    t0: float = 0.0
    vertices: Callable[[Any], Array] | None = None
    solver: diffrax.AbstractSolver | None = None
    dt: float | None = None
    rtol: float = 1e-5
    atol: float | None = None
    max_steps: int = 100_000
    preconditioner: Multigrid | None = None

    def __call__(self, params: Any, times: Any = None, adjoint: diffrax.AbstractAdjoint | None = None) -> Solution:
        """The run at some parameters.

        Args:
            params: parameters.
            times: times whose states are returned; None for the end alone.
            adjoint: how derivatives are taken through time, as of `solve`.

        Raises:
            ValueError: the run has no end, or a time is outside the run.
        """
        surface = self.surface if self.vertices is None else self.surface.with_vertices(self.vertices(params))
        u0 = self.u0(params) if callable(self.u0) else self.u0
        times = None if times is None else np.asarray(times, np.float64)
        end = self.t1 if self.t1 is not None else times[-1] if times is not None else None
        if end is None:
            raise ValueError("Expected an end of the run: give Experiment(t1=...), or observations with times.")
        if times is not None and (times[0] < self.t0 or times[-1] > end * (1 + 1e-12)):
            raise ValueError(
                f"Observations at times from {times[0]:g} to {times[-1]:g} lie outside the run, from {self.t0:g} to "
                f"{end:g}."
            )
        return solve(
            self.equation(params), surface, u0, end, times, self.solver, adjoint, t0=self.t0, dt=self.dt,
            rtol=self.rtol, atol=self.atol, max_steps=self.max_steps, preconditioner=self.preconditioner, throw=False,
        )  # fmt: skip
