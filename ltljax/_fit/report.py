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
# Outliers that a report names.
_NAMED = 5
# Values that must be left beside those the parameters take for the noise to be estimated.
_LEFT = 0.5


@dataclasses.dataclass(frozen=True)
class Evidence:
    """What a fit's Jacobian says.

    Attributes:
        names: names of the parameters, flattened, and of what was unknown about the data.
        values: (n,) their values.
        covariance: (n, n): (J^T J)^-1; where the noise is not known (J^T J)^-1 J^T D J (J^T J)^-1 with the variance D
            of the residuals, taken from those of each species; of a robust loss the sandwich A^-1 B A^-1, with A the
            second derivative of the loss along J and B the sum of its squared slopes (Huber 1967; White 1980).
        std: (n,) standard deviations.
        intervals: the lower and upper ends of the confidence intervals, each as the parameters; they are symmetric in
            the free unknowns, so that a positive parameter's stays positive.
        ends: (2, n) the same ends, flattened as ``values``.
        at_end: (n,) which values have run to an end of their range.
        confidence: confidence of the intervals.
        singular_values: (n,) of the data's Jacobian with respect to relative changes; descending.
        directions: (n, n) in rows, the relative changes that belong to them.
        noise: the standard deviation of the data's residuals, 1 if model and noise level are right, or where the noise
            was not given in the data's own unit; NaN where no value is left to tell it. With a robust loss it is taken
            from the median, and is the root mean square over the species.
        degrees_of_freedom: number of values less those that the parameters take.
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

    The variance of the data's residuals is their sum of squares over the degrees of freedom that parameters leave, M -
    tr(J (J^T J + P^T P)^-1 J^T) for M values of Jacobian J and penalties of Jacobian P: what a penalty holds of a
    parameter takes none (Hastie, Tibshirani, Friedman 2009, The Elements of Statistical Learning, eq. 7.32).

    Args:
        space: the unknowns.
        z: (n,) their vector.
        data: what was fitted.
        residuals: (M + P,) roots of the losses of the misfit, which are the misfit in least squares, and penalties.
        misfit: (M,) misfit.
        jacobian: (M + P, n) derivative of the residuals with respect to z.
        spread: standard deviation that the misfit is divided by where it is taken from the data.
        confidence: confidence of the intervals.
        adaptive: whether the model takes adaptive steps, whose errors hide what shows less.
    """
    from scipy import stats

    r, j = np.asarray(residuals, np.float64), np.asarray(jacobian, np.float64)
    size, num_values = j.shape[1], data.values.size
    if data.is_count and not data.loss.is_robust:
        j = np.concatenate([_of_pearson(data, np.asarray(misfit, np.float64), j[:num_values]), j[num_values:]])
    is_known = data.knows_noise or data.estimates_spread
    u, s, vt = np.linalg.svd(j, full_matrices=False)
    safe = np.maximum(s, np.finfo(np.float64).eps * (s[0] or 1.0))
    # What each value takes of the degrees of freedom.
    taken = np.sum((j[:num_values] @ (vt.T / safe)) ** 2, axis=1)
    free = data.num_values - float(np.sum(taken))
    noise = float(np.sqrt(np.sum(r[:num_values] ** 2) / free)) if free > _LEFT else float("nan")
    sigma = 1.0 if is_known else noise
    if data.loss.is_robust:
        in_z = _sandwich(data, np.asarray(misfit, np.float64), j, free)
        noise = float(np.sqrt(np.mean(spread**2)))
        if data.knows_noise:
            noise = float(data.median_spread(np.reshape(np.asarray(misfit), data.values.shape), size).mean())
    else:
        in_z = (vt.T / safe**2) @ vt * sigma**2
    deviations = np.full(num_values, sigma)
    if not is_known and data.has_species and np.isfinite(sigma):
        inverse = vt.T / safe**2 @ vt
        variances = _variances(data, r[:num_values], taken, sigma**2)
        weights = np.concatenate([variances, np.full(len(r) - num_values, sigma**2)])
        in_z = inverse @ ((j * weights[:, None]).T @ j) @ inverse
        deviations = np.sqrt(np.maximum(variances, np.finfo(np.float64).tiny))
    values_there = space.values(z)
    slopes = np.asarray(space.slopes(z), np.float64)
    std_z = np.sqrt(np.diag(in_z))
    quantile = stats.norm.ppf if data.knows_noise else lambda p: stats.t.ppf(p, max(free, _LEFT))
    reach = float(quantile(0.5 + confidence / 2)) * std_z
    ends = [space.values(z + jnp.asarray(side * reach, z.dtype)) for side in (-1, 1)]
    values = _flat(values_there)
    # Where a step of Gauss and Newton in the parameters themselves would lead. In a minimum it changes nothing; at the
    # end of a range it leads beyond.
    at_end = space.at_end(values_there, values - slopes * ((vt.T / safe) @ (u.T @ r)))
    # Relative changes; of parameters near zero changes by the scale of the start.
    leaves = jax.tree.leaves(values_there)
    scales = _flat([np.full(np.shape(leaf), scale) for scale, leaf in zip(space.scales, leaves, strict=True)])
    sizes = np.maximum(np.abs(values), 1e-3 * scales)
    relative = j[:num_values] * (sizes / np.where(slopes == 0, 1.0, slopes))
    _, singular, directions = np.linalg.svd(relative, full_matrices=num_values < size)
    singular = np.concatenate([singular, np.zeros(size - len(singular))])
    beyond = [
        f"{name} has run to the end of its range, {value:.4g}. The best value lies there or beyond, and the interval "
        "means nothing."
        for name, value, ended in zip(space.names, values, at_end, strict=True)
        if ended
    ]
    # In units of the noise of each value.
    units = np.where(np.isfinite(deviations) & (deviations > 0), deviations, 1.0)
    level = _level(data, spread * units.reshape(data.values.shape))
    rounding = float(np.sqrt(jnp.finfo(jacobian.dtype).eps))
    vague = _vague(
        space.names, relative / units[:, None], at_end, level, rounding, adaptive, is_known=bool(np.isfinite(sigma))
    )
    return Evidence(
        space.names, values, slopes[:, None] * in_z * slopes, slopes * std_z, (ends[0][0], ends[1][0]),
        np.array([_flat(end) for end in ends]), at_end, confidence, singular, directions, noise, free,
        (*beyond, *vague),
    )  # fmt: skip


def _vague(
    names: tuple[str, ...], jacobian: np.ndarray, at_end: np.ndarray, level: float, rounding: float, adaptive: bool,
    is_known: bool,
) -> list[str]:  # fmt: skip
    """A sentence for each direction of the parameters that the data do not determine.

    Args:
        names: names of the parameters.
        jacobian: (M, n) derivative of the predictions with respect to relative changes, in units of the noise.
        at_end: (n,) which parameters are at the end of their range, about which nothing is said.
        level: size of the data's variation, in units of the noise.
        rounding: share of it below which a change is rounding.
        adaptive: whether the model takes adaptive steps, whose errors hide small changes.
        is_known: whether the noise is known or estimated.
    """
    size = len(names)
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=len(jacobian) < size)
    sentences = []
    for value, direction in zip(np.concatenate([singular, np.zeros(size - len(singular))]), directions, strict=True):
        if np.abs(direction[at_end]).max(initial=0.0) > _VAGUE:
            continue
        is_vague, share = is_known and _VAGUE * value < 1, value / level
        if share < rounding or (is_vague and adaptive and share < _UNSEEN):
            sentences.append(_sentence(names, direction, share, "tell", "not seen at all"))
        elif is_vague:
            sentences.append(_sentence(names, direction, share, "tell", f"known to {100 / value:.0f} % only"))
        elif adaptive and share < _UNSEEN:
            less = "less than the errors that adaptive steps may have: tighten rtol and atol, or give dt="
            sentences.append(_sentence(names, direction, share, "safely tell", less))
    return sentences


def _of_pearson(data: Observations, misfit: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
    """The Jacobian (M, n) of Pearson's residuals of counts, whose square is Fisher's information.

    The root r of the deviance has the derivative (1 - n / l) / r with respect to the rate l of a count n; that of
    Pearson's residual, with the variance held, is l^-1/2.
    """
    counts = np.ravel(np.asarray(data.values, np.float64))
    rates = np.ravel(data.predicted(misfit.reshape(data.values.shape), np.ones(())))
    rates = np.maximum(rates, np.finfo(np.float64).tiny)
    far = np.abs(misfit) > 1e-6
    slopes = np.where(far, (1 - counts / rates) / np.where(far, misfit, 1), 1 / np.sqrt(rates))
    scale = 1 / (np.sqrt(rates) * np.where(slopes > 0, slopes, np.inf))
    return jacobian * np.where(np.ravel(np.asarray(data.mask)), scale, 0)[:, None]


def _sandwich(data: Observations, misfit: np.ndarray, jacobian: np.ndarray, free: float) -> np.ndarray:
    """The covariance of unknowns found with a robust loss.

    With the slopes g and second derivatives h of the loss at each residual, whose own Jacobian is J / q' for roots q
    with the Jacobian J, B = sum g^2 / q'^2 J^T J = sum q^2 J^T J and A = sum h / q'^2 J^T J. Penalties enter both as
    data do. Where A is not positive definite J^T J takes its place.
    """
    slope, bend = data.loss.influence(misfit)
    root = np.asarray(data.loss.root(jnp.asarray(misfit)))
    # The slope of the root: g / q, and 1 at zero.
    inner = np.where(np.abs(root) > 1e-6, slope / np.where(root == 0, 1, root), 1.0)
    weights = np.where(np.abs(inner) > 1e-12, bend / np.where(inner == 0, 1, inner) ** 2, 0.0)
    count = len(misfit)
    held = jacobian[count:].T @ jacobian[count:]
    own = jacobian[:count]
    outer = (own * weights[:, None]).T @ own + held
    if np.linalg.eigvalsh(outer)[0] <= 0:
        outer = own.T @ own + held
    middle = (own * root[:, None] ** 2).T @ own * (data.num_values / max(free, 1.0)) + held
    inverse = np.linalg.pinv(outer)
    return inverse @ middle @ inverse


def _variances(data: Observations, residuals: np.ndarray, taken: np.ndarray, all_of_them: float) -> np.ndarray:
    """(M,) variance of the residuals of each value's species; of all together where that species leaves too few."""
    shape, mask = data.values.shape, np.asarray(data.mask)
    variances = np.full(shape, all_of_them)
    for column in data.columns:
        free = np.sum(mask[column]) - np.sum(taken.reshape(shape)[column])
        if free > 1:
            variances[column] = np.sum(residuals.reshape(shape)[column] ** 2) / free
    return variances.ravel()


def _level(data: Observations, spread: np.ndarray) -> float:
    """The size of the data's variation, in the unit of the misfit."""
    values = np.asarray(data.values, np.float64)
    noise = np.broadcast_to(1.0 if data.noise is None else np.asarray(data.noise, np.float64), values.shape)
    units = np.broadcast_to(spread, values.shape) * noise
    if data.is_count:
        units = np.sqrt(np.maximum(values, 1))
    seen = (values / units)[np.asarray(data.mask)]
    return float(np.std(seen) * np.sqrt(seen.size)) or float(np.linalg.norm(seen)) or 1.0


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


def summary(fit: Any, data: Observations, vertex_numbers: np.ndarray | None = None) -> str:
    """The table of a fit, and in words whether the model explains the data and how well its parameters are known."""
    lines = [fit.agreement.sentence()]
    if fit.scanned:
        lines.append(fit.scanned)
    lines.append(
        f"{fit.method}: {fit.num_steps} steps, {fit.num_runs} runs of the model, loss {fit.loss:.4g}. "
        f"Status: {fit.status}; the search ended because {fit.reason}."
    )
    known = fit.evidence
    if known is None:
        leaves = jax.tree_util.tree_flatten_with_path(fit.params)[0]
        lines += [
            f"  {jax.tree_util.keystr(path) or 'parameter'}: {np.size(leaf)} values from {np.min(leaf):.4g} to "
            f"{np.max(leaf):.4g}"
            for path, leaf in leaves
        ]
        return "\n".join([*lines, *_outliers(fit, data, vertex_numbers)])
    width = max(9, *(len(name) for name in known.names))
    lines.append(f"  {'parameter':{width}} {'value':>12} {'std':>10}   {100 * known.confidence:.0f} % interval")
    lines += [
        f"  {name:{width}} {value:12.6g} {std:10.2g}   {low:.6g} to {high:.6g}"
        for name, value, std, low, high in zip(known.names, known.values, known.std, *known.ends, strict=True)
    ]
    if np.isfinite(known.noise):
        unit = "residuals over noise (1 if model and noise are right)" if data.knows_noise else "estimated noise"
        lines.append(f"{unit}: {known.noise:.3g}")
    lines.append("singular values: " + ", ".join(f"{value:.3g}" for value in known.singular_values))
    lines += _outliers(fit, data, vertex_numbers)
    lines += _advice(fit, data)
    if not data.knows_noise and not np.isfinite(known.noise):
        lines.append(
            f"There are no error bars: {data.num_values} values for {len(known.values)} unknowns leave none to tell "
            "the noise from. Give Observations(..., noise=...), or observe more."
        )
    elif not known.cannot_tell and fit.status == "converged":
        lines.append("The data determine every parameter.")
    return "\n".join([*lines, *known.cannot_tell])


def _advice(fit: Any, data: Observations) -> list[str]:
    """What to do where the model does not explain the data."""
    agreement = fit.agreement
    if not (agreement.is_useless or agreement.is_unexplained or agreement.is_structured):
        return []
    trouble = "The intervals mean nothing."
    if not (agreement.is_useless or agreement.is_unexplained):
        trouble = "The intervals are too narrow: they take residuals for independent noise."
    if len(agreement.outliers) and not agreement.has_many_outliers and not data.loss.is_robust:
        return [f'{trouble} Begin with the outliers: Observations(..., loss="huber").']
    return [
        f"{trouble} Doubt the model or the noise, begin elsewhere (ltl.inverse.explore, ltl.inverse.fit_many), or give what is unknown "
        "about the data, such as Observations(scale=Positive(1.0), offset=Real(0.0))."
    ]


def _outliers(fit: Any, data: Observations, vertex_numbers: np.ndarray | None) -> list[str]:
    """How many values are outliers, where the farthest are, and what they do."""
    outliers = fit.agreement.outliers
    if not len(outliers) or fit.agreement.has_many_outliers:
        return []
    named = "; ".join(_place(data, index, vertex_numbers) for index in outliers[:_NAMED])
    more = f"; and {len(outliers) - _NAMED} more (fit.agreement.outliers)" if len(outliers) > _NAMED else ""
    what = "They count less than others." if data.loss.is_robust else 'They count in full: loss="huber" limits that.'
    are = (
        f"1 of {data.num_values} values is an outlier"
        if len(outliers) == 1
        else (f"{len(outliers)} of {data.num_values} values are outliers")
    )
    return [
        f"{are}, more than {fit.agreement.outlier_limit:.1f} standard deviations from the model: {named}{more}. {what}"
    ]


def _place(data: Observations, index: np.ndarray, vertex_numbers: np.ndarray | None) -> str:
    """Where and when a value was measured, and the value."""
    parts, axis = [], 0
    if data.times is not None:
        parts.append(f"t = {data.times[index[0]]:g}")
        axis = 1
    if len(index) > axis:
        kind = "vertex" if data.sampling is None else "place"
        place = index[axis] if data.vertices is None else data.vertices[index[axis]]
        if data.sampling is None and vertex_numbers is not None:
            place = vertex_numbers[place]
        parts.append(f"{kind} {place}")
    if data.has_species and data.values.shape[-1] > 1:
        column = index[-1] if data.species is None else data.species[index[-1]]
        parts.append(f"species {column}")
    return f"{', '.join(parts) or 'the value'} ({float(data.values[tuple(index)]):.4g})"
