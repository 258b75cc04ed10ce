"""Taylor's test of gradients: its verdicts, and the gradients of runs that must pass it."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(1))


def test_a_right_gradient_passes_and_a_wrong_one_does_not(sphere):
    x = sphere.vertices[:, 0]

    def loss(p):
        solution = ltl.solve(ltl.Diffusion(p["d"]), sphere, x, 0.1, solver=diffrax.Heun(), dt=0.01, throw=False)
        # With a share of 1 the second factor has no derivative.
        hidden = jax.lax.stop_gradient(p["d"]) * p["share"] + p["d"] * (1 - p["share"])
        return jnp.sum(solution.u_end**2) * hidden

    along_d = dict(d=1.0, share=0.0)
    right = ltl.inverse.check_gradient(loss, dict(d=1.0, share=0.0), along_d)
    assert right.passed
    assert right.slope == pytest.approx(2, abs=0.1)
    wrong = ltl.inverse.check_gradient(loss, dict(d=1.0, share=1.0), along_d)
    assert not wrong.passed
    assert "wrong: slope 1.0" in str(wrong)
    # An interactive session shows the table, too.
    assert repr(wrong) == str(wrong)


def test_the_verdict_names_the_cause():
    check = ltl.inverse.check_gradient
    assert "linear" in check(lambda p: 3 * p["a"].sum(), dict(a=np.arange(3.0))).verdict
    slightly_wrong = check(lambda p: jnp.sin(p) + 1e-3 * jax.lax.stop_gradient(p), 1.0)
    assert not slightly_wrong.passed
    assert "right to 0.2 %, no better" in slightly_wrong.verdict
    assert "noisy" in check(lambda p: jnp.sin(p) + 1e-4 * jnp.sin(1e7 * jax.lax.stop_gradient(p)), 1.0).verdict
    with pytest.raises(ValueError, match="one finite number"):
        check(lambda p: jnp.log(p), -1.0)


@pytest.mark.parametrize(
    "loss",
    [
        lambda p: 1e12 + jax.lax.stop_gradient(p),
        lambda p: jnp.float32(1) + jnp.float32(1e-4) * jax.lax.stop_gradient(p).astype(jnp.float32),
        lambda p: 0 * p,
    ],
    ids=["float64", "float32", "constant"],
)
def test_a_loss_that_does_not_respond_does_not_pass(loss):
    check = ltl.inverse.check_gradient(loss, 1.0)
    assert not check.passed
    assert "does not respond to steps of this size" in check.verdict


FAMILIES = {
    "explicit": (diffrax.Heun(), 0.01), "RKL2": (ltl.RKL2(), 0.05), "SBDF2": (ltl.SBDF2(), 0.05),
    "TRBDF2": (ltl.TRBDF2(), 0.1), "stationary": (None, None),
}  # fmt: skip
SLOW_FAMILIES = {"explicit", "RKL2", "SBDF2", "TRBDF2"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW_FAMILIES else []) for name in FAMILIES]
)
def test_gradients_with_respect_to_vertices_pass(sphere, name):
    solver, dt = FAMILIES[name]
    x, hierarchy = sphere.vertices, ltl.solvers.multigrid(sphere)
    u0 = jnp.cos(2 * x[:, 0]) + x[:, 1]

    def loss(vertices):
        moved = sphere.with_vertices(vertices)
        if solver is None:
            u = ltl.screened_poisson(moved, u0, 1.0, rtol=1e-12, preconditioner=hierarchy)
        else:
            u = ltl.solve(
                ltl.Diffusion(0.5), moved, u0, 0.2, solver=solver, dt=dt, rtol=1e-12, throw=False,
                preconditioner=hierarchy,
            ).u_end  # fmt: skip
        return jnp.sum(u**2 * jnp.cos(x[:, 2]))

    direction = 0.2 * np.random.default_rng(0).normal(size=x.shape)
    check = ltl.inverse.check_gradient(loss, x, direction)
    assert check.passed, check
    assert check.slope == pytest.approx(2, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [diffrax.Tsit5(), ltl.RKL2(), ltl.TRBDF2()], ids=lambda s: type(s).__name__)
def test_tangents_of_adaptive_runs_are_of_second_order(sphere, solver):
    x, hierarchy = sphere.vertices, ltl.solvers.multigrid(sphere)

    @jax.jit
    def loss(p):
        kinetics = ltl.kinetics.schnakenberg(p["rate"], 0.9, rate=10.0)
        end = ltl.solve(
            ltl.ReactionDiffusion((0.1, 1.0), kinetics), sphere.with_vertices(p["vertices"]), p["start"], 0.1,
            solver=solver, adjoint=diffrax.ForwardMode(), rtol=1e-9, atol=1e-10, throw=False, preconditioner=hierarchy,
        ).u_end  # fmt: skip
        return jnp.sum(end**2 * jnp.cos(x[:, :2]))

    params = dict(rate=jnp.array(0.1), start=1 + 0.1 * x[:, :2], vertices=x)
    rng = np.random.default_rng(0)
    tangent = jax.jit(lambda direction: jax.jvp(loss, (params,), (direction,)))
    for key, size in dict(rate=0.1, start=0.3, vertices=0.1).items():
        zeros = {name: jnp.zeros_like(value) for name, value in params.items()}
        direction = {**zeros, key: jnp.asarray(size * rng.normal(size=params[key].shape))}
        value, slope = tangent(direction)
        remainders = [
            abs(loss(jax.tree.map(lambda a, d, h=h: a + h * d, params, direction)) - value - h * slope)
            for h in (0.1, 0.01)
        ]
        assert abs(np.log10(remainders[0] / remainders[1]) - 2) < 0.1, key
