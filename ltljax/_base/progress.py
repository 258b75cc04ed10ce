"""What is said on the terminal: how far a long piece of work is, how long its parts took, and what there is to note."""

import contextlib
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any


def watched(what: str, *, progress: bool = True, unit: str = "batch") -> Callable[[Sequence[Any]], Iterable[Any]]:
    """Hands on the steps it is given and, if asked, shows a bar with the remaining time: of tqdm where that is at hand.

    Args:
        what: what is being done.
        progress: whether to show anything.
        unit: what a step is.
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
    """Print how much of a work is done, and how long the rest will take if it goes on as since the start."""
    left = (time.perf_counter() - start) * (1 - share) / max(share, 1e-9)
    print(f"{what}: {100 * share:.0f} %, about {left:.0f} s left", file=sys.stderr)


@contextlib.contextmanager
def noted(*ignored: type[Warning]) -> Iterator[None]:
    """Prints the warnings of the work inside as notes, after it, except those of some categories."""
    with warnings.catch_warnings(record=True) as cautions:
        warnings.simplefilter("always")
        for category in ignored:
            warnings.simplefilter("ignore", category)
        yield
    for caution in cautions:
        print(f"note: {caution.message}")


class Laps:
    """A stopwatch for work in parts.

    Attributes:
        seconds: how long each part took, in order.
    """

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self._start = time.perf_counter()

    def end(self, part: str) -> None:
        """The end of a part that began with the last one's end."""
        now = time.perf_counter()
        self.seconds[part] = now - self._start
        self._start = now
