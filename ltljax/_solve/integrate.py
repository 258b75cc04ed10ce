"""Carrying a run from its initial to its final time: by diffrax, or by taped steps.

What enters: a `Run`. What leaves: a `Solution`, differentiable in the equation, the surface and the initial state.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._equations import Equation
from .._surface import Surface
from .._tables import AnyArray
from . import taped
from .implicit import ImplicitRungeKutta
from .solution import Condition, Solution
from .stepping import controller_of, first_step

# A state overflows beyond this fraction of the largest floating-point number.
_OVERFLOW = 1e-6

# With a scheme that may have growing modes, a state overflows when it exceeds this many times its initial size, or the
# change that the rate at u0 would cause over the whole run, whichever is larger.
_GROWTH = 1e6
# Fractions of the run at which the rate at u0 is evaluated to estimate that change.
_SOURCE_TIMES = (0.0, 0.382, 1.0)

# Bytes that the checkpoints of diffrax may take.
_CHECKPOINT_BYTES = 2**30
_FEWEST_CHECKPOINTS = 32


class Run(eqx.Module):
    """Everything that a run needs. Arrays are traced; all else is static.

    Attributes:
        equation: the equation.
        surface: the surface.
        u0: initial state.
        t0: initial time.
        t1: final time.
        ts: (T,) requested times.
        grid: (n + 1,) times between which fixed steps are taken; None for adaptive steps.
        solver: the solver.
        adjoint: how derivatives go through time; unused by taped fixed steps.
        rtol: relative tolerance of a step.
        atol: absolute tolerance of a step, or None for one relative to the size of each species.
        max_steps: number of steps after which the run fails, or None for no limit.
        stop_when: ``(t, u, rate) -> bool``, or None.
        meter: progress meter.
        dense: whether every step is kept for interpolation.
        is_taped: whether the reverse pass uses a tape (see `taped`).
    """

    equation: Equation
    surface: Surface
    u0: Array
    t0: Array
    t1: Array
    ts: AnyArray
    grid: np.ndarray | None
    solver: Any
    adjoint: diffrax.AbstractAdjoint | None
    rtol: Array
    atol: Array | None
    max_steps: int | None
    stop_when: Condition | None
    meter: diffrax.AbstractProgressMeter
    dense: bool
    is_taped: bool


class _Dynamics(NamedTuple):
    """What diffrax integrates.

    Attributes:
        rate: ``(t, u, args) -> du/dt``.
        args: the arguments of ``rate``, ``stop_when`` and the solver.
        largest: magnitude beyond which a state has overflowed.
        stop_when: ``(t, u, args) -> bool``, or None.
    """

    rate: Callable[[Any, Any, Any], Array]
    args: Any
    largest: Array
    stop_when: Callable[[Array, Array, Any], Array] | None


class _Steps(NamedTuple):
    """How diffrax takes its steps: its arguments of these names, and whether the times of all steps are recorded."""

    solver: diffrax.AbstractSolver
    adjoint: diffrax.AbstractAdjoint
    controller: diffrax.AbstractStepSizeController
    dt0: Array | None
    max_steps: int | None
    meter: diffrax.AbstractProgressMeter = diffrax.NoProgressMeter()
    dense: bool = False
    is_recorded: bool = False


class _AdaptiveSettings(NamedTuple):
    """The parts of a `Run` that choose adaptive steps, and ``size``, which gives the magnitude of each species."""

    t0: Array
    t1: Array
    ts: Array
    rtol: Array
    atol: Array | None
    adjoint: diffrax.AbstractAdjoint
    max_steps: int | None
    size: Callable[[Array], Array]


class _Outcome(NamedTuple):
    """How a run of diffrax ended, in the order of the fields of `Solution`."""

    counts: dict[str, Array]
    result: diffrax.RESULTS
    overflowed: Array
    stopped: Array


def integrate(run: Run) -> Solution:
    """The solution of a run."""
    if not run.is_taped:
        return _by_diffrax(run)
    if run.grid is None:
        return _by_taped_adaptive_steps(run)
    spacing = taped.spacing_of(len(run.grid) - 1, run.u0)
    marks, reverse_marks = (taped.marks_of(run.grid, np.asarray(run.ts), n) for n in (len(run.grid), spacing))
    # Taped fixed steps use neither field; None avoids a recompilation when they change.
    run = dataclasses.replace(run, adjoint=None, max_steps=None)
    return _by_taped_fixed_steps(run, marks, reverse_marks)


def checkpoints_for(grid: np.ndarray | None, max_steps: int | None, u0: Array) -> diffrax.AbstractAdjoint:
    """Recursive checkpointing with one checkpoint per step while that takes little memory.

    Otherwise the number of checkpoints is the square root of the number of steps.
    """
    steps = max_steps if grid is None else len(grid) - 1
    if steps is None:
        return diffrax.RecursiveCheckpointAdjoint()
    affordable = max(_FEWEST_CHECKPOINTS, _CHECKPOINT_BYTES // (2 * u0.nbytes))  # a state and its rate
    number = steps if grid is not None and steps <= affordable else math.isqrt(2 * steps) + 1
    return diffrax.RecursiveCheckpointAdjoint(checkpoints=max(1, min(number, affordable)))


def _rate(t, u, args):
    equation, surface = args
    return equation.rate(t, surface, u)


@eqx.filter_jit
def _by_diffrax(run: Run) -> Solution:
    equation, surface, t0, t1, solver = run.equation, run.surface, run.t0, run.t1, run.solver
    u0 = equation.held(t0, surface, run.u0)
    largest = _largest(surface, u0, lambda t, u: equation.rate(t, surface, u), t0, t1 - t0)

    def stop(t, u, args):
        return _checked(cast(Condition, run.stop_when))(t, u, _rate(t, u, args))

    max_steps = run.max_steps
    if run.grid is not None:
        controller, dt0 = diffrax.StepTo(ts=run.grid), None
        # A smaller max_steps makes diffrax allocate fewer checkpoints.
        max_steps = min(len(run.grid) - 1, max_steps) if max_steps is not None else len(run.grid) - 1
    elif not isinstance(solver, diffrax.AbstractAdaptiveSolver):  # a run of zero length has no steps
        controller, dt0 = diffrax.ConstantStepSize(), jnp.ones_like(t1)
    else:
        controller = controller_of(run.rtol, run.atol, solver, equation.size)
        dt0 = first_step(equation.spectral_bound(t0, surface, u0), t0, t1)
        if isinstance(solver, ImplicitRungeKutta):  # its interpolation is only linear
            controller = diffrax.ClipStepSizeController(controller, step_ts=run.ts)
    dynamics = _Dynamics(_rate, (equation, surface), largest, None if run.stop_when is None else stop)
    steps = _Steps(solver, cast(Any, run.adjoint), controller, dt0, max_steps, run.meter, run.dense)
    out = _diffeqsolve(dynamics, steps, u0, t0, t1, run.ts)
    (ts, t_end), (us, u_end) = cast(Any, out.ts), cast(Any, out.ys)
    solution = Solution(ts, us, t_end[0], u_end[0], *_outcome(out), out.interpolation, is_fixed=run.grid is not None)
    return _as_prescribed(equation, surface, solution)


@eqx.filter_jit
def _by_taped_fixed_steps(run: Run, marks: taped.Marks, reverse_marks: taped.Marks) -> Solution:
    grid = cast(Any, run.grid)
    start, rules = _start_and_rules(run, grid[0], grid[-1] - grid[0])
    fixed = taped.run_fixed(start, rules, grid, marks, reverse_marks)
    counts = dict(
        num_steps=fixed.num_steps,
        num_accepted_steps=fixed.num_steps,
        num_rejected_steps=jnp.zeros_like(fixed.num_steps),
        num_evaluations=fixed.num_evaluations,
    )
    has_ended = cast(Array, fixed.overflowed | fixed.stopped)
    result = diffrax.RESULTS.where(has_ended, diffrax.RESULTS.event_occurred, diffrax.RESULTS.successful)
    ts, t_end = jnp.where(fixed.is_reached, run.ts, jnp.inf), grid[fixed.num_steps]
    outcome = _Outcome(counts, result, fixed.overflowed, fixed.stopped)
    return _as_prescribed(
        run.equation, run.surface, Solution(ts, fixed.us, t_end, fixed.u_end, *outcome, is_fixed=True)
    )


@eqx.filter_jit
def _by_taped_adaptive_steps(run: Run) -> Solution:
    start, rules = _start_and_rules(run, run.t0, run.t1 - run.t0)
    settings = _AdaptiveSettings(
        run.t0, run.t1, cast(Any, run.ts), run.rtol, run.atol, cast(Any, run.adjoint), run.max_steps, run.equation.size
    )
    record_times = eqx.Partial(_record_times, _without_derivative(settings))
    us, u_end, (ts, t_end, outcome) = taped.run_adaptive(start, rules, record_times, settings.ts)
    return _as_prescribed(run.equation, run.surface, Solution(ts, us, t_end, u_end, *outcome))


def _record_times(settings: _AdaptiveSettings, start: tuple[Array, Any], rules: taped.Rules, is_recorded: bool) -> Any:
    """An adaptive run by diffrax, as `taped.run_adaptive` asks for it."""
    (u0, rate), (solver, extent, largest, condition) = start, rules
    solver = dataclasses.replace(
        solver,
        spectral_bound=lambda t, u, _: extent(t, u)[0],
        spectral_width=lambda t, u, _: extent(t, u)[1],
    )
    stop = None if condition is None else lambda t, u, _: condition(t, u, rate(t, u))
    controller = controller_of(settings.rtol, settings.atol, solver, settings.size)
    dt0 = first_step(extent(settings.t0, u0)[0], settings.t0, settings.t1)
    steps = _Steps(solver, settings.adjoint, controller, dt0, settings.max_steps, is_recorded=is_recorded)
    dynamics = _Dynamics(lambda t, u, _: rate(t, u), None, largest, stop)
    out = _diffeqsolve(dynamics, steps, u0, settings.t0, settings.t1, settings.ts)
    times = jnp.concatenate([settings.t0[None], cast(Any, out.ts)[2]]) if is_recorded else None
    (us, u_end, *_), (ts, t_end, *_) = cast(Any, out.ys), cast(Any, out.ts)
    return (us, u_end[0], (ts, t_end[0], _outcome(out))), times


def _start_and_rules(run: Run, t0: Array, span: Array) -> tuple[tuple[Array, Any], taped.Rules]:
    """The differentiated parts of a run (initial state and rate), and the others as `taped.Rules`."""
    args = run.equation, run.surface
    u0 = run.equation.held(t0, run.surface, run.u0)
    # diffrax broadcasts the rate to the state and converts it to its dtype; so do taped steps.
    term = diffrax.ODETerm(_rate)
    # A closure-converted function has the values it closes over among its leaves, where derivatives see them.
    rate = eqx.filter_closure_convert(lambda t, u: term.vf(t, u, args), t0, u0)
    extent = eqx.filter_closure_convert(lambda t, u: run.solver.extent(t, u, args), t0, u0)
    condition = None
    if run.stop_when is not None:
        condition = eqx.filter_closure_convert(_checked(run.stop_when), t0, u0, u0)
    rules = taped.Rules(run.solver, extent, _largest(run.surface, u0, rate, t0, span), condition)
    return (u0, rate), _without_derivative(rules)


def _checked(stop_when: Condition) -> Condition:
    """The condition, which raises an error if it does not return one truth value."""

    def condition(t, u, rate):
        holds = jnp.asarray(stop_when(t, u, rate))
        if holds.shape != () or holds.dtype != bool:
            raise ValueError(
                f"Expected stop_when to return one truth value, found an array of shape {holds.shape} and type "
                f"{holds.dtype}. Compare, and take jnp.all or jnp.any."
            )
        return holds

    return condition


def _without_derivative(tree: Any) -> Any:
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)


def _largest(surface: Surface, u0: Array, rate: Callable[[Array, Array], Array], t0: Array, span: Array) -> Array:
    """The magnitude beyond which a state of the run has overflowed."""
    # Beyond this size the rate, which is larger than the state by up to the stiffness, could overflow.
    largest = jnp.asarray(_OVERFLOW * jnp.finfo(u0.dtype).max, u0.dtype)
    if surface.scheme.is_monotone:
        return largest
    # Growing modes would approach that limit in ever shorter steps. So the run also ends when the state exceeds
    # `_GROWTH` times the larger of its initial size and the change that the rate at u0 would cause over the whole run.
    # The rate is evaluated at several times, because a source may set in late.
    changes = [jnp.max(jnp.abs(rate(t0 + fraction * span, u0) * span)) for fraction in _SOURCE_TIMES]
    size = jnp.max(jnp.stack([jnp.max(jnp.abs(u0)), *changes]))
    return jnp.where(size > 0, jnp.minimum(largest, _GROWTH * size), largest)


def _as_prescribed(equation: Equation, surface: Surface, solution: Solution) -> Solution:
    """The solution with the values that boundary conditions prescribe, which integration reaches only approximately."""
    us = jax.vmap(lambda t, u: equation.held(t, surface, u))(solution.ts, solution.us)
    us = jnp.where(jnp.isfinite(solution.ts).reshape(-1, *(1,) * solution.u_end.ndim), us, jnp.nan)
    u_end = equation.held(solution.t_end, surface, solution.u_end)
    return dataclasses.replace(solution, us=us, u_end=u_end)


def _diffeqsolve(dynamics: _Dynamics, steps: _Steps, u0: Array, t0: Array, t1: Array, ts: AnyArray) -> diffrax.Solution:
    """diffrax's solution with the states at ``ts`` and at the end, and the times of all steps if they are recorded."""

    # Negated, because every comparison with NaN is false.
    def has_overflowed(t, y, args, **_):
        del t, args
        return ~(jnp.max(jnp.abs(y)) <= dynamics.largest)

    events = {"overflowed": has_overflowed}
    if dynamics.stop_when is not None:
        stop_when = dynamics.stop_when
        events["stopped"] = lambda t, y, args, **_: stop_when(t, y, args)
    saved = [diffrax.SubSaveAt(ts=cast(Any, ts)), diffrax.SubSaveAt(t1=True)]
    if steps.is_recorded:
        saved.append(diffrax.SubSaveAt(steps=True, fn=lambda t, y, args: t))
    # Stabilised solvers count their evaluations in their state.
    counts_evaluations = hasattr(steps.solver, "spectral_bound")
    return diffrax.diffeqsolve(
        diffrax.ODETerm(dynamics.rate),
        steps.solver,
        t0,
        t1,
        steps.dt0,
        u0,
        dynamics.args,
        saveat=diffrax.SaveAt(subs=saved, solver_state=counts_evaluations, dense=steps.dense),
        stepsize_controller=steps.controller,
        adjoint=steps.adjoint,
        event=diffrax.Event(events),
        max_steps=steps.max_steps,
        throw=False,
        progress_meter=steps.meter,
    )


def _outcome(out: diffrax.Solution) -> _Outcome:
    counts = {name: out.stats[name] for name in ("num_steps", "num_accepted_steps", "num_rejected_steps")}
    if out.solver_state is not None:
        counts["num_evaluations"] = cast(Any, out.solver_state)[1]
    events = cast(dict[str, Array], out.event_mask)
    stopped = events.get("stopped", jnp.array(False))
    overflowed = events["overflowed"] | (out.result == diffrax.RESULTS.dt_min_reached)
    return _Outcome(counts, out.result, overflowed, stopped)
