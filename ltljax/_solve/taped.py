"""Runs of stabilised steps, with derivatives in reverse mode in the memory of some of their states.

What enters: a rate, a stepper and the times of its steps, or who finds them. What leaves: the states at some times, and
where the run ended. In the way back the steps from one kept state to the next are taken once more, and the states that
the rate was taken at go onto a tape; with them each stage has its transpose without being computed a third time. A
gradient of fixed steps costs a run, a run again and the transposed one, about three runs, where checkpoints of whole
steps cost six or more.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._tables import AnyArray
from .stabilised import FEWEST, Plan, Stabilised, is_sensible

# States that are kept of a run of n fixed steps, and as many on the tape, over sqrt(n): so many that steps of up to 36
# stages are taken again once and no more. Of adaptive steps, which are long and whose number is not known: so many.
_KEPT = 6
_KEPT_OF_ADAPTIVE = 256
# The shortest tape, and the bytes that what is kept may take, and the tape, where that leaves as many states.
_SHORTEST = 32
_BYTES = 2**29

# Tapes that a stretch between two kept states may take with steps of 36 stages. Its first steps are taken again for
# each, and beyond so many recursive checkpoints are quicker.
_RETRACED = 25

Rate = Callable[[Array, Array], Array]


class Marks(NamedTuple):
    """Where a run of fixed steps keeps its state.

    Attributes:
        ends: (E,) numbers of steps, ascending, the last that of all of them, perhaps more than once.
        kept: (T,) which of the states from the start on and at these ends are those at the times asked for.
    """

    ends: Int[AnyArray, " E"]
    kept: Int[AnyArray, " T"]


class March(NamedTuple):
    """What came of a run of fixed steps.

    Attributes:
        us: (T, V) or (T, V, S) states at the times asked for, infinite where the run did not get there.
        u_end: the state in the end.
        num_steps: how many were taken.
        num_evaluations: of the rate.
        overflowed: whether the state became too large or no number.
        stopped: whether the condition to stop held.
        is_reached: (T,) which times asked for the run got to.
    """

    us: Float[Array, "T V *S"]
    u_end: Float[Array, "V *S"]
    num_steps: Int[Array, ""]
    num_evaluations: Int[Array, ""]
    overflowed: Bool[Array, ""]
    stopped: Bool[Array, ""]
    is_reached: Bool[Array, " T"]


class Rules(NamedTuple):
    """What a run of stabilised steps follows, none of it differentiated.

    Attributes:
        stepper: what takes them.
        extent: ``(t, u) -> (2,)`` how far the eigenvalues extend, as of `Stabilised.extent`.
        largest: beyond it a state has overflowed.
        stop_when: ``(t, u, rate) -> bool``, or None.
    """

    stepper: Stabilised
    extent: Callable[[Array, Array], Array]
    largest: Float[Array, ""]
    stop_when: Callable[[Array, Array, Array], Array] | None


class Rows(NamedTuple):
    """Where in a run its states were asked for.

    Attributes:
        step: (T,) the step that reaches the time, ascending; -1 at the start.
        theta: (T,) how far into it, of its length.
    """

    step: Int[Array, " T"]
    theta: Float[Array, " T"]


def marks_of(grid: np.ndarray, ts: np.ndarray, spacing: int) -> Marks:
    """Marks at the times asked for, which are of the grid but for rounding, and in between after so many steps each."""
    count = len(grid) - 1
    after = np.clip(np.searchsorted(grid, ts), 1, count)
    at = np.where(ts - grid[after - 1] < grid[after] - ts, after - 1, after)
    between = np.arange(spacing, count, spacing)
    ends = np.unique(np.concatenate([at[at > 0], between, [count]]))
    # As many wherever they lie, so that nothing is compiled anew.
    ends = np.pad(ends, (0, len(ts) + len(between) + 1 - len(ends)), constant_values=count)
    return Marks(ends, np.searchsorted(ends, at, side="left") + (at > 0))


def is_worth_it(count: int | None, u0: AnyArray) -> bool:
    """Whether so many fixed steps (None: adaptive ones) have a tape of use: what fits is retraced seldom enough."""
    return count is None or 36 * count <= _RETRACED * _kept_of_fixed(count, u0) ** 2


def spacing_of(count: int, u0: AnyArray) -> int:
    """Of how many of so many fixed steps one has its state kept for the way back."""
    return -(-count // _kept_of_fixed(count, u0))


def _kept_of_fixed(count: int, u0: AnyArray) -> int:
    return _affordable(math.ceil(_KEPT * math.sqrt(count)), u0)


def _affordable(wanted: int, u0: AnyArray) -> int:
    return min(wanted, max(_SHORTEST, _BYTES // max(u0.nbytes, 1)))


@eqx.filter_custom_vjp
def march(start: tuple[Array, Rate], rules: Rules, times: Float[Array, " N"], marks: Marks, finer: Marks) -> March:
    """A run of fixed steps.

    Args:
        start: the state and the rate ``(t, u) -> du/dt``, both differentiable in reverse mode: what the rate depends on
            are its leaves (see `equinox.filter_closure_convert`).
        rules: what is followed.
        times: (n + 1,) where steps begin and end.
        marks: where the state is kept.
        finer: where it is kept if there is a way back.
    """
    del finer
    return _forward(start, rules, times, marks)[0]


@march.def_fwd
def _(perturbed, start, rules, times, marks, finer):
    del perturbed, marks
    return _forward(start, rules, times, finer)


@march.def_bwd
def _(residuals, cotangents, perturbed, start, rules, times, marks, finer):
    del marks
    states, taken = residuals
    starts, u0, count = _starts(finer), start[0], len(times) - 1
    step = starts[finer.kept] - 1
    back = _Back(rules, times, starts, states, taken, Rows(step, jnp.ones(step.shape, times.dtype)))
    longest, size = spacing_of(count, u0), max(_SHORTEST, _kept_of_fixed(count, u0))
    ct = jnp.zeros_like(u0) if cotangents.u_end is None else cotangents.u_end
    return _backward(back, start[1], perturbed, ct, cotangents.us, None, longest, size)


@eqx.filter_custom_vjp
def wander(start: tuple[Array, Rate], rules: Rules, explore: Callable[..., Any], ts: Float[Array, " T"]) -> Any:
    """A run of adaptive steps. The lengths of steps count as given in derivatives.

    Args:
        start: the state and the rate, as of `march`.
        rules: what is followed.
        explore: ``(start, rules, is_recorded) -> (us, u_end, further), times``: the states at ``ts`` by cubics, that in
            the end, whatever else; and where steps began and ended, (N + 1,) and infinite beyond the last, if asked.
        ts: (T,) the times asked for.
    """
    del ts
    return explore(start, rules, False)[0]


@wander.def_fwd
def _(perturbed, start, rules, explore, ts):
    del perturbed, ts
    found, times = explore(start, rules, True)
    return found, (times, found[1])


@wander.def_bwd
def _(residuals, cotangents, perturbed, start, rules, explore, ts):
    del explore
    times, u_end = residuals
    u0, taken = start[0], jnp.sum(jnp.isfinite(times)) - 1
    # Beyond the last step of a run in a batch there are steps of no length.
    times = jnp.where(jnp.isfinite(times), times, times[taken])
    size = _affordable(_KEPT_OF_ADAPTIVE, u0)
    longest = -(-(len(times) - 1) // size)
    # The steps of the longest run, between as many marks as there are or fewer.
    last = eqxi.unvmap_max(taken)
    spacing = jnp.maximum(-(-last // size), 1)
    starts = jnp.minimum(jnp.arange(size + 1) * spacing, last)
    # The state at the end of the last stretch is known, and none is asked for at marks.
    marks = Marks(jnp.minimum(starts[1:], jnp.maximum((last - 1) // spacing, 0) * spacing), jnp.zeros(0, starts.dtype))
    endless = rules._replace(largest=jnp.full_like(rules.largest, jnp.inf), stop_when=None)
    _, (states, _) = _forward(start, endless, times, marks)
    step = jnp.searchsorted(times, ts, side="left").astype(taken.dtype) - 1
    begin, end = times[jnp.maximum(step, 0)], times[jnp.maximum(step, 0) + 1]
    theta = (ts - begin) / jnp.where(end > begin, end - begin, 1)
    back = _Back(rules, times, starts, states, taken, Rows(step, theta))
    us, last_ct, _ = cotangents
    ct = jnp.zeros_like(u0) if last_ct is None else last_ct
    return _backward(back, start[1], perturbed, ct, us, u_end, longest, size)


def _forward(start: tuple[Array, Rate], rules: Rules, times: Array, marks: Marks) -> tuple[March, tuple[Array, Array]]:
    """The run; and the states at its marks, and the number of its steps."""
    u0, rate = start

    def ends_at(t, u, slope):
        # Not "is too large": a NaN compares false with everything.
        overflowed = ~(jnp.max(jnp.abs(u)) <= rules.largest)
        stopped = jnp.array(False) if rules.stop_when is None else rules.stop_when(t, u, slope)
        return overflowed, ~overflowed & stopped

    def take(walk):
        k, u, slope, taken, evaluations, overflowed, stopped = walk
        begin, end = times[k], times[k + 1]
        is_done = overflowed | stopped
        plan = rules.stepper.plan(rules.extent(begin, u), end - begin)
        # Without stages once it has ended: the bound of what is no number would ask for all of them.
        increment, _ = _increment(rate, plan, begin, u, slope, jnp.where(is_done, 0, plan.stages))
        found, before = u + increment, slope
        slope = rate(end, found)
        is_good = plan.is_stable & is_sensible(plan.dt, u, increment, before, slope)
        u = jnp.where(is_done, u, jnp.where(is_good, found, jnp.nan))
        taken = taken + (~is_done).astype(taken.dtype)
        evaluations = evaluations + jnp.where(is_done, 0, plan.stages).astype(taken.dtype)
        now = ends_at(end, u, slope)
        return k + 1, u, slope, taken, evaluations, overflowed | ~is_done & now[0], stopped | ~is_done & now[1]

    def goes_on(walk):
        # One answer for a whole batch: with one for each, a batch would select among all states that are kept.
        return eqxi.unvmap_any(~(walk[5] | walk[6]))

    def to_mark(carry):
        i, states, walk = carry
        end = marks.ends[i]
        walk = jax.lax.while_loop(lambda walk: (walk[0] < end) & goes_on(walk), take, walk)
        return i + 1, states.at[i + 1].set(walk[1]), walk

    zero, slope = jnp.zeros((), jnp.result_type(int)), rate(times[0], u0)
    overflowed, stopped = ends_at(times[0], u0, slope)
    # Of a known start XLA would make all of them a constant of the program.
    first = jax.lax.optimization_barrier(u0)
    states = jnp.full((len(marks.ends) + 1, *u0.shape), jnp.inf, u0.dtype).at[0].set(first)
    walk = (zero, u0, slope, zero, zero + 1, overflowed, stopped)
    _, states, walk = jax.lax.while_loop(
        lambda carry: (carry[0] < len(marks.ends)) & goes_on(carry[2]), to_mark, (zero, states, walk)
    )
    is_reached = _starts(marks)[marks.kept] <= walk[3]
    us = jnp.where(is_reached.reshape(-1, *(1,) * u0.ndim), states[marks.kept], jnp.inf)
    return March(us, walk[1], *walk[3:], is_reached), (states, walk[3])


class _Back(NamedTuple):
    """What the way back of a run rests on: its rules, times, marks, states at these, number of steps, rows."""

    rules: Rules
    times: Array
    starts: Array
    states: Array
    taken: Array
    rows: Rows


def _backward(
    back: _Back,
    rate: Any,
    perturbed: tuple[Any, Any],
    ct: Array,
    ct_us: Array | None,
    u_end: Array | None,
    longest: int,
    size: int,
) -> tuple[Array | None, Any]:
    """The cotangents of the start and of what is perturbed of the rate, from those of the end and the states asked for.

    Args:
        back: what it rests on.
        rate: of the run.
        perturbed: which of the start and of the rate's arrays are.
        ct: the cotangent of the state in the end.
        ct_us: those of the states asked for, or None.
        u_end: the state in the end, if rows are in the middle of steps.
        longest: how many steps there can be between two marks.
        size: how many states the tape holds.
    """
    rules, times, starts, states, taken, rows = back
    wanted, fixed = eqx.partition(rate, perturbed[1])
    zero, none = jnp.zeros_like(ct), jax.tree.map(jnp.zeros_like, wanted)

    def with_rows(k, sums, is_followed, ct_us=ct_us):
        """With the cotangents of states asked for within step k; and of the rate at its start by that in step k - 1."""
        if ct_us is None:
            return sums

        def with_row(row, sums):
            last, slope, through = sums
            step, x = rows.step[row], rows.theta[row]
            given, is_here = jnp.where(step < taken, ct_us[row], 0), step == k
            # A cubic in x of the states and the rates at both ends of the step; what is asked of its end goes on to its
            # start, and the weights of both states sum to one.
            rates = jnp.where(is_here, x * (1 - x) ** 2, jnp.where(is_followed, x**2 * (x - 1), 0))
            slope = slope + (times[step + 1] - times[step]) * rates * given
            return (
                last + jnp.where(is_here, x**2 * (3 - 2 * x), 0) * given,
                slope,
                through + jnp.where(is_here, given, 0),
            )

        first, end = (jnp.searchsorted(rows.step, n, side=side) for n, side in ((k - 1, "left"), (k, "right")))
        first = jnp.maximum(first, jnp.searchsorted(rows.step, 0))
        return jax.lax.fori_loop(first, end, with_row, sums)

    def on_arrival(k, ct):
        """At the end of step k, the cotangents of its last two increments, of the rate at its start, of that start by
        way of the rates at its stages, and of the start otherwise."""
        is_taken = k < taken
        last, slope, through = with_rows(k, (jnp.where(is_taken, ct, 0), zero, ct), is_taken)
        return last, zero, slope, zero, through

    def pulled_back(k, t, u, ct, gradient):
        """The cotangent of the state by way of the rate at it, and the gradient with what that adds."""
        found, pulled = jax.vjp(lambda wanted, u: eqx.combine(wanted, fixed)(t, u), wanted, u)[1](ct)
        # In a batch a run that has ended may stand where the rate has no derivative.
        found, pulled = jax.tree.map(lambda x: jnp.where(k < taken, x, 0), (found, pulled))
        return pulled, jax.tree.map(jnp.add, gradient, found)

    def segment(carry):
        i, sums, total, tape = carry
        begin = starts[i]
        last = jnp.minimum(starts[i + 1], eqxi.unvmap_max(taken)) - 1

        def replay(k_last, q_last, tape):
            """States that the rate is taken at, up to number q of step k; to its last where q is negative."""

            def again(walk):
                k, u, position, tape, positions, extents = walk
                t = times[k]
                extent = rules.extent(t, u)
                positions, extents = positions.at[k - begin].set(position), extents.at[k - begin].set(extent)
                plan = rules.stepper.plan(extent, times[k + 1] - t)
                # Of a batch the longest step leads, of runs that have not ended.
                stages = eqxi.unvmap_max(jnp.where(k < taken, plan.stages, FEWEST)).astype(k.dtype)
                until = jnp.where(k < k_last, stages, jnp.where(q_last < 0, stages - 1, q_last))

                def write(j, v, tape):
                    return jax.lax.dynamic_update_index_in_dim(tape, v, (position + j) % size, 0)

                increment, tape = _increment(rate, plan, t, u, rate(t, u), until, write, tape)
                # The last increment of a step gave the first state of the next.
                return k + 1, jnp.where(k < taken, u + increment, u), position + until, tape, positions, extents

            tape = jax.lax.dynamic_update_index_in_dim(tape, states[i], 0, 0)
            positions, extents = jnp.zeros(longest, begin.dtype), jnp.zeros((longest, 2), times.dtype)
            walk = (begin, states[i], jnp.zeros_like(begin), tape, positions, extents)
            return jax.lax.while_loop(lambda walk: walk[0] <= k_last, again, walk)[2:]

        def block(carry):
            """As far back as the tape goes."""
            k, q, sums, gradient, tape = carry
            top, tape, positions, extents = replay(k, q, tape)
            # A step that ends at its start wrote one state more.
            lowest = jnp.maximum(top - size + 2, 0)

            def step(carry):
                k, top, sums, gradient = carry
                t, position = times[k], positions[k - begin]
                plan = rules.stepper.plan(extents[k - begin], times[k + 1] - t)

                # Increment j is d_j = mu_j d_(j-1) + nu_j d_(j-2) + dt (mu'_j f(u + d_(j-1)) + gamma'_j f(u)): its
                # cotangent goes on to the two before, to the state in two ways, and to the rate at the start.
                def stage(carry):
                    top, (last, before, slope, by_rates, through), gradient = carry
                    j = top - position + 1
                    mu, nu, mu_rate, gamma_rate = plan.coefficients(j)
                    given = plan.dt * mu_rate * last
                    pulled, gradient = pulled_back(k, plan.time(t, j), tape[top % size], given, gradient)
                    slope = slope + plan.dt * gamma_rate * last
                    return (
                        top - 1,
                        (before + mu * last + pulled, nu * last, slope, by_rates + pulled, through),
                        gradient,
                    )

                def to_start(k, top, sums, gradient):
                    last, _, slope, by_rates, through = sums
                    pulled, gradient = pulled_back(k, t, tape[top % size], slope + plan.first(last), gradient)
                    # Summed up before they meet the state's, which are larger by the inverse of the step.
                    return k - 1, top - 1, on_arrival(k - 1, through + (by_rates + pulled)), gradient

                top, sums, gradient = jax.lax.while_loop(
                    lambda carry: carry[0] > jnp.maximum(position, lowest - 1), stage, (top, sums, gradient)
                )
                is_there = (top == position) & (top >= lowest)
                return jax.lax.cond(is_there, to_start, lambda *same: same, k, top, sums, gradient)

            k, top, sums, gradient = jax.lax.while_loop(
                lambda carry: carry[1] >= lowest, step, (k, top, sums, gradient)
            )
            # Of a step that is on the tape in part, where to go on; of the next, its end.
            q = jnp.where((k >= begin) & (top >= positions[k - begin]), top - positions[k - begin], -1)
            return k, q, sums, gradient, tape

        start = (last, -jnp.ones_like(last), sums, none, tape)
        *_, sums, gradient, tape = jax.lax.while_loop(lambda carry: carry[0] >= begin, block, start)
        # Sums of sums, whose rounding does not grow with the number of stages.
        return i - 1, sums, jax.tree.map(jnp.add, total, gradient), tape

    gradient = none
    if u_end is not None and ct_us is not None:
        # The rate in the end is that of no step that follows.
        _, slope, _ = with_rows(taken, (zero, zero, zero), True)
        pulled, gradient = pulled_back(taken - 1, times[taken], u_end, slope, gradient)
        ct = ct + pulled
    last = eqxi.unvmap_max(taken)
    i = jnp.searchsorted(starts, last).astype(starts.dtype) - 1
    tape = jnp.zeros((size, *ct.shape), ct.dtype)
    _, (*_, ct), gradient, _ = jax.lax.while_loop(
        lambda carry: carry[0] >= 0, segment, (i, on_arrival(last - 1, ct), gradient, tape)
    )
    if ct_us is not None:
        at_start = rows.step < 0
        ct = ct + jnp.sum(jnp.where(at_start.reshape(-1, *(1,) * ct.ndim), ct_us, 0), axis=0)
    return (ct if perturbed[0] else None), gradient


def _starts(marks: Marks) -> Array:
    """After how many steps the states that are kept are reached, from the start on."""
    return jnp.concatenate([jnp.zeros(1, marks.ends.dtype), marks.ends])


def _increment(
    rate: Rate,
    plan: Plan,
    t: Array,
    u: Array,
    slope: Array,
    until: Array,
    write: Callable[[ArrayLike, Array, Any], Any] = lambda j, v, tape: tape,
    tape: Any = (),
) -> tuple[Array, Any]:
    """The increment of a stage of a step from a state with a slope; what is written of the states until then."""

    def stage(carry):
        j, before, last, tape = carry
        new = plan.stage(j, before, last, rate(plan.time(t, j), u + last), slope)
        return j + 1, last, new, write(j, u + new, tape)

    first = plan.first(slope)
    start = (jnp.full((), 2, until.dtype), jnp.zeros_like(u), first, write(1, u + first, tape))
    *_, increment, tape = jax.lax.while_loop(lambda carry: carry[0] <= until, stage, start)
    return increment, tape
