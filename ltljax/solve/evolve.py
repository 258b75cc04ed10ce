"""`solve`: an equation, a surface and an initial state become a trajectory. The door to diffrax."""

import warnings
from collections.abc import Sequence
from typing import Any, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from ..equations import Equation
from ..lifting.schemes import Paper, Polynomial
from ..operators import growth_rate, spectral_bound
from ..surface import Surface
from ..tables import AnyArray
from .chebyshev import RKC2

# A state that grows this much over its start (or over one) is on its way to overflow.
_OVERFLOW = 1e6
# Eigenvalues with a real part below this share of the largest magnitude count as rounding.
_GROWTH = 1e-8


class SolveError(RuntimeError):
    """A run that could not be carried to its end.

    Attributes:
        time: the time reached.
        solution: what was computed until then.
    """

    def __init__(self, message: str, time: float, solution: "Solution"):
        super().__init__(message)
        self.time = time
        self.solution = solution


class GrowingModesWarning(UserWarning):
    """The Laplacian of a surface has eigenvalues with positive real part, so that diffusion can grow."""


class Solution(eqx.Module):
    """A trajectory.

    Attributes:
        ts: (T,) the times asked for; infinite where the run stopped before them.
        us: (T, V) or (T, V, S) the states at these times.
        t_end: the time reached.
        u_end: the state there.
        stats: numbers of steps and, with `RKC2`, of evaluations of the rate.
        result: `diffrax.RESULTS`; an overflow is not a failure of the solver and shows in ``overflowed`` instead.
        overflowed: whether the state became NaN, infinite, or a million times its start.
    """

    ts: Float[Array, " T"]
    us: Float[Array, "T V *S"]
    t_end: Float[Array, ""]
    u_end: Float[Array, "V *S"]
    stats: dict[str, Array]
    result: diffrax.RESULTS
    overflowed: Array

    def check(self, surface: Surface) -> None:
        """Raise `SolveError`, with causes and cures, where the run did not reach its end."""
        time = float(self.t_end)
        if bool(self.overflowed):
            raise SolveError(f"The state overflowed at t = {time:.4g}. {_cause_of_overflow(surface)}", time, self)
        if self.result != diffrax.RESULTS.successful and self.result != diffrax.RESULTS.event_occurred:
            raise SolveError(
                f"The run stopped at t = {time:.4g}: {diffrax.RESULTS[self.result]} Causes are (a) a state about to "
                "overflow, which forces ever smaller steps, (b) max_steps too small for the stiffness of the mesh, or "
                "(c) tolerances beyond the float type. Raise max_steps or rtol, use float64, or check the reaction.",
                time,
                self,
            )


def solve(
    equation: Equation,
    surface: Surface,
    u0: Float[AnyArray, "V *S"],
    t1: ArrayLike,
    ts: ArrayLike | Sequence[float] | None = None,
    solver: diffrax.AbstractSolver | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    progress: bool | diffrax.AbstractProgressMeter = False,
    *,
    t0: ArrayLike = 0.0,
    rtol: float = 1e-4,
    atol: float = 1e-6,
    max_steps: int | None = 1_000_000,
    throw: bool = True,
) -> Solution:
    """The solution of an evolution equation at given times.

    Steps are adaptive; the error is measured in a root-mean-square norm over vertices and species, which does not
    depend on the size of the mesh. The default solver is `RKC2` for ``Monotone`` surfaces, whose diffusion has
    eigenvalues near the negative real axis and a cheap bound of them, and `diffrax.Tsit5` for ``Paper`` ones, of which
    neither is true.

    Args:
        equation: what is solved, such as `Diffusion` or `ReactionDiffusion`.
        surface: where.
        u0: the state at t0, (V,) or (V, S); taken in the float type of the surface.
        t1: the last time.
        ts: the times at which to keep the state, ascending; by default t1 alone.
        solver: a diffrax solver.
        adjoint: how reverse-mode derivatives go through time; by default diffrax's recursive checkpointing.
        progress: True for a progress bar, or a diffrax progress meter.
        t0: the first time.
        rtol: relative tolerance of a step.
        atol: absolute tolerance of a step.
        max_steps: steps after which the run counts as failed; None for no limit, which reverse-mode derivatives refuse.
        throw: whether to raise when the run does not reach t1. Inside jit nothing can be raised: read
            ``solution.result`` and ``solution.overflowed`` there.

    Returns:
        The `Solution`.

    Raises:
        SolveError: the state overflowed, or the solver failed before t1.
        ValueError: the state does not fit the surface.

    Warns:
        GrowingModesWarning: of a ``Polynomial`` surface, whose Laplacian has growing modes. The spectrum is looked at
            once for each surface, and not inside jit.
    """
    u0 = jnp.asarray(u0, surface.dtype)
    if u0.ndim not in (1, 2) or u0.shape[0] != surface.num_vertices:
        raise ValueError(
            f"Expected an initial state of shape ({surface.num_vertices},) or ({surface.num_vertices}, S), "
            f"found {u0.shape}."
        )
    if isinstance(surface.scheme, Polynomial) and not surface.is_traced:
        _warn_of_growth(surface)
    # Time in the state's own float type: diffrax multiplies the two.
    time = surface.dtype
    ts = jnp.asarray([t1] if ts is None else ts, time)
    solution = _solve(
        equation, surface, u0, jnp.asarray(t0, time), jnp.asarray(t1, time), ts,
        default_solver(surface) if solver is None else solver,
        diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint,
        _meter(progress), rtol, atol, max_steps,
    )  # fmt: skip
    if throw and not isinstance(solution.t_end, Tracer):
        solution.check(surface)
    return solution


def default_solver(surface: Surface) -> diffrax.AbstractSolver:
    """The solver `solve` takes by itself."""
    return diffrax.Tsit5() if isinstance(surface.scheme, Paper) else RKC2(_bound)


def _warn_of_growth(surface: Surface) -> None:
    growth = surface.remembered("growth", lambda: growth_rate(surface))
    if growth > _GROWTH * float(spectral_bound(surface)):
        warnings.warn(
            f"Modes of this Laplacian grow like exp({growth:.3g} t) under diffusion. {surface.scheme} is made for "
            "stationary problems and good meshes: use ltl.Monotone() for time stepping, or a better mesh.",
            GrowingModesWarning,
            stacklevel=3,
        )


def _rate(t, u, args):
    equation, surface = args
    return equation.rate(t, surface, u)


def _bound(t, u, args):
    equation, surface = args
    return equation.spectral_bound(t, surface, u)


def _meter(progress: bool | diffrax.AbstractProgressMeter) -> diffrax.AbstractProgressMeter:
    if isinstance(progress, diffrax.AbstractProgressMeter):
        return progress
    if not progress:
        return diffrax.NoProgressMeter()
    try:
        return diffrax.TqdmProgressMeter()
    except (ImportError, ValueError):  # tqdm belongs to the extra `app`
        return diffrax.TextProgressMeter()


@eqx.filter_jit
def _solve(equation, surface, u0, t0, t1, ts, solver, adjoint, meter, rtol, atol, max_steps) -> Solution:
    u0 = equation.held(t0, surface, u0)
    largest = _OVERFLOW * jnp.maximum(1, jnp.max(jnp.abs(u0)))

    # Not "is too large": a NaN compares false with everything.
    def has_overflowed(t, y, args, **_):
        del t, args
        return ~(jnp.max(jnp.abs(y)) <= largest)

    bound = equation.spectral_bound(t0, surface, u0)
    # A first step that an explicit method takes safely; the controller finds the right one within a few steps.
    dt0 = jnp.minimum(1 / jnp.maximum(bound, jnp.finfo(bound.dtype).tiny), t1 - t0)
    keeps_state = isinstance(solver, RKC2)
    out = diffrax.diffeqsolve(
        diffrax.ODETerm(_rate),
        solver,
        t0,
        t1,
        dt0,
        u0,
        (equation, surface),
        saveat=diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=ts), diffrax.SubSaveAt(t1=True)], solver_state=keeps_state),
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=atol),
        adjoint=adjoint,
        event=diffrax.Event(has_overflowed),
        max_steps=max_steps,
        throw=False,
        progress_meter=meter,
    )
    (ts, t_end), (us, u_end) = cast(Any, out.ts), cast(Any, out.ys)
    # The integrated rate of a held value ends near the value; what is handed out is the value.
    us = jax.vmap(lambda t, u: equation.held(t, surface, u))(ts, us)
    u_end = jax.vmap(lambda t, u: equation.held(t, surface, u))(t_end, u_end)
    stats = {name: out.stats[name] for name in ("num_steps", "num_accepted_steps", "num_rejected_steps")}
    if keeps_state:
        stats["num_evaluations"] = cast(Any, out.solver_state)[1]
    return Solution(ts, us, t_end[0], u_end[0], stats, out.result, cast(Array, out.event_mask))


def _cause_of_overflow(surface: Surface) -> str:
    if isinstance(surface.scheme, Polynomial):
        return "Polynomial() has growing modes on bad meshes: use ltl.Monotone() for time stepping."
    if isinstance(surface.scheme, Paper):
        return "The published operator (scheme paper) has growing modes on such meshes: use ltl.Monotone()."
    return (
        "Diffusion cannot grow with this scheme, so the cause is (a) a reaction or source that grows without bound, or "
        "(b) an initial state that is not finite or far from where the reaction makes sense. Check the rates and the "
        "initial state."
    )
