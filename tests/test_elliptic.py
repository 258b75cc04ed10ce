"""General second-order operators with non-negative weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse.linalg

import ltljax as ltl


def relative_error(result, exact):
    return float(np.linalg.norm(np.asarray(result) - exact) / np.linalg.norm(exact))


def least_weight(stencil):
    return min(float(w.min()) for w in stencil.weights)


def plane(n, D, b):
    """The stencil of a constant operator on a jittered square, and its computed and exact values in the interior."""
    mesh = ltl.shapes.jittered(ltl.shapes.square(n=n), 0.25, seed=0)
    size = mesh.num_vertices
    tensor, drift = np.zeros((3, 3)), np.array([*b, 0.0])
    tensor[:2, :2] = D
    surface = ltl.Surface.from_mesh(mesh)
    stencil = ltl.operators.elliptic_stencil(
        surface, np.broadcast_to(tensor, (size, 3, 3)), np.broadcast_to(drift, (size, 3))
    )
    k = np.array([2.0, 1.0, 0.0])
    phase = mesh.vertices @ k
    exact = -(k @ tensor @ k) * np.sin(phase) + (drift @ k) * np.cos(phase)
    interior = ~mesh.boundary_vertices
    return stencil, interior, np.asarray(stencil(jnp.sin(jnp.asarray(phase))))[interior], exact[interior]


@pytest.mark.parametrize(
    ("D", "b", "last"),
    [([[2, 0.5], [0.5, 1]], [1, -2], 5e-3), ([[3, 1.3], [1.3, 1]], [0, 0], 8e-3), ([[10, 0], [0, 1]], [0, 0], 8e-3)],
)
def test_anisotropic_diffusion_with_drift_is_consistent_and_non_negative(D, b, last):
    errors = []
    for n in (16, 32, 64):
        stencil, interior, values, exact = plane(n, D, b)
        assert least_weight(stencil) >= 0
        assert float(np.asarray(stencil.residual)[interior].max()) < 1e-7
        errors.append(relative_error(values, exact))
    assert np.log2(errors[0] / errors[2]) / 2 > 0.9
    assert errors[-1] < last


def test_drift_alone_is_upwind_and_first_order():
    errors = []
    for n in (16, 32, 64):
        stencil, _, values, exact = plane(n, np.zeros((2, 2)), [1.0, 0.5])
        assert least_weight(stencil) >= 0
        errors.append(relative_error(values, exact))
    assert np.log2(errors[0] / errors[2]) / 2 > 0.9
    assert errors[-1] < 3e-2


def test_the_stencil_of_the_unit_tensor_is_the_laplacian():
    mesh = ltl.shapes.jittered_sphere(3, 0.5, seed=0)
    surface = ltl.Surface.from_mesh(mesh)
    u = jnp.asarray(mesh.vertices[:, 0] * mesh.vertices[:, 1])
    identity = np.broadcast_to(np.eye(3), (mesh.num_vertices, 3, 3))
    for diffusion in (1.0, np.ones(mesh.num_vertices), identity):
        result = ltl.operators.elliptic_stencil(surface, diffusion)(u)
        np.testing.assert_allclose(result, ltl.laplacian(surface, u), atol=1e-10)


def test_an_elliptic_stencil_has_a_maximum_principle():
    mesh = ltl.shapes.random_sphere(642, seed=0)
    surface = ltl.Surface.from_mesh(mesh)
    random = np.random.default_rng(0)
    factors = random.normal(size=(mesh.num_vertices, 3, 3))
    tensors = np.einsum("vij,vkj->vik", factors, factors)
    stencil = ltl.operators.elliptic_stencil(surface, tensors, random.normal(size=(mesh.num_vertices, 3)))
    assert least_weight(stencil) >= 0
    step = scipy.sparse.csc_matrix(scipy.sparse.eye_array(mesh.num_vertices) - 0.1 * stencil.matrix())
    u = random.uniform(-1, 1, (mesh.num_vertices, 50))
    after = scipy.sparse.linalg.splu(step).solve(u)
    assert (after.max(axis=0) <= u.max(axis=0) + 1e-12).all()
    assert (after.min(axis=0) >= u.min(axis=0) - 1e-12).all()


def test_coefficients_can_be_changed_and_differentiated():
    mesh = ltl.shapes.jittered_sphere(2, 0.3, seed=0)
    surface = ltl.Surface.from_mesh(mesh)
    x, y, z = mesh.vertices.T
    drift = np.stack([-y, x, 0 * x], axis=1)
    stencil = ltl.operators.elliptic_stencil(surface, 1.0, drift)
    same = stencil.with_coefficients(surface, 1.0, drift)
    u = jnp.asarray(x * z)
    np.testing.assert_allclose(same(u), stencil(u), atol=1e-9)

    def energy(d):
        return jnp.sum(stencil.with_coefficients(surface, d, drift)(u) ** 2)

    slope = (energy(1.1 + 1e-5) - energy(1.1 - 1e-5)) / 2e-5
    assert float(jax.jit(jax.grad(energy))(1.1)) == pytest.approx(float(slope), rel=1e-6)


def test_coefficients_that_do_not_fit_are_refused():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1))
    size = surface.num_vertices
    with pytest.raises(ValueError, match=r"found \(5,\)"):
        ltl.operators.elliptic_stencil(surface, np.ones(5))
    with pytest.raises(ValueError, match="not negative in any tangent direction"):
        ltl.operators.elliptic_stencil(surface, -1.0)
    skew = np.zeros((size, 3, 3))
    skew[3, 0, 1] = 1
    with pytest.raises(ValueError, match="Expected a symmetric diffusion tensor, found an asymmetric one at vertex 3"):
        ltl.operators.elliptic_stencil(surface, skew)
    with pytest.raises(ValueError, match="chosen on the host"):
        jax.jit(lambda s: ltl.operators.elliptic_stencil(s, 1.0)(s.vertices))(surface)


def test_the_weighted_laplacian_is_div_g_grad():
    errors = []
    for n in (16, 32, 64):
        mesh = ltl.shapes.jittered(ltl.shapes.square(n=n), 0.2, seed=0)
        x, y, _ = mesh.vertices.T
        g, u = 1 + x**2, np.cos(np.pi * x) * np.cos(2 * np.pi * y)
        exact = -5 * np.pi**2 * g * u - 2 * x * np.pi * np.sin(np.pi * x) * np.cos(2 * np.pi * y)
        errors.append(relative_error(ltl.weighted_laplacian(ltl.Surface.from_mesh(mesh), g, u), exact))
    assert np.log2(errors[0] / errors[2]) / 2 > 0.9
    assert errors[-1] < 1e-2
    for scheme in (ltl.Monotone(), ltl.Polynomial(3), ltl.Paper()):
        surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(3), scheme)
        x, y, _ = np.asarray(surface.vertices).T
        # div(x grad y) = x Delta y + grad x . grad y = -2 x y - x y on the unit sphere.
        assert relative_error(ltl.weighted_laplacian(surface, x, y), -3 * x * y) < 0.05
