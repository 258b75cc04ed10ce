"""`fit`: a model, a first guess and data become parameters with error bars. The door to optimistix."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..progress import watched
from .observations import Observations
from .problem import FAR, MANY, Model, Problem, Residuals, jacobian_of, prepare
from .report import Evidence, evidence
from .report import summary as _summary
from .unknowns import unknowns

# Rejected steps in a row after which no step lowers the loss.
_MOST_REJECTED = 12
# An accepted step that lowers the loss by less than this share is the last.
_SETTLED = 1e-8
# And so is one before a step of less than this share of the tolerance.
_SETTLED_STEP = 0.1


class FitError(RuntimeError):
    """A fit that could not begin: the model fails at the first guess."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """What a fit found.

    Attributes:
        params: the parameters, as the start was given.
        losses: (steps,) half the sum of squared residuals after every step, the start's first.
        reason: why it stopped, in words.
        converged: whether it stopped because the parameters and residuals no longer changed.
        num_steps: of the method; as many runs of the model, with or without derivatives.
        method: the method, and how derivatives were taken.
        residuals: (prediction - value) / noise, of every value.
        evidence: covariance, intervals, and what the data cannot tell; None with many unknowns.
    """

    params: Any
    losses: np.ndarray
    reason: str
    converged: bool
    num_steps: int
    method: str
    residuals: np.ndarray
    evidence: Evidence | None
    _problem: "Problem" = dataclasses.field(repr=False)

    @property
    def data(self) -> Observations:
        """What was fitted."""
        return self._problem.data

    @property
    def loss(self) -> float:
        """Half the sum of squared residuals, in units of the noise, penalties with them."""
        return float(self.losses[-1])

    @property
    def covariance(self) -> np.ndarray | None:
        """(n, n) of the parameters, flattened."""
        return None if self.evidence is None else self.evidence.covariance

    @property
    def singular_values(self) -> np.ndarray | None:
        """Of the Jacobian of the misfit, with respect to relative changes of the parameters; descending."""
        return None if self.evidence is None else self.evidence.singular_values

    @property
    def intervals(self) -> Any:
        """The lower and the upper ends of the confidence intervals, each as the parameters."""
        return None if self.evidence is None else self.evidence.intervals

    @property
    def prediction(self) -> Any:
        """What the model gives with the parameters found."""
        problem = self._problem
        return problem.residuals.predicted(problem.space.free(self.params))

    def summary(self) -> str:
        """A table of the parameters with intervals, and in words how well the data tell them."""
        return _summary(self, self.data)

    def __str__(self) -> str:
        return self.summary()

    def plot(self, surface: Any = None) -> Any:
        """The loss, the data against the model, and the confidence regions of pairs, as a matplotlib figure.

        Args:
            surface: where data of whole states are shown on; none for points alone.
        """
        from .picture import picture

        return picture(self, self.data, surface)

    def profile(self, name: str, values: Any, max_steps: int = 30) -> np.ndarray:
        """The least loss with one parameter held at each of some values: its profile likelihood.

        Two parameters' worth of loss above the least, 1.92, end the 95 % interval of a parameter, also where the
        model is far from linear.

        Args:
            name: of the parameter, as in the table.
            values: (P,) to hold it at.
            max_steps: for each of them.

        Returns:
            (P,) losses.

        Raises:
            ValueError: there is no such parameter, or a value is outside its range.
        """
        return self._problem.profile(self.params, name, np.asarray(values, np.float64), max_steps)


def fit(
    model: Model,
    start: Any,
    data: Observations,
    *,
    transforms: Any = None,
    penalty: Residuals | None = None,
    method: Any = None,
    rtol: float = 1e-5,
    atol: float = 1e-7,
    max_steps: int = 200,
    stop_when: Callable[[int, float, Any], bool] | None = None,
    progress: bool = False,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    confidence: float = 0.95,
) -> Fit:
    """The parameters of a model that explain data best, in the sense of least squares (host).

    With up to 64 unknowns the method is Levenberg-Marquardt on the residuals; their Jacobian is taken in forward mode
    along with the run (`diffrax.ForwardMode`), or in reverse mode where there are fewer values than unknowns. With more
    it is L-BFGS on the loss, its gradient in reverse mode (`diffrax.RecursiveCheckpointAdjoint`): a gradient costs a
    few runs, whatever the number of unknowns. A trial step for which the run fails, or that is not finite, is rejected.

    Args:
        model: an `Experiment`; or a function of the parameters that returns what the data are compared with: a
            `Solution` (then a run that failed is known to have), states, or a statistic. If it calls `solve` let it
            take ``adjoint`` and hand it on.
        start: the first guess: a pytree of floats or arrays.
        data: the `Observations`.
        transforms: the ranges of parameters, such as ``dict(a=Positive())``: a pytree that the parameters continue.
        penalty: ``params -> residuals`` that are added to those of the data, such as `smoothness`.
        method: a solver of optimistix for least squares (`LevenbergMarquardt`, `GaussNewton`, `Dogleg`) or for
            minimisation (`BFGS`, `LBFGS`), or an optimiser of optax; by default as above.
        rtol: it has converged when a step changes unknowns and residuals by less than this share.
        atol: or by less than this.
        max_steps: at most so many.
        stop_when: ``(step, loss, params) -> bool``, asked after each step.
        progress: whether to show a bar with the loss.
        checkpoint: a file (.npz) in which to keep the parameters as the fit goes.
        resume: whether to begin with what ``checkpoint`` holds.
        confidence: of the intervals.

    Returns:
        The `Fit`.

    Raises:
        ValueError: data and model do not go together, there are fewer values (and penalties) than unknowns, or the
            start is outside the range of its transforms.
        FitError: the model fails at the start.
    """
    space = unknowns(start, transforms)
    z = space.free(start)
    problem = prepare(model, space, data, penalty, method, z, rtol, atol)
    keeper = None if checkpoint is None else _Checkpoint(Path(checkpoint), space.names)
    if keeper is not None and resume and keeper.path.exists():
        z = keeper.read()
    converted = problem.converted(z)
    function = problem.function(converted, z)
    options: dict[str, Any] = {}
    y, state = z, _begin(problem.solver, function, z, options)
    losses: list[float] = []
    reason, converged = f"the {max_steps} steps allowed were taken", False
    bar = watched("fit", unit="step")(range(max_steps)) if progress else range(max_steps)
    for step in bar:
        y, state, loss, done, rejected = _step(problem.solver, function, y, options, state)
        losses.append(float(loss / function.scale**2))
        if step == 0 and not losses[0] < 0.5 * FAR**2:
            raise FitError(
                "The model fails at the start: its prediction is not finite, or the run did not reach its end. Run it "
                "there by itself (ltl.solve says why), and begin elsewhere."
            )
        if hasattr(bar, "set_postfix_str"):
            bar.set_postfix_str(f"loss {losses[-1]:.4g}")  # type: ignore
        if keeper is not None:
            keeper.keep(y)
        if bool(done):
            reason, converged = "parameters and residuals no longer change", True
            break
        if step and not int(rejected) and 0 < losses[-2] - losses[-1] <= _SETTLED * losses[-1]:
            reason, converged = "the loss no longer changes", True
            break
        if int(rejected) >= _MOST_REJECTED:
            reason, converged = "no step lowers the loss any further", True
            break
        if stop_when is not None and stop_when(step, losses[-1], space.params(y)):
            reason = "stop_when held"
            break
    return _found(problem, converted, y, losses, reason, converged, confidence)


@eqx.filter_jit
def _begin(solver, function, z, options):
    struct, aux = eqx.filter_eval_shape(function, z, None)
    return solver.init(function, z, None, options, struct, aux, frozenset())


@eqx.filter_jit
def _step(solver, function, z, options, state):
    z, state, _ = solver.step(function, z, None, options, state, frozenset())
    done, _ = solver.terminate(function, z, None, options, state, frozenset())
    loss = state.f_info.as_min() if hasattr(state, "f_info") else state.f
    rejected = getattr(state, "num_steps_since_acceptance", jnp.array(0))
    # In a minimum the residuals' rounding may keep the solver from seeing that its steps lead nowhere.
    ahead = jnp.abs(getattr(state, "y_eval", jnp.inf) - z)
    settled = jnp.all(ahead <= _SETTLED_STEP * (solver.rtol * jnp.abs(z) + solver.atol))
    return z, state, loss, done | settled, rejected


def _found(
    problem: Problem, converted: Any, z: Array, losses: list[float], reason: str, converged: bool, confidence: float
) -> Fit:
    num_values = problem.data.values.size
    space = problem.space
    known = None
    if z.size <= MANY and problem.is_least_squares:
        value, jacobian = jacobian_of(converted, z, problem.reverse)
        known = evidence(space, z, problem.data, value, jacobian, confidence)
    else:
        value = eqx.filter_jit(converted)(z)
    residuals = np.asarray(value[:num_values]).reshape(problem.data.values.shape)
    return Fit(
        space.params(z), np.array(losses), reason, converged, len(losses), problem.method, residuals, known, problem
    )


class _Checkpoint:
    """The unknowns on disk, whole or not at all."""

    def __init__(self, path: Path, names: tuple[str, ...]):
        self.path, self.names = path, names

    def keep(self, z: Array) -> None:
        draft = self.path.with_name(self.path.name + ".part")
        with draft.open("wb") as file:
            np.savez(file, unknowns=np.asarray(z), names=np.array(self.names))
        draft.replace(self.path)

    def read(self) -> Array:
        with np.load(self.path, allow_pickle=False) as kept:
            if tuple(kept["names"]) != self.names:
                raise ValueError(f"{self.path} holds the parameters of another fit: {', '.join(kept['names'][:8])}.")
            return jnp.asarray(kept["unknowns"])
