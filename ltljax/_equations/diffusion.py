"""Linear diffusion with a source, for one field or several uncoupled species."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._surface import Surface
from . import boundary as bounds
from .boundary import Conditions
from .equation import Equation
from .spreads import Spreads, as_spreads, mean_diffusivities, spread_bound, spread_rate, spread_width

Source = Float[Array, "V *S"] | Callable[[Float[Array, ""], Float[Array, "V 3"]], Float[Array, "V *S"]]


class Diffusion(Equation):
    """u_t = D Delta u + g, or div(D grad u) + g where D varies, on a surface.

    Attributes:
        diffusivity: D, in one of three forms. A positive number. A field (V,) for div(D grad u), which may jump; zeros
            block the flux (`weighted_laplacian` with the harmonic mean). An `EllipticStencil`, such as diffusion along
            a direction field or drift with a flow. For a state (V, S) also one number per species, (S,), or a tuple
            with any of these forms for each species.
        source: g: None, an array like the state, or a function ``(t, vertices) -> array``.
        boundary: boundary conditions: `Neumann`, `Dirichlet` or `Robin`, or a tuple of these, for all species or some.
            By default the normal derivative vanishes.

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 3.
    """

    diffusivity: Spreads = eqx.field(default=1.0, converter=as_spreads)
    source: Source | None = None
    boundary: Conditions = eqx.field(default=(), converter=bounds.as_tuple)

    def rate(self, t, surface: Surface, u):
        """The time derivative D Delta u + g; for values held by a boundary condition, their own time derivative."""
        return self.implicit_rate(t, surface, u) + self.explicit_rate(t, surface, u)

    def implicit_rate(self, t, surface: Surface, u):
        """D Delta u, including boundary fluxes; for held values, their own time derivative."""
        u = self.held(t, surface, u)
        spread = spread_rate(surface, self.diffusivity, self.boundary, t, u)
        return bounds.held_rate(surface, self.boundary, t, u, spread)

    def explicit_rate(self, t, surface: Surface, u):
        """The source g, zero at held values."""
        if self.source is None:
            return jnp.zeros_like(u)
        source = self.source(t, surface.vertices) if callable(self.source) else self.source
        source = jnp.asarray(source, u.dtype)
        if source.shape != u.shape:
            raise ValueError(f"Expected a source with the shape of the state, {u.shape}, found {source.shape}.")
        return bounds.released(surface, self.boundary, source)

    def diffusivities(self, u):
        """D for every species, averaged if it varies over the surface."""
        return mean_diffusivities(self.diffusivity, u)

    @property
    def is_affine(self) -> bool:
        """True: the rate is affine in u."""
        return True

    @property
    def conditions(self):
        """The boundary conditions."""
        return bounds.as_tuple(self.boundary)

    def held(self, t, surface: Surface, u):
        """The state with the values that the boundary conditions hold."""
        return bounds.held(surface, self.boundary, t, u)

    def spectral_bound(self, t, surface: Surface, u):
        """The largest diffusivity times the Laplacian's bound, or the largest bound of the stencils."""
        return spread_bound(surface, self.diffusivity, self.boundary, t, u)

    def diffusion_bound(self, t, surface: Surface, u):
        """All of `spectral_bound`."""
        return self.spectral_bound(t, surface, u)

    def spectral_width(self, t, surface: Surface, u):
        """The largest diffusivity times the Laplacian's width, or the largest width of the stencils."""
        del t
        return spread_width(surface, self.diffusivity, u)
