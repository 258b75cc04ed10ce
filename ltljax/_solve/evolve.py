"""`solve`: the solution of an equation on a surface from an initial state. It checks, chooses a solver, and runs."""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, ParamSpec

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from .._base.arguments import as_numbers, kind_of
from .._base.deprecated import warn_deprecated
from .._base.owned_folder import Folder
from .._equations import Equation
from .._lifting.schemes import Paper, Polynomial
from .._operators import growth_rate, spectral_bound, spectral_width
from .._surface import Surface, on_surface
from .._tables import AnyArray
from . import checks, taped
from .fingerprint import fingerprint
from .implicit import SBDF2, TRBDF2, ImplicitRungeKutta, without_matrices
from .integrate import Run, checkpoints_for, integrate
from .intervals import integrate_in_intervals
from .krylov import Jacobi
from .multigrid import Multigrid, is_available
from .preconditioning import StageSettings, preconditioner_for
from .restart import Checkpoints, Keeper
from .solution import Condition, Solution
from .stabilised import RKL2, Stabilised, differentiable
from .stepping import UNSET, Adaptive, Fixed, Unset, grid_of, meter_of, settings_of

P = ParamSpec("P")

# Eigenvalues whose real part is below this fraction of the largest magnitude count as rounding errors.
_ROUNDING = 1e-8

# Implicit steps are faster for linear runs whose length is at least this many times the fastest decay time, divided by
# the cube root of rtol: explicit steps are limited by stability, implicit ones by the tolerance. See
# benchmarks/time_to_accuracy.md. With a stiff reaction they can be slower by a factor of a hundred.
_STIFF = 2e3


class GrowingModesWarning(UserWarning):
    """The Laplacian of a surface has eigenvalues with positive real part, so diffusion can grow."""


def _with_old_keywords(function: Callable[P, Solution]) -> Callable[P, Solution]:
    """`solve` with the deprecated keywords that ``checkpoints`` has replaced."""
    new_names = dict(checkpoint_dir="folder", checkpoint_every="every", resume="resume", run_id="run_id")

    @functools.wraps(function)
    def accepting(*args: P.args, **kwargs: P.kwargs) -> Solution:
        options: dict[str, Any] = {}
        checkpoints = kwargs.get("checkpoints")
        if checkpoints is not None and not isinstance(checkpoints, Checkpoints):
            raise TypeError(f"Expected checkpoints as ltl.solvers.Checkpoints(folder), found {kind_of(checkpoints)}.")
        for old, new in new_names.items():
            if old in kwargs:
                warn_deprecated(f"The argument {old} of solve", "checkpoints=ltl.solvers.Checkpoints(folder, ...)")
                options[new] = kwargs.pop(old)
        if options and checkpoints is not None:
            raise TypeError("solve() got both checkpoints and keywords that it replaces. Give them inside checkpoints.")
        if options.get("folder") is not None:
            kwargs["checkpoints"] = Checkpoints(**options)
        elif options.get("resume") or options.get("every") is not None:
            option = "resume=True" if options.get("resume") else f"checkpoint_every={options['every']}"
            raise ValueError(f"{option} needs the folder of the run. Give checkpoints=ltl.solvers.Checkpoints(folder).")
        return function(*args, **kwargs)

    return accepting


@_with_old_keywords
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
    steps: Adaptive | Fixed | None = None,
    dt: float | None = None,
    rtol: ArrayLike | None = None,
    atol: ArrayLike | None = None,
    max_steps: int | Unset | None = UNSET,
    stop_when: Condition | None = None,
    dense: bool = False,
    preconditioner: Multigrid | None = None,
    checkpoints: Checkpoints | None = None,
    throw: bool = True,
) -> Solution:
    """The solution of an evolution equation at given times.

    The default solver is `RKL2`, whose cost grows with the square root of the stiffness. If the equation is linear and
    the run lasts at least ``2e3 * rtol ** (-1 / 3)`` (4e4 by default) fastest decay times, it is `TRBDF2`, provided
    that the extra `amg` is installed and the stiffness is known (not inside jit, grad or vmap). It is `diffrax.Tsit5`
    for ``Paper`` surfaces, whose eigenvalues are off the real axis. ``solution.stats`` reports the solver and the
    reason.

    Explicit solvers are those of diffrax, `RKL2` (stabilised, second order) and `RKL1` (stabilised, first order, with
    the maximum principle). Implicit solvers are `BackwardEuler`, `CrankNicolson`, `TRBDF2` and `diffrax.Kvaerno3`, `4`,
    `5`. Solvers that take diffusion implicitly and the reaction explicitly are `SBDF2` (fixed steps only),
    `diffrax.KenCarp3`, `4`, `5` and `diffrax.Sil3`. Implicit stages are solved by Krylov iteration, preconditioned by
    multigrid with the extra `amg` and by Jacobi's method without. No matrix of the size of the state is formed, not
    even in derivatives.

    Derivatives in reverse mode through `RKL2` and `RKL1` cost three to five runs, more with steps of more than 36
    stages. They keep about ``12 sqrt(n)`` states for n fixed steps and 512 for adaptive ones, or as many as a gigabyte
    holds (for each run of a batch). Derivatives treat adaptive step lengths as constants, so they are accurate only to
    the tolerance and `check_gradient` shows slope 1. With ``dt`` it shows slope 2. Other solvers, dense solutions, runs
    with ``progress``, traced times, and runs for which a gigabyte is too little use diffrax's recursive checkpointing,
    which costs 5 to 10 runs. It keeps all fixed steps while that takes less than a gigabyte, otherwise
    ``sqrt(2 max_steps)`` states and their rates, or as many as a gigabyte holds.

    Args:
        equation: the equation, such as `Diffusion` or `ReactionDiffusion`.
        surface: the surface.
        u0: (V,) or (V, S) initial state; converted to the dtype of the surface.
        t1: final time.
        ts: (T,) requested times, ascending; by default t1 alone.
        solver: the solver.
        adjoint: how derivatives go through time; by default as described above. Use `diffrax.ForwardMode()` for
            derivatives in few parameters.
        progress: True for a progress bar, or a diffrax progress meter.
        t0: initial time.
        steps: `ltl.solvers.Adaptive` (the default) or `ltl.solvers.Fixed`.
        dt: short for ``steps=Fixed(dt)``.
        rtol: short for ``rtol`` of ``steps``, 1e-4 by default.
        atol: short for ``atol`` of ``steps``.
        max_steps: short for ``max_steps`` of ``steps``, 1,000,000 by default.
        stop_when: ``(t, u, rate) -> bool``, such as `Steady`; the run ends after the first step for which it holds.
        dense: whether every step is kept, so that ``solution.at(t)`` gives the state at any time. Takes the memory of
            ``max_steps`` states.
        preconditioner: the result of `multigrid` for this surface or a similar one; needed for a surface that is being
            traced, where multigrid cannot be set up.
        checkpoints: where and how often the run is kept on disk; see `ltl.solvers.Checkpoints`.
        throw: whether a run that does not reach t1 raises an error. Inside jit nothing can be raised: read
            ``solution.result`` and ``solution.overflowed`` there.

    Returns:
        The `Solution`.

    Raises:
        SolveError: the state overflowed, or the solver failed before t1.
        ValueError: the state does not fit the surface, a value is not finite, a diffusivity is negative, times are not
            in order, tolerances are not positive, dt is too long for an explicit solver, the solver does not support
            the steps, or two arguments contradict each other.
        RestartError: the folder of ``checkpoints`` holds another run, or one that has not ended and was not to be
            resumed; or this run cannot be told from others without a ``run_id``.
        OutputError: another run is writing to that folder, or it holds files of other programs under ltljax's names.

    Warns:
        GrowingModesWarning: the Laplacian of a ``Polynomial`` surface has growing modes. This is checked once for each
            surface, and not inside jit.
    """
    settings = settings_of(steps, rtol, atol, dt, max_steps)
    checks.kinds(equation, solver, adjoint, preconditioner, settings.max_steps, stop_when)
    u0 = checks.field(surface, u0, "u0")
    times = _requested_times(surface, t0, t1, ts, settings)
    checks.finite(equation, u0)
    _warn_of_growth(surface)
    problem = _Problem(equation, surface, u0, t0, t1)
    method = _choose(problem, solver, settings, dense, preconditioner)
    grid = grid_of(t0, t1, times, settings.dt, method.substeps)
    is_plain = adjoint is None and not dense and not progress
    is_taped = is_plain and _can_be_taped(method.solver, grid, settings.max_steps, u0, (t0, t1, times))
    adjoint = checkpoints_for(grid, settings.max_steps, u0) if adjoint is None else adjoint
    run = Run(
        equation=equation,
        surface=_with_width(surface, method.solver),
        u0=u0,
        # Times and tolerances are arrays, so that other values need no compilation.
        t0=_as_array(t0, surface),
        t1=_as_array(t1, surface),
        ts=times,
        grid=grid,
        solver=differentiable(method.solver, adjoint),
        adjoint=adjoint,
        rtol=_as_array(settings.rtol, surface),
        atol=_as_array(settings.atol, surface),
        max_steps=settings.max_steps,
        stop_when=stop_when,
        meter=meter_of(progress),
        dense=dense,
        is_taped=is_taped,
    )
    solution = integrate(run) if checkpoints is None else _on_disk(run, problem, settings, method, solver, checkpoints)
    # The description is added last: the figures in it would make every run compile again.
    solution = dataclasses.replace(solution, method=method.description)
    if throw and not isinstance(solution.t_end, Tracer):
        solution.check(surface)
    return solution


class _Problem(NamedTuple):
    """The equation, where it is solved, and from what state and time to what time."""

    equation: Equation
    surface: Surface
    u0: Array
    t0: ArrayLike
    t1: ArrayLike


class _Method(NamedTuple):
    """The solver of a run.

    Attributes:
        solver: the solver, with the preconditioner and tolerances of its stages.
        description: name of the solver and the reason for its choice.
        substeps: number of equal substeps of each fixed step.
        uses_jacobi: whether implicit stages are preconditioned by Jacobi's method.
    """

    solver: diffrax.AbstractSolver
    description: str
    substeps: int = 1
    uses_jacobi: bool = False


def _as_array(x: ArrayLike | None, surface: Surface) -> Any:
    return None if x is None else jnp.asarray(x, surface.dtype)


def _requested_times(surface: Surface, t0: ArrayLike, t1: ArrayLike, ts: Any, settings: Adaptive | Fixed) -> AnyArray:
    """The requested times as an array, once all times and tolerances have been checked."""
    for name, time in (("t0", t0), ("t1", t1), *((("dt", settings.dt),) if settings.dt is not None else ())):
        checks.one_number(name, time)
    if ts is not None:
        as_numbers("ts", ts)
    times = [t1] if ts is None else ts
    # Concrete times stay in NumPy, because JAX arrays would be traced inside jit.
    is_concrete = not any(isinstance(time, Tracer) for time in jax.tree.leaves(times))
    times = (np if is_concrete else jnp).asarray(times, surface.dtype)
    checks.times(t0, t1, times, settings.dt)
    checks.tolerances(settings.rtol, settings.atol)
    return times


def _choose(
    problem: _Problem,
    solver: diffrax.AbstractSolver | None,
    settings: Adaptive | Fixed,
    dense: bool,
    preconditioner: Multigrid | None,
) -> _Method:
    """The solver that the caller names, or the default one, ready for the run."""
    equation, surface, u0, t0, _ = problem
    if solver is None:
        chosen, reason = _default(problem, settings.rtol, dense)
    else:
        chosen, reason = without_matrices(solver), "chosen by the caller"
    name = type(chosen if solver is None else solver).__name__
    if isinstance(chosen, SBDF2) and settings.dt is None:
        raise ValueError("SBDF2 takes fixed steps: give their length as dt, or use diffrax.KenCarp3().")
    if isinstance(chosen, ImplicitRungeKutta | SBDF2):
        inverse = preconditioner_for(equation, surface, u0, t0) if preconditioner is None else preconditioner
        rtol, atol = _as_array(settings.rtol, surface), _as_array(settings.atol, surface)
        chosen = dataclasses.replace(chosen, stages=StageSettings(inverse, rtol, atol))  # type: ignore (a dataclass)
        uses_jacobi = isinstance(inverse, Jacobi)
        reason += f", stages preconditioned by {'Jacobi' if uses_jacobi else 'multigrid'}"
        return _Method(chosen, f"{name}: {reason}", uses_jacobi=uses_jacobi)
    substeps = 1 if settings.dt is None else checks.num_substeps(equation, surface, u0, t0, settings.dt, chosen)
    if substeps > 1:
        reason += f", each step in {substeps} parts, since a whole one is unstable even with the most stages"
    return _Method(chosen, f"{name}: {reason}", substeps)


def _default(problem: _Problem, rtol: ArrayLike, dense: bool) -> tuple[diffrax.AbstractSolver, str]:
    """The solver for a caller who names none, and the reason for its choice."""
    equation, surface, u0, t0, t1 = problem
    if isinstance(surface.scheme, Paper):
        return diffrax.Tsit5(), "the published operator has eigenvalues off the real axis and no cheap bound of them"
    explicit = RKL2(), "explicit, with as many stages as the stiffness asks for"
    bound = _bound(equation, jnp.asarray(t0, surface.dtype), surface, u0)
    if any(isinstance(value, Tracer) for value in (bound, t0, t1, rtol)) or surface.is_traced or not is_available():
        return explicit
    span = float(bound) * (float(t1) - float(t0))  # type: ignore
    diffuses = bool(jnp.any(equation.diffusivities(u0) > 0))
    # Dense output needs short steps, because implicit solvers interpolate linearly.
    if span < _STIFF * float(np.asarray(rtol)) ** (-1 / 3) or not diffuses or not equation.is_affine or dense:
        return explicit
    return TRBDF2(), f"implicit, as the run is {span:.1e} times as long as the fastest decay"


@eqx.filter_jit
def _bound(equation: Equation, t: Array, surface: Surface, u: Array) -> Array:
    return equation.spectral_bound(t, surface, u)


def _can_be_taped(
    solver: diffrax.AbstractSolver, grid: np.ndarray | None, max_steps: int | None, u0: Array, times: tuple[Any, ...]
) -> bool:
    """Whether taped steps can take the run, and are faster than recursive checkpoints."""
    if max_steps is None or not isinstance(solver, Stabilised) or solver.loop_kind != "checkpointed":
        return False
    num_steps = None if grid is None else len(grid) - 1
    if num_steps is not None and num_steps > max_steps:
        return False
    # Taped runs have no derivatives in their times.
    return taped.is_worth_it(num_steps, u0) and not any(isinstance(time, Tracer) for time in times)


def _with_width(surface: Surface, solver: diffrax.AbstractSolver) -> Surface:
    """The surface, with the measured spectral width of its Laplacian if the solver needs it."""
    if surface.is_traced or not isinstance(solver, Stabilised):
        return surface
    return eqx.tree_at(
        lambda s: s.geometry.spectral_width, surface, spectral_width(surface), is_leaf=lambda leaf: leaf is None
    )


def _warn_of_growth(surface: Surface) -> None:
    """Warn if the Laplacian of a `Polynomial` surface has growing modes."""
    if not isinstance(surface.scheme, Polynomial) or surface.is_traced:
        return
    growth = surface.remembered("growth", lambda: growth_rate(surface))
    if growth > _ROUNDING * float(spectral_bound(surface)):
        warnings.warn(
            f"Modes of this Laplacian grow like exp({growth:.3g} t) under diffusion. {surface.scheme} is made for "
            "stationary problems and good meshes: use ltl.Monotone() for time stepping, or a better mesh.",
            GrowingModesWarning,
            stacklevel=5,
        )


def _on_disk(
    run: Run,
    problem: _Problem,
    settings: Adaptive | Fixed,
    method: _Method,
    solver: diffrax.AbstractSolver | None,
    checkpoints: Checkpoints,
) -> Solution:
    """The solution of a run that is kept on disk."""
    equation, surface, u0, t0, t1 = problem
    if run.dense or any(isinstance(x, Tracer) for x in jax.tree.leaves((*problem, run.ts))):
        raise ValueError("A run that is kept on disk cannot be traced by a JAX transformation, nor be dense.")
    identity = dict(
        mesh=fingerprint((surface.vertices, surface.centre, surface.faces, repr(surface.scheme))),
        equation=checkpoints.fingerprint_of(equation),
        start=fingerprint((u0, float(t0))),  # type: ignore
        end=fingerprint((float(t1), run.ts, settings.dt, checkpoints.every)),  # type: ignore
        solver=checkpoints.fingerprint_of((solver, run.stop_when)),
        tolerances=fingerprint((type(run.solver), method.uses_jacobi, settings.rtol, settings.atol)),
    )
    # Times are rounded to the dtype of the state, as those of the steps are.
    begin, end = (float(np.asarray(time, run.ts.dtype)) for time in (t0, t1))
    with Folder(checkpoints.folder).locked() as folder:
        keeper = Keeper(folder, identity, checkpoints.resume)
        if keeper.skipped:
            names = ", ".join(path.name for path in keeper.skipped)
            warnings.warn(f"Damaged files in {checkpoints.folder} were skipped: {names}.", stacklevel=5)
        return integrate_in_intervals(run, keeper, begin, end, checkpoints.every)
