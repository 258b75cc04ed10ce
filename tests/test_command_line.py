"""The command line as a person uses it: what it prints and writes, and how it reports mistakes."""

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
from ltljax.app.cli import main
from ltljax.app.run_files import short_number


@pytest.fixture
def mesh_file(tmp_path):
    """Writes a mesh to a PLY file and returns its path."""

    def write(mesh):
        path = tmp_path / "mesh.ply"
        files.write_ply(path, mesh.vertices, mesh.faces, np.full((mesh.num_vertices, 4), 255, np.uint8))
        return str(path)

    return write


@pytest.fixture
def no_pictures(monkeypatch):
    monkeypatch.setattr(pictures, "can_draw", lambda: False)


def fails(capsys, *arguments):
    """The exit code and the standard error of a run that fails."""
    try:
        code = main(list(arguments))
    except SystemExit as stop:
        code = stop.code
    return code, capsys.readouterr().err


def measured(folder):
    return json.loads((folder / "summary.json").read_text())["measured"]


@pytest.mark.parametrize(
    "command", [["--help"], ["run", "--help"], ["list"], ["new", "gray-scott"], ["smooth", "--help"]]
)
def test_help_and_lists_answer_without_jax(command):
    code = f"""
import sys
from ltljax.app.cli import main
try:
    main({command})
except SystemExit as stop:
    assert stop.code == 0
loaded = {{"jax", "numpy", "scipy"}} & set(sys.modules)
assert not loaded, loaded
import resource
usage = resource.getrusage(resource.RUSAGE_SELF)
assert usage.ru_utime + usage.ru_stime < 0.3 or {command} != ["--help"], usage
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "scenario" in result.stdout or "mesh" in result.stdout


def test_a_run_writes_picture_animation_series_surface_and_summary(tmp_path, mesh_file, capsys):
    out = tmp_path / "out"
    mesh = ltl.shapes.icosphere(3)
    assert main(["run", "turing", "--mesh", mesh_file(mesh), "--out", str(out), "--frames", "4"]) == 0
    assert {p.name for p in out.iterdir()} == {
        ".ltljax", "turing.png", "turing.mp4", "turing.glb", "turing.html", "turing.pvd", "turing.ply", "series",
        "summary.json", "scenario.toml", "inputs",
    }  # fmt: skip
    summary = json.loads((out / "summary.json").read_text())
    assert summary["mesh"]["vertices"] == 642
    assert summary["versions"]["jax"]
    assert summary["parameters"]["seed"] == 0
    assert summary["failure"] is None
    assert 30 <= summary["measured"]["maxima_of_v"] <= 60
    printed = capsys.readouterr()
    assert "scaled by" in printed.out
    assert "maxima of v" in printed.out
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
    block = pyvista.PVDReader(tmp_path / "a.pvd").read()[0]
    np.testing.assert_array_equal(block.points, mesh.vertices)
    np.testing.assert_array_equal(block.regular_faces, mesh.faces)
    for name, values in fields.items():
        np.testing.assert_array_equal(block[name], values)
    entry = xml.etree.ElementTree.parse(tmp_path / "a.pvd").getroot()[0][0]
    assert entry.attrib == {"timestep": "0.5", "file": "a.vtp"}


def test_results_come_in_the_order_of_the_file(tmp_path, no_pictures):
    sphere = ltl.shapes.icosphere(2)
    order = np.random.default_rng(0).permutation(sphere.num_vertices)
    path = tmp_path / "shuffled.obj"
    faces = np.argsort(order)[sphere.faces]
    files.write_obj(path, sphere.vertices[order], faces)
    arguments = ["run", "heat", "--mesh", str(path), "--keep-scale", "--frames", "1", "--t1", "0.5"]
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 0
    written = ltl.load_mesh(tmp_path / "out" / "heat.ply")
    np.testing.assert_allclose(written.vertices, sphere.vertices[order], atol=1e-6)
    np.testing.assert_array_equal(written.faces, faces)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--mesh", "sphere"], "relative error L2"),
        (["--mesh", "torus", "--source", "sine"], "relative error L2"),
        (["--mesh", "torus"], "ranges over +-2.1257"),
        (["--mesh", "torus", "--source", "angle"], "the mean of u grows like pi t"),
    ],
)
def test_heat_reaches_its_stationary_state(tmp_path, capsys, no_pictures, arguments, expected):
    assert main(["run", "heat", *arguments, "--out", str(tmp_path), "--frames", "1"]) == 0
    assert expected in capsys.readouterr().out
    results = measured(tmp_path)
    if "relative_error_L2" in results:
        assert results["relative_error_L2"] < 2e-3
    elif "angle" in arguments:
        assert results["mass_at_end"][0] == pytest.approx(np.pi * 10 * 8 * np.pi**2, rel=0.03)
    else:
        np.testing.assert_allclose(results["range_of_u"], (-2.1257, 2.1257), rtol=5e-3)


def test_the_published_turing_parameters_stay_uniform(tmp_path, capsys, no_pictures):
    coarse = ["--set", "mesh.n_major=24", "--set", "mesh.n_minor=12"]
    arguments = ["run", "turing", "--as-published", "--mesh", "torus", *coarse, "--out", str(tmp_path), "--frames", "1"]
    assert main(arguments) == 0
    assert "stays uniform and tends to (1, 16)" in capsys.readouterr().out
    assert measured(tmp_path)["maxima_of_v"] == 0
    assert measured(tmp_path)["relative_error_max"] < 1e-3


def run_heat(tmp_path, *arguments):
    assert main(["run", "heat", *arguments, "--frames", "1", "--out", str(tmp_path)]) == 0
    return measured(tmp_path)


def test_without_the_picture_extra_a_run_completes_and_says_how_to_get_it(tmp_path, capsys, monkeypatch, no_pictures):
    monkeypatch.setitem(sys.modules, "tqdm", None)
    arguments = ["--set", "mesh.subdivisions=2", "--t1", "0.1", "--dtype", "float64"]
    assert main(["run", "heat", *arguments, "--frames", "20", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr()
    assert 'pip install "ltljax[viz]"' in printed.out
    assert "s left" in printed.err
    assert (tmp_path / "heat.pvd").exists()
    assert not (tmp_path / "heat.png").exists()


# With the source x the stationary states are x (1 - r^2) / 8 for u = 0, x (3 - r^2) / 8 without flux, and
# x (2 - r^2) / 8 for u + du/dnu = 0. Their largest values are at r = 1 / sqrt(3), 1 and sqrt(2 / 3).
@pytest.mark.parametrize(
    ("condition", "largest"),
    [
        ("dirichlet=0", 3**-1.5 / 4),
        pytest.param("neumann=0@0", 1 / 4, marks=pytest.mark.slow),
        pytest.param("robin=1,1,0", (2 / 3) ** 1.5 / 4, marks=pytest.mark.slow),
    ],
)
def test_heat_in_a_disk_keeps_to_its_boundary_conditions(tmp_path, no_pictures, condition, largest):
    results = run_heat(tmp_path, "--mesh", "disk", "--set", "mesh.rings=20", "--boundary", condition)
    np.testing.assert_allclose(results["range_of_u"], [-largest, largest], rtol=1e-2)


def test_heat_without_flux_keeps_its_mass(tmp_path, real_mesh, no_pictures):
    results = run_heat(tmp_path, "--mesh", str(real_mesh("hand_open.obj")))
    assert abs(results["mass_at_end"][0]) < 1e-10


def test_the_polynomial_scheme_reports_growing_modes(tmp_path, mesh_file, capsys, no_pictures):
    assert run_heat(tmp_path, "--scheme", "polynomial", "--t1", "0.5")["relative_error_L2"] < 1e-3
    path = mesh_file(ltl.shapes.random_sphere(642, seed=0))
    arguments = ["run", "heat", "--mesh", path, "--scheme", "polynomial", "--degree", "3", "--out", str(tmp_path)]
    assert main(arguments) == 1
    printed = capsys.readouterr()
    assert printed.out.count("note: Modes of this Laplacian grow like") == 1
    assert "use ltl.Monotone()" in printed.err


def test_the_published_scheme_on_an_irregular_mesh_stops_with_its_time_and_reason(tmp_path, mesh_file, capsys):
    path, out = mesh_file(ltl.shapes.jittered_sphere(3, 0.3, seed=0)), tmp_path / "out"
    code, error = fails(capsys, "run", "heat", "--mesh", path, "--scheme", "paper", "--out", str(out), "--frames", "5")
    assert code == 1
    assert "overflowed at t = " in error
    assert "has growing modes on such meshes" in error.splitlines()[-1]
    assert "overflowed" in json.loads((out / "summary.json").read_text())["failure"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["run", "cooking"], "found 'cooking'"),
        (["run", "heat", "--mesh", "nowhere.obj"], "nowhere.obj"),
        (["run", "heat", "--t1", "-1"], "expected a positive number, found '-1'"),
        (["run", "heat", "--t1", "nan"], "expected a positive number"),
        (["run", "heat", "--boundary", "neumann=1"], "need a mesh with a boundary; this mesh is closed"),
        (["run", "heat", "--mesh", "disk", "--boundary", "robin=1,2"], "robin=A,B,G"),
        (["run", "heat", "--mesh", "disk", "--boundary", "robin=1,0,2"], "b not 0"),
        (["run", "heat", "--mesh", "disk", "--boundary", "dirichlet=hot"], "found 'dirichlet=hot'"),
        (["run", "heat", "--mesh", "disk", "--boundary", "dirichlet=0@1"], "expected a loop below 1"),
        (["run", "turing", "--boundary", "neumann=1"], "turing: boundary.conditions: Boundary conditions need a mesh"),
        (["run", "heat", "--degree", "3"], "needs the scheme polynomial (--scheme polynomial)"),
        (["run", "heat", "--frames", "0"], "expected a whole number from 1"),
        (["run", "heat", "--seed", "x"], "expected a whole number from 0"),
        (["run", "heat", "--source", "sine"], "needs --mesh torus"),
        (["run", "turing", "--source", "sine"], "turing has no variant 'sine'; its variants are"),
        (["run", "heat", "--as-published"], "heat has no variant 'as-published'; its variants are"),
        (["run", "heat", "--dtype", "float16"], "invalid choice"),
        (["info", "."], "ltljax: "),
        ([], "the following arguments are required: COMMAND"),
    ],
)
def test_a_wrong_argument_gets_one_line_and_exit_code_two(capsys, arguments, expected):
    code, error = fails(capsys, *arguments)
    assert code == 2
    assert expected in error
    assert len(error.strip().splitlines()) == 1
    assert "Traceback" not in error


def test_an_output_folder_that_cannot_be_made_is_one_line_too(tmp_path, capsys):
    (tmp_path / "taken").write_text("")
    code, error = fails(capsys, "run", "heat", "--out", str(tmp_path / "taken"))
    assert code == 2
    assert len(error.strip().splitlines()) == 1


def test_info_prints_the_report_and_list_the_scenarios(capsys, mesh_file):
    assert main(["info", mesh_file(ltl.shapes.icosphere(2))]) == 0
    assert "162" in capsys.readouterr().out
    assert main(["list"]) == 0
    assert "turing" in capsys.readouterr().out


def test_a_float32_run_needs_no_float64(tmp_path):
    arguments = ["run", "heat", "--dtype", "float32", "--frames", "1", "--out", str(tmp_path)]
    code = (
        "import ltljax._output.pictures as pictures; pictures.can_draw = lambda: False; "
        f"from ltljax.app.cli import main; main({arguments})"
    )
    result = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert measured(tmp_path)["relative_error_L2"] < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["spot.obj", "armadillo.obj", "hand_open.obj", "spot_low.obj"])
def test_real_meshes_get_their_spots(tmp_path, real_mesh, no_pictures, name):
    assert main(["run", "turing", "--mesh", str(real_mesh(name)), "--out", str(tmp_path), "--frames", "2"]) == 0
    assert 35 <= measured(tmp_path)["maxima_of_v"] <= 60


@pytest.mark.slow
def test_the_published_scheme_overflows_on_spot(tmp_path, real_mesh, capsys, no_pictures):
    mesh = str(real_mesh("spot.obj"))
    code, error = fails(capsys, "run", "turing", "--mesh", mesh, "--scheme", "paper", "--out", str(tmp_path))
    assert code == 1
    assert "overflowed at t = 0.0" in error


def test_an_interrupted_run_is_resumed_to_the_same_results(tmp_path, mesh_file, capsys, monkeypatch, no_pictures):
    arguments = ["run", "turing", "--mesh", mesh_file(ltl.shapes.icosphere(2)), "--t1", "2", "--frames", "5"]
    assert main([*arguments, "--out", str(tmp_path / "whole")]) == 0
    calls = []

    def interrupted(*positional, **named):
        calls.append(positional)
        if len(calls) == 4:  # after compiling and two frames
            raise KeyboardInterrupt
        time.sleep(0.3)
        return ltl.solve(*positional, **named)

    pieces = [*arguments, "--out", str(tmp_path / "pieces")]
    with monkeypatch.context() as patched:
        patched.setattr(sys.modules["ltljax.app.run"], "solve", interrupted)
        assert main(pieces) == 130
    assert (tmp_path / "pieces" / "restart" / "run.json").exists()
    advice = "Continue with the same command and --resume, or start over with --overwrite."
    assert advice in capsys.readouterr().err
    code, error = fails(capsys, *pieces)
    assert code == 2
    assert "holds a run that has not ended, at t = 0.8. Continue it with --resume, start over with --overwrite" in error
    code, error = fails(capsys, *pieces, "--resume", "--seed", "5")
    assert code == 2
    assert "differ in scenario" in error
    assert main([*pieces, "--resume"]) == 0
    assert "continuing from t = 0.8" in capsys.readouterr().out
    assert not (tmp_path / "pieces" / "restart").exists()
    for name in ("turing.ply", "series/turing_0005.vtp"):
        assert (tmp_path / "pieces" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert measured(tmp_path / "pieces")["steps"] == measured(tmp_path / "whole")["steps"]
    # The time and the steps of both parts count.
    assert measured(tmp_path / "pieces")["step_seconds"] >= 0.6


def test_info_describes_meshes_with_defects_too(real_mesh, tmp_path, capsys):
    assert main(["info", str(real_mesh("moebius.obj"))]) == 0
    printed = capsys.readouterr().out
    assert "not acceptable as it is: moebius.obj: The surface is not orientable" in printed
    assert "with --repair:" in printed
    assert "cut along" in printed
    (tmp_path / "a.obj").write_text("v 0 0 0\n")
    code, error = fails(capsys, "info", str(tmp_path / "a.obj"))
    assert code == 2
    assert "no faces" in error


def test_times_in_captions_are_numbers_as_people_write_them():
    assert [short_number(t) for t in (0.0, 0.25, 1000.0, 40.0, 123456.0, 1e-5, 2e7)] == [
        "0", "0.25", "1000", "40", "123000", "1e-05", "2e+07",
    ]  # fmt: skip
