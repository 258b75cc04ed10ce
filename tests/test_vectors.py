"""The calculus of tangent fields: convergence, the maximum principle, transport, symmetries, decomposition."""

import warnings

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


def gradient_of_degree_1(surface):
    return ltl.vectors.tangential(surface, jnp.broadcast_to(jnp.array([[0.6, 0.0, 0.8]]), surface.vertices.shape))


def gradient_of_degree_2(surface):
    x, y, z = surface.vertices.T
    return ltl.vectors.tangential(surface, jnp.stack([y, x, 0 * z], axis=1))


FIELDS = {
    "killing": (killing, -1),
    "gradient of degree 1": (gradient_of_degree_1, -1),
    "gradient of degree 2": (gradient_of_degree_2, -5),
}


LARGEST_ERROR = {"killing": 0.04, "gradient of degree 1": 0.1, "gradient of degree 2": 0.25}


def rms(X):
    return float(jnp.sqrt(jnp.mean(jnp.sum(X**2, axis=-1))))


def size(surface, X):
    """The root of the integral of |X|^2."""
    return float(jnp.sqrt(ltl.integrate(surface, jnp.sum(X**2, axis=-1))))


def order(errors):
    return np.log2(errors[0] / errors[1])


@pytest.mark.parametrize("name", FIELDS)
def test_the_vector_laplacian_converges_pointwise_on_spheres(spheres, name):
    field, eigenvalue = FIELDS[name]
    errors = []
    for surface in spheres:
        X = field(surface)
        errors.append(rms(ltl.vector_laplacian(surface, X) - eigenvalue * X) / rms(X))
    assert order(errors) >= 0.9
    assert errors[1] < LARGEST_ERROR[name]


def test_the_vector_heat_equation_is_of_second_order(spheres):
    errors = []
    for surface in spheres:
        slow, fast = killing(surface), gradient_of_degree_2(surface)
        solution = ltl.solve(
            ltl.VectorDiffusion(), surface, slow + fast, t1=0.2, rtol=1e-7, atol=1e-9, solver=ltl.RKL2()
        )
        exact = np.exp(-0.2) * slow + np.exp(-1.0) * fast
        errors.append(size(surface, solution.u_end - exact) / size(surface, exact))
    assert order(errors) >= 1.7  # On random spheres it varies between 1.8 and 2.4.
    assert errors[1] < 1e-3


def test_no_vector_grows_beyond_the_longest_in_a_thousand_trials(real_mesh):
    for mesh in (ltl.shapes.random_sphere(642), ltl.load_mesh(real_mesh("hand_open.obj"))):
        surface = surface_without_warnings(mesh)
        fields = jax.random.normal(jax.random.key(0), (surface.num_vertices, 1000, 3))
        fields = ltl.vectors.tangential(surface, fields / (0.1 + jax.random.uniform(jax.random.key(1), (1, 1000, 1))))
        # The longest explicit step that is a mean with non-negative weights.
        step = 2 / ltl.operators.spectral_bound(surface)
        after = fields + step * ltl.vector_laplacian(surface, fields)
        longest = jnp.linalg.norm(fields, axis=-1).max(axis=0)
        assert (jnp.linalg.norm(after, axis=-1).max(axis=0) <= longest * (1 + 1e-12)).all()
        assert float(jnp.mean(after**2)) < 0.995 * float(jnp.mean(fields**2))  # The field does change.


def surface_without_warnings(mesh):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ltl.errors.InconsistentRowsWarning)
        return ltl.Surface.from_mesh(mesh)


def errors_of_the_hodge_laplacian(surfaces, gradient, gradient_of_laplacian):
    errors = []
    for surface in surfaces:
        exact = gradient_of_laplacian(surface)
        errors.append(rms(ltl.vectors.hodge_laplacian(surface, gradient(surface)) - exact) / rms(exact))
    return errors


def test_the_hodge_laplacian_maps_the_gradient_of_u_to_that_of_its_laplacian_on_spheres(spheres):
    # For a linear function u on the sphere, Delta u = -2 u.
    errors = errors_of_the_hodge_laplacian(spheres, gradient_of_degree_1, lambda s: -2 * gradient_of_degree_1(s))
    assert order(errors) >= 0.9
    assert errors[1] < 0.15


def test_the_hodge_laplacian_maps_the_gradient_of_u_to_that_of_its_laplacian_on_the_torus(tori):
    errors = errors_of_the_hodge_laplacian(tori, torus_gradient, torus_gradient_of_laplacian)
    assert order(errors) >= 0.9
    assert errors[1] < 0.05


def torus_gradient(surface):
    """The gradient of u = z on the torus with radii 2 and 1."""
    return ltl.vectors.tangential(surface, jnp.broadcast_to(jnp.array([[0.0, 0.0, 1.0]]), surface.vertices.shape))


def torus_gradient_of_laplacian(surface):
    """The gradient of Delta z = -sin a - cos a sin a / (2 + cos a), where z = sin a."""
    x, y, z = surface.vertices.T
    rho = jnp.sqrt(x**2 + y**2)
    angle = jnp.arctan2(z, rho - 2)

    def laplacian(a):
        return -jnp.sin(a) - jnp.cos(a) * jnp.sin(a) / (2 + jnp.cos(a))

    slope = jax.vmap(jax.grad(laplacian))(angle)
    along = jnp.stack([-jnp.sin(angle) * x / rho, -jnp.sin(angle) * y / rho, jnp.cos(angle)], axis=1)
    return slope[:, None] * along


def test_the_curl_of_a_rotation_is_exact_to_first_order_and_the_divergence_of_a_rotated_gradient_vanishes(spheres):
    errors = []
    # Two vertices of the coarse random sphere are only 0.002 mean edges apart, which spoils the divergence there.
    for surface, bound in zip(spheres, (0.25, 0.1), strict=True):
        z = surface.vertices[:, 2]
        errors.append(float(jnp.sqrt(jnp.mean((ltl.vectors.curl(surface, killing(surface)) - 2 * z) ** 2))))
        clockwise = ltl.vectors.rotated_gradient(surface, z)
        assert rms(clockwise + killing(surface)) < 0.05
        assert float(jnp.sqrt(jnp.mean(ltl.divergence(surface, clockwise) ** 2))) < bound
    assert order(errors) >= 0.9
    assert errors[1] < 0.02


def test_the_covariant_derivative_of_a_killing_field_is_skew_and_its_trace_the_divergence(jittered):
    X = jnp.stack([killing(jittered), gradient_of_degree_2(jittered)], axis=1)
    D = ltl.vectors.covariant_derivative(jittered, X)
    np.testing.assert_allclose(jnp.trace(D, axis1=-2, axis2=-1), ltl.divergence(jittered, X), rtol=0, atol=1e-11)
    symmetric = D[:, 0] + D[:, 0].swapaxes(-1, -2)
    assert float(jnp.sqrt(jnp.mean(symmetric**2))) < 0.03
    first = jittered.geometry.frames[:, 0]
    rotation_rate = jnp.einsum("vcd,vc,vd->v", D[:, 0], ltl.vectors.rotated(jittered, first), first)
    np.testing.assert_allclose(rotation_rate, jittered.vertices[:, 2], atol=0.1)


def test_the_bracket_of_two_rotations_is_the_third(spheres):
    errors = []
    for surface in spheres:
        p = surface.vertices
        rotations = [jnp.cross(jnp.broadcast_to(axis[None], p.shape), p) for axis in jnp.eye(3)]
        errors.append(rms(ltl.vectors.lie_bracket(surface, rotations[0], rotations[1]) + rotations[2]))
        np.testing.assert_allclose(ltl.vectors.lie_derivative(surface, rotations[2], p[:, 2]), 0, atol=0.02)
    assert order(errors) >= 0.9
    assert errors[1] < 0.03


def test_tensors_diffuse_component_by_component_in_the_plane():
    surface = ltl.Surface.from_mesh(ltl.shapes.square(n=12))
    x, y, _ = surface.vertices.T
    u = jnp.stack([jnp.cos(jnp.pi * x), x * y, jnp.cos(jnp.pi * y)], axis=1)
    T = jnp.zeros((len(x), 3, 3)).at[:, 0, 0].set(u[:, 0]).at[:, 1, 1].set(u[:, 2])
    T = T.at[:, 0, 1].set(u[:, 1]).at[:, 1, 0].set(u[:, 1])
    rates = ltl.vectors.tensor_laplacian(surface, T)
    expected = ltl.laplacian(surface, u)
    for (i, j), column in (((0, 0), 0), ((0, 1), 1), ((1, 0), 1), ((1, 1), 2)):
        np.testing.assert_allclose(rates[:, i, j], expected[:, column], atol=1e-9)


def test_eigenvalues_of_diffused_tensors_stay_in_their_range(jittered):
    T = jax.random.normal(jax.random.key(0), (jittered.num_vertices, 50, 3, 3))
    frames = jittered.geometry.frames

    def eigenvalues(T):
        return jnp.linalg.eigvalsh(jnp.einsum("vac,vscd,vbd->vsab", frames, T, frames))

    T = T + T.swapaxes(-1, -2)
    before = eigenvalues(T)
    after = eigenvalues(T + 2 / ltl.operators.spectral_bound(jittered) * ltl.vectors.tensor_laplacian(jittered, T))
    assert (after[..., 1].max(axis=0) <= before[..., 1].max(axis=0) + 1e-12).all()
    assert (after[..., 0].min(axis=0) >= before[..., 0].min(axis=0) - 1e-12).all()


def test_operators_are_differentiable_in_field_and_vertices_and_act_on_every_column():
    surface = ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(1, 0.3, seed=2))
    X = jax.random.normal(jax.random.key(0), (surface.num_vertices, 3))
    fields = jnp.stack([X, 2 * X[::-1]], axis=1)

    @jax.jit
    def operators(p, X):
        moved = surface.with_vertices(p)
        D = ltl.vectors.covariant_derivative(moved, X)
        laplacians = ltl.vector_laplacian(moved, X) + ltl.vectors.hodge_laplacian(moved, X)
        return laplacians + D.sum(axis=-1), ltl.vectors.curl(moved, X)

    check_grads(operators, (surface.vertices, X), order=1, modes=["rev"], rtol=1e-4, atol=1e-4)
    check_grads(jax.jit(lambda X: ltl.vector_laplacian(surface, X)), (X,), order=1, modes=["fwd"])
    stacked = operators(surface.vertices, fields)
    mapped = jax.vmap(lambda X: operators(surface.vertices, X), in_axes=1, out_axes=1)(fields)
    single = operators(surface.vertices, X)
    for of_one, of_stack, of_map in zip(single, stacked, mapped, strict=True):
        np.testing.assert_allclose(of_stack[:, 0], of_one, atol=1e-9)
        np.testing.assert_allclose(of_map, of_stack, atol=1e-9)


def test_single_precision_stays_single_and_agrees_with_double_precision(jittered):
    single = ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(3, 0.4, seed=1), dtype="float32")
    X = gradient_of_degree_2(jittered)
    laplacian = ltl.vector_laplacian(single, jnp.asarray(X, jnp.float32))
    assert laplacian.dtype == jnp.float32
    np.testing.assert_allclose(laplacian, ltl.vector_laplacian(jittered, X), atol=2e-3)
    vectors = np.asarray(single.geometry.frames[:6:5, 0], np.float64)
    assert ltl.vectors.transport_vectors(single, [0, 5], vectors).dtype == jnp.float32
    assert ltl.vectors.helmholtz_hodge(single, jnp.asarray(X, jnp.float32)).gradient.dtype == jnp.float32


def test_wrong_arguments_are_refused(jittered):
    V = jittered.num_vertices
    X = gradient_of_degree_2(jittered)
    with pytest.raises(ValueError, match=rf"vectors of shape \({V}, 3\).*found \(7, 3\)"):
        ltl.vector_laplacian(jittered, jnp.ones((7, 3)))
    with pytest.raises(ValueError, match=r"normal part.*tangential"):
        ltl.vectors.transport_vectors(jittered, 3, jittered.normals[3])
    with pytest.raises(ValueError, match=rf"from 0 to {V - 1}, found \[{V}\]"):
        ltl.vectors.transport_vectors(jittered, V, X[0])
    with pytest.raises(ValueError, match="a vector for each of 2 sources"):
        ltl.vectors.transport_vectors(jittered, [1, 2], X[:3])
    with pytest.raises(ValueError, match="guide and the time"):
        ltl.vectors.direction_field(jittered, guide=X)
    with pytest.raises(ValueError, match="no vector Laplacian"):
        ltl.vector_laplacian(ltl.Surface.from_mesh(ltl.shapes.icosphere(1), ltl.Paper()), jnp.ones((42, 3)))
    with pytest.raises(ValueError, match="symmetry of 1 or more"):
        ltl.vectors.connection(jittered, 0)
    with pytest.raises(ValueError, match="returns the shape it is given"):
        ltl.VectorDiffusion(1.0, lambda vector, params: vector[:2]).rate(jnp.zeros(()), jittered, X)
    cylinder = ltl.Surface.from_mesh(ltl.shapes.cylinder(n_around=12, n_along=4))
    with pytest.raises(ValueError, match="closed surfaces or disks, found 2 boundary loops and 0 handles"):
        ltl.vectors.helmholtz_hodge(cylinder, jnp.ones((cylinder.num_vertices, 3)))
    with pytest.raises(ValueError, match="path of vertices from 0 to 641, found 99999"):
        ltl.vectors.transport_along(jittered, np.array([0, 99999]), X[0])
    with pytest.raises(ValueError, match="positive time, found 0"):
        ltl.vectors.transport_vectors(jittered, 3, X[3], time=0.0)
    with pytest.raises(ValueError, match="zero on all of the surface"):
        ltl.vectors.direction_field(jittered, 2, guide=jnp.zeros_like(X), time=0.1)


def test_components_are_treated_independently():
    ball, tube = ltl.shapes.icosphere(2), ltl.shapes.cylinder(n_around=12, n_along=4)

    def side_by_side(a, b):
        vertices = np.concatenate([a.vertices, b.vertices + np.array([5.0, 0.0, 0.0])])
        return ltl.Surface.from_mesh(ltl.Mesh(vertices, np.concatenate([a.faces, b.faces + a.num_vertices])))

    balls = side_by_side(ball, ball)
    index = np.asarray(ltl.vectors.singularities(balls, ltl.vectors.direction_field(balls, 4), 4)).reshape(2, -1)
    np.testing.assert_array_equal((np.abs(index) > 0.1).sum(axis=1), 8)
    with pytest.raises(ValueError, match="2 boundary loops and 0 handles on component 1"):
        ltl.vectors.harmonic_fields(side_by_side(ball, tube))


def test_functions_that_compute_on_the_host_can_be_called_inside_jit(jittered, tori):
    vector = jittered.geometry.frames[3, 0]
    field = jax.jit(lambda v: ltl.vectors.transport_vectors(jittered, 3, v))(vector)
    np.testing.assert_allclose(field, ltl.vectors.transport_vectors(jittered, 3, vector), atol=1e-12)
    X = killing(tori[0])
    parts = jax.jit(lambda X: ltl.vectors.helmholtz_hodge(tori[0], X))(X)
    np.testing.assert_allclose(parts.harmonic, ltl.vectors.helmholtz_hodge(tori[0], X).harmonic, atol=1e-9)
