"""Mistakes in the arguments of `solve`, and when its runs end."""

import functools

import diffrax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import ltljax as ltl
from ltljax._base.arguments import as_numbers


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(2))


# An array as diffusivity, so that other values need no compilation.
HEAT = ltl.Diffusion(jnp.array(1.0))


def field_diffusion(field):
    return ltl.ReactionDiffusion((field,), lambda species, _: (0 * species[0],))


def two_rates(species, _):
    u, v = species
    return -u, -v


def one_rate(species, _):
    return (-species[0],)


def no_tuple(species, _):
    return -species[0]


WRONG = {
    "negative diffusivity": (dict(equation=ltl.Diffusion(-1.0)), "not negative, found -1"),
    "a diffusivity of a species that is negative": (
        dict(equation=ltl.Diffusion(jnp.array([1.0, -2.0])), u0=jnp.ones((162, 2))),
        "found -2 at species 1",
    ),
    "a diffusivity that is negative somewhere": (
        dict(equation=field_diffusion(jnp.ones(162).at[7:9].set(-0.5)), u0=jnp.ones((162, 1))),
        r"found -0\.5 at vertex 7 in the equation's\.diffusivity\[0\]",
    ),
    "an equation that is not finite": (dict(equation=ltl.Diffusion(float("inf"))), "diffusivity is not finite"),
    "a state of another length": (dict(u0=jnp.ones(5)), r"found \(5,\)"),
    "a source of another shape": (dict(equation=ltl.Diffusion(source=jnp.ones(5))), r"found \(5,\)"),
    "times out of order": (dict(ts=[0.5, 0.2]), r"ts\[1\] = 0.2 after 0.5"),
    "times beyond the end": (dict(ts=[0.5, 2.0]), r"found ts\[1\] = 2.0"),
    "an end before the start": (dict(t0=3.0), "t0 = 3.0 and t1 = 1.0"),
    "no times": (dict(ts=[]), "at least one time"),
    "a relative tolerance of zero": (dict(rtol=0.0), "found rtol = 0.0"),
    "a negative absolute tolerance": (dict(atol=-1e-6), "found atol = -1e-06"),
    "a step that is not positive": (dict(dt=0.0), "dt = 0.0"),
    "an explicit step too long": (dict(dt=0.5, solver=diffrax.Tsit5()), "too long for Tsit5"),
    "SBDF2 without steps": (dict(solver=ltl.SBDF2()), "SBDF2 takes fixed steps"),
    "a step length that contradicts steps": (
        dict(steps=ltl.solvers.Adaptive(), dt=0.1), r"dt = 0\.1 contradicts steps = Adaptive",
    ),
    "a tolerance that contradicts steps": (
        dict(steps=ltl.solvers.Fixed(0.1, rtol=1e-6), rtol=1e-4), r"rtol = 0\.0001 contradicts steps = Fixed",
    ),
    "a limit of steps that contradicts steps": (
        dict(steps=ltl.solvers.Adaptive(), max_steps=None), "max_steps = None contradicts steps",
    ),
    "settings of a solver that would have no effect": (
        dict(solver=diffrax.Kvaerno3(root_finder=optx.Newton(1e-3, 1e-3))), "a root_finder, which would have no effect",
    ),
    "a masked state": (dict(u0=np.ma.masked_greater(np.arange(162.0), 9)), "u0 as a plain array, found a masked"),
    "a reaction of another number of species": (
        dict(equation=ltl.ReactionDiffusion((1.0, 1.0, 1.0), two_rates), u0=jnp.ones((162, 3))),
        "The state has 3 species, and the reaction is for another number",
    ),
    "a reaction with one rate for two species": (
        dict(equation=ltl.ReactionDiffusion((1.0, 1.0), one_rate), u0=jnp.ones((162, 2))),
        r"a tuple of 2 rates, one for each species, of shape \(162,\), found 1",
    ),
    "a reaction with a rate that is no tuple": (
        dict(equation=ltl.ReactionDiffusion((1.0, 1.0), no_tuple), u0=jnp.ones((162, 2))), "a tuple of 2 rates",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_each_mistake_is_one_clear_error(sphere, case):
    given, message = WRONG[case]
    call = dict(equation=ltl.Diffusion(), surface=sphere, u0=sphere.vertices[:, 0], t1=1.0) | given
    with pytest.raises(ValueError, match=message):
        ltl.solve(**call)


def test_steps_and_their_shorthands_are_the_same_run(sphere, as_users_call_it):
    run = functools.partial(ltl.solve, HEAT, sphere, sphere.vertices[:, 0], 0.1, solver=ltl.RKL2())
    fixed = run(steps=ltl.solvers.Fixed(0.02))
    np.testing.assert_array_equal(fixed.u_end, run(dt=0.02).u_end)
    np.testing.assert_array_equal(fixed.u_end, run(steps=ltl.solvers.Fixed(0.02), dt=0.02).u_end)
    adaptive = run(steps=ltl.solvers.Adaptive(rtol=1e-6, atol=1e-8))
    np.testing.assert_array_equal(adaptive.u_end, run(rtol=1e-6, atol=1e-8).u_end)
    with pytest.raises(TypeError, match=r"Expected steps as ltl\.solvers\.Adaptive\(\.\.\.\)"):
        run(steps=0.02)
    with pytest.raises(ValueError, match=r"found Fixed\(None\)"):
        ltl.solvers.Fixed(None)


def test_checkpoints_are_a_value_and_not_mixed_with_what_they_replace(sphere, tmp_path, as_users_call_it):
    run = functools.partial(ltl.solve, HEAT, sphere, sphere.vertices[:, 0], 0.1)
    with pytest.raises(TypeError, match=r"Expected checkpoints as ltl\.solvers\.Checkpoints\(folder\), found a str"):
        run(checkpoints=str(tmp_path))
    with pytest.warns(DeprecationWarning, match="run_id"), pytest.raises(TypeError, match="keywords that it replaces"):
        run(checkpoints=ltl.solvers.Checkpoints(tmp_path), run_id="a")


def test_other_lengths_and_tolerances_need_no_compilation(sphere):
    traced = []

    def source(t, x):
        traced.append(t)
        return x[:, 0]

    equation = ltl.Diffusion(1e4, source=source)
    runs = []
    for t1, rtol in ((1.0, 1e-4), (2.0, 2e-4)):
        solution = ltl.solve(equation, sphere, sphere.vertices[:, 0], t1, rtol=rtol)
        runs.append((solution.method, len(traced)))
    (first, traced_first), (second, traced_second) = runs
    assert first.startswith("TRBDF2: implicit")
    assert first != second
    # The source is evaluated once before the run, outside of jit.
    assert traced_second - traced_first <= 1


def test_the_error_of_an_unstable_fixed_step_names_dt_first(sphere):
    # The step is stable at the initial state, but too long once the reaction has stiffened.
    stiffening = ltl.ReactionDiffusion((0.1,), lambda species, _: (1000 - species[0] ** 3,))
    with pytest.raises(ltl.SolveError, match=r"overflowed.* The causes are \(a\) a dt that is too long for the solver"):
        ltl.solve(stiffening, sphere, 0 * sphere.vertices[:, :1], 1.0, solver=diffrax.Heun(), dt=0.02)


@pytest.mark.parametrize("dt", [None, 0.01])
def test_times_after_the_stop_are_nan_and_the_state_there_is_u_end(sphere, dt):
    u0 = sphere.vertices[:, 0]
    solution = ltl.solve(
        ltl.Diffusion(), sphere, u0, 1.0, ts=[0.1, 0.9], dt=dt, stop_when=lambda t, u, rate: jnp.max(u) < 0.5
    )
    assert bool(solution.stopped)
    assert 0.1 < float(solution.t_end) < 0.9
    assert np.isfinite(solution.us[0]).all()
    assert np.isnan(solution.us[1]).all()
    assert float(jnp.max(solution.u_end)) < 0.5


@pytest.mark.parametrize(
    "value",
    [
        np.ma.masked_greater(np.arange(5.0), 3),
        np.full(5, "2026", "datetime64[Y]"),
        np.full(5, "1"),
        ["0.5", "1"],
        np.datetime64("2026"),
        np.ones(5, complex),
        np.array([1, None]),
    ],
    ids=["masked", "dates", "digits", "a list of digits", "a date", "complex", "objects"],
)
def test_values_that_do_not_convert_to_numbers_are_refused(value):
    with pytest.raises(ValueError, match="Expected u0 as"):
        as_numbers("u0", value)


def test_numbers_of_all_kinds_are_accepted():
    for value in (1, 2.0, True, [1, 2.5], np.arange(3), np.float32(1), jnp.ones(3), [jnp.ones(()), 2]):
        assert as_numbers("u0", value) is value
