"""Records in NPZ files, without pickle.

A record is a dataclass or an equinox module of this package; its fields are arrays, numbers, strings, containers or
further records. Reading a file creates records and arrays and executes no code from the file.
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
_VERSION = 2


def write_record(path: Path, record: Any) -> None:
    """Write a record to a file; an existing file is replaced once the new file is complete.

    Raises:
        TypeError: a field of the record has a type that cannot be stored.
        ValueError: the folder does not exist.
    """
    arrays: list[np.ndarray] = []
    tree = dict(ltljax=_VERSION, record=_encoded(record, arrays))
    if not path.parent.is_dir():
        raise ValueError(f"There is no folder {path.parent}. Create it first, or choose another folder.")
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
    expected = f"Expected a file that {kind.__name__}.save wrote"
    if not path.is_file():
        raise ValueError(f"{expected}, but there is none at {path}.")
    try:
        with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
            tree = json.loads(file["tree"].item())
            if tree["ltljax"] != _VERSION:
                raise ValueError("it was written by another version of ltljax")
            record = _decoded(tree["record"], [file[f"array_{i}"] for i in range(len(file.files) - 1)])
    # NumPy and zipfile raise arbitrary exceptions on damaged archives.
    except Exception as error:
        raise ValueError(f"{expected}, found {path.name}: {' '.join(str(error).split())[:200]}.") from error
    if not isinstance(record, kind):
        raise ValueError(f"{expected}, found a {type(record).__name__}.")
    return record


def _encoded(value: Any, arrays: list[np.ndarray]) -> Any:
    """The value as JSON; arrays are appended to the list and replaced by their index in it."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray | jax.Array | np.generic):
        arrays.append(np.asarray(value))
        return {"array": len(arrays) - 1, "on": "device" if isinstance(value, jax.Array) else "host"}
    if isinstance(value, tuple | list):
        return {type(value).__name__: [_encoded(part, arrays) for part in value]}
    if isinstance(value, dict):
        return {"dict": [[_encoded(key, arrays), _encoded(part, arrays)] for key, part in value.items()]}
    if dataclasses.is_dataclass(value) and type(value).__module__.startswith(f"{_PACKAGE}."):
        fields = {field.name: _encoded(getattr(value, field.name), arrays) for field in dataclasses.fields(value)}
        return {"record": f"{type(value).__module__}:{type(value).__qualname__}", "fields": fields}
    raise TypeError(f"A {type(value).__name__} cannot be stored in a file.")


def _decoded(tree: Any, arrays: list[np.ndarray]) -> Any:
    """The value that `_encoded` turned into JSON."""
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        array = arrays[tree["array"]]
        if tree["on"] == "host":
            return array
        if array.dtype.itemsize == 8 and not jax.config.read("jax_enable_x64"):
            raise ValueError(f"{array.dtype} needs 64-bit mode in JAX: jax.config.update('jax_enable_x64', True)")
        return jnp.asarray(array)
    if "tuple" in tree:
        return tuple(_decoded(part, arrays) for part in tree["tuple"])
    if "list" in tree:
        return [_decoded(part, arrays) for part in tree["list"]]
    if "dict" in tree:
        return {_decoded(key, arrays): _decoded(part, arrays) for key, part in tree["dict"]}
    module, _, name = tree["record"].partition(":")
    if not module.startswith(f"{_PACKAGE}."):
        raise ValueError(f"{module} is not part of ltljax")
    kind: Any = getattr(importlib.import_module(module), name)
    if not dataclasses.is_dataclass(kind) or {field.name for field in dataclasses.fields(kind)} != set(tree["fields"]):
        raise ValueError("it was written by another version of ltljax")
    record: Any = object.__new__(kind)  # type: ignore (a dataclass, as checked above)
    for key, part in tree["fields"].items():
        object.__setattr__(record, key, _decoded(part, arrays))
    return record
