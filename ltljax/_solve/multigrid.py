"""Multigrid: an approximate inverse of ``alpha - beta Delta`` whose cost and quality do not depend on the mesh's size.

What enters: a surface, and what holds or absorbs on it (host). What leaves: a `Multigrid`, a pytree of the same tables
the Laplacian uses, whose V-cycle runs in JAX for any alpha and beta: the hierarchy is set up once.

Rows of non-negative weights are as a rule not symmetric in any measure, and on irregular meshes their symmetric part
is another diffusion. So the coarse levels are those of linear finite elements, which have the same smooth modes:
the graph with cotangent conductances, ``P^T K P`` on every level. On the finest level Jacobi sweeps with the rows
themselves deal with what is not smooth, and residuals are weighed with the measure that the rows nearly conserve. All
coarse matrices are ``alpha masses + beta (absorption - sum of differences)``: linear in alpha and beta, which are only
known inside jit.
"""

import importlib.util
import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse
from jaxtyping import Array, Float, Int

from .._lifting.layout import PerBlock
from .._lifting.schemes import Monotone
from .._mesh import Mesh
from .._operators import laplacian_matrix
from .._surface import Surface, on_surface
from .._tables import (
    AnyArray,
    ReverseWeights,
    Table,
    difference_sum,
    reverse_weights,
    reversible,
    slot_sum,
    weighted_table,
)

# A level of so many vertices is solved by its eigenvectors.
_COARSEST = 400
# Two sweeps of Jacobi before and after, damped by the inverse Chebyshev nodes of [0.5, 2], the upper three quarters of
# the range of a random walk's eigenvalues.
_DAMPING = tuple(float(1 / (1.25 + 0.75 * np.cos(np.pi * angle))) for angle in (0.25, 0.75))
# Sweeps of the transposed Laplacian from the vertex areas towards the measure it conserves.
_SWEEPS = 50


class Interpolation(eqx.Module):
    """How the vertices of a level take their values from those of the next.

    Attributes:
        table: where vertices that are not on the next level take their values from.
        shares: how much of each.
        reverse: the same in reverse, for restriction.
        coarse: (C,) the vertices of the next level.
    """

    table: Table
    shares: PerBlock
    reverse: ReverseWeights
    coarse: Int[AnyArray, " C"]

    def prolong(self, u: Float[Array, "C S"]) -> Float[Array, "V S"]:
        """A field of the next level on this one."""
        placed = jnp.zeros((self.table.num_vertices, u.shape[1]), u.dtype)
        placed = placed.at[self.coarse].set(u, unique_indices=True, mode="promise_in_bounds")
        # The rows of coarse vertices are empty, and elsewhere there is nothing to take a difference to.
        return placed + difference_sum(self.table, self.shares, placed)

    def restrict(self, r: Float[Array, "V S"]) -> Float[Array, "C S"]:
        """The transpose of `prolong`."""
        (gathered,) = jax.linear_transpose(lambda e: difference_sum(self.table, self.shares, e, self.reverse), r)(r)
        return (r + gathered).at[self.coarse].get(mode="promise_in_bounds", unique_indices=True)


class Level(eqx.Module):
    """A level below the finest: ``alpha masses u + beta (absorption u - sum of differences)``, symmetric.

    Attributes:
        table: the neighbours.
        conductances: weights of the differences to them.
        masses: (V,).
        absorption: (V,).
        down: the way to the next level.
    """

    table: Table
    conductances: PerBlock
    masses: Float[AnyArray, " V"]
    absorption: Float[AnyArray, " V"]
    down: Interpolation

    def apply(self, alpha: Array, beta: Array, u: Float[Array, "V S"]) -> Float[Array, "V S"]:
        """The operator of the level."""
        here = alpha[None] * self.masses[:, None] + beta[None] * self.absorption[:, None]
        return here * u - beta[None] * difference_sum(self.table, self.conductances, u)

    def diagonal(self, alpha: Array, beta: Array) -> Float[Array, "V S"]:
        """What `apply` multiplies u with at the vertex itself."""
        own = self.absorption + slot_sum(self.table, self.conductances)
        return alpha[None] * self.masses[:, None] + beta[None] * own[:, None]


class Multigrid(eqx.Module):
    """An approximate inverse of ``alpha - beta Delta`` for any alpha and beta.

    Attributes:
        table: the neighbours of the Laplacian.
        weights: its weights.
        reverse: the same in reverse, if the surface has them.
        absorption: (V,) what boundary conditions take from -Delta.
        is_free: (V,) 1 where no value is held, else 0.
        measure: (V,) nearly conserved by the Laplacian.
        down: the way to the first level below.
        levels: from fine to coarse.
        eigenvalues: (C,) of the coarsest level, relative to its masses.
        eigenvectors: (C, C) orthonormal with respect to them.
    """

    table: Table
    weights: PerBlock
    reverse: ReverseWeights | None
    absorption: Float[AnyArray, " V"]
    is_free: Float[AnyArray, " V"]
    measure: Float[AnyArray, " V"]
    down: Interpolation
    levels: tuple[Level, ...]
    eigenvalues: Float[AnyArray, " C"]
    eigenvectors: Float[AnyArray, "C C"]

    def apply(self, alpha: Array, beta: Array, u: Float[Array, "V S"]) -> Float[Array, "V S"]:
        """``alpha u - beta Delta u`` with what is absorbed; the identity where values are held."""
        free = self.is_free[:, None]
        u_free = free * u
        inward = self.absorption[:, None] * u_free - difference_sum(self.table, self.weights, u_free, self.reverse)
        return free * (alpha[None] * u_free + beta[None] * inward) + (1 - free) * u

    def __call__(
        self, alpha: Float[Array, " S"], beta: Float[Array, " S"], r: Float[Array, "V S"], transposed: bool = False
    ) -> Float[Array, "V S"]:
        """One V-cycle for ``apply(u) = r``, or for its transpose."""

        def forward(u):
            return self.apply(alpha, beta, u)

        def apply(u):
            return jax.linear_transpose(forward, u)(u)[0] if transposed else forward(u)

        own = self.absorption + slot_sum(self.table, self.weights)
        free = self.is_free[:, None]
        diagonal = free * (alpha[None] + beta[None] * own[:, None]) + (1 - free)
        weights = free * self.measure[:, None]
        u = _DAMPING[0] * r / diagonal
        u = u + _DAMPING[1] * (r - apply(u)) / diagonal
        residual = r - apply(u)
        below = self.down.restrict(residual if transposed else weights * residual)
        below = self.down.prolong(self._cycle(0, alpha, beta, below))
        u = u + (weights if transposed else free) * below
        return _sweeps(apply, diagonal, r, u)

    def _cycle(self, depth: int, alpha: Array, beta: Array, r: Array) -> Array:
        if depth == len(self.levels):
            # Where alpha and the eigenvalue vanish so does the operator; there it counts as the next eigenvalue.
            scale = alpha[None] + beta[None] * jnp.maximum(self.eigenvalues, self.smallest)[:, None]
            return self.eigenvectors @ ((self.eigenvectors.T @ r) / scale)
        level = self.levels[depth]
        diagonal = level.diagonal(alpha, beta)
        u = _DAMPING[0] * r / diagonal
        u = u + _DAMPING[1] * (r - level.apply(alpha, beta, u)) / diagonal
        below = self._cycle(depth + 1, alpha, beta, level.down.restrict(r - level.apply(alpha, beta, u)))
        return _sweeps(lambda u: level.apply(alpha, beta, u), diagonal, r, u + level.down.prolong(below))

    @property
    def smallest(self) -> Float[Array, ""]:
        """The smallest eigenvalue of the coarsest level that is not zero."""
        is_zero = self.eigenvalues <= 1e-6 * self.eigenvalues[-1]
        return jnp.min(jnp.where(is_zero, self.eigenvalues[-1], self.eigenvalues))


def _sweeps(apply: Callable[[Array], Array], diagonal: Array, r: Array, u: Array) -> Array:
    """The sweeps after the coarse correction, those before it in reverse. A loop: half as much to compile."""
    dampings = jnp.asarray(_DAMPING[::-1], r.dtype)
    return jax.lax.fori_loop(0, len(_DAMPING), lambda k, u: u + dampings[k] * (r - apply(u)) / diagonal, u)


def is_available() -> bool:
    """Whether pyamg, which chooses the coarse vertices, is installed."""
    return importlib.util.find_spec("pyamg") is not None


@on_surface
def multigrid(surface: Surface, absorption: np.ndarray | None = None, is_held: np.ndarray | None = None) -> Multigrid:
    """The hierarchy of a surface, set up once for its weights (host) and kept as long as they live.

    Args:
        surface: the surface. One whose scheme is not `Monotone` gets the hierarchy of `Monotone` on the same mesh.
        absorption: (V,) non-negative, what boundary conditions take from -Delta at each vertex; none by default.
        is_held: (V,) bool, vertices whose values are held; none by default.

    Raises:
        ImportError: pyamg is not installed.
        ValueError: the surface is being traced by a JAX transformation.
    """
    if not is_available():
        raise ImportError('Multigrid needs the extra "amg": pip install "ltljax[amg]".')
    if surface.is_traced:
        raise ValueError(
            "The hierarchy is set up on the host, but the surface is being traced by a JAX transformation. Set it up "
            "outside with ltl.solvers.multigrid(surface) and hand it in; that of a similar surface does as well."
        )
    size = surface.num_vertices
    absorption = np.zeros(size) if absorption is None else np.asarray(absorption, np.float64)
    is_held = np.zeros(size, bool) if is_held is None else np.asarray(is_held)
    key = f"multigrid {hash((absorption.tobytes(), is_held.tobytes()))}"
    # Inside jit too, of a surface that is not traced.
    with jax.ensure_compile_time_eval():
        return surface.remembered(key, lambda: _set_up(surface, absorption, is_held))


def _set_up(surface: Surface, absorption: np.ndarray, is_held: np.ndarray) -> Multigrid:
    vertices, faces = np.asarray(surface.vertices, np.float64), np.asarray(surface.faces)
    if not isinstance(surface.scheme, Monotone):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a surface the user did not ask for
            surface = Surface.from_mesh(Mesh(vertices, faces), Monotone(), surface.dtype)
    table, weights = surface.topology.diffusion, surface.geometry.laplacian_weights
    assert table is not None
    assert weights is not None
    areas = np.asarray(surface.vertex_areas, np.float64)
    # What flows to held vertices is absorbed; they themselves stand alone.
    free = scipy.sparse.diags_array((~is_held).astype(np.float64))
    conductances = _cotangents(vertices, faces)
    lost = np.where(is_held, areas, areas * absorption + conductances @ is_held)
    measure = _nearly_conserved(laplacian_matrix(surface), areas)
    down, levels, values, vectors = _hierarchy(scipy.sparse.csr_array(free @ conductances @ free), areas, lost)
    cast = lambda a: jnp.asarray(a, surface.dtype if a.dtype.kind == "f" else a.dtype)  # noqa: E731
    down, levels, values, vectors = jax.tree.map(cast, (down, levels, values, vectors))
    taken, is_free, measure = map(cast, (absorption, (~is_held).astype(np.float64), measure))
    reverse = surface.geometry.laplacian_reverse
    return Multigrid(table, weights, reverse, taken, is_free, measure, down, levels, values, vectors)


def _cotangents(vertices: np.ndarray, faces: np.ndarray) -> scipy.sparse.csr_array:
    """The conductances between vertices of linear finite elements, those of obtuse pairs of faces left out."""
    size, total = len(vertices), 0
    for corner in range(3):
        here, i, j = (faces[:, (corner + k) % 3] for k in range(3))
        a, b = vertices[i] - vertices[here], vertices[j] - vertices[here]
        twice_area = np.linalg.norm(np.cross(a, b), axis=1)
        half = np.einsum("fc,fc->f", a, b) / np.maximum(twice_area, 1e-12 * np.einsum("fc,fc->f", a, a)) / 2
        part = scipy.sparse.coo_array((half, (i, j)), shape=(size, size)).tocsr()
        total = total + part + part.T
    total = scipy.sparse.csr_array(total)
    total.data = np.maximum(total.data, 0)
    return total


def _nearly_conserved(laplacian: scipy.sparse.csr_array, areas: np.ndarray) -> np.ndarray:
    """The areas after some sweeps of Jacobi for ``L^T m = 0``: what differs from the conserved measure is smooth."""
    transposed, rates = scipy.sparse.csr_array(laplacian.T), -np.asarray(laplacian.diagonal(), np.float64)
    rates = np.where(rates > 0, rates, 1)
    for _ in range(_SWEEPS):
        areas = areas + 0.7 * (transposed @ areas) / rates
    return np.maximum(areas, 0)


def _hierarchy(conductances, masses: np.ndarray, absorption: np.ndarray) -> tuple[Interpolation, tuple, Any, Any]:
    """The way down, the levels below, and eigenvalues and eigenvectors of the coarsest, in NumPy (Ruge and Stueben)."""
    import pyamg

    matrix = scipy.sparse.csr_matrix(scipy.sparse.diags_array(conductances.sum(axis=1) + absorption) - conductances)
    # Vertices without neighbours would make empty rows.
    matrix = scipy.sparse.csr_matrix(matrix + 1e-3 * scipy.sparse.diags_array(masses) * (1 / masses.sum()))
    matrix.indices, matrix.indptr = matrix.indices.astype(np.int32), matrix.indptr.astype(np.int32)
    # With the second pass neighbours that depend on one another share a vertex of the next level to interpolate from:
    # without it iterations grow on random points, from 8 at 2,500 to 18 at 160,000, and with it from 6 to 8.
    splitting = ("RS", {"second_pass": True})
    solver: Any = pyamg.ruge_stuben_solver(matrix, CF=splitting, max_coarse=_COARSEST, keep=True, max_levels=20)
    if len(solver.levels) == 1:  # so few vertices that they are the coarsest level themselves
        every = np.arange(len(masses), dtype=np.int32)
        none = scipy.sparse.csr_array(matrix.shape)
        return _way_down(none, every), (), *_modes(matrix, masses)
    downs = [_way_down(_in_place(level), np.flatnonzero(level.splitting)) for level in solver.levels[:-1]]
    levels = []
    for fine, here, down in zip(solver.levels[:-1], solver.levels[1:], [*downs[1:], None], strict=True):
        masses = fine.P.T @ masses
        if down is not None:
            table, weights = weighted_table(-here.A)
            levels.append(Level(table, weights, masses, np.asarray(here.A.sum(axis=1)).ravel(), down))
    return downs[0], tuple(levels), *_modes(solver.levels[-1].A, masses)


def _in_place(level) -> scipy.sparse.csr_array:
    """The interpolation of a level with each column at the place of its coarse vertex."""
    spread = scipy.sparse.coo_array(level.P)
    coarse = np.flatnonzero(level.splitting)
    return scipy.sparse.csr_array((spread.data, (spread.row, coarse[spread.col])), shape=level.A.shape)


def _way_down(interpolation: scipy.sparse.csr_array, coarse: np.ndarray) -> Interpolation:
    table, shares = weighted_table(interpolation)
    table = reversible(table)
    reverse = reverse_weights(table, shares)
    assert reverse is not None
    return Interpolation(table, shares, reverse, coarse.astype(np.int32))


def _modes(matrix, masses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    values, vectors = scipy.linalg.eigh(matrix.toarray(), np.diag(masses))
    return np.maximum(values, 0), vectors
