"""Runs that survive: states on disk as a run goes, each whole or absent, and what a run must be to go on (host).

What enters: a folder and a description of the run. What leaves: the states kept there so far.
"""

import dataclasses
import functools
import hashlib
import json
import os
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..tables import AnyArray

_PROGRESS = "progress.json"


class RestartError(ValueError):
    """The files of a folder belong to another run, or are damaged."""


def fingerprint(value: Any) -> str:
    """A short text that differs where the value does: arrays by their bytes, functions by their code, what that names,
    and the numbers, arrays and functions of their module that it reads."""
    digest = hashlib.sha256()
    _feed(digest.update, value, set())
    return digest.hexdigest()[:16]


def _feed(update: Callable[[bytes], None], value: Any, seen: set[int]) -> None:
    if isinstance(value, np.ndarray | jax.Array | np.generic):
        array = np.asarray(value)
        update(f"{array.dtype}{array.shape}".encode())
        update(np.ascontiguousarray(array).tobytes())
    elif isinstance(value, eqx.Module):
        update(type(value).__qualname__.encode())
        _feed(update, {name: getattr(value, name) for name in value.__dataclass_fields__}, seen)
    elif isinstance(value, Mapping):
        for key in sorted(value, key=str):
            update(str(key).encode())
            _feed(update, value[key], seen)
    elif isinstance(value, tuple | list):
        update(f"{len(value)} of".encode())
        for part in value:
            _feed(update, part, seen)
    elif isinstance(value, types.CodeType):
        update(value.co_code + " ".join(value.co_names).encode())
        _feed(update, value.co_consts, seen)
    elif isinstance(value, functools.partial):
        _feed(update, (value.func, value.args, value.keywords), seen)
    elif isinstance(value, types.MethodType):
        _feed(update, (value.__func__, value.__self__), seen)
    elif callable(value):
        if id(value) in seen:  # functions that name one another
            return
        seen.add(id(value))
        code = getattr(value, "__code__", None)
        update(
            f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', type(value).__qualname__)}".encode()
        )
        if code is not None:
            cells = [cell.cell_contents for cell in value.__closure__ or ()]
            _feed(update, (code, value.__defaults__, value.__kwdefaults__, cells), seen)
            read = {name: value.__globals__.get(name) for name in code.co_names}
            plain = int | float | str | np.ndarray | jax.Array | eqx.Module
            own = {
                name: found
                for name, found in read.items()
                if isinstance(found, plain)
                or (isinstance(found, types.FunctionType) and found.__module__ == value.__module__)
            }
            _feed(update, own, seen)
        elif not isinstance(value, type):
            _feed(update, getattr(value, "__dict__", {}), seen)
    else:
        update(repr(value).encode())


class Keeper:
    """The folder of a run.

    Args:
        folder: where; made if absent.
        run: what the run is, as fingerprints by name; a run may only go on from files of the same.
        resume: whether to go on from what is there; otherwise it is removed.

    Raises:
        RestartError: the files are those of another run, or damaged.
    """

    def __init__(self, folder: str | Path, run: Mapping[str, str], resume: bool):
        self.folder = Path(folder)
        self.run = dict(run)
        self.done: list[dict[str, Any]] = []
        if not resume and self.folder.exists():
            self._clear()
        self.folder.mkdir(parents=True, exist_ok=True)
        if (self.folder / _PROGRESS).exists():
            self._read()

    def _read(self) -> None:
        path = self.folder / _PROGRESS
        try:
            found = json.loads(path.read_text())
            run, done = found["run"], found["done"]
        except (ValueError, KeyError, TypeError) as error:
            raise RestartError(f"{path} is damaged: {error}. Start the run anew without resume.") from error
        differing = [name for name in self.run if run.get(name) != self.run[name]]
        if differing:
            raise RestartError(
                f"The files in {self.folder} belong to a run with another {', another '.join(differing)}. Repeat that "
                "run as it was, take another folder, or start anew without resume."
            )
        self.done = done

    def states(self) -> list[np.ndarray]:
        """The states kept so far, in order."""
        states = []
        for index in range(len(self.done)):
            path = self._path(index)
            try:
                states.append(np.load(path, allow_pickle=False))
            except (OSError, ValueError) as error:
                raise RestartError(f"{path} is missing or damaged. Start the run anew without resume.") from error
        return states

    def keep(self, state: np.ndarray, record: dict[str, Any]) -> None:
        """Put a state on disk, then the record that it is there: at any moment every recorded state is whole."""

        def write(path: Path, save: Callable[[Any], None]) -> None:
            unfinished = path.with_suffix(".unfinished")
            with open(unfinished, "wb") as file:
                save(file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(unfinished, path)

        write(self._path(len(self.done)), lambda file: np.save(file, state))
        self.done.append(record)
        text = json.dumps(dict(run=self.run, done=self.done))
        write(self.folder / _PROGRESS, lambda file: file.write(text.encode()))

    def remove(self) -> None:
        """Remove the folder: the run has ended, and its results are elsewhere."""
        self._clear()
        if not any(self.folder.iterdir()):
            self.folder.rmdir()

    def _clear(self) -> None:
        # Only what is ours: the folder may hold other things.
        for path in [*self.folder.glob("state_*.npy"), *self.folder.glob("*.unfinished"), self.folder / _PROGRESS]:
            path.unlink(missing_ok=True)

    def _path(self, index: int) -> Path:
        return self.folder / f"state_{index:06d}.npy"


def in_intervals(
    advance: Callable[..., Any],
    keeper: Keeper,
    u0: Array,
    t0: float,
    t1: float,
    ts: AnyArray,
    grid: np.ndarray | None,
    every: float,
) -> Any:
    """The solution of a run that is made interval by interval, the state at the end of each being put on disk.

    Args:
        advance: ``(u, begin, end, ts, grid) -> Solution``.
        keeper: the folder, with the intervals that are done.
        u0: the state at t0.
        t0: the first time.
        t1: the last time.
        ts: the times asked for, at which intervals end too.
        grid: the times of fixed steps, or None.
        every: the length of an interval.
    """
    if t1 == t0:
        return advance(u0, t0, t1, ts, None)
    asked = np.asarray(ts, np.float64)
    ends = np.unique(np.concatenate([t0 + every * np.arange(1, np.ceil((t1 - t0) / every)), asked, [t1]]))
    if grid is not None:
        # Intervals of whole steps.
        steps = grid.astype(np.float64)
        ends = np.unique(steps[np.minimum(np.searchsorted(steps, ends - 1e-6 * every), len(steps) - 1)])
    ends = ends[ends > t0]
    states, records = keeper.states(), keeper.done
    if records and (len(records) == len(ends) or records[-1]["is_over"]):
        # Nothing is left to do but to say how it ended: the last interval is repeated.
        states.pop()
        records.pop()
    u, begin = (jnp.asarray(states[-1]), records[-1]["end"]) if states else (u0, t0)
    solution = None
    for end in ends[len(records) :]:
        within = None if grid is None else grid[(grid >= begin) & (grid <= end)]
        solution = advance(u, begin, end, np.asarray([end], ts.dtype), within)
        u, begin = solution.u_end, end
        counts = {name: int(count) for name, count in solution.counts.items()}
        has_failed = bool(solution.result != diffrax.RESULTS.successful)
        is_over = has_failed or bool(solution.overflowed | solution.stopped)
        keeper.keep(np.asarray(u), dict(end=float(end), t=float(solution.t_end), is_over=is_over, counts=counts))
        states.append(np.asarray(u))
        if is_over:
            break
    assert solution is not None  # the last interval is always advanced
    kept = {t0: np.asarray(u0)} | {record["end"]: state for record, state in zip(records, states, strict=True)}
    nearest = [min(kept, key=lambda t, time=time: abs(t - time)) for time in asked]
    reached = [abs(t - time) <= 1e-6 * every and t <= records[-1]["t"] for t, time in zip(nearest, asked, strict=True)]
    absent = np.full(u0.shape, np.inf, u0.dtype)
    us = [kept[t] if has else absent for t, has in zip(nearest, reached, strict=True)]
    return dataclasses.replace(
        solution,
        ts=jnp.asarray(np.where(reached, asked, np.inf), ts.dtype),
        us=jnp.asarray(np.stack(us)),
        counts={name: jnp.asarray(sum(record["counts"][name] for record in records)) for name in solution.counts},
    )
