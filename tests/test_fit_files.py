"""Fits of scenario files to files of data, and of the shared cases."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl
from ltljax.app import scenario
from ltljax.app.cli import main

NOISE = 0.01
TRUTH = {"kinetics.a": 0.12, "kinetics.b": 0.85, "diffusivity.v": 0.25}
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
[solver]
name = "Tsit5"
dt = 0.05
[fit]
free = ["kinetics.a", "kinetics.b", "diffusivity.v"]
OPTIONS
[[fit.data]]
file = "early.csv"
time = 0.3
[[fit.data]]
file = "late.csv"
"""


def read_scenario(text, folder):
    """The scenario without its table of the fit, its surface, and its states at both times of the data."""
    case = scenario.read(text.split("[fit]")[0], "mine", folder)
    surface = ltl.Surface.from_mesh(case.mesh)
    settings = case.settings
    states = ltl.solve(
        case.make_equation(surface), surface, case.u0, 0.9, ts=[0.3, 0.9], solver=settings.solver, dt=settings.dt
    ).us
    return case, surface, np.asarray(states)


def write_data(folder, places, states, spoil=lambda values, rng: values):
    """Write noisy states to two files, with columns for the places."""
    rng = np.random.default_rng(0)
    for name, state in zip(("early", "late"), states, strict=True):
        values = spoil(state + NOISE * rng.normal(size=state.shape), rng)
        head = ",".join([*places, "u", "v"])
        lines = [
            ",".join("" if np.isnan(x) else f"{x:.9g}" for x in row)
            for row in np.column_stack([*places.values(), values])
        ]
        (folder / f"{name}.csv").write_text("\n".join([head, *lines]) + "\n")


def write_vertices(folder, case, surface, states):
    write_data(folder, {}, states[:, np.asarray(case.mesh.source_order)])


def write_points(folder, case, surface, states):
    points = np.asarray(ltl.shapes.icosphere(3).vertices)[::2]
    states = np.asarray(ltl.inverse.observe_at(surface, points)(states, axis=1))
    write_data(folder, dict(zip("xyz", points.T, strict=True)), states)


def write_patches(folder, case, surface, states):
    numbers = (8 * (np.arctan2(*np.asarray(surface.vertices)[:, :2].T) / np.pi + 1)).astype(int) % 16
    states = np.asarray(ltl.inverse.observe_patches(surface, numbers)(states, axis=1))
    in_file_order = numbers[np.asarray(case.mesh.source_order)]
    (folder / "patches.csv").write_text("patch\n" + "\n".join(map(str, in_file_order)) + "\n")
    write_data(folder, dict(patch=np.arange(16)), states)


def write_sums(folder, case, surface, states):
    weights = np.random.default_rng(3).normal(size=(150, surface.num_vertices))
    np.savez(folder / "weights.npz", weights=weights[:, np.asarray(case.mesh.source_order)])
    dark = 1 + np.arange(150) % 3
    (folder / "dark.csv").write_text("u,v\n" + "\n".join(f"{x},{x}" for x in dark) + "\n")
    write_data(folder, {}, np.einsum("nv,tvs->tns", weights, states) + 0.2 * dark[:, None])


@pytest.mark.parametrize(
    ("options", "write"),
    [
        pytest.param("scale = true\noffset = 0", write_vertices, marks=pytest.mark.slow, id="calibration"),
        pytest.param("noise = 0.01\nrelative_noise = 0.001", write_points, id="points"),
        pytest.param('patches = "patches.csv"', write_patches, id="patches"),
        pytest.param(
            'operator = "weights.npz"\nbackground = "dark.csv"', write_sums, id="operator and background"
        ),
    ],
)  # fmt: skip
def test_a_scenario_file_is_fitted_to_data_at_any_places(tmp_path, options, write):
    text = SCENARIO.replace("OPTIONS", options)
    write(tmp_path, *read_scenario(text, tmp_path))
    (tmp_path / "mine.toml").write_text(text)
    changes = ["--set", "kinetics.a=0.2", "--set", "diffusivity.v=0.4"]
    assert main(["fit", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "out"), *changes]) == 0
    record = json.loads((tmp_path / "out" / "fit.json").read_text())
    assert record["status"] == "converged", record
    assert record["explanation"].startswith("The model explains the data")
    assert all(abs(record["found"][key] - value) < 3 * record["std"][key] for key, value in TRUTH.items())
    assert len(record["agreement"]["outliers"]) < 3


def spoiled(values, rng):
    """The values with 30 % gaps and 5 % outliers."""
    share = rng.random(values.shape)
    return np.where(share < 0.3, np.nan, np.where(share < 0.35, values + 20, values))


def test_new_fit_prints_a_scenario_that_can_be_fitted(tmp_path, capsys):
    assert main(["new", "fit"]) == 0
    text = capsys.readouterr().out.replace("subdivisions = 3", "subdivisions = 2")
    case, _, states = read_scenario(text, tmp_path)
    write_data(tmp_path, {}, states[:, np.asarray(case.mesh.source_order)], spoiled)
    (tmp_path / "my.toml").write_text(text)
    assert main(["fit", str(tmp_path / "my.toml"), "--out", str(tmp_path / "out"), "--set", "kinetics.a=0.2"]) == 0
    assert json.loads((tmp_path / "out" / "fit.json").read_text())["status"] == "converged"
    assert (tmp_path / "out" / "fit.png").exists()


def read_state(name, case_file, mesh):
    """The species u and v in a file of the shared cases, in the order of the mesh."""
    table = np.genfromtxt(case_file(name), delimiter=",", names=True)
    state = np.empty((mesh.num_vertices, 2))
    state[mesh.source_order] = np.stack([table["u"], table["v"]], axis=1)
    return state


def contains_the_rates(fit):
    low, high = fit.intervals
    truth = dict(a=0.12, b=0.85, dv=0.25)
    return all(low[key] <= truth[key] <= high[key] for key in truth)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ltljax.errors.InconsistentRowsWarning")
def test_the_shared_cases_give_the_rates(real_mesh, case_file):
    mesh = ltl.load_mesh(real_mesh("spot_low.obj"))
    times, start = np.array([0.15, 0.45, 0.9]), dict(a=0.15, b=0.7, dv=0.4)
    model = ltl.inverse.Experiment(
        lambda p: ltl.ReactionDiffusion((0.02, p["dv"]), ltl.kinetics.schnakenberg(p["a"], p["b"], rate=10.0)),
        # The data were made with this operator.
        ltl.Surface.from_mesh(mesh, ltl.Monotone(lift="chord")),
        jnp.asarray(read_state("schnakenberg_start.csv", case_file, mesh)),
    )

    def fitted(values, **options):
        data = ltl.Observations(values, times=times, **options)
        return ltl.fit(model, start, data, transforms=ltl.inverse.Positive())

    clean = np.stack([read_state(f"schnakenberg_{k}.csv", case_file, mesh) for k in range(3)])
    assert contains_the_rates(fitted(clean))
    with_gaps, wrong = clean.copy(), clean.copy()
    with_gaps[1] = read_state("schnakenberg_1_missing.csv", case_file, mesh)
    wrong[1] = read_state("schnakenberg_1_outliers.csv", case_file, mesh)
    assert contains_the_rates(fitted(with_gaps))
    robust = fitted(wrong, loss="huber")
    assert contains_the_rates(robust)
    assert robust.converged
    named = {tuple(index) for index in robust.agreement.outliers}
    assert named == {tuple(index) for index in np.argwhere(np.abs(wrong - clean) > 1)}
    assert np.sum(np.abs(wrong - clean) > 1) == 25
    scaled = fitted(2.9 * clean, scale=ltl.inverse.Positive(1.0))
    assert contains_the_rates(scaled)
    np.testing.assert_allclose(scaled.calibration["scale"], 2.9, rtol=2e-3)
    # Without the factor the model explains nothing, which shows after a few iterations.
    data = ltl.Observations(2.9 * clean, times=times)
    lost = ltl.fit(model, start, data, transforms=ltl.inverse.Positive(), max_iterations=10)
    assert lost.summary().startswith("The model explains nothing")
