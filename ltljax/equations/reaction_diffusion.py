"""Several species that diffuse, drift and react."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..elliptic import EllipticStencil
from ..operators import spectral_bound, spectral_width, weighted_laplacian
from ..surface import Surface
from . import boundary as bounds
from .boundary import Conditions, Neumann, Robin
from .equation import Equation
from .kinetics import Kinetics

# A spectral radius is estimated from a power whose exponent is two to this one.
_SQUARINGS = 5

# How one species spreads: a number, a field over the surface, or an operator of its own.
Spread = Float[Array, ""] | Float[Array, " V"] | EllipticStencil


class ReactionDiffusion(Equation):
    """u_t = D_a Delta u + f(u, v), v_t = D_b Delta v + g(u, v), for any number of species.

    The state is one array (V, S).

    Attributes:
        diffusivity: for each species how it spreads: a number D for D Delta u; a non-negative field (V,) for
            div(D grad u), which may jump, and through a zero of which nothing flows (`weighted_laplacian` with the
            harmonic mean); an `EllipticStencil` for D : Hess u + b . grad u, such as diffusion along a direction field
            or drift with a flow (b is minus the velocity). (S,) where all are numbers, else a tuple.
        reaction: a `Kinetics`, or a plain function ``((u, v), params) -> (du, dv)`` of the species, each an array (V,)
            over the vertices: what is written in arithmetic holds at every one of them. A function of a single point,
            such as a neural network, goes through `jax.vmap`.
        params: the parameters of a plain function; a pytree of scalars, or of fields (V,) over the surface.
        boundary: `Neumann`, `Dirichlet` or `Robin`, or several; without any the normal derivatives vanish. Fluxes
            need numbers as diffusivities.

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
        spreads = tuple(
            d if isinstance(d, EllipticStencil) else jnp.asarray(d, jnp.result_type(float)) for d in diffusivity
        )
        are_numbers = all(not isinstance(d, EllipticStencil) and d.ndim == 0 for d in spreads)
        self.diffusivity = jnp.stack(cast(list[Array], spreads)) if are_numbers else spreads
        self.reaction = reaction if isinstance(reaction, Kinetics) else Kinetics(reaction, params)
        self.boundary = bounds.as_tuple(boundary)
        if not are_numbers and any(isinstance(condition, Neumann | Robin) for condition in self.boundary):
            raise ValueError(
                "Neumann and Robin conditions need a number as the diffusivity of every species. Leave them out for "
                "vanishing normal derivatives, or hold values with ltl.Dirichlet."
            )

    @property
    def num_species(self) -> int:
        """The number of species."""
        return len(self.diffusivity)

    def rate(self, t, surface: Surface, u):
        """The time derivative: diffusion of every species and the reaction at every vertex."""
        return self.implicit_rate(t, surface, u) + self.explicit_rate(t, surface, u)

    def implicit_rate(self, t, surface: Surface, u):
        """The diffusion of every species; of a value that is held, that value's rate."""
        self._check(u)
        u = self.held(t, surface, u)
        if isinstance(self.diffusivity, tuple):
            columns = [_spread(surface, spread, u[:, s]) for s, spread in enumerate(self.diffusivity)]
            spread = jnp.stack(columns, axis=1)
        else:
            spread = self.diffusivities(u)[None] * bounds.bounded_laplacian(surface, self.boundary, t, u)
        return bounds.held_rate(surface, self.boundary, t, u, spread)

    def explicit_rate(self, t, surface: Surface, u):
        """The reaction at every vertex; zero where a value is held."""
        return bounds.released(surface, self.boundary, self.reaction(self.held(t, surface, u)))

    def diffusivities(self, u):
        """One number for each species; of what varies, the mean."""
        if not isinstance(self.diffusivity, tuple):
            return self.diffusivity.astype(u.dtype)
        means = [d.mean_diffusion if isinstance(d, EllipticStencil) else jnp.mean(d) for d in self.diffusivity]
        return jnp.stack([mean.astype(u.dtype) for mean in means])

    @property
    def conditions(self):
        """The boundary conditions."""
        return bounds.as_tuple(self.boundary)

    def held(self, t, surface: Surface, u):
        """The state with the values that the boundary conditions hold."""
        return bounds.held(surface, self.boundary, t, u)

    def spectral_bound(self, t, surface: Surface, u):
        """The diffusion's bound plus the largest one of the reaction's Jacobian over the surface, whatever the units of
        the species."""
        self._check(u)
        reaction = jnp.max(_spectral_radius(jnp.abs(self._jacobian(u))))
        bound = spectral_bound(surface) + bounds.stiffness(surface, self.boundary, t, u)
        fastest = [
            d.spectral_bound() if isinstance(d, EllipticStencil) else jnp.max(d.astype(u.dtype)) * bound
            for d in self.diffusivity
        ]
        return jnp.max(jnp.stack(fastest)) + reaction

    def spectral_width(self, t, surface: Surface, u):
        """The diffusion's width plus twice the largest frequency at which the reaction turns a state about another."""
        del t
        self._check(u)
        jacobian, width = self._jacobian(u), spectral_width(surface).astype(u.dtype)
        # Two species turn about one another at this frequency at most. More of them also turn in longer cycles, whose
        # frequency is at most the spectral radius of what is off the diagonal.
        turning = jnp.sqrt(jnp.maximum(-jacobian * jnp.swapaxes(jacobian, 1, 2), 0))
        if u.shape[1] > 2:
            turning = jnp.abs(jacobian) * (1 - jnp.eye(u.shape[1], dtype=u.dtype))
        widest = [
            d.spectral_width() if isinstance(d, EllipticStencil) else jnp.max(d.astype(u.dtype)) * width
            for d in self.diffusivity
        ]
        return jnp.max(jnp.stack(widest)) + 2 * jnp.max(_spectral_radius(turning))

    def _jacobian(self, u: Array) -> Array:
        """The derivatives of the reaction's rates at every vertex, (V, S, S)."""
        species = jnp.eye(u.shape[1], dtype=u.dtype)
        columns = [jax.jvp(self.reaction, (u,), (jnp.broadcast_to(unit[None], u.shape),))[1] for unit in species]
        return jnp.stack(columns, axis=2)

    def _check(self, u: Array) -> None:
        if u.ndim != 2 or u.shape[1] != self.num_species:
            raise ValueError(
                f"Expected a state of shape (V, {self.num_species}), one column for each diffusivity, found {u.shape}."
            )


def _spectral_radius(a: Float[Array, "V S S"]) -> Float[Array, " V"]:
    """The spectral radius of non-negative matrices, which a change of the species' units leaves as it is; of more than
    two species a bound that such a change hardly changes."""
    if a.shape[1] == 1:
        return a[:, 0, 0]
    if a.shape[1] == 2:
        half = (a[:, 0, 0] - a[:, 1, 1]) / 2
        across = jnp.sqrt(a[:, 0, 1]) * jnp.sqrt(a[:, 1, 0])
        return (a[:, 0, 0] + a[:, 1, 1]) / 2 + jnp.hypot(half, across)
    # The norm of the power 2^n is at least the radius to that power.
    logarithm = jnp.zeros(len(a), a.dtype)
    for _ in range(_SQUARINGS + 1):
        norm = jnp.maximum(jnp.max(jnp.sum(a, axis=2), axis=1), jnp.finfo(a.dtype).tiny)
        a, logarithm = a / norm[:, None, None], logarithm + jnp.log(norm)
        a, logarithm = jnp.einsum("vij,vjk->vik", a, a), 2 * logarithm
    return jnp.exp(logarithm / 2 ** (_SQUARINGS + 1))


def _spread(surface: Surface, spread: Spread, u: Float[Array, " V"]) -> Float[Array, " V"]:
    """What the diffusion of one species makes of it."""
    if isinstance(spread, EllipticStencil):
        return spread(u)
    conductivity = jnp.broadcast_to(spread.astype(u.dtype), u.shape)
    return weighted_laplacian(surface, conductivity, u, "harmonic")
