"""What was an image where it is missing? The field of least energy that continues what is known.

What enters: a surface, an image, and a mask of the vertices where it is missing. What leaves: the image, with the
values that are known as they were.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from ..._equations import Dirichlet
from ..._operators import laplacian
from ..._solve.direct import Factorized, factorized
from ..._solve.stationary import poisson
from ..._surface import Surface, on_surface
from ..._tables import AnyArray
from .minimiser import Faces, Functional, conjugate_gradients, minimise
from .signals import check, missing, signal
from .variation import deviation, flatness

_EXACT = {jnp.dtype("float64"): 1e-10, jnp.dtype("float32"): 1e-4}
_TOLERANCE = {jnp.dtype("float64"): 1e-8, jnp.dtype("float32"): 1e-5}
_ROUNDING = 1e-2
_MAX_STEPS = 200
_MAX_ITERATIONS = 5000


@on_surface
def inpaint(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    mask: AnyArray,
    method: str = "harmonic",
) -> Float[Array, "V *C"]:
    """The image with what is missing filled in; known values stay as they are.

    - ``"harmonic"``: Delta u = 0 where values are missing. Values stay within those at the rim; single known vertices
      become spikes, and level lines are not continued.
    - ``"biharmonic"``: the integral of (Delta u)^2 is least. Slopes are continued as well, values may overshoot.
    - ``"tv"``: the total variation is least, with slopes below a hundredth of the image's standard deviation over the
      root of the area counting as flat. Edges are continued, by the shortest way.

    Differentiable in the known values; ``"tv"`` in the vertices, too. On a surface that is being traced, or with such a
    mask, linear systems are solved without a good preconditioner, which takes longer.

    Args:
        surface: the surface.
        u: (V,) or (V, C); where values are missing anything, NaN too.
        mask: (V,) bool, True where the value is missing.
        method: ``"harmonic"``, ``"biharmonic"`` or ``"tv"``.

    Raises:
        SolveError: the iteration did not converge.
        ValueError: u or the mask do not fit the surface, u is not finite where it is known, a connected component has
            no known value, or an unknown method.

    Source: of ``"tv"`` Chan and Shen (2002), doi:10.1137/S0036139900368844.
    """
    if method not in ("harmonic", "biharmonic", "tv"):
        raise ValueError(f"Expected method 'harmonic', 'biharmonic' or 'tv', found {method!r}.")
    mask = missing(surface, mask)
    if jnp.shape(u)[:1] == mask.shape:
        u = jnp.where(mask.reshape(-1, *(1,) * (jnp.ndim(u) - 1)), 0, jnp.asarray(u, surface.dtype))
    u = signal(surface, u)
    here = mask.reshape(-1, *(1,) * (u.ndim - 1))
    if method == "biharmonic":
        is_known = not (surface.is_traced or isinstance(mask, Tracer))
        inverse = factorized(surface, 0.0, Dirichlet(0.0, where=~mask)) if is_known else None
        found, converged = _biharmonic(surface, u, mask, inverse)
    else:
        found, converged = poisson(surface, jnp.zeros_like(u), Dirichlet(u, where=~mask)), jnp.array(True)
    if method == "tv":
        found, converged = _least_variation(surface, jnp.where(here, found, u), mask)
    check("missing values", converged)
    return jnp.where(here, found, u)


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

    def about_inverse(r):
        if inverse is None:
            return r / (free * areas * surface.laplacian_stencil.diagonal()[:, None] ** 2 + (1 - free))
        there = inverse(free * r, True) * free / areas
        return free * inverse(there, False) + (1 - free) * r

    right = -free * energy(columns * (1 - free))
    share = _EXACT[jnp.dtype(u.dtype)]

    def solve(apply, b):
        x, missed = conjugate_gradients(apply, b, about_inverse, share, _MAX_ITERATIONS)
        return jnp.where(missed <= 100**2, x, jnp.nan)

    found = jax.lax.custom_linear_solve(apply, right, solve, symmetric=True)
    # In the norm that the iteration knows the size of.
    both = jax.lax.stop_gradient((apply(found) - right, right))
    size, before = (jnp.sum(r * about_inverse(r)) for r in both)
    return found.reshape(shape), size <= (100 * share) ** 2 * before


@eqx.filter_jit
def _least_variation(surface: Surface, u: Array, mask: Array) -> tuple[Array, Array]:
    columns = u.reshape(len(u), -1)
    free, nothing = mask.astype(u.dtype), jnp.zeros_like(surface.vertex_areas)
    one, flat = jnp.ones((), u.dtype), flatness(surface, columns, jnp.asarray(_ROUNDING, u.dtype))
    functional = Functional(Faces.of(surface), nothing, free, columns, one, flat)
    tolerance = _TOLERANCE[jnp.dtype(u.dtype)] * jax.lax.stop_gradient(deviation(surface, columns))
    found, converged, _ = minimise(functional, columns, tolerance, _MAX_STEPS)
    return jnp.where(converged, found, jnp.nan).reshape(u.shape), converged
