"""Mesh smoothing, ridges and the shape index: accuracy, derivatives, and error messages."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl
from ltljax import imaging

# Noisy meshes have a few inconsistent rows.
pytestmark = pytest.mark.filterwarnings("ignore::ltljax.errors.InconsistentRowsWarning")


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(2))


def noisy(mesh, amount=0.2):
    """A mesh with noise along its normals, of an amount given in mean edge lengths."""
    normals = np.asarray(ltl.Surface.from_mesh(mesh).normals)
    shift = amount * mesh.mesh_size * np.random.default_rng(0).normal(size=(mesh.num_vertices, 1))
    return ltl.Mesh(mesh.vertices + shift * normals, mesh.faces)


def face_normals(vertices, faces):
    a, b, c = np.moveaxis(np.asarray(vertices)[faces], 1, 0)
    doubled = np.cross(b - a, c - a)
    return doubled / np.linalg.norm(doubled, axis=1, keepdims=True)


def degrees_between(p, q):
    return np.degrees(np.arccos(np.clip(np.sum(p * q, axis=1), -1, 1)))


def cube(n):
    """The unit cube with n squares along each edge."""
    t = np.linspace(0, 1, n + 1)
    u, v = (a.ravel() for a in np.meshgrid(t, t, indexing="ij"))
    k = np.arange(len(u)).reshape(n + 1, n + 1)
    a, b, c, d = (part.ravel() for part in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    outward = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    vertices, faces = [], []
    for axis in range(3):
        for side in (0, 1):
            points = np.zeros((len(u), 3))
            points[:, axis], points[:, (axis + 1) % 3], points[:, (axis + 2) % 3] = side, u, v
            faces.append((outward if side else outward[:, ::-1]) + len(u) * len(vertices))
            vertices.append(points)
    vertices, faces = np.concatenate(vertices), np.concatenate(faces)
    _, first, index = np.unique(np.round(n * vertices).astype(int), axis=0, return_index=True, return_inverse=True)
    return ltl.Mesh(vertices[first], index.ravel()[faces])


SPHERES = {
    "icosphere": lambda: ltl.shapes.icosphere(3, radius=2.0),
    "jittered": lambda: ltl.shapes.jittered_sphere(3, 0.3, seed=0).scaled(2.0),
    "fine": lambda: ltl.shapes.icosphere(4, radius=2.0),
    "random": lambda: ltl.shapes.random_sphere(642, seed=0).scaled(2.0),
}


@functools.cache
def sphere_of_radius_two(name):
    return ltl.Surface.from_mesh(SPHERES[name]())


@pytest.mark.parametrize(
    "name", ["icosphere", *(pytest.param(name, marks=pytest.mark.slow) for name in ("jittered", "fine", "random"))]
)
def test_a_sphere_shrinks_by_mean_curvature_flow_at_the_exact_rate(name):
    surface = sphere_of_radius_two(name)
    radii = jnp.linalg.norm(imaging.mean_curvature_flow(surface, 0.75), axis=1)
    np.testing.assert_allclose(radii, np.sqrt(4 - 4 * 0.75), rtol=2.5e-3)


def test_mean_curvature_flow_is_second_order_in_time():
    surface = sphere_of_radius_two("icosphere")
    coarse = imaging.mean_curvature_flow(surface, 0.75)
    half = surface.with_vertices(imaging.mean_curvature_flow(surface, 0.375))
    fine = imaging.mean_curvature_flow(half, 0.375)
    errors = [float(jnp.abs(jnp.mean(jnp.linalg.norm(x, axis=1)) - 1)) for x in (coarse, fine)]
    assert np.log2(errors[0] / errors[1]) > 1.8
    assert errors[1] < 5e-4


def test_mean_curvature_flow_beyond_the_collapse_raises_or_is_nan():
    with pytest.raises(ltl.SolveError, match="collapsed"):
        imaging.mean_curvature_flow(sphere_of_radius_two("icosphere"), 1.2)
    assert jnp.isnan(imaging.mean_curvature_flow(sphere_of_radius_two("icosphere"), 1.2, throw=False)).all()


@pytest.mark.slow
def test_mean_curvature_flow_beyond_the_collapse_is_nan_inside_jit(sphere):
    flow = jax.jit(lambda time: imaging.mean_curvature_flow(sphere, time, steps=4))
    assert jnp.isnan(flow(0.5)).all()
    assert jnp.isfinite(flow(0.01)).all()


def test_fairing_that_was_not_solved_is_nan_inside_jit_and_raises_outside(sphere):
    fair = jax.jit(lambda strength: imaging.fair(sphere, strength))
    assert jnp.isnan(fair(jnp.inf)).all()
    assert jnp.isfinite(fair(0.1)).all()
    with pytest.raises(ltl.SolveError, match="not solved"):
        imaging.fair(sphere, jnp.inf)


@pytest.mark.slow
def test_mean_curvature_flow_is_as_accurate_in_float32():
    surface = ltl.Surface.from_mesh(SPHERES["icosphere"](), dtype=jnp.float32)
    vertices = imaging.mean_curvature_flow(surface, 0.75)
    assert vertices.dtype == jnp.float32
    np.testing.assert_allclose(jnp.linalg.norm(vertices, axis=1), 1, rtol=2.5e-3)


@pytest.mark.parametrize("method", ["fair", pytest.param("flow", marks=pytest.mark.slow)])
def test_boundary_vertices_are_fixed(method):
    mesh = ltl.shapes.disk(rings=8)
    rim = mesh.boundary_vertices
    height = 0.3 * (1 - np.sum(mesh.vertices**2, axis=1))
    bent = ltl.Mesh(np.column_stack([mesh.vertices[:, :2], height]), mesh.faces)
    surface = ltl.Surface.from_mesh(bent)
    if method == "flow":
        results = [imaging.mean_curvature_flow(surface, 0.5, steps=10)]
    else:
        results = [imaging.fair(surface, 10.0), imaging.fair(surface, 1.0, order=2)]
    for x in results:
        np.testing.assert_array_equal(x[rim], bent.vertices[rim])
        assert jnp.max(jnp.abs(x[:, 2])) < 0.1


@pytest.mark.parametrize("method", ["order 1", *(pytest.param(m, marks=pytest.mark.slow) for m in ("order 2", "flow"))])
def test_a_noisy_bunny_is_smoothed_and_keeps_its_volume(method, real_mesh):
    clean = ltl.load_mesh(real_mesh("bunny_closed.obj"))
    mesh, h = noisy(clean), clean.mesh_size
    surface = ltl.Surface.from_mesh(mesh)
    smoothed, error_ratio = {
        "flow": lambda: (imaging.mean_curvature_flow(surface, 0.25 * h**2, steps=8, keep_volume=True), 0.8),
        "order 1": lambda: (imaging.fair(surface, 0.25 * h**2, keep_volume=True), 0.8),
        "order 2": lambda: (imaging.fair(surface, 0.25 * h**4, order=2, keep_volume=True), 0.7),
    }[method]()
    before, after = (float(imaging.enclosed_volume(x, mesh.faces)) for x in (mesh.vertices, smoothed))
    assert abs(after / before - 1) < 1e-9
    assert abs(after / float(imaging.enclosed_volume(clean.vertices, mesh.faces)) - 1) < 0.01
    errors = [np.sqrt(np.mean((np.asarray(x) - clean.vertices) ** 2)) for x in (mesh.vertices, smoothed)]
    assert errors[1] < error_ratio * errors[0]
    reference = face_normals(clean.vertices, mesh.faces)
    angles = [degrees_between(face_normals(x, mesh.faces), reference).mean() for x in (mesh.vertices, smoothed)]
    assert angles[1] < 0.65 * angles[0]


def test_each_component_keeps_its_own_volume():
    ball = ltl.shapes.icosphere(2)
    vertices = np.concatenate([ball.vertices, 0.5 * ball.vertices + 3])
    mesh = ltl.Mesh(vertices, np.concatenate([ball.faces, ball.faces + ball.num_vertices]))
    faired = imaging.fair(ltl.Surface.from_mesh(mesh), 0.1, keep_volume=True)
    # Without keep_volume the smaller sphere would shrink by half.
    np.testing.assert_allclose(faired, mesh.vertices, atol=1e-2)


def test_fairing_divides_a_harmonic_by_the_documented_factor(sphere):
    z = sphere.vertices[:, 2:]
    # The position on a unit sphere is a harmonic of degree one: Delta X = -2 X.
    np.testing.assert_allclose(imaging.fair(sphere, 0.3)[:, 2:], z / (1 + 2 * 0.3), atol=2e-3)
    np.testing.assert_allclose(imaging.fair(sphere, 0.3, order=2)[:, 2:], z / (1 + 4 * 0.3), atol=2e-3)
    with_multigrid = imaging.fair(sphere, 0.3, order=2, preconditioner=ltl.solvers.multigrid(sphere))
    np.testing.assert_allclose(with_multigrid, imaging.fair(sphere, 0.3, order=2), atol=1e-8)
    batch = jax.vmap(lambda strength: imaging.fair(sphere, strength, throw=False))(jnp.array([0.3, 0.6]))
    np.testing.assert_allclose(batch[1], imaging.fair(sphere, 0.6), atol=1e-8)


@pytest.mark.parametrize(
    "method", ["order 1", *(pytest.param(method, marks=pytest.mark.slow) for method in ("order 2", "flow"))]
)
def test_smoothed_positions_have_the_right_derivatives(sphere, method):
    x = sphere.vertices + 0.05 * jnp.sin(3 * sphere.vertices)

    def loss(p):
        moved, amount = sphere.with_vertices(p[0]), p[1]
        if method == "flow":
            smooth = imaging.mean_curvature_flow(moved, amount, steps=2, keep_volume=True, throw=False)
        else:
            smooth = imaging.fair(moved, amount, order=1 if method == "order 1" else 2, throw=False)
        return jnp.sum(jnp.sin(2 * smooth + 1))

    check = ltl.inverse.check_gradient(loss, (x, 0.1))
    assert check.passed, check


def test_fairing_has_the_same_derivatives_in_both_modes(sphere):
    def loss(strength):
        return jnp.sum(jnp.sin(2 * imaging.fair(sphere, strength, throw=False) + 1))

    np.testing.assert_allclose(jax.jvp(loss, (0.1,), (1.0,))[1], jax.grad(loss)(0.1), rtol=1e-6)


@pytest.fixture(scope="module")
def noisy_cube():
    """A cube, the cube with noise, and the surface of the latter."""
    clean = cube(12)
    mesh = noisy(clean)
    return clean, mesh, ltl.Surface.from_mesh(mesh)


def test_normal_filtering_denoises_a_cube_better_than_fairing(noisy_cube):
    clean, mesh, surface = noisy_cube
    h = clean.mesh_size
    reference = face_normals(clean.vertices, mesh.faces)

    def error(vertices):
        return degrees_between(face_normals(vertices, mesh.faces), reference).mean()

    best_fairing = min(error(imaging.fair(surface, share * h**4, order=2)) for share in (0.1, 0.3, 0.5, 1.0))
    filtered = error(imaging.filter_normals(surface))
    assert filtered < 0.25 * error(mesh.vertices)
    assert filtered < 0.5 * best_fairing
    assert error(imaging.filter_normals(surface, normal_iterations=20)) < 0.1 * error(mesh.vertices)


def test_edges_of_a_cube_are_kept_up_to_the_documented_similarity(noisy_cube):
    clean, mesh, surface = noisy_cube
    reference, corners = face_normals(clean.vertices, mesh.faces), clean.vertices[mesh.faces]
    # Faces beside an edge have two corners that lie on two sides of the cube each.
    is_beside = (np.sum((corners < 1e-9) | (corners > 1 - 1e-9), axis=2) > 1).sum(axis=1) > 1
    before, beside = float(imaging.enclosed_volume(mesh.vertices, mesh.faces)), {}
    for similarity in (0.3, 0.4, 0.5, 0.7):
        x = imaging.filter_normals(surface, similarity, normal_iterations=20)
        beside[similarity] = degrees_between(face_normals(x, mesh.faces), reference)[is_beside].mean()
        if similarity < 0.5:
            assert abs(float(imaging.enclosed_volume(x, mesh.faces)) / before - 1) < 1e-3
    assert max(beside[0.3], beside[0.4]) < 3
    assert 4 < beside[0.5] < 15
    assert beside[0.7] > 20


@pytest.mark.slow
def test_normal_filtering_has_the_right_derivatives(sphere):
    x = sphere.vertices + 0.05 * jnp.sin(7 * sphere.vertices)

    def loss(p):
        return jnp.sum(imaging.filter_normals(sphere.with_vertices(p[0]), p[1], normal_iterations=2) ** 3)

    check = ltl.inverse.check_gradient(loss, (x, 0.35))
    assert check.passed, check


def test_ridges_and_valleys_lie_where_a_sheet_bends_most():
    mesh = ltl.shapes.jittered(ltl.shapes.square(n=40), 0.1, seed=0)
    x, y, _ = mesh.vertices.T
    centre, distance = x.mean(), np.abs(x - x.mean())
    inside = (distance < 0.4) & (np.abs(y - y.mean()) < 0.4)
    for sign, kind in ((-1, "ridge"), (1, "valley")):
        z = sign * np.sqrt((x - centre) ** 2 + 0.15**2)
        lines = imaging.ridges(ltl.Surface.from_mesh(ltl.Mesh(np.stack([x, y, z], axis=1), mesh.faces)))
        present, absent = (np.asarray(a) for a in (lines.ridge, lines.valley)[::-sign])
        assert 0 <= present.min() < present.max() <= 1
        assert present[inside & (distance < 0.01)].min() > 0.5, kind
        assert present[inside & (distance > 0.1)].max() < 0.1, kind
        assert absent[inside].max() < 0.1, kind


def test_the_shape_index_of_a_sphere_and_a_torus():
    index = imaging.shape_index(ltl.Surface.from_mesh(ltl.shapes.icosphere(3)))
    np.testing.assert_allclose(index, 1, atol=0.02)
    mesh = ltl.shapes.torus(2.0, 1.0, 48, 24)
    index = np.asarray(imaging.shape_index(ltl.Surface.from_mesh(mesh)))
    radius = np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1])
    k = np.stack([np.ones(len(radius)), (radius - 2) / radius])
    np.testing.assert_allclose(index, 2 / np.pi * np.arctan2(k[0] + k[1], k[0] - k[1]), atol=0.05)


def test_smoothed_positions_have_the_float_type_of_the_surface():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2), dtype=jnp.float32)
    for x in (imaging.fair(surface, 0.1, keep_volume=True), imaging.filter_normals(surface)):
        assert x.dtype == jnp.float32
        assert jnp.isfinite(x).all()


def test_invalid_arguments_raise_clear_errors(sphere):
    disk, cases = ltl.Surface.from_mesh(ltl.shapes.disk(rings=3)), []
    for smooth in (imaging.mean_curvature_flow, imaging.fair):
        cases += [
            (lambda smooth=smooth: smooth(disk, 0.1, keep_volume=True), "closed surface .* found 1 boundary loop,"),
            (lambda smooth=smooth: smooth(sphere, 0.0), "positive .* found 0"),
            (lambda smooth=smooth: smooth(sphere, -1.0), "positive .* found -1"),
        ]
    cases += [
        (lambda: imaging.mean_curvature_flow(sphere, 0.1, steps=0), "one step, found steps=0"),
        (lambda: imaging.filter_normals(sphere, 0.0), "positive similarity"),
        (lambda: imaging.filter_normals(sphere, normal_iterations=0), "at least one iteration"),
        (lambda: imaging.ridges(sphere, 0.0), "width to be finite and positive, found 0"),
        (lambda: imaging.ridges(sphere, -1.0), "width to be finite and positive, found -1"),
    ]
    for call, message in cases:
        with pytest.raises(ValueError, match=message):
            call()
