"""The reverse pass of a run of stabilised steps, by means of a tape of stage states.

What enters: the states that a run kept at some of its steps, and the cotangents of its results. What leaves: the
cotangents of its initial state and of what its rate depends on.

The pass goes backwards from one kept state to the one before (a segment). The steps of a segment are repeated, and the
states at which the rate is evaluated are written to the tape, so that each stage can be transposed without being
computed a third time. If the tape is too short for a segment, the segment is transposed in blocks, the last one first.
For each block, the steps from the start of the segment to the end of the block are repeated. The tape is a ring buffer
and keeps the states written last.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from .stabilised import FEWEST, Plan, Stabilised

Rate = Callable[[Array, Array], Array]


class Rules(NamedTuple):
    """The parts of a run that are not differentiated.

    Attributes:
        stepper: the stepper.
        extent: ``(t, u) -> (2,)`` spectral bound and width, as in `Stabilised.extent`.
        largest: magnitude beyond which a state has overflowed.
        stop_when: ``(t, u, rate) -> bool``, or None.
    """

    stepper: Stabilised
    extent: Callable[[Array, Array], Array]
    largest: Float[Array, ""]
    stop_when: Callable[[Array, Array, Array], Array] | None


class Requests(NamedTuple):
    """Where in a run its states were requested.

    Attributes:
        step: (T,) index of the step that reaches the requested time, ascending; -1 for the initial time.
        theta: (T,) fraction of that step at which the time lies.
    """

    step: Int[Array, " T"]
    theta: Float[Array, " T"]


class Trajectory(NamedTuple):
    """A run as the reverse pass needs it.

    Attributes:
        rules: the parts of the run that are not differentiated.
        times: (n + 1,) times between which the steps were taken.
        starts: (E + 1,) numbers of steps after which a state was kept, ascending from 0.
        states: (E + 1, V, ...) the states kept.
        num_steps: number of steps taken.
        requests: where states were requested.
        longest: largest number of steps in a segment.
        size: number of states on the tape.
    """

    rules: Rules
    times: Array
    starts: Array
    states: Array
    num_steps: Array
    requests: Requests
    longest: int
    size: int


class _Pass(NamedTuple):
    """What stays the same throughout a reverse pass.

    Attributes:
        run: the trajectory.
        parameters: the parts of the rate that have a cotangent.
        constants: the other parts of the rate.
        ct_us: (T, V, ...) cotangents of the requested states, or None.
    """

    run: Trajectory
    parameters: Any
    constants: Any
    ct_us: Array | None

    def rate(self, parameters: Any, t: Array, u: Array) -> Array:
        return eqx.combine(parameters, self.constants)(t, u)


class _Cotangents(NamedTuple):
    """The cotangents within a step, each of the shape of a state.

    Attributes:
        last: cotangent of the last increment.
        before: cotangent of the increment before.
        first_rate: cotangent of the rate at the start of the step.
        start_by_rates: the part of the cotangent of the step's start that comes through the stage rates.
        start: the remaining part of the cotangent of the step's start.
    """

    last: Array
    before: Array
    first_rate: Array
    start_by_rates: Array
    start: Array


class _Tape(NamedTuple):
    """The stage states of the last steps of a segment.

    Attributes:
        states: (size, V, ...) stage states; stage state p of the segment lies at p modulo the size.
        positions: (longest,) index, within the segment, of the first stage state of each step, which is its start.
        extents: (longest, 2) spectral bound and width at the start of each step.
    """

    states: Array
    positions: Array
    extents: Array


class _Replay(NamedTuple):
    """The progress of repeating steps: index, initial state and first stage state's index of the next step."""

    step: Array
    state: Array
    position: Array
    tape: _Tape


class _Segment(NamedTuple):
    """The progress over segments: index of the next one, cotangents at its end, gradient, and buffer of the tape."""

    number: Array
    cotangents: _Cotangents
    gradient: Any
    tape_states: Array


class _Block(NamedTuple):
    """The progress within a segment.

    Attributes:
        step: index of the next step to transpose.
        stage: index, within the step, of the last stage state still to transpose (0 is the start of the step); -1 if
            nothing of the segment has been transposed.
        cotangents: cotangents within the step.
        gradient: gradient of the segment so far.
        tape_states: buffer of the tape.
    """

    step: Array
    stage: Array
    cotangents: _Cotangents
    gradient: Any
    tape_states: Array


class _Backward(NamedTuple):
    """The progress within a block: index of the step, index of the next stage state to transpose, and cotangents."""

    step: Array
    top: Array
    cotangents: _Cotangents
    gradient: Any


def increment(
    rate: Rate,
    plan: Plan,
    t: Array,
    u: Array,
    rate0: Array,
    until: Array,
    write: Callable[[ArrayLike, Array, Any], Any] = lambda j, v, tape: tape,
    tape: Any = (),
) -> tuple[Array, Any]:
    """The increment of stage ``until`` of a step from u, and the tape to which the stage states were written."""

    def stage(carry):
        j, before, last, tape = carry
        new = plan.stage(j, before, last, rate(plan.time(t, j), u + last), rate0)
        return j + 1, last, new, write(j, u + new, tape)

    first = plan.first(rate0)
    start = (jnp.full((), 2, until.dtype), jnp.zeros_like(u), first, write(1, u + first, tape))
    *_, last, tape = jax.lax.while_loop(lambda carry: carry[0] <= until, stage, start)
    return last, tape


def reverse(
    run: Trajectory,
    rate: Any,
    perturbed: tuple[Any, Any],
    ct: Array,
    ct_us: Array | None,
    u_end: Array | None,
) -> tuple[Array | None, Any]:
    """The cotangents of the initial state and of the perturbed parts of the rate.

    Args:
        run: the run.
        rate: rate of the run.
        perturbed: whether the initial state, and which leaves of the rate, are differentiated.
        ct: cotangent of the final state.
        ct_us: cotangents of the requested states, or None.
        u_end: final state, needed if states were requested in the middle of steps.
    """
    parameters, constants = eqx.partition(rate, perturbed[1])
    context = _Pass(run, parameters, constants, ct_us)
    gradient, zero = jax.tree.map(jnp.zeros_like, parameters), jnp.zeros_like(ct)
    if u_end is not None and ct_us is not None:
        # The rate at the final state needs a separate transpose, because no further step begins there.
        _, first_rate, _ = _with_requests(context, run.num_steps, (zero, zero, zero), True)
        pulled, gradient = _pull_back(context, run.num_steps - 1, run.times[run.num_steps], u_end, first_rate, gradient)
        ct = ct + pulled
    last = eqxi.unvmap_max(run.num_steps)
    number = jnp.searchsorted(run.starts, last).astype(run.starts.dtype) - 1
    tape_states = jnp.zeros((run.size, *ct.shape), ct.dtype)
    end = jax.lax.while_loop(
        lambda segment: segment.number >= 0,
        functools.partial(_transpose_segment, context),
        _Segment(number, _at_end_of_step(context, last - 1, ct), gradient, tape_states),
    )
    ct = end.cotangents.start
    if ct_us is not None:
        is_initial = (run.requests.step < 0).reshape(-1, *(1,) * ct.ndim)
        ct = ct + jnp.sum(jnp.where(is_initial, ct_us, 0), axis=0)
    return (ct if perturbed[0] else None), end.gradient


def _with_requests(
    context: _Pass, k: Array, sums: tuple[Array, Array, Array], is_followed: Array | bool
) -> tuple[Array, Array, Array]:
    """Cotangents with those of the states requested within step k and, if step k was taken, within step k - 1.

    A requested state is the cubic Hermite interpolant of its step. The end of a step is its start plus the last
    increment, so the whole cotangent goes to the start, and the share theta^2 (3 - 2 theta) also to the last increment.
    The rate at the end of step k - 1 is the rate at the start of step k, so its share is added with step k.

    Args:
        context: the reverse pass.
        k: index of the step.
        sums: cotangents of the last increment, of the rate at the start, and of the start.
        is_followed: whether the states requested within step k - 1 contribute to the rate at its end.
    """
    if context.ct_us is None:
        return sums
    ct_us, (steps, thetas), times = context.ct_us, context.run.requests, context.run.times

    def add(row, sums):
        last, first_rate, start = sums
        step, x = steps[row], thetas[row]
        ct, is_within = jnp.where(step < context.run.num_steps, ct_us[row], 0), step == k
        weight = jnp.where(is_within, x * (1 - x) ** 2, jnp.where(is_followed, x**2 * (x - 1), 0))
        first_rate = first_rate + (times[step + 1] - times[step]) * weight * ct
        return (
            last + jnp.where(is_within, x**2 * (3 - 2 * x), 0) * ct,
            first_rate,
            start + jnp.where(is_within, ct, 0),
        )

    first, end = (jnp.searchsorted(steps, n, side=side) for n, side in ((k - 1, "left"), (k, "right")))
    return jax.lax.fori_loop(jnp.maximum(first, jnp.searchsorted(steps, 0)), end, add, sums)


def _at_end_of_step(context: _Pass, k: Array, ct: Array) -> _Cotangents:
    """The cotangents within step k, before its last stage is transposed, from the cotangent of its end."""
    is_taken, zero = k < context.run.num_steps, jnp.zeros_like(ct)
    last, first_rate, start = _with_requests(context, k, (jnp.where(is_taken, ct, 0), zero, ct), is_taken)
    return _Cotangents(last, zero, first_rate, zero, start)


def _pull_back(context: _Pass, k: Array, t: Array, u: Array, ct: Array, gradient: Any) -> tuple[Array, Any]:
    """The cotangent that the rate at (t, u) passes to u, and the gradient with its contribution."""
    _, transpose = jax.vjp(lambda parameters, u: context.rate(parameters, t, u), context.parameters, u)
    # In a batch, the final state of a run that has ended may be one where the rate has no derivative.
    added, pulled = jax.tree.map(lambda x: jnp.where(k < context.run.num_steps, x, 0), transpose(ct))
    return pulled, jax.tree.map(jnp.add, gradient, added)


def _transpose_segment(context: _Pass, segment: _Segment) -> _Segment:
    run, zero = context.run, jax.tree.map(jnp.zeros_like, context.parameters)
    begin = run.starts[segment.number]
    last = jnp.minimum(run.starts[segment.number + 1], eqxi.unvmap_max(run.num_steps)) - 1
    end = jax.lax.while_loop(
        lambda block: block.step >= begin,
        functools.partial(_transpose_block, context, segment.number),
        _Block(last, -jnp.ones_like(last), segment.cotangents, zero, segment.tape_states),
    )
    # The gradient is a sum of sums, whose rounding does not grow with the number of stages.
    gradient = jax.tree.map(jnp.add, segment.gradient, end.gradient)
    return _Segment(segment.number - 1, end.cotangents, gradient, end.tape_states)


def _transpose_block(context: _Pass, number: Array, block: _Block) -> _Block:
    """Transpose the last remaining stages of a segment, as many as the tape holds."""
    begin = context.run.starts[number]
    top, tape = _replay(context, number, block)
    # If only the start of the last step remains, `increment` still writes stage 1, which overwrites one more row.
    lowest = jnp.maximum(top - context.run.size + 2, 0)
    end = jax.lax.while_loop(
        lambda carry: carry.top >= lowest,
        functools.partial(_transpose_step, context, tape, begin, lowest),
        _Backward(block.step, top, block.cotangents, block.gradient),
    )
    # Index, within its step, of the last stage state still to transpose.
    remaining = end.top - tape.positions[end.step - begin]
    stage = jnp.where((end.step >= begin) & (end.top >= tape.positions[end.step - begin]), remaining, -1)
    return _Block(end.step, stage, end.cotangents, end.gradient, tape.states)


def _replay(context: _Pass, number: Array, block: _Block) -> tuple[Array, _Tape]:
    """The index, within the segment, of the last stage state still to transpose, and the tape up to it."""
    run, begin = context.run, context.run.starts[number]
    tape_states = jax.lax.dynamic_update_index_in_dim(block.tape_states, run.states[number], 0, 0)
    tape = _Tape(tape_states, jnp.zeros(run.longest, begin.dtype), jnp.zeros((run.longest, 2), run.times.dtype))
    end = jax.lax.while_loop(
        lambda replay: replay.step <= block.step,
        functools.partial(_repeat_step, context, begin, block),
        _Replay(begin, run.states[number], jnp.zeros_like(begin), tape),
    )
    return end.position, end.tape


def _repeat_step(context: _Pass, begin: Array, block: _Block, replay: _Replay) -> _Replay:
    """Repeat a step of a segment and write its stage states to the tape."""
    run, (k, u, position, tape) = context.run, replay
    rate, t = functools.partial(context.rate, context.parameters), run.times[k]
    extent = run.rules.extent(t, u)
    positions, extents = tape.positions.at[k - begin].set(position), tape.extents.at[k - begin].set(extent)
    plan = run.rules.stepper.plan(extent, run.times[k + 1] - t)
    # Under vmap, use the largest number of stages among the runs that have not ended.
    stages = eqxi.unvmap_max(jnp.where(k < run.num_steps, plan.stages, FEWEST)).astype(k.dtype)
    # Every step but the last runs all its stages, because its end is the start of the next step.
    last_stage = jnp.where(block.stage < 0, stages - 1, block.stage)
    until = jnp.where(k < block.step, stages, last_stage)

    def write(j, v, states):
        return jax.lax.dynamic_update_index_in_dim(states, v, (position + j) % run.size, 0)

    change, states = increment(rate, plan, t, u, rate(t, u), until, write, tape.states)
    u = jnp.where(k < run.num_steps, u + change, u)
    return _Replay(k + 1, u, position + until, _Tape(states, positions, extents))


def _transpose_step(context: _Pass, tape: _Tape, begin: Array, lowest: Array, carry: _Backward) -> _Backward:
    """Transpose the stages of a step that are on the tape, and its start if it is on the tape."""
    t, position = context.run.times[carry.step], tape.positions[carry.step - begin]
    plan = context.run.rules.stepper.plan(tape.extents[carry.step - begin], context.run.times[carry.step + 1] - t)
    carry = jax.lax.while_loop(
        lambda carry: carry.top > jnp.maximum(position, lowest - 1),
        functools.partial(_transpose_stage, context, tape, position, plan),
        carry,
    )
    is_on_tape = (carry.top == position) & (carry.top >= lowest)
    return jax.lax.cond(
        is_on_tape, functools.partial(_transpose_start, context, tape, plan), lambda carry: carry, carry
    )


def _transpose_stage(context: _Pass, tape: _Tape, position: Array, plan: Plan, carry: _Backward) -> _Backward:
    """Transpose ``d_j = mu_j d_(j-1) + nu_j d_(j-2) + dt (mu'_j f(u + d_(j-1)) + gamma'_j f(u))``.

    The cotangent of increment j goes to the two increments before it, to the state u and to the rate there.
    """
    k, top, ct, gradient = carry
    j = top - position + 1
    mu, nu, mu_rate, gamma_rate = plan.coefficients(j)
    ct_rate = plan.dt * mu_rate * ct.last
    t = plan.time(context.run.times[k], j)
    pulled, gradient = _pull_back(context, k, t, tape.states[top % context.run.size], ct_rate, gradient)
    first_rate = ct.first_rate + plan.dt * gamma_rate * ct.last
    ct = _Cotangents(ct.before + mu * ct.last + pulled, nu * ct.last, first_rate, ct.start_by_rates + pulled, ct.start)
    return _Backward(k, top - 1, ct, gradient)


def _transpose_start(context: _Pass, tape: _Tape, plan: Plan, carry: _Backward) -> _Backward:
    """Transpose the first increment and the rate at the start of a step, and go to the end of the step before."""
    k, top, ct, gradient = carry
    ct_rate = ct.first_rate + plan.first(ct.last)
    pulled, gradient = _pull_back(
        context, k, context.run.times[k], tape.states[top % context.run.size], ct_rate, gradient
    )
    # The contributions of the rates are summed first: they are smaller than that of the state by the length of a step.
    start = ct.start + (ct.start_by_rates + pulled)
    return _Backward(k - 1, top - 1, _at_end_of_step(context, k - 1, start), gradient)
