"""Every reaction rests where it says, keeps what it promises, and grows what linear theory says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import ltljax as ltl
from ltljax.app.run import count_maxima

NAMES = [name for name in ltl.kinetics.__all__ if name.islower()]
# Those whose species stay non-negative.
POSITIVE = ["turk", "gray_scott", "schnakenberg", "brusselator", "gierer_meinhardt", "meinhardt", "barkley"]
POSITIVE += ["fisher_kpp", "lotka_volterra"]


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(4))


def harmonic(surface, degree):
    """A zonal harmonic: a Legendre polynomial of z."""
    return jnp.asarray(np.polynomial.Legendre.basis(degree)(np.asarray(surface.vertices[:, 2])))


def wavelength(surface, u):
    """2 pi / k with k^2 the Rayleigh quotient of the field about its mean."""
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


def test_the_steady_state_of_fitzhugh_and_nagumo_moves_with_the_offset():
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
    for s in range(count):
        state_there = state.copy()
        state_there[s] = 0
        assert kinetics(jnp.asarray(state_there)[None])[0, s] >= 0


def test_a_reaction_without_a_known_steady_state_says_what_to_give():
    kinetics = ltl.kinetics.Kinetics(lambda u, p: (u[0] - u[1], u[1] - u[0] ** 3))
    with pytest.raises(ValueError, match="No steady state"):
        kinetics.steady_state()
    found = ltl.solvers.dispersion(kinetics, (1.0, 1.0), (0.8, 0.9))
    np.testing.assert_allclose(found.steady_state, (1, 1), atol=1e-10)


def test_turks_band_at_gamma_12_is_the_one_known():
    found = ltl.solvers.dispersion(ltl.kinetics.turk(rate=1.0), (0.8, 0.1))
    np.testing.assert_allclose(found.band, (2.2, 22.8), atol=0.06)
    np.testing.assert_allclose(found.fastest, (8.2, 0.77), atol=0.06)
    assert found.forms_pattern
    assert not ltl.solvers.dispersion(ltl.kinetics.turk(rate=1.0), (0.39, 0.1)).forms_pattern
    assert ltl.solvers.dispersion(ltl.kinetics.turk(rate=1.0), (0.41, 0.1)).forms_pattern


@pytest.mark.parametrize("name", NAMES)
def test_growth_rates_are_the_largest_eigenvalues_of_the_linearised_reaction(name):
    kinetics = getattr(ltl.kinetics, name)()
    diffusivity = 0.1 * 3.0 ** np.arange(len(kinetics.species))
    found = ltl.solvers.dispersion(kinetics, diffusivity)
    for eigenvalue in (0.0, 1.0, 7.5):
        matrix = np.asarray(found.jacobian) - eigenvalue * np.diag(diffusivity)
        np.testing.assert_allclose(found.growth(eigenvalue), np.linalg.eigvals(matrix).real.max(), atol=1e-9)


def test_growth_rates_are_differentiable():
    rate = lambda decay: ltl.solvers.dispersion(ltl.kinetics.turk(1.0, decay=decay), (0.8, 0.1)).growth(8.0)  # noqa: E731
    assert jax.grad(rate)(12.0) == pytest.approx(float((rate(12.001) - rate(11.999)) / 0.002), rel=1e-5)


@pytest.mark.parametrize("degree", [3, 4, 6])
def test_seeded_harmonics_grow_at_the_exact_linear_rate(degree):
    sphere = ltl.Surface.from_mesh(ltl.shapes.icosphere(5))
    kinetics = ltl.kinetics.schnakenberg(rate=30.0)
    found = ltl.solvers.dispersion(kinetics, (1.0, 10.0))
    values, vectors = np.linalg.eig(np.asarray(found.jacobian) - degree * (degree + 1) * np.diag([1.0, 10.0]))
    first = values.real.argmax()
    assert values[first].imag == 0
    seed = 1e-6 * harmonic(sphere, degree)[:, None] * vectors[None, :, first].real
    span = 0.5 / abs(values[first].real)
    u0 = found.steady_state[None] + seed
    u = ltl.solve(ltl.ReactionDiffusion((1.0, 10.0), kinetics), sphere, u0, span, rtol=1e-9, atol=1e-12).u_end
    grown = jnp.vdot((u - found.steady_state[None])[:, 0], seed[:, 0]) / jnp.vdot(seed[:, 0], seed[:, 0])
    assert float(jnp.log(grown)) / span == pytest.approx(float(values[first].real), rel=0.03)


def test_noise_grows_at_the_wavelength_of_linear_theory(sphere):
    kinetics = ltl.kinetics.schnakenberg(rate=100.0)
    found = ltl.solvers.dispersion(kinetics, (1.0, 10.0))
    noise = jnp.asarray(np.random.default_rng(0).normal(size=(sphere.num_vertices, 2)))
    span = 8 / found.fastest[1]
    equation = ltl.ReactionDiffusion((1.0, 10.0), kinetics)
    u = ltl.solve(equation, sphere, found.steady_state[None] + 1e-6 * noise, span, rtol=1e-6, atol=1e-10).u_end
    assert wavelength(sphere, u[:, 0]) == pytest.approx(found.wavelength, rel=0.1)


def test_explain_says_no_pattern_for_the_published_torus():
    surface = ltl.Surface.from_mesh(ltl.shapes.torus(n_major=48, n_minor=24))
    # alpha = 1, beta = s = 2, gamma = 0
    published = ltl.ReactionDiffusion((1.0, 2.0), ltl.kinetics.turk(rate=2.0, decay=0.0))
    found = ltl.explain(published, surface)
    assert not found.forms_pattern
    assert str(found).startswith("No pattern")
    assert "no diffusivities would make one" in str(found)
    for diffusivity in ((1.0, 0.01), (10.0, 0.1)):
        assert not ltl.explain(ltl.ReactionDiffusion(diffusivity, ltl.kinetics.turk(decay=0.0)), surface).forms_pattern


def test_explain_counts_the_modes_of_the_surface(sphere):
    equation = ltl.ReactionDiffusion((0.8, 0.1), ltl.kinetics.turk(rate=1.0))
    found = ltl.explain(equation, sphere)
    assert found.forms_pattern
    # l(l + 1) within 2.2 .. 22.8: l = 2, 3, 4.
    assert found.num_modes == 5 + 7 + 9
    assert found.wavelength == pytest.approx(2 * np.pi / np.sqrt(8.2), rel=0.01)
    assert "resolves" in str(found)


def test_explain_tells_what_stands_in_the_way(sphere):
    def explained(diffusivity, **how):
        return ltl.explain(ltl.ReactionDiffusion(diffusivity, ltl.kinetics.turk(**how)), sphere)

    assert "more than 4 times" in str(explained((0.3, 0.1)))
    assert "does not resolve" in str(explained((0.008, 0.001)))
    assert "too small for the wavelength" in str(explained((80.0, 10.0), rate=1.0))
    assert "unstable without diffusion" in str(explained((0.8, 0.1), decay=14.0))
    waves = ltl.ReactionDiffusion((0.03, 0.0), ltl.kinetics.barkley())
    assert "finite push" in str(ltl.explain(waves, sphere))


def test_explain_calls_a_centre_neutral(sphere):
    equation = ltl.ReactionDiffusion((0.002, 0.002), ltl.kinetics.lotka_volterra(growth=4.0))
    found = ltl.explain(equation, sphere)
    assert not found.forms_pattern
    assert "(1, 4) is neutral" in str(found)
    # The frequency at the centre is sqrt(a c).
    assert "in the time 3.142" in str(found)
    assert found.dispersion.band is None


def test_explain_tells_waves_from_a_pattern(sphere):
    """Two species that oscillate, and grow, but for a third that holds them back where it does not diffuse away."""

    def rates(species, p):
        u, v, w = species
        return 0.5 * u - 2 * v - w, 2 * u, 10 * (u - w)

    equation = ltl.ReactionDiffusion((1e-2, 1e-2, 10.0), ltl.kinetics.Kinetics(rates, None, ("u", "v", "w")))
    found = ltl.explain(equation, sphere, (0.0, 0.0, 0.0))
    at, rate = found.dispersion.fastest
    values = np.linalg.eigvals(np.asarray(found.dispersion.jacobian) - at * np.diag([1e-2, 1e-2, 10.0]))
    leading = values[values.real.argmax()]
    assert at > 1
    assert rate == pytest.approx(leading.real)
    assert rate > 0
    assert float(found.dispersion.frequency(at)) == pytest.approx(abs(leading.imag))
    assert abs(leading.imag) > 1
    assert float(found.dispersion.growth(0.0)) < 0
    assert not found.forms_pattern
    assert not found.dispersion.forms_pattern
    assert "Waves, and no stationary pattern" in str(found)


def pattern(level, diffusivity, kinetics, t1, amplitude=0.1, seed=0):
    """A pattern on the sphere out of a start that does not depend on the mesh, its surface and its mesh."""
    mesh = ltl.shapes.icosphere(level)
    surface = ltl.Surface.from_mesh(mesh)
    rng = np.random.default_rng(seed)
    waves, phases = 6 * rng.normal(size=(40, 3)), rng.uniform(0, 2 * np.pi, 40)
    start = np.sin(mesh.vertices @ waves.T + phases).sum(axis=1) / np.sqrt(20)
    u0 = np.asarray(kinetics.steady_state()) + amplitude * start[:, None] * np.array([1.0, -1.0])
    equation = ltl.ReactionDiffusion(diffusivity, kinetics)
    return ltl.solve(equation, surface, u0, t1, solver=ltl.RKL2(), rtol=1e-3, atol=1e-4).u_end, surface, mesh


def test_turks_model_makes_about_forty_spots():
    u, _, mesh = pattern(4, (0.8, 0.1), ltl.kinetics.turk(), 40.0)
    assert 30 <= count_maxima(mesh, -np.asarray(u[:, 1])) + count_maxima(mesh, np.asarray(u[:, 1])) <= 120


@pytest.mark.parametrize("finest", [5, pytest.param(6, marks=pytest.mark.slow)])
def test_the_wavelength_of_a_pattern_does_not_change_with_the_mesh(finest):
    lengths = []
    for level in range(4, finest + 1):
        u, surface, _ = pattern(level, (1.0, 10.0), ltl.kinetics.schnakenberg(rate=150.0), 1.5)
        lengths.append(wavelength(surface, u[:, 0]))
    assert np.ptp(lengths) < 0.05 * lengths[-1]
