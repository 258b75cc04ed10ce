"""What data tell about parameters: covariance, intervals, and in words what they cannot tell."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .observations import Observations
from .unknowns import Unknowns

# Adaptive steps are chosen anew for other parameters: what doubling the parameters changes by less than this share of
# the predictions' spread may be their errors, and nothing that was seen. (Of a diffusivity that enters by the length of
# the first step alone it is up to 0.64 %.)
_UNSEEN = 1e-2
# One standard deviation, relative, from which on a direction counts as not determined.
_VAGUE = 0.5
# Residuals that are so many times the noise are not noise.
_UNEXPLAINED = 2.0
# Values that must be left beside those the parameters take for the noise to be estimated.
_LEFT = 0.5


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
        noise: the standard deviation of the data's residuals, 1 if model and noise level are right, or where the noise
            was not given in the data's own unit; NaN where no value is left to tell it.
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
    space: Unknowns, z: Array, data: Observations, residuals: Array, jacobian: Array, confidence: float, adaptive: bool
) -> Evidence:
    """The evidence at a minimum.

    The variance of the data's residuals is their sum of squares over the degrees of freedom that parameters leave, M -
    tr(J (J^T J + P^T P)^-1 J^T) for M values of Jacobian J and penalties of Jacobian P: what a penalty holds of a
    parameter takes none (Hastie, Tibshirani, Friedman 2009, The Elements of Statistical Learning, eq. 7.32).

    Args:
        space: the unknowns.
        z: (n,) their vector.
        data: what was fitted.
        residuals: (M + P,) misfit and penalties.
        jacobian: (M + P, n) of them, with respect to z.
        confidence: of the intervals.
        adaptive: whether the model takes adaptive steps, whose errors hide what shows less.
    """
    from scipy import stats

    r, j = np.asarray(residuals, np.float64), np.asarray(jacobian, np.float64)
    size, num_values = j.shape[1], data.values.size
    u, s, vt = np.linalg.svd(j, full_matrices=False)
    safe = np.maximum(s, np.finfo(np.float64).eps * (s[0] or 1.0))
    free = num_values - float(np.sum((j[:num_values] @ (vt.T / safe)) ** 2))
    spread = float(np.sqrt(np.sum(r[:num_values] ** 2) / free)) if free > _LEFT else float("nan")
    sigma = 1.0 if data.noise is not None else spread
    in_z = (vt.T / safe**2) @ vt * sigma**2
    params = space.params(z)
    slopes = np.asarray(space.slopes(z), np.float64)
    std_z = np.sqrt(np.diag(in_z))
    quantile = stats.norm.ppf if data.noise is not None else lambda p: stats.t.ppf(p, max(free, _LEFT))
    reach = float(quantile(0.5 + confidence / 2)) * std_z
    ends = tuple(space.params(z + jnp.asarray(side * reach, z.dtype)) for side in (-1, 1))
    values = _flat(params)
    # Where a step of Gauss and Newton in the parameters themselves leads: in a minimum nowhere, at a bound beyond it.
    at_end = space.at_end(params, values - slopes * ((vt.T / safe) @ (u.T @ r)))
    # Relative changes; of parameters near zero changes by the scale of the start.
    leaves = jax.tree.leaves(params)
    scales = _flat([np.full(np.shape(leaf), scale) for scale, leaf in zip(space.scales, leaves, strict=True)])
    sizes = np.maximum(np.abs(values), 1e-3 * scales)
    relative = j[:num_values] * (sizes / np.where(slopes == 0, 1.0, slopes))
    _, singular, directions = np.linalg.svd(relative, full_matrices=num_values < size)
    singular = np.concatenate([singular, np.zeros(size - len(singular))])
    level = float(np.std(np.asarray(data.values / (1.0 if data.noise is None else data.noise)))) * np.sqrt(num_values)
    level = level or float(np.linalg.norm(np.asarray(data.values))) or 1.0
    rounding = float(np.sqrt(jnp.finfo(jacobian.dtype).eps))
    said = [
        f"{name} has run to the end of its range, {value:.4g}: the data would have it there or beyond, and its "
        "interval means nothing."
        for name, value, ended in zip(space.names, values, at_end, strict=True)
        if ended
    ]
    for value, direction in zip(singular, directions, strict=True):
        if np.abs(direction[at_end]).max(initial=0.0) > _VAGUE:
            continue
        is_vague, share = sigma > _VAGUE * value, value / level
        if share < rounding or (is_vague and adaptive and share < _UNSEEN):
            said.append(_sentence(space.names, direction, share, "tell", "not seen at all"))
        elif is_vague:
            said.append(_sentence(space.names, direction, share, "tell", f"known to {100 * sigma / value:.0f} % only"))
        elif adaptive and share < _UNSEEN:
            less = "less than the errors that adaptive steps may have: tighten rtol and atol, or give dt="
            said.append(_sentence(space.names, direction, share, "safely tell", less))
    return Evidence(
        space.names, values, slopes[:, None] * in_z * slopes, slopes * std_z, (ends[0], ends[1]), confidence, singular,
        directions, spread, tuple(said),
    )  # fmt: skip


def _flat(tree: Any) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(leaf, np.float64)) for leaf in jax.tree.leaves(tree)])


def _sentence(names: tuple[str, ...], direction: np.ndarray, share: float, verb: str, told: str) -> str:
    """What a direction (n,) of relative changes does to the predictions, a share of their spread when of length one."""
    largest = np.abs(direction).max()
    # The sign is chosen so that the first of the largest changes is an increase. If only the largest one counted,
    # rounding would decide between equal changes.
    first = np.flatnonzero(np.abs(direction) > 0.9 * largest)[0]
    change = direction / largest * np.sign(direction[first])
    parts = [f"{name} {10 * c:+.2g} %" for name, c in zip(names, change, strict=True) if abs(c) > 0.05]
    effect = 0.1 * share * np.linalg.norm(change)
    what = f"{parts[0].rsplit(' ', 2)[0]} alone" if len(parts) == 1 else "these apart"
    return (
        f"The data do not {verb} {what}: {', '.join(parts)} changes the predictions by {100 * effect:.2g} % of their "
        f"spread ({told})."
    )


def summary(fit: Any, data: Observations) -> str:
    """The table of a fit, and in words how well it is known."""
    lines = [
        f"{fit.method}: {fit.num_steps} steps, {fit.num_runs} runs of the model, loss {fit.loss:.4g}; stopped because "
        f"{fit.reason}."
    ]
    known = fit.evidence
    if known is None:
        leaves = jax.tree_util.tree_flatten_with_path(fit.params)[0]
        lines += [
            f"  {jax.tree_util.keystr(path) or 'parameter'}: {np.size(leaf)} values from {np.min(leaf):.4g} to "
            f"{np.max(leaf):.4g}"
            for path, leaf in leaves
        ]
        return "\n".join(lines)
    lows, highs = (_flat(end) for end in known.intervals)
    width = max(9, *(len(name) for name in known.names))
    lines.append(f"  {'parameter':{width}} {'value':>12} {'std':>10}   {100 * known.confidence:.0f} % interval")
    lines += [
        f"  {name:{width}} {value:12.6g} {std:10.2g}   {low:.6g} to {high:.6g}"
        for name, value, std, low, high in zip(known.names, known.values, known.std, lows, highs, strict=True)
    ]
    if np.isfinite(known.noise):
        unit = "estimated noise" if data.noise is None else "residuals over noise (1 if model and noise are right)"
        lines.append(f"{unit}: {known.noise:.3g}")
    lines.append("singular values: " + ", ".join(f"{value:.3g}" for value in known.singular_values))
    if data.noise is not None and known.noise > _UNEXPLAINED:
        return "\n".join([
            *lines,
            f"The model does not explain the data: what remains is {known.noise:.2g} times the noise, and the "
            "intervals mean nothing. Begin elsewhere (ltl.explore, ltl.fit_many), or doubt the model or the noise.",
            *known.cannot_tell,
        ])  # fmt: skip
    if data.noise is None and not np.isfinite(known.noise):
        lines.append(
            f"There are no error bars: {data.values.size} values for {len(known.values)} unknowns leave none to tell "
            "the noise from. Give Observations(..., noise=...), or observe more."
        )
        return "\n".join([*lines, *known.cannot_tell])
    return "\n".join([*lines, *(known.cannot_tell or ["The data determine every parameter."])])
