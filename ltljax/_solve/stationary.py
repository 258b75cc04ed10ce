"""Stationary states: where the rate of an equation vanishes.

What enters: an equation, a surface and a state to start from. What leaves: the stationary state, with derivatives by
the implicit function theorem.
"""

import warnings
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from .._base.deprecated import renamed_arguments
from .._equations import Diffusion, Equation, boundary as bounds
from .._surface import Surface, on_surface
from .._tables import AnyArray
from . import checks
from .direct import Factorized
from .evolve import solve
from .krylov import GMRES, Preconditioner, rms
from .multigrid import Multigrid
from .poisson_equation import (
    INCOMPATIBLE,
    IncompatibleSourceWarning,
    component_means,
    excess_mean,
    is_multiple_of_laplacian,
    raise_unless_converged,
    stationary_diffusion,
)
from .preconditioning import preconditioner_for
from .solution import SolveError, Steady

_MAX_STEPS = 500
_MAX_NEWTON = 5
# A state that has grown by this factor will not become stationary.
_GROWN = 1e6
# Longest time step of the continuation, in units of the reaction's time scale.
_LONGEST = 1e4
# Slowest reaction that sets this time scale, relative to the stiffness of the whole rate.
_SLOWEST = 1e-10

Rate = Callable[[Array], Array]


@renamed_arguments(tolerance="rtol")
@on_surface
def steady_state(
    equation: Equation,
    surface: Surface,
    u0: Float[AnyArray, "V *S"],
    method: Literal["newton", "marching"] = "newton",
    *,
    t: float = 0.0,
    rtol: float = 1e-8,
    t1: float = 1e4,
    preconditioner: Multigrid | Factorized | None = None,
    throw: bool = True,
) -> Float[Array, "V *S"]:
    """A state at which the rate of an equation vanishes.

    `Diffusion` with numbers as diffusivities and the same conditions for all species is one linear system, which is
    solved to rounding for every ``rtol``. Where nothing holds or absorbs u, the state has the mass of u0.

    For any other equation, ``"newton"`` finds a state near the one that u0 evolves to: by backward Euler steps that
    grow as the rate falls and end as Newton's method (pseudo-transient continuation). ``"marching"`` integrates in time
    with `solve` until the state is steady and then takes the last step of Newton's method, or solves the linear system
    of `Diffusion`.

    The state is differentiable in both modes by the implicit function theorem, in everything but u0. With a diffusivity
    that varies and no condition that holds or absorbs, the state is determined up to a constant that u0 sets, and it
    has no derivatives.

    Args:
        equation: the equation.
        surface: the surface.
        u0: (V,) or (V, S) initial state.
        method: ``"newton"`` or ``"marching"``.
        t: time at which sources and boundary data are evaluated.
        rtol: largest root mean square of the rate relative to that of the state, per unit of time.
        t1: longest time that ``"marching"`` integrates over.
        preconditioner: result of `multigrid` (or, for `Diffusion`, of `factorized`) for this surface or a similar one.
            It is needed where the surface is being traced.
        throw: whether to raise if no such state is found. Nothing is raised inside jit.

    Raises:
        SolveError: no stationary state was found, or there is none.

    Warns:
        IncompatibleSourceWarning: source and fluxes of `Diffusion` have a small mean where they must have none.

    Source: Kelley and Keyes (1998), Convergence analysis of pseudo-transient continuation,
    doi:10.1137/S0036142996304796.
    """
    u0 = checks.field(surface, u0, "u0")
    checks.finite(equation, u0)
    is_linear = isinstance(equation, Diffusion) and is_multiple_of_laplacian(equation, u0)
    if isinstance(preconditioner, Factorized) and not is_linear:
        raise ValueError(
            f"The result of ltl.solvers.factorized solves one linear system, but this {type(equation).__name__} has "
            "many. Hand in ltl.solvers.multigrid(surface) as preconditioner."
        )
    if not rtol > 0 or not t1 > 0:
        raise ValueError(f"Expected a positive rtol and a positive t1, found {rtol} and {t1}.")
    if method not in ("newton", "marching"):
        raise ValueError(f'Expected the method "newton" or "marching", found {method!r}.')
    inverse = preconditioner_for(equation, surface, u0, t) if preconditioner is None else preconditioner
    time = jnp.asarray(t, surface.dtype)
    start = u0
    if method == "marching":
        condition = Steady(min(1e-4, 1e3 * rtol))
        # The state at the end does not depend on the path to it, so the path carries no derivatives.
        numbers, others = eqx.partition((equation, surface, u0), eqx.is_inexact_array)
        fixed_equation, fixed_surface, start = eqx.combine(jax.lax.stop_gradient(numbers), others)
        start = solve(
            fixed_equation, fixed_surface, start, float(t) + t1, t0=float(t), stop_when=condition, throw=throw
        ).u_end
    if isinstance(equation, Diffusion) and is_linear:
        return _steady_diffusion(equation, surface, start, u0, time, inverse, throw)
    root = _steady_by_newton(equation, surface, start, time, inverse, rtol)
    if throw and not isinstance(root.u, Tracer) and (bool(root.outgrew) or not float(root.rate) <= float(root.bound)):
        raise SolveError(
            f"No stationary state was found: after {int(root.steps)} steps the rate is {float(root.rate):.2g}, "
            f"expected at most {float(root.bound):.2g}. Possible causes are (a) a state that oscillates, travels or "
            'grows for ever, (b) an initial state too far away: try method="marching", or (c) an rtol below the '
            "precision of the float type."
        )
    return root.u


def _steady_diffusion(
    equation: Diffusion, surface: Surface, start: Array, u0: Array, time: Array, inverse: Preconditioner, throw: bool
) -> Array:
    """The stationary state with the mass of u0, by a linear solve that begins at ``start``."""
    # From now on the source does not depend on time.
    source = equation.explicit_rate(time, surface, u0)
    frozen = eqx.tree_at(lambda e: e.source, equation, source, is_leaf=lambda x: x is None)
    no_screening = jnp.zeros(surface.num_vertices, u0.dtype)
    rtol = 1e-11 if u0.dtype == jnp.float64 else 1e-5
    state = stationary_diffusion(frozen, surface, start, time, no_screening, inverse, rtol)
    if throw and not isinstance(state.u, Tracer):
        raise_unless_converged(state, inverse)
        words, ratio = excess_mean(surface, state.mean, state.size) or ("", 0.0)
        if ratio > INCOMPATIBLE:
            raise SolveError(
                f"There is no stationary state: source and fluxes have {words} and nothing absorbs it, so u grows for "
                "ever. Subtract the mean, or hold u on a boundary."
            )
        if words:
            warnings.warn(
                f"Source and fluxes have {words} and nothing absorbs it, so u grows for ever. The result is the "
                "stationary state without this mean.",
                IncompatibleSourceWarning,
                stacklevel=5,
            )
    if any(not isinstance(condition, bounds.Neumann) for condition in equation.conditions):
        return state.u
    return state.u + component_means(surface, u0 - state.u, surface.quadrature)[surface.topology.components]


class _Root(NamedTuple):
    """A state at which the rate nearly vanishes.

    Attributes:
        u: the state.
        rate: root mean square of the rate at it.
        bound: root mean square up to which the state counts as stationary.
        steps: number of steps of the continuation.
        outgrew: whether the continuation ended because the state had grown too large to become stationary.
    """

    u: Float[Array, "V *S"]
    rate: Float[Array, ""]
    bound: Float[Array, ""]
    steps: Int[Array, ""]
    outgrew: Bool[Array, ""]


@eqx.filter_jit
def _steady_by_newton(
    equation: Equation, surface: Surface, u0: Array, time: Array, preconditioner: Preconditioner, rtol: Any
) -> _Root:
    u0 = equation.held(time, surface, u0)
    diffusivities = equation.diffusivities(u0).reshape(-1)
    stiffness = equation.spectral_bound(time, surface, u0)
    reaction = jnp.maximum(stiffness - equation.diffusion_bound(time, surface, u0), 0)
    is_held = bounds.held_values(surface, equation.conditions, u0)

    def rate(u):
        # Held values return to their data. This makes the system regular, and the derivative sees the data.
        return jnp.where(is_held, equation.held(time, surface, u) - u, equation.rate(time, surface, u))

    def inverse(shift):
        alpha = jnp.broadcast_to(shift + reaction / 4, diffusivities.shape)
        return jax.lax.stop_gradient(preconditioner.shifted(alpha, diffusivities))

    dt0 = jax.lax.stop_gradient(1 / jnp.maximum(reaction, _SLOWEST * stiffness))
    # A start at zero has the size that the initial rate gives it within this time.
    smallest = jax.lax.stop_gradient(jnp.maximum(rms(rate(u0)) * dt0, jnp.finfo(u0.dtype).tiny))
    largest = _GROWN * jnp.maximum(rms(u0), smallest)
    u, steps = _continuation(rate, inverse, u0, dt0, smallest, largest, rtol)
    # Newton's method may lead from such a state to another one, such as zero, that u0 does not evolve to.
    outgrew = rms(u) > largest
    u = equation.held(time, surface, _newton(rate, inverse(0.0), u, rtol))
    # Rounding may leave a larger rate than the tolerance allows.
    rounding = 20 * jnp.finfo(u.dtype).eps * equation.spectral_bound(time, surface, u)
    bound = jnp.where(rms(u) <= largest, jnp.maximum(10 * rtol, rounding) * rms(u), 0)
    return _Root(u, rms(rate(u)), bound, steps, outgrew)


def _continuation(
    rate: Rate, inverse: Callable[[Array], Preconditioner], u0: Array, dt0: Array, smallest: Array, largest: Array,
    rtol: Any,
) -> tuple[Array, Array]:  # fmt: skip
    """The state after pseudo-transient continuation, without derivatives, and the number of steps.

    Args:
        rate: the rate of change.
        inverse: preconditioner of ``shift - derivative of the rate``.
        u0: initial state.
        dt0: first time step.
        smallest: size that a state near zero counts with.
        largest: size beyond which the state will not become stationary.
        rtol: rate relative to the state at which the continuation ends.
    """

    def step(carry):
        u, value, dt, steps = carry
        _, derivative = jax.linearize(rate, u)
        operator = lx.FunctionLinearOperator(lambda d: d / dt - derivative(d), jax.eval_shape(lambda: u))
        solution = lx.linear_solve(operator, value, GMRES(1e-3, inverse(1 / dt)), throw=False)
        change = rms(solution.value) / jnp.maximum(rms(u), smallest)
        # Steps are meant to change the state by a tenth. A step that changes it by half is rejected.
        is_accepted = (change < 0.5) & (solution.result == lx.RESULTS.successful)
        growth = jnp.where(is_accepted, jnp.clip(0.1 / jnp.maximum(change, 1e-30), 0.2, 3.0), 0.2)
        u = jnp.where(is_accepted, u + solution.value, u)
        # The longest step settles all but neutral modes, such as the rotation of a pattern on a sphere. Those would
        # make the system of a longer step singular.
        return u, rate(u), jnp.minimum(dt * growth, _LONGEST * dt0), steps + 1

    def goes_on(carry):
        u, value, _, steps = carry
        return (rms(value) > rtol * rms(u)) & (steps < _MAX_STEPS) & (rms(u) <= largest)

    start = jax.lax.stop_gradient((u0, rate(u0), dt0))
    u, _, _, steps = jax.lax.while_loop(goes_on, step, (*start, jnp.zeros((), jnp.int32)))
    return jax.lax.stop_gradient(u), steps


def _newton(rate: Rate, inverse: Preconditioner, u: Array, rtol: Any) -> Array:
    """The root of the rate next to u, differentiable by the implicit function theorem.

    Where Newton's method does not reduce the rate, the value is u itself; the derivative is still that of the root.
    """
    linear_solver = GMRES(1e-10 if u.dtype == jnp.float64 else 1e-5, inverse)
    tolerance: Any = jnp.asarray(rtol, u.dtype)
    root = optx.root_find(
        lambda u, rate: rate(u),
        optx.Newton(tolerance, tolerance, optx.rms_norm, linear_solver=linear_solver),
        u,
        eqx.filter_closure_convert(rate, u),
        max_steps=_MAX_NEWTON,
        adjoint=optx.ImplicitAdjoint(linear_solver),
        throw=False,
    ).value
    is_better = rms(rate(root)) <= rms(rate(u))
    value = jax.lax.stop_gradient(jnp.where(is_better, root, u))
    return value + (root - jax.lax.stop_gradient(root))
