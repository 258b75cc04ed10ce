"""On meshes whose rows are not symmetric, steps of any solver and length are stable or refused."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import ltljax as ltl
from ltljax._solve.checks import longest_step
from ltljax._solve.stabilised import is_sensible

RANGE = 1.02


@pytest.fixture(scope="module")
def random_spheres():
    return [ltl.Surface.from_mesh(ltl.shapes.random_sphere(300, seed=seed)) for seed in range(4)]


def noise(surface, seed):
    return jnp.asarray(np.random.default_rng(seed).normal(size=surface.num_vertices))


def growth(surface, u0, dt, solver, steps=20):
    """The largest value of a run of heat over that of its start; None if the solver refuses steps of this length."""
    times = np.arange(1, steps + 1) * dt
    try:
        solution = ltl.solve(ltl.Diffusion(), surface, u0, times[-1], ts=times, solver=solver, dt=dt)
    except ValueError as error:
        return None if "is too long for" in str(error) else np.inf
    return float(jnp.max(jnp.abs(solution.us)) / jnp.max(jnp.abs(u0)))


def assert_keeps_range(surface, seed, dt, solver):
    ratio = growth(surface, noise(surface, seed), dt, solver)
    assert ratio is not None
    assert ratio <= RANGE


@pytest.mark.parametrize(
    "make", [ltl.shapes.random_sphere, lambda n, seed: ltl.shapes.jittered_torus(24, 12, 0.4, seed)]
)
def test_the_spectral_width_is_that_of_the_eigenvalues(make):
    surface = ltl.Surface.from_mesh(make(300, seed=3))
    values = scipy.linalg.eigvals(ltl.laplacian_matrix(surface).todense())
    values = values[np.abs(values) > 1e-6]
    exact = np.max(values.imag**2 / -values.real)
    assert exact <= float(ltl.operators.spectral_width(surface)) <= 5 * exact


def test_the_width_of_a_traced_surface_is_an_upper_bound(random_spheres):
    for surface in random_spheres[:3]:
        assert float(jax.jit(ltl.operators.spectral_width)(surface)) >= float(ltl.operators.spectral_width(surface))


@pytest.mark.parametrize("solver", [ltl.RKL2, ltl.RKL1])
@pytest.mark.parametrize(("bound", "width"), [(5, 0), (100, 0), (100, 1), (100, 5), (1000, 10), (3000, 9), (30, 4)])
def test_no_stage_polynomial_grows_inside_its_parabola(solver, bound, width):
    plan = solver().plan(jnp.array([bound, width], float), 1.0)
    assert bool(plan.is_stable)
    x = np.linspace(0, bound, 2000)[1:]
    z = (-x + 1j * np.sqrt(width * x) * np.linspace(0, 1, 9)[:, None]).ravel()
    before, last = np.zeros_like(z), float(plan.mu_rate[1]) * z
    for j in range(2, int(plan.stages) + 1):
        mu, nu, mu_rate, gamma_rate = map(float, plan.coefficients(jnp.array(j)))
        before, last = last, mu * last + nu * before + mu_rate * z * (1 + last) + gamma_rate * z
    assert np.abs(1 + last).max() <= 1 + 1e-9
    assert float(plan.c[int(plan.stages)]) == pytest.approx(1)


@pytest.mark.parametrize(("dt", "count"), [(1e-3, 4), (1e-2, 4), (1e-1, 2), (1.0, 1)])
def test_fixed_steps_of_any_length_keep_the_range_of_heat_on_random_points(random_spheres, dt, count):
    for seed, surface in enumerate(random_spheres[:count]):
        for solver in (ltl.RKL2(), ltl.RKL1()):
            assert_keeps_range(surface, seed, dt, solver)


IMPLICIT = [ltl.CrankNicolson(), ltl.BackwardEuler(), ltl.TRBDF2(), ltl.SBDF2(), diffrax.KenCarp3(), diffrax.Kvaerno3()]


@pytest.mark.parametrize("solver", IMPLICIT, ids=lambda solver: type(solver).__name__)
def test_implicit_steps_keep_the_range_of_heat_on_random_points(random_spheres, solver):
    for dt in (1e-2, 1.0):
        assert_keeps_range(random_spheres[0], 0, dt, solver)


def test_explicit_steps_are_stable_up_to_the_length_in_the_error(random_spheres):
    surface = random_spheres[1]
    values = scipy.linalg.eigvals(ltl.laplacian_matrix(surface).todense())
    length = longest_step(diffrax.Heun(), np.abs(values).max(), float(ltl.operators.spectral_width(surface)))
    for dt, is_stable in ((0.95 * length, True), (1.1 * length, False)):
        ratio = growth(surface, noise(surface, 1), dt, diffrax.Heun(), steps=50)
        assert (ratio is not None) == is_stable
        assert ratio is None or ratio <= RANGE


def test_adaptive_steps_are_rarely_rejected_on_random_points(random_spheres):
    x = random_spheres[0].vertices[:, 0]
    counts = ltl.solve(ltl.Diffusion(), random_spheres[0], x + x**3, 1.0, solver=ltl.RKL2()).counts
    assert counts["num_rejected_steps"] <= 0.05 * counts["num_steps"]


def test_damping_costs_less_than_twice_the_stages(random_spheres):
    surface = random_spheres[0]
    bound, width = float(ltl.operators.spectral_bound(surface)), float(ltl.operators.spectral_width(surface))
    for dt in (1e-3, 5e-3, 2e-2):
        damped, plain = (ltl.RKL2().plan(jnp.array([bound, chi]), dt).stages for chi in (width, 0.0))
        assert plain <= damped <= 2 * plain


def test_an_unstable_step_ends_the_run_with_an_error():
    # The solver is told that all eigenvalues are real, as if the rows of the mesh were symmetric.
    surface = ltl.Surface.from_mesh(ltl.shapes.random_sphere(3000, seed=3))
    blind = ltl.RKL2(spectral_width=lambda t, u, args: jnp.zeros(()))
    run = functools.partial(ltl.solve, ltl.Diffusion(), surface, noise(surface, 3), 2.0, solver=blind, dt=0.02)
    with pytest.raises(ltl.SolveError, match="overflowed"):
        run()
    assert bool(run(throw=False).overflowed)


def test_steps_of_rough_data_and_of_sources_that_set_in_are_credible():
    ones = jnp.ones((5, 1))
    assert bool(is_sensible(jnp.array(1.0), ones, -0.5 * ones, -1e6 * ones, -1e5 * ones))
    assert bool(is_sensible(jnp.array(1.0), 0 * ones, 0 * ones, 0 * ones, 1e6 * ones))
    assert not bool(is_sensible(jnp.array(1.0), ones, ones, ones, 1e3 * ones))


@pytest.mark.slow
@pytest.mark.parametrize("dt", [1e-3, 1e-2, 3e-2, 1e-1, 1.0])
def test_a_hundred_random_spheres_keep_the_range_of_heat(dt):
    for seed in range(100):
        surface = ltl.Surface.from_mesh(ltl.shapes.random_sphere(3000, seed=seed))
        for solver in (ltl.RKL2(), ltl.RKL1()):
            assert_keeps_range(surface, seed, dt, solver)


@pytest.mark.parametrize("solver", [ltl.RKL1(), ltl.RKL2()], ids=["RKL1", "RKL2"])
@pytest.mark.parametrize("diffusion", [0.0, 0.01, 1.0])
def test_drift_with_a_flow_stays_in_the_range_of_its_initial_state(solver, diffusion):
    surface = ltl.Surface.from_mesh(ltl.shapes.torus(n_major=20, n_minor=10))
    x, y, z = surface.vertices.T
    stencil = ltl.operators.elliptic_stencil(surface, diffusion, jnp.stack([-y, x, 0 * z], axis=1))
    assert _largest_ratio(stencil) <= float(stencil.spectral_width())
    u0 = noise(surface, 0)
    # The same number of steps, so that the second run needs no compilation.
    for steps, dt in ((100, 20 / float(stencil.spectral_bound())), (100, 200 / float(stencil.spectral_bound()))):
        end = ltl.solve(ltl.Diffusion(stencil), surface, u0, steps * dt, dt=dt, solver=solver).u_end
        assert float(jnp.max(jnp.abs(end))) <= RANGE * float(jnp.max(jnp.abs(u0)))


def test_the_width_of_a_stencil_is_an_upper_bound_where_diffusion_turns_and_varies():
    for mesh in (ltl.shapes.torus(n_major=20, n_minor=10), ltl.shapes.random_sphere(300, seed=1)):
        surface = ltl.Surface.from_mesh(mesh)
        x, y, z = surface.vertices.T
        turning = ltl.operators.direction_tensor(surface, jnp.stack([-y, x, 0 * z], axis=1), 1.0, 0.01)
        for tensor in (turning, 0.1 + jnp.exp(-10 * (x - 0.5) ** 2), jnp.where(x > 0, 1.0, 1e-3)):
            stencil = ltl.operators.elliptic_stencil(surface, tensor)
            assert _largest_ratio(stencil) <= float(stencil.spectral_width())
            assert _largest_ratio(stencil) <= float(stencil.with_coefficients(surface, tensor).spectral_width())


@pytest.mark.parametrize("seed", [1, 2, 3, 5])
def test_the_width_of_a_stencil_is_an_upper_bound_where_few_rows_are_active(seed):
    surface = ltl.Surface.from_mesh(ltl.shapes.random_sphere(400, seed=seed))
    x, y, z = surface.vertices.T
    around = ltl.operators.direction_tensor(surface, jnp.stack([-y, x, 0 * z], axis=1), 1.0, 1e-3)
    strength = jnp.exp(-30 * ((x - 1) ** 2 + y**2 + z**2))[:, None, None]
    tensor = around * strength + 1e-5 * jnp.eye(3)[None]
    stencil = ltl.operators.elliptic_stencil(surface, tensor, divergence_form=True)
    ratio = _largest_ratio(stencil)
    assert ratio <= float(stencil.spectral_width())
    assert ratio <= float(stencil.with_coefficients(surface, tensor, divergence_form=True).spectral_width())


def test_the_width_of_a_stencil_scales_with_its_units_in_float32():
    surface = ltl.Surface.from_mesh(ltl.shapes.torus(n_major=24, n_minor=12), dtype=jnp.float32)
    x, y, z = surface.vertices.T
    flow = jnp.stack([-y, x, 0 * z], axis=1)
    stencil = ltl.operators.elliptic_stencil(surface, 0.01, flow)
    widths = [
        float(stencil.with_coefficients(surface, 0.01 * unit, flow * unit).spectral_width()) / unit
        for unit in (1.0, 1e-20, 1e20)
    ]
    np.testing.assert_allclose(widths, widths[0], rtol=1e-4)


def _largest_ratio(stencil):
    values = scipy.linalg.eigvals(stencil.matrix().todense())
    values = values[values.real < -1e-9 * np.abs(values).max()]
    return np.max(values.imag**2 / -values.real)


@pytest.mark.parametrize("scheme", [ltl.Polynomial(3), ltl.Paper()], ids=["Polynomial", "Paper"])
@pytest.mark.parametrize("start", [0.0, 1e-12])
def test_a_source_that_sets_in_is_not_an_overflow(scheme, start):
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2), scheme=scheme)
    equation = ltl.Diffusion(1.0, source=lambda t, x: t * x[:, 2])
    end = ltl.solve(equation, surface, jnp.full(surface.num_vertices, start), 0.1, rtol=1e-6).u_end
    # The solution of u' = -2 u + t with u(0) = 0 is t / 2 - (1 - exp(-2 t)) / 4.
    assert float(jnp.max(end)) == pytest.approx(0.05 - (1 - np.exp(-0.2)) / 4, rel=0.02)


def test_steps_are_stable_where_species_oscillate_by_way_of_diffusion():
    # The second species inhibits the first at every other vertex; the first promotes the second at the others.
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2))
    side = (jnp.arange(surface.num_vertices) % 2).astype(float)

    def rates(species, side):
        u, v = species
        return -50 * side * v - 7 * u, 50 * (1 - side) * u - 7 * v

    equation = ltl.ReactionDiffusion([1.0, 1.0], rates, side)
    u0, now = jnp.ones((surface.num_vertices, 2)), jnp.zeros(())
    jacobian = jax.jacobian(lambda u: equation.rate(now, surface, u))(u0).reshape(u0.size, u0.size)
    values = np.linalg.eigvals(jacobian)
    assert values.real.max() < 0
    assert np.abs(values.imag).max() <= float(equation.spectral_width(now, surface, u0))
    # The slowest decay rate is a thirtieth of the frequency, which is about one over the length of these steps.
    end = ltl.solve(equation, surface, u0, 2.0, dt=0.05, solver=ltl.RKL2()).u_end
    exact = scipy.linalg.expm(2.0 * np.asarray(jacobian)) @ np.asarray(u0).ravel()
    assert float(jnp.max(jnp.abs(end))) < 1.5 * np.abs(exact).max()


@pytest.mark.parametrize("count", [2, 3])
def test_the_bound_of_reactions_that_differ_from_vertex_to_vertex_holds(count):
    # At some vertices the first species drives the second, at the others the reverse; diffusion couples the two.
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1))
    side = jnp.arange(surface.num_vertices) % 2
    strength = 50.0

    def rates(species, side):
        first, second, *rest = species
        return (strength * side * second, strength * (1 - side) * first, *(0 * u for u in rest))

    equation = ltl.ReactionDiffusion([1.0] * count, rates, side.astype(float))
    u, now = jnp.ones((surface.num_vertices, count)), jnp.zeros(())
    jacobian = jax.jacobian(lambda u: equation.rate(now, surface, u))(u).reshape(u.size, u.size)
    radius = np.abs(np.linalg.eigvals(jacobian)).max()
    assert radius <= float(equation.spectral_bound(now, surface, u))
