"""Time stepping against exact solutions and against itself at half the step, and its derivatives."""

import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl
from ltljax.app.run import count_maxima

# Real meshes have a few inconsistent rows.
pytestmark = pytest.mark.filterwarnings("ignore::ltljax.errors.InconsistentRowsWarning")


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(3))


@pytest.fixture(scope="module")
def small_sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(2))


@pytest.mark.parametrize(("scheme", "bound"), [(ltl.Paper(), 2e-4), (ltl.Monotone(), 2e-3)])
def test_heat_with_source_x1_reaches_the_exact_solution(scheme, bound):
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(4), scheme)
    x1 = surface.vertices[:, 0]
    solution = ltl.solve(ltl.Diffusion(source=x1), surface, jnp.zeros_like(x1), t1=2.0, rtol=1e-6, atol=1e-8)
    exact = x1 * (1 - np.exp(-4)) / 2
    assert jnp.linalg.norm(solution.us[-1] - exact) < bound * jnp.linalg.norm(exact)


def test_a_source_may_depend_on_time_and_place(sphere):
    def source(t, x):
        return 13 * x[:, 0] * x[:, 1] * x[:, 2] * jnp.exp(t)

    xyz = sphere.vertices.prod(axis=1)
    solution = ltl.solve(ltl.Diffusion(source=source), sphere, xyz, t1=1.0, ts=[0.5, 1.0])
    assert jnp.max(jnp.abs(solution.us - jnp.exp(solution.ts)[:, None] * xyz[None])) < 0.03 * np.e * jnp.max(xyz)


def test_the_default_is_second_order_in_time_where_explicit_steps_would_be_unstable(sphere):
    equation = ltl.Diffusion()
    # diffrax traces the surface, for which the width is only bounded, and the bound would ask for more damping.
    solver = ltl.RKL2(spectral_width=lambda *_: ltl.operators.spectral_width(sphere))
    u0 = sphere.vertices.prod(axis=1) + sphere.vertices[:, 0]
    rate = np.array(ltl.laplacian_matrix(sphere).todense())
    values, vectors = np.linalg.eig(rate)
    exact = (vectors @ (np.exp(0.4 * values) * np.linalg.solve(vectors, u0))).real
    errors = []
    for steps in (4, 8, 16, 32):
        out = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, u, args: args[0].rate(t, args[1], u)),
            solver, 0.0, 0.4, 0.4 / steps, u0, (equation, sphere),
            stepsize_controller=diffrax.ConstantStepSize(), saveat=diffrax.SaveAt(t1=True, solver_state=True),
        )  # fmt: skip
        errors.append(float(jnp.linalg.norm(out.ys[-1] - exact) / np.linalg.norm(exact)))
        assert int(out.solver_state[1]) < 2000
    slopes = np.diff(np.log(errors)) / -np.log(2)
    assert slopes.min() > 1.8
    assert errors[-1] < 2e-4


@pytest.mark.parametrize("atol_per_rtol", [1.0, None])
def test_adaptive_steps_follow_the_tolerance(small_sphere, atol_per_rtol):
    sphere = small_sphere
    u0 = sphere.vertices[:, 0]
    reference = ltl.solve(ltl.Diffusion(), sphere, u0, 1.0, solver=diffrax.Tsit5(), rtol=1e-11, atol=1e-13).us[-1]
    ends = []
    for rtol in (1e-4, 1e-6, 1e-8):
        atol = None if atol_per_rtol is None else atol_per_rtol * rtol
        ends.append(ltl.solve(ltl.Diffusion(), sphere, u0, 1.0, rtol=rtol, atol=atol).u_end)
    errors = [float(jnp.max(jnp.abs(end - reference))) for end in ends]
    assert errors[0] < 1e-3
    assert errors[1] < 0.2 * errors[0]
    assert errors[2] < 0.2 * errors[1]


def test_float32_runs_stay_float32_and_close(sphere):
    x1 = sphere.vertices[:, 0]
    single = ltl.Surface.from_mesh(ltl.shapes.icosphere(3), dtype=jnp.float32)
    a = ltl.solve(ltl.Diffusion(source=x1), sphere, 0 * x1, 1.0).us[-1]
    b = ltl.solve(ltl.Diffusion(source=x1.astype(jnp.float32)), single, 0 * x1, 1.0).us[-1]
    assert b.dtype == jnp.float32
    assert jnp.max(jnp.abs(a - b.astype(a.dtype))) < 1e-3 * jnp.max(jnp.abs(a))


@pytest.mark.parametrize("scheme", [ltl.Paper(), ltl.Monotone()])
def test_gradients_through_time_agree_with_differences(scheme):
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1), scheme)
    x = surface.vertices

    def loss(parameters):
        kinetics = ltl.kinetics.gray_scott(parameters["feed"], 0.06)
        equation = ltl.ReactionDiffusion((parameters["diffusivity"], 0.01), kinetics)
        u0 = jnp.stack([1 - 0.5 * jnp.exp(-parameters["start"] * x[:, 0] ** 2), 0.5 * jnp.exp(-4 * x[:, 0] ** 2)], 1)
        return jnp.sum(ltl.solve(equation, surface, u0, 2.0, rtol=1e-8, atol=1e-10, throw=False).us[-1] ** 2)

    loss = jax.jit(loss)
    parameters = dict(feed=jnp.array(0.04), diffusivity=jnp.array(0.02), start=jnp.array(3.0))
    gradient = jax.grad(loss)(parameters)
    for name, value in parameters.items():
        step = 1e-4 * value
        up, down = (loss({**parameters, name: value + sign * step}) for sign in (1, -1))
        np.testing.assert_allclose(gradient[name], (up - down) / (2 * step), rtol=1e-5)


def test_solve_is_vmapped_over_parameters(sphere):
    u0 = sphere.vertices[:, 0]
    rates = jnp.array([0.5, 1.0, 2.0])
    batch = jax.vmap(lambda d: ltl.solve(ltl.Diffusion(d), sphere, u0, 0.3, throw=False).us[-1])(rates)
    one_by_one = jnp.stack([ltl.solve(ltl.Diffusion(d), sphere, u0, 0.3).us[-1] for d in rates])
    np.testing.assert_allclose(batch, one_by_one, atol=1e-12)


def test_a_plain_function_serves_as_kinetics(sphere):
    def predator(species, params):
        u, v = species
        return u * (params["growth"] - v), v * (u - 1)

    u0 = jnp.full((sphere.num_vertices, 2), 0.5)
    plain = ltl.ReactionDiffusion((0.1, 0.1), predator, params=dict(growth=jnp.array(1.0)))
    solution = ltl.solve(plain, sphere, u0, 1.0)
    # A uniform state stays uniform and keeps the Lotka-Volterra invariant u + v - log(u v).
    assert jnp.ptp(solution.us[-1], axis=0).max() < 1e-10
    u, v = solution.us[-1][0]
    np.testing.assert_allclose(u + v - jnp.log(u * v), 1 - jnp.log(0.25), atol=1e-3)


@pytest.mark.parametrize("mesh", ["sphere", "spot_low.obj"])
def test_turks_reaction_keeps_v_nonnegative_and_makes_a_pattern(mesh, real_mesh):
    mesh = ltl.shapes.icosphere(3) if mesh == "sphere" else ltl.load_mesh(real_mesh(mesh))
    mesh = mesh.scaled(np.sqrt(4 * np.pi / mesh.area))
    surface = ltl.Surface.from_mesh(mesh)
    decay = 11 + np.random.default_rng(0).uniform(-0.1, 0.1, mesh.num_vertices)
    equation = ltl.ReactionDiffusion((0.8, 0.1), ltl.kinetics.turing(decay=jnp.asarray(decay)))
    u = ltl.solve(equation, surface, jnp.full((mesh.num_vertices, 2), 4.0), 40.0).us[-1]
    assert u.min() > -1e-3
    assert 30 <= count_maxima(mesh, np.asarray(u[:, 1])) <= 60


def test_an_overflow_is_raised_with_its_time_and_its_causes(sphere):
    def explosive(species, params):
        (u,) = species
        return (u**2 + params,)

    equation = ltl.ReactionDiffusion((0.1,), explosive, params=jnp.array(1.0))
    u0 = jnp.zeros((sphere.num_vertices, 1))
    with pytest.raises(ltl.SolveError, match=r"overflowed at t = 1\.57.*reaction or source") as caught:
        ltl.solve(equation, sphere, u0, 5.0)
    assert abs(caught.value.time - np.pi / 2) < 0.01
    silent = ltl.solve(equation, sphere, u0, 5.0, throw=False)
    assert bool(silent.overflowed)


def test_a_large_state_is_not_an_overflow(sphere):
    x1 = sphere.vertices[:, 0]
    large = ltl.solve(ltl.Diffusion(source=1e8 * x1), sphere, 0 * x1, 5.0).u_end
    np.testing.assert_allclose(large, 1e8 * (1 - np.exp(-10)) * x1 / 2, rtol=0.02, atol=1e4)
    growing = ltl.ReactionDiffusion((1.0,), lambda species, _: (20 * species[0],))
    grown = ltl.solve(growing, sphere, jnp.ones((sphere.num_vertices, 1)), 1.0, rtol=1e-6).u_end
    np.testing.assert_allclose(grown, np.exp(20), rtol=1e-2)


@pytest.mark.parametrize(
    ("solver", "dtype"),
    [
        (None, jnp.float32),
        (diffrax.Tsit5(), jnp.float64),
        (ltl.TRBDF2(), jnp.float32),
        pytest.param(None, jnp.float64, marks=pytest.mark.slow),
        pytest.param(diffrax.Tsit5(), jnp.float32, marks=pytest.mark.slow),
        pytest.param(ltl.TRBDF2(), jnp.float64, marks=pytest.mark.slow),
    ],
)
def test_a_blow_up_ends_the_run_within_few_steps(dtype, solver):
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1), dtype=dtype)
    explosive = ltl.ReactionDiffusion((0.1,), lambda species, p: (species[0] ** 3 + p,), params=jnp.ones((), dtype))
    u0 = jnp.zeros((surface.num_vertices, 1), dtype)
    solution = ltl.solve(explosive, surface, u0, 5.0, solver=solver, throw=False)
    assert bool(solution.overflowed)
    assert solution.t_end == pytest.approx(2 * np.pi / 3**1.5, rel=0.01)
    assert solution.counts["num_steps"] < 2000


def test_without_tqdm_the_remaining_time_is_printed(sphere, monkeypatch, capfd):
    def absent():
        raise ImportError

    monkeypatch.setattr(diffrax, "TqdmProgressMeter", absent)
    ltl.solve(ltl.Diffusion(), sphere, sphere.vertices[:, 0], 1.0, dt=0.01, solver=ltl.RKL2(), progress=True)
    printed = capfd.readouterr().err
    assert re.search(r"time: 5\d %, about \d+ s left", printed)
    assert "time: 100 %, about 0 s left" in printed


def test_a_nan_in_the_initial_state_is_refused(sphere):
    u0 = jnp.ones(sphere.num_vertices).at[7].set(jnp.nan)
    with pytest.raises(ValueError, match="nan at vertex 7"):
        ltl.solve(ltl.Diffusion(), sphere, u0, 1.0)
    assert bool(jax.jit(lambda u: ltl.solve(ltl.Diffusion(), sphere, u, 1.0).overflowed)(u0))


def test_the_published_operator_grows_on_an_irregular_mesh_and_the_error_says_so():
    mesh = ltl.shapes.jittered_sphere(3, 0.3, seed=0)
    u0 = jnp.asarray(mesh.vertices[:, 0])
    with pytest.raises(ltl.SolveError, match="growing modes"):
        ltl.solve(ltl.Diffusion(), ltl.Surface.from_mesh(mesh, ltl.Paper()), u0, 5.0)
    tame = ltl.solve(ltl.Diffusion(), ltl.Surface.from_mesh(mesh), u0, 5.0)
    assert jnp.max(jnp.abs(tame.us[-1])) < 1e-3


def test_too_few_steps_are_an_error_with_a_remedy(sphere):
    with pytest.raises(ltl.SolveError, match="Raise max_steps"):
        ltl.solve(ltl.Diffusion(), sphere, sphere.vertices[:, 0], 5.0, max_steps=3)


def test_a_state_that_does_not_fit_is_refused(sphere):
    with pytest.raises(ValueError, match=r"found \(7,\)"):
        ltl.solve(ltl.Diffusion(), sphere, jnp.zeros(7), 1.0)
    equation = ltl.ReactionDiffusion((1.0, 1.0), ltl.kinetics.gray_scott())
    with pytest.raises(ValueError, match="one column per diffusivity"):
        ltl.solve(equation, sphere, jnp.zeros((sphere.num_vertices, 3)), 1.0)


def test_gradients_are_finite_where_nothing_diffuses():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1))
    x1 = surface.vertices[:, 0]
    energy = lambda d: jnp.mean(ltl.solve(ltl.Diffusion(d), surface, x1, 0.1).u_end ** 2)  # noqa: E731
    # u decays like exp(-lambda d t) with lambda near 2.
    rate = -jnp.mean(x1 * ltl.laplacian(surface, x1)) / jnp.mean(x1**2)
    assert jax.grad(energy)(0.0) == pytest.approx(float(-2 * rate * 0.1 * jnp.mean(x1**2)), rel=1e-3)
