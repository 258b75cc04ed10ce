"""Linear diffusion with a source."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..operators import spectral_bound
from ..surface import Surface
from . import boundary as bounds
from .boundary import Conditions
from .equation import Equation

Source = Float[Array, "V *S"] | Callable[[Float[Array, ""], Float[Array, "V 3"]], Float[Array, "V *S"]]


class Diffusion(Equation):
    """u_t = D Delta u + g on a surface.

    Attributes:
        diffusivity: D, a positive number; for a state (V, S) also one number for each species, (S,).
        source: g: None, an array like the state, or a function ``(t, vertices) -> array``.
        boundary: `Neumann`, `Dirichlet` or `Robin`, or several; without any the normal derivative vanishes.

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 3.
    """

    diffusivity: Float[Array, "*S"] | float = 1.0
    source: Source | None = None
    boundary: Conditions = eqx.field(default=(), converter=bounds.as_tuple)

    def rate(self, t, surface: Surface, u):
        """The time derivative D Delta u + g; of a value that is held, that value's."""
        return self.implicit_rate(t, surface, u) + self.explicit_rate(t, surface, u)

    def implicit_rate(self, t, surface: Surface, u):
        """D Delta u with the fluxes through the boundary; of a value that is held, that value's rate."""
        u = self.held(t, surface, u)
        diffused = bounds.bounded_laplacian(surface, self.boundary, t, u)
        return bounds.held_rate(surface, self.boundary, t, u, self.diffusivities(u)[None] * diffused)

    def explicit_rate(self, t, surface: Surface, u):
        """The source g; zero where a value is held."""
        if self.source is None:
            return jnp.zeros_like(u)
        source = self.source(t, surface.vertices) if callable(self.source) else self.source
        source = jnp.asarray(source, u.dtype)
        if source.shape != u.shape:
            raise ValueError(f"Expected a source of the shape of the state, {u.shape}, found {source.shape}.")
        return bounds.released(surface, self.boundary, source)

    def diffusivities(self, u):
        """D for every species."""
        return jnp.broadcast_to(jnp.asarray(self.diffusivity, u.dtype), u.shape[1:])

    @property
    def is_affine(self) -> bool:
        """It is."""
        return True

    @property
    def conditions(self):
        """The boundary conditions."""
        return bounds.as_tuple(self.boundary)

    def held(self, t, surface: Surface, u):
        """The state with the values that the boundary conditions hold."""
        return bounds.held(surface, self.boundary, t, u)

    def spectral_bound(self, t, surface: Surface, u):
        """The largest diffusivity times the bound of the Laplacian's eigenvalues."""
        bound = spectral_bound(surface) + bounds.stiffness(surface, self.boundary, t, u)
        return jnp.max(jnp.abs(self.diffusivities(u))) * bound
