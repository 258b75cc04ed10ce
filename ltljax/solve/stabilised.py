"""Stabilised explicit steppers for diffusion: many cheap stages, and a step that grows with their square."""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple, cast

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

# Numbers of stages on offer, about a fifth apart, so at most that much of a step is wasted; odd, as even ones do not
# damp the stiffest modes.
STAGES = np.unique(np.round(np.geomspace(3, 257, 28)).astype(int) // 2 * 2 + 1)

FEWEST = int(STAGES[0])


def bound_of_equation(t, u, args):
    """The spectral bound of the equation that is solved."""
    equation, surface = args
    return equation.spectral_bound(t, surface, u)


class Plan(NamedTuple):
    """The stages of a step. Increments are over the state at its start, and the first is of stage one.

    Attributes:
        stages: their number.
        dt: the length of the step.
        is_stable: whether that is the length asked for.
        mu: (257 + 1,) of the last increment; entry j belongs to stage j, here and below.
        nu: of the increment before.
        mu_rate: of the rate at the last increment, over dt.
        gamma_rate: of the rate at the start, over dt.
        c: the time of stage j after the start, over dt.
    """

    stages: Int[Array, ""]
    dt: Float[Array, ""]
    is_stable: Bool[Array, ""]
    mu: Float[Array, " J"]
    nu: Float[Array, " J"]
    mu_rate: Float[Array, " J"]
    gamma_rate: Float[Array, " J"]
    c: Float[Array, " J"]

    def first(self, rate0: Array) -> Array:
        """The first increment."""
        return self.mu_rate[1] * self.dt * rate0

    def time(self, t0: ArrayLike, j: Array) -> Array:
        """When the rate is taken from which increment j is made."""
        # Beyond the last stage, where runs in a batch with longer steps get, within the step.
        return jnp.asarray(t0) + self.c[jnp.minimum(j, self.stages) - 1] * self.dt

    def stage(self, j: Array, before: Array, last: Array, rate: Array, rate0: Array) -> Array:
        """Increment j. Made of increments, its rounding is relative to the step, not to the state."""
        mu, nu, mu_rate, gamma_rate = self.coefficients(j)
        return mu * last + nu * before + self.dt * (mu_rate * rate + gamma_rate * rate0)

    def coefficients(self, j: Array) -> tuple[Array, Array, Array, Array]:
        """Those of increment j; beyond the last stage those of an increment like the last."""
        is_there, row = j <= self.stages, (self.mu[j], self.nu[j], self.mu_rate[j], self.gamma_rate[j])
        return cast(Any, tuple(jnp.where(is_there, x, rest) for x, rest in zip(row, (1, 0, 0, 0), strict=True)))


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
        plan = self.plan(self.spectral_bound(t0, y0, args), t1 - t0)

        def stage(carry):
            j, before, last = carry
            rate = terms.vf(plan.time(t0, j), y0 + last, args)
            return j + 1, last, plan.stage(j, before, last, rate, rate0)

        start = (jnp.full((), 2, plan.stages.dtype), jnp.zeros_like(y0), plan.first(rate0))
        _, _, increment = eqxi.while_loop(
            lambda carry: carry[0] <= plan.stages, stage, start, max_steps=int(STAGES[-1]), kind=self.loop_kind
        )
        y1 = y0 + increment
        rate1 = terms.vf(t1, y1, args)
        error = self._error(increment, plan.dt, rate0, rate1)
        y1, error = jnp.where(plan.is_stable, y1, jnp.nan), jnp.where(plan.is_stable, error, jnp.inf)
        dense = dict(y0=y0, y1=y1, k0=plan.dt * rate0, k1=plan.dt * rate1)
        state = (rate1, evaluations + plan.stages.astype(evaluations.dtype))
        return y1, error, dense, state, diffrax.RESULTS.successful

    def plan(self, bound: Float[Array, ""], length: ArrayLike) -> Plan:
        """The stages of a step of some length where eigenvalues are within a bound."""
        length = jnp.asarray(length)
        table = {name: jnp.asarray(values, length.dtype) for name, values in self._coefficients().items()}
        reach = table["reach"]
        # Beyond the largest number of stages a step would be unstable: an adaptive controller refuses it, and without
        # one the run stops at what is not a number. Its stages are those of the longest stable step: if they
        # overflowed, so would derivatives, whatever is made of their values.
        is_stable = length * bound <= reach[-1]
        dt = jnp.where(is_stable, length, jax.lax.stop_gradient(reach[-1] / jnp.maximum(bound, 1e-30)))
        choice = jnp.minimum(jnp.searchsorted(reach, dt * bound), len(STAGES) - 1)
        rows = {name: table[name][choice] for name in ("mu", "nu", "mu_rate", "gamma_rate", "c")}
        return Plan(jnp.asarray(STAGES)[choice], dt, is_stable, **rows)

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
        s, j = STAGES[:, None], _stage_numbers()
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
        s, j = STAGES[:, None], _stage_numbers()
        return _legendre(np.ones(j.shape), 2 / (s**2 + s), (j**2 + j) / (s**2 + s))

    def _error(self, increment, dt, rate0, rate1):
        return 0.5 * dt * (rate0 + rate1) - increment


def _stage_numbers() -> np.ndarray:
    # Entry 0 is of no stage; the one in its place keeps the formulas finite.
    return np.maximum(np.arange(STAGES[-1] + 1), 1).astype(float)


def _legendre(b: np.ndarray, scale: np.ndarray, c: np.ndarray) -> dict[str, np.ndarray]:
    """The recurrence of Legendre polynomials, stage j being 1 - b[j] + b[j] P_j(1 + scale z) of z = dt lambda."""
    j = _stage_numbers()
    before, last = np.roll(b, 2), np.roll(b, 1)
    mu, nu = (2 * j - 1) / j * b / last, (1 - j) / j * b / before
    mu_rate = mu * scale
    mu_rate[:, 1:2] = b[1] * scale
    table = dict(mu=mu, nu=nu, mu_rate=mu_rate, gamma_rate=(last - 1) * mu_rate, c=c)
    table = {name: np.broadcast_to(values, mu_rate.shape) for name, values in table.items()}
    return table | dict(reach=2 / scale[:, 0])
