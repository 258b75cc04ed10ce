"""What a fit looks like: data, model and residuals, the loss, intervals, and what is known of parameters together."""

import textwrap
from typing import Any

import numpy as np

from .observations import Observations

# Pairs of parameters drawn at most.
_PAIRS = 3
# Points drawn at most of data against model.
_POINTS = 4000
# The loss is compared with a parabola so many standard deviations from the minimum; the share by which it may differ.
_REACH, _BENT = 2.0, 0.5
# Intervals drawn at most, and the largest end that is drawn, as a multiple of the value.
_INTERVALS, _WIDEST = 12, 3.0


def picture(fit: Any, data: Observations, surface: Any = None, observed: np.ndarray | None = None) -> Any:
    """A matplotlib figure of a `Fit`: data, model and residuals on the surface, with outliers marked; the loss, data
    against model, intervals, and the regions of the parameters that are known together.

    Args:
        fit: the fit.
        data: what was fitted.
        surface: surface to draw on; None for none.
        observed: what the model predicts for the data, in their shape.
    """
    import matplotlib.pyplot as plt

    known = fit.evidence
    pairs = [] if known is None else _strongest(known.covariance)
    axis = 0 if data.times is None else 1
    has_places = surface is not None and data.values.ndim > axis and data.values.shape[axis] > 1
    bent = [] if known is None else _not_quadratic(fit)
    count = 2 + (known is not None) + len(pairs) + len(bent)
    figure = plt.figure(figsize=(3.6 * max(count, 2), 7.2 if has_places else 3.6), layout="constrained")
    figure.suptitle(textwrap.fill(fit.agreement.sentence(), 36 * max(count, 2)), fontsize="medium")
    grid = figure.add_gridspec(2 if has_places else 1, count)
    axes = figure.add_subplot(grid[0, 0])
    axes.semilogy(np.maximum(fit.losses, 1e-300), marker=".")
    axes.set(xlabel="step", ylabel="loss", title="loss")
    if data.has_moving_spread:
        axes.set(title="loss, in units of the noise so far")
    predicted = np.asarray(data.of(fit.prediction, fit.calibration) if observed is None else observed)
    _against(figure.add_subplot(grid[0, 1]), fit, data, predicted)
    if known is not None:
        _intervals(figure.add_subplot(grid[0, 2]), known)
    for k, pair in enumerate(pairs):
        _ellipse(figure.add_subplot(grid[0, 3 + k]), known, pair)
    for k, name in enumerate(bent):
        _profile(figure.add_subplot(grid[0, 3 + len(pairs) + k]), fit, name)
    if has_places:
        _on_surface(figure.add_subplot(grid[1, :]), fit, data, predicted, surface)
    return figure


def _against(axes: Any, fit: Any, data: Observations, predicted: np.ndarray) -> None:
    mask = np.asarray(data.mask)
    seen, model = np.asarray(data.values)[mask], predicted[mask]
    some = np.linspace(0, seen.size - 1, min(seen.size, _POINTS)).astype(int)
    ends = [min(seen.min(), model.min()), max(seen.max(), model.max())]
    axes.plot(ends, ends, color="gray", linewidth=0.8)
    axes.plot(seen[some], model[some], ".", markersize=2)
    if len(fit.agreement.outliers):
        far = tuple(fit.agreement.outliers.T)
        axes.plot(np.asarray(data.values)[far], predicted[far], "x", color="crimson", label="outliers")
        axes.legend()
    axes.set(xlabel="observed", ylabel="model", title="data against model")


def _intervals(axes: Any, known: Any) -> None:
    """The interval of each parameter, relative to its value."""
    names, values, ends = known.names[:_INTERVALS], known.values[:_INTERVALS], known.ends[:, :_INTERVALS]
    sizes = np.where(values == 0, 1.0, np.abs(values))
    places = np.arange(len(names))
    low, high = (np.clip((end - values) / sizes, -1, _WIDEST) for end in ends)
    axes.errorbar(100 * 0.5 * (low + high), places, xerr=100 * 0.5 * (high - low), fmt="none", capsize=4)
    axes.plot(np.zeros(len(names)), places, "|", color="black")
    labels = [f"{name} = {value:.4g}" for name, value in zip(names, values, strict=True)]
    axes.set_yticks(places, labels)
    axes.set(xlabel="% of the value", title=f"{100 * known.confidence:.0f} % intervals")


def _strongest(covariance: np.ndarray) -> list[tuple[int, int]]:
    """The pairs of parameters that are most correlated."""
    std = np.sqrt(np.diag(covariance))
    rows, columns = np.triu_indices(len(std), 1)
    # Without those whose errors are not known.
    known = np.isfinite(std) & (std > 0)
    rows, columns = rows[known[rows] & known[columns]], columns[known[rows] & known[columns]]
    correlation = np.abs(covariance / np.outer(np.where(known, std, 1.0), np.where(known, std, 1.0)))
    order = np.argsort(-correlation[rows, columns])[:_PAIRS]
    return [(int(rows[k]), int(columns[k])) for k in order]


def _ellipse(axes: Any, known: Any, pair: tuple[int, int]) -> None:
    """The region that holds both parameters with the confidence of the intervals."""
    from scipy import stats

    i, j = pair
    block = known.covariance[np.ix_(pair, pair)]
    values, vectors = np.linalg.eigh(block)
    angle = np.linspace(0, 2 * np.pi, 200)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    radius = np.sqrt(stats.chi2.ppf(known.confidence, 2))
    x, y = radius * vectors @ (np.sqrt(np.maximum(values, 0))[:, None] * circle)
    axes.plot(known.values[i] + x, known.values[j] + y)
    axes.plot(known.values[i], known.values[j], "+")
    axes.locator_params(nbins=3)
    axes.set(xlabel=known.names[i], ylabel=known.names[j], title=f"{100 * known.confidence:.0f} % region")


def _not_quadratic(fit: Any) -> list[str]:
    """The parameters at the ends of whose intervals the loss is far from what its curvature at the minimum says."""
    known = fit.evidence
    unit = 1.0 if fit.data.knows_noise or fit.data.estimates_spread else known.noise**2
    usable = np.isfinite(known.std) & (known.std > 0) & ~known.at_end
    if fit.data.loss.is_robust or not np.isfinite(unit) or unit == 0 or not fit.has_settled:
        return []
    bent = []
    for name in np.array(known.names)[usable][:_INTERVALS]:
        rise = (fit.losses_along(name, [-_REACH, _REACH]) - fit.loss) / (0.5 * unit * _REACH**2)
        if np.abs(rise - 1).max() > _BENT:
            bent.append(str(name))
    return bent[:_PAIRS]


def _profile(axes: Any, fit: Any, name: str) -> None:
    """The loss along a parameter, and the parabola that its interval rests on."""
    known = fit.evidence
    steps = np.linspace(-_REACH, _REACH, 9)
    unit = 1.0 if fit.data.knows_noise else known.noise**2
    axes.plot(steps, (fit.losses_along(name, steps) - fit.loss) / unit, marker=".", label="loss")
    axes.plot(steps, 0.5 * steps**2, color="gray", linewidth=0.8, label="parabola")
    axes.set(xlabel=f"{name}, standard deviations", ylabel="loss above the least", title="not quadratic")
    axes.legend()


def _on_surface(axes: Any, fit: Any, data: Observations, predicted: np.ndarray, surface: Any) -> None:
    """Data, model and what remains on the surface, of the first species and of the time with the most outliers."""
    from .._output import pictures

    far = fit.agreement.outliers
    when = -1
    if data.times is not None and len(far):
        when = int(np.argmax(np.bincount(far[:, 0], minlength=len(data.times))))
    mask, seen = np.asarray(data.mask), np.asarray(data.values, np.float64)
    is_far = np.zeros(seen.shape, bool)
    is_far[tuple(far.T)] = True
    fields = [np.where(mask, seen, np.nan), np.asarray(predicted, np.float64), is_far]
    if data.times is not None:
        fields = [field[when] for field in fields]
    observed, model, is_far = (field[:, 0] if field.ndim == 2 else field for field in fields)
    vertices, faces = np.asarray(surface.vertices), np.asarray(surface.faces)
    where = np.arange(len(vertices)) if data.vertices is None else data.vertices
    if data.sampling is not None:
        # Each measurement is drawn at the vertex that weighs most in it.
        heaviest = np.argmax(np.abs(np.asarray(data.sampling.weights)), axis=1)
        where = data.sampling.vertices[np.arange(len(heaviest)), heaviest]
    good = np.isfinite(observed) & ~is_far
    ends = (float(observed[good].min()), float(observed[good].max())) if good.any() else (0.0, 1.0)
    rest = model - observed
    size = float(np.abs(rest[good]).max(initial=0.0)) or 1.0
    rows = []
    for title, values, limits, colors in (
        ("observed", observed, ends, "viridis"), ("model", model, ends, "viridis"),
        ("model - observed", rest, (-size, size), "coolwarm"),
    ):  # fmt: skip
        field = np.full(len(vertices), np.nan)
        field[where] = values
        drawn = pictures.Picture(vertices, faces, title, limits, colors)
        rows.append(np.asarray(drawn.draw(field)))
        drawn.close()
    width = rows[0].shape[1] // 2
    axes.imshow(np.concatenate([row[:, :width] for row in rows], axis=1))
    time = "" if data.times is None else f" at t = {data.times[when]:g}"
    count = f"; {int(is_far.sum())} outliers are outside the colours' range" if is_far.any() else ""
    axes.set(title=f"observed, model, and model less observed{time}{count}")
    axes.set_axis_off()
