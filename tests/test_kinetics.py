"""Reactions: steady states, non-negative species, and growth rates and wavelengths of linear theory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import ltljax as ltl
from ltljax.app.run import count_maxima

NAMES = [name for name in ltl.kinetics.__all__ if name.islower()]
# Reactions whose species stay non-negative.
POSITIVE = ["turing", "gray_scott", "schnakenberg", "brusselator", "gierer_meinhardt", "meinhardt", "barkley"]
POSITIVE += ["fisher_kpp", "lotka_volterra"]


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(4))


def harmonic(surface, degree):
    """A zonal harmonic: a Legendre polynomial of z."""
    return jnp.asarray(np.polynomial.Legendre.basis(degree)(np.asarray(surface.vertices[:, 2])))


def wavelength(surface, u):
    """2 pi / k, where k^2 is the Rayleigh quotient of the field minus its mean."""
    mass = surface.mass
    u = u - ltl.integrate(surface, u, mass) / mass.sum()
    k2 = -ltl.integrate(surface, u * ltl.laplacian(surface, u), mass) / ltl.integrate(surface, u**2, mass)
    return float(2 * np.pi / jnp.sqrt(k2))


@pytest.mark.parametrize("name", NAMES)
def test_rates_vanish_at_the_steady_state(name):
    kinetics = getattr(ltl.kinetics, name)()
    state = kinetics.steady_state()
    assert state.shape == (len(kinetics.species),)
    np.testing.assert_allclose(kinetics(state[None]), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "state", "expected"),
    [
        ("gray_scott", (0.5, 0.25), (-0.01125, 0.00625)),
        ("schnakenberg", (1.0, 1.0), (10.0, -10.0)),
        ("brusselator", (1.0, 1.0), (-7.2, 9.2)),
        ("barkley", (0.5, 0.1), (4.25, 0.4)),
        ("fitzhugh_nagumo", (1.0, 0.5), (-0.5, 5.5)),
        ("allen_cahn", (0.5,), (0.375,)),
        ("ginzburg_landau", (1.0, 2.0), (11.0, -15.5)),
        ("fisher_kpp", (0.25,), (0.1875,)),
        ("lotka_volterra", (2.0, 3.0), (-4.0, 3.0)),
    ],
)
def test_rates_away_from_the_steady_state_have_the_values_of_their_formulas(name, state, expected):
    rates = getattr(ltl.kinetics, name)()(jnp.array([state]))
    np.testing.assert_allclose(rates[0], expected, rtol=1e-12)


def test_the_steady_state_of_fitzhugh_nagumo_depends_on_the_offset():
    for offset in (-0.3, 0.2):
        kinetics = ltl.kinetics.fitzhugh_nagumo(offset=offset)
        np.testing.assert_allclose(kinetics(kinetics.steady_state()[None]), 0, atol=1e-12)


@pytest.mark.parametrize("name", POSITIVE)
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_no_species_is_driven_below_zero(name, data):
    kinetics = getattr(ltl.kinetics, name)()
    count = len(kinetics.species)
    state = np.array(data.draw(st.lists(st.floats(0, 5), min_size=count, max_size=count)))
    # One row per species, with that species at zero.
    states = np.where(np.eye(count, dtype=bool), 0, state[None])
    assert (np.diag(kinetics(jnp.asarray(states))) >= 0).all()


def test_a_reaction_without_a_known_steady_state_asks_for_one():
    kinetics = ltl.kinetics.Kinetics(lambda u, p: (u[0] - u[1], u[1] - u[0] ** 3))
    with pytest.raises(ValueError, match="No steady state"):
        kinetics.steady_state()
    dispersion = ltl.solvers.dispersion(kinetics, (1.0, 1.0), (0.8, 0.9))
    np.testing.assert_allclose(dispersion.steady_state, (1, 1), atol=1e-10)


def test_turings_system_has_the_known_band_of_growing_modes():
    dispersion = ltl.solvers.dispersion(ltl.kinetics.turing(rate=1.0), (0.8, 0.1))
    np.testing.assert_allclose(dispersion.band, (2.2, 22.8), atol=0.06)
    np.testing.assert_allclose(dispersion.fastest, (8.2, 0.77), atol=0.06)
    assert dispersion.forms_pattern
    assert not ltl.solvers.dispersion(ltl.kinetics.turing(rate=1.0), (0.39, 0.1)).forms_pattern
    assert ltl.solvers.dispersion(ltl.kinetics.turing(rate=1.0), (0.41, 0.1)).forms_pattern


@pytest.mark.parametrize("name", NAMES)
def test_growth_rates_are_the_largest_eigenvalues_of_the_linearised_reaction(name):
    kinetics = getattr(ltl.kinetics, name)()
    diffusivity = 0.1 * 3.0 ** np.arange(len(kinetics.species))
    dispersion = ltl.solvers.dispersion(kinetics, diffusivity)
    for eigenvalue in (0.0, 1.0, 7.5):
        matrix = np.asarray(dispersion.jacobian) - eigenvalue * np.diag(diffusivity)
        np.testing.assert_allclose(dispersion.growth(eigenvalue), np.linalg.eigvals(matrix).real.max(), atol=1e-9)


def test_growth_rates_are_differentiable():
    rate = lambda decay: ltl.solvers.dispersion(ltl.kinetics.turing(1.0, decay=decay), (0.8, 0.1)).growth(8.0)  # noqa: E731
    assert jax.grad(rate)(12.0) == pytest.approx(float((rate(12.001) - rate(11.999)) / 0.002), rel=1e-5)


@pytest.mark.parametrize("degree", [4, *(pytest.param(degree, marks=pytest.mark.slow) for degree in (3, 6))])
def test_seeded_harmonics_grow_at_the_exact_linear_rate(degree):
    sphere = ltl.Surface.from_mesh(ltl.shapes.icosphere(5))
    kinetics = ltl.kinetics.schnakenberg(rate=30.0)
    dispersion = ltl.solvers.dispersion(kinetics, (1.0, 10.0))
    values, vectors = np.linalg.eig(np.asarray(dispersion.jacobian) - degree * (degree + 1) * np.diag([1.0, 10.0]))
    first = values.real.argmax()
    assert values[first].imag == 0
    seed = 1e-6 * harmonic(sphere, degree)[:, None] * vectors[None, :, first].real
    span = 0.5 / abs(values[first].real)
    u0 = dispersion.steady_state[None] + seed
    u = ltl.solve(ltl.ReactionDiffusion((1.0, 10.0), kinetics), sphere, u0, span, rtol=1e-9, atol=1e-12).u_end
    grown = jnp.vdot((u - dispersion.steady_state[None])[:, 0], seed[:, 0]) / jnp.vdot(seed[:, 0], seed[:, 0])
    assert float(jnp.log(grown)) / span == pytest.approx(float(values[first].real), rel=0.03)


def test_noise_grows_at_the_wavelength_of_linear_theory(sphere):
    kinetics = ltl.kinetics.schnakenberg(rate=100.0)
    dispersion = ltl.solvers.dispersion(kinetics, (1.0, 10.0))
    noise = jnp.asarray(np.random.default_rng(0).normal(size=(sphere.num_vertices, 2)))
    span = 8 / dispersion.fastest[1]
    equation = ltl.ReactionDiffusion((1.0, 10.0), kinetics)
    u = ltl.solve(equation, sphere, dispersion.steady_state[None] + 1e-6 * noise, span, rtol=1e-6, atol=1e-10).u_end
    assert wavelength(sphere, u[:, 0]) == pytest.approx(dispersion.wavelength, rel=0.1)


def test_explain_reports_no_pattern_for_the_published_torus():
    surface = ltl.Surface.from_mesh(ltl.shapes.torus(n_major=48, n_minor=24))
    # alpha = 1, beta = s = 2, gamma = 0
    published = ltl.ReactionDiffusion((1.0, 2.0), ltl.kinetics.turing(rate=2.0, decay=0.0))
    explanation = ltl.explain(published, surface)
    assert not explanation.forms_pattern
    assert str(explanation).startswith("No pattern")
    assert "no diffusivities would make one" in str(explanation)
    for diffusivity in ((1.0, 0.01), (10.0, 0.1)):
        equation = ltl.ReactionDiffusion(diffusivity, ltl.kinetics.turing(decay=0.0))
        assert not ltl.explain(equation, surface).forms_pattern


def test_explain_counts_the_modes_of_the_surface(sphere):
    equation = ltl.ReactionDiffusion((0.8, 0.1), ltl.kinetics.turing(rate=1.0))
    explanation = ltl.explain(equation, sphere)
    assert explanation.forms_pattern
    # l (l + 1) lies between 2.2 and 22.8 for l = 2, 3, 4.
    assert explanation.num_modes == 5 + 7 + 9
    assert explanation.wavelength == pytest.approx(2 * np.pi / np.sqrt(8.2), rel=0.01)
    assert "resolves" in str(explanation)


def test_explain_names_the_obstacle_to_a_pattern(sphere):
    def explanation(diffusivity, **parameters):
        return str(ltl.explain(ltl.ReactionDiffusion(diffusivity, ltl.kinetics.turing(**parameters)), sphere))

    assert "more than 4 times" in explanation((0.3, 0.1))
    assert "does not resolve" in explanation((0.008, 0.001))
    assert "too small for the wavelength" in explanation((80.0, 10.0), rate=1.0)
    assert "unstable without diffusion" in explanation((0.8, 0.1), decay=14.0)
    waves = ltl.ReactionDiffusion((0.03, 0.0), ltl.kinetics.barkley())
    assert "finite push" in str(ltl.explain(waves, sphere))


def test_explain_calls_a_centre_neutral(sphere):
    equation = ltl.ReactionDiffusion((0.002, 0.002), ltl.kinetics.lotka_volterra(growth=4.0))
    explanation = ltl.explain(equation, sphere)
    assert not explanation.forms_pattern
    assert "(1, 4) is neutral" in str(explanation)
    # The frequency at the centre is sqrt(a c).
    assert "in the time 3.142" in str(explanation)
    assert explanation.dispersion.band is None


def test_explain_distinguishes_waves_from_patterns(sphere):
    """Two species oscillate and grow, unless a third one, which diffuses away at short wavelengths, suppresses them."""

    def rates(species, p):
        u, v, w = species
        return 0.5 * u - 2 * v - w, 2 * u, 10 * (u - w)

    equation = ltl.ReactionDiffusion((1e-2, 1e-2, 10.0), ltl.kinetics.Kinetics(rates, None, ("u", "v", "w")))
    explanation = ltl.explain(equation, sphere, (0.0, 0.0, 0.0))
    dispersion = explanation.dispersion
    eigenvalue, rate = dispersion.fastest
    values = np.linalg.eigvals(np.asarray(dispersion.jacobian) - eigenvalue * np.diag([1e-2, 1e-2, 10.0]))
    leading = values[values.real.argmax()]
    assert eigenvalue > 1
    assert rate == pytest.approx(leading.real)
    assert rate > 0
    assert float(dispersion.frequency(eigenvalue)) == pytest.approx(abs(leading.imag))
    assert abs(leading.imag) > 1
    assert float(dispersion.growth(0.0)) < 0
    assert not explanation.forms_pattern
    assert not dispersion.forms_pattern
    assert "Waves, and no stationary pattern" in str(explanation)


def pattern(level, diffusivity, kinetics, t1, amplitude=0.1, seed=0):
    """A pattern on the sphere from an initial state that does not depend on the mesh, with its surface and mesh."""
    mesh = ltl.shapes.icosphere(level)
    surface = ltl.Surface.from_mesh(mesh)
    rng = np.random.default_rng(seed)
    waves, phases = 6 * rng.normal(size=(40, 3)), rng.uniform(0, 2 * np.pi, 40)
    start = np.sin(mesh.vertices @ waves.T + phases).sum(axis=1) / np.sqrt(20)
    u0 = np.asarray(kinetics.steady_state()) + amplitude * start[:, None] * np.array([1.0, -1.0])
    equation = ltl.ReactionDiffusion(diffusivity, kinetics)
    return ltl.solve(equation, surface, u0, t1, solver=ltl.RKL2(), rtol=1e-3, atol=1e-4).u_end, surface, mesh


@pytest.mark.slow
def test_turings_system_forms_about_forty_spots():
    u, _, mesh = pattern(4, (0.8, 0.1), ltl.kinetics.turing(), 40.0)
    assert 30 <= count_maxima(mesh, -np.asarray(u[:, 1])) + count_maxima(mesh, np.asarray(u[:, 1])) <= 120


@pytest.mark.parametrize("finest", [5, pytest.param(6, marks=pytest.mark.slow)])
def test_the_wavelength_of_a_pattern_does_not_change_with_the_mesh(finest):
    lengths = []
    for level in range(4, finest + 1):
        u, surface, _ = pattern(level, (1.0, 10.0), ltl.kinetics.schnakenberg(rate=150.0), 1.5)
        lengths.append(wavelength(surface, u[:, 0]))
    assert np.ptp(lengths) < 0.05 * lengths[-1]
