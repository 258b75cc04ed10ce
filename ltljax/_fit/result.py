"""`Fit`: parameters with their error bars, why the search ended, and whether the model explains the data."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._base.deprecated import renamed_arguments, warn_deprecated
from .agreement import Agreement
from .evidence import Evidence
from .experiment import Experiment
from .observations import Observations
from .problem import Problem, Program, jacobian_of
from .report import summary as _summary


@dataclasses.dataclass(frozen=True)
class Fit:
    """The result of a fit.

    Attributes:
        params: fitted parameters, in the structure of the start.
        calibration: fitted scale, offset and amount of background of the data, by name.
        losses: (iterations,) half the sum of squared residuals after every iteration, beginning with the start. If the
            spread of the residuals is estimated from the data, it changes a few times, and the unit of the loss with
            it.
        reason: why the search ended, as a sentence without its capital and full stop.
        has_settled: whether the search ended because the parameters or the loss no longer changed, or because no step
            lowers the loss.
        num_iterations: number of iterations of the method, including those whose step was rejected. Each is one run of
            the model. Least-squares methods take derivatives in every iteration, other methods in accepted ones.
        method: method and mode of differentiation, in words.
        residuals: (prediction - value) / noise of every value, in the unit of the data if the noise was not given; for
            counts the signed root of the deviance. NaN where nothing was measured.
        evidence: covariance, intervals and the directions that the data do not determine; None with many unknowns.
        agreement: size and structure of the residuals, and outliers.
        scanned: sentence about the scan for a better start; empty if there was none.
        penalties: sum of the squared residuals of the penalty, in the unit of the loss.
    """

    params: Any
    calibration: dict[str, Array]
    losses: np.ndarray
    reason: str
    has_settled: bool
    num_iterations: int
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
        """Status of the fit, one of these:

        - ``"converged"``: it has settled, the model explains the data, and the data determine every parameter;
        - ``"explains nothing"``: it has settled where the mean of the data would be a better model;
        - ``"end of range"``: it has settled with a parameter at the end of its range;
        - ``"unexplained"``: it has settled, and the residuals are much larger than the noise;
        - ``"structured residuals"``: it has settled, and residuals of neighbours correlate, unlike noise;
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
        """Number of runs of the model: one for each iteration, one at the start that scales the problem, and one at
        the end for the evidence.

        Runs that an optimiser of optax makes within an iteration are not counted.
        """
        return self.num_iterations + 2

    @property
    def num_steps(self) -> int:
        """Deprecated name of ``num_iterations``."""
        warn_deprecated("Fit.num_steps", "num_iterations")
        return self.num_iterations

    @property
    def data(self) -> Observations:
        """The fitted data."""
        return self._problem.data

    @property
    def loss(self) -> float:
        """Half the sum of squared residuals, in units of the noise, including those of the penalty."""
        return float(self.losses[-1])

    @property
    def covariance(self) -> np.ndarray | None:
        """(n, n) covariance of the flattened parameters."""
        return None if self.evidence is None else self.evidence.covariance

    @property
    def singular_values(self) -> np.ndarray | None:
        """Singular values of the misfit's Jacobian with respect to relative changes of the parameters, descending."""
        return None if self.evidence is None else self.evidence.singular_values

    @property
    def intervals(self) -> Any:
        """Lower and upper ends of the confidence intervals, each in the structure of the parameters."""
        return None if self.evidence is None else self.evidence.intervals

    @property
    def prediction(self) -> Any:
        """Output of the model at the fitted parameters."""
        return self._problem.residuals.predicted(self._z)

    def summary(self, vertex_numbers: np.ndarray | None = None) -> str:
        """A report: whether the model explains the data, a table of parameters with intervals, and how well each of
        them is known.

        Args:
            vertex_numbers: (V,) numbers to call the vertices by; by default those of the mesh.
        """
        return _summary(self, self.data, vertex_numbers)

    def __str__(self) -> str:
        return self.summary()

    def plot(self, surface: Any = None) -> Any:
        """A matplotlib figure: data, model and residuals on the surface with outliers marked, the loss, the intervals,
        and the joint confidence regions of pairs of parameters.

        Args:
            surface: surface to draw on; by default that of the `Experiment`.
        """
        from .picture import picture

        model = self._problem.model
        own_surface = model.surface if isinstance(model, Experiment) else None
        return picture(self, self.data, own_surface if surface is None else surface)

    def losses_along(self, name: str, deviations: Any) -> np.ndarray:
        """The loss as one parameter moves by multiples of its standard deviation and the others follow it according to
        the covariance.

        This is the profile if the loss is quadratic, and an upper bound of the profile otherwise.

        Args:
            name: name of the parameter, as in the table.
            deviations: (P,) multiples of the standard deviation, in the free unknowns.

        Returns:
            (P,) losses, each from one run of the model; infinite if it fails.

        Raises:
            ValueError: there is no parameter of this name, or its error is not known.
        """
        evidence, space = self.evidence, self._problem.space
        if name not in space.names:
            raise ValueError(f"There is no parameter {name!r}; there are {', '.join(space.names)}.")
        index = space.names.index(name)
        if evidence is None or not 0 < evidence.std[index] < np.inf:
            raise ValueError(f"The standard deviation of {name} is not known, so its loss has no scale to move along.")
        slopes = np.asarray(space.slopes(self._z), np.float64)
        direction = evidence.covariance[:, index] / (slopes * evidence.std[index])
        multiples = np.asarray(deviations, np.float64)
        points = [self._z + jnp.asarray(multiple * direction, self._z.dtype) for multiple in multiples]
        # The program that also takes derivatives is used because it is compiled already.
        residuals = [jacobian_of(self._program, z, self._problem.reverse)[0][0] for z in points]
        losses = np.array([0.5 * float(jnp.sum(r**2)) for r in residuals])
        return np.where(np.isfinite(losses), losses, np.inf)

    @renamed_arguments(max_steps="max_iterations")
    def profile(self, name: str, values: Any, max_iterations: int = 30) -> np.ndarray:
        """The least loss with one parameter held at each of some values: its profile likelihood.

        The 95 % interval of the parameter ends where the profile is 1.92 above its minimum (half the quantile of chi
        square with one degree of freedom), also if the model is far from linear.

        Args:
            name: name of the parameter, as in the table.
            values: (P,) values to hold it at.
            max_iterations: largest number of iterations for each value.

        Returns:
            (P,) losses.

        Raises:
            ValueError: there is no parameter of this name, or a value is outside its range.
        """
        return self._problem.profile(self._program, self._z, name, np.asarray(values, np.float64), max_iterations)
