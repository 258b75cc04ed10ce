"""What is known of a field beside the data: that it is smooth, or made of patches; and how much that should weigh."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._operators import gradient, laplacian
from .._surface import Surface, on_surface
from .._tables import AnyArray


@on_surface
def smoothness(
    surface: Surface,
    field: Float[AnyArray, " V"],
    weight: float = 1.0,
    mass: AnyArray | None = None,
    order: int = 1,
) -> Float[Array, "V *components"]:
    """Residuals whose sum of squares is ``weight`` times the integral of |grad f|^2, or of (Delta f)^2 (Tikhonov).

    The first allows kinks and says little about waves a few mesh sizes long; the second is for fields without either.

    Args:
        surface: where.
        field: (V,).
        weight: of the penalty.
        mass: the measure to integrate in; by default the vertex areas.
        order: 1 for the gradient (V, 3), 2 for the Laplacian (V,).
    """
    if order not in (1, 2):
        raise ValueError(f"Expected order 1 (the gradient) or 2 (the Laplacian), found {order}.")
    measure = surface.vertex_areas if mass is None else jnp.asarray(mass)
    root = jnp.sqrt(weight * jnp.maximum(measure, 0))
    return root[:, None] * gradient(surface, field) if order == 1 else root * laplacian(surface, field)


@on_surface
def total_variation(
    surface: Surface,
    field: Float[AnyArray, " V"],
    weight: float = 1.0,
    rounding: float = 1e-3,
    mass: AnyArray | None = None,
) -> Float[Array, " V"]:
    """Residuals whose sum of squares is ``weight`` times the integral of sqrt(|grad f|^2 + rounding^2).

    The total variation (Rudin, Osher and Fatemi 1992), rounded so that it has derivatives: edges cost by their height
    alone, however sharp they are.

    Args:
        surface: where.
        field: (V,).
        weight: of the penalty.
        rounding: slopes well below this count as flat.
        mass: the measure to integrate in; by default the vertex areas.
    """
    measure = surface.vertex_areas if mass is None else jnp.asarray(mass)
    slope = jnp.sqrt(jnp.sum(gradient(surface, field) ** 2, axis=-1) + rounding**2)
    return jnp.sqrt(weight * jnp.maximum(measure, 0) * slope)


def choose_weight(
    fit_with: Callable[[float, Any], Any], weights: Sequence[float] | np.ndarray, rule: str = "discrepancy"
) -> tuple[float, Any, np.ndarray]:
    """The weight of a penalty, by the discrepancy principle or the L-curve, and the fit made with it (host).

    Weights are tried from the largest down, each fit beginning at the last one's parameters.

    Args:
        fit_with: ``(weight, start) -> Fit``; ``start`` is None for the first, then the parameters of the last.
        weights: to choose from.
        rule: ``"discrepancy"``: the largest weight whose misfit is what the noise explains, a mean square of one
            (Morozov 1966); needs data whose noise is known. ``"l-curve"``: the weight where the curve of log misfit
            against log penalty bends most (Hansen 1992).

    Returns:
        The weight, its `Fit`, and the curve (W, 3): weight, misfit (sum of squares over the data) and penalty (sum of
        squares of its residuals), in the order tried.

    Raises:
        ValueError: an unknown rule, no weights, or with the discrepancy principle noise that is not known.

    Warns:
        UserWarning: no weight leaves as little as the noise explains; the least weight is returned.
    """
    if rule not in ("discrepancy", "l-curve"):
        raise ValueError(f"Expected rule 'discrepancy' or 'l-curve', found {rule!r}.")
    if not len(weights) or not min(weights) > 0:
        raise ValueError(f"Expected positive weights, found {list(weights)}.")
    curve, fits, start = [], [], None
    for weight in sorted(weights, reverse=True):
        found = fit_with(weight, start)
        if rule == "discrepancy" and not found.data.knows_noise:
            raise ValueError("The discrepancy principle needs the noise: give Observations(..., noise=...).")
        start = found.params
        misfit = 2 * found.loss - found.penalties
        fits.append(found)
        curve.append((weight, misfit, found.penalties))
        if rule == "discrepancy" and misfit <= found.data.num_values:
            break
    table = np.array(curve)
    if rule == "discrepancy" and table[-1, 1] > fits[-1].data.num_values:
        warnings.warn(
            f"No weight down to {table[-1, 0]:g} explains the data: the misfit is {table[-1, 1]:.4g}, of noise "
            f"{fits[-1].data.num_values}. Try smaller weights or more max_steps, or doubt the model or the noise.",
            stacklevel=2,
        )
    if rule == "discrepancy" or len(table) < 3:
        return curve[-1][0], fits[-1], table
    best = int(np.argmax(_bend(np.log(table[:, 1]), np.log(np.maximum(table[:, 2] / table[:, 0], 1e-300)))))
    return curve[best][0], fits[best], table


def _bend(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The curvature (Menger's) of a polyline at its inner points; its ends have none."""
    ax, ay, bx, by = x[1:-1] - x[:-2], y[1:-1] - y[:-2], x[2:] - x[1:-1], y[2:] - y[1:-1]
    sides = np.hypot(ax, ay) * np.hypot(bx, by) * np.hypot(ax + bx, ay + by)
    # From large weights to small ones the misfit falls first and the penalty rises then: a turn to the right.
    turn = np.abs(ax * by - ay * bx)
    return np.concatenate([[0.0], 2 * turn / np.maximum(sides, 1e-300), [0.0]])
