"""The choice of a preconditioner for an equation, and the accuracy to which the stages of implicit steps are solved.

What enters: an equation and a surface, or the tolerances of a run. What leaves: a `Preconditioner`, for the stages of
implicit steps, `steady_state`, `poisson` and fairing; and tolerances of the linear systems of a stage. `krylov` defines
the interface of preconditioners.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike

from .._equations import Equation, boundary as bounds
from .._surface import Surface
from .krylov import Jacobi, Preconditioner, rms
from .multigrid import Multigrid, is_available, multigrid
from .stepping import ATOL_PER_RTOL

# Linear systems are solved to this fraction of the tolerance of a step.
_LINEAR_SHARE = 1e-2
# Largest relative residual, which also bounds the error of derivatives.
LARGEST_RESIDUAL = 1e-4


class StageSettings(eqx.Module):
    """How the stages of implicit steps are solved.

    Chebyshev polynomials were measured as an alternative to Jacobi's method and left out. On an icosphere of 10,242
    vertices they took down to a quarter of the time. On random points, where eigenvalues lie off the real axis, those
    of degree four took thousands of iterations, and milder ones (on a fifth of the interval) as long as Jacobi's.

    Attributes:
        preconditioner: preconditioner of ``-Delta``; None, outside of `solve`, for that of Jacobi.
        rtol: relative tolerance of a step.
        atol: absolute tolerance of a step; None for a hundredth of ``rtol`` times the magnitude of each species.
    """

    preconditioner: Preconditioner | None = None
    rtol: Array | float = 1e-4
    atol: Array | float | None = None

    def preconditioner_of(self, surface: Surface, alpha: Array, beta: Array) -> Preconditioner:
        """The preconditioner of ``alpha - beta Delta``, with one alpha and one beta per species."""
        preconditioner = jacobi(surface) if self.preconditioner is None else self.preconditioner
        return jax.lax.stop_gradient(preconditioner.shifted(alpha, beta))

    def scaled_atol(self, unit: Array) -> Array:
        """The absolute tolerance of each species, in the species' own unit."""
        return jnp.broadcast_to(ATOL_PER_RTOL * self.rtol if self.atol is None else self.atol / unit, unit.shape)

    def residual_tolerance(self, u: Array, b: Array, atol: Array) -> Array:
        """The relative residual tolerance of a linear system with right-hand side b for a state of the size of u."""
        error = _LINEAR_SHARE * (jnp.sqrt(jnp.mean(atol**2)) + self.rtol * rms(u))
        least, size = 20 * jnp.finfo(u.dtype).eps, rms(b)
        tolerance = jnp.clip(error / jnp.where(size > 0, size, 1), least, LARGEST_RESIDUAL)
        return jax.lax.stop_gradient(tolerance)


def jacobi(surface: Surface) -> Jacobi:
    """Jacobi's preconditioner of ``-Delta``."""
    return Jacobi(jax.lax.stop_gradient(-surface.laplacian_stencil.diagonal()[:, None]))


def preconditioner_for(equation: Equation, surface: Surface, u0: Array, t0: ArrayLike) -> Multigrid | Jacobi:
    """Multigrid under the equation's conditions where it is available, else Jacobi."""
    hierarchy = multigrid_for(equation, surface, u0, t0)
    return jacobi(surface) if hierarchy is None else hierarchy


def multigrid_for(equation: Equation, surface: Surface, u0: Array, t0: ArrayLike) -> Multigrid | None:
    """The multigrid of a surface under the equation's conditions; None if it is not available.

    It is not available if pyamg is not installed, or if the surface or the held vertices are being traced.
    """
    if surface.is_traced or not is_available():
        return None
    conditions = fixed_by_conditions(equation, surface, u0, t0)
    return None if conditions is None else multigrid(surface, *conditions)


def fixed_by_conditions(
    equation: Equation, surface: Surface, u0: Array, t0: ArrayLike
) -> tuple[np.ndarray, np.ndarray] | None:
    """The absorption (V,) by the equation's conditions and the vertices (V,) that they hold (host).

    None if the held vertices are being traced by JAX.
    """
    conditions = equation.conditions
    # Values that are not traced themselves can be computed inside jit as well.
    with jax.ensure_compile_time_eval():
        time, like = jnp.asarray(t0, surface.dtype), jnp.zeros(u0.shape, u0.dtype)
        is_held = bounds.held_vertices(surface, conditions)
        absorption = (
            bounds.absorption(surface, conditions, time, like) if conditions else jnp.zeros(surface.num_vertices)
        )
    if isinstance(is_held, Tracer):
        return None
    # A preconditioner may be inexact, so an absorption that is being traced is left out.
    absorption = np.zeros(len(is_held)) if isinstance(absorption, Tracer) else np.maximum(np.asarray(absorption), 0)
    return absorption, np.asarray(is_held)
