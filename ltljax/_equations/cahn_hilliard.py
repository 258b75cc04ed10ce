"""The Cahn-Hilliard equation: phases that separate while their amounts are conserved."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._operators import laplacian, spectral_bound
from .._surface import Surface
from .equation import Equation


class CahnHilliard(Equation):
    """u_t = M Delta w with the chemical potential w = u^3 - u - eps^2 Delta u.

    Two phases, near -1 and 1, separate into domains that coarsen, with fronts about eps wide between them. The integral
    of u in ``surface.mass`` is conserved to rounding, and the energy
    ``integral of eps^2 |grad u|^2 / 2 + (u^2 - 1)^2 / 4`` decreases. The state is (V,) or (V, S), whose columns are
    independent. On a boundary the normal derivatives of u and w vanish.

    The equation is fourth order in space, so its stiffness is the square of the Laplacian's: the default solver needs a
    number of evaluations proportional to the number of vertices. A mesh resolves the fronts if its edges are shorter
    than eps.

    Attributes:
        width: front width eps.
        mobility: mobility M.

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
        """M b (eps^2 b + max |3 u^2 - 1|), where b bounds the eigenvalues of the Laplacian."""
        del t
        bound = spectral_bound(surface)
        steepness = jnp.asarray(self.width, u.dtype) ** 2 * bound + jnp.max(jnp.abs(3 * u**2 - 1))
        return jnp.asarray(self.mobility, u.dtype) * bound * steepness

    def spectral_width(self, t, surface: Surface, u):
        """Four times the default, because squaring the eigenvalue x + iy gives the imaginary part 2 x y."""
        return 4 * super().spectral_width(t, surface, u)
