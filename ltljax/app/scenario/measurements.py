"""The table `[fit]` of a scenario file: which of its numbers are unknown, what was measured, and how.

What enters: the table, the folder whose files it may name, and the mesh. What leaves: a `FitTask`.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from ..._mesh import Mesh
from ..._mesh.columns import DataError, read_columns
from .tables import Table

_LOSSES = ("linear", "huber", "soft_l1", "cauchy")
_AXES = ("x", "y", "z")


@dataclasses.dataclass(frozen=True)
class Places:
    """Where the data were measured: at all vertices, or as one of the attributes says.

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
        """Whether two files were measured at the same places."""
        pairs = [(getattr(self, field.name), getattr(other, field.name)) for field in dataclasses.fields(self)]
        return all((a is None) == (b is None) and (a is None or np.array_equal(a, b)) for a, b in pairs)


@dataclasses.dataclass(frozen=True)
class FitTask:
    """The unknowns of a fit and the measurements that it explains.

    Attributes:
        start: first guesses, by dotted key.
        values: (T, N, S) measured values; NaN where nothing was measured.
        times: (T,) times of the measurements.
        places: places of the measurements.
        species: (S,) columns of the state that were measured.
        options: noise, relative_noise, loss, scale, offset and background, as arguments of `Observations`; True for a
            scale or an offset that is unknown.
        max_iterations: maximum number of iterations.
        files: files that were read, by the dotted key that names each.
    """

    start: dict[str, float]
    values: np.ndarray
    times: np.ndarray
    places: Places
    species: tuple[int, ...]
    options: dict[str, Any]
    max_iterations: int
    files: dict[str, Path]


@dataclasses.dataclass(frozen=True)
class _Snapshot:
    """What one file of data holds.

    Attributes:
        time: time of the measurement.
        values: (N, S) measured values, in the order of the places.
        species: names of the species.
        places: places of the measurements.
        order: (N,) position among the places of every row of the file.
    """

    time: float
    values: np.ndarray
    species: tuple[str, ...]
    places: Places
    order: np.ndarray


def read_fit(
    table: Table, numbers: dict[str, float], mesh: Mesh, species: tuple[str, ...], end: float, folder: Path,
    factor: float = 1.0,
) -> FitTask | None:  # fmt: skip
    """The fit that a table describes; None if the table is empty.

    Args:
        table: `[fit]`.
        numbers: the scenario's numbers, any of which may be an unknown, by dotted key.
        mesh: the mesh.
        species: names of the species.
        end: end of the run, after which nothing can be measured.
        folder: the only folder whose files the table may name.
        factor: factor from the coordinates of the mesh file to those of the mesh.

    Raises:
        ScenarioError: a mistake in the table, or in a file that it names.
    """
    if not table.names():
        return None
    free = _free(table, numbers)
    options = _options(table)
    key = "max_steps" if "max_steps" in table and "max_iterations" not in table else "max_iterations"
    max_iterations = table.count(key, 200, 1, 100_000)
    files: dict[str, Path] = {}
    patches, operator = _patches(table, mesh, folder, files), _operator(table, mesh, folder, files)
    if patches is not None and operator is not None:
        raise table.error("operator", "either patches or an operator")
    fixed = Places(patches=patches, operator=operator)
    snapshots: list[_Snapshot] = []
    for index, entry in enumerate(table.tables("data")):
        snapshot, path = _snapshot(entry, mesh, species, fixed, end, folder, factor)
        files[f"fit.data.{index}.file"] = path
        if snapshots and not (
            snapshot.species == snapshots[0].species and snapshot.places.is_same(snapshots[0].places)
        ):
            raise entry.error("file", "the species and places of the first file of data")
        snapshots.append(snapshot)
    if "background" in table and snapshots:
        options["background"] = _background(table, snapshots[0], folder, files)
    table.finish()
    if not snapshots:
        raise table.error("data", "at least one [[fit.data]] with a file and a time")
    times = np.array([snapshot.time for snapshot in snapshots])
    if (np.diff(times) <= 0).any() or times[0] <= 0:
        raise table.error("data", "times that are positive and ascend from file to file")
    values = np.stack([snapshot.values for snapshot in snapshots])
    if np.sum(np.isfinite(values)) < len(free):
        raise table.error("data", f"at least as many measured values as the {len(free)} unknowns")
    columns = tuple(species.index(s) for s in snapshots[0].species)
    start = {key: numbers[key] for key in free}
    return FitTask(start, values, times, snapshots[0].places, columns, options, max_iterations, files)


def _free(table: Table, numbers: dict[str, float]) -> list[str]:
    """The keys of the unknowns."""
    free = table.texts("free")
    if not free or len(set(free)) != len(free):
        raise table.error("free", "a list of the numbers to be fitted, each once,")
    for key in free:
        if key not in numbers:
            raise table.error("free", f"some of {', '.join(numbers)} (numbers, not formulas of the position)")
        if numbers[key] <= 0:
            raise table.refused(
                "free", f"Only positive numbers can be fitted, but {key} is {numbers[key]:g} in this file."
            )
    return free


def _options(table: Table) -> dict[str, Any]:
    """The noise, the loss, the scale and the offset."""
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


def _patches(table: Table, mesh: Mesh, folder: Path, files: dict[str, Path]) -> np.ndarray | None:
    """The number of the patch of each vertex, in the order of the mesh; None if the table has no patches."""
    expected = f"a file with a column patch of {mesh.num_vertices} whole numbers, -1 for a vertex in no patch,"
    numbers = _per_vertex(table, "patches", "patch", 1, expected, mesh, folder, files)
    if numbers is None:
        return None
    if (numbers != np.floor(numbers)).any():
        raise table.error("patches", expected)
    return numbers.astype(np.int64)


def _operator(table: Table, mesh: Mesh, folder: Path, files: dict[str, Path]) -> np.ndarray | None:
    """The weights (N, V) of each measurement, in the order of the mesh; None if the table has no operator."""
    expected = f"an .npz file with an array weights of a row of {mesh.num_vertices} numbers for each measurement,"
    return _per_vertex(table, "operator", "weights", 2, expected, mesh, folder, files)


def _per_vertex(
    table: Table, key: str, column: str, ndim: int, expected: str, mesh: Mesh, folder: Path, files: dict[str, Path]
) -> np.ndarray | None:
    """A column of a file whose last axis is the vertices, in the order of the mesh; None if the key is absent."""
    if key not in table:
        return None
    path = table.file(key, folder)
    values = _columns(path, table, key).get(column)
    if values is None or values.ndim != ndim or values.shape[-1] != mesh.num_vertices:
        raise table.error(key, expected)
    files[f"fit.{key}"] = path
    ordered = np.empty_like(values)
    ordered[..., mesh.source_order] = values
    return ordered


def _snapshot(
    entry: Table, mesh: Mesh, species: tuple[str, ...], fixed: Places, end: float, folder: Path, factor: float
) -> tuple[_Snapshot, Path]:
    """What the file of an entry of ``[[fit.data]]`` holds, and the file."""
    path = entry.file("file", folder)
    time = entry.number("time", end, 0.0, end)
    entry.finish()
    columns = _columns(path, entry)
    places, order = _places(columns, mesh, fixed, factor, entry)
    measured = tuple(s for s in species if s in columns)
    if not measured:
        raise entry.error("file", f"a file with columns or arrays named {' or '.join(species)}")
    for s in measured:
        if columns[s].shape != (len(order),):
            raise entry.error("file", f"{len(order)} values of {s}, one for each place,")
        if num_infinite := int(np.sum(np.isinf(columns[s]))):
            advice = f"nan where nothing was measured: {num_infinite} are infinite"
            raise entry.error("file", f"finite values of {s}, or {advice},")
    values = np.empty((len(order), len(measured)))
    values[order] = np.stack([columns[s] for s in measured], axis=1)
    return _Snapshot(time, values, measured, places, order), path


def _background(table: Table, snapshot: _Snapshot, folder: Path, files: dict[str, Path]) -> np.ndarray:
    """The pattern (N, S) of which the data contain an unknown amount, in the order of the places."""
    path = table.file("background", folder)
    columns = _columns(path, table, "background")
    size = len(snapshot.order)
    for s in snapshot.species:
        if s not in columns or columns[s].shape != (size,) or not np.isfinite(columns[s]).all():
            raise table.error("background", f"a file with a column {s} of {size} finite numbers")
    files["fit.background"] = path
    pattern = np.empty((size, len(snapshot.species)))
    pattern[snapshot.order] = np.stack([columns[s] for s in snapshot.species], axis=1)
    if not pattern.any():
        raise table.error("background", "a pattern that is not zero everywhere")
    return pattern


def _places(
    columns: dict[str, np.ndarray], mesh: Mesh, fixed: Places, factor: float, table: Table
) -> tuple[Places, np.ndarray]:
    """The places of a file, and the position among them of each of its rows. Takes their columns away."""
    if fixed.operator is not None:
        return fixed, np.arange(len(fixed.operator))
    numbers_in_file = columns.pop("vertex", None)
    if numbers_in_file is not None:
        return Places(_vertices(numbers_in_file, mesh, table)), np.arange(len(numbers_in_file))
    if fixed.patches is not None:
        numbers, count = columns.pop("patch", None), int(fixed.patches.max()) + 1
        if numbers is None or not np.array_equal(np.sort(numbers), np.arange(count)):
            raise table.error("file", f"a column patch that names each of the {count} patches once, from 0,")
        return fixed, numbers.astype(np.int64)
    if set(_AXES) <= columns.keys():
        points = np.stack([columns.pop(axis) for axis in _AXES], axis=1)
        return Places(points=factor * points), np.arange(len(points))
    return Places(), np.asarray(mesh.source_order)


def _vertices(numbers: np.ndarray, mesh: Mesh, table: Table) -> np.ndarray:
    """The vertices of the mesh with these numbers in its file."""
    vertices = numbers.astype(np.int64)
    if (vertices != numbers).any() or len(np.unique(vertices)) != len(vertices):
        raise table.error("file", "whole numbers as its column vertex, each once,")
    if (vertices < 0).any() or (vertices >= mesh.num_vertices).any():
        invalid = vertices[(vertices < 0) | (vertices >= mesh.num_vertices)][0]
        raise table.error("file", f"vertices from 0 to {mesh.num_vertices - 1}, not {invalid},")
    return np.asarray(mesh.source_order)[vertices]


def _columns(path: Path, table: Table, key: str = "file") -> dict[str, np.ndarray]:
    """The arrays of a file, by name."""
    try:
        return {name: np.asarray(values, np.float64) for name, values in read_columns(path).items()}
    except DataError as error:
        raise table.error(key, error.expected) from None
