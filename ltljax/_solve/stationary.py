"""Stationary states: the Poisson and the screened Poisson equation, and where the rate of an equation vanishes.

What enters: a surface, and a right side or an equation with a first state. What leaves: fields, with derivatives by the
implicit function theorem.
"""

import contextlib
import warnings
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array, Float

from .._equations import Diffusion, Equation, ReactionDiffusion, boundary as bounds
from .._equations.spreads import are_numbers, spread_bound
from .._lifting.schemes import Monotone, Paper, Polynomial
from .._operators import spectral_bound
from .._surface import Surface, on_surface
from .._tables import AnyArray
from . import checks
from .direct import Factorized, factor
from .evolve import SolveError, Steady, hierarchy, solve, what_is_fixed
from .implicit import Preconditioning
from .krylov import GMRES, linear_solve, rms, unit_of
from .multigrid import Multigrid

# A right side whose mean is more than this share of its size was not meant to have none; nor one that has more than
# discretisation leaves of a mean that is none, which is at most this much over the number of vertices: 0.1 of it for
# harmonics of low degree on random points, 0.6 for waves eight vertices long, and less on better meshes.
_INCOMPATIBLE = 1e-2
_DISCRETE = 4 * np.pi
_MAX_MARCH = 500
_MAX_NEWTON = 5
_GROWN = 1e6
# Vertices up to which elimination is faster than iteration, on CPU: benchmarks/direct.md for `Monotone`. Factors of
# `Polynomial` have four times the entries and take four times as long to make; the matrix of `Paper` may be singular
# beyond constants.
_FACTORISED = {Monotone: 50_000, Polynomial: 20_000, Paper: 0}
# Of the steps in time towards a stationary state, in units of the reaction's time.
_LONGEST = 1e4
# And of the stiffness, where there is hardly a reaction.
_SLOWEST = 1e-10


class IncompatibleSourceWarning(UserWarning):
    """The right side of a Poisson equation has a mean, so that there is no solution."""


@on_surface
def poisson(
    surface: Surface,
    f: Float[AnyArray, "V *S"],
    boundary: bounds.Conditions | None = None,
    *,
    tolerance: float | None = None,
    preconditioner: Multigrid | Factorized | None = None,
    throw: bool = True,
) -> Float[Array, "V *S"]:
    """The solution of Delta u = f: second order with ``Monotone``, fourth with ``Polynomial(degree=4)``.

    Where nothing on a connected component holds or absorbs u, a solution exists only for an f without mean (in
    ``surface.mass``), and then up to a constant: the mean of f over the component is taken off, which is said if it is
    more than discretisation makes of none (``4 pi`` over the number of vertices, of the size of f, or a hundredth), and
    the u whose mean (in the vertex areas) is zero is returned.

    On CPU and up to 50,000 vertices (of ``Polynomial`` 20,000) by a factor of the matrix, made once for a surface
    (`factorized`); programs that ask it are not kept in JAX's persistent compilation cache. Otherwise by Krylov
    iteration (BiCGStab; with other schemes than ``Monotone`` then GMRES, where that fails) preconditioned by multigrid
    (the extra `amg`; without it by Jacobi's method, which takes many more iterations). Differentiable in f, the data of
    the conditions and, with a ``preconditioner``, the vertices.

    Args:
        surface: the surface.
        f: (V,) or (V, S).
        boundary: `Neumann`, `Dirichlet` or `Robin`, or several; without any the normal derivative vanishes.
        tolerance: of the residual, relative to f; by default 1e-10 for float64 and 1e-5 for float32.
        preconditioner: what `multigrid` or `factorized` returned for this surface or a similar one, where the surface
            is being traced.
        throw: whether to raise when the iteration does not converge. Inside jit nothing can be raised.

    Raises:
        SolveError: the iteration did not converge.
        ValueError: f does not fit the surface or is not finite.

    Warns:
        IncompatibleSourceWarning: f has a mean where it must have none.
    """
    return _elliptic(surface, f, 0.0, boundary, tolerance, preconditioner, throw)


@on_surface
def screened_poisson(
    surface: Surface,
    f: Float[AnyArray, "V *S"],
    screening: Float[AnyArray, "*V"] | float = 1.0,
    boundary: bounds.Conditions | None = None,
    *,
    tolerance: float | None = None,
    preconditioner: Multigrid | Factorized | None = None,
    throw: bool = True,
) -> Float[Array, "V *S"]:
    """The solution of Delta u - c u = f for a screening c > 0, a number or (V,): see `poisson`."""
    if not isinstance(screening, Tracer) and not (np.asarray(screening) > 0).all():
        raise ValueError(
            f"Expected a positive screening, found {np.asarray(screening).min()}; for none use ltl.poisson."
        )
    return _elliptic(surface, f, screening, boundary, tolerance, preconditioner, throw)


def _elliptic(surface, f, screening, boundary, tolerance, preconditioner, throw):
    f = checks.field(surface, f, "the right side")
    if not isinstance(f, Tracer) and not np.isfinite(np.asarray(f)).all():
        raise ValueError(f"The right side is not finite at vertex {np.argwhere(~np.isfinite(np.asarray(f)))[0][0]}.")
    if jnp.shape(screening) not in ((), f.shape[:1]):
        raise ValueError(
            f"Expected a screening that is a number or of shape {f.shape[:1]}, found {jnp.shape(screening)}."
        )
    equation = Diffusion(1.0, source=-f, boundary=() if boundary is None else boundary)
    if not _is_plain(equation, f):
        raise ValueError(
            "A condition for some species only belongs to a state of several species. The columns of a right side are "
            "systems of their own: solve for each of them by itself."
        )
    preconditioner = _inverse(equation, surface, f, screening) if preconditioner is None else preconditioner
    tolerance = (1e-10 if f.dtype == jnp.float64 else 1e-5) if tolerance is None else tolerance
    screening = jnp.broadcast_to(jnp.asarray(screening, f.dtype), f.shape[:1])
    start = jnp.zeros_like(f)
    time = jnp.zeros((), f.dtype)
    u, mean, size, converged, steps = _stationary(equation, surface, start, time, screening, preconditioner, tolerance)
    if not isinstance(u, Tracer):
        if said := _incompatible(surface, -mean, size):
            warnings.warn(
                f"The right side, fluxes included, has {said[0]} where nothing holds u, so that no solution exists. "
                "The equation was solved for the right side without its mean.",
                IncompatibleSourceWarning,
                stacklevel=3,
            )
        if throw and not bool(converged):
            raise SolveError(_unconverged(int(steps), preconditioner))
    return u


def _is_plain(equation: Diffusion, u: Array) -> bool:
    """Whether diffusion is a multiple of the Laplacian for every species, with the same conditions for all."""
    same = all(condition.species is None for condition in equation.conditions)
    return same and are_numbers(equation.diffusivity, u)


def _inverse(equation: Diffusion, surface: Surface, f: Array, screening: Any) -> Multigrid | Factorized | None:
    """A factor of a small system on CPU, else multigrid."""
    is_small = surface.num_vertices <= _FACTORISED[type(surface.scheme)] and jax.default_backend() == "cpu"
    fixed = None
    if is_small and not surface.is_traced and not isinstance(screening, Tracer):
        fixed = what_is_fixed(equation, surface, f, 0.0)
    if fixed is not None:
        absorption, is_held = fixed
        # One that is singular may still be solved by iteration.
        with contextlib.suppress(RuntimeError):
            return factor(surface, np.asarray(screening, np.float64) + absorption, is_held)
    return hierarchy(equation, surface, f, 0.0)


def _incompatible(surface: Surface, mean: Array, size: Array) -> tuple[str, float] | None:
    """The largest of the means (one for each component and column) that are more than discretisation leaves, in words,
    and as a share of what has it; None if there is none."""
    components = np.asarray(surface.topology.components)
    means, sizes = (np.asarray(a, np.float64).reshape(surface.topology.num_components, -1) for a in (mean, size))
    least = np.minimum(_DISCRETE / np.bincount(components), _INCOMPATIBLE)
    share = np.abs(means) / np.maximum(sizes, np.finfo(np.float64).tiny)
    component, column = np.unravel_index(np.argmax(share / least[:, None]), share.shape)
    at = (component, column)
    if not share[at] > least[component]:
        return None
    where = f" over component {component}" * (len(means) > 1) + f" in column {column}" * (means.shape[1] > 1)
    said = f"a mean of {means[at]:.3g}{where} (its root mean square there is {sizes[at]:.3g})"
    return said, float(share[at])


def _unconverged(steps: int, preconditioner: Multigrid | Factorized | None) -> str:
    if preconditioner is None:
        cure = 'Install the extra "amg" for multigrid'
    elif isinstance(preconditioner, Factorized):
        cure = "Hand in the factor of this system, raise the tolerance, or use float64"
    else:
        cure = "Raise the tolerance, or use float64"
    return f"The linear system was not solved within {steps} iterations. {cure}."


@eqx.filter_jit
def _stationary(
    equation: Diffusion, surface: Surface, start: Array, time: Array, screening: Array,
    inverse: Multigrid | Factorized | None, tolerance: Any,
) -> tuple[Array, Array, Array, Array, Array]:  # fmt: skip
    """The u with ``rate(u) = screening u``, the means taken off and the size of what has them (sources and fluxes) for
    every component and column, whether it was found, and in how many iterations."""
    start = equation.held(time, surface, start)
    trailing = (1,) * (start.ndim - 1)
    is_held = bounds.held_vertices(surface, equation.conditions)
    lost = bounds.absorption(surface, equation.conditions, time, start) + screening
    fixes = jnp.where(is_held, 1.0, jnp.abs(lost))
    diffusivities = equation.diffusivities(start)
    scale = 1.0 if inverse is None else inverse.smallest

    def rate(u):
        return equation.rate(time, surface, u) - jnp.where(is_held, 0, screening).reshape(-1, *trailing) * u

    # Constants on a component where nothing fixes u are moved to the smallest eigenvalue. The solution then has the
    # mean that a compatible right side would not give it: with m^T L = 0, scale * mean = m^T f / |m|.
    is_free = _over_components(surface, fixes, jax.ops.segment_max) <= 0

    def means(u):
        areas = surface.vertex_areas.reshape(-1, *trailing)
        total = _over_components(surface, surface.vertex_areas)
        mean = _over_components(surface, areas * u) / total.reshape(-1, *trailing)
        return jnp.where(is_free.reshape(-1, *trailing), mean, 0)

    def spread(means):
        return means[surface.topology.components] * scale * diffusivities[None]

    value, derivative = jax.linearize(rate, start)

    def apply(change):
        return spread(means(change)) - derivative(change) + jnp.where(is_held.reshape(-1, *trailing), change, 0)

    right = jnp.where(is_held.reshape(-1, *trailing), 0, value)
    flat = diffusivities.reshape(-1) if trailing else diffusivities[None]
    alpha = jnp.broadcast_to(jnp.mean(screening), flat.shape)
    is_factor = isinstance(inverse, Factorized)
    preconditioner = inverse if is_factor else Preconditioning(inverse).of(surface, alpha, flat)
    # Of high order the operator may be far from the one that preconditions it.
    persists = not isinstance(surface.scheme, Monotone)
    most = 200 if inverse is not None else 20_000
    found = linear_solve(apply, right, preconditioner, tolerance, most, persists=persists)
    constants = means(found.value)
    u = start + found.value - jnp.where(
        is_held.reshape(-1, *trailing), 0, constants[surface.topology.components]
    )  # fmt: skip
    load = rate(equation.held(time, surface, jnp.zeros_like(start)))
    # With what rounding and an unfinished iteration leave of a mean that is none.
    rounding = (1e3 * jnp.finfo(start.dtype).eps + tolerance) / _INCOMPATIBLE
    number = _over_components(surface, jnp.ones_like(surface.vertex_areas)).reshape(-1, *trailing)
    unit = unit_of(jnp.max(jnp.abs(load)))
    size = unit * jnp.sqrt(_over_components(surface, (load / unit) ** 2) / number) + rounding * rms(value)
    return (
        u,
        constants * scale * diffusivities[None],
        size,
        found.result == lx.RESULTS.successful,
        found.stats["num_steps"],
    )


def _over_components(surface: Surface, values: Array, reduce=jax.ops.segment_sum) -> Array:
    return reduce(values, surface.topology.components, num_segments=surface.topology.num_components)


@on_surface
def steady_state(
    equation: Equation,
    surface: Surface,
    u0: Float[AnyArray, "V *S"],
    method: Literal["newton", "marching"] = "newton",
    *,
    t: float = 0.0,
    tolerance: float = 1e-8,
    t1: float = 1e4,
    preconditioner: Multigrid | Factorized | None = None,
    throw: bool = True,
) -> Float[Array, "V *S"]:
    """A state at which the rate of an equation vanishes.

    `Diffusion` with numbers as diffusivities, and conditions for all species, is one linear system, solved to rounding
    whatever the tolerance; where it conserves mass (nothing holds or absorbs), the state has the mass of u0.
    Of any other equation ``"newton"`` finds a state near where u0 would go, by backward Euler steps that grow as the
    rate falls and end as Newton's (pseudo-transient continuation); ``"marching"`` lets time run with `solve` until the
    state is steady, then takes Newton's last step (for `Diffusion` the linear system). Differentiable in reverse and
    forward mode by the implicit function theorem, in everything but u0. With a diffusivity that varies and no condition
    that holds or absorbs, the state is fixed only up to a constant that u0 sets, and has no derivatives.

    Args:
        equation: the equation.
        surface: the surface.
        u0: where to start.
        method: ``"newton"`` or ``"marching"``.
        t: the time at which sources and boundary data are taken.
        tolerance: of the root mean square of the rate, relative to that of the state, per unit of time.
        t1: of ``"marching"``, the time not to run beyond.
        preconditioner: what `multigrid` (or, for `Diffusion`, `factorized`) returned for this surface or a similar one,
            where the surface is being traced.
        throw: whether to raise when no such state is found. Inside jit nothing can be raised.

    Raises:
        SolveError: no stationary state was found, or there is none.

    Warns:
        IncompatibleSourceWarning: of `Diffusion`, source and fluxes have a small mean where they must have none.

    Source: Kelley and Keyes (1998), Convergence analysis of pseudo-transient continuation,
    doi:10.1137/S0036142996304796.
    """
    u0 = checks.field(surface, u0, "u0")
    checks.finite(equation, u0)
    is_one_system = isinstance(equation, Diffusion) and _is_plain(equation, u0)
    if isinstance(preconditioner, Factorized) and not is_one_system:
        raise ValueError(
            f"A factor is that of one linear system, but this {type(equation).__name__} has many. Hand in "
            "ltl.solvers.multigrid(surface) as preconditioner."
        )
    if not tolerance > 0 or not t1 > 0:
        raise ValueError(f"Expected a positive tolerance and a positive t1, found {tolerance} and {t1}.")
    if method not in ("newton", "marching"):
        raise ValueError(f'Expected the method "newton" or "marching", found {method!r}.')
    preconditioner = hierarchy(equation, surface, u0, t) if preconditioner is None else preconditioner
    time = jnp.asarray(t, surface.dtype)
    first = u0
    if method == "marching":
        stopping = Steady(min(1e-4, 1e3 * tolerance))
        # The way there has no part in the derivative, and forward mode would not go through it.
        numbers, rest = eqx.partition((equation, surface, u0), eqx.is_inexact_array)
        still, where, u0 = eqx.combine(jax.lax.stop_gradient(numbers), rest)
        u0 = solve(still, where, u0, float(t) + t1, t0=float(t), stop_when=stopping, throw=throw).u_end
    if isinstance(equation, Diffusion) and is_one_system:
        return _steady_diffusion(equation, surface, u0, first, time, preconditioner, throw)
    u, rate, wanted, steps = _newton(equation, surface, u0, time, preconditioner, tolerance)
    if throw and not isinstance(u, Tracer) and not float(rate) <= float(wanted):
        raise SolveError(
            f"No stationary state was found: after {int(steps)} steps the rate is {float(rate):.2g}, expected at "
            f"most {float(wanted):.2g}. Causes are (a) a state that oscillates, travels or grows for ever, (b) a start "
            'too far away: try method="marching", or (c) a tolerance beyond the float type.'
        )
    return u


def _steady_diffusion(
    equation: Diffusion, surface: Surface, start: Array, u0: Array, time: Array, preconditioner, throw: bool
):
    """The stationary state, sought from a start, that has the mass of u0."""
    # The data at this time, from here on without one.
    source = equation.explicit_rate(time, surface, u0)
    still = eqx.tree_at(lambda e: e.source, equation, source, is_leaf=lambda x: x is None)
    none = jnp.zeros(surface.num_vertices, u0.dtype)
    tolerance = 1e-11 if u0.dtype == jnp.float64 else 1e-5
    u, mean, size, converged, steps = _stationary(still, surface, start, time, none, preconditioner, tolerance)
    if not isinstance(u, Tracer) and throw:
        if not bool(converged):
            raise SolveError(_unconverged(int(steps), preconditioner))
        said, share = _incompatible(surface, mean, size) or ("", 0.0)
        if share > _INCOMPATIBLE:
            raise SolveError(
                f"There is no stationary state: source and fluxes have {said} and nothing takes it away, so that u "
                "grows for ever. Take the mean off, or hold u on a boundary."
            )
        if said:
            warnings.warn(
                f"Source and fluxes have {said} and nothing takes it away, so that u grows for ever. The state is that "
                "without the mean.",
                IncompatibleSourceWarning,
                stacklevel=3,
            )
    conserved = surface.mass if isinstance(surface.scheme, Monotone) and not surface.is_traced else surface.vertex_areas
    has_conditions = any(not isinstance(condition, bounds.Neumann) for condition in equation.conditions)
    if has_conditions:
        return u
    lost = _over_components(surface, conserved.reshape(-1, *(1,) * (u.ndim - 1)) * (u0 - u))
    total = _over_components(surface, conserved).reshape(-1, *(1,) * (u.ndim - 1))
    return u + (lost / total)[surface.topology.components]


@eqx.filter_jit
def _newton(equation, surface, u0, time, multigrid, tolerance):
    preconditioning = Preconditioning(multigrid)
    u0 = equation.held(time, surface, u0)
    diffusivities = equation.diffusivities(u0)
    flat = diffusivities.reshape(-1)
    stiffness = equation.spectral_bound(time, surface, u0)
    if isinstance(equation, Diffusion | ReactionDiffusion):
        diffusion = spread_bound(surface, equation.diffusivity, equation.conditions, time, u0)
    else:
        diffusion = jnp.max(flat) * spectral_bound(surface)
    reaction = jnp.maximum(stiffness - diffusion, 0)

    is_held = bounds.held_values(surface, equation.conditions, u0)

    def rate(u):
        # What is held returns to its value, which makes the system regular and lets derivatives see the data.
        return jnp.where(is_held, equation.held(time, surface, u) - u, equation.rate(time, surface, u))

    dt0 = jax.lax.stop_gradient(1 / jnp.maximum(reaction, _SLOWEST * stiffness))

    def inverse(shift):
        alpha = jnp.broadcast_to(shift + reaction / 4, flat.shape)
        return jax.lax.stop_gradient(preconditioning.of(surface, alpha, flat))

    # Of a start at zero, what the rate there makes of it.
    least = jax.lax.stop_gradient(jnp.maximum(rms(rate(u0)) * dt0, jnp.finfo(u0.dtype).tiny))

    def march(carry):
        u, value, dt, steps = carry
        _, derivative = jax.linearize(rate, u)
        operator = lx.FunctionLinearOperator(lambda d: d / dt - derivative(d), jax.eval_shape(lambda: u))
        found = lx.linear_solve(operator, value, GMRES(1e-3, inverse(1 / dt)), throw=False)
        change = rms(found.value) / jnp.maximum(rms(u), least)
        # Steps that change the state by a tenth; one that changes it by half is taken back.
        is_good = (change < 0.5) & (found.result == lx.RESULTS.successful)
        growth = jnp.where(is_good, jnp.clip(0.1 / jnp.maximum(change, 1e-30), 0.2, 3.0), 0.2)
        proposed = jnp.where(is_good, u + found.value, u)
        # No longer than what settles all but neutral modes, such as a pattern's turning on a sphere: those would make
        # the system singular.
        return proposed, rate(proposed), jnp.minimum(dt * growth, _LONGEST * dt0), steps + 1

    def goes_on(carry):
        u, value, _, steps = carry
        return (rms(value) > tolerance * rms(u)) & (steps < _MAX_MARCH) & (rms(u) <= largest)

    # A state that grew this much, over its start or what the rate there makes of it, has no end to its growth.
    largest = _GROWN * jnp.maximum(rms(u0), least)
    frozen = jax.lax.stop_gradient((u0, rate(u0), dt0))
    u, _, _, steps = jax.lax.while_loop(goes_on, march, (*frozen, jnp.zeros((), jnp.int32)))
    u = jax.lax.stop_gradient(u)

    def residual(u, args):
        return args(u)

    exact = GMRES(1e-10 if u.dtype == jnp.float64 else 1e-5, inverse(0.0))
    goal: Any = jnp.asarray(tolerance, u.dtype)
    found = optx.root_find(
        residual,
        optx.Newton(goal, goal, optx.rms_norm, linear_solver=exact),
        u,
        eqx.filter_closure_convert(rate, u),
        max_steps=_MAX_NEWTON,
        adjoint=optx.ImplicitAdjoint(exact),
        throw=False,
    )
    # Where Newton's last steps did not help, what the march found stands; the derivative is that of the root.
    is_better = rms(rate(found.value)) <= rms(rate(u))
    best = jax.lax.stop_gradient(jnp.where(is_better, found.value, u))
    best = best + (found.value - jax.lax.stop_gradient(found.value))
    best = equation.held(time, surface, best)
    # Ten times the goal, or what rounding leaves of the rate of such a state.
    rounding = 20 * jnp.finfo(u.dtype).eps * equation.spectral_bound(time, surface, best)
    wanted = jnp.where(rms(best) <= largest, jnp.maximum(10 * tolerance, rounding) * rms(best), 0)
    return best, rms(rate(best)), wanted, steps
