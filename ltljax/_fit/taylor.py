"""Whether a gradient is right: Taylor's test, as a user's tool."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

# A gradient that errs by less than this share errs as adaptive steps do, not as a mistake does.
_NEARLY = 1e-2


@dataclasses.dataclass(frozen=True)
class GradientCheck:
    """Taylor's test of a gradient.

    Attributes:
        steps: (K,) the lengths of the steps.
        remainders: (K,) |f(x + h d) - f(x) - h f'(x) d|, which falls like h^2 where the derivative is right.
        differences: (K,) |f(x + h d) - f(x)|, which falls like h.
        slope: of the remainders, where rounding does not rule them; infinite where nothing else is left of them.
        derivative: f'(x) d.
        passed: whether the slope is within 0.1 of two or more, or the differences stand above rounding and the
            remainders do not.
        verdict: in words.
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
    """Taylor's test of ``jax.grad(loss)`` at some parameters (host).

    If the gradient is right the remainder of the linear prediction falls like the square of the step: slope 2. Slope 1
    says it is wrong (or the function has a kink there), or right to a share that is said, which is what adaptive steps
    leave: their lengths count as given in a gradient. With `solve(..., dt=...)` the slope is 2. No slope at all says
    that the loss is noisy, mostly because adaptive steps or an iteration end at different places, which tighter
    tolerances cure. A loss that does not answer to the steps beyond its rounding shows nothing, and does not pass.

    Args:
        loss: ``params -> number``, differentiable in reverse mode.
        params: a pytree of floats.
        direction: to step in, as ``params``; by default random, each entry in proportion to its parameter.
        step: the longest, as a share of the direction.
        seed: of the random direction.

    Returns:
        The `GradientCheck`, which prints as the table and what is wrong.

    Raises:
        ValueError: the loss or its gradient is not finite, or no number.
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
    # From the same program as the others, so that rounding cancels.
    first = float(value_of(flat))
    steps = step * 0.5 ** np.arange(8)
    values = np.array([float(value_of(flat + h * d)) for h in steps])
    differences, remainders = np.abs(values - first), np.abs(values - first - steps * derivative)
    rounding = 50 * float(jnp.finfo(flat.dtype).eps) * max(abs(first), 1e-300)
    usable = remainders > rounding
    slope = float("inf")
    if usable[:3].all():
        last = int(np.argmin(usable)) if not usable.all() else len(steps)
        slope = float(np.polyfit(np.log(steps[:last]), np.log(remainders[:last]), 1)[0])
    if np.isinf(slope) and max(remainders[0], rounding) > _NEARLY * differences[0]:
        verdict = (
            f"The loss does not answer to steps of this size: it changes by {differences[0]:.1g}, and the rounding of "
            f"{first:.3g} may be {rounding:.1g}. Take a larger step=, float64, or a loss without the large constant."
        )
        return GradientCheck(steps, remainders, differences, slope, derivative, False, verdict)
    share = remainders[-1] / max(differences[-1], 1e-300)
    verdict = _verdict(slope, derivative, share)
    return GradientCheck(steps, remainders, differences, slope, derivative, slope > 1.9, verdict)


def _verdict(slope: float, derivative: float, share: float) -> str:
    if np.isinf(slope):
        return "The gradient is right: nothing but rounding is left (the function is linear along this direction)."
    if slope > 1.9:
        return f"The gradient is right: slope {slope:.2f}."
    if slope > 1.3:
        return f"In doubt: slope {slope:.2f} instead of 2. Take a smaller step=, or tighter tolerances."
    if slope > 0.7 and share < _NEARLY:
        return (
            f"The gradient is right to {100 * share:.1g} %, no better: slope {slope:.2f} instead of 2. So it is with "
            "adaptive steps, whose lengths a gradient takes as given while they change with the parameters: what is "
            "left is of the size of their error. Tighten rtol, or give dt= for fixed steps, whose gradient is exact."
        )
    if slope > 0.7:
        return (
            f"The gradient is wrong: slope {slope:.2f} instead of 2, f'(x) d = {derivative:.3g}. Look for "
            "stop_gradient, a rounded or compared value that a parameter enters through, or a kink (abs, max, "
            "a clamp) at this point."
        )
    return (
        f"The loss is noisy: slope {slope:.2f}. An adaptive run or an iteration ends at another place for every step: "
        "tighten rtol and atol, or give dt= for fixed steps."
    )
