"""Linear systems: multigrid, sparse factors, and the Poisson equations that they solve."""

import functools
import gc
import os
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robust_laplacian
import scipy.sparse.linalg
from jax.test_util import check_grads

import ltljax as ltl
from ltljax._base import cache
from ltljax._solve import direct, poisson_equation, preconditioning
from ltljax._solve.krylov import Jacobi, linear_solve

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


@pytest.fixture(scope="module")
def small_sphere():
    return ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(2, 0.3, seed=0))


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


@pytest.fixture(params=["factor", "multigrid"])
def inverse_kind(request, monkeypatch):
    """The kind of inverse that `poisson` chooses by default."""
    return choose_inverse(request.param, monkeypatch)


def choose_inverse(kind, monkeypatch):
    if kind == "multigrid":
        monkeypatch.setattr(poisson_equation, "_FACTORISED", dict.fromkeys(poisson_equation._FACTORISED, 0))
    return kind


@pytest.fixture
def counts(monkeypatch):
    """The numbers of iterations of the Poisson equations solved so far."""
    numbers = []
    solve = poisson_equation.stationary_diffusion

    def counting_solve(*args):
        state = solve(*args)
        numbers.append(int(state.iterations))
        return state

    monkeypatch.setattr(poisson_equation, "stationary_diffusion", counting_solve)
    return numbers


def test_poisson_is_of_second_order_and_leaves_no_residual():
    errors = []
    for level in (3, 4):
        surface = ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(level, 0.3, seed=0))
        exact = surface.vertices.prod(axis=1)
        exact = exact - ltl.integrate(surface, exact) / jnp.sum(surface.vertex_areas)
        f = -12 * surface.vertices.prod(axis=1)
        u = ltl.poisson(surface, f)
        f = f - ltl.integrate(surface, f, surface.mass) / jnp.sum(surface.mass)
        assert jnp.linalg.norm(ltl.laplacian(surface, u) - f) < 1e-9 * jnp.linalg.norm(f)
        assert abs(ltl.integrate(surface, u)) < 1e-10
        errors.append(jnp.linalg.norm(u - exact) / jnp.linalg.norm(exact))
    assert np.log2(errors[0] / errors[1]) > 1.7
    assert errors[1] < 5e-3


@pytest.mark.parametrize(("kind", "inverse"), [
    ("icosphere", "factor"),
    ("jittered", "factor"),
    ("random", "factor"),
    ("torus", "factor"),
    pytest.param("icosphere", "multigrid", marks=pytest.mark.slow),
    pytest.param("jittered", "multigrid", marks=pytest.mark.slow),
    ("random", "multigrid"),
    pytest.param("torus", "multigrid", marks=pytest.mark.slow),
])  # fmt: skip
def test_poisson_leaves_no_residual_on_any_mesh(kind, inverse, monkeypatch):
    choose_inverse(inverse, monkeypatch)
    surface = surface_of(kind)
    f = jnp.sin(3 * surface.vertices[:, 0]) + surface.vertices[:, 2]
    f = f - ltl.integrate(surface, f, surface.mass) / jnp.sum(surface.mass)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        u = ltl.poisson(surface, f)
    assert jnp.linalg.norm(ltl.laplacian(surface, u) - f) < 1e-10 * jnp.linalg.norm(f)


def test_high_order_is_solved_with_the_multigrid_of_monotone_and_by_a_factor():
    surface = ltl.Surface.from_mesh(mesh_of("icosphere"), ltl.Polynomial(degree=4))
    u = surface.vertices.prod(axis=1)
    for inverse in (ltl.solvers.multigrid(surface), ltl.solvers.factorized(surface, 1.0)):
        solution = ltl.screened_poisson(surface, -13 * u, preconditioner=inverse)
        assert jnp.linalg.norm(solution - u) < 5e-5 * jnp.linalg.norm(u)


@pytest.mark.parametrize(("kind", "factor"), [("jittered", 40), pytest.param("random", 8, marks=pytest.mark.slow)])
def test_high_order_on_irregular_meshes_takes_few_iterations_and_beats_finite_elements(kind, factor, counts):
    mesh = mesh_of(kind)
    surface = ltl.Surface.from_mesh(mesh, ltl.Polynomial(degree=4))
    u = surface.vertices.prod(axis=1)
    solution = ltl.screened_poisson(surface, -13 * u, preconditioner=ltl.solvers.multigrid(surface))
    error = float(jnp.linalg.norm(solution - u) / jnp.linalg.norm(u))
    # Linear finite elements on intrinsic Delaunay triangles.
    stiffness, masses = robust_laplacian.mesh_laplacian(mesh.vertices, mesh.faces)
    exact = np.asarray(u)
    elements = scipy.sparse.linalg.spsolve((stiffness + masses).tocsc(), 13 * (masses @ exact))
    assert error * factor < np.linalg.norm(elements - exact) / np.linalg.norm(exact)
    if kind == "jittered":  # On random points BiCGStab fails, and GMRES takes about a hundred directions.
        assert counts[-1] < 35


@pytest.mark.slow
def test_high_order_takes_few_iterations_for_a_rough_right_hand_side():
    surface = ltl.Surface.from_mesh(mesh_of("jittered"), ltl.Polynomial(degree=4))
    assert num_iterations(surface, 1.0, 1e-10) < 35


def test_a_right_hand_side_with_a_mean_is_reported(sphere):
    x1 = sphere.vertices[:, 0]
    with pytest.warns(ltl.errors.IncompatibleSourceWarning, match=r"mean of 0\.5") as records:
        shifted = ltl.poisson(sphere, x1 + 0.5)
    if os.environ.get("LTLJAX_CHECK_SHAPES") != "1":  # the checks call functions through wrappers
        assert records[0].filename == __file__
    np.testing.assert_allclose(shifted, ltl.poisson(sphere, x1), atol=1e-8)


def two_spheres(subdivisions):
    sphere = ltl.shapes.icosphere(subdivisions)
    return ltl.Mesh(
        np.concatenate([sphere.vertices, sphere.vertices + 5]),
        np.concatenate([sphere.faces, sphere.faces + sphere.num_vertices]),
    )


@pytest.mark.parametrize("inverse_kind", ["factor", pytest.param("multigrid", marks=pytest.mark.slow)], indirect=True)
def test_every_component_has_its_own_mean(inverse_kind):
    mesh = ltl.shapes.icosphere(2)
    surface = ltl.Surface.from_mesh(two_spheres(2))
    x1 = jnp.asarray(np.tile(mesh.vertices[:, 0], 2) * np.repeat([1.0, 3.0], mesh.num_vertices))
    both = ltl.poisson(surface, x1).reshape(2, -1)
    single = ltl.poisson(ltl.Surface.from_mesh(mesh), jnp.asarray(mesh.vertices[:, 0]))
    np.testing.assert_allclose(both, np.stack([single, 3 * single]), atol=1e-8)


def test_the_report_of_a_small_mean_names_its_column_and_component():
    surface = ltl.Surface.from_mesh(two_spheres(4))
    is_second = surface.topology.components == 1
    x1 = surface.vertices[:, 0] - jnp.where(is_second, 5.0, 0)
    f = jnp.stack([100 * x1, x1], axis=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        exact = ltl.poisson(surface, f)
    with pytest.warns(ltl.errors.IncompatibleSourceWarning, match=r"mean of 0\.01 over component 1 in column 1"):
        u = ltl.poisson(surface, f.at[:, 1].add(jnp.where(is_second, 0.01, 0)))
    np.testing.assert_allclose(u, exact, atol=1e-6)


@pytest.mark.parametrize("kind", [pytest.param("jittered", marks=pytest.mark.slow), "random", "torus"])
def test_a_mean_that_discretisation_causes_is_not_reported(kind):
    surface = surface_of(kind)
    x, y, z = surface.vertices.T
    for f in (x, z * x, jnp.sin(5 * z), x * y * z):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            ltl.poisson(surface, f)
        with pytest.warns(ltl.errors.IncompatibleSourceWarning):
            ltl.poisson(surface, f + 0.01 * jnp.sqrt(jnp.mean(f**2)))


CONDITIONS = {
    "Dirichlet": ltl.Dirichlet(1.0),
    "Robin": ltl.Robin(1.0, 1.0, 3.0),
    "Neumann": (ltl.Neumann(2.0), ltl.Dirichlet(1.0, where=0)),
}


@pytest.mark.parametrize(("condition", "inverse"), [
    ("Dirichlet", "factor"),
    ("Robin", "factor"),
    ("Neumann", "factor"),
    pytest.param("Dirichlet", "multigrid", marks=pytest.mark.slow),
    pytest.param("Robin", "multigrid", marks=pytest.mark.slow),
    ("Neumann", "multigrid"),
])  # fmt: skip
def test_poisson_on_a_disk_satisfies_its_boundary_conditions(condition, inverse, monkeypatch):
    choose_inverse(inverse, monkeypatch)
    surface = ltl.Surface.from_mesh(ltl.shapes.disk())
    squared = jnp.sum(surface.vertices**2, axis=1)
    np.testing.assert_allclose(ltl.poisson(surface, 0 * squared + 4, CONDITIONS[condition]), squared, atol=1e-8)


def test_poisson_counts_fluxes_as_part_of_the_right_hand_side():
    surface = ltl.Surface.from_mesh(ltl.shapes.disk())
    x1 = surface.vertices[:, 0]
    # The Laplacian of x^2 + y^2 has a mean, which the flux of 2 through the boundary compensates.
    squared = jnp.sum(surface.vertices**2, axis=1)
    u = ltl.poisson(surface, 0 * x1 + 4, ltl.Neumann(2.0))
    np.testing.assert_allclose(u - u[0], squared - squared[0], atol=1e-2)
    with pytest.warns(ltl.errors.IncompatibleSourceWarning, match="fluxes included"):
        ltl.poisson(surface, 0 * x1 + 4, ltl.Neumann(1.0))
    with pytest.raises(ltl.SolveError, match="source and fluxes have a mean"):
        ltl.steady_state(ltl.Diffusion(boundary=ltl.Neumann(1.0)), surface, x1)


@pytest.mark.parametrize("inverse_kind", ["factor", pytest.param("multigrid", marks=pytest.mark.slow)], indirect=True)
def test_poisson_is_differentiable_in_its_right_hand_side_in_both_modes(small_sphere, inverse_kind):
    f = jnp.cos(2 * small_sphere.vertices[:, 0])
    f = f - ltl.integrate(small_sphere, f, small_sphere.mass) / jnp.sum(small_sphere.mass)
    solve = jax.jit(lambda f: jnp.sin(ltl.poisson(small_sphere, f)))
    check_grads(solve, (f,), order=1, modes=("fwd", "rev"), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("make_inverse", [
    pytest.param(ltl.solvers.multigrid, id="multigrid", marks=pytest.mark.slow),
    pytest.param(lambda surface: ltl.solvers.factorized(surface, 1.0), id="factor"),
])  # fmt: skip
def test_poisson_is_differentiable_in_the_vertices(make_inverse, sphere):
    inverse, x = make_inverse(sphere), sphere.vertices
    f = jnp.cos(2 * x[:, 0])

    @jax.jit
    def energy(stretch):
        moved = sphere.with_vertices(x * (1 + stretch * x[:, :1]))
        return jnp.sum(ltl.screened_poisson(moved, f, preconditioner=inverse) ** 2)

    slope = (energy(0.1 + 1e-4) - energy(0.1 - 1e-4)) / 2e-4
    np.testing.assert_allclose(jax.grad(energy)(0.1), slope, rtol=1e-6)


@pytest.mark.parametrize("scheme", [ltl.Monotone(), ltl.Polynomial(degree=4)], ids=["Monotone", "Polynomial"])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["float32", "float64"])
def test_a_factor_is_the_inverse_and_its_transpose(scheme, dtype):
    surface = ltl.Surface.from_mesh(two_spheres(2), scheme, dtype)
    laplacian = ltl.laplacian_matrix(surface).todense()
    areas = np.asarray(surface.vertex_areas)
    components = np.asarray(surface.topology.components)
    r = jnp.asarray(np.random.default_rng(0).normal(size=(surface.num_vertices, 2)), dtype)
    eps = float(jnp.finfo(dtype).eps)
    for screening in (0.0, 0.7):
        inverse = ltl.solvers.factorized(surface, screening)
        matrix = screening * np.eye(len(areas)) - laplacian
        if screening == 0:  # The means over components are moved to the smallest eigenvalue.
            is_same = components[:, None] == components[None]
            matrix = matrix + float(inverse.smallest) * is_same * areas / (is_same @ areas)[:, None]
        for transposed in (False, True):
            x = inverse(r, transposed)
            assert x.dtype == dtype
            product = (matrix.T if transposed else matrix) @ np.asarray(x, np.float64)
            np.testing.assert_allclose(product, r, atol=1e4 * eps)
            columns = jnp.stack([inverse(r[:, k], transposed) for k in range(2)], axis=1)
            np.testing.assert_allclose(columns, x, atol=1e3 * eps)
            batch = jax.jit(jax.vmap(lambda r, t=transposed, inverse=inverse: inverse(r, t)))(jnp.stack([r, 2 * r]))
            np.testing.assert_allclose(batch, jnp.stack([x, 2 * x]), atol=1e3 * eps)


def test_a_factor_solves_its_own_system_in_one_iteration_and_helps_with_a_similar_one(sphere, counts):
    f = jnp.sin(3 * sphere.vertices[:, 0])
    ltl.screened_poisson(sphere, f)
    ltl.screened_poisson(sphere, f, 1 + sphere.vertices[:, 0] ** 2, preconditioner=ltl.solvers.factorized(sphere, 1.0))
    ltl.poisson(sphere, sphere.vertices[:, 0])
    assert counts[0] == counts[2] == 1
    assert 1 < counts[1] < 8


def test_factors_of_one_size_share_a_program_and_are_released_with_their_surface():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2))
    f = surface.vertices[:, 0]
    ltl.screened_poisson(surface, f, 1.0)
    gc.collect()
    num_handles, num_programs = len(cache._handles), poisson_equation.stationary_diffusion._cached._cache_size()
    for screening in np.linspace(1.1, 2.0, 10):
        ltl.screened_poisson(surface, f, screening)
    assert poisson_equation.stationary_diffusion._cached._cache_size() == num_programs
    gc.collect()
    assert len(cache._handles) == num_handles + direct._CACHED - 1
    del surface, f
    gc.collect()
    assert len(cache._handles) < num_handles


def test_one_factor_serves_all_data_of_a_robin_condition():
    surface = ltl.Surface.from_mesh(ltl.shapes.disk(rings=5))
    gc.collect()
    num_handles = len(cache._handles)
    for g in (0.3, 0.7, 1.1):
        ltl.poisson(surface, jnp.zeros(surface.num_vertices), ltl.Robin(1.0, 1.0, g))
    assert len(cache._handles) == num_handles + 1
    assert isinstance(ltl.solvers.factorized(surface, 0.0, ltl.Neumann(np.array([1.0, 2.0]))), ltl.solvers.Factorized)


def test_poisson_uses_a_factor_or_multigrid_inside_jit_as_well(small_sphere, inverse_kind, monkeypatch):
    kinds = []
    solve = poisson_equation.stationary_diffusion

    def recording_solve(*args):
        kinds.append(type(args[5]))
        return solve(*args)

    monkeypatch.setattr(poisson_equation, "stationary_diffusion", recording_solve)
    f = jnp.sin(3 * small_sphere.vertices[:, 0])
    batch = jax.jit(jax.vmap(lambda f: ltl.screened_poisson(small_sphere, f, 1.0)))(jnp.stack([f, 2 * f]))
    np.testing.assert_allclose(batch[1] / 2, ltl.screened_poisson(small_sphere, f, 1.0), atol=1e-9)
    disk = ltl.Surface.from_mesh(ltl.shapes.disk(rings=5))
    jax.jit(lambda f: ltl.poisson(disk, f, ltl.Dirichlet(0.0)))(jnp.ones(disk.num_vertices))
    assert kinds == 3 * [dict(factor=ltl.solvers.Factorized, multigrid=ltl.solvers.Multigrid)[inverse_kind]]


def test_without_multigrid_poisson_falls_back_to_jacobi(small_sphere, monkeypatch):
    f = jnp.sin(3 * small_sphere.vertices[:, 0])
    exact = ltl.screened_poisson(small_sphere, f, 1.0)
    choose_inverse("multigrid", monkeypatch)
    monkeypatch.setattr(preconditioning, "is_available", lambda: False)
    np.testing.assert_allclose(ltl.screened_poisson(small_sphere, f, 1.0), exact, atol=1e-9)
    zero = jnp.zeros(())
    failed = poisson_equation.LinearState(f, zero, zero, jnp.array(False), jnp.array(20_000))
    with pytest.raises(ltl.SolveError, match=r'within 20000 iterations\. Install the extra "amg"'):
        poisson_equation.raise_unless_converged(failed, Jacobi(jnp.ones((1, 1))))


def test_a_singular_system_is_refused():
    disk = ltl.Surface.from_mesh(ltl.shapes.disk(rings=3))
    with pytest.raises(ValueError, match="found a singular matrix"):
        ltl.solvers.factorized(disk, 0.0, ltl.Robin(1.0, 0.0, 1.0))


def test_factorized_refuses_arguments_that_it_does_not_support(sphere):
    with pytest.raises(ValueError, match=r"nowhere negative, .* the least value -1"):
        ltl.solvers.factorized(sphere, -1.0)
    with pytest.raises(ValueError, match="vanish on more than constants"):
        ltl.solvers.factorized(ltl.Surface.from_mesh(ltl.shapes.icosphere(2), ltl.Paper()))
    for traced in (
        lambda x: ltl.solvers.factorized(sphere.with_vertices(x)).smallest,
        lambda x: ltl.solvers.factorized(sphere, x[:, 0]).smallest,
    ):
        with pytest.raises(ValueError, match="being traced"):
            jax.jit(traced)(sphere.vertices)


def test_a_factor_is_refused_where_many_systems_are_solved(sphere):
    inverse = ltl.solvers.factorized(sphere)
    with pytest.raises(TypeError, match=r"Multigrid|multigrid"):
        ltl.solve(ltl.Diffusion(), sphere, jnp.zeros(642), 1.0, solver=ltl.BackwardEuler(), preconditioner=inverse)
    reaction = ltl.ReactionDiffusion((1.0, 10.0), ltl.kinetics.schnakenberg(0.1, 0.9))
    with pytest.raises(ValueError, match="has many"):
        ltl.steady_state(reaction, sphere, jnp.ones((642, 2)), preconditioner=inverse)


def test_poisson_refuses_what_does_not_fit_the_surface(sphere):
    with pytest.raises(ValueError, match="positive screening, found 0"):
        ltl.screened_poisson(sphere, sphere.vertices[:, 0], 0.0)
    with pytest.raises(ValueError, match=r"number or of shape \(642,\), found \(642, 1\)"):
        ltl.screened_poisson(sphere, jnp.zeros(642), np.ones((642, 1)))
    with pytest.raises(ValueError, match=r"found \(7,\)"):
        ltl.poisson(sphere, jnp.zeros(7))
    with pytest.raises(ValueError, match="NaN or infinite at vertex 3"):
        ltl.poisson(sphere, jnp.zeros(642).at[3].set(jnp.nan))


def test_the_old_name_of_rtol_still_works(small_sphere):
    f = small_sphere.vertices[:, 0]
    with pytest.warns(DeprecationWarning, match="tolerance of screened_poisson"):
        u = ltl.screened_poisson(small_sphere, f, tolerance=1e-9)
    np.testing.assert_array_equal(u, ltl.screened_poisson(small_sphere, f, rtol=1e-9))
