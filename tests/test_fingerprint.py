"""Whether two runs are the same: fingerprints of values, functions and objects."""

import functools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl
from ltljax._solve.fingerprint import fingerprint
from ltljax.solvers import Checkpoints


@pytest.fixture(scope="module")
def case():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1))
    return ltl.Diffusion(source=surface.vertices[:, 0]), surface, jnp.zeros(surface.num_vertices)


def test_a_fingerprint_tells_values_apart():
    def plus(x, p):
        return x + p

    def minus(x, p):
        return x - p

    assert fingerprint(ltl.Diffusion(1.0)) == fingerprint(ltl.Diffusion(1.0))
    assert fingerprint(ltl.Diffusion(1.0)) != fingerprint(ltl.Diffusion(2.0))
    assert fingerprint(plus) != fingerprint(minus)
    assert fingerprint(np.zeros(3)) != fingerprint(np.zeros((3, 1)))


def test_a_fingerprint_covers_the_source_and_the_values_of_a_function():
    def with_default(rate):
        return lambda x, rate=rate: rate * x

    def around(rate):
        return lambda x: rate * x

    assert fingerprint(with_default(1.0)) != fingerprint(with_default(2.0))
    assert fingerprint(around(jnp.ones(3))) == fingerprint(around(jnp.ones(3)))
    assert fingerprint(around(jnp.ones(3))) != fingerprint(around(jnp.zeros(3)))
    assert fingerprint(functools.partial(max, 1.0)) != fingerprint(functools.partial(max, 2.0))
    assert fingerprint(lambda x: np.sin(x)) != fingerprint(lambda x: np.cos(x))
    assert fingerprint(ltl.RKL2()) != fingerprint(ltl.RKL1())


def scaled_by(factor):
    def decorated(function):
        @functools.wraps(function)
        def scaled(x):
            return factor * function(x)

        return scaled

    return decorated


def test_a_fingerprint_covers_decorators_and_the_order_of_values():
    def f(x):
        return x

    def g(x):
        return x + 1

    assert fingerprint(scaled_by(1)(f)) != fingerprint(scaled_by(2)(f))
    assert len({fingerprint(made(f)) for made in (jax.jit, jax.vmap, jax.grad, scaled_by(1))} | {fingerprint(f)}) == 5
    assert fingerprint([f, g, f]) != fingerprint([f, g, g])
    shared = [1.0]
    assert fingerprint([shared, shared]) == fingerprint([[1.0], [1.0]])
    assert fingerprint((1,)) == fingerprint((1.0,))
    assert fingerprint(True) != fingerprint(1)


def test_a_run_of_functions_without_a_source_needs_a_name(case, tmp_path):
    _, surface, u0 = case
    names = {}
    exec("def kinetics(s, p): return (-s[0],)", names)
    equation = ltl.ReactionDiffusion((0.1,), names["kinetics"])
    run = functools.partial(ltl.solve, equation, surface, u0[:, None], 0.2, dt=0.1)
    with pytest.raises(ltl.errors.RestartError, match=r"source of the function kinetics is not available.*run_id"):
        run(checkpoints=Checkpoints(tmp_path))
    named = run(checkpoints=Checkpoints(tmp_path, run_id="decay"))
    resumed = run(checkpoints=Checkpoints(tmp_path, run_id="decay", resume=True))
    np.testing.assert_array_equal(named.u_end, resumed.u_end)
    with pytest.raises(ltl.errors.RestartError, match="differ in equation"):
        run(checkpoints=Checkpoints(tmp_path, run_id="growth", resume=True))


class Opaque:
    def __init__(self, rate):
        self.rate = rate

    def __call__(self, x):
        return self.rate * x


def is_pattern(x):
    return x in {"spots", "stripes", "holes", "waves"}


PRINT = """
import sys
sys.path.insert(0, sys.argv[1])
from test_fingerprint import Opaque, fingerprint, is_pattern, ltl, np
print(fingerprint([is_pattern, Opaque(1.0), ltl.RKL2(), np.float32]))
"""


def test_a_fingerprint_is_the_same_in_every_process():
    command = [sys.executable, "-c", PRINT, os.path.dirname(__file__)]
    processes = [
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONHASHSEED": seed})
        for seed in ("1", "2")
    ]
    first, second = (process.communicate()[0] for process in processes)
    assert [process.returncode for process in processes] == [0, 0]
    assert first == second


def test_a_fingerprint_covers_objects_and_containers():
    assert fingerprint(Opaque(1.0)) == fingerprint(Opaque(1.0))
    assert fingerprint(Opaque(1.0)) != fingerprint(Opaque(2.0))
    assert fingerprint((12, 3)) != fingerprint((1, 23))
    assert fingerprint({1, 2}) != fingerprint({1, 3})
    with pytest.raises(TypeError, match="Objects of type generator cannot be compared"):
        fingerprint(x for x in ())


class Doubled:
    def __init__(self, factor):
        self.factor = factor

    @functools.wraps(max)
    def __call__(self, x):
        return self.factor * x


def test_a_fingerprint_covers_the_object_of_a_decorated_method():
    assert fingerprint(Doubled(1.0).__call__) != fingerprint(Doubled(2.0).__call__)
