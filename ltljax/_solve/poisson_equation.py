"""The Poisson and the screened Poisson equation, and the linear system behind stationary diffusion.

What enters: a surface, a right-hand side and boundary conditions. What leaves: a field, with derivatives by the
implicit function theorem.
"""

import contextlib
import warnings
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from .._base.deprecated import renamed_arguments
from .._equations import Diffusion, boundary as bounds
from .._equations.spreads import are_numbers
from .._lifting.schemes import Monotone, Paper, Polynomial
from .._surface import Surface, on_surface
from .._tables import AnyArray
from . import checks
from .direct import Factorized, factor
from .krylov import Jacobi, Preconditioner, linear_solve, rms, unit_of
from .multigrid import Multigrid
from .preconditioning import fixed_by_conditions, preconditioner_for
from .solution import SolveError

# A right-hand side whose mean exceeds this share of its root mean square is reported as incompatible.
INCOMPATIBLE = 1e-2
# So is one whose mean exceeds this number over the number of vertices: discretisation gives a right-hand side without
# mean up to 0.1 of that on random points for harmonics of low degree, up to 0.6 for waves eight vertices long, and less
# on better meshes.
_DISCRETE = 4 * np.pi
# On CPU, elimination is faster than iteration up to this number of vertices: see benchmarks/direct.md for `Monotone`.
# Factors of `Polynomial` have four times the entries and take four times as long to compute. The matrix of `Paper` may
# be singular beyond constants.
_FACTORISED = {Monotone: 50_000, Polynomial: 20_000, Paper: 0}

_REMEDIES = {
    Jacobi: 'Install the extra "amg" for multigrid',
    Factorized: "Hand in the factors of this system, raise rtol, or use float64",
}


class IncompatibleSourceWarning(UserWarning):
    """The right-hand side of a Poisson equation has a mean, so that there is no solution."""


@renamed_arguments(tolerance="rtol")
@on_surface
def poisson(
    surface: Surface,
    f: Float[AnyArray, "V *S"],
    boundary: bounds.Conditions | None = None,
    *,
    rtol: float | None = None,
    preconditioner: Multigrid | Factorized | None = None,
    throw: bool = True,
) -> Float[Array, "V *S"]:
    """The solution of Delta u = f: second order with ``Monotone``, fourth with ``Polynomial(degree=4)``.

    On a connected component where boundary conditions neither hold nor absorb u, a solution exists only if f has no
    mean (in ``surface.mass``), and it is unique up to a constant. There the mean of f is subtracted, and the solution
    whose mean (in the vertex areas) is zero is returned. A warning is issued if the mean of f, relative to its root
    mean square, exceeds a hundredth or ``4 pi`` over the number of vertices, which is what discretisation can cause.

    On CPU and up to 50,000 vertices (20,000 with ``Polynomial``) the matrix is factorised once per surface, as by
    `factorized`; programs that use the factors are not stored in JAX's persistent compilation cache. Otherwise the
    system is solved by BiCGStab preconditioned by multigrid, which needs the extra `amg`; without it Jacobi's method
    takes its place, at many more iterations. With schemes other than ``Monotone``, GMRES follows where BiCGStab fails.

    The solution is differentiable in f, in the data of the boundary conditions and, with a ``preconditioner``, in the
    vertices.

    Args:
        surface: the surface.
        f: (V,) or (V, S) right-hand side; columns are solved independently.
        boundary: `Neumann`, `Dirichlet` or `Robin` conditions, one or several. By default the normal derivative
            vanishes.
        rtol: residual tolerance relative to f; by default 1e-10 for float64 and 1e-5 for float32.
        preconditioner: result of `multigrid` or `factorized` for this surface or a similar one. It is needed where the
            surface is being traced.
        throw: whether to raise if the iteration does not converge. Nothing is raised inside jit.

    Raises:
        SolveError: the iteration did not converge.
        ValueError: f does not fit the surface or is not finite.

    Warns:
        IncompatibleSourceWarning: f has a mean where it must have none.
    """
    return _elliptic(surface, f, 0.0, boundary, rtol, preconditioner, throw)


@renamed_arguments(tolerance="rtol")
@on_surface
def screened_poisson(
    surface: Surface,
    f: Float[AnyArray, "V *S"],
    screening: Float[AnyArray, "*V"] | float = 1.0,
    boundary: bounds.Conditions | None = None,
    *,
    rtol: float | None = None,
    preconditioner: Multigrid | Factorized | None = None,
    throw: bool = True,
) -> Float[Array, "V *S"]:
    """The solution of Delta u - c u = f for a screening c > 0, a number or (V,).

    See `poisson` for the other arguments and the errors.
    """
    if not isinstance(screening, Tracer) and not (np.asarray(screening) > 0).all():
        raise ValueError(
            f"Expected a positive screening, found {np.asarray(screening).min()}. Use ltl.poisson for no screening."
        )
    return _elliptic(surface, f, screening, boundary, rtol, preconditioner, throw)


def _elliptic(surface, f, screening, boundary, rtol, preconditioner, throw):
    f, equation = _checked_equation(surface, f, screening, boundary)
    preconditioner = _inverse(equation, surface, f, screening) if preconditioner is None else preconditioner
    rtol = (1e-10 if f.dtype == jnp.float64 else 1e-5) if rtol is None else rtol
    screening = jnp.broadcast_to(jnp.asarray(screening, f.dtype), f.shape[:1])
    time = jnp.zeros((), f.dtype)
    state = stationary_diffusion(equation, surface, jnp.zeros_like(f), time, screening, preconditioner, rtol)
    if not isinstance(state.u, Tracer):
        if excess := excess_mean(surface, -state.mean, state.size):
            warnings.warn(
                f"The right-hand side, fluxes included, has {excess[0]} where nothing holds u, so no solution exists. "
                "The equation was solved for the right-hand side without its mean.",
                IncompatibleSourceWarning,
                stacklevel=5,
            )
        if throw:
            raise_unless_converged(state, preconditioner)
    return state.u


def _checked_equation(surface: Surface, f: Any, screening: Any, boundary: Any) -> tuple[Array, Diffusion]:
    """The right-hand side as an array, and ``Delta u = f`` as the stationary state of a diffusion."""
    f = checks.field(surface, f, "the right-hand side")
    if not isinstance(f, Tracer) and not np.isfinite(np.asarray(f)).all():
        first = np.argwhere(~np.isfinite(np.asarray(f)))[0][0]
        raise ValueError(f"The right-hand side is NaN or infinite at vertex {first}.")
    if jnp.shape(screening) not in ((), f.shape[:1]):
        raise ValueError(
            f"Expected a screening that is a number or of shape {f.shape[:1]}, found {jnp.shape(screening)}."
        )
    equation = Diffusion(1.0, source=-f, boundary=() if boundary is None else boundary)
    if not is_multiple_of_laplacian(equation, f):
        raise ValueError(
            "A boundary condition with species=... applies to a state of several species, but the columns of a "
            "right-hand side are independent systems. Solve each of them with a call of its own."
        )
    return f, equation


def is_multiple_of_laplacian(equation: Diffusion, u: Array) -> bool:
    """Whether every species has a number as diffusivity and all have the same boundary conditions."""
    has_common_conditions = all(condition.species is None for condition in equation.conditions)
    return has_common_conditions and are_numbers(equation.diffusivity, u)


def _inverse(equation: Diffusion, surface: Surface, f: Array, screening: Any) -> Preconditioner:
    """The factors of a small system on CPU, else an approximate inverse."""
    is_small = surface.num_vertices <= _FACTORISED[type(surface.scheme)] and jax.default_backend() == "cpu"
    fixed = None
    if is_small and not surface.is_traced and not isinstance(screening, Tracer):
        fixed = fixed_by_conditions(equation, surface, f, 0.0)
    if fixed is not None:
        absorption, is_held = fixed
        # Iteration may still solve a singular system.
        with contextlib.suppress(RuntimeError):
            return factor(surface, np.asarray(screening, np.float64) + absorption, is_held)
    return preconditioner_for(equation, surface, f, 0.0)


class LinearState(NamedTuple):
    """Stationary state of a linear diffusion, with what tells whether it exists.

    Attributes:
        u: the stationary state.
        mean: (C, *S) mean of the source over each component where nothing fixes u, else zero.
        size: (C, *S) root mean square of sources and fluxes over each component.
        has_converged: whether the linear system was solved.
        iterations: number of iterations.
    """

    u: Float[Array, "V *S"]
    mean: Float[Array, "C *S"]
    size: Float[Array, "C *S"]
    has_converged: Bool[Array, ""]
    iterations: Int[Array, ""]


@eqx.filter_jit
def stationary_diffusion(
    equation: Diffusion, surface: Surface, start: Array, time: Array, screening: Array,
    preconditioner: Preconditioner, rtol: Any,
) -> LinearState:  # fmt: skip
    """The u with ``rate(u) = screening u``, where means that have no solution are subtracted from the source."""
    start = equation.held(time, surface, start)
    column = (-1, *(1,) * (start.ndim - 1))
    is_held = bounds.held_vertices(surface, equation.conditions).reshape(column)
    absorption = bounds.absorption(surface, equation.conditions, time, start).reshape(column)
    screening = screening.reshape(column)
    diffusivities = equation.diffusivities(start)

    def rate(u):
        return equation.rate(time, surface, u) - jnp.where(is_held, 0, screening) * u

    # On a component where nothing fixes u, the eigenvalue of constants is moved from zero to `shift`. The solution then
    # has a mean exactly if the source has one: with m^T L = 0, shift * mean = m^T f / |m|.
    fixed_by = jnp.where(is_held, 1.0, jnp.abs(absorption + screening))
    is_singular = over_components(surface, fixed_by, jax.ops.segment_max) <= 0
    shift = preconditioner.null_shift() * diffusivities[None]

    def means(u):
        return jnp.where(is_singular, component_means(surface, u, surface.vertex_areas), 0)

    value, derivative = jax.linearize(rate, start)

    def apply(change):
        shifted = (means(change) * shift)[surface.topology.components]
        return shifted - derivative(change) + jnp.where(is_held, change, 0)

    beta = diffusivities.reshape(-1)
    inverse = preconditioner.shifted(jnp.broadcast_to(jnp.mean(screening), beta.shape), beta)
    # At high order the operator may be far from the one that is preconditioned.
    persists = not surface.scheme.is_monotone
    solution = linear_solve(
        apply, jnp.where(is_held, 0, value), inverse, rtol, preconditioner.max_iterations, persists=persists
    )
    constants = means(solution.value)
    u = start + solution.value - jnp.where(is_held, 0, constants[surface.topology.components])
    load = rate(equation.held(time, surface, jnp.zeros_like(start)))
    # Rounding and an unfinished iteration leave a mean in a source that has none.
    rounding = (1e3 * jnp.finfo(start.dtype).eps + rtol) / INCOMPATIBLE
    size = _component_rms(surface, load) + rounding * rms(value)
    has_converged = solution.result == lx.RESULTS.successful
    return LinearState(u, constants * shift, size, has_converged, solution.stats["num_steps"])


def over_components(surface: Surface, values: Array, reduce: Any = jax.ops.segment_sum) -> Array:
    """The sums, or other reductions, of a field over the connected components."""
    return reduce(values, surface.topology.components, num_segments=surface.topology.num_components)


def component_means(surface: Surface, u: Float[Array, "V *S"], measure: Float[Array, " V"]) -> Float[Array, "C *S"]:
    """The means of a field over the connected components in a measure."""
    measure = measure.reshape(-1, *(1,) * (u.ndim - 1))
    return over_components(surface, measure * u) / over_components(surface, measure)


def _component_rms(surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, "C *S"]:
    unit = unit_of(jnp.max(jnp.abs(u)))
    return unit * jnp.sqrt(component_means(surface, (u / unit) ** 2, jnp.ones_like(surface.vertex_areas)))


def excess_mean(surface: Surface, mean: Array, size: Array) -> tuple[str, float] | None:
    """The most excessive of the means of components and columns, in words, and its ratio to the root mean square.

    None if discretisation can have caused all of them.
    """
    components = np.asarray(surface.topology.components)
    means, sizes = (np.asarray(a, np.float64).reshape(surface.topology.num_components, -1) for a in (mean, size))
    threshold = np.minimum(_DISCRETE / np.bincount(components), INCOMPATIBLE)
    ratio = np.abs(means) / np.maximum(sizes, np.finfo(np.float64).tiny)
    component, column = np.unravel_index(np.argmax(ratio / threshold[:, None]), ratio.shape)
    worst = (component, column)
    if not ratio[worst] > threshold[component]:
        return None
    place = f" over component {component}" * (len(means) > 1) + f" in column {column}" * (means.shape[1] > 1)
    words = f"a mean of {means[worst]:.3g}{place} (its root mean square there is {sizes[worst]:.3g})"
    return words, float(ratio[worst])


def raise_unless_converged(state: LinearState, preconditioner: Preconditioner) -> None:
    """Raise if the linear system was not solved.

    Raises:
        SolveError: the linear system was not solved.
    """
    if not bool(state.has_converged):
        remedy = _REMEDIES.get(type(preconditioner), "Raise rtol, or use float64")
        raise SolveError(f"The linear system was not solved within {int(state.iterations)} iterations. {remedy}.")
