"""Eigenmodes of the Laplacian: exact values, multiplets, and derivatives of eigenvalues in the shape."""

import jax
import numpy as np
import pytest
from scipy.special import jn_zeros

import ltljax as ltl


def test_eigenvalues_of_the_sphere_and_of_the_disk():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(4))
    modes = ltl.eigenmodes(surface, 9)
    values, vectors = modes
    np.testing.assert_allclose(values, [0, 2, 2, 2, 6, 6, 6, 6, 6], rtol=5e-3, atol=1e-8)
    assert modes.residuals.max() < 1e-3
    np.testing.assert_allclose(ltl.integrate(surface, vectors**2), 1, rtol=1e-8)
    np.testing.assert_allclose(modes.left.T @ vectors, np.eye(9), atol=1e-8)
    disk = ltl.Surface.from_mesh(ltl.shapes.disk())
    dirichlet_values = ltl.eigenmodes(disk, 3, ltl.Dirichlet()).values
    exact = [jn_zeros(0, 1)[0] ** 2, jn_zeros(1, 1)[0] ** 2, jn_zeros(1, 1)[0] ** 2]
    np.testing.assert_allclose(dirichlet_values, exact, rtol=1e-2)


def test_the_derivative_of_an_eigenvalue_in_the_shape_agrees_with_differences():
    surface = ltl.Surface.from_mesh(ltl.shapes.ellipsoid((1.0, 1.3, 1.7), subdivisions=3))
    x = surface.vertices

    def moved(stretch):
        return surface.with_vertices(x * (1 + stretch * x[:, :1] ** 2))

    modes = ltl.eigenmodes(surface, 4)
    slopes = jax.jacfwd(lambda s: modes.values_on(moved(s)))(0.0)
    step = 1e-4
    upper, lower = (ltl.eigenmodes(moved(sign * step), 4).values for sign in (1, -1))
    np.testing.assert_allclose(slopes[1:], (upper - lower)[1:] / (2 * step), rtol=1e-4)


def test_modes_of_large_multiplets_are_real_and_biorthonormal():
    # The mesh splits multiplets into pairs, real and complex, whose real parts agree to rounding.
    modes = ltl.eigenmodes(ltl.Surface.from_mesh(ltl.shapes.icosphere(4)), 81)
    degrees = np.repeat(np.arange(9), 2 * np.arange(9) + 1)
    np.testing.assert_allclose(modes.values, degrees * (degrees + 1), rtol=0.03, atol=1e-9)
    np.testing.assert_allclose(modes.left.T @ modes.vectors, np.eye(81), atol=1e-12)


@pytest.mark.parametrize("k", [7, 20, 384])
def test_all_members_of_a_multiplet_are_found_on_a_mesh_with_its_symmetry(k):
    # Many eigenvalues of a cube are threefold to rounding. An iteration from one start finds each of them once.
    surface = ltl.Surface.from_mesh(ltl.shapes.box(n=8))
    exact = np.sort(np.linalg.eigvals(-ltl.laplacian_matrix(surface).toarray()).real)
    np.testing.assert_allclose(ltl.eigenmodes(surface, k).values, exact[:k], rtol=1e-8, atol=1e-9)


def test_eigenmodes_refuse_more_modes_than_the_surface_has():
    with pytest.raises(ValueError, match="number of modes"):
        ltl.eigenmodes(ltl.Surface.from_mesh(ltl.shapes.icosphere(1)), 10**6)
