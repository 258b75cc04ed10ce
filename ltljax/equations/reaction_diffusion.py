"""Several species that diffuse and react."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..operators import spectral_bound
from ..surface import Surface
from . import boundary as bounds
from .boundary import Conditions
from .equation import Equation
from .kinetics import Kinetics


class ReactionDiffusion(Equation):
    """u_t = D_a Delta u + f(u, v), v_t = D_b Delta v + g(u, v), for any number of species.

    The state is one array (V, S).

    Attributes:
        diffusivity: (S,) one non-negative number for each species.
        reaction: a `Kinetics`, or a plain function ``((u, v), params) -> (du, dv)`` of the species at one point.
        params: the parameters of a plain function; a pytree of scalars, or of fields (V,) over the surface.
        boundary: `Neumann`, `Dirichlet` or `Robin`, or several; without any the normal derivatives vanish.

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 4; Turing (1952), doi:10.1098/rstb.1952.0012.
    """

    diffusivity: Float[Array, " S"]
    reaction: Kinetics
    boundary: Conditions

    def __init__(
        self, diffusivity: Any, reaction: Kinetics | Callable, params: Any = None, boundary: Conditions | None = None
    ):
        self.diffusivity = jnp.stack([jnp.asarray(d, jnp.result_type(float)) for d in diffusivity])
        self.reaction = reaction if isinstance(reaction, Kinetics) else Kinetics(reaction, params)
        self.boundary = bounds.as_tuple(boundary)

    def rate(self, t, surface: Surface, u):
        """The time derivative: diffusion of every species and the reaction at every vertex."""
        return self.implicit_rate(t, surface, u) + self.explicit_rate(t, surface, u)

    def implicit_rate(self, t, surface: Surface, u):
        """The diffusion of every species; of a value that is held, that value's rate."""
        self._check(u)
        u = self.held(t, surface, u)
        diffused = bounds.bounded_laplacian(surface, self.boundary, t, u)
        return bounds.held_rate(surface, self.boundary, t, u, self.diffusivities(u)[None] * diffused)

    def explicit_rate(self, t, surface: Surface, u):
        """The reaction at every vertex; zero where a value is held."""
        return bounds.released(surface, self.boundary, self.reaction(self.held(t, surface, u)))

    def diffusivities(self, u):
        """One number for each species."""
        return self.diffusivity.astype(u.dtype)

    @property
    def conditions(self):
        """The boundary conditions."""
        return bounds.as_tuple(self.boundary)

    def held(self, t, surface: Surface, u):
        """The state with the values that the boundary conditions hold."""
        return bounds.held(surface, self.boundary, t, u)

    def spectral_bound(self, t, surface: Surface, u):
        """The diffusion's bound plus the largest row sum of the reaction's Jacobian over the surface."""
        self._check(u)
        species = jnp.eye(u.shape[1], dtype=u.dtype)
        columns = [jax.jvp(self.reaction, (u,), (jnp.broadcast_to(unit[None], u.shape),))[1] for unit in species]
        reaction = jnp.max(sum(jnp.abs(column) for column in columns))
        bound = spectral_bound(surface) + bounds.stiffness(surface, self.boundary, t, u)
        return jnp.max(self.diffusivity.astype(u.dtype)) * bound + reaction

    def _check(self, u: Array) -> None:
        if u.ndim != 2 or u.shape[1] != self.diffusivity.shape[0]:
            raise ValueError(
                f"Expected a state of shape (V, {self.diffusivity.shape[0]}), one column for each diffusivity, "
                f"found {u.shape}."
            )
