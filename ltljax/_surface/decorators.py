"""Decorators for functions of a surface: a check of the arguments, and compilation."""

import functools
import inspect
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import equinox as eqx
import numpy as np

from .._base.arguments import as_numbers, kind_of
from .._mesh import Mesh
from .surface import Surface

P = ParamSpec("P")
R = TypeVar("R")


def on_surface(function: Callable[P, R]) -> Callable[P, R]:
    """The function with a check that its argument ``surface`` is a `Surface`.

    Raises:
        TypeError: the argument is not a `Surface`.
    """
    place = list(inspect.signature(function).parameters).index("surface")

    @functools.wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        # If the argument is missing, the call itself raises.
        if "surface" in kwargs or place < len(args):
            surface = kwargs.get("surface", args[place] if place < len(args) else None)
            if not isinstance(surface, Surface):
                advice = " Build one: ltl.Surface.from_mesh(mesh)." if isinstance(surface, Mesh) else ""
                raise TypeError(f"{function.__name__} expected a Surface as surface, found {kind_of(surface)}.{advice}")
        return function(*args, **kwargs)

    return checked


def on_device(function: Callable) -> Callable:
    """The function compiled, with checks of its arguments, including those of `on_surface`.

    Raises:
        TypeError: None, a sequence, a mapping, a set, a function or a string was passed as an array.
        ValueError: an argument is a masked array, whose mask JAX would drop.
    """
    parameters = inspect.signature(function).parameters
    names = list(parameters)
    array_names = {name for name, p in parameters.items() if p.default is p.empty and p.annotation is not str}
    array_names.discard("surface")
    compiled = eqx.filter_jit(function)

    @functools.wraps(function)
    def checked(*args, **kwargs):
        for name, value in (*zip(names, args, strict=False), *kwargs.items()):
            if isinstance(value, np.ma.MaskedArray):
                as_numbers(f"the argument of {function.__name__}", value)
            is_missing = name in array_names and (value is None or isinstance(value, str | tuple))
            if is_missing or isinstance(value, list | dict | set) or inspect.isroutine(value):
                raise TypeError(f"{function.__name__} expected an array as {name}, found {kind_of(value)}.")
        return compiled(*args, **kwargs)

    return on_surface(checked) if "surface" in names else checked
