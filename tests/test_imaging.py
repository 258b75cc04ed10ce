"""Image filters on surfaces: range of values, derivatives, float types, transformations, and error messages."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from image_scenes import NOISE, Scene, excess, sphere_scene, spot_scene

import ltljax as ltl
from ltljax import imaging

# Two vertices of Spot have inconsistent rows.
pytestmark = pytest.mark.filterwarnings("ignore::ltljax.errors.InconsistentRowsWarning")


@pytest.fixture(scope="module")
def spot():
    return spot_scene()


@pytest.fixture(scope="module")
def sphere():
    return sphere_scene()


def patches(scene, columns=2):
    """Random patches of -1 and 1, whose wide flat parts at the extremes reveal any overshoot."""
    waves = np.random.default_rng(0).normal(size=(len(scene.x), columns))
    return np.sign(np.asarray(imaging.local_mean(scene.surface, waves, scene.edge)))


def diffusion(scene, name):
    """A diffusion ``(u, time) -> u`` by name."""
    surface, edge = scene.surface, scene.edge
    if name == "diffuse":
        return lambda u, time: imaging.diffuse(surface, u, time)
    if name == "perona_malik":
        return lambda u, time: imaging.perona_malik(surface, u, time, 0.1 / edge)
    structure = imaging.structure_tensor(surface, scene.noisy, edge, 3 * edge)
    coherent = imaging.diffusion_tensor(surface, structure, NOISE / edge, "coherence")
    return lambda u, time: imaging.anisotropic_diffusion(surface, u, coherent, time)


@pytest.mark.parametrize(
    "name", ["perona_malik", "anisotropic_diffusion", pytest.param("diffuse", marks=pytest.mark.slow)]
)
def test_diffusion_keeps_values_in_range(spot, name):
    flow, extremes = diffusion(spot, name), patches(spot)
    random = np.random.default_rng(1).uniform(-1, 1, extremes.shape)
    for u in (extremes, random):
        for time in (1e-2, 0.3, 3.0):
            after = flow(u, time * spot.edge**2)
            assert excess(after, u) < 1e-12
            assert float(jnp.max(jnp.abs(after - u))) > 1e-3


@pytest.mark.parametrize("time", [0.1, 1.0, 1e4])
def test_unit_vectors_stay_unit_vectors_and_stay_in_their_half_space(spot, time):
    random = np.random.default_rng(6)
    for d in (random.normal(size=(len(spot.x), 3)), random.normal(size=(len(spot.x), 5))):
        d = d / np.linalg.norm(d, axis=1, keepdims=True)
        after = imaging.diffuse_directions(spot.surface, d, time * spot.edge**2)
        assert np.abs(np.linalg.norm(after, axis=1) - 1).max() < 1e-12
        # All vectors lie inside a half space, and no mean of them is closer to its boundary than they are.
        within = np.column_stack([d[:, :-1], np.abs(d[:, -1]) + 0.2])
        within /= np.linalg.norm(within, axis=1, keepdims=True)
        after = np.asarray(imaging.diffuse_directions(spot.surface, within, time * spot.edge**2))
        assert after[:, -1].min() > within[:, -1].min() - 1e-9


def test_the_diffusion_of_directions_is_differentiable_at_time_zero(sphere):
    surface, d = sphere.surface, jnp.asarray(sphere.x)[:, jnp.array([1, 2, 0])]
    d = d + 0.3 * d**2
    d = d / jnp.linalg.norm(d, axis=1, keepdims=True)
    tangent = jax.jacfwd(lambda time: imaging.diffuse_directions(surface, d, time))(jnp.zeros(()))
    rate = ltl.laplacian(surface, d)
    # The derivative is the part of the Laplacian orthogonal to the direction.
    np.testing.assert_allclose(tangent, rate - d * jnp.sum(d * rate, axis=1, keepdims=True), atol=1e-8)
    slope = jax.grad(lambda time: jnp.sum(imaging.diffuse_directions(surface, d, time) ** 3))(jnp.zeros(()))
    np.testing.assert_allclose(slope, jnp.sum(3 * d**2 * tangent), rtol=1e-6)


def test_directions_in_a_plane_follow_the_heat_flow_of_their_angle_to_first_order():
    # For directions in a plane, the harmonic map heat flow is the heat flow of their angle.
    errors = []
    for steps in (8, 16):
        surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(3))
        angle = surface.vertices[:, 2]
        d = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)
        after = imaging.diffuse_directions(surface, d, 0.3, steps)
        exact = angle * np.exp(-0.6)
        errors.append(float(jnp.max(jnp.abs(jnp.arctan2(after[:, 1], after[:, 0]) - exact))))
    assert 0.8 < np.log2(errors[0] / errors[1]) < 1.3
    assert errors[1] < 0.02


def test_diffusion_of_directions_reduces_noise_in_normals_and_hues(spot):
    random = np.random.default_rng(7)
    normals = np.asarray(spot.surface.normals)
    noisy = normals + 0.3 * random.normal(size=normals.shape)
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    diffused = imaging.diffuse_directions(spot.surface, noisy, 0.3 * spot.edge**2)

    def angle(d):
        return np.degrees(np.arccos(np.clip(np.sum(np.asarray(d) * normals, axis=1), -1, 1))).mean()

    assert angle(diffused) < 0.6 * angle(noisy)
    hues = np.stack([0.2 + 0.8 * spot.clean, np.full(len(normals), 0.5), 1 - 0.8 * spot.clean], axis=1)
    colours = hues + NOISE * random.normal(size=hues.shape)
    denoised = imaging.denoise_chromaticity(spot.surface, colours, 0.1 * spot.edge**2, 0.01)
    assert float(imaging.psnr(spot.surface, denoised, hues)) > float(imaging.psnr(spot.surface, colours, hues)) + 3


@pytest.mark.parametrize(
    ("enhancing", "dtype"), [("edges", jnp.float32), pytest.param("coherence", jnp.float64, marks=pytest.mark.slow)]
)
def test_diffusion_tensors_are_differentiable_where_an_image_is_flat(enhancing, dtype):
    scene = Scene(ltl.shapes.icosphere(2), dtype)
    u = jnp.asarray(np.maximum(scene.x[:, 2], 0), dtype)
    weights = jnp.asarray(np.random.default_rng(12).normal(size=(len(u), 3, 3)), dtype)

    def loss(u):
        structure = imaging.structure_tensor(scene.surface, u, 0.0, 0.0)
        return jnp.sum(weights * imaging.diffusion_tensor(scene.surface, structure, 1.0, enhancing))

    slope = jax.grad(loss)(u)
    assert jnp.isfinite(slope).all()
    assert jnp.max(jnp.abs(slope)) > 1e-3
    # Well inside the flat half the tensor is constant.
    np.testing.assert_array_equal(slope[scene.x[:, 2] < -0.7], 0)


def test_coherence_enhancing_closes_gaps_in_lines():
    surface = ltl.Surface.from_mesh(ltl.shapes.square(n=30))
    x, y, _ = np.asarray(surface.vertices).T
    lines = np.sin(6 * np.pi * y)
    broken = np.where(np.abs(x - 0.5) < 0.05, 0.0, lines)
    edge = float(surface.mesh_size)
    closed = imaging.coherence_enhancing(surface, broken, 20 * edge**2, 1.0, rounds=2)
    inside = (np.abs(x - 0.5) < 0.05) & (np.abs(y - 0.5) < 0.4)
    assert np.corrcoef(np.asarray(closed)[inside], lines[inside])[0, 1] > 0.9
    assert np.abs(closed)[inside].mean() > 0.25
    # The diffusion goes along the lines, so they keep more of their height than linear diffusion would leave.
    intact = (np.abs(x - 0.5) > 0.2) & (np.abs(y - 0.5) < 0.4)
    assert np.abs(closed)[intact].mean() > 0.6 * np.abs(lines)[intact].mean()


def test_the_structure_tensor_of_a_ramp_is_the_outer_product_of_its_gradient():
    surface = ltl.Surface.from_mesh(ltl.shapes.jittered(ltl.shapes.square(n=20), 0.2, seed=0))
    x, y, _ = np.asarray(surface.vertices).T
    inside = (np.abs(x - 0.5) < 0.25) & (np.abs(y - 0.5) < 0.25)
    tensor = np.asarray(imaging.structure_tensor(surface, np.stack([3 * x + y, y], axis=1), 0.02, 0.02))
    expected = np.array([[9, 3, 0], [3, 2, 0], [0, 0, 0]])
    np.testing.assert_allclose(tensor[inside], np.broadcast_to(expected, tensor[inside].shape), atol=2e-2)
    edges = np.asarray(imaging.diffusion_tensor(surface, tensor, 1.0))
    values, vectors = np.linalg.eigh(edges[inside])
    np.testing.assert_allclose(values, np.broadcast_to([0, 1e-3, 1], values.shape), atol=2e-3)
    steepest = np.linalg.eigh(expected)[1][:, -1]
    assert np.abs(vectors[:, :, 2] @ steepest).max() < 2e-2


def test_segmentation_finds_two_regions_under_noise_that_defeats_a_threshold(spot):
    inside = spot.clean > 0.4
    u = inside + 0.4 * np.random.default_rng(8).normal(size=len(inside))
    grey = imaging.segment(spot.surface, u)
    assert np.mean(np.asarray(grey.is_inside) == inside) > 0.98
    assert np.mean((u > 0.5) == inside) < 0.93
    np.testing.assert_allclose(grey.means, [1, 0], atol=0.05)
    assert float(jnp.max(jnp.abs(grey.phi))) < 1
    coloured = imaging.segment(spot.surface, np.stack([u, 1 - u], axis=1) + 3)
    assert coloured.means.shape == (2, 2)
    agreement = np.mean(np.asarray(coloured.is_inside) == inside)
    assert max(agreement, 1 - agreement) > 0.98


def test_the_phase_field_has_the_derivative_of_the_energy_minimiser(spot):
    u = (spot.clean > 0.4) + 0.2 * np.random.default_rng(9).normal(size=len(spot.x))
    x, areas = spot.x[:, 0], spot.surface.vertex_areas
    check = ltl.inverse.check_gradient(
        lambda u: jnp.sum(areas * x * imaging.segment(spot.surface, u, rtol=1e-11, throw=False).phi), u, step=1e-4
    )
    assert check.passed, check


def test_sharpening_undoes_a_blur_and_is_bounded(spot):
    blurred = imaging.diffuse(spot.surface, spot.clean, 0.3 * spot.edge**2)
    sharp = imaging.sharpen(spot.surface, blurred, 1.0, spot.edge)
    assert spot.decibels(sharp) > spot.decibels(blurred) + 2
    u = np.random.default_rng(10).normal(size=len(spot.x))
    # A mean with non-negative weights does not exceed the largest value.
    assert np.abs(imaging.sharpen(spot.surface, u, 1.0, spot.edge)).max() <= 3 * np.abs(u).max()
    np.testing.assert_array_equal(imaging.sharpen(spot.surface, u, 0.0, spot.edge), u)


def test_measures_of_quality_follow_their_formulas(spot):
    surface, clean, noisy = spot.surface, spot.clean, spot.noisy
    areas = np.asarray(surface.vertex_areas)
    error = areas @ (noisy - clean) ** 2 / areas.sum()
    np.testing.assert_allclose(imaging.mse(surface, noisy, clean), error, rtol=1e-12)
    np.testing.assert_allclose(imaging.psnr(surface, noisy, clean), -10 * np.log10(error), rtol=1e-12)
    np.testing.assert_allclose(imaging.psnr(surface, noisy, clean, 2.0), 10 * np.log10(4 / error), rtol=1e-12)
    np.testing.assert_allclose(imaging.ssim(surface, clean, clean), 1, atol=1e-12)
    values = [float(imaging.ssim(surface, clean + size * (noisy - clean), clean)) for size in (0.1, 0.5, 1.0)]
    assert 1 > values[0] > values[1] > values[2] > 0
    # Two constants differ only in luminance.
    a, b, c = 0.3, 0.5, 1e-4
    flat = imaging.ssim(surface, np.full(len(areas), a), np.full(len(areas), b), peak=1.0)
    np.testing.assert_allclose(flat, (2 * a * b + c) / (a**2 + b**2 + c), rtol=1e-6)


QUICK = ["denoise", "directions"]


def filters(surface, u, mask, d, size, edge):
    """All filters that can be compiled, by name."""
    return {
        "denoise": lambda: imaging.denoise(surface, u, strength=0.02 * size),
        "denoise by noise": lambda: imaging.denoise(surface, u, noise=NOISE * size),
        "diffuse": lambda: imaging.diffuse(surface, u, size * edge**2),
        "perona_malik": lambda: imaging.perona_malik(surface, u, size * edge**2, 0.1 / edge),
        "sharpen": lambda: imaging.sharpen(surface, u, size, edge),
        "harmonic": lambda: imaging.inpaint(surface, u, mask),
        "biharmonic": lambda: imaging.inpaint(surface, u, mask, "biharmonic"),
        "tv": lambda: imaging.inpaint(surface, u, mask, "tv"),
        "directions": lambda: imaging.diffuse_directions(surface, d, size * edge**2),
        "segment": lambda: imaging.segment(surface, u).phi,
        "ssim": lambda: imaging.ssim(surface, u, u + d[:, 0]),
        "psnr": lambda: imaging.psnr(surface, u, u + d[:, 0]),
        "structure_tensor": lambda: imaging.structure_tensor(surface, u, edge, edge),
    }


def arguments(scene):
    dtype = scene.surface.dtype
    x, u = jnp.asarray(scene.x, dtype), jnp.asarray(scene.noisy, dtype)
    return scene.surface, u, x[:, 2] > 0.7, x, jnp.ones((), dtype), scene.edge


def check_compiled(scene, names):
    *traced, edge = arguments(scene)
    compiled = jax.jit(lambda *args: {name: filters(*args, edge)[name]() for name in names})(*traced)
    for name in names:
        eager = filters(*traced, edge)[name]()
        np.testing.assert_allclose(compiled[name], eager, atol=2e-6, err_msg=name)


def test_filters_give_the_same_images_inside_jit_and_under_vmap(sphere):
    check_compiled(sphere, QUICK)
    u, surface = jnp.asarray(sphere.noisy), sphere.surface
    batch = jax.vmap(lambda u: imaging.denoise(surface, u, strength=0.01))(jnp.stack([u, 2 * u]))
    np.testing.assert_allclose(batch[0], imaging.denoise(surface, u, strength=0.01), atol=1e-7)


@pytest.mark.slow
def test_all_filters_without_host_code_give_the_same_images_inside_jit(sphere):
    check_compiled(sphere, list(filters(*arguments(sphere))))


def check_single(names):
    mesh = ltl.shapes.jittered_sphere(3, 0.3, seed=0)
    single, double = (filters(*arguments(Scene(mesh, dtype))) for dtype in (jnp.float32, jnp.float64))
    for name in names:
        value = single[name]()
        assert value.dtype == jnp.float32, name
        np.testing.assert_allclose(value, double[name](), rtol=5e-3, atol=5e-3, err_msg=name)


def test_float32_is_accurate_enough_for_images():
    check_single(QUICK)


@pytest.mark.slow
def test_all_filters_are_accurate_enough_in_float32(sphere):
    check_single(list(filters(*arguments(sphere))))
    surface = ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(3, 0.3, seed=0), dtype=jnp.float32)
    edge = sphere.edge
    single = imaging.edge_enhancing(surface, sphere.noisy, edge**2, 0.2 / edge, rounds=1)
    double = imaging.edge_enhancing(sphere.surface, sphere.noisy, edge**2, 0.2 / edge, rounds=1)
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, double, atol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["perona_malik", "sharpen", "directions", "ssim", "harmonic"])
def test_filters_that_are_not_minimisers_have_correct_derivatives(sphere, name):
    surface, u, mask, x, size, edge = arguments(sphere)
    weights = jnp.asarray(np.random.default_rng(11).normal(size=len(x)))

    def loss(change):
        turned = x + change * x[:, jnp.array([1, 2, 0])]
        turned = turned / jnp.linalg.norm(turned, axis=1, keepdims=True)
        image = filters(surface, u + change * x[:, 1], mask, turned, size, edge)[name]()
        return jnp.sum(weights.reshape(-1, *(1,) * (image.ndim - 1)) * (image + image**2))

    check = ltl.inverse.check_gradient(loss, jnp.asarray(0.3), step=1e-2)
    # The slope is not tested, because adaptive step sizes depend on the image, which limits the accuracy.
    assert check.remainders[-1] < 1e-3 * check.differences[-1], check


def test_invalid_arguments_raise_clear_errors(sphere):
    surface, u = sphere.surface, sphere.noisy
    size, bad = len(u), u.copy()
    bad[7] = np.nan
    everywhere = np.ones(size, bool)
    cases = [
        (lambda: imaging.denoise(surface, u[:-1], strength=0.1), r"u of shape \(642,\).*found \(641,\)"),
        (lambda: imaging.diffuse(surface, u[None], 0.1), r"found \(1, 642\)"),
        (lambda: imaging.denoise(surface, bad, strength=0.1), "found u = nan at vertex 7"),
        (lambda: imaging.denoise(surface, u, strength=-1.0), "strength to be finite and not negative, found -1"),
        (lambda: imaging.denoise(surface, u, noise=0.0), "noise to be finite and positive, found 0"),
        (lambda: imaging.denoise(surface, u, noise=9.0), "below the standard deviation of u, .* found 9"),
        (lambda: imaging.denoise(surface, u), "one of strength and noise, found neither"),
        (lambda: imaging.denoise(surface, u, strength=0.1, noise=0.1), "found both"),
        (lambda: imaging.perona_malik(surface, u, 0.1, 0.0), "contrast to be finite and positive"),
        (lambda: imaging.diffuse(surface, u, -0.1), "time to be finite and not negative, found -0.1"),
        (lambda: imaging.sharpen(surface, u, np.ones(3), 0.1), r"amount as one number, found the shape \(3,\)"),
        (lambda: imaging.inpaint(surface, u, everywhere[:-1]), r"booleans of shape \(642,\).*found bool \(641,\)"),
        (lambda: imaging.inpaint(surface, u, u), "found float64"),
        (lambda: imaging.inpaint(surface, u, everywhere), "mask is True at all"),
        (lambda: imaging.inpaint(surface, u, ~everywhere, "cubic"), "found 'cubic'"),
        (lambda: imaging.inpaint(surface, bad, ~everywhere), "nan at vertex 7"),
        (lambda: imaging.diffuse_directions(surface, 2 * sphere.x, 0.1), "found the length 2 at vertex 0"),
        (lambda: imaging.diffuse_directions(surface, u, 0.1), r"directions of shape \(642, N\)"),
        (lambda: imaging.segment(surface, 0 * u), "constant"),
        (lambda: imaging.psnr(surface, u, 0 * u), "constant"),
        (lambda: imaging.mse(surface, u, sphere.x), "of the shape of u"),
        (lambda: imaging.anisotropic_diffusion(surface, u, np.eye(3), 0.1), r"tensor of shape \(642, 3, 3\)"),
        (lambda: imaging.edge_enhancing(surface, u, 0.1, 1.0, rounds=0), "at least one round"),
        (lambda: imaging.diffusion_tensor(surface, np.zeros((size, 3, 3)), 1.0, "lines"), "found 'lines'"),
        (
            lambda: jax.jit(lambda s: imaging.anisotropic_diffusion(surface, u, s * np.ones((size, 3, 3)), 0.1))(1.0),
            "being traced",
        ),
        (lambda: jax.jit(lambda u: imaging.edge_enhancing(surface, u, 0.1, 1.0))(u), "in every round"),
        (lambda: jax.jit(lambda u: imaging.coherence_enhancing(surface, u, 0.1, 1.0))(u), "in every round"),
    ]
    for call, message in cases:
        with pytest.raises(ValueError, match=message):
            call()


def test_failure_to_converge_raises_or_is_nan_inside_jit(sphere):
    with pytest.raises(ltl.SolveError, match="did not converge"):
        imaging.denoise(sphere.surface, sphere.noisy, strength=0.1, max_iterations=1)
    with pytest.raises(ltl.SolveError, match="two regions"):
        imaging.segment(sphere.surface, sphere.noisy, max_iterations=1)
    inside = jax.jit(lambda u: imaging.denoise(sphere.surface, u, strength=0.1, max_iterations=1))(sphere.noisy)
    assert bool(jnp.isnan(inside).all())


def test_a_uv_map_that_leaves_the_image_by_rounding_reads_the_same_side():
    square = ltl.shapes.square(n=4)
    corners, faces = square.vertices, square.faces
    # Pixel values are ten times the column plus the row from below.
    image = np.outer([3.0, 2, 1, 0], np.ones(4)) + 10 * np.arange(4.0)
    exact = imaging.from_texture(ltl.Mesh(corners, faces, uv=corners[faces][..., :2]), image)
    x, y = np.clip(4 * corners[:, :2] - 0.5, 0, 3).T
    np.testing.assert_allclose(exact, 10 * x + y, atol=1e-12)
    for off in (1e-6, -1e-6):
        # Slightly outside the image and slightly inside it, in this period of the image and in others.
        uv = 0.5 + (1 + off) * (corners[faces][..., :2] - 0.5)
        for turns in (0, 1, -3):
            values = imaging.from_texture(ltl.Mesh(corners, faces, uv=uv + turns), image)
            np.testing.assert_allclose(values, exact, atol=1e-3)


def test_old_names_of_functions_and_arguments_still_work_and_warn():
    scene = Scene(ltl.shapes.icosphere(1))
    surface, u = scene.surface, scene.x[:, 2]
    with pytest.warns(DeprecationWarning, match="smoothed is deprecated.*use local_mean"):
        old = imaging.smoothed(surface, u, scene.edge)
    np.testing.assert_array_equal(old, imaging.local_mean(surface, u, scene.edge))
    with pytest.warns(DeprecationWarning, match="denoise_mesh is deprecated.*use filter_normals"):
        old = imaging.denoise_mesh(surface)
    np.testing.assert_array_equal(old, imaging.filter_normals(surface))
    renamed = [
        (imaging.denoise, dict(f=u, strength=-1.0), "argument f of denoise"),
        (imaging.denoise, dict(u=u, strength=-1.0, tolerance=1e-3), "argument tolerance of denoise"),
        (imaging.denoise, dict(u=u, strength=-1.0, max_steps=9), "argument max_steps of denoise"),
        (imaging.noise_strength, dict(f=u, noise=0.0), "argument f of noise_strength"),
        (imaging.segment, dict(u=u, width=-1.0, tolerance=1e-3), "argument tolerance of segment"),
        (imaging.segment, dict(u=u, width=-1.0, max_steps=9), "argument max_steps of segment"),
        (imaging.ssim, dict(u=u, reference=u, radius=-1.0), "argument radius of ssim"),
        (imaging.denoise_chromaticity, dict(colours=u, time=1.0), "argument colours of denoise_chromaticity"),
        (imaging.mean_curvature_flow, dict(t1=-1.0), "argument t1 of mean_curvature_flow"),
    ]
    for function, arguments, message in renamed:
        # Another argument is invalid, which is found only after the old name has been accepted.
        with pytest.warns(DeprecationWarning, match=message), pytest.raises(ValueError, match="Expected"):
            function(surface, **arguments)
