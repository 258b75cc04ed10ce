"""`Evidence`: covariance, intervals, and the directions of the parameters that the data do not determine."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .observations import Observations
from .unknowns import Unknowns

# Adaptive time steps change with the parameters. If doubling the parameters along a direction changes the predictions
# by less than this share of their spread, the change may be the error of the steps. (For a diffusivity that enters only
# through the length of the first step, the change is up to 0.64 %.)
_UNSEEN = 1e-2
# A direction counts as not determined from this relative standard deviation on.
_VAGUE = 0.5
# Smallest number of degrees of freedom from which the noise is estimated.
_FEW = 0.5


@dataclasses.dataclass(frozen=True)
class Evidence:
    """The information about the parameters in the Jacobian of a fit.

    Attributes:
        names: names of the flattened parameters and of the unknowns of the measurement.
        values: (n,) values of both.
        covariance: (n, n) covariance. With known noise it is (J^T J)^-1, with unknown noise (J^T J)^-1 J^T D J
            (J^T J)^-1 with the variance D of the residuals of each species, and with a robust loss the sandwich
            A^-1 B A^-1 with the second derivative A of the loss along J and the sum B of its squared slopes (Huber
            1967; White 1980).
        std: (n,) standard deviations.
        intervals: lower and upper ends of the confidence intervals, each in the structure of the parameters. They are
            symmetric in the free unknowns, so the interval of a positive parameter is positive.
        ends: (2, n) the same ends, flattened as ``values``.
        at_end: (n,) which values are at an end of their range.
        confidence: confidence of the intervals.
        singular_values: (n,) singular values of the data's Jacobian with respect to relative changes, descending.
        directions: (n, n) relative changes that belong to the singular values, in rows.
        noise: standard deviation of the data's residuals, in units of the noise if that was given, so that 1 means that
            model and noise are right, and otherwise in the unit of the data. NaN if there are no degrees of freedom to
            estimate it from. With a robust loss it comes from the median, and is the root mean square over species.
        degrees_of_freedom: number of values minus the number that the parameters take.
        cannot_tell: a sentence for each direction that the data do not determine.
    """

    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    std: np.ndarray
    intervals: tuple[Any, Any]
    ends: np.ndarray
    at_end: np.ndarray
    confidence: float
    singular_values: np.ndarray
    directions: np.ndarray
    noise: float
    degrees_of_freedom: float
    cannot_tell: tuple[str, ...]


def evidence(
    space: Unknowns, z: Array, data: Observations, residuals: Array, misfit: Array, jacobian: Array,
    spread: np.ndarray, confidence: float, adaptive: bool,
) -> Evidence:  # fmt: skip
    """The evidence at a minimum.

    The variance of the data's residuals is their sum of squares over the degrees of freedom M - tr(J (J^T J + P^T P)^-1
    J^T), for M values with the Jacobian J and penalties with the Jacobian P. A parameter that is determined by a
    penalty takes no degree of freedom (Hastie, Tibshirani, Friedman 2009, The Elements of Statistical Learning, eq.
    7.32).

    Args:
        space: unknowns.
        z: vector of the unknowns at the minimum.
        data: data.
        residuals: (M + P,) residuals, which the loss made of the misfit, and penalties.
        misfit: (M,) misfit.
        jacobian: (M + P, n) derivative of the residuals with respect to z.
        spread: standard deviation that the misfit was divided by, if it is estimated from the data.
        confidence: confidence of the intervals.
        adaptive: whether the model takes adaptive time steps, whose errors hide smaller effects.
    """
    r, j, misfit_ = (np.asarray(array, np.float64) for array in (residuals, jacobian, misfit))
    num_values = data.values.size
    if data.is_count and not data.loss.is_robust:
        j = np.concatenate([_pearson_jacobian(data, misfit_, j[:num_values]), j[num_values:]])
    errors = _errors(data, r, misfit_, j, spread)
    values, slopes = space.values(z), np.asarray(space.slopes(z), np.float64)
    flat = _flat(values)
    # A Gauss-Newton step in the parameters is zero at a minimum inside the range, and leads beyond an end of the range.
    at_end = space.at_end(values, flat - slopes * errors.newton_step)
    std_z = np.sqrt(np.diag(errors.covariance))
    ends = _interval_ends(space, z, data, std_z, errors.degrees_of_freedom, confidence)
    # Changes are relative to the parameter, or to the scale of the start if the parameter is near zero.
    leaves = jax.tree.leaves(values)
    scales = _flat([np.full(np.shape(leaf), scale) for scale, leaf in zip(space.scales, leaves, strict=True)])
    sizes = np.maximum(np.abs(flat), 1e-3 * scales)
    relative = j[:num_values] * (sizes / np.where(slopes == 0, 1.0, slopes))
    singular_values, directions = _singular(relative)
    deviations = np.where(np.isfinite(errors.deviations) & (errors.deviations > 0), errors.deviations, 1.0)
    beyond = [
        f"{name} is at the end of its range, {value:.4g}. The best value lies there or beyond, so the interval has no "
        "meaning."
        for name, value, is_at_end in zip(space.names, flat, at_end, strict=True)
        if is_at_end
    ]
    vague = _vague(
        space.names,
        relative / deviations[:, None],
        at_end,
        level=_level(data, spread * deviations.reshape(data.values.shape)),
        rounding=float(np.sqrt(jnp.finfo(jacobian.dtype).eps)),
        adaptive=adaptive,
        is_noise_known=bool(np.isfinite(errors.deviations).all()),
    )
    return Evidence(
        names=space.names,
        values=flat,
        covariance=slopes[:, None] * errors.covariance * slopes,
        std=slopes * std_z,
        intervals=(ends[0][0], ends[1][0]),
        ends=np.array([_flat(end) for end in ends]),
        at_end=at_end,
        confidence=confidence,
        singular_values=singular_values,
        directions=directions,
        noise=errors.noise,
        degrees_of_freedom=errors.degrees_of_freedom,
        cannot_tell=(*beyond, *vague),
    )


@dataclasses.dataclass(frozen=True)
class _Errors:
    """The errors of the unknowns.

    Attributes:
        covariance: (n, n) covariance of the unknowns.
        deviations: (M,) standard deviation of each residual of the data.
        noise: standard deviation of the data's residuals, as in `Evidence`.
        degrees_of_freedom: number of values minus the number that the unknowns take.
        newton_step: (n,) Gauss-Newton step, to be subtracted from the unknowns.
    """

    covariance: np.ndarray
    deviations: np.ndarray
    noise: float
    degrees_of_freedom: float
    newton_step: np.ndarray


def _errors(data: Observations, r: np.ndarray, misfit: np.ndarray, j: np.ndarray, spread: np.ndarray) -> _Errors:
    """The errors of the unknowns, from the singular value decomposition of the Jacobian."""
    num_values = data.values.size
    u, s, vt = np.linalg.svd(j, full_matrices=False)
    safe = np.maximum(s, np.finfo(np.float64).eps * (s[0] or 1.0))
    leverages = np.sum((j[:num_values] @ (vt.T / safe)) ** 2, axis=1)
    free = data.num_values - float(np.sum(leverages))
    noise = float(np.sqrt(np.sum(r[:num_values] ** 2) / free)) if free > _FEW else float("nan")
    is_known = data.knows_noise or data.estimates_spread
    sigma = 1.0 if is_known else noise
    deviations = np.full(num_values, sigma)
    inverse = (vt.T / safe**2) @ vt
    if data.loss.is_robust:
        covariance = _sandwich(data, misfit, j, free)
        noise = float(np.sqrt(np.mean(spread**2)))
        if data.knows_noise:
            noise = float(data.median_spread(np.reshape(misfit, data.values.shape), j.shape[1]).mean())
    else:
        covariance = inverse * sigma**2
    if not is_known and data.has_species and np.isfinite(sigma):
        variances = _variances(data, r[:num_values], leverages, sigma**2)
        weights = np.concatenate([variances, np.full(len(r) - num_values, sigma**2)])
        covariance = inverse @ ((j * weights[:, None]).T @ j) @ inverse
        deviations = np.sqrt(np.maximum(variances, np.finfo(np.float64).tiny))
    return _Errors(covariance, deviations, noise, free, (vt.T / safe) @ (u.T @ r))


def _interval_ends(
    space: Unknowns, z: Array, data: Observations, std: np.ndarray, free: float, confidence: float
) -> list[tuple[Any, Any]]:
    """Parameters and calibration at the lower and the upper ends of the confidence intervals."""
    from scipy import stats

    probability = 0.5 + confidence / 2
    quantile = stats.norm.ppf(probability) if data.knows_noise else stats.t.ppf(probability, max(free, _FEW))
    reach = float(quantile) * std
    return [space.values(z + jnp.asarray(side * reach, z.dtype)) for side in (-1, 1)]


def _singular(jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All n singular values of a Jacobian (M, n), zeros included, and the directions (n, n) in rows."""
    size = jacobian.shape[1]
    _, singular_values, directions = np.linalg.svd(jacobian, full_matrices=len(jacobian) < size)
    return np.concatenate([singular_values, np.zeros(size - len(singular_values))]), directions


def _vague(
    names: tuple[str, ...], jacobian: np.ndarray, at_end: np.ndarray, level: float, rounding: float, adaptive: bool,
    is_noise_known: bool,
) -> list[str]:  # fmt: skip
    """A sentence for each direction of the parameters that the data do not determine.

    Args:
        names: names of the parameters.
        jacobian: (M, n) derivative of the predictions with respect to relative changes, in units of the noise.
        at_end: (n,) which parameters are at an end of their range; these have a sentence of their own.
        level: size of the data's variation, in units of the noise.
        rounding: share of ``level`` below which a change is a rounding error.
        adaptive: whether the model takes adaptive time steps, whose errors hide small changes.
        is_noise_known: whether the noise was given or could be estimated.
    """
    sentences = []
    for value, direction in zip(*_singular(jacobian), strict=True):
        if np.abs(direction[at_end]).max(initial=0.0) > _VAGUE:
            continue
        is_vague, share = is_noise_known and _VAGUE * value < 1, value / level
        if share < rounding or (is_vague and adaptive and share < _UNSEEN):
            sentences.append(_sentence(names, direction, share, "tell", "not seen at all"))
        elif is_vague:
            sentences.append(_sentence(names, direction, share, "tell", f"known to {100 / value:.0f} % only"))
        elif adaptive and share < _UNSEEN:
            cause = "less than the errors that adaptive steps may have: tighten rtol and atol, or give dt="
            sentences.append(_sentence(names, direction, share, "safely tell", cause))
    return sentences


def _sentence(names: tuple[str, ...], direction: np.ndarray, share: float, verb: str, cause: str) -> str:
    """A sentence about a direction (n,) of relative changes.

    Args:
        names: names of the parameters.
        direction: (n,) relative changes, of norm one.
        share: change of the predictions along it, as a share of their spread.
        verb: what the data cannot do with the parameters.
        cause: why they cannot.
    """
    largest = np.abs(direction).max()
    # The sign makes the first of the large changes an increase. If only the largest counted, rounding errors would
    # decide between equal changes.
    first = np.flatnonzero(np.abs(direction) > 0.9 * largest)[0]
    change = direction / largest * np.sign(direction[first])
    parts = [f"{name} {10 * c:+.2g} %" for name, c in zip(names, change, strict=True) if abs(c) > 0.05]
    effect = 0.1 * share * np.linalg.norm(change)
    what = f"{parts[0].rsplit(' ', 2)[0]} alone" if len(parts) == 1 else "these apart"
    return (
        f"The data do not {verb} {what}: {', '.join(parts)} changes the predictions by {100 * effect:.2g} % of their "
        f"spread ({cause})."
    )


def _pearson_jacobian(data: Observations, misfit: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
    """The Jacobian (M, n) of Pearson's residuals of counts, whose square is Fisher's information.

    The root r of the deviance has the derivative (1 - n / l) / r with respect to the rate l of a count n; the
    derivative of Pearson's residual, with its variance held constant, is l^-1/2.
    """
    counts = np.ravel(np.asarray(data.values, np.float64))
    rates = np.ravel(data.predicted(misfit.reshape(data.values.shape), np.ones(())))
    rates = np.maximum(rates, np.finfo(np.float64).tiny)
    is_far = np.abs(misfit) > 1e-6
    slopes = np.where(is_far, (1 - counts / rates) / np.where(is_far, misfit, 1), 1 / np.sqrt(rates))
    scale = 1 / (np.sqrt(rates) * np.where(slopes > 0, slopes, np.inf))
    return jacobian * np.where(np.ravel(np.asarray(data.mask)), scale, 0)[:, None]


def _sandwich(data: Observations, misfit: np.ndarray, jacobian: np.ndarray, free: float) -> np.ndarray:
    """The covariance of the unknowns of a robust loss.

    Let g and h be the first and second derivatives of the loss at each residual, q the signed root of the loss and J
    the Jacobian of q, so that the residual has the Jacobian J / q'. Then B = sum g^2 / q'^2 J^T J = sum q^2 J^T J and
    A = sum h / q'^2 J^T J. Penalties enter both as data do. If A is not positive definite, J^T J takes its place.
    """
    slope, curvature = data.loss.influence(misfit)
    root = np.asarray(data.loss.root(jnp.asarray(misfit)))
    # The slope of the root, q' = g / q, is 1 at zero.
    root_slope = np.where(np.abs(root) > 1e-6, slope / np.where(root == 0, 1, root), 1.0)
    weights = np.where(np.abs(root_slope) > 1e-12, curvature / np.where(root_slope == 0, 1, root_slope) ** 2, 0.0)
    count = len(misfit)
    own, penalties = jacobian[:count], jacobian[count:]
    from_penalties = penalties.T @ penalties
    outer = (own * weights[:, None]).T @ own + from_penalties
    if np.linalg.eigvalsh(outer)[0] <= 0:
        outer = own.T @ own + from_penalties
    middle = (own * root[:, None] ** 2).T @ own * (data.num_values / max(free, 1.0)) + from_penalties
    inverse = np.linalg.pinv(outer)
    return inverse @ middle @ inverse


def _variances(data: Observations, residuals: np.ndarray, leverages: np.ndarray, overall: float) -> np.ndarray:
    """(M,) variance of the residuals of each value's species, or the overall one if a species has too few values."""
    shape, mask = data.values.shape, np.asarray(data.mask)
    variances = np.full(shape, overall)
    for column in data.columns:
        free = np.sum(mask[column]) - np.sum(leverages.reshape(shape)[column])
        if free > 1:
            variances[column] = np.sum(residuals.reshape(shape)[column] ** 2) / free
    return variances.ravel()


def _level(data: Observations, spread: np.ndarray | np.floating) -> float:
    """The size of the data's variation, in the unit of the misfit."""
    values = np.asarray(data.values, np.float64)
    noise = np.broadcast_to(1.0 if data.noise is None else np.asarray(data.noise, np.float64), values.shape)
    units = np.broadcast_to(spread, values.shape) * noise
    if data.is_count:
        units = np.sqrt(np.maximum(values, 1))
    measured = (values / units)[np.asarray(data.mask)]
    return float(np.std(measured) * np.sqrt(measured.size)) or float(np.linalg.norm(measured)) or 1.0


def _flat(tree: Any) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(leaf, np.float64)) for leaf in jax.tree.leaves(tree)])
