"""Transport, decomposition and diffusion of tangent vector fields."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import ltljax as ltl

SPHERES = {
    "icosphere": lambda level: ltl.shapes.icosphere(subdivisions=level),
    "jittered": lambda level: ltl.shapes.jittered_sphere(level, 0.5),
    "random": lambda level: ltl.shapes.random_sphere(10 * 4**level + 2),
}


# Random spheres are the hardest of the three.
@pytest.fixture(scope="module", params=[
    pytest.param("icosphere", marks=pytest.mark.slow), pytest.param("jittered", marks=pytest.mark.slow), "random"
])  # fmt: skip
def spheres(request):
    return [ltl.Surface.from_mesh(SPHERES[request.param](level)) for level in (3, 4)]


@pytest.fixture(scope="module")
def jittered():
    return ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(3, 0.4, seed=1))


@pytest.fixture(scope="module")
def tori():
    return [ltl.Surface.from_mesh(ltl.shapes.torus(n_major=2 * n, n_minor=n)) for n in (24, 48)]


def killing(surface):
    x, y, z = surface.vertices.T
    return jnp.stack([-y, x, 0 * z], axis=1)


def gradient_of_degree_2(surface):
    x, y, z = surface.vertices.T
    return ltl.vectors.tangential(surface, jnp.stack([y, x, 0 * z], axis=1))


def rms(X):
    return float(jnp.sqrt(jnp.mean(jnp.sum(X**2, axis=-1))))


def order(errors):
    return np.log2(errors[0] / errors[1])


def around_octant(mesh):
    """The closed path that has the sphere's faces with centres in the first octant on its left, and their area."""
    inside = (mesh.vertices[mesh.faces].mean(axis=1) > 0).all(axis=1)
    patch = ltl.Mesh(mesh.vertices, mesh.faces[inside])
    (loop,) = patch.boundary_loops
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[inside]], 1, 0)
    volume = np.einsum("fc,fc->f", a, np.cross(b, c))
    dots = [np.einsum("fc,fc->f", p, q) for p, q in ((a, b), (b, c), (c, a))]
    path = patch.original_index[loop]
    return np.append(path, path[0]), 2 * np.arctan2(volume, 1 + sum(dots)).sum()


def test_the_holonomy_around_a_region_of_the_sphere_is_its_area(spheres):
    errors = []
    for surface in spheres:
        mesh = ltl.Mesh(surface.vertices, surface.faces)
        path, area = around_octant(mesh)
        start = surface.geometry.frames[path[0], 0]
        carried = ltl.vectors.transport_along(surface, path, start)[-1]
        np.testing.assert_allclose(jnp.linalg.norm(carried), 1, atol=1e-12)
        angle = float(jnp.arctan2(carried @ jnp.cross(surface.normals[path[0]], start), carried @ start))
        errors.append(abs(angle - area))
        assert abs(angle - np.pi / 2) < 0.3  # The area of the octant itself differs by the width of a face.
    assert errors[1] < 2e-3
    assert errors[1] < errors[0] / 2 or errors[0] < 1e-9


def exact_transport(points, source, vector):
    """The vector at points[source], transported along great circles."""
    p = points[source]
    cosine = np.maximum(points @ p, -1 + 1e-9)
    return vector - ((points @ vector) / (1 + cosine))[:, None] * (points + p)


def angles(X, Y, normals):
    return np.arctan2(np.sum(np.cross(X, Y) * normals, axis=1), np.sum(X * Y, axis=1))


# Largest root mean square errors in degrees at 2562 vertices: half of potpourri3d's (benchmarks/imaging.md).
LARGEST_ANGLE = {"icosphere": 0.08, "jittered": 0.3, "random": 0.6}


def test_a_vector_is_carried_over_the_sphere(spheres, request):
    name = request.node.callspec.params["spheres"]
    errors = []
    for surface in spheres:
        points = np.asarray(surface.vertices)
        source = 7
        vector = 2 * surface.geometry.frames[source, 0]
        X = ltl.vectors.transport_vectors(surface, source, vector)
        np.testing.assert_allclose(jnp.linalg.norm(X, axis=1), 2, rtol=1e-9)
        exact = exact_transport(points, source, np.asarray(vector))
        is_away_from_antipode = points @ points[source] > -0.97
        angle = angles(exact, np.asarray(X), points)[is_away_from_antipode]
        errors.append(np.degrees(np.sqrt(np.mean(angle**2))))
    assert errors[1] < LARGEST_ANGLE[name]
    assert errors[1] < 1.1 * errors[0]


def test_each_vertex_takes_the_vector_of_the_nearest_source(jittered):
    top, bottom = (int(jnp.argmax(sign * jittered.vertices[:, 2])) for sign in (1, -1))
    frames = jittered.geometry.frames
    vectors = jnp.stack([frames[top, 0], 3 * frames[bottom, 1]])
    X = ltl.vectors.transport_vectors(jittered, [top, bottom], vectors)
    length = np.linalg.norm(X, axis=1)
    z = np.asarray(jittered.vertices[:, 2])
    np.testing.assert_allclose(length[z > 0.6], 1, atol=0.05)
    np.testing.assert_allclose(length[z < -0.6], 3, atol=0.05)
    assert length[np.abs(z) < 0.1].min() > 1.2

    def carried(angle):
        turned = jnp.cos(angle) * frames[top, 0] + jnp.sin(angle) * frames[top, 1]
        return ltl.vectors.transport_vectors(jittered, top, turned)

    check_grads(carried, (jnp.asarray(0.3),), order=1, modes=["fwd", "rev"])


@pytest.mark.parametrize("symmetry", [1, 2, 4])
def test_the_indices_of_any_field_sum_to_the_euler_characteristic(jittered, tori, symmetry):
    for surface, characteristic in ((jittered, 2), (tori[0], 0)):
        X = ltl.vectors.tangential(surface, jax.random.normal(jax.random.key(symmetry), (surface.num_vertices, 3)))
        index = ltl.vectors.singularities(surface, X, symmetry)
        np.testing.assert_allclose(index * symmetry, jnp.round(index * symmetry), atol=1e-9)
        np.testing.assert_allclose(jnp.sum(index), characteristic, atol=1e-9)


def test_the_smoothest_cross_field_has_eight_singularities_on_a_sphere_and_the_smoothest_vectors_none_on_a_torus(
    jittered, tori
):
    X = ltl.vectors.direction_field(jittered, symmetry=4)
    np.testing.assert_allclose(jnp.linalg.norm(X, axis=1), 1, atol=1e-12)
    index = ltl.vectors.singularities(jittered, X, 4)
    np.testing.assert_allclose(jnp.sort(index)[-8:], 0.25, atol=1e-9)
    assert int(jnp.sum(jnp.abs(index) > 0.1)) == 8
    torus_index = ltl.vectors.singularities(tori[0], ltl.vectors.direction_field(tori[0], symmetry=1), 1)
    np.testing.assert_allclose(torus_index, 0, atol=1e-9)


def test_a_noisy_cross_field_is_smoothed(tori):
    surface = tori[0]
    x, y, _ = surface.vertices.T
    around = killing(surface) / jnp.sqrt(x**2 + y**2)[:, None]
    across = ltl.vectors.rotated(surface, around)
    arms = jnp.stack([around, across, -around, -across])
    cross = arms[jax.random.randint(jax.random.key(0), x.shape, 0, 4), jnp.arange(len(x))]
    noisy = ltl.vectors.tangential(surface, cross + 0.3 * jax.random.normal(jax.random.key(1), cross.shape))

    def error(X):
        angle = jnp.arctan2(jnp.sum(X * across, axis=1), jnp.sum(X * around, axis=1))
        return float(jnp.sqrt(jnp.mean((angle - jnp.pi / 2 * jnp.round(angle / (jnp.pi / 2))) ** 2)))

    smooth = ltl.vectors.direction_field(surface, 4, guide=noisy, time=0.1)
    assert error(smooth) < 0.3 * error(noisy)


def test_a_field_splits_into_orthogonal_parts_with_both_harmonic_fields_of_the_torus(tori):
    errors = []
    for surface in tori:
        harmonic = ltl.vectors.harmonic_fields(surface)
        assert len(harmonic.fields) == 2
        x, y, _ = surface.vertices.T
        around = killing(surface) / (x**2 + y**2)[:, None]
        exact = jnp.stack([around, ltl.vectors.rotated(surface, around)])

        def product(X, Y, measure=harmonic.measure):
            return jnp.einsum("v,...vc,...vc->...", measure, X, Y)

        coefficients = jax.vmap(lambda X, h=harmonic.fields: product(h, X[None]))(exact)
        residual = exact - jnp.einsum("en,nvc->evc", coefficients, harmonic.fields)
        errors.append(float(jnp.max(jnp.sqrt(product(residual, residual) / product(exact, exact)))))
        noise = ltl.vectors.tangential(surface, jax.random.normal(jax.random.key(0), around.shape))
        smooth = ltl.gradient(surface, jnp.sin(x)) + ltl.vectors.rotated_gradient(surface, y)
        X = smooth + exact[0] - 0.5 * exact[1] + noise
        decomposition = ltl.vectors.helmholtz_hodge(surface, X, harmonic)
        parts = (decomposition.gradient, decomposition.rotation, decomposition.harmonic)
        for a, b in ((0, 1), (0, 2), (1, 2)):
            assert abs(product(parts[a], parts[b])) < 1e-6 * product(X, X)
            assert product(parts[a], parts[a]) > 1e-2 * product(X, X)
        np.testing.assert_allclose(sum(parts), ltl.vectors.tangential(surface, X), atol=1e-12)
    assert order(errors) > 1.5
    assert errors[1] < 2e-3


def test_the_decomposition_recovers_the_parts_of_a_smooth_field(jittered):
    x, y, z = jittered.vertices.T
    gradient, rotation = ltl.gradient(jittered, x * y), ltl.vectors.rotated_gradient(jittered, z + x * z)
    parts = ltl.vectors.helmholtz_hodge(jittered, gradient + rotation)
    assert rms(parts.gradient - gradient) < 0.03
    assert rms(parts.rotation - ltl.vectors.rotated_gradient(jittered, parts.stream)) < 0.03
    np.testing.assert_allclose(parts.harmonic, 0)
    np.testing.assert_allclose(parts.potential, x * y, atol=0.03)
    np.testing.assert_allclose(parts.stream, z + x * z, atol=0.03)
    disk = ltl.Surface.from_mesh(ltl.shapes.disk(rings=6))
    along = ltl.gradient(disk, disk.vertices[:, 0])
    np.testing.assert_allclose(ltl.vectors.helmholtz_hodge(disk, along).gradient, along, atol=1e-6)


def settled(surface, start, solver=None, **options):
    """The field after the vectors have saturated, ``X_t = 0.05 Delta X + 2 X (1 - |X|^2)``."""

    def saturation(X, rate):
        return rate * X * (1 - jnp.sum(X**2))

    equation = ltl.VectorDiffusion(0.05, saturation, params=2.0)
    return ltl.solve(equation, surface, start, t1=8.0, solver=solver, **options).u_end


def noisy_rotation(surface):
    noise = ltl.vectors.tangential(surface, jax.random.normal(jax.random.key(0), (surface.num_vertices, 3)))
    return 0.1 * noise + 0.07 * ltl.vectors.tangential(surface, killing(surface))


def test_vectors_that_saturate_settle_at_length_one_in_the_tangent_planes(tori):
    surface = tori[0]
    start = noisy_rotation(surface)
    X = settled(surface, start)
    assert rms(X) > 0.95
    np.testing.assert_allclose(settled(surface, start + surface.normals), X, atol=1e-9)
    assert float(jnp.abs(jnp.sum(X * surface.normals, axis=1)).max()) < 1e-12


@pytest.mark.parametrize(
    "solver", [pytest.param(ltl.TRBDF2(), marks=pytest.mark.slow), ltl.SBDF2()], ids=["TRBDF2", "SBDF2"]
)
def test_implicit_solvers_settle_at_the_same_vectors(tori, solver):
    start = noisy_rotation(tori[0])
    options = {"dt": 0.02} if isinstance(solver, ltl.SBDF2) else {}
    assert rms(settled(tori[0], start, solver, **options) - settled(tori[0], start)) < 0.02


def test_derivatives_through_vector_diffusion_pass_taylors_test(jittered):
    X = gradient_of_degree_2(jittered) + killing(jittered)

    def loss(params):
        equation = ltl.VectorDiffusion(params["diffusivity"], lambda X, rate: rate * X, params=params["rate"])
        end = ltl.solve(equation, jittered, params["start"], t1=0.1, dt=0.02, solver=ltl.RKL2()).u_end
        return ltl.integrate(jittered, end[:, 0] ** 2 + end[:, 1] * end[:, 2])

    params = {"diffusivity": jnp.asarray(0.7), "rate": jnp.asarray(0.3), "start": X}
    assert ltl.inverse.check_gradient(loss, params).passed


def test_the_connection_matrix_is_the_vector_laplacian(jittered):
    X = gradient_of_degree_2(jittered)
    z = np.asarray(ltl.vectors.to_frame(jittered, X)) @ [1, 1j]
    applied = ltl.vectors.connection_matrix(jittered) @ z
    expected = np.asarray(ltl.vectors.to_frame(jittered, ltl.vector_laplacian(jittered, X))) @ [1, 1j]
    np.testing.assert_allclose(applied, expected, atol=1e-10)
