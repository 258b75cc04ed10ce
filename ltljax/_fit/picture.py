"""The picture of a fit: data, model and residuals, the loss, the intervals, and joint confidence regions."""

import textwrap
from typing import Any

import numpy as np

from .observations import Observations

# Largest number of pairs of parameters that are drawn.
_PAIRS = 3
# Largest number of points in the plot of data against model.
_POINTS = 4000
# The loss is compared with a parabola this many standard deviations from the minimum, and may differ by this share.
_REACH, _BENT = 2.0, 0.5
# Largest number of intervals that are drawn, and the largest drawn end, as a multiple of the value.
_INTERVALS, _WIDEST = 12, 3.0


def picture(fit: Any, data: Observations, surface: Any = None, observed: np.ndarray | None = None) -> Any:
    """A matplotlib figure of a `Fit`: data, model and residuals on the surface with outliers marked, the loss, data
    against model, the intervals, and the joint confidence regions of pairs of parameters.

    Args:
        fit: the fit.
        data: fitted data.
        surface: surface to draw on; None for none.
        observed: prediction in the shape of the data; by default that of the fit.
    """
    import matplotlib.pyplot as plt

    evidence = fit.evidence
    pairs = [] if evidence is None else _strongest(evidence.covariance)
    axis = 0 if data.times is None else 1
    has_places = surface is not None and data.values.ndim > axis and data.values.shape[axis] > 1
    bent = [] if evidence is None else _not_quadratic(fit)
    count = 2 + (evidence is not None) + len(pairs) + len(bent)
    figure = plt.figure(figsize=(3.6 * max(count, 2), 7.2 if has_places else 3.6), layout="constrained")
    figure.suptitle(textwrap.fill(fit.agreement.sentence(), 36 * max(count, 2)), fontsize="medium")
    grid = figure.add_gridspec(2 if has_places else 1, count)
    axes = figure.add_subplot(grid[0, 0])
    axes.semilogy(np.maximum(fit.losses, 1e-300), marker=".")
    axes.set(xlabel="iteration", ylabel="loss", title="loss")
    if data.has_moving_spread:
        axes.set(title="loss, in units of the estimated noise")
    predicted = np.asarray(data.of(fit.prediction, fit.calibration) if observed is None else observed)
    _against(figure.add_subplot(grid[0, 1]), fit, data, predicted)
    if evidence is not None:
        _intervals(figure.add_subplot(grid[0, 2]), evidence)
    for k, pair in enumerate(pairs):
        _ellipse(figure.add_subplot(grid[0, 3 + k]), evidence, pair)
    for k, name in enumerate(bent):
        _profile(figure.add_subplot(grid[0, 3 + len(pairs) + k]), fit, name)
    if has_places:
        _on_surface(figure.add_subplot(grid[1, :]), fit, data, predicted, surface)
    return figure


def _against(axes: Any, fit: Any, data: Observations, predicted: np.ndarray) -> None:
    """The predicted values against the observed ones."""
    mask = np.asarray(data.mask)
    observed, model = np.asarray(data.values)[mask], predicted[mask]
    drawn = np.linspace(0, observed.size - 1, min(observed.size, _POINTS)).astype(int)
    ends = [min(observed.min(), model.min()), max(observed.max(), model.max())]
    axes.plot(ends, ends, color="gray", linewidth=0.8)
    axes.plot(observed[drawn], model[drawn], ".", markersize=2)
    if len(fit.agreement.outliers):
        outliers = tuple(fit.agreement.outliers.T)
        axes.plot(np.asarray(data.values)[outliers], predicted[outliers], "x", color="crimson", label="outliers")
        axes.legend()
    axes.set(xlabel="observed", ylabel="model", title="data against model")


def _intervals(axes: Any, evidence: Any) -> None:
    """The interval of each parameter, relative to its value."""
    names, values, ends = evidence.names[:_INTERVALS], evidence.values[:_INTERVALS], evidence.ends[:, :_INTERVALS]
    sizes = np.where(values == 0, 1.0, np.abs(values))
    places = np.arange(len(names))
    low, high = (np.clip((end - values) / sizes, -1, _WIDEST) for end in ends)
    axes.errorbar(100 * 0.5 * (low + high), places, xerr=100 * 0.5 * (high - low), fmt="none", capsize=4)
    axes.plot(np.zeros(len(names)), places, "|", color="black")
    labels = [f"{name} = {value:.4g}" for name, value in zip(names, values, strict=True)]
    axes.set_yticks(places, labels)
    axes.set(xlabel="% of the value", title=f"{100 * evidence.confidence:.0f} % intervals")


def _strongest(covariance: np.ndarray) -> list[tuple[int, int]]:
    """The pairs of parameters with the strongest correlation."""
    std = np.sqrt(np.diag(covariance))
    is_known = np.isfinite(std) & (std > 0)
    rows, columns = np.triu_indices(len(std), 1)
    both_known = is_known[rows] & is_known[columns]
    rows, columns = rows[both_known], columns[both_known]
    safe = np.where(is_known, std, 1.0)
    correlation = np.abs(covariance / np.outer(safe, safe))
    order = np.argsort(-correlation[rows, columns])[:_PAIRS]
    return [(int(rows[k]), int(columns[k])) for k in order]


def _ellipse(axes: Any, evidence: Any, pair: tuple[int, int]) -> None:
    """The region that contains both parameters with the confidence of the intervals."""
    from scipy import stats

    i, j = pair
    block = evidence.covariance[np.ix_(pair, pair)]
    values, vectors = np.linalg.eigh(block)
    angle = np.linspace(0, 2 * np.pi, 200)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    radius = np.sqrt(stats.chi2.ppf(evidence.confidence, 2))
    x, y = radius * vectors @ (np.sqrt(np.maximum(values, 0))[:, None] * circle)
    axes.plot(evidence.values[i] + x, evidence.values[j] + y)
    axes.plot(evidence.values[i], evidence.values[j], "+")
    axes.locator_params(nbins=3)
    axes.set(xlabel=evidence.names[i], ylabel=evidence.names[j], title=f"{100 * evidence.confidence:.0f} % region")


def _not_quadratic(fit: Any) -> list[str]:
    """The parameters along which the loss at two standard deviations is far from the parabola at the minimum."""
    evidence = fit.evidence
    unit = 1.0 if fit.data.knows_noise or fit.data.estimates_spread else evidence.noise**2
    is_usable = np.isfinite(evidence.std) & (evidence.std > 0) & ~evidence.at_end
    if fit.data.loss.is_robust or not np.isfinite(unit) or unit == 0 or not fit.has_settled:
        return []
    bent = []
    for name in np.array(evidence.names)[is_usable][:_INTERVALS]:
        rise = (fit.losses_along(name, [-_REACH, _REACH]) - fit.loss) / (0.5 * unit * _REACH**2)
        if np.abs(rise - 1).max() > _BENT:
            bent.append(str(name))
    return bent[:_PAIRS]


def _profile(axes: Any, fit: Any, name: str) -> None:
    """The loss along a parameter, and the parabola that its interval is based on."""
    deviations = np.linspace(-_REACH, _REACH, 9)
    unit = 1.0 if fit.data.knows_noise else fit.evidence.noise**2
    axes.plot(deviations, (fit.losses_along(name, deviations) - fit.loss) / unit, marker=".", label="loss")
    axes.plot(deviations, 0.5 * deviations**2, color="gray", linewidth=0.8, label="parabola")
    axes.set(xlabel=f"{name}, standard deviations", ylabel="loss above the minimum", title="not quadratic")
    axes.legend()


def _on_surface(axes: Any, fit: Any, data: Observations, predicted: np.ndarray, surface: Any) -> None:
    """Data, model and their difference on the surface, for the first species and the time with the most outliers."""
    from .._output import pictures

    outliers, time_index = fit.agreement.outliers, -1
    if data.times is not None and len(outliers):
        time_index = int(np.argmax(np.bincount(outliers[:, 0], minlength=len(data.times))))
    mask, values = np.asarray(data.mask), np.asarray(data.values, np.float64)
    is_outlier = np.zeros(values.shape, bool)
    is_outlier[tuple(outliers.T)] = True
    fields = [np.where(mask, values, np.nan), np.asarray(predicted, np.float64), is_outlier]
    if data.times is not None:
        fields = [field[time_index] for field in fields]
    observed, model, is_outlier = (field[:, 0] if field.ndim == 2 else field for field in fields)
    is_good = np.isfinite(observed) & ~is_outlier
    ends = (float(observed[is_good].min()), float(observed[is_good].max())) if is_good.any() else (0.0, 1.0)
    difference = model - observed
    size = float(np.abs(difference[is_good]).max(initial=0.0)) or 1.0
    vertices, faces = np.asarray(surface.vertices), np.asarray(surface.faces)
    places = _drawn_vertices(data, len(vertices))
    images = []
    for title, values, limits, colors in (
        ("observed", observed, ends, "viridis"), ("model", model, ends, "viridis"),
        ("model - observed", difference, (-size, size), "coolwarm"),
    ):  # fmt: skip
        field = np.full(len(vertices), np.nan)
        field[places] = values
        drawn = pictures.Picture(vertices, faces, title, limits, colors)
        images.append(np.asarray(drawn.draw(field)))
        drawn.close()
    width = images[0].shape[1] // 2
    axes.imshow(np.concatenate([image[:, :width] for image in images], axis=1))
    time = "" if data.times is None else f" at t = {data.times[time_index]:g}"
    count = f"; {int(is_outlier.sum())} outliers are outside the range of colours" if is_outlier.any() else ""
    axes.set(title=f"observed, model, and model - observed{time}{count}")
    axes.set_axis_off()


def _drawn_vertices(data: Observations, num_vertices: int) -> np.ndarray:
    """The vertex at which each measurement is drawn; for a weighted sum the one with the largest weight."""
    if data.sampling is not None:
        heaviest = np.argmax(np.abs(np.asarray(data.sampling.weights)), axis=1)
        return data.sampling.vertices[np.arange(len(heaviest)), heaviest]
    return np.arange(num_vertices) if data.vertices is None else data.vertices
