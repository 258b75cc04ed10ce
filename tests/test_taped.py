"""Runs of stabilised steps: their results, and derivatives in reverse mode that take each step twice."""

import dataclasses
import functools
import itertools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl
from ltljax._solve import integrate, taped


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(1))


class After(eqx.Module):
    """A stopping condition whose time is an array, so that other times need no compilation."""

    time: jax.Array = dataclasses.field(default_factory=lambda: jnp.array(jnp.inf))

    def __call__(self, t, u, rate):
        return t > self.time


def reaction(species, params):
    u, v = species
    rates = params["a"] - u + u**2 * v, 0.9 - u**2 * v
    return tuple(30 * params["scale"] * rate for rate in rates)


def start_on(surface):
    x = surface.vertices
    return jnp.stack([1 + 0.1 * x[:, 0], 0.9 + 0.1 * x[:, 1]], axis=1)


def run(surface, params, u0, adjoint=None, solver=None, ts=(0.0, 0.013, 0.1, 0.2), stop=jnp.inf, **how):
    equation = ltl.ReactionDiffusion((1.0, params["d"]), reaction, dict(a=params["a"], scale=params["scale"]))
    solver, stop_when = ltl.RKL2() if solver is None else solver, After(jnp.asarray(stop))
    return ltl.solve(equation, surface, u0, 0.2, ts, solver, adjoint, stop_when=stop_when, **(dict(dt=0.011) | how))


def params_on(surface):
    return dict(a=jnp.full(surface.num_vertices, 0.1), d=jnp.array(10.0), scale=jnp.array(1.0))


def loss_of(solution):
    reached = jnp.where(jnp.isfinite(solution.us), solution.us, 0)
    return jnp.sum(reached**2) + jnp.sum(solution.u_end**3)


# Cases of the same solver and number of steps share their compiled functions.
CASES = {
    "RKL2": {},
    "states in one step": dict(ts=(0.05, 0.05, 0.1, 0.1 + 1e-12)),
    "stopped between": dict(stop=0.055),
    "stopped at a state": dict(stop=0.095, ts=(0.0, 0.013, 0.099, 0.2)),
    "stopped at once": dict(stop=-1.0, ts=(0.05, 0.1, 0.1, 0.2)),
    "many stages": dict(dt=0.07),
    "adaptive": dict(dt=None, ts=(0.0, 0.05, 0.0501, 0.2)),
    "adaptive, stopped": dict(dt=None, stop=0.055),
    "adaptive, no step": dict(dt=None, stop=-1.0, ts=(0.05, 0.1, 0.1, 0.2)),
    "RKL1": dict(solver=ltl.RKL1()),
    "few stages": dict(dt=1e-3, ts=None),
}
SLOW = ("RKL1", "few stages")


CHECKPOINTS = diffrax.RecursiveCheckpointAdjoint(checkpoints=99)


def gradients(surface, case, adjoint=None):
    """The value and the solution of a case, and the gradients."""

    def value(params, u0):
        solution = run(surface, params, u0, adjoint, **CASES[case])
        return loss_of(solution), solution

    return jax.value_and_grad(value, (0, 1), has_aux=True)(params_on(surface), start_on(surface))


@functools.cache
def checkpointed_gradients(case):
    """The gradients of a case by diffrax's checkpoints."""
    return gradients(ltl.Surface.from_mesh(ltl.shapes.icosphere(1)), case, CHECKPOINTS)


def assert_equal_gradients(derivative, expected, is_adaptive, rtol=1e-11):
    if is_adaptive:
        # In diffrax, the first step and with it all others depend on the bound of the eigenvalues.
        derivative, expected = derivative[0]["a"], expected[0]["a"]
    for x, y in zip(jax.tree.leaves(derivative), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, atol=rtol * float(jnp.max(jnp.abs(y))))


@pytest.mark.parametrize("case", [pytest.param(c, marks=pytest.mark.slow) if c in SLOW else c for c in CASES])
def test_runs_and_derivatives_equal_those_of_checkpoints(sphere, case):
    (_, ours), derivative = gradients(sphere, case)
    (_, theirs), expected = checkpointed_gradients(case)
    for name in ("ts", "us", "t_end", "u_end", "overflowed", "stopped"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-12, err_msg=name)
    assert ours.result == theirs.result
    assert {name: int(count) for name, count in ours.counts.items()} == {
        name: int(count) for name, count in theirs.counts.items()
    }
    assert_equal_gradients(derivative, expected, "adaptive" in case)


def forget_taped_runs():
    for compiled in (integrate._by_taped_fixed_steps, integrate._by_taped_adaptive_steps):
        compiled._cached.clear_cache()


@pytest.mark.parametrize(
    ("kept", "shortest", "case"),
    [
        (0.3, 4, "RKL2"),
        (0.3, 2, "many stages"),
        (3, 0, "adaptive"),
        pytest.param(0.1, 7, "many stages", marks=pytest.mark.slow),
        pytest.param(2, 0, "adaptive", marks=pytest.mark.slow),
    ],
)
def test_a_tape_shorter_than_a_step_is_filled_several_times(sphere, monkeypatch, kept, shortest, case):
    monkeypatch.setattr(taped, "_KEPT_OF_ADAPTIVE" if case == "adaptive" else "_KEPT", kept)
    monkeypatch.setattr(taped, "_SHORTEST", shortest)
    _, expected = checkpointed_gradients(case)
    # The sizes are read when a run is traced, so traced runs must be forgotten.
    forget_taped_runs()
    _, derivative = gradients(sphere, case)
    forget_taped_runs()
    assert_equal_gradients(derivative, expected, case == "adaptive")


def test_adaptive_steps_have_the_derivatives_of_short_ones(sphere):
    @jax.jit
    def slopes(params, u0, rtol):
        return jax.grad(lambda *x: loss_of(run(sphere, *x, dt=None, rtol=rtol, atol=rtol)), (0, 1))(params, u0)

    coarse, fine = (slopes(params_on(sphere), start_on(sphere), rtol) for rtol in (1e-7, 1e-9))
    for derivative, expected in zip(jax.tree.leaves(coarse), jax.tree.leaves(fine), strict=True):
        np.testing.assert_allclose(derivative, expected, atol=2e-3 * float(jnp.max(jnp.abs(expected))))


def test_times_have_derivatives(sphere):
    def value(t1):
        u0 = sphere.vertices[:, 0]
        return jnp.sum(ltl.solve(ltl.Diffusion(), sphere, u0, t1, solver=ltl.RKL2(), rtol=1e-7).u_end ** 2)

    energy, slope = jax.value_and_grad(value)(0.3)
    np.testing.assert_allclose(slope, -4 * energy, rtol=0.05)


ENDS = jnp.array([1.0, 0.055, 0.155, 0.0])
RATES = jnp.array([1.0, 10.0, 80.0, 3.0])


def batched_value(surface, dt, d, end):
    params = params_on(surface) | dict(d=d, scale=d / 10)
    return loss_of(run(surface, params, start_on(surface), dt=dt, stop=end))


@pytest.mark.parametrize("dt", [0.02, None])
def test_runs_of_a_batch_with_different_stages_and_ends_have_their_own_derivatives(sphere, dt):
    value = functools.partial(batched_value, sphere, dt)
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(value)))(RATES, ENDS)
    alone = jax.jit(jax.value_and_grad(value))
    for i in range(len(RATES)):
        # The slope is a small difference of large sums, which are rounded differently in a batch.
        np.testing.assert_allclose([values[i], slopes[i]], alone(RATES[i], ENDS[i]), rtol=1e-9)


@pytest.mark.parametrize("dt", [0.02, pytest.param(None, marks=pytest.mark.slow)])
def test_the_derivative_of_the_sum_over_a_batch_is_that_of_each_run(sphere, dt):
    value = functools.partial(batched_value, sphere, dt)
    of_sum = jax.jit(jax.grad(lambda d: jnp.sum(jax.vmap(value)(d, ENDS))))(RATES)
    alone = jax.jit(jax.grad(value))
    np.testing.assert_allclose(of_sum, [alone(*each) for each in zip(RATES, ENDS, strict=True)], rtol=1e-9)


@pytest.mark.slow
def test_derivatives_in_the_vertices_and_in_time_dependent_data_pass_the_taylor_test():
    surface = ltl.Surface.from_mesh(ltl.shapes.disk(rings=3))
    boundary = ltl.Dirichlet(lambda t, x: jnp.sin(3 * t) * x[:, 0])

    def value(params):
        moved = surface.with_vertices(surface.vertices * params["stretch"][None])
        equation = ltl.Diffusion(params["d"], source=lambda t, x: jnp.cos(t) * x[:, 1], boundary=boundary)
        return jnp.sum(ltl.solve(equation, moved, params["u0"], 0.3, solver=ltl.RKL2(), dt=0.02).u_end ** 2)

    x = surface.vertices
    params = dict(stretch=jnp.ones(3), d=1.3, u0=x[:, 0] * x[:, 1])
    check = ltl.inverse.check_gradient(value, params)
    assert check.passed, check


def heat_energy(d, surface, num_steps, reaction):
    equation = ltl.ReactionDiffusion((1.0, d), reaction)
    end = ltl.solve(equation, surface, start_on(surface), num_steps * 1e-3, solver=ltl.RKL2(), dt=1e-3).u_end
    return jnp.sum(end**2)


def test_a_gradient_takes_the_rate_three_times(sphere):
    calls = []

    def counted(species, _):
        jax.debug.callback(lambda: calls.append(1))
        return tuple(-u for u in species)

    counts = []
    for function in (heat_energy, jax.grad(heat_energy)):
        calls.clear()
        jax.block_until_ready(jax.jit(function, static_argnums=(2, 3))(10.0, sphere, 200, counted))
        jax.effects_barrier()
        counts.append(len(calls))
    assert counts[0] > 600
    # The rate is taken forward, again, and in the transpose, which calls back twice.
    assert counts[1] < 3.2 * counts[0]


def test_the_memory_of_a_gradient_grows_with_the_square_root_of_the_steps():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(3))

    def decay(species, _):
        return tuple(-u for u in species)

    memory = [
        jax.jit(jax.grad(lambda d, n=num_steps: heat_energy(d, surface, n, decay)))
        .lower(10.0)
        .compile()
        .memory_analysis()
        .temp_size_in_bytes
        for num_steps in (1000, 4000, 16000)
    ]
    for shorter, longer in itertools.pairwise(memory):
        assert longer < 2.2 * shorter
    assert memory[0] < 450 * start_on(surface).nbytes


def test_the_rounding_error_is_that_of_sums_of_sums():
    # In float32, the error of a single sum would grow with the number of stages.
    def value(params, surface):
        x = surface.vertices
        equation = ltl.Diffusion(params["d"], source=lambda t, x: params["s"] * x[:, 1])
        end = ltl.solve(equation, surface, x[:, 0], 1.0, solver=ltl.RKL2(), dt=1e-3).u_end
        return jnp.sum(end * (x[:, 0] + x[:, 1]))

    mesh, slopes = ltl.shapes.icosphere(2), []
    for dtype in (jnp.float32, jnp.float64):
        surface = ltl.Surface.from_mesh(mesh, dtype=dtype)
        slopes.append(jax.grad(value)(dict(d=jnp.asarray(0.5, dtype), s=jnp.asarray(0.5, dtype)), surface))
    for name in ("d", "s"):
        np.testing.assert_allclose(slopes[0][name], slopes[1][name], rtol=3e-5)


def assert_batch_equals_runs(value, *params):
    derivative = jax.jit(jax.grad(lambda shared: jnp.sum(jax.vmap(functools.partial(value, shared))(*params))))(1.0)
    alone = jax.jit(jax.grad(value))
    np.testing.assert_allclose(derivative, sum(alone(1.0, *each) for each in zip(*params, strict=True)), rtol=1e-10)


def test_a_run_that_has_ended_leaves_the_rest_of_the_batch_alone(sphere):
    # When these runs end, their rate has no derivative. The level 0.01 is not reached.
    def melting(shared, level):
        equation = ltl.ReactionDiffusion((0.1,), lambda species, _: (-shared / jnp.sqrt(species[0]),))
        start = 0.2 + 0 * sphere.vertices[:, :1]
        how = dict(solver=ltl.RKL2(), dt=0.005, stop_when=lambda t, u, rate: jnp.min(u) < level)
        return jnp.sum(ltl.solve(equation, sphere, start, 0.04, **how).u_end)

    assert_batch_equals_runs(melting, jnp.array([0.13, 0.19, 0.01]))


def test_a_run_of_more_stages_begins_no_step_beyond_the_end_of_the_batch(sphere):
    # The source has no real value after the end.
    def until(shared, d):
        equation = ltl.Diffusion(d * shared, source=lambda t, x: jnp.sqrt(0.1 - t) * x[:, 0])
        return jnp.sum(ltl.solve(equation, sphere, sphere.vertices[:, 0], 0.1, solver=ltl.RKL2(), dt=0.02).u_end ** 2)

    assert_batch_equals_runs(until, jnp.array([0.5, 40.0]))


def test_rates_and_bounds_may_be_anything_that_diffrax_accepts(sphere):
    class Bound(eqx.Module):
        d: jax.Array

        def __call__(self, t, u, args):
            return 400 * self.d

    class Even(ltl.Equation):
        level: jax.Array

        def rate(self, t, surface, u):
            return jnp.asarray(self.level, jnp.float32)

        def spectral_bound(self, t, surface, u):
            return jnp.ones(())

    def value(d, equation):
        how = dict(solver=ltl.RKL2(Bound(d)), dt=0.01)
        return jnp.sum(ltl.solve(equation(d), sphere, sphere.vertices[:, 0], 0.1, **how).u_end ** 2)

    exact = jax.grad(lambda d: jnp.sum((sphere.vertices[:, 0] + 0.1 * d) ** 2))(1.0)
    np.testing.assert_allclose(jax.grad(value)(1.0, Even), exact, rtol=1e-6)
    assert jnp.isfinite(jax.grad(value)(1.0, ltl.Diffusion))


@pytest.mark.parametrize("how", [dict(dt=0.01), {}], ids=["fixed", "adaptive"])
def test_a_condition_that_is_not_one_truth_value_is_refused(sphere, how):
    with pytest.raises(ValueError, match="stop_when to return one truth value"):
        ltl.solve(ltl.Diffusion(), sphere, sphere.vertices[:, 0], 0.1, stop_when=lambda t, u, rate: u > 0, **how)


def test_runs_that_do_not_fit_on_a_tape_use_checkpoints():
    large = np.broadcast_to(np.zeros((), np.float32), (2**22, 2))
    assert taped.is_worth_it(500, large)
    assert taped.is_worth_it(None, large)
    assert not taped.is_worth_it(10_000, large)
    assert taped.is_worth_it(10_000, large[:10_000])
