"""The iterations of a fit, one at a time, and the reason why they end."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

from .methods import SETTLED, Marquardt

# The search ends before a step of less than this share of the tolerance.
_SETTLED_STEP = 0.1
# A least-squares fit ends if this many iterations together lower twice the loss by less than this share of the variance
# of the noise.
_CRAWLING, _IMMATERIAL = 12, 1e-3
# Reasons of a search that has found a minimum.
_NO_CHANGE, _NO_DESCENT, _CRAWLED = (
    "parameters or loss no longer change", "no step lowers the loss any further", "the loss no longer changes",
)  # fmt: skip


class FitError(RuntimeError):
    """The model fails at the start of a fit."""


@dataclasses.dataclass(frozen=True)
class End:
    """The end of a search.

    Attributes:
        z: unknowns with the least loss.
        losses: loss after each iteration.
        reason: reason of the end, as a sentence without its capital and full stop.
        has_settled: whether the search ended in a minimum, as far as the method can tell.
    """

    z: Array
    losses: list[float]
    reason: str
    has_settled: bool


def search(
    solver: Any, objective: Any, z: Array, iterations: Any, unit: Callable[[float], float],
    after: Callable[[int, float, Array], bool],
) -> End:  # fmt: skip
    """Minimise until the loss settles, the model fails, or the caller stops the search.

    Args:
        solver: solver of optimistix.
        objective: function to minimise, with the factor ``scale`` of the residuals.
        z: first unknowns.
        iterations: iterable over the numbers of the iterations, such as a progress bar.
        unit: ``loss -> number``, half the variance of the noise.
        after: ``(iteration, loss, z) -> bool``, called after each iteration; True ends the search.

    Raises:
        FitError: the model fails at the first unknowns.
    """
    options: dict[str, Any] = {}
    y, state, best = z, _begin(solver, objective, z, options), z
    losses: list[float] = []
    for iteration in iterations:
        y, state, outcome = _iterate(solver, objective, y, options, state)
        loss = float(outcome.loss / objective.scale**2)
        if not np.isfinite(loss):
            if iteration == 0:
                raise FitError(
                    "The model fails at the start: its prediction is not finite, or the run did not reach its end. Run "
                    "the model there by itself (ltl.solve reports the cause), and choose another start."
                )
            reason = "the model fails where the optimiser went, and its steps cannot be rejected: lower its rate"
            return End(best, losses, reason, False)
        best = outcome.z
        losses.append(loss)
        if hasattr(iterations, "set_postfix_str"):
            iterations.set_postfix_str(f"loss {loss:.4g}")
        is_stopped = after(iteration, loss, best)
        rejected, failed = int(outcome.rejected), int(outcome.failed)
        if bool(outcome.done):
            return End(best, losses, _NO_CHANGE, True)
        if failed and rejected >= outcome.most:
            reason = f"the model fails at every step from here, however short ({failed} in a row): choose another start"
            return End(best, losses, reason, False)
        if rejected >= outcome.most:
            return End(best, losses, _NO_DESCENT, True)
        if isinstance(solver, Marquardt) and not rejected and _crawls(losses, unit(loss)):
            return End(best, losses, _CRAWLED, True)
        if is_stopped:
            return End(best, losses, "stop_when returned True", False)
    return End(best, losses, f"the limit of {len(losses)} iterations was reached", False)


def _crawls(losses: list[float], unit: float) -> bool:
    return len(losses) > _CRAWLING and losses[-1 - _CRAWLING] - losses[-1] <= _IMMATERIAL * unit


class _Outcome(eqx.Module):
    """The outcome of an iteration.

    Attributes:
        z: unknowns at which the loss is known.
        loss: scaled loss.
        done: whether the solver has converged.
        rejected: number of consecutive rejected steps.
        failed: number of consecutive steps at which the model failed.
        most: number of consecutive rejections that ends the search.
    """

    z: Array
    loss: Array
    done: Array
    rejected: Array
    failed: Array
    most: int = eqx.field(static=True)


@eqx.filter_jit
def _begin(solver, objective, z, options):
    struct, aux = eqx.filter_eval_shape(objective, z, None)
    return solver.init(objective, z, None, options, struct, aux, frozenset())


@eqx.filter_jit
def _iterate(solver: Any, objective: Any, z: Array, options: dict[str, Any], state: Any) -> tuple[Array, Any, _Outcome]:
    if isinstance(solver, optx.OptaxMinimiser):
        # The loss in its state is the loss at the beginning of the step.
        next_z, state, _ = solver.step(objective, z, None, options, state, frozenset())
        none = jnp.array(0)
        return next_z, state, _Outcome(z, state.f, state.terminate, none, none, 1)
    before = state.f_info.as_min()
    next_z, state, _ = solver.step(objective, z, None, options, state, frozenset())
    done, _ = solver.terminate(objective, z, None, options, state, frozenset())
    loss, trials, most = state.f_info.as_min(), state.search_state, solver.search.most
    if not isinstance(solver, Marquardt):
        # Close to a minimum, rounding errors of the loss may keep the solver from detecting convergence.
        is_short = jnp.abs(state.y_eval - next_z) <= _SETTLED_STEP * (solver.rtol * jnp.abs(next_z) + solver.atol)
        done |= jnp.all(is_short) & (trials.failed == 0)
        done |= (loss < before) & (before - loss <= SETTLED * loss)
    return next_z, state, _Outcome(next_z, loss, done, trials.rejected, trials.failed, most)
