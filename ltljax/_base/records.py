"""Records of ltljax as files, without pickle.

What enters: a record, that is a dataclass or an equinox module of this package, of arrays, numbers, texts, containers
and further records. What leaves: an NPZ file; and from one, the record again. Such a file can only make records and
arrays: nothing in it is run.
"""

import dataclasses
import importlib
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_PACKAGE = __name__.partition(".")[0]
_VERSION = 1


def write_record(path: Path, record: Any) -> None:
    """Write a record to a file; one that is there is replaced, when the new one is complete.

    Raises:
        TypeError: the record holds something that cannot be kept in a file.
    """
    arrays: list[np.ndarray] = []
    tree = dict(ltljax=_VERSION, record=_described(record, arrays))
    if not path.parent.is_dir():
        raise ValueError(f"There is no folder {path.parent}. Make it first, or choose another one.")
    named: dict[str, Any] = {f"array_{i}": array for i, array in enumerate(arrays)}
    with tempfile.TemporaryDirectory(prefix=".ltljax-", dir=path.parent) as draft:
        complete = Path(draft) / "record.npz"
        np.savez(complete, tree=np.array(json.dumps(tree)), **named)
        os.replace(complete, path)


def read_record(path: Path, kind: type) -> Any:
    """The record in a file.

    Raises:
        ValueError: there is no such file, it is damaged, or it holds a record of another kind or version.
    """
    advice = f"Expected a file that {kind.__name__}.save wrote"
    if not path.is_file():
        raise ValueError(f"{advice}, and there is none at {path}.")
    try:
        with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
            tree = json.loads(file["tree"].item())
            if tree["ltljax"] != _VERSION:
                raise ValueError("it was written by another version of ltljax")
            record = _made(tree["record"], [file[f"array_{i}"] for i in range(len(file.files) - 1)])
    # NumPy, zipfile and what follows meet damaged archives with any exception there is.
    except Exception as error:
        raise ValueError(f"{advice}, found {path.name}: {' '.join(str(error).split())[:200]}.") from error
    if not isinstance(record, kind):
        raise ValueError(f"{advice}, found a {type(record).__name__}.")
    return record


def _described(value: Any, arrays: list[np.ndarray]) -> Any:
    """A value as JSON; arrays are put into the list, and named by their place in it."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray | jax.Array | np.generic):
        arrays.append(np.asarray(value))
        return {"array": len(arrays) - 1, "on": "device" if isinstance(value, jax.Array) else "host"}
    if isinstance(value, tuple | list):
        return {type(value).__name__: [_described(part, arrays) for part in value]}
    if isinstance(value, dict):
        return {"dict": [[_described(key, arrays), _described(part, arrays)] for key, part in value.items()]}
    if dataclasses.is_dataclass(value) and type(value).__module__.startswith(f"{_PACKAGE}."):
        fields = {field.name: _described(getattr(value, field.name), arrays) for field in dataclasses.fields(value)}
        return {"record": f"{type(value).__module__}:{type(value).__qualname__}", "fields": fields}
    raise TypeError(f"A {type(value).__name__} cannot be kept in a file.")


def _made(tree: Any, arrays: list[np.ndarray]) -> Any:
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        array = arrays[tree["array"]]
        if tree["on"] == "host":
            return array
        if array.dtype.itemsize == 8 and not jax.config.read("jax_enable_x64"):
            raise ValueError(f"{array.dtype} needs 64-bit numbers in JAX: jax.config.update('jax_enable_x64', True)")
        return jnp.asarray(array)
    if "tuple" in tree:
        return tuple(_made(part, arrays) for part in tree["tuple"])
    if "list" in tree:
        return [_made(part, arrays) for part in tree["list"]]
    if "dict" in tree:
        return {_made(key, arrays): _made(part, arrays) for key, part in tree["dict"]}
    module, _, name = tree["record"].partition(":")
    if not module.startswith(f"{_PACKAGE}."):
        raise ValueError(f"{module} is no part of ltljax")
    kind: Any = getattr(importlib.import_module(module), name)
    if not dataclasses.is_dataclass(kind) or {field.name for field in dataclasses.fields(kind)} != set(tree["fields"]):
        raise ValueError("it was written by another version of ltljax")
    record: Any = object.__new__(kind)  # type: ignore (checked above to be a class)
    for key, part in tree["fields"].items():
        object.__setattr__(record, key, _made(part, arrays))
    return record
