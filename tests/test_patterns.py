"""Every scenario of the library shows what its title says: spots, holes, stripes, spirals, phases, fronts."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

import ltljax as ltl
from ltljax.app import scenario
from ltljax.app.run import count_maxima


@functools.cache
def ran(name, ts=None, **changes):
    """The states of a scenario of the library on 2562 vertices, its surface, and what was run."""
    text = scenario.library()[name]
    coarse = {"mesh.n_major": 72, "mesh.n_minor": 36} if "torus" in text else {"mesh.subdivisions": 4}
    example = scenario.read(text, name, ".", coarse | {key.replace("__", "."): v for key, v in changes.items()})
    surface = ltl.Surface.from_mesh(example.mesh)
    equation = example.make_equation(surface)
    ts = (example.t1,) if ts is None else ts
    found = ltl.solve(equation, surface, example.u0, ts[-1], ts, rtol=1e-3, atol=1e-4)
    return np.asarray(found.us), surface, equation, example


def regions(example, inside):
    """The number of connected regions of marked vertices."""
    edges = example.mesh.edges
    edges = edges[inside[edges].all(axis=1)]
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(inside),) * 2)
    return connected_components(graph, directed=False)[0] - int((~inside).sum())


def halves(example, u):
    """The numbers of regions above and below the middle of a field."""
    middle = (u.max() + u.min()) / 2
    return regions(example, u > middle), regions(example, u < middle)


def wavelength(surface, u):
    return float(ltl.inverse.pattern_statistics(surface, jnp.asarray(u), surface.mass).wavelength)


# Isolated regions of the species shown: above or below the rest, and how many there are at least and at most.
SPOTS = {
    "barrio-spots": ("above", 12, 30), "brusselator-holes": ("below", 60, 110), "gierer-meinhardt": ("above", 18, 45),
    "brusselator-spots": ("above", 130, 260), "schnakenberg": ("above", 50, 100), "two-scales": ("above", 25, 60),
}  # fmt: skip


@pytest.mark.parametrize("name", SPOTS)
def test_spots_are_isolated_and_holes_too(name):
    which, least, most = SPOTS[name]
    # The Brusselator's are too small for 2562 vertices.
    us, _, _, example = ran(name, mesh__subdivisions=5) if name == "brusselator-spots" else ran(name)
    above, below = halves(example, us[-1][:, 0])
    spots, ground = (above, below) if which == "above" else (below, above)
    assert least <= spots <= most
    assert ground == 1
    skewness = float(np.mean((us[-1][:, 0] - us[-1][:, 0].mean()) ** 3))
    assert skewness > 0 if which == "above" else skewness < 0


@pytest.mark.parametrize("name", ["barrio-stripes", "brusselator-stripes", "fitzhugh-nagumo", "meinhardt-stripes"])
def test_stripes_are_long_and_cover_half(name):
    us, _, _, example = ran(name)
    u = us[-1][:, 0]
    above, below = halves(example, u)
    # Spots of this wavelength would be many times as many.
    area = float(np.pi * 4)
    length = wavelength(ran(name)[1], u)
    as_spots = area / (length**2 * np.sqrt(3) / 2)
    assert max(above, below) < 0.2 * as_spots
    assert abs((u > (u.max() + u.min()) / 2).mean() - 0.5) < 0.1
    assert abs(((u - u.mean()) ** 3).mean() / u.std() ** 3) < 0.25


LINEAR = ["barrio-stripes", "fitzhugh-nagumo", "gierer-meinhardt", "meinhardt-stripes", "schnakenberg", "turk"]


@pytest.mark.parametrize("name", [*LINEAR, "barrio-spots"])
def test_the_first_wavelength_is_that_of_linear_theory(name):
    """Measured when a small random start has grown for eight times the time the fastest mode takes."""
    _, surface, equation, example = ran(name, ts=(1e-6,))
    found = ltl.explain(equation, surface)
    assert found.forms_pattern
    rest = np.asarray(found.dispersion.steady_state)
    rng = np.random.default_rng(0)
    u0 = rest + 1e-6 * rng.normal(size=(surface.num_vertices, len(rest)))
    uniform = equation
    # The decay of these two varies from vertex to vertex.
    if name == "meinhardt-stripes":
        uniform = ltl.ReactionDiffusion((4e-5, 4e-5, 0.0, 9e-4, 9e-4), ltl.kinetics.meinhardt())
    elif name == "turk":
        uniform = ltl.ReactionDiffusion((0.8, 0.1), ltl.kinetics.turk(rate=10.0, decay=12.0))
    u = ltl.solve(uniform, surface, u0, 8 / found.dispersion.fastest[1], rtol=1e-5, atol=1e-10).u_end
    assert wavelength(surface, u[:, 0] - rest[0]) == pytest.approx(found.dispersion.wavelength, rel=0.1)
    assert example.species[0] in ("u", "g")


@pytest.mark.parametrize(("kind", "level"), [("stripes", 4), ("holes", 4), ("spots", 5)])
def test_the_brusselators_first_wavelength_outgrows_its_oscillation(kind, level):
    """Its uniform state oscillates slowly (b > 1 + a^2); patterns grow three times as fast, or more. Tight
    tolerances: within wide ones steps are so long that they amplify the oscillation, which by itself hardly grows."""
    example = scenario.read(scenario.library()[f"brusselator-{kind}"], kind, ".", {"mesh.subdivisions": level})
    surface = ltl.Surface.from_mesh(example.mesh)
    equation = example.make_equation(surface)
    found = ltl.explain(equation, surface)
    assert found.forms_pattern
    assert "everywhere at once (rate 0.1)" in str(found)
    rest = np.asarray(found.dispersion.steady_state)
    u0 = rest + 1e-6 * np.random.default_rng(0).normal(size=(surface.num_vertices, 2))
    u = ltl.solve(equation, surface, u0, 10 / found.dispersion.fastest[1], rtol=1e-9, atol=1e-12).u_end
    assert wavelength(surface, u[:, 0] - jnp.mean(u[:, 0])) == pytest.approx(found.wavelength, rel=0.1)


def test_turks_spots_are_as_many_and_as_high_as_known():
    """About 40 spots, u from 2.3 to 6.4, v from 0 to 9.9: within what other noise changes."""
    us, _, _, example = ran("turk")
    u, v = us[-1].T
    assert abs(count_maxima(example.mesh, v) - 40) <= 8
    np.testing.assert_allclose([u.min(), u.max()], [2.3, 6.4], atol=0.3)
    np.testing.assert_allclose([v.min(), v.max()], [0, 9.9], atol=1.5)
    assert v.min() >= 0


@pytest.mark.slow
def test_gray_and_scotts_published_spots_grow_where_the_mesh_resolves_them():
    text = scenario.library()["gray-scott"]
    changes = {"diffusivity.u": 2e-5, "diffusivity.v": 1e-5, "initial.u": "1 - exp(-80*(x^2 + y^2 + (z - 1)^2))"}
    changes |= {"initial.v": "exp(-80*(x^2 + y^2 + (z - 1)^2))", "mesh.subdivisions": 6}
    example = scenario.read(text, "published", ".", changes)
    surface = ltl.Surface.from_mesh(example.mesh)
    times = (300.0, 1000.0, 3000.0)
    us = ltl.solve(example.make_equation(surface), surface, example.u0, times[-1], times, rtol=1e-3, atol=1e-4).us
    covered = [float((u[:, 1] > 0.1).mean()) for u in us]
    assert covered[2] > 2 * covered[1] > 3 * covered[0] > 0
    spots = regions(example, np.asarray(us[-1][:, 1]) > 0.15)
    assert spots + regions(example, np.asarray(us[-1][:, 1]) < 0.15) > 10


def test_gray_and_scotts_spots_grow_and_divide():
    us, _, _, example = ran("gray-scott", ts=(0.0, 400.0, 1000.0, 4000.0))
    covered = [(u[:, 1] > 0.1).mean() for u in us]
    assert covered[0] < 0.25
    assert covered[-1] > 0.5
    assert (np.diff(covered) > 0).sum() >= 2
    assert wavelength(ran("gray-scott")[1], us[-1][:, 1]) < 0.6
    assert (us >= -1e-3).all()
    assert regions(example, us[-1][:, 1] > 0.2) < 40


def defects(example, u, v):
    """The numbers of faces around which the phase of (u, v) turns once, forwards and backwards."""
    phase = np.arctan2(v, u)[example.mesh.faces]
    turn = np.diff(np.concatenate([phase, phase[:, :1]], axis=1), axis=1)
    winding = np.rint(((turn + np.pi) % (2 * np.pi) - np.pi).sum(axis=1) / (2 * np.pi)).astype(int)
    return int((winding > 0).sum()), int((winding < 0).sum())


def test_ginzburg_and_landaus_noise_orders_into_spirals_of_both_senses():
    us, _, _, example = ran("ginzburg-landau", ts=(2.0, 20.0, 100.0))
    counts = [defects(example, u[:, 0], u[:, 1]) for u in us]
    # On a closed surface senses balance; at first pairs meet and vanish, then spirals hold their ground.
    assert all(forwards == backwards for forwards, backwards in counts)
    assert counts[0][0] > counts[1][0] >= 2
    assert abs(counts[2][0] - counts[1][0]) <= 0.1 * counts[1][0]
    np.testing.assert_allclose(np.median(np.hypot(us[-1][:, 0], us[-1][:, 1])), 1, atol=0.1)


def test_barkleys_waves_curl_about_tips_and_go_on():
    us, surface, _, example = ran("spirals", ts=(10.0, 29.0, 30.0))
    for u in us[1:]:
        assert sum(defects(example, u[:, 0] - 0.5, u[:, 1] - 0.3)) >= 2
        assert u[:, 0].max() > 0.95
        assert u[:, 0].min() < 0.05
    # It turns: in a unit of time the front sweeps a good part of the surface.
    assert ((us[1][:, 0] > 0.5) != (us[2][:, 0] > 0.5)).mean() > 0.1
    assert surface.num_vertices == 2562


def test_allen_and_cahns_domains_coarsen():
    us, surface, _, _ = ran("allen-cahn", ts=(8.0, 20.0, 40.0))
    lengths = [
        float(ltl.integrate(surface, jnp.linalg.norm(ltl.gradient(surface, jnp.asarray(u[:, 0])), axis=1))) for u in us
    ]
    assert lengths[0] > 1.1 * lengths[1] > 1.1 * lengths[2] > 0
    np.testing.assert_allclose(np.abs(us[-1]).max(), 1, atol=0.01)


def test_cahn_and_hilliards_phases_separate_and_keep_their_amounts():
    us, surface, _, example = ran("cahn-hilliard", ts=(0.05, 1.0))
    amounts = [float(ltl.integrate(surface, jnp.asarray(u.reshape(-1)), surface.mass)) for u in (example.u0, *us)]
    np.testing.assert_allclose(amounts, amounts[0], rtol=1e-9)
    assert us[-1].max() > 0.9
    assert us[-1].min() < -0.9


def test_fishers_front_spreads_at_its_speed():
    us, _, _, example = ran("fisher-kpp", ts=(6.0, 8.0, 10.0))
    first = example.mesh.vertices[np.argmax(example.u0[:, 0])]
    angle = np.arccos(np.clip(example.mesh.vertices @ first, -1, 1))
    # The radius of a cap of the area covered.
    radii = [np.arccos(1 - 2 * (u[:, 0] > 0.5).mean()) for u in us]
    speed = (radii[2] - radii[0]) / 4
    # Fronts approach 2 sqrt(D r) from below, like 1 / t; curved ones lose D / R more.
    assert 0.75 < speed / (2 * np.sqrt(0.005)) < 1.02
    assert angle[us[2][:, 0] > 0.5].max() < 1.15 * radii[2]


def test_lotka_and_volterras_populations_cycle_and_stay_positive():
    us, surface, _, _ = ran("lotka-volterra", ts=tuple(np.linspace(1.0, 30.0, 59)))
    assert us.min() > 0.2
    prey = np.array([float(ltl.integrate(surface, jnp.asarray(u[:, 0]))) for u in us]) / 78.96
    # Around the state (1, 1) a turn takes 2 pi.
    turns = np.sum(np.diff(np.sign(us[:, 0, 0] - 1)) != 0) / 2
    assert 3.5 <= turns <= 5.5
    assert np.ptp(prey) < 1


@pytest.mark.parametrize("name", ["zebra", "rings"])
def test_stripes_keep_to_circles_of_latitude_or_go_around_the_tube(name):
    us, surface, _, _ = ran(name)
    x = np.asarray(surface.vertices)
    slope = np.asarray(ltl.gradient(surface, jnp.asarray(us[-1][:, 0])))
    round_the_axis = np.stack([-x[:, 1], x[:, 0], 0 * x[:, 0]], axis=1)
    along = round_the_axis if name == "zebra" else np.cross(round_the_axis, np.asarray(surface.normals))
    where = np.hypot(x[:, 0], x[:, 1]) > 0.5
    steep = np.linalg.norm(slope, axis=1)
    cosine = np.abs((slope * along).sum(axis=1)) / (steep * np.linalg.norm(along, axis=1) + 1e-30)
    off = np.degrees(np.arcsin(np.clip(cosine, 0, 1)))
    assert np.average(off[where], weights=steep[where]) < 10


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
