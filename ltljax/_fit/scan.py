"""A better start for a fit whose first guess explains nothing: the best of some points around it, over decades."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc

from .experiment import Experiment
from .methods import MANY
from .problem import FitResiduals
from .unknowns import Bounded, Positive

# Half the width of the first pass, in decades, and the numbers of points of the first and of the second pass, which
# looks closer to the best point of the first.
_DECADES, _POINTS, _CLOSER = 3.0, 64, 32
# Largest number of points of the first pass that change a single parameter.
_ALONE = 30
# Half the width of the second pass, in decades.
_NARROW = 0.5
# In the scan an adaptive run of more time steps than the first number counts as failed. If no point is better than the
# first guess, the scan is repeated with the second number.
_MAX_STEPS = 250, 3000
# A guess may explain something if its distance from the data is below this share of the size of the data.
_SHARE = 0.5
# Smallest number of values for which a share of explained variance is meaningful.
_FEW = 10


def explains_nothing(residuals: FitResiduals, misfit: np.ndarray) -> bool:
    """Whether the first guess explains nothing: its prediction is farther from the data than half their size, and
    farther than their mean, with the best unknown scale and offset.

    It is False for statistics, whose mean has no meaning.

    Args:
        residuals: residuals of the fit.
        misfit: (M,) misfit at the first guess.
    """
    data = residuals.data
    is_run = isinstance(residuals.model, Experiment) or data.times is not None
    if not is_run or len(residuals.space.names) > MANY or data.num_values < _FEW:
        return False
    values = np.asarray(data.values, np.float64)
    misfit = np.reshape(np.asarray(misfit, np.float64), values.shape)
    if not np.isfinite(misfit).all():
        return True
    predicted = data.predicted(misfit, np.asarray(residuals.spread, np.float64))
    size = distance_to(data, np.zeros(values.shape))
    return bool(distance_to(data, predicted) > max(distance_to(data, _means(data)), _SHARE * size) > 0)


def better_start(residuals: FitResiduals, z: np.ndarray) -> tuple[np.ndarray, int] | None:
    """A better vector of unknowns than a first guess, and the number of points tried; None if there was none.

    Parameters are multiplied by factors from 1/1000 to 1000: one at a time, all together, and at the points of a Sobol
    sequence. Bounded parameters move within their range instead. A second pass looks closer to the best point. Points
    are compared by the mean distance of the prediction from the data, which outliers hardly change.
    """
    if not isinstance(residuals.model, Experiment) or residuals.model.dt is not None:
        return _scan(residuals, z)
    for max_steps in _MAX_STEPS:
        model = dataclasses.replace(residuals.model, max_steps=min(residuals.model.max_steps, max_steps))
        if (better := _scan(dataclasses.replace(residuals, model=model), z)) is not None:
            return better
    return None


def _scan(residuals: FitResiduals, z: np.ndarray) -> tuple[np.ndarray, int] | None:
    size = sum(leaf.size for leaf in jax.tree.leaves(residuals.space.params(jnp.asarray(z))))
    # The arrays of the model become arguments, so that the program holds no large constants.
    predict = eqx.filter_closure_convert(lambda z: residuals.data.of(residuals.predicted(z)), jnp.asarray(z))

    def distance(point: np.ndarray) -> float:
        predicted = np.asarray(_called(predict, jnp.asarray(point, z.dtype)), np.float64)
        return distance_to(residuals.data, predicted) if np.isfinite(predicted).all() else np.inf

    sobol = qmc.Sobol(size, rng=0)
    best, least = z, distance(z)
    first = least
    for decades in (_points(size, sobol.random(_POINTS)), _NARROW * (2 * sobol.random(_CLOSER) - 1)):
        center = best
        for row in decades:
            point = _moved(residuals, center, row)
            if (new := distance(point)) < least:
                best, least = point, new
    return (best, _POINTS + _CLOSER) if least < first else None


@eqx.filter_jit
def _called(function, z):
    return function(z)


def _points(size: int, random: np.ndarray) -> np.ndarray:
    """Moves (N, size) from the first guess in decades: all parameters together, one at a time, and at random."""
    together = [np.full(size, x) for x in np.arange(-_DECADES, _DECADES + 0.25, 0.5) if x]
    alone = [x * row for row in np.eye(size) for x in (-1, 1, -2, 2, -3, 3)]
    alone = [alone[k] for k in np.unique(np.linspace(0, len(alone) - 1, _ALONE).astype(int))]
    return np.array([*together, *alone, *(_DECADES * (2 * random - 1))])[: len(random)]


def _moved(residuals: FitResiduals, z: np.ndarray, decades: np.ndarray) -> np.ndarray:
    """A vector of unknowns with its parameters moved by some decades; the unknowns of the measurement stay."""
    moved, begin = z.copy(), 0
    space = residuals.space
    leaves = jax.tree.leaves(space.params(jnp.asarray(z)))
    for leaf, transform in zip(leaves, space.transforms, strict=False):
        part = slice(begin, begin + leaf.size)
        if isinstance(transform, Positive):
            moved[part] = z[part] + np.log(10) * decades[part]
        elif isinstance(transform, Bounded):
            share = 1 / (1 + np.exp(-z[part])) + decades[part] / (2 * _DECADES)
            share = np.clip(share, 0.01, 0.99)
            moved[part] = np.where(decades[part] == 0, z[part], np.log(share / (1 - share)))
        else:
            moved[part] = z[part] * 10 ** decades[part]
        begin += leaf.size
    return moved


def distance_to(data: Any, predicted: np.ndarray) -> float:
    """The mean distance of a prediction from the data, with the best unknown scales and offsets, in units of the spread
    of each species."""
    values, mask = np.asarray(data.values, np.float64), np.asarray(data.mask)
    guess = data.calibration.guess(predicted, values, mask)
    if guess:
        predicted = np.asarray(data.calibration(jnp.asarray(predicted), {k: jnp.asarray(v) for k, v in guess.items()}))
    distances = []
    for column in data.columns:
        measured = values[column][mask[column]]
        if measured.size:
            difference = predicted[column][mask[column]] - measured
            distances.append(np.mean(np.abs(difference)) / (np.std(measured) or 1.0))
    return float(np.mean(distances))


def _means(data: Any) -> np.ndarray:
    """The mean of each species, in the shape of the data."""
    values, mask = np.asarray(data.values, np.float64), np.asarray(data.mask)
    axes = tuple(range(values.ndim - 1)) if data.has_species else tuple(range(values.ndim))
    count = np.maximum(mask.sum(axis=axes, keepdims=True), 1)
    return np.broadcast_to(np.where(mask, values, 0).sum(axis=axes, keepdims=True) / count, values.shape)
