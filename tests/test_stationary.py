"""Stationary states: closed forms on the torus, patterns, boundary data, and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(2, 0.3, seed=0))


def test_time_stepping_and_the_linear_system_reach_the_same_stationary_state():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(4))
    x1 = surface.vertices[:, 0]
    equation = ltl.Diffusion(source=x1)
    stepped = ltl.solve(equation, surface, 0 * x1, 15.0, rtol=1e-8, atol=1e-10).us[-1]
    solved = ltl.steady_state(equation, surface, 0 * x1)
    np.testing.assert_allclose(solved, x1 / 2, atol=1e-4)
    np.testing.assert_allclose(stepped, solved, atol=1e-6)
    marched = ltl.steady_state(equation, surface, 0 * x1, method="marching", t1=20.0)
    np.testing.assert_allclose(marched, solved, atol=1e-8)
    with pytest.raises(ValueError, match="positive t1"):
        ltl.steady_state(equation, surface, 0 * x1, method="marching", t1=-1.0)
    # The initial mass is conserved.
    np.testing.assert_allclose(ltl.steady_state(equation, surface, 0 * x1 + 3), solved + 3, atol=1e-8)


def poloidal_angle(mesh):
    x, y, z = mesh.vertices.T
    return np.arctan2(z, np.hypot(x, y) - 2)


def test_the_torus_with_source_sin_x_has_its_closed_form():
    errors = []
    for n in (24, 48):
        mesh = ltl.shapes.torus(2.0, 1.0, 2 * n, n)
        surface, x = ltl.Surface.from_mesh(mesh), poloidal_angle(mesh)
        exact = np.sin(x) / 2 + (x - 2 * np.arctan(np.sqrt(1 / 3) * np.tan(x / 2)))
        assert abs(np.abs(exact).max() - 1.0330186828) < 0.01
        u = ltl.steady_state(
            ltl.Diffusion(source=jnp.sin(jnp.asarray(x))), surface, jnp.zeros(mesh.num_vertices),
            preconditioner=ltl.solvers.factorized(surface),
        )  # fmt: skip
        errors.append(float(jnp.linalg.norm(u - exact) / np.linalg.norm(exact)))
    assert np.log2(errors[0] / errors[1]) > 1.8
    assert errors[1] < 2e-3


def test_the_published_source_on_the_torus_has_a_stationary_state_only_without_its_mean():
    mesh = ltl.shapes.torus(2.0, 1.0, 128, 64)
    surface = ltl.Surface.from_mesh(mesh)
    angle = jnp.asarray(np.mod(poloidal_angle(mesh), 2 * np.pi))
    # At the jump the source is the mean of both sides, as the integral takes it.
    angle = jnp.where(angle == 0, jnp.pi, angle)
    zero, inverse = jnp.zeros(mesh.num_vertices), ltl.solvers.factorized(surface)
    u = ltl.steady_state(ltl.Diffusion(source=angle - jnp.pi), surface, zero, preconditioner=inverse)
    assert abs(u.max() - 2.1257) < 5e-3
    assert abs(u.min() + 2.1257) < 5e-3
    quarter = u[jnp.argmin(jnp.abs(angle - jnp.pi / 2))]
    assert abs(quarter + 2.119092) < 5e-3
    with pytest.raises(ltl.SolveError, match="no stationary state"):
        ltl.steady_state(ltl.Diffusion(source=angle), surface, zero, preconditioner=inverse)


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
    pattern = ltl.steady_state(equation(rate), surface, start)
    assert jnp.ptp(pattern[:, 0]) > 0.5
    residual = equation(rate).rate(jnp.zeros(()), surface, pattern)
    assert jnp.sqrt(jnp.mean(residual**2)) < 1e-8

    @jax.jit
    def mean_square(rate):
        return jnp.mean(ltl.steady_state(equation(rate), surface, pattern, throw=False)[:, 0] ** 2)

    step = 1e-4
    slope = (mean_square(rate + step) - mean_square(rate - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(mean_square)(rate), slope, rtol=1e-4)


def linear_decay(species, p):
    return (-p * species[0],)


@pytest.mark.parametrize("reacts", [False, True], ids=["Diffusion", "ReactionDiffusion"])
def test_a_stationary_state_has_the_boundary_data_of_its_time(reacts):
    surface = ltl.Surface.from_mesh(ltl.shapes.disk(rings=4))
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
    # Both equations are linear in the boundary data.
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


def test_the_old_name_of_rtol_still_works(sphere):
    x1 = sphere.vertices[:, 0]
    with pytest.warns(DeprecationWarning, match="tolerance of steady_state"):
        ltl.steady_state(ltl.Diffusion(source=x1), sphere, 0 * x1, tolerance=1e-6)
