"""What is wrong with a run before it starts: each mistake one clear error (host)."""

from typing import Any

import diffrax
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
from .stabilised import Stabilised

# Products with the rate's derivative from which the stiffest mode is estimated.
_PRODUCTS = 30


def field(surface: Surface, u: Any, name: str) -> Array:
    """A field over a surface as an array (V,) or (V, S) in its float type, if it is one."""
    if u is None:
        raise TypeError(f"Expected {name} as real numbers, found None.")
    u = jnp.asarray(as_numbers(name, u), surface.dtype)
    state(surface, u)
    return u


def kinds(equation: Any, solver: Any, adjoint: Any, max_steps: Any, stop_when: Any) -> None:
    """Raise where an argument of `solve` is of the wrong kind."""
    if not isinstance(equation, Equation):
        raise TypeError(f"Expected an equation such as ltl.Diffusion(), found {equation!r:.80}.")
    for name, value, kind, example in (
        ("solver", solver, diffrax.AbstractSolver, "ltl.RKL2()"),
        ("adjoint", adjoint, diffrax.AbstractAdjoint, "diffrax.ForwardMode()"),
    ):
        if value is not None and not isinstance(value, kind):
            what = f"the class {value.__name__}" if isinstance(value, type) else f"{value!r:.80}"
            raise TypeError(f"Expected as {name} an instance such as {example}, found {what}.")
    if max_steps is not None:
        at_least("max_steps", max_steps, 1)
    if stop_when is not None and not callable(stop_when):
        raise TypeError(f"Expected stop_when as a function (t, u, rate) -> bool, found {stop_when!r:.80}.")


def one_number(name: str, value: Any) -> None:
    """Raise where a time or a length of steps is no single number."""
    if value is None:
        raise TypeError(f"Expected {name} as real numbers, found None.")
    as_numbers(name, value)
    if np.ndim(value) != 0:
        raise ValueError(f"Expected {name} as one number, found an array of shape {np.shape(value)}.")


def state(surface: Surface, u0: Array) -> None:
    """Raise where a state does not fit the surface."""
    if u0.ndim not in (1, 2) or u0.shape[0] != surface.num_vertices:
        raise ValueError(
            f"Expected a state of shape ({surface.num_vertices},) or ({surface.num_vertices}, S), found {u0.shape}."
        )


def times(t0: ArrayLike, t1: ArrayLike, ts: AnyArray, dt: float | None) -> None:
    """Raise where the times of a run are not in order."""
    if dt is not None and not isinstance(dt, Tracer) and not (np.isfinite(dt) and dt > 0):
        raise ValueError(f"Expected a positive length of steps, found dt = {dt}.")
    if any(isinstance(value, Tracer) for value in (t0, t1, ts)):
        return
    start, end, asked = (np.asarray(value, ts.dtype) for value in (t0, t1, ts))
    if not (np.isfinite(start) and np.isfinite(end) and end >= start):
        raise ValueError(f"Expected t1 at or after t0, found t0 = {start} and t1 = {end}.")
    if asked.ndim != 1:
        raise ValueError(f"Expected ts as a list of times, found an array of shape {asked.shape}.")
    if not asked.size:
        raise ValueError("Expected ts to hold at least one time, found none. Leave it out for the state at t1 alone.")
    is_bad = ~((asked >= start) & (asked <= end))
    if is_bad.any():
        first = int(np.flatnonzero(is_bad)[0])
        raise ValueError(f"Expected ts between t0 = {start} and t1 = {end}, found ts[{first}] = {asked[first]}.")
    falls = np.flatnonzero(np.diff(asked) < 0)
    if len(falls):
        first = int(falls[0])
        raise ValueError(
            f"Expected ts in ascending order, found ts[{first + 1}] = {asked[first + 1]} after {asked[first]}."
        )


def tolerances(rtol: ArrayLike, atol: ArrayLike | None) -> None:
    """Raise where tolerances are not positive."""
    for name, tolerance in (("rtol", rtol), ("atol", atol)):
        if tolerance is None:
            continue
        as_numbers(name, tolerance)
        if not isinstance(tolerance, Tracer) and not np.all(np.isfinite(tolerance) & (np.asarray(tolerance) > 0)):
            raise ValueError(
                f"Expected a positive tolerance, found {name} = {tolerance}: steps would have to be without error. For "
                "steps of a length of your own give dt."
            )


def finite(equation: Equation, u0: Array) -> None:
    """Raise where the initial state or the numbers of an equation are not finite, or a diffusivity is negative."""
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
    # Fields too, whose mean is what `diffusivities` says; stencils have signs of their own.
    for path, leaf in jax.tree_util.tree_leaves_with_path(equation, is_leaf=lambda x: isinstance(x, EllipticStencil)):
        is_spread = any(getattr(key, "name", None) in ("diffusivity", "mobility") for key in path)
        if is_spread and isinstance(leaf, float | np.ndarray | jax.Array):
            _diffuses_forwards(leaf, f" in the equation's{jax.tree_util.keystr(path)}", u0)
    if not isinstance(u0, Tracer):
        _diffuses_forwards(equation.diffusivities(u0), "", u0)


def _diffuses_forwards(diffusivity: ArrayLike, where: str, u0: Array) -> None:
    """Raise where a diffusivity, a number or one for each species or vertex, is negative."""
    if isinstance(diffusivity, Tracer) or not (is_negative := np.asarray(diffusivity) < 0).any():
        return
    at = np.argwhere(is_negative)[0]
    is_field = is_negative.shape[:1] == u0.shape[:1]
    place = f" at {'vertex' if is_field else 'species'} {at[0]}" if at.size else ""
    raise ValueError(
        f"Expected diffusivities that are not negative, found {np.asarray(diffusivity)[tuple(at)]:g}{place}{where}: "
        "diffusion backwards in time is not well posed. Where nothing diffuses give 0."
    )


def parts_of_a_step(
    equation: Equation, surface: Surface, u0: Array, t0: ArrayLike, dt: float, solver: diffrax.AbstractSolver
) -> int:
    """The number of equal parts to split a step into.

    More than one where `RKL2` or `RKL1` is unstable for the whole step even with the most stages, judged by the
    stiffest mode of the initial state; 1 where that is unknown.

    Raises:
        ValueError: the step is too long for an explicit method without stages to choose from.
    """
    if any(isinstance(x, Tracer) for x in jax.tree.leaves((equation, surface, u0, t0, dt))):
        return 1
    # What is traced may be reached through a closure too.
    t0 = jnp.asarray(t0, u0.dtype)
    if isinstance(solver, Stabilised):
        longest = solver.longest_step(solver.extent(t0, u0, (equation, surface)))
        if isinstance(longest, Tracer) or not (np.isfinite(longest) and longest > 0):
            return 1
        # With a margin for the rounding of the times between parts.
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


@jax.jit
def _power_iteration(equation: Equation, surface: Surface, u0: Array, t0: Array, v: Array) -> Array:
    def product(_, v):
        change = jax.jvp(lambda u: equation.rate(t0, surface, u), (u0,), (v / jnp.linalg.norm(v),))[1]
        return change

    return jnp.linalg.norm(jax.lax.fori_loop(0, _PRODUCTS, product, v))


def _stiffest(equation: Equation, surface: Surface, u0: Array, t0: Array) -> Array:
    """The magnitude of the largest eigenvalue of the rate's derivative, from below."""
    start = jnp.asarray(np.random.default_rng(0).normal(size=u0.shape), u0.dtype)
    return _power_iteration(equation, surface, u0, t0, start)


def longest_step(solver: diffrax.AbstractSolver, bound: float, width: float) -> float:
    """The longest step with which an explicit Runge-Kutta method is stable where eigenvalues x + iy have ``-bound <= x
    <= 0`` and ``y^2 <= width |x|``."""
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
    """What a step of an explicit Runge-Kutta method multiplies exp(lambda t) with, as a polynomial of lambda dt."""
    if isinstance(solver, diffrax.Euler):
        return np.polynomial.Polynomial([1, 1])
    tableau = solver.tableau  # type: ignore
    size = len(tableau.b_sol)
    a = np.zeros((size, size))
    for row, values in enumerate(tableau.a_lower, start=1):
        a[row, :row] = values
    # R(z) = 1 + z b (I - z a)^-1 1, a polynomial since a is nilpotent.
    coefficients, powers = [1.0], np.ones(size)
    for _ in range(size):
        coefficients.append(tableau.b_sol @ powers)
        powers = a @ powers
    return np.polynomial.Polynomial(coefficients)
