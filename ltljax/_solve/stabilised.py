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

# The numbers of stages on offer are about a fifth apart, so that at most a fifth of the stages is wasted. They are odd,
# because an even number does not damp the stiffest modes.
STAGES = np.unique(np.round(np.geomspace(3, 257, 28)).astype(int) // 2 * 2 + 1)

FEWEST = int(STAGES[0])

# The damping on offer. Legendre's polynomials are taken about the point cosh(angle): at the angle zero these are the
# stages of the papers, and the larger the angle, the stronger the damping.
_ANGLES = np.append(0, np.geomspace(1.5 / STAGES[-1], 2.5, 17))

# A step has failed if the rate after it would change the state by more than so many times its size.
_LARGEST_CHANGE = 10


def bound_of_equation(t, u, args):
    """The spectral bound of the equation that is solved."""
    equation, surface = args
    return equation.spectral_bound(t, surface, u)


def width_of_equation(t, u, args):
    """The spectral width of the equation that is solved."""
    equation, surface = args
    return equation.spectral_width(t, surface, u)


class Plan(NamedTuple):
    """The stages of a step. Increments are differences from the state at its start; the first one is of stage one.

    Attributes:
        stages: the number of stages.
        dt: the length of the step.
        is_stable: whether that is the length that was asked for; if not, it is the longest stable one.
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
        # In a batch the loop goes on beyond the last stage of a run for the sake of others, with times within its step.
        return jnp.asarray(t0) + self.c[jnp.minimum(j, self.stages) - 1] * self.dt

    def stage(self, j: Array, before: Array, last: Array, rate: Array, rate0: Array) -> Array:
        """Increment j. Made of increments, its rounding is relative to the step, not to the state."""
        mu, nu, mu_rate, gamma_rate = self.coefficients(j)
        return mu * last + nu * before + self.dt * (mu_rate * rate + gamma_rate * rate0)

    def coefficients(self, j: Array) -> tuple[Array, Array, Array, Array]:
        """The coefficients of increment j; beyond the last stage those that repeat the last increment."""
        is_there, row = j <= self.stages, (self.mu[j], self.nu[j], self.mu_rate[j], self.gamma_rate[j])
        return cast(Any, tuple(jnp.where(is_there, x, rest) for x, rest in zip(row, (1, 0, 0, 0), strict=True)))


@dataclasses.dataclass(frozen=True, eq=False)
class Family:
    """The members to choose from, M in all: for each number of stages several, from no damping to much.

    The stages of a step of length dt are stable where eigenvalues x + iy, of negative real part, satisfy
    ``dt y^2 <= parabola |x| (1 - dt |x| / reach)``.

    Attributes:
        stages: (M,) the number of stages, ascending.
        level: (M,) which of the N dampings they have.
        scale: (M,) what multiplies the rates.
        reach: (M,) how far along the negative real axis they are stable.
        parabola: (M,) how wide they are stable close to the origin.
        rows: (5, N, 257 + 1) the coefficients of stage j, those of rates over ``scale``: mu, nu, mu_rate, gamma_rate
            and c as of `Plan`.
    """

    stages: np.ndarray
    level: np.ndarray
    scale: np.ndarray
    reach: np.ndarray
    parabola: np.ndarray
    rows: np.ndarray

    def inverse_lengths(self, extent: Float[Array, "2"]) -> Float[Array, " M"]:
        """One over the longest stable step of each member, where eigenvalues have such a bound and width."""
        bound, width = extent
        return bound / jnp.asarray(self.reach, bound.dtype) + width / jnp.asarray(self.parabola, bound.dtype)


class Stabilised(diffrax.AbstractAdaptiveSolver):
    """What the steppers share: a recurrence over as many stages as the length of a step needs."""

    spectral_bound: eqx.AbstractVar[Callable[..., Float[Array, ""]]]
    spectral_width: eqx.AbstractVar[Callable[..., Float[Array, ""]]]
    loop_kind: eqx.AbstractVar[Literal["lax", "checkpointed", "bounded"]]

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.ThirdOrderHermitePolynomialInterpolation

    @staticmethod
    @abc.abstractmethod
    def _family() -> "Family":
        """The stages on offer."""

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
        """How far the eigenvalues of the rate's derivative extend: their bound and their width."""
        bound = jnp.asarray(self.spectral_bound(t, y, args))
        return jnp.stack([bound, jnp.asarray(self.spectral_width(t, y, args), bound.dtype)])

    def plan(self, extent: Float[Array, "2"], length: ArrayLike) -> Plan:
        """The stages of a step of some length where eigenvalues extend so far."""
        length, family = jnp.asarray(length), self._family()
        inverse = family.inverse_lengths(extent)
        # Beyond the largest number of stages a step would be unstable: an adaptive controller refuses it, and without
        # one the run stops at what is not a number. Its stages are those of the longest stable step: if they
        # overflowed, so would derivatives, whatever is made of their values.
        is_enough = length * inverse <= 1
        is_stable, longest = jnp.any(is_enough), jnp.argmin(inverse)
        dt = jnp.where(is_stable, length, jax.lax.stop_gradient(1 / jnp.maximum(inverse[longest], 1e-30)))
        # Members are in the order of their stages, and of their damping.
        choice = jnp.where(is_stable, jnp.argmax(is_enough), longest)
        stages, level = jnp.asarray(family.stages)[choice], jnp.asarray(family.level)[choice]
        scale = jnp.asarray(family.scale, length.dtype)[choice]
        mu, nu, mu_rate, gamma_rate, c = jnp.asarray(family.rows, length.dtype)[:, level]
        return Plan(stages, dt, is_stable, mu, nu, scale * mu_rate, scale * gamma_rate, scale * c)

    def longest_step(self, extent: Float[Array, "2"]) -> Float[Array, ""]:
        """The longest stable step where eigenvalues extend so far."""
        return 1 / jnp.maximum(jnp.min(self._family().inverse_lengths(extent)), 1e-30)

    def func(self, terms, t0, y0, args) -> Any:
        """The rate of change."""
        return terms.vf(t0, y0, args)


def is_sensible(dt: Array, y0: Array, increment: Array, rate0: Array, rate1: Array) -> Bool[Array, ""]:
    """Whether a step can be believed.

    It cannot if it changed a species by more than half of its size, increased its rate, and the new rate would change
    the species in one more step by ten times its size. Sizes are largest magnitudes over the surface. What is unstable
    is seen in the rate first, where the stiffest modes weigh the most.
    """
    start, change, first, last = (jnp.max(jnp.abs(x), axis=0) for x in (y0, increment, rate0, rate1))
    grows = (last > first) & (dt * last > _LARGEST_CHANGE * (start + change))
    return ~jnp.any((start > 0) & (change > start / 2) & grows)


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
    off the axis; Chebyshev's polynomials reach 30 % further with s stages, and have neither. An oscillation that is
    hardly damped needs steps that resolve it, of about one over its angular frequency: longer fixed steps let it grow.

    Attributes:
        spectral_bound: ``(t, y, args) -> bound``; by default that of the equation.
        spectral_width: ``(t, y, args) -> width``; by default that of the equation.
        loop_kind: of the loop over stages, as equinox names them: ``"checkpointed"`` for derivatives in reverse mode,
            ``"lax"`` for forward mode; `solve` chooses it by its adjoint.

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
        # The third derivative's share in the error is 1/18, that in the trapezoidal rule's 1/12.
        return (dt * (rate0 + rate1) / 2 - increment) * 2 / 3


class RKL1(Stabilised):
    """Runge-Kutta-Legendre of first order: explicit, and monotone for `Monotone` diffusion with symmetric rows.

    There it keeps the maximum principle. Where rows are not symmetric its stages are damped, and the range of the start
    was kept in all runs on 100 random spheres (`tests/test_stability.py`), which is measured and not proven.

    Stable where ``dt * bound <= s^2 + s``. The error is estimated by the difference from the trapezoidal rule. Like
    every explicit method of first order it lets an oscillation grow that is hardly damped: take `RKL2` for those.

    Attributes:
        spectral_bound: ``(t, y, args) -> bound``; by default that of the equation.
        spectral_width: ``(t, y, args) -> width``; by default that of the equation.
        loop_kind: of the loop over stages, as equinox names them: ``"checkpointed"`` for derivatives in reverse mode,
            ``"lax"`` for forward mode; `solve` chooses it by its adjoint.

    Source: as of `RKL2`, equations 8 to 11 (the formula), section 4 (the maximum principle).
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
    """Legendre's polynomials and their first and second derivatives at some points (N,): (3, N, 257 + 1)."""
    found = np.zeros((3, len(w0), STAGES[-1] + 1))
    value, slope, bend = found
    value[:, 0], value[:, 1], slope[:, 1] = 1, w0, 1
    for j in range(2, STAGES[-1] + 1):
        for row, extra in ((value, 0), (slope, value[:, j - 1]), (bend, 2 * slope[:, j - 1])):
            row[:, j] = ((2 * j - 1) * (w0 * row[:, j - 1] + extra) - (j - 1) * row[:, j - 2]) / j
    return found


def _family_of(b: np.ndarray, value: np.ndarray, slope: np.ndarray, scale: np.ndarray, narrowest: float) -> Family:
    """The family whose stage j is 1 - b[j] P_j(w0) + b[j] P_j(w0 + scale z) of z = dt lambda.

    Args:
        b: (N, 257 + 1) at each angle.
        value: of Legendre's polynomials P at w0, the cosine of the angle; and ``slope`` of their derivatives.
        scale: (N, 28) at each angle, of each number of stages.
        narrowest: the parabola of stages without damping.
    """
    j, w0 = np.maximum(np.arange(STAGES[-1] + 1), 1.0), np.cosh(_ANGLES)[:, None]
    before, last = np.roll(b, 2, axis=1), np.roll(b, 1, axis=1)
    mu_rate, nu = (2 * j - 1) / j * b / last, (1 - j) / j * b / before
    mu = w0 * mu_rate
    mu_rate[:, 1] = b[:, 1]
    gamma_rate = (np.roll(b * value, 1, axis=1) - 1) * mu_rate
    rows = np.stack([mu, nu, mu_rate, gamma_rate, b * slope])
    # The first stage has none before it, and there is no stage zero.
    rows[[0, 1, 3], :, 1], rows[:, :, 0] = 0, 0
    # On the ellipse with the foci -1 and 1 through w0 no |P_j| is larger than at w0, so that there no stage grows.
    reach = 2 * w0 / scale
    parabola = np.maximum(narrowest, (1 - 1 / w0**2) * reach)
    level, number = (axis.T.ravel() for axis in np.indices(scale.shape))
    of_member = level, number
    return Family(STAGES[number], level, scale[of_member], reach[of_member], parabola[of_member], rows)
