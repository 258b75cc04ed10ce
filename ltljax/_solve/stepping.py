"""How steps are taken: `Adaptive` and `Fixed`, the times of fixed steps, and the controller of adaptive ones.

What enters: step settings and the times of a run. What leaves: a grid of times, or a step size controller of diffrax.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from .._base.progress import say
from .._tables import AnyArray
from .stabilised import Stabilised

# The default absolute tolerance of a species is this fraction of rtol times its largest magnitude.
ATOL_PER_RTOL = 1e-2

# A run of more fixed steps than this, substeps included, is refused as a mistake.
_MOST_STEPS = 10_000_000


class Unset:
    """The type of an argument that was left out, where None has a meaning of its own."""

    def __repr__(self) -> str:
        return "<the default>"


UNSET = Unset()


@dataclasses.dataclass(frozen=True)
class Adaptive:
    """Adaptive steps, for ``ltl.solve(..., steps=Adaptive(rtol=1e-6))``.

    The error is measured in a root-mean-square norm over vertices and species, which does not depend on the mesh size.

    Attributes:
        rtol: relative tolerance of a step; implicit stages are solved to a hundredth of it.
        atol: absolute tolerance of a step. By default ``rtol / 100`` times the largest magnitude that each species has
            reached so far, so that a change of units changes nothing else.
        max_steps: number of steps after which the run fails; None for no limit, which rules out reverse mode.
    """

    rtol: ArrayLike = 1e-4
    atol: ArrayLike | None = None
    max_steps: int | None = 1_000_000

    dt: ClassVar[None] = None


@dataclasses.dataclass(frozen=True)
class Fixed:
    """Steps of fixed length, for ``ltl.solve(..., steps=Fixed(dt=0.01))``.

    Attributes:
        dt: length of the steps. The last step before each requested time may be shorter. A step of `RKL2` or `RKL1`
            that is too long even for the largest number of stages is split into equal parts that are stable at the
            initial state; ``solution.stats`` reports their number. Inside jit, where the stability is not known, such
            a run ends with NaN.
        rtol: relative tolerance, to a hundredth of which implicit stages are solved.
        atol: absolute tolerance for implicit stages; by default as in `Adaptive`.
        max_steps: number of steps after which the run fails; None for no limit.
    """

    dt: float
    rtol: ArrayLike = 1e-4
    atol: ArrayLike | None = None
    max_steps: int | None = 1_000_000

    def __post_init__(self):
        if self.dt is None:
            raise ValueError("Expected the length of steps, found Fixed(None). For adaptive steps use Adaptive().")


def settings_of(
    steps: Adaptive | Fixed | None,
    rtol: ArrayLike | None,
    atol: ArrayLike | None,
    dt: float | None,
    max_steps: int | Unset | None,
) -> Adaptive | Fixed:
    """The step settings that ``steps``, or the plain arguments of `solve`, ask for.

    Raises:
        ValueError: an argument contradicts ``steps``.
        TypeError: ``steps`` is of another type.
    """
    options: dict[str, Any] = {
        name: value for name, value in dict(rtol=rtol, atol=atol, dt=dt).items() if value is not None
    }
    if not isinstance(max_steps, Unset):
        options["max_steps"] = max_steps
    if steps is None:
        return Adaptive(**options) if dt is None else Fixed(**options)
    if not isinstance(steps, Adaptive | Fixed):
        raise TypeError(f"Expected steps as ltl.solvers.Adaptive(...) or ltl.solvers.Fixed(dt), found {steps!r:.80}.")
    for name, value in options.items():
        if not _agree(value, getattr(steps, name)):
            raise ValueError(f"{name} = {value} contradicts steps = {steps}. Give it inside steps only.")
    return steps


def _agree(value: Any, other: Any) -> bool:
    if value is other:
        return True
    if value is None or other is None or isinstance(value, Tracer) or isinstance(other, Tracer):
        return False
    return np.array_equal(value, other)


def grid_of(t0: ArrayLike, t1: ArrayLike, ts: AnyArray, dt: float | None, substeps: int) -> np.ndarray | None:
    """The times of fixed steps: t0, t1, multiples of dt and the requested times. None for adaptive steps.

    Each step in between is divided into equal substeps.

    Raises:
        ValueError: a time is being traced by JAX, or dt is too long.
    """
    if dt is None:
        return None
    if any(isinstance(value, Tracer) for value in (t0, t1, ts, dt)):
        raise ValueError("Fixed steps need concrete times: t0, t1, ts and dt cannot be traced by JAX.")
    start, end = (np.asarray(time, ts.dtype) for time in (t0, t1))
    if start == end:  # a run of zero length has no steps
        return None
    count = int(np.ceil((end - start) / dt - 1e-6))
    multiples = np.asarray(float(start) + dt * np.arange(1, count), ts.dtype)
    least = max(1e-6 * dt, 4 * float(np.finfo(ts.dtype).eps) * float(max(abs(start), abs(end))))
    grid = without_near_duplicates(start, end, (np.asarray(ts), multiples), least)
    if substeps > 1 and (dt / substeps < least or len(grid) * substeps > _MOST_STEPS):
        raise ValueError(
            f"dt = {dt:g} is too long: each step would be taken in {substeps} parts. Take shorter steps, leave dt out "
            "for adaptive ones, or use ltl.TRBDF2()."
        )
    divided = grid[:-1, None] + np.diff(grid)[:, None] * (np.arange(substeps) / substeps)
    return np.append(divided.ravel(), grid[-1]).astype(grid.dtype)


def without_near_duplicates(start: Any, end: Any, groups: Sequence[np.ndarray], least: float) -> np.ndarray:
    """The ascending times from start to end, at least ``least`` apart.

    Both ends are kept; of two times that are closer, the one of the earlier group is.
    """
    grid = np.array([start, end])
    for group in groups:
        times = np.unique(group)
        times = times[(times > start) & (times < end)]
        neighbours = np.clip(np.searchsorted(grid, times)[:, None] - [0, 1], 0, len(grid) - 1)
        distance = np.abs(times[:, None] - grid[neighbours]).min(axis=1, initial=np.inf)
        grid = np.sort(np.concatenate([grid, times[distance > least]]))
    return grid


def controller_of(
    rtol: Array, atol: Array | None, solver: diffrax.AbstractSolver, size: Callable[[Array], Array]
) -> "AdvancingController":
    """The step size controller of an adaptive run; ``size`` gives the magnitude of each species in a state."""
    longest = None
    if isinstance(solver, Stabilised):
        longest = lambda t, u, args: solver.longest_step(solver.extent(t, u, args))  # noqa: E731
    # The type checker sees neither the defaults of the arguments left out nor the order of fields.
    inner = diffrax.PIDController(rtol=rtol, atol=jnp.zeros_like(rtol) if atol is None else atol)  # type: ignore
    return AdvancingController(inner, longest, None if atol is not None else ATOL_PER_RTOL * rtol, size)  # type: ignore


def first_step(spectral_bound: Array, t0: Array, t1: Array) -> Array:
    """A first step at which an explicit method is stable; the controller adjusts it within a few steps."""
    is_stiff = spectral_bound * (t1 - t0) > 1
    return jnp.where(is_stiff, 1 / jnp.where(is_stiff, spectral_bound, 1), t1 - t0)


class AdvancingController(diffrax.AbstractAdaptiveStepSizeController):
    """A controller that fails when a step would not advance time, where diffrax would take `max_steps` of them.

    This is how a run ends whose state blows up in finite time, or whose implicit stages cannot be solved however short
    the step.

    Attributes:
        controller: the controller that chooses the steps.
        longest: ``(t, y, args) -> length`` of the longest step that the solver can take from a state, or None. A longer
            step would be rejected, at the cost of computing it.
        relative_atol: absolute tolerance of each species divided by its largest magnitude so far. If None, the absolute
            tolerance is that of the controller.
        size: ``y -> magnitudes`` of the species.
    """

    controller: diffrax.AbstractAdaptiveStepSizeController
    longest: Callable[..., Float[Array, ""]] | None = None
    relative_atol: Float[Array, ""] | None = None
    size: Callable[[Array], Array] = lambda y: jnp.max(jnp.abs(y), axis=0)

    @property
    def rtol(self):  # type: ignore
        """The relative tolerance of the controller."""
        return self.controller.rtol

    @property
    def atol(self):  # type: ignore
        """The absolute tolerance of the controller."""
        return self.controller.atol

    @property
    def norm(self):  # type: ignore
        """The norm of the controller."""
        return self.controller.norm

    def wrap(self, direction):
        """The controller for a direction of time."""
        return dataclasses.replace(self, controller=self.controller.wrap(direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """The end of the first step, and the controller's state."""
        end, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return end, (state, self.size(y0))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        """The next step, or a failure if it would not advance time."""
        state, size = controller_state
        size, controller = jnp.maximum(size, self.size(y0)), self.controller
        if self.relative_atol is not None:
            # The smallest number keeps the tolerance positive for a species that is zero.
            magnitude = jnp.fmax(size, self.size(y1_candidate))
            atol = self.relative_atol * magnitude + jnp.finfo(jnp.result_type(size)).tiny
            controller = eqx.tree_at(lambda c: c.atol, controller, atol[None])
        keep, begin, end, made_jump, state, result = controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state
        )
        if self.longest is not None:
            y = jnp.where(keep, y1_candidate, y0)
            # Slightly less, because the difference of the two times is rounded.
            end = jnp.minimum(end, begin + 0.999 * self.longest(begin, y, args).astype(jnp.result_type(end)))
        # A rejected step that rounding leaves as long as before does not advance time either.
        stands_still = ((end <= begin) | (~jnp.asarray(keep) & (end >= t1))) & (result == diffrax.RESULTS.successful)
        result = diffrax.RESULTS.where(stands_still, diffrax.RESULTS.dt_min_reached, result)
        return keep, begin, end, made_jump, (state, size), result


class TextMeter(diffrax.TextProgressMeter):
    """The progress of a run in lines of text with the remaining time, for use without tqdm."""

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


def meter_of(progress: bool | diffrax.AbstractProgressMeter) -> diffrax.AbstractProgressMeter:
    """The progress meter that ``progress`` asks for: a bar if tqdm is installed, lines of text otherwise."""
    if isinstance(progress, diffrax.AbstractProgressMeter):
        return progress
    if not progress:
        return diffrax.NoProgressMeter()
    try:
        return diffrax.TqdmProgressMeter()
    except (ImportError, ValueError):  # tqdm belongs to the extra `app`
        return TextMeter()
