"""Runs that are made interval by interval, with the state at the end of each interval put on disk.

What enters: a `Run` and a `Keeper`, which may hold the first intervals already. What leaves: a `Solution`.
"""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from .integrate import Run, integrate
from .restart import Keeper
from .solution import Solution
from .stepping import without_near_duplicates

# Default number of intervals.
_INTERVALS = 20


def integrate_in_intervals(run: Run, keeper: Keeper, t0: float, t1: float, every: float | None) -> Solution:
    """The solution of a run that is kept on disk.

    The states at the requested times are kept permanently, on disk and in memory.

    Args:
        run: the run.
        keeper: the states on disk.
        t0: initial time.
        t1: final time.
        every: length of the intervals, which also end at the requested times; by default a twentieth of the run.
    """
    if t1 == t0:
        return integrate(run)
    every = (t1 - t0) / _INTERVALS if every is None else every
    requested, slack = np.asarray(run.ts, np.float64), 1e-6 * every
    ends = _interval_ends(run, t0, t1, every, slack)
    # The interval at whose end each requested time lies; interval 0 ends at t0.
    places = np.abs(ends - requested[:, None]).argmin(axis=1)
    _drop_unusable(keeper, places.tolist(), len(ends))
    states = {0: np.asarray(run.u0)} | {
        record["interval"]: keeper.state(index)
        for index, record in enumerate(keeper.done)
        if record["interval"] in places
    }
    solution, last = _remaining_intervals(run, keeper, ends, places, states)
    keeper.end()
    is_reached = (np.abs(ends[places] - requested) <= slack) & (ends[places] <= last["t"])
    missing = np.full(run.u0.shape, np.nan, run.u0.dtype)
    us = [states[place] if reached else missing for place, reached in zip(places.tolist(), is_reached, strict=True)]
    return dataclasses.replace(
        solution,
        ts=jnp.asarray(np.where(is_reached, requested, np.inf), run.ts.dtype),
        us=jnp.asarray(np.stack(us)),
        counts={name: jnp.asarray(count) for name, count in last["counts"].items()},
    )


def _interval_ends(run: Run, t0: float, t1: float, every: float, slack: float) -> np.ndarray:
    """t0, and the time at which each interval ends."""
    multiples = t0 + every * np.arange(1, np.ceil((t1 - t0) / every))
    ends = without_near_duplicates(t0, t1, (np.asarray(run.ts, np.float64), multiples), slack)
    if run.grid is None:
        return ends
    # Intervals consist of whole steps.
    grid = run.grid.astype(np.float64)
    return np.unique(grid[np.minimum(np.searchsorted(grid, ends - slack), len(grid) - 1)])


def _drop_unusable(keeper: Keeper, places: list[int], count: int) -> None:
    """Drop the states from which a run cannot go on."""
    if keeper.done and (keeper.done[-1]["interval"] == count - 1 or keeper.done[-1]["is_over"]):
        # The run is complete. Its last interval is repeated to find out how it ended.
        keeper.take_back()
    # If a requested state is damaged or missing, the run goes on from before it.
    available = {0, *(record["interval"] for record in keeper.done)}
    missing = [place for place in places if place not in available]
    keeper.keep_first(sum(record["interval"] < min(missing, default=count) for record in keeper.done))


def _remaining_intervals(
    run: Run, keeper: Keeper, ends: np.ndarray, places: np.ndarray, states: dict[int, np.ndarray]
) -> tuple[Solution, dict[str, Any]]:
    """The solution over the last interval, and its record. States at requested times are added to ``states``."""
    last: dict[str, Any] = keeper.done[-1] if keeper.done else dict(interval=0, counts={})
    u = jnp.asarray(keeper.state(-1)) if keeper.done else run.u0
    solution: Any = None
    for interval in range(last["interval"] + 1, len(ends)):
        solution = integrate(_part(run, u, ends[interval - 1], ends[interval]))
        u = solution.u_end
        counts = {name: int(count) + last["counts"].get(name, 0) for name, count in solution.counts.items()}
        last = dict(interval=interval, t=float(solution.t_end), is_over=solution.is_over, counts=counts)
        is_requested = interval in places
        keeper.keep(np.asarray(u), last, for_good=is_requested)
        if is_requested:
            states[interval] = np.asarray(u)
        if last["is_over"]:
            break
    assert solution is not None  # there is always an interval that remains
    return solution, last


def _part(run: Run, u0: Any, begin: float, end: float) -> Run:
    """The run from one time to another."""
    grid = None if run.grid is None else run.grid[(run.grid >= begin) & (run.grid <= end)]
    t0, t1 = (jnp.asarray(time, run.u0.dtype) for time in (begin, end))
    return dataclasses.replace(run, u0=u0, t0=t0, t1=t1, ts=np.asarray([end], run.ts.dtype), grid=grid)
