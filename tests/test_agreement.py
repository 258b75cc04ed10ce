"""Reports about runs and data that disagree: outliers, structured residuals, wrong models, and every status."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl

TIMES = np.array([0.15, 0.45, 0.9])
TRUTH = dict(a=0.12, b=0.85, dv=0.25)
START = dict(a=0.15, b=0.7, dv=0.4)
NOISE = 0.01
CURVE = np.linspace(0, 4, 60)


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(2))


def schnakenberg(surface, **options):
    x = np.asarray(surface.vertices)
    push = np.sin(5 * x[:, 0]) * np.cos(4 * x[:, 1]) + np.sin(6 * x[:, 2])
    u0 = jnp.asarray(np.array([0.97, 0.9]) + 0.3 * push[:, None] * np.array([1.0, -1.0]))
    return ltl.inverse.Experiment(
        lambda p: ltl.ReactionDiffusion((0.02, p["dv"]), ltl.kinetics.schnakenberg(p["a"], p["b"], rate=10.0)),
        surface, u0, **options,
    )  # fmt: skip


@pytest.fixture(scope="module")
def experiment(sphere):
    """A run with fixed explicit steps, which compile quickly."""
    return schnakenberg(sphere, solver=diffrax.Heun(), dt=0.03)


@pytest.fixture(scope="module")
def exact(experiment):
    return np.asarray(experiment(TRUTH, TIMES).us)


def noisy(exact, seed):
    return exact + NOISE * np.random.default_rng(seed).normal(size=exact.shape)


def fitted(experiment, values, start=START, **options):
    data = ltl.Observations(values, times=TIMES, **options)
    return ltl.fit(experiment, start, data, transforms=ltl.inverse.Positive())


def with_outliers(values):
    """The values with 5 % outliers, most of them too large."""
    rng = np.random.default_rng(1000)
    is_outlier = rng.random(values.shape) < 0.05
    return np.where(is_outlier, values + 20 * rng.choice([1, 1, 1, -1], values.shape), values)


def test_least_squares_with_outliers_reports_them(experiment, exact):
    values = with_outliers(noisy(exact, 0))
    fit = fitted(experiment, values)
    assert not fit.converged
    assert 'loss="huber"' in fit.summary()
    assert f"of {values.size} values are outliers" in fit.summary()


def test_a_wrong_factor_is_not_explained(experiment, exact):
    for options in (dict(), dict(noise=NOISE)):
        fit = fitted(experiment, 3.7 * noisy(exact, 0), **options)
        assert fit.status in ("explains nothing", "unexplained", "structured residuals", "end of range")
        assert fit.summary().startswith(("The model explains nothing", "The model does not explain the data"))
        assert "scale=Positive" in fit.summary()


def test_a_model_of_the_wrong_form_is_reported():
    x = np.linspace(0, 1, 50)
    fit = ltl.fit(lambda p: p["slope"] * x, dict(slope=1.0), ltl.Observations(x**2 + 1, 0.01))
    assert "does not explain the data" in fit.summary()
    assert "determine every parameter" not in fit.summary()


def test_a_report_does_not_claim_that_unknown_structure_is_absent():
    fit = ltl.fit(lambda p: p[0] + p[1] * CURVE, np.zeros(2), ltl.Observations(CURVE**2))
    assert "whether the residuals have structure is unknown" in fit.summary()


@pytest.mark.slow
@pytest.mark.parametrize("factor", [300.0, 1 / 300])
def test_the_rates_of_a_run_are_found_from_a_start_far_away(sphere, factor):
    experiment = schnakenberg(sphere)
    values = noisy(np.asarray(experiment(TRUTH, TIMES).us), 0)
    fit = fitted(experiment, values, {key: factor * value for key, value in TRUTH.items()})
    assert fit.converged
    low, high = fit.intervals
    assert all(low[key] <= TRUTH[key] <= high[key] for key in TRUTH)
    assert "The start explains nothing, so the fit began at the best of" in fit.summary()


def test_a_start_that_cannot_be_improved_does_not_count_as_converged():
    # The prediction does not depend on the parameter.
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1))
    experiment = ltl.inverse.Experiment(
        lambda p: ltl.Diffusion(0 * p), surface, jnp.ones(surface.num_vertices), solver=diffrax.Heun(), dt=0.1
    )
    values = 5 + np.random.default_rng(0).normal(size=(2, surface.num_vertices))
    fit = ltl.fit(experiment, 1.0, ltl.Observations(values, times=[0.1, 0.2]))
    assert fit.status == "explains nothing"
    assert "none of the points tried within a factor of 1000 explains more" in fit.summary()


@pytest.mark.parametrize("places", ["all", "some"])
def test_a_smooth_error_is_structure_and_independent_noise_is_not(experiment, exact, sphere, places):
    vertices = None if places == "all" else np.arange(0, sphere.num_vertices, 2)
    rows = slice(None) if vertices is None else vertices
    wave = NOISE * np.sin(4 * np.asarray(sphere.vertices)[:, 1])[rows, None]
    for seed in range(5):
        values = noisy(exact[:, rows], seed)
        assert not fitted(experiment, values, vertices=vertices).agreement.is_structured
        wrong = fitted(experiment, values + wave, vertices=vertices)
        assert wrong.status == "structured residuals"
        assert wrong.agreement.in_space.is_structure
        assert "intervals are too narrow" in wrong.summary()


def test_errors_that_persist_in_time_are_structure(experiment, exact):
    # The noise is independent from place to place and the same at all times.
    values = exact + NOISE * np.random.default_rng(0).normal(size=exact.shape[1:])
    fit = fitted(experiment, values)
    assert fit.status == "structured residuals"
    assert fit.agreement.in_time.value > 0.8
    assert not fit.agreement.in_space.is_structure


def test_every_outcome_of_a_fit_has_its_status(experiment, exact):
    values = noisy(exact, 0)
    assert fitted(experiment, values).status == "converged"
    stopped = ltl.fit(
        experiment, START, ltl.Observations(values, times=TIMES), transforms=ltl.inverse.Positive(), max_iterations=2
    )
    assert (stopped.status, stopped.has_settled) == ("stopped", False)
    assert fitted(experiment, values, noise=NOISE / 5).status == "unexplained"
    # Only the product of two factors can be determined.
    flat = ltl.fit(lambda p: p["c"] * p["d"] * CURVE, dict(c=1.0, d=1.0), ltl.Observations(2 * CURVE, 0.1))
    assert flat.status == "undetermined"
    # The best value is outside the range.
    low = ltl.fit(lambda p: p * CURVE, 0.5, ltl.Observations(2 * CURVE, 5.0), transforms=ltl.inverse.Bounded(0.0, 1.0))
    assert low.status == "end of range"
    assert [fit.converged for fit in (flat, low, stopped)] == [False] * 3


def test_a_robust_fit_resumes_from_its_checkpoint(experiment, exact, tmp_path):
    data = ltl.Observations(with_outliers(noisy(exact, 0)), times=TIMES, loss="huber")
    options = dict(transforms=ltl.inverse.Positive(), checkpoint=tmp_path / "fit.npz")
    interrupted = ltl.fit(experiment, START, data, stop_when=lambda iteration, *_: iteration == 8, **options)
    resumed = ltl.fit(experiment, START, data, resume=True, **options)
    complete = ltl.fit(experiment, START, data, transforms=ltl.inverse.Positive())
    assert resumed.converged
    assert interrupted.num_iterations == 9
    assert resumed.num_iterations < complete.num_iterations
    for key in TRUTH:
        assert float(resumed.params[key]) == pytest.approx(float(complete.params[key]), rel=1e-3)
    # Another model with another loss is refused.
    ltl.fit(experiment, START, data, stop_when=lambda iteration, *_: iteration == 8, **options)
    other = dataclasses.replace(experiment, u0=1.05 * experiment.u0)
    with pytest.raises(ltl.errors.RestartError, match="holds another fit"):
        ltl.fit(other, START, data, resume=True, **options)


def test_a_second_fit_of_the_same_model_compiles_nothing(experiment, exact):
    compilations = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: compilations.append(name) if name.endswith("backend_compile_duration") else None
    )
    fitted(dataclasses.replace(experiment, rtol=2e-5), noisy(exact, 0), loss="huber")
    begin = len(compilations)
    assert begin > 0
    fitted(dataclasses.replace(experiment, rtol=2e-5), noisy(exact, 1), loss="huber")
    assert len(compilations) == begin


def test_the_picture_of_a_fit_shows_outliers(experiment, exact):
    plt = pytest.importorskip("matplotlib.pyplot")
    figure = fitted(experiment, with_outliers(noisy(exact, 0)), loss="huber").plot()
    titles = [axes.get_title() for axes in figure.axes]
    assert "95 % intervals" in titles
    assert any("outliers are outside" in title for title in titles)
    plt.close(figure)
