"""Curvature of polyhedra: integrals are exact, and the share of creases is named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_intrinsic import strip

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
    bent = ltl.operators.polyhedral_curvature(surface)
    total = ltl.integrate(surface, bent.gauss) + jnp.sum(bent.turning)
    assert float(total) == pytest.approx(2 * np.pi * mesh.report.euler_number, abs=1e-9)


def test_mean_curvature_of_a_sphere():
    surface = ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(4, 0.3, seed=0).scaled(2))
    bent = ltl.operators.polyhedral_curvature(surface)
    # The integral of H over a sphere of radius R is 4 pi R.
    assert float(ltl.integrate(surface, bent.mean)) == pytest.approx(8 * np.pi, rel=2e-3)
    np.testing.assert_allclose(bent.crease_mean, 0)


def test_all_curvature_of_a_fold_is_in_its_crease():
    mesh, x = strip(8, 90)
    surface = ltl.Surface.from_mesh(mesh)
    bent = ltl.operators.polyhedral_curvature(surface)
    # The crease is concave seen from the side of the normals: half of length times angle.
    assert float(ltl.integrate(surface, bent.crease_mean)) == pytest.approx(-np.pi / 4)
    np.testing.assert_allclose(bent.mean, bent.crease_mean, atol=1e-9)
    np.testing.assert_allclose(np.asarray(bent.gauss), 0, atol=1e-9)
    # Its vector Laplacian and that of Hodge agree: the fold is flat inside.
    X = ltl.gradient(surface, jnp.sin(3 * x))
    inside = ~mesh.boundary_vertices
    both = [f(surface, X)[inside] for f in (ltl.vectors.hodge_laplacian, ltl.vector_laplacian)]
    np.testing.assert_allclose(*both, atol=1e-6)


def test_it_is_differentiable_in_the_vertices():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1), ltl.Paper())
    direction = np.random.default_rng(0).normal(size=surface.vertices.shape)

    @jax.jit
    def total(h):
        bent = ltl.operators.polyhedral_curvature(surface.with_vertices(surface.vertices + h * direction))
        return jnp.sum(bent.mean**2 + bent.gauss**2)

    slope, step = jax.grad(total)(0.0), 1e-5
    assert float((total(step) - total(-step)) / (2 * step)) == pytest.approx(float(slope), rel=1e-6)


@pytest.mark.parametrize("lift", ["intrinsic", "chord", "projection"])
def test_the_fitted_curvature_of_a_sphere_is_nearly_exact_whatever_the_lift(lift):
    surface = ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(3, 0.4, seed=0), ltl.Monotone(lift=lift))
    found = ltl.curvature(surface)
    np.testing.assert_allclose(found.mean, 1, atol=1e-4)
    np.testing.assert_allclose(found.gauss, 1, atol=1e-4)


@pytest.mark.parametrize("ratio", [1e-2, 1e-4])
def test_curvature_is_accurate_in_float32_beside_a_very_short_edge(ratio):
    mesh = ltl.shapes.jittered_sphere(2, 0.4, seed=0)
    vertices, (v, w) = mesh.vertices.copy(), mesh.edges[10]
    vertices[w] = vertices[v] + ratio * (vertices[w] - vertices[v])
    vertices[w] /= np.linalg.norm(vertices[w])
    with jax.enable_x64(False):
        surface = ltl.Surface.from_mesh(ltl.Mesh(vertices, mesh.faces, normals=vertices))
        found = ltl.curvature(surface)
    assert surface.dtype == jnp.float32
    np.testing.assert_allclose(found.mean, 1, atol=1e-3)
    np.testing.assert_allclose(found.gauss, 1, atol=2e-3)
