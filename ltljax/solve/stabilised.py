"""Stabilised explicit steppers for diffusion: many cheap stages, and a step that grows with their square."""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar, Literal

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Numbers of stages on offer, about a fifth apart, so at most that much of a step is wasted; odd, as even ones do not
# damp the stiffest modes.
_STAGES = np.unique(np.round(np.geomspace(3, 257, 28)).astype(int) // 2 * 2 + 1)


def bound_of_equation(t, u, args):
    """The spectral bound of the equation that is solved."""
    equation, surface = args
    return equation.spectral_bound(t, surface, u)


class Stabilised(diffrax.AbstractAdaptiveSolver):
    """What the steppers share: a recurrence over as many stages as the length of a step needs."""

    spectral_bound: eqx.AbstractVar[Callable[..., Float[Array, ""]]]
    loop_kind: eqx.AbstractVar[Literal["lax", "checkpointed", "bounded"]]

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.ThirdOrderHermitePolynomialInterpolation

    @staticmethod
    @abc.abstractmethod
    def _coefficients() -> dict[str, np.ndarray]:
        """One row for each number of stages on offer; entry j belongs to stage j."""

    @abc.abstractmethod
    def _error(self, increment, dt, rate0, rate1) -> Array:
        """The estimated error."""

    def init(self, terms, t0, t1, y0, args):
        """The rate at the start, and the number of evaluations so far."""
        return terms.vf(t0, y0, args), jnp.ones((), jnp.result_type(int))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step with as many stages as its length needs."""
        del made_jump
        rate0, evaluations = solver_state
        table = self._coefficients()
        counts = table["stages"]
        table = {name: jnp.asarray(values, y0.dtype) for name, values in table.items()}
        bound = self.spectral_bound(t0, y0, args)
        reach = table["reach"]
        # Beyond the largest number of stages a step would be unstable: an adaptive controller refuses it, and without
        # one the run stops at what is not a number. Its stages are those of the longest stable step: if they
        # overflowed, so would derivatives, whatever is made of their values.
        is_stable = (t1 - t0) * bound <= reach[-1]
        dt = jnp.where(is_stable, t1 - t0, jax.lax.stop_gradient(reach[-1] / jnp.maximum(bound, 1e-30)))
        stiffness = dt * bound
        choice = jnp.minimum(jnp.searchsorted(reach, stiffness), len(counts) - 1)
        stages = jnp.asarray(counts)[choice]
        mu, nu, mu_rate, gamma_rate, c = (table[name][choice] for name in ("mu", "nu", "mu_rate", "gamma_rate", "c"))

        # Written for the increments over y0: their rounding is relative to the step, not to the state.
        def stage(carry):
            j, before, last = carry
            rate = terms.vf(t0 + c[j - 1] * dt, y0 + last, args)
            new = mu[j] * last + nu[j] * before + dt * (mu_rate[j] * rate + gamma_rate[j] * rate0)
            return j + 1, last, new

        first = mu_rate[1] * dt * rate0
        start = (jnp.full((), 2, stages.dtype), jnp.zeros_like(y0), first)
        _, _, increment = eqxi.while_loop(
            lambda carry: carry[0] <= stages, stage, start, max_steps=int(counts[-1]), kind=self.loop_kind
        )
        y1 = y0 + increment
        rate1 = terms.vf(t1, y1, args)
        error = self._error(increment, dt, rate0, rate1)
        y1, error = jnp.where(is_stable, y1, jnp.nan), jnp.where(is_stable, error, jnp.inf)
        dense = dict(y0=y0, y1=y1, k0=dt * rate0, k1=dt * rate1)
        state = (rate1, evaluations + stages.astype(evaluations.dtype))
        return y1, error, dense, state, diffrax.RESULTS.successful

    def longest_step(self, bound: float) -> float:
        """The longest stable step where eigenvalues are within a bound."""
        return float(self._coefficients()["reach"][-1]) / max(bound, 1e-30)

    def func(self, terms, t0, y0, args) -> Any:
        """The rate of change."""
        return terms.vf(t0, y0, args)


def differentiable(solver: diffrax.AbstractSolver, adjoint: diffrax.AbstractAdjoint) -> diffrax.AbstractSolver:
    """The solver with a loop over stages that has the derivatives of the adjoint's loop over steps."""
    if isinstance(solver, Stabilised) and isinstance(adjoint, diffrax.ForwardMode):
        return dataclasses.replace(solver, loop_kind="lax")
    if isinstance(solver, Stabilised) and isinstance(adjoint, diffrax.DirectAdjoint):
        return dataclasses.replace(solver, loop_kind="bounded")
    return solver


class RKL2(Stabilised):
    """Runge-Kutta-Legendre of second order, explicit, adaptive, for ``u_t = f(t, u)`` with a stiff diffusion part.

    With s stages it is stable where ``dt * bound <= (s^2 + s - 2) / 2``, bound being that of the eigenvalues of f's
    derivative, which lie near the negative real axis. Each step takes the least s for its own length, so the number
    of evaluations grows with the square root of the stiffness, where an explicit method's grows with the stiffness.
    A step halves what is stiff, which keeps the error estimate from being led by it, and leaves room for eigenvalues
    off the axis; Chebyshev's polynomials reach 30 % further with s stages, and have neither.

    Attributes:
        spectral_bound: ``(t, y, args) -> bound``; by default that of the equation.
        loop_kind: of the loop over stages, as equinox names them: ``"checkpointed"`` for derivatives in reverse mode,
            ``"lax"`` for forward mode; `solve` chooses it by its adjoint.

    Source: Meyer, Balsara and Aslam (2014), A stabilized Runge-Kutta-Legendre method for explicit super-time-stepping
    of parabolic and mixed equations, doi:10.1016/j.jcp.2013.08.021, equations 14 to 18.
    """

    spectral_bound: Callable[..., Float[Array, ""]] = bound_of_equation
    loop_kind: Literal["lax", "checkpointed", "bounded"] = eqx.field(default="checkpointed", static=True)

    def order(self, terms):
        """Two."""
        return 2

    @staticmethod
    @functools.cache
    def _coefficients() -> dict[str, np.ndarray]:  # type: ignore
        s, j = _STAGES[:, None], _stage_numbers()
        b = np.where(j < 2, 1 / 3, (j**2 + j - 2) / (2 * j * (j + 1)))
        c = (j**2 + j - 2) / (s**2 + s - 2)
        c[:, 1] = c[:, 2] / 3
        return _legendre(b, 4 / (s**2 + s - 2), c)

    def _error(self, increment, dt, rate0, rate1):
        # The third derivative's share in the error is 1/18, that in the trapezoidal rule's 1/12.
        return (dt * (rate0 + rate1) / 2 - increment) * 2 / 3


class RKL1(Stabilised):
    """Runge-Kutta-Legendre of first order: explicit, and with `Monotone` diffusion it keeps the maximum principle.

    Stable where ``dt * bound <= s^2 + s``. The error is estimated by the difference from the trapezoidal rule.

    Attributes:
        spectral_bound: ``(t, y, args) -> bound``; by default that of the equation.
        loop_kind: of the loop over stages, as equinox names them: ``"checkpointed"`` for derivatives in reverse mode,
            ``"lax"`` for forward mode; `solve` chooses it by its adjoint.

    Source: as of `RKL2`, equations 8 to 11 (the formula), section 4 (the maximum principle).
    """

    spectral_bound: Callable[..., Float[Array, ""]] = bound_of_equation
    loop_kind: Literal["lax", "checkpointed", "bounded"] = eqx.field(default="checkpointed", static=True)

    def order(self, terms):
        """One."""
        return 1

    def error_order(self, terms):
        """Two."""
        return 2

    @staticmethod
    @functools.cache
    def _coefficients() -> dict[str, np.ndarray]:  # type: ignore
        s, j = _STAGES[:, None], _stage_numbers()
        return _legendre(np.ones(j.shape), 2 / (s**2 + s), (j**2 + j) / (s**2 + s))

    def _error(self, increment, dt, rate0, rate1):
        return 0.5 * dt * (rate0 + rate1) - increment


def _stage_numbers() -> np.ndarray:
    # Entry 0 is of no stage; the one in its place keeps the formulas finite.
    return np.maximum(np.arange(_STAGES[-1] + 1), 1).astype(float)


def _legendre(b: np.ndarray, scale: np.ndarray, c: np.ndarray) -> dict[str, np.ndarray]:
    """The recurrence of Legendre polynomials, stage j being 1 - b[j] + b[j] P_j(1 + scale z) of z = dt lambda."""
    j = _stage_numbers()
    before, last = np.roll(b, 2), np.roll(b, 1)
    mu, nu = (2 * j - 1) / j * b / last, (1 - j) / j * b / before
    mu_rate = mu * scale
    mu_rate[:, 1:2] = b[1] * scale
    table = dict(mu=mu, nu=nu, mu_rate=mu_rate, gamma_rate=(last - 1) * mu_rate, c=c)
    table = {name: np.broadcast_to(values, mu_rate.shape) for name, values in table.items()}
    return table | dict(reach=2 / scale[:, 0], stages=_STAGES)
