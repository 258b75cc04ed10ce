"""Inverse problems: what is recovered, how well it is known, and what is said of data that cannot tell."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from jax.test_util import check_grads

import ltljax as ltl

TIMES = np.array([0.2, 0.4, 0.6])
TRUTH = dict(a=0.1, b=0.9, d=10.0)
AWAY = dict(a=0.13, b=0.7, d=7.0)
RANGES = dict(a=ltl.inverse.Positive(), d=ltl.inverse.Positive())


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(3))


def bumpy(surface, seed=0):
    """A smooth random field of size one."""
    rng = np.random.default_rng(seed)
    x = np.asarray(surface.vertices)
    return np.sin(x @ (6 * rng.normal(size=(3, 40))) + rng.uniform(0, 2 * np.pi, 40)).sum(axis=1) / np.sqrt(20)


def schnakenberg(surface, **how):
    """A Schnakenberg run whose rates a and b and diffusivity d are unknown."""
    u0 = np.array([1.0, 0.9]) + 0.1 * bumpy(surface)[:, None] * np.array([1.0, -1.0])
    return ltl.inverse.Experiment(
        lambda p: ltl.ReactionDiffusion((1.0, p["d"]), ltl.kinetics.schnakenberg(p["a"], p["b"], rate=30.0)),
        surface, u0, **how,
    )  # fmt: skip


def noisy(values, share, seed):
    level = share * float(values.std())
    return values + level * np.random.default_rng(seed).normal(size=values.shape), level


@pytest.fixture(scope="module")
def rates(sphere):
    experiment = schnakenberg(sphere)
    return experiment, experiment(TRUTH, TIMES).us


def relative(found, truth):
    return max(abs(float(found[key]) / truth[key] - 1) for key in truth)


@pytest.mark.parametrize(
    "method",
    [
        None,
        optx.Dogleg(1e-6, 1e-8),
        optx.LBFGS(1e-7, 1e-9),
        pytest.param(optx.BFGS(1e-7, 1e-9), marks=pytest.mark.slow),
    ],
    ids=lambda m: type(m).__name__,
)
def test_rates_are_recovered_from_clean_snapshots(rates, method):
    experiment, clean = rates
    start = AWAY if method is None else dict(a=0.11, b=0.85, d=9.0)
    found = ltl.fit(experiment, start, ltl.Observations(clean, times=TIMES), transforms=RANGES, method=method)
    assert found.converged
    assert relative(found.params, TRUTH) < 1e-3
    assert found.losses[-1] < 1e-4 * found.losses[0]


def test_an_optimiser_of_optax_serves_as_method(rates):
    experiment, clean = rates
    values, level = noisy(np.asarray(clean), 0.01, 0)
    start = {key: 1.02 * value for key, value in TRUTH.items()}
    data = ltl.Observations(values, level, TIMES)
    with jax.numpy_dtype_promotion("standard"):  # which optax counts on
        found = ltl.fit(
            experiment, start, data, transforms=ltl.inverse.Positive(), method=optax.adam(5e-3), max_steps=60
        )
    assert found.method.startswith("optax")
    assert found.loss < 0.01 * found.losses[0]
    assert relative(found.params, TRUTH) < 0.01


def test_intervals_hold_what_noise_hides_and_the_noise_is_estimated(rates):
    experiment, clean = rates
    inside, spreads = 0, []
    for seed in range(5):
        values, level = noisy(clean, 0.01, seed)
        found = ltl.fit(experiment, AWAY, ltl.Observations(values, level, TIMES), transforms=RANGES)
        low, high = found.intervals
        inside += sum(bool(low[key] < TRUTH[key] < high[key]) for key in TRUTH)
        assert relative(found.params, TRUTH) < 0.03
        spreads.append(found.evidence.noise)
        unknown = ltl.fit(experiment, found.params, ltl.Observations(values, times=TIMES), transforms=RANGES)
        assert unknown.evidence.noise == pytest.approx(level, rel=0.05)
        np.testing.assert_allclose(unknown.evidence.std, found.evidence.std, rtol=0.05)
    assert inside >= 13  # of 15, with 14.25 expected
    assert np.mean(spreads) == pytest.approx(1, abs=0.05)


def test_the_covariance_is_that_of_repeated_experiments(sphere):
    """A linear model, for which theory is exact."""
    x = np.asarray(sphere.vertices)
    model = lambda p: p["c"] @ jnp.asarray(x.T) + p["k"] * jnp.asarray(x[:, 0] * x[:, 1])  # noqa: E731
    truth = dict(c=np.array([1.0, -2.0, 0.5]), k=0.3)
    clean = np.asarray(model(truth))
    start = dict(c=np.ones(3), k=1.0)
    data = ltl.Observations(clean, 0.1)
    found = ltl.fit(model, start, data)
    design = np.concatenate([x, (x[:, 0] * x[:, 1])[:, None]], axis=1)
    np.testing.assert_allclose(found.covariance, 0.01 * np.linalg.inv(design.T @ design), rtol=1e-6, atol=1e-12)
    # Repeated with other noise, all at once.
    values = clean + 0.1 * np.random.default_rng(0).normal(size=(400, len(clean)))
    many = ltl.inverse.fit_many(model, start, data, values=values)
    assert many.converged.all()
    spread = np.concatenate([many.params["c"], many.params["k"][:, None]], axis=1).std(axis=0)
    np.testing.assert_allclose(spread, found.evidence.std, rtol=0.15)


def test_what_data_cannot_tell_is_named(sphere):
    u0 = np.array([1.0, 0.9]) + 0.1 * bumpy(sphere)[:, None] * np.array([1.0, -1.0])

    def model(p, adjoint=None):
        kinetics = ltl.kinetics.schnakenberg(0.1, 0.9, rate=p["rate"])
        equation = ltl.ReactionDiffusion((p["spread"], 10 * p["spread"]), kinetics)
        return ltl.solve(equation, sphere, u0, p["time"], adjoint=adjoint, throw=False).u_end

    truth = dict(rate=30.0, spread=1.0, time=0.3)
    values, level = noisy(model(jax.tree.map(jnp.asarray, truth)), 0.01, 0)
    start = dict(rate=27.0, spread=1.1, time=0.32)
    found = ltl.fit(model, start, ltl.Observations(values, level), transforms=ltl.inverse.Positive())
    # All rates times s and the time over s is the same run.
    [said] = found.evidence.cannot_tell
    for part in ("rate +10 %", "spread +10 %", "time -10 %", "not seen at all"):
        assert part in said
    assert said in found.summary()
    assert float(found.params["rate"] * found.params["time"]) == pytest.approx(9.0, rel=0.01)
    # With the time known nothing is in doubt.
    known = ltl.fit(
        lambda p, adjoint=None: model({**p, "time": jnp.array(0.3)}, adjoint),
        dict(rate=27.0, spread=1.1), ltl.Observations(values, level), transforms=ltl.inverse.Positive(),
    )  # fmt: skip
    assert not known.evidence.cannot_tell
    assert "determine every parameter" in known.summary()


def test_a_model_that_does_not_explain_the_data_is_said_not_to():
    x = np.linspace(0, 1, 50)
    found = ltl.fit(lambda p: p["slope"] * x, dict(slope=1.0), ltl.Observations(x**2 + 1, 0.01))
    assert "does not explain the data" in found.summary()
    assert "determine every parameter" not in found.summary()


def test_what_shows_by_the_length_of_steps_alone_is_no_information(sphere):
    """A uniform mixture says nothing of diffusion, though the first step is as long as diffusion allows.

    Derivatives see that length, so the singular value of d is not zero; it is below what adaptive steps may err by.
    """
    u0 = np.array([1.5, 0.5]) + 0 * bumpy(sphere)[:, None]
    experiment = ltl.inverse.Experiment(schnakenberg(sphere).equation, sphere, u0)
    data = ltl.Observations(experiment(TRUTH, TIMES).us, 1e-3, TIMES)
    found = ltl.fit(experiment, AWAY, data, transforms=ltl.inverse.Positive())
    assert found.singular_values[-1] < 1e-3 * found.singular_values[0]
    assert "d alone" in found.summary()
    [said] = found.evidence.cannot_tell
    assert "not seen at all" in said or "less than the errors that adaptive steps may have" in said


def test_what_is_small_but_well_known_is_said_to_be_known():
    """A model without steps errs by rounding alone, so the least effect of a parameter is seen."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(10_000, 2))
    data = ltl.Observations(x @ [1000.0, 0.003] + 0.01 * rng.normal(size=len(x)), 0.01)
    found = ltl.fit(lambda p: p["big"] * x[:, 0] + p["small"] * x[:, 1], dict(big=900.0, small=0.002), data)
    assert not found.evidence.cannot_tell
    assert "determine every parameter" in found.summary()
    # Damping that suits the large one does not end the fit before the small one has moved.
    best = np.linalg.lstsq(x, np.asarray(data.values))[0]
    np.testing.assert_allclose([found.params["big"], found.params["small"]], best, rtol=1e-4)
    assert found.evidence.std[1] == pytest.approx(1e-4, rel=0.05)


def test_a_small_effect_of_adaptive_steps_is_not_safely_told(sphere):
    """The noise would let it be known; the errors of the steps do not."""
    u0 = np.array([1.0, 0.9]) + 0.1 * bumpy(sphere)[:, None] * np.array([1.0, -1.0])

    def model(p, adjoint=None):
        equation = ltl.ReactionDiffusion((1.0, 10.0), ltl.kinetics.schnakenberg(p["a"], 0.9, rate=30.0))
        u = ltl.solve(equation, sphere, u0, 0.05, adjoint=adjoint, throw=False).u_end
        return u + 1e-4 * p["small"]

    data = ltl.Observations(model(dict(a=jnp.array(0.1), small=jnp.array(1.0))), 1e-6)
    [said] = ltl.fit(model, dict(a=0.11, small=0.9), data).evidence.cannot_tell
    assert "do not safely tell" in said
    assert "less than the errors that adaptive steps may have" in said
    assert "not seen" not in said


def test_as_many_values_as_unknowns_without_noise_have_no_error_bars():
    model = lambda p: jnp.stack([p["a"] + p["b"], p["a"] - p["b"]])  # noqa: E731
    found = ltl.fit(model, dict(a=1.0, b=1.0), ltl.Observations([1.0, 2.0]))
    assert np.isnan(found.evidence.std).all()
    assert "There are no error bars: 2 values for 2 unknowns" in found.summary()
    assert "determine every parameter" not in found.summary()
    known = ltl.fit(model, dict(a=1.0, b=1.0), ltl.Observations([1.0, 2.0], 0.1))
    np.testing.assert_allclose(known.evidence.std, 0.1 / np.sqrt(2), rtol=1e-6)
    assert "determine every parameter" in known.summary()


def test_noise_is_estimated_from_the_data_not_from_the_penalty():
    rng = np.random.default_rng(0)
    design = rng.normal(size=(50, 30))
    rows = np.concatenate([3 * np.eye(30), np.zeros((500, 30))])
    values = design @ rng.normal(size=30) + 0.1 * rng.normal(size=50)
    found = ltl.fit(
        lambda p: jnp.asarray(design) @ p,
        np.zeros(30),
        ltl.Observations(values),
        penalty=lambda p: jnp.asarray(rows) @ p,
    )
    inverse = np.linalg.inv(design.T @ design + rows.T @ rows)
    best = inverse @ design.T @ values
    # Degrees of freedom: the trace of the matrix that makes predictions of values.
    free = 50 - np.trace(design @ inverse @ design.T)
    noise = np.sqrt(np.sum((values - design @ best) ** 2) / free)
    np.testing.assert_allclose(found.params, best, atol=1e-4)
    assert found.evidence.noise == pytest.approx(noise, rel=1e-4)
    np.testing.assert_allclose(found.covariance, noise**2 * inverse, rtol=1e-3, atol=1e-9)


def test_a_profile_is_least_at_the_optimum_and_ends_the_interval(rates):
    experiment, clean = rates
    values, level = noisy(clean, 0.02, 1)
    found = ltl.fit(experiment, AWAY, ltl.Observations(values, level, TIMES), transforms=RANGES)
    index = found.evidence.names.index("d")
    d, std = found.evidence.values[index], found.evidence.std[index]
    losses = found.profile("d", d + std * np.array([-1.96, 0.0, 1.96]))
    assert losses[1] == pytest.approx(found.loss, rel=1e-6)
    # Half of chi-squared: 1.92 above the least.
    np.testing.assert_allclose(losses[[0, 2]] - losses[1], 1.92, rtol=0.1)
    with pytest.raises(ValueError, match="no parameter 'e'; there are a, b, d"):
        found.profile("e", [1.0])


def test_many_starts_run_at_once_and_find_the_same(rates):
    experiment, clean = rates
    rng = np.random.default_rng(0)
    starts = {key: value * (1 + 0.15 * rng.uniform(-1, 1, 4)) for key, value in TRUTH.items()}
    seen = np.arange(0, 642, 5)
    data = ltl.Observations(clean[:, seen], times=TIMES, vertices=seen)
    many = ltl.inverse.fit_many(experiment, starts, data, transforms=RANGES)
    assert many.losses.shape == (4,)
    for k in range(4):
        assert relative({key: leaf[k] for key, leaf in many.params.items()}, TRUTH) < 1e-3
    assert relative(many.best, TRUTH) < 1e-3


def test_a_search_begins_where_the_loss_has_many_valleys():
    # sin(k x) seen along a line: the loss has a valley every few tenths of k.
    x = np.linspace(0, 10, 200)
    model = lambda p: jnp.sin(p["k"] * x)  # noqa: E731
    data = ltl.Observations(np.sin(2.7 * x), 0.1)
    alone = ltl.fit(model, dict(k=5.0), data)
    assert abs(float(alone.params["k"]) - 2.7) > 0.1
    starts, losses = ltl.inverse.explore(model, dict(k=0.5), dict(k=8.0), data, count=64)
    assert losses[0] == losses.min()
    assert starts["k"].shape == (8,)
    assert ltl.inverse.fit_many(model, starts, data).best["k"] == pytest.approx(2.7, abs=1e-4)


def test_rates_are_found_from_statistics_of_a_pattern(sphere):
    """Where its spots are cannot be known, so the statistics of another run, of another start, are matched."""
    surface, mass = sphere, sphere.mass

    def statistics(p, seed=1, adjoint=None):
        u0 = np.array([1.0, 0.9]) + 0.1 * bumpy(surface, seed)[:, None] * np.array([1.0, -1.0])
        equation = ltl.ReactionDiffusion((1.0, 10.0), ltl.kinetics.schnakenberg(p["a"], p["b"], rate=60.0))
        u = ltl.solve(equation, surface, u0, 2.0, adjoint=adjoint, throw=False).u_end
        return ltl.inverse.pattern_statistics(surface, u[:, 0], mass).vector[:3]

    truth = dict(a=0.1, b=0.9)
    seen = np.mean([statistics(truth, seed) for seed in range(2, 8)], axis=0)
    spread = np.std([statistics(truth, seed) for seed in range(2, 8)], axis=0)
    start = dict(a=0.13, b=0.8)
    found = ltl.fit(statistics, start, ltl.Observations(seen, spread), transforms=ltl.inverse.Positive())
    assert relative(found.params, truth) < 0.1
    low, high = found.intervals
    assert all(low[key] < truth[key] < high[key] for key in truth)


def test_a_histogram_is_the_coverage_between_levels(sphere):
    u, mass = sphere.vertices[:, 2], sphere.mass
    found = ltl.inverse.pattern_statistics(sphere, u, mass, levels=[-0.5, 0.0, 0.5], softness=0.02)
    # Heights on a sphere are distributed evenly (Archimedes).
    np.testing.assert_allclose(found.histogram, [0.25, 0.25, 0.25, 0.25], atol=0.02)
    assert float(found.histogram.sum()) == pytest.approx(1)
    assert found.vector.shape == (7,)


def test_the_statistics_tell_spots_from_holes_and_are_differentiable(sphere):
    x, mass = sphere.vertices, sphere.mass
    spots = jnp.exp(8 * (x[:, 2] - 1))
    found = ltl.inverse.pattern_statistics(sphere, spots, mass, levels=[0.1, 0.5])
    assert found.skewness > 1
    assert ltl.inverse.pattern_statistics(sphere, -spots, mass).skewness < -1
    # The share of a cap: (1 - cos) / 2.
    np.testing.assert_allclose(found.coverage, [np.log(10) / 16, np.log(2) / 16], rtol=0.1)
    first = ltl.inverse.pattern_statistics(sphere, x[:, 0], mass)
    assert first.wavelength == pytest.approx(2 * np.pi / np.sqrt(2), rel=0.01)
    assert first.deviation == pytest.approx(np.sqrt(1 / 3), rel=0.01)
    check_grads(
        lambda u: ltl.inverse.pattern_statistics(sphere, u, mass, levels=[0.1]).vector,
        (spots,),
        order=1,
        modes=["fwd", "rev"],
    )


def test_a_source_of_two_bumps_is_found_from_a_noisy_stationary_state(sphere):
    x = np.asarray(sphere.vertices)
    centres = np.array([[1.0, 0, 0], [-0.6, 0.8, 0]])
    truth = sum(np.exp(-((x - c) ** 2).sum(axis=1) / 0.2) for c in centres)
    values, level = noisy(ltl.screened_poisson(sphere, truth, 1.0), 0.01, 0)
    data, mass = ltl.Observations(values, level), sphere.mass

    def with_weight(weight, start):
        return ltl.fit(
            lambda p: ltl.screened_poisson(sphere, p["source"], 1.0),
            dict(source=np.zeros(len(x))) if start is None else start, data,
            penalty=lambda p: ltl.inverse.smoothness(sphere, p["source"], weight, mass), max_steps=400,
        )  # fmt: skip

    weight, found, curve = ltl.inverse.choose_weight(with_weight, [1000.0, 300.0, 100.0, 30.0, 10.0, 3.0])
    assert "L-BFGS" in found.method
    source = np.asarray(found.params["source"])
    assert np.linalg.norm(source - truth) < 0.15 * np.linalg.norm(truth)
    # Misfit falls and roughness grows as the weight falls; the chosen one's misfit is what noise explains.
    assert (np.diff(curve[:, 1]) < 0).all()
    assert curve[-1, 1] <= values.size
    assert weight == curve[-1, 0]


def test_a_discrepancy_that_no_weight_reaches_is_said_to_be_missed():
    x = jnp.linspace(0.0, 1.0, 20)

    def with_weight(weight, start):
        del start
        return ltl.fit(lambda p: p * x, 1.0, ltl.Observations(x**2 + 1, 0.01), penalty=lambda p: weight * p)

    with pytest.warns(UserWarning, match="No weight down to 0.1 explains the data"):
        weight, _, _ = ltl.inverse.choose_weight(with_weight, [1.0, 0.1])
    assert weight == 0.1


@pytest.mark.slow
def test_the_l_curve_bends_at_a_good_weight():
    rng = np.random.default_rng(0)
    t = np.linspace(0, 1, 60)
    blur = np.exp(-((t[:, None] - t) ** 2) / 0.01)
    blur /= blur.sum(axis=1, keepdims=True)
    truth = np.sin(2 * np.pi * t)
    values = blur @ truth + 0.01 * rng.normal(size=60)

    def with_weight(weight, start):
        return ltl.fit(
            lambda p: jnp.asarray(blur) @ p, np.zeros(60) if start is None else start, ltl.Observations(values, 0.01),
            penalty=lambda p: jnp.sqrt(weight) * jnp.diff(p), method=optx.LevenbergMarquardt(1e-6, 1e-8),
        )  # fmt: skip

    weights = np.geomspace(1e-4, 1e6, 11)
    errors = [np.linalg.norm(with_weight(w, None).params - truth) for w in weights]
    chosen, found, _ = ltl.inverse.choose_weight(with_weight, weights, rule="l-curve")
    assert chosen in weights
    assert np.linalg.norm(found.params - truth) < 3 * min(errors)
    with pytest.raises(ValueError, match="'discrepancy' or 'l-curve'"):
        ltl.inverse.choose_weight(with_weight, weights, rule="gcv")


def test_total_variation_keeps_a_step_that_smoothness_blurs(sphere):
    x = np.asarray(sphere.vertices)
    truth = np.where(x[:, 2] > 0, 1.0, 0.0)
    values = truth + 0.2 * np.random.default_rng(0).normal(size=len(x))
    data, mass = ltl.Observations(values, 0.2), sphere.mass

    def denoised(penalty):
        found = ltl.fit(lambda p: p, values, data, penalty=penalty, max_steps=300)
        return np.linalg.norm(found.params - truth)

    sharp = min(denoised(lambda p, w=w: ltl.inverse.total_variation(sphere, p, w, mass=mass)) for w in (100.0, 300.0))
    smooth = min(denoised(lambda p, w=w: ltl.inverse.smoothness(sphere, p, w, mass)) for w in (3.0, 10.0, 30.0))
    assert sharp < 0.75 * smooth


def test_an_initial_state_is_found_from_a_later_noisy_one(sphere):
    x = np.asarray(sphere.vertices)
    truth = x[:, 0] + 0.5 * x[:, 1] * x[:, 2]
    experiment = ltl.inverse.Experiment(
        lambda p: ltl.Diffusion(), sphere, lambda p: p, t1=0.05, dt=0.01, solver=ltl.TRBDF2()
    )
    values, level = noisy(experiment(truth).u_end, 0.02, 0)

    def with_weight(weight, start):
        return ltl.fit(
            experiment, np.zeros(len(x)) if start is None else start, ltl.Observations(values, level),
            penalty=lambda p: ltl.inverse.smoothness(sphere, p, weight, order=2), max_steps=150,
        )  # fmt: skip

    _, found, _ = ltl.inverse.choose_weight(with_weight, [1000.0, 100.0, 10.0, 1.0])
    assert "reverse mode with checkpoints" in found.method
    assert np.linalg.norm(found.params - truth) < 0.05 * np.linalg.norm(truth)
    with pytest.raises(ValueError, match="order 1"):
        ltl.inverse.smoothness(sphere, truth, order=3)


def test_boundary_data_are_found_inside():
    surface = ltl.Surface.from_mesh(ltl.shapes.disk(rings=12))
    angle = np.arctan2(*np.asarray(surface.vertices)[:, 1::-1].T)

    def model(p):
        edge = p["c"] * jnp.cos(angle) + p["s"] * jnp.sin(2 * angle) + p["mean"]
        return ltl.poisson(surface, jnp.zeros(len(angle)), boundary=ltl.Dirichlet(edge))

    truth = dict(c=1.0, s=-0.5, mean=0.2)
    values, level = noisy(model(truth), 0.01, 0)
    inner = np.linalg.norm(np.asarray(surface.vertices), axis=1) < 0.5
    data = ltl.Observations(np.asarray(values)[inner], level, vertices=inner)
    found = ltl.fit(model, dict(c=0.5, s=0.1, mean=0.1), data)
    low, high = found.intervals
    for key, value in truth.items():
        assert low[key] < value < high[key]
        assert float(found.params[key]) == pytest.approx(value, abs=0.1)


def test_a_shape_is_found_by_an_eigenvalue(sphere):
    x = sphere.vertices

    def model(p):
        moved = sphere.with_vertices(x * jnp.exp(p["stretch"] * jnp.array([[0.0, 0.0, 1.0]])))
        # The eigenvalue of the odd function along z, by its Rayleigh quotient after some steps of heat flow.
        u = ltl.solve(ltl.Diffusion(), moved, x[:, 2], 1.0, throw=False, adjoint=diffrax.ForwardMode()).u_end
        return -jnp.vdot(u, ltl.laplacian(moved, u)) / jnp.vdot(u, u)

    found = ltl.fit(model, dict(stretch=0.05), ltl.Observations(1.4))
    assert float(model(found.params)) == pytest.approx(1.4, abs=1e-4)
    assert float(found.params["stretch"]) > 0.1  # longer, so slower


LEAST_SQUARES = [optx.LevenbergMarquardt(1e-6, 1e-8), optx.Dogleg(1e-6, 1e-8), optx.GaussNewton(1e-6, 1e-8)]
METHODS = [*LEAST_SQUARES, optx.BFGS(1e-6, 1e-8), optx.LBFGS(1e-6, 1e-8)]


@pytest.fixture(scope="module")
def explosive():
    """u = 1 / (1 - r t), which ends at r = 1; what r = 0.9 gives, and the rates at which it was run."""
    surface, tried = ltl.Surface.from_mesh(ltl.shapes.icosphere(1)), []

    def model(p, adjoint=None):
        jax.debug.callback(lambda r: tried.append(float(r)), p["r"])
        kinetics = ltl.kinetics.Kinetics(lambda u, q: (q["r"] * u[0] ** 2,), dict(r=p["r"]))
        equation = ltl.ReactionDiffusion((1.0,), kinetics)
        u0 = jnp.ones((surface.num_vertices, 1))
        return ltl.solve(equation, surface, u0, 1.0, adjoint=adjoint, throw=False, max_steps=300)

    clean = model(dict(r=jnp.array(0.9))).u_end
    np.testing.assert_allclose(clean, 1 / (1 - 0.9), rtol=0.05)
    return model, ltl.Observations(clean), tried


@pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)
def test_a_diverging_trial_step_is_rejected(explosive, method):
    """From far off the first step would overflow the reaction."""
    model, data, tried = explosive
    tried.clear()
    found = ltl.fit(model, dict(r=0.1), data, method=method)
    jax.effects_barrier()
    assert max(tried) > 1
    assert np.isfinite(found.losses).all()
    assert (np.diff(found.losses) <= 0).all()
    assert found.converged
    assert float(found.params["r"]) == pytest.approx(0.9, abs=1e-3)


def test_a_start_that_fails_is_said_to(explosive):
    model, data, _ = explosive
    with pytest.raises(ltl.errors.FitError, match="fails at the start"):
        ltl.fit(model, dict(r=2.0), data)
    with pytest.raises(ltl.errors.FitError, match="no finite derivatives"):
        ltl.fit(lambda p: jnp.sqrt(p) * jnp.ones(3), 0.0, ltl.Observations(np.ones(3)))
    many = ltl.inverse.fit_many(model, dict(r=np.array([0.1, 2.0])), data)
    assert many.converged.tolist() == [True, False]
    assert np.isfinite(many.losses).tolist() == [True, False]
    assert float(many.best["r"]) == pytest.approx(0.9, abs=1e-3)


@pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)
def test_a_fit_that_only_fails_from_where_it_is_has_not_converged(method):
    model = lambda p: jnp.where(p <= 0.5, p, jnp.nan) * jnp.ones(5)  # noqa: E731
    found = ltl.fit(model, 0.5, ltl.Observations(np.full(5, 10.0)), method=method)
    assert not found.converged
    assert "the model fails at every step from here" in found.reason
    assert float(found.params) == 0.5


@pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)
def test_a_model_that_does_not_answer_is_fitted_to_nothing(method):
    found = ltl.fit(lambda p: 0 * p + jnp.arange(5.0), 2.0, ltl.Observations(np.arange(5.0) + 0.05, 0.1), method=method)
    assert float(found.params) == 2.0
    assert found.loss == pytest.approx(0.5 * 5 * 0.25)
    if method in LEAST_SQUARES:
        assert "not seen at all" in found.summary()


def test_large_residuals_are_no_failure():
    x = np.linspace(1.0, 2.0, 20)
    found = ltl.fit(lambda p: p * jnp.asarray(x), 1e12, ltl.Observations(2 * x, 1e-3), atol=0.0)
    assert found.converged
    assert float(found.params) == pytest.approx(2.0)


def test_runs_of_the_model_are_counted(explosive):
    model, data, tried = explosive
    tried.clear()
    found = ltl.fit(model, dict(r=0.5), data)
    jax.effects_barrier()
    assert len(tried) == found.num_runs == found.num_steps + 2
    assert f"{found.num_runs} runs of the model" in found.summary()


def test_steps_of_optax_end_where_the_model_fails():
    x = jnp.linspace(1.0, 2.0, 20)
    data = ltl.Observations(2 * x, 0.1)
    with jax.numpy_dtype_promotion("standard"):  # which optax counts on
        found = ltl.fit(lambda p: jnp.where(p < 1.5, p, jnp.nan) * x, 1.0, data, method=optax.adam(0.1))
    assert not found.converged
    assert "the model fails where the optimiser went" in found.reason
    assert 1.3 < float(found.params) < 1.5
    # The loss is that of the parameters returned.
    assert found.loss == pytest.approx(0.5 * np.sum(found.residuals**2))


def test_a_fit_goes_on_where_it_was_left(rates, tmp_path):
    experiment, clean = rates
    data, kept = ltl.Observations(clean, times=TIMES), tmp_path / "fit.npz"
    first = ltl.fit(experiment, AWAY, data, transforms=RANGES, max_steps=4, checkpoint=kept)
    assert not first.converged
    assert "4 steps" in first.reason
    second = ltl.fit(experiment, AWAY, data, transforms=RANGES, checkpoint=kept, resume=True)
    assert second.losses[0] == pytest.approx(first.loss, rel=1e-9)
    assert relative(second.params, TRUTH) < 1e-3
    with pytest.raises(ValueError, match="another fit"):
        ltl.fit(lambda p: p * data.values, 1.0, data, checkpoint=kept, resume=True)


def test_a_fit_goes_on_from_what_was_kept_whatever_the_start_and_refuses_what_another_left(tmp_path):
    x, kept = jnp.linspace(0.0, 1.0, 20), tmp_path / "fit.npz"
    model = lambda p: p["a"] * x + p["b"] ** 2  # noqa: E731
    data = ltl.Observations(3 * x + 4, 0.1)
    first = ltl.fit(model, dict(a=1.0, b=1.0), data, checkpoint=kept)
    second = ltl.fit(model, dict(a=0.1, b=7.0), data, checkpoint=kept, resume=True)
    for key, value in first.params.items():
        assert float(second.params[key]) == pytest.approx(float(value), rel=1e-9)
    assert second.num_steps == 1
    start = dict(a=1.0, b=1.0)
    for other, message in (
        (dict(data=ltl.Observations(3 * x + 4, 0.2)), "its data differ"),
        (dict(transforms=ltl.inverse.Positive()), "its ranges of parameters differ"),
        (dict(model=lambda p: p["a"] * x + p["b"]), "its loss was"),
        (dict(penalty=lambda p: p["a"]), "its loss was"),
    ):
        with pytest.raises(ltl.errors.RestartError, match=f"holds another fit: {message}"):
            ltl.fit(**(dict(model=model, start=start, data=data, checkpoint=kept, resume=True) | other))
    kept.write_bytes(b"PK no zip")
    with pytest.raises(ltl.errors.RestartError, match="damaged"):
        ltl.fit(model, start, data, checkpoint=kept, resume=True)


def test_a_fit_stops_when_told_and_shows_its_progress(rates, capfd):
    experiment, clean = rates
    asked = []

    def stop(step, loss, params):
        asked.append((step, loss, float(params["a"])))
        return loss < 10

    found = ltl.fit(
        experiment, AWAY, ltl.Observations(clean, times=TIMES), transforms=RANGES, stop_when=stop, progress=True
    )
    assert found.reason == "stop_when held"
    assert asked[-1][1] == found.loss < 10
    assert "loss" in capfd.readouterr().err


BAD = {
    "infinity": (lambda x: ltl.Observations(np.where(np.arange(len(x)) == 7, np.inf, 1.0)), r"inf at index \(7,\)"),
    "noise": (lambda x: ltl.Observations(np.ones(3), 0.0), "positive noise"),
    "noise shape": (lambda x: ltl.Observations(np.ones(3), np.ones(2)), "does not fit values"),
    "noise of more": (lambda x: ltl.Observations(np.ones(3), np.ones((2, 3))), r"\(2, 3\) does not fit values \(3,\)"),
    "negative species": (lambda x: ltl.Observations(np.ones(3), species=-1), "from 0, found -1"),
    "times": (lambda x: ltl.Observations(np.ones((2, 3)), times=[1.0, 0.5]), "ascending times"),
    "number of times": (lambda x: ltl.Observations(np.ones((2, 3)), times=[1.0]), "values for 1 times"),
    "negative vertex": (lambda x: ltl.Observations(np.ones(1), vertices=[-1]), "from 0, found -1"),
    "no values": (lambda x: ltl.Observations([]), "at least one"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_data_are_refused_where_they_are_made(sphere, name):
    make, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        make(np.asarray(sphere.vertices))


def test_data_that_do_not_fit_the_model_are_refused(sphere, rates):
    experiment, clean = rates
    few = np.asarray(clean)[:, :3]
    for data, message in (
        (ltl.Observations(few, times=TIMES), "shape"),
        (ltl.Observations(few, times=TIMES, vertices=[1, 2, 642]), "Vertex 642"),
        (ltl.Observations(few[..., 0], times=TIMES, vertices=[1, 2, 3], species=2), "Species 2"),
        (ltl.Observations(few[0]), "end of the run"),
        (
            ltl.Observations(few, times=TIMES, vertices=np.arange(10) < 3),
            "a mask of the model's 642 vertices, found one of 10",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            ltl.fit(experiment, AWAY, data)
    with pytest.raises(ValueError, match="outside the run"):
        ltl.fit(schnakenberg(sphere, t1=0.5), AWAY, ltl.Observations(clean, times=TIMES))
    with pytest.raises(ValueError, match="at least as many values as unknowns"):
        ltl.fit(experiment, AWAY, ltl.Observations(few[:1, :2, 0], times=TIMES[:1], vertices=[0, 1], species=0))
    with pytest.raises(ValueError, match="a to be positive"):
        ltl.fit(experiment, {**AWAY, "a": -1.0}, ltl.Observations(clean, times=TIMES), transforms=RANGES)
    with pytest.raises(ValueError, match="no parameter 'c'"):
        ltl.fit(experiment, AWAY, ltl.Observations(clean, times=TIMES), transforms=dict(c=ltl.inverse.Positive()))
    with pytest.raises(ValueError, match="to be a float"):
        ltl.fit(experiment, {**AWAY, "a": 1}, ltl.Observations(clean, times=TIMES))
    with pytest.raises(ValueError, match=r"method of optimistix .* or an optimiser of optax, found 'lm'"):
        ltl.fit(experiment, AWAY, ltl.Observations(clean, times=TIMES), method="lm")
    with pytest.raises(ValueError, match="low < high"):
        ltl.inverse.Bounded(1.0, 1.0)
    with pytest.raises(ValueError, match="has only one"):
        ltl.fit(lambda p: p * bumpy(sphere), 1.0, ltl.Observations(bumpy(sphere), species=0))
    with pytest.raises(ValueError, match=r"inf at index \(0, 1\)"):
        ltl.inverse.fit_many(
            lambda p: p * jnp.ones(3), 1.0, ltl.Observations(np.ones(3)), values=np.where(np.eye(2, 3, 1), np.inf, 1.0)
        )
    # A model without an adjoint can be differentiated in reverse alone.
    reverse = lambda p: experiment(p, TIMES).us  # noqa: E731
    with pytest.raises(ValueError, match="take adjoint="):
        ltl.fit(reverse, AWAY, ltl.Observations(clean, times=TIMES))


def test_bounded_parameters_stay_between_their_bounds():
    x = np.linspace(0, 1, 20)
    found = ltl.fit(
        lambda p: p * jnp.asarray(x),
        0.5,
        ltl.Observations(2 * x, 0.1),
        transforms=ltl.inverse.Bounded(0.0, 1.0),
        max_steps=30,
    )
    assert 0.99 < float(found.params) <= 1


def test_a_parameter_that_ran_to_its_bound_is_said_to_have():
    x = jnp.linspace(0.0, 1.0, 20)
    found = ltl.fit(lambda p: p * x, 0.5, ltl.Observations(1.02 * x, 0.1), transforms=ltl.inverse.Bounded(0.0, 1.0))
    assert 1 - 1e-4 < float(found.params) <= 1
    assert "parameter has run to the end of its range" in found.summary()
    assert np.isfinite(found.evidence.singular_values).all()
    spent = ltl.fit(lambda p: p * x, 0.5, ltl.Observations(2 * x, 0.1), transforms=ltl.inverse.Bounded(0.0, 1.0))
    assert 1 - 1e-4 < float(spent.params) <= 1
    assert "has run to the end of its range" in spent.summary()
    inside = ltl.fit(lambda p: p * x, 0.5, ltl.Observations(0.9995 * x, 0.1), transforms=ltl.inverse.Bounded(0.0, 1.0))
    assert "determine every parameter" in inside.summary()


def test_a_right_gradient_passes_and_a_wrong_one_is_named(sphere):
    x = sphere.vertices[:, 0]

    def loss(d):
        return jnp.sum(ltl.solve(ltl.Diffusion(d), sphere, x, 0.1, dt=0.01, throw=False).u_end ** 2)

    right = ltl.inverse.check_gradient(loss, 1.0)
    assert right.passed
    assert right.slope == pytest.approx(2, abs=0.1)
    wrong = ltl.inverse.check_gradient(lambda d: loss(d) + loss(jax.lax.stop_gradient(d)), 1.0)
    assert not wrong.passed
    assert "wrong: slope 1.0" in str(wrong)
    assert "linear" in ltl.inverse.check_gradient(lambda p: 3 * p["a"].sum(), dict(a=np.arange(3.0))).verdict
    slightly = ltl.inverse.check_gradient(lambda p: jnp.sin(p) + 1e-3 * jax.lax.stop_gradient(p), 1.0)
    assert not slightly.passed
    assert "right to 0.2 %, no better" in slightly.verdict
    rounded = ltl.inverse.check_gradient(lambda p: jnp.sin(p) + 1e-4 * jnp.sin(1e7 * jax.lax.stop_gradient(p)), 1.0)
    assert "noisy" in rounded.verdict
    # In a session the table is what is shown.
    assert repr(wrong) == str(wrong)
    with pytest.raises(ValueError, match="one finite number"):
        ltl.inverse.check_gradient(lambda p: jnp.log(p), -1.0)


@pytest.mark.parametrize(
    "loss",
    [
        lambda p: 1e12 + jax.lax.stop_gradient(p),
        lambda p: jnp.float32(1) + jnp.float32(1e-4) * jax.lax.stop_gradient(p).astype(jnp.float32),
        lambda p: 0 * p,
    ],
    ids=["float64", "float32", "constant"],
)
def test_a_loss_that_does_not_answer_shows_no_gradient_to_be_right(loss):
    found = ltl.inverse.check_gradient(loss, 1.0)
    assert not found.passed
    assert "does not answer to steps of this size" in found.verdict


FAMILIES = {
    "explicit": (diffrax.Heun(), 0.01), "RKL2": (ltl.RKL2(), 0.05), "SBDF2": (ltl.SBDF2(), 0.05),
    "TRBDF2": (ltl.TRBDF2(), 0.1), "stationary": (None, None),
}  # fmt: skip
IN_FULL = {"explicit", "SBDF2", "TRBDF2"}


@pytest.mark.parametrize("name", [pytest.param(f, marks=[pytest.mark.slow] if f in IN_FULL else []) for f in FAMILIES])
def test_gradients_of_free_vertices_pass_taylors_test(name):
    surface, (solver, dt) = ltl.Surface.from_mesh(ltl.shapes.icosphere(1)), FAMILIES[name]
    x, hierarchy = surface.vertices, ltl.solvers.multigrid(surface)
    u0 = jnp.cos(2 * x[:, 0]) + x[:, 1]

    def loss(vertices):
        moved = surface.with_vertices(vertices)
        if solver is None:
            u = ltl.screened_poisson(moved, u0, 1.0, rtol=1e-12, preconditioner=hierarchy)
        else:
            u = ltl.solve(
                ltl.Diffusion(0.5), moved, u0, 0.2, solver=solver, dt=dt, rtol=1e-12, throw=False,
                preconditioner=hierarchy,
            ).u_end  # fmt: skip
        return jnp.sum(u**2 * jnp.cos(x[:, 2]))

    direction = 0.2 * np.random.default_rng(0).normal(size=x.shape)
    found = ltl.inverse.check_gradient(loss, x, direction)
    assert found.passed, found
    assert found.slope == pytest.approx(2, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [diffrax.Tsit5(), ltl.RKL2(), ltl.TRBDF2()], ids=lambda s: type(s).__name__)
def test_tangents_beside_adaptive_steps_pass_taylors_test(solver):
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1))
    x, hierarchy = surface.vertices, ltl.solvers.multigrid(surface)

    @jax.jit
    def loss(p):
        kinetics = ltl.kinetics.schnakenberg(p["rate"], 0.9, rate=10.0)
        end = ltl.solve(
            ltl.ReactionDiffusion((0.1, 1.0), kinetics), surface.with_vertices(p["vertices"]), p["start"], 0.1,
            solver=solver, adjoint=diffrax.ForwardMode(), rtol=1e-9, atol=1e-10, throw=False, preconditioner=hierarchy,
        ).u_end  # fmt: skip
        return jnp.sum(end**2 * jnp.cos(x[:, :2]))

    at = dict(rate=jnp.array(0.1), start=1 + 0.1 * x[:, :2], vertices=x)
    random = np.random.default_rng(0)
    tangent = jax.jit(lambda direction: jax.jvp(loss, (at,), (direction,)))
    for key, size in dict(rate=0.1, start=0.3, vertices=0.1).items():
        still = {other: jnp.zeros_like(value) for other, value in at.items()}
        direction = {**still, key: jnp.asarray(size * random.normal(size=at[key].shape))}
        value, slope = tangent(direction)
        rest = [
            abs(loss(jax.tree.map(lambda a, d, h=h: a + h * d, at, direction)) - value - h * slope) for h in (0.1, 0.01)
        ]
        assert abs(np.log10(rest[0] / rest[1]) - 2) < 0.1, key


def test_a_report_and_its_picture(rates, sphere):
    plt = pytest.importorskip("matplotlib.pyplot")
    experiment, clean = rates
    values, level = noisy(clean, 0.01, 0)
    found = ltl.fit(experiment, AWAY, ltl.Observations(values, level, TIMES), transforms=RANGES)
    text = str(found)
    for part in ("Levenberg-Marquardt", "forward mode", "95 % interval", "singular values", "a ", "b ", "d "):
        assert part in text
    np.testing.assert_allclose(found.prediction.us, values + level * found.residuals, atol=1e-8)
    figure = found.plot(sphere)
    assert len(figure.axes) == 7
    plt.close(figure)
