"""Stabilised explicit steppers for diffusion: many cheap stages, and a step that grows with their square."""

import abc
import functools
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Damping of Sommeijer, Shampine and Verwer: the stability region keeps a strip around the negative axis.
_DAMPING = 2 / 13
# Numbers of stages on offer, about a fifth apart, so at most that much of a step is wasted; odd for RKL1, whose even
# ones do not damp the stiffest modes.
_STAGES = np.unique(np.round(np.geomspace(2, 256, 28)).astype(int))
_ODD_STAGES = np.unique(np.round(np.geomspace(3, 257, 28)).astype(int) // 2 * 2 + 1)


def bound_of_equation(t, u, args):
    """The spectral bound of the equation that is solved."""
    equation, surface = args
    return equation.spectral_bound(t, surface, u)


class _Stabilised(diffrax.AbstractAdaptiveSolver):
    """What the steppers share: a recurrence over as many stages as the length of a step needs."""

    spectral_bound: eqx.AbstractVar[Callable[..., Float[Array, ""]]]

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
        dt = t1 - t0
        table = self._coefficients()
        counts = table["stages"]
        table = {name: jnp.asarray(values, y0.dtype) for name, values in table.items()}
        stiffness = dt * self.spectral_bound(t0, y0, args)
        reach = table["reach"]
        choice = jnp.minimum(jnp.searchsorted(reach, stiffness), len(counts) - 1)
        stages = jnp.asarray(counts)[choice]
        mu, nu, mu_rate, gamma_rate, c = (table[name][choice] for name in ("mu", "nu", "mu_rate", "gamma_rate", "c"))

        # Written for the increments over y0: their rounding is relative to the step, not to the state.
        def stage(carry):
            j, before, last = carry
            rate = terms.vf(t0 + c[j - 1] * (t1 - t0), y0 + last, args)
            new = mu[j] * last + nu[j] * before + dt * (mu_rate[j] * rate + gamma_rate[j] * rate0)
            return j + 1, last, new

        first = mu_rate[1] * dt * rate0
        start = (jnp.full((), 2, stages.dtype), jnp.zeros_like(y0), first)
        _, _, increment = eqxi.while_loop(
            lambda carry: carry[0] <= stages, stage, start, max_steps=int(counts[-1]), kind="checkpointed"
        )
        y1 = y0 + increment
        rate1 = terms.vf(t1, y1, args)
        error = self._error(increment, dt, rate0, rate1)
        # Beyond the largest number of stages the step would be unstable: an adaptive controller refuses it, and without
        # one the run stops at what is not a number.
        is_stable = stiffness <= reach[-1]
        y1, error = jnp.where(is_stable, y1, jnp.nan), jnp.where(is_stable, error, jnp.inf)
        dense = dict(y0=y0, y1=y1, k0=dt * rate0, k1=dt * rate1)
        state = (rate1, evaluations + stages.astype(evaluations.dtype))
        return y1, error, dense, state, diffrax.RESULTS.successful

    def func(self, terms, t0, y0, args) -> Any:
        """The rate of change."""
        return terms.vf(t0, y0, args)


class RKC2(_Stabilised):
    """Runge-Kutta-Chebyshev of second order, explicit, adaptive, for ``u_t = f(t, u)`` with a stiff diffusion part.

    With s stages it is stable where ``dt * bound <= 0.65 (s^2 - 1)``, bound being that of the eigenvalues of f's
    derivative, which lie near the negative real axis. Each step takes the least s for its own length, so the number
    of evaluations grows with the square root of the stiffness, where an explicit method's grows with the stiffness.

    Attributes:
        spectral_bound: ``(t, y, args) -> bound``; by default that of the equation.

    Source: Sommeijer, Shampine and Verwer (1998), RKC: an explicit solver for parabolic PDEs,
    doi:10.1016/S0377-0427(97)00219-7, equations 2.1 to 2.6 (the formula), 2.10 (the error estimate).
    """

    spectral_bound: Callable[..., Float[Array, ""]] = bound_of_equation

    def order(self, terms):
        """Two."""
        return 2

    @staticmethod
    @functools.cache
    def _coefficients() -> dict[str, np.ndarray]:  # type: ignore
        rows = [_row(int(stages)) for stages in _STAGES]
        return {name: np.stack([row[name] for row in rows]) for name in rows[0]} | {"stages": _STAGES}

    def _error(self, increment, dt, rate0, rate1):
        return -0.8 * increment + 0.4 * dt * (rate0 + rate1)


class RKL1(_Stabilised):
    """Runge-Kutta-Legendre of first order: explicit, and with `Monotone` diffusion it keeps the maximum principle.

    Stable where ``dt * bound <= s^2 + s``. The error is estimated by the difference from the trapezoidal rule.

    Attributes:
        spectral_bound: ``(t, y, args) -> bound``; by default that of the equation.

    Source: Meyer, Balsara and Aslam (2014), A stabilized Runge-Kutta-Legendre method for explicit super-time-stepping
    of parabolic and mixed equations, doi:10.1016/j.jcp.2013.08.021, equations 8 to 11 (the formula), section 4 (the
    maximum principle).
    """

    spectral_bound: Callable[..., Float[Array, ""]] = bound_of_equation

    def order(self, terms):
        """One."""
        return 1

    def error_order(self, terms):
        """Two."""
        return 2

    @staticmethod
    @functools.cache
    def _coefficients() -> dict[str, np.ndarray]:  # type: ignore
        s = _ODD_STAGES[:, None]
        j = np.maximum(np.arange(s[-1, 0] + 1), 1)[None]
        table = dict(mu=(2 * j - 1) / j, nu=(1 - j) / j, mu_rate=(2 * j - 1) / j * 2 / (s**2 + s))
        table = {name: np.broadcast_to(values, (len(s), j.size)) for name, values in table.items()}
        c = np.arange(j.size)[None] * (np.arange(j.size)[None] + 1) / (s**2 + s)
        reach = (s**2 + s)[:, 0].astype(float)
        return table | dict(gamma_rate=np.zeros_like(c), c=c, reach=reach, stages=_ODD_STAGES)

    def _error(self, increment, dt, rate0, rate1):
        return 0.5 * dt * (rate0 + rate1) - increment


def _row(s: int) -> dict[str, np.ndarray]:
    w0 = 1 + _DAMPING / s**2
    # Chebyshev polynomials and their first two derivatives at w0, by the three-term recurrence.
    T, dT, ddT = np.zeros(s + 1), np.zeros(s + 1), np.zeros(s + 1)
    T[:2], dT[1] = (1, w0), 1
    for j in range(2, s + 1):
        T[j] = 2 * w0 * T[j - 1] - T[j - 2]
        dT[j] = 2 * T[j - 1] + 2 * w0 * dT[j - 1] - dT[j - 2]
        ddT[j] = 4 * dT[j - 1] + 2 * w0 * ddT[j - 1] - ddT[j - 2]
    w1 = dT[s] / ddT[s]
    b = np.zeros(s + 1)
    b[2:] = ddT[2:] / dT[2:] ** 2
    # As the code of the source has it: then the first stage stands where its time says, c[1] = mu_rate[1].
    b[:2] = b[2]
    a = 1 - b * T
    size = int(_STAGES[-1]) + 1
    mu, nu, mu_rate, gamma_rate, c = (np.zeros(size) for _ in range(5))
    mu_rate[1] = b[1] * w1
    mu[2 : s + 1] = 2 * b[2:] * w0 / b[1:-1]
    nu[2 : s + 1] = -b[2:] / b[:-2]
    mu_rate[2 : s + 1] = 2 * b[2:] * w1 / b[1:-1]
    gamma_rate[2 : s + 1] = -a[1:-1] * mu_rate[2 : s + 1]
    c[2 : s + 1] = w1 * ddT[2:] / dT[2:]
    c[1] = c[2] / (4 * w0)
    return dict(
        mu=mu, nu=nu, mu_rate=mu_rate, gamma_rate=gamma_rate, c=c,
        reach=np.array(2 / 3 * (s**2 - 1) * (1 - 2 / 15 * _DAMPING)),
    )  # fmt: skip
