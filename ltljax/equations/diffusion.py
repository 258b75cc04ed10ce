"""Linear diffusion with a source."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..operators import laplacian, spectral_bound
from ..surface import Surface
from .equation import Equation

Source = Float[Array, "V *S"] | Callable[[Float[Array, ""], Float[Array, "V 3"]], Float[Array, "V *S"]]


class Diffusion(Equation):
    """u_t = D Delta u + g on a surface; on a boundary the normal derivative of u vanishes.

    Attributes:
        diffusivity: D, a positive number; for a state (V, S) also one number for each species, (S,).
        source: g: None, an array like the state, or a function ``(t, vertices) -> array``.

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 3.
    """

    diffusivity: Float[Array, "*S"] | float = 1.0
    source: Source | None = None

    def rate(self, t, surface: Surface, u):
        """The time derivative D Delta u + g."""
        diffusivity = jnp.broadcast_to(jnp.asarray(self.diffusivity, u.dtype), u.shape[1:])
        rate = diffusivity[None] * laplacian(surface, u)
        if self.source is None:
            return rate
        source = self.source(t, surface.vertices) if callable(self.source) else self.source
        return rate + jnp.asarray(source, u.dtype)

    def spectral_bound(self, t, surface: Surface, u):
        """The largest diffusivity times the bound of the Laplacian's eigenvalues."""
        return jnp.max(jnp.asarray(self.diffusivity, u.dtype)) * spectral_bound(surface)
