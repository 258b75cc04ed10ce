"""Checks of the arguments of image filters, on the host.

What enters: a surface, a signal (V,) or colours (V, C), and numbers. What leaves: the same in the surface's float type,
or one clear error. Values that JAX is tracing are not checked.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from ..._base.arguments import as_numbers
from ..._solve.solution import SolveError
from ..._surface import Surface
from ..._tables import AnyArray


def signal(surface: Surface, u: AnyArray, name: str = "u") -> Float[Array, "V *C"]:
    """The signal in the float type of the surface.

    Raises:
        ValueError: the signal does not fit the surface, or is NaN or infinite somewhere.
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
            index = np.argwhere(is_bad)[0]
            raise ValueError(
                f"Expected finite values, found {name} = {np.asarray(u)[tuple(index)]} at vertex {index[0]}. Fill in "
                "missing values with ltl.imaging.inpaint."
            )
    return u


def same_shape(u: Array, other: Array, name: str) -> None:
    """Raise if two signals differ in shape."""
    if u.shape != other.shape:
        raise ValueError(f"Expected {name} of the shape of u, {u.shape}, found {other.shape}.")


def number(surface: Surface, name: str, value: Any, *, may_be_zero: bool = False) -> Float[Array, ""]:
    """The value as a scalar in the float type of the surface.

    Raises:
        ValueError: the value is not a single finite number, is negative, or is zero where it must be positive.
    """
    if jnp.shape(value) != ():
        raise ValueError(f"Expected {name} as one number, found the shape {jnp.shape(value)}.")
    if not isinstance(value, Tracer):
        x = float(value)
        if not np.isfinite(x) or x < 0 or (x == 0 and not may_be_zero):
            sign = "not negative" if may_be_zero else "positive"
            raise ValueError(f"Expected {name} to be finite and {sign}, found {x:g}.")
    return jnp.asarray(value, surface.dtype)


def missing(surface: Surface, mask: AnyArray) -> Bool[Array, " V"]:
    """The mask of the vertices without a value.

    Raises:
        ValueError: the mask does not fit the surface, or leaves a connected component without a known value.
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
            part = f"component {int(np.argmin(known))} of the surface" if len(known) > 1 else "the surface"
            raise ValueError(f"No vertex of {part} has a known value: mask is True at all of them. Unmask some.")
    return jnp.asarray(mask)


def check(what: str, is_converged: Array) -> None:
    """Raise if an iteration did not converge; inside jit nothing is raised."""
    if not isinstance(is_converged, Tracer) and not bool(is_converged):
        raise SolveError(
            f"The iteration for {what} did not converge. Causes are (a) a tolerance beyond the float type, (b) too few "
            "iterations, or (c) faces without area. Raise rtol or max_iterations, use float64, or repair the mesh."
        )
