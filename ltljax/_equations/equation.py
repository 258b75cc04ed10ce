"""The interface of equations: the rate of change of a state, and bounds of its stiffness."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._operators import spectral_bound, spectral_width
from .._surface import Surface
from .boundary import Condition


class Equation(eqx.Module):
    """An evolution equation u_t = rate(t, surface, u) on a surface.

    A subclass must define `rate` and `spectral_bound`. Define `explicit_rate` to use implicit-explicit solvers, and
    `diffusivities` to precondition implicit stages by multigrid.
    """

    @abc.abstractmethod
    def rate(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, "V *S"]:
        """The time derivative of the state."""

    @abc.abstractmethod
    def spectral_bound(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, ""]:
        """An upper bound of the magnitudes of the eigenvalues of the rate's derivative at the state."""

    def diffusion_bound(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, ""]:
        """The part of `spectral_bound` that is due to diffusion; the rest is the reaction's."""
        del t
        return jnp.max(self.diffusivities(u)) * spectral_bound(surface)

    def spectral_width(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, ""]:
        """The extent of those eigenvalues off the real axis, as in `ltl.operators.spectral_width`.

        By default that of the Laplacian, scaled by the ratio of the spectral bounds.
        """
        bound = self.spectral_bound(t, surface, u)
        return bound * (spectral_width(surface) / spectral_bound(surface)).astype(bound.dtype)

    def explicit_rate(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, "V *S"]:
        """The nonstiff part of the rate; the rest, `implicit_rate`, must be affine in u."""
        raise NotImplementedError(
            f"{type(self).__name__} does not define the nonstiff part of its rate. Define explicit_rate and "
            "implicit_rate, or use a solver that does not split the rate, such as ltl.TRBDF2() or ltl.RKL2()."
        )

    def implicit_rate(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, "V *S"]:
        """The rate without its `explicit_rate`."""
        return self.rate(t, surface, u) - self.explicit_rate(t, surface, u)

    def diffusivities(self, u: Float[Array, "V *S"]) -> Float[Array, "*S"]:
        """The diffusivity of each species, from which multigrid builds its preconditioner."""
        return jnp.zeros(u.shape[1:], u.dtype)

    @property
    def size(self) -> Callable[[Array], Array]:
        """``u -> sizes (S,)``: the largest magnitude of each species of a state; tolerances are relative to it."""
        return _largest

    @property
    def is_affine(self) -> bool:
        """Whether the rate is affine in u."""
        return False

    def held(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, "V *S"]:
        """The state with the values that boundary conditions hold; by default the state itself."""
        del t, surface
        return u

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """The boundary conditions."""
        return ()


def _largest(u: Array) -> Array:
    return jnp.max(jnp.abs(u), axis=0)
