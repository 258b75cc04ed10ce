"""Phases that separate and keep their amounts."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._operators import laplacian, spectral_bound
from .._surface import Surface
from .equation import Equation


class CahnHilliard(Equation):
    """u_t = M Delta w with the chemical potential w = u^3 - u - eps^2 Delta u.

    Two phases, near -1 and 1, separate into domains that coarsen, joined by fronts about eps wide. What diffusion
    conserves, the integral of u in ``surface.mass``, is conserved to rounding; the energy
    ``integral of eps^2 |grad u|^2 / 2 + (u^2 - 1)^2 / 4`` falls. State (V,) or (V, S), each column by itself. On a
    boundary the normal derivatives of u and w vanish.

    Of fourth order in space, so its stiffness grows with the square of the Laplacian's: the default solver takes a
    number of evaluations in proportion to that of the vertices. A mesh resolves the fronts where its edges are shorter
    than eps.

    Attributes:
        width: eps.
        mobility: M.

    Source: Cahn and Hilliard (1958), doi:10.1063/1.1744102; Cahn (1961), doi:10.1016/0001-6160(61)90182-1.
    """

    width: Float[Array, ""] | float = 0.05
    mobility: Float[Array, ""] | float = 1.0

    def rate(self, t, surface: Surface, u):
        """The time derivative M Delta w."""
        del t
        return jnp.asarray(self.mobility, u.dtype) * laplacian(surface, self.potential(surface, u))

    def potential(self, surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, "V *S"]:
        """The chemical potential w."""
        return u**3 - u - jnp.asarray(self.width, u.dtype) ** 2 * laplacian(surface, u)

    def spectral_bound(self, t, surface: Surface, u):
        """The mobility times bound (eps^2 bound + max |3 u^2 - 1|), bound being that of the Laplacian."""
        del t
        bound = spectral_bound(surface)
        steepness = jnp.asarray(self.width, u.dtype) ** 2 * bound + jnp.max(jnp.abs(3 * u**2 - 1))
        return jnp.asarray(self.mobility, u.dtype) * bound * steepness

    def spectral_width(self, t, surface: Surface, u):
        """Four times that in proportion to the bounds: the square of x + iy has the imaginary part 2 x y."""
        return 4 * super().spectral_width(t, surface, u)
