"""Fingerprints, by which two runs are compared (host).

What enters: any value that describes a run, such as an equation, an initial state or an option. What leaves: a short
text that is the same for equal values in every process.
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
    """A text of 16 hexadecimal digits that differs between different values.

    Arrays are compared by their bytes, records and objects by their type and fields, and functions by their source,
    default values and closures. The values that a function reads from its module and the methods of a class are not
    compared.

    Raises:
        TypeError: the source of a function is not available, or the fields of an object cannot be read.
    """
    digest = hashlib.sha256()
    _feed(digest.update, value, [])
    return digest.hexdigest()[:16]


def read_from_modules(value: Any) -> dict[str, Any]:
    """The values that the functions in a pytree read from their modules, by module and name.

    The functions are those in the pytree, in closures, and among the values that other functions read. Functions of
    installed packages are left out.

    Args:
        value: a pytree or a function.
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
    """The names that a code object, and the functions inside it, may read from their module."""
    inner = [part for part in code.co_consts if isinstance(part, types.CodeType)]
    return set(code.co_names).union(*map(_names, inner))


def _is_installed(function: types.FunctionType) -> bool:
    file = function.__code__.co_filename
    return "site-packages" in file or (function.__module__ or "").split(".")[0] == "ltljax"


def _feed(update: Callable[[bytes], None], value: Any, within: list[int]) -> None:
    """Feed a value into a digest.

    Args:
        update: function that takes bytes.
        value: the value.
        within: identities of the values that contain this one, from the outermost.
    """

    def put(text: str, *parts: Any) -> None:
        update(f"{text}\0".encode())
        for part in parts:
            _feed(update, part, within)

    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        value = jax.random.key_data(value)
    if isinstance(value, int | float) and not isinstance(value, bool) and _is_exact(value):
        put(repr(float(value)))  # 1 and 1.0 are the same step length
    elif value is None or isinstance(value, bool | int | float | complex | str | bytes):
        put(repr(value))
    elif isinstance(value, np.ndarray | jax.Array | np.generic):
        array = np.asarray(value)
        put(f"{array.dtype}{array.shape}")
        if array.dtype.kind == "O":
            put("objects", *array.ravel().tolist())
        else:
            update(np.ascontiguousarray(array).tobytes())
    elif isinstance(value, set | frozenset):  # sorted, because their order differs between processes
        put("set", sorted(map(fingerprint, value)))
    elif isinstance(value, type | types.ModuleType | types.BuiltinFunctionType | np.ufunc):
        put(f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', value.__name__)}")
    elif id(value) in within:  # a value that contains itself
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
    """A text and the parts that distinguish a value from others of its kind."""
    if isinstance(value, tuple | list):
        return f"{len(value)} in order", *value
    if isinstance(value, Mapping):
        return f"{len(value)} by name", *((key, value[key]) for key in sorted(value, key=str))
    if isinstance(value, types.FunctionType):
        # The shape checks that jaxtyping wraps around a function do not change its results.
        if "jaxtyping" in value.__code__.co_filename and hasattr(value, "__wrapped__"):
            return "checked", inspect.unwrap(value, stop=lambda inner: not _only_checks(inner))
        return _source(value), value.__defaults__, value.__kwdefaults__, _enclosed(value)
    if isinstance(value, types.MethodType):
        return "method", value.__func__, value.__self__
    if isinstance(value, functools.partial):
        return "partial", value.func, value.args, value.keywords
    if hasattr(value, "__wrapped__") and not hasattr(value, "__self__"):  # a jit-compiled function
        return "wrapped", type(value), value.__wrapped__
    try:
        copied = value.__reduce_ex__(2)  # the fields that a copy of the object would get
    except Exception:  # objects may raise any exception
        raise TypeError(f"Objects of type {type(value).__name__} cannot be compared.") from None
    if isinstance(copied, str):
        return "object", type(value), copied
    return "object", type(value), *(list(part) if isinstance(part, Iterator) else part for part in copied[1:])


def _only_checks(function: Any) -> bool:
    """Whether a function is a wrapper made by jaxtyping or beartype."""
    file = getattr(getattr(function, "__code__", None), "co_filename", "")
    return "jaxtyping" in file or "beartype" in file


def _enclosed(function: types.FunctionType) -> dict[str, Any]:
    """The values in a function's closure, by name."""
    values = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):  # not assigned yet
            values[name] = cell.cell_contents
    return values


def _source(function: types.FunctionType) -> str:
    try:
        if function.__code__.co_filename == "<string>":  # exec or python -c, which newer Pythons confuse
            raise OSError
        source = inspect.getsource(function.__code__)  # not the source of a function that it wraps
    except OSError:
        raise TypeError(f"The source of the function {function.__qualname__} is not available.") from None
    # Several lambdas may share a line, so their columns are included.
    columns = [column for place in function.__code__.co_positions() for column in place[2:] if column is not None]
    return f"{source}{min(columns, default=0)}-{max(columns, default=0)}"
