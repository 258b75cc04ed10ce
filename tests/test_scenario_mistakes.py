"""A mistake in a scenario file is reported in one line that names the file, the key and the cause."""

import tracemalloc

import numpy as np
import pytest
from scenario_files import FIT, NUM_VERTICES, PLAIN, REACTION, SPHERE, START, changed, write_measured

from ltljax._mesh import columns
from ltljax.app import scenario
from ltljax.app.cli import main

BROKEN = {
    "not TOML": ("[mesh", "expected TOML"),
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
    "too many frames": (changed("frames = 2", "frames = 200000000"), "time.frames"),
    "fraction of a frame": (changed("frames = 2", "frames = 2.5"), "time.frames"),
    "memory": (changed("subdivisions = 1", "subdivisions = 6").replace("frames = 2", "frames = 9999"), "GB of memory"),
    "too fine": (changed("subdivisions = 1", "subdivisions = 30"), "mesh.subdivisions"),
    "unknown shape": (changed('"sphere"', '"cube"'), "mesh.shape"),
    "wrong number of a shape": (changed("subdivisions = 1", "radius = -1"), "mesh.radius"),
    "key of another shape": (changed("subdivisions = 1", "rings = 3"), "mesh.rings is not known"),
    "code": (changed('"1 + 0.1*noise"', "\"__import__('os').system('touch hacked')\""), "expected a function"),
    "attribute": (changed('"1 + 0.1*noise"', '"x.__class__"'), "found '.'"),
    "call of a call": (changed('"1 + 0.1*noise"', '"sin(x)(y)"'), "found '('"),
    "unknown name": (changed('"1 + 0.1*noise"', '"1 + w"'), "found 'w'"),
    "cycle": (changed("rate = 30.0", 'a = "b"\nb = "a"'), "found 'b'"),
    "species in a parameter": (changed("rate = 30.0", 'rate = "u"'), "found 'u'"),
    "not finite": (changed('"1 + 0.1*noise"', '"log(x)"'), "finite at every vertex"),
    "huge exponent": (changed('"1 + 0.1*noise"', '"9^9^9^9"'), "a finite number"),
    "deep": (changed('"1 + 0.1*noise"', '"' + "(" * 300 + '1"'), "at most 60 levels"),
    "long": (changed('"1 + 0.1*noise"', '"' + "1+" * 3000 + '1"'), "at most 2000 characters"),
    "formula of a list": (changed('"1 + 0.1*noise"', "[1, 2]"), "a number or a formula"),
    "no start": (changed("v = 0.9\n", ""), "initial.v, found nothing"),
    "path upwards": (changed(SPHERE, 'file = "../secret.obj"'), "own folder"),
    "absolute path": (changed(SPHERE, 'file = "/etc/passwd"'), "own folder"),
    "path through a link": (changed(SPHERE, 'file = "link.obj"'), "own folder"),
    "no such file": (changed(SPHERE, 'file = "none.obj"'), "a file that exists"),
    "null in a path": (changed(SPHERE, 'file = "a\\u0000b"'), "mesh.file"),
    "folder as file": (changed(SPHERE, 'file = "."'), "a file that exists"),
    "state out of the folder": (changed(START, 'file = "../start.npz"'), "own folder"),
    "file that is not a state": (changed(START, 'file = "bad.npz"'), "a CSV or .npz file"),
    "pickle": (changed(START, 'file = "pickle.npz"'), "a CSV or .npz file"),
    "negative diffusivity": (changed("u = 1.0", "u = -1.0"), "a diffusivity that is not negative"),
    "negative somewhere": (changed("u = 1.0", 'u = "x"'), "a diffusivity that is not negative"),
    "diffusivity of an unknown species": (changed("v = 10.0", "v = 10.0\nw = 3"), "diffusivity.w is not known"),
    "boundary of a sphere": (PLAIN + '[boundary]\nconditions = ["dirichlet=0"]\n', "boundary.conditions: Boundary"),
    "not a condition": (PLAIN + '[boundary]\nconditions = ["fixed=0"]\n', "boundary.conditions: Expected"),
    "unknown solver": (PLAIN + '[solver]\nname = "Magic"\n', "solver.name"),
    "solver without its step": (PLAIN + '[solver]\nname = "SBDF2"\n', "solver.dt"),
    "unknown species shown": (PLAIN + '[output]\nshow = "w"\n', "output.show"),
    "two reactions": (PLAIN + '[reactions]\ndu = "1"\n', "There are both"),
    "short direction": (PLAIN + '[direction]\nfield = ["1", "2"]\n', "a list of 3 formulas"),
    "direction of no species": (PLAIN + '[direction]\nfield = [1, 0, 0]\nspecies = ["w"]\n', "direction.species"),
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
        changed(REACTION, "[reactions]\ndu = 'k'\ndv = 'v'")
        + "[parameters]\n"
        + "".join(f"{'p' * 90}{k} = 1\n" for k in range(900)), "expected one of u, v, ppp",
    ),
    "too many species": (
        changed(REACTION, "[reactions]\n")
        .replace("[reactions]\n", "[reactions]\n" + "".join(f"ds{k} = 0\n" for k in range(100))),
        "more than 64 species",
    ),
    "state of nothing": (changed(START, 'file = "empty.npz"'), "a CSV or .npz file"),
    "state cut short": (changed(START, 'file = "cut.npz"'), "a CSV or .npz file"),
    "state that is damaged": (changed(START, 'file = "damaged.npz"'), "a CSV or .npz file"),
    "state of another size": (changed(START, 'file = "far.npz"'), "float64 of shape (500"),
    "splitting solver for Cahn-Hilliard": (
        changed('name = "schnakenberg"\nrate = 30.0', 'name = "cahn-hilliard"')
        .replace("u = 1.0\nv = 10.0\n", "").replace("[diffusivity]\n", "").replace("v = 0.9\n", "")
        + '[solver]\nname = "KenCarp4"\n', "solver.name",
    ),
    "degree of another scheme": (PLAIN + "[solver]\ndegree = 3\n", "solver.degree"),
    "brain elsewhere": (changed(SPHERE, 'file = "brain.gii"'), "refers to '../secret"),
    "scene elsewhere": (changed(SPHERE, 'file = "scene.gltf"'), "refers to '../secret"),
    "a file that is not a mesh": (changed(SPHERE, 'file = "flat.obj"'), "mesh.file: flat.obj"),
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder of damaged and malicious files, beside a secret one."""
    outside = tmp_path_factory.mktemp("outside")
    inside = outside / "inside"
    inside.mkdir()
    (outside / "secret.obj").write_text("v 0 0 0\n")
    (inside / "link.obj").symlink_to(outside / "secret.obj")
    (inside / "bad.npz").write_text("no zip")
    np.savez(inside / "pickle.npz", u=np.array([{}], object), v=np.zeros(3))
    (inside / "empty.npz").write_bytes(b"")
    np.savez_compressed(inside / "far.npz", u=np.zeros(500_000), v=np.zeros(NUM_VERTICES))
    intact = (inside / "far.npz").read_bytes()
    (inside / "cut.npz").write_bytes(intact[: len(intact) // 2])
    np.savez(inside / "damaged.npz", u=np.ones(NUM_VERTICES), v=np.ones(NUM_VERTICES))
    damaged = bytearray((inside / "damaged.npz").read_bytes())
    damaged[150:200] = bytes(50)
    (inside / "damaged.npz").write_bytes(damaged)
    array = '<DataArray Encoding="ExternalFileBinary" ExternalFileName="../secret.bin"/>'
    (inside / "brain.gii").write_text(f'<?xml version="1.0"?><GIFTI NumberOfDataArrays="1">{array}</GIFTI>')
    (inside / "scene.gltf").write_text('{"asset": {"version": "2.0"}, "buffers": [{"uri": "../secret.bin"}]}')
    (inside / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 9\n")
    return inside


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_or_malicious_file_is_one_clear_line(name, folder, capsys, monkeypatch):
    text, expected = BROKEN[name]
    monkeypatch.chdir(folder)
    (folder / "my.toml").write_text(text)
    before = sorted(folder.parent.rglob("*"))
    assert main(["run", "my.toml", "--out", str(folder.parent / "out")]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert "my.toml" in printed.err
    assert printed.err.strip().isprintable()
    assert expected in printed.err
    assert len(printed.err) < 700
    # Nothing was executed, and nothing written.
    assert sorted(folder.parent.rglob("*")) == before


def fails(capsys, *arguments):
    """The standard error of a command that fails."""
    assert main([str(argument) for argument in arguments]) == 2
    return capsys.readouterr().err


def test_a_file_that_is_not_text_is_one_clear_line(tmp_path, capsys):
    path, out = tmp_path / "mine.toml", tmp_path / "out"
    path.write_bytes(b'title = "a"\n# \xff\n')
    error = fails(capsys, "run", path, "--out", out)
    assert "mine.toml: expected text in UTF-8, found the byte 0xff in line 2" in error
    path.write_bytes(b"#" * 5_000_000)
    assert "at most 1000000 characters" in fails(capsys, "run", path, "--out", out)
    path.write_text("mesh = 3\n")
    error = fails(capsys, "run", path, "--mesh", "ball.obj", "--out", out)
    assert "mine.toml: expected [mesh] as a table, found 3" in error
    fails(capsys, "run", tmp_path, "--out", out)


def test_running_out_of_memory_is_one_clear_line(tmp_path, capsys, monkeypatch):
    def greedy(*_, **__):
        raise MemoryError("Unable to allocate 99 GiB")

    monkeypatch.setattr(scenario, "read", greedy)
    error = fails(capsys, "run", "gray-scott", "--out", tmp_path)
    assert error.count("\n") == 1
    assert "Out of memory" in error
    assert "99 GiB" in error


def test_the_header_of_a_start_is_checked_before_it_is_unpacked(tmp_path):
    """A file of a few kilobytes that announces a huge array is refused without making the array."""
    np.savez_compressed(tmp_path / "start.npz", u=np.zeros(20_000_000), v=np.zeros(1))
    text = changed(START, 'file = "start.npz"')
    tracemalloc.start()
    expected = rf"shape \({NUM_VERTICES},\) for u, found float64 of shape \(20000000,\)"
    with pytest.raises(scenario.ScenarioError, match=expected):
        scenario.read(text, "mine", tmp_path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6


def test_changes_on_the_command_line_are_checked_like_the_file(tmp_path, capsys):
    assert "did you mean feed" in fails(capsys, "run", "gray-scott", "--set", "kinetics.fed=1", "--out", tmp_path)
    assert "KEY=VALUE" in fails(capsys, "run", "gray-scott", "--set", "feed", "--out", tmp_path)
    assert "turing: a is not known" in fails(capsys, "run", "turing", "--set", "a.b=1", "--out", tmp_path)
    error = fails(capsys, "run", "gray-scott", "--as-published", "--out", tmp_path)
    assert "gray-scott has no variant 'as-published'; it has none" in error


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
    "wrong length": ("early.npz", "short.npz", "42 values of u"),
    "not a number": (
        "early.npz",
        "bad.npz",
        "finite values of u, or nan where nothing was measured: 42 are infinite",
    ),
    "no species": ("early.npz", "other.npz", "columns or arrays named u or v"),
    "damaged": ("early.npz", "damaged.npz", "an intact file"),
    "vertex too large": ("early.npz", "far.csv", "vertices from 0 to 41, not 500"),
    "other species": ("late.npz", "only_u.npz", "of the first file"),
}


@pytest.mark.parametrize("name", BROKEN_FITS)
def test_a_broken_fit_is_one_clear_line(name, tmp_path, capsys):
    write_measured(tmp_path)
    np.savez(tmp_path / "short.npz", u=np.ones(3), v=np.ones(3))
    np.savez(tmp_path / "bad.npz", u=np.full(NUM_VERTICES, np.inf), v=np.ones(NUM_VERTICES))
    np.savez(tmp_path / "other.npz", w=np.ones(NUM_VERTICES))
    np.savez(tmp_path / "only_u.npz", u=np.ones(NUM_VERTICES))
    (tmp_path / "damaged.npz").write_bytes(b"PK no zip")
    (tmp_path / "far.csv").write_text("vertex,u,v\n1,1,1\n500,1,1\n")
    old, new, expected = BROKEN_FITS[name]
    assert old in FIT
    (tmp_path / "mine.toml").write_text(PLAIN + FIT.replace(old, new, 1))
    error = fails(capsys, "fit", tmp_path / "mine.toml", "--out", tmp_path / "out")
    assert error.count("\n") == 1
    assert expected in error
    assert not (tmp_path / "out").exists()


def test_data_that_would_not_fit_into_memory_are_refused_before_they_are_read(tmp_path, capsys, monkeypatch):
    write_measured(tmp_path)
    monkeypatch.setattr(columns, "_LARGEST", 500)
    (tmp_path / "mine.toml").write_text(PLAIN + FIT)
    error = fails(capsys, "fit", tmp_path / "mine.toml", "--out", tmp_path / "out")
    assert "expected arrays of at most 500 bytes, found" in error


def test_a_file_without_measurements_is_told_what_to_add(tmp_path, capsys):
    (tmp_path / "mine.toml").write_text(PLAIN)
    assert "no table [fit]" in fails(capsys, "fit", tmp_path / "mine.toml", "--out", tmp_path / "out")
    assert "ends in .toml" in fails(capsys, "fit", "gray-scott")
