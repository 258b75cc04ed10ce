"""Methods of fitting: solvers of optimistix that count and reject steps.

The input is the user's method, or None; the output is a solver for `fit`, and its name.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array

# With more unknowns than this no Jacobian is formed, and the default method is L-BFGS with gradients in reverse mode.
MANY = 64
# The search ends at a step that lowers the loss by less than this share.
SETTLED = 1e-8
# No step lowers the loss if this many in a row are rejected, for methods that shorten steps to a quarter and to a half.
_MOST_QUARTERED, _MOST_HALVED = 12, 24
# Factor by which the damping is reduced if it makes steps short far from a minimum.
_UNDAMPED = 1e3


class Trials(eqx.Module):
    """State of a search, with the number of trial steps since the last accepted one.

    Attributes:
        inner: state of the search of optimistix.
        rejected: number of consecutive rejected steps.
        failed: number of consecutive steps at which the model failed, up to the last one.
    """

    inner: Any
    rejected: Array
    failed: Array


class Counted(optx.AbstractSearch):
    """A search of optimistix that counts the steps it rejects. If the model fails, the loss is infinite and the step is
    rejected.

    Attributes:
        search: search of optimistix.
        most: number of consecutive rejections that ends the fit.
    """

    search: optx.AbstractSearch
    most: int = eqx.field(static=True)

    def init(self, y, f_info_struct):
        """The initial state."""
        return Trials(self.search.init(y, f_info_struct), jnp.array(0), jnp.array(0))

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        """The step of the search, counted."""
        size, accept, result, inner = self.search.step(first_step, y, y_eval, f_info, f_eval_info, state.inner)
        has_failed = ~jnp.isfinite(f_eval_info.as_min())
        rejected = jnp.where(accept, 0, state.rejected + 1)
        return size, accept, result, Trials(inner, rejected, jnp.where(has_failed, state.failed + 1, 0))


class Marquardt(optx.LevenbergMarquardt):
    """Levenberg-Marquardt that does not mistake a step shortened by damping for convergence.

    If the data determine one direction a thousand times better than another, damping that suits the first holds back
    the second, and steps become short far from the minimum. Short and rejected steps are therefore compared with the
    Gauss-Newton step. If that is short as well, or would lower the loss by no more than `SETTLED`, the minimum is
    reached; otherwise damping is reduced. Long steps must meet both conditions.

    No step changes an unknown by more than ``reach``, because a run at parameters far from any sensible value may take
    thousands of times as long as others, only for its step to be rejected.

    Attributes:
        reach: (n,) largest change of each unknown in one step; None for no limit.
    """

    reach: Array | None

    def __init__(self, rtol, atol, norm, linear_solver, verbose, reach=None):
        super().__init__(rtol, atol, norm, linear_solver, verbose)
        self.reach = reach

    def step(self, fn, y, args, options, state, tags):
        """The step of optimistix, with another test of convergence."""
        before = state.f_info.as_min()
        y, state, aux = super().step(fn, y, args, options, state, tags)
        loss, trials = state.f_info.as_min(), state.search_state
        is_short = state.terminate | ((trials.rejected == 0) & (before > loss) & (before - loss <= SETTLED * loss))
        size = trials.inner.step_size
        largest = jnp.asarray(1 / jnp.finfo(size.dtype).eps, size.dtype)

        full, _ = self.descent.step(largest, state.descent_state)
        is_close = jnp.all(jnp.abs(full) <= self.rtol * jnp.abs(y) + self.atol)
        is_level = 0.5 * jnp.sum(state.f_info.jac.mv(full) ** 2) <= SETTLED * loss
        is_held = is_short | (trials.rejected > 0)
        is_minimum = jnp.where(is_held, is_close | is_level, is_close & is_level) | (is_short & (size >= largest))
        # In optimistix the damping is the inverse of the step size.
        next_size = jnp.where(is_short & ~is_minimum, jnp.minimum(_UNDAMPED * size, largest), size)
        next_step, _ = self.descent.step(next_size, state.descent_state)
        if self.reach is not None:
            next_step = jnp.clip(next_step, -self.reach, self.reach)
        where = lambda s: (s.terminate, s.y_eval, s.search_state.inner.step_size)  # noqa: E731
        return y, eqx.tree_at(where, state, (is_minimum, y + next_step, next_size)), aux


def method_of(method: Any, size: int, rtol: float, atol: float, reach: Array | None = None) -> tuple[Any, str]:
    """The solver for a user's method, and its name.

    Args:
        method: method of optimistix or optax; None for the default.
        size: number of unknowns.
        rtol: relative tolerance of the default method.
        atol: absolute tolerance of the default method.
        reach: (size,) largest change of each unknown in one Levenberg-Marquardt step.

    Raises:
        ValueError: the method is of another kind, or has no search.
    """
    if method is None and size <= MANY:
        return _prepared(optx.LevenbergMarquardt(rtol, atol), reach), "Levenberg-Marquardt"
    if method is None:
        return _prepared(optx.LBFGS(rtol, atol, history_length=20)), "L-BFGS"
    if isinstance(method, optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser) and hasattr(method, "search"):
        return _prepared(method, reach), type(method).__name__
    if hasattr(method, "init") and hasattr(method, "update"):
        return optx.OptaxMinimiser(method, rtol, atol), "optax"
    raise ValueError(
        "Expected a method of optimistix with a search (LevenbergMarquardt, GaussNewton, Dogleg, BFGS, "
        f"LBFGS, ...) or an optimiser of optax, found {method!r}."
    )


def _prepared(method: Any, reach: Array | None = None) -> Any:
    """The method with steps that are counted and can be rejected."""
    if type(method) is optx.LevenbergMarquardt:
        plain = method
        solver = plain.descent.linear_solver  # type: ignore (the stubs do not declare the attributes)
        method = Marquardt(plain.rtol, plain.atol, plain.norm, solver, plain.verbose, reach)
        method = eqx.tree_at(lambda m: m.search, method, plain.search)
    if isinstance(method.search, optx.LearningRate):
        # Full steps if they lower the loss, shorter ones otherwise.
        search = optx.BacktrackingArmijo(step_init=method.search.learning_rate)
        method = eqx.tree_at(lambda m: m.search, method, search)
    if isinstance(getattr(method.descent, "linear_solver", None), lx.AutoLinearSolver):
        # SVD gives the shortest of all optimal steps; QR gives infinite steps if a column of the Jacobian vanishes.
        method = eqx.tree_at(lambda m: m.descent.linear_solver, method, lx.SVD())
    most = _MOST_HALVED if isinstance(method.search, optx.BacktrackingArmijo) else _MOST_QUARTERED
    return eqx.tree_at(lambda m: m.search, method, Counted(method.search, most))
