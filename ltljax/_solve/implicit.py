"""Implicit and implicit-explicit steppers, whose stages are solved by preconditioned Krylov iteration.

What enters: the stiff part of an equation, a tableau, and a `Preconditioning`. What leaves: diffrax solvers. diffrax
has most of these methods itself, but solves their stages, and differentiates through them, with matrices of the size
of the state.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array

from .._equations import Equation
from .._surface import Surface
from .krylov import BiCGStab, Jacobi, Preconditioner, linear_solve, rms, unit_of
from .multigrid import Multigrid

# Linear systems are solved to this share of the tolerance of a step, Newton's iterations to the share optimistix takes.
_SHARE = 1e-2
# And at least to this relative residual, which also bounds the error of derivatives.
_LOOSEST = 1e-4
# Absolute tolerances that are not given are this share of the relative one, times the size of a species.
SHARE = 1e-2
_MAX_NEWTON = 10


class _Newton(optx.Newton):
    """Newton's method, which ends when the next correction would be a hundredth of the tolerance.

    optimistix's own test, without its look at the residual, takes whatever has not converged in two steps for diverged.
    """

    rtol: Array | float  # type: ignore
    atol: Array | float  # type: ignore

    def terminate(self, fn, y, args, options, state, tags):
        """Whether the corrections are small enough, or the linear systems could not be solved."""
        del fn, y, args, options, tags
        before = jnp.where(jnp.isfinite(state.diffsize_prev), state.diffsize_prev, 0)  # of the first there is none
        rate = jnp.minimum(state.diffsize / jnp.maximum(before, 1e-30), 1)
        has_converged = (state.step >= 1) & (state.diffsize * rate < self.kappa)
        return has_converged | (state.result != optx.RESULTS.successful), state.result


class Preconditioning(eqx.Module):
    """How stages are solved.

    Without multigrid by Jacobi's method. Chebyshev polynomials in its place were measured and left out: on an icosphere
    of 10,242 vertices they take down to a quarter of the time, but on random points, whose eigenvalues are off the real
    axis, those of degree four take thousands of iterations, and milder ones (on a fifth of the interval) as long as
    Jacobi's method.

    Attributes:
        multigrid: the hierarchy of the surface; None for Jacobi's method.
        rtol: relative tolerance of a step.
        atol: absolute tolerance of a step; None for a hundredth of ``rtol`` times the size of each species.
    """

    multigrid: Multigrid | None = None
    rtol: Array | float = 1e-4
    atol: Array | float | None = None

    def of(self, surface: Surface, alpha: Array, beta: Array) -> Preconditioner:
        """An approximate inverse of ``alpha - beta Delta``, with one alpha and one beta for every species."""
        if self.multigrid is not None:
            return self.multigrid.shifted(alpha, beta)
        return Jacobi(-surface.laplacian_stencil.diagonal()[:, None]).shifted(alpha, beta)

    def absolute(self, unit: Array) -> Array:
        """The absolute tolerance of each species, in units of their own."""
        return jnp.broadcast_to(SHARE * self.rtol if self.atol is None else self.atol / unit, unit.shape)

    def tolerance(self, u: Array, b: Array, absolute: Array) -> Array:
        """Of a linear system for a state like u with right side b, relative to b."""
        wanted = _SHARE * (jnp.sqrt(jnp.mean(absolute**2)) + self.rtol * rms(u))
        least, size = 20 * jnp.finfo(u.dtype).eps, rms(b)
        return jax.lax.stop_gradient(jnp.clip(wanted / jnp.where(size > 0, size, 1), least, _LOOSEST))


def implicit_stage(
    equation: Equation,
    rate: Callable[[Array], Array],
    is_affine: bool,
    surface: Surface,
    factor: Any,
    right: Array,
    guess: Array,
    preconditioning: Preconditioning,
    scale: Array | float = 1.0,
) -> tuple[Array, Array]:
    """The y with ``scale y - factor rate(y) = right``, and whether it was found.

    One linear system where the rate is affine, else Newton's method; differentiable by the implicit function theorem.
    """
    # In units in which every species is of size one, or as large as the others where it vanishes.
    size = jnp.maximum(equation.size(right), equation.size(guess))
    unit = unit_of(jnp.where(size > 0, size, jnp.max(size)))[None]
    y, found = _stage_in_units(
        equation, lambda y: rate(y * unit) / unit, is_affine, surface, factor, right / unit, guess / unit,
        preconditioning, preconditioning.absolute(unit), scale,
    )  # fmt: skip
    return y * unit, found


def _stage_in_units(
    equation, rate, is_affine, surface, factor, right, guess, preconditioning, absolute, scale
) -> tuple[Array, Array]:
    diffusivity = jnp.broadcast_to(equation.diffusivities(right), (right[0].size,)).astype(right.dtype)
    alpha, beta = jnp.broadcast_to(jnp.asarray(scale, right.dtype), diffusivity.shape), factor * diffusivity
    preconditioner = jax.lax.stop_gradient(preconditioning.of(surface, alpha, beta))

    if is_affine:
        value, derivative = jax.linearize(rate, guess)
        defect = right - scale * guess + factor * value
        tolerance = preconditioning.tolerance(guess, defect, absolute)
        found = linear_solve(lambda d: scale * d - factor * derivative(d), defect, preconditioner, tolerance)
        return guess + found.value, found.result == lx.RESULTS.successful

    def defect_of(y, args):
        rate, factor, right, scale = args
        return scale * y - factor * rate(y) - right

    # Closed over, what the rate depends on would be invisible to the derivative of the root.
    rate = eqx.filter_closure_convert(rate, guess)
    # Corrections below what the tolerance can see are none, or the last would be solved for among rounding errors.
    enough = 1e-3 * (jnp.sqrt(jnp.mean(absolute**2)) + preconditioning.rtol * rms(guess))
    enough = jax.lax.stop_gradient(jnp.asarray(enough, right.dtype))
    solver = BiCGStab(jnp.asarray(_LOOSEST, right.dtype), preconditioner, atol=enough)
    newton = _Newton(
        jnp.asarray(preconditioning.rtol, right.dtype),
        jax.lax.stop_gradient(jnp.asarray(absolute, right.dtype)),
        norm=optx.rms_norm,
        linear_solver=solver,
        cauchy_termination=False,
    )
    exact = BiCGStab(1e-8 if right.dtype == jnp.float64 else 1e-5, preconditioner)
    found = optx.root_find(
        defect_of,
        newton,
        guess,
        (rate, factor, right, jnp.asarray(scale, right.dtype)),
        max_steps=_MAX_NEWTON,
        adjoint=optx.ImplicitAdjoint(exact),
        throw=False,
    )
    return found.value, found.result == optx.RESULTS.successful


# Compared by identity, so that compiled code is found again.
@dataclasses.dataclass(frozen=True, eq=False)
class Tableau:
    """The coefficients of a diagonally implicit Runge-Kutta method, and of the explicit one beside it if there is one.

    Attributes:
        a: (s, s) of the implicit part, lower triangular with its diagonal.
        b: (s,) of the step.
        b_error: (s,) of the estimated error.
        c: (s,) the times.
        orders: in time, and of the estimated error.
        explicit: a, b and b_error of the explicit part.
    """

    a: np.ndarray
    b: np.ndarray
    b_error: np.ndarray
    c: np.ndarray
    orders: tuple[int, int]
    explicit: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None


class ImplicitRungeKutta(diffrax.AbstractAdaptiveSolver):
    """A diagonally implicit Runge-Kutta method for the equations of ltljax, by itself or beside an explicit one.

    With an explicit part the equation is split: what is stiff and affine (diffusion) is taken implicitly, the rest
    (reactions, sources) explicitly; each stage is then one linear system. A step whose stages cannot be solved is
    refused.

    Attributes:
        tableau: the method.
        preconditioning: how stages are solved; `solve` fills it in.
    """

    tableau: Tableau = eqx.field(static=True)
    preconditioning: Preconditioning = Preconditioning()

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms):
        """The order in time."""
        return self.tableau.orders[0]

    def error_order(self, terms):
        """The order of the estimated error."""
        return self.tableau.orders[1]

    def init(self, terms, t0, t1, y0, args):
        """Nothing is carried from step to step."""
        del terms, t0, t1, y0, args

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step."""
        del terms, solver_state, made_jump
        equation, surface = args
        is_split = self.tableau.explicit is not None
        dt, stages = t1 - t0, len(self.tableau.b)
        cast = lambda values: jnp.asarray(values, y0.dtype)  # noqa: E731
        a, b, b_error, c = map(cast, (self.tableau.a, self.tableau.b, self.tableau.b_error, self.tableau.c))
        beside = tuple(map(cast, self.tableau.explicit or (0 * a, 0 * b, 0 * b)))

        def stiff(t, y):
            return equation.implicit_rate(t, surface, y) if is_split else equation.rate(t, surface, y)

        def sum_of(weights, rates):
            return jnp.tensordot(weights, rates, axes=1)

        def stage(carry, i):
            rates, mild, guess, fine = carry
            t = t0 + c[i] * dt
            right = y0 + dt * (sum_of(a[i], rates) + sum_of(beside[0][i], mild))
            factor = dt * a[i, i]
            y, found = implicit_stage(
                equation, lambda y: stiff(t, y), is_split or equation.is_affine, surface, factor, right, guess,
                self.preconditioning,
            )  # fmt: skip
            rates = rates.at[i].set((y - right) / factor)
            mild = mild.at[i].set(equation.explicit_rate(t, surface, y)) if is_split else mild
            return (rates, mild, y, fine & found), None

        empty = jnp.zeros((stages, *y0.shape), y0.dtype)
        begins = int(self.tableau.a[0, 0] == 0)
        rates = empty.at[0].set(stiff(t0, y0)) if begins else empty
        mild = empty.at[0].set(equation.explicit_rate(t0, surface, y0)) if is_split else empty
        carry = (rates, mild, y0, jnp.array(True))
        (rates, mild, _, fine), _ = jax.lax.scan(stage, carry, jnp.arange(begins, stages))
        y1 = y0 + dt * (sum_of(b, rates) + sum_of(beside[1], mild))
        error = dt * (sum_of(b_error, rates) + sum_of(beside[2], mild))
        # An adaptive controller refuses the step; without one the run stops at what is not a number.
        y1, error = jnp.where(fine, y1, jnp.nan), jnp.where(fine, error, jnp.inf)
        return y1, error, dict(y0=y0, y1=y1), None, diffrax.RESULTS.successful

    def func(self, terms, t0, y0, args):
        """The rate of change."""
        return terms.vf(t0, y0, args)


_W, _D = np.sqrt(2) / 4, 1 - np.sqrt(2) / 2
_BACKWARD_EULER = Tableau(
    a=np.array([[0, 0], [0, 1.0]]), b=np.array([0, 1.0]), b_error=np.array([-0.5, 0.5]), c=np.array([0, 1.0]),
    orders=(1, 2),
)  # fmt: skip
_CRANK_NICOLSON = Tableau(
    a=np.array([[0, 0], [0.5, 0.5]]), b=np.array([0.5, 0.5]), b_error=np.array([0.5, -0.5]), c=np.array([0, 1.0]),
    orders=(2, 2),
)  # fmt: skip
_TRBDF2 = Tableau(
    a=np.array([[0, 0, 0], [_D, _D, 0], [_W, _W, _D]]),
    b=np.array([_W, _W, _D]),
    b_error=np.array([_W - (1 - _W) / 3, _W - (3 * _W + 1) / 3, _D - _D / 3]),
    c=np.array([0, 2 * _D, 1.0]),
    orders=(2, 3),
)


class BackwardEuler(ImplicitRungeKutta):
    """y1 = y0 + dt f(t1, y1): of first order, L-stable; with `Monotone` diffusion keeps the maximum principle.

    The error is estimated by the difference from the trapezoidal rule.
    """

    tableau: Tableau = eqx.field(static=True, default=_BACKWARD_EULER)


class CrankNicolson(ImplicitRungeKutta):
    """y1 = y0 + dt (f(t0, y0) + f(t1, y1)) / 2: of second order, A-stable but not L-stable.

    For fixed steps and smooth data. The error is estimated by the difference from backward Euler.
    """

    tableau: Tableau = eqx.field(static=True, default=_CRANK_NICOLSON)


class TRBDF2(ImplicitRungeKutta):
    """The trapezoidal rule for a part of the step, then the second backward difference: of second order, L-stable.

    Source: Hosea and Shampine (1996), Analysis and implementation of TR-BDF2, doi:10.1016/0168-9274(95)00115-8.
    """

    tableau: Tableau = eqx.field(static=True, default=_TRBDF2)


class SBDF2(diffrax.AbstractSolver):
    """The second backward difference for what is stiff, extrapolation for the rest: of second order, one system a step.

    For fixed steps. The first step is of first order, which costs no order over all.

    Attributes:
        preconditioning: how systems are solved; `solve` fills it in.

    Source: Ascher, Ruuth and Wetton (1995), Implicit-explicit methods for time-dependent partial differential
    equations, doi:10.1137/0732037; with steps of changing length Wang and Ruuth (2008), J. Comput. Math. 26.
    """

    preconditioning: Preconditioning = Preconditioning()

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms):
        """Two."""
        return 2

    def init(self, terms, t0, t1, y0, args):
        """The state before, the explicit rate there, and the length of the step from there: none yet."""
        del terms, t1, args
        return y0, jnp.zeros_like(y0), jnp.zeros_like(t0)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step."""
        del terms, made_jump
        equation, surface = args
        before, mild_before, dt_before = solver_state
        dt = t1 - t0
        # The ratio of the steps; with zero in its place the formula is the backward-forward Euler of the first step.
        has_begun = dt_before > 0
        ratio = jnp.where(has_begun, dt / jnp.where(has_begun, dt_before, 1), 0)
        mild = equation.explicit_rate(t0, surface, y0)
        right = (
            (1 + ratio) * y0
            - ratio**2 / (1 + ratio) * before
            + dt * ((1 + ratio) * mild - ratio * mild_before)
        )  # fmt: skip
        y1, fine = implicit_stage(
            equation, lambda y: equation.implicit_rate(t1, surface, y), True, surface, dt, right,
            y0 + ratio * (y0 - before), self.preconditioning, (1 + 2 * ratio) / (1 + ratio),
        )  # fmt: skip
        y1 = jnp.where(fine, y1, jnp.nan)
        return y1, None, dict(y0=y0, y1=y1), (y0, mild, dt), diffrax.RESULTS.successful

    def func(self, terms, t0, y0, args):
        """The rate of change."""
        return terms.vf(t0, y0, args)


def _square(tableau) -> tuple[np.ndarray, np.ndarray]:
    """The matrix and the times of one of diffrax's tableaus."""
    size = len(tableau.b_sol)
    a = np.zeros((size, size))
    for row, values in enumerate(tableau.a_lower, start=1):
        a[row, :row] = values
    if tableau.a_diagonal is not None:
        a += np.diag(tableau.a_diagonal)
    return a, np.concatenate([[0 if tableau.c1 is None else tableau.c1], tableau.c])


def _of_diffrax(solver: Any) -> Tableau:
    """The method of one of diffrax's implicit solvers."""
    tableaus = getattr(solver.tableau, "tableaus", (solver.tableau,))
    implicit = tableaus[-1]
    a, c = _square(implicit)
    explicit = (_square(tableaus[0])[0], tableaus[0].b_sol, tableaus[0].b_error) if len(tableaus) == 2 else None
    order = solver().order(None)
    return Tableau(a, implicit.b_sol, implicit.b_error, c, (order, order), explicit)


_OF_DIFFRAX: dict[type, Tableau] = {
    solver: _of_diffrax(solver)
    for solver in (
        diffrax.Kvaerno3, diffrax.Kvaerno4, diffrax.Kvaerno5, diffrax.KenCarp3, diffrax.KenCarp4, diffrax.KenCarp5,
        diffrax.Sil3,
    )
} | {diffrax.ImplicitEuler: _BACKWARD_EULER}  # fmt: skip


def without_matrices(solver: diffrax.AbstractSolver) -> diffrax.AbstractSolver:
    """The solver itself; in place of an implicit one of diffrax the same method with its stages solved as here."""
    if isinstance(solver, diffrax.AbstractImplicitSolver):
        if type(solver) not in _OF_DIFFRAX:
            names = ", ".join(sorted(known.__name__ for known in _OF_DIFFRAX))
            raise ValueError(
                f"{type(solver).__name__} solves its stages with a matrix of the size of the state. Expected one of "
                f"{names}, or ltl.TRBDF2, ltl.CrankNicolson, ltl.SBDF2."
            )
        if not eqx.tree_equal(solver, type(solver)()):
            raise ValueError(
                f"{type(solver).__name__} was given settings of its own, such as a root_finder, which would have no "
                "effect: its stages are solved by Krylov iteration. Leave them out; rtol of ltl.solve says how well."
            )
        return ImplicitRungeKutta(_OF_DIFFRAX[type(solver)])
    return solver
