"""Mesh smoothing, streamlines and line integral convolution: accuracy, derivatives, and error messages."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl
from ltljax import imaging
from ltljax._imaging.flow.tracing import mean_edge
from ltljax._imaging.flow.views import look

# Noisy meshes have a few inconsistent rows.
pytestmark = pytest.mark.filterwarnings("ignore::ltljax.errors.InconsistentRowsWarning")


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.icosphere(2))


def tangent(surface, X):
    return X - jnp.sum(X * surface.normals, axis=1, keepdims=True) * surface.normals


def rotation(surface):
    """The rotation about the third axis."""
    x, y, z = surface.vertices.T
    return tangent(surface, jnp.stack([-y, x, 0 * z], axis=1))


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


@pytest.mark.parametrize("method", ["fair", pytest.param("flow", marks=pytest.mark.slow)])
def test_smoothed_positions_have_the_right_derivatives(sphere, method):
    x = sphere.vertices + 0.05 * jnp.sin(3 * sphere.vertices)

    def loss(p):
        moved, amount = sphere.with_vertices(p[0]), p[1]
        if method == "flow":
            smooth = imaging.mean_curvature_flow(moved, amount, steps=2, keep_volume=True, throw=False)
        else:
            smooth = imaging.fair(moved, amount, order=2, throw=False)
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


@pytest.mark.parametrize(
    "make",
    [
        ltl.shapes.icosphere,
        pytest.param(lambda level: ltl.shapes.jittered_sphere(level, 0.5, seed=0), marks=pytest.mark.slow),
    ],
    ids=["icosphere", "jittered"],
)
def test_streamlines_of_a_rotation_stay_on_circles_to_second_order(make):
    errors = []
    for level in (3, 5):
        surface = ltl.Surface.from_mesh(make(level))
        inside = np.flatnonzero(np.abs(np.asarray(surface.vertices)[:, 2]) < 0.95)
        seeds = np.random.default_rng(0).choice(inside, 64, replace=False)
        lines = imaging.streamlines(surface, rotation(surface), seeds, 2 * np.pi)
        assert lines.is_valid.all()
        heights = lines.points[..., 2] / jnp.linalg.norm(lines.points, axis=-1)
        errors.append(float(jnp.sqrt(jnp.mean((heights - heights[:, :1]) ** 2))))
    assert np.log2(errors[0] / errors[1]) / 2 > 1.9
    assert errors[-1] < 4e-5


@pytest.mark.parametrize("share", [40, *(pytest.param(share, marks=pytest.mark.slow) for share in (0.5, 6))])
def test_lines_have_their_full_length_whatever_the_step(share):
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(4))
    X, x = rotation(surface), surface.vertices
    step = share * mean_edge(surface)
    seeds = jnp.argsort(jnp.abs(x[:, 2]))[:40]
    lines = imaging.streamlines(surface, X, seeds, 2.0, step)
    assert lines.is_valid.all()
    ends = x[seeds] @ jnp.array([[np.cos(2), np.sin(2), 0], [-np.sin(2), np.cos(2), 0], [0, 0, 1]])
    np.testing.assert_allclose(lines.points[:, -1], ends, atol=0.02)
    convolved = imaging.line_integral_convolution(surface, X, noise=x[:, 0], length=2.0, step=step, window="box")
    # The mean of cos(angle + s) over s from -2 to 2.
    np.testing.assert_allclose(convolved[seeds], np.sin(2) / 2 * x[seeds, 0], atol=0.01)


def test_streamlines_end_at_boundaries_and_at_zeros_of_the_field():
    mesh = ltl.shapes.jittered(ltl.shapes.disk(rings=8), 0.2, seed=0)
    surface = ltl.Surface.from_mesh(mesh)
    seeds = np.flatnonzero(np.hypot(*mesh.vertices[:, :2].T) < 0.5)[:20]
    to_right = jnp.zeros_like(surface.vertices).at[:, 0].set(1)
    lines = imaging.streamlines(surface, to_right, seeds, 2.0, 0.1)
    begin = surface.vertices[seeds]
    distance = jnp.linspace(0, 2, 21)
    straight = begin[:, None] + distance[None, :, None] * jnp.array([1.0, 0, 0]).reshape(1, 1, 3)
    np.testing.assert_allclose(jnp.where(lines.is_valid[..., None], lines.points - straight, 0), 0, atol=1e-8)
    np.testing.assert_allclose(lines.points[..., 1], jnp.broadcast_to(begin[:, None, 1], (20, 21)), atol=1e-8)
    room = jnp.sqrt(1 - begin[:, 1] ** 2) - begin[:, 0]
    np.testing.assert_allclose(jnp.sum(lines.is_valid, axis=1), jnp.floor(room / 0.1) + 1, atol=1)
    assert not lines.is_valid[:, -1].any()
    # The field vanishes in the left half.
    half = jnp.where(surface.vertices[:, :1] < 0, 0, to_right)
    ended = imaging.streamlines(surface, half, seeds, 2.0, 0.1)
    is_left = mesh.vertices[seeds, 0] < -0.3
    assert not ended.is_valid[is_left, 1:].any()
    np.testing.assert_allclose(ended.points[is_left, -1], begin[is_left], atol=1e-6)


def test_streamlines_of_an_undirected_field_continue_straight_even_around_sharp_edges():
    mesh = cube(6)
    surface = ltl.Surface.from_mesh(mesh)
    normals = surface.normals
    X = jnp.stack([-normals[:, 1], normals[:, 0], 0 * normals[:, 0]], axis=1)
    sides = np.linalg.norm(np.asarray(X), axis=1) > 0.9
    heights = mesh.vertices[:, 2]
    seeds = np.flatnonzero(sides & (heights > 0.2) & (heights < 0.8))[:30]
    directed = imaging.streamlines(surface, X, seeds, 4.0, 0.05)
    assert directed.is_valid.all()
    np.testing.assert_allclose(directed.points[..., 2], np.tile(heights[seeds, None], 81), atol=1e-8)
    np.testing.assert_allclose(directed.points[:, -1], directed.points[:, 0], atol=1e-6)
    flips = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], size=(mesh.num_vertices, 1)))
    lines = imaging.streamlines(surface, flips * X, seeds, 4.0, 0.05, is_directed=False)
    reverse = imaging.streamlines(surface, -X, seeds, 4.0, 0.05)
    expected = jnp.where((flips[seeds] > 0)[:, :, None], directed.points, reverse.points)
    np.testing.assert_allclose(lines.points, expected, atol=1e-6)


@pytest.mark.slow
def test_streamlines_are_differentiable_in_the_field_and_convolution_in_forward_mode(sphere):
    x = sphere.vertices
    seeds = (jnp.arange(10), jnp.full((10, 3), 1 / 3))

    def loss(turn):
        X = tangent(sphere, jnp.stack([-x[:, 1], x[:, 0], turn + 0.3 * x[:, 0]], axis=1))
        return jnp.sum(jnp.sin(imaging.streamlines(sphere, X, seeds, 0.7, 0.1).points))

    check = ltl.inverse.check_gradient(loss, 0.3, step=1e-3)
    assert check.passed, check

    def convolved(noise):
        return imaging.line_integral_convolution(sphere, rotation(sphere), noise=noise, window="box")

    # A linear function is its own derivative.
    noise = jax.random.normal(jax.random.key(1), (sphere.num_vertices,))
    np.testing.assert_allclose(jax.jvp(convolved, (noise,), (noise,))[1], convolved(noise), atol=1e-12)


@pytest.mark.slow
def test_line_integral_convolution_shows_circles():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(5))
    X = rotation(surface)
    u = imaging.line_integral_convolution(surface, X)
    slope = ltl.gradient(surface, u)
    steepness = jnp.linalg.norm(slope, axis=1)
    speed = jnp.linalg.norm(X, axis=1)
    along = jnp.abs(jnp.sum(slope * X, axis=1)) / jnp.maximum(steepness * speed, 1e-12)
    angle = jnp.degrees(jnp.arcsin(jnp.clip(along, 0, 1)))
    weight = jnp.where(speed > 0.05, steepness, 0)
    assert jnp.sum(angle * weight) / jnp.sum(weight) < 8
    # At seven vertices in eight, the gradient is large enough to have a clear direction.
    assert jnp.mean(angle[weight > 0.25 * jnp.mean(steepness)]) < 10


def test_a_picture_of_a_rotation_shows_circles(tmp_path):
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(4), dtype=jnp.float32)
    pytest.importorskip("imageio")
    path = tmp_path / "lines.png"
    image, mask = imaging.lic_picture(surface, rotation(surface), path, view=(0, 0, 1), resolution=300)
    assert path.stat().st_size > 10_000
    assert image.shape == mask.shape == (300, 300)
    assert image.dtype == np.uint8
    assert (image[~mask] == 255).all()
    radius = 300 * (1 - 2 * 0.04) / 2
    assert abs(mask.sum() / (np.pi * radius**2) - 1) < 0.01
    row, column = np.mgrid[:300, :300]
    x, y = (column - 149.5) / radius, (149.5 - row) / radius
    down, right = np.gradient(image.astype(float))
    steepness, r = np.hypot(down, right), np.hypot(x, y)
    # At the rim circles are seen too obliquely, and near the pole they are smaller than pixels.
    shown = (r < 0.9) & (r > 0.05)
    angle = np.degrees(np.arcsin(np.clip(np.abs(-y * right - x * down) / np.maximum(steepness * r, 1e-12), 0, 1)))
    assert np.sum((angle * steepness)[shown]) / np.sum(steepness[shown]) < 10
    assert angle[shown & (steepness > 0.5 * steepness[shown].mean())].mean() < 10


def test_line_integral_convolution_is_linear_in_the_noise_and_differentiable(sphere):
    X, noise = rotation(sphere), jax.random.normal(jax.random.key(1), (sphere.num_vertices,))

    def convolved(noise):
        return imaging.line_integral_convolution(sphere, X, noise=noise)

    np.testing.assert_allclose(convolved(0 * noise + 3), 3, rtol=1e-12)
    check = ltl.inverse.check_gradient(lambda noise: jnp.sum(convolved(noise) ** 2), noise)
    assert check.passed, check
    # A function of the height is constant along a line.
    heights = sphere.vertices[:, 2]
    inside = jnp.abs(heights) < 0.9
    np.testing.assert_allclose(jnp.where(inside, convolved(heights) - heights, 0), 0, atol=0.03)


def test_flow_and_mesh_functions_return_the_float_type_of_the_surface():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2), dtype=jnp.float32)
    points = (jnp.arange(50), jnp.full((50, 3), 1 / 3))
    values = imaging.line_integral_convolution(surface, rotation(surface), points=points)
    assert values.shape == (50,)
    assert values.dtype == jnp.float32
    assert 0 < values.min() < values.max() < 1
    noise = imaging.solid_noise(jax.random.key(2), 0.1)
    values_of_other_noise = imaging.line_integral_convolution(surface, rotation(surface), noise=noise, points=points)
    assert not jnp.allclose(values, values_of_other_noise)
    for x in (imaging.fair(surface, 0.1, keep_volume=True), imaging.filter_normals(surface)):
        assert x.dtype == jnp.float32
        assert jnp.isfinite(x).all()


def test_a_view_shows_the_nearest_face():
    front = np.array([[-1.0, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
    behind = 2 * front * np.array([1, 1, -1])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    visible = look(np.concatenate([front, behind]), faces, (0, 0, 1), (0, 1, 0), 50)
    points = np.einsum("nk,nkc->nc", visible.weights, np.concatenate([front, behind])[faces[visible.face]])
    row, column = np.nonzero(visible.mask)
    np.testing.assert_allclose(points[:, 0], (column - 24.5) * visible.pixel, atol=1e-9)
    np.testing.assert_allclose(points[:, 1], (24.5 - row) * visible.pixel, atol=1e-9)
    is_front = (np.abs(points[:, :2]) < 1 + 1e-9).all(axis=1)
    np.testing.assert_allclose(points[:, 2], np.where(is_front, 1, -2), atol=1e-9)


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


def test_invalid_arguments_raise_clear_errors(sphere):
    disk = ltl.Surface.from_mesh(ltl.shapes.disk(rings=3))
    X, cases = rotation(sphere), []
    for smooth in (imaging.mean_curvature_flow, imaging.fair):
        cases += [
            (lambda smooth=smooth: smooth(disk, 0.1, keep_volume=True), "closed surface .* found 1 boundary loop,"),
            (lambda smooth=smooth: smooth(sphere, 0.0), "positive .* found 0"),
            (lambda smooth=smooth: smooth(sphere, -1.0), "positive .* found -1"),
        ]
    for draw in (
        imaging.line_integral_convolution,
        imaging.lic_picture,
        lambda surface, X: imaging.streamlines(surface, X, jnp.array([0]), 1.0),
    ):
        cases += [
            (lambda draw=draw: draw(sphere, X[:7]), r"\(162, 3\), found shape \(7, 3\)"),
            (lambda draw=draw: draw(sphere, X + 0.1 * sphere.normals), "vertex 0 .*tangential"),
            (lambda draw=draw: draw(sphere, X.at[5].set(jnp.nan)), "finite vectors, .* at vertex 5"),
        ]
    third = jnp.full((1, 3), 1 / 3)
    cases += [
        (lambda: imaging.mean_curvature_flow(sphere, 0.1, steps=0), "one step, found steps=0"),
        (lambda: imaging.filter_normals(sphere, 0.0), "positive similarity"),
        (lambda: imaging.filter_normals(sphere, normal_iterations=0), "at least one iteration"),
        (lambda: imaging.streamlines(sphere, X, jnp.array([0, 162]), 1.0), "0 to 161, found vertex 162 at index 1"),
        (lambda: imaging.streamlines(sphere, X, jnp.array([-1]), 1.0), "found vertex -1 at index 0"),
        (lambda: imaging.streamlines(sphere, X, (jnp.array([320]), third), 1.0), "0 to 319, found face 320"),
        (lambda: imaging.streamlines(sphere, X, (jnp.array([0]), 2 * third), 1.0), "sum to one, found"),
        (lambda: imaging.streamlines(sphere, X, jnp.array([0]), -1.0), "positive length and step, found -1.0"),
        (lambda: imaging.line_integral_convolution(sphere, X, length=0.0), "positive length and step, found 0.0"),
        (lambda: imaging.line_integral_convolution(sphere, X, noise=jnp.ones(5)), r"\(162,\), found \(5,\)"),
        (lambda: imaging.lic_picture(sphere, X, view=(0, 1, 0)), "not along up"),
        (lambda: imaging.lic_picture(sphere, X, resolution=0), "positive resolution, found 0"),
        (lambda: imaging.lic_picture(sphere, X, shading=2.0), "from 0 to 1, found 2.0"),
        (lambda: imaging.lic_picture(sphere, X, length=0.0), "positive length of the lines, found 0.0"),
        (lambda: imaging.ridges(sphere, 0.0), "width to be finite and positive, found 0"),
        (lambda: imaging.ridges(sphere, -1.0), "width to be finite and positive, found -1"),
    ]
    for call, message in cases:
        with pytest.raises(ValueError, match=message):
            call()
    traced = jax.jit(lambda x: imaging.line_integral_convolution(sphere.with_vertices(x), X))
    with pytest.raises(ValueError, match="Give step= and length="):
        traced(sphere.vertices)
