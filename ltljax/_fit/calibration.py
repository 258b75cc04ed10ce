"""The calibration of data: measured value = ``scale * field + offset + amount * background``."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._base.arguments import as_numbers
from .unknowns import Bounded, Real, Transform, start_of


class Calibration(eqx.Module):
    """Scale, offset and background of data, each of them known or unknown.

    Attributes:
        scale: factor between field and data, or the `Transform` of an unknown factor.
        offset: constant between field and data, or the `Transform` of an unknown constant.
        background: known pattern of which the data contain an unknown amount; None for none.
        shape: shape of each unknown: () or the number of species.
    """

    scale: Transform | Array
    offset: Transform | Array
    background: Array | None
    shape: tuple[int, ...] = eqx.field(static=True)

    def unknowns(self, size: float) -> dict[str, tuple[np.ndarray, Transform, float]]:
        """First guess, transform and typical size of each unknown, by name.

        Args:
            size: typical size of the data.
        """
        unknown: dict[str, tuple[np.ndarray, Transform, float]] = {}
        for name, value, default, typical in (("scale", self.scale, 1.0, 1.0), ("offset", self.offset, 0.0, size)):
            if isinstance(value, Transform):
                start = start_of(value, _inside(value, default))
                unknown[name] = np.full(self.shape, start), value, max(abs(start), typical)
        if self.background is not None:
            strength = float(np.sqrt(np.mean(np.asarray(self.background, np.float64) ** 2)))
            unknown["background"] = np.zeros(self.shape), Real(), size / strength
        return unknown

    def __call__(self, field: Array, unknown: dict[str, Array]) -> Array:
        """The measured values for the values of a field, given the unknowns by name."""
        scale = unknown.get("scale", None if isinstance(self.scale, Transform) else self.scale)
        offset = unknown.get("offset", None if isinstance(self.offset, Transform) else self.offset)

        def full(value: Any) -> Array:
            return jnp.broadcast_to(jnp.asarray(value, field.dtype), field.shape)

        measured = field if scale is None else full(scale) * field
        measured = measured if offset is None else measured + full(offset)
        if self.background is not None and "background" in unknown:
            measured = measured + full(unknown["background"]) * full(self.background)
        return measured

    def guess(self, field: np.ndarray, values: np.ndarray, mask: np.ndarray) -> dict[str, np.ndarray]:
        """The least-squares unknowns for given values of the field; the first guess where they are out of range.

        Args:
            field: values of the field at the places of the data, in the shape of the data.
            values: the data.
            mask: which values were measured.
        """
        unknown = self.unknowns(float(np.sqrt(np.mean(values[mask] ** 2))) or 1.0)
        if not unknown:
            return {}
        terms = {"scale": field, "offset": np.ones_like(field)}
        if self.background is not None:
            terms["background"] = np.broadcast_to(np.asarray(self.background, field.dtype), field.shape)
        known = {
            name: np.broadcast_to(np.asarray(getattr(self, name)), self.shape)
            for name in ("scale", "offset")
            if name not in unknown
        }
        solved = {name: start.copy() for name, (start, _, _) in unknown.items()}
        for index in np.ndindex(self.shape):
            column = (..., *index)
            rows = mask[column]
            fixed = [factor[index] * terms[name][column][rows] for name, factor in known.items()]
            remainder = values[column][rows] - sum(fixed)
            columns = np.stack([terms[name][column][rows] for name in unknown], axis=-1)
            for name, value in zip(unknown, np.linalg.lstsq(columns, remainder)[0], strict=True):
                if unknown[name][1].admits(value):
                    solved[name][index] = value
        return solved


def calibration(scale: Any, offset: Any, background: Any, shape: tuple[int, ...], data: tuple[int, ...]) -> Calibration:
    """The calibration that a user describes.

    Args:
        scale: number, one number for each species, or transform; None for 1.
        offset: number, one number for each species, or transform; None for 0.
        background: array that broadcasts to the data; None for none.
        shape: shape of each unknown: () or the number of species.
        data: shape of the data.

    Raises:
        ValueError: a number is not finite, a scale is zero, or a shape does not match.
    """
    chosen: dict[str, Any] = {}
    for name, value, default in (("scale", scale, 1.0), ("offset", offset, 0.0)):
        if isinstance(value, Transform):
            start = np.asarray(start_of(value, _inside(value, default)), np.float64)
            if not value.admits(start):
                raise ValueError(f"Expected the start of {name} to be {value}, found {start:g}.")
            chosen[name] = value
            continue
        known = np.asarray(as_numbers(name, default if value is None else value), np.float64)
        if known.shape not in ((), shape) or not np.isfinite(known).all() or (name == "scale" and not known.all()):
            raise ValueError(
                f"Expected {name} as a finite number{' other than zero' if name == 'scale' else ''}, one for each "
                f"species, or unknown as Positive({default or 1.0:g}) or Real({default:g}), found {value!r}."
            )
        chosen[name] = jnp.asarray(known, jnp.result_type(float))
    if background is None:
        return Calibration(chosen["scale"], chosen["offset"], None, shape)
    pattern = np.asarray(as_numbers("background", background), np.float64)
    if not broadcasts(pattern.shape, data) or not np.isfinite(pattern).all() or not pattern.any():
        raise ValueError(
            f"Expected background as finite numbers, not all zero, of a shape that broadcasts to the values' {data}, "
            f"found the shape {pattern.shape}."
        )
    return Calibration(chosen["scale"], chosen["offset"], jnp.asarray(pattern, jnp.result_type(float)), shape)


def _inside(transform: Transform, default: float) -> float:
    """The default, or the middle of a bounded range that does not contain the default."""
    if isinstance(transform, Bounded) and not transform.admits(np.asarray(default)):
        return 0.5 * (transform.low + transform.high)
    return default


def broadcasts(shape: tuple[int, ...], to: tuple[int, ...]) -> bool:
    """Whether an array of a shape broadcasts to another shape."""
    try:
        return np.broadcast_shapes(shape, to) == to
    except ValueError:
        return False
