"""Multigrid: an approximate inverse of ``alpha - beta Delta`` whose cost per vertex and quality do not depend on the
mesh size.

What enters: a surface, and what boundary conditions hold or absorb on it (host). What leaves: a `Multigrid`, a pytree
of the same kind of tables as the Laplacian's. Its V-cycle runs in JAX for any alpha and beta, so the hierarchy is set
up once.

The coarse levels are those of linear finite elements: the graph with cotangent conductances K, and ``P^T K P`` below.
The rows of the Laplacian cannot take their place. They are not symmetric in any measure as a rule, and on irregular
meshes their symmetric part is a different diffusion; but their smooth modes are those of finite elements. On the finest
level, Jacobi sweeps with the rows themselves damp what is not smooth, and the residual is weighted with the measure
that the rows nearly conserve. Every coarse matrix is ``alpha masses + beta (absorption - sum of differences)``, hence
linear in alpha and beta, which are known only inside jit.
"""

import dataclasses
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

from .._lifting.schemes import Monotone
from .._mesh import Mesh
from .._surface import Surface, on_surface
from .._tables import AnyArray, Stencil, reverse_weights, reversible, weighted_table
from .krylov import Preconditioner

# A level with at most this many vertices is solved by its eigenvectors.
_COARSEST = 400
# Two Jacobi sweeps precede the coarse correction and two follow it. Their damping factors are the inverse Chebyshev
# nodes of [0.5, 2], the upper three quarters of the range of a random walk's eigenvalues.
_DAMPING = tuple(float(1 / (1.25 + 0.75 * np.cos(np.pi * angle))) for angle in (0.25, 0.75))
# Number of sweeps that turn the vertex areas into an approximation of the measure that the Laplacian conserves.
_SWEEPS = 50


class Interpolation(eqx.Module):
    """Interpolation from a level to the next finer one, and its transpose.

    Attributes:
        stencil: interpolation weights of the vertices that are not on the coarse level.
        coarse: (C,) fine-level indices of the vertices on the coarse level.
    """

    stencil: Stencil
    coarse: Int[AnyArray, " C"]

    def prolong(self, u: Float[Array, "C S"]) -> Float[Array, "V S"]:
        """A coarse field on the fine level."""
        values = jnp.zeros((self.stencil.table.num_vertices, u.shape[1]), u.dtype)
        values = values.at[self.coarse].set(u, unique_indices=True, mode="promise_in_bounds")
        # A difference equals the neighbour's value at the other vertices, and coarse vertices have empty rows.
        return values + self.stencil(values)

    def restrict(self, r: Float[Array, "V S"]) -> Float[Array, "C S"]:
        """The transpose of `prolong`."""
        return (r + self.stencil.transpose(r)).at[self.coarse].get(mode="promise_in_bounds", unique_indices=True)


class Level(eqx.Module):
    """A level below the finest: ``alpha masses u + beta (absorption u - sum of differences)``, which is symmetric.

    Attributes:
        conductances: the sum of differences to the neighbours.
        masses: (V,) sums of fine-level areas.
        absorption: (V,) what boundary conditions absorb.
        interpolation: interpolation from the next coarser level.
    """

    conductances: Stencil
    masses: Float[AnyArray, " V"]
    absorption: Float[AnyArray, " V"]
    interpolation: Interpolation

    def apply(self, alpha: Array, beta: Array, u: Float[Array, "V S"]) -> Float[Array, "V S"]:
        """The operator of the level applied to u."""
        local = alpha[None] * self.masses[:, None] + beta[None] * self.absorption[:, None]
        return local * u - beta[None] * self.conductances(u)

    def diagonal(self, alpha: Array, beta: Array) -> Float[Array, "V S"]:
        """The diagonal of `apply`."""
        leaving = self.absorption + self.conductances.row_sums()
        return alpha[None] * self.masses[:, None] + beta[None] * leaving[:, None]


class Multigrid(Preconditioner):
    """An approximate inverse of ``alpha - beta Delta``: one V-cycle.

    `shifted` sets alpha and beta without setting up the hierarchy again.

    Attributes:
        laplacian: the Laplacian of `Monotone`.
        absorption: (V,) what boundary conditions absorb from -Delta.
        is_free: (V,) 1 where no value is held, else 0.
        measure: (V,) measure that the Laplacian nearly conserves.
        interpolation: interpolation from the first coarse level.
        levels: coarse levels, from fine to coarse.
        eigenvalues: (C,) eigenvalues of the coarsest level relative to its masses.
        eigenvectors: (C, C) eigenvectors of the coarsest level, orthonormal with respect to its masses.
        alpha: (S,) or (1,) coefficient of u.
        beta: (S,) or (1,) coefficient of -Delta u.
    """

    laplacian: Stencil
    absorption: Float[AnyArray, " V"]
    is_free: Float[AnyArray, " V"]
    measure: Float[AnyArray, " V"]
    interpolation: Interpolation
    levels: tuple[Level, ...]
    eigenvalues: Float[AnyArray, " C"]
    eigenvectors: Float[AnyArray, "C C"]
    alpha: Float[Array, " S"]
    beta: Float[Array, " S"]

    def shifted(self, alpha, beta):
        """The same hierarchy for other alpha and beta, one of each per species."""
        return dataclasses.replace(self, alpha=alpha, beta=beta)

    def null_shift(self):
        """The smallest eigenvalue of the coarsest level that is not zero."""
        is_zero = self.eigenvalues <= 1e-6 * self.eigenvalues[-1]
        return jnp.min(jnp.where(is_zero, self.eigenvalues[-1], self.eigenvalues))

    def apply(self, u: Float[Array, "V S"]) -> Float[Array, "V S"]:
        """``alpha u - beta Delta u`` including absorption, and u itself where values are held."""
        free = self.is_free[:, None]
        u_free = free * u
        inward = self.absorption[:, None] * u_free - self.laplacian(u_free)
        return free * (self.alpha[None] * u_free + self.beta[None] * inward) + (1 - free) * u

    def __call__(self, r: Float[Array, "V *S"], transposed: bool = False) -> Float[Array, "V *S"]:
        """One V-cycle for ``apply(u) = r``, or for its transpose."""
        return self._cycle(r.reshape(len(r), -1), transposed).reshape(r.shape)

    def _cycle(self, r: Float[Array, "V S"], transposed: bool) -> Float[Array, "V S"]:
        def apply(u):
            return jax.linear_transpose(self.apply, u)(u)[0] if transposed else self.apply(u)

        leaving = self.absorption + self.laplacian.row_sums()
        free = self.is_free[:, None]
        diagonal = free * (self.alpha[None] + self.beta[None] * leaving[:, None]) + (1 - free)
        weights = free * self.measure[:, None]
        u = _sweeps_before(apply, diagonal, r)
        residual = r - apply(u)
        coarse = self.interpolation.restrict(residual if transposed else weights * residual)
        correction = self.interpolation.prolong(self._coarse_cycle(0, coarse))
        u = u + (weights if transposed else free) * correction
        return _sweeps_after(apply, diagonal, r, u)

    def _coarse_cycle(self, depth: int, r: Array) -> Array:
        if depth == len(self.levels):
            # Where alpha and an eigenvalue both vanish, the operator is singular; the next eigenvalue takes its place.
            scale = self.alpha[None] + self.beta[None] * jnp.maximum(self.eigenvalues, self.null_shift())[:, None]
            return self.eigenvectors @ ((self.eigenvectors.T @ r) / scale)
        level = self.levels[depth]

        def apply(u):
            return level.apply(self.alpha, self.beta, u)

        diagonal = level.diagonal(self.alpha, self.beta)
        u = _sweeps_before(apply, diagonal, r)
        correction = self._coarse_cycle(depth + 1, level.interpolation.restrict(r - apply(u)))
        return _sweeps_after(apply, diagonal, r, u + level.interpolation.prolong(correction))


def _sweeps_before(apply: Callable[[Array], Array], diagonal: Array, r: Array) -> Array:
    """The damped Jacobi sweeps before the coarse correction, which start from zero."""
    u = _DAMPING[0] * r / diagonal
    return u + _DAMPING[1] * (r - apply(u)) / diagonal


def _sweeps_after(apply: Callable[[Array], Array], diagonal: Array, r: Array, u: Array) -> Array:
    """The damped Jacobi sweeps after the coarse correction, in reverse order.

    A loop compiles in half the time of two sweeps written out.
    """
    dampings = jnp.asarray(_DAMPING[::-1], r.dtype)
    return jax.lax.fori_loop(0, len(_DAMPING), lambda k, u: u + dampings[k] * (r - apply(u)) / diagonal, u)


def is_available() -> bool:
    """Whether pyamg, which chooses the coarse vertices, is installed."""
    return importlib.util.find_spec("pyamg") is not None


@on_surface
def multigrid(surface: Surface, absorption: np.ndarray | None = None, is_held: np.ndarray | None = None) -> Multigrid:
    """The multigrid hierarchy of a surface (host), which the surface keeps for as long as it lives.

    Args:
        surface: surface of any scheme. The hierarchy is that of `Monotone` on the same mesh.
        absorption: (V,) non-negative rates at which boundary conditions absorb from -Delta; none by default.
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
            "outside with ltl.solvers.multigrid(surface) and hand it in; the hierarchy of a similar surface works too."
        )
    size = surface.num_vertices
    absorption = np.zeros(size) if absorption is None else np.asarray(absorption, np.float64)
    is_held = np.zeros(size, bool) if is_held is None else np.asarray(is_held)
    key = f"multigrid {hash((absorption.tobytes(), is_held.tobytes()))}"
    # A surface that is not traced can be asked for its hierarchy inside jit as well.
    with jax.ensure_compile_time_eval():
        return surface.remembered(key, lambda: _set_up(surface, absorption, is_held))


def _set_up(surface: Surface, absorption: np.ndarray, is_held: np.ndarray) -> Multigrid:
    vertices, faces = np.asarray(surface.vertices, np.float64), np.asarray(surface.faces)
    if not surface.scheme.is_monotone:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # They would concern a surface that the user did not ask for.
            surface = Surface.from_mesh(Mesh(vertices, faces), Monotone(), surface.dtype)
    laplacian = surface.laplacian_stencil
    assert isinstance(laplacian, Stencil)
    areas = np.asarray(surface.vertex_areas, np.float64)
    # What flows to held vertices is absorbed, and held vertices are decoupled from the others.
    is_free = (~is_held).astype(np.float64)
    free = scipy.sparse.diags_array(is_free)
    conductances = _cotangent_conductances(vertices, faces)
    absorbed = np.where(is_held, areas, areas * absorption + conductances @ is_held)
    measure = _nearly_conserved(laplacian.matrix(), areas)
    coarse = _hierarchy(scipy.sparse.csr_array(free @ conductances @ free), areas, absorbed)
    cast = lambda a: jnp.asarray(a, surface.dtype if a.dtype.kind == "f" else a.dtype)  # noqa: E731
    absorption, is_free, measure, coarse = jax.tree.map(cast, (absorption, is_free, measure, coarse))
    interpolation, levels, eigenvalues, eigenvectors = coarse
    alpha, beta = jnp.zeros(1, surface.dtype), jnp.ones(1, surface.dtype)
    return Multigrid(
        laplacian, absorption, is_free, measure, interpolation, levels, eigenvalues, eigenvectors,
        alpha, beta,
    )  # fmt: skip


def _cotangent_conductances(vertices: np.ndarray, faces: np.ndarray) -> scipy.sparse.csr_array:
    """The conductances of linear finite elements between vertices, with negative ones replaced by zero."""
    size, total = len(vertices), 0
    for corner in range(3):
        apex, i, j = (faces[:, (corner + k) % 3] for k in range(3))
        a, b = vertices[i] - vertices[apex], vertices[j] - vertices[apex]
        twice_area = np.linalg.norm(np.cross(a, b), axis=1)
        half = np.einsum("fc,fc->f", a, b) / np.maximum(twice_area, 1e-12 * np.einsum("fc,fc->f", a, a)) / 2
        part = scipy.sparse.coo_array((half, (i, j)), shape=(size, size)).tocsr()
        total = total + part + part.T
    total = scipy.sparse.csr_array(total)
    total.data = np.maximum(total.data, 0)
    return total


def _nearly_conserved(laplacian: scipy.sparse.csr_array, areas: np.ndarray) -> np.ndarray:
    """The areas after some Jacobi sweeps for ``L^T m = 0``: their error as a conserved measure is smooth."""
    transposed, rates = scipy.sparse.csr_array(laplacian.T), -np.asarray(laplacian.diagonal(), np.float64)
    rates = np.where(rates > 0, rates, 1)
    for _ in range(_SWEEPS):
        areas = areas + 0.7 * (transposed @ areas) / rates
    return np.maximum(areas, 0)


def _hierarchy(
    conductances: scipy.sparse.csr_array, masses: np.ndarray, absorption: np.ndarray
) -> tuple[Interpolation, tuple[Level, ...], np.ndarray, np.ndarray]:
    """The first interpolation, the coarse levels, and the eigenvalues and eigenvectors of the coarsest, in NumPy.

    Source: Ruge and Stueben (1987), Algebraic multigrid, doi:10.1137/1.9781611971057.ch4.
    """
    import pyamg

    matrix = scipy.sparse.csr_matrix(scipy.sparse.diags_array(conductances.sum(axis=1) + absorption) - conductances)
    # Vertices without neighbours would make empty rows.
    matrix = scipy.sparse.csr_matrix(matrix + 1e-3 * scipy.sparse.diags_array(masses) * (1 / masses.sum()))
    matrix.indices, matrix.indptr = matrix.indices.astype(np.int32), matrix.indptr.astype(np.int32)
    # The second pass makes sure that neighbours which depend on one another share a coarse vertex to interpolate from.
    # From 2,500 to 160,000 random points, iterations grow from 6 to 8 with it and from 8 to 18 without it.
    splitting = ("RS", {"second_pass": True})
    solver: Any = pyamg.ruge_stuben_solver(matrix, CF=splitting, max_coarse=_COARSEST, keep=True, max_levels=20)
    if len(solver.levels) == 1:  # The mesh is so small that it is its own coarsest level.
        all_vertices = np.arange(len(masses), dtype=np.int32)
        return _interpolation(scipy.sparse.csr_array(matrix.shape), all_vertices), (), *_modes(matrix, masses)
    interpolations = [
        _interpolation(_square_interpolation(level), np.flatnonzero(level.splitting)) for level in solver.levels[:-1]
    ]
    levels = []
    for fine, coarse, interpolation in zip(
        solver.levels[:-1], solver.levels[1:], [*interpolations[1:], None], strict=True
    ):
        masses = fine.P.T @ masses
        if interpolation is not None:
            table, weights = weighted_table(-coarse.A)
            levels.append(
                Level(Stencil(table, weights), masses, np.asarray(coarse.A.sum(axis=1)).ravel(), interpolation)
            )
    return interpolations[0], tuple(levels), *_modes(solver.levels[-1].A, masses)


def _square_interpolation(level: Any) -> scipy.sparse.csr_array:
    """The interpolation matrix of a pyamg level with each column at the fine-level index of its coarse vertex."""
    entries = scipy.sparse.coo_array(level.P)
    coarse = np.flatnonzero(level.splitting)
    return scipy.sparse.csr_array((entries.data, (entries.row, coarse[entries.col])), shape=level.A.shape)


def _interpolation(matrix: scipy.sparse.csr_array, coarse: np.ndarray) -> Interpolation:
    table, shares = weighted_table(matrix)
    table = reversible(table)
    reverse = reverse_weights(table, shares)
    assert reverse is not None
    return Interpolation(Stencil(table, shares, reverse), coarse.astype(np.int32))


def _modes(matrix: Any, masses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues and eigenvectors of a matrix relative to masses."""
    values, vectors = scipy.linalg.eigh(matrix.toarray(), np.diag(masses))
    return np.maximum(values, 0), vectors
