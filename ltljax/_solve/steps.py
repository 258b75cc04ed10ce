"""When steps are taken, and how far they are: times that are one but for rounding, steps so short that time stands
still, and the remaining time of a run.

What enters: times, or a step size controller of diffrax. What leaves: the same, with those seen to.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._base.progress import say


def without_twins(start: Any, end: Any, groups: Sequence[np.ndarray], least: float) -> np.ndarray:
    """The times from start to end, ascending, at least so far apart: the ends first, then one group after the other."""
    grid = np.array([start, end])
    for group in groups:
        times = np.unique(group)
        times = times[(times > start) & (times < end)]
        around = np.clip(np.searchsorted(grid, times)[:, None] - [0, 1], 0, len(grid) - 1)
        nearest = np.abs(times[:, None] - grid[around]).min(axis=1, initial=np.inf)
        grid = np.sort(np.concatenate([grid, times[nearest > least]]))
    return grid


class Advancing(diffrax.AbstractAdaptiveStepSizeController):
    """A controller that fails where a step would not advance the time, of which diffrax would make `max_steps`.

    So ends a state that becomes infinite within finite time, and an implicit stage that is not found however short the
    step.

    Attributes:
        controller: what chooses the steps.
        longest: ``(t, y, args) -> length`` of the longest step that the solver can take from a state, or None. A longer
            one would be refused, and the run would waste it.
        share: where given, the absolute tolerance of each species over the largest it has been in the run; else it is
            that of the controller.
        size: ``y -> sizes`` of the species.
    """

    controller: diffrax.AbstractAdaptiveStepSizeController
    longest: Callable[..., Float[Array, ""]] | None = None
    share: Float[Array, ""] | None = None
    size: Callable[[Array], Array] = lambda y: jnp.max(jnp.abs(y), axis=0)

    @property
    def rtol(self):  # type: ignore
        """That of the controller."""
        return self.controller.rtol

    @property
    def atol(self):  # type: ignore
        """That of the controller."""
        return self.controller.atol

    @property
    def norm(self):  # type: ignore
        """That of the controller."""
        return self.controller.norm

    def wrap(self, direction):
        """The controller for a direction of time."""
        return dataclasses.replace(self, controller=self.controller.wrap(direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """The end of the first step."""
        end, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return end, (state, self.size(y0))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        """The next step, or that there is none."""
        state, size = controller_state
        size, controller = jnp.maximum(size, self.size(y0)), self.controller
        if self.share is not None:
            # Of a species that is zero the smallest number, which no error is compared with but its own zero.
            atol = self.share * jnp.fmax(size, self.size(y1_candidate)) + jnp.finfo(jnp.result_type(size)).tiny
            controller = eqx.tree_at(lambda c: c.atol, controller, atol[None])
        keep, begin, end, made_jump, state, result = controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state
        )
        if self.longest is not None:
            y = jnp.where(keep, y1_candidate, y0)
            # A little less, as the difference of two times is rounded.
            end = jnp.minimum(end, begin + 0.999 * self.longest(begin, y, args).astype(jnp.result_type(end)))
        # A refused step that rounding makes as long again counts too.
        stands_still = ((end <= begin) | (~jnp.asarray(keep) & (end >= t1))) & (result == diffrax.RESULTS.successful)
        result = diffrax.RESULTS.where(stands_still, diffrax.RESULTS.dt_min_reached, result)
        return keep, begin, end, made_jump, (state, size), result


class TextMeter(diffrax.TextProgressMeter):
    """The progress of a run in lines of text with the remaining time, where there is no tqdm for a bar."""

    @staticmethod
    def _init_bar() -> list[float]:
        return [0.0, time.perf_counter()]

    @staticmethod
    def _step_bar(bar: list[float], progress: Any) -> None:
        bar[0] = float(progress)
        say("time", bar[0], bar[1])

    @staticmethod
    def _close_bar(bar: list[float]) -> None:
        del bar
