"""Reaction rates from snapshots, on 2562 vertices and on a cow, from starts 30 % off."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import ltljax as ltl

MESHES = Path(__file__).parents[2] / "shared" / "meshes"


def built(where):
    if where == "sphere":
        return ltl.Surface.from_mesh(ltl.shapes.icosphere(4))
    if not (MESHES / "spot.obj").exists():
        pytest.skip("the folder of real meshes is not at hand")
    mesh = ltl.load_mesh(MESHES / "spot.obj").reordered()
    return ltl.Surface.from_mesh(mesh.scaled(np.sqrt(4 * np.pi / mesh.area)))


def waves(surface):
    rng = np.random.default_rng(0)
    x = np.asarray(surface.vertices)
    return np.sin(x @ (5 * rng.normal(size=(3, 40))) + rng.uniform(0, 2 * np.pi, 40)).sum(axis=1) / np.sqrt(20)


def schnakenberg(surface):
    u0 = np.array([1.0, 0.9]) + 0.1 * waves(surface)[:, None] * np.array([1.0, -1.0])
    experiment = ltl.Experiment(
        lambda p: ltl.ReactionDiffusion((1.0, p["d"]), ltl.kinetics.schnakenberg(p["a"], p["b"], rate=30.0)),
        surface, u0,
    )  # fmt: skip
    return experiment, dict(a=0.1, b=0.9, d=10.0), dict(a=0.13, b=0.63, d=7.0), np.array([0.1, 0.25, 0.5])


def gray_scott(surface):
    push = np.clip(waves(surface), 0, 1)
    experiment = ltl.Experiment(
        lambda p: ltl.ReactionDiffusion((2e-3, 1e-3), ltl.kinetics.gray_scott(p["feed"], p["kill"])),
        surface, np.stack([1 - 0.5 * push, 0.5 * push], axis=1),
    )  # fmt: skip
    return experiment, dict(feed=0.04, kill=0.06), dict(feed=0.052, kill=0.042), np.array([20.0, 60.0, 120.0])


PROBLEMS = {"schnakenberg": schnakenberg, "gray-scott": gray_scott}


def errors(found, truth):
    return max(abs(float(found.params[key]) / truth[key] - 1) for key in truth)


@pytest.mark.parametrize("where", ["sphere", pytest.param("spot", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", PROBLEMS)
def test_rates_are_recovered_from_clean_snapshots_30_percent_off(name, where):
    experiment, truth, start, times = PROBLEMS[name](built(where))
    data = ltl.Observations(experiment(truth, times).us, times=times)
    found = ltl.fit(experiment, start, data, transforms=ltl.Positive())
    assert found.converged
    assert errors(found, truth) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("where", ["sphere", "spot"])
@pytest.mark.parametrize("name", PROBLEMS)
def test_with_noise_of_one_percent_the_truth_is_in_the_interval(name, where):
    experiment, truth, start, times = PROBLEMS[name](built(where))
    clean = np.asarray(experiment(truth, times).us)
    level = 0.01 * clean.std()
    inside = dict.fromkeys(truth, 0)
    for seed in range(20):
        values = clean + level * np.random.default_rng(seed).normal(size=clean.shape)
        found = ltl.fit(experiment, start, ltl.Observations(values, level, times), transforms=ltl.Positive())
        assert errors(found, truth) < 0.03
        low, high = found.intervals
        for key, value in truth.items():
            inside[key] += bool(low[key] < value < high[key])
    print(name, where, inside)
    # 18 of 20 for the set as a whole; one parameter by itself may have a worse seed.
    assert np.mean(list(inside.values())) >= 18
    assert min(inside.values()) >= 17


@pytest.mark.slow
def test_eight_unknowns_take_a_fifth_of_the_runs_that_finite_differences_take():
    surface = built("sphere")
    x = surface.vertices
    u0 = np.array([1.0, 0.9]) + 0.1 * waves(surface)[:, None] * np.array([1.0, -1.0])
    times = np.array([0.1, 0.25, 0.5])

    def equation(p):
        kinetics = ltl.kinetics.schnakenberg(p["a"], p["b"] * jnp.exp(x @ p["tilt"]), rate=p["rate"])
        return ltl.ReactionDiffusion((p["du"], p["dv"]), kinetics)

    experiment = ltl.Experiment(equation, surface, u0)
    truth = dict(a=0.1, b=0.9, du=1.0, dv=10.0, rate=30.0, tilt=np.array([0.1, -0.05, 0.02]))
    start = dict(a=0.12, b=0.8, du=1.2, dv=8.5, rate=27.0, tilt=np.zeros(3))
    data = ltl.Observations(experiment(truth, times).us, times=times)
    ours = ltl.fit(experiment, start, data)
    flat, rebuild = jax.flatten_util.ravel_pytree(jax.tree.map(jnp.asarray, start))
    residuals = jax.jit(lambda z: data.misfit(experiment(rebuild(z), times)))
    runs = 0

    def counted(z):
        nonlocal runs
        runs += 1
        return np.asarray(residuals(z))

    theirs = optimize.least_squares(counted, np.asarray(flat), x_scale=np.maximum(np.abs(flat), 0.1), xtol=1e-8)
    wanted = jax.flatten_util.ravel_pytree(truth)[0]
    np.testing.assert_allclose(jax.flatten_util.ravel_pytree(ours.params)[0], wanted, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(theirs.x, wanted, rtol=1e-3, atol=1e-4)
    print(f"{ours.num_steps} runs with derivatives, {runs} without")
    assert runs >= 5 * ours.num_steps


@pytest.mark.slow
def test_a_source_of_two_bumps_is_found_on_a_rabbit():
    if not (MESHES / "bunny_closed.obj").exists():
        pytest.skip("the folder of real meshes is not at hand")
    mesh = ltl.load_mesh(MESHES / "bunny_closed.obj")
    mesh = mesh.scaled(np.sqrt(4 * np.pi / mesh.area))
    with pytest.warns(ltl.InconsistentRowsWarning):  # eight of 3,301
        surface = ltl.Surface.from_mesh(mesh)
    mass = surface.mass
    centres = [int(mesh.vertices[:, 1].argmax()), int(mesh.vertices[:, 0].argmin())]
    distances = [np.asarray(ltl.geodesic_distance(surface, [centre])) for centre in centres]
    truth = sum(np.exp(-((d / 0.25) ** 2)) for d in distances)
    clean = np.asarray(ltl.screened_poisson(surface, truth, 1.0))
    level = 0.01 * clean.std()
    data = ltl.Observations(clean + level * np.random.default_rng(0).normal(size=clean.shape), level)

    def with_weight(weight, start):
        return ltl.fit(
            lambda p: ltl.screened_poisson(surface, p["source"], 1.0),
            dict(source=np.zeros(len(truth))) if start is None else start, data,
            penalty=lambda p: ltl.smoothness(surface, p["source"], weight, mass, order=2), max_steps=400,
        )  # fmt: skip

    _, found, _ = ltl.choose_weight(with_weight, [300.0, 100.0, 30.0, 10.0, 3.0, 1.0])
    source = np.asarray(found.params["source"])
    weight = np.asarray(mass)
    error = np.sqrt(weight @ (source - truth) ** 2 / (weight @ truth**2))
    step = float(np.linalg.norm(np.diff(mesh.vertices[mesh.edges], axis=1), axis=-1).mean())
    off = [d[np.where(d < 0.5, source, -np.inf).argmax()] for d in distances]
    print(f"relative L2 error {error:.3f}, centres off by {np.array(off) / step} mesh sizes")
    assert error < 0.15
    assert max(off) < 2 * step
