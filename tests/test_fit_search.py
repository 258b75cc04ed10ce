"""The search of a fit: methods, models that fail, why it ends, bounds, checkpoints, and global searches."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest

import ltljax as ltl

LEAST_SQUARES = [optx.LevenbergMarquardt(1e-6, 1e-8), optx.Dogleg(1e-6, 1e-8), optx.GaussNewton(1e-6, 1e-8)]
METHODS = [*LEAST_SQUARES, optx.BFGS(1e-6, 1e-8), optx.LBFGS(1e-6, 1e-8)]
LINE = np.linspace(0.0, 1.0, 20)


def name_of(method):
    return type(method).__name__


class Explosive:
    """The solution u = 1 / (1 - r) of u' = r u^2 at t = 1, which is infinite from r = 1 on; it records every r."""

    def __init__(self):
        self.rates = []

    def __call__(self, p):
        jax.debug.callback(lambda r: self.rates.append(float(r)), p["r"])
        return jnp.where(p["r"] < 1, 1 / (1 - p["r"]), jnp.inf) * jnp.ones(4)


@pytest.fixture(scope="module")
def explosive():
    """The model, and its data for r = 0.9."""
    return Explosive(), ltl.Observations(np.full(4, 10.0))


@pytest.mark.parametrize("method", METHODS, ids=name_of)
def test_a_diverging_trial_step_is_rejected(explosive, method):
    model, data = explosive
    model.rates.clear()
    fit = ltl.fit(model, dict(r=0.1), data, method=method)
    jax.effects_barrier()
    assert max(model.rates) > 1
    assert np.isfinite(fit.losses).all()
    assert (np.diff(fit.losses) <= 0).all()
    assert fit.converged
    assert float(fit.params["r"]) == pytest.approx(0.9, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=name_of)
def test_a_diverging_run_is_rejected(method):
    surface, rates = ltl.Surface.from_mesh(ltl.shapes.icosphere(1)), []

    def model(p, adjoint=None):
        jax.debug.callback(lambda r: rates.append(float(r)), p["r"])
        kinetics = ltl.kinetics.Kinetics(lambda u, q: (q["r"] * u[0] ** 2,), dict(r=p["r"]))
        equation = ltl.ReactionDiffusion((1.0,), kinetics)
        u0 = jnp.ones((surface.num_vertices, 1))
        return ltl.solve(equation, surface, u0, 1.0, adjoint=adjoint, throw=False, max_steps=300)

    clean = model(dict(r=jnp.array(0.9))).u_end
    np.testing.assert_allclose(clean, 1 / (1 - 0.9), rtol=0.05)
    rates.clear()
    fit = ltl.fit(model, dict(r=0.1), ltl.Observations(clean), method=method)
    jax.effects_barrier()
    assert max(rates) > 1
    assert np.isfinite(fit.losses).all()
    assert (np.diff(fit.losses) <= 0).all()
    assert fit.converged
    assert float(fit.params["r"]) == pytest.approx(0.9, abs=1e-3)


def test_a_run_that_does_not_reach_its_end_predicts_nan():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(0))
    solution = ltl.inverse.Experiment(ltl.Diffusion, surface, surface.vertices[:, 0], t1=10.0, max_steps=2)(1.0)
    assert np.isnan(ltl.Observations(np.zeros(12)).of(solution)).all()


def test_a_start_that_fails_is_reported(explosive):
    model, data = explosive
    with pytest.raises(ltl.errors.FitError, match="fails at the start"):
        ltl.fit(model, dict(r=2.0), data)
    with pytest.raises(ltl.errors.FitError, match="no finite derivatives"):
        ltl.fit(lambda p: jnp.sqrt(p) * jnp.ones(3), 0.0, ltl.Observations(np.ones(3)))
    many = ltl.inverse.fit_many(model, dict(r=np.array([0.1, 2.0])), data)
    assert many.converged.tolist() == [True, False]
    assert np.isfinite(many.losses).tolist() == [True, False]
    assert float(many.best["r"]) == pytest.approx(0.9, abs=1e-3)


def test_runs_of_the_model_are_counted(explosive):
    model, data = explosive
    model.rates.clear()
    fit = ltl.fit(model, dict(r=0.5), data)
    jax.effects_barrier()
    assert len(model.rates) == fit.num_runs == fit.num_iterations + 2
    assert f"{fit.num_runs} runs of the model" in fit.summary()


@pytest.mark.parametrize("method", METHODS, ids=name_of)
def test_a_fit_that_fails_at_every_further_step_has_not_converged(method):
    model = lambda p: jnp.where(p <= 0.5, p, jnp.nan) * jnp.ones(5)  # noqa: E731
    fit = ltl.fit(model, 0.5, ltl.Observations(np.full(5, 10.0)), method=method)
    assert not fit.converged
    assert "the model fails at every step from here" in fit.reason
    assert float(fit.params) == 0.5


@pytest.mark.parametrize("method", METHODS, ids=name_of)
def test_a_parameter_without_effect_stays_at_the_start(method):
    data = ltl.Observations(np.arange(5.0) + 0.05, 0.1)
    fit = ltl.fit(lambda p: 0 * p + jnp.arange(5.0), 2.0, data, method=method)
    assert float(fit.params) == 2.0
    assert fit.loss == pytest.approx(0.5 * 5 * 0.25)
    if method in LEAST_SQUARES:
        assert "not seen at all" in fit.summary()


@pytest.mark.parametrize(
    "method", [None, optx.Dogleg(1e-6, 1e-8), optx.LBFGS(1e-7, 1e-9), optx.BFGS(1e-7, 1e-9)], ids=name_of
)
def test_every_method_recovers_the_parameters_of_clean_data(method):
    truth, ranges = dict(size=2.0, rate=1.5, floor=0.5), dict(rate=ltl.inverse.Positive())
    model = lambda p: p["size"] * jnp.exp(-p["rate"] * LINE) + p["floor"]  # noqa: E731
    fit = ltl.fit(
        model, dict(size=1.5, rate=1.0, floor=0.8), ltl.Observations(model(truth)), transforms=ranges, method=method
    )
    assert fit.converged
    assert max(abs(float(fit.params[key]) / truth[key] - 1) for key in truth) < 1e-3
    assert fit.losses[-1] < 1e-4 * fit.losses[0]


def test_large_residuals_are_not_a_failure():
    x = np.linspace(1.0, 2.0, 20)
    fit = ltl.fit(lambda p: p * jnp.asarray(x), 1e12, ltl.Observations(2 * x, 1e-3), atol=0.0)
    assert fit.converged
    assert float(fit.params) == pytest.approx(2.0)


def test_an_optimiser_of_optax_serves_as_method():
    truth = dict(a=0.1, b=0.9)
    model = lambda p: p["a"] + p["b"] * jnp.exp(-LINE / p["a"] / 10)  # noqa: E731
    clean = np.asarray(model(truth))
    level = 1e-3 * clean.std()
    data = ltl.Observations(clean + level * np.random.default_rng(0).normal(size=20), level)
    start = {key: 1.02 * value for key, value in truth.items()}
    with jax.numpy_dtype_promotion("standard"):  # optax relies on it
        fit = ltl.fit(
            model, start, data, transforms=ltl.inverse.Positive(), method=optax.adam(5e-3), max_iterations=100
        )
    assert fit.method.startswith("optax")
    assert fit.loss < 0.01 * fit.losses[0]
    assert max(abs(float(fit.params[key]) / truth[key] - 1) for key in truth) < 0.01


def test_a_fit_with_optax_ends_where_the_model_fails():
    x = jnp.linspace(1.0, 2.0, 20)
    data = ltl.Observations(2 * x, 0.1)
    with jax.numpy_dtype_promotion("standard"):  # optax relies on it
        fit = ltl.fit(lambda p: jnp.where(p < 1.5, p, jnp.nan) * x, 1.0, data, method=optax.adam(0.1))
    assert not fit.converged
    assert "the model fails where the optimiser went" in fit.reason
    assert 1.3 < float(fit.params) < 1.5
    # The loss belongs to the returned parameters.
    assert fit.loss == pytest.approx(0.5 * np.sum(fit.residuals**2))


def test_bounded_parameters_stay_between_their_bounds():
    fit = ltl.fit(
        lambda p: p * jnp.asarray(LINE), 0.5, ltl.Observations(2 * LINE, 0.1),
        transforms=ltl.inverse.Bounded(0.0, 1.0), max_iterations=30,
    )  # fmt: skip
    assert 0.99 < float(fit.params) <= 1


def test_a_parameter_at_its_bound_is_reported():
    x, unit = jnp.asarray(LINE), ltl.inverse.Bounded(0.0, 1.0)
    near, far, inside = (
        ltl.fit(lambda p: p * x, 0.5, ltl.Observations(slope * x, 0.1), transforms=unit) for slope in (1.02, 2, 0.9995)
    )
    for fit in (near, far):
        assert 1 - 1e-4 < float(fit.params) <= 1
        assert "parameter is at the end of its range" in fit.summary()
    assert np.isfinite(near.evidence.singular_values).all()
    assert "determine every parameter" in inside.summary()


def test_a_resumed_fit_ignores_the_start_and_refuses_the_checkpoint_of_another_fit(tmp_path):
    x, path = jnp.asarray(LINE), tmp_path / "fit.npz"
    model = lambda p: p["a"] * x + p["b"] ** 2  # noqa: E731
    data, start = ltl.Observations(3 * x + 4, 0.1), dict(a=1.0, b=1.0)
    first = ltl.fit(model, start, data, checkpoint=path)
    second = ltl.fit(model, dict(a=0.1, b=7.0), data, checkpoint=path, resume=True)
    for key, value in first.params.items():
        assert float(second.params[key]) == pytest.approx(float(value), rel=1e-9)
    assert second.num_iterations == 1
    for change, message in (
        (dict(data=ltl.Observations(3 * x + 4, 0.2)), "its data differ"),
        (dict(transforms=ltl.inverse.Positive()), "its ranges of parameters differ"),
        (dict(model=lambda p: p["a"] * x + p["b"]), "its loss was"),
        (dict(penalty=lambda p: p["a"]), "its loss was"),
    ):
        with pytest.raises(ltl.errors.RestartError, match=f"holds another fit: {message}"):
            ltl.fit(**(dict(model=model, start=start, data=data, checkpoint=path, resume=True) | change))
    path.write_bytes(b"PK no zip")
    with pytest.raises(ltl.errors.RestartError, match="damaged"):
        ltl.fit(model, start, data, checkpoint=path, resume=True)


def test_a_global_search_finds_a_start_in_the_right_valley():
    # The loss of sin(k x) on a line has a valley every few tenths of k.
    x = np.linspace(0, 10, 200)
    model = lambda p: jnp.sin(p["k"] * x)  # noqa: E731
    data = ltl.Observations(np.sin(2.7 * x), 0.1)
    single = ltl.fit(model, dict(k=5.0), data)
    assert abs(float(single.params["k"]) - 2.7) > 0.1
    starts, losses = ltl.inverse.explore(model, dict(k=0.5), dict(k=8.0), data, count=64)
    assert losses[0] == losses.min()
    assert starts["k"].shape == (8,)
    assert ltl.inverse.fit_many(model, starts, data).best["k"] == pytest.approx(2.7, abs=1e-4)


def test_many_fits_and_global_searches_accept_gaps_and_unknown_factors():
    x = np.linspace(0, 4, 60)
    line = lambda p: p * jnp.exp(-x)  # noqa: E731
    sets = np.stack([np.exp(-x), 3 * np.exp(-x)])
    sets[:, ::7] = np.nan
    data = ltl.Observations(np.zeros(60), 0.1)
    np.testing.assert_allclose(ltl.inverse.fit_many(line, 1.5, data, values=sets).params, [1, 3], rtol=1e-6)
    masked = np.ma.masked_array(np.nan_to_num(sets, nan=99.0), np.isnan(sets))
    np.testing.assert_allclose(ltl.inverse.fit_many(line, 1.5, data, values=masked).params, [1, 3], rtol=1e-6)
    with pytest.raises(ValueError, match="Data set 1 has no measured values"):
        ltl.inverse.fit_many(line, 1.5, data, values=np.stack([sets[0], np.full(60, np.nan)]))
    with pytest.raises(ValueError, match="fit_many needs known noise"):
        ltl.inverse.fit_many(line, np.ones(2), ltl.Observations(sets[0], loss="huber"))
    decay = lambda p: jnp.exp(-p * x)  # noqa: E731
    data = ltl.Observations(10 * np.exp(-x), scale=ltl.inverse.Positive(1.0))
    starts, _ = ltl.inverse.explore(decay, 0.01, 100.0, data, count=128)
    assert 0.8 < float(starts[0]) < 1.25


def test_a_scan_keeps_bounded_parameters_near_their_start():
    from ltljax._fit.problem import prepare
    from ltljax._fit.scan import _moved
    from ltljax._fit.unknowns import unknowns

    start = dict(a=2.0, b=0.05, c=3.0)
    space = unknowns(start, dict(a=ltl.inverse.Positive(), b=ltl.inverse.Bounded(0.0, 1.0)))
    z = np.asarray(space.free((start, {})))
    model = lambda p: p["a"] * p["b"] * p["c"] * LINE  # noqa: E731
    problem = prepare(model, space, ltl.Observations(LINE), None, None, jnp.asarray(z), 1e-5, 1e-7)
    unmoved = space.params(jnp.asarray(_moved(problem.residuals, z, np.zeros(3))))
    assert {key: pytest.approx(float(value)) for key, value in unmoved.items()} == start
    moved = space.params(jnp.asarray(_moved(problem.residuals, z, np.array([1.0, 1.0, -1.0]))))
    assert [float(moved[key]) for key in "abc"] == pytest.approx([20.0, 0.05 + 1 / 6, 0.3])


FACTORS = {"k": 1.0}


def test_a_model_that_reads_a_changed_value_is_traced_again():
    """The value may come from a closure, a module or an object."""

    class Scaled:
        def __init__(self, factor):
            self.factor = factor

        def __call__(self, p):
            return p * self.factor * jnp.asarray(LINE)

    closure = {"k": 1.0}
    models = (lambda p: p * closure["k"] * LINE), (lambda p: p * FACTORS["k"] * LINE), Scaled(1.0)
    data = ltl.Observations(2 * LINE)
    for model in models:
        assert float(ltl.fit(model, 1.0, data).params) == pytest.approx(2.0)
    closure["k"] = FACTORS["k"] = models[2].factor = 4.0
    for model in models:
        assert float(ltl.fit(model, 1.0, data).params) == pytest.approx(0.5)
    FACTORS["k"] = 1.0
