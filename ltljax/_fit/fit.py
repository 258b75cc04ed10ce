"""`fit`: a model, a first guess and data become parameters with error bars. Optimistix takes the steps."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._base.deprecated import renamed_arguments
from .._base.progress import watched
from .agreement import agreement
from .checkpoint import Checkpoint, Interrupted
from .evidence import evidence
from .experiment import Experiment
from .methods import MANY
from .observations import Observations
from .problem import (
    Model,
    Problem,
    Program,
    Residuals,
    first_unknowns,
    jacobian_of,
    prepare,
    steps_adaptively,
    values_of,
)
from .result import Fit
from .scan import better_start, explains_nothing
from .search import End, FitError, search

# The spread of the misfit is consistent with the parameters when a round of the fit changes it by less than this share.
_CONSISTENT = 0.01
# Largest number of rounds.
_MAX_ROUNDS = 12


@renamed_arguments(max_steps="max_iterations")
def fit(
    model: Model,
    start: Any,
    data: Observations,
    *,
    transforms: Any = None,
    penalty: Residuals | None = None,
    method: Any = None,
    rtol: float = 1e-5,
    atol: float = 1e-7,
    max_iterations: int = 200,
    stop_when: Callable[[int, float, Any], bool] | None = None,
    progress: bool = False,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    confidence: float = 0.95,
    scan: bool = True,
) -> Fit:
    """The parameters of a model that explain data best, in the sense of least squares or of a robust loss (host).

    With up to 64 unknowns the method is Levenberg-Marquardt on the residuals. Their Jacobian is taken in forward mode
    along with the run (`diffrax.ForwardMode`), or row by row if the model has reverse mode only and there are up to 64
    values. With more unknowns the method is L-BFGS on the loss, with its gradient in reverse mode (see `solve`): a
    gradient costs a few runs, whatever the number of unknowns.

    If the run fails at a trial step, or its result is not finite, the step is rejected and a shorter one is tried.
    Steps of an optimiser of optax cannot be rejected; there a failure ends the fit.

    Args:
        model: an `Experiment`, or a function of the parameters whose output is compared with the data: a `Solution`
            (so that a failed run is recognised), states, or a statistic. A function that calls `solve` should take
            ``adjoint`` and pass it on.
        start: first guess: a pytree of floats or arrays.
        data: the `Observations`.
        transforms: ranges of the parameters, such as ``dict(a=Positive())``: a prefix of the parameters' pytree.
        penalty: ``params -> residuals`` to add to those of the data, such as `smoothness`.
        method: a solver of optimistix for least squares (`LevenbergMarquardt`, `GaussNewton`, `Dogleg`) or for
            minimisation (`BFGS`, `LBFGS`), or an optimiser of optax; by default as above.
        rtol: relative tolerance: the fit has converged when a step changes unknowns and residuals by less than this
            share.
        atol: absolute tolerance of the same changes.
        max_iterations: largest number of iterations of the method.
        stop_when: ``(iteration, loss, params) -> bool``, called after each iteration; True ends the fit.
        progress: whether to show a progress bar with the loss.
        checkpoint: file (.npz) that keeps the parameters after each iteration.
        resume: whether to continue from the parameters in ``checkpoint``, whatever the start.
        confidence: confidence of the intervals.
        scan: whether to replace a start that explains nothing by the best of 96 points around it, with up to 64
            unknowns.

    Returns:
        The `Fit`.

    Raises:
        ValueError: data and model do not match, there are fewer values (and penalties) than unknowns, or the start is
            outside the range of its transforms.
        RestartError: the file to resume from is damaged or belongs to another fit.
        OutputError: ``checkpoint`` names a file that ltljax did not write.
        FitError: the model fails at the start.
    """
    space, z = first_unknowns(start, transforms, data)
    keeper = interrupted = None
    if checkpoint is not None:
        keeper = Checkpoint(Path(checkpoint), space, data)
        if resume and keeper.path.exists():
            interrupted = keeper.read()
            space, z = interrupted.space, interrupted.z
        keeper.folder.check([keeper.path.name])
    problem = prepare(model, space, data, penalty, method, z, rtol, atol)
    beginning = _begin(problem, z, interrupted, scan)

    def after(iteration: int, loss: float, z: Array, spread: Array) -> bool:
        if keeper is not None:
            if iteration == 0 and interrupted is not None:
                keeper.refuse_other(loss, interrupted.loss, np.asarray(spread, np.float64))
            keeper.keep(z, loss, np.asarray(spread))
        return stop_when is not None and bool(stop_when(iteration, loss, space.params(z)))

    program, end = _search_in_rounds(problem, beginning, max_iterations, progress, after)
    return _result(problem, program, end, beginning.scanned, confidence)


@dataclasses.dataclass(frozen=True)
class _Beginning:
    """The point at which a search begins.

    Attributes:
        z: first unknowns.
        objective: scaled objective, as the solver calls it.
        program: residuals inside ``objective``.
        scanned: sentence about the scan for a better start; empty if there was none.
    """

    z: Array
    objective: Any
    program: Program
    scanned: str


def _begin(problem: Problem, z: Array, interrupted: Interrupted | None, scan: bool) -> _Beginning:
    """The beginning of a search: from a checkpoint, from the first guess, or from a better point found by a scan.

    Raises:
        FitError: the derivatives at this point are not finite.
    """
    program, scanned = problem.program, ""
    if interrupted is not None:
        program = program.with_spread(jnp.asarray(interrupted.spread, z.dtype))
    objective, (value, misfit) = problem.objective(program, z)
    if scan and interrupted is None and explains_nothing(problem.residuals, np.asarray(misfit)):
        z, scanned = _scan(problem.residuals, z)
        objective, (value, misfit) = problem.objective(program, z)
    # Infinite derivatives make the scale zero.
    if not 0 < float(objective.scale) < np.inf and bool(jnp.isfinite(value).all()):
        raise FitError(
            "The model has no finite derivatives at the start, though its prediction is finite. Look for a square "
            "root, a norm or a power of zero there, or choose another start."
        )
    if interrupted is None and problem.data.has_moving_spread:
        program, _ = _respread(problem.data, program, misfit)
        objective = dataclasses.replace(objective, residuals=program)
    return _Beginning(z, objective, program, scanned)


def _search_in_rounds(
    problem: Problem,
    beginning: _Beginning,
    max_iterations: int,
    progress: bool,
    after: Callable[[int, float, Array, Array], bool],
) -> tuple[Program, End]:
    """Search until the parameters are consistent with the spread of the residuals, and return the last residuals and
    the end of the search.

    A spread that depends on the parameters is held during each round and updated between rounds.

    Args:
        problem: the problem.
        beginning: where to begin.
        max_iterations: largest number of iterations in all rounds together.
        progress: whether to show a progress bar.
        after: ``(iteration, loss, z, spread) -> bool``, called after each iteration; True ends the search.
    """
    data, z = problem.data, beginning.z
    objective, program = beginning.objective, beginning.program
    losses: list[float] = []
    end = End(z, losses, "", False)

    def unit(loss: float) -> float:
        return max(0.0 if data.noise is None else 0.5, loss / data.num_values)

    for round_ in range(_MAX_ROUNDS):
        num_before, spread = len(losses), program.arrays.spread
        iterations = range(max_iterations - num_before)
        end = search(
            problem.solver, objective, z,
            watched("fit", unit="iteration")(iterations) if progress else iterations, unit,
            lambda k, loss, z, num_before=num_before, spread=spread: after(num_before + k, loss, z, spread),
        )  # fmt: skip
        z, losses = end.z, losses + end.losses
        if not data.has_moving_spread:
            break
        changed, change = _respread(data, program, values_of(program, z)[1])
        if change < _CONSISTENT:
            break
        if not end.has_settled or len(losses) >= max_iterations or round_ == _MAX_ROUNDS - 1:
            reason = "the spread of the residuals, which is estimated from the data, has not settled"
            end = dataclasses.replace(end, has_settled=False, reason=reason if end.has_settled else end.reason)
            break
        program = changed
        objective = dataclasses.replace(objective, residuals=program)
    return program, dataclasses.replace(end, losses=losses)


def _respread(data: Observations, program: Program, misfit: Array) -> tuple[Program, float]:
    """The residuals with the spread that the misfit shows, and the relative change of the spread."""
    before = np.asarray(program.arrays.spread, np.float64)
    spread = data.spread(np.asarray(misfit), before, program.num_unknowns)
    change = float(np.max(np.abs(np.log(spread / before))))
    return program.with_spread(jnp.asarray(spread, program.arrays.spread.dtype)), change


def _scan(residuals: Any, z: Array) -> tuple[Array, str]:
    """A better start than the first guess if there is one, and a sentence about the scan."""
    better = better_start(residuals, np.asarray(z))
    if better is None:
        return z, "The start explains nothing, and none of the points tried within a factor of 1000 explains more."
    start, count = better
    z = jnp.asarray(start, z.dtype)
    values = jax.tree.leaves(residuals.space.params(z))
    flat = np.concatenate([np.ravel(np.asarray(leaf)) for leaf in values])
    words = ", ".join(f"{name} = {value:.3g}" for name, value in zip(residuals.space.names, flat, strict=False))
    return z, f"The start explains nothing, so the fit began at the best of {count} points around it: {words}."


def _result(problem: Problem, program: Program, end: End, scanned: str, confidence: float) -> Fit:
    """The `Fit` at the end of a search, with its evidence and agreement."""
    data, space, model, z = problem.data, problem.space, problem.model, end.z
    spread = np.asarray(program.arrays.spread, np.float64)
    known, degrees_of_freedom = None, float("nan")
    reason, has_settled = end.reason, end.has_settled
    if z.size <= MANY and problem.is_least_squares:
        (value, misfit), jacobian = jacobian_of(program, z, problem.reverse)
        if bool(jnp.isfinite(jacobian).all()):
            known = evidence(space, z, data, value, misfit, jacobian, spread, confidence, steps_adaptively(model))
            degrees_of_freedom = known.degrees_of_freedom
        else:
            reason += "; derivatives are not finite there, so that errors are unknown"
            has_settled = False
    else:
        value, misfit = values_of(program, z)
    # If the noise was not given, residuals are in the unit of the data.
    factor = spread if data.estimates_spread else 1.0
    misfit = np.asarray(misfit, np.float64).reshape(data.values.shape) * factor
    misfit = np.where(np.asarray(data.mask), misfit, np.nan)
    surface = model.surface if isinstance(model, Experiment) and model.vertices is None else None
    params, calibration = space.values(z)
    return Fit(
        params=params,
        calibration=calibration,
        losses=np.array(end.losses),
        reason=reason,
        has_settled=has_settled,
        num_iterations=len(end.losses),
        method=problem.method,
        residuals=misfit,
        evidence=known,
        agreement=agreement(
            data, misfit, degrees_of_freedom, np.ones(()) if data.estimates_spread else spread, z.size, surface
        ),
        scanned=scanned,
        penalties=float(np.sum(np.asarray(value)[data.values.size :] ** 2)),
        _problem=problem,
        _program=program,
        _z=z,
    )
