"""What the data determine: covariance, intervals, estimated noise, and the directions that a report names."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl
from ltljax._fit.losses import as_loss

CURVE = np.linspace(0, 4, 60)


def test_the_covariance_matches_repeated_experiments():
    """The model is linear, so theory is exact."""
    x = ltl.shapes.icosphere(2).vertices
    model = lambda p: p["c"] @ jnp.asarray(x.T) + p["k"] * jnp.asarray(x[:, 0] * x[:, 1])  # noqa: E731
    truth, start = dict(c=np.array([1.0, -2.0, 0.5]), k=0.3), dict(c=np.ones(3), k=1.0)
    clean = np.asarray(model(truth))
    data = ltl.Observations(clean, 0.1)
    fit = ltl.fit(model, start, data)
    design = np.concatenate([x, (x[:, 0] * x[:, 1])[:, None]], axis=1)
    np.testing.assert_allclose(fit.covariance, 0.01 * np.linalg.inv(design.T @ design), rtol=1e-6, atol=1e-12)
    values = clean + 0.1 * np.random.default_rng(0).normal(size=(400, len(clean)))
    many = ltl.inverse.fit_many(model, start, data, values=values)
    assert many.converged.all()
    spread = np.concatenate([many.params["c"], many.params["k"][:, None]], axis=1).std(axis=0)
    np.testing.assert_allclose(spread, fit.evidence.std, rtol=0.15)


def test_the_covariance_is_that_of_the_parameter_whatever_its_transform():
    data = ltl.Observations(3 * CURVE, 0.1)
    fit = ltl.fit(lambda p: p * jnp.asarray(CURVE), 2.0, data, transforms=ltl.inverse.Positive())
    np.testing.assert_allclose(np.ravel(fit.covariance), [0.01 / np.sum(CURVE**2)], rtol=1e-6)


@pytest.mark.parametrize("loss", ["huber", "soft_l1", "cauchy"])
def test_the_covariance_of_a_robust_loss_is_the_sandwich(loss):
    """The textbook's formula for a linear model, from derivatives of the loss as a whole."""
    rng = np.random.default_rng(0)
    design = rng.normal(size=(200, 2))
    values = design @ [1.0, -2.0] + 0.1 * rng.standard_t(3, size=200)
    fit = ltl.fit(lambda p: jnp.asarray(design) @ p, jnp.zeros(2), ltl.Observations(values, 0.1, loss=loss),
                  rtol=1e-10, atol=1e-12)  # fmt: skip
    rho = as_loss(loss)

    def loss_of(p):
        return 0.5 * rho.root((jnp.asarray(design) @ p - values) / 0.1) ** 2

    bread = jnp.linalg.inv(jax.hessian(lambda p: jnp.sum(loss_of(p)))(fit.params))
    slopes = jax.jacobian(loss_of)(fit.params)
    expected = bread @ slopes.T @ slopes @ bread
    # The two parameters take two degrees of freedom.
    np.testing.assert_allclose(fit.covariance, expected * 200 / 198, rtol=2e-3)


def test_errors_over_their_standard_deviations_have_a_mean_square_of_one():
    """For a curve with few points, for two species with very different noise, and for counts."""
    rng, num_sets = np.random.default_rng(0), 60
    truth, errors = np.array([2.0, 1.0]), {"few": [], "species": [], "counts": []}
    shape = jnp.stack([jnp.exp(-jnp.asarray(CURVE)), jnp.ones(60)])
    start = np.array([1.5, 1.5])
    for _ in range(num_sets):
        values = truth @ np.asarray(shape) + 0.1 * rng.normal(size=60)
        for name, data in (
            ("few", ltl.Observations(values, loss="huber")),
            ("counts", ltl.Observations(rng.poisson(2 * truth @ np.asarray(shape)), "poisson", scale=2.0)),
        ):
            fit = ltl.fit(lambda p: p @ shape, start, data)
            errors[name].append((np.asarray(fit.params) - truth) / fit.evidence.std)
        pair = np.stack([3 * rng.normal(size=60), 0.01 * rng.normal(size=60)], axis=1) + (truth @ shape)[:, None]
        fit = ltl.fit(lambda p: jnp.stack([p @ shape] * 2, axis=1), start, ltl.Observations(pair))
        errors["species"].append((np.asarray(fit.params) - truth) / fit.evidence.std)
    for name, values in errors.items():
        # The mean square of 120 normal values has a standard deviation of 13 %.
        assert np.mean(np.square(values)) == pytest.approx(1, abs=0.4), name


def test_the_noise_is_estimated_from_the_data_and_not_from_the_penalty():
    rng = np.random.default_rng(0)
    design = rng.normal(size=(50, 30))
    rows = np.concatenate([3 * np.eye(30), np.zeros((500, 30))])
    values = design @ rng.normal(size=30) + 0.1 * rng.normal(size=50)
    fit = ltl.fit(
        lambda p: jnp.asarray(design) @ p,
        np.zeros(30),
        ltl.Observations(values),
        penalty=lambda p: jnp.asarray(rows) @ p,
    )
    inverse = np.linalg.inv(design.T @ design + rows.T @ rows)
    best = inverse @ design.T @ values
    # The trace of the matrix from values to predictions is the number of degrees of freedom that the parameters take.
    free = 50 - np.trace(design @ inverse @ design.T)
    noise = np.sqrt(np.sum((values - design @ best) ** 2) / free)
    np.testing.assert_allclose(fit.params, best, atol=1e-4)
    assert fit.evidence.noise == pytest.approx(noise, rel=1e-4)
    np.testing.assert_allclose(fit.covariance, noise**2 * inverse, rtol=1e-3, atol=1e-9)


def test_values_that_are_matched_exactly_do_not_hide_the_noise():
    mask = np.where(np.arange(60) < 40, 0.0, 1.0)
    values = mask * (2 + 0.1 * np.random.default_rng(0).normal(size=60))
    fit = ltl.fit(lambda p: p * jnp.asarray(mask), 1.0, ltl.Observations(values, loss="huber"))
    assert float(fit.params) == pytest.approx(2, abs=0.1)
    assert fit.evidence.noise == pytest.approx(0.1, rel=0.6)


def test_as_many_values_as_unknowns_without_noise_have_no_error_bars():
    model = lambda p: jnp.stack([p["a"] + p["b"], p["a"] - p["b"]])  # noqa: E731
    fit = ltl.fit(model, dict(a=1.0, b=1.0), ltl.Observations([1.0, 2.0]))
    assert np.isnan(fit.evidence.std).all()
    assert "There are no error bars: 2 values for 2 unknowns" in fit.summary()
    assert "determine every parameter" not in fit.summary()
    with_noise = ltl.fit(model, dict(a=1.0, b=1.0), ltl.Observations([1.0, 2.0], 0.1))
    np.testing.assert_allclose(with_noise.evidence.std, 0.1 / np.sqrt(2), rtol=1e-6)
    assert "determine every parameter" in with_noise.summary()


def check_that_the_unit_of_time_is_named(model, noise_share):
    """Rates and diffusivities times s and the time over s give the same run."""
    truth = dict(rate=30.0, spread=1.0, time=0.3)
    clean = np.asarray(model(jax.tree.map(jnp.asarray, truth)))
    level = noise_share * float(clean.std())
    data = ltl.Observations(clean + level * np.random.default_rng(0).normal(size=clean.shape), level)
    start, positive = dict(rate=27.0, spread=1.1, time=0.32), ltl.inverse.Positive()
    fit = ltl.fit(model, start, data, transforms=positive)
    [sentence] = fit.evidence.cannot_tell
    for part in ("rate +10 %", "spread +10 %", "time -10 %", "not seen at all"):
        assert part in sentence
    assert sentence in fit.summary()
    assert float(fit.params["rate"] * fit.params["time"]) == pytest.approx(9.0, rel=0.01)
    timed = ltl.fit(
        lambda p, **options: model({**p, "time": jnp.array(0.3)}, **options),
        dict(rate=27.0, spread=1.1), data, transforms=positive,
    )  # fmt: skip
    assert not timed.evidence.cannot_tell
    assert "determine every parameter" in timed.summary()


def test_a_direction_that_the_data_do_not_determine_is_named():
    wave = jnp.sin(3 * jnp.asarray(CURVE))

    def model(p):
        # Logistic growth of the mean, and diffusive decay of a wave.
        mean = 1 / (1 + 1e4 * jnp.exp(-p["rate"] * p["time"]))
        return mean + jnp.exp(-2 * p["spread"] * p["time"]) * wave

    check_that_the_unit_of_time_is_named(model, 1e-3)


@pytest.mark.slow
def test_the_unit_of_time_of_a_run_is_named():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(3))
    rng, x = np.random.default_rng(0), np.asarray(surface.vertices)
    waves = np.sin(x @ (6 * rng.normal(size=(3, 40))) + rng.uniform(0, 2 * np.pi, 40)).sum(axis=1) / np.sqrt(20)
    u0 = np.array([1.0, 0.9]) + 0.1 * waves[:, None] * np.array([1.0, -1.0])

    def model(p, adjoint=None):
        kinetics = ltl.kinetics.schnakenberg(0.1, 0.9, rate=p["rate"])
        equation = ltl.ReactionDiffusion((p["spread"], 10 * p["spread"]), kinetics)
        return ltl.solve(equation, surface, u0, p["time"], adjoint=adjoint, throw=False).u_end

    check_that_the_unit_of_time_is_named(model, 0.01)


def test_a_small_effect_is_determined_if_the_model_takes_no_time_steps():
    """A model without steps has only rounding errors, so even the least effect of a parameter counts."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(10_000, 2))
    data = ltl.Observations(x @ [1000.0, 0.003] + 0.01 * rng.normal(size=len(x)), 0.01)
    fit = ltl.fit(lambda p: p["big"] * x[:, 0] + p["small"] * x[:, 1], dict(big=900.0, small=0.002), data)
    assert not fit.evidence.cannot_tell
    assert "determine every parameter" in fit.summary()
    # Damping that suits the large parameter does not end the fit before the small one has moved.
    best = np.linalg.lstsq(x, np.asarray(data.values))[0]
    np.testing.assert_allclose([fit.params["big"], fit.params["small"]], best, rtol=1e-4)
    assert fit.evidence.std[1] == pytest.approx(1e-4, rel=0.05)


def test_a_small_effect_is_not_safely_determined_if_the_model_may_take_adaptive_steps():
    """The noise would let it be known, but the errors of the steps do not."""

    def model(p, adjoint=None):
        del adjoint  # a model with this argument may take adaptive steps
        return jnp.exp(-p["a"] * jnp.asarray(CURVE)) + 1e-4 * p["small"]

    data = ltl.Observations(model(dict(a=jnp.array(0.1), small=jnp.array(1.0))), 1e-6)
    [sentence] = ltl.fit(model, dict(a=0.11, small=0.9), data).evidence.cannot_tell
    assert "do not safely tell" in sentence
    assert "less than the errors that adaptive steps may have" in sentence
    assert "not seen" not in sentence


@pytest.mark.slow
def test_the_length_of_adaptive_steps_is_no_information():
    """A uniform mixture carries no information about diffusion, although diffusion limits the first step.

    Derivatives depend on that length, so the singular value of d is not zero, but it is below the error of the steps.
    """
    surface, times = ltl.Surface.from_mesh(ltl.shapes.icosphere(3)), np.array([0.2, 0.4, 0.6])
    experiment = ltl.inverse.Experiment(
        lambda p: ltl.ReactionDiffusion((1.0, p["d"]), ltl.kinetics.schnakenberg(p["a"], p["b"], rate=30.0)),
        surface, np.array([1.5, 0.5]) + np.zeros((surface.num_vertices, 1)),
    )  # fmt: skip
    data = ltl.Observations(experiment(dict(a=0.1, b=0.9, d=10.0), times).us, 1e-3, times)
    fit = ltl.fit(experiment, dict(a=0.13, b=0.7, d=7.0), data, transforms=ltl.inverse.Positive())
    assert fit.singular_values[-1] < 1e-3 * fit.singular_values[0]
    assert "d alone" in fit.summary()
    [sentence] = fit.evidence.cannot_tell
    assert "not seen at all" in sentence or "less than the errors that adaptive steps may have" in sentence


def test_losses_along_a_parameter_show_where_the_loss_is_not_quadratic():
    plt = pytest.importorskip("matplotlib.pyplot")
    early = np.linspace(0, 0.5, 12)
    model = lambda p: p["size"] * (1 - jnp.exp(-p["rate"] * early))  # noqa: E731
    values = 2 * (1 - np.exp(-early)) + 0.03 * np.random.default_rng(1).normal(size=12)
    fit = ltl.fit(model, dict(size=2.0, rate=1.0), ltl.Observations(values, 0.03), transforms=ltl.inverse.Positive())
    deviations = np.array([-2.0, 0.0, 2.0])
    rise = fit.losses_along("rate", deviations) - fit.loss
    assert rise[1] == pytest.approx(0, abs=1e-9)
    assert np.abs(rise[[0, 2]] / 2 - 1).max() > 0.5
    figure = fit.plot()
    assert "not quadratic" in [axes.get_title() for axes in figure.axes]
    plt.close(figure)
    linear = ltl.fit(lambda p: p * jnp.asarray(early), 1.0, ltl.Observations(early, 0.1))
    np.testing.assert_allclose(
        linear.losses_along("parameter", deviations) - linear.loss, deviations**2 / 2, rtol=1e-6, atol=1e-9
    )
    with pytest.raises(ValueError, match="There is no parameter 'b'"):
        linear.losses_along("b", deviations)


def test_the_reduced_chi_square_is_relative_to_the_degrees_of_freedom():
    rng = np.random.default_rng(0)
    design, values = rng.normal(size=(6, 3)), rng.normal(size=6)
    fit = ltl.fit(lambda p: jnp.asarray(design) @ p, np.zeros(3), ltl.Observations(values, 0.5))
    misfit = (values - design @ np.linalg.lstsq(design, values)[0]) / 0.5
    assert fit.agreement.reduced_chi_square == pytest.approx(np.sum(misfit**2) / (6 - 3), rel=1e-6)


def test_the_chi_square_of_counts_is_one_even_for_low_rates():
    for rate in (0.03, 1.0, 30.0):
        sizes, num_inside = [], 0
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
            num_inside += low < sizes[-1] < high
            assert fit.evidence.std[0] == pytest.approx(np.sqrt(counts.mean() / 400), rel=1e-3)
        assert np.mean(sizes) == pytest.approx(1, abs=0.05)
        # If each interval holds the truth with 95 %, at least 18 of 20 do with 92 %.
        assert num_inside >= 18
