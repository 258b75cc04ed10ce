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
print("begun", flush=True)
solution = ltl.solve(
    equation, surface, u0, 20.0, dt=0.01, checkpoint_dir=sys.argv[1], checkpoint_every=0.2, resume=True
)
np.save(sys.argv[2], solution.u_end)
"""


def run(folder, end, kill_after=None):
    """One process of the run, killed so many seconds after it has begun if it lasts that long."""
    command = [sys.executable, "-c", RUN, folder, end]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        if kill_after is not None:
            process.stdout.readline()
            time.sleep(kill_after)
            process.send_signal(signal.SIGKILL)
        return process.wait()


def killed_and_resumed(tmp_path, kills):
    """The end of a run that was not interrupted, and of one that was killed that many times."""
    whole, pieces = tmp_path / "whole.npy", tmp_path / "pieces.npy"
    assert run(tmp_path / "a", whole) == 0
    chance = random.Random(0)
    for _ in range(kills):
        run(tmp_path / "b", pieces, kill_after=chance.uniform(0.0, 4.0))
    assert run(tmp_path / "b", pieces) == 0
    return np.load(whole), np.load(pieces)


def test_a_killed_run_goes_on_to_the_same_bits(tmp_path):
    whole, pieces = killed_and_resumed(tmp_path, 2)
    assert np.array_equal(whole, pieces)


@pytest.mark.slow
def test_a_run_killed_twenty_times_goes_on_to_the_same_bits(tmp_path):
    whole, pieces = killed_and_resumed(tmp_path, 20)
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
    ltl.solve(equation, surface, u0, 1.0, checkpoint_dir=tmp_path)
    (tmp_path / "state_000020.unfinished").write_bytes(b"half")
    ltl.solve(equation, surface, u0, 1.0, checkpoint_dir=tmp_path, resume=True)
    state = tmp_path / "state_000003.npy"
    state.write_bytes(state.read_bytes()[:50])
    with pytest.raises(ltl.RestartError, match=r"state_000003\.npy is missing or damaged"):
        ltl.solve(equation, surface, u0, 1.0, checkpoint_dir=tmp_path, resume=True)
    (tmp_path / "progress.json").write_text("{")
    with pytest.raises(ltl.RestartError, match=r"progress.json is damaged"):
        ltl.solve(equation, surface, u0, 1.0, checkpoint_dir=tmp_path, resume=True)


def test_starting_anew_leaves_other_files_alone(case, tmp_path):
    equation, surface, u0 = case
    (tmp_path / "notes.txt").write_text("mine")
    ltl.solve(equation, surface, u0, 0.5, checkpoint_dir=tmp_path)
    ltl.solve(equation, surface, u0, 1.0, checkpoint_dir=tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert len(os.listdir(tmp_path)) == 22  # twenty states, the progress, the notes


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
