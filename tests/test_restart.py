"""A run kept on disk is resumed to the same result, whenever it was killed."""

import functools
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl
from ltljax._base.owned_folder import Folder
from ltljax.app import scenario
from ltljax.solvers import Checkpoints

RUN = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import ltljax as ltl

surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1))
x = surface.vertices
u0 = jax.numpy.stack([1 - 0.5 * jax.numpy.exp(-4 * x[:, 0] ** 2), 0.5 * jax.numpy.exp(-4 * x[:, 0] ** 2)], axis=1)
equation = ltl.ReactionDiffusion((0.02, 0.01), ltl.kinetics.gray_scott())
solution = ltl.solve(
    equation, surface, u0, float(sys.argv[3]), dt=0.01,
    checkpoints=ltl.solvers.Checkpoints(sys.argv[1], every=0.1, resume=True),
)
np.save(sys.argv[2], solution.u_end)
"""


def latest(folder):
    """The number of the last state in a folder, or -1 if there is none."""
    return max((int(path.stem.removeprefix("state_")) for path in folder.glob("state_*.npz")), default=-1)


def start(folder, end, intervals):
    command = [sys.executable, "-c", RUN, str(folder), str(end), str(0.1 * intervals)]
    # An unread pipe would fill up with warnings and block the process.
    with log_of(end).open("w") as log:
        return subprocess.Popen(command, stderr=log)


def log_of(end):
    """The file for the standard error of the process that writes ``end``."""
    return end.with_suffix(".log")


def killed_and_resumed(tmp_path, kills, intervals, signals=(signal.SIGKILL,)):
    """The final states of an undisturbed run and of one that was killed several times, by each signal in turn."""
    whole, pieces, folder = tmp_path / "whole.npy", tmp_path / "pieces.npy", tmp_path / "b"
    undisturbed = start(tmp_path / "a", whole, intervals)
    chance = random.Random(0)
    for _, stop in zip(range(kills), itertools.cycle(signals), strict=False):
        begun = latest(folder)
        until = begun + chance.randint(1, intervals // (2 * kills))
        process = start(folder, pieces, intervals)
        while latest(folder) < until and process.poll() is None:
            time.sleep(1e-3)
        time.sleep(chance.uniform(0.0, 0.02))  # at any point of an interval
        process.send_signal(stop)
        assert process.wait() != 0
        assert begun < latest(folder) < intervals - 1
    for process, end in ((undisturbed, whole), (start(folder, pieces, intervals), pieces)):
        assert process.wait() == 0, log_of(end).read_text()
    return np.load(whole), np.load(pieces)


def test_a_killed_run_is_resumed_to_the_same_bits(tmp_path):
    whole, pieces = killed_and_resumed(tmp_path, 1, 200)
    assert np.array_equal(whole, pieces)


SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


@pytest.mark.slow
def test_a_run_killed_twenty_times_is_resumed_to_the_same_bits(tmp_path):
    whole, pieces = killed_and_resumed(tmp_path, 20, 2000, SIGNALS)
    assert np.array_equal(whole, pieces)


SCENARIO = """
[mesh]
shape = "sphere"
subdivisions = 3
[kinetics]
name = "gray-scott"
[diffusivity]
u = 2e-4
v = 1e-4
[initial]
u = "1 - 0.5*bumps"
v = "0.5*bumps"
[time]
end = 2000
frames = 100
"""


FITTED = (
    SCENARIO.replace("end = 2000", "end = 60").replace("frames = 100", "frames = 1")
    + """
[fit]
free = ["kinetics.feed", "kinetics.kill", "diffusivity.u", "diffusivity.v"]
[[fit.data]]
file = "seen.npz"
time = 60
"""
)


@pytest.mark.slow
@pytest.mark.parametrize(("command", "kills"), [("run", 10), ("fit", 10)])
def test_a_command_killed_ten_times_is_resumed_to_the_same_bits(tmp_path, command, kills):
    """The last state of a run, and the parameters of a fit, are those of an undisturbed command."""
    (tmp_path / "mine.toml").write_text(FITTED if command == "fit" else SCENARIO)
    example = scenario.read(SCENARIO.replace("end = 2000", "end = 60"), "mine.toml", tmp_path)
    surface = ltl.Surface.from_mesh(example.mesh)
    us = ltl.solve(example.make_equation(surface), surface, example.u0, 60.0).u_end
    np.savez(tmp_path / "seen.npz", u=1.01 * np.asarray(us[:, 0]), v=0.99 * np.asarray(us[:, 1]))
    code = "import sys; from ltljax.app.cli import main; sys.exit(main(sys.argv[1:]))"

    def begin(out, *more):
        changes = ["--set", "kinetics.feed=0.05", "--set", "diffusivity.u=3e-4"] if command == "fit" else []
        line = [sys.executable, "-c", code, command, str(tmp_path / "mine.toml"), "--out", str(out), *changes, *more]
        return subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)

    def end(process):
        errors = process.communicate()[1]
        assert process.returncode == 0, errors

    end(begin(tmp_path / "whole"))
    chance, restart = random.Random(1), tmp_path / "pieces" / "restart"
    killed = 0
    for stop in itertools.islice(itertools.cycle(SIGNALS), kills):
        before = sorted((path.name, path.stat().st_mtime_ns) for path in restart.glob("*.npz"))
        process = begin(tmp_path / "pieces", *(["--resume"] if restart.exists() else []))
        while process.poll() is None and before == sorted(
            (path.name, path.stat().st_mtime_ns) for path in restart.glob("*.npz")
        ):
            time.sleep(1e-3)
        time.sleep(chance.uniform(0.0, 0.1))
        process.send_signal(stop)
        killed += process.wait() != 0
        process.stderr.close()
    assert killed >= kills // 2
    end(begin(tmp_path / "pieces", *(["--resume"] if restart.exists() else [])))
    if command == "run":
        whole, pieces = (tmp_path / out / "series" / "mine_0100.vtp" for out in ("whole", "pieces"))
        assert whole.read_bytes() == pieces.read_bytes()
    else:
        whole, pieces = (json.loads((tmp_path / out / "fit.json").read_text()) for out in ("whole", "pieces"))
        assert whole["found"] == pieces["found"]


@pytest.fixture(scope="module")
def case():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1))
    return ltl.Diffusion(source=surface.vertices[:, 0]), surface, jnp.zeros(surface.num_vertices)


@pytest.mark.parametrize("how", [dict(dt=0.05), dict()], ids=["fixed", "adaptive"])
def test_a_run_in_intervals_equals_the_plain_run(case, tmp_path, how):
    equation, surface, u0 = case
    run = functools.partial(ltl.solve, equation, surface, u0, 1.0, ts=[0.3, 0.5, 1.0], rtol=1e-7, atol=1e-9, **how)
    plain = run()
    stored = run(checkpoints=Checkpoints(tmp_path))
    resumed = run(checkpoints=Checkpoints(tmp_path, resume=True))
    np.testing.assert_allclose(stored.us, plain.us, atol=1e-6)
    np.testing.assert_array_equal(resumed.us, stored.us)
    np.testing.assert_allclose(resumed.ts, plain.ts)
    assert resumed.counts == stored.counts
    if "dt" in how:
        assert stored.counts["num_steps"] == plain.counts["num_steps"] == 20


def test_old_keywords_still_work_and_warn(case, tmp_path):
    equation, surface, u0 = case
    run = functools.partial(ltl.solve, equation, surface, u0, 1.0, dt=0.1)
    with pytest.warns(
        DeprecationWarning, match=r"The argument checkpoint_\w+ of solve .* use checkpoints=ltl\.solvers"
    ):
        old = run(checkpoint_dir=tmp_path, checkpoint_every=0.5)
    resumed = run(checkpoints=Checkpoints(tmp_path, every=0.5, resume=True))
    np.testing.assert_array_equal(old.us, resumed.us)
    for option, message in ((dict(resume=True), "resume=True"), (dict(checkpoint_every=0.1), "checkpoint_every=0.1")):
        with (
            pytest.warns(DeprecationWarning, match="of solve"),
            pytest.raises(ValueError, match=f"{message} needs the folder"),
        ):
            run(**option)
    with pytest.raises(ValueError, match="every must be positive and finite, found 0"):
        Checkpoints(tmp_path, every=0)


def test_files_of_another_run_are_refused(case, tmp_path):
    equation, surface, u0 = case
    ltl.solve(equation, surface, u0, 1.0, checkpoints=Checkpoints(tmp_path))
    other_mesh = ltl.Surface.from_mesh(ltl.shapes.icosphere(1, radius=2.0))
    for name, call in {
        "mesh": (equation, other_mesh, u0, 1.0),
        "equation": (ltl.Diffusion(2.0, source=surface.vertices[:, 0]), surface, u0, 1.0),
        "start": (equation, surface, u0 + 1, 1.0),
        "end": (equation, surface, u0, 2.0),
    }.items():
        with pytest.raises(ltl.errors.RestartError, match=f"differ in {name}"):
            ltl.solve(*call, checkpoints=Checkpoints(tmp_path, resume=True))


def test_a_run_goes_on_from_before_a_damaged_state(case, tmp_path):
    equation, surface, u0 = case
    run = functools.partial(ltl.solve, equation, surface, u0, 1.0, ts=[0.2, 1.0])
    whole = run(checkpoints=Checkpoints(tmp_path))
    resume = Checkpoints(tmp_path, resume=True)
    requested = tmp_path / "state_000003.npz"
    content = requested.read_bytes()
    for damaged in (content[:50], content[: len(content) // 2] + b"x" * 30 + content[len(content) // 2 + 30 :], b""):
        requested.write_bytes(damaged)
        with pytest.warns(UserWarning, match=r"Damaged files in .* were skipped: state_000003\.npz"):
            np.testing.assert_array_equal(run(checkpoints=resume).us, whole.us)
        assert requested.read_bytes() == damaged
        # The state was computed again and stored under another name.
        for state in tmp_path.glob("state_*.npz"):
            state.unlink()
        requested.write_bytes(content)
    requested.unlink()
    np.testing.assert_array_equal(run(checkpoints=resume).us, whole.us)
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(ltl.errors.RestartError, match=r"run\.json was damaged"):
        run(checkpoints=resume)


@pytest.mark.parametrize("count", [1100, pytest.param(11_000, marks=pytest.mark.slow)])
def test_a_damaged_state_never_leads_to_another_result(case, tmp_path, count):
    equation, surface, u0 = case
    run = functools.partial(ltl.solve, equation, surface, u0, 1.0, dt=0.1)
    whole = np.asarray(run(checkpoints=Checkpoints(tmp_path, every=0.5)).u_end)
    intact = {path.name: path.read_bytes() for path in tmp_path.glob("state_*.npz")}
    folder, chance = Folder(tmp_path), random.Random(0)
    # Each turn flips a bit, or truncates in one of eleven turns. No such file passes for intact; four are resumed from.
    for turn in range(count):
        name = chance.choice(sorted(intact))
        content = bytearray(intact[name])
        if turn % 11:
            content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        else:
            content = content[: chance.randrange(len(content))]
        (tmp_path / name).write_bytes(content)
        assert not folder.owns(name)
        if turn % (count // 4) == 0:
            with pytest.warns(UserWarning, match="were skipped"):
                resumed = run(checkpoints=Checkpoints(tmp_path, every=0.5, resume=True))
            np.testing.assert_array_equal(resumed.u_end, whole)
            for path in tmp_path.glob("state_*.npz"):
                path.unlink()
            for other, original in intact.items():
                (tmp_path / other).write_bytes(original)
        (tmp_path / name).write_bytes(intact[name])


def test_a_run_that_has_not_ended_is_not_erased(case, tmp_path):
    equation, surface, u0 = case

    class Stopped(Exception):
        pass

    def stop(t, u, rate):
        jax.debug.callback(lambda now: (_ for _ in ()).throw(Stopped) if now > 0.45 else None, t)
        return jnp.array(False)

    run = functools.partial(ltl.solve, equation, surface, u0, 1.0, dt=0.05)
    with pytest.raises(Exception, match="Stopped"):
        run(checkpoints=Checkpoints(tmp_path, every=0.1), stop_when=stop)
    states = {path.name: path.read_bytes() for path in tmp_path.glob("state_*.npz")}
    assert states
    with pytest.raises(
        ltl.errors.RestartError, match=r"holds a run that has not ended, at t = 0\.\d+\. Go on with resume=True"
    ):
        run(checkpoints=Checkpoints(tmp_path))
    assert states == {path.name: path.read_bytes() for path in tmp_path.glob("state_*.npz")}


def test_files_of_another_program_are_named_in_the_error_and_kept(case, tmp_path):
    equation, surface, u0 = case
    for name in ("state_000000.npz", "state_000007.npz", "run.json"):
        folder = tmp_path / name
        folder.mkdir()
        (folder / name).write_bytes(b"mine")
        for resume in (False, True):
            with pytest.raises(ValueError, match=name.replace(".", r"\.")):
                ltl.solve(equation, surface, u0, 0.5, checkpoints=Checkpoints(folder, resume=resume))
        assert (folder / name).read_bytes() == b"mine"


def test_a_second_run_in_a_folder_in_use_is_refused(case, tmp_path):
    equation, surface, u0 = case
    with Folder(tmp_path).locked(), pytest.raises(ValueError, match="Another run is writing"):
        ltl.solve(equation, surface, u0, 0.5, checkpoints=Checkpoints(tmp_path))


def test_a_new_run_leaves_other_files_alone(case, tmp_path):
    equation, surface, u0 = case
    (tmp_path / "notes.txt").write_text("mine")
    ltl.solve(equation, surface, u0, 0.5, checkpoints=Checkpoints(tmp_path))
    ltl.solve(equation, surface, u0, 1.0, checkpoints=Checkpoints(tmp_path))
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_the_folder_holds_the_last_states_and_the_requested_ones(case, tmp_path):
    equation, surface, u0 = case
    ltl.solve(equation, surface, u0, 1.0, ts=[0.25, 0.5], checkpoints=Checkpoints(tmp_path, every=0.01))
    states = sorted(os.listdir(tmp_path))
    assert states == [".ltljax", "run.json", *(f"state_{number:06d}.npz" for number in (24, 49, 98, 99))]


@pytest.mark.parametrize("how", [dict(dt=0.05), dict()], ids=["fixed", "adaptive"])
def test_rounding_makes_no_extra_interval(case, tmp_path, how):
    equation, surface, u0 = case
    # Three times 0.1 is not 0.3.
    ltl.solve(equation, surface, u0, 0.9, ts=[0.3, 0.6, 0.9], checkpoints=Checkpoints(tmp_path, every=0.1), **how)
    assert sorted(os.listdir(tmp_path))[-1] == "state_000008.npz"


def test_a_run_of_zero_length_can_be_kept(case, tmp_path):
    equation, surface, u0 = case
    solution = ltl.solve(equation, surface, u0, 0.0, checkpoints=Checkpoints(tmp_path), dt=0.1)
    np.testing.assert_array_equal(solution.u_end, u0)


def test_an_overflow_is_reported_again_on_resume(case, tmp_path):
    _, surface, _ = case
    explosive = ltl.ReactionDiffusion((0.1,), lambda s, p: (s[0] ** 2 + p,), params=jnp.array(1.0))
    u0 = jnp.zeros((surface.num_vertices, 1))
    for resume in (False, True):
        with pytest.raises(ltl.SolveError, match=r"overflowed at t = 1\.57"):
            ltl.solve(explosive, surface, u0, 5.0, checkpoints=Checkpoints(tmp_path, resume=resume))


def test_states_without_their_description_are_neither_erased_nor_resumed(case, tmp_path):
    equation, surface, u0 = case
    run = functools.partial(ltl.solve, equation, surface, u0, 0.5, dt=0.1)
    run(checkpoints=Checkpoints(tmp_path))
    states = {path.name: path.read_bytes() for path in tmp_path.glob("state_*.npz")}
    (tmp_path / "run.json").unlink()
    with pytest.raises(ltl.errors.RestartError, match="that says which run made them"):
        run(checkpoints=Checkpoints(tmp_path, resume=True))
    with pytest.raises(ltl.errors.RestartError, match="holds a run that has not ended"):
        run(checkpoints=Checkpoints(tmp_path))
    assert states == {path.name: path.read_bytes() for path in tmp_path.glob("state_*.npz")}
