"""Symmetric positive definite linear systems, by lineax's conjugate gradients with split preconditioning.

What enters: an operator A, a right-hand side b, and C with C C^T close to the inverse of A. What leaves: the solution.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Bool, Float

# lineax also bounds the size of a step, and rejects directions of small curvature. With the operator multiplied by this
# factor, which divides the solution by it, the residual alone decides.
_UNIT = 1e6


class SplitPreconditioner(NamedTuple):
    """C, where C C^T is close to the inverse of the operator.

    Attributes:
        apply: z -> C z.
        transposed: r -> C^T r.
    """

    apply: Callable[[Array], Array]
    transposed: Callable[[Array], Array]

    @classmethod
    def jacobi(cls, diagonal: Array) -> "SplitPreconditioner":
        """The inverse square root of the operator's diagonal."""
        root = jnp.sqrt(diagonal)
        return cls(lambda z: z / root, lambda r: r / root)

    def norm(self, r: Array) -> Float[Array, ""]:
        """The norm of C^T r, in which residuals are measured."""
        return jnp.sqrt(jnp.sum(self.transposed(r) ** 2))


def conjugate_gradients(
    apply: Callable[[Array], Array], b: Array, preconditioner: SplitPreconditioner, rtol: Any, max_iterations: int
) -> tuple[Array, Bool[Array, ""]]:
    """The x with ``apply(x) = b``, and whether the iteration converged.

    Solves ``C^T A C z = C^T b`` and returns ``x = C z``; stops when the residual of that system is below ``rtol``
    times its right-hand side.

    Args:
        apply: the operator, symmetric and positive definite.
        b: the right-hand side.
        preconditioner: C.
        rtol: relative residual tolerance.
        max_iterations: number of iterations after which the solve has failed.
    """

    def scaled(z: Array) -> Array:
        return preconditioner.transposed(apply(preconditioner.apply(z))) * _UNIT

    size = jnp.maximum(preconditioner.norm(b), jnp.finfo(b.dtype).tiny)
    operator = lx.FunctionLinearOperator(scaled, jax.eval_shape(lambda: b), lx.positive_semidefinite_tag)
    atol: Any = jnp.asarray(rtol, b.dtype)
    solver = lx.CG(0.0, atol, lx.internal.two_norm, stabilise_every=None, max_steps=max_iterations)
    z, result, _ = solver.compute(solver.init(operator, {}), preconditioner.transposed(b) / size, {})
    return preconditioner.apply(z) * (size * _UNIT), result == lx.RESULTS.successful
