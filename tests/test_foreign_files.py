"""No command changes a file in a folder of results that ltljax did not write."""

import functools
import os

import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl
from ltljax._base.owned_folder import OutputError
from ltljax._output import files
from ltljax.app.cli import main

FITTED = """
[mesh]
shape = "sphere"
subdivisions = 1
[kinetics]
name = "fisher-kpp"
[initial]
u = "0.5 + 0.3*x"
[time]
end = 0.1
frames = 1
[fit]
free = ["kinetics.rate"]
[[fit.data]]
file = "seen.npz"
time = 0.1
"""


def commands(inputs):
    """Functions that write results to a folder and return an exit code, by name."""
    mesh = ltl.shapes.icosphere(2)
    files.write_obj(inputs / "mesh.obj", mesh.vertices, mesh.faces)
    (inputs / "mine.toml").write_text(FITTED)
    np.savez(inputs / "seen.npz", u=0.55 + 0.3 * ltl.shapes.icosphere(1).vertices[:, 0])
    np.savez(inputs / "data.npz", u=mesh.vertices[:, 0])
    obj, toml = str(inputs / "mesh.obj"), str(inputs / "mine.toml")

    def solve(folder):
        surface = ltl.Surface.from_mesh(mesh)
        try:
            ltl.solve(
                ltl.Diffusion(),
                surface,
                surface.vertices[:, 0],
                0.1,
                dt=0.05,
                checkpoints=ltl.solvers.Checkpoints(folder),
            )
        except OutputError:
            return 2
        return 0

    def fit(folder):
        def model(params):
            return params["a"] * jnp.arange(5.0)

        try:
            ltl.fit(model, {"a": 1.0}, ltl.Observations(2 * jnp.arange(5.0)), checkpoint=folder / "unknowns.npz")
        except OutputError:
            return 2
        return 0

    lines = {
        "run": ["run", "heat", "--mesh", obj, "--frames", "1", "--t1", "0.01"],
        "run a file": ["run", toml],
        "fit": ["fit", toml],
        "denoise": ["denoise", obj, "--data", str(inputs / "data.npz")],
        "smooth": ["smooth", obj, "--method", "fair"],
        "lic": ["lic", obj, "--field", "rotation", "--resolution", "64"],
        "curvature": ["curvature", obj],
        "distance": ["distance", obj, "--from", "0"],
    }
    functions = {name: lambda folder, line=line: main([*line, "--out", str(folder)]) for name, line in lines.items()}
    return functions | {"solve": solve, "ltl.fit": fit}


@functools.cache
def names_of(inputs, name):
    """The names of the results that a command writes to an empty folder."""
    folder = inputs / f"empty-{name}"
    assert commands(inputs)[name](folder) == 0
    return {path for path in tree(folder) if not path.startswith(".ltljax/")}


def tree(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def seeded(folder, names, seed):
    """The contents by name of 200 new files of the user, some of which have the given names."""
    random = np.random.default_rng(seed)
    used = [f"restart/state_{number:06d}.npz" for number in range(40)]
    used += [f"state_{number:06d}.npz" for number in range(40)] + ["unknowns.npz", "restart/unknowns.npz", "run.json"]
    used += [
        "restart/run.json",
        "manifest.json",
        "lock",
        "inputs/mesh/mesh.obj",
        "notes.txt",
        "state_000000.unfinished",
    ]
    all_names = [*names, *random.permutation(used)]
    all_names += [f"{random.integers(1 << 30)}.{suffix}" for suffix in ("npz", "json", "vtp", "png") for _ in range(50)]
    for name in list(dict.fromkeys(all_names))[:200]:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(random.bytes(random.integers(0, 200)))
    return tree(folder)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    return tmp_path_factory.mktemp("inputs")


# The slow commands write their results with the same functions as the others.
QUICK, SLOW = ["run a file", "smooth", "solve", "ltl.fit"], ["run", "fit", "denoise", "lic", "curvature", "distance"]
COMMANDS = [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)]


def names_of_some(inputs, name):
    """The names of the results of a command and of the quick commands."""
    return set().union(*(names_of(inputs, command) for command in {*QUICK, name}))


@pytest.mark.parametrize("name", COMMANDS)
def test_a_folder_full_of_user_files_is_rejected_and_not_changed(inputs, tmp_path, capsys, name):
    before = seeded(tmp_path, sorted(names_of_some(inputs, name)), 1)
    assert len(before) == 200
    capsys.readouterr()
    assert commands(inputs)[name](tmp_path) == 2
    after = tree(tmp_path)
    assert {path: after[path] for path in before} == before
    assert {path for path in after.keys() - before.keys() if not path.startswith(".ltljax/")} == set()


@pytest.mark.parametrize("name", COMMANDS)
def test_the_error_names_the_file_in_the_way(inputs, tmp_path, capsys, name):
    for index, own in enumerate(sorted(names_of(inputs, name))):
        folder = tmp_path / str(index)
        (folder / own).parent.mkdir(parents=True)
        (folder / own).write_bytes(b"mine")
        capsys.readouterr()
        assert commands(inputs)[name](folder) == 2, own
        assert (folder / own).read_bytes() == b"mine"
        if name not in ("solve", "ltl.fit"):
            assert os.path.basename(own) in capsys.readouterr().err


@pytest.mark.parametrize("name", COMMANDS)
def test_user_files_of_other_names_stay_beside_the_results(inputs, tmp_path, name):
    own = names_of(inputs, name)
    others = names_of_some(inputs, name) - own
    folders = {path.split("/")[0] for path in own if "/" in path}
    before = seeded(tmp_path, sorted(path for path in others if path.split("/")[0] not in folders), 2)
    for path in list(before):
        if path in own or path == "unknowns.npz" or path.startswith(("restart/", "state_", "run.json")):
            (tmp_path / path).unlink()
            del before[path]
    assert commands(inputs)[name](tmp_path) == 0
    after = tree(tmp_path)
    assert {path: after[path] for path in before} == before
    assert own <= after.keys()
