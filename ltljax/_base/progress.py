"""Output on the terminal: progress bars, notes, and the time that parts of a computation took."""

import contextlib
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any


def watched(what: str, *, progress: bool = True, unit: str = "batch") -> Callable[[Sequence[Any]], Iterable[Any]]:
    """A function that returns an iterable over its steps, with a progress bar (by tqdm, if installed).

    Args:
        what: description of the work.
        progress: whether to show the progress bar.
        unit: name of a step.
    """

    def watch(steps: Sequence[Any]) -> Iterable[Any]:
        if not progress:
            return steps
        try:
            from tqdm import tqdm  # in the extra `app`
        except ImportError:
            return _plain(steps, what)
        return tqdm(steps, desc=what, unit=unit, dynamic_ncols=True)

    return watch


def _plain(steps: Sequence[Any], what: str) -> Iterator[Any]:
    start = time.perf_counter()
    for done, step in enumerate(steps):
        if done and done % max(1, len(steps) // 10) == 0:
            say(what, done / len(steps), start)
        yield step


def say(what: str, share: float, start: float) -> None:
    """Print the finished share of the work, and the remaining time if it continues at the same rate.

    Args:
        what: description of the work.
        share: finished share of the work, from 0 to 1.
        start: value of ``time.perf_counter()`` when the work began.
    """
    remaining = (time.perf_counter() - start) * (1 - share) / max(share, 1e-9)
    print(f"{what}: {100 * share:.0f} %, about {remaining:.0f} s left", file=sys.stderr)


@contextlib.contextmanager
def noted(*ignored: type[Warning]) -> Iterator[None]:
    """Print the warnings of the ``with`` block as notes when it ends, except those of the ignored categories."""
    with warnings.catch_warnings(record=True) as recorded:
        warnings.simplefilter("always")
        for category in ignored:
            warnings.simplefilter("ignore", category)
        yield
    for warning in recorded:
        print(f"note: {warning.message}")


class Laps:
    """A stopwatch for a computation in several parts.

    Attributes:
        seconds: duration of each part by name, in order.
    """

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self._start = time.perf_counter()

    def end(self, part: str) -> None:
        """Record the end of a part, which began at the end of the previous part."""
        now = time.perf_counter()
        self.seconds[part] = now - self._start
        self._start = now
