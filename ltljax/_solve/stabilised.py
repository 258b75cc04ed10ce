"""Stabilised explicit steppers for diffusion, whose longest stable step grows with the square of their stages."""

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

# The available numbers of stages differ by about a fifth, so at most a fifth of the stages is wasted. They are odd,
# because an even number does not damp the stiffest modes.
STAGES = np.unique(np.round(np.geomspace(3, 257, 28)).astype(int) // 2 * 2 + 1)

FEWEST = int(STAGES[0])

# The available dampings. The Legendre polynomials are expanded about the point cosh(angle). The angle zero gives the
# stages of the papers, and the damping grows with the angle.
_ANGLES = np.append(0, np.geomspace(1.5 / STAGES[-1], 2.5, 17))

# A step has failed if the new rate would change the state by more than this many times its size in one more step.
_LARGEST_CHANGE = 10


def bound_of_equation(t, u, args):
    """The spectral bound of the equation."""
    equation, surface = args
    return equation.spectral_bound(t, surface, u)


def width_of_equation(t, u, args):
    """The spectral width of the equation."""
    equation, surface = args
    return equation.spectral_width(t, surface, u)


class Plan(NamedTuple):
    """The stages of a step.

    An increment is the difference of a stage state from the state at the start of the step; stage 1 gives the first.
    Entry j of a coefficient array belongs to stage j.

    Attributes:
        stages: number of stages.
        dt: length of the step.
        is_stable: whether ``dt`` is the requested length; otherwise it is the longest stable one.
        mu: (257 + 1,) coefficients of the last increment.
        nu: (257 + 1,) coefficients of the increment before.
        mu_rate: (257 + 1,) coefficients of the rate at the last increment, divided by dt.
        gamma_rate: (257 + 1,) coefficients of the rate at the start, divided by dt.
        c: (257 + 1,) times of the stages after the start, divided by dt.
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
        """The time of the rate that increment j uses."""
        # In a batch, the loop goes on beyond the last stage of a run, where times stay within its step.
        return jnp.asarray(t0) + self.c[jnp.minimum(j, self.stages) - 1] * self.dt

    def stage(self, j: Array, before: Array, last: Array, rate: Array, rate0: Array) -> Array:
        """Increment j. Its rounding error is relative to the increments, not to the state."""
        mu, nu, mu_rate, gamma_rate = self.coefficients(j)
        return mu * last + nu * before + self.dt * (mu_rate * rate + gamma_rate * rate0)

    def coefficients(self, j: Array) -> tuple[Array, Array, Array, Array]:
        """The coefficients of increment j. Beyond the last stage they repeat the last increment."""
        exists, row = j <= self.stages, (self.mu[j], self.nu[j], self.mu_rate[j], self.gamma_rate[j])
        return cast(Any, tuple(jnp.where(exists, x, rest) for x, rest in zip(row, (1, 0, 0, 0), strict=True)))


@dataclasses.dataclass(frozen=True, eq=False)
class Family:
    """The M methods to choose from: for each number of stages several, from no damping to strong damping.

    A step of length dt is stable for all eigenvalues x + iy of negative real part that satisfy
    ``dt y^2 <= parabola |x| (1 - dt |x| / reach)``.

    Attributes:
        stages: (M,) number of stages, ascending.
        level: (M,) index of the damping, of N.
        scale: (M,) factor of the rates.
        reach: (M,) extent of the stability region along the negative real axis.
        parabola: (M,) width of the stability region near the origin.
        rows: (5, N, 257 + 1) coefficients mu, nu, mu_rate, gamma_rate and c of `Plan`; the last three are divided by
            ``scale``.
    """

    stages: np.ndarray
    level: np.ndarray
    scale: np.ndarray
    reach: np.ndarray
    parabola: np.ndarray
    rows: np.ndarray

    def inverse_lengths(self, extent: Float[Array, "2"]) -> Float[Array, " M"]:
        """One over the longest stable step of each method, for a spectral bound and width."""
        bound, width = extent
        return bound / jnp.asarray(self.reach, bound.dtype) + width / jnp.asarray(self.parabola, bound.dtype)


class Stabilised(diffrax.AbstractAdaptiveSolver):
    """The base of the stabilised steppers: a recurrence over as many stages as the length of a step needs."""

    spectral_bound: eqx.AbstractVar[Callable[..., Float[Array, ""]]]
    spectral_width: eqx.AbstractVar[Callable[..., Float[Array, ""]]]
    loop_kind: eqx.AbstractVar[Literal["lax", "checkpointed", "bounded"]]

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.ThirdOrderHermitePolynomialInterpolation

    @staticmethod
    @abc.abstractmethod
    def _family() -> "Family":
        """The methods to choose from."""

    @abc.abstractmethod
    def _error(self, increment, dt, rate0, rate1) -> Array:
        """The error estimate."""

    def init(self, terms, t0, t1, y0, args):
        """The rate at the initial state, and the number of evaluations so far."""
        return terms.vf(t0, y0, args), jnp.ones((), jnp.result_type(int))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step with as many stages as its length needs."""
        del made_jump
        rate0, evaluations = solver_state
        plan = self.plan(self.extent(t0, y0, args), t1 - t0)

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
        is_good = plan.is_stable & is_sensible(plan.dt, y0, increment, rate0, rate1)
        y1, error = jnp.where(is_good, y1, jnp.nan), jnp.where(is_good, error, jnp.inf)
        dense = dict(y0=y0, y1=y1, k0=plan.dt * rate0, k1=plan.dt * rate1)
        state = (rate1, evaluations + plan.stages.astype(evaluations.dtype))
        return y1, error, dense, state, diffrax.RESULTS.successful

    def extent(self, t, y, args) -> Float[Array, "2"]:
        """The spectral bound and the spectral width of the rate's derivative."""
        bound = jnp.asarray(self.spectral_bound(t, y, args))
        return jnp.stack([bound, jnp.asarray(self.spectral_width(t, y, args), bound.dtype)])

    def plan(self, extent: Float[Array, "2"], length: ArrayLike) -> Plan:
        """The stages of a step of a given length, for a spectral bound and width."""
        length, family = jnp.asarray(length), self._family()
        inverse = family.inverse_lengths(extent)
        # If even the largest number of stages is unstable, an adaptive controller rejects the step, and fixed steps end
        # the run with NaN. The stages are then those of the longest stable step: if they overflowed, so would their
        # derivatives, although their values are not used.
        is_enough = length * inverse <= 1
        is_stable, longest = jnp.any(is_enough), jnp.argmin(inverse)
        dt = jnp.where(is_stable, length, jax.lax.stop_gradient(1 / jnp.maximum(inverse[longest], 1e-30)))
        # Methods are ordered by their stages, then by their damping, so the first stable one is the cheapest.
        choice = jnp.where(is_stable, jnp.argmax(is_enough), longest)
        stages, level = jnp.asarray(family.stages)[choice], jnp.asarray(family.level)[choice]
        scale = jnp.asarray(family.scale, length.dtype)[choice]
        mu, nu, mu_rate, gamma_rate, c = jnp.asarray(family.rows, length.dtype)[:, level]
        return Plan(stages, dt, is_stable, mu, nu, scale * mu_rate, scale * gamma_rate, scale * c)

    def longest_step(self, extent: Float[Array, "2"]) -> Float[Array, ""]:
        """The longest stable step, for a spectral bound and width."""
        return 1 / jnp.maximum(jnp.min(self._family().inverse_lengths(extent)), 1e-30)

    def func(self, terms, t0, y0, args) -> Any:
        """The rate of change."""
        return terms.vf(t0, y0, args)


def is_sensible(dt: Array, y0: Array, increment: Array, rate0: Array, rate1: Array) -> Bool[Array, ""]:
    """Whether a step is credible.

    It is not if, for some species, it changed the species by more than half of its size, increased its rate, and the
    new rate would change it by more than ten times its size in one more step. Sizes are largest magnitudes over the
    surface. An instability shows in the rate first, where the stiffest modes have the largest weight.
    """
    start, change, first, last = (jnp.max(jnp.abs(x), axis=0) for x in (y0, increment, rate0, rate1))
    grows = (last > first) & (dt * last > _LARGEST_CHANGE * (start + change))
    return ~jnp.any((start > 0) & (change > start / 2) & grows)


def differentiable(solver: diffrax.AbstractSolver, adjoint: diffrax.AbstractAdjoint) -> diffrax.AbstractSolver:
    """The solver with a loop over stages that has the same modes of differentiation as the adjoint."""
    if isinstance(solver, Stabilised) and isinstance(adjoint, diffrax.ForwardMode):
        return dataclasses.replace(solver, loop_kind="lax")
    if isinstance(solver, Stabilised) and isinstance(adjoint, diffrax.DirectAdjoint):
        return dataclasses.replace(solver, loop_kind="bounded")
    return solver


class RKL2(Stabilised):
    """The Runge-Kutta-Legendre method of second order: explicit and adaptive, for a stiff diffusion ``u_t = f(t, u)``.

    With s stages, a step is stable if ``dt * bound <= (s^2 + s - 2) / 2``, where ``bound`` is the largest magnitude of
    the eigenvalues of f's derivative, which lie near the negative real axis. Each step takes the smallest s for its
    length, so the number of evaluations grows with the square root of the stiffness; for other explicit methods it
    grows with the stiffness.

    A step halves stiff modes. They therefore do not dominate the error estimate, and eigenvalues off the real axis are
    stable too. Chebyshev polynomials reach 30 % further with s stages but have neither property. A weakly damped
    oscillation needs steps of about one over its angular frequency; longer fixed steps let it grow.

    Attributes:
        spectral_bound: ``(t, y, args) -> bound``; by default that of the equation.
        spectral_width: ``(t, y, args) -> width``; by default that of the equation.
        loop_kind: kind of the loop over stages, in equinox's terms: ``"checkpointed"`` for reverse mode, ``"lax"`` for
            forward mode. `solve` chooses it to match the adjoint.

    Source: Meyer, Balsara and Aslam (2014), A stabilized Runge-Kutta-Legendre method for explicit super-time-stepping
    of parabolic and mixed equations, doi:10.1016/j.jcp.2013.08.021, equations 14 to 18.
    """

    spectral_bound: Callable[..., Float[Array, ""]] = bound_of_equation
    spectral_width: Callable[..., Float[Array, ""]] = width_of_equation
    loop_kind: Literal["lax", "checkpointed", "bounded"] = eqx.field(default="checkpointed", static=True)

    def order(self, terms):
        """Two."""
        return 2

    @staticmethod
    @functools.cache
    def _family():  # type: ignore
        value, slope, bend = _legendre(np.cosh(_ANGLES))
        b = bend[:, 2:] / slope[:, 2:] / slope[:, 2:]
        b = np.concatenate([b[:, :1], b[:, :1], b], axis=1)
        return _family_of(b, value, slope, slope[:, STAGES] / bend[:, STAGES], narrowest=0.9)

    def _error(self, increment, dt, rate0, rate1):
        # The coefficient of the third derivative is 1/18 in the error, and 1/12 in that of the trapezoidal rule.
        return (dt * (rate0 + rate1) / 2 - increment) * 2 / 3


class RKL1(Stabilised):
    """The Runge-Kutta-Legendre method of first order: explicit and adaptive.

    For `Monotone` diffusion with symmetric rows it keeps the maximum principle. If rows are not symmetric, its stages
    are damped; then all runs on 100 random spheres stayed in the range of their start (`tests/test_stability.py`),
    which is measured and not proven.

    With s stages, a step is stable if ``dt * bound <= s^2 + s``. The error is estimated by the difference from the
    trapezoidal rule. Like every explicit method of first order, it amplifies weakly damped oscillations; use `RKL2` for
    those.

    Attributes:
        spectral_bound: ``(t, y, args) -> bound``; by default that of the equation.
        spectral_width: ``(t, y, args) -> width``; by default that of the equation.
        loop_kind: kind of the loop over stages, in equinox's terms: ``"checkpointed"`` for reverse mode, ``"lax"`` for
            forward mode. `solve` chooses it to match the adjoint.

    Source: Meyer, Balsara and Aslam (2014), doi:10.1016/j.jcp.2013.08.021, equations 8 to 11 (the method) and section 4
    (the maximum principle).
    """

    spectral_bound: Callable[..., Float[Array, ""]] = bound_of_equation
    spectral_width: Callable[..., Float[Array, ""]] = width_of_equation
    loop_kind: Literal["lax", "checkpointed", "bounded"] = eqx.field(default="checkpointed", static=True)

    def order(self, terms):
        """One."""
        return 1

    def error_order(self, terms):
        """Two."""
        return 2

    @staticmethod
    @functools.cache
    def _family():  # type: ignore
        value, slope, _ = _legendre(np.cosh(_ANGLES))
        return _family_of(1 / value, value, slope, value[:, STAGES] / slope[:, STAGES], narrowest=2.3)

    def _error(self, increment, dt, rate0, rate1):
        return 0.5 * dt * (rate0 + rate1) - increment


def _legendre(w0: np.ndarray) -> np.ndarray:
    """(3, N, 257 + 1) Legendre polynomials and their first and second derivatives at the points w0 (N,)."""
    values = np.zeros((3, len(w0), STAGES[-1] + 1))
    value, slope, bend = values
    value[:, 0], value[:, 1], slope[:, 1] = 1, w0, 1
    for j in range(2, STAGES[-1] + 1):
        for row, extra in ((value, 0), (slope, value[:, j - 1]), (bend, 2 * slope[:, j - 1])):
            row[:, j] = ((2 * j - 1) * (w0 * row[:, j - 1] + extra) - (j - 1) * row[:, j - 2]) / j
    return values


def _family_of(b: np.ndarray, value: np.ndarray, slope: np.ndarray, scale: np.ndarray, narrowest: float) -> Family:
    """The family whose stability polynomial of stage j is ``1 - b[j] P_j(w0) + b[j] P_j(w0 + scale z)``, z = dt lambda.

    Args:
        b: (N, 257 + 1) coefficients for each angle.
        value: (N, 257 + 1) Legendre polynomials P at w0, the hyperbolic cosine of the angle.
        slope: (N, 257 + 1) their derivatives at w0.
        scale: (N, 28) factor of the rates for each angle and number of stages.
        narrowest: width of the stability region without damping.
    """
    j, w0 = np.maximum(np.arange(STAGES[-1] + 1), 1.0), np.cosh(_ANGLES)[:, None]
    before, last = np.roll(b, 2, axis=1), np.roll(b, 1, axis=1)
    mu_rate, nu = (2 * j - 1) / j * b / last, (1 - j) / j * b / before
    mu = w0 * mu_rate
    mu_rate[:, 1] = b[:, 1]
    gamma_rate = (np.roll(b * value, 1, axis=1) - 1) * mu_rate
    rows = np.stack([mu, nu, mu_rate, gamma_rate, b * slope])
    # There is no stage zero, and the first stage has no stage before it.
    rows[[0, 1, 3], :, 1], rows[:, :, 0] = 0, 0
    # On the ellipse through w0 with foci -1 and 1, every |P_j| is largest at w0, so no stage grows there.
    reach = 2 * w0 / scale
    parabola = np.maximum(narrowest, (1 - 1 / w0**2) * reach)
    level, number = (axis.T.ravel() for axis in np.indices(scale.shape))
    of_member = level, number
    return Family(STAGES[number], level, scale[of_member], reach[of_member], parabola[of_member], rows)
