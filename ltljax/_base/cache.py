"""A cache of host values that live as long as the array they belong to.

Surfaces are immutable pytrees, so values that are expensive to compute from their weights (a factorization, a multigrid
hierarchy, the stationary measure) are stored here instead of in the surface. Entries are keyed by the identity of an
array and removed when the array is freed. All functions are thread-safe. The lock is not held while a value is
computed, so two threads may compute the same value; the cache keeps the value that is ready first.
"""

import itertools
import threading
import weakref
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")

_lock = threading.Lock()
_values: dict[int, dict[str, Any]] = {}
_handles: dict[int, Any] = {}
_next_handle = itertools.count()


def remembered(owner: Any, name: str, compute: Callable[[], T]) -> T:
    """The value of ``compute()``, computed once for an owner and a name and cached until the owner is freed.

    Args:
        owner: an array, or another object that can be referenced weakly.
        name: name of the computation; a name always stands for the same computation.
        compute: function that is called if the value is not in the cache.
    """
    key = id(owner)
    with _lock:
        if key not in _values:
            _values[key] = {}
            weakref.finalize(owner, _values.pop, key, None)
        values = _values[key]
        if name in values:
            return values[name]
    value = compute()
    with _lock:
        return values.setdefault(name, value)


def new_handle(value: Any) -> int:
    """A number by which a compiled program can get a value from the host; see `value_of` and `release_with`."""
    handle = next(_next_handle)
    _handles[handle] = value
    return handle


def value_of(handle: int) -> Any:
    """The value of a handle, or None if the handle has been released."""
    return _handles.get(handle)


def release_with(handle: int, owner: Any) -> None:
    """Release a handle when an array, its owner, is freed."""
    weakref.finalize(owner, _handles.pop, handle, None)
