"""`Observations`: measured values with their noise, their places and times, and their misfit to a prediction."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import lambertw

from .._base.arguments import as_numbers, positive
from .._solve import Solution
from .calibration import Calibration, broadcasts, calibration
from .losses import Loss, as_loss
from .sampling import Sampling, as_sampling

# Standard deviation of a normal distribution over the median of its absolute values.
_NORMAL_OVER_MEDIAN = 1.4826


class Observations(eqx.Module):
    """Measured values of some species at some places and times, or of any statistic.

    A value is compared with ``scale * field + offset + amount * background``, where the field is the model's prediction
    at a vertex, or a weighted sum of its values at several. Scale and offset are known numbers, or unknown:
    ``scale=Positive(1.0)`` adds an unknown factor for each observed species to the fit. Values that are NaN or masked
    count as not measured.

    Example:
        >>> import numpy as np
        >>> import ltljax as ltl
        >>> values = np.array([[1.0, 2.0, np.nan], [3.0, 60.0, 5.0]])
        >>> data = ltl.Observations(values, noise=0.1, times=[0.5, 1.0], loss="huber")
        >>> data.num_values
        5

    Attributes:
        values: (T, N, S) at T times, N places and S species, with the axes that the model has: (T, N) for a scalar
            equation, (N, S) for a stationary state, any shape for a statistic. Zero where nothing was measured. The
            last of two axes without times, and of three with times, is the axis of species.
        mask: which values were measured, in the shape of the values.
        noise: standard deviation of the noise at zero signal, a number or an array that broadcasts to the values; None
            if it is unknown, and for counts.
        relative_noise: standard deviation of the part of the noise that grows with the signal, as a share of it.
        is_count: whether the values are counts with a Poisson distribution.
        times: (T,) ascending times; None if the model returns one state or a statistic.
        vertices: (N,) indices of the observed vertices; None for all, and if there is a ``sampling``.
        sampling: weighted sums of values at vertices; None if values at single vertices were measured.
        species: observed columns of the state; None for all.
        calibration: scale, offset and background of the values.
        loss: loss function.
    """

    values: Float[Array, "..."]
    mask: Bool[Array, "..."]
    noise: Float[Array, "..."] | None
    relative_noise: Float[Array, ""] | None
    times: np.ndarray | None
    vertices: np.ndarray | None
    sampling: Sampling | None
    calibration: Calibration
    loss: Loss
    is_count: bool = eqx.field(static=True)
    species: tuple[int, ...] | None = eqx.field(static=True)
    _mask_size: int | None = eqx.field(static=True)

    def __init__(
        self,
        values: Any,
        noise: Any = None,
        times: Any = None,
        vertices: Any = None,
        species: int | tuple[int, ...] | None = None,
        *,
        mask: Any = None,
        loss: Any = "linear",
        relative_noise: float | None = None,
        scale: Any = None,
        offset: Any = None,
        background: Any = None,
        operator: Any = None,
    ):
        """Check the data.

        Args:
            values: measured values; NaN or masked where nothing was measured.
            noise: standard deviation of the noise, a number or an array that broadcasts to the values; ``"poisson"``
                for counts; None if it is unknown: the fit then estimates it from the residuals.
            times: ascending times of the measurements.
            vertices: (N,) indices or a mask (V,); None for all.
            species: observed columns of the state; None for all.
            mask: booleans that broadcast to the values, False for those to leave out.
            loss: ``"linear"`` for least squares; ``"huber"``, ``"soft_l1"`` or ``"cauchy"``, which limit the influence
                of wrong values and estimate the scale of the residuals from the data if no noise is given; or a
                function rho(z) of squared residuals z in units of the noise.
            relative_noise: standard deviation of the noise as a share of the signal, in addition to ``noise``.
            scale: factor between field and data: a number, one for each species, or unknown as ``Positive(1.0)``.
            offset: constant between field and data: a number, one for each species, or unknown as ``Real(0.0)``.
            background: known pattern that broadcasts to the values, which contain an unknown amount of it.
            operator: weighted sums that were measured in place of values at vertices: from `observe_at` or
                `observe_patches`, or a matrix (N, V), dense or sparse.

        Raises:
            ValueError: nothing was measured, a value is infinite, a noise, loss or operator cannot be used, or shapes
                do not match.
        """
        dtype = jnp.result_type(float)
        is_given = ~np.ma.getmaskarray(values) if isinstance(values, np.ma.MaskedArray) else True
        values = values.filled(0) if isinstance(values, np.ma.MaskedArray) else values
        for name, given in (("values", values), ("times", times)):
            as_numbers(name, given)
        host = np.asarray(jnp.asarray(values, dtype))
        self.mask = jnp.asarray(_measured(host, mask, is_given))
        self.values = jnp.where(self.mask, jnp.asarray(host), 0)
        self.is_count = isinstance(noise, str) and noise == "poisson"
        self.noise = None if noise is None or self.is_count else _noise(noise, np.asarray(self.mask), dtype)
        if self.is_count and bool(jnp.any(self.values < 0)):
            raise ValueError('Expected counts from 0 with noise="poisson", found a negative value.')
        self.relative_noise = None
        if relative_noise is not None:
            if self.noise is None:
                raise ValueError(
                    "Expected noise= in addition to relative_noise=: the standard deviation of the noise at zero "
                    "signal."
                )
            self.relative_noise = jnp.asarray(positive("relative_noise", relative_noise), dtype)
        self.loss = as_loss(loss)
        self.times = None if times is None else np.atleast_1d(np.asarray(times, np.float64))
        if self.times is not None:
            if self.times.ndim != 1 or not np.isfinite(self.times).all() or (np.diff(self.times) <= 0).any():
                raise ValueError(f"Expected finite ascending times, found {times}.")
            if host.shape[:1] != self.times.shape:
                raise ValueError(f"Expected values for {len(self.times)} times, found values of shape {host.shape}.")
        self._mask_size, self.vertices = _vertices(vertices)
        self.sampling = None if operator is None else as_sampling(operator)
        if self.sampling is not None and vertices is not None:
            raise ValueError("Expected either vertices= or operator=, found both.")
        self.species = None if species is None else tuple(int(s) for s in np.atleast_1d(species))
        if self.species is not None and (not self.species or min(self.species) < 0):
            raise ValueError(f"Expected species as columns of the state, from 0, found {species!r}.")
        columns = host.shape[-1:] if host.ndim == self._axis + 2 else ()
        self.calibration = calibration(scale, offset, background, columns, host.shape)

    @property
    def num_values(self) -> int:
        """Number of measured values."""
        return int(np.sum(np.asarray(self.mask)))

    @property
    def typical_size(self) -> float:
        """Root mean square of the measured values; 1 if all are zero."""
        return float(np.sqrt(np.mean(np.asarray(self.values, np.float64)[np.asarray(self.mask)] ** 2))) or 1.0

    @property
    def has_species(self) -> bool:
        """Whether the last axis of the values is the axis of species."""
        return self.values.ndim == self._axis + 2

    @property
    def columns(self) -> list[tuple[Any, ...]]:
        """Index of the values of each species; one index of all values if there is no axis of species."""
        return [(..., k) for k in range(self.values.shape[-1])] if self.has_species else [(...,)]

    @property
    def knows_noise(self) -> bool:
        """Whether the noise was given, as numbers or as Poisson's."""
        return self.noise is not None or self.is_count

    @property
    def _axis(self) -> int:
        """The axis of places."""
        return 0 if self.times is None else 1

    def of(self, prediction: Any, calibration: dict[str, Array] | None = None) -> Array:
        """The values that a prediction gives in place of the observed ones.

        Args:
            prediction: output of the model: a `Solution`, states or a statistic.
            calibration: unknown scale, offset and background, by name; without them, only the known ones apply.
        """
        if isinstance(prediction, Solution):
            # A run that failed predicts nothing.
            failed = prediction.overflowed | (prediction.result != diffrax.RESULTS.successful)
            states = prediction.u_end if self.times is None else prediction.us
            prediction = jnp.where(failed & ~prediction.stopped, jnp.nan, states)
        field, axis = jnp.asarray(prediction), self._axis
        if self.sampling is not None:
            field = self.sampling(field, axis)
        if self.vertices is not None:
            field = jnp.take(field, self.vertices, axis=axis)
        if self.species is not None:
            field = jnp.take(field, np.array(self.species), axis=axis + 1)
            field = field[..., 0] if field.ndim == self.values.ndim + 1 and len(self.species) == 1 else field
        return self.calibration(field, calibration or {})

    def check(self, prediction: Any) -> None:
        """Raise `ValueError` if the shapes of a prediction (arrays or their shapes) do not match the data."""
        is_solution = isinstance(prediction, Solution)
        states = prediction.us if is_solution and self.times is not None else prediction
        shape = (states.u_end if isinstance(states, Solution) else states).shape
        axis = self._axis
        if self._mask_size is not None and len(shape) > axis and self._mask_size != shape[axis]:
            raise ValueError(
                f"Expected vertices= as a mask of the model's {shape[axis]} vertices, found one of {self._mask_size}."
            )
        if self.sampling is not None and (len(shape) <= axis or self.sampling.num_vertices != shape[axis]):
            raise ValueError(
                f"The operator reads {self.sampling.num_vertices} vertices; the model predicts the shape {shape}."
            )
        if self.vertices is not None and len(shape) > axis and (self.vertices >= shape[axis]).any():
            raise ValueError(f"Vertex {self.vertices.max()} was observed; the model has {shape[axis]} vertices.")
        if self.species is not None and len(shape) <= axis + 1:
            raise ValueError(f"Species {max(self.species)} was observed; the model has only one. Leave out species=.")
        if self.species is not None and max(self.species) >= shape[axis + 1]:
            raise ValueError(f"Species {max(self.species)} was observed; the model has {shape[axis + 1]} species.")
        predicted = jax.eval_shape(lambda prediction: self.of(prediction), prediction).shape
        if predicted != self.values.shape:
            raise ValueError(
                f"The model predicts an array of shape {predicted} for observations of shape {self.values.shape}. "
                "Expected observations of shape (times, vertices, species), or of the shape of the model's output."
            )

    def misfit(
        self, prediction: Any, calibration: dict[str, Array] | None = None, spread: Array | float = 1.0
    ) -> Float[Array, " M"]:
        """(prediction - value) / noise of every value; zero where nothing was measured.

        For counts it is the signed root of the deviance. The squares of these roots sum to twice the logarithm of a
        likelihood ratio.

        Args:
            prediction: output of the model.
            calibration: unknown scale, offset and background, by name.
            spread: standard deviation of the residuals in units of the noise, as estimated from the data.
        """
        predicted = self.of(prediction, calibration)
        if self.is_count:
            # Where nothing was measured, the rate is set to 1: the derivative of an infinite root would be NaN there.
            rates = jnp.where(self.mask, predicted, 1)
            return jnp.ravel(jnp.where(self.mask, root_of_deviance(self.values, rates), 0))
        noise = jnp.broadcast_to(1.0 if self.noise is None else self.noise, predicted.shape)
        spread = jnp.broadcast_to(jnp.asarray(spread, predicted.dtype), predicted.shape)
        return jnp.ravel(jnp.where(self.mask, (predicted - self.values) / (noise * spread), 0))

    def predicted(self, misfit: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """The predicted values, from their misfit (host).

        Args:
            misfit: misfit in the shape of the values.
            spread: spread that the misfit was computed with.
        """
        values = np.asarray(self.values, np.float64)
        if not self.is_count:
            noise = np.broadcast_to(1.0 if self.noise is None else np.asarray(self.noise, np.float64), values.shape)
            return values + misfit * noise * spread
        # With the deviance d = r^2 / 2 of a count n the rate solves rate / n - 1 - log(rate / n) = d / n.
        safe = np.where(values > 0, values, 1)
        inner = -np.exp(-1 - misfit**2 / (2 * safe))
        above, below = (-safe * np.real(lambertw(inner, branch)) for branch in (-1, 0))
        return np.where(values > 0, np.where(misfit > 0, above, below), misfit**2 / 2)

    def spread(self, misfit: np.ndarray, spread: np.ndarray, num_unknowns: int) -> np.ndarray:
        """Standard deviation of the misfit in units of the noise, for `misfit` (host).

        If the noise grows with the signal, it follows the prediction. With a robust loss and unknown noise it is 1.4826
        times the median of the absolute residuals of each species, which outliers hardly change. Otherwise it is 1.

        Args:
            misfit: (M,) misfit.
            spread: spread that the misfit was computed with.
            num_unknowns: number of unknowns of the fit.
        """
        values = np.asarray(self.values, np.float64)
        residuals = np.reshape(np.asarray(misfit, np.float64), values.shape) * spread
        if self.relative_noise is not None:
            noise = np.broadcast_to(np.asarray(self.noise, np.float64), values.shape)
            return np.sqrt(1 + (float(self.relative_noise) * (values / noise + residuals)) ** 2)
        if not self.estimates_spread:
            return np.ones(())
        return self.median_spread(residuals, num_unknowns)

    def median_spread(self, residuals: np.ndarray, num_unknowns: int) -> np.ndarray:
        """The standard deviation () or (S,) of residuals in the shape of the values, from their median (host).

        As many of the smallest residuals as there are unknowns are left out, because a fit may match that many values
        exactly; so are residuals that are rounding errors.
        """
        mask = np.asarray(self.mask)
        noise = np.broadcast_to(1.0 if self.noise is None else np.asarray(self.noise, np.float64), mask.shape)
        size = np.sqrt(np.mean((np.asarray(self.values, np.float64) / noise)[mask] ** 2))
        least = max(10 * float(jnp.finfo(self.values.dtype).eps) * size, float(jnp.finfo(self.values.dtype).tiny))
        sizes = []
        for column in self.columns:
            absolute = np.sort(np.abs(residuals[column][mask[column]]))
            num_exact = min(round(num_unknowns * absolute.size / self.num_values), max(absolute.size - 1, 0))
            absolute = absolute[num_exact:]
            absolute = absolute[absolute > least]
            sizes.append(_NORMAL_OVER_MEDIAN * np.median(absolute) if absolute.size else least)
        return np.reshape(np.array(sizes), mask.shape[-1:] if self.has_species else ())

    @property
    def spread_shape(self) -> tuple[int, ...]:
        """Shape of `spread`."""
        if self.relative_noise is not None:
            return self.values.shape
        return self.values.shape[-1:] if self.estimates_spread and self.has_species else ()

    @property
    def estimates_spread(self) -> bool:
        """Whether the scale of the residuals is estimated from the data: with a robust loss and unknown noise."""
        return self.loss.is_robust and self.noise is None and not self.is_count

    @property
    def has_moving_spread(self) -> bool:
        """Whether the spread depends on the parameters, so that a fit must continue until both are consistent."""
        return self.estimates_spread or self.relative_noise is not None


def _measured(values: np.ndarray, mask: Any, is_given: Any) -> np.ndarray | np.bool:
    """Which values were measured and are not masked."""
    if values.size == 0:
        raise ValueError("Expected at least one observed value, found none.")
    counts = np.broadcast_to(is_given, values.shape) & ~np.isnan(values)
    if mask is not None:
        mask = np.asarray(mask)
        if mask.dtype != bool or not broadcasts(mask.shape, values.shape):
            raise ValueError(
                f"Expected mask as booleans of a shape that broadcasts to the values' {values.shape}, found the type "
                f"{mask.dtype} and the shape {mask.shape}."
            )
        counts = counts & mask
    refuse_infinite(np.where(counts, values, 0))
    if not counts.any():
        raise ValueError(f"None of the {values.size} values was measured: all of them are NaN or masked.")
    return counts


def _noise(noise: Any, mask: np.ndarray, dtype: Any) -> Array:
    """The checked standard deviation of the noise."""
    if isinstance(noise, str):
        raise ValueError(f'Expected noise as a number, an array or "poisson", found {noise!r}.')
    shape, levels = mask.shape, jnp.asarray(as_numbers("noise", noise), dtype)
    fits = broadcasts(levels.shape, shape)
    if fits and levels.ndim:
        # Where nothing was measured, any noise is accepted.
        levels = jnp.where(jnp.asarray(mask), jnp.broadcast_to(levels, shape), 1)
    if not bool(jnp.all(jnp.isfinite(levels) & (levels > 0))):
        raise ValueError("Expected positive finite noise levels. For values without noise, leave out noise=.")
    if not fits:
        raise ValueError(
            f"Expected noise as a number or an array that broadcasts to the shape {shape} of the values, found the "
            f"shape {levels.shape}."
        )
    return levels


def _vertices(vertices: Any) -> tuple[int | None, np.ndarray | None]:
    """The size of a mask of vertices (None if indices were given), and the indices."""
    if vertices is None:
        return None, None
    indices, mask_size = np.asarray(vertices), None
    if indices.dtype == bool:
        mask_size, indices = indices.size, np.flatnonzero(indices) if indices.ndim == 1 else indices
    if indices.ndim != 1 or not np.issubdtype(indices.dtype, np.integer):
        raise ValueError(f"Expected vertices as indices (N,) or a mask (V,), found {vertices!r}.")
    if (indices < 0).any():
        raise ValueError(f"Expected vertices as indices from 0, found {indices.min()}.")
    return mask_size, indices


def root_of_deviance(counts: Array, rates: Array) -> Array:
    """The signed root of the deviance 2 (rate - count + count log(count / rate)).

    NaN where a rate is not positive, except that a rate of zero is valid for a count of zero.

    McCullagh and Nelder 1989, Generalized Linear Models, section 2.3.
    """
    has_counts = counts > 0
    is_valid = (rates > 0) | ((rates == 0) & ~has_counts)
    rates = jnp.where(rates > 0, rates, jnp.where(is_valid, jnp.finfo(rates.dtype).tiny, 1))
    excess = rates / jnp.where(has_counts, counts, 1) - 1
    is_near = jnp.abs(excess) < 0.05
    # 2 (excess - log(1 + excess)) / excess^2 loses its digits near zero, so its power series is used there.
    series = sum(2 * (-1.0) ** k / (k + 2) * jnp.where(is_near, excess, 0) ** k for k in range(14))
    far = jnp.where(is_near, 1.0, excess)
    ratio = jnp.where(is_near, series, 2 * (far - jnp.log1p(far)) / far**2)
    root = jnp.sqrt(jnp.where(has_counts, counts, 1)) * excess * jnp.sqrt(ratio)
    return jnp.where(is_valid, jnp.where(has_counts, root, jnp.sqrt(2 * rates)), jnp.nan)


def refuse_infinite(values: np.ndarray) -> None:
    """Raise `ValueError` if a value is infinite."""
    bad = np.argwhere(np.isinf(values))
    if len(bad):
        first = tuple(int(i) for i in bad[0])
        raise ValueError(
            f"Expected finite observations, found {values[first]} at index {first} and {len(bad)} infinite values in "
            "all. Mark values that were not measured as NaN."
        )
