"""A scenario file becomes a `Scenario`: mesh, equation, initial state, time, solver and output.

What enters: a TOML text, the folder whose files it may name, and what the command line changes. What leaves: a
`Scenario`, whose ``tables`` hold every value, defaults included.
"""

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import diffrax
import numpy as np

from ..._mesh import Mesh
from ..._output.colors import COLORMAPS
from ..._output.pictures import VIEWS
from ..._solve import RKL1, RKL2, SBDF2, TRBDF2, BackwardEuler, CrankNicolson
from ..choices import DTYPES, SCHEMES
from .equations import read_equation
from .fields import Fields
from .inputs import arrays
from .measurements import read_fit
from .meshes import SHAPES, read_mesh
from .scenario import Scenario, Settings
from .tables import ScenarioError, Table, load
from .wording import cut, listed

SOLVERS = {
    "RKL2": RKL2, "RKL1": RKL1, "Tsit5": diffrax.Tsit5, "TRBDF2": TRBDF2, "BackwardEuler": BackwardEuler,
    "CrankNicolson": CrankNicolson, "SBDF2": SBDF2, "KenCarp3": diffrax.KenCarp3, "KenCarp4": diffrax.KenCarp4,
    "Kvaerno5": diffrax.Kvaerno5,
}  # fmt: skip
# Solvers that split the rate into a stiff part and the rest.
_SPLITTING = ("SBDF2", "KenCarp3", "KenCarp4")
# The states of a run must fit into so many bytes.
_MOST_BYTES = 8e9
# Changes of these tables, and of the shape and the resolution of the mesh, leave a known solution exact.
_KEEP_EXACT = ("time", "solver", "output", "exact", "notes", "title", "seed")
_KEEP_EXACT_OF_MESH = {"shape", *(key for _, resolutions in SHAPES.values() for key in resolutions)}


def parse_change(text: str) -> tuple[str, Any]:
    """The key and the value of a change such as ``kinetics.feed=0.05``. A value that is not TOML is a text.

    Raises:
        ScenarioError: there is no key, or no value.
    """
    key, _, value = (part.strip() for part in text.partition("="))
    if not value or not all(part.isidentifier() for part in key.split(".")):
        raise ScenarioError(f"Expected --set KEY=VALUE, such as kinetics.feed=0.05, found {cut(text, 80)!r}.")
    try:
        return key, load(f"value = {value}", "--set")["value"]
    except ScenarioError:
        return key, value


def read(
    text: str,
    name: str,
    folder: Path | str,
    changes: Mapping[str, Any] | None = None,
    mesh_file: Path | None = None,
    variant: str | None = None,
) -> Scenario:
    """The scenario that a text describes.

    Args:
        text: TOML.
        name: name of the file or of the scenario, for messages and results.
        folder: the only folder whose files the text may name.
        changes: values by dotted key that replace those of the text, such as ``{"kinetics.feed": 0.05}``, in order.
        mesh_file: a mesh file, which may lie anywhere, in place of the mesh of the text. It is set before the changes.
        variant: a variant that the text describes.

    Raises:
        ScenarioError: the text has a mistake. The message names the file, the key, what was found and what is allowed.
    """
    folder, changes = Path(folder), dict(changes or {})
    tables = _changed_tables(load(text, name), name, changes, mesh_file, variant)
    root = Table(tables, name)
    stem = _plain(Path(name).stem)
    title, notes = root.text("title", stem), tuple(root.texts("notes"))
    seed = root.count("seed", 0, 0, 2**63 - 1)
    scenario_mesh = read_mesh(root.table("mesh"), folder, mesh_file)
    mesh = scenario_mesh.mesh
    fields = Fields(root.table("bumps"), mesh, seed)
    scale = root.number("scale", 1.0, 1e-3, 1e3)
    equation = read_equation(root, mesh, fields, scale)
    species = equation.species
    end, frames = _time(root.table("time"), mesh, species, name)
    u0, initial_file = _initial_state(root.table("initial"), mesh, fields, species, folder)
    exact, exact_is = fields.read_exact(root.table("exact"), species)
    settings = _settings(root, species)
    fit_task = read_fit(root.table("fit"), equation.numbers, mesh, species, end, folder, scenario_mesh.factor)
    root.finish()
    files = {"mesh.file": scenario_mesh.path, "initial.file": initial_file} | (fit_task.files if fit_task else {})
    return Scenario(
        name=stem,
        title=title,
        mesh=mesh,
        make_equation=equation.make,
        u0=u0,
        t1=end,
        frames=frames,
        species=species,
        settings=settings,
        tables=root.taken,
        files={key: path for key, path in files.items() if path is not None},
        exact=exact,
        exact_is=exact_is,
        notes=scenario_mesh.notes + equation.notes + notes,
        fit_task=fit_task,
    )


def _changed_tables(
    tables: dict[str, Any], name: str, changes: dict[str, Any], mesh_file: Path | None, variant: str | None
) -> dict[str, Any]:
    """The tables of a file with the mesh, the variants and the changes that were asked for."""
    variants = Table(tables.pop("variants", {}), name, "variants")
    if mesh_file is not None:
        mesh = Table(tables.get("mesh", {}), name, "mesh")
        treatment = {key: mesh.peek(key) for key in ("scale", "repair") if key in mesh}
        tables["mesh"] = treatment | {"file": mesh_file.name}
    for key, value in changes.items():
        _set(tables, key, value, name)
    explicit = _flat(changes)
    for key, value in _chosen_variants(variants, tables, name, variant).items():
        if key not in explicit:
            _set(tables, key, value, name)
    if not all(map(_keeps_exact, explicit)):
        tables.pop("exact", None)
    return tables


def _keeps_exact(key: str) -> bool:
    table, _, value = key.partition(".")
    return table in _KEEP_EXACT or (table == "mesh" and value in _KEEP_EXACT_OF_MESH)


def _chosen_variants(variants: Table, tables: dict[str, Any], name: str, variant: str | None) -> dict[str, Any]:
    """The values, by dotted key, of the first variant for the shape of the mesh and of the one that was named."""
    mesh = tables.get("mesh", {})
    shape = None if not isinstance(mesh, dict) or "file" in mesh else mesh.get("shape", "sphere")
    by_name = {key: variants.table(key) for key in variants.names()}
    shapes = {key: table.text("shape") if "shape" in table else None for key, table in by_name.items()}
    chosen = [key for key in by_name if shapes[key] is not None and shapes[key] == shape][:1]
    if variant is not None:
        if variant not in by_name:
            names = f"its variants are {listed(by_name)}" if by_name else "it has none"
            raise ScenarioError(f"{name} has no variant {variant!r}; {names}.")
        if shapes[variant] not in (None, shape):
            raise ScenarioError(f"{name}: the variant {variant} needs --mesh {shapes[variant]}.")
        chosen.append(variant)
    values: dict[str, Any] = {}
    for key in chosen:
        values |= _flat({inner: by_name[key].peek(inner) for inner in by_name[key].names()})
    return values


def _flat(tables: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of nested tables by dotted key."""
    values: dict[str, Any] = {}
    for key, value in tables.items():
        values |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return values


def _set(tables: dict[str, Any], key: str, value: Any, name: str) -> None:
    *path, last = key.split(".")
    inner: Any = tables
    for part in path:
        inner = inner.setdefault(part, {})
        if not isinstance(inner, dict):
            raise ScenarioError(f"{name}: {cut(key, 80)} cannot be set: {cut(part, 40)} is not a table.")
    inner[last] = copy.deepcopy(value)


def _plain(name: str) -> str:
    """A name that is safe in the names of files."""
    return "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in name)[:60] or "scenario"


def _time(table: Table, mesh: Mesh, species: tuple[str, ...], name: str) -> tuple[float, int]:
    """The end of the run and the number of frames."""
    end = table.number("end", 10.0, least=1e-300)
    frames = table.count("frames", 60, 1, 10_000)
    table.finish()
    # All states are kept in memory, and writing them takes three more states of one species.
    if (size := 8.0 * (frames + 1) * mesh.num_vertices * (len(species) + 3)) > _MOST_BYTES:
        raise ScenarioError(
            f"{name}: {frames} frames (time.frames) of {mesh.num_vertices} vertices and {len(species)} species would "
            f"take {size / 1e9:.0f} GB of memory. Expected at most 8 GB: ask for fewer frames, or a coarser mesh."
        )
    return end, frames


def _initial_state(
    table: Table, mesh: Mesh, fields: Fields, species: tuple[str, ...], folder: Path
) -> tuple[np.ndarray, Path | None]:
    """The initial state (V, S), from formulas or from a file of numbers in the order of the mesh file."""
    if "file" not in table:
        columns = [np.broadcast_to(fields.read(table, s), mesh.num_vertices) for s in species]
        table.finish()
        return np.stack(columns, axis=1), None
    path = table.file("file", folder)
    table.finish()
    try:
        columns = arrays(path, species, mesh.num_vertices)
    except Exception as error:  # A damaged archive can raise any exception.
        reason = f"{type(error).__name__}: {str(error)[:200]}".rstrip(": ")
        raise table.error("file", f"a CSV or .npz file with {listed(species)} ({reason})") from None
    for s, column in zip(species, columns, strict=True):
        if not np.isfinite(column).all():
            raise table.error("file", f"finite values for {s}")
    state = np.empty((mesh.num_vertices, len(species)))
    state[mesh.source_order] = np.stack(columns, axis=1)
    return state, path


def _settings(root: Table, species: tuple[str, ...]) -> Settings:
    solver, output = root.table("solver"), root.table("output")
    name = solver.choice("name", tuple(SOLVERS), "RKL2")
    kinetics = root.peek("kinetics")
    if name in _SPLITTING and kinetics and kinetics.get("name") == "cahn-hilliard":
        others = ", ".join(other for other in SOLVERS if other not in _SPLITTING)
        raise solver.error("name", f"a solver that does not split the rate, which cahn-hilliard needs ({others}),")
    dt = solver.number("dt", 0.0, least=0.0)
    if name == "SBDF2" and not dt:
        raise solver.error("dt", "the length of the steps, which SBDF2 needs,")
    scheme = solver.choice("scheme", SCHEMES, "monotone")
    if scheme != "polynomial" and "degree" in solver:
        raise solver.refused("degree", "A degree needs the scheme polynomial (--scheme polynomial).")
    settings = Settings(
        scheme=scheme,
        degree=solver.count("degree", 4, 3, 4) if scheme == "polynomial" else None,
        dtype=solver.choice("dtype", DTYPES, "float64"),
        solver=None if name == "RKL2" else SOLVERS[name](),
        rtol=solver.number("rtol", 1e-4, 1e-14, 1e-1),
        atol=solver.number("atol", 1e-6, 1e-16, 1.0) if "atol" in solver else None,
        dt=dt or None,
        show=output.choice("show", species, species[0]),
        colormap=output.choice("colormap", tuple(COLORMAPS), "viridis"),
        view=output.choice("view", tuple(VIEWS), "aslant"),
        texture=output.count("texture", 1024, 16, 16384),
        displacement=output.number("displacement", 0.0, -1e3, 1e3),
    )
    solver.finish()
    output.finish()
    return settings
