"""`solve`: an equation, a surface and an initial state become a trajectory. The door to diffrax."""

import dataclasses
import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

from .._base.arguments import as_numbers
from .._base.folder import Folder
from .._equations import Equation, boundary as bounds
from .._lifting.schemes import Monotone, Paper, Polynomial
from .._operators import growth_rate, spectral_bound, spectral_width
from .._surface import Surface, on_surface
from .._tables import AnyArray
from . import checks, taped
from .fingerprint import fingerprint
from .implicit import SBDF2, SHARE, TRBDF2, ImplicitRungeKutta, Preconditioning, without_matrices
from .krylov import rms
from .multigrid import Multigrid, is_available, multigrid
from .restart import Keeper, RestartError, in_intervals
from .stabilised import RKL2, Stabilised, differentiable
from .steps import Advancing, TextMeter, without_twins

# Eigenvalues with a real part below this share of the largest magnitude count as rounding.
_GROWTH = 1e-8

# A state overflows beyond this share of the largest number.
_ALMOST_ALL = 1e-6

# With a scheme that has growing modes a state that is this many times its start, or what the first rate would make of
# it, is on its way to overflow.
_GROWN = 1e6
# At these shares of a run its source is looked at for that.
_SHARES = (0.0, 0.382, 1.0)

# Linear runs are quicker with implicit steps where they are this many times as long as the fastest decay, over the cube
# root of the tolerance: explicit steps are as long as stability allows, implicit ones as the tolerance does. See
# benchmarks/time_to_accuracy.md. With a reaction they can be slower by a hundred times, where it is stiff itself.
_STIFF = 2e3

# Bytes that diffrax's checkpoints of a reverse pass may take: with one for every step none is taken a third time.
_CHECKPOINTED = 2**30
_FEWEST_CHECKPOINTS = 32

# Intervals of a run that is kept on disk.
_INTERVALS = 20
# Fixed steps of more parts in all than this are a mistake.
_MOST_STEPS = 10_000_000

Condition = Callable[[Array, Array, Array], Bool[Array, ""]]


class SolveError(RuntimeError):
    """A run that could not be carried to its end, or a system that could not be solved.

    Attributes:
        time: the time reached, of a run.
        solution: what was computed until then.
    """

    def __init__(self, message: str, time: float = float("nan"), solution: "Solution | None" = None):
        super().__init__(message)
        self.time = time
        self.solution = solution


class GrowingModesWarning(UserWarning):
    """The Laplacian of a surface has eigenvalues with positive real part, so that diffusion can grow."""


class Steady(eqx.Module):
    """A condition to stop at: the root mean square of the rate is at most ``tolerance`` times that of the state.

    Attributes:
        tolerance: per unit of time.
    """

    tolerance: float = 1e-6

    def __call__(self, t, u, rate) -> Bool[Array, ""]:
        """Whether the state is steady."""
        del t
        return rms(rate) <= self.tolerance * rms(u)


class Solution(eqx.Module):
    """A trajectory.

    Attributes:
        ts: (T,) the times asked for; infinite where the run stopped before them.
        us: (T, V) or (T, V, S) the states at these times; NaN where the run stopped before them.
        t_end: the time reached.
        u_end: the state there, also of a run that ``stop_when`` ended.
        counts: numbers of steps and, with `RKL2` and `RKL1`, of evaluations of the rate.
        result: `diffrax.RESULTS`; an overflow is not a failure of the solver and shows in ``overflowed`` instead.
        overflowed: whether the state became NaN, larger than a millionth of the largest number (with other schemes than
            `Monotone`, a million times its start), or so fast that time no longer resolved its changes; or whether a
            fixed step came out as nonsense.
        stopped: whether ``stop_when`` held.
        interpolation: of a dense solution, from which `at` reads.
        method: the solver, and why it was taken.
        is_fixed: whether steps were of fixed length.
    """

    ts: Float[Array, " T"]
    us: Float[Array, "T V *S"]
    t_end: Float[Array, ""]
    u_end: Float[Array, "V *S"]
    counts: dict[str, Array]
    result: diffrax.RESULTS
    overflowed: Array
    stopped: Array
    interpolation: diffrax.DenseInterpolation | None
    method: str = eqx.field(static=True)
    is_fixed: bool = eqx.field(static=True)

    @property
    def stats(self) -> dict[str, Any]:
        """The solver and why it was taken, and the counts."""
        return {"solver": self.method, **self.counts}

    def at(self, t: ArrayLike) -> Float[Array, "V *S"]:
        """The state at a time up to ``t_end``, of a solution made with ``dense=True``.

        Between steps it is interpolated, by cubics after explicit steps and linearly after implicit ones; values that
        conditions hold are then those of the interpolation.
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
        """Raise `SolveError`, with causes and cures, where the run did not reach its end."""
        time = float(self.t_end)
        if bool(self.overflowed):
            if self.is_fixed:
                raise SolveError(
                    f"The state overflowed at t = {time:.4g}, or the step there could not be made. Causes are (a) a dt "
                    "beyond what the solver is stable for, or with which an implicit stage cannot be solved: take a "
                    "shorter dt, or leave dt out for adaptive steps, which try shorter ones; or (b) what is solved. "
                    f"{_cause_of_overflow(surface)}",
                    time,
                    self,
                )
            raise SolveError(f"The state overflowed at t = {time:.4g}. {_cause_of_overflow(surface)}", time, self)
        if self.result != diffrax.RESULTS.successful and self.result != diffrax.RESULTS.event_occurred:
            raise SolveError(
                f"The run stopped at t = {time:.4g}: {diffrax.RESULTS[self.result]} Causes are (a) a state about to "
                "overflow, which forces ever smaller steps, (b) max_steps too small for the stiffness of the mesh, or "
                "(c) tolerances beyond the float type. Raise max_steps or rtol, use float64, or check the reaction.",
                time,
                self,
            )


@on_surface
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
    dt: float | None = None,
    rtol: float = 1e-4,
    atol: float | None = None,
    max_steps: int | None = 1_000_000,
    stop_when: Condition | None = None,
    dense: bool = False,
    preconditioner: Multigrid | None = None,
    checkpoint_dir: str | Path | None = None,
    checkpoint_every: float | None = None,
    resume: bool = False,
    run_id: str | None = None,
    throw: bool = True,
) -> Solution:
    """The solution of an evolution equation at given times.

    Steps are adaptive unless ``dt`` is given; the error is measured in a root-mean-square norm over vertices and
    species, which does not depend on the size of the mesh. The default solver is `RKL2`, whose cost grows with the
    square root of the stiffness; for linear equations and runs 4e4 times as long as the fastest decay (with other
    tolerances than the default in proportion to ``rtol ** (-1 / 3)``) `TRBDF2`, where the extra `amg` is at hand and
    the stiffness is known (not inside jit, grad or vmap); for ``Paper`` surfaces, whose
    eigenvalues are off the real axis, `diffrax.Tsit5`. ``solution.stats`` says which it was and why.

    Solvers: any explicit one of diffrax; `RKL2` (second order) and `RKL1` (first, with the maximum principle),
    explicit and stabilised; `BackwardEuler`, `CrankNicolson`, `TRBDF2` and `diffrax.Kvaerno3`, `4`, `5`, implicit;
    `diffrax.KenCarp3`, `4`, `5`, `diffrax.Sil3` and `SBDF2` (fixed steps), diffusion implicit and the reaction
    explicit. Implicit stages are solved by Krylov iteration, preconditioned by multigrid with the extra `amg` and by
    Jacobi's method without; no matrix of the size of the state is formed, in derivatives neither.

    Args:
        equation: what is solved, such as `Diffusion` or `ReactionDiffusion`.
        surface: where.
        u0: the state at t0, (V,) or (V, S); taken in the float type of the surface.
        t1: the last time.
        ts: the times at which to keep the state, ascending; by default t1 alone.
        solver: a solver.
        adjoint: how derivatives go through time; by default in reverse mode, for `RKL2` and `RKL1` at the cost of three
            to five runs, more with steps of more than 36 stages. Of n fixed steps some ``12 sqrt(n)`` states are then
            kept, of adaptive ones 512; of large states what a gigabyte holds (all of it for each run of a batch). The
            lengths of adaptive steps count as given: the derivative is right to the error of the steps, and Taylor's
            test (`check_gradient`) shows slope 1, with ``dt`` slope 2. For other solvers, for dense solutions, with
            ``progress``, for times that are traced, and where a gigabyte is too little, it is diffrax's recursive
            checkpointing: fixed steps are all kept while that takes less than a gigabyte, otherwise the memory is that
            of ``sqrt(2 max_steps)`` states and their rates, or of a gigabyte, and the cost 5 to 10 runs.
            `diffrax.ForwardMode()` for few parameters.
        progress: True for a progress bar, or a diffrax progress meter.
        t0: the first time.
        dt: the length of steps, for fixed ones; the last before each of ``ts`` may be shorter. A step of `RKL2` or
            `RKL1` that is too long even for the largest number of stages is split into equal parts that are stable at
            the initial state; ``solution.stats`` says how many. Inside jit, where that is not known, the run ends with
            NaN.
        rtol: relative tolerance of a step; implicit stages are solved to a hundredth of it.
        atol: absolute tolerance of a step; by default a hundredth of ``rtol`` times the largest that each species has
            been in the run so far, so that a change of its unit changes nothing else.
        max_steps: steps after which the run counts as failed; None for no limit, which reverse-mode derivatives refuse.
        stop_when: ``(t, u, rate) -> bool``; the run ends with the first step after which it holds: `Steady`, or your
            own.
        dense: whether to keep every step, so that ``solution.at(t)`` gives the state at any time. Takes the memory of
            ``max_steps`` states. Explicit solvers interpolate by cubics, implicit ones linearly.
        preconditioner: what `multigrid` returned for this surface or a similar one, where it is not to be set up anew:
            for surfaces that are being traced.
        checkpoint_dir: a folder in which to keep the state as the run goes: the last ones, and those at ``ts``. The run
            is then made of intervals that each begin with a first step, and a run that is killed loses at most the
            last of them. Not inside jit.
        checkpoint_every: the length of these intervals in time, which also end at ``ts``; by default a twentieth of the
            run.
        resume: whether to go on from what ``checkpoint_dir`` holds of the same call; the result is the same as that of
            a run that was not interrupted. Two calls are the same when all arrays and options are, and the functions
            in ``equation``, ``solver`` and ``stop_when`` have the same source. Values that such a function reads from
            its module are not compared, nor are the methods of a class.
        run_id: a name that stands for the equation, solver and ``stop_when`` when runs are compared. Use it where the
            source of a function is not available, or changes without changing what it does.
        throw: whether to raise when the run does not reach t1. Inside jit nothing can be raised: read
            ``solution.result`` and ``solution.overflowed`` there.

    Returns:
        The `Solution`.

    Raises:
        SolveError: the state overflowed, or the solver failed before t1.
        ValueError: the state does not fit the surface, something is not finite, a diffusivity is negative anywhere,
            times are not in order, tolerances are not positive, dt is beyond the stability of an explicit solver, or
            solver and dt do not go together.
        RestartError: ``checkpoint_dir`` holds the files of another run, or of one that has not ended and was not to be
            resumed; or this run cannot be told from others without a ``run_id``.
        OutputError: another run is writing to ``checkpoint_dir``, or files that ltljax has not written have the names
            of its own there.

    Warns:
        GrowingModesWarning: of a ``Polynomial`` surface, whose Laplacian has growing modes. The spectrum is looked at
            once for each surface, and not inside jit.
    """
    checks.kinds(equation, solver, adjoint, max_steps, stop_when)
    u0 = checks.field(surface, u0, "u0")
    if checkpoint_dir is None and (resume or checkpoint_every is not None):
        given = "resume=True" if resume else f"checkpoint_every={checkpoint_every}"
        raise ValueError(f"{given} needs the folder that the run is kept in: give checkpoint_dir.")
    # In NumPy where they are known, which inside jit they would not be as JAX's arrays.
    for name, time in (("t0", t0), ("t1", t1), *((("dt", dt),) if dt is not None else ())):
        checks.one_number(name, time)
    if ts is not None:
        as_numbers("ts", ts)
    times = [t1] if ts is None else ts
    is_known = not any(isinstance(time, Tracer) for time in jax.tree.leaves(times))
    times = (np if is_known else jnp).asarray(times, surface.dtype)
    checks.times(t0, t1, times, dt)
    checks.tolerances(rtol, atol)
    checks.finite(equation, u0)
    if isinstance(surface.scheme, Polynomial) and not surface.is_traced:
        _warn_of_growth(surface)
    if preconditioner is not None and not isinstance(preconditioner, Multigrid):
        raise TypeError(
            f"Expected as preconditioner what ltl.solvers.multigrid(surface) returned, found {type(preconditioner).__name__}."
        )
    # As arrays, so that other tolerances need no compiling.
    relative = jnp.asarray(rtol, surface.dtype)
    absolute = None if atol is None else jnp.asarray(atol, surface.dtype)
    if solver is None:
        method, why = _choice(equation, surface, u0, t0, t1, rtol, dense)
    else:
        method, why = without_matrices(solver), "chosen by the caller"
    if isinstance(method, SBDF2) and dt is None:
        raise ValueError("SBDF2 takes fixed steps: give their length as dt, or use diffrax.KenCarp3().")
    parts = 1
    if isinstance(method, ImplicitRungeKutta | SBDF2):
        inverse = hierarchy(equation, surface, u0, t0) if preconditioner is None else preconditioner
        method = dataclasses.replace(method, preconditioning=Preconditioning(inverse, relative, absolute))
        why += f", stages preconditioned by {'Jacobi' if inverse is None else 'multigrid'}"
    elif dt is not None:
        parts = checks.parts_of_a_step(equation, surface, u0, t0, dt, method)
        if parts > 1:
            why += f", each step in {parts} parts, since a whole one is unstable even with the most stages"
    if not surface.is_traced and isinstance(method, Stabilised):
        surface = eqx.tree_at(
            lambda s: s.geometry.spectral_width, surface, spectral_width(surface), is_leaf=lambda leaf: leaf is None
        )
    name = f"{type(method if solver is None else solver).__name__}: {why}"
    grid = _grid(t0, t1, times, dt, parts)
    is_taped = (
        adjoint is None
        and max_steps is not None
        and (grid is None or len(grid) <= max_steps + 1)
        and isinstance(method, Stabilised)
        and taped.is_worth_it(None if grid is None else len(grid) - 1, u0)
        and method.loop_kind == "checkpointed"
        and not dense
        and not progress
        # In these it has no derivative.
        and not any(isinstance(time, Tracer) for time in (t0, t1, times))
    )
    adjoint = _checkpoints(grid, max_steps, u0) if adjoint is None else adjoint
    method = differentiable(method, adjoint)

    def advance(u, begin, end, times, grid):
        # Time in the state's own float type: diffrax multiplies the two.
        begin, end = jnp.asarray(begin, surface.dtype), jnp.asarray(end, surface.dtype)
        if is_taped and grid is not None:
            spacing = taped.spacing_of(len(grid) - 1, u)
            marks, finer = (taped.marks_of(grid, times, every) for every in (len(grid), spacing))
            found = _fixed(equation, surface, u, grid, times, method, stop_when, marks, finer)
        elif is_taped:
            found = _adaptive(
                equation, surface, u, begin, end, times, method, adjoint, relative, absolute, max_steps, stop_when
            )
        else:
            found = _solve(
                equation, surface, u, begin, end, times, method, adjoint, _meter(progress), relative, absolute, grid,
                max_steps, stop_when, dense,
            )  # fmt: skip
        # Said here: the numbers in it would have every run compiled anew.
        return dataclasses.replace(found, method=name)

    if checkpoint_every is not None and not checkpoint_every > 0:
        raise ValueError(f"Expected a positive length of intervals, found checkpoint_every = {checkpoint_every}.")
    if checkpoint_dir is None:
        solution = advance(u0, t0, t1, times, grid)
    else:
        if dense or any(isinstance(x, Tracer) for x in jax.tree.leaves((equation, surface, u0, t0, t1, times))):
            raise ValueError("A run that is kept on disk cannot be traced by a JAX transformation, nor be dense.")
        run = dict(
            mesh=fingerprint((surface.vertices, surface.centre, surface.faces, repr(surface.scheme))),
            equation=_fingerprint(equation, run_id),
            start=fingerprint((u0, float(t0))),  # type: ignore
            end=fingerprint((float(t1), times, dt, checkpoint_every)),  # type: ignore
            solver=_fingerprint((solver, stop_when), run_id),
            tolerances=fingerprint((type(method), "Jacobi" in why, rtol, atol)),
        )
        # As the steps have them: in the state's float type.
        begin, end = (float(np.asarray(time, times.dtype)) for time in (t0, t1))
        every = (end - begin) / _INTERVALS if checkpoint_every is None else checkpoint_every
        with Folder(checkpoint_dir).locked() as folder:
            keeper = Keeper(folder, run, resume)
            if keeper.passed_over:
                passed = ", ".join(path.name for path in keeper.passed_over)
                warnings.warn(f"Passed over in {checkpoint_dir}, as they are damaged: {passed}.", stacklevel=2)
            solution = in_intervals(advance, keeper, u0, begin, end, times, grid, every)
    if throw and not isinstance(solution.t_end, Tracer):
        solution.check(surface)
    return solution


def _fingerprint(value: Any, run_id: str | None) -> str:
    try:
        return fingerprint(value if run_id is None else run_id)
    except TypeError as error:
        raise RestartError(f"The run cannot be identified. {error} Name it with run_id=...") from None


@eqx.filter_jit
def _bound(equation: Equation, t: Array, surface: Surface, u: Array) -> Array:
    return equation.spectral_bound(t, surface, u)


def _choice(
    equation: Equation, surface: Surface, u0: Array, t0: ArrayLike, t1: ArrayLike, rtol: ArrayLike, dense: bool
) -> tuple[diffrax.AbstractSolver, str]:
    """The solver that is taken where the caller names none, and why."""
    if isinstance(surface.scheme, Paper):
        return diffrax.Tsit5(), "the published operator has eigenvalues off the real axis and no cheap bound of them"
    explicit = "explicit, with as many stages as the stiffness asks for"
    bound = _bound(equation, jnp.asarray(t0, surface.dtype), surface, u0)
    if any(isinstance(value, Tracer) for value in (bound, t0, t1, rtol)) or surface.is_traced or not is_available():
        return RKL2(), explicit
    span = float(bound) * (float(t1) - float(t0))  # type: ignore
    diffuses = bool(jnp.any(equation.diffusivities(u0) > 0))
    # Between long implicit steps there are lines only.
    if span < _STIFF * float(np.asarray(rtol)) ** (-1 / 3) or not diffuses or not equation.is_affine or dense:
        return RKL2(), explicit
    return TRBDF2(), f"implicit, as the run is {span:.1e} times as long as the fastest decay"


def hierarchy(equation: Equation, surface: Surface, u0: Array, t0: ArrayLike) -> Multigrid | None:
    """The multigrid of the surface under the equation's conditions, where it can be had."""
    fixed = None if surface.is_traced or not is_available() else what_is_fixed(equation, surface, u0, t0)
    return None if fixed is None else multigrid(surface, *fixed)


def what_is_fixed(
    equation: Equation, surface: Surface, u0: Array, t0: ArrayLike
) -> tuple[np.ndarray, np.ndarray] | None:
    """What conditions absorb and which vertices they hold (host); None where that is being traced."""
    conditions = equation.conditions
    # Inside jit too, of what is not being traced itself.
    with jax.ensure_compile_time_eval():
        time, like = jnp.asarray(t0, surface.dtype), jnp.zeros(u0.shape, u0.dtype)
        is_held = bounds.held_vertices(surface, conditions)
        absorption = (
            bounds.absorption(surface, conditions, time, like) if conditions else jnp.zeros(surface.num_vertices)
        )
    if isinstance(is_held, Tracer):
        return None
    # Where the data of conditions are being traced their absorption is left out: a preconditioner may be off.
    absorption = np.zeros(len(is_held)) if isinstance(absorption, Tracer) else np.maximum(np.asarray(absorption), 0)
    return absorption, np.asarray(is_held)


def _grid(t0: ArrayLike, t1: ArrayLike, ts: AnyArray, dt: float | None, parts: int) -> np.ndarray | None:
    """The times of fixed steps: multiples of dt, and the times asked for, with each step between in equal parts; None
    for adaptive steps."""
    if dt is None:
        return None
    if any(isinstance(value, Tracer) for value in (t0, t1, ts, dt)):
        raise ValueError("Fixed steps need their times to be known: t0, t1, ts and dt cannot be traced by JAX.")
    start, end = (np.asarray(time, ts.dtype) for time in (t0, t1))
    if start == end:  # a run of no length has no steps, whatever theirs
        return None
    count = int(np.ceil((end - start) / dt - 1e-6))
    multiples = np.asarray(float(start) + dt * np.arange(1, count), ts.dtype)
    least = max(1e-6 * dt, 4 * float(np.finfo(ts.dtype).eps) * float(max(abs(start), abs(end))))
    grid = without_twins(start, end, (np.asarray(ts), multiples), least)
    if parts > 1 and (dt / parts < least or len(grid) * parts > _MOST_STEPS):
        raise ValueError(
            f"dt = {dt:g} is too long: each step would be taken in {parts} parts. Take shorter steps, leave dt out for "
            "adaptive ones, or use ltl.TRBDF2()."
        )
    within = grid[:-1, None] + np.diff(grid)[:, None] * (np.arange(parts) / parts)
    return np.append(within.ravel(), grid[-1]).astype(grid.dtype)


def _checkpoints(grid: np.ndarray | None, max_steps: int | None, u0: Array) -> diffrax.AbstractAdjoint:
    """Checkpointing with a checkpoint for every step while that is little memory, else for the root of their number."""
    steps = max_steps if grid is None else len(grid) - 1
    if steps is None:
        return diffrax.RecursiveCheckpointAdjoint()
    affordable = max(_FEWEST_CHECKPOINTS, _CHECKPOINTED // (2 * u0.nbytes))  # a state and its rate
    wanted = steps if grid is not None and steps <= affordable else math.isqrt(2 * steps) + 1
    return diffrax.RecursiveCheckpointAdjoint(checkpoints=max(1, min(wanted, affordable)))


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


def _meter(progress: bool | diffrax.AbstractProgressMeter) -> diffrax.AbstractProgressMeter:
    if isinstance(progress, diffrax.AbstractProgressMeter):
        return progress
    if not progress:
        return diffrax.NoProgressMeter()
    try:
        return diffrax.TqdmProgressMeter()
    except (ImportError, ValueError):  # tqdm belongs to the extra `app`
        return TextMeter()


@eqx.filter_jit
def _fixed(equation, surface, u0, grid, ts, solver, stop_when, marks, finer) -> Solution:
    """Fixed steps of a stabilised solver."""
    start, rules = _start_and_rules(equation, surface, grid[0], grid[-1] - grid[0], u0, solver, stop_when)
    found = taped.march(start, rules, grid, marks, finer)
    zero = jnp.zeros_like(found.num_steps)
    counts = dict(num_steps=found.num_steps, num_accepted_steps=found.num_steps, num_rejected_steps=zero)
    counts["num_evaluations"] = found.num_evaluations
    has_ended = cast(Array, found.overflowed | found.stopped)
    result = diffrax.RESULTS.where(has_ended, diffrax.RESULTS.event_occurred, diffrax.RESULTS.successful)
    return _as_held(
        equation, surface, jnp.where(found.is_reached, ts, jnp.inf), found.us, grid[found.num_steps],
        found.u_end, counts, result, found.overflowed, found.stopped, None, "", True,
    )  # fmt: skip


@eqx.filter_jit
def _adaptive(equation, surface, u0, t0, t1, ts, solver, adjoint, rtol, atol, max_steps, stop_when) -> Solution:
    """Adaptive steps of a stabilised solver."""
    start, rules = _start_and_rules(equation, surface, t0, t1 - t0, u0, solver, stop_when)

    size = equation.size

    def explore(how, start, rules, is_recorded):
        t0, t1, ts, rtol, atol = how
        (u0, rate), (solver, extent, largest, condition) = start, rules
        solver = dataclasses.replace(
            solver,
            spectral_bound=lambda t, u, _: extent(t, u)[0],
            spectral_width=lambda t, u, _: extent(t, u)[1],
        )
        stop = None if condition is None else lambda t, u, _: condition(t, u, rate(t, u))
        out = _by_diffrax(
            lambda t, u, _: rate(t, u), None, solver, adjoint, diffrax.NoProgressMeter(), u0, t0, t1,
            _first_step(extent(t0, u0)[0], t0, t1), ts, _controller(rtol, atol, solver, size), max_steps, largest, stop,
            False, is_recorded,
        )  # fmt: skip
        times = jnp.concatenate([t0[None], cast(Any, out.ts)[2]]) if is_recorded else None
        (us, u_end, *_), (ts, t_end, *_) = cast(Any, out.ys), cast(Any, out.ts)
        return (us, u_end[0], (ts, t_end[0], *_outcome(out))), times

    how = _constant((t0, t1, ts, rtol, atol))
    us, u_end, (ts, t_end, *outcome) = taped.wander(start, rules, eqx.Partial(explore, how), ts)
    return _as_held(equation, surface, ts, us, t_end, u_end, *outcome, None, "", False)


def _start_and_rules(equation, surface, t0, span, u0, solver, stop_when) -> tuple[tuple[Array, Any], taped.Rules]:
    """The state and the rate that a run begins with, and the rest, as functions of the time and the state."""
    u0 = equation.held(t0, surface, u0)

    def closed(function, *like):
        # What it closes over becomes a part of it, which derivatives see.
        return eqx.filter_closure_convert(function, *like)

    # As diffrax has it: broadcast to the state, and in its float type.
    term = diffrax.ODETerm(_rate)
    rate = closed(lambda t, u: term.vf(t, u, (equation, surface)), t0, u0)
    extent = closed(lambda t, u: solver.extent(t, u, (equation, surface)), t0, u0)
    condition = None if stop_when is None else closed(_checked(stop_when), t0, u0, u0)
    return (u0, rate), taped.Rules(*_constant((solver, extent, _largest(surface, u0, rate, t0, span), condition)))


def _checked(stop_when: Condition) -> Condition:
    def condition(t, u, rate):
        holds = jnp.asarray(stop_when(t, u, rate))
        if holds.shape != () or holds.dtype != bool:
            raise ValueError(
                f"Expected stop_when to return one truth value, found an array of shape {holds.shape} and type "
                f"{holds.dtype}. Compare, and take jnp.all or jnp.any."
            )
        return holds

    return condition


def _constant(tree: Any) -> Any:
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)


def _largest(surface: Surface, u0: Array, rate: Callable[[Array, Array], Array], t0: Array, span: Array) -> Array:
    """What no state may exceed of a run that begins like this."""
    # A rate that is larger by the stiffness would be no number.
    largest = jnp.asarray(_ALMOST_ALL * jnp.finfo(u0.dtype).max, u0.dtype)
    if isinstance(surface.scheme, Monotone):
        return largest
    # Growing modes get there by ever shorter steps: what grew beyond the start, and what the rates there would make of
    # it, is on its way. A source may begin later, so that rates count at several times.
    changes = [jnp.max(jnp.abs(rate(t0 + share * span, u0) * span)) for share in _SHARES]
    size = jnp.max(jnp.stack([jnp.max(jnp.abs(u0)), *changes]))
    return jnp.where(size > 0, jnp.minimum(largest, _GROWN * size), largest)


def _as_held(equation: Equation, surface: Surface, ts: Array, us: Array, t_end: Array, u_end: Array, *rest) -> Solution:
    """The solution with the values that conditions hold: the integrated rate of such a value ends near it only."""
    us = jax.vmap(lambda t, u: equation.held(t, surface, u))(ts, us)
    us = jnp.where(jnp.isfinite(ts).reshape(-1, *(1,) * u_end.ndim), us, jnp.nan)
    return Solution(ts, us, t_end, equation.held(t_end, surface, u_end), *rest)


@eqx.filter_jit
def _solve(
    equation, surface, u0, t0, t1, ts, solver, adjoint, meter, rtol, atol, grid, max_steps, stop_when, dense
) -> Solution:
    u0 = equation.held(t0, surface, u0)
    largest = _largest(surface, u0, lambda t, u: equation.rate(t, surface, u), t0, t1 - t0)

    def stop(t, u, args):
        equation, surface = args
        return _checked(stop_when)(t, u, equation.rate(t, surface, u))

    if grid is not None:
        controller, dt0 = diffrax.StepTo(ts=grid), None
        # Of a known number of steps the checkpoints are few.
        max_steps = min(len(grid) - 1, max_steps) if max_steps is not None else len(grid) - 1
    elif not isinstance(solver, diffrax.AbstractAdaptiveSolver):  # in a run of no length, which has no steps
        controller, dt0 = diffrax.ConstantStepSize(), jnp.ones_like(t1)
    else:
        controller = _controller(rtol, atol, solver, equation.size)
        dt0 = _first_step(equation.spectral_bound(t0, surface, u0), t0, t1)
        if isinstance(solver, ImplicitRungeKutta):  # whose interpolation is linear
            controller = diffrax.ClipStepSizeController(controller, step_ts=ts)
    out = _by_diffrax(
        _rate, (equation, surface), solver, adjoint, meter, u0, t0, t1, dt0, ts, controller, max_steps, largest,
        None if stop_when is None else stop, dense,
    )  # fmt: skip
    (ts, t_end), (us, u_end) = cast(Any, out.ts), cast(Any, out.ys)
    return _as_held(
        equation, surface, ts, us, t_end[0], u_end[0], *_outcome(out), out.interpolation, "", grid is not None
    )


def _controller(rtol: Array, atol: Array | None, solver: diffrax.AbstractSolver, size: Callable[[Array], Array]) -> Any:
    longest = None
    if isinstance(solver, Stabilised):
        longest = lambda t, u, args: solver.longest_step(solver.extent(t, u, args))  # noqa: E731
    # The type checker does not see that the arguments left out have defaults, nor the order of fields.
    inner = diffrax.PIDController(rtol=rtol, atol=jnp.zeros_like(rtol) if atol is None else atol)  # type: ignore
    return Advancing(inner, longest, None if atol is not None else SHARE * rtol, size)  # type: ignore


def _first_step(bound: Array, t0: Array, t1: Array) -> Array:
    """A first step that an explicit method takes safely; the controller finds the right one within a few steps."""
    is_stiff = bound * (t1 - t0) > 1
    return jnp.where(is_stiff, 1 / jnp.where(is_stiff, bound, 1), t1 - t0)


def _by_diffrax(
    rate, args, solver, adjoint, meter, u0, t0, t1, dt0, ts, controller, max_steps, largest, stop, dense,
    is_recorded=False,
) -> diffrax.Solution:  # fmt: skip
    """The run: its states at ``ts`` and in the end, and when steps ended if that is recorded."""

    # Not "is too large": a NaN compares false with everything.
    def has_overflowed(t, y, args, **_):
        del t, args
        return ~(jnp.max(jnp.abs(y)) <= largest)

    events = {"overflowed": has_overflowed}
    if stop is not None:
        events["stopped"] = lambda t, y, args, **_: stop(t, y, args)
    kept = [diffrax.SubSaveAt(ts=ts), diffrax.SubSaveAt(t1=True)]
    if is_recorded:
        kept.append(diffrax.SubSaveAt(steps=True, fn=lambda t, y, args: t))
    return diffrax.diffeqsolve(
        diffrax.ODETerm(rate),
        solver,
        t0,
        t1,
        dt0,
        u0,
        args,
        saveat=diffrax.SaveAt(subs=kept, solver_state=hasattr(solver, "spectral_bound"), dense=dense),
        stepsize_controller=controller,
        adjoint=adjoint,
        event=diffrax.Event(events),
        max_steps=max_steps,
        throw=False,
        progress_meter=meter,
    )


def _outcome(out: diffrax.Solution) -> tuple[dict[str, Array], diffrax.RESULTS, Array, Array]:
    """Counts, result, whether the state overflowed and whether the run was stopped."""
    counts = {name: out.stats[name] for name in ("num_steps", "num_accepted_steps", "num_rejected_steps")}
    if out.solver_state is not None:
        counts["num_evaluations"] = cast(Any, out.solver_state)[1]
    happened = cast(dict[str, Array], out.event_mask)
    stopped = happened.get("stopped", jnp.array(False))
    return counts, out.result, happened["overflowed"] | (out.result == diffrax.RESULTS.dt_min_reached), stopped


def _cause_of_overflow(surface: Surface) -> str:
    if isinstance(surface.scheme, Polynomial):
        return "Polynomial() has growing modes on bad meshes: use ltl.Monotone() for time stepping."
    if isinstance(surface.scheme, Paper):
        return "The published operator (scheme paper) has growing modes on such meshes: use ltl.Monotone()."
    return (
        "Diffusion cannot grow with this scheme, so the cause is (a) a reaction or source that grows without bound, or "
        "(b) an initial state far from where the reaction makes sense. Check the rates and the initial state; where an "
        "implicit solver cannot find its stages, take ltl.RKL2()."
    )
