"""Runs that survive: states on disk as a run goes, each whole or absent, and what a run must be to go on (host).

What enters: a folder and a description of the run. What leaves: the states kept there so far.
"""

import dataclasses
import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._base.folder import Folder
from .._tables import AnyArray
from .steps import without_twins

_RUN = "run.json"
_ANEW = "Begin again in another folder."
# The number of states that are always kept: the last one, and the one before it, from which it can be recomputed.
_LAST = 2


class RestartError(ValueError):
    """The files of a folder belong to another run, or to one that has not ended, or are damaged."""


class Keeper:
    """The states of a run in a folder: the run's description, and one file for each state with its record.

    Every file is either complete or absent, and is recorded as ltljax's own. A state that is not kept for good is
    removed once two later ones exist, so that neither the folder nor what is written at a time grows with the
    length of a run. A state that was damaged or changed is passed over, and stays.

    Args:
        folder: where; locked.
        run: what the run is, as fingerprints by name; a run may only go on from files of the same.
        resume: whether to go on from what is there; otherwise the states of a run that has ended are removed.
        within: the part of the folder that holds the states.
        overwrite: whether to remove the states of a run that has not ended, too.
        ways: what can be done about a run that has not ended, as a sentence.

    Attributes:
        done: the records of the states that are kept, in order.
        passed_over: the files of states that were damaged or changed.

    Raises:
        RestartError: the files are those of another run, or damaged; or of a run that has not ended, and it is neither
            to go on nor to be removed.
        OutputError: files that ltljax has not written have the names of its own.
    """

    def __init__(
        self,
        folder: Folder,
        run: Mapping[str, str],
        resume: bool,
        within: str = "",
        overwrite: bool = False,
        ways: str = "Go on with resume=True, remove the folder, or name another one.",
    ):
        self.folder, self._run, self._within = folder, dict(run), f"{within}/" if within else ""
        self.done: list[dict[str, Any]] = []
        self.passed_over: list[Path] = []
        self._files: list[tuple[int, bool]] = []  # the number of each state, and whether it is kept for good
        description = self._within + _RUN
        if resume and (folder.path / description).exists():
            self._check(description)
            self._read()
            return
        if resume and _states(folder, self._within):
            raise RestartError(
                f"{folder.path / within} holds states, but not {_RUN}, which says what run made them. {_ANEW}"
            )
        if not overwrite and (end := _unfinished(folder, self._within)) is not None:
            raise RestartError(f"{folder.path / within} holds a run that has not ended{end}. {ways}")
        # All is known to be ltljax's own before anything is removed.
        there = sorted((folder.path / within).glob("state_*.npz"))
        folder.check([description, *(self._within + path.name for path in there)])
        folder.remove([description, *_states(folder, self._within)])
        folder.write(description, json.dumps(dict(run=self._run, has_ended=False)).encode())

    def _check(self, description: str) -> None:
        path = self.folder.path / description
        if not self.folder.owns(description):
            raise RestartError(f"{path} was damaged, changed, or not written by ltljax. {_ANEW}")
        found = _description(self.folder, self._within)["run"]
        differing = [name for name in self._run if found.get(name) != self._run[name]]
        if differing:
            raise RestartError(
                f"The files in {path.parent} belong to a run with another {', another '.join(differing)}. Repeat that "
                "run as it was, or name another folder."
            )

    def _read(self) -> None:
        for path in sorted((self.folder.path / self._within).glob("state_*.npz")):
            found = self._load(path)
            if found is None or found["run"] != self._run:
                self.passed_over.append(path)
                continue
            self.done.append(found["record"])
            self._files.append((int(path.stem.removeprefix("state_")), found["for_good"]))

    def _load(self, path: Path) -> dict[str, Any] | None:
        """What a state's file holds beside the state; None where it is not what was written."""
        if not self.folder.owns(self._within + path.name):
            return None
        with np.load(path, allow_pickle=False) as arrays:
            return json.loads(arrays["record"].item())

    def state(self, index: int) -> np.ndarray:
        """The state of one of the records.

        Raises:
            RestartError: its file was damaged since.
        """
        name = self._name(self._files[index][0])
        if not self.folder.owns(name):
            raise RestartError(f"{self.folder.path / name} was damaged or removed while it was in use. {_ANEW}")
        with np.load(self.folder.path / name, allow_pickle=False) as arrays:
            return arrays["state"]

    def states(self) -> list[np.ndarray]:
        """The states kept so far, in order."""
        return [self.state(index) for index in range(len(self.done))]

    def keep(self, state: np.ndarray, record: dict[str, Any], *, for_good: bool = True) -> None:
        """Put a state on disk with its record, for good or until two later ones are there."""
        number = self._files[-1][0] + 1 if self._files else 0
        while (self.folder.path / self._name(number)).exists() and not self.folder.owns(self._name(number)):
            number += 1  # what was passed over stays
        text = np.asarray(json.dumps(dict(run=self._run, record=record, for_good=for_good)))
        content = io.BytesIO()
        np.savez(content, state=state, record=text)
        self.folder.write(self._name(number), content.getvalue())
        self.done.append(record)
        self._files.append((number, for_good))
        for index in reversed(range(len(self._files) - _LAST)):
            number, is_for_good = self._files[index]
            if not is_for_good:
                self.folder.remove([self._name(number)])
                del self.done[index], self._files[index]

    def take_back(self) -> None:
        """Forget the last state; its file stays until the next state overwrites it."""
        self.done.pop()
        self._files.pop()

    def keep_first(self, count: int) -> None:
        """Remove all states but the first ones, from which the rest are made again."""
        self.folder.remove([self._name(number) for number, _ in self._files[count:]])
        del self.done[count:], self._files[count:]

    def end(self) -> None:
        """Note that the run has ended: another one may take its place."""
        self.folder.write(self._within + _RUN, json.dumps(dict(run=self._run, has_ended=True)).encode())

    def remove(self) -> None:
        """Remove the states: the run has ended, and its results are elsewhere."""
        self.folder.remove([self._within + _RUN, *_states(self.folder, self._within)])

    def _name(self, number: int) -> str:
        return f"{self._within}state_{number:06d}.npz"


def _states(folder: Folder, within: str) -> list[str]:
    """The names of the states in a part of a folder that are ltljax's own."""
    names = sorted((folder.path / within).glob("state_*.npz"))
    return [within + path.name for path in names if folder.owns(within + path.name)]


def _description(folder: Folder, within: str) -> dict[str, Any]:
    return json.loads((folder.path / within / _RUN).read_text(encoding="utf-8"))


def _unfinished(folder: Folder, within: str) -> str | None:
    """How far a run is that has states and has not ended, for a message; None if there is none.

    States whose description is damaged or gone count as such a run.
    """
    states = _states(folder, within)
    if not states or (folder.owns(within + _RUN) and _description(folder, within)["has_ended"]):
        return None
    with np.load(folder.path / states[-1], allow_pickle=False) as arrays:
        record = json.loads(arrays["record"].item())["record"]
    return f", at t = {record['t']:g}" if "t" in record else ""


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
    # Where a state that was asked for is damaged or gone, the run goes on from before it.
    there = {0, *(record["interval"] for record in keeper.done)}
    absent = [place for place in places.tolist() if place not in there]
    keeper.keep_first(sum(record["interval"] < min(absent, default=len(ends)) for record in keeper.done))
    last: dict[str, Any] = keeper.done[-1] if keeper.done else dict(interval=0, counts={})
    u = jnp.asarray(keeper.state(-1)) if keeper.done else u0
    kept = {0: np.asarray(u0)} | {
        record["interval"]: keeper.state(index)
        for index, record in enumerate(keeper.done)
        if record["interval"] in places
    }
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
    keeper.end()
    reached = (np.abs(ends[places] - asked) <= slack) & (ends[places] <= last["t"])
    never = np.full(u0.shape, np.nan, u0.dtype)
    us = [kept[place] if has else never for place, has in zip(places.tolist(), reached, strict=True)]
    return dataclasses.replace(
        solution,
        ts=jnp.asarray(np.where(reached, asked, np.inf), ts.dtype),
        us=jnp.asarray(np.stack(us)),
        counts={name: jnp.asarray(count) for name, count in last["counts"].items()},
    )
