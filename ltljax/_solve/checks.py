"""Checks of the arguments of a run before it starts: each mistake raises one clear error (host)."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike

from .._base.arguments import as_numbers, at_least
from .._equations import Equation
from .._operators import EllipticStencil
from .._surface import Surface
from .._tables import AnyArray
from .multigrid import Multigrid
from .stabilised import Stabilised

# Number of power iterations with which the stiffest mode is estimated.
_POWER_ITERATIONS = 30


def field(surface: Surface, u: Any, name: str) -> Array:
    """A field over a surface as an array (V,) or (V, S) in the dtype of the surface.

    Raises:
        TypeError: the field is None.
        ValueError: the field does not fit the surface.
    """
    if u is None:
        raise TypeError(f"Expected {name} as real numbers, found None.")
    u = jnp.asarray(as_numbers(name, u), surface.dtype)
    state(surface, u)
    return u


def kinds(equation: Any, solver: Any, adjoint: Any, preconditioner: Any, max_steps: Any, stop_when: Any) -> None:
    """Raise an error if an argument of `solve` is of the wrong kind."""
    if not isinstance(equation, Equation):
        raise TypeError(f"Expected an equation such as ltl.Diffusion(), found {equation!r:.80}.")
    for name, value, kind, example in (
        ("solver", solver, diffrax.AbstractSolver, "ltl.RKL2()"),
        ("adjoint", adjoint, diffrax.AbstractAdjoint, "diffrax.ForwardMode()"),
    ):
        if value is not None and not isinstance(value, kind):
            description = f"the class {value.__name__}" if isinstance(value, type) else f"{value!r:.80}"
            raise TypeError(f"Expected {name} as an instance such as {example}, found {description}.")
    if preconditioner is not None and not isinstance(preconditioner, Multigrid):
        raise TypeError(
            "Expected preconditioner as the result of ltl.solvers.multigrid(surface), found "
            f"{type(preconditioner).__name__}."
        )
    if max_steps is not None:
        at_least("max_steps", max_steps, 1)
    if stop_when is not None and not callable(stop_when):
        raise TypeError(f"Expected stop_when as a function (t, u, rate) -> bool, found {stop_when!r:.80}.")


def one_number(name: str, value: Any) -> None:
    """Raise an error if a time or a step length is not a single number."""
    if value is None:
        raise TypeError(f"Expected {name} as real numbers, found None.")
    as_numbers(name, value)
    if np.ndim(value) != 0:
        raise ValueError(f"Expected {name} as one number, found an array of shape {np.shape(value)}.")


def state(surface: Surface, u0: Array) -> None:
    """Raise an error if a state does not fit the surface."""
    if u0.ndim not in (1, 2) or u0.shape[0] != surface.num_vertices:
        raise ValueError(
            f"Expected a state of shape ({surface.num_vertices},) or ({surface.num_vertices}, S), found {u0.shape}."
        )


def times(t0: ArrayLike, t1: ArrayLike, ts: AnyArray, dt: float | None) -> None:
    """Raise an error if the times of a run are not in order."""
    if dt is not None and not isinstance(dt, Tracer) and not (np.isfinite(dt) and dt > 0):
        raise ValueError(f"Expected a positive step length, found dt = {dt}.")
    if any(isinstance(value, Tracer) for value in (t0, t1, ts)):
        return
    start, end, requested = (np.asarray(value, ts.dtype) for value in (t0, t1, ts))
    if not (np.isfinite(start) and np.isfinite(end) and end >= start):
        raise ValueError(f"Expected t1 at or after t0, found t0 = {start} and t1 = {end}.")
    if requested.ndim != 1:
        raise ValueError(f"Expected ts as a list of times, found an array of shape {requested.shape}.")
    if not requested.size:
        raise ValueError("Expected at least one time in ts, found none. Leave ts out for the state at t1 alone.")
    is_bad = ~((requested >= start) & (requested <= end))
    if is_bad.any():
        first = int(np.flatnonzero(is_bad)[0])
        raise ValueError(f"Expected ts between t0 = {start} and t1 = {end}, found ts[{first}] = {requested[first]}.")
    decreases = np.flatnonzero(np.diff(requested) < 0)
    if len(decreases):
        first = int(decreases[0])
        raise ValueError(
            f"Expected ts in ascending order, found ts[{first + 1}] = {requested[first + 1]} after {requested[first]}."
        )


def tolerances(rtol: ArrayLike, atol: ArrayLike | None) -> None:
    """Raise an error if a tolerance is not positive."""
    for name, tolerance in (("rtol", rtol), ("atol", atol)):
        if tolerance is None:
            continue
        as_numbers(name, tolerance)
        if not isinstance(tolerance, Tracer) and not np.all(np.isfinite(tolerance) & (np.asarray(tolerance) > 0)):
            raise ValueError(
                f"Expected a positive tolerance, found {name} = {tolerance}: no step is exact. For fixed steps, give "
                "dt."
            )


def finite(equation: Equation, u0: Array) -> None:
    """Raise an error if the initial state or a value of the equation is not finite, or a diffusivity is negative."""
    if not isinstance(u0, Tracer):
        is_bad = ~np.isfinite(np.asarray(u0))
        if is_bad.any():
            at = np.argwhere(is_bad)[0]
            raise ValueError(f"The initial state is {np.asarray(u0)[tuple(at)]} at vertex {at[0]}.")
    for path, leaf in jax.tree_util.tree_leaves_with_path(equation):
        if isinstance(leaf, Tracer) or not isinstance(leaf, float | np.ndarray | jax.Array):
            continue
        if not np.isfinite(np.asarray(leaf)).all():
            raise ValueError(f"The equation's{jax.tree_util.keystr(path)} is not finite.")
    # `diffusivities` gives only the means of fields, so the fields are checked too. Stencils may have any sign.
    for path, leaf in jax.tree_util.tree_leaves_with_path(equation, is_leaf=lambda x: isinstance(x, EllipticStencil)):
        is_spread = any(getattr(key, "name", None) in ("diffusivity", "mobility") for key in path)
        if is_spread and isinstance(leaf, float | np.ndarray | jax.Array):
            _diffuses_forwards(leaf, f" in the equation's{jax.tree_util.keystr(path)}", u0)
    if not isinstance(u0, Tracer):
        _diffuses_forwards(equation.diffusivities(u0), "", u0)


def _diffuses_forwards(diffusivity: ArrayLike, where: str, u0: Array) -> None:
    """Raise an error if a diffusivity is negative: a number, or an array with one per species or vertex."""
    if isinstance(diffusivity, Tracer) or not (is_negative := np.asarray(diffusivity) < 0).any():
        return
    at = np.argwhere(is_negative)[0]
    is_field = is_negative.shape[:1] == u0.shape[:1]
    place = f" at {'vertex' if is_field else 'species'} {at[0]}" if at.size else ""
    raise ValueError(
        f"Expected diffusivities that are not negative, found {np.asarray(diffusivity)[tuple(at)]:g}{place}{where}: "
        "backward diffusion is ill-posed. Use 0 where nothing diffuses."
    )


def num_substeps(
    equation: Equation, surface: Surface, u0: Array, t0: ArrayLike, dt: float, solver: diffrax.AbstractSolver
) -> int:
    """The number of equal substeps of each fixed step.

    It exceeds one if a whole step of `RKL2` or `RKL1` is unstable even with the most stages, judged by the stiffest
    mode at the initial state. It is one if the stiffness is not known.

    Raises:
        ValueError: the step is too long for another explicit method.
    """
    if any(isinstance(x, Tracer) for x in jax.tree.leaves((equation, surface, u0, t0, dt))):
        return 1
    # Tracers may also be reached through closures, so results are checked for them as well.
    t0 = jnp.asarray(t0, u0.dtype)
    if isinstance(solver, Stabilised):
        longest = solver.longest_step(solver.extent(t0, u0, (equation, surface)))
        if isinstance(longest, Tracer) or not (np.isfinite(longest) and longest > 0):
            return 1
        # The margin allows for rounding of the times between substeps.
        return 1 if dt <= longest else int(np.ceil(1.02 * dt / float(longest)))
    elif isinstance(solver, diffrax.AbstractERK | diffrax.Euler):
        stiffest, width = _stiffest(equation, surface, u0, t0), equation.spectral_width(t0, surface, u0)
        if isinstance(stiffest, Tracer) or isinstance(width, Tracer):
            return 1
        longest = 1.02 * longest_step(solver, float(stiffest), float(width))
    else:
        return 1
    if dt > longest:
        raise ValueError(
            f"dt = {dt:g} is too long for {type(solver).__name__}, which is stable up to {float(longest):.2g} on "
            f"this surface. Take shorter steps, leave dt out for adaptive ones, or use ltl.RKL2() or ltl.TRBDF2()."
        )
    return 1


@eqx.filter_jit
def _power_iteration(equation: Equation, surface: Surface, u0: Array, t0: Array, v: Array) -> Array:
    def product(_, v):
        return jax.jvp(lambda u: equation.rate(t0, surface, u), (u0,), (v / jnp.linalg.norm(v),))[1]

    return jnp.linalg.norm(jax.lax.fori_loop(0, _POWER_ITERATIONS, product, v))


def _stiffest(equation: Equation, surface: Surface, u0: Array, t0: Array) -> Array:
    """A lower bound of the largest magnitude of the eigenvalues of the rate's derivative."""
    start = jnp.asarray(np.random.default_rng(0).normal(size=u0.shape), u0.dtype)
    return _power_iteration(equation, surface, u0, t0, start)


def longest_step(solver: diffrax.AbstractSolver, bound: float, width: float) -> float:
    """The longest stable step of an explicit Runge-Kutta method.

    It is stable for all eigenvalues x + iy with ``-bound <= x <= 0`` and ``y^2 <= width |x|``.
    """
    growth = _growth(solver)
    x = max(bound, 1e-30) * np.linspace(0, 1, 400)[1:]
    eigenvalues = -x + 1j * np.sqrt(width * x) * np.linspace(0, 1, 21)[:, None]
    reach = np.arange(1e-3, 50, 1e-3)
    on_axis = reach[np.argmax(np.abs(growth(-reach)) > 1 + 1e-9)]
    for length in on_axis / max(bound, 1e-30) * 0.95 ** np.arange(400):
        if np.abs(growth(length * eigenvalues)).max() <= 1 + 1e-9:
            return float(length)
    return 0.0


def _growth(solver: diffrax.AbstractSolver) -> np.polynomial.Polynomial:
    """The stability polynomial of an explicit Runge-Kutta method: the growth of exp(lambda t) in terms of lambda dt."""
    if isinstance(solver, diffrax.Euler):
        return np.polynomial.Polynomial([1, 1])
    tableau = solver.tableau  # type: ignore
    size = len(tableau.b_sol)
    a = np.zeros((size, size))
    for row, values in enumerate(tableau.a_lower, start=1):
        a[row, :row] = values
    # R(z) = 1 + z b (I - z a)^-1 1 is a polynomial because a is nilpotent.
    coefficients, powers = [1.0], np.ones(size)
    for _ in range(size):
        coefficients.append(tableau.b_sol @ powers)
        powers = a @ powers
    return np.polynomial.Polynomial(coefficients)
