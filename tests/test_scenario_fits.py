"""``ltljax fit`` finds the numbers of a scenario file from files of measurements."""

import json
import tomllib

import pytest
from scenario_files import FIT, GUESS, NUM_VERTICES, write_measured

from ltljax._mesh import columns
from ltljax.app import scenario
from ltljax.app.cli import main


def result(folder):
    return json.loads((folder / "fit.json").read_text())


@pytest.mark.parametrize("kind", ["npz", "vtp", "ply", pytest.param("csv", marks=pytest.mark.slow)])
def test_numbers_of_a_file_are_found_from_files_of_data(kind, tmp_path, capsys):
    write_measured(tmp_path, kind)
    (tmp_path / "mine.toml").write_text(GUESS + FIT.replace("npz", kind))
    out = tmp_path / "out"
    assert main(["fit", str(tmp_path / "mine.toml"), "--out", str(out)]) == 0
    assert "The data determine every parameter" in capsys.readouterr().out
    fit = result(out)
    for key, truth in (("kinetics.a", 0.1), ("diffusivity.v", 10.0)):
        assert fit["found"][key] == pytest.approx(truth, rel=0.05)
        assert abs(fit["found"][key] - truth) < 3 * fit["std"][key]
    assert fit["noise"] == pytest.approx(1, abs=0.15)
    assert (out / "fit.png").stat().st_size > 10_000
    assert not (out / "restart").exists()
    fitted = tomllib.loads((out / "fitted.toml").read_text())
    assert fitted["kinetics"]["a"] == fit["found"]["kinetics.a"]
    assert "fit" not in fitted
    assert scenario.read((out / "fitted.toml").read_text(), "fitted", out).fit_task is None


def test_columns_of_a_ply_file_are_all_but_the_positions(tmp_path):
    path = tmp_path / "measured.ply"
    head = "ply\nformat ascii 1.0\nelement vertex 1\n"
    head += "".join(f"property double {name}\n" for name in ("x", "y", "z", "xy", "u")) + "end_header\n"
    path.write_text(head + "1 2 3 4 5\n")
    assert {name: float(values[0]) for name, values in columns.read_columns(path).items()} == dict(xy=4.0, u=5.0)


@pytest.mark.parametrize("key", ["max_iterations", "max_steps"])
def test_the_number_of_iterations_has_a_maximum(key, tmp_path):
    write_measured(tmp_path)
    text = GUESS + FIT.replace("noise = 0.002", f"noise = 0.002\n{key} = 2")
    assert scenario.read(text, "mine", tmp_path).fit_task.max_iterations == 2


def test_all_files_of_a_fit_are_copied_beside_the_results_of_a_run(tmp_path, monkeypatch):
    monkeypatch.setattr("ltljax._output.pictures.can_draw", lambda: False)
    for name in ("early", "late"):
        (tmp_path / f"{name}.csv").write_text("patch,u,v\n0,1.0,0.9\n1,1.1,0.8\n")
    (tmp_path / "patches.csv").write_text("patch\n" + "".join(f"{index % 2}\n" for index in range(NUM_VERTICES)))
    text = FIT.replace("npz", "csv").replace("noise = 0.002", 'noise = 0.002\npatches = "patches.csv"')
    (tmp_path / "mine.toml").write_text(GUESS + text)
    out = tmp_path / "out"
    assert main(["run", str(tmp_path / "mine.toml"), "--t1", "0.1", "--frames", "1", "--out", str(out)]) == 0
    example = scenario.read((out / "scenario.toml").read_text(), "scenario", out)
    assert set(example.files) == {"fit.patches", "fit.data.0.file", "fit.data.1.file"}


def test_an_interrupted_fit_is_resumed_by_the_same_fit_alone(tmp_path, capsys):
    write_measured(tmp_path)
    text = GUESS + FIT
    (tmp_path / "mine.toml").write_text(text.replace("noise = 0.002", "noise = 0.002\nmax_iterations = 2"))
    (tmp_path / "on.toml").write_text(text)
    (tmp_path / "other.toml").write_text(text.replace("noise = 0.002", "noise = 0.004"))
    out = tmp_path / "out"
    assert main(["fit", str(tmp_path / "mine.toml"), "--out", str(out)]) == 0
    interrupted = result(out)
    assert not interrupted["converged"]
    capsys.readouterr()
    assert main(["fit", str(tmp_path / "on.toml"), "--out", str(out)]) == 2
    assert "holds a fit that has not converged. Continue it with --resume" in capsys.readouterr().err
    assert main(["fit", str(tmp_path / "other.toml"), "--resume", "--out", str(out)]) == 2
    assert "holds another fit: its data differ" in capsys.readouterr().err
    # Another first guess makes no difference, since the saved unknowns replace it.
    changes = ["--set", "kinetics.a=0.3", "--resume"]
    assert main(["fit", str(tmp_path / "on.toml"), *changes, "--out", str(out)]) == 0
    fit = result(out)
    assert fit["converged"]
    assert fit["loss"] < interrupted["loss"]
    assert fit["found"]["kinetics.a"] == pytest.approx(0.1, rel=0.05)
    assert not (out / "restart").exists()


def test_a_fit_replaces_only_files_that_a_fit_has_written(tmp_path, capsys):
    write_measured(tmp_path)
    path, out = tmp_path / "fitted.toml", tmp_path / "out"
    path.write_text(GUESS + FIT)
    assert main(["fit", str(path), "--out", str(tmp_path)]) == 2
    assert "which is read" in capsys.readouterr().err
    assert path.read_text() == GUESS + FIT
    out.mkdir()
    (out / "fit.json").write_text('{"of": "another program"}')
    assert main(["fit", str(path), "--out", str(out)]) == 2
    assert "fit.json, which ltljax did not write" in capsys.readouterr().err
