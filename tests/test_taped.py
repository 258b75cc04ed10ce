"""Runs of stabilised steps: what they return, and derivatives in reverse mode that take each step twice."""

import itertools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl
from ltljax._solve import taped


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(1))


def start_on(surface):
    x = surface.vertices
    return jnp.stack([1 + 0.1 * x[:, 0], 0.9 + 0.1 * x[:, 1]], axis=1)


def run(surface, params, u0, adjoint=None, solver=None, ts=(0.0, 0.013, 0.1, 0.2), **how):
    how = dict(dt=0.01) | how
    # The rate reaches one of its parameters through a closure.
    kinetics = ltl.kinetics.schnakenberg(params["a"], 0.9, rate=30.0)
    equation = ltl.ReactionDiffusion(
        (1.0, params["d"]),
        lambda species, _: tuple(params["scale"] * rate for rate in kinetics.rates(species, kinetics.params)),
    )
    solver = ltl.RKL2() if solver is None else solver
    return ltl.solve(equation, surface, u0, 0.2, ts, solver, adjoint, **how)


def params_on(surface):
    return dict(a=jnp.full(surface.num_vertices, 0.1), d=jnp.array(10.0), scale=jnp.array(1.0))


def loss_of(found):
    reached = jnp.where(jnp.isfinite(found.us), found.us, 0)
    return jnp.sum(reached**2) + jnp.sum(found.u_end**3)


CASES = {
    "RKL2": {},
    "RKL1": dict(solver=ltl.RKL1()),
    "few stages": dict(dt=1e-3, ts=None),
    "many stages": dict(dt=0.1),
    "states in one step": dict(ts=[0.05, 0.05, 0.1, 0.1 + 1e-12]),
    "stopped between": dict(stop_when=lambda t, u, rate: t > 0.055),
    "stopped at a state": dict(stop_when=lambda t, u, rate: t > 0.095),
    "stopped at once": dict(stop_when=lambda t, u, rate: t > -1, ts=(0.1,)),
    "adaptive": dict(dt=None, ts=(0.0, 0.05, 0.0501, 0.0502, 0.2)),
    "adaptive, stopped": dict(dt=None, stop_when=lambda t, u, rate: t > 0.055),
    "adaptive, no step": dict(dt=None, stop_when=lambda t, u, rate: t > -1, ts=(0.1,)),
}


@pytest.mark.parametrize("case", CASES)
def test_runs_and_derivatives_are_those_of_checkpoints(sphere, case):
    def value(params, u0, adjoint):
        found = run(sphere, params, u0, adjoint, **CASES[case])
        return loss_of(found), found

    both = jax.value_and_grad(value, (0, 1), has_aux=True)
    (_, ours), derivatives = both(params_on(sphere), start_on(sphere), None)
    (_, theirs), others = both(params_on(sphere), start_on(sphere), diffrax.RecursiveCheckpointAdjoint(checkpoints=99))
    for name in ("ts", "us", "t_end", "u_end", "overflowed", "stopped"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-12, err_msg=name)
    assert ours.result == theirs.result
    assert {name: int(count) for name, count in ours.counts.items()} == {
        name: int(count) for name, count in theirs.counts.items()
    }
    if "adaptive" in case:
        # To diffrax the first step, and all others in proportion, is a function of what bounds the eigenvalues.
        derivatives, others = derivatives[0]["a"], others[0]["a"]
    for found, other in zip(jax.tree.leaves(derivatives), jax.tree.leaves(others), strict=True):
        np.testing.assert_allclose(found, other, atol=1e-11 * float(jnp.max(jnp.abs(other))))


@pytest.mark.parametrize(
    ("kept", "shortest", "dt"), [(0.3, 4, 0.011), (0.1, 7, 0.07), (0.3, 2, 0.07), (2, 0, None), (3, 0, None)]
)
def test_a_tape_shorter_than_a_step_is_filled_again(sphere, monkeypatch, kept, shortest, dt):
    monkeypatch.setattr(taped, "_KEPT" if dt else "_KEPT_OF_ADAPTIVE", kept)
    monkeypatch.setattr(taped, "_SHORTEST", shortest)
    eqx.clear_caches()

    def value(params, adjoint):
        return loss_of(run(sphere, params, start_on(sphere), adjoint, dt=dt))

    found = jax.grad(value)(params_on(sphere), None)
    other = jax.grad(value)(params_on(sphere), diffrax.RecursiveCheckpointAdjoint(checkpoints=99))
    eqx.clear_caches()
    if dt is None:
        found, other = found["a"], other["a"]
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-11 * float(jnp.max(jnp.abs(y))))


def test_adaptive_steps_have_the_derivatives_of_short_ones(sphere):
    def value(params, u0, rtol):
        return loss_of(run(sphere, params, u0, dt=None, rtol=rtol, atol=rtol))

    coarse, fine = (jax.grad(value, (0, 1))(params_on(sphere), start_on(sphere), rtol) for rtol in (1e-7, 1e-9))
    for found, other in zip(jax.tree.leaves(coarse), jax.tree.leaves(fine), strict=True):
        np.testing.assert_allclose(found, other, atol=2e-3 * float(jnp.max(jnp.abs(other))))


def test_times_have_derivatives_too(sphere):
    def value(t1):
        return jnp.sum(
            ltl.solve(ltl.Diffusion(), sphere, sphere.vertices[:, 0], t1, solver=ltl.RKL2(), rtol=1e-7).u_end ** 2
        )

    np.testing.assert_allclose(jax.grad(value)(0.3), -4 * value(0.3), rtol=0.05)


@pytest.mark.parametrize("dt", [0.01, None])
def test_batches_with_other_stages_and_other_ends_have_the_derivatives_of_each(sphere, dt):
    def value(d, end):
        params = params_on(sphere) | dict(d=d, scale=d / 10)
        return loss_of(run(sphere, params, start_on(sphere), dt=dt, stop_when=lambda t, u, rate: t > end))

    d, end = jnp.array([1.0, 10.0, 80.0, 3.0]), jnp.array([1.0, 0.055, 0.155, 0.0])
    values, slopes = jax.vmap(jax.value_and_grad(value))(d, end)
    for i in range(len(d)):
        one, slope = jax.value_and_grad(value)(d[i], end[i])
        # The slope is a small difference of sums as large as the value, and batches round differently.
        np.testing.assert_allclose([values[i], slopes[i]], [one, slope], rtol=1e-9)
    of_sum = jax.grad(lambda d: jnp.sum(jax.vmap(value)(d, end)))(d)
    np.testing.assert_allclose(of_sum, slopes, rtol=1e-9)


def test_derivatives_in_the_vertices_and_in_time_dependent_data_pass_the_taylor_test():
    surface = ltl.Surface.from_mesh(ltl.shapes.disk(rings=4))
    boundary = ltl.Dirichlet(lambda t, x: jnp.sin(3 * t) * x[:, 0])

    def value(params):
        moved = surface.with_vertices(surface.vertices * params["stretch"][None])
        equation = ltl.Diffusion(params["d"], source=lambda t, x: jnp.cos(t) * x[:, 1], boundary=boundary)
        return jnp.sum(ltl.solve(equation, moved, params["u0"], 0.3, solver=ltl.RKL2(), dt=0.02).u_end ** 2)

    x = surface.vertices
    params = dict(stretch=jnp.ones(3), d=1.3, u0=x[:, 0] * x[:, 1])
    found = ltl.inverse.check_gradient(value, params)
    assert found.passed, found


def test_a_gradient_takes_the_rate_three_times_in_the_memory_of_the_root_of_the_steps(sphere):
    plain, taken = ltl.kinetics.schnakenberg(0.1, 0.9, rate=30.0), []

    def counted(species, _):
        jax.debug.callback(lambda: taken.append(1))
        return plain.rates(species, plain.params)

    def value(d, steps, kinetics, surface=sphere):
        equation = ltl.ReactionDiffusion((1.0, d), kinetics)
        u0 = start_on(surface)
        return jnp.sum(ltl.solve(equation, surface, u0, steps * 1e-3, solver=ltl.RKL2(), dt=1e-3).u_end ** 2)

    calls = []
    for function in (value, jax.grad(value)):
        taken.clear()
        jax.block_until_ready(jax.jit(function, static_argnums=(1, 2))(10.0, 200, counted))
        jax.effects_barrier()
        calls.append(len(taken))
    assert calls[0] > 600
    # There, again, and at the states it is transposed at, where one transposition calls back twice.
    assert calls[1] < 3.2 * calls[0]
    fine = ltl.Surface.from_mesh(ltl.shapes.icosphere(3))
    memory = [
        jax.jit(jax.grad(lambda d, steps=steps: value(d, steps, plain, fine)))
        .lower(10.0)
        .compile()
        .memory_analysis()
        .temp_size_in_bytes
        for steps in (1000, 4000, 16000)
    ]
    for shorter, longer in itertools.pairwise(memory):
        assert longer < 2.2 * shorter
    assert memory[0] < 450 * start_on(fine).nbytes


def test_rounding_is_that_of_sums_of_sums():
    # In float32, where one sum over all stages would be as wrong as their number.
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


def test_runs_of_a_batch_that_end_leave_the_others_alone(sphere):
    def batch(value, *params):
        found = jax.grad(lambda shared: jnp.sum(jax.vmap(lambda *each: value(shared, *each))(*params)))(1.0)
        alone = [jax.grad(value)(1.0, *each) for each in zip(*params, strict=True)]
        np.testing.assert_allclose(found, sum(alone), rtol=1e-10)

    # Where the rate has no derivative in the end, and runs of more stages that begin no step beyond it.
    def melting(shared, level):
        equation = ltl.ReactionDiffusion((0.1,), lambda species, _: (-shared / jnp.sqrt(species[0]),))
        start = 0.2 + 0 * sphere.vertices[:, :1]
        how = dict(solver=ltl.RKL2(), dt=0.005, stop_when=lambda t, u, rate: jnp.min(u) < level)
        return jnp.sum(ltl.solve(equation, sphere, start, 0.04, **how).u_end)

    def until(shared, d):
        equation = ltl.Diffusion(d * shared, source=lambda t, x: jnp.sqrt(0.1 - t) * x[:, 0])
        return jnp.sum(ltl.solve(equation, sphere, sphere.vertices[:, 0], 0.1, solver=ltl.RKL2(), dt=0.02).u_end ** 2)

    # 0.01 is not reached.
    batch(melting, jnp.array([0.13, 0.19, 0.01]))
    batch(until, jnp.array([0.5, 40.0]))


def test_rates_and_bounds_may_be_anything_that_diffrax_takes(sphere):
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
        found = ltl.solve(equation(d), sphere, sphere.vertices[:, 0], 0.1, solver=ltl.RKL2(Bound(d)), dt=0.01)
        return jnp.sum(found.u_end**2)

    exact = jax.grad(lambda d: jnp.sum((sphere.vertices[:, 0] + 0.1 * d) ** 2))(1.0)
    np.testing.assert_allclose(jax.grad(value)(1.0, Even), exact, rtol=1e-6)
    assert jnp.isfinite(jax.grad(value)(1.0, ltl.Diffusion))


def test_a_condition_that_is_no_truth_value_is_said_so(sphere):
    for how in (dict(dt=0.01), {}):
        with pytest.raises(ValueError, match="stop_when to return one truth value"):
            ltl.solve(ltl.Diffusion(), sphere, sphere.vertices[:, 0], 0.1, stop_when=lambda t, u, rate: u > 0, **how)


def test_what_no_tape_holds_is_left_to_checkpoints():
    large = np.broadcast_to(np.zeros((), np.float32), (2**22, 2))
    assert taped.is_worth_it(500, large)
    assert taped.is_worth_it(None, large)
    assert not taped.is_worth_it(10_000, large)
    assert taped.is_worth_it(10_000, large[:10_000])
