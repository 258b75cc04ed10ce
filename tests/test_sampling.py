"""Sampling of fields: at points, over patches, and by any operator; and what is refused."""

import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(2))


def test_the_closest_point_agrees_with_a_search_over_all_triangles():
    mesh = ltl.shapes.jittered_torus(14, 7, 0.3, seed=0)
    surface = ltl.Surface.from_mesh(mesh)
    points = np.random.default_rng(0).uniform(-1.4, 1.4, size=(40, 3))
    sampling = ltl.inverse.observe_at(surface, points, within=10.0)
    feet = np.asarray(sampling(surface.vertices)) + surface.centre
    corners = mesh.vertices[mesh.faces]
    grid = np.linspace(0, 1, 25)
    s, t = (w.ravel() for w in np.meshgrid(grid, grid))
    inside = s + t <= 1
    weights = np.stack([1 - s - t, s, t])[:, inside]
    candidates = np.einsum("kw,fkd->fwd", weights, corners).reshape(-1, 3)
    for point, foot in zip(points, feet, strict=True):
        least = np.linalg.norm(candidates - point, axis=1).min()
        assert np.linalg.norm(foot - point) <= least + 1e-12
        assert least - np.linalg.norm(foot - point) < 0.03


def test_measurements_at_points_are_of_second_order():
    errors, sizes = [], []
    points = np.random.default_rng(0).normal(size=(50, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    for level in (2, 3, 4):
        surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(level))
        sampled = ltl.inverse.observe_at(surface, points)(np.sin(3 * np.asarray(surface.vertices)[:, 0]))
        errors.append(float(np.abs(sampled - np.sin(3 * points[:, 0])).max()))
        sizes.append(float(surface.mesh_size))
    assert np.polyfit(np.log(sizes), np.log(errors), 1)[0] > 1.8
    assert errors[-1] < 0.01


def test_averages_over_patches_are_weighted_by_area(sphere):
    u, areas = 2 + np.asarray(sphere.vertices)[:, 2], np.asarray(sphere.vertex_areas)
    north = np.asarray(sphere.vertices)[:, 2] > 0
    as_masks = ltl.inverse.observe_patches(sphere, [north, ~north])
    as_numbers = ltl.inverse.observe_patches(sphere, np.where(north, 0, 1))
    expected = [np.average(u[part], weights=areas[part]) for part in (north, ~north)]
    np.testing.assert_allclose(as_masks(u), expected, rtol=1e-12)
    np.testing.assert_allclose(as_numbers(u), expected, rtol=1e-12)


def test_a_matrix_is_an_operator(sphere):
    matrix = np.random.default_rng(0).normal(size=(5, sphere.num_vertices))
    data = ltl.Observations(np.zeros((2, 5)), times=[0.1, 0.2], operator=matrix)
    states = np.random.default_rng(1).normal(size=(2, sphere.num_vertices))
    np.testing.assert_allclose(data.of(states), states @ matrix.T, rtol=1e-10)


@pytest.mark.usefixtures("as_users_call_it")
def test_points_and_patches_that_cannot_be_used_are_refused(sphere):
    with pytest.raises(ValueError, match=r"Point 1 at \(3, 0, 0\) is 2 from the surface, and 1 of 2 points"):
        ltl.inverse.observe_at(sphere, np.array([[1.0, 0, 0], [3.0, 0, 0]]))
    with pytest.raises(ValueError, match="Point 0 is not finite"):
        ltl.inverse.observe_at(sphere, np.full((1, 3), np.nan))
    with pytest.raises(ValueError, match=r"Expected points of shape \(M, 3\)"):
        ltl.inverse.observe_at(sphere, np.zeros(3))
    with pytest.raises(ValueError, match="Patch 1 has no vertices"):
        ltl.inverse.observe_patches(sphere, [[0, 1], []])
    with pytest.raises(ValueError, match="Patch 0 has vertices outside"):
        ltl.inverse.observe_patches(sphere, [[0, 10_000]])
    small = ltl.Surface.from_mesh(ltl.shapes.icosphere(1))
    model = ltl.inverse.Experiment(ltl.Diffusion, small, small.vertices[:, 0])
    data = ltl.Observations([[1.0]], times=[0.1], operator=ltl.inverse.observe_patches(sphere, [[0]]))
    with pytest.raises(ValueError, match="The operator reads 162 vertices; the model predicts"):
        ltl.fit(model, 1.0, data)


REFUSED = [
    (dict(values=[np.nan, np.nan]), "None of the 2 values was measured"),
    (dict(values=[1.0, 2.0], mask=[False, False]), "None of the 2 values was measured"),
    (dict(values=[1.0, np.inf]), r"Expected finite observations, found inf at index \(1,\)"),
    (dict(values=[1.0, 2.0], mask=[1, 0]), "Expected mask as booleans"),
    (dict(values=[1.0, 2.0], loss="tukey"), "Expected a loss: 'linear', 'huber', 'soft_l1', 'cauchy', or a function"),
    (dict(values=[1.0, 2.0], loss=lambda z: z + 1), r"rho\(0\) = 0 that increases"),
    (dict(values=[1.0, 2.0], loss=lambda z: -z), r"rho\(0\) = 0 that increases"),
    (dict(values=[1.0, 2.0], loss=lambda z: jnp.sum(z)), "one finite number for each squared residual"),
    (dict(values=[1.0, 2.0], loss=lambda z, y: z), "The loss fails on an array"),
    (dict(values=[1.0, 2.0], loss=3), "Expected a loss"),
    (dict(values=[1.0, 2.0], noise="gauss"), 'Expected noise as a number, an array or "poisson"'),
    (dict(values=[1.0, -2.0], noise="poisson"), "Expected counts from 0"),
    (dict(values=[1.0, 2.0], relative_noise=0.1), "Expected noise= in addition to relative_noise="),
    (dict(values=[1.0, 2.0], scale=0.0), "Expected scale as a finite number other than zero"),
    (dict(values=[1.0, 2.0], scale=ltl.inverse.Positive(-1.0)), "Expected the start of scale to be positive"),
    (dict(values=[1.0, 2.0], offset="free"), "offset as real numbers"),
    (dict(values=[1.0, 2.0], background=np.zeros(2)), "Expected background as finite numbers, not all zero"),
    (dict(values=[1.0, 2.0], operator=np.ones(3)), r"Expected an operator as a matrix \(M, V\)"),
    (dict(values=[1.0, 2.0], operator=np.zeros((2, 3))), "Row 0 of the operator has no entries"),
    (dict(values=[1.0, 2.0], operator=np.ones((2, 3)), vertices=[0, 1]), "either vertices= or operator="),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "message"), REFUSED)
def test_data_that_cannot_be_used_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        ltl.Observations(**arguments)


def test_transforms_of_parameters_have_no_start_of_their_own():
    with pytest.raises(ValueError, match="Expected a transform without a start"):
        ltl.fit(lambda p: p * jnp.ones(3), 1.0, ltl.Observations(np.ones(3)), transforms=ltl.inverse.Positive(2.0))
