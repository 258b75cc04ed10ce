"""Equations on moving surfaces, whose deformation is a given function of time."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._surface import Surface
from .equation import Equation

Motion = Callable[[Float[Array, ""], Float[Array, "V 3"]], Float[Array, "V 3"]]


class Moving(Equation):
    """u_t + u div v = rate of another equation, on a surface whose vertices move with the velocity v.

    The state moves with the vertices, and the term u div v dilutes it where the surface grows, so the total amount of a
    species that only diffuses is conserved. The weights are recomputed for the positions of every stage, on the
    neighbours chosen for the surface passed to `solve`. Build that surface from an average shape, and keep deformations
    moderate.

    Attributes:
        equation: equation on the surface, such as `ReactionDiffusion`.
        motion: differentiable function ``(t, vertices) -> vertices`` from the vertices of the given surface to those at
            time t. For example ``lambda t, x: jnp.exp(0.1 * t) * x`` is exponential growth. Positions are relative to
            ``surface.centre``.

    Source: Crampin, Gaffney and Maini (1999), doi:10.1006/bulm.1999.0131, equation 2; on surfaces, Dziuk and Elliott
    (2007), doi:10.1093/imanum/drl023, equation 1.1.
    """

    equation: Equation
    motion: Motion

    def surface_at(self, t: Float[Array, ""], surface: Surface) -> Surface:
        """The surface at time t."""
        return surface.with_vertices(self.motion(t, surface.vertices).astype(surface.vertices.dtype))

    def dilution(self, t: Float[Array, ""], surface: Surface) -> Float[Array, " V"]:
        """div v, the relative growth rate of the area around each vertex."""

        def log_areas(t):
            return jnp.log(self.surface_at(t, surface).vertex_areas)

        return jax.jvp(log_areas, (t,), (jnp.ones_like(t),))[1]

    def rate(self, t, surface: Surface, u):
        """The equation's rate on the surface at time t, minus the dilution."""
        return self.equation.rate(t, self.surface_at(t, surface), u) - self._diluted(t, surface, u)

    def explicit_rate(self, t, surface: Surface, u):
        """The equation's explicit rate on the surface at time t, minus the dilution."""
        return self.equation.explicit_rate(t, self.surface_at(t, surface), u) - self._diluted(t, surface, u)

    def implicit_rate(self, t, surface: Surface, u):
        """The equation's implicit rate on the surface at time t."""
        return self.equation.implicit_rate(t, self.surface_at(t, surface), u)

    def diffusivities(self, u):
        """The diffusivities of the equation."""
        return self.equation.diffusivities(u)

    def spectral_bound(self, t, surface: Surface, u):
        """The equation's bound on the surface at time t, plus the fastest dilution."""
        bound = self.equation.spectral_bound(t, self.surface_at(t, surface), u)
        return bound + jnp.max(jnp.abs(self.dilution(t, surface)))

    def spectral_width(self, t, surface: Surface, u):
        """The equation's width on the surface at time t."""
        return self.equation.spectral_width(t, self.surface_at(t, surface), u)

    @property
    def size(self):
        """The size function of the equation."""
        return self.equation.size

    def held(self, t, surface: Surface, u):
        """The state with the values that the equation holds."""
        return self.equation.held(t, self.surface_at(t, surface), u)

    @property
    def conditions(self):
        """The equation's boundary conditions."""
        return self.equation.conditions

    def _diluted(self, t, surface: Surface, u):
        return self.dilution(t, surface).reshape(-1, *(1,) * (u.ndim - 1)) * u
