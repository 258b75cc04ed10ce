"""The `[fit]` of a scenario file: which of its numbers are unknown, and what was seen.

What enters: the table, the folder whose files it may name, the mesh. What leaves: a `Wanted`.
"""

import dataclasses
from pathlib import Path

import numpy as np

from ..mesh import Mesh
from ..mesh.columns import DataError, read_columns
from .reader import Table


@dataclasses.dataclass(frozen=True)
class Wanted:
    """What is to be fitted, to what.

    Attributes:
        start: the first guesses, by dotted key.
        values: (T, N, S) what was seen.
        times: (T,).
        vertices: (N,) where, in the order of the mesh; None for all.
        species: (S,) the columns of the state that were seen.
        noise: its standard deviation; None where it is not known.
        max_steps: of the fit.
        files: that were read.
    """

    start: dict[str, float]
    values: np.ndarray
    times: np.ndarray
    vertices: np.ndarray | None
    species: tuple[int, ...]
    noise: float | None
    max_steps: int
    files: tuple[Path, ...]


def wanted(
    table: Table, numbers: dict[str, float], mesh: Mesh, species: tuple[str, ...], end: float, folder: Path
) -> Wanted | None:
    """What the table asks for; None where there is none.

    Args:
        table: `[fit]`.
        numbers: what may be free, by dotted key: the scenario's numbers.
        mesh: where the data are.
        species: their names.
        end: the end of the run, after which nothing can have been seen.
        folder: the only one whose files may be named.

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
    noise = table.number("noise", 0.0, 0.0, 1e300) or None
    max_steps = table.count("max_steps", 200, 1, 100_000)
    seen, times, files, where, names = [], [], [], None, None
    for entry in table.tables("data"):
        path = entry.file("file", folder)
        time = entry.number("time", end, 0.0, end)
        entry.finish()
        columns = _columns(path, entry)
        here = columns.pop("vertex", None)
        which = tuple(s for s in species if s in columns)
        if not which:
            raise entry.error("file", f"a file with columns or arrays named {' or '.join(species)}")
        vertices = _vertices(here, mesh, entry)
        same = where is None if vertices is None else where is not None and np.array_equal(vertices, where)
        if seen and not (which == names and same):
            raise entry.error("file", "the species and vertices of the first file of data")
        names, where = which, vertices
        size = mesh.num_vertices if here is None else len(here)
        for s in which:
            if columns[s].shape != (size,):
                raise entry.error("file", f"{size} values of {s}, one for each vertex,")
            if missing := int(np.sum(~np.isfinite(columns[s]))):
                way = "name the vertices of the others in a column vertex" if here is None else "leave those rows out"
                raise entry.error("file", f"finite values of {s}; {missing} are missing or infinite ({way}),")
        state = np.stack([columns[s] for s in which], axis=1)
        if here is None:
            ordered = np.empty_like(state)
            ordered[mesh.source_order] = state
            state = ordered
        seen.append(state)
        times.append(time)
        files.append(path)
    table.finish()
    if not seen:
        raise table.error("data", "at least one [[fit.data]] with a file and a time")
    if (np.diff(times) <= 0).any() or times[0] <= 0:
        raise table.error("data", "times that are positive and ascend from file to file")
    if sum(state.size for state in seen) < len(free):
        raise table.error("data", f"at least as many values as the {len(free)} unknowns")
    return Wanted(
        {key: numbers[key] for key in free}, np.stack(seen), np.array(times), where,
        tuple(species.index(s) for s in names or ()), noise, max_steps, tuple(files),
    )  # fmt: skip


def _vertices(here: np.ndarray | None, mesh: Mesh, table: Table) -> np.ndarray | None:
    """Vertices of the mesh, from their numbers in its file."""
    if here is None:
        return None
    found = here.astype(np.int64)
    if (found != here).any() or len(np.unique(found)) != len(found):
        raise table.error("file", "whole numbers as its column vertex, each once,")
    if (found < 0).any() or (found >= mesh.num_vertices).any():
        bad = found[(found < 0) | (found >= mesh.num_vertices)][0]
        raise table.error("file", f"vertices from 0 to {mesh.num_vertices - 1}, not {bad},")
    return np.asarray(mesh.source_order)[found]


def _columns(path: Path, table: Table) -> dict[str, np.ndarray]:
    """The arrays of a file, by name."""
    try:
        return {name: np.asarray(values, np.float64) for name, values in read_columns(path).items()}
    except DataError as error:
        raise table.error("file", error.expected) from None
