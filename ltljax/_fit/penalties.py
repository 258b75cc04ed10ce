"""Penalties: prior knowledge that a field is smooth or piecewise constant, and the choice of their weight."""

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
    weight: float | int | AnyArray = 1.0,
    mass: AnyArray | None = None,
    order: int = 1,
) -> Float[Array, "V *components"]:
    """Residuals whose sum of squares is ``weight`` times the integral of |grad f|^2, or of (Delta f)^2 (Tikhonov).

    The gradient allows kinks and hardly penalises waves of a few mesh sizes; the Laplacian suppresses both.

    Args:
        surface: the surface.
        field: (V,) field f.
        weight: weight of the penalty.
        mass: measure of the integral; by default the vertex areas.
        order: 1 for the gradient, with residuals (V, 3), or 2 for the Laplacian, with residuals (V,).

    Raises:
        ValueError: the order is neither 1 nor 2.
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
    weight: float | int | AnyArray = 1.0,
    rounding: float | int | AnyArray = 1e-3,
    mass: AnyArray | None = None,
) -> Float[Array, " V"]:
    """Residuals whose sum of squares is ``weight`` times the integral of sqrt(|grad f|^2 + rounding^2).

    This is the total variation (Rudin, Osher and Fatemi 1992), rounded so that it is differentiable. The cost of an
    edge depends on its height, not on its sharpness.

    Args:
        surface: the surface.
        field: (V,) field f.
        weight: weight of the penalty.
        rounding: slope below which the field counts as flat.
        mass: measure of the integral; by default the vertex areas.
    """
    measure = surface.vertex_areas if mass is None else jnp.asarray(mass)
    slope = jnp.sqrt(jnp.sum(gradient(surface, field) ** 2, axis=-1) + rounding**2)
    return jnp.sqrt(weight * jnp.maximum(measure, 0) * slope)


def choose_weight(
    fit_with: Callable[[float, Any], Any], weights: Sequence[float] | np.ndarray, rule: str = "discrepancy"
) -> tuple[float, Any, np.ndarray]:
    """The weight of a penalty by the discrepancy principle or the L-curve, and the fit with this weight (host).

    Weights are tried in descending order, and each fit begins at the parameters of the one before.

    Args:
        fit_with: ``(weight, start) -> Fit``; ``start`` is None for the first fit, then the parameters of the last.
        weights: weights to choose from.
        rule: ``"discrepancy"`` for the largest weight whose misfit is explained by the noise, which means a mean square
            of one (Morozov 1966); it needs data with known noise. ``"l-curve"`` for the weight where the curve of log
            misfit against log penalty has its largest curvature (Hansen 1992).

    Returns:
        The weight, its `Fit`, and the curve (W, 3) of weight, misfit (sum of squares over the data) and penalty (sum of
        squares of its residuals), in the order of the trials.

    Raises:
        ValueError: the rule is unknown, a weight is not positive, there are no weights, or the discrepancy principle is
            used with unknown noise.

    Warns:
        UserWarning: the misfit of every weight is larger than the noise explains; the smallest weight is returned.
    """
    if rule not in ("discrepancy", "l-curve"):
        raise ValueError(f"Expected rule 'discrepancy' or 'l-curve', found {rule!r}.")
    if not len(weights) or not min(weights) > 0:
        raise ValueError(f"Expected positive weights, found {list(weights)}.")
    curve, fits, start = [], [], None
    for weight in sorted(weights, reverse=True):
        fit = fit_with(weight, start)
        if rule == "discrepancy" and not fit.data.knows_noise:
            raise ValueError("The discrepancy principle needs the noise: give Observations(..., noise=...).")
        start = fit.params
        misfit = 2 * fit.loss - fit.penalties
        fits.append(fit)
        curve.append((weight, misfit, fit.penalties))
        if rule == "discrepancy" and misfit <= fit.data.num_values:
            break
    table = np.array(curve)
    if rule == "discrepancy" and table[-1, 1] > fits[-1].data.num_values:
        warnings.warn(
            f"No weight down to {table[-1, 0]:g} explains the data: the misfit is {table[-1, 1]:.4g}, and noise alone "
            f"gives {fits[-1].data.num_values}. Try smaller weights or a larger max_iterations, or check the model and "
            "the noise.",
            stacklevel=2,
        )
    if rule == "discrepancy" or len(table) < 3:
        return curve[-1][0], fits[-1], table
    best = int(np.argmax(_bend(np.log(table[:, 1]), np.log(np.maximum(table[:, 2] / table[:, 0], 1e-300)))))
    return curve[best][0], fits[best], table


def _bend(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Menger's curvature of a polyline at its points; zero at its ends."""
    ax, ay, bx, by = x[1:-1] - x[:-2], y[1:-1] - y[:-2], x[2:] - x[1:-1], y[2:] - y[1:-1]
    sides = np.hypot(ax, ay) * np.hypot(bx, by) * np.hypot(ax + bx, ay + by)
    # As the weight falls, first the misfit falls, then the penalty rises.
    turn = np.abs(ax * by - ay * bx)
    return np.concatenate([[0.0], 2 * turn / np.maximum(sides, 1e-300), [0.0]])
