"""Runs that survive: states on disk as a run goes, each whole or absent, and what a run must be to go on (host).

What enters: a folder and a description of the run. What leaves: the states kept there so far.
"""

import dataclasses
import functools
import hashlib
import json
import os
import types
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..tables import AnyArray
from .steps import without_twins

_RUN = "run.json"
# States that stand whether they were asked for or not: the last, and the one to make it again from.
_LAST = 2


class RestartError(ValueError):
    """The files of a folder belong to another run, or are damaged."""


def fingerprint(value: Any) -> str:
    """A short text that differs where the value does, the same in every process: arrays by their bytes, functions by
    their code and what of their module and surroundings they read, other objects by their type and state."""
    digest = hashlib.sha256()
    _feed(digest.update, value, {})
    return digest.hexdigest()[:16]


def _feed(update: Callable[[bytes], None], value: Any, seen: dict[int, Any]) -> None:
    def tell(text: str) -> None:
        update(f"{text}\0".encode())

    def feed(*parts: Any) -> None:
        for part in parts:
            _feed(update, part, seen)

    if value is None or isinstance(value, bool | int | float | complex | str | bytes):
        tell(repr(value))
        return
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        value = jax.random.key_data(value)
    if isinstance(value, np.ndarray | jax.Array | np.generic):
        array = np.asarray(value)
        tell(f"{array.dtype}{array.shape}")
        update(np.ascontiguousarray(array).tobytes())
        return
    if isinstance(value, tuple | list):
        tell(f"{len(value)} of")
        feed(*value)
        return
    if isinstance(value, set | frozenset):  # whose order differs from process to process
        tell(f"set of {sorted(map(fingerprint, value))}")
        return
    if isinstance(value, Mapping):
        tell(f"{len(value)} by name")
        for key in sorted(value, key=str):
            tell(str(key))
            feed(value[key])
        return
    if isinstance(value, types.CodeType):
        tell(value.co_code.hex())
        feed(value.co_names, value.co_consts)
        return
    if id(value) in seen:  # what names itself, by way of others
        return
    seen[id(value)] = value
    if isinstance(value, type | types.ModuleType | types.BuiltinFunctionType | np.ufunc):
        tell(f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', value.__name__)}")
        if isinstance(value, type) and value.__module__ == "__main__":
            feed({name: own for name, own in vars(value).items() if isinstance(own, types.FunctionType)})
    elif isinstance(value, types.FunctionType):
        tell(f"{value.__module__}.{value.__qualname__}")
        feed(value.__code__, value.__defaults__, value.__kwdefaults__, list(_enclosed(value)), _read_by(value))
    elif isinstance(value, types.MethodType):
        feed(value.__func__, value.__self__)
    elif isinstance(value, functools.partial):
        feed(value.func, value.args, value.keywords)
    elif isinstance(value, eqx.Module):
        feed(type(value), {name: getattr(value, name) for name in value.__dataclass_fields__})
    elif hasattr(value, "__wrapped__"):  # such as what jit makes of a function
        feed(value.__wrapped__)
    else:
        feed(type(value), _state_of(value))


def _enclosed(function: types.FunctionType) -> Iterator[Any]:
    """The values of a function's surroundings that it names."""
    for cell in function.__closure__ or ():
        try:
            yield cell.cell_contents
        except ValueError:  # not given yet
            yield None


def _read_by(function: types.FunctionType) -> dict[str, Any]:
    """What a function, or one made within it, reads of its module: values, and functions and classes of the same."""

    def names(code: types.CodeType) -> set[str]:
        within = (names(part) for part in code.co_consts if isinstance(part, types.CodeType))
        return set(code.co_names).union(*within)

    found = {name: function.__globals__[name] for name in names(function.__code__) if name in function.__globals__}
    elsewhere = types.ModuleType | types.FunctionType | types.BuiltinFunctionType | type
    return {
        name: value
        for name, value in found.items()
        if not isinstance(value, elsewhere) or getattr(value, "__module__", None) == function.__module__
    }


def _state_of(value: Any) -> Any:
    """What an object is beside its type, as it would be copied."""
    try:
        made = value.__reduce_ex__(2)
    except TypeError:  # such as a lock, which has none
        return None
    return made if isinstance(made, str) else [list(part) if isinstance(part, Iterator) else part for part in made[1:]]


class Keeper:
    """The folder of a run: the run's description, and one file for each state with the record that belongs to it.

    At any moment every file is whole. States that are not to be kept for good go when two later ones are there, so
    that neither the folder nor what is written at a time grows with the length of a run.

    Args:
        folder: where; made if absent.
        run: what the run is, as fingerprints by name; a run may only go on from files of the same.
        resume: whether to go on from what is there; otherwise it is removed.

    Attributes:
        done: the records of the states that are kept, in order.

    Raises:
        RestartError: the files are those of another run, or damaged.
    """

    def __init__(self, folder: str | Path, run: Mapping[str, str], resume: bool):
        self.folder = Path(folder)
        self.done: list[dict[str, Any]] = []
        self._files: list[tuple[int, bool]] = []  # the number of each state, and whether it is kept for good
        if not resume and self.folder.exists():
            self._clear()
        self.folder.mkdir(parents=True, exist_ok=True)
        if (self.folder / _RUN).exists():
            self._check(dict(run))
            self._read()
        else:
            self._write(self.folder / _RUN, lambda file: file.write(json.dumps(dict(run)).encode()))

    def _check(self, run: dict[str, str]) -> None:
        path = self.folder / _RUN
        try:
            found = dict(json.loads(path.read_text()))
        except (ValueError, TypeError) as error:
            raise RestartError(f"{path} is damaged: {error}. Start the run anew without resume.") from error
        differing = [name for name in run if found.get(name) != run[name]]
        if differing:
            raise RestartError(
                f"The files in {self.folder} belong to a run with another {', another '.join(differing)}. Repeat that "
                "run as it was, take another folder, or start anew without resume."
            )

    def _read(self) -> None:
        for path in sorted(self.folder.glob("state_*.npz")):
            record = json.loads(self._load(path, "record").item())
            self.done.append(record["record"])
            self._files.append((int(path.stem.removeprefix("state_")), record["for_good"]))

    def state(self, index: int) -> np.ndarray:
        """The state of one of the records."""
        return self._load(self._path(self._files[index][0]), "state")

    def states(self) -> list[np.ndarray]:
        """The states kept so far, in order."""
        return [self.state(index) for index in range(len(self.done))]

    def keep(self, state: np.ndarray, record: dict[str, Any], *, for_good: bool = True) -> None:
        """Put a state on disk with its record, for good or until two later ones are there."""
        number = self._files[-1][0] + 1 if self._files else 0
        text = np.asarray(json.dumps(dict(record=record, for_good=for_good)))
        self._write(self._path(number), lambda file: np.savez(file, state=state, record=text))
        self.done.append(record)
        self._files.append((number, for_good))
        for index in reversed(range(len(self._files) - _LAST)):
            number, is_for_good = self._files[index]
            if not is_for_good:
                self._path(number).unlink(missing_ok=True)
                del self.done[index], self._files[index]

    def take_back(self) -> None:
        """Count the last state as not made; its file stands until the next takes its place."""
        self.done.pop()
        self._files.pop()

    def remove(self) -> None:
        """Remove the folder: the run has ended, and its results are elsewhere."""
        self._clear()
        if not any(self.folder.iterdir()):
            self.folder.rmdir()

    def _clear(self) -> None:
        # Only what is ours: the folder may hold other things.
        for path in [*self.folder.glob("state_*.npz"), *self.folder.glob("*.unfinished"), self.folder / _RUN]:
            path.unlink(missing_ok=True)

    def _path(self, number: int) -> Path:
        return self.folder / f"state_{number:06d}.npz"

    @staticmethod
    def _load(path: Path, name: str) -> np.ndarray:
        try:
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as found:
                return found[name]
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise RestartError(f"{path} is missing or damaged. Start the run anew without resume.") from error

    @staticmethod
    def _write(path: Path, save: Callable[[Any], Any]) -> None:
        unfinished = path.with_suffix(".unfinished")
        with open(unfinished, "wb") as file:
            save(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)


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

    Kept for good, on disk and in memory, are the states at the times asked for.

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
    asked, slack = np.asarray(ts, np.float64), 1e-6 * every
    multiples = t0 + every * np.arange(1, np.ceil((t1 - t0) / every))
    ends = without_twins(t0, t1, (asked, multiples), slack)
    if grid is not None:
        # Intervals of whole steps.
        steps = grid.astype(np.float64)
        ends = np.unique(steps[np.minimum(np.searchsorted(steps, ends - slack), len(steps) - 1)])
    places = np.abs(ends - asked[:, None]).argmin(axis=1)
    if keeper.done and (keeper.done[-1]["interval"] == len(ends) - 1 or keeper.done[-1]["is_over"]):
        # Nothing is left to do but to say how it ended: the last interval is repeated.
        keeper.take_back()
    last: dict[str, Any] = keeper.done[-1] if keeper.done else dict(interval=0, counts={})
    u = jnp.asarray(keeper.state(-1)) if keeper.done else u0
    kept = {0: np.asarray(u0)} | {
        record["interval"]: keeper.state(index)
        for index, record in enumerate(keeper.done)
        if record["interval"] in places
    }
    if absent := sorted({int(place) for place in places if place <= last["interval"]} - set(kept)):
        raise RestartError(
            f"The state at t = {ends[absent[0]]:g} is missing in {keeper.folder}. Start the run anew without resume."
        )
    solution: Any = None
    for interval in range(last["interval"] + 1, len(ends)):
        begin, end = ends[interval - 1], ends[interval]
        within = None if grid is None else grid[(grid >= begin) & (grid <= end)]
        solution = advance(u, begin, end, np.asarray([end], ts.dtype), within)
        u = solution.u_end
        has_failed = bool(solution.result != diffrax.RESULTS.successful)
        is_over = has_failed or bool(solution.overflowed | solution.stopped)
        counts = {name: int(count) + last["counts"].get(name, 0) for name, count in solution.counts.items()}
        last = dict(interval=interval, t=float(solution.t_end), is_over=is_over, counts=counts)
        is_asked = interval in places
        keeper.keep(np.asarray(u), last, for_good=is_asked)
        if is_asked:
            kept[interval] = np.asarray(u)
        if is_over:
            break
    assert solution is not None  # the last interval is always advanced
    reached = (np.abs(ends[places] - asked) <= slack) & (ends[places] <= last["t"])
    never = np.full(u0.shape, np.nan, u0.dtype)
    us = [kept[place] if has else never for place, has in zip(places.tolist(), reached, strict=True)]
    return dataclasses.replace(
        solution,
        ts=jnp.asarray(np.where(reached, asked, np.inf), ts.dtype),
        us=jnp.asarray(np.stack(us)),
        counts={name: jnp.asarray(count) for name, count in last["counts"].items()},
    )
