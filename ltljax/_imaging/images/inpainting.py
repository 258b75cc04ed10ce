"""Inpainting: missing values are replaced by the field of least energy that continues the known ones.

What enters: a surface, an image, and a mask of the vertices where it is missing. What leaves: the complete image, with
known values unchanged.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from ..._equations import Dirichlet
from ..._operators import laplacian
from ..._solve.direct import Factorized, factorized
from ..._solve.poisson_equation import poisson
from ..._surface import Surface, on_surface
from ..._tables import AnyArray
from .checks import check, missing, signal
from .conjugate_gradients import SplitPreconditioner, conjugate_gradients
from .minimiser import Functional, HatGradients, minimise
from .total_variation import deviation, flatness

_EXACT = {jnp.dtype("float64"): 1e-10, jnp.dtype("float32"): 1e-4}
# A biharmonic residual up to this many times the tolerance is accepted if the iteration stalls.
_SLACK = 100
_RTOL = {jnp.dtype("float64"): 1e-8, jnp.dtype("float32"): 1e-5}
_ROUNDING = 1e-2
_MAX_NEWTON_ITERATIONS = 200
_MAX_ITERATIONS = 5000


@on_surface
def inpaint(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    mask: AnyArray,
    method: str = "harmonic",
) -> Float[Array, "V *C"]:
    """The image with its missing values filled in and its known values unchanged.

    - ``"harmonic"``: Delta u = 0 where values are missing. Values stay within those at the rim; isolated known vertices
      become spikes, and level lines are not continued.
    - ``"biharmonic"``: minimises the integral of (Delta u)^2. Slopes are continued as well; values may overshoot.
    - ``"tv"``: minimises the total variation. Edges are continued along the shortest path. Slopes below a hundredth of
      the image's standard deviation over the root of the area count as flat.

    Differentiable in the known values, and for ``"tv"`` also in the vertices. If the surface or the mask is being
    traced, linear systems are solved without a good preconditioner, which takes longer.

    Args:
        surface: the surface.
        u: image, (V,) or (V, C); missing values are ignored and may be NaN.
        mask: (V,) bool, True where the value is missing.
        method: ``"harmonic"``, ``"biharmonic"`` or ``"tv"``.

    Raises:
        SolveError: the iteration did not converge.
        ValueError: u or the mask does not fit the surface, a known value is NaN or infinite, a connected component has
            no known value, or the method is unknown.

    Source: for ``"tv"``, Chan and Shen (2002), doi:10.1137/S0036139900368844.
    """
    if method not in ("harmonic", "biharmonic", "tv"):
        raise ValueError(f"Expected method 'harmonic', 'biharmonic' or 'tv', found {method!r}.")
    mask = missing(surface, mask)
    if jnp.shape(u)[:1] == mask.shape:
        u = jnp.where(mask.reshape(-1, *(1,) * (jnp.ndim(u) - 1)), 0, jnp.asarray(u, surface.dtype))
    u = signal(surface, u)
    is_missing = mask.reshape(-1, *(1,) * (u.ndim - 1))
    if method == "biharmonic":
        can_factorize = not (surface.is_traced or isinstance(mask, Tracer))
        inverse = factorized(surface, 0.0, Dirichlet(0.0, where=~mask)) if can_factorize else None
        filled, is_converged = _biharmonic(surface, u, mask, inverse)
    else:
        filled, is_converged = poisson(surface, jnp.zeros_like(u), Dirichlet(u, where=~mask)), jnp.array(True)
    if method == "tv":
        filled, is_converged = _least_variation(surface, jnp.where(is_missing, filled, u), mask)
    check("missing values", is_converged)
    return jnp.where(is_missing, filled, u)


@eqx.filter_jit
def _biharmonic(surface: Surface, u: Array, mask: Array, inverse: Factorized | None) -> tuple[Array, Array]:
    shape, columns = u.shape, u.reshape(len(u), -1)
    free, areas = mask[:, None].astype(u.dtype), surface.vertex_areas[:, None]
    rate = functools.partial(laplacian, surface)
    transposed = jax.linear_transpose(rate, columns)

    def energy(u):
        return transposed(areas * rate(u))[0]

    def apply(d):
        return free * energy(free * d) + (1 - free) * d

    preconditioner = _split_inverse(surface, free, inverse)
    rtol = _EXACT[jnp.dtype(u.dtype)]

    def is_accepted(apply: Callable[[Array], Array], x: Array, b: Array) -> Array:
        return preconditioner.norm(apply(x) - b) <= _SLACK * rtol * preconditioner.norm(b)

    def solve(apply, b):
        x, is_solved = conjugate_gradients(apply, b, preconditioner, rtol, _MAX_ITERATIONS)
        return jnp.where(is_solved | is_accepted(apply, x, b), x, jnp.nan)

    right = -free * energy(columns * (1 - free))
    filled = jax.lax.custom_linear_solve(apply, right, solve, symmetric=True)
    return filled.reshape(shape), is_accepted(apply, *jax.lax.stop_gradient((filled, right)))


def _split_inverse(surface: Surface, free: Array, inverse: Factorized | None) -> SplitPreconditioner:
    """C = L^-1 M^-1/2 on the free vertices, with L the Laplacian there and M the areas: C C^T inverts L^T M L."""
    areas = surface.vertex_areas[:, None]
    if inverse is None:
        return SplitPreconditioner.jacobi(
            free * areas * surface.laplacian_stencil.diagonal()[:, None] ** 2 + (1 - free)
        )
    root = jnp.sqrt(areas)
    return SplitPreconditioner(
        lambda z: free * inverse(free * z / root, False) + (1 - free) * z,
        lambda r: free * inverse(free * r, True) / root + (1 - free) * r,
    )


@eqx.filter_jit
def _least_variation(surface: Surface, u: Array, mask: Array) -> tuple[Array, Array]:
    columns = u.reshape(len(u), -1)
    free, no_data = mask.astype(u.dtype), jnp.zeros_like(surface.vertex_areas)
    strength, flat = jnp.ones((), u.dtype), flatness(surface, columns, jnp.asarray(_ROUNDING, u.dtype))
    functional = Functional(HatGradients.from_surface(surface), no_data, free, columns, strength, flat)
    tolerance = _RTOL[jnp.dtype(u.dtype)] * jax.lax.stop_gradient(deviation(surface, columns))
    filled, is_converged, _ = minimise(functional, columns, tolerance, _MAX_NEWTON_ITERATIONS)
    return jnp.where(is_converged, filled, jnp.nan).reshape(u.shape), is_converged
