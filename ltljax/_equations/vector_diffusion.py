"""Tangent vector fields that diffuse and react."""

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

    Delta is `vector_laplacian`; a normal part of the start is left out. Without a reaction no vector becomes longer
    than the longest at the start (with `Monotone`).

    Attributes:
        diffusivity: D, a positive number.
        reaction: f, a plain function ``(X, params) -> rate`` of the vector at one point, (3,); of the rate the tangent
            part counts. None for none.
        params: the parameters of the reaction, a pytree.
        symmetry: n where the state is the n-th power, in the frames, of a field that looks the same after a turn by
            1/n: see `connection`.

    Source: Chen, Chi and Wu, arXiv 0907.1817, who announce vector-valued data; the operator as of `vector_laplacian`.
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
        # Of a surface that stays, XLA weighs the connection once for all steps.
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
        """D for every component."""
        return jnp.broadcast_to(jnp.asarray(self.diffusivity, u.dtype), u.shape[1:])

    @property
    def is_affine(self) -> bool:
        """Whether there is no reaction."""
        return self.reaction is None

    @property
    def size(self):
        """Of each vector field the largest magnitude of its components, in whichever direction."""
        return _largest

    def held(self, t, surface: Surface, u):
        """The tangent part of the state."""
        del t
        return tangential(surface, u)

    def spectral_bound(self, t, surface: Surface, u):
        """The largest diffusivity times the Laplacian's bound, which is the vector Laplacian's too, and the largest row
        sum of the reaction's Jacobian."""
        bound = jnp.max(jnp.abs(self.diffusivities(u))) * spectral_bound(surface)
        if self.reaction is None:
            return bound
        rate = lambda u: self.explicit_rate(t, surface, u)  # noqa: E731
        axes = jnp.eye(3, dtype=u.dtype)
        columns = [jax.jvp(rate, (u,), (jnp.broadcast_to(unit[None], u.shape),))[1] for unit in axes]
        return bound + jnp.max(sum(jnp.abs(column) for column in columns))


def _largest(u: Array) -> Array:
    return jnp.broadcast_to(jnp.max(jnp.abs(u), axis=(0, -1), keepdims=True)[0], u.shape[1:])
