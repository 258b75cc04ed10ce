"""A scenario file describes a mesh, an equation, a start and how to solve and show it."""

import tomllib
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scenario_files import NUM_VERTICES, PLAIN, REACTION, SPHERE, START, changed, write_ball

import ltljax as ltl
from ltljax._output import pictures
from ltljax._output.colors import COLORMAPS
from ltljax.app import choices, scenario
from ltljax.app.scenario.equations import KINETICS

SMALL = {
    "sphere": {"mesh.subdivisions": 1},
    "ellipsoid": {"mesh.subdivisions": 1},
    "torus": {"mesh.n_major": 8, "mesh.n_minor": 6},
}


def small(name, **options):
    """A scenario of the library on a small mesh of the same shape."""
    text = scenario.library()[name]
    return scenario.read(text, name, Path(), SMALL[tomllib.loads(text)["mesh"]["shape"]], **options)


def rate(example, mesh=None):
    surface = ltl.Surface.from_mesh(example.mesh if mesh is None else mesh)
    return surface, example.make_equation(surface).rate(jnp.array(0.0), surface, jnp.asarray(example.u0))


@pytest.mark.parametrize("name", scenario.library())
def test_every_scenario_of_the_library_can_be_read_and_its_state_changes(name):
    example = small(name)
    surface, change = rate(example)
    assert change.shape == example.u0.shape == (surface.num_vertices, len(example.species))
    assert np.isfinite(change).all()
    assert float(jnp.abs(change).max()) > 0
    assert example.settings.colormap in COLORMAPS


def test_the_library_shows_every_kinetics():
    names = {tomllib.loads(text).get("kinetics", {}).get("name") for text in scenario.library().values()}
    assert set(KINETICS) <= names
    assert {"cahn-hilliard", "heat"} <= names


def test_the_command_line_offers_what_the_library_has():
    assert tuple(pictures.VIEWS) == choices.VIEWS
    assert set(choices.RENAMED_SMOOTHING_METHODS.values()) <= set(choices.SMOOTHING_METHODS)
    assert set(choices.SCHEMES) == {name.lower() for name in ("Monotone", "Polynomial", "Paper") if hasattr(ltl, name)}


def test_a_written_reaction_is_the_named_one(tmp_path):
    named = scenario.read(PLAIN, "named", tmp_path)
    text = changed(
        REACTION,
        """
[reactions]
du = "rate*(a - u + u^2*v)"
dv = "rate*(b - u^2*v)"
[parameters]
a = 0.1
b = "0.9 + 0*x"
rate = 30""",
    )
    written = scenario.read(text, "written", tmp_path)
    np.testing.assert_array_equal(named.u0, written.u0)
    np.testing.assert_allclose(rate(named)[1], rate(written)[1], rtol=1e-9, atol=1e-9)


def test_directions_and_flows_become_operators(tmp_path):
    text = PLAIN + '[direction]\nfield = ["-y", "x", "0"]\nspecies = ["u"]\n[flow]\nvelocity = ["-y", "x", 0]\n'
    example = scenario.read(text, "flowing", tmp_path)
    diffusivities = example.make_equation(ltl.Surface.from_mesh(example.mesh)).diffusivity
    assert all(isinstance(diffusivity, ltl.operators.EllipticStencil) for diffusivity in diffusivities)


def test_heat_has_a_source_whose_mean_is_subtracted_unless_the_boundary_has_conditions():
    disk = {"mesh": {"shape": "disk"}, "mesh.rings": 4, "kinetics.source": "x + 1", "kinetics.balanced": True}
    text = scenario.library()["heat"]
    balanced = scenario.read(text, "heat", Path(), disk)
    surface, change = rate(balanced)
    assert float(ltl.integrate(surface, change[:, 0], surface.mass)) == pytest.approx(0, abs=1e-12)
    assert any("mean of the source is subtracted" in note for note in balanced.notes)
    held = scenario.read(text, "heat", Path(), disk | {"boundary.conditions": ["neumann=0"]})
    np.testing.assert_allclose(rate(held)[1][:, 0], held.mesh.vertices[:, 0] + 1, atol=1e-12)
    assert not any("mean of the source" in note for note in held.notes)


def test_the_first_variant_for_the_shape_applies_and_a_named_one_after_it():
    text = scenario.library()["heat"]
    torus = {"mesh": {"shape": "torus"}, "mesh.n_major": 8}
    plain = scenario.read(text, "heat", Path(), torus)
    sine = scenario.read(text, "heat", Path(), torus, variant="sine")
    assert plain.tables["mesh"]["n_major"] == 8
    assert plain.tables["mesh"]["n_minor"] == sine.tables["mesh"]["n_minor"] == 48
    assert plain.t1 == sine.t1 == 10
    assert plain.exact is None
    assert sine.exact(1.0).shape == sine.u0.shape
    assert "variants" not in sine.tables
    with pytest.raises(scenario.ScenarioError, match="the variant sine needs --mesh torus"):
        scenario.read(text, "heat", Path(), variant="sine")
    with pytest.raises(scenario.ScenarioError, match=r"heat has no variant 'cosine'; its variants are .*sine"):
        scenario.read(text, "heat", Path(), variant="cosine")


def test_the_variant_as_published_is_uniform_and_its_noise_the_same_in_all_formulas():
    published = small("turing", variant="as-published")
    np.testing.assert_array_equal(published.u0, 1)
    np.testing.assert_array_equal(published.exact(3.0), np.full(published.u0.shape, [1.0, 16.0]))
    text = changed(START, 'u = "shared_noise"\nv = "shared_noise"')
    shared = scenario.read(text, "shared", Path()).u0
    np.testing.assert_array_equal(shared[:, 0], shared[:, 1])
    assert np.ptp(shared) > 1


def test_a_changed_equation_has_no_exact_solution():
    assert small("heat").exact is not None
    text, on = scenario.library()["heat"], SMALL["sphere"]
    for change in ({"diffusivity.u": 2.0}, {"mesh.radius": 2.0}, {"scale": 2.0}, {"initial.u": "x"}):
        assert scenario.read(text, "heat", Path(), on | change).exact is None
    assert scenario.read(text, "heat", Path(), on | {"time.end": 1.0, "solver.rtol": 1e-6}).exact is not None


def test_old_names_of_turings_system_still_work():
    with pytest.warns(DeprecationWarning, match=r"ltljax.kinetics.turk is deprecated .* use turing"):
        kinetics = ltl.kinetics.turk(rate=2.0)
    assert kinetics.species == ("u", "v")
    text = changed(REACTION, '[kinetics]\nname = "turk"')
    with pytest.warns(DeprecationWarning, match='use "turing"'):
        example = scenario.read(text, "old", Path())
    assert example.tables["kinetics"]["name"] == "turing"


def test_a_mesh_of_the_command_line_comes_first_and_changes_after(tmp_path):
    np.savez(tmp_path / "start.npz", **{name: np.ones(200) for name in "uv"})
    write_ball(tmp_path / "elsewhere" / "ball.obj")
    # A mesh that the command line names may be a link.
    (tmp_path / "link.obj").symlink_to(tmp_path / "elsewhere" / "ball.obj")
    text = changed(START, 'file = "start.npz"')
    for path in (tmp_path / "elsewhere/ball.obj", tmp_path / "link.obj"):
        example = scenario.read(text, "my", tmp_path, {"mesh.scale": "keep"}, path)
        assert example.mesh.num_vertices == 200
        assert example.tables["mesh"]["scale"] == "keep"
        assert example.where == path.name


def test_a_mesh_file_is_scaled_to_the_area_of_the_unit_sphere(tmp_path):
    write_ball(tmp_path / "ball.obj")
    mesh = scenario.read(PLAIN, "ball", tmp_path, {}, tmp_path / "ball.obj").mesh
    assert mesh.area == pytest.approx(4 * np.pi, rel=1e-6)


def test_a_box_has_the_sides_it_is_given(tmp_path):
    changes = {"mesh": {"shape": "box"}, "mesh.sides": [2.0, 1.0, 1.5], "mesh.n": 8}
    mesh = scenario.read(PLAIN, "box", tmp_path, changes).mesh
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [2.0, 1.0, 1.5])
    assert mesh.area == pytest.approx(13)
    with pytest.raises(scenario.ScenarioError, match="sides"):
        scenario.read(PLAIN, "box", tmp_path, changes | {"mesh.sides": [2.0, 1.0]})


def test_states_come_from_a_file_beside_the_scenario(tmp_path):
    state = {name: np.random.default_rng(0).random(NUM_VERTICES) for name in "uv"}
    np.savez(tmp_path / "start.npz", **state)
    example = scenario.read(changed(START, 'file = "start.npz"'), "mine", tmp_path)
    np.testing.assert_array_equal(example.u0[example.mesh.source_order], np.stack([state["u"], state["v"]], axis=1))


def test_a_start_is_read_from_a_table_of_a_spreadsheet(tmp_path):
    mesh = scenario.read(PLAIN, "plain.toml", tmp_path).mesh
    rows = "\n".join(f"{x:.17g},{2 * x:.17g}" for x in mesh.vertices[mesh.source_order, 0])
    (tmp_path / "start.csv").write_text(f"v,u\n{rows}\n")
    text = changed(START, 'file = "start.csv"')
    np.testing.assert_array_equal(
        scenario.read(text, "mine.toml", tmp_path).u0, mesh.vertices[:, :1] * np.array([2.0, 1.0])
    )
    (tmp_path / "start.csv").write_text("v,w\n1,2\n")
    with pytest.raises(ValueError, match=r"expected the column u, found v, w"):
        scenario.read(text, "mine.toml", tmp_path)


def test_noise_of_each_key_is_its_own(tmp_path):
    text = changed("u = 1.0\nv = 10.0", 'u = "1.5 + noise"\nv = 10.0').replace('"1 + 0.1*noise"', '"noise"')
    example = scenario.read(text.replace(SPHERE, 'shape = "sphere"\nsubdivisions = 2'), "mine", tmp_path)
    diffusivity = example.make_equation(ltl.Surface.from_mesh(example.mesh)).diffusivity[0]
    assert abs(np.corrcoef(np.asarray(diffusivity), example.u0[:, 0])[0, 1]) < 0.3


@pytest.mark.parametrize("name", ["gray-scott", "cahn-hilliard"])
def test_the_scale_of_a_pattern_is_one_number(name):
    def scaled_rate(scale):
        example = scenario.read(scenario.library()[name], name, Path(), SMALL["sphere"] | {"scale": scale})
        surface = ltl.Surface.from_mesh(example.mesh.scaled(scale), dtype=jnp.float64)
        u = np.random.default_rng(0).uniform(0.2, 0.8, example.u0.shape)
        return np.asarray(example.make_equation(surface).rate(jnp.zeros(()), surface, jnp.asarray(u)))

    # On a sphere twice as large the same numbers make a pattern twice as large.
    np.testing.assert_allclose(scaled_rate(2.0), scaled_rate(1.0), rtol=1e-9)


def test_a_bound_that_means_zero_is_called_zero(tmp_path):
    with pytest.raises(ValueError, match=r"expected a number above 0 as time\.end"):
        scenario.read(changed("end = 0.1", "end = 0"), "mine.toml", tmp_path)
