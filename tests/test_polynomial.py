"""`ltl.Polynomial()`: orders of accuracy, the jets it shares with `Monotone()`, growing modes, and curvature."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
from jax.test_util import check_grads

import ltljax as ltl

TORUS_SIZES = {3: (36, 18), 4: (72, 36), 5: (144, 72)}


def sphere(level):
    """A sphere without exact normals, a function u on it, and Delta u - u."""
    mesh = ltl.shapes.jittered_sphere(level, 0.5, seed=0)
    x, y, z = mesh.vertices.T
    e2, e3 = (x**2 - y**2) / 2, x * y * z
    return ltl.Mesh(mesh.vertices, mesh.faces), e2 + e3, -7 * e2 - 13 * e3


def torus(level):
    """A torus with radii 2 and 1, u = x + sin 2p with p the poloidal angle, and Delta u - u."""
    mesh = ltl.shapes.jittered_torus(*TORUS_SIZES[level], 0.45, seed=0)
    x, y, z = mesh.vertices.T
    p, w = np.arctan2(z, np.hypot(x, y) - 2), np.hypot(x, y)
    u, cosine = x + np.sin(2 * p), x / w
    slope, bend = -np.sin(p) * cosine + 2 * np.cos(2 * p), -np.cos(p) * cosine - 4 * np.sin(2 * p)
    laplacian = bend - np.sin(p) * slope / w - cosine / w
    return ltl.Mesh(mesh.vertices, mesh.faces), u, laplacian - u


def relative_error(approximation, exact):
    return float(np.linalg.norm(np.asarray(approximation) - exact) / np.linalg.norm(exact))


def elliptic_errors(case, scheme):
    """Relative errors of Delta u - u = f on three refinements."""
    errors = []
    for level in (3, 4, 5):
        mesh, u, right_hand_side = case(level)
        matrix = ltl.laplacian_matrix(ltl.Surface.from_mesh(mesh, scheme))
        operator = scipy.sparse.csc_matrix(matrix - scipy.sparse.eye_array(len(u)))
        errors.append(relative_error(scipy.sparse.linalg.spsolve(operator, right_hand_side), u))
    return errors


@pytest.mark.parametrize(("case", "order", "last"), [(sphere, 3.5, 2e-6), (torus, 3.0, 5e-5)])
def test_degree_4_has_high_order_for_stationary_problems(case, order, last):
    errors = elliptic_errors(case, ltl.Polynomial(4))
    assert np.log2(errors[0] / errors[2]) / 2 >= order
    assert np.log2(errors[1] / errors[2]) >= order
    assert errors[2] < last


def test_degree_3_is_second_order_for_stationary_problems():
    errors = elliptic_errors(sphere, ltl.Polynomial(3))
    assert np.log2(errors[0] / errors[2]) / 2 >= 1.9
    assert errors[2] < 1e-3


@pytest.mark.parametrize("degree", [3, 4])
def test_polynomials_of_the_same_degree_are_differentiated_exactly_in_the_plane(degree):
    mesh = ltl.shapes.jittered(ltl.shapes.square(n=12), 0.3, seed=0)
    surface = ltl.Surface.from_mesh(mesh, ltl.Polynomial(degree))
    x, y, _ = mesh.vertices.T
    n = degree
    u = x**n - 2 * x ** (n - 1) * y + y**2
    u_x, u_y = n * x ** (n - 1) - 2 * (n - 1) * x ** (n - 2) * y, -2 * x ** (n - 1) + 2 * y
    u_xx, u_xy = n * (n - 1) * x ** (n - 2) - 2 * (n - 1) * (n - 2) * x ** (n - 3) * y, -2 * (n - 1) * x ** (n - 2)
    np.testing.assert_allclose(ltl.gradient(surface, u), np.stack([u_x, u_y, 0 * x], axis=1), atol=1e-9)
    hessian = np.asarray(ltl.hessian(surface, u))
    np.testing.assert_allclose(hessian[:, 0, 0], u_xx, atol=1e-7)
    np.testing.assert_allclose(hessian[:, 0, 1], u_xy, atol=1e-7)
    np.testing.assert_allclose(hessian[:, 1, 1], 2, atol=1e-7)
    is_interior = ~mesh.boundary_vertices
    np.testing.assert_allclose(np.asarray(ltl.laplacian(surface, u))[is_interior], (u_xx + 2)[is_interior], atol=1e-7)
    # Boundary rows assume zero flux, and are exact if the actual flux is passed.
    flux = np.stack([u_x, u_y, 0 * x], axis=1)
    is_smooth = np.asarray(surface.topology.kinds) <= 1
    np.testing.assert_allclose(np.asarray(ltl.laplacian(surface, u, flux))[is_smooth], (u_xx + 2)[is_smooth], atol=1e-6)


@pytest.mark.parametrize("scheme", [ltl.Monotone(), ltl.Polynomial(3), ltl.Polynomial(4)])
def test_the_jets_of_hessian_laplacian_and_divergence_agree(scheme):
    mesh = ltl.shapes.jittered_sphere(3, 0.3, seed=1)
    surface = ltl.Surface.from_mesh(mesh, scheme)
    u = jnp.asarray(mesh.vertices[:, 0] * mesh.vertices[:, 1] + mesh.vertices[:, 2])
    hessian = np.asarray(ltl.hessian(surface, u))
    np.testing.assert_allclose(hessian, np.swapaxes(hessian, 1, 2), atol=1e-12)
    normal_part = np.einsum("vcd,vd->vc", hessian, np.asarray(surface.normals))
    assert np.abs(normal_part).max() < 1e-12
    trace, laplacian = np.trace(hessian, axis1=1, axis2=2), np.asarray(ltl.laplacian(surface, u))
    # The Laplacian is the trace of the Hessian where both use the same neighbours.
    is_same_fit = np.ones(len(u), bool)
    if isinstance(scheme, ltl.Monotone):
        is_same_fit = (surface.report.rings == 1) & ~np.isin(np.arange(len(u)), surface.report.wide_gradient_rows)
    assert is_same_fit.mean() > 0.9
    np.testing.assert_allclose(trace[is_same_fit], laplacian[is_same_fit], atol=1e-8 * np.abs(laplacian).max())
    # The divergence uses another fit, so it agrees only up to the discretisation error.
    divergence = ltl.divergence(surface, ltl.gradient(surface, u))
    assert relative_error(divergence, laplacian) < 0.05


@pytest.mark.parametrize(
    ("scheme", "order", "last"),
    [(ltl.Monotone(), 0.8, 1.5e-1), (ltl.Polynomial(3), 1.8, 1.5e-2), (ltl.Polynomial(4), 2.8, 1e-3)],
)
@pytest.mark.parametrize("shape", ["sphere", "torus"])
def test_the_largest_error_of_the_curvature_converges(scheme, order, last, shape):
    errors = []
    for level in (3, 4, 5):
        if shape == "sphere":
            mesh = ltl.shapes.jittered_sphere(level, 0.5, seed=0)
            gauss = np.ones(mesh.num_vertices)
        else:
            mesh = ltl.shapes.jittered_torus(*TORUS_SIZES[level], 0.45, seed=0)
            distance = np.hypot(*mesh.vertices[:, :2].T)
            gauss = (distance - 2) / distance
        curvature = ltl.curvature(ltl.Surface.from_mesh(mesh, scheme))
        mean = (1 + gauss) / 2
        errors.append((np.abs(curvature.mean - mean).max(), np.abs(curvature.gauss - gauss).max()))
    errors = np.array(errors)
    assert (np.log2(errors[0] / errors[2]) / 2 > order).all()
    assert (errors[2] < last).all()


def test_principal_curvatures_and_directions_of_a_cylinder_are_accurate():
    mesh = ltl.shapes.cylinder(radius=0.5, n_around=48, n_along=24)
    curvature = ltl.curvature(ltl.Surface.from_mesh(mesh))
    np.testing.assert_allclose(curvature.principal, np.broadcast_to([2.0, 0.0], (mesh.num_vertices, 2)), atol=2e-2)
    np.testing.assert_allclose(np.abs(curvature.directions[:, 1, 2]), 1, atol=1e-3)
    around = np.stack([-mesh.vertices[:, 1], mesh.vertices[:, 0], 0 * mesh.vertices[:, 0]], axis=1) / 0.5
    np.testing.assert_allclose(np.einsum("vcd,vd->vc", curvature.shape_operator, around), 2 * around, atol=3e-2)
    assert (curvature.principal[:, 0] >= curvature.principal[:, 1]).all()


@pytest.mark.slow
def test_curvature_is_differentiable_in_the_vertices_also_at_umbilics():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1))

    @jax.jit
    def total(vertices):
        curvature = ltl.curvature(surface.with_vertices(vertices))
        return jnp.sum(curvature.mean * curvature.gauss)

    check_grads(total, (surface.vertices,), order=1, modes=("rev",), rtol=1e-5, eps=1e-6)
    flat = ltl.Surface.from_mesh(ltl.shapes.square(n=4))
    gradient = jax.grad(lambda v: jnp.sum(ltl.curvature(flat.with_vertices(v)).principal))(flat.vertices)
    assert np.isfinite(np.asarray(gradient)).all()


def test_solve_warns_of_growing_modes_before_it_steps():
    bad = ltl.Surface.from_mesh(ltl.shapes.random_sphere(642, seed=0), ltl.Polynomial(4))
    exact = np.linalg.eigvals(ltl.laplacian_matrix(bad).todense()).real.max()
    assert exact > 1
    assert ltl.operators.growth_rate(bad) == pytest.approx(exact, rel=1e-2)
    # The tests turn warnings into exceptions, so that nothing is compiled for the steps.
    with pytest.raises(ltl.errors.GrowingModesWarning, match="grow like exp"):
        ltl.solve(ltl.Diffusion(), bad, bad.vertices[:, 0], 1e-6)
    good = ltl.Surface.from_mesh(ltl.shapes.icosphere(3), ltl.Polynomial(4))
    x = np.asarray(good.vertices[:, 0])
    u = ltl.solve(ltl.Diffusion(), good, x, 0.5, rtol=1e-7, atol=1e-9).us[-1]
    assert relative_error(u, x * np.exp(-1.0)) < 2e-3


def test_a_mesh_too_small_for_the_fit_warns():
    with pytest.warns(ltl.errors.InconsistentRowsWarning, match=r"At 12 vertices.*polynomial of degree 4.*subdivide"):
        ltl.Surface.from_mesh(ltl.shapes.icosphere(0), ltl.Polynomial(4))


def test_other_degrees_raise():
    with pytest.raises(ValueError, match=r"degree 3 or 4, found 2.*Monotone"):
        ltl.Polynomial(2)


def test_operators_that_the_published_scheme_lacks_raise():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1), ltl.Paper())
    for operator in (lambda: ltl.hessian(surface, surface.vertices[:, 0]), lambda: ltl.curvature(surface)):
        with pytest.raises(ValueError, match="no second derivatives"):
            operator()
    with pytest.raises(ValueError, match="supports no flux"):
        ltl.laplacian(surface, surface.vertices[:, 0], flux=surface.vertices[:, 0])
    with pytest.raises(ValueError, match="has no conserved measure"):
        _ = surface.mass


def test_a_mesh_too_coarse_for_degree_4_to_be_more_accurate_warns():
    with pytest.warns(ltl.errors.CoarseMeshWarning, match=r"ltl\.Monotone\(\) is at least as accurate"):
        ltl.Surface.from_mesh(ltl.shapes.torus(2.0, 1.0, 28, 14), ltl.Polynomial())
    with warnings.catch_warnings():
        warnings.simplefilter("error", ltl.errors.CoarseMeshWarning)
        ltl.Surface.from_mesh(ltl.shapes.torus(2.0, 1.0, 80, 40), ltl.Polynomial())
        # The angle of a crease does not count as curvature of its sides.
        ltl.Surface.from_mesh(ltl.shapes.box(n=8), ltl.Polynomial())
