"""What is wrong with an image before anything is computed of it, and how fine the surface is that it lives on.

What enters: a surface, a signal (V,) or colours (V, C), numbers. What leaves: the same in the surface's float type, or
one clear error (host; what JAX is tracing is not looked into).
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from ..._base.arguments import as_numbers
from ..._solve.evolve import SolveError
from ..._surface import Surface
from ..._tables import AnyArray


def signal(surface: Surface, u: AnyArray, name: str = "u") -> Float[Array, "V *C"]:
    """The signal in the float type of the surface.

    Raises:
        ValueError: it does not fit the surface, or is not finite.
    """
    size = surface.num_vertices
    as_numbers(name, u)
    if jnp.ndim(u) not in (1, 2) or jnp.shape(u)[0] != size:
        raise ValueError(
            f"Expected {name} of shape ({size},) or ({size}, C), one row for each vertex, found {jnp.shape(u)}."
        )
    u = jnp.asarray(u, surface.dtype)
    if not isinstance(u, Tracer):
        is_bad = ~np.isfinite(np.asarray(u))
        if is_bad.any():
            at = np.argwhere(is_bad)[0]
            raise ValueError(
                f"Expected finite values, found {name} = {np.asarray(u)[tuple(at)]} at vertex {at[0]}. Values that are "
                "missing are filled in by ltl.imaging.inpaint."
            )
    return u


def same_shape(u: Array, other: Array, name: str) -> None:
    """Raise where two signals do not have the same shape."""
    if u.shape != other.shape:
        raise ValueError(f"Expected {name} of the shape of u, {u.shape}, found {other.shape}.")


def number(surface: Surface, name: str, value: Any, *, may_be_zero: bool = False) -> Float[Array, ""]:
    """The value as a scalar of the float type of the surface.

    Raises:
        ValueError: it is not one finite, positive number.
    """
    if jnp.shape(value) != ():
        raise ValueError(f"Expected {name} as one number, found the shape {jnp.shape(value)}.")
    if not isinstance(value, Tracer):
        found = float(value)
        if not np.isfinite(found) or found < 0 or (found == 0 and not may_be_zero):
            wanted = "not negative" if may_be_zero else "positive"
            raise ValueError(f"Expected {name} to be finite and {wanted}, found {found:g}.")
    return jnp.asarray(value, surface.dtype)


def missing(surface: Surface, mask: AnyArray) -> Bool[Array, " V"]:
    """The mask of the vertices without a value.

    Raises:
        ValueError: it is no mask of the vertices, or leaves a connected part of the surface without any value.
    """
    size = surface.num_vertices
    if jnp.shape(mask) != (size,) or jnp.asarray(mask).dtype != bool:
        raise ValueError(
            f"Expected a mask of booleans of shape ({size},), True where the value is missing, found "
            f"{jnp.asarray(mask).dtype} {jnp.shape(mask)}."
        )
    if not isinstance(mask, Tracer) and not isinstance(surface.topology.components, Tracer):
        known = np.bincount(np.asarray(surface.topology.components), ~np.asarray(mask), surface.topology.num_components)
        if not known.all():
            where = f"component {int(np.argmin(known))} of the surface" if len(known) > 1 else "the surface"
            raise ValueError(f"No vertex of {where} has a known value: mask is True at all of them. Unmask some.")
    return jnp.asarray(mask)


def check(what: str, found: Array) -> None:
    """Raise where an iteration outside of jit did not find what it was after."""
    if not isinstance(found, Tracer) and not bool(found):
        raise SolveError(
            f"The iteration for {what} did not converge. Causes are (a) a tolerance beyond the float type, (b) too few "
            "steps, or (c) faces without area. Raise the tolerance or max_steps, use float64, or repair the mesh."
        )
