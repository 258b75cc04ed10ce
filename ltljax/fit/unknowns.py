"""Unknowns without bounds: what is fitted becomes a flat vector on which any step is allowed.

What enters: the user's parameters, a pytree, and the range that each may take. What leaves: `Unknowns`, which carries
parameters to the vector and back.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..tables import AnyArray

# A parameter this near to an end of its range, as a share of it, has run there if it is to go on.
_NEAR = 1e-3


class Transform(eqx.Module):
    """The range of a parameter: a smooth map from all numbers onto it, and back."""

    def constrained(self, z: Array, scale: Array) -> Array:
        """The parameter of a free number."""
        raise NotImplementedError

    def free(self, x: Array, scale: Array) -> Array:
        """The free number of a parameter."""
        raise NotImplementedError

    def admits(self, x: np.ndarray) -> bool:
        """Whether parameters are inside the range."""
        raise NotImplementedError

    def at_end(self, x: np.ndarray, wanted: np.ndarray, scale: float) -> np.ndarray:
        """Which parameters have run to an end of the range, where values beyond it are wanted."""
        raise NotImplementedError


class Real(Transform):
    """Any number: x = scale z, with the start's root mean square as scale."""

    def constrained(self, z, scale):
        """The parameter."""
        return scale * z

    def free(self, x, scale):
        """The free number."""
        return x / scale

    def admits(self, x):
        """Whether all are finite."""
        return bool(np.isfinite(x).all())

    def at_end(self, x, wanted, scale):
        """None of them."""
        del wanted, scale
        return np.zeros(np.shape(x), bool)

    def __str__(self):
        return "finite"


class Positive(Transform):
    """Positive numbers: x = exp(z), so that steps are relative ones."""

    def constrained(self, z, scale):
        """The parameter."""
        del scale
        return jnp.exp(z)

    def free(self, x, scale):
        """The free number."""
        del scale
        return jnp.log(x)

    def admits(self, x):
        """Whether all are positive."""
        return bool((np.isfinite(x) & (x > 0)).all())

    def at_end(self, x, wanted, scale):
        """Those next to zero."""
        return (x < _NEAR * scale) & (wanted <= 0)

    def __str__(self):
        return "positive"


class Bounded(Transform):
    """Numbers between two bounds: x = low + (high - low) / (1 + exp(-z)).

    Attributes:
        low: the lower bound.
        high: the upper bound.
    """

    low: float
    high: float

    def __check_init__(self):
        if not self.low < self.high:
            raise ValueError(f"Expected bounds low < high, found {self.low} and {self.high}.")

    def constrained(self, z, scale):
        """The parameter."""
        del scale
        return self.low + (self.high - self.low) * jax.nn.sigmoid(z)

    def free(self, x, scale):
        """The free number."""
        del scale
        share = (x - self.low) / (self.high - self.low)
        return jnp.log(share) - jnp.log1p(-share)

    def admits(self, x):
        """Whether all are between the bounds."""
        return bool(((x > self.low) & (x < self.high)).all())

    def at_end(self, x, wanted, scale):
        """Those next to a bound."""
        del scale
        near = _NEAR * (self.high - self.low)
        return ((x < self.low + near) & (wanted <= self.low)) | ((x > self.high - near) & (wanted >= self.high))

    def __str__(self):
        return f"between {self.low:g} and {self.high:g}"


class Unknowns(eqx.Module):
    """The parameters as a flat vector without bounds.

    Attributes:
        transforms: of each leaf of the parameters.
        scales: of each leaf.
        names: of every entry of the vector.
        unravel: from a flat vector to the pytree.
    """

    transforms: tuple[Transform, ...]
    scales: tuple[Array, ...]
    names: tuple[str, ...] = eqx.field(static=True)
    unravel: Callable[[Array], Any] = eqx.field(static=True)

    def params(self, z: Float[Array, " n"]) -> Any:
        """The parameters of a vector."""
        leaves, structure = jax.tree.flatten(self.unravel(z))
        each = zip(leaves, self.transforms, self.scales, strict=True)
        return structure.unflatten([transform.constrained(leaf, scale) for leaf, transform, scale in each])

    def free(self, params: Any) -> Float[Array, " n"]:
        """The vector of parameters."""
        each = zip(jax.tree.leaves(params), self.transforms, self.scales, strict=True)
        free = [transform.free(jnp.asarray(leaf, scale.dtype), scale) for leaf, transform, scale in each]
        return jnp.concatenate([jnp.ravel(leaf) for leaf in free])

    def slopes(self, z: Float[Array, " n"]) -> Float[Array, " n"]:
        """The derivative of every parameter with respect to its own entry."""
        _, slopes = jax.jvp(lambda z: ravel_pytree(self.params(z))[0], (z,), (jnp.ones_like(z),))
        return slopes

    def at_end(self, params: Any, wanted: np.ndarray) -> np.ndarray:
        """(n,) whether each parameter has run to an end of its range, where values (n,) beyond it are wanted."""
        found, begin = [], 0
        for leaf, transform, scale in zip(jax.tree.leaves(params), self.transforms, self.scales, strict=True):
            x = np.ravel(np.asarray(leaf, np.float64))
            found.append(transform.at_end(x, wanted[begin : begin + x.size], float(scale)))
            begin += x.size
        return np.concatenate(found)


def unknowns(start: Any, transforms: Any = None) -> Unknowns:
    """The unknowns of a fit.

    Args:
        start: a pytree of floats or float arrays.
        transforms: a pytree of `Transform` that ``start`` continues, None for `Real`; one for all of them, or one for
            each entry of a dictionary.

    Raises:
        ValueError: a parameter is no float, outside its range, or a transform belongs to none.
    """
    paths, structure = jax.tree_util.tree_flatten_with_path(start)
    if not paths:
        raise ValueError("Expected at least one parameter to fit, found none.")
    if isinstance(transforms, dict) and isinstance(start, dict):
        if unknown := sorted(set(transforms) - set(start)):
            raise ValueError(
                f"There is no parameter {unknown[0]!r} to transform; there are {', '.join(map(str, start))}."
            )
        transforms = {key: transforms.get(key) for key in start}
    is_transform = lambda x: x is None or isinstance(x, Transform)  # noqa: E731
    try:
        chosen = jax.tree.map(
            lambda transform, below: jax.tree.map(lambda _: transform or Real(), below),
            transforms, start, is_leaf=is_transform,
        )  # fmt: skip
    except ValueError as error:
        raise ValueError(f"The transforms do not have the structure of the parameters: {error}") from None
    leaves_of_transforms = jax.tree.leaves(chosen, is_leaf=lambda x: isinstance(x, Transform))
    names, scales, dtype = [], [], jnp.result_type(float)
    for (path, leaf), transform in zip(paths, leaves_of_transforms, strict=True):
        name = "".join(str(getattr(key, "key", getattr(key, "idx", getattr(key, "name", key)))) + "." for key in path)
        name = name.rstrip(".") or "parameter"
        values = np.asarray(leaf)
        if not np.issubdtype(values.dtype, np.floating):
            raise ValueError(f"Expected parameter {name} to be a float or an array of floats, found {leaf!r}.")
        if not transform.admits(values):
            found = f"{values:g}" if values.ndim == 0 else f"values from {values.min():g} to {values.max():g}"
            raise ValueError(f"Expected the start of {name} to be {transform}, found {found}.")
        size = float(np.sqrt(np.mean(values**2, dtype=np.float64)))
        scales.append(jnp.asarray(size if size > 0 else 1.0, dtype))
        indices = np.ndindex(values.shape) if values.ndim else [()]
        names += [name + (f"[{','.join(map(str, i))}]" if i else "") for i in indices]
    _, unravel = ravel_pytree(structure.unflatten([jnp.zeros(np.shape(leaf), dtype) for _, leaf in paths]))
    return Unknowns(tuple(leaves_of_transforms), tuple(scales), tuple(names), unravel)


def as_floats(values: AnyArray) -> Array:
    """An array in the default float type."""
    return jnp.asarray(values, jnp.result_type(float))
