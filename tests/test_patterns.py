"""Every scenario of the library shows what its title says: spots, holes, stripes, spirals, phases or fronts."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

import ltljax as ltl
from ltljax.app import scenario
from ltljax.app.run import count_maxima


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


@functools.cache
def run_scenario(name, ts=None, **changes):
    """The states of a scenario of the library on 2562 vertices, with its surface, equation and contents."""
    text = scenario.library()[name]
    coarse = {"mesh.n_major": 72, "mesh.n_minor": 36} if "torus" in text else {"mesh.subdivisions": 4}
    contents = scenario.read(text, name, ".", coarse | {key.replace("__", "."): v for key, v in changes.items()})
    surface = ltl.Surface.from_mesh(contents.mesh)
    equation = contents.make_equation(surface)
    ts = (contents.t1,) if ts is None else ts
    solution = ltl.solve(equation, surface, contents.u0, ts[-1], ts, rtol=1e-3, atol=1e-4)
    return np.asarray(solution.us), surface, equation, contents


def count_regions(contents, inside):
    """The number of connected regions of marked vertices."""
    edges = contents.mesh.edges
    edges = edges[inside[edges].all(axis=1)]
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(inside),) * 2)
    return connected_components(graph, directed=False)[0] - int((~inside).sum())


def count_halves(contents, u):
    """The numbers of regions above and below the mid-range of a field."""
    middle = (u.max() + u.min()) / 2
    return count_regions(contents, u > middle), count_regions(contents, u < middle)


def wavelength(surface, u):
    return float(ltl.inverse.pattern_statistics(surface, jnp.asarray(u), surface.mass).wavelength)


# Isolated regions of the first species: above or below the rest, with their least and largest number.
SPOTS = {
    "barrio-spots": ("above", 12, 30), "brusselator-holes": ("below", 60, 110), "gierer-meinhardt": ("above", 18, 45),
    "brusselator-spots": ("above", 130, 260), "schnakenberg": ("above", 50, 100), "two-scales": ("above", 25, 60),
}  # fmt: skip


QUICK_SPOTS = ("schnakenberg", "brusselator-holes")


@pytest.mark.parametrize("name", [*QUICK_SPOTS, *(slow(name) for name in SPOTS if name not in QUICK_SPOTS)])
def test_spots_and_holes_are_isolated(name):
    side, least, most = SPOTS[name]
    # The spots of the Brusselator are too small for 2562 vertices.
    changes = dict(mesh__subdivisions=5) if name == "brusselator-spots" else {}
    us, _, _, contents = run_scenario(name, **changes)
    above, below = count_halves(contents, us[-1][:, 0])
    spots, background = (above, below) if side == "above" else (below, above)
    assert least <= spots <= most
    assert background == 1
    skewness = float(np.mean((us[-1][:, 0] - us[-1][:, 0].mean()) ** 3))
    assert skewness > 0 if side == "above" else skewness < 0


@pytest.mark.parametrize(
    "name", ["fitzhugh-nagumo", *map(slow, ("barrio-stripes", "brusselator-stripes", "meinhardt-stripes"))]
)
def test_stripes_are_long_and_cover_half(name):
    us, surface, _, contents = run_scenario(name)
    u = us[-1][:, 0]
    # Spots of the same wavelength would be many more than stripes.
    num_spots = 4 * np.pi / (wavelength(surface, u) ** 2 * np.sqrt(3) / 2)
    assert max(count_halves(contents, u)) < 0.2 * num_spots
    assert abs((u > (u.max() + u.min()) / 2).mean() - 0.5) < 0.1
    assert abs(((u - u.mean()) ** 3).mean() / u.std() ** 3) < 0.25


@pytest.mark.parametrize(
    "name",
    [
        "schnakenberg",
        *map(slow, ("barrio-spots", "barrio-stripes", "fitzhugh-nagumo", "gierer-meinhardt", "meinhardt-stripes")),
        slow("turing-ridges"),
    ],
)
def test_the_first_wavelength_is_that_of_linear_theory(name):
    """Small noise grows for eight times the growth time of the fastest mode before the wavelength is measured."""
    _, surface, equation, contents = run_scenario(name, ts=(1e-6,))
    explanation = ltl.explain(equation, surface)
    assert explanation.forms_pattern
    dispersion = explanation.dispersion
    rest = np.asarray(dispersion.steady_state)
    rng = np.random.default_rng(0)
    u0 = rest + 1e-6 * rng.normal(size=(surface.num_vertices, len(rest)))
    uniform = equation
    # The decay rates of these two scenarios vary from vertex to vertex.
    if name == "meinhardt-stripes":
        uniform = ltl.ReactionDiffusion((4e-5, 4e-5, 0.0, 9e-4, 9e-4), ltl.kinetics.meinhardt())
    elif name == "turing-ridges":
        uniform = ltl.ReactionDiffusion((0.8, 0.1), ltl.kinetics.turing(rate=10.0, decay=12.0))
    u = ltl.solve(uniform, surface, u0, 8 / dispersion.fastest[1], rtol=1e-5, atol=1e-10).u_end
    assert wavelength(surface, u[:, 0] - rest[0]) == pytest.approx(dispersion.wavelength, rel=0.1)
    assert contents.species[0] in ("u", "g")


@pytest.mark.parametrize(("kind", "level"), [("stripes", 4), slow("holes", 4), slow("spots", 5)])
def test_the_brusselators_first_wavelength_outgrows_its_oscillation(kind, level):
    """The uniform state oscillates slowly (b > 1 + a^2), and patterns grow at least three times as fast.

    The tolerances are tight, because long time steps would amplify the oscillation.
    """
    contents = scenario.read(scenario.library()[f"brusselator-{kind}"], kind, ".", {"mesh.subdivisions": level})
    surface = ltl.Surface.from_mesh(contents.mesh)
    equation = contents.make_equation(surface)
    explanation = ltl.explain(equation, surface)
    assert explanation.forms_pattern
    assert "grow too, but more slowly (rate 0.1)" in str(explanation)
    rest = np.asarray(explanation.dispersion.steady_state)
    u0 = rest + 1e-6 * np.random.default_rng(0).normal(size=(surface.num_vertices, 2))
    u = ltl.solve(equation, surface, u0, 10 / explanation.dispersion.fastest[1], rtol=1e-9, atol=1e-12).u_end
    assert wavelength(surface, u[:, 0] - jnp.mean(u[:, 0])) == pytest.approx(explanation.wavelength, rel=0.1)


def test_turings_spots_have_the_known_number_and_height():
    """About 40 spots, with u from 2.3 to 6.4 and v from 0 to 9.9, up to the variation between random seeds."""
    us, _, _, contents = run_scenario("turing-ridges")
    u, v = us[-1].T
    assert abs(count_maxima(contents.mesh, v) - 40) <= 8
    np.testing.assert_allclose([u.min(), u.max()], [2.3, 6.4], atol=0.3)
    np.testing.assert_allclose([v.min(), v.max()], [0, 9.9], atol=1.5)
    assert v.min() >= 0


@pytest.mark.slow
def test_published_gray_scott_spots_grow_if_the_mesh_resolves_them():
    text = scenario.library()["gray-scott"]
    changes = {"diffusivity.u": 2e-5, "diffusivity.v": 1e-5, "initial.u": "1 - exp(-80*(x^2 + y^2 + (z - 1)^2))"}
    changes |= {"initial.v": "exp(-80*(x^2 + y^2 + (z - 1)^2))", "mesh.subdivisions": 6}
    contents = scenario.read(text, "published", ".", changes)
    surface = ltl.Surface.from_mesh(contents.mesh)
    times = (300.0, 1000.0, 3000.0)
    us = ltl.solve(contents.make_equation(surface), surface, contents.u0, times[-1], times, rtol=1e-3, atol=1e-4).us
    covered = [float((u[:, 1] > 0.1).mean()) for u in us]
    assert covered[2] > 2 * covered[1] > 3 * covered[0] > 0
    v = np.asarray(us[-1][:, 1])
    assert count_regions(contents, v > 0.15) + count_regions(contents, v < 0.15) > 10


@pytest.mark.slow
def test_gray_scott_spots_grow_and_divide():
    us, surface, _, contents = run_scenario("gray-scott", ts=(0.0, 400.0, 1000.0, 4000.0))
    covered = [(u[:, 1] > 0.1).mean() for u in us]
    assert covered[0] < 0.25
    assert covered[-1] > 0.5
    assert (np.diff(covered) > 0).sum() >= 2
    assert wavelength(surface, us[-1][:, 1]) < 0.6
    assert (us >= -1e-3).all()
    assert count_regions(contents, us[-1][:, 1] > 0.2) < 40


def count_defects(contents, u, v):
    """The numbers of faces around which the phase of (u, v) turns once, forwards and backwards."""
    phase = np.arctan2(v, u)[contents.mesh.faces]
    turn = np.diff(np.concatenate([phase, phase[:, :1]], axis=1), axis=1)
    winding = np.rint(((turn + np.pi) % (2 * np.pi) - np.pi).sum(axis=1) / (2 * np.pi)).astype(int)
    return int((winding > 0).sum()), int((winding < 0).sum())


@pytest.mark.slow
def test_ginzburg_landau_noise_organises_into_spirals_of_both_senses():
    us, _, _, contents = run_scenario("ginzburg-landau", ts=(2.0, 20.0, 100.0))
    counts = [count_defects(contents, u[:, 0], u[:, 1]) for u in us]
    # On a closed surface both senses balance. At first pairs annihilate, and then the number of spirals is stable.
    assert all(forwards == backwards for forwards, backwards in counts)
    assert counts[0][0] > counts[1][0] >= 2
    assert abs(counts[2][0] - counts[1][0]) <= 0.1 * counts[1][0]
    np.testing.assert_allclose(np.median(np.hypot(us[-1][:, 0], us[-1][:, 1])), 1, atol=0.1)


def test_barkley_waves_form_rotating_spirals():
    us, surface, _, contents = run_scenario("spirals", ts=(10.0, 29.0, 30.0))
    for u in us[1:]:
        assert sum(count_defects(contents, u[:, 0] - 0.5, u[:, 1] - 0.3)) >= 2
        assert u[:, 0].max() > 0.95
        assert u[:, 0].min() < 0.05
    # The spirals rotate: in one unit of time the front sweeps a tenth of the surface.
    assert ((us[1][:, 0] > 0.5) != (us[2][:, 0] > 0.5)).mean() > 0.1
    assert surface.num_vertices == 2562


def test_allen_cahn_domains_coarsen():
    us, surface, _, _ = run_scenario("allen-cahn", ts=(8.0, 20.0, 40.0))
    lengths = [
        float(ltl.integrate(surface, jnp.linalg.norm(ltl.gradient(surface, jnp.asarray(u[:, 0])), axis=1))) for u in us
    ]
    assert lengths[0] > 1.1 * lengths[1] > 1.1 * lengths[2] > 0
    np.testing.assert_allclose(np.abs(us[-1]).max(), 1, atol=0.01)


@pytest.mark.slow
def test_cahn_hilliard_phases_separate_and_conserve_their_amounts():
    us, surface, _, contents = run_scenario("cahn-hilliard", ts=(0.05, 1.0))
    amounts = [float(ltl.integrate(surface, jnp.asarray(u.reshape(-1)), surface.mass)) for u in (contents.u0, *us)]
    np.testing.assert_allclose(amounts, amounts[0], rtol=1e-9)
    assert us[-1].max() > 0.9
    assert us[-1].min() < -0.9


def test_the_fisher_kpp_front_spreads_at_its_theoretical_speed():
    us, _, _, contents = run_scenario("fisher-kpp", ts=(6.0, 8.0, 10.0))
    centre = contents.mesh.vertices[np.argmax(contents.u0[:, 0])]
    angle = np.arccos(np.clip(contents.mesh.vertices @ centre, -1, 1))
    # The radius of a spherical cap with the covered area.
    radii = [np.arccos(1 - 2 * (u[:, 0] > 0.5).mean()) for u in us]
    speed = (radii[2] - radii[0]) / 4
    # The speed approaches 2 sqrt(D r) from below like 1 / t, and curvature reduces it by D / R.
    assert 0.75 < speed / (2 * np.sqrt(0.005)) < 1.02
    assert angle[us[2][:, 0] > 0.5].max() < 1.15 * radii[2]


@pytest.mark.slow
def test_lotka_volterra_populations_cycle_and_stay_positive():
    us, surface, _, _ = run_scenario("lotka-volterra", ts=tuple(np.linspace(1.0, 30.0, 59)))
    assert us.min() > 0.2
    prey = np.array([float(ltl.integrate(surface, jnp.asarray(u[:, 0]))) for u in us]) / 78.96
    # The period around the state (1, 1) is 2 pi.
    turns = np.sum(np.diff(np.sign(us[:, 0, 0] - 1)) != 0) / 2
    assert 3.5 <= turns <= 5.5
    assert np.ptp(prey) < 1


@pytest.mark.parametrize("name", ["zebra", slow("rings")])
def test_stripes_follow_circles_of_latitude_or_go_around_the_tube(name):
    us, surface, _, _ = run_scenario(name)
    x = np.asarray(surface.vertices)
    slope = np.asarray(ltl.gradient(surface, jnp.asarray(us[-1][:, 0])))
    around_axis = np.stack([-x[:, 1], x[:, 0], 0 * x[:, 0]], axis=1)
    along = around_axis if name == "zebra" else np.cross(around_axis, np.asarray(surface.normals))
    is_off_axis = np.hypot(x[:, 0], x[:, 1]) > 0.5
    steep = np.linalg.norm(slope, axis=1)
    cosine = np.abs((slope * along).sum(axis=1)) / (steep * np.linalg.norm(along, axis=1) + 1e-30)
    angle = np.degrees(np.arcsin(np.clip(cosine, 0, 1)))
    assert np.average(angle[is_off_axis], weights=steep[is_off_axis]) < 10


@pytest.mark.slow
def test_a_pattern_on_a_growing_surface_keeps_its_size_and_gains_spots():
    mesh = ltl.shapes.icosphere(3)
    start = ltl.Surface.from_mesh(mesh)
    kinetics = ltl.kinetics.schnakenberg(rate=40.0)
    growth, end = 0.25, 3.0
    equation = ltl.Moving(ltl.ReactionDiffusion((1.0, 10.0), kinetics), lambda t, x: jnp.exp(growth * t) * x)
    u0 = np.asarray(kinetics.steady_state()) + 0.1 * np.random.default_rng(0).normal(size=(mesh.num_vertices, 2))
    us = ltl.solve(equation, start, u0, end, (1.0, end), rtol=1e-3, atol=1e-4).us
    lengths, counts = [], []
    for t, u in zip((1.0, end), us, strict=True):
        lengths.append(wavelength(equation.surface_at(jnp.array(t), start), u[:, 0]))
        counts.append(count_maxima(mesh, np.asarray(u[:, 0])))
    assert lengths[1] == pytest.approx(lengths[0], rel=0.2)
    assert counts[1] >= 2 * counts[0] >= 8
