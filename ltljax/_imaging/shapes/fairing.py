"""Mesh smoothing: mean curvature flow, and implicit fairing.

What enters: a surface, and a duration or strength. What leaves: new positions of its vertices, differentiable in the
old ones; ``surface.with_vertices`` turns them into a surface.
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..._base.deprecated import renamed_arguments
from ..._equations import Diffusion, Dirichlet
from ..._operators import laplacian
from ..._solve import Multigrid, SolveError
from ..._solve.krylov import Jacobi, Preconditioner, linear_solve
from ..._solve.preconditioning import multigrid_for
from ..._surface import Surface, on_surface
from ..._tables import AnyArray
from .volume import check_volume, volumes, with_volumes

_MAX_ITERATIONS = 1000


@renamed_arguments(t1="time")
@on_surface
def mean_curvature_flow(
    surface: Surface,
    time: float | int | AnyArray,
    steps: int = 30,
    keep_volume: bool = False,
    *,
    preconditioner: Multigrid | None = None,
    throw: bool = True,
) -> Float[Array, "V 3"]:
    """The vertices after mean curvature flow, dX/dt = Delta_S(t) X = -2 H n.

    A sphere of radius R shrinks as sqrt(R^2 - 4 t). Each step extrapolates the linearly implicit Euler method from one
    whole step and two half steps. This is second order in time and damps short waves whatever the step size. The
    weights are recomputed for the moved vertices, on the neighbours chosen for the original surface. Only the normal
    part of the motion is used. Boundary vertices are fixed. The flow breaks down when the surface collapses, so stop
    before.

    Args:
        surface: the surface.
        time: duration of the flow, in units of length squared.
        steps: number of time steps, all of the same size.
        keep_volume: whether each step ends with a uniform shift along the normals that restores the volume of each
            component. The flow is then dX/dt = (mean of 2 H - 2 H) n, which keeps the volume and reduces the area.
            Unlike a scaling, it needs no centre.
        preconditioner: a `Multigrid` built by `multigrid` for this surface or a similar one, for long steps on fine
            meshes; by default Jacobi's method.
        throw: whether to raise if a step was not solved. Otherwise, and inside jit, all vertices are then NaN.

    Raises:
        ValueError: the time or the number of steps is not positive, or ``keep_volume`` is set for a surface with a
            boundary.
        SolveError: a step was not solved, as happens when the surface collapses.

    Source: Dziuk (1990), An algorithm for evolutionary surfaces, doi:10.1007/BF01385643, for the linearly implicit
    step; Deuflhard (1985), doi:10.1137/1027140, for its extrapolation; Huisken (1987), The volume preserving mean
    curvature flow, doi:10.1515/crll.1987.382.35.
    """
    if not isinstance(time, Tracer) and not (np.asarray(time) > 0).all():
        raise ValueError(f"Expected a positive time, found {time}.")
    if steps < 1:
        raise ValueError(f"Expected at least one step, found steps={steps}.")
    check_volume(surface, keep_volume)
    vertices, is_solved = _flow(surface, jnp.asarray(time, surface.dtype), int(steps), keep_volume, preconditioner)
    if throw and not isinstance(is_solved, Tracer) and not bool(is_solved):
        raise SolveError(
            f"Mean curvature flow failed before time = {float(time):.3g}. Causes are (a) the surface has collapsed, as "
            "a sphere of radius R does at R^2 / 4, or (b) a step was too long to be solved. Stop earlier, take more "
            "steps, or pass preconditioner=ltl.solvers.multigrid(surface)."
        )
    return vertices


@on_surface
def fair(
    surface: Surface,
    strength: float | int | AnyArray,
    order: Literal[1, 2] = 1,
    keep_volume: bool = False,
    *,
    preconditioner: Multigrid | None = None,
    throw: bool = True,
) -> Float[Array, "V 3"]:
    """The vertices after implicit fairing: (I - strength Delta) X = X0, or (I + strength Delta^2) X = X0.

    A wave of wavenumber k is divided by 1 + strength k^2 (order 1) or 1 + strength k^4 (order 2). Order 2 separates
    more sharply: it keeps long waves and damps short ones. Boundary vertices are fixed.

    Args:
        surface: the surface.
        strength: strength in units of length squared (order 1) or length to the fourth (order 2). A small multiple of
            the squared edge length, or of its square, removes the noise of the vertices and little else.
        order: 1 or 2.
        keep_volume: whether to restore the volume of each component, as in `mean_curvature_flow`.
        preconditioner: a `Multigrid` built by `multigrid` for this surface or a similar one. By default Jacobi's
            method; for order 2 multigrid, if the extra `amg` is installed and the surface is not being traced.
        throw: whether to raise if the system was not solved. Otherwise, and inside jit, all vertices are then NaN.

    Raises:
        ValueError: the strength is not positive, the order is neither 1 nor 2, or ``keep_volume`` is set for a surface
            with a boundary.
        SolveError: the system was not solved.

    Source: Desbrun, Meyer, Schroeder and Barr (1999), Implicit fairing of irregular meshes using diffusion and
    curvature flow, doi:10.1145/311535.311576.
    """
    if not isinstance(strength, Tracer) and not (np.asarray(strength) > 0).all():
        raise ValueError(f"Expected a positive strength, found {strength}.")
    if order not in (1, 2):
        raise ValueError(f"Expected order 1 or 2, found {order!r}.")
    check_volume(surface, keep_volume)
    if preconditioner is None and order == 2:
        # Jacobi's method preconditions Delta^2 poorly where the size of a row differs much from its neighbours'.
        held = Dirichlet(0.0) if surface.topology.num_loops else ()
        preconditioner = multigrid_for(Diffusion(boundary=held), surface, surface.vertices[:, 0], 0.0)
    vertices, is_solved = _faired(surface, jnp.asarray(strength, surface.dtype), order, keep_volume, preconditioner)
    if throw and not isinstance(is_solved, Tracer) and not bool(is_solved):
        raise SolveError(
            f"Fairing with strength {float(strength):.3g} was not solved within {_MAX_ITERATIONS} iterations. Pass "
            "preconditioner=ltl.solvers.multigrid(surface), or use float64."
        )
    return vertices


@eqx.filter_jit
def _flow(
    surface: Surface, time: Array, steps: int, keep_volume: bool, multigrid: Multigrid | None
) -> tuple[Array, Array]:
    dt = time / steps
    start, is_open = surface.vertices, surface.topology.num_loops > 0
    start_volumes = volumes(surface, start)

    def step(carry, _):
        vertices, is_solved = carry
        current = surface.with_vertices(vertices)
        whole, whole_solved = _implicit_step(current, vertices, dt, 1, multigrid)
        half, half_solved = _implicit_step(current, vertices, dt / 2, 1, multigrid)
        half = vertices + _normal_part(current.normals, half - vertices)
        halves, halves_solved = _implicit_step(surface.with_vertices(half), half, dt / 2, 1, multigrid)
        vertices = vertices + _normal_part(current.normals, 2 * halves - whole - vertices)
        # A component that has passed through its collapse is inside out.
        is_solved = is_solved & (is_open | jnp.all(volumes(surface, vertices) * start_volumes > 0))
        if keep_volume:
            vertices = with_volumes(surface, vertices, start_volumes)
        return (vertices, is_solved & whole_solved & half_solved & halves_solved), None

    (vertices, is_solved), _ = jax.lax.scan(step, (start, jnp.ones((), bool)), length=steps)
    return jnp.where(is_solved, vertices, jnp.nan), is_solved


@eqx.filter_jit
def _faired(
    surface: Surface, strength: Array, order: int, keep_volume: bool, multigrid: Multigrid | None
) -> tuple[Array, Array]:
    start = surface.vertices
    vertices, is_solved = _implicit_step(surface, start, strength, order, multigrid)
    vertices = with_volumes(surface, vertices, volumes(surface, start)) if keep_volume else vertices
    return jnp.where(is_solved, vertices, jnp.nan), is_solved


def _implicit_step(
    surface: Surface, vertices: Array, strength: Array, order: int, multigrid: Multigrid | None
) -> tuple[Array, Array]:
    """The X with ``X - strength Delta X = vertices`` (or plus strength Delta^2 X), and whether it was solved."""
    is_held = jnp.zeros(surface.num_vertices, bool).at[surface.topology.boundary].set(True)[:, None]

    def fall(X):
        once = laplacian(surface, X)
        return -strength * once if order == 1 else strength * laplacian(surface, jnp.where(is_held, 0, once))

    # Solving for the change makes the tolerance independent of the origin.
    right = -jnp.where(is_held, 0, fall(vertices))
    solution = linear_solve(
        lambda change: change + jnp.where(is_held, 0, fall(jnp.where(is_held, 0, change))),
        right,
        _inverse(surface, strength, order, multigrid),
        1e-10 if vertices.dtype == jnp.float64 else 1e-5,
        _MAX_ITERATIONS,
    )
    return vertices + solution.value, (solution.result == lx.RESULTS.successful) & jnp.all(jnp.isfinite(right))


def _normal_part(normals: Array, change: Array) -> Array:
    """The normal part of a motion, which alone changes the shape.

    The tangential part is an error of rows that have become inconsistent as the surface deformed, and following it
    would make more rows inconsistent.
    """
    return normals * jnp.sum(normals * change, axis=1, keepdims=True)


class _Squared(Preconditioner):
    """The square of an inverse of 1 - beta Delta.

    ``(1 - beta Delta)^2`` lies between one and two times ``1 + beta^2 Delta^2``.
    """

    inverse: Preconditioner

    def __call__(self, r, transposed):
        """The inverse applied twice to r."""
        return self.inverse(self.inverse(r, transposed), transposed)


def _inverse(surface: Surface, strength: Array, order: int, multigrid: Multigrid | None) -> Preconditioner:
    if multigrid is None:
        main: Any = surface.laplacian_stencil.diagonal()
        return Jacobi((1 - strength * main if order == 1 else 1 + strength * main**2)[:, None])
    ones = jnp.ones(3, strength.dtype)
    shifted = multigrid.shifted
    return shifted(ones, strength * ones) if order == 1 else _Squared(shifted(ones, strength**0.5 * ones))
