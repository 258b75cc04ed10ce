"""Steppers: order in time, stability, the maximum principle, and derivatives through all of them."""

import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl
from ltljax._solve import preconditioning
from ltljax._solve.checks import longest_step

# The solver, its order, and the numbers of fixed steps between which the order is measured.
SOLVERS = {
    "BackwardEuler": (ltl.BackwardEuler(), 1, (8, 32)),
    "CrankNicolson": (ltl.CrankNicolson(), 2, (8, 32)),
    "TRBDF2": (ltl.TRBDF2(), 2, (8, 32)),
    "SBDF2": (ltl.SBDF2(), 2, (16, 64)),
    "Kvaerno3": (diffrax.Kvaerno3(), 3, (16, 64)),
    "Kvaerno5": (diffrax.Kvaerno5(), 5, (8, 32)),
    "KenCarp3": (diffrax.KenCarp3(), 3, (16, 64)),
    "KenCarp4": (diffrax.KenCarp4(), 4, (8, 32)),
    "KenCarp5": (diffrax.KenCarp5(), 5, (8, 32)),
    "Sil3": (diffrax.Sil3(), 2, (8, 32)),
    "RKL2": (ltl.RKL2(), 2, (64, 256)),
    "RKL1": (ltl.RKL1(), 1, (16, 64)),
}


FULLY_IMPLICIT = ["BackwardEuler", "CrankNicolson", "TRBDF2", "Kvaerno3", "Kvaerno5"]


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(2))


@pytest.fixture(scope="module")
def random_sphere():
    return ltl.Surface.from_mesh(ltl.shapes.random_sphere(300, seed=1))


@pytest.fixture(scope="module")
def decay(sphere):
    """The initial state of a diffusion and its state at t = 0.4, by the matrix exponential.

    It has only a few modes, so that the order of a solver shows.
    """
    values, vectors = np.linalg.eig(ltl.laplacian_matrix(sphere).todense())
    x = np.asarray(sphere.vertices)
    few = np.argsort(-values.real)[:16]
    start = (vectors[:, few] @ np.linalg.pinv(vectors[:, few]) @ (3 * x.prod(axis=1) + x[:, 0])).real
    return start, (vectors @ (np.exp(0.4 * values) * np.linalg.solve(vectors, start))).real


def slopes(errors, counts):
    return -np.diff(np.log(errors)) / np.diff(np.log(counts))


def end_after(equation, surface, u0, t1, name, count, pieces=1):
    """The state at t1 after fixed steps, a number of which make a piece.

    A one-step method can be run piece by piece, so that runs with different numbers of steps share what is compiled.
    """
    how = dict(solver=SOLVERS[name][0], dt=t1 / count, rtol=1e-12, atol=1e-13)
    u = u0
    for piece in range(pieces):
        begin, end = (jnp.asarray(t1 * number / pieces) for number in (piece, piece + 1))
        u = ltl.solve(equation, surface, u, float(end), t0=float(begin), **how).u_end
    return u


def errors_after(equation, surface, u0, exact, t1, name, counts):
    """The relative errors with the two numbers of steps."""
    pieces = 1 if name == "SBDF2" else counts[1] // counts[0]
    ends = [
        end_after(equation, surface, u0, t1, name, counts[0]),
        end_after(equation, surface, u0, t1, name, counts[1], pieces),
    ]
    return [float(jnp.linalg.norm(end - exact) / np.linalg.norm(exact)) for end in ends]


# An array as diffusivity, so that other values need no compilation.
HEAT = ltl.Diffusion(jnp.array(1.0))


@pytest.mark.parametrize("name", SOLVERS)
def test_fixed_steps_have_the_order_of_the_method(sphere, decay, name):
    _, order, counts = SOLVERS[name]
    u0, exact = decay
    errors = errors_after(HEAT, sphere, jnp.asarray(u0), exact, 0.4, name, counts)
    assert abs(slopes(errors, counts)[0] - order) < 0.2
    assert errors[-1] < 0.1**order


def oscillator(species, params):
    u, v = species
    return -2.0 * v - u**3, 2.0 * u - params * v


@pytest.fixture(scope="module")
def forced(sphere):
    """A reaction and a diffusion with a time-dependent source, and their states at t = 1 by a method of order 8."""
    x = sphere.vertices
    reacting = ltl.ReactionDiffusion((0.05, 0.02), oscillator, params=jnp.array(0.3))
    driven = ltl.Diffusion(0.05, source=lambda t, x: jnp.cos(5 * t) * x[:, 0])
    cases = []
    for equation, u0 in ((reacting, jnp.stack([1 + x[:, 0], x[:, 1]], axis=1)), (driven, 0 * x[:, 0])):
        end = ltl.solve(equation, sphere, u0, 1.0, solver=diffrax.Dopri8(), rtol=1e-12, atol=1e-13).u_end
        cases.append((equation, u0, end))
    return cases


# Numbers of steps, for the reaction and the source, at which errors follow the order and exceed rounding errors.
FORCED = {
    "SBDF2": ((32, 96), (32, 96)), "RKL2": ((32, 96), (32, 96)), "Sil3": ((48, 144), (48, 144)),
    "KenCarp3": ((64, 256), (64, 256)), "KenCarp4": ((8, 24), (8, 24)), "KenCarp5": ((64, 128), (8, 24)),
    "Kvaerno5": ((48, 96), (12, 24)),
}  # fmt: skip


QUICK = ["TRBDF2", "SBDF2", "KenCarp4", "RKL2"]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in SOLVERS]
)
def test_the_order_holds_with_a_time_dependent_source_and_a_reaction(sphere, forced, name):
    order = SOLVERS[name][1]
    for (equation, u0, exact), counts in zip(forced, FORCED.get(name, 2 * ((16, 48),)), strict=True):
        errors = errors_after(equation, sphere, u0, exact, 1.0, name, counts)
        assert abs(slopes(errors, counts)[0] - order) < 0.2
        assert errors[-1] < 0.1


L_STABLE = ["BackwardEuler", "TRBDF2", "SBDF2", "Kvaerno3", "Kvaerno5", "KenCarp3", "KenCarp4", "KenCarp5"]


@pytest.mark.parametrize("name", [*L_STABLE, "CrankNicolson"])
def test_l_stable_solvers_damp_stiff_modes(sphere, name):
    rough = jnp.asarray(np.random.default_rng(0).normal(size=sphere.num_vertices))
    mean = ltl.integrate(sphere, rough, sphere.mass) / jnp.sum(sphere.mass)
    # The number of steps is that of the test of the order, whose compiled functions are used again.
    count = SOLVERS[name][2][0]
    how = dict(solver=SOLVERS[name][0], dt=0.1, rtol=1e-10, atol=1e-12)
    end = ltl.solve(ltl.Diffusion(jnp.array(1e5)), sphere, rough, 0.1 * count, **how).u_end
    # Crank-Nicolson does not damp them.
    assert (jnp.max(jnp.abs(end - mean)) < 1e-6) == (name in L_STABLE)


@pytest.mark.parametrize("solver", [ltl.RKL1(), ltl.BackwardEuler()], ids=["RKL1", "BackwardEuler"])
@pytest.mark.parametrize("stiffness", [3.0, 100.0, 3000.0])
def test_solvers_of_first_order_keep_the_maximum_principle(random_sphere, solver, stiffness):
    surface = random_sphere
    dt = stiffness / float(ltl.operators.spectral_bound(surface))
    random = np.random.default_rng(0)
    spikes = jnp.asarray((random.random((surface.num_vertices, 8)) > 0.97) * 1.0)
    u = ltl.solve(ltl.Diffusion(jnp.ones(8)), surface, spikes, 5 * dt, solver=solver, dt=dt, rtol=1e-12, atol=1e-13).us
    assert u.min() > -1e-10
    assert u.max() < 1 + 1e-10


@pytest.mark.parametrize("solver", [ltl.RKL2(), ltl.RKL1()], ids=["RKL2", "RKL1"])
def test_stages_grow_with_the_square_root_of_the_stiffness(sphere, solver):
    counts = []
    for diffusivity in (10.0, 1000.0):
        equation = ltl.Diffusion(jnp.array(diffusivity))
        solution = ltl.solve(equation, sphere, sphere.vertices[:, 0], 0.1, solver=solver, dt=0.1)
        counts.append(int(solution.stats["num_evaluations"]))
    assert 8 < counts[1] / counts[0] < 13


def test_a_fixed_step_that_needs_more_than_all_stages_is_taken_in_parts(sphere):
    def end(diffusivity, t1=1.0):
        return ltl.solve(
            ltl.Diffusion(jnp.array(diffusivity)), sphere, sphere.vertices[:, 0], t1, solver=ltl.RKL2(), dt=t1
        )

    solution = end(1e5)
    parts = int(re.search(r"each step in (\d+) parts", solution.method)[1])
    assert solution.counts["num_steps"] == parts > 1
    assert np.abs(solution.u_end).max() < 1e-3
    with pytest.raises(ValueError, match=r"dt = 1e\+09 is too long: each step would be taken in \d+ parts"):
        end(1e5, 1e9)
    # Inside jit, where nothing can be raised, the state is NaN.
    assert not jnp.isfinite(jax.jit(lambda d: end(d).u_end)(1e5)).any()


@pytest.mark.parametrize("solver", [ltl.BackwardEuler(), ltl.RKL2()], ids=["BackwardEuler", "RKL2"])
def test_fixed_steps_run_in_float32_for_any_requested_times(solver):
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2), dtype=jnp.float32)
    x1 = surface.vertices[:, 0]
    times = np.linspace(0, 1, 11)
    run = ltl.solve(ltl.Diffusion(), surface, x1, 1.0, ts=times, solver=solver, dt=0.01)
    assert int(run.stats["num_steps"]) == 100
    assert run.us.dtype == jnp.float32
    np.testing.assert_allclose(run.us, np.exp(-2 * times)[:, None] * np.asarray(x1), atol=2e-2)


@pytest.mark.parametrize("name", ["TRBDF2", "KenCarp3", pytest.param("Kvaerno5", marks=pytest.mark.slow)])
def test_adaptive_implicit_steps_follow_the_tolerance(sphere, decay, name):
    start, exact = decay
    errors = []
    for tolerance in (1e-4, 1e-7):
        end = ltl.solve(HEAT, sphere, start, 0.4, solver=SOLVERS[name][0], rtol=tolerance, atol=tolerance).u_end
        errors.append(float(jnp.linalg.norm(end - exact) / np.linalg.norm(exact)))
    assert errors[0] < 1e-2
    assert errors[1] < 0.03 * errors[0]


def test_jacobi_is_used_where_multigrid_is_not_available(sphere, monkeypatch):
    with_multigrid = ltl.solve(ltl.Diffusion(), sphere, sphere.vertices[:, 0], 0.5, solver=ltl.TRBDF2())
    monkeypatch.setattr(preconditioning, "is_available", lambda: False)
    without = ltl.solve(ltl.Diffusion(), sphere, sphere.vertices[:, 0], 0.5, solver=ltl.TRBDF2())
    assert "multigrid" in with_multigrid.stats["solver"]
    assert "Jacobi" in without.stats["solver"]
    np.testing.assert_allclose(without.us, with_multigrid.us, atol=1e-5)


def test_implicit_steps_hold_boundary_values():
    surface = ltl.Surface.from_mesh(ltl.shapes.disk(12))
    x = surface.vertices
    equation = ltl.Diffusion(source=0 * x[:, 0], boundary=ltl.Dirichlet(lambda t, x: 1 + t + 0 * x[:, 0]))
    explicit = ltl.solve(equation, surface, jnp.ones(surface.num_vertices), 1.0, rtol=1e-8, atol=1e-10).us[-1]
    for solver in (ltl.TRBDF2(), diffrax.KenCarp4()):
        implicit = ltl.solve(
            equation, surface, jnp.ones(surface.num_vertices), 1.0, solver=solver, rtol=1e-7, atol=1e-9
        ).us[-1]
        np.testing.assert_allclose(implicit, explicit, atol=1e-4)
        assert implicit[surface.topology.boundary].min() == 2.0


def test_a_run_ends_when_its_stopping_condition_holds(sphere):
    x1 = sphere.vertices[:, 0]
    source = ltl.Diffusion(source=x1)
    steady = ltl.solve(source, sphere, 0 * x1, 1e3, stop_when=ltl.Steady(1e-5))
    assert bool(steady.stopped)
    assert 2 < steady.t_end < 40
    np.testing.assert_allclose(steady.u_end, x1 / 2, atol=1e-2)
    never = ltl.solve(source, sphere, 0 * x1, 0.1, stop_when=lambda t, u, rate: jnp.max(u) > 10)
    assert not bool(never.stopped)


def test_a_dense_solution_can_be_evaluated_at_any_time(sphere):
    x1 = sphere.vertices[:, 0]
    dense = ltl.solve(ltl.Diffusion(), sphere, x1, 1.0, dense=True, max_steps=500, rtol=1e-7, atol=1e-9)
    for t in (0.1, 0.37, 0.9):
        np.testing.assert_allclose(dense.at(t), jnp.exp(-2 * t) * x1, atol=2e-2)
    with pytest.raises(ValueError, match=r"a time from 0 to 1, found 2\.0"):
        dense.at(2.0)
    with pytest.raises(ValueError, match="dense=True"):
        ltl.solve(ltl.Diffusion(), sphere, x1, 1.0).at(0.5)


def test_sbdf2_is_exact_for_linear_growth_whatever_the_lengths_of_its_steps(sphere):
    one, times = jnp.ones(sphere.num_vertices), np.array([0.1, 0.25, 0.3, 0.7])
    run = ltl.solve(ltl.Diffusion(source=3 * one), sphere, one, 0.7, ts=times, solver=ltl.SBDF2(), dt=0.1)
    np.testing.assert_allclose(run.us, np.outer(1 + 3 * times, one), rtol=1e-8)


def test_the_longest_stable_step_is_that_of_the_stiffest_mode(sphere):
    values = np.linalg.eigvals(ltl.laplacian_matrix(sphere).todense())
    longest = longest_step(diffrax.Heun(), np.abs(values).max(), 0.0)
    rough = jnp.asarray(np.random.default_rng(0).normal(size=sphere.num_vertices))
    ltl.solve(ltl.Diffusion(), sphere, rough, 300 * longest, solver=diffrax.Heun(), dt=0.98 * longest)
    with pytest.raises(ValueError, match="too long for Heun"):
        ltl.solve(ltl.Diffusion(), sphere, rough, 300 * longest, solver=diffrax.Heun(), dt=1.1 * longest)


@pytest.mark.parametrize(
    "name", [name if name == "TRBDF2" else pytest.param(name, marks=pytest.mark.slow) for name in FULLY_IMPLICIT]
)
def test_newton_solves_a_stiff_reaction(sphere, name):
    relax = ltl.ReactionDiffusion((0.1,), lambda species, k: (-k * (species[0] ** 3 - 1),), params=jnp.array(1e4))
    u0 = 1 + 0.5 * sphere.vertices[:, :1]
    end = ltl.solve(relax, sphere, u0, 1.0, solver=SOLVERS[name][0]).us[-1]
    np.testing.assert_allclose(end, 1, atol=1e-3)


def test_long_stiff_runs_take_implicit_steps_by_default(sphere):
    def chosen(diffusivity, **how):
        return ltl.solve(ltl.Diffusion(jnp.array(diffusivity)), sphere, sphere.vertices[:, 0], 1.0, **how).stats[
            "solver"
        ]

    assert chosen(1.0).startswith("RKL2: explicit")
    assert chosen(1e4).startswith("TRBDF2: implicit")
    # Whether a run counts as stiff depends on the tolerance.
    assert chosen(300.0, rtol=1e-3).startswith("TRBDF2: implicit")
    assert chosen(300.0, rtol=1e-6).startswith("RKL2: explicit")
    assert chosen(1e4, solver=ltl.RKL2()).startswith("RKL2: chosen by the caller")
    # A reaction may itself be stiff, for which implicit steps are slow.
    reacting = ltl.ReactionDiffusion((1e4,), lambda species, _: (-species[0],))
    reacted = ltl.solve(reacting, sphere, sphere.vertices[:, :1], 1.0, max_steps=10, throw=False)
    assert reacted.method.startswith("RKL2: explicit")
    traced = jax.jit(lambda d: ltl.solve(ltl.Diffusion(d), sphere, sphere.vertices[:, 0], 1.0, max_steps=10))
    assert traced(1e4).method.startswith("RKL2")
