"""Streamlines, line integral convolution and views: accuracy, derivatives, and error messages."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_graphics import cube

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


def test_line_integral_convolution_at_points_returns_the_float_type_of_the_surface():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2), dtype=jnp.float32)
    points = (jnp.arange(50), jnp.full((50, 3), 1 / 3))
    values = imaging.line_integral_convolution(surface, rotation(surface), points=points)
    assert values.shape == (50,)
    assert values.dtype == jnp.float32
    assert 0 < values.min() < values.max() < 1
    noise = imaging.solid_noise(jax.random.key(2), 0.1)
    values_of_other_noise = imaging.line_integral_convolution(surface, rotation(surface), noise=noise, points=points)
    assert not jnp.allclose(values, values_of_other_noise)


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


def test_invalid_arguments_raise_clear_errors(sphere):
    X, cases = rotation(sphere), []
    for draw in (
        imaging.line_integral_convolution,
        imaging.lic_picture,
        lambda surface, X: imaging.streamlines(surface, X, jnp.array([0]), 1.0),
    ):
        cases += [
            (lambda draw=draw: draw(sphere, X[:7]), r"\(162, 3\), found shape \(7, 3\)"),
            (lambda draw=draw: draw(sphere, X + 0.1 * sphere.normals), r"vertex 0\. .*tangential"),
            (lambda draw=draw: draw(sphere, X.at[5].set(jnp.nan)), "finite vectors, .* at vertex 5"),
        ]
    third = jnp.full((1, 3), 1 / 3)
    cases += [
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
    ]
    for call, message in cases:
        with pytest.raises(ValueError, match=message):
            call()
    traced = jax.jit(lambda x: imaging.line_integral_convolution(sphere.with_vertices(x), X))
    with pytest.raises(ValueError, match="Give step= and length="):
        traced(sphere.vertices)
