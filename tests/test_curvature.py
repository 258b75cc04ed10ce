"""Curvature of polyhedra and of fitted surfaces: integrals are exact, and the curvature of creases is separate."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sharp_shapes import strip

import ltljax as ltl


@pytest.mark.parametrize("name", ["sphere", "torus", "disk", "spot_low.obj", "bunny_closed.obj", "hand_open.obj"])
@pytest.mark.filterwarnings("ignore::ltljax.errors.InconsistentRowsWarning")
def test_gauss_and_bonnet_hold_to_rounding(name, real_mesh):
    shapes = {
        "sphere": lambda: ltl.shapes.random_sphere(300, seed=0),
        "torus": lambda: ltl.shapes.jittered_torus(24, 12, 0.45, seed=0),
        "disk": lambda: ltl.shapes.jittered(ltl.shapes.disk(rings=6), 0.3, seed=0),
    }
    mesh = shapes[name]() if name in shapes else ltl.load_mesh(real_mesh(name))
    surface = ltl.Surface.from_mesh(mesh, ltl.Paper())
    curvature = ltl.operators.polyhedral_curvature(surface)
    total = ltl.integrate(surface, curvature.gauss) + jnp.sum(curvature.turning)
    assert float(total) == pytest.approx(2 * np.pi * mesh.report.euler_number, abs=1e-9)


def test_the_integral_of_the_mean_curvature_of_a_sphere_is_accurate():
    surface = ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(4, 0.3, seed=0).scaled(2))
    curvature = ltl.operators.polyhedral_curvature(surface)
    # The integral of H over a sphere of radius R is 4 pi R.
    assert float(ltl.integrate(surface, curvature.mean)) == pytest.approx(8 * np.pi, rel=2e-3)
    np.testing.assert_allclose(curvature.crease_mean, 0)


def test_all_curvature_of_a_fold_is_in_its_crease():
    surface = ltl.Surface.from_mesh(strip(8, 90)[0])
    curvature = ltl.operators.polyhedral_curvature(surface)
    # The integral of H is half the length times the angle; the crease is concave on the side of the normals.
    assert float(ltl.integrate(surface, curvature.crease_mean)) == pytest.approx(-np.pi / 4)
    np.testing.assert_allclose(curvature.mean, curvature.crease_mean, atol=1e-9)
    np.testing.assert_allclose(np.asarray(curvature.gauss), 0, atol=1e-9)


def test_the_two_vector_laplacians_agree_inside_a_fold_which_is_intrinsically_flat():
    mesh, x = strip(8, 90)
    surface = ltl.Surface.from_mesh(mesh)
    X = ltl.gradient(surface, jnp.sin(3 * x))
    is_interior = ~mesh.boundary_vertices
    laplacians = [f(surface, X)[is_interior] for f in (ltl.vectors.hodge_laplacian, ltl.vector_laplacian)]
    np.testing.assert_allclose(*laplacians, atol=1e-6)


def test_polyhedral_curvature_is_differentiable_in_the_vertices():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1), ltl.Paper())
    direction = np.random.default_rng(0).normal(size=surface.vertices.shape)

    @jax.jit
    @jax.value_and_grad
    def total(h):
        curvature = ltl.operators.polyhedral_curvature(surface.with_vertices(surface.vertices + h * direction))
        return jnp.sum(curvature.mean**2 + curvature.gauss**2)

    (_, slope), step = total(0.0), 1e-5
    assert float((total(step)[0] - total(-step)[0]) / (2 * step)) == pytest.approx(float(slope), rel=1e-6)


@pytest.mark.parametrize("lift", ["intrinsic", "chord", "projection"])
def test_the_fitted_curvature_of_a_sphere_is_nearly_exact_whatever_the_lift(lift):
    surface = ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(3, 0.4, seed=0), ltl.Monotone(lift=lift))
    curvature = ltl.curvature(surface)
    np.testing.assert_allclose(curvature.mean, 1, atol=1e-4)
    np.testing.assert_allclose(curvature.gauss, 1, atol=1e-4)


@pytest.mark.parametrize("ratio", [1e-2, 1e-4])
def test_curvature_is_accurate_in_float32_beside_a_very_short_edge(ratio):
    mesh = ltl.shapes.jittered_sphere(2, 0.4, seed=0)
    vertices, (v, w) = mesh.vertices.copy(), mesh.edges[10]
    vertices[w] = vertices[v] + ratio * (vertices[w] - vertices[v])
    vertices[w] /= np.linalg.norm(vertices[w])
    with jax.enable_x64(False):
        surface = ltl.Surface.from_mesh(ltl.Mesh(vertices, mesh.faces, normals=vertices))
        curvature = ltl.curvature(surface)
    assert surface.dtype == jnp.float32
    np.testing.assert_allclose(curvature.mean, 1, atol=1e-3)
    np.testing.assert_allclose(curvature.gauss, 1, atol=2e-3)
