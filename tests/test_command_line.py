"""The command line as a person uses it: what it prints and writes, and what it says of mistakes."""

import json
import subprocess
import sys
import time
import xml.etree.ElementTree

import numpy as np
import pytest
import trimesh

import ltljax as ltl
from ltljax._output import files, pictures
from ltljax.app import run
from ltljax.app.cli import main


@pytest.fixture
def mesh_file(tmp_path):
    """Write a mesh to a PLY and return its path."""

    def write(mesh):
        path = tmp_path / "mesh.ply"
        files.write_ply(path, mesh.vertices, mesh.faces, np.full((mesh.num_vertices, 4), 255, np.uint8))
        return str(path)

    return write


def fails(capsys, *arguments):
    """The exit code and the standard error of a run that fails."""
    try:
        code = main(list(arguments))
    except SystemExit as stop:
        code = stop.code
    return code, capsys.readouterr().err


def test_a_run_writes_picture_animation_series_surface_and_summary(tmp_path, mesh_file, capsys):
    out = tmp_path / "out"
    mesh = ltl.shapes.icosphere(3)
    assert main(["run", "turing", "--mesh", mesh_file(mesh), "--out", str(out), "--frames", "4"]) == 0
    assert {p.name for p in out.iterdir()} == {
        ".ltljax", "turing.png", "turing.mp4", "turing.glb", "turing.html", "turing.pvd", "turing.ply", "series",
        "summary.json",
    }  # fmt: skip
    summary = json.loads((out / "summary.json").read_text())
    assert summary["mesh"]["vertices"] == 642
    assert summary["versions"]["jax"]
    assert summary["options"]["seed"] == 0
    assert summary["failure"] is None
    assert 30 <= summary["measured"]["maxima_of_u2"] <= 60
    printed = capsys.readouterr()
    assert "scaled by" in printed.out
    assert "maxima of u2" in printed.out
    assert "100%" in printed.err
    saved = trimesh.load(out / "turing.ply", process=False)
    assert saved.visual.vertex_colors.shape == (642, 4)
    assert len(np.unique(saved.visual.vertex_colors, axis=0)) > 50


def test_the_series_is_read_back_by_vtk_to_the_last_bit(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    mesh = ltl.shapes.icosphere(2)
    fields = {"u": np.arange(162.0), "X": np.random.default_rng(0).normal(size=(162, 3)).astype(np.float32)}
    files.write_vtp(tmp_path / "a.vtp", mesh.vertices, mesh.faces, fields)
    files.write_series(tmp_path / "a.pvd", np.array([0.5]), ["a.vtp"])
    read = pyvista.PVDReader(tmp_path / "a.pvd").read()[0]
    np.testing.assert_array_equal(read.points, mesh.vertices)
    np.testing.assert_array_equal(read.regular_faces, mesh.faces)
    for name, values in fields.items():
        np.testing.assert_array_equal(read[name], values)
    entry = xml.etree.ElementTree.parse(tmp_path / "a.pvd").getroot()[0][0]
    assert entry.attrib == {"timestep": "0.5", "file": "a.vtp"}


def test_results_come_in_the_order_of_the_file(tmp_path, monkeypatch):
    monkeypatch.setattr("ltljax._output.pictures.can_draw", lambda: False)
    sphere = ltl.shapes.icosphere(2)
    order = np.random.default_rng(0).permutation(sphere.num_vertices)
    shuffled = tmp_path / "shuffled.obj"
    faces = np.argsort(order)[sphere.faces] + 1
    lines = [*("v {} {} {}".format(*v) for v in sphere.vertices[order]), *("f {} {} {}".format(*f) for f in faces)]
    shuffled.write_text("\n".join(lines))
    arguments = ["run", "heat", "--mesh", str(shuffled), "--keep-scale", "--frames", "2", "--t1", "0.5"]
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 0
    written = ltl.load_mesh(tmp_path / "out" / "heat.ply")
    np.testing.assert_allclose(written.vertices, sphere.vertices[order], atol=1e-6)
    np.testing.assert_array_equal(written.faces, faces - 1)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--mesh", "sphere"], "relative error L2"),
        (["--mesh", "torus", "--source", "sine"], "relative error L2"),
        (["--mesh", "torus"], "ranges over +-2.1257"),
        (["--mesh", "torus", "--source", "angle"], "the mean of u grows like pi t"),
    ],
)
def test_heat_reaches_its_stationary_state(tmp_path, capsys, monkeypatch, arguments, says):
    monkeypatch.setattr(pictures, "can_draw", lambda: False)
    assert main(["run", "heat", *arguments, "--out", str(tmp_path), "--frames", "2"]) == 0
    printed = capsys.readouterr().out
    assert says in printed
    measured = json.loads((tmp_path / "summary.json").read_text())["measured"]
    if "relative_error_L2" in measured:
        assert measured["relative_error_L2"] < 2e-3
    elif "angle" in arguments:
        assert measured["mass_at_end"][0] == pytest.approx(np.pi * 10 * 8 * np.pi**2, rel=0.03)
    else:
        np.testing.assert_allclose(measured["range_of_u"], (-2.1257, 2.1257), rtol=5e-3)


def test_the_published_turing_parameters_stay_uniform(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(pictures, "can_draw", lambda: False)
    arguments = ["run", "turing", "--as-published", "--mesh", "torus", "--out", str(tmp_path), "--frames", "1"]
    assert main(arguments) == 0
    assert "stays uniform and tends to (1, 16)" in capsys.readouterr().out
    measured = json.loads((tmp_path / "summary.json").read_text())["measured"]
    assert measured["maxima_of_u2"] == 0
    assert measured["relative_error_max"] < 1e-3


def test_without_the_picture_extra_a_run_goes_through_and_says_how_to_get_it(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(pictures, "can_draw", lambda: False)
    monkeypatch.setitem(sys.modules, "tqdm", None)
    assert main(["run", "heat", "--out", str(tmp_path), "--frames", "20", "--dtype", "float64"]) == 0
    printed = capsys.readouterr()
    assert 'pip install "ltljax[viz]"' in printed.out
    assert "s left" in printed.err
    assert (tmp_path / "heat.pvd").exists()
    assert not (tmp_path / "heat.png").exists()


def run_heat(tmp_path, *arguments):
    assert main(["run", "heat", *arguments, "--frames", "2", "--out", str(tmp_path)]) == 0
    return json.loads((tmp_path / "summary.json").read_text())["measured"]


def test_heat_in_a_disk_keeps_to_its_boundary_conditions(tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "can_draw", lambda: False)
    # Stationary for the source x: x (1 - r^2) / 8 where u = 0, x (3 - r^2) / 8 where nothing flows, and with
    # u + du/dnu = 0 x (2 - r^2) / 8: the largest values are at r = 1 / sqrt(3), 1 and sqrt(2 / 3).
    largest = {"dirichlet=0": 3**-1.5 / 4, "neumann=0@0": 1 / 4, "robin=1,1,0": (2 / 3) ** 1.5 / 4}
    for condition, value in largest.items():
        measured = run_heat(tmp_path, "--mesh", "disk", "--boundary", condition)
        np.testing.assert_allclose(measured["range_of_u"], [-value, value], rtol=1e-2)


def test_heat_without_flux_keeps_its_mass(tmp_path, real_mesh, monkeypatch):
    monkeypatch.setattr(pictures, "can_draw", lambda: False)
    measured = run_heat(tmp_path, "--mesh", str(real_mesh("hand_open.obj")))
    assert abs(measured["mass_at_end"][0]) < 1e-10


def test_the_polynomial_scheme_says_where_it_grows(tmp_path, mesh_file, capsys, monkeypatch):
    monkeypatch.setattr(pictures, "can_draw", lambda: False)
    assert run_heat(tmp_path, "--scheme", "polynomial", "--t1", "0.5")["relative_error_L2"] < 1e-3
    path = mesh_file(ltl.shapes.random_sphere(642, seed=0))
    arguments = ["run", "heat", "--mesh", path, "--scheme", "polynomial", "--degree", "3", "--out", str(tmp_path)]
    assert main(arguments) == 1
    printed = capsys.readouterr()
    assert printed.out.count("note: Modes of this Laplacian grow like") == 1
    assert "use ltl.Monotone()" in printed.err


def test_the_published_scheme_on_an_irregular_mesh_stops_with_its_time_and_reason(tmp_path, mesh_file, capsys):
    path, out = mesh_file(ltl.shapes.jittered_sphere(3, 0.3, seed=0)), tmp_path / "out"
    code, said = fails(capsys, "run", "heat", "--mesh", path, "--scheme", "paper", "--out", str(out), "--frames", "5")
    assert code == 1
    assert "overflowed at t = " in said
    assert "has growing modes on such meshes" in said.splitlines()[-1]
    assert "overflowed" in json.loads((out / "summary.json").read_text())["failure"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["run", "cooking"], "found 'cooking'"),
        (["run", "heat", "--mesh", "nowhere.obj"], "nowhere.obj"),
        (["run", "heat", "--t1", "-1"], "expected a positive number, found '-1'"),
        (["run", "heat", "--t1", "nan"], "expected a positive number"),
        (["run", "heat", "--boundary", "neumann=1"], "needs a mesh with a boundary; the sphere is closed"),
        (["run", "heat", "--mesh", "disk", "--boundary", "robin=1,2"], "robin=A,B,G"),
        (["run", "heat", "--mesh", "disk", "--boundary", "robin=1,0,2"], "b not 0"),
        (["run", "heat", "--mesh", "disk", "--boundary", "dirichlet=hot"], "found 'dirichlet=hot'"),
        (["run", "heat", "--mesh", "disk", "--boundary", "dirichlet=0@1"], "expected a loop below 1"),
        (["run", "turing", "--boundary", "neumann=1"], "--boundary belongs to heat"),
        (["run", "heat", "--degree", "3"], "--degree 3 needs --scheme polynomial"),
        (["run", "heat", "--frames", "0"], "expected a whole number from 1"),
        (["run", "heat", "--seed", "x"], "expected a whole number from 0"),
        (["run", "heat", "--source", "sine"], "needs --mesh torus"),
        (["run", "turing", "--source", "sine"], "belongs to heat"),
        (["run", "heat", "--as-published"], "belongs to turing"),
        (["run", "heat", "--dtype", "float16"], "invalid choice"),
        (["info", "."], "ltljax: "),
        ([], "the following arguments are required: COMMAND"),
    ],
)
def test_a_wrong_argument_gets_one_line_and_exit_code_two(capsys, arguments, says):
    code, said = fails(capsys, *arguments)
    assert code == 2
    assert says in said
    assert len(said.strip().splitlines()) == 1
    assert "Traceback" not in said


def test_an_output_folder_that_cannot_be_made_is_one_line_too(tmp_path, capsys):
    (tmp_path / "taken").write_text("")
    code, said = fails(capsys, "run", "heat", "--out", str(tmp_path / "taken"))
    assert code == 2
    assert len(said.strip().splitlines()) == 1


def test_info_prints_the_report_and_list_the_scenarios(capsys, mesh_file):
    assert main(["info", mesh_file(ltl.shapes.icosphere(2))]) == 0
    assert "162" in capsys.readouterr().out
    assert main(["list"]) == 0
    assert "turing" in capsys.readouterr().out


def test_a_float32_run_needs_no_float64(tmp_path):
    arguments = ["run", "heat", "--dtype", "float32", "--frames", "2", "--out", str(tmp_path)]
    code = f"import ltljax._output.pictures as p; p.can_draw = lambda: False; import ltljax.app.cli as c; c.main({arguments})"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    measured = json.loads((tmp_path / "summary.json").read_text())["measured"]
    assert measured["relative_error_L2"] < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["spot.obj", "armadillo.obj", "hand_open.obj", "spot_low.obj"])
def test_real_meshes_get_their_spots(tmp_path, real_mesh, monkeypatch, name):
    monkeypatch.setattr(pictures, "can_draw", lambda: False)
    assert main(["run", "turing", "--mesh", str(real_mesh(name)), "--out", str(tmp_path), "--frames", "2"]) == 0
    measured = json.loads((tmp_path / "summary.json").read_text())["measured"]
    assert 35 <= measured["maxima_of_u2"] <= 60


@pytest.mark.slow
def test_the_published_scheme_overflows_on_spot(tmp_path, real_mesh, capsys, monkeypatch):
    monkeypatch.setattr(pictures, "can_draw", lambda: False)
    mesh = str(real_mesh("spot.obj"))
    code, said = fails(capsys, "run", "turing", "--mesh", mesh, "--scheme", "paper", "--out", str(tmp_path))
    assert code == 1
    assert "overflowed at t = 0.0" in said


def test_an_interrupted_run_is_resumed_to_the_same_results(tmp_path, mesh_file, capsys, monkeypatch):
    monkeypatch.setattr(pictures, "can_draw", lambda: False)
    arguments = ["run", "turing", "--mesh", mesh_file(ltl.shapes.icosphere(2)), "--t1", "2", "--frames", "5"]
    assert main([*arguments, "--out", str(tmp_path / "whole")]) == 0
    calls = []

    def interrupted(*given, **named):
        calls.append(given)
        if len(calls) == 4:  # one to compile, two frames
            raise KeyboardInterrupt
        time.sleep(0.3)
        return ltl.solve(*given, **named)

    pieces = [*arguments, "--out", str(tmp_path / "pieces")]
    with monkeypatch.context() as patched:
        patched.setattr(sys.modules["ltljax.app.run"], "solve", interrupted)
        assert main(pieces) == 130
    assert (tmp_path / "pieces" / "restart" / "run.json").exists()
    assert "Go on with the same command and --resume, or start over with --overwrite." in capsys.readouterr().err
    code, error = fails(capsys, *pieces)
    assert code == 2
    assert "holds a run that has not ended, at t = 0.8. Continue it with --resume, start over with --overwrite" in error
    code, error = fails(capsys, *pieces, "--resume", "--seed", "5")
    assert code == 2
    assert "another scenario" in error
    assert main([*pieces, "--resume"]) == 0
    assert "going on from t = 0.8" in capsys.readouterr().out
    assert not (tmp_path / "pieces" / "restart").exists()
    for name in ("turing.ply", "series/turing_0005.vtp"):
        assert (tmp_path / "pieces" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    summaries = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("pieces", "whole")]
    assert summaries[0]["measured"]["steps"] == summaries[1]["measured"]["steps"]
    # The time of both legs counts, and the steps of both are divided by it.
    assert summaries[0]["measured"]["step_seconds"] >= 0.6


def test_info_describes_what_is_not_acceptable_too(real_mesh, tmp_path, capsys):
    assert main(["info", str(real_mesh("moebius.obj"))]) == 0
    said = capsys.readouterr().out
    assert "not acceptable as it is: moebius.obj: The surface is not orientable" in said
    assert "with --repair:" in said
    assert "cut along" in said
    (tmp_path / "a.obj").write_text("v 0 0 0\n")
    code, error = fails(capsys, "info", str(tmp_path / "a.obj"))
    assert code == 2
    assert "no faces" in error


def test_times_in_captions_are_numbers_as_people_write_them():
    assert [run._short(t) for t in (0.0, 0.25, 1000.0, 40.0, 123456.0, 1e-5, 2e7)] == [
        "0", "0.25", "1000", "40", "123000", "1e-05", "2e+07",
    ]  # fmt: skip
