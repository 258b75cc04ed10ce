"""How steps are taken: methods of optimistix, their trials counted, and none that cannot take a step back.

What enters: the method that a user names, or none. What leaves: a solver for `fit`, and its name.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array

# From this many unknowns on Jacobians are not formed: gradients in reverse mode feed L-BFGS.
MANY = 64
# A step that lowers the loss by less than this share is the last.
SETTLED = 1e-8
# Trials rejected in a row after which no step lowers the loss: of methods that shorten steps to a quarter, to a half.
_MOST_QUARTERED, _MOST_HALVED = 12, 24
# By how much damping falls where it, and not a minimum, makes steps short.
_UNDAMPED = 1e3


class Trials(eqx.Module):
    """What became of a method's steps since one was last taken.

    Attributes:
        inner: the state of the search itself.
        rejected: how many in a row lowered the loss too little.
        failed: at how many of the last ones, in a row, the model failed.
    """

    inner: Any
    rejected: Array
    failed: Array


class Counted(optx.AbstractSearch):
    """A search of optimistix that counts the steps it rejects. Where a model fails the loss is infinite, and too high.

    Attributes:
        search: the search.
        most: how many rejections in a row end it.
    """

    search: optx.AbstractSearch
    most: int = eqx.field(static=True)

    def init(self, y, f_info_struct):
        """Nothing rejected yet."""
        return Trials(self.search.init(y, f_info_struct), jnp.array(0), jnp.array(0))

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        """As the search itself."""
        size, accept, result, inner = self.search.step(first_step, y, y_eval, f_info, f_eval_info, state.inner)
        has_failed = ~jnp.isfinite(f_eval_info.as_min())
        rejected = jnp.where(accept, 0, state.rejected + 1)
        return size, accept, result, Trials(inner, rejected, jnp.where(has_failed, state.failed + 1, 0))


class Marquardt(optx.LevenbergMarquardt):
    """Levenberg-Marquardt that does not take a step made short by damping for the end.

    If the data determine one direction a thousand times better than another, damping that suits the first holds back
    the second, and steps become short far from the minimum. So short steps, and rejected ones, are compared with the
    step that Gauss and Newton would take. If that is short as well, or would lower the loss by no more than `SETTLED`,
    the minimum is reached; otherwise damping is reduced. Where steps are long, both must hold.

    No step changes an unknown by more than ``reach``. A run far from all parameters that make sense may take thousands
    of times as long as any other, only for its step to be rejected.

    Attributes:
        reach: (n,) largest change of each unknown in one step; None for any.
    """

    reach: Array | None

    def __init__(self, rtol, atol, norm, linear_solver, verbose, reach=None):
        super().__init__(rtol, atol, norm, linear_solver, verbose)
        self.reach = reach

    def step(self, fn, y, args, options, state, tags):
        """As of optimistix, with another end."""
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
        is_there = jnp.where(is_held, is_close | is_level, is_close & is_level) | (is_short & (size >= largest))
        freer = jnp.where(is_short & ~is_there, jnp.minimum(_UNDAMPED * size, largest), size)
        ahead, _ = self.descent.step(freer, state.descent_state)
        if self.reach is not None:
            ahead = jnp.clip(ahead, -self.reach, self.reach)
        where = lambda s: (s.terminate, s.y_eval, s.search_state.inner.step_size)  # noqa: E731
        return y, eqx.tree_at(where, state, (is_there, y + ahead, freer)), aux


def method_of(method: Any, size: int, rtol: float, atol: float, reach: Array | None = None) -> tuple[Any, str]:
    """The solver that a user's method becomes, and its name.

    Args:
        method: of optimistix or optax, or None.
        size: the number of unknowns.
        rtol: of the solver where the user names none.
        atol: as ``rtol``.
        reach: (size,) largest change of each unknown in one step of Levenberg and Marquardt's method.

    Raises:
        ValueError: it is no method, or one without a search.
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
        "Expected a method of optimistix that steps along a search (LevenbergMarquardt, GaussNewton, Dogleg, BFGS, "
        f"LBFGS, ...) or an optimiser of optax, found {method!r}."
    )


def _prepared(method: Any, reach: Array | None = None) -> Any:
    """A method whose steps are counted and can be taken back."""
    if type(method) is optx.LevenbergMarquardt:
        kept = method
        method = Marquardt(kept.rtol, kept.atol, kept.norm, kept.descent.linear_solver, kept.verbose, reach)  # type: ignore (not seen as a class of optimistix's)
        method = eqx.tree_at(lambda m: m.search, method, kept.search)
    if isinstance(method.search, optx.LearningRate):
        # Whole steps where they lower the loss, shorter ones where not.
        search = optx.BacktrackingArmijo(step_init=method.search.learning_rate)
        method = eqx.tree_at(lambda m: m.search, method, search)
    if isinstance(getattr(method.descent, "linear_solver", None), lx.AutoLinearSolver):
        # The least of the best steps: those of a QR decomposition are infinite where columns vanish.
        method = eqx.tree_at(lambda m: m.descent.linear_solver, method, lx.SVD())
    most = _MOST_HALVED if isinstance(method.search, optx.BacktrackingArmijo) else _MOST_QUARTERED
    return eqx.tree_at(lambda m: m.search, method, Counted(method.search, most))
