"""Runs on disk: each state is either complete or absent, and only the same run may go on from it (host).

What enters: a folder and a description of the run. What leaves: the states that were kept there.
"""

import dataclasses
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .._base.arguments import positive
from .._base.owned_folder import Folder
from .fingerprint import fingerprint

_RUN = "run.json"
_NEW_FOLDER = "Start again in another folder."
# Number of states that are always kept: the last one, and the one from which it can be recomputed.
_LAST = 2


class RestartError(ValueError):
    """The files of a folder belong to another run, or to one that has not ended, or are damaged."""


@dataclasses.dataclass(frozen=True)
class Checkpoints:
    """Where and how often a run is kept on disk, for ``ltl.solve(..., checkpoints=Checkpoints(folder))``.

    The run is made interval by interval. Each interval begins with a first step and ends with its state put on disk, so
    a run that is killed loses at most one interval. The last states and those at the requested times are kept. Not
    inside jit.

    Attributes:
        folder: the folder; created if it does not exist.
        every: length of the intervals in time, which also end at the requested times; by default a twentieth of the
            run.
        resume: whether to go on from the states in the folder, if they are those of the same call. The result is the
            same as without the interruption. Two calls are the same if all arrays and options are, and if the functions
            in ``equation``, ``solver`` and ``stop_when`` have the same source. The values that such a function reads
            from its module, and the methods of a class, are not compared.
        run_id: a name that stands for the equation, solver and ``stop_when`` when runs are compared. It is needed if
            the source of a function is not available, or changes without changing what the function does.
    """

    folder: str | Path
    every: float | int | None = None
    resume: bool = False
    run_id: str | None = None

    def __post_init__(self):
        if self.every is not None:
            positive("every", self.every)

    def fingerprint_of(self, value: Any) -> str:
        """The fingerprint of a value that may contain functions, or of ``run_id`` if there is one.

        Raises:
            RestartError: the value cannot be compared.
        """
        try:
            return fingerprint(value if self.run_id is None else self.run_id)
        except TypeError as error:
            raise RestartError(f"The run cannot be identified. {error} Name it with run_id=...") from None


class Keeper:
    """The states of a run in a folder: the run's description, and one file for each state with its record.

    Every file is either complete or absent, and is recorded as ltljax's own. A state that is not permanent is removed
    once two later ones exist, so neither the folder nor a single write grows with the length of a run. A damaged or
    changed state is skipped and left in place. The caller warns about the skipped files and decides from ``done`` where
    the run continues: `solve` from its last state before the first requested one that is missing (see `intervals`), the
    application from the frame before the first one that is missing.

    Args:
        folder: the folder, locked.
        run: fingerprints that identify the run, by name. Only a run with the same fingerprints goes on from its files.
        resume: whether to go on from the states in the folder. Otherwise the states of a run that has ended are
            removed.
        within: the part of the folder that holds the states.
        overwrite: whether to remove the states of a run that has not ended as well.
        ways: a sentence that says what can be done about a run that has not ended.

    Attributes:
        done: records of the kept states, in order.
        skipped: files of damaged or changed states.

    Raises:
        RestartError: the files are damaged or those of another run; or the run has not ended and is neither to be
            resumed nor to be removed.
        OutputError: files of other programs have the names of ltljax's own.
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
        self.skipped: list[Path] = []
        self._files: list[tuple[int, bool]] = []  # number of each state, and whether it is permanent
        description = self._within + _RUN
        if resume and (folder.path / description).exists():
            self._check(description)
            self._read()
            return
        if resume and _states(folder, self._within):
            raise RestartError(
                f"{folder.path / within} holds states, but no {_RUN} that says which run made them. {_NEW_FOLDER}"
            )
        if not overwrite and (end := _unfinished(folder, self._within)) is not None:
            raise RestartError(f"{folder.path / within} holds a run that has not ended{end}. {ways}")
        # All files are checked to be ltljax's own before any is removed.
        states = sorted((folder.path / within).glob("state_*.npz"))
        folder.check([description, *(self._within + path.name for path in states)])
        folder.remove([description, *_states(folder, self._within)])
        folder.write(description, json.dumps(dict(run=self._run, has_ended=False)).encode())

    def _check(self, description: str) -> None:
        path = self.folder.path / description
        if not self.folder.owns(description):
            raise RestartError(f"{path} was damaged, changed, or not written by ltljax. {_NEW_FOLDER}")
        earlier = _description(self.folder, self._within)["run"]
        differing = [name for name in self._run if earlier.get(name) != self._run[name]]
        if differing:
            raise RestartError(
                f"The files in {path.parent} belong to another run, or to another version of ltljax: they differ in "
                f"{', '.join(differing)}. Repeat that run unchanged, or name another folder."
            )

    def _read(self) -> None:
        for path in sorted((self.folder.path / self._within).glob("state_*.npz")):
            content = self._load(path)
            if content is None or content["run"] != self._run:
                self.skipped.append(path)
                continue
            self.done.append(content["record"])
            self._files.append((int(path.stem.removeprefix("state_")), content["for_good"]))

    def _load(self, path: Path) -> dict[str, Any] | None:
        """What the file of a state holds besides the state; None if the file is not as it was written."""
        if not self.folder.owns(self._within + path.name):
            return None
        with np.load(path, allow_pickle=False) as arrays:
            return json.loads(arrays["record"].item())

    def state(self, index: int) -> np.ndarray:
        """The state that belongs to a record.

        Raises:
            RestartError: its file has been damaged since.
        """
        name = self._name(self._files[index][0])
        if not self.folder.owns(name):
            raise RestartError(f"{self.folder.path / name} was damaged or removed while it was in use. {_NEW_FOLDER}")
        with np.load(self.folder.path / name, allow_pickle=False) as arrays:
            return arrays["state"]

    def states(self) -> list[np.ndarray]:
        """The kept states, in order."""
        return [self.state(index) for index in range(len(self.done))]

    def keep(self, state: np.ndarray, record: dict[str, Any], *, for_good: bool = True) -> None:
        """Put a state on disk with its record, permanently or until two later states exist."""
        number = self._files[-1][0] + 1 if self._files else 0
        while (self.folder.path / self._name(number)).exists() and not self.folder.owns(self._name(number)):
            number += 1  # skipped files stay
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
        """Forget the last state. Its file stays until the next state overwrites it."""
        self.done.pop()
        self._files.pop()

    def keep_first(self, count: int) -> None:
        """Remove all states but the first ``count``, from which the others are computed again."""
        self.folder.remove([self._name(number) for number, _ in self._files[count:]])
        del self.done[count:], self._files[count:]

    def end(self) -> None:
        """Record that the run has ended, so that another run may take its place."""
        self.folder.write(self._within + _RUN, json.dumps(dict(run=self._run, has_ended=True)).encode())

    def remove(self) -> None:
        """Remove the states and the description of a run whose results are stored elsewhere."""
        self.folder.remove([self._within + _RUN, *_states(self.folder, self._within)])

    def _name(self, number: int) -> str:
        return f"{self._within}state_{number:06d}.npz"


def _states(folder: Folder, within: str) -> list[str]:
    """The names of ltljax's own state files in a part of a folder."""
    names = sorted((folder.path / within).glob("state_*.npz"))
    return [within + path.name for path in names if folder.owns(within + path.name)]


def _description(folder: Folder, within: str) -> dict[str, Any]:
    return json.loads((folder.path / within / _RUN).read_text(encoding="utf-8"))


def _unfinished(folder: Folder, within: str) -> str | None:
    """The progress of a run that has not ended, in words for a message; None if there is no such run.

    States whose description is damaged or missing count as a run that has not ended.
    """
    states = _states(folder, within)
    if not states or (folder.owns(within + _RUN) and _description(folder, within)["has_ended"]):
        return None
    with np.load(folder.path / states[-1], allow_pickle=False) as arrays:
        record = json.loads(arrays["record"].item())["record"]
    return f", at t = {record['t']:g}" if "t" in record else ""
