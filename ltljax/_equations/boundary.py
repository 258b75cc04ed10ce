"""Boundary conditions as values, and their effect on diffusion.

What enters: conditions, the time and the state. What leaves: boundary fluxes, and the state with the values that
conditions hold. Where no condition applies the normal derivative vanishes. If two conditions apply to the same vertex,
the later one wins. A condition changes a flux or a value at its own vertices; anything that joins vertices (such as
periodic boundaries) belongs to the mesh.
"""

import functools
import inspect
import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._operators import add_flux, laplacian, through_sides
from .._surface import Surface

# None for the whole boundary, the index of a boundary loop in mesh.boundary_loops, a mask (V,), or a predicate
# ``vertices (V, 3) -> (V,)``.
Where = None | int | Bool[Array, " V"] | Callable[[Float[Array, "V 3"]], Bool[Array, " V"]]
# None for all species of a state (V, S), the index of a species, or several indices.
Species = None | int | tuple[int, ...]
# A number, an array that fits the state, or a function ``(t, vertices) -> array``.
Data = Any


def _species(species: Species) -> Species:
    if species is None:
        return None
    if isinstance(species, tuple | list):
        return tuple(operator.index(index) for index in species)
    return operator.index(species)


class Neumann(eqx.Module):
    """du/dnu = flux on the boundary, where nu is the outward conormal.

    Attributes:
        flux: a number, an array (V,), (S,) or (V, S), or a function ``(t, vertices)`` that returns one of these. Also a
            gradient (V, 3) or (V, S, 3), whose component along the conormal is used; it fits both sides of a corner.
        where: None for the whole boundary, the index of a loop in ``mesh.boundary_loops``, a mask (V,), or a predicate
            ``vertices (V, 3) -> (V,)``.
        species: index of the species of a state (V, S) to which the condition applies, or several; None for all.
    """

    flux: Data = 0.0
    where: Where = None
    species: Species = eqx.field(default=None, static=True, converter=_species)


class Dirichlet(eqx.Module):
    """u = value on the boundary, or with a mask also at interior vertices.

    Attributes:
        value: a number, an array (V,), (S,) or (V, S), or a function ``(t, vertices)`` that returns one of these.
        where: as in `Neumann`.
        species: as in `Neumann`.
    """

    value: Data = 0.0
    where: Where = None
    species: Species = eqx.field(default=None, static=True, converter=_species)


class Robin(eqx.Module):
    """a u + b du/dnu = g on the boundary, where nu is the outward conormal. Diffusion is stable if a / b >= 0.

    Attributes:
        a: coefficient of u, in the forms that ``Dirichlet.value`` takes.
        b: nonzero coefficient of du/dnu, in the same forms.
        g: right-hand side, in the same forms.
        where: as in `Neumann`.
        species: as in `Neumann`.
    """

    a: Data = 1.0
    b: Data = 1.0
    g: Data = 0.0
    where: Where = None
    species: Species = eqx.field(default=None, static=True, converter=_species)


Condition = Neumann | Dirichlet | Robin
Conditions = Condition | tuple[Condition, ...]


def as_tuple(conditions: Conditions | list[Condition] | None) -> tuple[Condition, ...]:
    """The conditions as a tuple.

    Raises:
        TypeError: a value is not a boundary condition.
    """
    if conditions is None:
        return ()
    conditions = tuple(conditions) if isinstance(conditions, tuple | list) else (conditions,)
    for condition in conditions:
        if not isinstance(condition, Condition):
            raise TypeError(f"Expected ltl.Neumann, ltl.Dirichlet or ltl.Robin, found {condition!r}.")
    return conditions


def bounded_laplacian(
    surface: Surface, conditions: Conditions, t: Float[Array, ""], u: Float[Array, "V *S"]
) -> Float[Array, "V *S"]:
    """The Laplacian of a state that satisfies the conditions, including their fluxes."""
    rate, flux = laplacian(surface, u), fluxes(surface, conditions, t, u)
    return rate if flux is None else add_flux(surface, rate, flux)


def fluxes(
    surface: Surface, conditions: Conditions, t: Float[Array, ""], u: Float[Array, "V *S"]
) -> Float[Array, "2 B *S"] | None:
    """The normal derivatives of a state at both sides of every boundary vertex; None if no condition prescribes any."""
    conditions = as_tuple(conditions)
    if not any(isinstance(condition, Neumann | Robin) for condition in conditions):
        return None
    boundary = surface.topology.boundary
    through = jnp.zeros((2, boundary.shape[0], *u.shape[1:]), u.dtype)
    for condition in conditions:
        if isinstance(condition, Neumann):
            flux = through_sides(surface, _data(condition.flux, t, surface, u, may_be_gradient=True), u)
        elif isinstance(condition, Robin):
            a, b, g = (_data(data, t, surface, u) for data in (condition.a, condition.b, condition.g))
            flux = through_sides(surface, (g - a * u) / b, u)
        else:
            continue
        through = jnp.where(_covered(condition, surface, u)[boundary][None], flux, through)
    return through


def held(
    surface: Surface, conditions: Conditions, t: Float[Array, ""], u: Float[Array, "V *S"]
) -> Float[Array, "V *S"]:
    """The state with the values that Dirichlet conditions hold."""
    for condition in _dirichlet(conditions):
        u = _where(condition, surface, _data(condition.value, t, surface, u), u)
    return u


def held_rate(
    surface: Surface,
    conditions: Conditions,
    t: Float[Array, ""],
    u: Float[Array, "V *S"],
    rate: Float[Array, "V *S"],
) -> Float[Array, "V *S"]:
    """The rate of change, replaced at held vertices by the time derivative of the held values."""
    for condition in _dirichlet(conditions):
        t = jnp.asarray(t, u.dtype)
        _, change = jax.jvp(lambda t, c=condition: _data(c.value, t, surface, u), (t,), (jnp.ones_like(t),))
        rate = _where(condition, surface, change, rate)
    return rate


def released(surface: Surface, conditions: Conditions, rate: Float[Array, "V *S"]) -> Float[Array, "V *S"]:
    """The rate of change, set to zero where Dirichlet conditions hold the state."""
    for condition in _dirichlet(conditions):
        rate = _where(condition, surface, jnp.zeros_like(rate), rate)
    return rate


def held_values(surface: Surface, conditions: Conditions, u: Float[Array, "V *S"]) -> Bool[Array, "V *S"]:
    """The mask of the values of a state that Dirichlet conditions hold."""
    masks = [_covered(condition, surface, u) for condition in _dirichlet(conditions)]
    return functools.reduce(jnp.logical_or, masks, jnp.zeros(u.shape, bool))


def held_vertices(surface: Surface, conditions: Conditions) -> Bool[Array, " V"]:
    """The mask of the vertices at which Dirichlet conditions hold every species."""
    masks = [_mask(condition.where, surface) for condition in _dirichlet(conditions) if condition.species is None]
    return functools.reduce(jnp.logical_or, masks, jnp.zeros(surface.num_vertices, bool))


def absorption(
    surface: Surface, conditions: Conditions, t: Float[Array, ""], u: Float[Array, "V *S"]
) -> Float[Array, " V"]:
    """The contribution of Robin conditions to -Delta u at each vertex, per unit of u and averaged over species."""
    linear = tuple(
        Robin(condition.a, condition.b, 0.0, condition.where, condition.species)
        if isinstance(condition, Robin)
        else Neumann(0.0, condition.where, condition.species)
        for condition in as_tuple(conditions)
        if not isinstance(condition, Dirichlet)
    )
    absorbed = -bounded_laplacian(surface, linear, t, jnp.ones_like(u))
    return jnp.mean(absorbed.reshape(surface.num_vertices, -1), axis=1)


def stiffness(
    surface: Surface,
    conditions: Conditions,
    t: Float[Array, ""],
    u: Float[Array, "V *S"],
    weights: Float[Array, "B 2"] | None = None,
) -> Float[Array, ""]:
    """A bound of the change of the Laplacian's eigenvalues by Robin conditions.

    With ``weights``, of the eigenvalues of an operator that has these flux weights.
    """
    bound = jnp.zeros((), u.dtype)
    for condition in as_tuple(conditions):
        if isinstance(condition, Robin):
            ratio = _data(condition.a, t, surface, u) / _data(condition.b, t, surface, u)
            ratio = jnp.where(_covered(condition, surface, u), ratio, 0)
            added = add_flux(surface, jnp.zeros_like(u), through_sides(surface, jnp.abs(ratio), u), weights)
            bound = jnp.maximum(bound, jnp.max(jnp.abs(added)))
    return bound


def _dirichlet(conditions: Conditions) -> list[Dirichlet]:
    return [condition for condition in as_tuple(conditions) if isinstance(condition, Dirichlet)]


def _where(condition: Condition, surface: Surface, inside: Array, outside: Array) -> Array:
    return jnp.where(_covered(condition, surface, outside), inside, outside)


def _covered(condition: Condition, surface: Surface, u: Array) -> Bool[Array, "V *#S"]:
    """The mask of the values of a state to which a condition applies."""
    mask = _mask(condition.where, surface).reshape(-1, *(1,) * (u.ndim - 1))
    if condition.species is None:
        return mask
    if u.ndim != 2:
        raise ValueError(
            f"A condition for species {condition.species} needs a state of several species (V, S), found shape "
            f"{u.shape}."
        )
    chosen = (condition.species,) if isinstance(condition.species, int) else condition.species
    if not all(0 <= species < u.shape[1] for species in chosen):
        raise ValueError(f"Expected species from 0 to {u.shape[1] - 1}, found {condition.species} in a condition.")
    return mask & jnp.asarray([species in chosen for species in range(u.shape[1])])[None]


def _mask(where: Where, surface: Surface) -> Bool[Array, " V"]:
    """The mask of the vertices to which a condition applies."""
    topology = surface.topology
    is_mask = not (where is None or isinstance(where, int) or callable(where))
    if topology.num_loops == 0 and not is_mask:
        raise ValueError(
            "Expected a surface with a boundary for a boundary condition, but the surface is closed. To hold values at "
            "interior vertices, give a mask as `where`."
        )
    if isinstance(where, int) and not 0 <= where < topology.num_loops:
        raise ValueError(
            f"Expected the index of a boundary loop below {topology.num_loops} (see mesh.boundary_loops), "
            f"found {where}."
        )
    size = surface.num_vertices
    on_boundary = jnp.zeros(size, bool).at[topology.boundary].set(True)
    if where is None:
        return on_boundary
    if isinstance(where, int):
        return jnp.zeros(size, bool).at[topology.boundary].set(topology.loops == where)
    mask = where(surface.vertices) if callable(where) else jnp.asarray(where)
    if mask.shape != (size,) or mask.dtype != bool:
        raise ValueError(f"Expected `where` to give booleans of shape ({size},), found {mask.dtype} {mask.shape}.")
    return mask & on_boundary if callable(where) else mask


def _called(data: Callable, t: Any, surface: Surface) -> Any:
    """The value of a function ``(t, vertices)``.

    Raises:
        TypeError: the function takes other arguments.
    """
    try:
        inspect.signature(data).bind(t, surface.vertices)
    except TypeError:
        raise TypeError(
            "Expected boundary data as a number, an array or a function (t, vertices) -> array, found a function "
            f"{inspect.signature(data)}."
        ) from None
    return data(t, surface.vertices)


def _data(data: Data, t, surface: Surface, u: Array, *, may_be_gradient: bool = False) -> Array:
    """The data of a condition at time t, in the shape of the state or of its gradient."""
    values = jnp.asarray(_called(data, t, surface) if callable(data) else data, u.dtype)
    if may_be_gradient and values.shape == (*u.shape, 3):
        return values
    if values.shape == u.shape[:1] and u.ndim == 2:
        return jnp.broadcast_to(values[:, None], u.shape)
    if values.shape in ((), u.shape[1:]):
        return jnp.broadcast_to(values.reshape((1,) * (u.ndim - values.ndim) + values.shape), u.shape)
    if values.shape != u.shape:
        raise ValueError(
            f"Expected boundary data as a number or of shape {u.shape}{f' or {u.shape[:1]}' * (u.ndim - 1)}"
            f"{f' or {(*u.shape, 3)}' * may_be_gradient}, found {values.shape}."
        )
    return values
