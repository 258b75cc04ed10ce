"""What a fit looks like: the loss, the data against the model, and which parameters are known together."""

from typing import Any

import numpy as np

from .observations import Observations

# Pairs of parameters drawn at most.
_PAIRS = 3
# Points drawn at most of data against model.
_POINTS = 4000


def picture(fit: Any, data: Observations, surface: Any = None) -> Any:
    """A matplotlib figure of a `Fit`."""
    import matplotlib.pyplot as plt

    known = fit.evidence
    pairs = [] if known is None else _strongest(known.covariance)
    shown = surface is not None and data.values.size and fit.residuals.shape != ()
    count = 2 + len(pairs)
    figure = plt.figure(figsize=(3.6 * max(count, 2), 7.0 if shown else 3.4), layout="constrained")
    grid = figure.add_gridspec(2 if shown else 1, count)
    axes = figure.add_subplot(grid[0, 0])
    axes.semilogy(np.maximum(fit.losses, 1e-300), marker=".")
    axes.set(xlabel="step", ylabel="loss", title="loss")
    _against(figure.add_subplot(grid[0, 1]), fit, data)
    for k, pair in enumerate(pairs):
        _ellipse(figure.add_subplot(grid[0, 2 + k]), known, pair)
    if shown:
        _on_surface(figure.add_subplot(grid[1, :]), fit, data, surface)
    return figure


def _against(axes: Any, fit: Any, data: Observations) -> None:
    noise = 1.0 if data.noise is None else np.asarray(data.noise)
    seen = np.asarray(data.values)
    predicted = (seen + fit.residuals * noise).ravel()
    seen = seen.ravel()
    some = np.linspace(0, seen.size - 1, min(seen.size, _POINTS)).astype(int)
    ends = [min(seen.min(), predicted.min()), max(seen.max(), predicted.max())]
    axes.plot(ends, ends, color="gray", linewidth=0.8)
    axes.plot(seen[some], predicted[some], ".", markersize=2)
    axes.set(xlabel="observed", ylabel="model", title="data against model")


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
    axes.set(xlabel=known.names[i], ylabel=known.names[j], title=f"{100 * known.confidence:.0f} % region")


def _on_surface(axes: Any, fit: Any, data: Observations, surface: Any) -> None:
    """Data, model and what remains, on the surface, of the last time and the first species."""
    from ..output import pictures

    noise = 1.0 if data.noise is None else np.broadcast_to(np.asarray(data.noise), fit.residuals.shape)
    seen, rest = np.asarray(data.values), fit.residuals * noise
    if data.times is not None:
        seen, rest = seen[-1], rest[-1]
    if seen.ndim == 2:
        seen, rest = seen[:, 0], rest[:, 0]
    where = np.arange(surface.num_vertices) if data.vertices is None else data.vertices
    vertices, faces = np.asarray(surface.vertices), np.asarray(surface.faces)
    rows = []
    ends = float(seen.min()), float(seen.max())
    far = float(np.abs(rest).max()) or 1.0
    for title, values, limits, colors in (
        ("observed", seen, ends, "viridis"), ("model", seen + rest, ends, "viridis"),
        ("model - observed", rest, (-far, far), "coolwarm"),
    ):  # fmt: skip
        field = np.full(len(vertices), np.nan)
        field[where] = values
        drawn = pictures.Picture(vertices, faces, title, limits, colors)
        rows.append(np.asarray(drawn.draw(field)))
        drawn.close()
    width = rows[0].shape[1] // 2
    axes.imshow(np.concatenate([row[:, :width] for row in rows], axis=1))
    axes.set(title="observed, model, and model less observed")
    axes.set_axis_off()
