"""The report of a fit in words: whether the model explains the data, and how well the parameters are known."""

from typing import Any

import jax
import numpy as np

from .observations import Observations

# Number of outliers that a report names.
_NAMED = 5


def summary(fit: Any, data: Observations, vertex_numbers: np.ndarray | None = None) -> str:
    """The report of a fit.

    Args:
        fit: the fit.
        data: its data.
        vertex_numbers: (V,) numbers to call the vertices by; by default those of the mesh.
    """
    lines = [fit.agreement.sentence()]
    if fit.scanned:
        lines.append(fit.scanned)
    lines.append(
        f"{fit.method}: {fit.num_iterations} iterations, {fit.num_runs} runs of the model, loss {fit.loss:.4g}. "
        f"Status: {fit.status}; the search ended because {fit.reason}."
    )
    evidence, outliers = fit.evidence, _outliers(fit, data, vertex_numbers)
    if evidence is None:
        return "\n".join([*lines, *_ranges(fit.params), *outliers])
    lines += _table(evidence)
    if np.isfinite(evidence.noise):
        unit = "residuals over noise (1 if model and noise are right)" if data.knows_noise else "estimated noise"
        lines.append(f"{unit}: {evidence.noise:.3g}")
    lines.append("singular values: " + ", ".join(f"{value:.3g}" for value in evidence.singular_values))
    lines += [*outliers, *_advice(fit, data)]
    if not data.knows_noise and not np.isfinite(evidence.noise):
        lines.append(
            f"There are no error bars: {data.num_values} values for {len(evidence.values)} unknowns leave no degrees "
            "of freedom to estimate the noise. Give Observations(..., noise=...), or observe more."
        )
    elif not evidence.cannot_tell and fit.status == "converged":
        lines.append("The data determine every parameter.")
    return "\n".join([*lines, *evidence.cannot_tell])


def _ranges(params: Any) -> list[str]:
    """The number and range of the values of each leaf of the parameters."""
    return [
        f"  {jax.tree_util.keystr(path) or 'parameter'}: {np.size(leaf)} values from {np.min(leaf):.4g} to "
        f"{np.max(leaf):.4g}"
        for path, leaf in jax.tree_util.tree_flatten_with_path(params)[0]
    ]


def _table(evidence: Any) -> list[str]:
    """A table of parameters, standard deviations and intervals."""
    width = max(9, *(len(name) for name in evidence.names))
    columns = zip(evidence.names, evidence.values, evidence.std, *evidence.ends, strict=True)
    rows = [
        f"  {name:{width}} {value:12.6g} {std:10.2g}   {low:.6g} to {high:.6g}"
        for name, value, std, low, high in columns
    ]
    head = f"  {'parameter':{width}} {'value':>12} {'std':>10}   {100 * evidence.confidence:.0f} % interval"
    return [head, *rows]


def _advice(fit: Any, data: Observations) -> list[str]:
    """Advice if the model does not explain the data."""
    agreement = fit.agreement
    if not (agreement.is_useless or agreement.is_unexplained or agreement.is_structured):
        return []
    problem = "The intervals have no meaning."
    if not (agreement.is_useless or agreement.is_unexplained):
        problem = "The intervals are too narrow, because they treat the residuals as independent noise."
    if len(agreement.outliers) and not agreement.has_many_outliers and not data.loss.is_robust:
        return [f'{problem} Begin with the outliers: Observations(..., loss="huber").']
    return [
        f"{problem} Check the model and the noise, try other starts (ltl.inverse.explore, ltl.inverse.fit_many), or "
        "add the unknowns of the measurement, such as Observations(scale=Positive(1.0), offset=Real(0.0))."
    ]


def _outliers(fit: Any, data: Observations, vertex_numbers: np.ndarray | None) -> list[str]:
    """The number of outliers, the places of the farthest, and their influence on the fit."""
    outliers = fit.agreement.outliers
    if not len(outliers) or fit.agreement.has_many_outliers:
        return []
    places = "; ".join(_place(data, index, vertex_numbers) for index in outliers[:_NAMED])
    more = f"; and {len(outliers) - _NAMED} more (fit.agreement.outliers)" if len(outliers) > _NAMED else ""
    influence = (
        "They count less than others." if data.loss.is_robust else 'They count in full: loss="huber" limits that.'
    )
    verb = "is an outlier" if len(outliers) == 1 else "are outliers"
    return [
        f"{len(outliers)} of {data.num_values} values {verb}, more than {fit.agreement.outlier_limit:.1f} standard "
        f"deviations from the model: {places}{more}. {influence}"
    ]


def _place(data: Observations, index: np.ndarray, vertex_numbers: np.ndarray | None) -> str:
    """The time, place and species of a value, and the value."""
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
