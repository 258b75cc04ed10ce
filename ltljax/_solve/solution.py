"""What `solve` returns, the error it raises, and the condition `Steady` at which it may stop."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

from .._lifting.schemes import Paper, Polynomial
from .._surface import Surface
from .krylov import rms

Condition = Callable[[Array, Array, Array], Bool[Array, ""]]


class SolveError(RuntimeError):
    """A run did not reach its end, or a system of equations could not be solved.

    Attributes:
        time: the time that a run reached.
        solution: the solution up to that time.
    """

    def __init__(self, message: str, time: float = float("nan"), solution: "Solution | None" = None):
        super().__init__(message)
        self.time = time
        self.solution = solution


class Steady(eqx.Module):
    """A condition for ``stop_when``: ``rms(rate) <= tolerance * rms(u)``.

    Attributes:
        tolerance: relative rate of change, per unit of time.
    """

    tolerance: float = 1e-6

    def __call__(self, t, u, rate) -> Bool[Array, ""]:
        """Whether the state is steady."""
        del t
        return rms(rate) <= self.tolerance * rms(u)


class Solution(eqx.Module):
    """A trajectory.

    Attributes:
        ts: (T,) requested times; infinite if the run stopped before them.
        us: (T, V) or (T, V, S) states at these times; NaN if the run stopped before them.
        t_end: time that the run reached.
        u_end: state at ``t_end``, also if ``stop_when`` ended the run.
        counts: numbers of steps and, for `RKL2` and `RKL1`, of evaluations of the rate.
        result: `diffrax.RESULTS`. An overflow is not a failure of the solver and is reported by ``overflowed`` instead.
        overflowed: whether the state became NaN, exceeded a millionth of the largest floating-point number (with
            schemes other than `Monotone`, a million times its initial size) or changed faster than time can resolve,
            or whether a fixed step was unstable.
        stopped: whether ``stop_when`` held.
        interpolation: dense output, which `at` evaluates.
        method: name of the solver and the reason for its choice.
        is_fixed: whether the steps had a fixed length.
    """

    ts: Float[Array, " T"]
    us: Float[Array, "T V *S"]
    t_end: Float[Array, ""]
    u_end: Float[Array, "V *S"]
    counts: dict[str, Array]
    result: diffrax.RESULTS
    overflowed: Array
    stopped: Array
    interpolation: diffrax.DenseInterpolation | None = None
    method: str = eqx.field(static=True, default="")
    is_fixed: bool = eqx.field(static=True, default=False)

    @property
    def stats(self) -> dict[str, Any]:
        """The solver with the reason for its choice, and the counts."""
        return {"solver": self.method, **self.counts}

    @property
    def is_over(self) -> bool:
        """Whether the run ended before its final time or at an event (host)."""
        has_failed = bool(self.result != diffrax.RESULTS.successful)
        return has_failed or bool(self.overflowed | self.stopped)

    def at(self, t: ArrayLike) -> Float[Array, "V *S"]:
        """The state at any time up to ``t_end``, if the run was made with ``dense=True``.

        Explicit solvers interpolate between steps by cubics, implicit ones linearly. The values that boundary
        conditions prescribe are interpolated too.

        Raises:
            ValueError: the solution is not dense, or the time is outside the run.
        """
        if self.interpolation is None:
            raise ValueError("The solution is not dense. Call ltl.solve(..., dense=True, max_steps=...).")
        if not any(isinstance(x, Tracer) for x in (t, self.t_end)):
            begin, time, end = float(self.interpolation.t0), np.asarray(t), float(self.t_end)
            slack = 1e-6 * (end - begin)
            if not ((time >= begin - slack) & (time <= end + slack)).all():
                raise ValueError(f"Expected a time from {begin:g} to {end:g}, found {t}.")
        return self.interpolation.evaluate(jnp.asarray(t, self.us.dtype))

    def check(self, surface: Surface) -> None:
        """Raise `SolveError`, with causes and remedies, if the run did not reach its end."""
        time = float(self.t_end)
        if bool(self.overflowed):
            cause = _cause_of_overflow(surface)
            if self.is_fixed:
                cause = (
                    "The causes are (a) a dt that is too long for the solver to be stable or for its implicit stages "
                    "to be solved: take a shorter dt, or leave dt out for adaptive steps, which try shorter ones; or "
                    f"(b) the problem itself. {cause}"
                )
            raise SolveError(f"The state overflowed at t = {time:.4g}. {cause}", time, self)
        if self.result != diffrax.RESULTS.successful and self.result != diffrax.RESULTS.event_occurred:
            raise SolveError(
                f"The run stopped at t = {time:.4g}: {diffrax.RESULTS[self.result]} The causes are (a) a state about "
                "to overflow, which forces ever smaller steps, (b) max_steps too small for the stiffness of the mesh, "
                "or (c) tolerances beyond the floating-point type. Raise max_steps or rtol, use float64, or check the "
                "reaction.",
                time,
                self,
            )


def _cause_of_overflow(surface: Surface) -> str:
    if isinstance(surface.scheme, Polynomial):
        return "Polynomial() has growing modes on bad meshes: use ltl.Monotone() for time stepping."
    if isinstance(surface.scheme, Paper):
        return "The published operator (scheme Paper) has growing modes on such meshes: use ltl.Monotone()."
    return (
        "Diffusion cannot grow with this scheme, so the cause is (a) a reaction or source that grows without bound, or "
        "(b) an initial state far outside the range for which the reaction is meant. Check the rates and the initial "
        "state; if an implicit solver fails to solve its stages, use ltl.RKL2()."
    )
