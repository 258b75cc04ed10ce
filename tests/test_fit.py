"""Fits of runs, from data to report: rates with their intervals, profiles, interrupted fits, and refused input."""

import diffrax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import ltljax as ltl

TRUTH = dict(a=0.1, b=0.9, d=10.0)
START = dict(a=0.13, b=0.7, d=7.0)
RANGES = dict(a=ltl.inverse.Positive(), d=ltl.inverse.Positive())
# With this many times there are enough values, on a tiny mesh, to estimate the noise to 5 %.
TIMES = np.linspace(0.2, 0.6, 41)


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(1))


def bumpy(surface, seed=0):
    """A smooth random field of size one."""
    rng = np.random.default_rng(seed)
    x = np.asarray(surface.vertices)
    return np.sin(x @ (6 * rng.normal(size=(3, 40))) + rng.uniform(0, 2 * np.pi, 40)).sum(axis=1) / np.sqrt(20)


def schnakenberg(surface, **options):
    """A Schnakenberg run with unknown rates a and b and unknown diffusivity d."""
    u0 = np.array([1.0, 0.9]) + 0.1 * bumpy(surface)[:, None] * np.array([1.0, -1.0])
    return ltl.inverse.Experiment(
        lambda p: ltl.ReactionDiffusion((1.0, p["d"]), ltl.kinetics.schnakenberg(p["a"], p["b"], rate=30.0)),
        surface, u0, **options,
    )  # fmt: skip


@pytest.fixture(scope="module")
def experiment(sphere):
    """A run with fixed explicit steps, which compile quickly."""
    return schnakenberg(sphere, solver=diffrax.Heun(), dt=0.004)


@pytest.fixture(scope="module")
def clean(experiment):
    return np.asarray(experiment(TRUTH, TIMES).us)


def noisy(values, share, seed):
    level = share * float(values.std())
    return values + level * np.random.default_rng(seed).normal(size=values.shape), level


@pytest.fixture(scope="module")
def data(clean):
    return ltl.Observations(*noisy(clean, 0.01, 0), TIMES)


def relative_error(params, truth=TRUTH):
    return max(abs(float(params[key]) / truth[key] - 1) for key in truth)


def test_rates_are_recovered_with_adaptive_steps(sphere):
    times = np.array([0.2, 0.4, 0.6])
    experiment = schnakenberg(sphere)
    fit = ltl.fit(experiment, START, ltl.Observations(experiment(TRUTH, times).us, times=times), transforms=RANGES)
    assert fit.converged
    assert relative_error(fit.params) < 1e-3
    assert fit.losses[-1] < 1e-4 * fit.losses[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [optx.Dogleg(1e-6, 1e-8), optx.LBFGS(1e-7, 1e-9), optx.BFGS(1e-7, 1e-9)], ids=lambda m: type(m).__name__
)
def test_rates_are_recovered_by_other_methods(sphere, method):
    times = np.array([0.2, 0.4, 0.6])
    experiment, start = schnakenberg(sphere), dict(a=0.11, b=0.85, d=9.0)
    data = ltl.Observations(experiment(TRUTH, times).us, times=times)
    fit = ltl.fit(experiment, start, data, transforms=RANGES, method=method)
    assert fit.converged
    assert relative_error(fit.params) < 1e-3
    assert fit.losses[-1] < 1e-4 * fit.losses[0]


def test_intervals_contain_the_truth_and_the_noise_is_estimated(experiment, clean):
    num_inside, spreads = 0, []
    for seed in range(5):
        values, level = noisy(clean, 0.01, seed)
        fit = ltl.fit(experiment, START, ltl.Observations(values, level, TIMES), transforms=RANGES)
        low, high = fit.intervals
        num_inside += sum(bool(low[key] < TRUTH[key] < high[key]) for key in TRUTH)
        assert relative_error(fit.params) < 0.03
        spreads.append(fit.evidence.noise)
        estimated = ltl.fit(experiment, fit.params, ltl.Observations(values, times=TIMES), transforms=RANGES)
        assert estimated.evidence.noise == pytest.approx(level, rel=0.05)
        np.testing.assert_allclose(estimated.evidence.std, fit.evidence.std, rtol=0.05)
    assert num_inside >= 13  # of 15, with 14.25 expected
    assert np.mean(spreads) == pytest.approx(1, abs=0.05)


def test_a_profile_has_its_minimum_at_the_optimum_and_rises_by_1_92_at_the_ends_of_the_interval(experiment, data):
    fit = ltl.fit(experiment, START, data, transforms=RANGES)
    index = fit.evidence.names.index("d")
    d, std = fit.evidence.values[index], fit.evidence.std[index]
    losses = fit.profile("d", d + std * np.array([-1.96, 0.0, 1.96]))
    assert losses[1] == pytest.approx(fit.loss, rel=1e-6)
    np.testing.assert_allclose(losses[[0, 2]] - losses[1], 1.92, rtol=0.1)
    with pytest.raises(ValueError, match="no parameter 'e'; there are a, b, d"):
        fit.profile("e", [1.0])


def test_many_starts_run_at_once_and_lead_to_the_same_rates(experiment, clean):
    rng = np.random.default_rng(0)
    starts = {key: value * (1 + 0.15 * rng.uniform(-1, 1, 4)) for key, value in TRUTH.items()}
    vertices = np.arange(0, 42, 2)
    data = ltl.Observations(clean[:, vertices], times=TIMES, vertices=vertices)
    many = ltl.inverse.fit_many(experiment, starts, data, transforms=RANGES)
    assert many.losses.shape == (4,)
    for k in range(4):
        assert relative_error({key: leaf[k] for key, leaf in many.params.items()}) < 1e-3
    assert relative_error(many.best) < 1e-3


def test_an_interrupted_fit_continues_from_its_checkpoint(experiment, data, tmp_path):
    path = tmp_path / "fit.npz"
    first = ltl.fit(experiment, START, data, transforms=RANGES, max_iterations=4, checkpoint=path)
    assert not first.converged
    assert "the limit of 4 iterations" in first.reason
    second = ltl.fit(experiment, START, data, transforms=RANGES, checkpoint=path, resume=True)
    assert second.losses[0] == pytest.approx(first.loss, rel=1e-9)
    assert relative_error(second.params) < 1e-3
    with pytest.raises(ValueError, match="another fit"):
        ltl.fit(lambda p: p * data.values, 1.0, data, checkpoint=path, resume=True)


def test_a_fit_stops_on_request_and_shows_its_progress(experiment, data, capfd):
    calls = []

    def stop(iteration, loss, params):
        calls.append((iteration, loss, float(params["a"])))
        return loss < 1e7

    fit = ltl.fit(experiment, START, data, transforms=RANGES, stop_when=stop, progress=True)
    assert fit.reason == "stop_when returned True"
    assert not fit.has_settled
    assert [iteration for iteration, *_ in calls] == list(range(len(fit.losses)))
    assert calls[-1][1] == fit.loss < 1e7
    assert "loss" in capfd.readouterr().err


def test_the_report_and_the_picture_show_parameters_and_intervals(experiment, data, sphere):
    plt = pytest.importorskip("matplotlib.pyplot")
    fit = ltl.fit(experiment, START, data, transforms=RANGES)
    text = str(fit)
    for part in ("Levenberg-Marquardt", "forward mode", "95 % interval", "singular values", "a ", "b ", "d "):
        assert part in text
    np.testing.assert_allclose(fit.prediction.us, data.values + data.noise * fit.residuals, atol=1e-8)
    figure = fit.plot(sphere)
    assert len(figure.axes) == 7
    plt.close(figure)


def test_the_old_name_of_max_iterations_works_with_a_warning():
    x = np.linspace(0.0, 1.0, 20)
    model, data = (lambda p: p["a"] * x), ltl.Observations(2 * x, 0.1)
    with pytest.warns(DeprecationWarning, match="use max_iterations"):
        fit = ltl.fit(model, dict(a=1.0), data, max_steps=1)
    assert fit.num_iterations == 1
    with pytest.warns(DeprecationWarning, match="use num_iterations"):
        assert fit.num_steps == 1
    with pytest.warns(DeprecationWarning, match="use max_iterations"):
        many = ltl.inverse.fit_many(model, dict(a=np.ones(2)), data, max_steps=30)
    np.testing.assert_allclose(many.params["a"], 2.0)


REFUSED_DATA = {
    "infinity": (lambda: ltl.Observations(np.where(np.arange(42) == 7, np.inf, 1.0)), r"inf at index \(7,\)"),
    "noise": (lambda: ltl.Observations(np.ones(3), 0.0), "positive finite noise"),
    "noise shape": (lambda: ltl.Observations(np.ones(3), np.ones(2)), r"shape \(3,\) of the values, found .* \(2,\)"),
    "too many axes": (
        lambda: ltl.Observations(np.ones(3), np.ones((2, 3))),
        r"\(3,\) of the values, found .* \(2, 3\)",
    ),
    "negative species": (lambda: ltl.Observations(np.ones(3), species=-1), "from 0, found -1"),
    "times": (lambda: ltl.Observations(np.ones((2, 3)), times=[1.0, 0.5]), "ascending times"),
    "number of times": (lambda: ltl.Observations(np.ones((2, 3)), times=[1.0]), "values for 1 times"),
    "negative vertex": (lambda: ltl.Observations(np.ones(1), vertices=[-1]), "from 0, found -1"),
    "no values": (lambda: ltl.Observations([]), "at least one"),
}


@pytest.mark.parametrize("name", REFUSED_DATA)
def test_bad_data_are_refused_when_they_are_made(name):
    make, message = REFUSED_DATA[name]
    with pytest.raises(ValueError, match=message):
        make()


def test_data_that_do_not_match_the_model_are_refused(sphere, experiment, clean, data):
    few = np.asarray(clean)[:, :3]
    for mismatch, message in (
        (ltl.Observations(few, times=TIMES), "shape"),
        (ltl.Observations(few, times=TIMES, vertices=[1, 2, 42]), "Vertex 42"),
        (ltl.Observations(few[..., 0], times=TIMES, vertices=[1, 2, 3], species=2), "Species 2"),
        (ltl.Observations(few[0]), "end of the run"),
        (
            ltl.Observations(few, times=TIMES, vertices=np.arange(10) < 3),
            "a mask of the model's 42 vertices, found one of 10",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            ltl.fit(experiment, START, mismatch)
    with pytest.raises(ValueError, match="outside the run"):
        ltl.fit(schnakenberg(sphere, t1=0.5), START, data)
    with pytest.raises(ValueError, match="at least as many values as unknowns"):
        ltl.fit(experiment, START, ltl.Observations(few[:1, :2, 0], times=TIMES[:1], vertices=[0, 1], species=0))
    with pytest.raises(ValueError, match="has only one"):
        ltl.fit(lambda p: p * bumpy(sphere), 1.0, ltl.Observations(bumpy(sphere), species=0))
    with pytest.raises(ValueError, match=r"inf at index \(0, 1\)"):
        ltl.inverse.fit_many(
            lambda p: p * jnp.ones(3), 1.0, ltl.Observations(np.ones(3)), values=np.where(np.eye(2, 3, 1), np.inf, 1.0)
        )
    # A model without an adjoint has only a reverse mode.
    with pytest.raises(ValueError, match="take adjoint="):
        ltl.fit(lambda p: schnakenberg(sphere)(p, TIMES).us, START, data)


def test_parameters_and_methods_that_cannot_be_used_are_refused(experiment, data):
    with pytest.raises(ValueError, match="a to be positive"):
        ltl.fit(experiment, {**START, "a": -1.0}, data, transforms=RANGES)
    with pytest.raises(ValueError, match="no parameter 'c'"):
        ltl.fit(experiment, START, data, transforms=dict(c=ltl.inverse.Positive()))
    with pytest.raises(ValueError, match="to be a float"):
        ltl.fit(experiment, {**START, "a": 1}, data)
    with pytest.raises(ValueError, match=r"method of optimistix .* or an optimiser of optax, found 'lm'"):
        ltl.fit(experiment, START, data, method="lm")
    with pytest.raises(ValueError, match="low < high"):
        ltl.inverse.Bounded(1.0, 1.0)
