"""Reaction-diffusion: several species that diffuse, drift and react."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._surface import Surface
from . import boundary as bounds
from .boundary import Conditions
from .equation import Equation
from .kinetics import Kinetics
from .spreads import Spread, as_spreads, mean_diffusivities, spread_bound, spread_rate, spread_width

# Number of squarings of a matrix in the bound of its spectral radius.
_SQUARINGS = 6


class ReactionDiffusion(Equation):
    """u_t = D_a Delta u + f(u, v), v_t = D_b Delta v + g(u, v), for any number of species.

    The state is one array (V, S).

    Attributes:
        diffusivity: one diffusivity per species, in one of three forms. A number D for D Delta u. A non-negative field
            (V,) for div(D grad u), which may jump; zeros block the flux (`weighted_laplacian` with the harmonic mean).
            An `EllipticStencil` for D : Hess u + b . grad u, such as diffusion along a direction field or drift with a
            flow (b is minus the velocity). An array (S,) if all are numbers, otherwise a tuple.
        reaction: a `Kinetics`, or a plain function ``((u, v), params) -> (du, dv)`` of the species, each an array (V,)
            over the vertices. Arithmetic acts on all vertices at once; wrap a function of a single point, such as a
            neural network, in `jax.vmap`.
        params: parameters of a plain function: a pytree of scalars, or of fields (V,) over the surface.
        boundary: boundary conditions: `Neumann`, `Dirichlet` or `Robin`, or a tuple of these, for all species or some.
            By default the normal derivatives vanish.

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 4; Turing (1952), doi:10.1098/rstb.1952.0012.
    """

    diffusivity: Float[Array, " S"] | tuple[Spread, ...]
    reaction: Kinetics
    boundary: Conditions

    def __init__(
        self,
        diffusivity: Sequence[Any] | Array,
        reaction: Kinetics | Callable,
        params: Any = None,
        boundary: Conditions | None = None,
    ):
        self.diffusivity = cast(Array | tuple[Spread, ...], as_spreads(tuple(diffusivity)))
        self.reaction = reaction if isinstance(reaction, Kinetics) else Kinetics(reaction, params)
        self.boundary = bounds.as_tuple(boundary)

    @property
    def num_species(self) -> int:
        """The number of species."""
        return len(self.diffusivity)

    def rate(self, t, surface: Surface, u):
        """The time derivative: the diffusion of every species plus the reaction at every vertex."""
        return self.implicit_rate(t, surface, u) + self.explicit_rate(t, surface, u)

    def implicit_rate(self, t, surface: Surface, u):
        """The diffusion of every species; for held values, their own time derivative."""
        self._check(u)
        u = self.held(t, surface, u)
        spread = spread_rate(surface, self.diffusivity, self.boundary, t, u)
        return bounds.held_rate(surface, self.boundary, t, u, spread)

    def explicit_rate(self, t, surface: Surface, u):
        """The reaction at every vertex, zero at held values."""
        return bounds.released(surface, self.boundary, self.reaction(self.held(t, surface, u)))

    def diffusivities(self, u):
        """One diffusivity per species, averaged if it varies over the surface."""
        self._check(u)
        return mean_diffusivities(self.diffusivity, u)

    @property
    def conditions(self):
        """The boundary conditions."""
        return bounds.as_tuple(self.boundary)

    def held(self, t, surface: Surface, u):
        """The state with the values that the boundary conditions hold."""
        return bounds.held(surface, self.boundary, t, u)

    def spectral_bound(self, t, surface: Surface, u):
        """The diffusion's bound plus the spectral radius of the matrix of the reaction's largest derivatives.

        It is nearly independent of the units of the species.
        """
        self._check(u)
        reaction = _spectral_radius(jnp.max(jnp.abs(self._jacobian(u)), axis=0))
        return self.diffusion_bound(t, surface, u) + reaction

    def diffusion_bound(self, t, surface: Surface, u):
        """The largest diffusivity times the bound of the Laplacian's eigenvalues, or the largest of the operators'."""
        return spread_bound(surface, self.diffusivity, self.boundary, t, u)

    def spectral_width(self, t, surface: Surface, u):
        """The diffusion's width plus twice the largest frequency at which the reaction can oscillate."""
        del t
        self._check(u)
        jacobian = self._jacobian(u)
        if u.shape[1] == 2:
            # Two species oscillate if one promotes the other, which inhibits it. The largest derivatives may occur at
            # different vertices, because diffusion couples them.
            promotes, inhibits = (jnp.max(jnp.maximum(part, 0), axis=0) for part in (jacobian, -jacobian))
            products = promotes * inhibits.T
            frequency = jnp.sqrt(jnp.maximum(products[0, 1], products[1, 0]))
        else:
            # Three or more species can also oscillate in longer cycles.
            others = 1 - jnp.eye(u.shape[1], dtype=u.dtype)
            frequency = _spectral_radius(jnp.max(jnp.abs(jacobian), axis=0) * others)
        return spread_width(surface, self.diffusivity, u) + 2 * frequency

    def _jacobian(self, u: Array) -> Array:
        """The derivatives of the reaction's rates at every vertex, (V, S, S), as constants for differentiation."""
        species = jnp.eye(u.shape[1], dtype=u.dtype)
        columns = [jax.jvp(self.reaction, (u,), (jnp.broadcast_to(unit[None], u.shape),))[1] for unit in species]
        return jax.lax.stop_gradient(jnp.stack(columns, axis=2))

    def _check(self, u: Array) -> None:
        if u.ndim != 2 or u.shape[1] != self.num_species:
            raise ValueError(
                f"Expected a state of shape (V, {self.num_species}), one column per diffusivity, found {u.shape}."
            )


def _spectral_radius(a: Float[Array, "S S"]) -> Float[Array, ""]:
    """The spectral radius of a non-negative matrix, or for more than two species a close upper bound of it.

    The spectral radius does not depend on the units of the species, and the bound hardly does.
    """
    if len(a) == 1:
        return a[0, 0]
    if len(a) == 2:
        half = (a[0, 0] - a[1, 1]) / 2
        across = jnp.sqrt(a[0, 1]) * jnp.sqrt(a[1, 0])
        return (a[0, 0] + a[1, 1]) / 2 + jnp.hypot(half, across)
    # The norm of A^(2^n) is at least the spectral radius to the power 2^n.
    logarithm = jnp.zeros((), a.dtype)
    for squaring in range(_SQUARINGS + 1):
        a = a @ a if squaring else a
        norm = jnp.maximum(jnp.max(jnp.sum(a, axis=1)), jnp.finfo(a.dtype).tiny)
        a, logarithm = a / norm, 2 * logarithm + jnp.log(norm)
    return jnp.exp(logarithm / 2**_SQUARINGS)
