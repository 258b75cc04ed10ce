"""Does the model explain the data? The size of the residuals, their structure in space and time, and outliers."""

import dataclasses
from typing import Any

import numpy as np
from scipy import stats
from scipy.spatial import KDTree

from .observations import Observations

# Fewer than this many pure-noise values per fit are expected to count as outliers.
_FALSE_OUTLIERS = 0.05
# Residuals count as structured from this correlation of neighbours on, if it is also this many standard deviations
# away from what independent noise gives.
_CORRELATED, _SIGNIFICANT = 0.05, 4.0
# If more than this share of the values are outliers, the model is wrong rather than the values.
_MANY = 0.25
# Variance of a standard deviation over that of one estimated from the median; the other constant turns the median of
# absolute values into the standard deviation of a normal distribution.
_EFFICIENCY, _NORMAL_OVER_MEDIAN = 2.7, 1.4826
# Residuals below this share of the data's spread, or of a known noise, are too small for their structure to matter.
_NEGLIGIBLE, _WELL_BELOW = 1e-3, 0.5
# Residuals are clipped at so many standard deviations before correlations are taken, so that outliers do not decide.
_CLIPPED = 3.0
# Neighbours of each place, where data are not given at all vertices.
_NEIGHBOURS = 4
# A model explains nothing if it is worse than the mean of the data by more than this share of their variance.
_WORSE = 0.05
# Residuals this many times a known noise are not noise.
_UNEXPLAINED = 2.0


@dataclasses.dataclass(frozen=True)
class Correlation:
    """How far the residuals of neighbours agree (Moran 1950, Biometrika 37), about zero in place of their mean.

    Attributes:
        value: mean product of the residuals of neighbours over their mean square: 0 for independent noise, near 1 for
            residuals that vary slowly.
        deviations: value over its standard deviation under independent noise of random sign.
    """

    value: float
    deviations: float

    @property
    def is_structure(self) -> bool:
        """Whether it is more than independent noise would show."""
        return self.value > _CORRELATED and self.deviations > _SIGNIFICANT


@dataclasses.dataclass(frozen=True)
class Agreement:
    """How well a model agrees with the data it was fitted to.

    Attributes:
        reduced_chi_square: sum of the squared residuals, in units of a known noise, over the degrees of freedom: about
            1 if model and noise are right. With a robust loss outliers are left out. NaN where the noise is not known,
            or no degree of freedom is left.
        expected: interval that holds the reduced chi square with a probability of 95 % if model and noise are right.
        explained: share of the variance of the data that the model explains, of the values that are no outliers; 0
            for a model that is no better than the mean, negative for a worse one.
        is_negligible: whether the residuals are too small for a pattern in them to matter.
        in_space: correlation of residuals over the surface; None where the data have no places, or the residuals are
            negligible.
        in_time: correlation of residuals from one time to the next; None where there is one time only, or the residuals
            are negligible.
        outliers: indices (K, values.ndim) of values too far from the model to be noise, the farthest first.
        outlier_limit: smallest residual, in standard deviations, of an outlier.
        num_values: number of values that were measured.
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
        """Whether the residuals are much larger than the noise is known to be, or too many values are outliers."""
        return bool(self.reduced_chi_square > _UNEXPLAINED**2) or self.has_many_outliers

    @property
    def has_many_outliers(self) -> bool:
        """Whether so many values are outliers that the model must be wrong, and not the values."""
        return len(self.outliers) > _MANY * self.num_values

    @property
    def is_structured(self) -> bool:
        """Whether the residuals follow a pattern in space or in time, which noise does not."""
        return any(
            correlation is not None and correlation.is_structure for correlation in (self.in_space, self.in_time)
        )

    @property
    def is_useless(self) -> bool:
        """Whether the mean of the data is a better model, and the residuals are not simply noise of the known size."""
        is_noise = self.reduced_chi_square < _UNEXPLAINED**2
        return self.explained < -_WORSE and not is_noise

    def sentence(self) -> str:
        """Whether the model explains the data, in one sentence."""
        if np.isfinite(self.reduced_chi_square):
            low, high = self.expected
            size = f"the reduced chi square is {self.reduced_chi_square:.3g} ({low:.3g} to {high:.3g} expected)"
        else:
            size = f"{100 * self.explained:.4g} % of the variance is explained"
        patterns = [
            f"residuals of neighbours in {where} correlate by {correlation.value:.2f}, which noise does not "
            f"({correlation.deviations:.0f} standard deviations)"
            for where, correlation in (("space", self.in_space), ("time", self.in_time))
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
        rest = "and the residuals show no structure"
        if self.is_negligible:
            rest = "and the residuals are negligible"
        elif self.in_space is None and self.in_time is None:
            rest = "but nothing tells whether the residuals have structure"
        if self.reduced_chi_square > self.expected[1]:
            return f"The model explains the data, though not to the last: {size}, {rest}."
        return f"The model explains the data: {size}, {rest}."


def agreement(
    data: Observations, misfit: np.ndarray, free: float, scales: np.ndarray, num_unknowns: int, surface: Any = None
) -> Agreement:
    """How well a model agrees with its data.

    Args:
        data: the data.
        misfit: residuals in units of the noise where it is known, in the shape of the values.
        free: degrees of freedom: number of values less those that the parameters take; NaN where they are not known.
        scales: standard deviation of the noise in units of the noise given, where it grows with the signal.
        num_unknowns: number of unknowns of the fit.
        surface: surface that carries the field; None where there is none.
    """
    mask = np.asarray(data.mask)
    is_known, rates = data.knows_noise, None
    if data.is_count:
        # Pearson's residuals, whose squares have a mean of one however low the rates are.
        rates = np.maximum(data.predicted(np.where(mask, misfit, 0), np.ones(())), np.finfo(np.float64).tiny)
        misfit = np.where(mask, (rates - np.asarray(data.values, np.float64)) / np.sqrt(rates), np.nan)
    spread = np.ones(()) if is_known else data.median_spread(np.where(mask, misfit, 0), num_unknowns)
    residuals = np.where(mask, misfit / np.broadcast_to(spread, misfit.shape), np.nan)
    size = int(mask.sum())
    # Where the noise is estimated, quotients by it have Student's distribution.
    tail = stats.norm if is_known else stats.t(max(size - num_unknowns, 1) / _EFFICIENCY)
    limit = float(tail.isf(0.5 * _FALSE_OUTLIERS / size))
    is_far = np.nan_to_num(np.abs(residuals)) > limit
    if rates is not None:
        # Counts of low rates have longer tails than a normal distribution.
        counts = np.asarray(data.values, np.float64)
        chance = np.minimum(stats.poisson.sf(counts - 1, rates), stats.poisson.cdf(counts, rates))
        is_far &= chance < 0.5 * _FALSE_OUTLIERS / size
    far = np.argwhere(is_far)
    if len(far):
        far = far[np.argsort(-np.abs(residuals[tuple(far.T)]))]
    chi_square, expected = float("nan"), (float("nan"), float("nan"))
    good = mask & ~is_far
    if data.loss.is_robust:
        free -= len(far)
    if is_known and free >= 1:
        counted = good if data.loss.is_robust else mask
        chi_square = float(np.sum(np.where(counted, misfit, 0) ** 2) / free)
        expected = _expected(free, None if rates is None else rates[counted])
    explained = explained_share(data, misfit, good, scales)
    typical = _NORMAL_OVER_MEDIAN * float(np.sqrt(np.nanmedian(residuals**2)))
    is_small = bool(chi_square < _WELL_BELOW**2 if is_known else 1 - explained < _NEGLIGIBLE**2)
    clipped = np.clip(residuals, -_CLIPPED * typical, _CLIPPED * typical) if typical > 0 else residuals
    in_space = in_time = None
    if not is_small:
        in_space = None if surface is None else _in_space(data, clipped, surface)
        in_time = None if data.times is None or len(data.times) < 2 else _correlation(clipped[:-1], clipped[1:])
    return Agreement(chi_square, expected, explained, is_small, in_space, in_time, far, limit, size)


def _expected(free: float, rates: np.ndarray | None) -> tuple[float, float]:
    """The interval that holds the reduced chi square of a right model with a probability of 95 %.

    Args:
        free: degrees of freedom.
        rates: rates of the counts; None for normal noise.
    """
    if rates is None:
        return float(stats.chi2.ppf(0.025, free) / free), float(stats.chi2.ppf(0.975, free) / free)
    # A squared Pearson residual of a count with the rate l has the variance 2 + 1 / l.
    reach = float(stats.norm.ppf(0.975) * np.sqrt(np.sum(2 + 1 / rates)) / free)
    return max(1 - reach, 0.0), 1 + reach


def explained_share(data: Observations, misfit: np.ndarray, mask: np.ndarray, scales: np.ndarray) -> float:
    """The share of the variance about the mean that a model explains, in units of the noise: the mean over species.

    Args:
        data: the data.
        misfit: residuals in units of the noise where it is known, in the shape of the values.
        mask: which of them count.
        scales: standard deviation of the noise in units of the noise given.
    """
    values = np.asarray(data.values, np.float64)
    noise = scales * (1.0 if data.noise is None else np.asarray(data.noise, np.float64))
    noise = np.broadcast_to(noise, values.shape)
    shares = []
    for column in data.columns:
        seen, weight = values[column][mask[column]], 1 / noise[column][mask[column]] ** 2
        if not seen.size:
            continue
        mean = np.average(seen, weights=weight)
        off = (seen - mean) / np.sqrt(mean or 1.0) if data.is_count else (seen - mean) * np.sqrt(weight)
        if (spread := np.sum(off**2)) > 0:
            shares.append(1 - np.sum(misfit[column][mask[column]] ** 2) / spread)
    return float(np.mean(shares)) if shares else 1.0


def _correlation(first: np.ndarray, second: np.ndarray) -> Correlation | None:
    """The correlation of pairs of residuals, NaN where one was not measured."""
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
    """The correlation of neighbours over the surface, of all times and species together."""
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
    """Where each measurement was taken (N, 3): the weighted mean of its vertices."""
    vertices = np.asarray(surface.vertices, np.float64) + surface.centre
    if data.sampling is not None:
        weights = np.asarray(data.sampling.weights, np.float64)
        total = np.abs(weights).sum(axis=1, keepdims=True)
        return np.einsum("mk,mkd->md", np.abs(weights) / total, vertices[data.sampling.vertices])
    return vertices if data.vertices is None else vertices[data.vertices]


def _neighbours(points: np.ndarray) -> np.ndarray:
    """Pairs of places that are close to each other."""
    count = min(_NEIGHBOURS, len(points) - 1)
    near = KDTree(points).query(points, k=count + 1)[1]
    first = np.repeat(np.arange(len(points)), count + 1)
    pairs = np.sort(np.stack([first, near.ravel()], axis=1), axis=1)
    return np.unique(pairs[pairs[:, 0] < pairs[:, 1]], axis=0)
