"""Runs of stabilised steps whose reverse pass takes the memory of only some of their states.

What enters: a rate, a stepper, and the times of its steps or a function that finds them. What leaves: the states at
some times, and the end of the run. The reverse pass (`reverse_pass.py`) repeats the steps between kept states. A
gradient of fixed steps costs a run, its repetition and its transpose, about three runs; checkpoints of whole steps cost
six or more.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._tables import AnyArray
from .reverse_pass import Rate, Requests, Rules, Trajectory, increment, reverse
from .stabilised import is_sensible

# Number of kept states, and of states on the tape, over the square root of the number n of fixed steps. With so many,
# steps of up to 36 stages are repeated only once.
_KEPT = 6
# Number of kept states, and of states on the tape, for adaptive steps, whose number is not known in advance.
_KEPT_OF_ADAPTIVE = 256
# Smallest number of states that are kept or on the tape, and the bytes that either of the two may take beyond it.
_SHORTEST = 32
_BYTES = 2**29

# Number of tapes that a segment between two kept states may fill with steps of 36 stages. Its first steps are repeated
# for each of them, and beyond this number recursive checkpoints are faster.
_RETRACED = 25


class Marks(NamedTuple):
    """Where a run of fixed steps keeps its state.

    Attributes:
        ends: (E,) numbers of steps, ascending; the last one is the number of all steps, perhaps more than once.
        requested: (T,) indices of the requested states among the initial state and the states at ``ends``.
    """

    ends: Int[AnyArray, " E"]
    requested: Int[AnyArray, " T"]

    @property
    def starts(self) -> Array:
        """(E + 1,) numbers of steps after which a state is kept, the initial state included."""
        return jnp.concatenate([jnp.zeros(1, self.ends.dtype), self.ends])


class FixedRun(NamedTuple):
    """The result of a run of fixed steps.

    Attributes:
        us: (T, V) or (T, V, S) requested states; infinite if the run did not reach them.
        u_end: final state.
        num_steps: number of steps taken.
        num_evaluations: number of evaluations of the rate.
        overflowed: whether the state became too large or NaN.
        stopped: whether the stopping condition held.
        is_reached: (T,) whether the run reached each requested time.
    """

    us: Float[Array, "T V *S"]
    u_end: Float[Array, "V *S"]
    num_steps: Int[Array, ""]
    num_evaluations: Int[Array, ""]
    overflowed: Bool[Array, ""]
    stopped: Bool[Array, ""]
    is_reached: Bool[Array, " T"]


class _Progress(NamedTuple):
    """The progress of a run: index of the next step, state, rate there, counts, and whether the run has ended."""

    step: Array
    state: Array
    rate: Array
    num_steps: Array
    num_evaluations: Array
    overflowed: Array
    stopped: Array


def marks_of(grid: np.ndarray, ts: np.ndarray, spacing: int) -> Marks:
    """Marks at the requested times, which agree with grid times up to rounding, and after every ``spacing`` steps."""
    count = len(grid) - 1
    after = np.clip(np.searchsorted(grid, ts), 1, count)
    at = np.where(ts - grid[after - 1] < grid[after] - ts, after - 1, after)
    between = np.arange(spacing, count, spacing)
    ends = np.unique(np.concatenate([at[at > 0], between, [count]]))
    # Their number does not depend on the times, so that other times need no compilation.
    ends = np.pad(ends, (0, len(ts) + len(between) + 1 - len(ends)), constant_values=count)
    return Marks(ends, np.searchsorted(ends, at, side="left") + (at > 0))


def is_worth_it(count: int | None, u0: AnyArray) -> bool:
    """Whether a tape is faster than recursive checkpoints for so many fixed steps (None for adaptive steps)."""
    return count is None or 36 * count <= _RETRACED * _kept_of_fixed(count, u0) ** 2


def spacing_of(count: int, u0: AnyArray) -> int:
    """The number of steps between two kept states, of ``count`` fixed steps."""
    return -(-count // _kept_of_fixed(count, u0))


def _kept_of_fixed(count: int, u0: AnyArray) -> int:
    return _affordable(math.ceil(_KEPT * math.sqrt(count)), u0)


def _affordable(number: int, u0: AnyArray) -> int:
    """At most this number of states, and no more than the memory limit allows."""
    return min(number, max(_SHORTEST, _BYTES // max(u0.nbytes, 1)))


@eqx.filter_custom_vjp
def run_fixed(
    start: tuple[Array, Rate], rules: Rules, times: Float[Array, " N"], marks: Marks, reverse_marks: Marks
) -> FixedRun:
    """A run of fixed steps.

    Args:
        start: the initial state and the rate ``(t, u) -> du/dt``, both differentiable in reverse mode. What the rate
            depends on must be among its leaves (see `equinox.filter_closure_convert`).
        rules: the parts of the run that are not differentiated.
        times: (n + 1,) times between which the steps are taken.
        marks: where the state is kept.
        reverse_marks: where the state is kept if there is a reverse pass.
    """
    del reverse_marks
    return _forward(start, rules, times, marks)[0]


@run_fixed.def_fwd
def _(perturbed, start, rules, times, marks, reverse_marks):
    del perturbed, marks
    return _forward(start, rules, times, reverse_marks)


@run_fixed.def_bwd
def _(residuals, cotangents, perturbed, start, rules, times, marks, reverse_marks):
    del marks
    states, num_steps = residuals
    starts, u0, count = reverse_marks.starts, start[0], len(times) - 1
    step = starts[reverse_marks.requested] - 1
    requests = Requests(step, jnp.ones(step.shape, times.dtype))
    longest, size = spacing_of(count, u0), max(_SHORTEST, _kept_of_fixed(count, u0))
    run = Trajectory(rules, times, starts, states, num_steps, requests, longest, size)
    ct = jnp.zeros_like(u0) if cotangents.u_end is None else cotangents.u_end
    return reverse(run, start[1], perturbed, ct, cotangents.us, None)


@eqx.filter_custom_vjp
def run_adaptive(
    start: tuple[Array, Rate], rules: Rules, record_times: Callable[..., Any], ts: Float[Array, " T"]
) -> Any:
    """A run of adaptive steps. Derivatives treat the lengths of the steps as constants.

    Args:
        start: the initial state and the rate, as in `run_fixed`.
        rules: the parts of the run that are not differentiated.
        record_times: ``(start, rules, is_recorded) -> (us, u_end, more), times``: the states at ``ts`` by cubic
            interpolation, the final state and anything else; and, if recorded, the times (N + 1,) between which the
            steps were taken, infinite beyond the last.
        ts: (T,) requested times.
    """
    del ts
    return record_times(start, rules, False)[0]


@run_adaptive.def_fwd
def _(perturbed, start, rules, record_times, ts):
    del perturbed, ts
    results, times = record_times(start, rules, True)
    return results, (times, results[1])


@run_adaptive.def_bwd
def _(residuals, cotangents, perturbed, start, rules, record_times, ts):
    del record_times
    times, u_end = residuals
    u0, num_steps = start[0], jnp.sum(jnp.isfinite(times)) - 1
    # In a batch, a run that has ended continues with steps of zero length.
    times = jnp.where(jnp.isfinite(times), times, times[num_steps])
    size = _affordable(_KEPT_OF_ADAPTIVE, u0)
    # At most as many segments as states on the tape divide the steps of the longest run of a batch.
    last = eqxi.unvmap_max(num_steps)
    spacing = jnp.maximum(-(-last // size), 1)
    starts = jnp.minimum(jnp.arange(size + 1) * spacing, last)
    # The last segment need not be run, since the final state is known.
    ends = jnp.minimum(starts[1:], jnp.maximum((last - 1) // spacing, 0) * spacing)
    endless = rules._replace(largest=jnp.full_like(rules.largest, jnp.inf), stop_when=None)
    _, (states, _) = _forward(start, endless, times, Marks(ends, jnp.zeros(0, starts.dtype)))
    step = jnp.searchsorted(times, ts, side="left").astype(num_steps.dtype) - 1
    begin, end = times[jnp.maximum(step, 0)], times[jnp.maximum(step, 0) + 1]
    requests = Requests(step, (ts - begin) / jnp.where(end > begin, end - begin, 1))
    longest = -(-(len(times) - 1) // size)
    run = Trajectory(rules, times, starts, states, num_steps, requests, longest, size)
    ct_us, ct, _ = cotangents
    return reverse(run, start[1], perturbed, jnp.zeros_like(u0) if ct is None else ct, ct_us, u_end)


def _forward(
    start: tuple[Array, Rate], rules: Rules, times: Array, marks: Marks
) -> tuple[FixedRun, tuple[Array, Array]]:
    """The run; and the states at its marks, with the number of its steps."""
    u0, rate = start
    take_step = functools.partial(_take_step, rate, rules, times)

    def to_mark(carry):
        i, states, progress = carry
        end = marks.ends[i]
        progress = jax.lax.while_loop(lambda progress: (progress.step < end) & _goes_on(progress), take_step, progress)
        return i + 1, states.at[i + 1].set(progress.state), progress

    zero, rate0 = jnp.zeros((), jnp.result_type(int)), rate(times[0], u0)
    # If u0 is a constant, XLA would constant-fold the whole buffer.
    first = jax.lax.optimization_barrier(u0)
    states = jnp.full((len(marks.ends) + 1, *u0.shape), jnp.inf, u0.dtype).at[0].set(first)
    begin = _Progress(zero, u0, rate0, zero, zero + 1, *_has_ended(rules, times[0], u0, rate0))
    _, states, end = jax.lax.while_loop(
        lambda carry: (carry[0] < len(marks.ends)) & _goes_on(carry[2]), to_mark, (zero, states, begin)
    )
    is_reached = marks.starts[marks.requested] <= end.num_steps
    us = jnp.where(is_reached.reshape(-1, *(1,) * u0.ndim), states[marks.requested], jnp.inf)
    return FixedRun(us, end.state, *end[3:], is_reached), (states, end.num_steps)


def _take_step(rate: Rate, rules: Rules, times: Array, progress: _Progress) -> _Progress:
    """The progress after one more step."""
    begin, end, u = times[progress.step], times[progress.step + 1], progress.state
    is_done = progress.overflowed | progress.stopped
    plan = rules.stepper.plan(rules.extent(begin, u), end - begin)
    # A run that has ended takes no stages: the spectral bound of a NaN state would ask for all of them.
    stages = jnp.where(is_done, 0, plan.stages)
    change, _ = increment(rate, plan, begin, u, progress.rate, stages)
    u1 = u + change
    rate1 = rate(end, u1)
    is_good = plan.is_stable & is_sensible(plan.dt, u, change, progress.rate, rate1)
    u1 = jnp.where(is_done, u, jnp.where(is_good, u1, jnp.nan))
    num_steps = progress.num_steps + (~is_done).astype(progress.num_steps.dtype)
    num_evaluations = progress.num_evaluations + stages.astype(progress.num_steps.dtype)
    overflowed, stopped = _has_ended(rules, end, u1, rate1)
    return _Progress(
        progress.step + 1, u1, rate1, num_steps, num_evaluations,
        progress.overflowed | ~is_done & overflowed, progress.stopped | ~is_done & stopped,
    )  # fmt: skip


def _has_ended(rules: Rules, t: Array, u: Array, rate: Array) -> tuple[Array, Array]:
    """Whether the state has overflowed, and whether the stopping condition holds."""
    # Negated, because every comparison with NaN is false.
    overflowed = ~(jnp.max(jnp.abs(u)) <= rules.largest)
    stopped = jnp.array(False) if rules.stop_when is None else rules.stop_when(t, u, rate)
    return overflowed, ~overflowed & stopped


def _goes_on(progress: _Progress) -> Array:
    # A single condition for the whole batch. With one for each run, every step would select among all kept states.
    return eqxi.unvmap_any(~(progress.overflowed | progress.stopped))
