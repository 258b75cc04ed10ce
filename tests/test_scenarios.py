"""A scenario file says everything, runs as it says, and a mistake in it is one line that names file, key and cause."""

import json
import tomllib
import tracemalloc
from pathlib import Path

import imageio.v3
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import ltljax as ltl
from ltljax._mesh import columns
from ltljax._output import files
from ltljax.app import scenario
from ltljax.app.cli import main
from ltljax.app.scenario.written import KINETICS

PLAIN = """
[mesh]
shape = "sphere"
subdivisions = 2
[kinetics]
name = "schnakenberg"
rate = 30.0
[diffusivity]
u = 1.0
v = 10.0
[initial]
u = "1 + 0.1*noise"
v = 0.9
[time]
end = 0.1
frames = 2
"""


@pytest.mark.parametrize("name", scenario.library())
def test_every_scenario_of_the_library_can_be_read_and_its_state_changes(name, tmp_path):
    text = scenario.library()[name]
    coarse = {"mesh.n_major": 24, "mesh.n_minor": 12} if "torus" in text else {"mesh.subdivisions": 2}
    example = scenario.read(text, name, tmp_path, coarse)
    surface = ltl.Surface.from_mesh(example.mesh)
    equation = example.make_equation(surface)
    rate = equation.rate(jnp.array(0.0), surface, jnp.asarray(example.u0))
    assert rate.shape == example.u0.shape == (surface.num_vertices, len(example.species))
    assert np.isfinite(rate).all()
    assert float(jnp.abs(rate).max()) > 0


def test_the_library_shows_every_kinetics():
    names = {tomllib.loads(text).get("kinetics", {}).get("name") for text in scenario.library().values()}
    assert set(KINETICS) <= names
    assert "cahn-hilliard" in names


def test_a_written_reaction_is_the_named_one(tmp_path):
    named = scenario.read(PLAIN, "named", tmp_path)
    text = PLAIN.replace(
        '[kinetics]\nname = "schnakenberg"\nrate = 30.0',
        """
[reactions]
du = "rate*(a - u + u^2*v)"
dv = "rate*(b - u^2*v)"
[parameters]
a = 0.1
b = "0.9 + 0*x"
rate = 30""",
    )
    written = scenario.read(text, "written", tmp_path)
    surface = ltl.Surface.from_mesh(named.mesh)
    u = jnp.asarray(named.u0)
    np.testing.assert_array_equal(named.u0, written.u0)
    rates = [example.make_equation(surface).rate(jnp.array(0.0), surface, u) for example in (named, written)]
    np.testing.assert_allclose(*rates, rtol=1e-9, atol=1e-9)


def test_directions_and_flows_become_operators(tmp_path):
    text = PLAIN + '[direction]\nfield = ["-y", "x", "0"]\nspecies = ["u"]\n[flow]\nvelocity = ["-y", "x", 0]\n'
    equation = scenario.read(text, "flowing", tmp_path)
    surface = ltl.Surface.from_mesh(equation.mesh)
    spreads = equation.make_equation(surface).diffusivity
    assert all(isinstance(spread, ltl.operators.EllipticStencil) for spread in spreads)


def saved_ball(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    ball = ltl.shapes.random_sphere(200, seed=0)
    trimesh.Trimesh(ball.vertices, ball.faces, process=False).export(path)


@pytest.fixture
def no_pictures(monkeypatch):
    monkeypatch.setattr("ltljax._output.pictures.can_draw", lambda: False)


def test_a_resolved_scenario_gives_the_same_numbers_again(tmp_path, no_pictures):
    saved_ball(tmp_path / "mine" / "balls" / "ball.obj")
    # Both files by the same name, in folders of their own, one of them through a link.
    np.savez(tmp_path / "mine" / "kept.npz", **{name: np.linspace(0.9, 1.1, 200) for name in "uv"})
    (tmp_path / "mine" / "starts").mkdir()
    (tmp_path / "mine" / "starts" / "ball.obj").symlink_to(tmp_path / "mine" / "kept.npz")
    text = PLAIN.replace('shape = "sphere"\nsubdivisions = 2', 'file = "balls/ball.obj"')
    text = text.replace('u = "1 + 0.1*noise"\nv = 0.9', 'file = "starts/ball.obj"')
    (tmp_path / "mine" / "my.toml").write_text(text)
    first, second = tmp_path / "first", tmp_path / "second"
    assert main(["run", str(tmp_path / "mine/my.toml"), "--out", str(first), "--set", "kinetics.a=0.12"]) == 0
    for path in (tmp_path / "mine").rglob("*.obj"):
        path.unlink()
    assert main(["run", str(first / "scenario.toml"), "--out", str(second)]) == 0
    states = first / "series/my_0002.vtp", second / "series/scenario_0002.vtp"
    assert states[0].read_bytes() == states[1].read_bytes()
    assert tomllib.loads((first / "scenario.toml").read_text())["kinetics"]["a"] == 0.12


def test_results_replace_no_input_and_nothing_that_is_no_result(tmp_path, capsys, monkeypatch, no_pictures):
    monkeypatch.chdir(tmp_path)
    saved_ball(tmp_path / "my.ply")
    mesh = (tmp_path / "my.ply").read_bytes()
    text = PLAIN.replace('shape = "sphere"\nsubdivisions = 2', 'file = "my.ply"')
    (tmp_path / "my.toml").write_text(text)
    assert main(["run", "my.toml", "--out", "."]) == 2
    assert "would replace my.ply, which is read" in capsys.readouterr().err
    assert main(["run", "gray-scott", "--mesh", "my.ply", "--t1", "0.01", "--frames", "1", "--out", "other"]) == 0
    assert main(["run", "my.toml", "--out", "other"]) == 0  # of a run before it
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "my.glb").write_text("of the user")
    assert main(["run", "my.toml", "--out", "mine"]) == 2
    assert "my.glb, which ltljax did not write" in capsys.readouterr().err
    assert main(["run", "other/scenario.toml", "--out", "other"]) == 2
    assert "scenario.toml, which is read" in capsys.readouterr().err
    assert (tmp_path / "my.ply").read_bytes() == mesh
    assert (tmp_path / "other" / "inputs" / "mesh" / "my.ply").read_bytes() == mesh
    assert ltl.load_mesh(tmp_path / "other" / "my.ply").num_vertices == 200


def test_a_mesh_of_the_command_line_comes_first_and_changes_after(tmp_path):
    np.savez(tmp_path / "start.npz", **{name: np.ones(200) for name in "uv"})
    saved_ball(tmp_path / "elsewhere" / "ball.obj")
    (tmp_path / "my.toml").write_text(PLAIN.replace('u = "1 + 0.1*noise"\nv = 0.9', 'file = "start.npz"'))
    changes = {"mesh.scale": "keep"}
    found = scenario.read((tmp_path / "my.toml").read_text(), "my", tmp_path, changes, tmp_path / "elsewhere/ball.obj")
    assert found.mesh.num_vertices == 200
    assert found.resolved["mesh"]["scale"] == "keep"


def test_a_mesh_file_is_scaled_to_the_area_of_the_unit_sphere(tmp_path):
    saved_ball(tmp_path / "ball.obj")
    mesh = scenario.read(PLAIN, "ball", tmp_path, {}, tmp_path / "ball.obj").mesh
    assert mesh.area == pytest.approx(4 * np.pi, rel=1e-6)


def test_a_built_in_mesh_takes_changes(tmp_path, no_pictures):
    arguments = ["--mesh", "sphere", "--set", "mesh.subdivisions=2", "--t1", "0.1", "--frames", "1"]
    assert main(["run", "lotka-volterra", *arguments, "--out", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "summary.json").read_text())["mesh"]["vertices"] == 162


def test_a_box_has_the_sides_it_is_given(tmp_path):
    changes = {"mesh": {"shape": "box"}, "mesh.sides": [2.0, 1.0, 1.5], "mesh.n": 8}
    mesh = scenario.read(PLAIN, "box", tmp_path, changes).mesh
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [2.0, 1.0, 1.5])
    assert mesh.area == pytest.approx(13)
    with pytest.raises(scenario.ScenarioError, match="sides"):
        scenario.read(PLAIN, "box", tmp_path, changes | {"mesh.sides": [2.0, 1.0]})


def test_states_come_from_a_file_beside_the_scenario(tmp_path):
    state = {name: np.random.default_rng(0).random(162) for name in "uv"}
    np.savez(tmp_path / "start.npz", **state)
    text = PLAIN.replace('u = "1 + 0.1*noise"\nv = 0.9', 'file = "start.npz"')
    found = scenario.read(text, "mine", tmp_path)
    np.testing.assert_array_equal(found.u0[found.mesh.source_order], np.stack([state["u"], state["v"]], axis=1))


def changed(old, new):
    assert old in PLAIN
    return PLAIN.replace(old, new)


BROKEN = {
    "no TOML": ("[mesh", "expected TOML"),
    "nothing": ("", "as kinetics.name, found nothing"),
    "unknown table": (PLAIN + "[mehs]\nshape = 1\n", "mehs is not known (did you mean mesh?)"),
    "unknown key": (changed("end = 0.1", "end = 0.1\nfrmaes = 3"), "time.frmaes is not known (did you mean frames?)"),
    "unknown kinetics": (changed('"schnakenberg"', '"schnackenberg"'), "did you mean schnakenberg?"),
    "unknown parameter": (changed("rate = 30.0", "rtae = 30.0"), "kinetics.rtae is not known (did you mean rate?)"),
    "table as value": ("mesh = 3" + PLAIN.replace("[mesh]", "[other]"), "expected [mesh] as a table"),
    "text as number": (changed("end = 0.1", 'end = "soon"'), "time.end"),
    "boolean as number": (changed("end = 0.1", "end = true"), "time.end"),
    "negative time": (changed("end = 0.1", "end = -1"), "time.end"),
    "infinite time": (changed("end = 0.1", "end = inf"), "time.end"),
    "NaN": (changed("end = 0.1", "end = nan"), "time.end"),
    "huge integer": (changed("end = 0.1", "end = 1" + "0" * 400), "time.end"),
    "NaN parameter": (changed("rate = 30.0", "rate = nan"), "kinetics.rate"),
    "no frames": (changed("frames = 2", "frames = 0"), "time.frames"),
    "too many frames": (changed("frames = 2", "frames = 1000000000"), "time.frames"),
    "fraction of a frame": (changed("frames = 2", "frames = 2.5"), "time.frames"),
    "memory": (changed("subdivisions = 2", "subdivisions = 8").replace("frames = 2", "frames = 5000"), "GB of memory"),
    "too fine": (changed("subdivisions = 2", "subdivisions = 30"), "mesh.subdivisions"),
    "unknown shape": (changed('"sphere"', '"cube"'), "mesh.shape"),
    "wrong number of a shape": (changed("subdivisions = 2", "radius = -1"), "mesh.radius"),
    "key of another shape": (changed("subdivisions = 2", "rings = 3"), "mesh.rings is not known"),
    "code": (changed('"1 + 0.1*noise"', "\"__import__('os').system('touch hacked')\""), "expected a function"),
    "attribute": (changed('"1 + 0.1*noise"', '"x.__class__"'), "found '.'"),
    "call of a call": (changed('"1 + 0.1*noise"', '"sin(x)(y)"'), "found '('"),
    "name of nothing": (changed('"1 + 0.1*noise"', '"1 + w"'), "found 'w'"),
    "cycle": (changed("rate = 30.0", 'a = "b"\nb = "a"'), "found 'b'"),
    "species in a parameter": (changed("rate = 30.0", 'rate = "u"'), "found 'u'"),
    "not finite": (changed('"1 + 0.1*noise"', '"log(x)"'), "finite at every vertex"),
    "huge exponent": (changed('"1 + 0.1*noise"', '"9^9^9^9"'), "a finite number"),
    "deep": (changed('"1 + 0.1*noise"', '"' + "(" * 300 + '1"'), "at most 60 levels"),
    "long": (changed('"1 + 0.1*noise"', '"' + "1+" * 3000 + '1"'), "at most 2000 characters"),
    "formula of a list": (changed('"1 + 0.1*noise"', "[1, 2]"), "a number or a formula"),
    "no start": (changed("v = 0.9\n", ""), "initial.v, found nothing"),
    "path upwards": (changed('shape = "sphere"\nsubdivisions = 2', 'file = "../secret.obj"'), "own folder"),
    "absolute path": (changed('shape = "sphere"\nsubdivisions = 2', 'file = "/etc/passwd"'), "own folder"),
    "path through a link": (changed('shape = "sphere"\nsubdivisions = 2', 'file = "link.obj"'), "own folder"),
    "no such file": (changed('shape = "sphere"\nsubdivisions = 2', 'file = "none.obj"'), "a file that exists"),
    "null in a path": (changed('shape = "sphere"\nsubdivisions = 2', 'file = "a\\u0000b"'), "mesh.file"),
    "folder as file": (changed('shape = "sphere"\nsubdivisions = 2', 'file = "."'), "a file that exists"),
    "state out of the folder": (changed('u = "1 + 0.1*noise"\nv = 0.9', 'file = "../start.npz"'), "own folder"),
    "state that is no state": (changed('u = "1 + 0.1*noise"\nv = 0.9', 'file = "bad.npz"'), "a CSV or .npz file"),
    "pickle": (changed('u = "1 + 0.1*noise"\nv = 0.9', 'file = "pickle.npz"'), "a CSV or .npz file"),
    "negative diffusivity": (changed("u = 1.0", "u = -1.0"), "a diffusivity that is not negative"),
    "negative somewhere": (changed("u = 1.0", 'u = "x"'), "a diffusivity that is not negative"),
    "diffusivity of nobody": (changed("v = 10.0", "v = 10.0\nw = 3"), "diffusivity.w is not known"),
    "boundary of a sphere": (PLAIN + '[boundary]\nconditions = ["dirichlet=0"]\n', "boundary.conditions"),
    "no condition": (PLAIN + '[boundary]\nconditions = ["fixed=0"]\n', "boundary.conditions: Expected"),
    "unknown solver": (PLAIN + '[solver]\nname = "Magic"\n', "solver.name"),
    "solver without its step": (PLAIN + '[solver]\nname = "SBDF2"\n', "solver.dt"),
    "unknown species shown": (PLAIN + '[output]\nshow = "w"\n', "output.show"),
    "two reactions": (PLAIN + '[reactions]\ndu = "1"\n', "not both"),
    "short direction": (PLAIN + '[direction]\nfield = ["1", "2"]\n', "a list of 3 formulas"),
    "direction of nobody": (PLAIN + '[direction]\nfield = [1, 0, 0]\nspecies = ["w"]\n', "direction.species"),
    "deep tables": ("x = " + "[" * 5000 + "]" * 5000 + PLAIN, "expected"),
    "too long": ("# " + "x" * 2_000_000 + PLAIN, "characters"),
    "title of lines": ('title = "a\\nb"' + PLAIN, "title"),
    "negative seed": ("seed = -1" + PLAIN, "seed"),
    "keys of thousands of parts": (PLAIN + "a" + ".a" * 400_000 + " = 1\n", "expected keys of at most 8 parts"),
    "quoted keys of thousands of parts": (PLAIN + "'a'" + " . 'a'" * 100_000 + " = 1\n", "at most 8 parts"),
    "digits beyond number": (changed("frames = 2", "frames = 0x" + "f" * 9000), "a very large int"),
    "colours of a terminal": (PLAIN + '"a\\u001b[31m\\u202e" = 1\n', "a\\x1b[31m\\u202e is not known"),
    "a long key": (PLAIN + "b" * 100_000 + " = 1\n", "bbb... is not known"),
    "a long name in a formula": (changed('"1 + 0.1*noise"', '"' + "b" * 1900 + '"'), "found 'bbb"),
    "many parameters": (
        changed('[kinetics]\nname = "schnakenberg"\nrate = 30.0', "[reactions]\ndu = 'k'\ndv = 'v'")
        + "[parameters]\n"
        + "".join(f"{'p' * 90}{k} = 1\n" for k in range(900)), "expected one of u, v, ppp",
    ),
    "too many species": (
        changed('[kinetics]\nname = "schnakenberg"\nrate = 30.0', "[reactions]\n")
        .replace("[reactions]\n", "[reactions]\n" + "".join(f"ds{k} = 0\n" for k in range(100))), "at most 64 species",
    ),
    "state of nothing": (changed('u = "1 + 0.1*noise"\nv = 0.9', 'file = "empty.npz"'), "a CSV or .npz file"),
    "state cut short": (changed('u = "1 + 0.1*noise"\nv = 0.9', 'file = "cut.npz"'), "a CSV or .npz file"),
    "state that is damaged": (changed('u = "1 + 0.1*noise"\nv = 0.9', 'file = "damaged.npz"'), "a CSV or .npz file"),
    "state of another size": (changed('u = "1 + 0.1*noise"\nv = 0.9', 'file = "far.npz"'), "float64 of shape (500"),
    "no equation of Cahn and Hilliard": (
        changed('name = "schnakenberg"\nrate = 30.0', 'name = "cahn-hilliard"')
        .replace("u = 1.0\nv = 10.0\n", "").replace("[diffusivity]\n", "").replace("v = 0.9\n", "")
        + '[solver]\nname = "KenCarp4"\n', "solver.name",
    ),
    "degree of another scheme": (PLAIN + "[solver]\ndegree = 3\n", "solver.degree"),
    "brain elsewhere": (changed('shape = "sphere"\nsubdivisions = 2', 'file = "brain.gii"'), "refers to '../secret"),
    "scene elsewhere": (changed('shape = "sphere"\nsubdivisions = 2', 'file = "scene.gltf"'), "refers to '../secret"),
    "a mesh that is none": (changed('shape = "sphere"\nsubdivisions = 2', 'file = "flat.obj"'), "mesh.file: flat.obj"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_or_malicious_file_is_one_clear_line(name, tmp_path, capsys, monkeypatch):
    text, says = BROKEN[name]
    inside = tmp_path / "inside"
    inside.mkdir()
    monkeypatch.chdir(inside)
    (tmp_path / "secret.obj").write_text("v 0 0 0\n")
    (inside / "link.obj").symlink_to(tmp_path / "secret.obj")
    (inside / "bad.npz").write_text("no zip")
    np.savez(inside / "pickle.npz", u=np.array([{}], object), v=np.zeros(3))
    (inside / "empty.npz").write_bytes(b"")
    np.savez_compressed(inside / "far.npz", u=np.zeros(500_000), v=np.zeros(162))
    sound = (inside / "far.npz").read_bytes()
    (inside / "cut.npz").write_bytes(sound[: len(sound) // 2])
    np.savez(inside / "damaged.npz", u=np.ones(162), v=np.ones(162))
    damaged = bytearray((inside / "damaged.npz").read_bytes())
    damaged[150:200] = bytes(50)
    (inside / "damaged.npz").write_bytes(damaged)
    array = '<DataArray Encoding="ExternalFileBinary" ExternalFileName="../secret.bin"/>'
    (inside / "brain.gii").write_text(f'<?xml version="1.0"?><GIFTI NumberOfDataArrays="1">{array}</GIFTI>')
    (inside / "scene.gltf").write_text('{"asset": {"version": "2.0"}, "buffers": [{"uri": "../secret.bin"}]}')
    (inside / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 9\n")
    (inside / "my.toml").write_text(text)
    before = sorted(tmp_path.rglob("*"))
    assert main(["run", "my.toml", "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert "my.toml" in said.err
    assert said.err.strip().isprintable()
    assert says in said.err
    assert len(said.err) < 700
    # Nothing was executed, and nothing written.
    assert sorted(tmp_path.rglob("*")) == before


def test_a_file_that_is_no_text_is_one_clear_line(tmp_path, capsys):
    (tmp_path / "mine.toml").write_bytes(b'title = "a"\n# \xff\n')
    assert main(["run", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "out")]) == 2
    assert "mine.toml: expected text in UTF-8, found the byte 0xff in line 2" in capsys.readouterr().err
    (tmp_path / "mine.toml").write_bytes(b"#" * 5_000_000)
    assert main(["run", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "out")]) == 2
    assert "at most 1000000 characters" in capsys.readouterr().err
    (tmp_path / "a.toml").write_text("mesh = 3\n")
    assert main(["run", str(tmp_path / "a.toml"), "--mesh", "ball.obj", "--out", str(tmp_path / "out")]) == 2
    assert "a.toml: expected [mesh] as a table, found 3" in capsys.readouterr().err
    assert main(["run", str(tmp_path), "--out", str(tmp_path / "out")]) == 2


def test_memory_that_does_not_suffice_is_one_clear_line(tmp_path, capsys, monkeypatch):
    def greedy(*_, **__):
        raise MemoryError("Unable to allocate 99 GiB")

    monkeypatch.setattr(scenario, "read", greedy)
    assert main(["run", "gray-scott", "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "99 GiB" in said


def test_the_start_is_read_before_it_is_unpacked(tmp_path):
    """What a file of a few kilobytes says it holds is never made."""
    np.savez_compressed(tmp_path / "start.npz", u=np.zeros(100_000_000), v=np.zeros(1))
    text = PLAIN.replace('u = "1 + 0.1*noise"\nv = 0.9', 'file = "start.npz"')
    tracemalloc.start()
    with pytest.raises(scenario.ScenarioError, match=r"shape \(162,\) for u, found float64 of shape \(100000000,\)"):
        scenario.read(text, "mine", tmp_path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 50e6


def test_any_letters_may_name_files_and_species(tmp_path, no_pictures):
    text = PLAIN.replace('[kinetics]\nname = "schnakenberg"\nrate = 30.0', "[reactions]\ndself = '-self'\n'dü' = 0\n")
    text = text.replace("u = 1.0\nv = 10.0", 'self = 1.0\n"ü" = 2.0').replace("v = 0.9", '"ü" = "noise"')
    path = tmp_path / "müsli 図.toml"
    path.write_text(text.replace('u = "1 + 0.1*noise"', 'self = "x"'), encoding="utf-8")
    assert main(["run", str(path), "--out", str(tmp_path / "out")]) == 0
    series = (tmp_path / "out" / "müsli-図.pvd").read_text(encoding="utf-8")
    assert 'file="series/müsli-図_0002.vtp"' in series
    pyvista = pytest.importorskip("pyvista")
    (read,) = pyvista.PVDReader(tmp_path / "out" / "müsli-図.pvd").read()
    assert set(read.point_data.keys()) == {"self", "ü"}


def test_noise_of_each_key_is_its_own(tmp_path):
    text = PLAIN.replace("u = 1.0\nv = 10.0", 'u = "1.5 + noise"\nv = 10.0').replace('"1 + 0.1*noise"', '"noise"')
    found = scenario.read(text, "mine", tmp_path)
    spread = found.make_equation(ltl.Surface.from_mesh(found.mesh)).diffusivity[0]
    assert abs(np.corrcoef(np.asarray(spread), found.u0[:, 0])[0, 1]) < 0.3


def test_the_degree_of_the_scheme_is_kept(tmp_path, no_pictures):
    arguments = ["--scheme", "polynomial", "--degree", "3", "--set", "mesh.subdivisions=2", "--t1", "0.01"]
    assert main(["run", "allen-cahn", *arguments, "--frames", "1", "--out", str(tmp_path)]) == 0
    assert tomllib.loads((tmp_path / "scenario.toml").read_text())["solver"]["degree"] == 3
    assert "degree=3" in json.loads((tmp_path / "summary.json").read_text())["scheme"]


def test_a_field_may_be_written_as_a_relief(tmp_path, no_pictures):
    arguments = ["--set", "mesh.subdivisions=2", "--t1", "0.01", "--frames", "1", "--out", str(tmp_path)]
    assert main(["run", "fisher-kpp", "--set", "output.displacement=0.5", *arguments]) == 0
    (raised,) = trimesh.load(tmp_path / "fisher-kpp-displaced.glb", process=False).geometry.values()
    heights = np.linalg.norm(raised.vertices, axis=1)
    np.testing.assert_allclose([heights.min(), heights.max()], [1, 1.5], atol=1e-5)


def test_changes_on_the_command_line_are_checked_like_the_file(tmp_path, capsys):
    assert main(["run", "gray-scott", "--set", "kinetics.fed=1", "--out", str(tmp_path)]) == 2
    assert "did you mean feed" in capsys.readouterr().err
    assert main(["run", "gray-scott", "--set", "feed", "--out", str(tmp_path)]) == 2
    assert "KEY=VALUE" in capsys.readouterr().err
    assert main(["run", "turing", "--set", "a.b=1", "--out", str(tmp_path)]) == 2
    assert "--set is for scenario files" in capsys.readouterr().err
    assert main(["run", "gray-scott", "--as-published", "--out", str(tmp_path)]) == 2
    assert "heat and turing" in capsys.readouterr().err


def test_new_prints_a_file_that_runs(tmp_path, capsys):
    assert main(["new", "two-scales"]) == 0
    (tmp_path / "my.toml").write_text(capsys.readouterr().out)
    arguments = ["--set", "mesh.subdivisions=2", "--t1", "0.01", "--frames", "1", "--out", str(tmp_path / "out")]
    assert main(["run", str(tmp_path / "my.toml"), *arguments]) == 0
    assert (tmp_path / "out" / "scenario.toml").exists()


SOUGHT = """
[fit]
free = ["kinetics.a", "diffusivity.v"]
noise = 0.002
[[fit.data]]
file = "early.npz"
time = 0.05
[[fit.data]]
file = "late.npz"
time = 0.1
"""


@pytest.fixture(scope="module")
def seen():
    """What a run of the plain scenario looks like, with a little noise, in the order of the mesh file."""
    example = scenario.read(PLAIN, "seen", ".")
    surface = ltl.Surface.from_mesh(example.mesh)
    us = np.asarray(ltl.solve(example.make_equation(surface), surface, example.u0, 0.1, ts=[0.05, 0.1], rtol=1e-6).us)
    noise = 0.002 * np.random.default_rng(0).normal(size=us.shape)
    return example.mesh, (us + noise)[:, np.asarray(example.mesh.source_order)]


def keep(kind, folder, name, state, mesh):
    """A state in a file of a kind; returns what is to be named in the scenario."""
    path = folder / f"{name}.{kind}"
    if kind == "npz":
        np.savez(path, u=state[:, 0], v=state[:, 1])
    elif kind == "csv":
        some = np.arange(0, len(state), 3)
        rows = np.column_stack([some, state[some]])
        # With the mark that spreadsheets begin a file with.
        head = "\ufeffvertex,u,v"
        np.savetxt(path, rows, delimiter=",", header=head, comments="", fmt=["%d", "%.9g", "%.9g"], encoding="utf-8")
    elif kind == "vtp":
        files.write_vtp(path, mesh.vertices, mesh.faces, dict(u=state[:, 0], v=state[:, 1]))
    else:
        rows = "\n".join(
            " ".join(f"{value:.9g}" for value in (*x, *u)) for x, u in zip(mesh.vertices, state, strict=True)
        )
        head = f"ply\nformat ascii 1.0\nelement vertex {len(state)}\n"
        head += "".join(f"property double {axis}\n" for axis in ("x", "y", "z", "u", "v")) + "end_header\n"
        path.write_text(head + rows + "\n")
    return path.name


@pytest.mark.parametrize("kind", ["npz", "csv", "vtp", "ply"])
def test_numbers_of_a_file_are_found_from_files_of_data(kind, seen, tmp_path, capsys):
    mesh, states = seen
    text = PLAIN.replace("rate = 30.0", "rate = 30.0\na = 0.13").replace("v = 10.0", "v = 8.0") + SOUGHT
    for name, state in zip(("early", "late"), states, strict=True):
        text = text.replace(f"{name}.npz", keep(kind, tmp_path, name, state, mesh))
    (tmp_path / "mine.toml").write_text(text)
    out = tmp_path / "out"
    assert main(["fit", str(tmp_path / "mine.toml"), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "The data determine every parameter" in said
    found = json.loads((out / "fit.json").read_text())
    for key, truth in (("kinetics.a", 0.1), ("diffusivity.v", 10.0)):
        assert found["found"][key] == pytest.approx(truth, rel=0.05)
        assert abs(found["found"][key] - truth) < 3 * found["std"][key]
    assert found["noise"] == pytest.approx(1, abs=0.15)
    assert (out / "fit.png").stat().st_size > 10_000
    assert not (out / "restart").exists()
    fitted = tomllib.loads((out / "fitted.toml").read_text())
    assert fitted["kinetics"]["a"] == found["found"]["kinetics.a"]
    assert "fit" not in fitted
    example = scenario.read((out / "fitted.toml").read_text(), "fitted", out)
    assert example.wanted is None


def test_columns_of_a_ply_file_are_all_but_the_positions(tmp_path):
    path = tmp_path / "seen.ply"
    head = "ply\nformat ascii 1.0\nelement vertex 1\n"
    head += "".join(f"property double {name}\n" for name in ("x", "y", "z", "xy", "u")) + "end_header\n"
    path.write_text(head + "1 2 3 4 5\n")
    assert {name: float(values[0]) for name, values in columns.read_columns(path).items()} == dict(xy=4.0, u=5.0)


def test_a_fit_from_files_goes_on_where_it_was_left_and_no_other_does(seen, tmp_path, capsys):
    mesh, states = seen
    for name, state in zip(("early", "late"), states, strict=True):
        keep("npz", tmp_path, name, state, mesh)
    text = PLAIN.replace("rate = 30.0", "rate = 30.0\na = 0.13").replace("v = 10.0", "v = 8.0") + SOUGHT
    (tmp_path / "mine.toml").write_text(text.replace("noise = 0.002", "noise = 0.002\nmax_steps = 2"))
    (tmp_path / "on.toml").write_text(text)
    (tmp_path / "other.toml").write_text(text.replace("noise = 0.002", "noise = 0.004"))
    out = ["--out", str(tmp_path / "out")]
    assert main(["fit", str(tmp_path / "mine.toml"), *out]) == 0
    left = json.loads((tmp_path / "out" / "fit.json").read_text())
    assert not left["converged"]
    capsys.readouterr()
    assert main(["fit", str(tmp_path / "on.toml"), *out]) == 2
    assert "holds a fit that has not converged. Continue it with --resume" in capsys.readouterr().err
    assert main(["fit", str(tmp_path / "other.toml"), "--resume", *out]) == 2
    assert "holds another fit: its data differ" in capsys.readouterr().err
    # With another start, whose place what was kept takes.
    assert main(["fit", str(tmp_path / "on.toml"), "--set", "kinetics.a=0.3", "--resume", *out]) == 0
    found = json.loads((tmp_path / "out" / "fit.json").read_text())
    assert found["converged"]
    assert found["loss"] < left["loss"]
    assert found["found"]["kinetics.a"] == pytest.approx(0.1, rel=0.05)
    assert not (tmp_path / "out" / "restart").exists()


def test_a_fit_replaces_nothing_that_no_fit_has_written(seen, tmp_path, capsys):
    mesh, states = seen
    for name, state in zip(("early", "late"), states, strict=True):
        keep("npz", tmp_path, name, state, mesh)
    (tmp_path / "fitted.toml").write_text(PLAIN.replace("rate = 30.0", "rate = 30.0\na = 0.13") + SOUGHT)
    before = (tmp_path / "fitted.toml").read_text()
    assert main(["fit", str(tmp_path / "fitted.toml"), "--out", str(tmp_path)]) == 2
    assert "which is read" in capsys.readouterr().err
    assert (tmp_path / "fitted.toml").read_text() == before
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "fit.json").write_text('{"of": "another program"}')
    assert main(["fit", str(tmp_path / "fitted.toml"), "--out", str(tmp_path / "out")]) == 2
    assert "fit.json, which ltljax did not write" in capsys.readouterr().err


BROKEN_FITS = {
    "free unknown": ('"kinetics.a"', '"kinetics.zeta"', "fit.free"),
    "free twice": ('"kinetics.a", "diffusivity.v"', '"kinetics.a", "kinetics.a"', "each once"),
    "free a field": ('"kinetics.a"', '"initial.u"', "kinetics.a, kinetics.b"),
    "free nothing": ('free = ["kinetics.a", "diffusivity.v"]', "free = []", "fit.free"),
    "negative noise": ("noise = 0.002", "noise = -1", "fit.noise"),
    "no file": ("early.npz", "nothing.npz", "fit.data.file"),
    "a file outside": ("early.npz", "../early.npz", "fit.data.file"),
    "an unknown kind": ("early.npz", "mine.toml", ".npz, .csv, .ply, .vtp"),
    "times that fall": ("time = 0.05", "time = 0.1", "ascend"),
    "a time after the end": ("time = 0.05", "time = 0.5", "fit.data.time"),
    "another key": ("noise = 0.002", "noies = 0.002", "did you mean noise"),
    "data as a table": ('[[fit.data]]\nfile = "early.npz"\ntime = 0.05\n[[fit.data]]', "[fit.data]", "list of tables"),
    "wrong length": ("early.npz", "short.npz", "162 values of u"),
    "not a number": (
        "early.npz",
        "bad.npz",
        "finite values of u, or nan where nothing was measured: 162 are infinite",
    ),
    "no species": ("early.npz", "other.npz", "columns or arrays named u or v"),
    "damaged": ("early.npz", "damaged.npz", "an intact file"),
    "vertex too large": ("early.npz", "far.csv", "vertices from 0 to 161, not 500"),
    "other species": ("late.npz", "only_u.npz", "of the first file"),
}


@pytest.mark.parametrize("name", BROKEN_FITS)
def test_a_broken_fit_is_one_clear_line(name, seen, tmp_path, capsys):
    mesh, states = seen
    for stem, state in zip(("early", "late"), states, strict=True):
        keep("npz", tmp_path, stem, state, mesh)
    np.savez(tmp_path / "short.npz", u=np.ones(3), v=np.ones(3))
    np.savez(tmp_path / "bad.npz", u=np.full(162, np.inf), v=np.ones(162))
    np.savez(tmp_path / "other.npz", w=np.ones(162))
    np.savez(tmp_path / "only_u.npz", u=np.ones(162))
    (tmp_path / "damaged.npz").write_bytes(b"PK no zip")
    (tmp_path / "far.csv").write_text("vertex,u,v\n1,1,1\n500,1,1\n")
    old, new, message = BROKEN_FITS[name]
    assert old in SOUGHT
    (tmp_path / "mine.toml").write_text(PLAIN + SOUGHT.replace(old, new, 1))
    assert main(["fit", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    assert message in said.err
    assert not (tmp_path / "out").exists()


def test_data_that_memory_would_not_hold_are_refused_unread(seen, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(columns, "_LARGEST", 1000)
    for name, state in zip(("early", "late"), seen[1], strict=True):
        keep("npz", tmp_path, name, state, seen[0])
    (tmp_path / "mine.toml").write_text(PLAIN + SOUGHT)
    assert main(["fit", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "out")]) == 2
    assert "expected arrays of at most 1000 bytes, found 2848" in capsys.readouterr().err


def test_a_file_without_data_says_what_to_add(tmp_path, capsys):
    (tmp_path / "mine.toml").write_text(PLAIN)
    assert main(["fit", str(tmp_path / "mine.toml"), "--out", str(tmp_path / "out")]) == 2
    assert "no table [fit]" in capsys.readouterr().err
    assert main(["fit", "gray-scott"]) == 2
    assert "ends in .toml" in capsys.readouterr().err


def test_a_scenario_runs_with_fixed_steps_of_sbdf2(tmp_path):
    (tmp_path / "my.toml").write_text(
        PLAIN.replace("[initial]", '[solver]\nname = "SBDF2"\ndt = 1e-3\n[initial]'), encoding="utf-8"
    )
    assert main(["run", str(tmp_path / "my.toml"), "--out", str(tmp_path / "out"), "--set", "time.end=0.01"]) == 0
    assert json.loads((tmp_path / "out/summary.json").read_text())["measured"]["reached_time"] == pytest.approx(0.01)


@pytest.mark.parametrize("name", ["gray-scott", "cahn-hilliard"])
def test_the_scale_of_a_pattern_is_one_number(name):
    mesh_of = {"mesh": {"shape": "sphere", "subdivisions": 2}}

    def rate(scale, on):
        example = scenario.read(scenario.library()[name], name, Path(), {**mesh_of, "scale": scale})
        surface = ltl.Surface.from_mesh(on(example.mesh), dtype=jnp.float64)
        equation = example.make_equation(surface)
        u = np.random.default_rng(0).uniform(0.2, 0.8, example.u0.shape)
        return np.asarray(equation.rate(jnp.zeros(()), surface, jnp.asarray(u)))

    # On a sphere twice as large the same numbers make a pattern of twice the scale.
    np.testing.assert_allclose(rate(2.0, lambda mesh: mesh.scaled(2.0)), rate(1.0, lambda mesh: mesh), rtol=1e-9)


def test_the_side_seen_and_the_size_of_a_texture_are_chosen(tmp_path):
    square = ltl.shapes.square(1.0, 12)
    flat = square.vertices[:, :2] - square.vertices[:, :2].min(axis=0)
    files.write_obj(tmp_path / "a.obj", square.vertices, square.faces, flat[square.faces])
    arguments = ["run", "fisher-kpp", "--mesh", str(tmp_path / "a.obj"), "--frames", "1", "--t1", "0.01"]
    out = tmp_path / "out"
    assert main([*arguments, "--out", str(out), "--view", "top", "--texture", "64", "--scale", "0.5"]) == 0
    assert imageio.v3.imread(out / "textured" / "fisher-kpp.png").shape == (64, 64, 3)
    resolved = tomllib.loads((out / "scenario.toml").read_text())
    assert (resolved["scale"], resolved["output"]["view"], resolved["output"]["texture"]) == (0.5, "top", 64)
    # The square lies in the plane z = 0. Seen from above, along y, it is a line, and most of the picture is white.
    assert (imageio.v3.imread(out / "fisher-kpp.png") > 250).all(axis=2).mean() > 0.9


def test_a_start_is_read_from_a_table_of_a_spreadsheet(tmp_path):
    mesh = scenario.read(PLAIN, "plain.toml", tmp_path).mesh
    rows = "\n".join(f"{x:.17g},{2 * x:.17g}" for x in mesh.vertices[:, 0])
    (tmp_path / "start.csv").write_text(f"v,u\n{rows}\n")
    text = PLAIN.replace('u = "1 + 0.1*noise"\nv = 0.9', 'file = "start.csv"')
    np.testing.assert_array_equal(
        scenario.read(text, "mine.toml", tmp_path).u0, mesh.vertices[:, :1] * np.array([2.0, 1.0])
    )
    (tmp_path / "start.csv").write_text("v,w\n1,2\n")
    with pytest.raises(ValueError, match=r"expected the column u, found v, w"):
        scenario.read(text, "mine.toml", tmp_path)


def test_a_command_names_a_mesh_anywhere_and_a_file_only_beside_it(tmp_path, capsys):
    (tmp_path / "elsewhere").mkdir()
    mesh = ltl.shapes.icosphere(2)
    files.write_obj(tmp_path / "elsewhere" / "a.obj", mesh.vertices, mesh.faces)
    path = tmp_path / "elsewhere" / "a.obj"
    (tmp_path / "plain.toml").write_text(PLAIN)
    run = ["run", str(tmp_path / "plain.toml"), "--out", str(tmp_path / "out"), "--frames", "1"]
    assert main([*run, "--set", f"mesh.file={path}"]) == 0
    (tmp_path / "plain.toml").write_text(PLAIN.replace('shape = "sphere"\nsubdivisions = 2', f'file = "{path}"'))
    (tmp_path / "inner").mkdir()
    (tmp_path / "plain.toml").rename(tmp_path / "inner" / "plain.toml")
    assert main(["run", str(tmp_path / "inner" / "plain.toml"), "--out", str(tmp_path / "out2")]) == 2
    assert "from elsewhere name it by --mesh" in capsys.readouterr().err


def test_a_bound_that_means_zero_is_called_zero(tmp_path):
    with pytest.raises(ValueError, match=r"expected a number above 0 as time\.end"):
        scenario.read(PLAIN.replace("end = 0.1", "end = 0"), "mine.toml", tmp_path)
