"""`fit`: a model, a first guess and data become parameters with error bars. The door to optimistix."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._base.progress import watched
from .agreement import Agreement, agreement
from .checkpoint import Checkpoint
from .methods import MANY
from .observations import Experiment, Observations
from .problem import (
    Model,
    Problem,
    Program,
    Residuals,
    first_unknowns,
    jacobian_of,
    prepare,
    steps_adaptively,
    values_of,
)
from .report import Evidence, evidence, summary as _summary
from .scan import better_start, explains_nothing
from .search import End, FitError, search

# The spread of the misfit and the parameters agree when a round of the fit changes the spread by less than this share;
# rounds at most.
_AGREED, _ROUNDS = 0.01, 12


@dataclasses.dataclass(frozen=True)
class Fit:
    """What a fit found.

    Attributes:
        params: the parameters, as the start was given.
        calibration: what was unknown about the measurement: scale, offset and amount of background, by name.
        losses: (steps,) half the sum of squared residuals after every step, the first step being the start. Where the
            spread of the residuals is taken from the data it changes a few times, and the unit of the loss with it.
        reason: why it stopped, in words.
        has_settled: whether it stopped because the parameters or the loss no longer changed, or no step lowers the
            loss.
        num_steps: number of steps of the method, including rejected ones. Each is a run of the model; a least-squares
            method takes derivatives in every step, other methods in accepted ones.
        method: the method, and how derivatives were taken.
        residuals: (prediction - value) / noise of every value, in the unit of the data where the noise was not given;
            of counts the signed root of the deviance. NaN where nothing was measured.
        evidence: covariance, intervals, and what the data cannot tell; None with many unknowns.
        agreement: whether the model explains the data: size and structure of the residuals, outliers.
        scanned: what was done about a start that explains nothing, in words; empty where it explains something.
        penalties: sum of the squared residuals of the penalty, in the unit of the loss.
    """

    params: Any
    calibration: dict[str, Array]
    losses: np.ndarray
    reason: str
    has_settled: bool
    num_steps: int
    method: str
    residuals: np.ndarray
    evidence: Evidence | None
    agreement: Agreement
    scanned: str
    penalties: float
    _problem: Problem = dataclasses.field(repr=False)
    _program: Program = dataclasses.field(repr=False)
    _z: Array = dataclasses.field(repr=False)

    @property
    def status(self) -> str:
        """What became of the fit, in one of these words or phrases:

        - ``"converged"``: it has settled, the model explains the data, and they determine every parameter;
        - ``"explains nothing"``: it has settled where the mean of the data would be a better model;
        - ``"end of range"``: it has settled with a parameter at the end of its range;
        - ``"unexplained"``: it has settled, and the residuals are much larger than the noise;
        - ``"structured residuals"``: it has settled, and the residuals are no noise: neighbours agree;
        - ``"undetermined"``: it has settled in a flat valley, where the data do not determine every parameter;
        - ``"stopped"``: it has not settled; ``reason`` says why.
        """
        if not self.has_settled:
            return "stopped"
        if self.agreement.is_useless:
            return "explains nothing"
        if self.evidence is not None and self.evidence.at_end.any():
            return "end of range"
        if self.agreement.is_unexplained:
            return "unexplained"
        if self.agreement.is_structured:
            return "structured residuals"
        if self.evidence is not None and self.evidence.cannot_tell:
            return "undetermined"
        return "converged"

    @property
    def converged(self) -> bool:
        """Whether the fit has settled at parameters that explain the data and are determined by them."""
        return self.status == "converged"

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
        return self._problem.residuals.predicted(self._z)

    def summary(self, vertex_numbers: np.ndarray | None = None) -> str:
        """Whether the model explains the data, a table of the parameters with intervals, and how well they are known.

        Args:
            vertex_numbers: (V,) numbers by which vertices are called; by default those of the mesh.
        """
        return _summary(self, self.data, vertex_numbers)

    def __str__(self) -> str:
        return self.summary()

    def plot(self, surface: Any = None) -> Any:
        """Data, model and residuals on the surface, outliers marked; the loss, intervals and regions of pairs, as a
        matplotlib figure.

        Args:
            surface: surface to draw on; by default that of the `Experiment`.
        """
        from .picture import picture

        model = self._problem.model
        known = model.surface if isinstance(model, Experiment) else None
        return picture(self, self.data, known if surface is None else surface)

    def losses_along(self, name: str, deviations: Any) -> np.ndarray:
        """The loss where one parameter is moved by some of its standard deviations, and the others follow it as their
        covariance says. It is the profile where the loss is quadratic, and an upper bound of the profile elsewhere.

        Args:
            name: name of the parameter, as in the table.
            deviations: (P,) multiples of the standard deviation, in the free unknowns.

        Returns:
            (P,) losses, each from one run of the model; infinite where it fails.

        Raises:
            ValueError: there is no such parameter, or nothing is known of its error.
        """
        known, space = self.evidence, self._problem.space
        if name not in space.names:
            raise ValueError(f"There is no parameter {name!r}; there are {', '.join(space.names)}.")
        index = space.names.index(name)
        if known is None or not 0 < known.std[index] < np.inf:
            raise ValueError(f"Nothing is known of the error of {name}.")
        slopes = np.asarray(space.slopes(self._z), np.float64)
        direction = known.covariance[:, index] / (slopes * known.std[index])
        points = [self._z + jnp.asarray(step * direction, self._z.dtype) for step in np.asarray(deviations, np.float64)]
        # With the derivatives, which are not needed, since that program is compiled.
        runs = [jacobian_of(self._program, z, self._problem.reverse)[0][0] for z in points]
        losses = np.array([0.5 * float(jnp.sum(residuals**2)) for residuals in runs])
        return np.where(np.isfinite(losses), losses, np.inf)

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
        return self._problem.profile(self._program, self._z, name, np.asarray(values, np.float64), max_steps)


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
    scan: bool = True,
) -> Fit:
    """The parameters of a model that explain data best, in the sense of least squares or of a robust loss (host).

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
        scan: whether a start that explains nothing is replaced by the best of 96 points around it, with up to 64
            unknowns.

    Returns:
        The `Fit`.

    Raises:
        ValueError: data and model do not go together, there are fewer values (and penalties) than unknowns, or the
            start is outside the range of its transforms.
        RestartError: the file to resume from is that of another fit, or damaged.
        OutputError: ``checkpoint`` names a file that ltljax did not write.
        FitError: the model fails at the start.
    """
    space, z = first_unknowns(start, transforms, data)
    left = spread = None
    keeper = None if checkpoint is None else Checkpoint(Path(checkpoint), space, data)
    if keeper is not None and resume and keeper.path.exists():
        space, z, left, spread = keeper.read()
    if keeper is not None:
        keeper.folder.check([keeper.path.name])
    problem = prepare(model, space, data, penalty, method, z, rtol, atol)
    residuals = problem.program if spread is None else problem.program.with_spread(jnp.asarray(spread, z.dtype))
    function, (value, misfit) = problem.function(residuals, z)
    scanned = ""
    if scan and left is None and explains_nothing(problem.residuals, np.asarray(misfit)):
        z, scanned = _scanned(problem.residuals, z)
        function, (value, misfit) = problem.function(residuals, z)
    # Infinite derivatives make the factor zero.
    if not 0 < float(function.scale) < np.inf and bool(jnp.isfinite(value).all()):
        raise FitError(
            "The model has no finite derivatives at the start, though its prediction is finite. Look for a square "
            "root, a norm or a power of zero there, or begin elsewhere."
        )
    if spread is None and data.has_moving_spread:
        residuals, _ = _respread(data, residuals, misfit)
        function = dataclasses.replace(function, residuals=residuals)

    def after(step: int, loss: float, z: Array) -> bool:
        if keeper is not None:
            if step == 0 and left is not None and not num_steps:
                keeper.refuse_other(loss, left, np.asarray(residuals.arrays.spread, np.float64))
            keeper.keep(z, loss, np.asarray(residuals.arrays.spread))
        return stop_when is not None and bool(stop_when(num_steps + step, loss, space.params(z)))

    def unit(loss: float) -> float:
        return max(0.0 if data.noise is None else 0.5, loss / data.num_values)

    num_steps, losses, end = 0, [], End(z, [], "", False)
    for round_ in range(_ROUNDS):
        steps = range(max_steps - num_steps)
        steps = watched("fit", unit="step")(steps) if progress else steps
        end = search(problem.solver, function, z, steps, unit, after)
        z, num_steps, losses = end.z, num_steps + len(end.losses), losses + end.losses
        if not data.has_moving_spread:
            break
        changed, change = _respread(data, residuals, values_of(residuals, z)[1])
        if change < _AGREED:
            break
        if not end.has_settled or num_steps >= max_steps or round_ == _ROUNDS - 1:
            reason = "the size of the residuals, which is taken from the data, has not settled"
            end = dataclasses.replace(end, has_settled=False, reason=reason if end.has_settled else end.reason)
            break
        residuals = changed
        function = dataclasses.replace(function, residuals=residuals)
    return _found(problem, residuals, dataclasses.replace(end, losses=losses), scanned, confidence)


def _respread(data: Observations, residuals: Program, misfit: Array) -> tuple[Program, float]:
    """The residuals with the spread that the misfit shows, and by what share it differs from the one before."""
    before = np.asarray(residuals.arrays.spread, np.float64)
    spread = data.spread(np.asarray(misfit), before, residuals.num_unknowns)
    change = float(np.max(np.abs(np.log(spread / before))))
    return residuals.with_spread(jnp.asarray(spread, residuals.arrays.spread.dtype)), change


def _scanned(residuals: Any, z: Array) -> tuple[Array, str]:
    """A better start than the first guess, and what was done to find it, in words."""
    better = better_start(residuals, np.asarray(z))
    if better is None:
        return z, "The start explains nothing, and no point within a factor of 1000 of it that was tried explains more."
    start, count = better
    z = jnp.asarray(start, z.dtype)
    values = jax.tree.leaves(residuals.space.params(z))
    flat = np.concatenate([np.ravel(np.asarray(leaf)) for leaf in values])
    words = ", ".join(f"{name} = {value:.3g}" for name, value in zip(residuals.space.names, flat, strict=False))
    return z, f"The start explains nothing, so the fit began at the best of {count} points around it: {words}."


def _found(
    problem: Problem, residuals: Program, end: End, scanned: str, confidence: float
) -> Fit:  # fmt: skip
    data, space, z = problem.data, problem.space, end.z
    spread = np.asarray(residuals.arrays.spread, np.float64)
    known, free = None, float("nan")
    reason, has_settled = end.reason, end.has_settled
    if z.size <= MANY and problem.is_least_squares:
        (value, misfit), jacobian = jacobian_of(residuals, z, problem.reverse)
        if bool(jnp.isfinite(jacobian).all()):
            adaptive = steps_adaptively(problem.model)
            known = evidence(space, z, data, value, misfit, jacobian, spread, confidence, adaptive)
            free = known.degrees_of_freedom
        else:
            reason += "; derivatives are not finite there, so that nothing is known of errors"
            has_settled = False
    else:
        value, misfit = values_of(residuals, z)
    shape = data.values.shape
    # Where the noise was not given, residuals are in the unit of the data.
    factor = spread if data.estimates_spread else 1.0
    misfit = np.where(np.asarray(data.mask), np.asarray(misfit, np.float64).reshape(shape) * factor, np.nan)
    penalties = float(np.sum(np.asarray(value)[data.values.size :] ** 2))
    model = problem.model
    surface = model.surface if isinstance(model, Experiment) and model.vertices is None else None
    scales = np.ones(()) if data.estimates_spread else spread
    agreed = agreement(data, misfit, free, scales, z.size, surface)
    params, calibration = space.values(z)
    return Fit(
        params, calibration, np.array(end.losses), reason, has_settled, len(end.losses), problem.method, misfit, known,
        agreed, scanned, penalties, problem, residuals, z,
    )  # fmt: skip
