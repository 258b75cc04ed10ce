"""The `[fit]` of a scenario file: which of its numbers are unknown, what was measured, and how.

What enters: the table, the folder whose files it may name, the mesh. What leaves: a `Wanted`.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from ..._mesh import Mesh
from ..._mesh.columns import DataError, read_columns
from .reader import Table

_LOSSES = ("linear", "huber", "soft_l1", "cauchy")
_AXES = ("x", "y", "z")


@dataclasses.dataclass(frozen=True)
class Places:
    """Where data were measured: at all vertices, or at one of these.

    Attributes:
        vertices: (N,) vertices, in the order of the mesh.
        points: (N, 3) points in space.
        patches: (V,) number of the patch of each vertex, in the order of the mesh; -1 for none.
        operator: (N, V) dense weights of the vertices in each measurement, in the order of the mesh.
    """

    vertices: np.ndarray | None = None
    points: np.ndarray | None = None
    patches: np.ndarray | None = None
    operator: np.ndarray | None = None

    def is_same(self, other: "Places") -> bool:
        """Whether two files have the same places."""
        pairs = [(getattr(self, field.name), getattr(other, field.name)) for field in dataclasses.fields(self)]
        return all((a is None) == (b is None) and (a is None or np.array_equal(a, b)) for a, b in pairs)


@dataclasses.dataclass(frozen=True)
class Wanted:
    """What is to be fitted, to what.

    Attributes:
        start: first guesses, by dotted key.
        values: (T, N, S) what was measured; NaN where nothing was.
        times: (T,).
        places: where it was measured.
        species: (S,) columns of the state that were seen.
        options: noise, relative noise, loss, scale, offset and background, by the names that observations have for
            them; True for a scale or an offset that is unknown.
        max_steps: number of steps of the fit at most.
        files: files that were read.
    """

    start: dict[str, float]
    values: np.ndarray
    times: np.ndarray
    places: Places
    species: tuple[int, ...]
    options: dict[str, Any]
    max_steps: int
    files: tuple[Path, ...]


def wanted(
    table: Table, numbers: dict[str, float], mesh: Mesh, species: tuple[str, ...], end: float, folder: Path,
    factor: float = 1.0,
) -> Wanted | None:  # fmt: skip
    """What the table asks for; None where there is none.

    Args:
        table: `[fit]`.
        numbers: what may be free, by dotted key: the scenario's numbers.
        mesh: where the data are.
        species: their names.
        end: the end of the run, after which nothing can have been seen.
        folder: the only one whose files may be named.
        factor: factor from the coordinates of the mesh file to those of the mesh.

    Raises:
        ScenarioError: a mistake in the table, or in a file that it names.
    """
    if not table.names():
        return None
    free = table.texts("free")
    if not free or len(set(free)) != len(free):
        raise table.error("free", "a list of the numbers that are to be found, each once,")
    for key in free:
        if key not in numbers:
            raise table.error("free", f"some of {', '.join(numbers)} (numbers, not formulas of the place)")
        if numbers[key] <= 0:
            raise table.error("free", f"numbers that are positive in this file: {key} is {numbers[key]:g}, but")
    options = _options(table)
    max_steps = table.count("max_steps", 200, 1, 100_000)
    files: list[Path] = []
    patches, operator = _patches(table, mesh, folder, files), _operator(table, mesh, folder, files)
    if patches is not None and operator is not None:
        raise table.error("operator", "either patches or an operator")
    seen, times, where, names, order = [], [], Places(), None, np.zeros(0, np.int64)
    for entry in table.tables("data"):
        path = entry.file("file", folder)
        time = entry.number("time", end, 0.0, end)
        entry.finish()
        columns = _columns(path, entry)
        places, order = _places(columns, mesh, patches, operator, factor, entry)
        which = tuple(s for s in species if s in columns)
        if not which:
            raise entry.error("file", f"a file with columns or arrays named {' or '.join(species)}")
        if seen and not (which == names and places.is_same(where)):
            raise entry.error("file", "the species and places of the first file of data")
        names, where = which, places
        for s in which:
            if columns[s].shape != (len(order),):
                raise entry.error("file", f"{len(order)} values of {s}, one for each place,")
            if missing := int(np.sum(np.isinf(columns[s]))):
                advice = f"nan where nothing was measured: {missing} are infinite"
                raise entry.error("file", f"finite values of {s}, or {advice},")
        state = np.empty((len(order), len(which)))
        state[order] = np.stack([columns[s] for s in which], axis=1)
        seen.append(state)
        times.append(time)
        files.append(path)
    if "background" in table and names:
        options["background"] = _background(table, names, order, folder, files)
    table.finish()
    if not seen:
        raise table.error("data", "at least one [[fit.data]] with a file and a time")
    if (np.diff(times) <= 0).any() or times[0] <= 0:
        raise table.error("data", "times that are positive and ascend from file to file")
    values = np.stack(seen)
    if np.sum(np.isfinite(values)) < max(len(free), 1):
        raise table.error("data", f"at least as many measured values as the {len(free)} unknowns")
    return Wanted(
        {key: numbers[key] for key in free}, values, np.array(times), where,
        tuple(species.index(s) for s in names or ()), options, max_steps, tuple(files),
    )  # fmt: skip


def _options(table: Table) -> dict[str, Any]:
    """Noise, loss, scale and offset."""
    if table.peek("noise") == "poisson":
        noise: Any = table.choice("noise", ("poisson",))
    else:
        noise = table.number("noise", 0.0, 0.0, 1e300) or None
    options: dict[str, Any] = dict(noise=noise, loss=table.choice("loss", _LOSSES, "linear"))
    if "relative_noise" in table:
        options["relative_noise"] = table.number("relative_noise", 0.0, 1e-300, 1e300)
        if not isinstance(noise, float):
            raise table.error("noise", "the noise where the signal is zero, beside relative_noise,")
    for key in ("scale", "offset"):
        if isinstance(table.peek(key), bool):
            options[key] = table.flag(key, False) or None
        elif key in table:
            options[key] = table.number(key, 1.0, *((1e-300, 1e300) if key == "scale" else (-1e300, 1e300)))
    return options


def _patches(table: Table, mesh: Mesh, folder: Path, files: list[Path]) -> np.ndarray | None:
    """The number of the patch of each vertex, in the order of the mesh; None where the table names no file of them."""
    if "patches" not in table:
        return None
    path = table.file("patches", folder)
    numbers = _columns(path, table, "patches").get("patch")
    if numbers is None or numbers.shape != (mesh.num_vertices,) or (numbers != np.floor(numbers)).any():
        raise table.error(
            "patches", f"a file with a column patch of {mesh.num_vertices} whole numbers, -1 for a vertex in no patch,"
        )
    files.append(path)
    ordered = np.empty(len(numbers), np.int64)
    ordered[mesh.source_order] = numbers
    return ordered


def _operator(table: Table, mesh: Mesh, folder: Path, files: list[Path]) -> np.ndarray | None:
    """The weights of the vertices in each measurement (N, V), in the order of the mesh; None where none are named."""
    if "operator" not in table:
        return None
    path = table.file("operator", folder)
    weights = _columns(path, table, "operator").get("weights")
    if weights is None or weights.ndim != 2 or weights.shape[1] != mesh.num_vertices:
        raise table.error(
            "operator",
            f"an .npz file with an array weights of a row of {mesh.num_vertices} numbers for each measurement,",
        )
    files.append(path)
    ordered = np.empty_like(weights)
    ordered[:, mesh.source_order] = weights
    return ordered


def _background(
    table: Table, names: tuple[str, ...], order: np.ndarray, folder: Path, files: list[Path]
) -> np.ndarray:  # fmt: skip
    """The pattern (N, S) of which the data hold an unknown amount, in the order of the data."""
    path = table.file("background", folder)
    columns = _columns(path, table, "background")
    for name in names:
        if name not in columns or columns[name].shape != (len(order),) or not np.isfinite(columns[name]).all():
            raise table.error("background", f"a file with a column {name} of {len(order)} finite numbers")
    files.append(path)
    pattern = np.empty((len(order), len(names)))
    pattern[order] = np.stack([columns[name] for name in names], axis=1)
    if not pattern.any():
        raise table.error("background", "a pattern that is not zero everywhere")
    return pattern


def _places(
    columns: dict[str, np.ndarray], mesh: Mesh, patches: np.ndarray | None, operator: np.ndarray | None, factor: float,
    table: Table,
) -> tuple[Places, np.ndarray]:  # fmt: skip
    """Where the rows of a file were measured, and the row of the data that each of its rows becomes."""
    if operator is not None:
        return Places(operator=operator), np.arange(len(operator))
    numbers_of_vertices = columns.pop("vertex", None)
    if numbers_of_vertices is not None:
        return Places(_vertices(numbers_of_vertices, mesh, table)), np.arange(len(numbers_of_vertices))
    if patches is not None:
        numbers, count = columns.pop("patch", None), int(patches.max()) + 1
        if numbers is None or not np.array_equal(np.sort(numbers), np.arange(count)):
            raise table.error("file", f"a column patch that names each of the {count} patches once, from 0,")
        return Places(patches=patches), numbers.astype(np.int64)
    if set(_AXES) <= columns.keys():
        points = np.stack([columns.pop(axis) for axis in _AXES], axis=1)
        return Places(points=factor * points), np.arange(len(points))
    return Places(), np.asarray(mesh.source_order)


def _vertices(numbers: np.ndarray, mesh: Mesh, table: Table) -> np.ndarray:
    """Vertices of the mesh, from their numbers in its file."""
    vertices = numbers.astype(np.int64)
    if (vertices != numbers).any() or len(np.unique(vertices)) != len(vertices):
        raise table.error("file", "whole numbers as its column vertex, each once,")
    if (vertices < 0).any() or (vertices >= mesh.num_vertices).any():
        bad = vertices[(vertices < 0) | (vertices >= mesh.num_vertices)][0]
        raise table.error("file", f"vertices from 0 to {mesh.num_vertices - 1}, not {bad},")
    return np.asarray(mesh.source_order)[vertices]


def _columns(path: Path, table: Table, key: str = "file") -> dict[str, np.ndarray]:
    """The arrays of a file, by name."""
    try:
        return {name: np.asarray(values, np.float64) for name, values in read_columns(path).items()}
    except DataError as error:
        raise table.error(key, error.expected) from None
