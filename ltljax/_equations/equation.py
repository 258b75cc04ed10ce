"""What every equation answers: its rate of change, and how stiff it is."""

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

    An equation of your own needs `rate` and `spectral_bound`. With `explicit_rate` it can be stepped by
    implicit-explicit solvers, and with `diffusivities` its implicit stages are preconditioned by multigrid.
    """

    @abc.abstractmethod
    def rate(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, "V *S"]:
        """The time derivative of the state."""

    @abc.abstractmethod
    def spectral_bound(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, ""]:
        """An upper bound of the magnitude of the eigenvalues of the rate's derivative at the state."""

    def spectral_width(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, ""]:
        """How far those eigenvalues lie off the real axis, as `ltl.operators.spectral_width` has it; by default as far as the
        Laplacian's, in proportion to the bounds."""
        bound = self.spectral_bound(t, surface, u)
        return bound * (spectral_width(surface) / spectral_bound(surface)).astype(bound.dtype)

    def explicit_rate(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, "V *S"]:
        """The part of the rate that is not stiff; what remains, `implicit_rate`, must be affine in u."""
        raise NotImplementedError(
            f"{type(self).__name__} does not say which part of its rate is not stiff. Define explicit_rate and "
            "implicit_rate, or take a solver that does not split the rate, such as ltl.TRBDF2() or ltl.RKL2()."
        )

    def implicit_rate(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, "V *S"]:
        """The rate without its `explicit_rate`."""
        return self.rate(t, surface, u) - self.explicit_rate(t, surface, u)

    def diffusivities(self, u: Float[Array, "V *S"]) -> Float[Array, "*S"]:
        """How fast each species of the state diffuses: what multigrid preconditions with."""
        return jnp.zeros(u.shape[1:], u.dtype)

    @property
    def size(self) -> Callable[[Array], Array]:
        """``u -> sizes (S,)``, the largest magnitude of each species of a state, which tolerances are relative to."""
        return _largest

    @property
    def is_affine(self) -> bool:
        """Whether the rate is affine in u."""
        return False

    def held(self, t: Float[Array, ""], surface: Surface, u: Float[Array, "V *S"]) -> Float[Array, "V *S"]:
        """The state with the values that boundary conditions hold; the state itself where there are none."""
        del t, surface
        return u

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """The boundary conditions."""
        return ()


def _largest(u: Array) -> Array:
    return jnp.max(jnp.abs(u), axis=0)
