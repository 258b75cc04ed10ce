"""Linear systems without a matrix: BiCGStab as a lineax solver, whose preconditioner knows its own transpose.

What enters: an operator, a right side and a `Preconditioner`. What leaves: the solution, with the derivatives that
lineax gives it (the solution of the same system, or of its transpose, for another right side).
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array


def unit_of(x: Array) -> Array:
    """The power of two above a magnitude (any shape), and one in place of zero: to divide by without rounding, so that
    squares stay within the range of the float type."""
    exponent = jnp.minimum(jnp.frexp(jax.lax.stop_gradient(jnp.abs(x)))[1], jnp.finfo(x.dtype).maxexp - 1)
    return jnp.where((x == 0) | ~jnp.isfinite(x), 1, jnp.ldexp(jnp.ones_like(x), exponent))


def rms(x: Array) -> Array:
    """The root mean square, whatever the unit of x."""
    unit = unit_of(jnp.max(jnp.abs(x)))
    return unit * jnp.sqrt(jnp.mean((x / unit) ** 2))


class Preconditioner(eqx.Module):
    """An approximate inverse, and that of the transposed operator."""

    @abc.abstractmethod
    def __call__(self, r: Array, transposed: bool) -> Array:
        """What an approximate inverse of the operator (or of its transpose) makes of r."""


class Identity(Preconditioner):
    """No preconditioner."""

    def __call__(self, r, transposed):
        """r."""
        del transposed
        return r


class BiCGStab(lx.AbstractLinearSolver):
    """The stabilised biconjugate gradients, preconditioned from the right.

    Stops when the root mean square of the residual is at most ``tolerance`` times that of the right side. One pass of
    its loop is half an iteration: one application of the preconditioner and one of the operator, compiled once, where
    lineax's own has two of each.

    Attributes:
        tolerance: of the residual, relative.
        preconditioner: an approximate inverse.
        max_steps: iterations after which the solve has failed.
        absolute: a root mean square of the residual that is small enough, whatever the right side.

    Source: van der Vorst (1992), Bi-CGSTAB, doi:10.1137/0913035.
    """

    tolerance: Array | float = 1e-8
    preconditioner: Preconditioner = Identity()
    max_steps: int = eqx.field(static=True, default=200)
    absolute: Array | float = 0.0

    def init(self, operator, options):
        """The operator, which is not looked into."""
        del options
        return lx.linearise(operator), False

    def compute(self, state, vector, options):
        """The solution, whether it was found, and the number of iterations."""
        del options
        operator, transposed = state
        unit = unit_of(jnp.max(jnp.abs(vector)))
        vector = vector / unit
        size = jnp.sqrt(jnp.sum(vector**2))
        enough = jnp.asarray(self.absolute, vector.dtype) / unit * vector.size**0.5
        goal = jnp.maximum(jnp.asarray(self.tolerance, vector.dtype) * size, enough)
        tiny = jnp.finfo(vector.dtype).tiny
        shadow = vector

        def divide(a, b):
            return jnp.where(jnp.abs(b) > tiny, a / jnp.where(jnp.abs(b) > tiny, b, 1), 0)

        def goes_on(carry):
            (_, r, *_), passes = carry
            return (jnp.sqrt(jnp.sum(r**2)) > goal) & (passes < 2 * self.max_steps)

        def half(carry):
            (x, r, p, v, rho, alpha), passes = carry
            is_first = passes % 2 == 0
            # The first half goes along p, the second along what is left of the residual.
            direction = jnp.where(is_first, p, r)
            y = self.preconditioner(direction, transposed)
            q = operator.mv(y)
            along = jnp.where(is_first, divide(rho, jnp.sum(shadow * q)), divide(jnp.sum(q * r), jnp.sum(q * q)))
            x, r = x + along * y, r - along * q
            v, alpha = jnp.where(is_first, q, v), jnp.where(is_first, along, alpha)
            new_rho = jnp.sum(shadow * r)
            beta = divide(new_rho, rho) * divide(alpha, along)
            p = jnp.where(is_first, p, r + beta * (p - along * v))
            return (x, r, p, v, jnp.where(is_first, rho, new_rho), alpha), passes + 1

        zero, one = jnp.zeros_like(vector), jnp.ones((), vector.dtype)
        start = (zero, vector, vector, zero, jnp.sum(shadow * vector), one)
        (x, r, *_), passes = jax.lax.while_loop(goes_on, half, (start, jnp.zeros((), jnp.int32)))
        found = jnp.sqrt(jnp.sum(r**2)) <= goal
        result = lx.RESULTS.where(found, lx.RESULTS.successful, lx.RESULTS.max_steps_reached)
        return x * unit, result, {"num_steps": (passes + 1) // 2, "max_steps": self.max_steps}

    def transpose(self, state, options):
        """The transposed operator, for which the preconditioner is transposed too."""
        operator, transposed = state
        return (operator.transpose(), not transposed), options

    def conj(self, state, options):
        """The same: everything is real."""
        return state, options

    def assume_full_rank(self):
        """Singular systems are made regular before they come here."""
        return True


class GMRES(lx.AbstractLinearSolver):
    """lineax's GMRES with a preconditioner that knows its own transpose: for operators that are not definite.

    Attributes:
        tolerance: of the root mean square of the residual, relative to that of the right side.
        preconditioner: an approximate inverse.
        restart: directions that are kept; as many states of memory.
        max_steps: iterations after which the solve has failed.
    """

    tolerance: Array | float = 1e-8
    preconditioner: Preconditioner = Identity()
    restart: int = eqx.field(static=True, default=60)
    max_steps: int = eqx.field(static=True, default=300)

    def _inner(self, dtype) -> lx.GMRES:
        tolerance: Any = jnp.asarray(self.tolerance, dtype)
        return lx.GMRES(0.0, tolerance, rms, self.max_steps, self.restart, self.max_steps)

    def init(self, operator, options):
        """The operator, which is not looked into."""
        del options
        return lx.linearise(operator), False

    def compute(self, state, vector, options):
        """The solution, whether it was found, and the number of iterations."""
        del options
        operator, transposed = state
        size = jnp.maximum(rms(vector), jnp.finfo(vector.dtype).tiny)
        inverse = lx.FunctionLinearOperator(lambda r: self.preconditioner(r, transposed), operator.in_structure())
        inner = self._inner(vector.dtype)
        x, result, stats = inner.compute(inner.init(operator, {}), vector / size, {"preconditioner": inverse})
        return x * size, result, stats

    def transpose(self, state, options):
        """The transposed operator, for which the preconditioner is transposed too."""
        operator, transposed = state
        return (operator.transpose(), not transposed), options

    def conj(self, state, options):
        """The same: everything is real."""
        return state, options

    def assume_full_rank(self):
        """Singular systems are made regular before they come here."""
        return True


class Persistent(lx.AbstractLinearSolver):
    """BiCGStab, and where that does not converge GMRES with a long memory: for operators far from their preconditioner.

    Attributes:
        quick: what is tried.
        thorough: what is taken where that fails.
    """

    quick: BiCGStab
    thorough: GMRES

    def init(self, operator, options):
        """The operator, which is not looked into."""
        return self.quick.init(operator, options)

    def compute(self, state, vector, options):
        """The solution, whether it was found, and the number of iterations of whichever found it."""
        x, result, stats = self.quick.compute(state, vector, options)

        def again():
            x, result, stats = self.thorough.compute(state, vector, options)
            return x, result == lx.RESULTS.successful, jnp.asarray(stats["num_steps"], jnp.int32)

        found = result == lx.RESULTS.successful
        x, found, steps = jax.lax.cond(found, lambda: (x, found, stats["num_steps"].astype(jnp.int32)), again)
        result = lx.RESULTS.where(found, lx.RESULTS.successful, lx.RESULTS.max_steps_reached)
        return x, result, stats | {"num_steps": steps}

    def transpose(self, state, options):
        """The transposed operator, for which the preconditioner is transposed too."""
        return self.quick.transpose(state, options)

    def conj(self, state, options):
        """The same: everything is real."""
        return state, options

    def assume_full_rank(self):
        """Singular systems are made regular before they come here."""
        return True


def linear_solve(
    apply: Callable[[Array], Array],
    b: Array,
    preconditioner: Preconditioner,
    tolerance: Any,
    max_steps: int = 200,
    *,
    persists: bool = False,
) -> lx.Solution:
    """The x with ``apply(x) = b``, differentiable in b and in whatever ``apply`` closes over, in both modes.

    With ``persists`` a system that BiCGStab does not solve is given to GMRES, at the memory of a hundred states.
    """
    operator = lx.FunctionLinearOperator(apply, jax.eval_shape(lambda: b))
    preconditioner = jax.lax.stop_gradient(preconditioner)
    solver: Any = BiCGStab(tolerance, preconditioner, max_steps)
    if persists:
        solver = Persistent(solver, GMRES(tolerance, preconditioner, restart=100, max_steps=30))
    return lx.linear_solve(operator, b, solver, throw=False)
