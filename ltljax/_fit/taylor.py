"""`check_gradient`: Taylor's test of a gradient."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

# A gradient error below this share is attributed to adaptive time steps, and a larger one to a mistake.
_NEARLY = 1e-2


@dataclasses.dataclass(frozen=True)
class GradientCheck:
    """The result of Taylor's test of a gradient.

    Attributes:
        steps: (K,) step lengths h.
        remainders: (K,) |f(x + h d) - f(x) - h f'(x) d|, which decrease like h^2 if the derivative is right.
        differences: (K,) |f(x + h d) - f(x)|, which decrease like h.
        slope: order of the remainders in h, from those above rounding errors; infinite if all are rounding errors.
        derivative: directional derivative f'(x) d.
        passed: whether the slope is above 1.9, or the remainders are rounding errors and the differences are not.
        verdict: result in words.
    """

    steps: np.ndarray
    remainders: np.ndarray
    differences: np.ndarray
    slope: float
    derivative: float
    passed: bool
    verdict: str

    def __str__(self) -> str:
        rows = zip(self.steps, self.differences, self.remainders, strict=True)
        table = [f"{'step':>10} {'|f(x+hd)-f(x)|':>16} {'less h f(x)d':>14}".replace("f(x)d", "f'(x)d")]
        table += [f"{h:10.1e} {difference:16.3e} {remainder:14.3e}" for h, difference, remainder in rows]
        return "\n".join([*table, self.verdict])

    __repr__ = __str__


def check_gradient(
    loss: Callable[[Any], Any], params: Any, direction: Any = None, step: float = 1e-2, seed: int = 0
) -> GradientCheck:
    """The result of Taylor's test of ``jax.grad(loss)`` at some parameters (host).

    If the gradient is right, the remainder of the linear prediction decreases like the square of the step: slope 2.

    Slope 1 means that the gradient is wrong, that the loss has a kink at these parameters, or that the gradient is
    right only to the share given in the verdict. The last is typical of adaptive time steps, whose lengths are treated
    as constants in a gradient; with `solve(..., dt=...)` the slope is 2.

    Slope 0 means that the loss is noisy, mostly because adaptive steps or iterations end at different points. Tighter
    tolerances help. A loss that changes by no more than its rounding errors does not pass.

    Args:
        loss: ``params -> number``, differentiable in reverse mode.
        params: parameters: a pytree of floats.
        direction: direction of the steps, in the structure of ``params``; by default random, with entries in proportion
            to the parameters.
        step: longest step, as a share of the direction.
        seed: seed of the random direction.

    Returns:
        The `GradientCheck`, which prints as a table and a verdict.

    Raises:
        ValueError: the loss is not one finite number, or its gradient is not finite.
    """
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.result_type(float)), params)
    flat, rebuild = ravel_pytree(params)
    if direction is None:
        random = np.random.default_rng(seed).normal(size=flat.shape)
        d = jnp.asarray(random, flat.dtype) * jnp.where(flat == 0, jnp.ones_like(flat), jnp.abs(flat))
    else:
        d = ravel_pytree(jax.tree.map(lambda leaf: jnp.asarray(leaf, flat.dtype), direction))[0]
    value_of = jax.jit(lambda x: loss(rebuild(x)))
    value, gradient = jax.value_and_grad(lambda x: loss(rebuild(x)))(flat)
    if jnp.shape(value) != () or not bool(jnp.isfinite(value)):
        raise ValueError(f"Expected the loss to be one finite number, found {value}.")
    if not bool(jnp.all(jnp.isfinite(gradient))):
        bad = int(np.argwhere(~np.isfinite(np.asarray(gradient)))[0, 0])
        raise ValueError(f"The gradient is not finite: entry {bad} is {gradient[bad]}.")
    derivative = float(jnp.vdot(gradient, d))
    # All values come from the same program, so that their rounding errors cancel.
    first = float(value_of(flat))
    steps = step * 0.5 ** np.arange(8)
    values = np.array([float(value_of(flat + h * d)) for h in steps])
    differences, remainders = np.abs(values - first), np.abs(values - first - steps * derivative)
    rounding = 50 * float(jnp.finfo(flat.dtype).eps) * max(abs(first), 1e-300)
    is_usable = remainders > rounding
    slope = float("inf")
    if is_usable[:3].all():
        count = int(np.argmin(is_usable)) if not is_usable.all() else len(steps)
        slope = float(np.polyfit(np.log(steps[:count]), np.log(remainders[:count]), 1)[0])
    if np.isinf(slope) and max(remainders[0], rounding) > _NEARLY * differences[0]:
        verdict = (
            f"The loss does not respond to steps of this size: it changes by {differences[0]:.1g}, and the rounding "
            f"error of {first:.3g} may be {rounding:.1g}. Take a larger step=, float64, or a loss without the large "
            "constant."
        )
        return GradientCheck(steps, remainders, differences, slope, derivative, False, verdict)
    share = remainders[-1] / max(differences[-1], 1e-300)
    verdict = _verdict(slope, derivative, share)
    return GradientCheck(steps, remainders, differences, slope, derivative, slope > 1.9, verdict)


def _verdict(slope: float, derivative: float, share: float) -> str:
    if np.isinf(slope):
        return "The gradient is right: the remainders are rounding errors (the loss is linear along this direction)."
    if slope > 1.9:
        return f"The gradient is right: slope {slope:.2f}."
    if slope > 1.3:
        return f"The result is in doubt: slope {slope:.2f} instead of 2. Take a smaller step=, or tighter tolerances."
    if slope > 0.7 and share < _NEARLY:
        return (
            f"The gradient is right to {100 * share:.1g} %, no better: slope {slope:.2f} instead of 2. This is typical "
            "of adaptive steps: their lengths change with the parameters, but a gradient treats them as constants. "
            "Tighten rtol, or give dt= for fixed steps, whose gradient is exact."
        )
    if slope > 0.7:
        return (
            f"The gradient is wrong: slope {slope:.2f} instead of 2, f'(x) d = {derivative:.3g}. Look for "
            "stop_gradient, for rounding or comparisons of values that depend on a parameter, or for a kink (abs, max, "
            "a clamp) at this point."
        )
    return (
        f"The loss is noisy: slope {slope:.2f}. Adaptive time steps or iterations end at a different point for every "
        "step: tighten rtol and atol, or give dt= for fixed steps."
    )
