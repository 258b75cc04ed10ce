"""`fit`: a model, a first guess and data become parameters with error bars. The door to optimistix."""

import dataclasses
import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array

from ..folder import Folder
from ..progress import watched
from ..solve.fingerprint import fingerprint
from ..solve.restart import RestartError
from .methods import MANY, SETTLED, Marquardt
from .observations import Observations
from .problem import Model, Problem, Residuals, jacobian_of, prepare, steps_adaptively
from .report import Evidence, evidence
from .report import summary as _summary
from .unknowns import Unknowns, unknowns

# A step is the last that comes before a step of less than this share of the tolerance.
_SETTLED_STEP = 0.1


# Residuals that differ by less than this share, of themselves and of the data, are those of the same model.
_SAME = 1e-4
_ANEW = "Fit without resume, or give another checkpoint."


# A least-squares fit that crawls ends when so many steps together lower twice the loss by less than this share of the
# variance of the noise.
_CRAWLING, _IMMATERIAL = 12, 1e-3


class FitError(RuntimeError):
    """A fit that could not begin: the model fails at the first guess."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """What a fit found.

    Attributes:
        params: the parameters, as the start was given.
        losses: (steps,) half the sum of squared residuals after every step, the start's first.
        reason: why it stopped, in words.
        converged: whether it stopped because the parameters or the loss no longer changed, or no step lowers the loss.
        num_steps: of the method, rejected ones with them: each a run of the model, with derivatives in a least-squares
            method, and in others where it was accepted.
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
    def num_runs(self) -> int:
        """Of the model: one for each step, one at the start to scale the problem, and one at the end for the evidence.

        Those that an optimiser of optax makes within a step are not counted.
        """
        return self.num_steps + 2

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
    along with the run (`diffrax.ForwardMode`), or row by row of a model that has reverse mode alone and up to 64
    values. With more it is L-BFGS on the loss, its gradient in reverse mode (see `solve`): a gradient costs a few
    runs, whatever the number of unknowns. A trial step for which the run fails, or that is not finite, is rejected and
    a shorter one tried; steps of an optimiser of optax cannot be taken back, and end the fit there.

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
        resume: whether to begin with what ``checkpoint`` holds, whatever the start.
        confidence: of the intervals.

    Returns:
        The `Fit`.

    Raises:
        ValueError: data and model do not go together, there are fewer values (and penalties) than unknowns, or the
            start is outside the range of its transforms.
        RestartError: the file to resume from is that of another fit, or damaged.
        OutputError: ``checkpoint`` names a file that ltljax did not write.
        FitError: the model fails at the start.
    """
    space = unknowns(start, transforms)
    z, left = space.free(start), None
    keeper = None if checkpoint is None else _Checkpoint(Path(checkpoint), space, data)
    if keeper is not None and resume and keeper.path.exists():
        space, z, left = keeper.read()
    if keeper is not None:
        keeper.folder.check([keeper.path.name])
    problem = prepare(model, space, data, penalty, method, z, rtol, atol)
    converted = problem.converted(z)
    function = problem.function(converted, z)
    # Of infinite derivatives it is zero.
    if not 0 < float(function.scale) < np.inf and bool(jnp.isfinite(eqx.filter_jit(converted)(z)).all()):
        raise FitError(
            "The model has no finite derivatives at the start, though its prediction is finite. Look for a square "
            "root, a norm or a power of zero there, or begin elsewhere."
        )
    # Half the variance of the noise, in the loss's unit.
    unit, size = 0.0 if data.noise is None else 0.5, data.values.size
    options: dict[str, Any] = {}
    y, state, best = z, _begin(problem.solver, function, z, options), z
    losses: list[float] = []
    reason, converged = f"the {max_steps} steps allowed were taken", False
    bar = watched("fit", unit="step")(range(max_steps)) if progress else range(max_steps)
    for step in bar:
        y, state, seen = _step(problem.solver, function, y, options, state)
        loss = float(seen.loss / function.scale**2)
        if not np.isfinite(loss):
            if step == 0:
                raise FitError(
                    "The model fails at the start: its prediction is not finite, or the run did not reach its end. Run "
                    "it there by itself (ltl.solve says why), and begin elsewhere."
                )
            reason = "the model fails where the optimiser went, which cannot go back: take a lower rate"
            break
        best = seen.z
        losses.append(loss)
        if hasattr(bar, "set_postfix_str"):
            bar.set_postfix_str(f"loss {loss:.4g}")  # type: ignore
        if keeper is not None:
            if step == 0 and left is not None:
                keeper.refuse_other(loss, left)
            keeper.keep(best, loss)
        if bool(seen.done):
            reason, converged = "parameters or loss no longer change", True
            break
        rejected, failed = int(seen.rejected), int(seen.failed)
        if failed and rejected >= seen.most:
            reason = f"the model fails at every step from here, {failed} ever shorter ones: begin elsewhere"
            break
        if rejected >= seen.most:
            reason, converged = "no step lowers the loss any further", True
            break
        if (
            isinstance(problem.solver, Marquardt)
            and not rejected
            and len(losses) > _CRAWLING
            and losses[-1 - _CRAWLING] - loss <= _IMMATERIAL * max(unit, loss / size)
        ):
            reason, converged = "the loss no longer changes", True
            break
        if stop_when is not None and stop_when(step, loss, space.params(best)):
            reason = "stop_when held"
            break
    return _found(problem, converted, best, losses, reason, converged, confidence)


class _Seen(eqx.Module):
    """A step as `fit` sees it: where the loss is known, the loss, and how the search goes."""

    z: Array
    loss: Array
    done: Array
    rejected: Array
    failed: Array
    most: int = eqx.field(static=True)


@eqx.filter_jit
def _begin(solver, function, z, options):
    struct, aux = eqx.filter_eval_shape(function, z, None)
    return solver.init(function, z, None, options, struct, aux, frozenset())


@eqx.filter_jit
def _step(solver: Any, function: Any, z: Array, options: dict[str, Any], state: Any) -> tuple[Array, Any, _Seen]:
    if isinstance(solver, optx.OptaxMinimiser):
        # Its loss is that of the point the step began at.
        further, state, _ = solver.step(function, z, None, options, state, frozenset())
        none = jnp.array(0)
        return further, state, _Seen(z, state.f, state.terminate, none, none, 1)
    before = state.f_info.as_min()
    further, state, _ = solver.step(function, z, None, options, state, frozenset())
    done, _ = solver.terminate(function, z, None, options, state, frozenset())
    loss, trials, most = state.f_info.as_min(), state.search_state, solver.search.most
    if not isinstance(solver, Marquardt):
        # In a minimum the loss's rounding may keep the solver from seeing that its steps lead nowhere.
        is_short = jnp.abs(state.y_eval - further) <= _SETTLED_STEP * (solver.rtol * jnp.abs(further) + solver.atol)
        done |= jnp.all(is_short) & (trials.failed == 0)
        done |= (loss < before) & (before - loss <= SETTLED * loss)
    return further, state, _Seen(further, loss, done, trials.rejected, trials.failed, most)


def _found(
    problem: Problem, converted: Any, z: Array, losses: list[float], reason: str, converged: bool, confidence: float
) -> Fit:
    num_values = problem.data.values.size
    space = problem.space
    known = None
    if z.size <= MANY and problem.is_least_squares:
        value, jacobian = jacobian_of(converted, z, problem.reverse)
        if bool(jnp.isfinite(jacobian).all()):
            adaptive = steps_adaptively(problem.residuals.model)
            known = evidence(space, z, problem.data, value, jacobian, confidence, adaptive)
        else:
            reason, converged = f"{reason}; derivatives are not finite there, so that nothing is known of errors", False
    else:
        value = eqx.filter_jit(converted)(z)
    residuals = np.asarray(value[:num_values]).reshape(problem.data.values.shape)
    return Fit(
        space.params(z), np.array(losses), reason, converged, len(losses), problem.method, residuals, known, problem
    )


class _Checkpoint:
    """The unknowns on disk, whole or not at all, and what a fit must be to go on from them.

    Args:
        path: the file.
        space: the unknowns.
        data: what is fitted.
    """

    def __init__(self, path: Path, space: Unknowns, data: Observations):
        self.path, self.space, self.data = path, space, data
        self.folder = Folder(path.parent)
        self.fit = {"data": fingerprint(data), "ranges of parameters": fingerprint(space.transforms)}

    def keep(self, z: Array, loss: float) -> None:
        """Write a step."""
        scales = np.array([float(scale) for scale in self.space.scales])
        content = io.BytesIO()
        np.savez(
            content, unknowns=np.asarray(z), names=np.array(self.space.names), scales=scales, loss=loss,
            fit=np.array(list(self.fit.values())),
        )  # fmt: skip
        with self.folder.locked(waits=True):
            self.folder.write(self.path.name, content.getvalue())

    def read(self) -> tuple[Unknowns, Array, float]:
        """The unknowns with the scales they were left with, their vector, and the loss there."""
        try:
            with np.load(self.path, allow_pickle=False) as file:
                kept = {name: file[name] for name in ("unknowns", "names", "scales", "loss", "fit")}
        except (ValueError, KeyError, OSError, EOFError, NotImplementedError, RecursionError, zipfile.BadZipFile):
            raise RestartError(f"{self.path} is damaged, or no file of a fit. {_ANEW}") from None
        if tuple(kept["names"]) != self.space.names:
            raise RestartError(
                f"{self.path} holds the parameters of another fit: {', '.join(kept['names'][:8])}; expected "
                f"{', '.join(self.space.names[:8])}. {_ANEW}"
            )
        for (what, mine), theirs in zip(self.fit.items(), kept["fit"], strict=True):
            if mine != theirs:
                raise RestartError(f"{self.path} holds another fit: its {what} differ. {_ANEW}")
        scales = tuple(jnp.asarray(k, s.dtype) for k, s in zip(kept["scales"], self.space.scales, strict=True))
        space = dataclasses.replace(self.space, scales=scales)
        self.space = space
        return space, jnp.asarray(kept["unknowns"], scales[0].dtype), float(kept["loss"])

    def refuse_other(self, loss: float, left: float) -> None:
        """Raise where the model gives another loss than the one that was left."""
        here, there = np.sqrt(2 * loss), np.sqrt(2 * left)
        noise = 1.0 if self.data.noise is None else np.asarray(self.data.noise)
        size = np.linalg.norm(np.asarray(self.data.values) / noise)
        if not abs(here - there) <= _SAME * (there + size):
            raise RestartError(
                f"{self.path} holds another fit: its loss was {left:.6g} where this model's is {loss:.6g}. {_ANEW}"
            )
