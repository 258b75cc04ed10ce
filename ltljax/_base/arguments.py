"""Checks of arguments: each function returns the value or raises with a message that names the argument."""

import inspect
import operator
from typing import Any

import numpy as np


def kind_of(value: Any) -> str:
    """The kind of a value, for a message."""
    if value is None:
        return "None"
    return "a function" if inspect.isroutine(value) else f"a {type(value).__name__}"


def as_numbers(name: str, value: Any) -> Any:
    """The value, unchanged, if converting it to an array of real numbers loses nothing.

    Raises:
        TypeError: the value is a function, a mapping or a set.
        ValueError: the value is a masked array, or an array of dates, text, complex numbers or objects.
    """
    if isinstance(value, dict | set) or inspect.isroutine(value):
        raise TypeError(f"Expected {name} as real numbers, found {kind_of(value)}.")
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError(
            f"Expected {name} as a plain array, found a masked array, whose mask would be lost. Fill it with "
            "values.filled(...), or leave out the masked entries."
        )
    if isinstance(value, list | tuple):
        for item in value:
            as_numbers(name, item)
    elif isinstance(value, np.ndarray | np.generic | str | bytes) and np.asarray(value).dtype.kind not in "biuf":
        kind = np.asarray(value).dtype
        raise ValueError(f"Expected {name} as real numbers, found type {kind}. Convert it with astype(float).")
    return value


def at_least(name: str, value: Any, least: int, most: int | None = None) -> int:
    """The value as an integer, if it is within the bounds."""
    try:
        count = operator.index(value)
    except TypeError:
        raise ValueError(f"{name} must be an integer, found {value!r}.") from None
    if count < least or (most is not None and count > most):
        limit = f"at least {least}" if most is None else f"from {least} to {most}"
        raise ValueError(f"{name} must be {limit}, found {count}.")
    return count


def positive(name: str, value: Any) -> float:
    """The value as a float, if it is positive and finite."""
    number = _number(name, value)
    if not 0 < number < float("inf"):
        raise ValueError(f"{name} must be positive and finite, found {number}.")
    return number


def not_negative(name: str, value: Any) -> float:
    """The value as a float, if it is finite and not negative."""
    number = _number(name, value)
    if not 0 <= number < float("inf"):
        raise ValueError(f"{name} must be finite and not negative, found {number}.")
    return number


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} must be a number, found {value!r}.") from None
