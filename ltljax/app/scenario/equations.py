"""The tables of a scenario file that describe the equation: `[kinetics]` or `[reactions]`, `[diffusivity]`,
`[direction]`, `[flow]` and `[boundary]`.
"""

import dataclasses
import functools
import inspect
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..._base.deprecated import warn_deprecated
from ..._equations import CahnHilliard, Diffusion, Dirichlet, Equation, Neumann, ReactionDiffusion, Robin, kinetics
from ..._mesh import Mesh
from ..._operators import curvature, direction_tensor, elliptic_stencil, integrate
from ..._solve import solve
from ..._surface import Surface
from .fields import Fields
from .formulas import Formula
from .tables import Table

# Reactions that a scenario file can name.
KINETICS: dict[str, Callable[..., kinetics.Kinetics]] = {
    name.replace("_", "-"): getattr(kinetics, name) for name in kinetics.__all__ if name.islower()
}
# Direction fields that a scenario file can name, and whether they follow the largest curvature or the smallest.
_CURVATURE_FIELDS = {"greatest-curvature": True, "least-curvature": False}
_MOST_SPECIES = 64

# Numbers that replace those of the file, by dotted key. In a fit they are the unknowns.
_Overrides = Mapping[str, Any]
_NO_OVERRIDES: _Overrides = MappingProxyType({})
_Conditions = tuple[Neumann | Dirichlet | Robin, ...]


@dataclasses.dataclass(frozen=True)
class ScenarioEquation:
    """The equation of a scenario.

    Attributes:
        make: ``(surface, overrides) -> equation``. The overrides are numbers that replace those of the file, by dotted
            key; none by default.
        species: names of the species.
        numbers: numbers of the file that may be unknowns of a fit, by dotted key.
        notes: what a reader of the results should know.
    """

    make: Callable[..., Equation]
    species: tuple[str, ...]
    numbers: dict[str, float]
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class _Reaction:
    """What acts at a point, beside diffusion.

    Attributes:
        make_equation: ``(surface, diffusions, conditions, overrides) -> equation``, with a diffusivity or an operator
            for each species.
        species: names of the species.
        numbers: numbers that may be unknowns of a fit, by dotted key.
        is_balanced: whether the mean of a source is subtracted.
    """

    make_equation: Callable[[Surface, list[Any], _Conditions, _Overrides], Equation]
    species: tuple[str, ...]
    numbers: dict[str, float]
    is_balanced: bool = False


def read_equation(root: Table, mesh: Mesh, fields: Fields, scale: float) -> ScenarioEquation:
    """The equation of a scenario.

    Args:
        root: all tables.
        mesh: the mesh.
        fields: evaluates formulas at the vertices.
        scale: factor by which patterns are larger than the file describes; lengths in diffusivities and velocities are
            multiplied by it.

    Raises:
        ScenarioError: a table has a mistake.
    """
    table = root.table("kinetics")
    if table.peek("name") == "cahn-hilliard" and not root.table("reactions").names():
        return _cahn_hilliard(table, scale)
    reaction = _reaction(root, table, fields)
    species = reaction.species
    diffusivities = _diffusivities(root.table("diffusivity"), fields, species)
    direction, flow = _direction(root.table("direction"), fields, species), _flow(root.table("flow"), fields, scale)
    conditions = _conditions(root.table("boundary"), mesh)

    def make(surface: Surface, overrides: _Overrides = _NO_OVERRIDES) -> Equation:
        diffusions = [
            _diffusion(surface, scale**2 * overrides.get(f"diffusivity.{s}", d), direction.get(s), flow)
            for s, d in zip(species, diffusivities, strict=True)
        ]
        return reaction.make_equation(surface, diffusions, conditions, overrides)

    # A diffusivity can be fitted only if it multiplies the Laplacian: with a direction or a flow, the host chooses the
    # neighbours by it.
    plain = {s: d for s, d in zip(species, diffusivities, strict=True) if flow is None and s not in direction}
    notes = ("The mean of the source is subtracted, so that a stationary state exists.",)
    has_note = reaction.is_balanced and not conditions
    return ScenarioEquation(make, species, reaction.numbers | _numbers("diffusivity", plain), notes if has_note else ())


def _reaction(root: Table, table: Table, fields: Fields) -> _Reaction:
    formulas = root.table("reactions")
    if formulas.names():
        if table.names():
            raise root.refused(
                "kinetics",
                "There are both [kinetics] with a name and [reactions] with formulas. Leave one of them out.",
            )
        return _written_reaction(formulas, root.table("parameters"), fields)
    if table.peek("name") == "turk":
        warn_deprecated('The scenario value kinetics.name = "turk"', '"turing"')
        return _named_reaction(table, "turing", fields)
    name = table.choice("name", (*KINETICS, "heat", "cahn-hilliard"))
    return _heat(table, fields) if name == "heat" else _named_reaction(table, name, fields)


def _numbers(prefix: str, values: dict[str, Any]) -> dict[str, float]:
    """The values that are numbers and not fields, by dotted key."""
    return {f"{prefix}.{key}": float(value) for key, value in values.items() if np.ndim(value) == 0}


def _named_reaction(table: Table, name: str, fields: Fields) -> _Reaction:
    make = KINETICS[name]
    table.taken["name"] = name
    values = {key: fields.read(table, key, p.default) for key, p in inspect.signature(make).parameters.items()}
    table.finish()

    def make_equation(
        surface: Surface, diffusions: list[Any], conditions: _Conditions, overrides: _Overrides
    ) -> Equation:
        parameters = {key: jnp.asarray(overrides.get(f"kinetics.{key}", v), surface.dtype) for key, v in values.items()}
        return ReactionDiffusion(diffusions, make(**parameters), boundary=conditions)

    return _Reaction(make_equation, make().species, _numbers("kinetics", values))


class _WrittenRates(eqx.Module):
    """Rates of change as formulas of species and parameters."""

    formulas: tuple[Formula, ...] = eqx.field(static=True)
    species: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, u, params):
        known = dict(zip(self.species, u, strict=True)) | params
        return tuple(jnp.broadcast_to(f(**{name: known[name] for name in f.names}), u[0].shape) for f in self.formulas)


def _written_reaction(table: Table, parameters: Table, fields: Fields) -> _Reaction:
    rates, names = table.names(), parameters.names()
    for key in rates:
        if not (key.startswith("d") and key[1:].isidentifier()):
            raise table.refused(key, "This is not the rate of a species. Name rates like du or dv.")
    species = tuple(key[1:] for key in rates)
    if len(species) > _MOST_SPECIES:
        raise table.refused(rates[-1], f"There are more than {_MOST_SPECIES} species. Remove this one.")
    for name in names:
        if name in species or not name.isidentifier():
            raise parameters.refused(name, "This is the name of a species, or not a valid name. Choose another one.")
    written = _WrittenRates(tuple(table.formula(key, (*species, *names)) for key in rates), species)
    values = {name: fields.read(parameters, name) for name in names}

    def make_equation(
        surface: Surface, diffusions: list[Any], conditions: _Conditions, overrides: _Overrides
    ) -> Equation:
        params = {
            name: jnp.asarray(overrides.get(f"parameters.{name}", v), surface.dtype) for name, v in values.items()
        }
        return ReactionDiffusion(diffusions, kinetics.Kinetics(written, params, species), boundary=conditions)

    return _Reaction(make_equation, species, _numbers("parameters", values))


def _heat(table: Table, fields: Fields) -> _Reaction:
    """du/dt = d Laplacian(u) + source.

    If ``balanced``, the mean of the source is subtracted, unless there are boundary conditions.
    """
    source, is_balanced = fields.read(table, "source", 0.0), table.flag("balanced", False)
    table.finish()

    def make_equation(
        surface: Surface, diffusions: list[Any], conditions: _Conditions, overrides: _Overrides
    ) -> Equation:
        g = jnp.asarray(overrides.get("kinetics.source", source), surface.dtype)
        g = jnp.broadcast_to(g, surface.vertices.shape[:1])
        if is_balanced and not conditions:
            # Diffusion conserves the mean in this measure. In any other measure, a small mean would remain and
            # accumulate.
            measure = surface.quadrature
            g = g - integrate(surface, g, measure) / jnp.sum(measure)
        return Diffusion(tuple(diffusions), g[:, None], conditions)

    return _Reaction(make_equation, ("u",), _numbers("kinetics", {"source": source}), is_balanced)


def _cahn_hilliard(table: Table, scale: float) -> ScenarioEquation:
    values = dict(width=table.number("width", 0.05, 1e-6, 1e3), mobility=table.number("mobility", 1.0, 0, 1e6))
    table.choice("name", ("cahn-hilliard",))
    table.finish()

    def make(surface: Surface, overrides: _Overrides = _NO_OVERRIDES) -> Equation:
        width, mobility = (jnp.asarray(overrides.get(f"kinetics.{key}", v), surface.dtype) for key, v in values.items())
        return CahnHilliard(scale * width, scale**2 * mobility)

    return ScenarioEquation(make, ("u",), _numbers("kinetics", values))


def _diffusivities(table: Table, fields: Fields, species: tuple[str, ...]) -> list[np.ndarray | float]:
    values = [fields.read(table, s, 0.0) for s in species]
    for s, value in zip(species, values, strict=True):
        if (np.asarray(value) < 0).any():
            raise table.error(s, "a diffusivity that is not negative")
    table.finish()
    return values


def _conditions(table: Table, mesh: Mesh) -> _Conditions:
    texts = table.texts("conditions")
    table.finish()
    num_loops = len(mesh.boundary_loops)
    try:
        conditions = tuple(parse_condition(text) for text in texts)
    except ValueError as error:
        raise table.refused("conditions", error) from None
    if conditions and not num_loops:
        raise table.refused("conditions", "Boundary conditions need a mesh with a boundary; this mesh is closed.")
    for text, condition in zip(texts, conditions, strict=True):
        if isinstance(condition.where, int) and condition.where >= num_loops:
            reason = f"expected a loop below {num_loops}, the number of boundary loops, found {text!r}."
            raise table.refused("conditions", reason)
    return conditions


def parse_condition(text: str) -> Neumann | Dirichlet | Robin:
    """A boundary condition from ``neumann=FLUX``, ``dirichlet=VALUE`` or ``robin=A,B,G``; with ``@LOOP`` for one loop.

    Raises:
        ValueError: the text is none of these.
    """
    kinds = {"neumann": (Neumann, 1), "dirichlet": (Dirichlet, 1), "robin": (Robin, 3)}
    name, _, rest = text.partition("=")
    numbers, _, loop = rest.partition("@")
    try:
        make, count = kinds[name]
        values = [float(number) for number in numbers.split(",")]
        where = int(loop) if loop else None
        if len(values) != count or not all(map(math.isfinite, values)) or (where is not None and where < 0):
            raise ValueError
        if make is Robin and values[1] == 0:
            raise ValueError
    except (KeyError, ValueError):
        raise ValueError(
            f"Expected neumann=FLUX, dirichlet=VALUE or robin=A,B,G (a u + b du/dnu = g, b not 0), with @LOOP for one "
            f"boundary loop, such as dirichlet=1@0; found {text!r}."
        ) from None
    return make(*values, where=where)


# The direction field along which a species diffuses faster, and the ratio of the two diffusivities.
_Direction = tuple[Callable[[Surface], np.ndarray], float]


def _direction(table: Table, fields: Fields, species: tuple[str, ...]) -> dict[str, _Direction]:
    """The direction field of every species that has one."""
    if not table.names():
        return {}
    if isinstance(table.peek("field"), str):
        is_largest = _CURVATURE_FIELDS[table.choice("field", tuple(_CURVATURE_FIELDS))]
        smoothing = table.number("smoothing", 0.1, 0.0, 1e3)
        field = functools.partial(_principal_direction, is_largest=is_largest, smoothing=smoothing)
    else:
        vectors = fields.read_vectors(table, "field")
        field = lambda surface: vectors  # noqa: E731
    ratio = table.number("ratio", 4.0, 1e-3, 1e3)
    # If all species had a direction, the pattern would be stretched and would not align with it.
    directed = tuple(table.texts("species")) or species[:1]
    if unknown := [s for s in directed if s not in species]:
        raise table.refused("species", f"{unknown[0]!r} is not a species. Name some of {', '.join(species)}.")
    table.finish()
    return dict.fromkeys(directed, (field, ratio))


def _principal_direction(surface: Surface, is_largest: bool, smoothing: float) -> np.ndarray:
    """The direction of the largest or smallest curvature, averaged over a length."""
    bend = curvature(surface).shape_operator.reshape(-1, 9)
    if smoothing:  # on a noisy mesh, directions without smoothing are noise
        bend = solve(Diffusion(), surface, bend, smoothing**2 / 4).u_end
    bend = np.asarray(bend, np.float64).reshape(-1, 3, 3)
    frames = np.asarray(surface.geometry.frames, np.float64)
    values, vectors = np.linalg.eigh(np.einsum("vac,vcd,vbd->vab", frames, bend, frames))
    column = np.abs(values).argmax(axis=1) if is_largest else np.abs(values).argmin(axis=1)
    chosen = np.take_along_axis(vectors, column[:, None, None], axis=2)[..., 0]
    return np.einsum("va,vac->vc", chosen, frames)


def _flow(table: Table, fields: Fields, scale: float) -> np.ndarray | None:
    if not table.names():
        return None
    velocity = fields.read_vectors(table, "velocity")
    table.finish()
    return scale * velocity


def _diffusion(surface: Surface, diffusivity: Any, direction: _Direction | None, flow: np.ndarray | None) -> Any:
    """The diffusivity of a species, or its operator if the species has a direction or drifts with a flow."""
    if direction is None and flow is None:
        return diffusivity
    tensors: Any = np.asarray(diffusivity)
    if direction is not None:
        field, ratio = direction
        # The mean of both diffusivities stays the same, and with it the scale of the pattern.
        across = 2 / (1 + ratio)
        tensor = np.asarray(direction_tensor(surface, field(surface), ratio * across, across))
        tensors = tensor * tensors.reshape(-1, 1, 1)
    return elliptic_stencil(surface, tensors, None if flow is None else -flow)
