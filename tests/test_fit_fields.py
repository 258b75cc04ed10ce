"""Fits of fields and shapes: sources, initial states, boundary data, eigenvalues, patterns, and weights."""

import diffrax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jax.test_util import check_grads

import ltljax as ltl


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(2))


@pytest.fixture(scope="module")
def fine_sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(3))


def waves(surface, seed, wavenumber=6.0):
    """A random field of size one whose waves have random directions."""
    rng = np.random.default_rng(seed)
    x = np.asarray(surface.vertices)
    directions = wavenumber * rng.normal(size=(3, 40))
    return jnp.sin(x @ directions + rng.uniform(0, 2 * np.pi, 40)).sum(axis=1) / np.sqrt(20)


def noisy(values, share, seed):
    level = share * float(values.std())
    return values + level * np.random.default_rng(seed).normal(size=values.shape), level


def relative_error(params, truth):
    return float(np.linalg.norm(params - truth) / np.linalg.norm(truth))


# In these tests the weight of a penalty is an array, so that all weights share one compiled program.


def test_a_source_of_two_bumps_is_found_from_a_noisy_stationary_state(sphere):
    x = np.asarray(sphere.vertices)
    centres = np.array([[1.0, 0, 0], [-0.6, 0.8, 0]])
    truth = sum(np.exp(-((x - c) ** 2).sum(axis=1) / 0.2) for c in centres)
    values, level = noisy(ltl.screened_poisson(sphere, truth, 1.0), 0.01, 0)
    data, mass = ltl.Observations(values, level), sphere.mass

    def fit_with(weight, start):
        weight = jnp.asarray(weight)
        return ltl.fit(
            lambda p: ltl.screened_poisson(sphere, p["source"], 1.0),
            dict(source=np.zeros(len(x))) if start is None else start, data,
            penalty=lambda p: ltl.inverse.smoothness(sphere, p["source"], weight, mass), max_iterations=400,
        )  # fmt: skip

    weight, fit, curve = ltl.inverse.choose_weight(fit_with, [1000.0, 300.0, 100.0, 30.0, 10.0, 3.0])
    assert "L-BFGS" in fit.method
    assert relative_error(fit.params["source"], truth) < 0.15
    # The misfit decreases with the weight, and the misfit of the chosen weight is explained by noise.
    assert (np.diff(curve[:, 1]) < 0).all()
    assert curve[-1, 1] <= values.size
    assert weight == curve[-1, 0]


def test_an_initial_state_is_found_from_a_later_noisy_one():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2))
    x = np.asarray(surface.vertices)
    truth = x[:, 0] + 0.5 * x[:, 1] * x[:, 2]
    experiment = ltl.inverse.Experiment(
        lambda p: ltl.Diffusion(), surface, lambda p: p, t1=0.05, dt=0.01, solver=diffrax.Heun()
    )
    values, level = noisy(experiment(truth).u_end, 0.02, 0)

    def fit_with(weight, start):
        weight = jnp.asarray(weight)
        return ltl.fit(
            experiment, np.zeros(len(x)) if start is None else start, ltl.Observations(values, level),
            penalty=lambda p: ltl.inverse.smoothness(surface, p, weight, order=2), max_iterations=150,
        )  # fmt: skip

    _, fit, _ = ltl.inverse.choose_weight(fit_with, [1000.0, 100.0, 10.0, 1.0])
    assert "reverse mode with checkpoints" in fit.method
    assert relative_error(fit.params, truth) < 0.05
    with pytest.raises(ValueError, match="order 1"):
        ltl.inverse.smoothness(surface, truth, order=3)


def test_total_variation_keeps_a_jump_that_smoothness_blurs(fine_sphere):
    surface = fine_sphere
    x = np.asarray(surface.vertices)
    truth = np.where(x[:, 2] > 0, 1.0, 0.0)
    values = truth + 0.2 * np.random.default_rng(0).normal(size=len(x))
    data, mass = ltl.Observations(values, 0.2), surface.mass

    def error_with(penalty, weight):
        weight = jnp.asarray(weight)
        fit = ltl.fit(
            lambda p: p, values, data, penalty=lambda p: penalty(surface, p, weight, mass=mass), max_iterations=300
        )
        return np.linalg.norm(fit.params - truth)

    sharp = min(error_with(ltl.inverse.total_variation, weight) for weight in (100.0, 300.0))
    smooth = min(error_with(ltl.inverse.smoothness, weight) for weight in (3.0, 10.0, 30.0))
    assert sharp < 0.75 * smooth


def test_boundary_data_are_found_from_values_inside():
    surface = ltl.Surface.from_mesh(ltl.shapes.disk(rings=12))
    angle = np.arctan2(*np.asarray(surface.vertices)[:, 1::-1].T)

    def model(p):
        edge = p["c"] * jnp.cos(angle) + p["s"] * jnp.sin(2 * angle) + p["mean"]
        return ltl.poisson(surface, jnp.zeros(len(angle)), boundary=ltl.Dirichlet(edge))

    truth = dict(c=1.0, s=-0.5, mean=0.2)
    values, level = noisy(model(truth), 0.01, 0)
    inner = np.linalg.norm(np.asarray(surface.vertices), axis=1) < 0.5
    fit = ltl.fit(
        model, dict(c=0.5, s=0.1, mean=0.1), ltl.Observations(np.asarray(values)[inner], level, vertices=inner)
    )
    low, high = fit.intervals
    for key, value in truth.items():
        assert low[key] < value < high[key]
        assert float(fit.params[key]) == pytest.approx(value, abs=0.1)


def test_a_shape_is_found_from_an_eigenvalue():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1))
    x = surface.vertices

    def model(p):
        moved = surface.with_vertices(x * jnp.exp(p["stretch"] * jnp.array([[0.0, 0.0, 1.0]])))
        # Heat flow leaves the odd eigenfunction along z, and its Rayleigh quotient is the eigenvalue.
        u = ltl.solve(
            ltl.Diffusion(), moved, x[:, 2], 1.0, solver=diffrax.Heun(), dt=0.02, throw=False,
            adjoint=diffrax.ForwardMode(),
        ).u_end  # fmt: skip
        return -jnp.vdot(u, ltl.laplacian(moved, u)) / jnp.vdot(u, u)

    fit = ltl.fit(model, dict(stretch=0.05), ltl.Observations(1.4))
    assert float(model(fit.params)) == pytest.approx(1.4, abs=1e-4)
    assert float(fit.params["stretch"]) > 0.1  # a longer shape has a smaller eigenvalue


def test_parameters_are_found_from_the_statistics_of_fields_with_other_phases(sphere):
    """The positions of the waves are unknown, so only statistics can be compared."""

    def statistics(p, seed=1):
        u = p["mean"] + p["size"] * waves(sphere, seed, 2.0)
        return ltl.inverse.pattern_statistics(sphere, u, mass).vector[1:3]

    mass, truth = sphere.mass, dict(mean=1.0, size=0.3)
    samples = [np.asarray(statistics(truth, seed)) for seed in range(2, 22)]
    data = ltl.Observations(np.mean(samples, axis=0), np.std(samples, axis=0))
    fit = ltl.fit(statistics, dict(mean=0.8, size=0.5), data, transforms=ltl.inverse.Positive())
    low, high = fit.intervals
    assert all(low[key] < truth[key] < high[key] for key in truth)


@pytest.mark.slow
def test_rates_are_found_from_statistics_of_a_pattern(fine_sphere):
    """The positions of the spots are unknown, so the statistics of runs with other starts are compared."""
    surface, mass = fine_sphere, fine_sphere.mass

    def statistics(p, seed=1, adjoint=None):
        u0 = np.array([1.0, 0.9]) + 0.1 * waves(surface, seed)[:, None] * np.array([1.0, -1.0])
        equation = ltl.ReactionDiffusion((1.0, 10.0), ltl.kinetics.schnakenberg(p["a"], p["b"], rate=60.0))
        u = ltl.solve(equation, surface, u0, 2.0, adjoint=adjoint, throw=False).u_end
        return ltl.inverse.pattern_statistics(surface, u[:, 0], mass).vector[:3]

    truth = dict(a=0.1, b=0.9)
    samples = [statistics(truth, seed) for seed in range(2, 8)]
    data = ltl.Observations(np.mean(samples, axis=0), np.std(samples, axis=0))
    fit = ltl.fit(statistics, dict(a=0.13, b=0.8), data, transforms=ltl.inverse.Positive())
    assert max(abs(float(fit.params[key]) / truth[key] - 1) for key in truth) < 0.1
    low, high = fit.intervals
    assert all(low[key] < truth[key] < high[key] for key in truth)


def test_a_histogram_is_the_coverage_between_levels(fine_sphere):
    u, mass = fine_sphere.vertices[:, 2], fine_sphere.mass
    statistics = ltl.inverse.pattern_statistics(fine_sphere, u, mass, levels=[-0.5, 0.0, 0.5], softness=0.02)
    # Heights on a sphere are uniformly distributed (Archimedes).
    np.testing.assert_allclose(statistics.histogram, [0.25, 0.25, 0.25, 0.25], atol=0.02)
    assert float(statistics.histogram.sum()) == pytest.approx(1)
    assert statistics.vector.shape == (7,)


def test_the_statistics_tell_spots_from_holes_and_are_differentiable(fine_sphere):
    x, mass = fine_sphere.vertices, fine_sphere.mass
    spots = jnp.exp(8 * (x[:, 2] - 1))
    statistics = ltl.inverse.pattern_statistics(fine_sphere, spots, mass, levels=[0.1, 0.5])
    assert statistics.skewness > 1
    assert ltl.inverse.pattern_statistics(fine_sphere, -spots, mass).skewness < -1
    # A cap covers the share (1 - cos) / 2 of the sphere.
    np.testing.assert_allclose(statistics.coverage, [np.log(10) / 16, np.log(2) / 16], rtol=0.1)
    first = ltl.inverse.pattern_statistics(fine_sphere, x[:, 0], mass)
    assert first.wavelength == pytest.approx(2 * np.pi / np.sqrt(2), rel=0.01)
    assert first.deviation == pytest.approx(np.sqrt(1 / 3), rel=0.01)
    check_grads(
        lambda u: ltl.inverse.pattern_statistics(fine_sphere, u, mass, levels=[0.1]).vector,
        (spots,),
        order=1,
        modes=["fwd", "rev"],
    )


def test_a_discrepancy_that_no_weight_reaches_is_reported():
    x = jnp.linspace(0.0, 1.0, 20)

    def fit_with(weight, start):
        del start
        weight = jnp.asarray(weight)
        return ltl.fit(lambda p: p * x, 1.0, ltl.Observations(x**2 + 1, 0.01), penalty=lambda p: weight * p)

    with pytest.warns(UserWarning, match="No weight down to 0.1 explains the data"):
        weight, _, _ = ltl.inverse.choose_weight(fit_with, [1.0, 0.1])
    assert weight == 0.1
    with pytest.raises(ValueError, match="'discrepancy' or 'l-curve'"):
        ltl.inverse.choose_weight(fit_with, [1.0, 0.1], rule="gcv")


@pytest.mark.slow
def test_the_l_curve_bends_at_a_good_weight():
    rng = np.random.default_rng(0)
    t = np.linspace(0, 1, 60)
    blur = np.exp(-((t[:, None] - t) ** 2) / 0.01)
    blur /= blur.sum(axis=1, keepdims=True)
    truth = np.sin(2 * np.pi * t)
    values = blur @ truth + 0.01 * rng.normal(size=60)

    def fit_with(weight, start):
        return ltl.fit(
            lambda p: jnp.asarray(blur) @ p, np.zeros(60) if start is None else start, ltl.Observations(values, 0.01),
            penalty=lambda p: jnp.sqrt(weight) * jnp.diff(p), method=optx.LevenbergMarquardt(1e-6, 1e-8),
        )  # fmt: skip

    weights = np.geomspace(1e-4, 1e6, 11)
    errors = [np.linalg.norm(fit_with(w, None).params - truth) for w in weights]
    chosen, fit, _ = ltl.inverse.choose_weight(fit_with, weights, rule="l-curve")
    assert chosen in weights
    assert np.linalg.norm(fit.params - truth) < 3 * min(errors)
