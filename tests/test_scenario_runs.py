"""A run of a scenario writes its results, which repeat it, and replaces no file of the user."""

import json
import tomllib

import imageio.v3
import numpy as np
import pytest
import trimesh
from scenario_files import PLAIN, REACTION, SPHERE, START, changed, write_ball

import ltljax as ltl
from ltljax._output import files
from ltljax.app.cli import main

# One frame of a run that hardly begins.
SHORT = ["--t1", "0.01", "--frames", "1"]
# A scenario of the library with the mesh and the reaction of the plain one, which is compiled once for all tests.
SMALL = ["schnakenberg", "--mesh", "sphere", "--set", "mesh.subdivisions=1", *SHORT]


@pytest.fixture
def no_pictures(monkeypatch):
    monkeypatch.setattr("ltljax._output.pictures.can_draw", lambda: False)


def summary(folder):
    return json.loads((folder / "summary.json").read_text())


def test_a_resolved_scenario_gives_the_same_numbers_again(tmp_path, no_pictures):
    folder = tmp_path / "mine"
    write_ball(folder / "balls" / "ball.obj")
    # The mesh and the start have the same name, in folders of their own, and the start is a link.
    np.savez(folder / "start.npz", **{name: np.linspace(0.9, 1.1, 200) for name in "uv"})
    (folder / "starts").mkdir()
    (folder / "starts" / "ball.obj").symlink_to(folder / "start.npz")
    text = changed(SPHERE, 'file = "balls/ball.obj"')
    (folder / "my.toml").write_text(changed(START, 'file = "starts/ball.obj"', text))
    first, second = tmp_path / "first", tmp_path / "second"
    assert main(["run", str(folder / "my.toml"), "--out", str(first), "--set", "kinetics.a=0.12"]) == 0
    for path in folder.rglob("*.obj"):
        path.unlink()
    assert main(["run", str(first / "scenario.toml"), "--out", str(second)]) == 0
    states = first / "series/my_0002.vtp", second / "series/scenario_0002.vtp"
    assert states[0].read_bytes() == states[1].read_bytes()
    assert tomllib.loads((first / "scenario.toml").read_text())["kinetics"]["a"] == 0.12


def test_results_replace_neither_inputs_nor_files_of_the_user(tmp_path, capsys, monkeypatch, no_pictures):
    monkeypatch.chdir(tmp_path)
    write_ball(tmp_path / "my.ply")
    mesh = (tmp_path / "my.ply").read_bytes()
    (tmp_path / "my.toml").write_text(changed(SPHERE, 'file = "my.ply"'))
    assert main(["run", "my.toml", "--out", "."]) == 2
    assert "would replace my.ply, which is read" in capsys.readouterr().err
    # The results of an earlier run are replaced.
    assert main(["run", "schnakenberg", "--mesh", "my.ply", *SHORT, "--out", "other"]) == 0
    assert main(["run", "my.toml", "--out", "other"]) == 0
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "my.glb").write_text("of the user")
    assert main(["run", "my.toml", "--out", "mine"]) == 2
    assert "my.glb, which ltljax did not write" in capsys.readouterr().err
    assert main(["run", "other/scenario.toml", "--out", "other"]) == 2
    assert "scenario.toml, which is read" in capsys.readouterr().err
    assert (tmp_path / "my.ply").read_bytes() == mesh
    assert (tmp_path / "other" / "inputs" / "mesh" / "my.ply").read_bytes() == mesh
    assert ltl.load_mesh(tmp_path / "other" / "my.ply").num_vertices == 200


def test_a_built_in_mesh_takes_changes(tmp_path, no_pictures):
    assert main(["run", *SMALL, "--out", str(tmp_path)]) == 0
    assert summary(tmp_path)["mesh"]["vertices"] == 42


def test_any_letters_may_name_files_and_species(tmp_path, no_pictures):
    text = changed(REACTION, "[reactions]\ndself = '-self'\n'dü' = 0\n")
    text = text.replace("u = 1.0\nv = 10.0", 'self = 1.0\n"ü" = 2.0').replace("v = 0.9", '"ü" = "noise"')
    path = tmp_path / "müsli 図.toml"
    path.write_text(text.replace('u = "1 + 0.1*noise"', 'self = "x"'), encoding="utf-8")
    assert main(["run", str(path), "--out", str(tmp_path / "out")]) == 0
    series = (tmp_path / "out" / "müsli-図.pvd").read_text(encoding="utf-8")
    assert 'file="series/müsli-図_0002.vtp"' in series
    pyvista = pytest.importorskip("pyvista")
    (blocks,) = pyvista.PVDReader(tmp_path / "out" / "müsli-図.pvd").read()
    assert set(blocks.point_data.keys()) == {"self", "ü"}


def test_the_degree_of_the_scheme_is_recorded(tmp_path, no_pictures):
    arguments = ["--scheme", "polynomial", "--degree", "3", "--set", "mesh.subdivisions=2", *SHORT]
    assert main(["run", "allen-cahn", *arguments, "--out", str(tmp_path)]) == 0
    assert tomllib.loads((tmp_path / "scenario.toml").read_text())["solver"]["degree"] == 3
    assert "degree=3" in summary(tmp_path)["scheme"]


def test_a_field_may_be_written_as_a_relief(tmp_path, no_pictures):
    assert main(["run", *SMALL, "--set", "output.displacement=0.5", "--out", str(tmp_path)]) == 0
    (relief,) = trimesh.load(tmp_path / "schnakenberg-displaced.glb", process=False).geometry.values()
    heights = np.linalg.norm(relief.vertices, axis=1)
    np.testing.assert_allclose([heights.min(), heights.max()], [1, 1.5], atol=1e-5)


def test_new_prints_a_file_that_runs(tmp_path, capsys, no_pictures):
    assert main(["new", "schnakenberg"]) == 0
    (tmp_path / "my.toml").write_text(capsys.readouterr().out)
    assert main(["run", str(tmp_path / "my.toml"), *SMALL[1:], "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "scenario.toml").exists()


def test_a_scenario_under_its_old_name_works_with_a_warning(tmp_path, capsys):
    # The mistake stops the run before anything is computed.
    assert main(["run", "turk", "--set", "kinetics.fed=1", "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert "warning: the scenario turk is now called turing-ridges" in error
    assert "turing-ridges: kinetics.fed is not known (did you mean feed?)" in error
    assert main(["new", "turk"]) == 0
    printed = capsys.readouterr()
    assert "warning: the scenario turk is now called turing-ridges" in printed.err
    assert 'name = "turing"' in printed.out


def test_a_scenario_runs_with_fixed_steps_of_sbdf2(tmp_path, no_pictures):
    (tmp_path / "my.toml").write_text(changed("[initial]", '[solver]\nname = "SBDF2"\ndt = 1e-3\n[initial]'))
    assert main(["run", str(tmp_path / "my.toml"), "--out", str(tmp_path / "out"), "--set", "time.end=0.01"]) == 0
    assert summary(tmp_path / "out")["measured"]["reached_time"] == pytest.approx(0.01)


def test_the_view_and_the_size_of_a_texture_are_chosen(tmp_path):
    square = ltl.shapes.square(1.0, 12)
    flat = square.vertices[:, :2] - square.vertices[:, :2].min(axis=0)
    files.write_obj(tmp_path / "a.obj", square.vertices, square.faces, flat[square.faces])
    out = tmp_path / "out"
    arguments = ["run", "fisher-kpp", "--mesh", str(tmp_path / "a.obj"), *SHORT, "--out", str(out)]
    assert main([*arguments, "--view", "top", "--texture", "64", "--scale", "0.5"]) == 0
    assert imageio.v3.imread(out / "textured" / "fisher-kpp.png").shape == (64, 64, 3)
    tables = tomllib.loads((out / "scenario.toml").read_text())
    assert (tables["scale"], tables["output"]["view"], tables["output"]["texture"]) == (0.5, "top", 64)
    # The square lies in the plane z = 0. From above, along y, it is a line, and most of the picture is white.
    assert (imageio.v3.imread(out / "fisher-kpp.png") > 250).all(axis=2).mean() > 0.9


def test_a_command_names_a_mesh_anywhere_and_a_file_only_beside_it(tmp_path, capsys, no_pictures):
    path, toml = tmp_path / "elsewhere" / "a.obj", tmp_path / "inner" / "plain.toml"
    path.parent.mkdir()
    toml.parent.mkdir()
    mesh = ltl.shapes.icosphere(1)
    files.write_obj(path, mesh.vertices, mesh.faces)
    toml.write_text(PLAIN)
    run = ["run", str(toml), "--out", str(tmp_path / "out"), "--frames", "1"]
    assert main([*run, "--set", f"mesh.file={path}"]) == 0
    toml.write_text(changed(SPHERE, f'file = "{path}"'))
    assert main(run) == 2
    assert "give a mesh from elsewhere by --mesh" in capsys.readouterr().err
