"""Shapes that are smoothed: mean curvature flow, and implicit fairing of positions.

What enters: a surface, and for how long or how strongly. What leaves: the positions of its vertices afterwards,
differentiable in the positions before; ``surface.with_vertices`` makes a surface of them.
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..._equations import Diffusion, Dirichlet
from ..._operators import laplacian
from ..._solve import Multigrid, SolveError
from ..._solve.evolve import hierarchy
from ..._solve.implicit import Cycle, Jacobi
from ..._solve.krylov import Preconditioner, linear_solve
from ..._surface import Surface, on_surface
from ..._tables import AnyArray
from .volume import check_volume, volumes, with_volumes

_MOST_ITERATIONS = 1000


@on_surface
def mean_curvature_flow(
    surface: Surface,
    t1: float | int | AnyArray,
    steps: int = 30,
    keep_volume: bool = False,
    *,
    preconditioner: Multigrid | None = None,
    throw: bool = True,
) -> Float[Array, "V 3"]:
    """The vertices after mean curvature flow: dX/dt = Delta_S(t) X = -2 H n up to the time t1.

    A sphere of radius R shrinks as sqrt(R^2 - 4 t). Every step is linearly implicit Euler's, once over the whole step
    and twice over its halves, extrapolated: second order in time, damping however long it is, with the weights made
    anew for the moved vertices on the neighbours chosen for the surface given, and only the normal part of the motion
    taken. Boundary vertices stay where they are. The flow ends where the surface collapses; stop before.

    Args:
        surface: the surface.
        t1: how long, in units of length squared.
        steps: how many, all equal.
        keep_volume: whether every step ends with a shift along the normals, the same everywhere, that gives each
            component the volume it had. That makes the flow dX/dt = (mean of 2 H - 2 H) n, which keeps volume and
            shrinks area and needs no centre; a scaling would move most what is far from one.
        preconditioner: what `multigrid` returned for this surface or a similar one, for long steps on fine meshes;
            by default Jacobi's method.
        throw: whether to raise when a step could not be solved. Without it, and inside jit, where nothing can be
            raised, all vertices are NaN then.

    Raises:
        ValueError: t1 or steps is not positive, or volume is to be kept of a surface with a boundary.
        SolveError: a step could not be solved, as where the surface collapses.

    Source: Dziuk (1990), An algorithm for evolutionary surfaces, doi:10.1007/BF01385643, for the linearly implicit
    step; Deuflhard (1985), doi:10.1137/1027140, for its extrapolation; Huisken (1987), The volume preserving mean
    curvature flow, doi:10.1515/crll.1987.382.35.
    """
    if not isinstance(t1, Tracer) and not (np.asarray(t1) > 0).all():
        raise ValueError(f"Expected a positive time t1 to flow to, found {t1}.")
    if steps < 1:
        raise ValueError(f"Expected at least one step, found steps={steps}.")
    check_volume(surface, keep_volume)
    vertices, found = _flow(surface, jnp.asarray(t1, surface.dtype), int(steps), keep_volume, preconditioner)
    if throw and not isinstance(found, Tracer) and not bool(found):
        raise SolveError(
            f"A step of mean curvature flow could not be solved on the way to t1 = {float(t1):.3g}. Where the surface "
            "has collapsed (a sphere of radius R does at R^2 / 4) stop earlier; else take more steps, or hand in "
            "preconditioner=ltl.solvers.multigrid(surface)."
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
    """The vertices faired in one linear solve: (I - strength Delta) X = X0, or (I + strength Delta^2) X = X0.

    A wave of wavenumber k is divided by 1 + strength k^2 (order 1), or 1 + strength k^4 (order 2), which spares long
    waves and takes short ones more sharply. Boundary vertices stay where they are.

    Args:
        surface: the surface.
        strength: in units of length squared (order 1), or to the fourth (order 2). A multiple of the squared edge
            length (of its square) takes noise of the vertices and little else.
        order: 1 or 2.
        keep_volume: whether each component is given back the volume it had: see `mean_curvature_flow`.
        preconditioner: what `multigrid` returned for this surface or a similar one; by default Jacobi's method, and of
            order 2 multigrid where the extra `amg` is at hand and the surface is not being traced.
        throw: whether to raise when the system could not be solved. Without it, and inside jit, where nothing can be
            raised, all vertices are NaN then.

    Raises:
        ValueError: the strength is not positive, the order is neither 1 nor 2, or volume is to be kept of a surface
            with a boundary.
        SolveError: the system could not be solved.

    Source: Desbrun, Meyer, Schroeder and Barr (1999), Implicit fairing of irregular meshes using diffusion and
    curvature flow, doi:10.1145/311535.311576.
    """
    if not isinstance(strength, Tracer) and not (np.asarray(strength) > 0).all():
        raise ValueError(f"Expected a positive strength, found {strength}.")
    if order not in (1, 2):
        raise ValueError(f"Expected order 1 or 2, found {order!r}.")
    check_volume(surface, keep_volume)
    if preconditioner is None and order == 2:
        # Of the square Jacobi's method is no inverse where a row stands out.
        held = Dirichlet(0.0) if surface.topology.num_loops else ()
        preconditioner = hierarchy(Diffusion(boundary=held), surface, surface.vertices[:, 0], 0.0)
    vertices, found = _faired(surface, jnp.asarray(strength, surface.dtype), order, keep_volume, preconditioner)
    if throw and not isinstance(found, Tracer) and not bool(found):
        raise SolveError(
            f"The system of strength {float(strength):.3g} was not solved within {_MOST_ITERATIONS} iterations. Hand "
            "in preconditioner=ltl.solvers.multigrid(surface), or use float64."
        )
    return vertices


@eqx.filter_jit
def _flow(
    surface: Surface, t1: Array, steps: int, keep_volume: bool, multigrid: Multigrid | None
) -> tuple[Array, Array]:
    dt = t1 / steps
    start, is_open = surface.vertices, surface.topology.num_loops > 0
    wanted = volumes(surface, start)

    def step(carry, _):
        vertices, found = carry
        here = surface.with_vertices(vertices)
        whole, found_whole = _smoothed(here, vertices, dt, 1, multigrid)
        half, found_half = _smoothed(here, vertices, dt / 2, 1, multigrid)
        half = vertices + _along(here.normals, half - vertices)
        again, found_again = _smoothed(surface.with_vertices(half), half, dt / 2, 1, multigrid)
        vertices = vertices + _along(here.normals, 2 * again - whole - vertices)
        # What has collapsed and gone on faces the other way.
        found = found & (is_open | jnp.all(volumes(surface, vertices) * wanted > 0))
        if keep_volume:
            vertices = with_volumes(surface, vertices, wanted)
        return (vertices, found & found_whole & found_half & found_again), None

    (vertices, found), _ = jax.lax.scan(step, (start, jnp.ones((), bool)), length=steps)
    return jnp.where(found, vertices, jnp.nan), found


@eqx.filter_jit
def _faired(
    surface: Surface, strength: Array, order: int, keep_volume: bool, multigrid: Multigrid | None
) -> tuple[Array, Array]:
    start = surface.vertices
    vertices, found = _smoothed(surface, start, strength, order, multigrid)
    vertices = with_volumes(surface, vertices, volumes(surface, start)) if keep_volume else vertices
    return jnp.where(found, vertices, jnp.nan), found


def _smoothed(
    surface: Surface, vertices: Array, strength: Array, order: int, multigrid: Multigrid | None
) -> tuple[Array, Array]:
    """The X with ``X - strength Delta X = vertices`` (or plus strength Delta^2 X), and whether it was found."""
    is_held = jnp.zeros(surface.num_vertices, bool).at[surface.topology.boundary].set(True)[:, None]

    def fall(X):
        once = laplacian(surface, X)
        return -strength * once if order == 1 else strength * laplacian(surface, jnp.where(is_held, 0, once))

    # For the change, to which the tolerance then refers, and which does not know where the origin is.
    right = -jnp.where(is_held, 0, fall(vertices))
    found = linear_solve(
        lambda change: change + jnp.where(is_held, 0, fall(jnp.where(is_held, 0, change))),
        right,
        _inverse(surface, strength, order, multigrid),
        1e-10 if vertices.dtype == jnp.float64 else 1e-5,
        _MOST_ITERATIONS,
    )
    return vertices + found.value, (found.result == lx.RESULTS.successful) & jnp.all(jnp.isfinite(right))


def _along(normals: Array, change: Array) -> Array:
    """The part of a motion that changes the shape.

    What runs along the surface is none of the flow's: it comes of rows that the deformation has left inconsistent, and
    would make more of them.
    """
    return normals * jnp.sum(normals * change, axis=1, keepdims=True)


class _Twice(Preconditioner):
    """The square of an inverse: of ``(1 - beta Delta)^2``, which lies between one and two times 1 + beta^2 Delta^2."""

    inverse: Preconditioner

    def __call__(self, r, transposed):
        """The inverse of the inverse of r."""
        return self.inverse(self.inverse(r, transposed), transposed)


def _inverse(surface: Surface, strength: Array, order: int, multigrid: Multigrid | None) -> Preconditioner:
    if multigrid is None:
        own: Any = surface.laplacian_stencil.diagonal()
        return Jacobi(1 / (1 - strength * own if order == 1 else 1 + strength * own**2)[:, None])
    one = jnp.ones(3, strength.dtype)
    return Cycle(multigrid, one, strength * one) if order == 1 else _Twice(Cycle(multigrid, one, strength**0.5 * one))
