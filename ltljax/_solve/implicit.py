"""Implicit and implicit-explicit steppers, whose stages are solved by preconditioned Krylov iteration.

What enters: the stiff part of an equation, a tableau, and `StageSettings`. What leaves: diffrax solvers. diffrax has
most of these methods itself, but its stages, and the derivatives through them, use matrices of the size of the state.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

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
from .krylov import BiCGStab, Preconditioner, linear_solve, rms, unit_of
from .preconditioning import LARGEST_RESIDUAL, StageSettings

_MAX_NEWTON = 10
# Corrections of Newton's method below this fraction of the tolerance are not solved for, because they are lost among
# rounding errors.
_NEWTON_SHARE = 1e-3


class _Newton(optx.Newton):
    """Newton's method, which ends when the next correction would be a hundredth of the tolerance.

    optimistix's own test, without its check of the residual, treats an iteration that has not converged in two steps
    as divergent.
    """

    rtol: Array | float  # type: ignore
    atol: Array | float  # type: ignore

    def terminate(self, fn, y, args, options, state, tags):
        """Whether the corrections are small enough, or a linear system could not be solved."""
        del fn, y, args, options, tags
        before = jnp.where(jnp.isfinite(state.diffsize_prev), state.diffsize_prev, 0)  # infinite at first
        rate = jnp.minimum(state.diffsize / jnp.maximum(before, 1e-30), 1)
        has_converged = (state.step >= 1) & (state.diffsize * rate < self.kappa)
        return has_converged | (state.result != optx.RESULTS.successful), state.result


class Stage(NamedTuple):
    """The equation ``scale y - factor rate(y) = b`` of a stage.

    Attributes:
        rate: ``y -> rate``.
        is_affine: whether the rate is affine in y.
        factor: coefficient of the rate.
        b: right-hand side.
        guess: initial guess of y.
        scale: coefficient of y.
    """

    rate: Callable[[Array], Array]
    is_affine: bool
    factor: Any
    b: Array
    guess: Array
    scale: Array | float = 1.0


def solve_stage(equation: Equation, surface: Surface, stage: Stage, settings: StageSettings) -> tuple[Array, Array]:
    """The solution of a stage, and whether it converged.

    One linear system if the rate is affine, else Newton's method. Differentiable by the implicit function theorem.
    """
    # In these units each species has size one, or that of the largest species if it vanishes.
    size = jnp.maximum(equation.size(stage.b), equation.size(stage.guess))
    unit = unit_of(jnp.where(size > 0, size, jnp.max(size)))[None]
    scaled = stage._replace(rate=lambda y: stage.rate(y * unit) / unit, b=stage.b / unit, guess=stage.guess / unit)
    b = scaled.b
    diffusivity = jnp.broadcast_to(equation.diffusivities(b), (b[0].size,)).astype(b.dtype)
    alpha = jnp.broadcast_to(jnp.asarray(stage.scale, b.dtype), diffusivity.shape)
    preconditioner = settings.preconditioner_of(surface, alpha, stage.factor * diffusivity)
    solve = _solve_affine if stage.is_affine else _solve_by_newton
    y, has_converged = solve(scaled, preconditioner, settings, settings.scaled_atol(unit))
    return y * unit, has_converged


def _solve_affine(
    stage: Stage, preconditioner: Preconditioner, settings: StageSettings, atol: Array
) -> tuple[Array, Array]:
    rate, _, factor, b, guess, scale = stage
    value, derivative = jax.linearize(rate, guess)
    defect = b - scale * guess + factor * value
    rtol = settings.residual_tolerance(guess, defect, atol)
    correction = linear_solve(lambda d: scale * d - factor * derivative(d), defect, preconditioner, rtol)
    return guess + correction.value, correction.result == lx.RESULTS.successful


def _solve_by_newton(
    stage: Stage, preconditioner: Preconditioner, settings: StageSettings, atol: Array
) -> tuple[Array, Array]:
    rate, _, factor, b, guess, scale = stage

    def defect(y, args):
        rate, factor, b, scale = args
        return scale * y - factor * rate(y) - b

    # The derivative of the root sees what the rate depends on only if it is passed in, not closed over.
    rate = eqx.filter_closure_convert(rate, guess)
    smallest = _NEWTON_SHARE * (jnp.sqrt(jnp.mean(atol**2)) + settings.rtol * rms(guess))
    smallest = jax.lax.stop_gradient(jnp.asarray(smallest, b.dtype))
    newton = _Newton(
        jnp.asarray(settings.rtol, b.dtype),
        jax.lax.stop_gradient(jnp.asarray(atol, b.dtype)),
        norm=optx.rms_norm,
        linear_solver=BiCGStab(jnp.asarray(LARGEST_RESIDUAL, b.dtype), preconditioner, atol=smallest),
        cauchy_termination=False,
    )
    exact = BiCGStab(1e-8 if b.dtype == jnp.float64 else 1e-5, preconditioner)
    root = optx.root_find(
        defect,
        newton,
        guess,
        (rate, factor, b, jnp.asarray(scale, b.dtype)),
        max_steps=_MAX_NEWTON,
        adjoint=optx.ImplicitAdjoint(exact),
        throw=False,
    )
    return root.value, root.result == optx.RESULTS.successful


# Compared by identity, so that the compilation cache recognises it.
@dataclasses.dataclass(frozen=True, eq=False)
class Tableau:
    """The coefficients of a diagonally implicit Runge-Kutta method with s stages, or of an implicit-explicit pair.

    Attributes:
        a: (s, s) coefficients of the implicit part, lower triangular with the diagonal.
        b: (s,) weights of the step.
        b_error: (s,) weights of the error estimate.
        c: (s,) times of the stages.
        orders: orders of the method and of the error estimate.
        explicit: ``a``, ``b`` and ``b_error`` of the explicit part, if there is one.
    """

    a: np.ndarray
    b: np.ndarray
    b_error: np.ndarray
    c: np.ndarray
    orders: tuple[int, int]
    explicit: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None


class ImplicitRungeKutta(diffrax.AbstractAdaptiveSolver):
    """A diagonally implicit Runge-Kutta method for the equations of ltljax, or an implicit-explicit one.

    A method with an explicit part splits the equation: diffusion, which is stiff and affine, is taken implicitly, and
    reactions and sources explicitly. Each stage is then one linear system. A step whose stages cannot be solved is
    rejected.

    Attributes:
        tableau: coefficients of the method.
        stages: how stages are solved; `solve` sets it.
    """

    tableau: Tableau = eqx.field(static=True)
    stages: StageSettings = StageSettings()

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms):
        """The order of the method."""
        return self.tableau.orders[0]

    def error_order(self, terms):
        """The order of the error estimate."""
        return self.tableau.orders[1]

    def init(self, terms, t0, t1, y0, args):
        """None: no state is carried from step to step."""
        del terms, t0, t1, y0, args

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step."""
        del terms, solver_state, made_jump
        equation, surface = args
        is_split = self.tableau.explicit is not None
        dt, num_stages = t1 - t0, len(self.tableau.b)
        cast = lambda values: jnp.asarray(values, y0.dtype)  # noqa: E731
        a, b, b_error, c = map(cast, (self.tableau.a, self.tableau.b, self.tableau.b_error, self.tableau.c))
        a_explicit, b_explicit, b_error_explicit = map(cast, self.tableau.explicit or (0 * a, 0 * b, 0 * b))

        def stiff(t, y):
            return equation.implicit_rate(t, surface, y) if is_split else equation.rate(t, surface, y)

        def weighted(weights, rates):
            return jnp.tensordot(weights, rates, axes=1)

        def stage(carry, i):
            rates, mild_rates, guess, is_good = carry
            t = t0 + c[i] * dt
            known = y0 + dt * (weighted(a[i], rates) + weighted(a_explicit[i], mild_rates))
            factor = dt * a[i, i]
            task = Stage(lambda y: stiff(t, y), is_split or equation.is_affine, factor, known, guess)
            y, has_converged = solve_stage(equation, surface, task, self.stages)
            rates = rates.at[i].set((y - known) / factor)
            mild_rates = mild_rates.at[i].set(equation.explicit_rate(t, surface, y)) if is_split else mild_rates
            return (rates, mild_rates, y, is_good & has_converged), None

        empty = jnp.zeros((num_stages, *y0.shape), y0.dtype)
        num_explicit = int(self.tableau.a[0, 0] == 0)
        rates = empty.at[0].set(stiff(t0, y0)) if num_explicit else empty
        mild_rates = empty.at[0].set(equation.explicit_rate(t0, surface, y0)) if is_split else empty
        carry = (rates, mild_rates, y0, jnp.array(True))
        (rates, mild_rates, _, is_good), _ = jax.lax.scan(stage, carry, jnp.arange(num_explicit, num_stages))
        y1 = y0 + dt * (weighted(b, rates) + weighted(b_explicit, mild_rates))
        error = dt * (weighted(b_error, rates) + weighted(b_error_explicit, mild_rates))
        # An adaptive controller rejects a step of infinite error; with fixed steps, the run ends at the NaN.
        y1, error = jnp.where(is_good, y1, jnp.nan), jnp.where(is_good, error, jnp.inf)
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
    """``y1 = y0 + dt f(t1, y1)``: first order and L-stable. Keeps the maximum principle with `Monotone` diffusion.

    The error is estimated by the difference from the trapezoidal rule.
    """

    tableau: Tableau = eqx.field(static=True, default=_BACKWARD_EULER)


class CrankNicolson(ImplicitRungeKutta):
    """``y1 = y0 + dt (f(t0, y0) + f(t1, y1)) / 2``: second order, A-stable but not L-stable.

    It suits fixed steps and smooth data. The error is estimated by the difference from backward Euler.
    """

    tableau: Tableau = eqx.field(static=True, default=_CRANK_NICOLSON)


class TRBDF2(ImplicitRungeKutta):
    """The trapezoidal rule for part of a step, then the second backward difference: second order and L-stable.

    Source: Hosea and Shampine (1996), Analysis and implementation of TR-BDF2, doi:10.1016/0168-9274(95)00115-8.
    """

    tableau: Tableau = eqx.field(static=True, default=_TRBDF2)


class SBDF2(diffrax.AbstractSolver):
    """The second backward difference for diffusion and extrapolation for reactions and sources: second order.

    Each step solves one linear system. Steps must be fixed. The first step has first order, which leaves the order of
    the run at two.

    Attributes:
        stages: how linear systems are solved; `solve` sets it.

    Source: Ascher, Ruuth and Wetton (1995), Implicit-explicit methods for time-dependent partial differential
    equations, doi:10.1137/0732037; with steps of changing length Wang and Ruuth (2008), J. Comput. Math. 26.
    """

    stages: StageSettings = StageSettings()

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms):
        """Two."""
        return 2

    def init(self, terms, t0, t1, y0, args):
        """The previous state, its explicit rate, and the length of the previous step: zero at first."""
        del terms, t1, args
        return y0, jnp.zeros_like(y0), jnp.zeros_like(t0)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step."""
        del terms, made_jump
        equation, surface = args
        before, mild_before, dt_before = solver_state
        dt = t1 - t0
        # The ratio of the two steps. At zero, the formula is that of forward-backward Euler, for the first step.
        has_begun = dt_before > 0
        ratio = jnp.where(has_begun, dt / jnp.where(has_begun, dt_before, 1), 0)
        mild = equation.explicit_rate(t0, surface, y0)
        known = (
            (1 + ratio) * y0
            - ratio**2 / (1 + ratio) * before
            + dt * ((1 + ratio) * mild - ratio * mild_before)
        )  # fmt: skip
        guess, scale = y0 + ratio * (y0 - before), (1 + 2 * ratio) / (1 + ratio)
        task = Stage(lambda y: equation.implicit_rate(t1, surface, y), True, dt, known, guess, scale)
        y1, has_converged = solve_stage(equation, surface, task, self.stages)
        y1 = jnp.where(has_converged, y1, jnp.nan)
        return y1, None, dict(y0=y0, y1=y1), (y0, mild, dt), diffrax.RESULTS.successful

    def func(self, terms, t0, y0, args):
        """The rate of change."""
        return terms.vf(t0, y0, args)


def _square(tableau) -> tuple[np.ndarray, np.ndarray]:
    """The matrix and the times of a tableau of diffrax."""
    size = len(tableau.b_sol)
    a = np.zeros((size, size))
    for row, values in enumerate(tableau.a_lower, start=1):
        a[row, :row] = values
    if tableau.a_diagonal is not None:
        a += np.diag(tableau.a_diagonal)
    return a, np.concatenate([[0 if tableau.c1 is None else tableau.c1], tableau.c])


def _of_diffrax(solver: Any) -> Tableau:
    """The tableau of an implicit solver of diffrax."""
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
    """The solver itself, or the matrix-free form of an implicit solver of diffrax.

    Raises:
        ValueError: the solver has no matrix-free form, or has settings that would be ignored.
    """
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
                "effect: its stages are solved by Krylov iteration. Leave them out; the accuracy follows from the rtol "
                "of ltl.solve."
            )
        return ImplicitRungeKutta(_OF_DIFFRAX[type(solver)])
    return solver
