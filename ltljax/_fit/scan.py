"""Where a fit begins if its first guess explains nothing: the best of a few points around it, over decades."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc

from .methods import MANY
from .observations import Experiment
from .problem import FitResiduals
from .unknowns import Bounded, Positive

# Factors are scanned over so many decades each way; points of the first pass and of the second, closer to the best.
_DECADES, _POINTS, _CLOSER = 3.0, 64, 32
# Points of the first pass at most that change one parameter alone.
_ALONE = 30
# Half the width of the second pass, in decades.
_NARROW = 0.5
# An adaptive run counts as failed in the scan if it takes more steps than the first number. If no point is better than
# the first guess then, the scan is repeated with the second number.
_MOST_STEPS = 250, 3000
# A guess may explain something if it is off by less than this share of the size of the data.
_SHARE = 0.5
# Values that must be there for a share of explained variance to mean something.
_FEW = 10


def explains_nothing(residuals: FitResiduals, misfit: np.ndarray) -> bool:
    """Whether the prediction of a first guess is off by more than half the size of the data, and farther from them than
    their mean is, whatever their unknown scale and offset; False for statistics, whose mean says nothing.

    Args:
        residuals: the residuals.
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
    measured = data.predicted(misfit, np.asarray(residuals.spread, np.float64))
    size = distance_to(data, np.zeros(values.shape))
    return bool(distance_to(data, measured) > max(distance_to(data, _means(data)), _SHARE * size) > 0)


def better_start(residuals: FitResiduals, z: np.ndarray) -> tuple[np.ndarray, int] | None:
    """A better vector of unknowns than a first guess, and the number of runs it took; None where none was found.

    Positive parameters are multiplied by factors from 1/1000 to 1000: one at a time, all together, and at the points
    of a Sobol sequence; other parameters likewise, but bounded ones fill their range. A second pass looks closer
    around the best. The points are compared by the mean distance of the prediction from the data, which outliers hardly
    change.
    """
    if not isinstance(residuals.model, Experiment) or residuals.model.dt is not None:
        return _scan(residuals, z)
    for most in _MOST_STEPS:
        model = dataclasses.replace(residuals.model, max_steps=min(residuals.model.max_steps, most))
        if (better := _scan(dataclasses.replace(residuals, model=model), z)) is not None:
            return better
    return None


def _scan(residuals: FitResiduals, z: np.ndarray) -> tuple[np.ndarray, int] | None:
    size = sum(leaf.size for leaf in jax.tree.leaves(residuals.space.params(jnp.asarray(z))))
    # Its arrays become arguments, so that none is a constant of the program.
    seen = eqx.filter_closure_convert(lambda z: residuals.data.of(residuals.predicted(z)), jnp.asarray(z))

    def distance(point: np.ndarray) -> float:
        measured = np.asarray(_called(seen, jnp.asarray(point, z.dtype)), np.float64)
        return distance_to(residuals.data, measured) if np.isfinite(measured).all() else np.inf

    chance = qmc.Sobol(size, rng=0)
    best, least = z, distance(z)
    first = least
    for decades in (_points(size, chance.random(_POINTS)), _NARROW * (2 * chance.random(_CLOSER) - 1)):
        center = best
        for row in decades:
            point = _moved(residuals, center, row)
            off = distance(point)
            if off < least:
                best, least = point, off
    return (best, _POINTS + _CLOSER) if least < first else None


@eqx.filter_jit
def _called(function, z):
    return function(z)


def _points(size: int, chance: np.ndarray) -> np.ndarray:
    """Decades (N, size) to go from the first guess: all parameters together, one at a time, and at random."""
    together = [np.full(size, x) for x in np.arange(-_DECADES, _DECADES + 0.25, 0.5) if x]
    alone = [x * row for row in np.eye(size) for x in (-1, 1, -2, 2, -3, 3)]
    alone = [alone[k] for k in np.unique(np.linspace(0, len(alone) - 1, _ALONE).astype(int))]
    return np.array([*together, *alone, *(_DECADES * (2 * chance - 1))])[: len(chance)]


def _moved(residuals: FitResiduals, z: np.ndarray, decades: np.ndarray) -> np.ndarray:
    """A vector of unknowns with the parameters so many decades away; what is unknown about the data stays."""
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


def distance_to(data: Any, measured: np.ndarray) -> float:
    """The mean distance of data from a prediction, after unknown scales and offsets are set to their best values, in
    units of each species' spread."""
    values, mask = np.asarray(data.values, np.float64), np.asarray(data.mask)
    guess = data.calibration.guess(measured, values, mask)
    if guess:
        measured = np.asarray(data.calibration(jnp.asarray(measured), {k: jnp.asarray(v) for k, v in guess.items()}))
    off = []
    for column in data.columns:
        seen = values[column][mask[column]]
        if seen.size:
            off.append(np.mean(np.abs(measured[column][mask[column]] - seen)) / (np.std(seen) or 1.0))
    return float(np.mean(off))


def _means(data: Any) -> np.ndarray:
    """The mean of each species, in the shape of the data."""
    values, mask = np.asarray(data.values, np.float64), np.asarray(data.mask)
    axes = tuple(range(values.ndim - 1)) if data.has_species else tuple(range(values.ndim))
    count = np.maximum(mask.sum(axis=axes, keepdims=True), 1)
    return np.broadcast_to(np.where(mask, values, 0).sum(axis=axes, keepdims=True) / count, values.shape)
