"""Unknowns without bounds: the fitted parameters become a flat vector on which any step is allowed.

The input is the user's pytree of parameters and their ranges; the output is `Unknowns`, which maps the parameters to
the vector and back.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .._tables import AnyArray

# A parameter counts as at the end of its range within this share of it, if the best value is beyond.
_NEAR = 1e-3


class Transform(eqx.Module):
    """The range of a parameter: a smooth map from the real numbers onto the range, and its inverse."""

    def constrained(self, z: Array, scale: Array) -> Array:
        """The parameter of a free number."""
        raise NotImplementedError

    def free(self, x: Array, scale: Array) -> Array:
        """The free number of a parameter."""
        raise NotImplementedError

    def admits(self, x: np.ndarray) -> bool:
        """Whether parameters are inside the range."""
        raise NotImplementedError

    def at_end(self, x: np.ndarray, best: np.ndarray, scale: float) -> np.ndarray:
        """Which parameters are at an end of the range because their best value is there or beyond."""
        raise NotImplementedError


def start_of(transform: Transform, default: float) -> float:
    """The start of a transform, or the default if it has none."""
    start = getattr(transform, "start", None)
    return default if start is None else float(start)


class Real(Transform):
    """Any real number: x = scale z, with the root mean square of the start as scale.

    Attributes:
        start: first guess of an unknown that has no other, as in ``Observations(offset=Real(0.0))``.
    """

    start: float | None = None

    def constrained(self, z, scale):
        """The parameter."""
        return scale * z

    def free(self, x, scale):
        """The free number."""
        return x / scale

    def admits(self, x):
        """Whether all are finite."""
        return bool(np.isfinite(x).all())

    def at_end(self, x, best, scale):
        """False for all."""
        del best, scale
        return np.zeros(np.shape(x), bool)

    def __str__(self):
        return "finite"


class Positive(Transform):
    """Positive numbers: x = exp(z), so that steps are relative changes.

    Attributes:
        start: first guess of an unknown that has no other, as in ``Observations(scale=Positive(1.0))``.
    """

    start: float | None = None

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

    def at_end(self, x, best, scale):
        """True next to zero."""
        return (x < _NEAR * scale) & (best <= 0)

    def __str__(self):
        return "positive"


class Bounded(Transform):
    """Numbers between two bounds: x = low + (high - low) / (1 + exp(-z)).

    Attributes:
        low: lower bound.
        high: upper bound.
        start: first guess of an unknown that has no other, as in ``Observations(scale=Bounded(...))``.
    """

    low: float
    high: float
    start: float | None = None

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

    def at_end(self, x, best, scale):
        """True next to a bound."""
        del scale
        margin = _NEAR * (self.high - self.low)
        return ((x < self.low + margin) & (best <= self.low)) | ((x > self.high - margin) & (best >= self.high))

    def __str__(self):
        return f"between {self.low:g} and {self.high:g}"


class Unknowns(eqx.Module):
    """The parameters and the unknowns of the measurement, together as a flat vector without bounds.

    Attributes:
        transforms: transform of each leaf.
        scales: scale of each leaf.
        names: name of every entry of the vector.
        unravel: function from a flat vector to the pair of parameters and calibration.
    """

    transforms: tuple[Transform, ...]
    scales: tuple[Array, ...]
    names: tuple[str, ...] = eqx.field(static=True)
    unravel: Callable[[Array], tuple[Any, dict[str, Any]]] = eqx.field(static=True)

    def values(self, z: Float[Array, " n"]) -> tuple[Any, dict[str, Array]]:
        """The parameters of a vector, and its calibration: the unknowns of the measurement, by name."""
        leaves, structure = jax.tree.flatten(self.unravel(z))
        each = zip(leaves, self.transforms, self.scales, strict=True)
        return structure.unflatten([transform.constrained(leaf, scale) for leaf, transform, scale in each])

    def params(self, z: Float[Array, " n"]) -> Any:
        """The parameters of a vector."""
        return self.values(z)[0]

    def calibration(self, z: Float[Array, " n"]) -> dict[str, Array]:
        """The unknowns of the measurement in a vector, by name."""
        return self.values(z)[1]

    def free(self, values: tuple[Any, dict[str, Any]]) -> Float[Array, " n"]:
        """The vector of parameters and calibration."""
        each = zip(jax.tree.leaves(values), self.transforms, self.scales, strict=True)
        free = [transform.free(jnp.asarray(leaf, scale.dtype), scale) for leaf, transform, scale in each]
        return jnp.concatenate([jnp.ravel(leaf) for leaf in free])

    @property
    def reach(self) -> Float[Array, " n"]:
        """The largest change of each entry in one step of a search: a factor of ten if the transform makes changes
        relative, no limit otherwise."""
        leaves = jax.tree.leaves(self.unravel(jnp.zeros(len(self.names), self.scales[0].dtype)))
        each = zip(leaves, self.transforms, strict=True)
        return jnp.concatenate([
            jnp.full(leaf.size, jnp.inf if isinstance(transform, Real) else jnp.log(10.0), leaf.dtype)
            for leaf, transform in each
        ])  # fmt: skip

    def slopes(self, z: Float[Array, " n"]) -> Float[Array, " n"]:
        """The derivative of each value with respect to its own entry of the vector."""
        _, slopes = jax.jvp(lambda z: ravel_pytree(self.values(z))[0], (z,), (jnp.ones_like(z),))
        return slopes

    def at_end(self, values: Any, best: np.ndarray) -> np.ndarray:
        """(n,) whether each value is at an end of its range because its best value (n,) is there or beyond."""
        is_at_end, begin = [], 0
        for leaf, transform, scale in zip(jax.tree.leaves(values), self.transforms, self.scales, strict=True):
            x = np.ravel(np.asarray(leaf, np.float64))
            is_at_end.append(transform.at_end(x, best[begin : begin + x.size], float(scale)))
            begin += x.size
        return np.concatenate(is_at_end)


def unknowns(
    start: Any, transforms: Any = None, calibration: dict[str, tuple[Any, Transform, float]] | None = None
) -> Unknowns:
    """The unknowns of a fit.

    Args:
        start: first guess: a pytree of floats or float arrays.
        transforms: a prefix of the pytree ``start`` with leaves `Transform`, or None for `Real`: one for all
            parameters, or one for each entry of a dictionary.
        calibration: first guess, transform and typical size of each unknown of the measurement, by name.

    Raises:
        ValueError: a parameter is not a float or is outside its range, or a transform belongs to no parameter.
    """
    calibration = calibration or {}
    own = _chosen(start, transforms)
    first = start, {name: guess for name, (guess, *_) in calibration.items()}
    measured = [calibration[name][1:] for name in sorted(calibration)]
    leaves_of_transforms = own + [transform for transform, _ in measured]
    sizes = [None] * len(own) + [size for _, size in measured]
    names, scales, dtype = [], [], jnp.result_type(float)
    paths, structure = jax.tree_util.tree_flatten_with_path(first)
    for (path, leaf), transform, size in zip(paths, leaves_of_transforms, sizes, strict=True):
        keys = [str(getattr(key, "key", getattr(key, "idx", getattr(key, "name", key)))) for key in path[1:]]
        name = ".".join(["data", *keys] if path[0].idx else keys) or "parameter"
        values = np.asarray(leaf)
        if not np.issubdtype(values.dtype, np.floating):
            raise ValueError(f"Expected parameter {name} to be a float or an array of floats, found {leaf!r}.")
        if not transform.admits(values):
            range_ = f"{values:g}" if values.ndim == 0 else f"values from {values.min():g} to {values.max():g}"
            raise ValueError(f"Expected the start of {name} to be {transform}, found {range_}.")
        size = float(np.sqrt(np.mean(values**2, dtype=np.float64))) if size is None else size
        scales.append(jnp.asarray(size if size > 0 else 1.0, dtype))
        indices = np.ndindex(values.shape) if values.ndim else [()]
        names += [name + (f"[{','.join(map(str, i))}]" if i else "") for i in indices]
    _, unravel = ravel_pytree(structure.unflatten([jnp.zeros(np.shape(leaf), dtype) for _, leaf in paths]))
    return Unknowns(tuple(leaves_of_transforms), tuple(scales), tuple(names), unravel)


def _chosen(start: Any, transforms: Any) -> list[Transform]:
    """The transform of each leaf of the parameters."""
    if not jax.tree.leaves(start):
        raise ValueError("Expected at least one parameter to fit, found none.")
    if isinstance(transforms, dict) and isinstance(start, dict):
        if unknown := sorted(set(transforms) - set(start)):
            raise ValueError(
                f"There is no parameter {unknown[0]!r} for its transform; there are {', '.join(map(str, start))}."
            )
        transforms = {key: transforms.get(key) for key in start}
    is_transform = lambda x: x is None or isinstance(x, Transform)  # noqa: E731
    try:
        chosen = jax.tree.map(
            lambda transform, below: jax.tree.map(lambda _: transform or Real(), below),
            transforms, start, is_leaf=is_transform,
        )  # fmt: skip
    except ValueError as error:
        raise ValueError(f"Expected transforms in the structure of the parameters: {error}") from None
    leaves = jax.tree.leaves(chosen, is_leaf=lambda x: isinstance(x, Transform))
    for transform in leaves:
        if getattr(transform, "start", None) is not None:
            raise ValueError(
                f"Expected a transform without a start, found {transform!r}. The start of fit() is the first guess."
            )
    return leaves


def as_floats(values: AnyArray) -> Array:
    """An array in the default float type."""
    return jnp.asarray(values, jnp.result_type(float))
