"""What runs and fits write and print alike: scenarios as TOML, versions, and numbers as people read them."""

import copy
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
import tomli_w

# What to do with an interrupted run or fit.
INTERRUPTED = "Continue it with --resume, start over with --overwrite, or name another --out."
NO_PICTURES = 'note: pictures need the extra "viz": pip install "ltljax[viz]"'
_PACKAGES = ("ltljax", "jax", "jaxlib", "numpy", "scipy", "trimesh", "equinox", "diffrax", "pyvista")


def scenario_toml(tables: Mapping[str, Any], changes: Mapping[str, Any], comment: str) -> str:
    """The text of a scenario file: a comment, and the tables with values changed by dotted key."""
    tables = copy.deepcopy({key: value for key, value in tables.items() if value not in ({}, [], ())})
    for key, value in changes.items():
        *path, last = key.split(".")
        inner: Any = tables
        for part in path:
            inner = inner[int(part)] if isinstance(inner, list) else inner[part]
        inner[last] = value
    return f"# {comment}\n{tomli_w.dumps(tables)}"


def versions() -> dict[str, str | None]:
    """The versions of Python and of the packages that results depend on; None for a package that is not installed."""
    numbers: dict[str, str | None] = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            numbers[package] = version(package)
        except PackageNotFoundError:
            numbers[package] = None
    return numbers


def as_json(value: Any) -> Any:
    """A value that JSON can hold."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


def readable(value: Any) -> str:
    """A measured value with six digits; a pair is a range."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple | list):
        return (" .. " if isinstance(value, tuple) else ", ").join(f"{v:.6g}" for v in value)
    return str(value)


def print_measured(measured: Mapping[str, Any]) -> None:
    """Print measured values in a table; None is left out."""
    for name, value in measured.items():
        if value is not None:
            print(f"{name.replace('_', ' '):32} {readable(value)}")
