"""`Agreement` of a model with its data: size of the residuals, their structure in space and time, and outliers."""

import dataclasses
from typing import Any

import numpy as np
from scipy import stats
from scipy.spatial import KDTree

from .observations import Observations

# Expected number of values per fit that count as outliers although they are pure noise.
_FALSE_OUTLIERS = 0.05
# Residuals count as structured if neighbours correlate by more than the first number, and if the correlation is more
# than the second number of standard deviations away from zero.
_CORRELATED, _SIGNIFICANT = 0.05, 4.0
# If more than this share of the values are outliers, the model is wrong and not the values.
_MANY = 0.25
# Variance of a standard deviation that is estimated from the median, over that of the usual estimate.
_EFFICIENCY = 2.7
# Standard deviation of a normal distribution over the median of its absolute values.
_NORMAL_OVER_MEDIAN = 1.4826
# Residuals below this share of the data's spread, or of a known noise, are too small for their structure to matter.
_NEGLIGIBLE, _WELL_BELOW = 1e-3, 0.5
# Residuals are clipped at this many standard deviations before correlations are computed, to limit outliers.
_CLIPPED = 3.0
# Number of neighbours of each place, if the data are not given at all vertices.
_NEIGHBOURS = 4
# A model explains nothing if it is worse than the mean of the data by more than this share of their variance.
_WORSE = 0.05
# Residuals this many times a known noise are not noise.
_UNEXPLAINED = 2.0


@dataclasses.dataclass(frozen=True)
class Correlation:
    """The correlation of the residuals of neighbours (Moran 1950, Biometrika 37), about zero instead of their mean.

    Attributes:
        value: mean product of the residuals of neighbours over their mean square: 0 for independent noise, near 1 for
            residuals that vary slowly.
        deviations: value over its standard deviation for independent noise of random sign.
    """

    value: float
    deviations: float

    @property
    def is_structure(self) -> bool:
        """Whether the correlation is larger than that of independent noise."""
        return self.value > _CORRELATED and self.deviations > _SIGNIFICANT


@dataclasses.dataclass(frozen=True)
class Agreement:
    """The agreement of a model with the data it was fitted to.

    Attributes:
        reduced_chi_square: sum of the squared residuals, in units of a known noise, over the degrees of freedom: about
            1 if model and noise are right. With a robust loss outliers are left out. NaN if the noise is unknown or
            there are no degrees of freedom.
        expected: interval that holds the reduced chi square with a probability of 95 % if model and noise are right.
        explained: share of the variance of the data, without outliers, that the model explains; 0 for a model that is
            no better than the mean, negative for a worse one.
        is_negligible: whether the residuals are too small for a pattern in them to matter.
        in_space: correlation of residuals over the surface; None if the data have no places, or the residuals are
            negligible.
        in_time: correlation of residuals at consecutive times; None if there is only one time, or the residuals are
            negligible.
        outliers: (K, values.ndim) indices of values too far from the model to be noise, the farthest first.
        outlier_limit: smallest residual of an outlier, in standard deviations.
        num_values: number of measured values.
    """

    reduced_chi_square: float
    expected: tuple[float, float]
    explained: float
    is_negligible: bool
    in_space: Correlation | None
    in_time: Correlation | None
    outliers: np.ndarray
    outlier_limit: float
    num_values: int

    @property
    def is_unexplained(self) -> bool:
        """Whether the residuals are much larger than the known noise, or too many values are outliers."""
        return bool(self.reduced_chi_square > _UNEXPLAINED**2) or self.has_many_outliers

    @property
    def has_many_outliers(self) -> bool:
        """Whether so many values are outliers that the model must be wrong rather than the values."""
        return len(self.outliers) > _MANY * self.num_values

    @property
    def is_structured(self) -> bool:
        """Whether the residuals follow a pattern in space or in time, unlike noise."""
        return any(
            correlation is not None and correlation.is_structure for correlation in (self.in_space, self.in_time)
        )

    @property
    def is_useless(self) -> bool:
        """Whether the mean of the data is a better model, and the residuals are not just noise of the known size."""
        is_noise = self.reduced_chi_square < _UNEXPLAINED**2
        return self.explained < -_WORSE and not is_noise

    def sentence(self) -> str:
        """A sentence that says whether the model explains the data."""
        if np.isfinite(self.reduced_chi_square):
            low, high = self.expected
            size = f"the reduced chi square is {self.reduced_chi_square:.3g} ({low:.3g} to {high:.3g} expected)"
        else:
            size = f"{100 * self.explained:.4g} % of the variance is explained"
        patterns = [
            f"residuals of neighbours in {domain} correlate by {correlation.value:.2f}, unlike noise "
            f"({correlation.deviations:.0f} standard deviations)"
            for domain, correlation in (("space", self.in_space), ("time", self.in_time))
            if correlation is not None and correlation.is_structure
        ]
        if self.is_useless:
            return "The model explains nothing: the mean of the data is closer to them than the model."
        if self.has_many_outliers:
            patterns.append(f"{len(self.outliers)} of {self.num_values} values are too far from the model to be noise")
        if self.is_unexplained or patterns:
            return f"The model does not explain the data: {'; '.join([size, *patterns])}."
        if not np.isfinite(self.reduced_chi_square) and self.explained < _WORSE:
            return f"The model explains the data no better than their mean does: {size}."
        structure = "and the residuals show no structure"
        if self.is_negligible:
            structure = "and the residuals are negligible"
        elif self.in_space is None and self.in_time is None:
            structure = "but whether the residuals have structure is unknown"
        if self.reduced_chi_square > self.expected[1]:
            return f"The model explains the data, though not completely: {size}, {structure}."
        return f"The model explains the data: {size}, {structure}."


def agreement(
    data: Observations, misfit: np.ndarray, free: float, scales: np.ndarray, num_unknowns: int, surface: Any = None
) -> Agreement:
    """The agreement of a model with its data.

    Args:
        data: the data.
        misfit: residuals in the shape of the values, in units of the noise if that is known.
        free: degrees of freedom: number of values minus the number that the parameters take; NaN if unknown.
        scales: standard deviation of the noise in units of the given noise, if it grows with the signal.
        num_unknowns: number of unknowns of the fit.
        surface: surface of the field; None if there is none.
    """
    mask = np.asarray(data.mask)
    is_known, rates = data.knows_noise, None
    if data.is_count:
        # Pearson's residuals, whose squares have a mean of one even for low rates.
        rates = np.maximum(data.predicted(np.where(mask, misfit, 0), np.ones(())), np.finfo(np.float64).tiny)
        misfit = np.where(mask, (rates - np.asarray(data.values, np.float64)) / np.sqrt(rates), np.nan)
    spread = np.ones(()) if is_known else data.median_spread(np.where(mask, misfit, 0), num_unknowns)
    residuals = np.where(mask, misfit / np.broadcast_to(spread, misfit.shape), np.nan)
    size = int(mask.sum())
    # If the noise is estimated, residuals in units of it have Student's distribution.
    tail = stats.norm if is_known else stats.t(max(size - num_unknowns, 1) / _EFFICIENCY)
    limit = float(tail.isf(0.5 * _FALSE_OUTLIERS / size))
    is_outlier = np.nan_to_num(np.abs(residuals)) > limit
    if rates is not None:
        # Counts of low rates have longer tails than a normal distribution.
        counts = np.asarray(data.values, np.float64)
        probability = np.minimum(stats.poisson.sf(counts - 1, rates), stats.poisson.cdf(counts, rates))
        is_outlier &= probability < 0.5 * _FALSE_OUTLIERS / size
    outliers = np.argwhere(is_outlier)
    if len(outliers):
        outliers = outliers[np.argsort(-np.abs(residuals[tuple(outliers.T)]))]
    chi_square, expected = float("nan"), (float("nan"), float("nan"))
    is_good = np.asarray(mask & ~is_outlier)
    if data.loss.is_robust:
        free -= len(outliers)
    if is_known and free >= 1:
        counted = is_good if data.loss.is_robust else mask
        chi_square = float(np.sum(np.where(counted, misfit, 0) ** 2) / free)
        expected = _expected(free, None if rates is None else rates[counted])
    explained = explained_share(data, misfit, is_good, scales)
    is_small = bool(chi_square < _WELL_BELOW**2 if is_known else 1 - explained < _NEGLIGIBLE**2)
    in_space = in_time = None
    if not is_small:
        in_space, in_time = _correlations(data, residuals, surface)
    return Agreement(chi_square, expected, explained, is_small, in_space, in_time, outliers, limit, size)


def _correlations(
    data: Observations, residuals: np.ndarray, surface: Any
) -> tuple[Correlation | None, Correlation | None]:
    """The correlations of the residuals of neighbours in space and in time."""
    typical = _NORMAL_OVER_MEDIAN * float(np.sqrt(np.nanmedian(residuals**2)))
    clipped = np.clip(residuals, -_CLIPPED * typical, _CLIPPED * typical) if typical > 0 else residuals
    in_space = None if surface is None else _in_space(data, clipped, surface)
    in_time = None if data.times is None or len(data.times) < 2 else _correlation(clipped[:-1], clipped[1:])
    return in_space, in_time


def _expected(free: float, rates: np.ndarray | None) -> tuple[float, float]:
    """The interval that holds the reduced chi square of a right model with a probability of 95 %.

    Args:
        free: degrees of freedom.
        rates: rates of the counts; None for normal noise.
    """
    if rates is None:
        return float(stats.chi2.ppf(0.025, free) / free), float(stats.chi2.ppf(0.975, free) / free)
    # The squared Pearson residual of a count with the rate l has the variance 2 + 1 / l.
    reach = float(stats.norm.ppf(0.975) * np.sqrt(np.sum(2 + 1 / rates)) / free)
    return max(1 - reach, 0.0), 1 + reach


def explained_share(data: Observations, misfit: np.ndarray, mask: np.ndarray, scales: np.ndarray) -> float:
    """The share of the variance about the mean that a model explains, in units of the noise; the mean over species.

    Args:
        data: the data.
        misfit: residuals in the shape of the values, in units of the noise if that is known.
        mask: which residuals count.
        scales: standard deviation of the noise in units of the given noise.
    """
    values = np.asarray(data.values, np.float64)
    noise = scales * (1.0 if data.noise is None else np.asarray(data.noise, np.float64))
    noise = np.broadcast_to(noise, values.shape)
    shares = []
    for column in data.columns:
        measured, weight = values[column][mask[column]], 1 / noise[column][mask[column]] ** 2
        if not measured.size:
            continue
        mean = np.average(measured, weights=weight)
        centred = measured - mean
        centred = centred / np.sqrt(mean or 1.0) if data.is_count else centred * np.sqrt(weight)
        if (spread := np.sum(centred**2)) > 0:
            shares.append(1 - np.sum(misfit[column][mask[column]] ** 2) / spread)
    return float(np.mean(shares)) if shares else 1.0


def _correlation(first: np.ndarray, second: np.ndarray) -> Correlation | None:
    """The correlation of pairs of residuals, NaN where nothing was measured; None for fewer than two pairs."""
    is_pair = np.isfinite(first) & np.isfinite(second)
    if is_pair.sum() < 2:
        return None
    products = (first * second)[is_pair]
    size = 0.5 * np.mean(first[is_pair] ** 2 + second[is_pair] ** 2)
    deviation = np.sqrt(np.sum(products**2))
    if size == 0 or deviation == 0:
        return None
    return Correlation(float(products.mean() / size), float(products.sum() / deviation))


def _in_space(data: Observations, residuals: np.ndarray, surface: Any) -> Correlation | None:
    """The correlation of neighbours on the surface, over all times and species."""
    axis = 0 if data.times is None else 1
    if residuals.ndim <= axis or residuals.shape[axis] < 2:
        return None
    if data.sampling is None and data.vertices is None:
        faces = np.asarray(surface.faces)
        pairs = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    else:
        pairs = _neighbours(places(data, surface))
    if not len(pairs) or pairs.max() >= residuals.shape[axis]:
        return None
    placed = np.moveaxis(residuals, axis, 0)
    return _correlation(placed[pairs[:, 0]], placed[pairs[:, 1]])


def places(data: Observations, surface: Any) -> np.ndarray:
    """The position (N, 3) of each measurement: the weighted mean of its vertices."""
    vertices = np.asarray(surface.vertices, np.float64) + surface.centre
    if data.sampling is not None:
        weights = np.asarray(data.sampling.weights, np.float64)
        total = np.abs(weights).sum(axis=1, keepdims=True)
        return np.einsum("mk,mkd->md", np.abs(weights) / total, vertices[data.sampling.vertices])
    return vertices if data.vertices is None else vertices[data.vertices]


def _neighbours(points: np.ndarray) -> np.ndarray:
    """Pairs (P, 2) of points that are close to each other."""
    count = min(_NEIGHBOURS, len(points) - 1)
    nearest = KDTree(points).query(points, k=count + 1)[1]
    first = np.repeat(np.arange(len(points)), count + 1)
    pairs = np.sort(np.stack([first, nearest.ravel()], axis=1), axis=1)
    return np.unique(pairs[pairs[:, 0] < pairs[:, 1]], axis=0)
