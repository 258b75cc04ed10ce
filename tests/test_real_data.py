"""Fits of measured data with outliers, gaps, unknown scales and counts, and reports about models that are wrong."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats

import ltljax as ltl
from ltljax._fit.losses import as_loss
from ltljax._fit.observations import root_of_deviance
from ltljax.app.cli import main

TIMES = np.array([0.15, 0.45, 0.9])
TRUTH = dict(a=0.12, b=0.85, dv=0.25)
START = dict(a=0.15, b=0.7, dv=0.4)
NOISE = 0.01


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(2))


@pytest.fixture(scope="module")
def experiment(sphere):
    x = np.asarray(sphere.vertices)
    push = np.sin(5 * x[:, 0]) * np.cos(4 * x[:, 1]) + np.sin(6 * x[:, 2])
    u0 = jnp.asarray(np.array([0.97, 0.9]) + 0.3 * push[:, None] * np.array([1.0, -1.0]))
    return ltl.inverse.Experiment(
        lambda p: ltl.ReactionDiffusion((0.02, p["dv"]), ltl.kinetics.schnakenberg(p["a"], p["b"], rate=10.0)),
        sphere, u0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def exact(experiment):
    return np.asarray(experiment(TRUTH, TIMES).us)


def noisy(exact, seed):
    return exact + NOISE * np.random.default_rng(seed).normal(size=exact.shape)


def fitted(experiment, values, start=START, **options):
    data = ltl.Observations(values, times=TIMES, **options)
    return ltl.fit(experiment, start, data, transforms=ltl.inverse.Positive())


def holds(found, truth=TRUTH):
    """Whether all intervals together hold the truth: 95 % of them should hold each."""
    low, high = found.intervals
    return np.array([low[key] <= truth[key] <= high[key] for key in truth])


def with_outliers(values, seed):
    """Five values in a hundred off by a lot, most of them to one side."""
    chance = np.random.default_rng(1000 + seed)
    off = chance.random(values.shape) < 0.05
    return np.where(off, values + 20 * chance.choice([1, 1, 1, -1], values.shape), values), off


# If each interval holds the truth with a probability of 95 %, at least 18 of 20 do with a probability of 92 %.
SEEDS, ENOUGH = range(20), 18


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_intervals_hold_the_truth_with_five_outliers_in_a_hundred(experiment, exact, loss):
    held = np.zeros(3)
    for seed in SEEDS:
        values, off = with_outliers(noisy(exact, seed), seed)
        found = fitted(experiment, values, loss=loss)
        held += holds(found)
        assert found.converged, found
        named = np.zeros(values.shape, bool)
        named[tuple(found.agreement.outliers.T)] = True
        assert (named >= off).all()
        assert named.sum() - off.sum() <= 2
    assert (held >= ENOUGH).all(), held


def test_intervals_hold_the_truth_with_a_third_of_the_values_missing(experiment, exact):
    held = np.zeros(3)
    for seed in SEEDS:
        values = noisy(exact, seed)
        values[np.random.default_rng(seed).random(values.shape) < 0.3] = np.nan
        found = fitted(experiment, values)
        assert found.converged
        held += holds(found)
    assert (held >= ENOUGH).all(), held


def test_intervals_hold_the_truth_and_an_unknown_factor_of_each_species(experiment, exact):
    held = np.zeros(5)
    factors = np.array([3.7, 0.2])
    for seed in SEEDS:
        found = fitted(experiment, factors * noisy(exact, seed), scale=ltl.inverse.Positive(1.0))
        assert found.converged
        low, high = found.evidence.ends
        truth = np.array([*TRUTH.values(), *factors])
        assert found.evidence.names[3:] == ("data.scale[0]", "data.scale[1]")
        held += (low <= truth) & (truth <= high)
    assert (held >= ENOUGH).all(), held


def test_an_offset_and_a_background_are_found(experiment, exact, sphere):
    pattern = np.asarray(sphere.vertices)[:, 2:]
    values = noisy(exact, 0) + np.array([0.5, -0.2]) + np.array([0.1, 0.3]) * pattern
    found = fitted(experiment, values, offset=ltl.inverse.Real(0.0), background=pattern)
    assert holds(found).all()
    np.testing.assert_allclose(found.calibration["offset"], [0.5, -0.2], atol=0.01)
    np.testing.assert_allclose(found.calibration["background"], [0.1, 0.3], atol=0.01)
    known = fitted(experiment, 2 * values - 1, scale=2.0, offset=[0.0, -1.4], background=pattern, species=(0, 1))
    for key in TRUTH:
        assert float(known.params[key]) == pytest.approx(float(found.params[key]), rel=0.01)
    np.testing.assert_allclose(known.calibration["background"], [0.2, 0.6], atol=0.02)


def test_least_squares_of_outliers_says_what_is_wrong(experiment, exact):
    values, _ = with_outliers(noisy(exact, 0), 0)
    found = fitted(experiment, values)
    assert not found.converged
    assert 'loss="huber"' in found.summary()
    assert f"of {values.size} values are outliers" in found.summary()


def test_a_wrong_factor_is_not_explained(experiment, exact):
    for options in (dict(), dict(noise=NOISE)):
        found = fitted(experiment, 3.7 * noisy(exact, 0), **options)
        assert found.status in ("explains nothing", "unexplained", "structured residuals", "end of range")
        assert found.summary().startswith(("The model explains nothing", "The model does not explain the data"))
        assert "scale=Positive" in found.summary()


@pytest.mark.parametrize("factor", [300.0, 1 / 300])
def test_a_far_start_is_recovered(experiment, exact, factor):
    found = fitted(experiment, noisy(exact, 0), {key: factor * value for key, value in TRUTH.items()})
    assert found.converged
    assert holds(found).all()
    assert "The start explains nothing, so the fit began at the best of" in found.summary()


def test_a_start_that_nothing_helps_is_not_called_converged(sphere):
    # The prediction does not depend on the parameter where the data are.
    experiment = ltl.inverse.Experiment(lambda p: ltl.Diffusion(0 * p), sphere, jnp.ones(sphere.num_vertices))
    values = 5 + np.random.default_rng(0).normal(size=(2, sphere.num_vertices))
    found = ltl.fit(experiment, 1.0, ltl.Observations(values, times=[0.1, 0.2]))
    assert found.status == "explains nothing"
    assert "no point within a factor of 1000" in found.summary()


CURVE = np.linspace(0, 4, 60)


def curve(p):
    return p["size"] * jnp.exp(-p["rate"] * CURVE) + p["floor"]


def numpy_curve(x):
    return x[0] * np.exp(-x[1] * CURVE) + x[2]


def spoiled(seed=0):
    chance = np.random.default_rng(seed)
    values = numpy_curve([2.0, 1.0, 0.5]) + 0.05 * chance.normal(size=60)
    values[::9] += 3
    return values


@pytest.mark.parametrize("loss", ["linear", "huber", "soft_l1", "cauchy"])
def test_the_minimum_is_that_of_scipy(loss):
    values, scale = spoiled(), as_loss(loss).scale * 0.05
    found = ltl.fit(curve, dict(size=1.5, rate=0.8, floor=0.3), ltl.Observations(values, 0.05, loss=loss),
                    rtol=1e-9, atol=1e-11)  # fmt: skip
    peer = scipy.optimize.least_squares(
        lambda x: numpy_curve(x) - values, [1.5, 0.8, 0.3], loss=loss, f_scale=scale, xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    ours = np.array([found.params[key] for key in ("size", "rate", "floor")])
    np.testing.assert_allclose(ours, peer.x, rtol=5e-4)
    assert found.loss == pytest.approx(peer.cost / 0.05**2, rel=1e-6)


def test_a_loss_of_ones_own_is_minimised():
    def geman(z):
        return z / (1 + z / 9)

    values = spoiled()
    found = ltl.fit(curve, dict(size=1.5, rate=0.8, floor=0.3), ltl.Observations(values, 0.05, loss=geman))
    peer = scipy.optimize.minimize(
        lambda x: np.sum(geman(((numpy_curve(x) - values) / 0.05) ** 2)), [2.0, 1.0, 0.5], method="Nelder-Mead",
        options=dict(xatol=1e-9, fatol=1e-9, maxiter=5000),
    )  # fmt: skip
    np.testing.assert_allclose([found.params[key] for key in ("size", "rate", "floor")], peer.x, rtol=1e-3)
    assert "geman" in repr(found.data.loss)


@pytest.mark.parametrize("loss", ["huber", "soft_l1", "cauchy"])
def test_the_covariance_of_a_robust_loss_is_the_sandwich(loss):
    """The textbook's formula on a linear model, from derivatives of the whole loss."""
    chance = np.random.default_rng(0)
    design = chance.normal(size=(200, 2))
    values = design @ [1.0, -2.0] + 0.1 * chance.standard_t(3, size=200)
    found = ltl.fit(lambda p: jnp.asarray(design) @ p, jnp.zeros(2), ltl.Observations(values, 0.1, loss=loss),
                    rtol=1e-10, atol=1e-12)  # fmt: skip
    rho = as_loss(loss)

    def loss_of(p):
        return 0.5 * rho.root((jnp.asarray(design) @ p - values) / 0.1) ** 2

    bread = jnp.linalg.inv(jax.hessian(lambda p: jnp.sum(loss_of(p)))(found.params))
    slopes = jax.jacobian(loss_of)(found.params)
    expected = bread @ slopes.T @ slopes @ bread
    # The degrees of freedom that two parameters take are counted.
    np.testing.assert_allclose(found.covariance, expected * 200 / 198, rtol=2e-3)


def test_the_roots_of_the_deviance_sum_to_the_likelihood():
    counts = np.array([0, 0, 1, 3, 10, 10, 10, 500])
    rates = np.array([0.1, 2.0, 0.5, 3.0, 10.0, 10.000001, 14.0, 520.0])
    roots = np.asarray(root_of_deviance(jnp.asarray(counts, float), jnp.asarray(rates)))
    best = scipy.stats.poisson.logpmf(counts, np.where(counts == 0, 1e-300, counts))
    expected = 2 * (best - scipy.stats.poisson.logpmf(counts, rates))
    np.testing.assert_allclose(roots**2, expected, rtol=1e-9, atol=1e-11)
    assert (np.sign(roots) == np.sign(rates - counts)).all()
    assert np.isfinite(jax.vmap(jax.grad(root_of_deviance, 1))(jnp.asarray(counts, float), jnp.asarray(rates))).all()
    assert np.isnan(root_of_deviance(jnp.ones(()), jnp.zeros(())))


def test_intervals_of_counts_hold_the_truth(experiment, exact):
    held, sizes = np.zeros(3), []
    for seed in SEEDS:
        counts = np.random.default_rng(seed).poisson(30 * exact)
        found = fitted(experiment, counts, noise="poisson", scale=30.0)
        sizes.append(found.agreement.reduced_chi_square)
        held += holds(found)
    assert (held >= ENOUGH).all(), held
    assert np.mean(sizes) == pytest.approx(1, abs=0.03)


def test_intervals_hold_the_truth_where_noise_grows_with_the_signal(experiment, exact):
    held, sizes = np.zeros(3), []
    for seed in SEEDS:
        levels = np.sqrt(NOISE**2 + (0.1 * exact) ** 2)
        values = exact + levels * np.random.default_rng(seed).normal(size=exact.shape)
        found = fitted(experiment, values, noise=NOISE, relative_noise=0.1)
        sizes.append(found.agreement.reduced_chi_square)
        held += holds(found)
    assert (held >= ENOUGH).all(), held
    assert np.mean(sizes) == pytest.approx(1, abs=0.03)


def test_gaps_may_be_given_as_nan_masks_or_masked_arrays(experiment, exact):
    values = noisy(exact, 0)
    gaps = np.random.default_rng(0).random(values.shape) < 0.3
    found = [
        fitted(experiment, np.where(gaps, np.nan, values)),
        fitted(experiment, np.where(gaps, 1e9, values), mask=~gaps),
        fitted(experiment, np.ma.masked_array(values, gaps)),
    ]
    assert found[0].params == found[1].params == found[2].params
    assert found[0].data.num_values == (~gaps).sum()
    assert (np.isnan(found[0].residuals) == gaps).all()


def test_the_closest_point_is_that_of_a_search_over_all_triangles():
    mesh = ltl.shapes.jittered_torus(14, 7, 0.3, seed=0)
    surface = ltl.Surface.from_mesh(mesh)
    points = np.random.default_rng(0).uniform(-1.4, 1.4, size=(40, 3))
    sampling = ltl.inverse.observe_at(surface, points, within=10.0)
    found = np.asarray(sampling(surface.vertices)) + surface.centre
    corners = mesh.vertices[mesh.faces]
    grid = np.linspace(0, 1, 25)
    s, t = (w.ravel() for w in np.meshgrid(grid, grid))
    inside = s + t <= 1
    weights = np.stack([1 - s - t, s, t])[:, inside]
    everywhere = np.einsum("kw,fkd->fwd", weights, corners).reshape(-1, 3)
    for point, place in zip(points, found, strict=True):
        least = np.linalg.norm(everywhere - point, axis=1).min()
        assert np.linalg.norm(place - point) <= least + 1e-12
        assert least - np.linalg.norm(place - point) < 0.03


def test_measurements_at_points_are_of_second_order():
    errors, sizes = [], []
    points = np.random.default_rng(0).normal(size=(50, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    for level in (2, 3, 4):
        surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(level))
        found = ltl.inverse.observe_at(surface, points)(jnp.sin(3 * surface.vertices[:, 0]))
        errors.append(float(np.abs(found - np.sin(3 * points[:, 0])).max()))
        sizes.append(float(surface.mesh_size))
    assert np.polyfit(np.log(sizes), np.log(errors), 1)[0] > 1.8
    assert errors[-1] < 0.01


def test_data_on_another_mesh_and_over_patches_recover_the_rates(experiment, exact, sphere):
    other = ltl.shapes.icosphere(4).vertices[::3]
    patches = np.argmax(np.asarray(sphere.vertices) @ np.random.default_rng(0).normal(size=(3, 60)), axis=1)
    patches = np.unique(patches, return_inverse=True)[1]
    for sampling in (ltl.inverse.observe_at(sphere, other), ltl.inverse.observe_patches(sphere, patches)):
        clean = np.asarray(sampling(exact, axis=1))
        found = fitted(experiment, noisy(clean, 0), operator=sampling)
        assert found.converged
        assert max(abs(found.params[key] / TRUTH[key] - 1) for key in TRUTH) < 0.05
        assert holds(found).all()


def test_averages_over_patches_are_weighted_by_area(sphere):
    u, areas = 2 + np.asarray(sphere.vertices)[:, 2], np.asarray(sphere.vertex_areas)
    north = np.asarray(sphere.vertices)[:, 2] > 0
    as_masks = ltl.inverse.observe_patches(sphere, [north, ~north])
    as_numbers = ltl.inverse.observe_patches(sphere, np.where(north, 0, 1))
    expected = [np.average(u[part], weights=areas[part]) for part in (north, ~north)]
    np.testing.assert_allclose(as_masks(u), expected, rtol=1e-12)
    np.testing.assert_allclose(as_numbers(u), expected, rtol=1e-12)


def test_a_matrix_is_an_operator(sphere):
    matrix = np.random.default_rng(0).normal(size=(5, sphere.num_vertices))
    data = ltl.Observations(np.zeros((2, 5)), times=[0.1, 0.2], operator=matrix)
    states = np.random.default_rng(1).normal(size=(2, sphere.num_vertices))
    np.testing.assert_allclose(data.of(states), states @ matrix.T, rtol=1e-10)


@pytest.mark.parametrize("where", ["all", "some"])
def test_independent_noise_shows_no_structure_and_a_smooth_error_does(experiment, exact, sphere, where):
    vertices = None if where == "all" else np.arange(0, sphere.num_vertices, 2)
    pick = slice(None) if vertices is None else vertices
    wave = NOISE * np.sin(4 * np.asarray(sphere.vertices)[:, 1])[pick, None]
    for seed in range(5):
        values = noisy(exact[:, pick], seed)
        assert not fitted(experiment, values, vertices=vertices).agreement.is_structured
        wrong = fitted(experiment, values + wave, vertices=vertices)
        assert wrong.status == "structured residuals"
        assert wrong.agreement.in_space.is_structure
        assert "intervals are too narrow" in wrong.summary()


def test_errors_that_stay_in_time_are_seen(experiment, exact):
    # Noise that is independent from place to place but the same at all times.
    values = exact + NOISE * np.random.default_rng(0).normal(size=exact.shape[1:])
    found = fitted(experiment, values)
    assert found.status == "structured residuals"
    assert found.agreement.in_time.value > 0.8
    assert not found.agreement.in_space.is_structure


def test_every_state_of_a_fit_has_its_name(experiment, exact):
    values = noisy(exact, 0)
    assert fitted(experiment, values).status == "converged"
    stopped = ltl.fit(
        experiment, START, ltl.Observations(values, times=TIMES), transforms=ltl.inverse.Positive(), max_steps=2
    )
    assert (stopped.status, stopped.has_settled) == ("stopped", False)
    assert fitted(experiment, values, noise=NOISE / 5).status == "unexplained"
    # One of two factors cannot be told; and the best value lies beyond the range.
    flat = ltl.fit(lambda p: p["c"] * p["d"] * CURVE, dict(c=1.0, d=1.0), ltl.Observations(2 * CURVE, 0.1))
    assert flat.status == "undetermined"
    low = ltl.fit(lambda p: p * CURVE, 0.5, ltl.Observations(2 * CURVE, 5.0), transforms=ltl.inverse.Bounded(0.0, 1.0))
    assert low.status == "end of range"
    assert [fit.converged for fit in (flat, low, stopped)] == [False] * 3


def test_the_chi_square_of_the_right_noise_is_one(experiment, exact):
    shares = []
    for seed in range(20):
        found = fitted(experiment, noisy(exact, seed), noise=NOISE).agreement
        low, high = found.expected
        shares.append(low < found.reduced_chi_square < high)
    assert np.sum(shares) >= ENOUGH


def test_a_second_fit_of_the_same_model_compiles_nothing(experiment, exact):
    counted = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: counted.append(name) if name.endswith("backend_compile_duration") else None
    )
    fitted(dataclasses.replace(experiment, rtol=2e-5), noisy(exact, 0), loss="huber")
    begin = len(counted)
    assert begin > 0
    fitted(dataclasses.replace(experiment, rtol=2e-5), noisy(exact, 1), loss="huber")
    assert len(counted) == begin


RATES = {"k": 1.0}


def test_a_model_that_reads_a_changed_value_is_traced_again():
    """From a closure, from its module, and from an object."""

    class Scaled:
        def __init__(self, factor):
            self.factor = factor

        def __call__(self, p):
            return p * self.factor * jnp.asarray(CURVE)

    held = {"k": 1.0}
    models = (lambda p: p * held["k"] * CURVE), (lambda p: p * RATES["k"] * CURVE), Scaled(1.0)
    data = ltl.Observations(2 * CURVE)
    for model in models:
        assert float(ltl.fit(model, 1.0, data).params) == pytest.approx(2.0)
    held["k"] = RATES["k"] = models[2].factor = 4.0
    for model in models:
        assert float(ltl.fit(model, 1.0, data).params) == pytest.approx(0.5)
    RATES["k"] = 1.0


@pytest.mark.parametrize("factor", [1e-12, 1e12])
@pytest.mark.parametrize("loss", ["linear", "huber"])
def test_the_unit_of_the_data_changes_units_only(factor, loss):
    values = spoiled()
    one, other = (
        ltl.fit(curve, dict(size=k * 1.5, rate=0.8, floor=k * 0.3), ltl.Observations(k * values, loss=loss))
        for k in (1.0, factor)
    )
    for key, k in (("size", factor), ("rate", 1.0), ("floor", factor)):
        assert float(other.params[key]) == pytest.approx(float(k * one.params[key]), rel=1e-4)
    ratios = dict(zip(one.evidence.names, other.evidence.std / one.evidence.std, strict=True))
    for key, k in (("size", factor), ("rate", 1.0), ("floor", factor)):
        assert ratios[key] == pytest.approx(k, rel=1e-2)
    assert len(other.agreement.outliers) == len(one.agreement.outliers)


def test_a_robust_fit_is_resumed_as_it_was_left(experiment, exact, tmp_path):
    values, _ = with_outliers(noisy(exact, 0), 0)
    data = ltl.Observations(values, times=TIMES, loss="huber")
    options = dict(transforms=ltl.inverse.Positive(), checkpoint=tmp_path / "fit.npz")
    left = ltl.fit(experiment, START, data, stop_when=lambda step, *_: step == 8, **options)
    resumed = ltl.fit(experiment, START, data, resume=True, **options)
    whole = ltl.fit(experiment, START, data, transforms=ltl.inverse.Positive())
    assert resumed.converged
    assert left.num_steps == 9
    assert resumed.num_steps < whole.num_steps
    # Another model, whose loss there is another, is refused.
    ltl.fit(experiment, START, data, stop_when=lambda step, *_: step == 8, **options)
    other = dataclasses.replace(experiment, u0=1.05 * experiment.u0)
    with pytest.raises(ltl.errors.RestartError, match="holds another fit"):
        ltl.fit(other, START, data, resume=True, **options)
    for key in TRUTH:
        assert float(resumed.params[key]) == pytest.approx(float(whole.params[key]), rel=1e-3)


def test_errors_over_their_standard_deviations_have_a_size_of_one():
    """Of a curve with few points, of two species with very different noise, and of counts."""
    chance, many = np.random.default_rng(0), 60
    truth, off = np.array([2.0, 1.0]), {"few": [], "species": [], "counts": []}
    shape = jnp.stack([jnp.exp(-jnp.asarray(CURVE)), jnp.ones(60)])
    for _ in range(many):
        values = truth @ np.asarray(shape) + 0.1 * chance.normal(size=60)
        for name, data in (
            ("few", ltl.Observations(values, loss="huber")),
            ("counts", ltl.Observations(chance.poisson(2 * truth @ np.asarray(shape)), "poisson", scale=2.0)),
        ):
            fit = ltl.fit(lambda p: p @ shape, np.array([1.5, 1.5]), data)
            off[name].append((np.asarray(fit.params) - truth) / fit.evidence.std)
        pair = np.stack([3 * chance.normal(size=60), 0.01 * chance.normal(size=60)], axis=1) + (truth @ shape)[:, None]
        fit = ltl.fit(lambda p: jnp.stack([p @ shape] * 2, axis=1), np.array([1.5, 1.5]), ltl.Observations(pair))
        off["species"].append((np.asarray(fit.params) - truth) / fit.evidence.std)
    for name, values in off.items():
        # The mean square of 120 normal values has a standard deviation of 13 %.
        assert np.mean(np.square(values)) == pytest.approx(1, abs=0.4), name


def test_the_chi_square_of_counts_is_one_however_low_the_rates():
    for rate in (0.03, 1.0, 30.0):
        sizes, inside = [], 0
        for seed in range(20):
            counts = np.random.default_rng(seed).poisson(rate, size=400)
            fit = ltl.fit(
                lambda p: p * jnp.ones(400),
                rate,
                ltl.Observations(counts, "poisson"),
                transforms=ltl.inverse.Positive(),
            )
            sizes.append(fit.agreement.reduced_chi_square)
            low, high = fit.agreement.expected
            inside += low < sizes[-1] < high
            assert fit.evidence.std[0] == pytest.approx(np.sqrt(counts.mean() / 400), rel=1e-3)
        assert np.mean(sizes) == pytest.approx(1, abs=0.05)
        assert inside >= ENOUGH


def test_values_that_are_met_exactly_do_not_hide_the_noise():
    where = np.where(np.arange(60) < 40, 0.0, 1.0)
    values = where * (2 + 0.1 * np.random.default_rng(0).normal(size=60))
    fit = ltl.fit(lambda p: p * jnp.asarray(where), 1.0, ltl.Observations(values, loss="huber"))
    assert float(fit.params) == pytest.approx(2, abs=0.1)
    assert fit.evidence.noise == pytest.approx(0.1, rel=0.6)


def test_a_report_does_not_speak_of_structure_that_was_not_looked_for():
    fit = ltl.fit(lambda p: p[0] + p[1] * CURVE, np.zeros(2), ltl.Observations(CURVE**2))
    assert "nothing tells whether the residuals have structure" in fit.summary()


def test_many_fits_and_searches_take_gaps_and_unknown_factors():
    line = lambda p: p * jnp.exp(-CURVE)  # noqa: E731
    sets = np.stack([np.exp(-CURVE), 3 * np.exp(-CURVE)])
    sets[:, ::7] = np.nan
    data = ltl.Observations(np.zeros(60), 0.1)
    np.testing.assert_allclose(ltl.inverse.fit_many(line, 1.5, data, values=sets).params, [1, 3], rtol=1e-6)
    masked = np.ma.masked_array(np.nan_to_num(sets, nan=99.0), np.isnan(sets))
    np.testing.assert_allclose(ltl.inverse.fit_many(line, 1.5, data, values=masked).params, [1, 3], rtol=1e-6)
    with pytest.raises(ValueError, match="Data set 1 has no value that was measured"):
        ltl.inverse.fit_many(line, 1.5, data, values=np.stack([sets[0], np.full(60, np.nan)]))
    with pytest.raises(ValueError, match="takes the noise as given"):
        ltl.inverse.fit_many(line, np.ones(2), ltl.Observations(sets[0], loss="huber"))
    decay = lambda p: jnp.exp(-p * CURVE)  # noqa: E731
    unknown = ltl.Observations(10 * np.exp(-CURVE), scale=ltl.inverse.Positive(1.0))
    best, _ = ltl.inverse.explore(decay, 0.01, 100.0, unknown, count=128)
    assert 0.8 < float(best[0]) < 1.25


def test_a_scan_keeps_bounded_parameters_near_their_start():
    from ltljax._fit.problem import prepare
    from ltljax._fit.scan import _moved
    from ltljax._fit.unknowns import unknowns

    start = dict(a=2.0, b=0.05, c=3.0)
    space = unknowns(start, dict(a=ltl.inverse.Positive(), b=ltl.inverse.Bounded(0.0, 1.0)))
    z = np.asarray(space.free((start, {})))
    model = lambda p: p["a"] * p["b"] * p["c"] * CURVE  # noqa: E731
    problem = prepare(model, space, ltl.Observations(CURVE), None, None, jnp.asarray(z), 1e-5, 1e-7)
    still = space.params(jnp.asarray(_moved(problem.residuals, z, np.zeros(3))))
    assert {key: pytest.approx(float(value)) for key, value in still.items()} == start
    moved = space.params(jnp.asarray(_moved(problem.residuals, z, np.array([1.0, 1.0, -1.0]))))
    assert [float(moved[key]) for key in "abc"] == pytest.approx([20.0, 0.05 + 1 / 6, 0.3])


def test_derivatives_do_not_see_what_was_not_measured():
    data = ltl.Observations([3.0, np.nan], "poisson")
    slope = jax.grad(lambda m: jnp.sum(data.misfit(m) ** 2))(jnp.array([2.0, -1.0]))
    np.testing.assert_allclose(slope, [2 * (1 - 3 / 2), 0.0], rtol=1e-6)
    assert ltl.Observations([1.0, 2.0], [0.1, np.nan], mask=[True, False]).num_values == 1
    assert ltl.Observations([1.0], scale=ltl.inverse.Bounded(2.0, 5.0)).calibration.unknowns(1.0)["scale"][0] == 3.5


REFUSED = [
    (dict(values=[np.nan, np.nan]), "None of the 2 values was measured"),
    (dict(values=[1.0, 2.0], mask=[False, False]), "None of the 2 values was measured"),
    (dict(values=[1.0, np.inf]), r"Expected finite observations, found inf at index \(1,\)"),
    (dict(values=[1.0, 2.0], mask=[1, 0]), "Expected mask as booleans"),
    (dict(values=[1.0, 2.0], loss="tukey"), "Expected a loss: 'linear', 'huber', 'soft_l1', 'cauchy', or a function"),
    (dict(values=[1.0, 2.0], loss=lambda z: z + 1), r"rho\(0\) = 0 that rises"),
    (dict(values=[1.0, 2.0], loss=lambda z: -z), r"rho\(0\) = 0 that rises"),
    (dict(values=[1.0, 2.0], loss=lambda z: jnp.sum(z)), "one finite number for each squared residual"),
    (dict(values=[1.0, 2.0], loss=lambda z, y: z), "The loss fails on an array"),
    (dict(values=[1.0, 2.0], loss=3), "Expected a loss"),
    (dict(values=[1.0, 2.0], noise="gauss"), 'Expected noise as a number, an array or "poisson"'),
    (dict(values=[1.0, -2.0], noise="poisson"), "Expected counts from 0"),
    (dict(values=[1.0, 2.0], relative_noise=0.1), "Expected noise= beside relative_noise="),
    (dict(values=[1.0, 2.0], scale=0.0), "Expected scale as a finite number other than zero"),
    (dict(values=[1.0, 2.0], scale=ltl.inverse.Positive(-1.0)), "Expected the start of scale to be positive"),
    (dict(values=[1.0, 2.0], offset="free"), "offset as real numbers"),
    (dict(values=[1.0, 2.0], background=np.zeros(2)), "Expected background as finite numbers, not all zero"),
    (dict(values=[1.0, 2.0], operator=np.ones(3)), r"Expected an operator as a matrix \(M, V\)"),
    (dict(values=[1.0, 2.0], operator=np.zeros((2, 3))), "Row 0 of the operator has no entries"),
    (dict(values=[1.0, 2.0], operator=np.ones((2, 3)), vertices=[0, 1]), "either vertices= or operator="),
]  # fmt: skip


@pytest.mark.parametrize(("given", "message"), REFUSED)
def test_data_that_cannot_be_used_are_refused(given, message):
    with pytest.raises(ValueError, match=message):
        ltl.Observations(**given)


@pytest.mark.usefixtures("as_users_call_it")
def test_points_and_patches_that_cannot_be_used_are_refused(sphere):
    with pytest.raises(ValueError, match=r"Point 1 at \(3, 0, 0\) is 2 from the surface, and 1 of 2 points"):
        ltl.inverse.observe_at(sphere, np.array([[1.0, 0, 0], [3.0, 0, 0]]))
    with pytest.raises(ValueError, match="Point 0 is not finite"):
        ltl.inverse.observe_at(sphere, np.full((1, 3), np.nan))
    with pytest.raises(ValueError, match=r"Expected points of shape \(M, 3\)"):
        ltl.inverse.observe_at(sphere, np.zeros(3))
    with pytest.raises(ValueError, match="Patch 1 has no vertices"):
        ltl.inverse.observe_patches(sphere, [[0, 1], []])
    with pytest.raises(ValueError, match="Patch 0 has vertices outside"):
        ltl.inverse.observe_patches(sphere, [[0, 10_000]])
    small = ltl.Surface.from_mesh(ltl.shapes.icosphere(1))
    model = ltl.inverse.Experiment(ltl.Diffusion, small, small.vertices[:, 0])
    data = ltl.Observations([[1.0]], times=[0.1], operator=ltl.inverse.observe_patches(sphere, [[0]]))
    with pytest.raises(ValueError, match="The operator reads 162 vertices; the model predicts"):
        ltl.fit(model, 1.0, data)


def test_transforms_of_parameters_have_no_start_of_their_own():
    with pytest.raises(ValueError, match="Expected a transform without a start"):
        ltl.fit(
            curve,
            dict(size=1.0, rate=1.0, floor=0.1),
            ltl.Observations(spoiled()),
            transforms=ltl.inverse.Positive(2.0),
        )


def rows(name, case_file, mesh):
    """u and v of a file of the shared cases, in the order of the mesh."""
    table = np.genfromtxt(case_file(name), delimiter=",", names=True)
    state = np.empty((mesh.num_vertices, 2))
    state[mesh.source_order] = np.stack([table["u"], table["v"]], axis=1)
    return state


@pytest.fixture
def spot(real_mesh, case_file):
    mesh = ltl.load_mesh(real_mesh("spot_low.obj"))
    u0 = jnp.asarray(rows("schnakenberg_start.csv", case_file, mesh))
    model = ltl.inverse.Experiment(
        lambda p: ltl.ReactionDiffusion((0.02, p["dv"]), ltl.kinetics.schnakenberg(p["a"], p["b"], rate=10.0)),
        # The operator that made the data.
        ltl.Surface.from_mesh(mesh, ltl.Monotone(lift="chord")), u0,
    )  # fmt: skip
    return model, lambda name: rows(name, case_file, mesh)


@pytest.mark.filterwarnings("ignore::ltljax.errors.InconsistentRowsWarning")
def test_the_shared_cases_give_the_rates(spot):
    model, read = spot
    clean = np.stack([read(f"schnakenberg_{k}.csv") for k in range(3)])
    assert holds(fitted(model, clean)).all()
    with_gaps, wrong = clean.copy(), clean.copy()
    with_gaps[1], wrong[1] = read("schnakenberg_1_missing.csv"), read("schnakenberg_1_outliers.csv")
    assert holds(fitted(model, with_gaps)).all()
    robust = fitted(model, wrong, loss="huber")
    assert holds(robust).all()
    assert robust.converged
    named = {tuple(index) for index in robust.agreement.outliers}
    assert named == {tuple(index) for index in np.argwhere(np.abs(wrong - clean) > 1)}
    assert np.sum(np.abs(wrong - clean) > 1) == 25
    scaled = fitted(model, 2.9 * clean, scale=ltl.inverse.Positive(1.0))
    assert holds(scaled).all()
    np.testing.assert_allclose(scaled.calibration["scale"], 2.9, rtol=2e-3)
    # A few steps are enough to see it.
    data = ltl.Observations(2.9 * clean, times=TIMES)
    lost = ltl.fit(model, START, data, transforms=ltl.inverse.Positive(), max_steps=10)
    assert lost.summary().startswith("The model explains nothing")


SCENARIO = """
[mesh]
shape = "sphere"
subdivisions = 2
[kinetics]
name = "schnakenberg"
a = 0.12
b = 0.85
rate = 10
[diffusivity]
u = 0.02
v = 0.25
[initial]
u = "0.97 + 0.3*sin(5*x)*cos(4*y)"
v = "0.9 - 0.3*sin(6*z)"
[time]
end = 0.9
frames = 1
[fit]
free = ["kinetics.a", "kinetics.b", "diffusivity.v"]
OPTIONS
[[fit.data]]
file = "early.csv"
time = 0.3
[[fit.data]]
file = "late.csv"
"""


def in_files(folder, places, states, spoil):
    """Two files of data with columns that say where."""
    chance = np.random.default_rng(0)
    for name, state in zip(("early", "late"), states, strict=True):
        values = spoil(state + NOISE * chance.normal(size=state.shape), chance)
        head = ",".join([*places, "u", "v"])
        lines = [
            ",".join("" if np.isnan(x) else f"{x:.9g}" for x in row)
            for row in np.column_stack([*places.values(), values])
        ]
        (folder / f"{name}.csv").write_text("\n".join([head, *lines]) + "\n")


def as_is(values, chance):
    return values


def off(values, chance):
    share = chance.random(values.shape)
    return np.where(share < 0.3, np.nan, np.where(share < 0.35, values + 20, values))


@pytest.mark.parametrize(
    ("options", "where", "spoil"),
    [
        ("scale = true\noffset = 0", "vertices", as_is),
        ("noise = 0.01\nrelative_noise = 0.001", "points", as_is),
        ('patches = "patches.csv"', "patches", as_is),
        ('operator = "weights.npz"\nbackground = "dark.csv"', "sums", as_is),
    ],
    ids=["calibration", "points", "patches", "operator and background"],
)
def test_a_scenario_file_fits_data_as_they_are_measured(tmp_path, options, where, spoil):
    from ltljax.app import scenario

    text = SCENARIO.replace("OPTIONS", options)
    example = scenario.read(text.split("[fit]")[0], "mine", tmp_path)
    surface = ltl.Surface.from_mesh(example.mesh)
    states = np.asarray(ltl.solve(example.make_equation(surface), surface, example.u0, 0.9, ts=[0.3, 0.9]).us)
    order = np.asarray(example.mesh.source_order)
    if where == "points":
        points = np.asarray(ltl.shapes.icosphere(3).vertices)[::2]
        states = np.asarray(ltl.inverse.observe_at(surface, points)(states, axis=1))
        in_files(tmp_path, dict(zip("xyz", points.T, strict=True)), states, spoil)
    elif where == "patches":
        numbers = (8 * (np.arctan2(*np.asarray(surface.vertices)[:, :2].T) / np.pi + 1)).astype(int) % 16
        states = np.asarray(ltl.inverse.observe_patches(surface, numbers)(states, axis=1))
        (tmp_path / "patches.csv").write_text("patch\n" + "\n".join(map(str, numbers[order])) + "\n")
        in_files(tmp_path, dict(patch=np.arange(16)), states, spoil)
    elif where == "sums":
        weights = np.random.default_rng(3).normal(size=(150, surface.num_vertices))
        np.savez(tmp_path / "weights.npz", weights=weights[:, order])
        dark = 1 + np.arange(150) % 3
        head = "u,v\n" + "\n".join(f"{x},{x}" for x in dark) + "\n"
        (tmp_path / "dark.csv").write_text(head)
        in_files(tmp_path, {}, np.einsum("nv,tvs->tns", weights, states) + 0.2 * dark[:, None], spoil)
    else:
        in_files(tmp_path, {}, states[:, order], spoil)
    (tmp_path / "mine.toml").write_text(text)
    changes = ["--set", "kinetics.a=0.2", "--set", "diffusivity.v=0.4"]
    assert main(["fit", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "out"), *changes]) == 0
    record = json.loads((tmp_path / "out" / "fit.json").read_text())
    assert record["status"] == "converged", record
    assert record["explanation"].startswith("The model explains the data")
    truth = {"kinetics.a": 0.12, "kinetics.b": 0.85, "diffusivity.v": 0.25}
    std = record["std"]
    assert all(abs(record["found"][key] - truth[key]) < 3 * std[key] for key in truth)
    assert len(record["agreement"]["outliers"]) < 3


def test_new_fit_prints_a_scenario_that_is_fitted(tmp_path, capsys):
    from ltljax.app import scenario

    assert main(["new", "fit"]) == 0
    text = capsys.readouterr().out.replace("subdivisions = 3", "subdivisions = 2")
    example = scenario.read(text.split("[fit]")[0], "mine", tmp_path)
    surface = ltl.Surface.from_mesh(example.mesh)
    states = np.asarray(ltl.solve(example.make_equation(surface), surface, example.u0, 0.9, ts=[0.3, 0.9]).us)
    in_files(tmp_path, {}, states[:, np.asarray(example.mesh.source_order)], off)
    (tmp_path / "my.toml").write_text(text)
    assert main(["fit", str(tmp_path / "my.toml"), "--out", str(tmp_path / "out"), "--set", "kinetics.a=0.2"]) == 0
    assert json.loads((tmp_path / "out" / "fit.json").read_text())["status"] == "converged"
    assert (tmp_path / "out" / "fit.png").exists()


def test_the_picture_shows_where_the_loss_is_not_quadratic():
    plt = pytest.importorskip("matplotlib.pyplot")
    early = np.linspace(0, 0.5, 12)
    model = lambda p: p["size"] * (1 - jnp.exp(-p["rate"] * early))  # noqa: E731
    values = 2 * (1 - np.exp(-early)) + 0.03 * np.random.default_rng(1).normal(size=12)
    fit = ltl.fit(model, dict(size=2.0, rate=1.0), ltl.Observations(values, 0.03), transforms=ltl.inverse.Positive())
    steps = np.array([-2.0, 0.0, 2.0])
    rise = fit.losses_along("rate", steps) - fit.loss
    assert rise[1] == pytest.approx(0, abs=1e-9)
    assert np.abs(rise[[0, 2]] / 2 - 1).max() > 0.5
    figure = fit.plot()
    assert "not quadratic" in [axes.get_title() for axes in figure.axes]
    plt.close(figure)
    linear = ltl.fit(lambda p: p * jnp.asarray(early), 1.0, ltl.Observations(early, 0.1))
    np.testing.assert_allclose(
        linear.losses_along("parameter", steps) - linear.loss, steps**2 / 2, rtol=1e-6, atol=1e-9
    )
    with pytest.raises(ValueError, match="There is no parameter 'b'"):
        linear.losses_along("b", steps)


def test_the_picture_of_a_fit_shows_outliers(experiment, exact):
    plt = pytest.importorskip("matplotlib.pyplot")
    values, _ = with_outliers(noisy(exact, 0), 0)
    figure = fitted(experiment, values, loss="huber").plot()
    titles = [axes.get_title() for axes in figure.axes]
    assert "95 % intervals" in titles
    assert any("outliers are outside" in title for title in titles)
    plt.close(figure)
