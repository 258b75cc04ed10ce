"""The measure that diffusion conserves."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse

import ltljax as ltl
from ltljax._surface.conservation import stationary_measure


def test_mass_is_conserved_to_rounding_over_10000_steps(real_mesh):
    surface = ltl.Surface.from_mesh(ltl.load_mesh(real_mesh("spot.obj")))
    mass = surface.mass
    u0 = 1 + jnp.asarray(np.random.default_rng(0).uniform(size=surface.num_vertices))
    # Heun's method at half its largest stable step.
    dt = 0.5 / float(jnp.max(-ltl.laplacian_matrix(surface).diagonal()))

    @jax.jit
    def run(surface, u):
        def step(_, u):
            middle = u + dt / 2 * ltl.laplacian(surface, u)
            return u + dt * ltl.laplacian(surface, middle)

        return jax.lax.fori_loop(0, 10_000, step, u)

    u = run(surface, u0)
    before, after = ltl.integrate(surface, u0, mass), ltl.integrate(surface, u, mass)
    assert abs(float(after / before) - 1) < 1e-12
    # The field did diffuse, and its integral over the areas did change.
    assert float(jnp.std(u)) < 0.2 * float(jnp.std(u0))
    assert abs(float(ltl.integrate(surface, u) / ltl.integrate(surface, u0)) - 1) > 1e-8


@pytest.mark.parametrize("solver", [None, diffrax.Dopri5()], ids=["default", "Dopri5"])
def test_solve_conserves_the_mass_of_every_component(solver):
    parts = [ltl.shapes.jittered_sphere(2, 0.4, seed=1), ltl.shapes.hemisphere(rings=6)]
    vertices = np.concatenate([parts[0].vertices, parts[1].vertices + 5])
    mesh = ltl.Mesh(vertices, np.concatenate([parts[0].faces, parts[1].faces + parts[0].num_vertices]))
    surface = ltl.Surface.from_mesh(mesh)
    mass = np.asarray(surface.mass)
    assert (mass >= 0).all()
    u0 = np.random.default_rng(0).uniform(size=mesh.num_vertices)
    u = np.asarray(ltl.solve(ltl.Diffusion(), surface, u0, 0.2, solver=solver).us[-1])
    areas = np.asarray(surface.vertex_areas)
    for component in range(2):
        is_member = mesh.components == component
        assert mass[is_member] @ u[is_member] == pytest.approx(mass[is_member] @ u0[is_member], rel=1e-12)
        assert mass[is_member].sum() == pytest.approx(areas[is_member].sum(), rel=1e-12)


def test_mass_is_the_weight_of_a_quadrature():
    errors = []
    for level in (3, 4, 5):
        mesh = ltl.shapes.jittered_sphere(level, 0.5, seed=0)
        surface = ltl.Surface.from_mesh(mesh)
        integral = ltl.integrate(surface, mesh.vertices[:, 0] ** 4, surface.mass)
        errors.append(abs(float(integral) / (4 * np.pi / 5) - 1))
        ratio = np.asarray(surface.mass / surface.vertex_areas)
        assert np.median(ratio) == pytest.approx(1, abs=0.02)
    assert errors[-1] < 1e-3


def test_mass_is_computed_once_and_refused_inside_jit():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2))
    assert surface.mass is surface.mass
    moved = surface.with_vertices(surface.vertices * jnp.asarray([[1.0, 1.0, 1.1]]))
    assert not np.allclose(moved.mass, surface.mass, rtol=1e-3)
    with pytest.raises(ValueError, match=r"being traced.*pass it"):
        jax.jit(lambda s: s.mass)(surface)


def test_mass_and_quadrature_can_be_asked_for_inside_jit_if_the_surface_is_not_traced():
    surface = ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(1, 0.3, seed=0))
    inside = jax.jit(lambda u: jnp.sum(surface.quadrature * u))(jnp.ones(surface.num_vertices))
    np.testing.assert_allclose(inside, jnp.sum(surface.mass), rtol=1e-12)
    traced = jax.jit(lambda s: s.quadrature)(surface)
    np.testing.assert_array_equal(traced, surface.vertex_areas)


def chain(rows):
    matrix = np.array(rows, float)
    return scipy.sparse.csr_array(matrix - np.diag(matrix.sum(axis=1)))


def test_the_measure_collects_the_areas_where_the_random_walk_stays():
    # States 0 and 1 exchange, 2 moves to 1, 3 stays, and 4 moves to 3 and to 0 at equal rates.
    generator = chain([[0, 1, 0, 0, 0], [3, 0, 0, 0, 0], [0, 2, 0, 0, 0], [0, 0, 0, 0, 0], [1, 0, 0, 1, 0]])
    measure = stationary_measure(generator, np.array([1.0, 1, 2, 1, 4]))
    np.testing.assert_allclose(measure, [6 * 3 / 4, 6 / 4, 0, 3, 0], rtol=1e-14)
    np.testing.assert_allclose(measure @ generator.todense(), 0, atol=1e-14)


@pytest.mark.parametrize("seed", range(20))
def test_the_measure_is_the_limit_of_the_random_walk(seed):
    random = np.random.default_rng(seed)
    size = 12
    rows = random.uniform(size=(size, size)) * (random.uniform(size=(size, size)) < 0.12)
    np.fill_diagonal(rows, 0)
    generator, areas = chain(rows), random.uniform(0.5, 1, size)
    walk = np.eye(size) + generator.todense() / (2 * rows.sum(axis=1).max() + 1e-3)
    for _ in range(60):
        walk = walk @ walk
        walk /= walk.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(stationary_measure(generator, areas), areas @ walk, atol=1e-8)
