"""Deprecated names, which still work for one release and warn with a `DeprecationWarning` that gives the new name."""

import functools
import warnings
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

# The release in which the old names are removed.
REMOVED_IN = "0.3"


def warn_deprecated(old: str, new: str, stacklevel: int = 3) -> None:
    """Warn that a deprecated name is in use; by default, the warning points at the caller's caller."""
    message = f"{old} is deprecated and will be removed in version {REMOVED_IN}: use {new}."
    warnings.warn(message, DeprecationWarning, stacklevel=stacklevel)


def renamed_arguments(**new_names: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A decorator that passes deprecated keyword arguments on under their new names.

    Example: ``@renamed_arguments(max_steps="max_iterations")``.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def accepting(*args: P.args, **kwargs: P.kwargs) -> R:
            for old, new in new_names.items():
                if old in kwargs:
                    if new in kwargs:
                        raise TypeError(f"{function.__name__}() got both {new} and its old name {old}.")
                    warn_deprecated(f"The argument {old} of {function.__name__}", new)
                    kwargs[new] = kwargs.pop(old)
            return function(*args, **kwargs)

        return accepting

    return decorate


def deprecated_alias(old: str, new: Callable[P, R]) -> Callable[P, R]:
    """The function under its deprecated name."""

    @functools.wraps(new)
    def alias(*args: P.args, **kwargs: P.kwargs) -> R:
        warn_deprecated(old, new.__name__)
        return new(*args, **kwargs)

    # Under its own name and module, so that it can be pickled.
    alias.__module__, _, alias.__name__ = old.rpartition(".")
    alias.__qualname__ = alias.__name__
    return alias
