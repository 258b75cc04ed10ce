"""The steps of a fit, one at a time, and the reason why they end."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

from .methods import SETTLED, Marquardt

# A step is the last that comes before a step of less than this share of the tolerance.
_SETTLED_STEP = 0.1
# A least-squares fit that crawls ends when so many steps together lower twice the loss by less than this share of the
# variance of the noise.
_CRAWLING, _IMMATERIAL = 12, 1e-3
# How a search ends that has found a minimum.
_NO_CHANGE, _NO_DESCENT, _CRAWLED = (
    "parameters or loss no longer change", "no step lowers the loss any further", "the loss no longer changes",
)  # fmt: skip


class FitError(RuntimeError):
    """A fit that could not begin: the model fails at the first guess."""


@dataclasses.dataclass(frozen=True)
class End:
    """The end of a search.

    Attributes:
        z: unknowns with the least loss.
        losses: loss after each step.
        reason: why it ended, in words.
        has_settled: whether it ended in a minimum, as far as the method can tell.
    """

    z: Array
    losses: list[float]
    reason: str
    has_settled: bool


def search(
    solver: Any, function: Any, z: Array, steps: Any, unit: Callable[[float], float],
    after: Callable[[int, float, Array], bool],
) -> End:  # fmt: skip
    """Step until the loss is least, or something else ends it.

    Args:
        solver: optimiser of optimistix.
        function: function that it steps on, with the factor ``scale`` of the residuals.
        z: first unknowns.
        steps: iterable over the steps allowed, such as a progress bar.
        unit: ``loss -> number``, half the variance of the noise.
        after: ``(step, loss, z) -> bool``, called after each step; True ends the search.

    Raises:
        FitError: the model fails at the first unknowns.
    """
    options: dict[str, Any] = {}
    y, state, best = z, _begin(solver, function, z, options), z
    losses: list[float] = []
    for step in steps:
        y, state, seen = _step(solver, function, y, options, state)
        loss = float(seen.loss / function.scale**2)
        if not np.isfinite(loss):
            if step == 0:
                raise FitError(
                    "The model fails at the start: its prediction is not finite, or the run did not reach its end. Run "
                    "it there by itself (ltl.solve says why), and begin elsewhere."
                )
            reason = "the model fails where the optimiser went, which cannot go back: take a lower rate"
            return End(best, losses, reason, False)
        best = seen.z
        losses.append(loss)
        if hasattr(steps, "set_postfix_str"):
            steps.set_postfix_str(f"loss {loss:.4g}")
        is_stopped = after(step, loss, best)
        rejected, failed = int(seen.rejected), int(seen.failed)
        if bool(seen.done):
            return End(best, losses, _NO_CHANGE, True)
        if failed and rejected >= seen.most:
            reason = f"the model fails at every step from here, {failed} ever shorter ones: begin elsewhere"
            return End(best, losses, reason, False)
        if rejected >= seen.most:
            return End(best, losses, _NO_DESCENT, True)
        if isinstance(solver, Marquardt) and not rejected and _crawls(losses, unit(loss)):
            return End(best, losses, _CRAWLED, True)
        if is_stopped:
            return End(best, losses, "stop_when held", False)
    return End(best, losses, f"the {len(losses)} steps allowed were taken", False)


def _crawls(losses: list[float], unit: float) -> bool:
    return len(losses) > _CRAWLING and losses[-1 - _CRAWLING] - losses[-1] <= _IMMATERIAL * unit


class _Seen(eqx.Module):
    """A step as `fit` sees it: where the loss is known, the loss, and how the search goes."""

    z: Array
    loss: Array
    done: Array
    rejected: Array
    failed: Array
    most: int = eqx.field(static=True)


@eqx.filter_jit
def _begin(solver, function, z, options):
    struct, aux = eqx.filter_eval_shape(function, z, None)
    return solver.init(function, z, None, options, struct, aux, frozenset())


@eqx.filter_jit
def _step(solver: Any, function: Any, z: Array, options: dict[str, Any], state: Any) -> tuple[Array, Any, _Seen]:
    if isinstance(solver, optx.OptaxMinimiser):
        # Its loss is that of the point the step began at.
        further, state, _ = solver.step(function, z, None, options, state, frozenset())
        none = jnp.array(0)
        return further, state, _Seen(z, state.f, state.terminate, none, none, 1)
    before = state.f_info.as_min()
    further, state, _ = solver.step(function, z, None, options, state, frozenset())
    done, _ = solver.terminate(function, z, None, options, state, frozenset())
    loss, trials, most = state.f_info.as_min(), state.search_state, solver.search.most
    if not isinstance(solver, Marquardt):
        # In a minimum the loss's rounding may keep the solver from seeing that its steps lead nowhere.
        is_short = jnp.abs(state.y_eval - further) <= _SETTLED_STEP * (solver.rtol * jnp.abs(further) + solver.atol)
        done |= jnp.all(is_short) & (trials.failed == 0)
        done |= (loss < before) & (before - loss <= SETTLED * loss)
    return further, state, _Seen(further, loss, done, trials.rejected, trials.failed, most)
