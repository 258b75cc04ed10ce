"""Linear systems without a matrix: Krylov solvers for lineax whose preconditioners also approximate the transpose.

What enters: an operator, a right-hand side and a `Preconditioner`. What leaves: the solution, which lineax
differentiates by solving the same system, or its transpose, for another right-hand side.
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float


def unit_of(x: Array) -> Array:
    """The smallest power of two above each magnitude, and one for zero, NaN and infinity.

    Division by a power of two does not round, and it keeps squares within the range of the float type.
    """
    exponent = jnp.minimum(jnp.frexp(jax.lax.stop_gradient(jnp.abs(x)))[1], jnp.finfo(x.dtype).maxexp - 1)
    return jnp.where((x == 0) | ~jnp.isfinite(x), 1, jnp.ldexp(jnp.ones_like(x), exponent))


def rms(x: Array) -> Array:
    """The root mean square, computed without overflow or underflow for any unit of x."""
    unit = unit_of(jnp.max(jnp.abs(x)))
    return unit * jnp.sqrt(jnp.mean((x / unit) ** 2))


class Preconditioner(eqx.Module):
    """An approximate inverse of a linear operator and of its transpose.

    Attributes:
        max_iterations: number of iterations after which a solve with this preconditioner counts as failed.
    """

    max_iterations: ClassVar[int] = 200

    @abc.abstractmethod
    def __call__(self, r: Array, transposed: bool) -> Array:
        """The approximate inverse of the operator, or of its transpose, applied to r."""

    def shifted(self, alpha: Float[Array, " S"], beta: Float[Array, " S"]) -> "Preconditioner":
        """The preconditioner of ``alpha - beta Delta``, with one alpha and one beta per species.

        A preconditioner that serves a single operator returns itself.
        """
        del alpha, beta
        return self

    def null_shift(self) -> Array | float:
        """The eigenvalue that a singular system assigns to constants in order to become regular."""
        return 1.0


class Identity(Preconditioner):
    """No preconditioner."""

    def __call__(self, r, transposed):
        """r itself."""
        del transposed
        return r


class Jacobi(Preconditioner):
    """Division by the diagonal.

    Attributes:
        diagonal: (V, 1) or (V, S) diagonal of the operator. A preconditioner made for `shifted` holds the diagonal of
            -Delta.
    """

    max_iterations: ClassVar[int] = 20_000

    diagonal: Float[Array, "V S"]

    def __call__(self, r, transposed):
        """r divided by the diagonal."""
        del transposed
        return (r.reshape(len(r), -1) / self.diagonal).reshape(r.shape)

    def shifted(self, alpha, beta):
        """The Jacobi preconditioner of ``alpha - beta Delta``."""
        return Jacobi(alpha[None] + beta[None] * self.diagonal)


class KrylovSolver(lx.AbstractLinearSolver):
    """Base of the Krylov solvers: their scaling, their stopping rule and their transpose.

    A solve has converged when the root mean square of the residual is at most
    ``max(rtol * rms(right-hand side), atol)``.

    Attributes:
        rtol: relative residual tolerance.
        preconditioner: approximate inverse of the operator.
        max_iterations: number of iterations after which the solve has failed.
        atol: absolute tolerance on the root mean square of the residual.
    """

    rtol: Array | float = 1e-8
    preconditioner: Preconditioner = Identity()
    max_iterations: int = eqx.field(static=True, default=200)
    atol: Array | float = 0.0

    @abc.abstractmethod
    def iterate(
        self, operator: lx.AbstractLinearOperator, precondition: Callable[[Array], Array], b: Array, goal: Array
    ) -> tuple[Array, Array, Array]:
        """The solution, whether it has converged, and the number of iterations.

        Args:
            operator: operator of the system.
            precondition: approximate inverse of the operator.
            b: right-hand side, of magnitude one.
            goal: root mean square of the residual at which the iteration stops.
        """

    def init(self, operator, options):
        """The linearised operator, and whether it is the transpose of the one that the preconditioner was made for."""
        del options
        return lx.linearise(operator), False

    def compute(self, state, vector, options):
        """The solution, whether it has converged, and the number of iterations."""
        del options
        operator, transposed = state
        unit = unit_of(jnp.max(jnp.abs(vector)))
        b = vector / unit
        size = jnp.sqrt(jnp.mean(b**2))
        rtol, atol = jnp.asarray(self.rtol, b.dtype), jnp.asarray(self.atol, b.dtype)
        goal = jnp.maximum(rtol * jnp.where(size > 0, size, 1), atol / unit)
        x, has_converged, iterations = self.iterate(operator, lambda r: self.preconditioner(r, transposed), b, goal)
        result = lx.RESULTS.where(has_converged, lx.RESULTS.successful, lx.RESULTS.max_steps_reached)
        return x * unit, result, {"num_steps": iterations, "max_steps": self.max_iterations}

    def transpose(self, state, options):
        """The transposed operator, which the transposed preconditioner approximates."""
        operator, transposed = state
        return (operator.transpose(), not transposed), options

    def conj(self, state, options):
        """The same state, because everything is real."""
        return state, options

    def assume_full_rank(self):
        """True: callers make singular systems regular."""
        return True


class BiCGStab(KrylovSolver):
    """The stabilised biconjugate gradient method with right preconditioning.

    One pass of its loop is half an iteration. The preconditioner and the operator are therefore compiled once, whereas
    lineax's own solver compiles each of them twice.

    Source: van der Vorst (1992), Bi-CGSTAB, doi:10.1137/0913035.
    """

    def iterate(self, operator, precondition, b, goal):
        """See `KrylovSolver.iterate`."""
        tiny = jnp.finfo(b.dtype).tiny
        shadow = b

        def divide(a, b):
            return jnp.where(jnp.abs(b) > tiny, a / jnp.where(jnp.abs(b) > tiny, b, 1), 0)

        def exceeds_goal(r):
            return jnp.sqrt(jnp.mean(r**2)) > goal

        def goes_on(carry):
            (_, r, *_), passes = carry
            return exceeds_goal(r) & (passes < 2 * self.max_iterations)

        def half(carry):
            (x, r, p, v, rho, alpha), passes = carry
            is_first = passes % 2 == 0
            # The first half moves along p, the second along the residual.
            direction = jnp.where(is_first, p, r)
            y = precondition(direction)
            q = operator.mv(y)
            step = jnp.where(is_first, divide(rho, jnp.sum(shadow * q)), divide(jnp.sum(q * r), jnp.sum(q * q)))
            x, r = x + step * y, r - step * q
            v, alpha = jnp.where(is_first, q, v), jnp.where(is_first, step, alpha)
            new_rho = jnp.sum(shadow * r)
            beta = divide(new_rho, rho) * divide(alpha, step)
            p = jnp.where(is_first, p, r + beta * (p - step * v))
            return (x, r, p, v, jnp.where(is_first, rho, new_rho), alpha), passes + 1

        zero = jnp.zeros_like(b)
        start = (zero, b, b, zero, jnp.sum(shadow * b), jnp.ones((), b.dtype))
        (x, r, *_), passes = jax.lax.while_loop(goes_on, half, (start, jnp.zeros((), jnp.int32)))
        return x, ~exceeds_goal(r), (passes + 1) // 2


class GMRES(KrylovSolver):
    """lineax's GMRES with a preconditioner for the operator and its transpose: for indefinite operators.

    Its preconditioner acts from the left, so its stopping rule concerns the preconditioned residual.

    Attributes:
        restart: number of directions between restarts; the memory is as many states.
        max_iterations: number of restarts after which the solve has failed.
    """

    max_iterations: int = eqx.field(static=True, default=300)
    restart: int = eqx.field(static=True, default=60)

    def iterate(self, operator, precondition, b, goal):
        """See `KrylovSolver.iterate`."""
        # lineax detects a breakdown by an absolute threshold, which suits a right-hand side of root mean square one.
        size = jnp.sqrt(jnp.mean(b**2))
        size = jnp.where(size > 0, size, 1)
        atol: Any = goal / size
        solver = lx.GMRES(0.0, atol, rms, self.max_iterations, self.restart, self.max_iterations)
        options = {"preconditioner": lx.FunctionLinearOperator(precondition, operator.in_structure())}
        x, result, stats = solver.compute(solver.init(operator, {}), b / size, options)
        return x * size, result == lx.RESULTS.successful, jnp.asarray(stats["num_steps"], jnp.int32)


class BiCGStabThenGMRES(KrylovSolver):
    """BiCGStab, and GMRES for the systems that BiCGStab does not solve.

    It suits operators that are far from their preconditioner. GMRES takes the memory of a hundred states, and its
    number of iterations is its number of restarts.
    """

    def iterate(self, operator, precondition, b, goal):
        """See `KrylovSolver.iterate`."""
        quick = BiCGStab(max_iterations=self.max_iterations).iterate(operator, precondition, b, goal)
        gmres = GMRES(max_iterations=30, restart=100)
        return jax.lax.cond(quick[1], lambda: quick, lambda: gmres.iterate(operator, precondition, b, goal))


def linear_solve(
    apply: Callable[[Array], Array],
    b: Array,
    preconditioner: Preconditioner,
    rtol: Any,
    max_iterations: int = 200,
    *,
    persists: bool = False,
) -> lx.Solution:
    """The x with ``apply(x) = b``, differentiable in both modes in b and in everything that ``apply`` closes over.

    Args:
        apply: linear function.
        b: right-hand side.
        preconditioner: approximate inverse of ``apply``; it carries no derivatives.
        rtol: relative residual tolerance.
        max_iterations: number of iterations of BiCGStab after which it has failed.
        persists: whether GMRES is tried on a system that BiCGStab does not solve, at the memory of a hundred states.
    """
    operator = lx.FunctionLinearOperator(apply, jax.eval_shape(lambda: b))
    kind = BiCGStabThenGMRES if persists else BiCGStab
    solver: Any = kind(rtol, jax.lax.stop_gradient(preconditioner), max_iterations)
    return lx.linear_solve(operator, b, solver, throw=False)
