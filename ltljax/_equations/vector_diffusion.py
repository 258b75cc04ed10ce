"""Diffusion and reaction of tangent vector fields."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._operators import connection, from_frame, spectral_bound, tangential, to_frame
from .._surface import Surface
from .._tables import AnyArray
from .equation import Equation

Reaction = Callable[..., AnyArray]


class VectorDiffusion(Equation):
    """X_t = D Delta X + f(X) for a tangent field X, the state (V, 3).

    Delta is `vector_laplacian`. The normal part of the initial state is ignored. With `Monotone` and without a
    reaction, no vector becomes longer than the longest one at the start.

    Attributes:
        diffusivity: D, a positive number.
        reaction: f, a plain function ``(X, params) -> rate`` of the vector (3,) at one point, whose tangent part is
            used; or None.
        params: parameters of the reaction, a pytree.
        symmetry: n if the state represents a field with n-fold rotational symmetry, as in `connection`.

    Source: Chen, Chi and Wu, arXiv 0907.1817, who announce vector-valued data; for the operator, see
    `vector_laplacian`.
    """

    diffusivity: Float[Array, ""] | float = 1.0
    reaction: Reaction | None = None
    params: Any = None
    symmetry: int = eqx.field(static=True, default=1)

    def rate(self, t, surface: Surface, u):
        """The time derivative D Delta X + f(X)."""
        return self.implicit_rate(t, surface, u) + self.explicit_rate(t, surface, u)

    def implicit_rate(self, t, surface: Surface, u):
        """D Delta X."""
        del t
        # If the surface does not move, XLA hoists the weights of the connection out of the time loop.
        diffused = from_frame(surface, connection(surface, self.symmetry)(to_frame(surface, u)))
        return self.diffusivities(u)[None] * diffused

    def explicit_rate(self, t, surface: Surface, u):
        """The tangent part of the reaction."""
        del t
        if self.reaction is None:
            return jnp.zeros_like(u)
        reaction, u = self.reaction, tangential(surface, u)
        rate = jnp.asarray(jax.vmap(lambda X: reaction(X, self.params))(u), u.dtype)
        if rate.shape != u.shape:
            raise ValueError(
                f"Expected a reaction that returns the shape it is given, {u.shape[1:]}, found {rate.shape[1:]}."
            )
        return tangential(surface, rate)

    def diffusivities(self, u):
        """D, once for each component."""
        return jnp.broadcast_to(jnp.asarray(self.diffusivity, u.dtype), u.shape[1:])

    @property
    def is_affine(self) -> bool:
        """Whether there is no reaction."""
        return self.reaction is None

    @property
    def size(self):
        """``u -> sizes``: the largest magnitude over all components of each vector field."""
        return _largest

    def held(self, t, surface: Surface, u):
        """The tangent part of the state."""
        del t
        return tangential(surface, u)

    def spectral_bound(self, t, surface: Surface, u):
        """D times the bound of the Laplacian, which also bounds the vector Laplacian, plus the largest row sum of the
        reaction's Jacobian."""
        bound = jnp.max(jnp.abs(self.diffusivities(u))) * spectral_bound(surface)
        if self.reaction is None:
            return bound
        rate = lambda u: self.explicit_rate(t, surface, u)  # noqa: E731
        axes = jnp.eye(3, dtype=u.dtype)
        columns = [jax.jvp(rate, (u,), (jnp.broadcast_to(unit[None], u.shape),))[1] for unit in axes]
        return bound + jnp.max(sum(jnp.abs(column) for column in columns))


def _largest(u: Array) -> Array:
    return jnp.broadcast_to(jnp.max(jnp.abs(u), axis=(0, -1), keepdims=True)[0], u.shape[1:])
