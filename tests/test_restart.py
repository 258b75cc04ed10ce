"""Runs that are kept on disk go on from there to the same end, whenever they were killed."""

import functools
import os
import random
import signal
import subprocess
import sys
import time

import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl
from ltljax.solve.restart import fingerprint

RUN = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import ltljax as ltl

surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(3))
x = surface.vertices
u0 = jax.numpy.stack([1 - 0.5 * jax.numpy.exp(-4 * x[:, 0] ** 2), 0.5 * jax.numpy.exp(-4 * x[:, 0] ** 2)], axis=1)
equation = ltl.ReactionDiffusion((0.02, 0.01), ltl.kinetics.gray_scott())
solution = ltl.solve(
    equation, surface, u0, float(sys.argv[3]), dt=0.01, checkpoint_dir=sys.argv[1], checkpoint_every=0.1, resume=True
)
np.save(sys.argv[2], solution.u_end)
"""


def latest(folder):
    """The number of the last state in a folder; -1 where there is none."""
    return max((int(path.stem.removeprefix("state_")) for path in folder.glob("state_*.npz")), default=-1)


def start(folder, end, intervals):
    command = [sys.executable, "-c", RUN, str(folder), str(end), str(0.1 * intervals)]
    # A pipe that nobody reads would fill up with warnings, and the process would wait for ever.
    with said_in(end).open("w") as said:
        return subprocess.Popen(command, stderr=said)


def said_in(end):
    """The file that holds what the process that writes ``end`` says on standard error."""
    return end.with_suffix(".log")


def killed_and_resumed(tmp_path, kills, intervals):
    """The end of a run that was not interrupted, and of one that was killed that many times on its way."""
    whole, pieces, folder = tmp_path / "whole.npy", tmp_path / "pieces.npy", tmp_path / "b"
    undisturbed = start(tmp_path / "a", whole, intervals)
    chance = random.Random(0)
    for _ in range(kills):
        begun = latest(folder)
        until = begun + chance.randint(1, intervals // (2 * kills))
        process = start(folder, pieces, intervals)
        while latest(folder) < until and process.poll() is None:
            time.sleep(1e-3)
        time.sleep(chance.uniform(0.0, 0.02))  # anywhere in what an interval does
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        assert begun < latest(folder) < intervals - 1
    for process, end in ((undisturbed, whole), (start(folder, pieces, intervals), pieces)):
        assert process.wait() == 0, said_in(end).read_text()
    return np.load(whole), np.load(pieces)


def test_a_killed_run_goes_on_to_the_same_bits(tmp_path):
    whole, pieces = killed_and_resumed(tmp_path, 2, 80)
    assert np.array_equal(whole, pieces)


@pytest.mark.slow
def test_a_run_killed_twenty_times_goes_on_to_the_same_bits(tmp_path):
    whole, pieces = killed_and_resumed(tmp_path, 20, 2000)
    assert np.array_equal(whole, pieces)


@pytest.fixture
def case():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2))
    return ltl.Diffusion(source=surface.vertices[:, 0]), surface, jnp.zeros(surface.num_vertices)


@pytest.mark.parametrize("how", [dict(dt=0.05), dict()], ids=["fixed", "adaptive"])
def test_a_run_in_intervals_is_the_run(case, tmp_path, how):
    equation, surface, u0 = case
    how = dict(ts=[0.3, 0.5, 1.0], rtol=1e-7, atol=1e-9) | how
    plain = ltl.solve(equation, surface, u0, 1.0, **how)
    kept = ltl.solve(equation, surface, u0, 1.0, checkpoint_dir=tmp_path, **how)
    again = ltl.solve(equation, surface, u0, 1.0, checkpoint_dir=tmp_path, resume=True, **how)
    np.testing.assert_allclose(kept.us, plain.us, atol=1e-6)
    np.testing.assert_array_equal(again.us, kept.us)
    np.testing.assert_allclose(again.ts, plain.ts)
    assert again.counts == kept.counts


def test_files_of_another_run_are_refused(case, tmp_path):
    equation, surface, u0 = case
    ltl.solve(equation, surface, u0, 1.0, checkpoint_dir=tmp_path)
    other_mesh = ltl.Surface.from_mesh(ltl.shapes.icosphere(2, radius=2.0))
    for name, call in {
        "mesh": (equation, other_mesh, u0, 1.0),
        "equation": (ltl.Diffusion(2.0, source=surface.vertices[:, 0]), surface, u0, 1.0),
        "start": (equation, surface, u0 + 1, 1.0),
        "end": (equation, surface, u0, 2.0),
    }.items():
        with pytest.raises(ltl.RestartError, match=f"another {name}"):
            ltl.solve(*call, checkpoint_dir=tmp_path, resume=True)


def test_damaged_files_are_refused_and_unfinished_ones_not_read(case, tmp_path):
    equation, surface, u0 = case
    run = functools.partial(ltl.solve, equation, surface, u0, 1.0, ts=[0.2, 1.0], checkpoint_dir=tmp_path)
    whole = run()
    (tmp_path / "state_000020.unfinished").write_bytes(b"half")
    np.testing.assert_array_equal(run(resume=True).us, whole.us)
    asked = tmp_path / "state_000003.npz"
    content = asked.read_bytes()
    for damaged in (content[:50], content[: len(content) // 2] + b"x" * 30 + content[len(content) // 2 + 30 :]):
        asked.write_bytes(damaged)
        with pytest.raises(ltl.RestartError, match=r"state_000003\.npz is missing or damaged"):
            run(resume=True)
    asked.unlink()
    with pytest.raises(ltl.RestartError, match=r"state at t = 0\.2 is missing"):
        run(resume=True)
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(ltl.RestartError, match=r"run\.json is damaged"):
        run(resume=True)


def test_starting_anew_leaves_other_files_alone(case, tmp_path):
    equation, surface, u0 = case
    (tmp_path / "notes.txt").write_text("mine")
    ltl.solve(equation, surface, u0, 0.5, checkpoint_dir=tmp_path)
    ltl.solve(equation, surface, u0, 1.0, checkpoint_dir=tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_the_folder_holds_the_last_states_and_those_asked_for(case, tmp_path):
    equation, surface, u0 = case
    ltl.solve(equation, surface, u0, 1.0, ts=[0.25, 0.5], checkpoint_dir=tmp_path, checkpoint_every=0.01)
    states = sorted(os.listdir(tmp_path))
    assert states == ["run.json", *(f"state_{number:06d}.npz" for number in (24, 49, 98, 99))]


@pytest.mark.parametrize("how", [dict(dt=0.05), dict()], ids=["fixed", "adaptive"])
def test_no_interval_is_of_rounding(case, tmp_path, how):
    equation, surface, u0 = case
    # A tenth three times is not three tenths.
    ltl.solve(equation, surface, u0, 0.9, ts=[0.3, 0.6, 0.9], checkpoint_dir=tmp_path, checkpoint_every=0.1, **how)
    assert sorted(os.listdir(tmp_path))[-1] == "state_000008.npz"


def test_a_fingerprint_is_of_what_a_value_is():
    def one(x, p):
        return x + p

    def other(x, p):
        return x - p

    assert fingerprint(ltl.Diffusion(1.0)) == fingerprint(ltl.Diffusion(1.0))
    assert fingerprint(ltl.Diffusion(1.0)) != fingerprint(ltl.Diffusion(2.0))
    assert fingerprint(one) != fingerprint(other)
    assert fingerprint(np.zeros(3)) != fingerprint(np.zeros((3, 1)))


RATE = 1.0


def reads_a_number_of_its_module(x):
    return RATE * x


def calls_a_function_of_its_module(x):
    return reads_a_number_of_its_module(x)


def test_a_fingerprint_is_of_what_a_function_reads(monkeypatch):
    before = [fingerprint(f) for f in (reads_a_number_of_its_module, calls_a_function_of_its_module)]
    assert before == [fingerprint(f) for f in (reads_a_number_of_its_module, calls_a_function_of_its_module)]
    monkeypatch.setitem(globals(), "RATE", 2.0)
    after = [fingerprint(f) for f in (reads_a_number_of_its_module, calls_a_function_of_its_module)]
    assert before[0] != after[0]
    assert before[1] != after[1]

    def with_default(rate):
        return lambda x, rate=rate: rate * x

    assert fingerprint(with_default(1.0)) != fingerprint(with_default(2.0))
    assert fingerprint(functools.partial(max, 1.0)) != fingerprint(functools.partial(max, 2.0))
    assert fingerprint(lambda x: np.sin(x)) != fingerprint(lambda x: np.cos(x))
    assert fingerprint(ltl.RKL2()) != fingerprint(ltl.RKL1())


class Opaque:
    def __init__(self, rate):
        self.rate = rate

    def __call__(self, x):
        return self.rate * x


TABLE = {"rate": [1.0, 2.0]}


def makes_a_function(x):
    def within(x):
        return RATE * x + TABLE["rate"][0]

    return within(x)


def tells_apart(x):
    return x in {"spots", "stripes", "holes", "waves"}


PRINT = """
import sys
sys.path.insert(0, sys.argv[1])
import test_restart as here
from ltljax.solve.restart import fingerprint
print(fingerprint([here.tells_apart, here.Opaque(1.0), here.makes_a_function, here.ltl.RKL2(), here.np.float32]))
"""


def test_a_fingerprint_is_the_same_in_every_process():
    command = [sys.executable, "-c", PRINT, os.path.dirname(__file__)]
    processes = [
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONHASHSEED": seed})
        for seed in ("1", "2")
    ]
    one, other = (process.communicate()[0] for process in processes)
    assert [process.returncode for process in processes] == [0, 0]
    assert one == other


def test_a_fingerprint_sees_objects_and_what_functions_within_read(monkeypatch):
    assert fingerprint(Opaque(1.0)) == fingerprint(Opaque(1.0))
    assert fingerprint(Opaque(1.0)) != fingerprint(Opaque(2.0))
    assert fingerprint((12, 3)) != fingerprint((1, 23))
    assert fingerprint({1, 2}) != fingerprint({1, 3})
    before = fingerprint(makes_a_function)
    monkeypatch.setitem(globals(), "RATE", 2.0)
    after = fingerprint(makes_a_function)
    assert before != after
    monkeypatch.setitem(globals(), "TABLE", {"rate": [5.0, 2.0]})
    assert after != fingerprint(makes_a_function)


def test_a_run_of_no_length_is_kept_too(case, tmp_path):
    equation, surface, u0 = case
    found = ltl.solve(equation, surface, u0, 0.0, checkpoint_dir=tmp_path, dt=0.1)
    np.testing.assert_array_equal(found.u_end, u0)


def test_an_overflow_is_kept_and_said_again(case, tmp_path):
    _, surface, _ = case
    explosive = ltl.ReactionDiffusion((0.1,), lambda s, p: (s[0] ** 2 + p,), params=jnp.array(1.0))
    u0 = jnp.zeros((surface.num_vertices, 1))
    for resume in (False, True):
        with pytest.raises(ltl.SolveError, match=r"overflowed at t = 1\.57"):
            ltl.solve(explosive, surface, u0, 5.0, checkpoint_dir=tmp_path, resume=resume)
