"""Geodesic distance: exact where a surface unfolds into a plane, first order elsewhere, better than the heat method."""

import sys

import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl

potpourri3d = pytest.importorskip("potpourri3d")
igl = pytest.importorskip("igl")


def heat_method(mesh, sources):
    solver = potpourri3d.MeshHeatMethodDistanceSolver(mesh.vertices, mesh.faces)
    return np.asarray(solver.compute_distance_multisource([int(source) for source in np.atleast_1d(sources)]))


def rolled_strip(length):
    """A strip of width 1 rolled up with a pitch of 1, with edges of length a quarter.

    Returns:
        The mesh, the length of its edge from the first vertex to the end, and the vertex at the end.
    """
    angle = np.linspace(0, 60, 200_001)
    radius = 0.5 + angle / (2 * np.pi)
    curve = radius * np.exp(1j * angle)
    along = np.append(0, np.cumsum(np.abs(np.diff(curve))))
    curve = np.interp(np.linspace(0, length, round(4 * length) + 1), along, angle)
    curve = (0.5 + curve / (2 * np.pi)) * np.exp(1j * curve)
    count = len(curve)
    vertices = np.concatenate(
        [np.stack([curve.real, curve.imag, np.full(count, z)], axis=1) for z in np.linspace(0, 1, 5)]
    )
    first = (np.arange(4)[:, None] * count + np.arange(count - 1)).ravel()
    faces = [[first, first + 1, first + count + 1], [first, first + count + 1, first + count]]
    return ltl.Mesh(vertices, np.concatenate(np.moveaxis(faces, 1, 2))), np.abs(np.diff(curve)).sum(), count - 1


@pytest.mark.parametrize("length", [15.6, 46.7, pytest.param(93.3, marks=pytest.mark.slow)])
def test_the_distance_along_a_rolled_strip_is_its_length(length):
    mesh, exact, end = rolled_strip(length)
    assert float(ltl.geodesic_distance(ltl.Surface.from_mesh(mesh), 0)[end]) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("scheme", [ltl.Monotone(), ltl.Polynomial(), ltl.Paper()], ids=lambda scheme: str(scheme)[:8])
def test_distances_in_the_plane_are_exact_on_any_mesh(scheme):
    mesh = ltl.shapes.jittered(ltl.shapes.square(n=12), 0.3, seed=1)
    exact = np.linalg.norm(mesh.vertices - mesh.vertices[0], axis=1)
    distance = ltl.geodesic_distance(ltl.Surface.from_mesh(mesh, scheme), 0)
    np.testing.assert_allclose(distance, exact, atol=1e-12)


@pytest.mark.parametrize(
    "make",
    [
        ltl.shapes.icosphere,
        lambda n: ltl.shapes.jittered_sphere(n, 0.4, seed=0),
        lambda n: ltl.shapes.random_sphere(10 * 4**n + 2, seed=0),
    ],
    ids=["icosphere", "jittered", "random"],
)
def test_on_spheres_the_mean_error_is_of_first_order_and_smaller_than_that_of_the_heat_method(make):
    errors, mean_lengths = [], []
    for level in (2, 3, 4):
        mesh = make(level)
        exact = np.arccos(np.clip(mesh.vertices @ mesh.vertices[0], -1, 1))
        errors.append(np.mean(np.abs(ltl.geodesic_distance(ltl.Surface.from_mesh(mesh), 0) - exact)))
        mean_lengths.append(mesh.mesh_size)
    assert np.polyfit(np.log(mean_lengths), np.log(errors), 1)[0] > 0.9
    assert errors[-1] < 0.5 * np.mean(np.abs(heat_method(mesh, 0) - exact))


@pytest.mark.parametrize("name", ["spot_low.obj", "bunny_closed.obj", "hand_open.obj"])
def test_on_scans_the_error_is_a_tenth_of_that_of_the_heat_method(name, real_mesh):
    mesh = ltl.load_mesh(real_mesh(name))
    surface = ltl.Surface.from_mesh(mesh)
    exact = ltl.geodesic_distance(surface, 0, method="exact")
    error = np.abs(ltl.geodesic_distance(surface, 0) - exact)
    heat_error = np.abs(heat_method(mesh, 0) - exact)
    assert error.mean() < 0.1 * heat_error.mean()
    assert error.max() < 0.2 * heat_error.max()


@pytest.mark.parametrize("kind", ["two", "five", "boundary", "disc"])
@pytest.mark.parametrize("n", [16, pytest.param(48, marks=pytest.mark.slow)])
def test_in_the_plane_several_sources_give_the_distance_from_the_nearest_to_a_tenth_of_an_edge(kind, n):
    mesh = ltl.shapes.jittered(ltl.shapes.square(n=n), 0.3, seed=1)
    x = mesh.vertices[:, :2]
    sources = {
        "two": np.random.default_rng(2).choice(len(x), 2, replace=False),
        "five": np.random.default_rng(3).choice(len(x), 5, replace=False),
        "boundary": np.flatnonzero(np.minimum(x, 1 - x).min(axis=1) < 1e-9),
        "disc": np.flatnonzero(np.linalg.norm(x - 0.5, axis=1) < 0.2),
    }[kind]
    exact = np.linalg.norm(x[:, None] - x[None, sources], axis=2).min(axis=1)
    error = np.abs(np.asarray(ltl.geodesic_distance(ltl.Surface.from_mesh(mesh), sources)) - exact)
    assert not error[sources].any()
    assert error.max() < 0.1 * mesh.mesh_size
    assert error.mean() < 0.01 * np.mean(np.abs(heat_method(mesh, sources) - exact))


@pytest.mark.parametrize("is_outside", [
    lambda x: (np.abs(x - 0.5) < 0.2).all(axis=1),
    lambda x: np.linalg.norm(x - 0.5, axis=1) < 0.2,
    lambda x: (x > 0.5).all(axis=1),
], ids=["square hole", "round hole", "L"])  # fmt: skip
@pytest.mark.parametrize("num_sources", [1, 3])
def test_paths_bend_at_holes_and_corners(is_outside, num_sources):
    for n in (10, 30):
        square = ltl.shapes.jittered(ltl.shapes.square(n=n), 0.3, seed=2)
        inside = square.faces[~is_outside(square.vertices[square.faces].mean(axis=1)[:, :2])]
        used, faces = np.unique(inside, return_inverse=True)
        mesh = ltl.Mesh(square.vertices[used], faces.reshape(inside.shape), repair=True)
        surface = ltl.Surface.from_mesh(mesh)
        sources = np.random.default_rng(3).choice(mesh.num_vertices, num_sources, replace=False)
        error = ltl.geodesic_distance(surface, sources) - ltl.geodesic_distance(surface, sources, "exact")
        assert np.abs(error).max() < 0.33 * mesh.mesh_size


def test_paths_bend_around_the_end_of_a_slit():
    square = ltl.shapes.jittered(ltl.shapes.square(n=20), 0.3, seed=2)
    x, y = square.vertices[square.faces].mean(axis=1)[:, :2].T
    faces = square.faces[~((np.abs(x - 0.5) < 0.06) & (y > 0.3))]
    used, faces = np.unique(faces, return_inverse=True)
    mesh = ltl.Mesh(square.vertices[used], faces.reshape(-1, 3), repair=True)
    surface = ltl.Surface.from_mesh(mesh)
    source = np.random.default_rng(3).choice(mesh.num_vertices, 1, replace=False)
    error = ltl.geodesic_distance(surface, source) - ltl.geodesic_distance(surface, source, "exact")
    assert np.abs(error).max() < 0.33 * mesh.mesh_size


def test_distances_do_not_depend_on_the_numbering():
    mesh = ltl.shapes.jittered_torus(18, 9, 0.3, seed=0)
    order = np.random.default_rng(0).permutation(mesh.num_vertices)
    new_index = np.argsort(order)
    renumbered_mesh = ltl.Mesh(mesh.vertices[order], new_index[mesh.faces])
    distance = ltl.geodesic_distance(ltl.Surface.from_mesh(mesh), np.array([0, 7]))
    renumbered = ltl.geodesic_distance(ltl.Surface.from_mesh(renumbered_mesh), new_index[[0, 7]])
    np.testing.assert_allclose(renumbered[new_index], distance, atol=1e-9)


def test_exact_distances_are_those_of_the_polyhedron():
    mesh = ltl.shapes.icosphere(3)
    distance = ltl.geodesic_distance(ltl.Surface.from_mesh(mesh), 0, method="exact")
    angle = np.arccos(np.clip(mesh.vertices @ mesh.vertices[0], -1, 1))
    # The polyhedron lies inside the sphere, so its paths are shorter, by a second-order amount.
    assert (distance <= angle + 1e-12).all()
    assert np.abs(distance - angle).max() < 0.01


def test_exact_distances_without_libigl_say_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "igl", None)
    with pytest.raises(ImportError, match="pip install libigl"):
        ltl.geodesic_distance(ltl.Surface.from_mesh(ltl.shapes.icosphere(1)), 0, method="exact")


def test_the_distance_is_that_from_the_nearest_source_and_infinite_on_a_component_without_one():
    mesh = ltl.shapes.icosphere(3)
    surface = ltl.Surface.from_mesh(mesh)
    poles = [int(np.argmax(mesh.vertices[:, 2])), int(np.argmin(mesh.vertices[:, 2]))]
    exact = np.arccos(np.clip(np.abs(mesh.vertices[:, 2]), 0, 1))
    assert np.max(np.abs(ltl.geodesic_distance(surface, poles) - exact)) < 0.04
    count = mesh.num_vertices
    two = ltl.Mesh(np.concatenate([mesh.vertices, mesh.vertices + 5]), np.concatenate([mesh.faces, mesh.faces + count]))
    pair, single = ltl.Surface.from_mesh(two), ltl.geodesic_distance(surface, 0)
    for method in ("marching", "exact"):
        distance = ltl.geodesic_distance(pair, 0, method=method)
        np.testing.assert_allclose(distance[:count], ltl.geodesic_distance(surface, 0, method=method), atol=1e-9)
        assert jnp.isinf(distance[count:]).all()
    both = ltl.geodesic_distance(pair, [0, count])
    np.testing.assert_allclose(both, np.tile(single, 2), atol=1e-9)


@pytest.mark.parametrize("sources", [[10**6], [-1], []])
def test_sources_that_are_not_on_the_surface_are_refused(sources):
    with pytest.raises(ValueError, match="source vertices from 0"):
        ltl.geodesic_distance(ltl.Surface.from_mesh(ltl.shapes.icosphere(1)), np.array(sources, int))
