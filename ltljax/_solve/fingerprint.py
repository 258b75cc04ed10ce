"""Whether two runs are the same (host).

What enters: an equation, a start, options: any value that describes a run. What leaves: a short text that is equal for
equal values, in this process and any other.
"""

import contextlib
import functools
import hashlib
import inspect
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def fingerprint(value: Any) -> str:
    """A text of 16 digits that differs where the value does.

    Arrays count by their bytes, records and objects by their type and fields, functions by their source and by the
    values that they have as defaults or from the functions around them. What a function reads from its module does not
    count, nor do the methods of a class.

    Raises:
        TypeError: the source of a function is not available, or an object has no fields to tell it by.
    """
    digest = hashlib.sha256()
    _feed(digest.update, value, [])
    return digest.hexdigest()[:16]


def read_from_modules(value: Any) -> dict[str, Any]:
    """The values that the functions in a value read from the modules they are written in, by module and name.

    Functions are looked for in pytrees, in closures, and among the values that other functions read. Those of
    installed packages count as constant.

    Args:
        value: a pytree, or a function.
    """
    values: dict[str, Any] = {}
    waiting, seen = list(jax.tree.leaves(value)), set()
    while waiting:
        function = inspect.unwrap(waiting.pop()) if callable(waiting[-1]) else waiting.pop()
        if isinstance(function, functools.partial):
            waiting += [function.func, *jax.tree.leaves((function.args, function.keywords))]
        if isinstance(function, types.MethodType):
            waiting += [function.__func__, function.__self__]
        if not isinstance(function, types.FunctionType) or id(function) in seen or _is_installed(function):
            continue
        seen.add(id(function))
        waiting += jax.tree.leaves(list(_enclosed(function).values()))
        for name in _names(function.__code__):
            if name in function.__globals__ and not isinstance(function.__globals__[name], types.ModuleType | type):
                values[f"{function.__module__}.{name}"] = function.__globals__[name]
                waiting += jax.tree.leaves(function.__globals__[name])
    return values


def _names(code: types.CodeType) -> set[str]:
    """The names that code and the functions within it may read from their module."""
    inner = [part for part in code.co_consts if isinstance(part, types.CodeType)]
    return set(code.co_names).union(*map(_names, inner))


def _is_installed(function: types.FunctionType) -> bool:
    file = function.__code__.co_filename
    return "site-packages" in file or (function.__module__ or "").split(".")[0] == "ltljax"


def _feed(update: Callable[[bytes], None], value: Any, within: list[int]) -> None:
    """Feed a value into a digest.

    Args:
        update: takes bytes.
        value: the value.
        within: the identities of the values that hold this one, from the outermost.
    """

    def put(text: str, *parts: Any) -> None:
        update(f"{text}\0".encode())
        for part in parts:
            _feed(update, part, within)

    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        value = jax.random.key_data(value)
    if isinstance(value, int | float) and not isinstance(value, bool) and _is_exact(value):
        put(repr(float(value)))  # 1 and 1.0 are one length of steps
    elif value is None or isinstance(value, bool | int | float | complex | str | bytes):
        put(repr(value))
    elif isinstance(value, np.ndarray | jax.Array | np.generic):
        array = np.asarray(value)
        put(f"{array.dtype}{array.shape}")
        if array.dtype.kind == "O":
            put("objects", *array.ravel().tolist())
        else:
            update(np.ascontiguousarray(array).tobytes())
    elif isinstance(value, set | frozenset):  # in an order that is the same in every process
        put("set", sorted(map(fingerprint, value)))
    elif isinstance(value, type | types.ModuleType | types.BuiltinFunctionType | np.ufunc):
        put(f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', value.__name__)}")
    elif id(value) in within:  # a value that holds itself
        put(f"the value {len(within) - within.index(id(value))} levels up")
    else:
        parts = _parts(value)
        within.append(id(value))
        put(*parts)
        within.pop()


def _is_exact(number: int | float) -> bool:
    try:
        return float(number) == number
    except OverflowError:
        return False


def _parts(value: Any) -> tuple[Any, ...]:
    """A text and the parts that tell a value from others of its kind."""
    if isinstance(value, tuple | list):
        return f"{len(value)} in order", *value
    if isinstance(value, Mapping):
        return f"{len(value)} by name", *((key, value[key]) for key in sorted(value, key=str))
    if isinstance(value, types.FunctionType):
        # The checks of shapes that jaxtyping wraps around a function change no result.
        if "jaxtyping" in value.__code__.co_filename and hasattr(value, "__wrapped__"):
            return "checked", inspect.unwrap(value, stop=lambda inner: not _only_checks(inner))
        return _source(value), value.__defaults__, value.__kwdefaults__, _enclosed(value)
    if isinstance(value, types.MethodType):
        return "method", value.__func__, value.__self__
    if isinstance(value, functools.partial):
        return "partial", value.func, value.args, value.keywords
    if hasattr(value, "__wrapped__") and not hasattr(value, "__self__"):  # what jit makes of a function
        return "wrapped", type(value), value.__wrapped__
    try:
        copied = value.__reduce_ex__(2)  # the fields of an object, as a copy of it would get them
    except Exception:  # objects answer this question with any exception there is
        raise TypeError(f"Objects of type {type(value).__name__} cannot be compared.") from None
    if isinstance(copied, str):
        return "object", type(value), copied
    return "object", type(value), *(list(part) if isinstance(part, Iterator) else part for part in copied[1:])


def _only_checks(function: Any) -> bool:
    """Whether a function is a wrapper of jaxtyping or beartype."""
    file = getattr(getattr(function, "__code__", None), "co_filename", "")
    return "jaxtyping" in file or "beartype" in file


def _enclosed(function: types.FunctionType) -> dict[str, Any]:
    """The values that a function has from the functions around it, by name."""
    values = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):  # not assigned yet
            values[name] = cell.cell_contents
    return values


def _source(function: types.FunctionType) -> str:
    try:
        if function.__code__.co_filename == "<string>":  # from exec, or from python -c, which later Pythons mix up
            raise OSError
        source = inspect.getsource(function.__code__)  # its own, not that of a function that it wraps
    except OSError:
        raise TypeError(f"The source of the function {function.__qualname__} is not available.") from None
    # Several lambdas may share their lines: their columns tell them apart.
    columns = [column for place in function.__code__.co_positions() for column in place[2:] if column is not None]
    return f"{source}{min(columns, default=0)}-{max(columns, default=0)}"
