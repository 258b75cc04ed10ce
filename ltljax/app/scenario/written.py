"""A scenario file becomes a `Scenario`: mesh, equation, initial state, time, solver and outputs.

What enters: a TOML text, the folder whose files it may name, and what the command line sets. What leaves: a `Scenario`
whose ``resolved`` table holds every value, defaults too.
"""

import functools
import inspect
import math
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..._equations import CahnHilliard, Diffusion, Equation, ReactionDiffusion, kinetics
from ..._mesh import Mesh, MeshError, load_mesh, shapes
from ..._operators import curvature, direction_tensor, elliptic_stencil
from ..._output.colors import COLORMAPS
from ..._output.pictures import VIEWS
from ..._solve import RKL1, RKL2, SBDF2, TRBDF2, BackwardEuler, CrankNicolson, solve
from ..._surface import Surface
from .formulas import Formula, cut
from .inputs import arrays, check_self_contained
from .observed import wanted
from .paper import parse_condition
from .reader import ScenarioError, Table, listed, load
from .scenario import Scenario, Settings, scaled_to_unit_area

# Where nothing else is said every formula knows these: positions, a random number for each vertex between -1 and 1, and
# random bumps of height one.
PLACES = ("x", "y", "z", "noise", "bumps")
KINETICS: dict[str, Callable[..., kinetics.Kinetics]] = {
    name.replace("_", "-"): getattr(kinetics, name) for name in kinetics.__all__ if name.islower()
}
SOLVERS = {
    "RKL2": RKL2, "RKL1": RKL1, "Tsit5": diffrax.Tsit5, "TRBDF2": TRBDF2, "BackwardEuler": BackwardEuler,
    "CrankNicolson": CrankNicolson, "SBDF2": SBDF2, "KenCarp3": diffrax.KenCarp3, "KenCarp4": diffrax.KenCarp4,
    "Kvaerno5": diffrax.Kvaerno5,
}  # fmt: skip
# Those that take a stiff part of the rate apart from the rest.
_SPLITTING = ("SBDF2", "KenCarp3", "KenCarp4")
SCHEMES = ("monotone", "polynomial", "paper")
_SHAPES: dict[str, tuple[Callable[..., Mesh], dict[str, tuple[int, int]]]] = {
    "sphere": (shapes.icosphere, {"subdivisions": (5, 8)}),
    "ellipsoid": (shapes.ellipsoid, {"subdivisions": (5, 8)}),
    "torus": (shapes.torus, {"n_major": (144, 2000), "n_minor": (72, 2000)}),
    "disk": (shapes.disk, {"rings": (60, 500)}),
    "hemisphere": (shapes.hemisphere, {"rings": (50, 500)}),
    "square": (shapes.square, {"n": (100, 1500)}),
    "cylinder": (shapes.cylinder, {"n_around": (120, 2000), "n_along": (80, 2000)}),
    "box": (shapes.box, {"n": (40, 500)}),
}
_TRIPLES = {"axes": (2.0, 1.0, 1.5), "sides": (1.0, 1.0, 1.0)}
# Direction fields by name: that in which the surface bends most, around limbs, and least, along them.
_CURVED = {"greatest-curvature": True, "least-curvature": False}
# States of more bytes than this are not kept without being asked twice.
_MOST_BYTES = 8e9
_MOST_SPECIES = 64


def library() -> dict[str, str]:
    """The texts of the scenarios that come with the package, by name."""
    folder = files("ltljax.app.scenario") / "library"
    found = {entry.name.removesuffix(".toml"): entry for entry in folder.iterdir() if entry.name.endswith(".toml")}
    return {name: found[name].read_text(encoding="utf-8") for name in sorted(found)}


def templates() -> dict[str, str]:
    """The texts of scenario files to start from, by name: those of the library, and those that need files of data."""
    folder = files("ltljax.app.scenario") / "templates"
    return library() | {
        entry.name.removesuffix(".toml"): entry.read_text(encoding="utf-8")
        for entry in folder.iterdir() if entry.name.endswith(".toml")
    }  # fmt: skip


def title(text: str) -> str:
    """The title of a scenario of the library."""
    return str(load(text, "library")["title"])


def parse_change(text: str) -> tuple[str, Any]:
    """Key and value of a change such as ``kinetics.feed=0.05``; what is no TOML value counts as a text.

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
    text: str, name: str, folder: Path, changes: dict[str, Any] | None = None, mesh_file: Path | None = None
) -> Scenario:
    """The scenario that a text describes.

    Args:
        text: TOML.
        name: of the file or scenario, for messages.
        folder: the only one whose files the text may name.
        changes: values by dotted key that replace those of the text, as ``{"kinetics.feed": 0.05}``; in their order.
        mesh_file: a mesh file from anywhere, in place of the text's mesh, before the changes.

    Raises:
        ScenarioError: the text has a mistake; its file, key, what was found and what is allowed are named.
    """
    tables = load(text, name)
    if mesh_file is not None:
        given = Table(tables.get("mesh", {}), name, "mesh")
        kept = {key: given.peek(key) for key in ("scale", "repair") if key in given}
        tables["mesh"] = kept | {"file": mesh_file.name}
    for key, value in (changes or {}).items():
        _set(tables, key, value, name)
    root = Table(tables, name)
    title = root.text("title", _plain(Path(name).stem))
    seed = root.count("seed", 0, 0, 2**63 - 1)
    mesh, used, note, factor = _mesh(root.table("mesh"), folder if mesh_file is None else mesh_file.parent)
    place = _places(root.table("bumps"), mesh, seed)
    scale = root.number("scale", 1.0, 1e-3, 1e3)
    make_equation, species, numbers = _equation(root, mesh, place, scale)
    time = root.table("time")
    end = time.number("end", 10.0, least=1e-300)
    frames = time.count("frames", 60, 1, 10_000)
    time.finish()
    # Every state is kept, and to be written three more of one species.
    if (size := 8.0 * (frames + 1) * mesh.num_vertices * (len(species) + 3)) > _MOST_BYTES:
        raise ScenarioError(
            f"{name}: {frames} frames (time.frames) of {mesh.num_vertices} vertices and {len(species)} species would "
            f"take {size / 1e9:.0f} GB of memory. Expected at most 8 GB: ask for fewer frames, or a coarser mesh."
        )
    start, start_file = _start(root.table("initial"), mesh, place, species, folder)
    settings = _settings(root, species)
    sought = wanted(root.table("fit"), numbers, mesh, species, end, folder, factor)
    root.finish()
    named = {"mesh.file": used, "initial.file": start_file}
    named |= {f"fit.data.{index}.file": path for index, path in enumerate(sought.files if sought else ())}
    return Scenario(
        name=_plain(Path(name).stem),
        mesh=mesh,
        make_equation=make_equation,
        u0=start,
        t1=end,
        parameters=root.taken,
        species=species,
        shown=species.index(settings.show),
        notes=note,
        title=title,
        frames=frames,
        settings=settings,
        resolved=root.taken,
        files={key: path for key, path in named.items() if path is not None},
        wanted=sought,
    )


def _set(tables: dict[str, Any], key: str, value: Any, name: str) -> None:
    *path, last = key.split(".")
    inner: Any = tables
    for part in path:
        inner = inner.setdefault(part, {})
        if not isinstance(inner, dict):
            raise ScenarioError(f"{name}: {cut(key, 80)} cannot be set: {cut(part, 40)} is no table.")
    inner[last] = value


def _plain(name: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in name)[:60] or "scenario"


def _mesh(table: Table, folder: Path) -> tuple[Mesh, Path | None, tuple[str, ...], float]:
    """The mesh, its file, a note on its scale, and the factor by which the coordinates of the file were multiplied."""
    if "file" in table:
        path = table.file("file", folder)
        repair = table.flag("repair", False)
        scale = table.choice("scale", ("unit", "keep"), "unit")
        table.finish()
        try:
            check_self_contained(path)
            mesh = load_mesh(path, repair=repair).reordered()
        except MeshError as error:
            raise table.refused("file", error) from None
        if scale == "keep":
            return mesh, path, (f"The mesh keeps its scale: area {mesh.area:.6g}.",), 1.0
        scaled, note = scaled_to_unit_area(mesh)
        return scaled, path, (note,), math.sqrt(scaled.area / mesh.area)
    shape = table.choice("shape", tuple(_SHAPES), "sphere")
    make, counts = _SHAPES[shape]
    arguments: dict[str, Any] = {
        key: table.count(key, default, 0 if key == "subdivisions" else 3, most)
        for key, (default, most) in counts.items()
    }
    for key, parameter in inspect.signature(make).parameters.items():
        if key in _TRIPLES:
            arguments[key] = tuple(table.numbers(key, _TRIPLES[key], 1e-3, 1e3))
        elif key not in counts:
            arguments[key] = table.number(key, float(parameter.default), 1e-3, 1e3)
    table.finish()
    return make(**arguments), None, (), 1.0


def _places(table: Table, mesh: Mesh, seed: int) -> Callable[[Formula, str], np.ndarray]:
    """What evaluates a formula at every vertex; random numbers differ from one dotted key to another, and
    not with the order of either."""
    count = table.count("count", 12, 1, 10_000)
    radius = table.number("radius", 0.1, 1e-6, 1e6)
    table.finish()
    order, size = mesh.source_order, mesh.num_vertices

    @functools.cache
    def bumps() -> np.ndarray:
        centres = mesh.vertices[order[np.random.default_rng(seed).integers(size, size=count)]]
        height = np.zeros(size)
        for centre in centres:
            squared = ((mesh.vertices - centre) ** 2).sum(axis=1)
            height = np.maximum(height, np.exp(-squared / radius**2))
        return height

    def evaluate(formula: Formula, key: str) -> np.ndarray:
        values = dict(zip("xyz", mesh.vertices.T, strict=True))
        if "noise" in formula.names:
            values["noise"] = np.empty(size)
            values["noise"][order] = np.random.default_rng([seed, *key.encode()]).uniform(-1, 1, size)
        if "bumps" in formula.names:
            values["bumps"] = bumps()
        known = {name: jnp.asarray(values[name], jnp.result_type(float)) for name in formula.names}
        return np.broadcast_to(np.asarray(formula(**known), np.float64), size)

    return evaluate


def _finite(values: np.ndarray, table: Table, key: str) -> np.ndarray:
    if not np.isfinite(values).all():
        raise table.error(key, "a formula that is finite at every vertex")
    return values


class _Written(eqx.Module):
    """Rates that were written as formulas of species and parameters."""

    formulas: tuple[Formula, ...] = eqx.field(static=True)
    species: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, u, params):
        known = dict(zip(self.species, u, strict=True)) | params
        return tuple(jnp.broadcast_to(f(**{name: known[name] for name in f.names}), u[0].shape) for f in self.formulas)


# What replaces numbers of the file, by dotted key: the unknowns of a fit.
_Free = Mapping[str, Any]
_Reaction = Callable[[Any, _Free], kinetics.Kinetics]


def _numbers(prefix: str, values: dict[str, Any]) -> dict[str, float]:
    """Those that are numbers, by dotted key."""
    return {f"{prefix}.{key}": float(value) for key, value in values.items() if np.ndim(value) == 0}


def _named_reaction(table: Table, place) -> tuple[_Reaction, tuple[str, ...], dict[str, float]]:
    make = KINETICS[table.taken["name"]]
    values = {key: _field(table, key, place, one.default) for key, one in inspect.signature(make).parameters.items()}
    table.finish()

    def reaction(dtype, free):
        return make(**{key: jnp.asarray(free.get(f"kinetics.{key}", value), dtype) for key, value in values.items()})

    return reaction, make().species, _numbers("kinetics", values)


def _written_reaction(table: Table, parameters: Table, place) -> tuple[_Reaction, tuple[str, ...], dict[str, float]]:
    rates, names = table.names(), parameters.names()
    for key in rates:
        if not (key.startswith("d") and key[1:].isidentifier()):
            raise table.error(key, "the rate of a species, such as du or dv,")
    species = tuple(key[1:] for key in rates)
    if len(species) > _MOST_SPECIES:
        raise table.error(rates[-1], f"at most {_MOST_SPECIES} species; without this one")
    for name in names:
        if name in species or not name.isidentifier():
            raise parameters.error(name, "a name that is no species'")
    written = _Written(tuple(table.formula(key, (*species, *names)) for key in rates), species)
    values = {name: _field(parameters, name, place) for name in names}

    def reaction(dtype, free):
        given = {name: jnp.asarray(free.get(f"parameters.{name}", value), dtype) for name, value in values.items()}
        return kinetics.Kinetics(written, given, species)

    return reaction, species, _numbers("parameters", values)


def _cahn_hilliard(table: Table, scale: float) -> tuple[Callable[..., Equation], tuple[str, ...], dict[str, float]]:
    width, mobility = table.number("width", 0.05, 1e-6, 1e3), table.number("mobility", 1.0, 0, 1e6)
    table.finish()
    values = dict(width=width, mobility=mobility)

    def make_equation(surface: Surface, free: _Free = MappingProxyType({})) -> Equation:
        given = {key: jnp.asarray(free.get(f"kinetics.{key}", value), surface.dtype) for key, value in values.items()}
        return CahnHilliard(scale * given["width"], scale**2 * given["mobility"])

    return make_equation, ("u",), _numbers("kinetics", values)


def _equation(
    root: Table, mesh: Mesh, place, scale: float
) -> tuple[Callable[..., Equation], tuple[str, ...], dict[str, float]]:
    """How to make the equation, its species, and its numbers by dotted key.

    Args:
        root: all tables.
        mesh: where.
        place: what evaluates a formula at every vertex.
        scale: how many times as large patterns are: lengths in diffusivities and velocities grow with it.
    """
    table, reactions = root.table("kinetics"), root.table("reactions")
    if reactions.names():
        if table.names():
            raise root.error("kinetics", "either [kinetics] with a name or [reactions] with formulas, not both,")
        reaction, species, numbers = _written_reaction(reactions, root.table("parameters"), place)
    elif table.choice("name", (*KINETICS, "cahn-hilliard")) == "cahn-hilliard":
        return _cahn_hilliard(table, scale)
    else:
        reaction, species, numbers = _named_reaction(table, place)
    diffusion = root.table("diffusivity")
    spreads = [_field(diffusion, s, place, 0.0) for s in species]
    for s, spread in zip(species, spreads, strict=True):
        if (np.asarray(spread) < 0).any():
            raise diffusion.error(s, "a diffusivity that is not negative")
    diffusion.finish()
    direction, flow = _direction(root.table("direction"), place, species), _flow(root.table("flow"), place)
    boundary = root.table("boundary")
    try:
        conditions = tuple(parse_condition(text) for text in boundary.texts("conditions"))
    except ValueError as error:
        raise boundary.refused("conditions", error) from None
    boundary.finish()
    loops = [condition.where if isinstance(condition.where, int) else 0 for condition in conditions]
    if any(loop >= len(mesh.boundary_loops) for loop in loops):
        raise boundary.error("conditions", f"conditions for a mesh with {len(mesh.boundary_loops)} boundary loops")

    scaled_flow = None if flow is None else scale * flow

    def make_equation(surface: Surface, free: _Free = MappingProxyType({})) -> Equation:
        given = [scale**2 * free.get(f"diffusivity.{s}", d) for s, d in zip(species, spreads, strict=True)]
        spread = [
            _operator(surface, d, direction if direction and s in direction[2] else None, scaled_flow)
            for s, d in zip(species, given, strict=True)
        ]
        return ReactionDiffusion(spread, reaction(surface.dtype, free), boundary=conditions)

    # Operators of directions and flows choose their neighbours on the host, by the diffusivity among others.
    plain = [s for s in species if flow is None and not (direction and s in direction[2])]
    numbers |= _numbers("diffusivity", {s: d for s, d in zip(species, spreads, strict=True) if s in plain})
    return make_equation, species, numbers


def _field(table: Table, key: str, place, default: Any = None) -> np.ndarray | float:
    """A number, or the values of a formula at every vertex."""
    if default is inspect.Parameter.empty:
        default = None
    formula = table.formula(key, PLACES, default)
    if not formula.names:
        value = float(formula())
        if not math.isfinite(value):
            raise table.error(key, "a finite number")
        return value
    return _finite(place(formula, table.name(key)), table, key)


def _direction(
    table: Table, place, species: tuple[str, ...]
) -> tuple[Callable[[Surface], np.ndarray], float, tuple[str, ...]] | None:
    """The field along which species diffuse faster, how much, and which do."""
    if not table.names():
        return None
    if isinstance(table.peek("field"), str):
        which = table.choice("field", tuple(_CURVED))
        smoothing = table.number("smoothing", 0.1, 0.0, 1e3)
        field = functools.partial(_principal, largest=_CURVED[which], smoothing=smoothing)
    else:
        vectors = _vectors(table, "field", place)
        field = lambda surface: vectors  # noqa: E731
    ratio = table.number("ratio", 4.0, 1e-3, 1e3)
    # With all species alike a pattern would be stretched, and keep no direction.
    which = tuple(table.texts("species")) or species[:1]
    if unknown := [s for s in which if s not in species]:
        raise table.error("species", f"some of {', '.join(species)} without {unknown[0]!r}")
    table.finish()
    return field, ratio, which


def _principal(surface: Surface, largest: bool, smoothing: float) -> np.ndarray:
    """The direction in which a surface bends most, or least, averaged over a length."""
    bend = curvature(surface).shape_operator.reshape(-1, 9)
    # Diffused, as the directions of noise are noise.
    if smoothing:
        bend = solve(Diffusion(), surface, bend, smoothing**2 / 4).u_end
    bend = np.asarray(bend, np.float64).reshape(-1, 3, 3)
    frames = np.asarray(surface.geometry.frames, np.float64)
    values, vectors = np.linalg.eigh(np.einsum("vac,vcd,vbd->vab", frames, bend, frames))
    column = np.abs(values).argmax(axis=1) if largest else np.abs(values).argmin(axis=1)
    chosen = np.take_along_axis(vectors, column[:, None, None], axis=2)[..., 0]
    return np.einsum("va,vac->vc", chosen, frames)


def _flow(table: Table, place) -> np.ndarray | None:
    if not table.names():
        return None
    velocity = _vectors(table, "velocity", place)
    table.finish()
    return velocity


def _vectors(table: Table, key: str, place) -> np.ndarray:
    """The vectors (V, 3) of three formulas."""
    parts = [
        place(formula, f"{table.name(key)}.{axis}")
        for formula, axis in zip(table.formulas(key, 3, PLACES), "xyz", strict=True)
    ]
    return _finite(np.stack(parts, axis=-1), table, key)


def _operator(surface: Surface, diffusivity, direction, flow) -> Any:
    """How one species spreads: as little as its diffusivity, direction and flow ask for."""
    if direction is None and flow is None:
        return diffusivity
    tensors: Any = np.asarray(diffusivity)
    if direction is not None:
        field, ratio, _ = direction
        # The mean of both directions is the diffusivity, so that the pattern's scale stays.
        across = 2 / (1 + ratio)
        tensors = np.asarray(direction_tensor(surface, field(surface), ratio * across, across)) * tensors.reshape(
            -1, 1, 1
        )
    return elliptic_stencil(surface, tensors, None if flow is None else -flow)


def _start(table: Table, mesh: Mesh, place, species: tuple[str, ...], folder: Path) -> tuple[np.ndarray, Path | None]:
    """The initial state (V, S), from formulas or from a file of numbers in the order of the mesh file."""
    if "file" not in table:
        columns = [np.broadcast_to(_field(table, s, place), mesh.num_vertices) for s in species]
        table.finish()
        return np.stack(columns, axis=1), None
    path = table.file("file", folder)
    table.finish()
    try:
        columns = arrays(path, species, mesh.num_vertices)
    except Exception as error:  # damaged archives raise anything; here all mean the same
        reason = f"{type(error).__name__}: {str(error)[:200]}".rstrip(": ")
        raise table.error("file", f"a CSV or .npz file with {listed(species)} ({reason})") from None
    state = np.empty((mesh.num_vertices, len(species)))
    for s, column in zip(species, columns, strict=True):
        if not np.isfinite(column).all():
            raise table.error("file", f"finite values for {s}")
    state[mesh.source_order] = np.stack(columns, axis=1)
    return state, path


def _settings(root: Table, species: tuple[str, ...]) -> Settings:
    solver, output = root.table("solver"), root.table("output")
    name = solver.choice("name", tuple(SOLVERS), "RKL2")
    if name in _SPLITTING and root.peek("kinetics") and root.peek("kinetics").get("name") == "cahn-hilliard":
        whole = [one for one in SOLVERS if one not in _SPLITTING]
        raise solver.error("name", f"one that does not split the rate, which cahn-hilliard needs ({', '.join(whole)}),")
    dt = solver.number("dt", 0.0, least=0.0)
    if name == "SBDF2" and not dt:
        raise solver.error("dt", "the length of steps, which SBDF2 needs,")
    scheme = solver.choice("scheme", SCHEMES, "monotone")
    if scheme != "polynomial" and "degree" in solver:
        raise solver.error("degree", "no degree, which only the scheme polynomial has,")
    settings = Settings(
        scheme=scheme,
        degree=solver.count("degree", 4, 3, 4) if scheme == "polynomial" else None,
        dtype=solver.choice("dtype", ("float32", "float64"), "float64"),
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
