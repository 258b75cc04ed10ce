"""The one cache of the package: host values that live as long as the array they belong to.

Surfaces are immutable pytrees, so what is expensive to compute from their weights (a factorization, a multigrid
hierarchy, the stationary measure) is kept here and not in the record. Entries are found by the identity of an array and
are dropped when that array is freed. All functions may be called from several threads: the lock is never held while a
value is computed, so two threads may compute the same value, and the first to finish is the one that is kept.
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
    """The value of ``compute()``, computed once for this owner and name and kept as long as the owner is alive.

    Args:
        owner: an array, which can be referenced weakly.
        name: what is computed; the same name always stands for the same computation.
        compute: called if the value is not there.
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
    """A number by which a compiled program can ask the host for a value: see `value_of` and `release_with`."""
    handle = next(_next_handle)
    _handles[handle] = value
    return handle


def value_of(handle: int) -> Any:
    """The value of a handle, or None if it has been released."""
    return _handles.get(handle)


def release_with(handle: int, owner: Any) -> None:
    """Release a handle when its owner, an array, is freed."""
    weakref.finalize(owner, _handles.pop, handle, None)
