"""A reaction as a value: the rates of change at a point, their parameters, and a uniform steady state."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Rates = Callable[[tuple[Array, ...], Any], tuple[Array, ...]]
Resting = Callable[[Any], tuple[Array, ...]]


class Kinetics(eqx.Module):
    """A reaction with its parameters.

    Attributes:
        rates: function ``(species, params) -> rates of change``, a tuple with one array (V,) per species. Arithmetic
            acts on all vertices at once; wrap a function of a single point in `jax.vmap`.
        params: pytree of scalars, or of fields (V,) over the surface.
        species: names of the species, in the order of the state's columns.
        resting: function ``params -> species`` that returns a uniform steady state, if one is known in closed form.
    """

    rates: Rates = eqx.field(static=True)
    params: Any = None
    species: tuple[str, ...] = eqx.field(static=True, default=("u", "v"))
    resting: Resting | None = eqx.field(static=True, default=None)

    def __call__(self, u: Float[Array, "V S"]) -> Float[Array, "V S"]:
        """The rates of change of all species at every vertex."""
        return _together(self.rates, u, self.params)

    def steady_state(self) -> Float[Array, " S"]:
        """A uniform state (S,) at which every rate vanishes; parameters that are fields are replaced by their means.

        Raises:
            ValueError: no steady state is known in closed form.
        """
        if self.resting is None:
            raise ValueError(
                f"No steady state of {getattr(self.rates, '__name__', 'these rates')} is known in closed form. "
                "Pass a state (u, v, ...) to ltl.solvers.dispersion or ltl.explain."
            )
        means = jax.tree.map(lambda p: jnp.mean(jnp.asarray(p, jnp.result_type(float))), self.params)
        return jnp.stack([jnp.asarray(s, jnp.result_type(float)) for s in self.resting(means)])


def with_params(rates: Rates, species: tuple[str, ...], resting: Resting, **params: Any) -> Kinetics:
    """A `Kinetics` whose parameters are a dictionary of arrays."""
    return Kinetics(rates, {name: jnp.asarray(value) for name, value in params.items()}, species, resting)


# Checkpointing stores only u for the reverse pass, and not every intermediate product of the rates.
@functools.partial(jax.checkpoint, prevent_cse=False, static_argnums=0)
def _together(rates: Rates, u: Array, params: Any) -> Array:
    count = u.shape[1]
    try:
        result: Any = rates(tuple(u[:, s] for s in range(count)), params)
    except ValueError as error:
        if "values to unpack" not in str(error):
            raise
        raise ValueError(f"The state has {count} species, and the reaction is for another number: {error}.") from error
    is_single = count == 1 and not isinstance(result, tuple | list) and jnp.ndim(result) < 2
    columns: tuple[Any, ...] = (result,) if is_single else tuple(result)
    if len(columns) != count or any(jnp.shape(column) not in ((), u.shape[:1]) for column in columns):
        shapes = ", ".join(str(jnp.shape(column)) for column in columns[:5])
        raise ValueError(
            f"Expected the reaction to return a tuple of {count} rates, one for each species, of shape {u.shape[:1]}, "
            f"found {len(columns)} of shape {shapes}."
        )
    return jnp.stack([jnp.broadcast_to(column, u.shape[:1]) for column in columns], axis=1)
