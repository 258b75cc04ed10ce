"""Derivatives through every family of time steppers."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(2))


def test_a_rejected_step_does_not_spoil_the_derivative(sphere):
    rough = jnp.asarray(np.random.default_rng(0).normal(size=sphere.num_vertices))
    solver = dataclasses.replace(ltl.RKL2(), loop_kind="bounded")

    def after(diffusivity):
        # The step is so long that its stages would overflow.
        begin, end = jnp.zeros(()), jnp.ones(())
        args = (ltl.Diffusion(diffusivity), sphere)
        terms = diffrax.ODETerm(lambda t, u, args: args[0].rate(t, args[1], u))
        state = solver.init(terms, begin, end, rough, args)
        stepped, error, *_ = solver.step(terms, begin, end, rough, args, state, made_jump=jnp.array(False))
        is_taken = jnp.isfinite(error).all()
        return jnp.sum(jnp.where(is_taken, stepped, diffusivity * rough))

    np.testing.assert_allclose(jax.grad(after)(1e9), jnp.sum(rough))


GRADIENTS = {
    "explicit": (diffrax.Heun(), dict(dt=0.01)),
    "RKL2": (ltl.RKL2(), dict(dt=0.1)),
    "SBDF2": (ltl.SBDF2(), dict(dt=0.1)),
    "KenCarp3": (diffrax.KenCarp3(), dict(dt=0.2)),
    "TRBDF2": (ltl.TRBDF2(), dict(dt=0.2)),
}


def families(*quick):
    """All families of solvers, those that are not quick marked as slow: each is quick in one of the two tests below."""
    return [name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in GRADIENTS]


def assert_second_order_remainders(loss, at, directions, smallest_slope=0.0):
    """The remainder of a linear model of the loss falls like the square of the step, in each direction."""
    both = jax.jit(jax.value_and_grad(loss))
    value, gradient = both(at)
    for key, direction in directions.items():
        slope = jnp.sum(gradient[key] * direction)
        assert abs(slope) > smallest_slope
        rest = [abs(both({**at, key: at[key] + h * direction})[0] - value - h * slope) for h in (0.1, 0.01)]
        assert abs(np.log10(rest[0] / rest[1]) - 2) < 0.1, key


@pytest.mark.parametrize("name", families("RKL2"))
def test_taylor_remainders_are_of_second_order_through_every_family(sphere, name):
    solver, how = GRADIENTS[name]
    x = sphere.vertices
    hierarchy = ltl.solvers.multigrid(sphere)
    u0 = jnp.stack([1 - 0.5 * jnp.exp(-4 * x[:, 0] ** 2), 0.5 * jnp.exp(-4 * x[:, 1] ** 2)], axis=1)

    def loss(parameters):
        kinetics = ltl.kinetics.gray_scott(parameters["feed"], 0.06)
        equation = ltl.ReactionDiffusion((parameters["diffusivity"], 0.01), kinetics)
        moved = sphere.with_vertices(x + parameters["vertices"])
        start = u0 * (1 + parameters["start"][:, None])
        options = dict(rtol=1e-11, atol=1e-12, throw=False, preconditioner=hierarchy, **how)
        end = ltl.solve(equation, moved, start, 1.0, solver=solver, **options).us[-1]
        return jnp.sum(end**2 * x[:, :2])

    random = np.random.default_rng(0)
    at = dict(
        diffusivity=jnp.array(0.1), feed=jnp.array(0.04), vertices=0.1 * x[:, :1] * x,
        start=jnp.asarray(0.1 * random.normal(size=sphere.num_vertices)),
    )  # fmt: skip
    directions = dict(
        diffusivity=0.1, feed=0.03, start=0.2 * random.normal(size=sphere.num_vertices),
        vertices=0.1 * random.normal(size=x.shape),
    )  # fmt: skip
    assert_second_order_remainders(loss, at, directions)


@pytest.mark.parametrize("name", families("explicit", "SBDF2", "KenCarp3"))
def test_taylor_remainders_of_boundary_data_and_fields_through_every_family(name):
    solver, how = GRADIENTS[name]
    surface = ltl.Surface.from_mesh(ltl.shapes.disk(rings=6))
    x = surface.vertices
    hierarchy = ltl.solvers.multigrid(surface)

    def loss(parameters):
        # A logistic reaction whose rate is a field, with a source, values held on one side and a flux on the other.
        conditions = (
            ltl.Neumann(parameters["flux"] * jnp.sin(x[:, 1])),
            ltl.Dirichlet(parameters["values"], where=lambda x: x[:, 0] > 0.2),
        )
        equation = ltl.ReactionDiffusion(
            (0.1,), lambda species, p: (p["rate"] * species[0] * (1 - species[0]) + p["source"],),
            params=dict(rate=parameters["rate"], source=parameters["source"]), boundary=conditions,
        )  # fmt: skip
        options = dict(rtol=1e-11, atol=1e-12, throw=False, preconditioner=hierarchy, **how)
        end = ltl.solve(equation, surface, 0.2 + 0 * x[:, :1], 1.0, solver=solver, **options).us[-1]
        return jnp.sum(end[:, 0] ** 2 * jnp.cos(x[:, 0]))

    field = jnp.asarray(np.random.default_rng(0).uniform(size=surface.num_vertices))
    at = dict(values=0.3 + field, flux=jnp.array(0.5), rate=1 + field, source=0.2 * field)
    directions = dict(values=0.5 * field, flux=jnp.array(0.5), rate=field, source=field)
    assert_second_order_remainders(loss, at, directions, smallest_slope=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", GRADIENTS)
def test_the_direct_adjoint_has_the_derivatives_of_checkpoints(sphere, name):
    solver, how = GRADIENTS[name]
    x1 = sphere.vertices[:, 0]

    def end(rate, adjoint):
        equation = ltl.ReactionDiffusion((0.2,), lambda species, p: (p * species[0] - species[0] ** 2,), params=rate)
        options = dict(rtol=1e-11, atol=1e-12, throw=False, max_steps=100, adjoint=adjoint, **how)
        return jnp.sum(ltl.solve(equation, sphere, 1 + x1[:, None], 1.0, solver=solver, **options).us[-1] ** 2)

    checkpointed = jax.grad(end)(jnp.array(1.5), None)
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(derivative(end)(jnp.array(1.5), diffrax.DirectAdjoint()), checkpointed, rtol=1e-7)


def test_a_source_field_is_differentiated_in_forward_and_reverse(sphere):
    x1 = sphere.vertices[:, 0]

    def end(source, adjoint=None):
        equation = ltl.Diffusion(0.5, source=source)
        solution = ltl.solve(equation, sphere, 0 * x1, 1.0, solver=ltl.TRBDF2(), dt=0.25, adjoint=adjoint, rtol=1e-10)
        return jnp.sum(solution.us[-1] * jnp.cos(3 * x1))

    reverse = jax.grad(end)(x1)
    _, forward = jax.jvp(lambda source: end(source, diffrax.ForwardMode()), (x1,), (x1**2,))
    np.testing.assert_allclose(jnp.sum(reverse * x1**2), forward, rtol=1e-8)
    # The run is linear in the source, so the difference is exact.
    np.testing.assert_allclose(end(x1 + x1**2) - end(x1), forward, rtol=1e-7)


def test_ensembles_are_vmapped_through_implicit_steps(sphere):
    x = sphere.vertices
    run = lambda d, u: ltl.solve(  # noqa: E731
        ltl.Diffusion(d), sphere, u, 0.5, solver=ltl.TRBDF2(), dt=0.1, rtol=1e-10, throw=False
    ).us[-1]
    rates, starts = jnp.array([0.5, 1.0, 2.0]), jnp.stack([x[:, 0], x[:, 1], x[:, 2] ** 2])
    batch = jax.vmap(run)(rates, starts)
    for d, u, end in zip(rates, starts, batch, strict=True):
        np.testing.assert_allclose(end, run(d, u), atol=1e-9)
