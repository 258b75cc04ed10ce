"""Multigrid and the Krylov solvers that it preconditions."""

import functools

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

import ltljax as ltl
from ltljax._solve.krylov import GMRES, BiCGStab, BiCGStabThenGMRES, Jacobi, linear_solve

MESHES = {
    "icosphere": lambda n: ltl.shapes.icosphere({2500: 4, 40000: 6, 160000: 7}[n]),
    "jittered": lambda n: ltl.shapes.jittered_sphere({2500: 4, 40000: 6, 160000: 7}[n], 0.5, seed=0),
    "random": lambda n: ltl.shapes.random_sphere({2500: 2562, 40000: 40962, 160000: 163842}[n], seed=0),
    "torus": lambda n: ltl.shapes.torus(n_major=2 * round((n / 2) ** 0.5), n_minor=round((n / 2) ** 0.5)),
}


@functools.cache
def mesh_of(kind):
    return MESHES[kind](2500)


@functools.cache
def surface_of(kind):
    return ltl.Surface.from_mesh(mesh_of(kind))


@pytest.fixture(scope="module", autouse=True)
def release_surfaces():
    yield
    surface_of.cache_clear()


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(3, 0.3, seed=0))


@jax.jit
def implicit_step(surface, hierarchy, b, dt, rtol):
    """The number of iterations and the relative residual of a solve with ``1 - dt Delta``."""
    inverse = hierarchy.shifted(jnp.ones(1, b.dtype), dt * jnp.ones(1, b.dtype))
    solution = linear_solve(lambda u: u - dt * ltl.laplacian(surface, u), b, inverse, rtol)
    residual = solution.value - dt * ltl.laplacian(surface, solution.value) - b
    return solution.stats["num_steps"], jnp.linalg.norm(residual) / jnp.linalg.norm(b)


def num_iterations(surface, dt, rtol):
    b = jnp.asarray(np.random.default_rng(0).normal(size=surface.num_vertices))
    iterations, residual = implicit_step(surface, ltl.solvers.multigrid(surface), b, dt, rtol)
    assert residual < 2 * rtol
    return int(iterations)


@pytest.mark.parametrize("kind", [
    pytest.param("icosphere", marks=pytest.mark.slow), pytest.param("jittered", marks=pytest.mark.slow), "random",
    pytest.param("torus", marks=pytest.mark.slow),
])  # fmt: skip
def test_multigrid_needs_few_iterations_on_any_mesh(kind):
    surface = surface_of(kind)
    assert num_iterations(surface, 1.0, 1e-8) < 12
    assert num_iterations(surface, 1e-2, 1e-8) < 10


@pytest.mark.slow
@pytest.mark.parametrize("size", [40000, 160000])
@pytest.mark.parametrize("kind", MESHES)
def test_the_number_of_iterations_does_not_grow_with_the_mesh(kind, size):
    surface = ltl.Surface.from_mesh(MESHES[kind](size))
    assert num_iterations(surface, 1.0, 1e-8) < 15


def test_the_transposed_cycle_is_the_transpose_of_the_cycle(sphere):
    hierarchy = ltl.solvers.multigrid(sphere).shifted(jnp.array([1.0, 0.3]), jnp.array([0.1, 2.0]))
    random = np.random.default_rng(0)
    r, s = (jnp.asarray(random.normal(size=(sphere.num_vertices, 2))) for _ in range(2))
    cycle = jax.jit(lambda hierarchy, r, transposed: hierarchy(r, transposed), static_argnums=2)
    forward = jnp.sum(s * cycle(hierarchy, r, False))
    backward = jnp.sum(r * cycle(hierarchy, s, True))
    np.testing.assert_allclose(forward, backward, rtol=1e-10)


@pytest.mark.parametrize("kind", [BiCGStab, GMRES, BiCGStabThenGMRES])
def test_every_krylov_solver_reaches_its_tolerance_in_any_unit(kind):
    random = np.random.default_rng(0)
    matrix = jnp.asarray(np.diag(np.arange(1.0, 31.0)) + 0.1 * random.normal(size=(30, 30)))
    b = jnp.asarray(random.normal(size=30))

    @jax.jit
    def solve(b):
        solver = kind(1e-9, Jacobi(jnp.diag(matrix)[:, None]))
        solution = lx.linear_solve(lx.MatrixLinearOperator(matrix), b, solver, throw=False)
        return solution.value, solution.result == lx.RESULTS.successful

    for unit in (1.0, 1e-250, 0.0):
        x, has_converged = solve(unit * b)
        assert has_converged
        np.testing.assert_allclose(matrix @ x, unit * b, atol=1e-8 * unit)


def test_bicgstab_needs_no_more_iterations_than_there_are_eigenvalues():
    random = np.random.default_rng(0)
    vectors = np.eye(40) + 0.1 * random.normal(size=(40, 40))
    matrix = jnp.asarray(vectors @ np.diag(np.repeat([1.0, 2.0, 5.0, 9.0], 10)) @ np.linalg.inv(vectors))
    b = jnp.asarray(random.normal(size=40))
    solution = lx.linear_solve(lx.MatrixLinearOperator(matrix), b, BiCGStab(1e-9), throw=False)
    np.testing.assert_allclose(matrix @ solution.value, b, atol=1e-7)
    assert int(solution.stats["num_steps"]) <= 4


def test_gmres_takes_over_where_bicgstab_fails():
    # Rotations by a right angle: every residual is orthogonal to its image, so BiCGStab makes no progress.
    matrix = jnp.asarray(np.kron(np.diag(np.arange(1.0, 6.0)), [[0.0, 1.0], [-1.0, 0.0]]))
    b = jnp.arange(1.0, 11.0)
    operator = lx.MatrixLinearOperator(matrix)
    quick = lx.linear_solve(operator, b, BiCGStab(1e-9), throw=False)
    assert quick.result == lx.RESULTS.max_steps_reached
    solution = lx.linear_solve(operator, b, BiCGStabThenGMRES(1e-9), throw=False)
    assert solution.result == lx.RESULTS.successful
    np.testing.assert_allclose(matrix @ solution.value, b, atol=1e-7)
