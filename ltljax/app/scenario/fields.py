"""Formulas of the position become values at the vertices of a mesh."""

import functools
import inspect
import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..._mesh import Mesh
from .formulas import Formula
from .tables import Table

# The names that formulas of the position may use: coordinates, two kinds of random numbers, and bumps of height one.
POSITION_NAMES = ("x", "y", "z", "noise", "shared_noise", "bumps")


class Fields:
    """Evaluates formulas at every vertex of a mesh.

    ``noise`` is a random number from -1 to 1 for every vertex, different in every formula; ``shared_noise`` is the
    same in all of them. Both depend on the seed and on the order of the mesh file, and on nothing else.

    Args:
        table: `[bumps]`.
        mesh: the mesh.
        seed: seed of the random numbers.
    """

    def __init__(self, table: Table, mesh: Mesh, seed: int):
        self._mesh, self._seed = mesh, seed
        self._count = table.count("count", 12, 1, 10_000)
        self._radius = table.number("radius", 0.1, 1e-6, 1e6)
        table.finish()

    @functools.cached_property
    def _bumps(self) -> np.ndarray:
        vertices, order = self._mesh.vertices, self._mesh.source_order
        indices = order[np.random.default_rng(self._seed).integers(len(vertices), size=self._count)]
        height = np.zeros(len(vertices))
        for centre in vertices[indices]:
            squared = ((vertices - centre) ** 2).sum(axis=1)
            height = np.maximum(height, np.exp(-squared / self._radius**2))
        return height

    def _noise(self, key: str) -> np.ndarray:
        entropy = [self._seed, *key.encode()] if key else self._seed
        values = np.empty(self._mesh.num_vertices)
        values[self._mesh.source_order] = np.random.default_rng(entropy).uniform(-1, 1, len(values))
        return values

    def evaluate(self, formula: Formula, key: str, **values: float) -> np.ndarray:
        """The values (V,) of a formula.

        Args:
            formula: the formula.
            key: dotted key of the formula, on which its noise depends.
            **values: values of further names, such as the time.
        """
        known: dict[str, Any] = dict(zip("xyz", self._mesh.vertices.T, strict=True)) | values
        if "noise" in formula.names:
            known["noise"] = self._noise(key)
        if "shared_noise" in formula.names:
            known["shared_noise"] = self._noise("")
        if "bumps" in formula.names:
            known["bumps"] = self._bumps
        arrays = {name: jnp.asarray(known[name], jnp.result_type(float)) for name in formula.names}
        return np.broadcast_to(np.asarray(formula(**arrays), np.float64), self._mesh.num_vertices)

    def read(self, table: Table, key: str, default: Any = None) -> np.ndarray | float:
        """A number, or the values (V,) of a formula.

        Raises:
            ScenarioError: the value of the key is neither, or is NaN or infinite somewhere.
        """
        formula = table.formula(key, POSITION_NAMES, None if default is inspect.Parameter.empty else default)
        if formula.names:
            return _finite(self.evaluate(formula, table.name(key)), table, key)
        value = float(formula())
        if not math.isfinite(value):
            raise table.error(key, "a finite number")
        return value

    def read_vectors(self, table: Table, key: str) -> np.ndarray:
        """The vectors (V, 3) of three formulas.

        Raises:
            ScenarioError: the value of the key is not a list of three formulas, or is NaN or infinite somewhere.
        """
        formulas = table.formulas(key, 3, POSITION_NAMES)
        columns = [self.evaluate(f, f"{table.name(key)}.{axis}") for f, axis in zip(formulas, "xyz", strict=True)]
        return _finite(np.stack(columns, axis=-1), table, key)

    def read_exact(self, table: Table, species: tuple[str, ...]) -> tuple[Callable[[float], np.ndarray] | None, str]:
        """The known solution ``t -> (V, S)`` and its formulas in words; None and an empty text without a table."""
        if not table.names():
            return None, ""
        formulas = [table.formula(s, ("x", "y", "z", "t")) for s in species]
        table.finish()

        def exact(t: float) -> np.ndarray:
            return np.stack([self.evaluate(formula, "exact", t=t) for formula in formulas], axis=1)

        return exact, ", ".join(f"{s} = {formula}" for s, formula in zip(species, formulas, strict=True))


def _finite(values: np.ndarray, table: Table, key: str) -> np.ndarray:
    if not np.isfinite(values).all():
        raise table.error(key, "a formula that is finite at every vertex")
    return values
