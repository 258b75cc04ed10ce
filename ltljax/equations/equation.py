"""What every equation answers: its rate of change, and how stiff it is."""

import abc

import equinox as eqx
from jaxtyping import Array, Float

from ..surface import Surface


class Equation(eqx.Module):
    """An evolution equation u_t = rate(t, surface, u) on a surface."""

    @abc.abstractmethod
    def rate(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, "V *S"]:
        """The time derivative of the state."""

    @abc.abstractmethod
    def spectral_bound(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, ""]:
        """An upper bound of the magnitude of the eigenvalues of the rate's derivative at the state."""

    def held(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, "V *S"]:
        """The state with the values that boundary conditions hold; the state itself where there are none."""
        del t, surface
        return u
