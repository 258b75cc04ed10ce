"""Linear systems and what is made of them: multigrid, Poisson, stationary states, eigenmodes."""

import gc
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robust_laplacian
import scipy.sparse.linalg
from jax.test_util import check_grads
from scipy.special import jn_zeros

import ltljax as ltl
from ltljax._base import cache
from ltljax._solve import direct, stationary
from ltljax._solve.implicit import Preconditioning
from ltljax._solve.krylov import linear_solve

MESHES = {
    "icosphere": lambda n: ltl.shapes.icosphere({2500: 4, 40000: 6, 160000: 7}[n]),
    "jittered": lambda n: ltl.shapes.jittered_sphere({2500: 4, 40000: 6, 160000: 7}[n], 0.5, seed=0),
    "random": lambda n: ltl.shapes.random_sphere({2500: 2562, 40000: 40962, 160000: 163842}[n], seed=0),
    "torus": lambda n: ltl.shapes.torus(n_major=2 * round((n / 2) ** 0.5), n_minor=round((n / 2) ** 0.5)),
}


def iterations(surface, dt, tolerance):
    hierarchy = ltl.solvers.multigrid(surface)
    b = jnp.asarray(np.random.default_rng(0).normal(size=surface.num_vertices))

    @jax.jit
    def run(surface, hierarchy, b):
        one = jnp.ones(1, b.dtype)
        inverse = Preconditioning(hierarchy).of(surface, one, dt * one)
        found = linear_solve(lambda u: u - dt * ltl.laplacian(surface, u), b, inverse, tolerance)
        rest = found.value - dt * ltl.laplacian(surface, found.value) - b
        return found.stats["num_steps"], jnp.linalg.norm(rest) / jnp.linalg.norm(b)

    steps, residual = run(surface, hierarchy, b)
    assert residual < 2 * tolerance
    return int(steps)


@pytest.mark.parametrize("kind", MESHES)
def test_iterations_do_not_grow_with_the_mesh(kind):
    surface = ltl.Surface.from_mesh(MESHES[kind](2500))
    assert iterations(surface, 1.0, 1e-8) < 12
    assert iterations(surface, 1e-2, 1e-8) < 10


@pytest.mark.slow
@pytest.mark.parametrize("size", [40000, 160000])
@pytest.mark.parametrize("kind", MESHES)
def test_iterations_do_not_grow_with_the_mesh_up_to_160_000_vertices(kind, size):
    surface = ltl.Surface.from_mesh(MESHES[kind](size))
    assert iterations(surface, 1.0, 1e-8) < 15


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(3, 0.3, seed=0))


def test_the_cycle_for_the_transpose_is_the_transposed_cycle(sphere):
    hierarchy = ltl.solvers.multigrid(sphere)
    random = np.random.default_rng(0)
    r, s = (jnp.asarray(random.normal(size=(sphere.num_vertices, 2))) for _ in range(2))
    alpha, beta = jnp.array([1.0, 0.3]), jnp.array([0.1, 2.0])
    forth = jnp.sum(s * hierarchy(alpha, beta, r))
    back = jnp.sum(r * hierarchy(alpha, beta, s, transposed=True))
    np.testing.assert_allclose(forth, back, rtol=1e-10)


@pytest.fixture(params=["factor", "multigrid"])
def way(request, monkeypatch):
    """How `poisson` solves its systems."""
    if request.param == "multigrid":
        monkeypatch.setattr(stationary, "_FACTORISED", dict.fromkeys(stationary._FACTORISED, 0))
    return request.param


def test_poisson_is_of_second_order_and_leaves_no_residual():
    errors = []
    for level in (3, 4):
        surface = ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(level, 0.3, seed=0))
        exact = surface.vertices.prod(axis=1)
        exact = exact - ltl.integrate(surface, exact) / jnp.sum(surface.vertex_areas)
        f = -12 * surface.vertices.prod(axis=1)
        found = ltl.poisson(surface, f)
        f = f - ltl.integrate(surface, f, surface.mass) / jnp.sum(surface.mass)
        assert jnp.linalg.norm(ltl.laplacian(surface, found) - f) < 1e-9 * jnp.linalg.norm(f)
        assert abs(ltl.integrate(surface, found)) < 1e-10
        errors.append(jnp.linalg.norm(found - exact) / jnp.linalg.norm(exact))
    assert np.log2(errors[0] / errors[1]) > 1.7
    assert errors[1] < 5e-3


@pytest.mark.parametrize("kind", MESHES)
def test_poisson_leaves_no_residual_on_any_mesh(kind, way):
    surface = ltl.Surface.from_mesh(MESHES[kind](2500))
    f = jnp.sin(3 * surface.vertices[:, 0]) + surface.vertices[:, 2]
    f = f - ltl.integrate(surface, f, surface.mass) / jnp.sum(surface.mass)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = ltl.poisson(surface, f)
    assert jnp.linalg.norm(ltl.laplacian(surface, found) - f) < 1e-10 * jnp.linalg.norm(f)


def test_high_order_is_solved_with_the_multigrid_of_monotone_and_by_a_factor():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(4), ltl.Polynomial(degree=4))
    u = surface.vertices.prod(axis=1)
    for inverse in (ltl.solvers.multigrid(surface), ltl.solvers.factorized(surface, 1.0)):
        found = ltl.screened_poisson(surface, -13 * u, preconditioner=inverse)
        assert jnp.linalg.norm(found - u) < 5e-5 * jnp.linalg.norm(u)


@pytest.mark.parametrize(("kind", "better"), [("jittered", 40), ("random", 8)])
def test_high_order_on_irregular_meshes_takes_few_iterations_and_is_far_ahead(kind, better):
    mesh = MESHES[kind](2500)
    surface = ltl.Surface.from_mesh(mesh, ltl.Polynomial(degree=4))
    u = surface.vertices.prod(axis=1)
    found = ltl.screened_poisson(surface, -13 * u, preconditioner=ltl.solvers.multigrid(surface))
    error = float(jnp.linalg.norm(found - u) / jnp.linalg.norm(u))
    # Of linear finite elements on intrinsic Delaunay triangles.
    stiffness, masses = robust_laplacian.mesh_laplacian(mesh.vertices, mesh.faces)
    exact = np.asarray(u)
    peer = scipy.sparse.linalg.spsolve((stiffness + masses).tocsc(), 13 * (masses @ exact))
    assert error * better < np.linalg.norm(peer - exact) / np.linalg.norm(exact)
    if kind == "jittered":  # on random points BiCGStab fails, and GMRES takes some hundred directions
        assert iterations(surface, 1.0, 1e-10) < 35


def test_a_right_side_with_a_mean_is_said(sphere):
    x1 = sphere.vertices[:, 0]
    with pytest.warns(ltl.errors.IncompatibleSourceWarning, match=r"mean of 0\.5"):
        shifted = ltl.poisson(sphere, x1 + 0.5)
    np.testing.assert_allclose(shifted, ltl.poisson(sphere, x1), atol=1e-8)


def test_every_component_has_its_own_mean(way):
    one = ltl.shapes.icosphere(2)
    surface = ltl.Surface.from_mesh(two_spheres(2))
    x1 = jnp.asarray(np.tile(one.vertices[:, 0], 2) * np.repeat([1.0, 3.0], one.num_vertices))
    found = ltl.poisson(surface, x1).reshape(2, -1)
    alone = ltl.poisson(ltl.Surface.from_mesh(one), jnp.asarray(one.vertices[:, 0]))
    np.testing.assert_allclose(found, np.stack([alone, 3 * alone]), atol=1e-8)


def two_spheres(subdivisions):
    one = ltl.shapes.icosphere(subdivisions)
    return ltl.Mesh(
        np.concatenate([one.vertices, one.vertices + 5]), np.concatenate([one.faces, one.faces + one.num_vertices])
    )


def test_a_small_mean_is_said_in_its_column_and_component():
    surface = ltl.Surface.from_mesh(two_spheres(4))
    x1 = surface.vertices[:, 0] - jnp.where(surface.topology.components == 1, 5.0, 0)
    f = jnp.stack([100 * x1, x1], axis=1)
    wrong = f.at[:, 1].add(jnp.where(surface.topology.components == 1, 0.01, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        right = ltl.poisson(surface, f)
    with pytest.warns(ltl.errors.IncompatibleSourceWarning, match=r"mean of 0\.01 over component 1 in column 1"):
        found = ltl.poisson(surface, wrong)
    np.testing.assert_allclose(found, right, atol=1e-6)


@pytest.mark.parametrize("kind", ["jittered", "random", "torus"])
def test_what_discretisation_leaves_of_no_mean_is_not_said(kind):
    surface = ltl.Surface.from_mesh(MESHES[kind](2500))
    x, y, z = surface.vertices.T
    for f in (x, z * x, jnp.sin(5 * z), x * y * z):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            ltl.poisson(surface, f)
        with pytest.warns(ltl.errors.IncompatibleSourceWarning):
            ltl.poisson(surface, f + 0.01 * jnp.sqrt(jnp.mean(f**2)))


@pytest.mark.parametrize(
    "condition", [ltl.Dirichlet(1.0), ltl.Robin(1.0, 1.0, 3.0), (ltl.Neumann(2.0), ltl.Dirichlet(1.0, where=0))]
)
def test_poisson_on_a_disk_keeps_its_conditions(condition, way):
    surface = ltl.Surface.from_mesh(ltl.shapes.disk())
    squared = jnp.sum(surface.vertices**2, axis=1)
    np.testing.assert_allclose(ltl.poisson(surface, 0 * squared + 4, condition), squared, atol=1e-8)


def test_poisson_is_differentiated_in_both_modes(sphere, way):
    x = sphere.vertices
    f = jnp.cos(2 * x[:, 0])
    f = f - ltl.integrate(sphere, f, sphere.mass) / jnp.sum(sphere.mass)
    check_grads(lambda f: jnp.sin(ltl.poisson(sphere, f)), (f,), order=1, modes=("fwd", "rev"), rtol=1e-5, atol=1e-5)
    inverse = ltl.solvers.multigrid(sphere) if way == "multigrid" else ltl.solvers.factorized(sphere, 1.0)

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
    matrix = ltl.laplacian_matrix(surface).todense()
    areas = np.asarray(surface.vertex_areas)
    components = np.asarray(surface.topology.components)
    r = jnp.asarray(np.random.default_rng(0).normal(size=(surface.num_vertices, 2)), dtype)
    eps = float(jnp.finfo(dtype).eps)
    for screening in (0.0, 0.7):
        inverse = ltl.solvers.factorized(surface, screening)
        whole = screening * np.eye(len(areas)) - matrix
        if screening == 0:  # the means over components are moved to the smallest eigenvalue
            same = components[:, None] == components[None]
            whole = whole + float(inverse.smallest) * same * areas / (same @ areas)[:, None]
        for transposed in (False, True):
            found = inverse(r, transposed)
            assert found.dtype == dtype
            again = (whole.T if transposed else whole) @ np.asarray(found, np.float64)
            np.testing.assert_allclose(again, r, atol=1e4 * eps)
            one_by_one = jnp.stack([inverse(r[:, k], transposed) for k in range(2)], axis=1)
            np.testing.assert_allclose(one_by_one, found, atol=1e3 * eps)
            batch = jax.jit(jax.vmap(lambda r, t=transposed, inverse=inverse: inverse(r, t)))(jnp.stack([r, 2 * r]))
            np.testing.assert_allclose(batch, jnp.stack([found, 2 * found]), atol=1e3 * eps)


def test_a_factor_ends_the_iteration_at_once_and_one_that_is_off_still_helps(sphere, monkeypatch):
    counts = []
    solved = stationary._stationary

    def counting(*args):
        out = solved(*args)
        counts.append(int(out[-1]))
        return out

    monkeypatch.setattr(stationary, "_stationary", counting)
    f = jnp.sin(3 * sphere.vertices[:, 0])
    ltl.screened_poisson(sphere, f)
    ltl.screened_poisson(sphere, f, 1 + sphere.vertices[:, 0] ** 2, preconditioner=ltl.solvers.factorized(sphere, 1.0))
    ltl.poisson(sphere, sphere.vertices[:, 0])
    assert counts[0] == counts[2] == 1
    assert 1 < counts[1] < 8


def test_factors_of_one_size_share_a_program_and_go_with_their_surface():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2))
    f = surface.vertices[:, 0]
    ltl.screened_poisson(surface, f, 1.0)
    gc.collect()
    before, programs = len(cache._handles), stationary._stationary._cached._cache_size()
    for screening in np.linspace(1.1, 2.0, 10):
        ltl.screened_poisson(surface, f, screening)
    assert stationary._stationary._cached._cache_size() == programs
    gc.collect()
    assert len(cache._handles) == before + direct._KEPT - 1  # the last few
    del surface, f
    gc.collect()
    assert len(cache._handles) < before


def test_the_factor_of_a_robin_condition_serves_all_its_data():
    surface = ltl.Surface.from_mesh(ltl.shapes.disk(rings=5))
    gc.collect()
    before = len(cache._handles)
    for g in (0.3, 0.7, 1.1):
        ltl.poisson(surface, jnp.zeros(surface.num_vertices), ltl.Robin(1.0, 1.0, g))
    assert len(cache._handles) == before + 1
    assert isinstance(ltl.solvers.factorized(surface, 0.0, ltl.Neumann(np.array([1.0, 2.0]))), ltl.solvers.Factorized)


def test_a_factor_or_multigrid_is_taken_inside_jit_too(way, monkeypatch):
    surface = ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(2, 0.3, seed=0))
    given = []
    solved = stationary._stationary
    monkeypatch.setattr(stationary, "_stationary", lambda *args: given.append(type(args[5])) or solved(*args))
    f = jnp.sin(3 * surface.vertices[:, 0])
    inside = jax.jit(jax.vmap(lambda f: ltl.screened_poisson(surface, f, 1.0)))(jnp.stack([f, 2 * f]))
    np.testing.assert_allclose(inside[1] / 2, ltl.screened_poisson(surface, f, 1.0), atol=1e-9)
    disk = ltl.Surface.from_mesh(ltl.shapes.disk(rings=5))
    jax.jit(lambda f: ltl.poisson(disk, f, ltl.Dirichlet(0.0)))(jnp.ones(disk.num_vertices))
    assert given == 3 * [dict(factor=ltl.solvers.Factorized, multigrid=ltl.solvers.Multigrid)[way]]


def test_a_singular_system_is_said():
    disk = ltl.Surface.from_mesh(ltl.shapes.disk(rings=3))
    with pytest.raises(ValueError, match="found a singular matrix"):
        ltl.solvers.factorized(disk, 0.0, ltl.Robin(1.0, 0.0, 1.0))


def test_a_factor_says_what_it_cannot_do(sphere):
    with pytest.raises(ValueError, match=r"nowhere negative, .* the least value -1"):
        ltl.solvers.factorized(sphere, -1.0)
    with pytest.raises(ValueError, match=r"number or of shape \(642,\), found \(642, 1\)"):
        ltl.screened_poisson(sphere, jnp.zeros(642), np.ones((642, 1)))
    with pytest.raises(ValueError, match="vanish on more than constants"):
        ltl.solvers.factorized(ltl.Surface.from_mesh(ltl.shapes.icosphere(2), ltl.Paper()))
    for traced in (
        lambda x: ltl.solvers.factorized(sphere.with_vertices(x)).smallest,
        lambda x: ltl.solvers.factorized(sphere, x[:, 0]).smallest,
    ):
        with pytest.raises(ValueError, match="being traced"):
            jax.jit(traced)(sphere.vertices)
    inverse = ltl.solvers.factorized(sphere)
    with pytest.raises(TypeError, match=r"Multigrid|multigrid"):
        ltl.solve(ltl.Diffusion(), sphere, jnp.zeros(642), 1.0, solver=ltl.BackwardEuler(), preconditioner=inverse)
    reaction = ltl.ReactionDiffusion((1.0, 10.0), ltl.kinetics.schnakenberg(0.1, 0.9))
    with pytest.raises(ValueError, match="has many"):
        ltl.steady_state(reaction, sphere, jnp.ones((642, 2)), preconditioner=inverse)


def test_heat_with_a_source_reaches_its_stationary_state_both_ways():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(4))
    x1 = surface.vertices[:, 0]
    equation = ltl.Diffusion(source=x1)
    marched = ltl.solve(equation, surface, 0 * x1, 15.0, rtol=1e-8, atol=1e-10).us[-1]
    solved = ltl.steady_state(equation, surface, 0 * x1)
    np.testing.assert_allclose(solved, x1 / 2, atol=1e-4)
    np.testing.assert_allclose(marched, solved, atol=1e-6)
    close = ltl.steady_state(equation, surface, 0 * x1, method="marching", t1=20.0)
    np.testing.assert_allclose(close, solved, atol=1e-8)
    with pytest.raises(ValueError, match="positive t1"):
        ltl.steady_state(equation, surface, 0 * x1, method="marching", t1=-1.0)
    # The mass of where it starts is kept.
    np.testing.assert_allclose(ltl.steady_state(equation, surface, 0 * x1 + 3), solved + 3, atol=1e-8)


def poloidal(mesh):
    x, y, z = mesh.vertices.T
    return np.arctan2(z, np.hypot(x, y) - 2)


def test_the_torus_with_source_sin_x_has_its_closed_form():
    errors = []
    for n in (24, 48):
        mesh = ltl.shapes.torus(2.0, 1.0, 2 * n, n)
        surface, x = ltl.Surface.from_mesh(mesh), poloidal(mesh)
        exact = np.sin(x) / 2 + (x - 2 * np.arctan(np.sqrt(1 / 3) * np.tan(x / 2)))
        assert abs(np.abs(exact).max() - 1.0330186828) < 0.01
        found = ltl.steady_state(ltl.Diffusion(source=jnp.sin(jnp.asarray(x))), surface, jnp.zeros(mesh.num_vertices))
        errors.append(float(jnp.linalg.norm(found - exact) / np.linalg.norm(exact)))
    assert np.log2(errors[0] / errors[1]) > 1.8
    assert errors[1] < 2e-3


def test_the_torus_with_the_published_source_has_its_profile_and_without_its_mean_taken_off_none():
    mesh = ltl.shapes.torus(2.0, 1.0, 128, 64)
    surface = ltl.Surface.from_mesh(mesh)
    angle = jnp.asarray(np.mod(poloidal(mesh), 2 * np.pi))
    # At the jump the mean of both sides, as the integral has it.
    angle = jnp.where(angle == 0, jnp.pi, angle)
    found = ltl.steady_state(ltl.Diffusion(source=angle - jnp.pi), surface, jnp.zeros(mesh.num_vertices))
    assert abs(found.max() - 2.1257) < 5e-3
    assert abs(found.min() + 2.1257) < 5e-3
    quarter = found[jnp.argmin(jnp.abs(angle - jnp.pi / 2))]
    assert abs(quarter + 2.119092) < 5e-3
    with pytest.raises(ltl.SolveError, match="no stationary state"):
        ltl.steady_state(ltl.Diffusion(source=angle), surface, jnp.zeros(mesh.num_vertices))


def test_a_pattern_is_found_as_a_stationary_state_and_differentiated():
    surface = ltl.Surface.from_mesh(ltl.shapes.torus(n_major=24, n_minor=12))

    def schnakenberg(species, p):
        u, v = species
        return p * (0.1 - u + u**2 * v), p * (0.9 - u**2 * v)

    random = np.random.default_rng(0)
    start = jnp.asarray(np.array([1.0, 0.9]) + 0.1 * random.normal(size=(surface.num_vertices, 2)) * np.array([1, 0]))

    def equation(rate):
        return ltl.ReactionDiffusion((1.0, 40.0), schnakenberg, params=rate)

    rate = jnp.array(4.0)
    found = ltl.steady_state(equation(rate), surface, start)
    assert jnp.ptp(found[:, 0]) > 0.5
    residual = equation(rate).rate(jnp.zeros(()), surface, found)
    assert jnp.sqrt(jnp.mean(residual**2)) < 1e-8

    def mean_square(rate):
        return jnp.mean(ltl.steady_state(equation(rate), surface, found, throw=False)[:, 0] ** 2)

    step = 1e-4
    slope = (mean_square(rate + step) - mean_square(rate - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(mean_square)(rate), slope, rtol=1e-4)


def test_eigenvalues_of_the_sphere_and_of_the_disk():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(4))
    modes = ltl.eigenmodes(surface, 9)
    values, vectors = modes
    np.testing.assert_allclose(values, [0, 2, 2, 2, 6, 6, 6, 6, 6], rtol=5e-3, atol=1e-8)
    assert modes.residuals.max() < 1e-3
    np.testing.assert_allclose(ltl.integrate(surface, vectors**2), 1, rtol=1e-8)
    np.testing.assert_allclose(modes.left.T @ vectors, np.eye(9), atol=1e-8)
    disk = ltl.Surface.from_mesh(ltl.shapes.disk())
    held = ltl.eigenmodes(disk, 3, ltl.Dirichlet()).values
    expected = [jn_zeros(0, 1)[0] ** 2, jn_zeros(1, 1)[0] ** 2, jn_zeros(1, 1)[0] ** 2]
    np.testing.assert_allclose(held, expected, rtol=1e-2)


def test_the_derivative_of_an_eigenvalue_in_the_shape_agrees_with_differences():
    mesh = ltl.shapes.ellipsoid((1.0, 1.3, 1.7), subdivisions=3)
    surface = ltl.Surface.from_mesh(mesh)
    x = surface.vertices

    def moved(stretch):
        return surface.with_vertices(x * (1 + stretch * x[:, :1] ** 2))

    modes = ltl.eigenmodes(surface, 4)
    slopes = jax.jacfwd(lambda s: modes.values_on(moved(s)))(0.0)
    step = 1e-4
    up, down = (ltl.eigenmodes(moved(sign * step), 4).values for sign in (1, -1))
    np.testing.assert_allclose(slopes[1:], (up - down)[1:] / (2 * step), rtol=1e-4)


def test_modes_of_large_multiplets_are_real_and_biorthonormal():
    # The mesh splits multiplets into pairs, real and complex, whose real parts agree to rounding.
    modes = ltl.eigenmodes(ltl.Surface.from_mesh(ltl.shapes.icosphere(4)), 81)
    degrees = np.repeat(np.arange(9), 2 * np.arange(9) + 1)
    np.testing.assert_allclose(modes.values, degrees * (degrees + 1), rtol=0.03, atol=1e-9)
    np.testing.assert_allclose(modes.left.T @ modes.vectors, np.eye(81), atol=1e-12)


@pytest.mark.parametrize("k", [7, 20, 384])
def test_no_member_of_a_multiplet_is_missed_where_the_mesh_has_its_symmetry(k):
    # Eigenvalues of a cube are threefold to rounding, of which an iteration from one start sees one.
    surface = ltl.Surface.from_mesh(ltl.shapes.box(n=8))
    exact = np.sort(np.linalg.eigvals(-ltl.laplacian_matrix(surface).toarray()).real)
    np.testing.assert_allclose(ltl.eigenmodes(surface, k).values, exact[:k], rtol=1e-8, atol=1e-9)


def test_what_is_not_solvable_is_said(sphere):
    with pytest.raises(ValueError, match="positive screening, found 0"):
        ltl.screened_poisson(sphere, sphere.vertices[:, 0], 0.0)
    with pytest.raises(ValueError, match=r"found \(7,\)"):
        ltl.poisson(sphere, jnp.zeros(7))
    with pytest.raises(ValueError, match="number of modes"):
        ltl.eigenmodes(sphere, 10**6)


def test_poisson_counts_fluxes_in_what_is_solvable():
    surface = ltl.Surface.from_mesh(ltl.shapes.disk())
    x1 = surface.vertices[:, 0]
    # Of x^2 + y^2 the Laplacian has a mean, and the flux of 2 through the rim takes it away.
    squared = jnp.sum(surface.vertices**2, axis=1)
    found = ltl.poisson(surface, 0 * x1 + 4, ltl.Neumann(2.0))
    np.testing.assert_allclose(found - found[0], squared - squared[0], atol=1e-2)
    with pytest.warns(ltl.errors.IncompatibleSourceWarning, match="fluxes included"):
        ltl.poisson(surface, 0 * x1 + 4, ltl.Neumann(1.0))
    with pytest.raises(ltl.SolveError, match="source and fluxes have a mean"):
        ltl.steady_state(ltl.Diffusion(boundary=ltl.Neumann(1.0)), surface, x1)


def linear_decay(species, p):
    return (-p * species[0],)


@pytest.mark.parametrize("reacts", [False, True], ids=["Diffusion", "ReactionDiffusion"])
def test_a_stationary_state_has_the_boundary_data_of_its_time(reacts):
    surface = ltl.Surface.from_mesh(ltl.shapes.disk(rings=8))
    x = surface.vertices

    def equation(height):
        rim = ltl.Dirichlet(lambda t, x: height * (1 + t) * jnp.exp(x[:, 0]))
        if reacts:
            return ltl.ReactionDiffusion((1.0,), linear_decay, params=jnp.array(2.0), boundary=rim)
        return ltl.Diffusion(boundary=rim)

    u0 = jnp.zeros((len(x), 1)) if reacts else jnp.zeros(len(x))

    def total(height):
        return jnp.sum(ltl.steady_state(equation(height), surface, u0, t=2.0, throw=False))

    at_2, at_0 = (ltl.steady_state(equation(1.0), surface, u0, t=t) for t in (2.0, 0.0))
    np.testing.assert_allclose(at_2, 3 * at_0, rtol=1e-6)
    # Both equations are linear in what the rim is held at.
    np.testing.assert_allclose(jax.jvp(total, (1.0,), (1.0,))[1], jnp.sum(at_2), rtol=1e-6)
    np.testing.assert_allclose(jax.grad(total)(1.0), jnp.sum(at_2), rtol=1e-6)


@pytest.mark.slow
def test_marching_to_a_stationary_state_has_derivatives_in_both_modes(sphere):
    def logistic(species, p):
        return (p * species[0] - species[0] ** 2,)

    def mean(p):
        equation = ltl.ReactionDiffusion((1.0,), logistic, params=p)
        start = jnp.full((sphere.num_vertices, 1), 0.3)
        return jnp.mean(ltl.steady_state(equation, sphere, start, method="marching", t1=100.0, throw=False) ** 2)

    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(derivative(mean)(1.5), 2 * 1.5, rtol=1e-5)


def test_a_state_that_grows_for_ever_is_not_called_stationary(sphere):
    growing = ltl.ReactionDiffusion((1.0,), linear_decay, params=jnp.array(-1.0))
    with pytest.raises(ltl.SolveError, match="grows for ever"):
        ltl.steady_state(growing, sphere, jnp.ones((sphere.num_vertices, 1)))
