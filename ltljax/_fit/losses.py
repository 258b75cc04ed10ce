"""Loss functions, which limit the influence of outliers.

As in SciPy, a loss is a function rho of the squared residual z in units of the noise. A fit minimises
``1/2 sum(c^2 rho(r^2 / c^2))``. rho(z) = z is least squares, and a rho that grows more slowly limits the influence of
outliers. Least-squares methods receive the signed root of each term as its residual, so they minimise the same sum.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Below this power of the machine epsilon, a loss is taken to be proportional to the squared residual z, because
# formulas such as sqrt(1 + z) - 1 lose their digits there.
_SMALL = 0.45


def _linear(z: Array) -> Array:
    return z


def _huber(z: Array) -> Array:
    # rho(z) = z for z <= 1, otherwise 2 sqrt(z) - 1: quadratic in the residual at first, then linear.
    return jnp.where(z <= 1, z, 2 * jnp.sqrt(jnp.maximum(z, 1)) - 1)


def _soft_l1(z: Array) -> Array:
    # rho(z) = 2 (sqrt(1 + z) - 1), in a form that keeps its digits for small z.
    return 2 * z / (1 + jnp.sqrt(1 + z))


# Each loss with the scale c at which it has 95 % of the efficiency of least squares under normal noise
# (Holland and Welsch 1977, Robust regression using iteratively reweighted least-squares; soft_l1 by quadrature).
_LOSSES: dict[str, tuple[Callable[[Array], Array], float]] = {
    "linear": (_linear, 1.0),
    "huber": (_huber, 1.345),
    "soft_l1": (_soft_l1, 1.287),
    "cauchy": (jnp.log1p, 2.385),
}


class Loss(eqx.Module):
    """A loss function of residuals in units of the noise.

    Attributes:
        name: name of the loss, as in reports.
        rho: function of the squared residual over the squared scale; rho(0) = 0.
        scale: residual c at which the loss begins to grow more slowly than the square, in units of the noise.
    """

    name: str = eqx.field(static=True)
    rho: Callable[[Array], Array] = eqx.field(static=True)
    scale: float = eqx.field(static=True)

    @property
    def is_robust(self) -> bool:
        """Whether the loss differs from least squares."""
        return self.rho is not _linear

    def root(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """The number with the sign of the residual, half of whose square is the loss."""
        if not self.is_robust:
            return r
        z = (r / self.scale) ** 2
        safe = jnp.maximum(z, float(jnp.finfo(z.dtype).eps) ** _SMALL)
        return r * jnp.sqrt(self.rho(safe) / safe)

    def influence(self, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First and second derivatives (N,) of the loss with respect to each residual."""
        residuals = jnp.asarray(r)
        first = jax.grad(lambda r: 0.5 * self.root(r) ** 2)
        return np.asarray(jax.vmap(first)(residuals)), np.asarray(jax.vmap(jax.grad(first))(residuals))


def as_loss(loss: Any) -> Loss:
    """The loss with a name, or of a function rho.

    Raises:
        ValueError: there is no loss of this name, or the function is not finite, not zero at zero, or decreases.
    """
    if isinstance(loss, Loss):
        return loss
    if isinstance(loss, str) and loss in _LOSSES:
        rho, scale = _LOSSES[loss]
        return Loss(loss, rho, scale)
    names = ", ".join(map(repr, _LOSSES))
    if not callable(loss):
        raise ValueError(
            f"Expected a loss: {names}, or a function rho(z) of squared residuals z in units of the noise, "
            f"found {loss!r}."
        )
    z = jnp.asarray(np.concatenate([[0.0], np.logspace(-4, 4, 33)]))
    try:
        values = np.asarray(loss(z), np.float64)
    except Exception as error:  # a user's function may raise any exception
        raise ValueError(f"The loss fails on an array of squared residuals: {type(error).__name__}: {error}") from error
    if values.shape != z.shape or not np.isfinite(values).all():
        raise ValueError("Expected a loss that returns one finite number for each squared residual from 0 to 10,000.")
    if abs(values[0]) > 1e-6 * abs(values[-1]) or values[1] <= 0 or (np.diff(values) < -1e-6 * values.max()).any():
        raise ValueError(
            f"Expected a loss rho(z) with rho(0) = 0 that increases with z, found rho(0) = {values[0]:.3g}, "
            f"rho(1e-4) = {values[1]:.3g} and rho(1e4) = {values[-1]:.3g}."
        )
    return Loss(getattr(loss, "__name__", "loss"), loss, 1.0)  # type: ignore (its values were checked above)
