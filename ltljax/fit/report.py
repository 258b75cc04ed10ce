"""What data tell about parameters: covariance, intervals, and in words what they cannot tell."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .observations import Observations
from .unknowns import Unknowns

# A direction along which doubling the parameters changes the predictions by less than this share of their spread is not
# told from zero: time stepping itself errs by as much.
_UNSEEN = 5e-3
# One standard deviation, relative, from which on a direction counts as not determined.
_VAGUE = 0.5
# Residuals that are so many times the noise are not noise.
_UNEXPLAINED = 2.0


@dataclasses.dataclass(frozen=True)
class Evidence:
    """What a fit's Jacobian says.

    Attributes:
        names: of the parameters, flattened.
        values: (n,) of the parameters.
        covariance: (n, n): (J^T J)^-1, times the variance of the residuals where the noise is not known.
        std: (n,) standard deviations.
        intervals: the lower and upper ends of the confidence intervals, each as the parameters; they are symmetric in
            the free unknowns, so that a positive parameter's stays positive.
        confidence: of the intervals.
        singular_values: (n,) of the data's Jacobian with respect to relative changes; descending.
        directions: (n, n) in rows, the relative changes that belong to them.
        noise: the standard deviation of the residuals, 1 if model and noise level are right, or where the noise was not
            given in the data's own unit.
        cannot_tell: a sentence for each direction that the data do not determine.
    """

    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    std: np.ndarray
    intervals: tuple[Any, Any]
    confidence: float
    singular_values: np.ndarray
    directions: np.ndarray
    noise: float
    cannot_tell: tuple[str, ...]


def evidence(
    space: Unknowns, z: Array, data: Observations, residuals: Array, jacobian: Array, confidence: float
) -> Evidence:
    """The evidence at a minimum.

    Args:
        space: the unknowns.
        z: (n,) their vector.
        data: what was fitted.
        residuals: (M,) misfit and penalties.
        jacobian: (M, n) of them, with respect to z.
        confidence: of the intervals.
    """
    from scipy import stats

    r, j = np.asarray(residuals, np.float64), np.asarray(jacobian, np.float64)
    count, size = j.shape
    num_values = data.values.size
    free = count - size
    spread = float(np.sqrt(r @ r / free)) if free > 0 else float("nan")
    sigma = 1.0 if data.noise is not None else spread
    u, s, vt = np.linalg.svd(j, full_matrices=False)
    del u
    safe = np.maximum(s, np.finfo(np.float64).eps * max(s[0], 1e-300))
    in_z = (vt.T / safe**2) @ vt * sigma**2
    slopes = np.asarray(space.slopes(z), np.float64)
    std_z = np.sqrt(np.diag(in_z))
    quantile = stats.norm.ppf if data.noise is not None or free <= 0 else lambda p: stats.t.ppf(p, free)
    reach = float(quantile(0.5 + confidence / 2)) * std_z
    ends = tuple(space.params(z + jnp.asarray(side * reach, z.dtype)) for side in (-1, 1))
    values = _flat(space.params(z))
    # Relative changes; of parameters near zero changes by the scale of the start.
    leaves = jax.tree.leaves(space.params(z))
    scales = _flat([np.full(np.shape(leaf), scale) for scale, leaf in zip(space.scales, leaves, strict=True)])
    sizes = np.maximum(np.abs(values), 1e-3 * scales)
    relative = j[:num_values] * (sizes / slopes)
    _, singular, directions = np.linalg.svd(relative, full_matrices=False)
    if num_values < size:
        directions = np.linalg.svd(relative)[2]
        singular = np.concatenate([singular, np.zeros(size - num_values)])
    level = float(np.std(np.asarray(data.values / (1.0 if data.noise is None else data.noise)))) * np.sqrt(num_values)
    level = level or float(np.linalg.norm(np.asarray(data.values))) or 1.0
    vague = [
        _sentence(space.names, direction, value, sigma, level)
        for value, direction in zip(singular, directions, strict=True)
        if value < _UNSEEN * level or sigma > _VAGUE * value
    ]
    return Evidence(
        space.names, values, slopes[:, None] * in_z * slopes, slopes * std_z, (ends[0], ends[1]), confidence, singular,
        directions, spread, tuple(vague),
    )  # fmt: skip


def _flat(tree: Any) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(leaf, np.float64)) for leaf in jax.tree.leaves(tree)])


def _sentence(names: tuple[str, ...], direction: np.ndarray, value: float, sigma: float, level: float) -> str:
    change = direction / np.abs(direction).max() * np.sign(direction[np.abs(direction).argmax()])
    parts = [f"{name} {10 * c:+.2g} %" for name, c in zip(names, change, strict=True) if abs(c) > 0.05]
    effect = 0.1 * value / np.linalg.norm(direction / np.abs(direction).max()) ** -1 / level
    what = f"{parts[0].rsplit(' ', 2)[0]} alone" if len(parts) == 1 else "these apart"
    told = f"known to {100 * sigma / value:.0f} % only" if value > _UNSEEN * level else "not seen at all"
    return (
        f"The data do not tell {what}: {', '.join(parts)} changes the predictions by {100 * effect:.2g} % of their "
        f"spread ({told})."
    )


def summary(fit: Any, data: Observations) -> str:
    """The table of a fit, and in words how well it is known."""
    lines = [f"{fit.method}: {fit.num_steps} steps, loss {fit.loss:.4g}; stopped because {fit.reason}."]
    known = fit.evidence
    if known is None:
        leaves = jax.tree_util.tree_flatten_with_path(fit.params)[0]
        lines += [
            f"  {jax.tree_util.keystr(path)}: {np.size(leaf)} values from {np.min(leaf):.4g} to {np.max(leaf):.4g}"
            for path, leaf in leaves
        ]
    else:
        lows, highs = (_flat(end) for end in known.intervals)
        width = max(9, *(len(name) for name in known.names))
        lines.append(f"  {'parameter':{width}} {'value':>12} {'std':>10}   {100 * known.confidence:.0f} % interval")
        lines += [
            f"  {name:{width}} {value:12.6g} {std:10.2g}   {low:.6g} to {high:.6g}"
            for name, value, std, low, high in zip(known.names, known.values, known.std, lows, highs, strict=True)
        ]
        unit = "estimated noise" if data.noise is None else "residuals over noise (1 if model and noise are right)"
        lines.append(f"{unit}: {known.noise:.3g}")
        lines.append("singular values: " + ", ".join(f"{value:.3g}" for value in known.singular_values))
        if data.noise is not None and known.noise > _UNEXPLAINED:
            lines.append(
                f"The model does not explain the data: what remains is {known.noise:.2g} times the noise, and the "
                "intervals mean nothing. Begin elsewhere (ltl.explore, ltl.fit_many), or doubt the model or the noise."
            )
        else:
            lines += known.cannot_tell or ["The data determine every parameter."]
    return "\n".join(lines)
