"""A self-check of the backend: some releases of jaxlib return wrong results for jit(vmap(...)) of padded gathers.

jax-ml/jax#39103: jaxlib 0.10.2 on CPU, silently. The releases known to do so are excluded in pyproject.toml.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl

WIDTHS = [1, 2, 3, 4, 5, 8, 16, 17]


@pytest.fixture(scope="module", params=[jnp.float32, jnp.float64], ids=["float32", "float64"])
def case(request):
    surface = ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(2, 0.5, seed=3), dtype=request.param)
    return surface, ltl.laplacian_matrix(surface)


def assert_equal(found, expected, surface):
    tolerance = 20 * jnp.finfo(surface.dtype).eps
    np.testing.assert_allclose(found, expected, rtol=0, atol=float(tolerance * np.abs(expected).max()))


@pytest.mark.parametrize("width", WIDTHS)
def test_batched_laplacians_equal_the_sparse_matrix(case, width):
    surface, matrix = case
    batch = np.random.default_rng(width).normal(size=(width, surface.num_vertices)).astype(surface.dtype)
    expected = (matrix @ batch.T).T
    for function in (
        jax.vmap(ltl.laplacian, in_axes=(None, 0)),
        jax.jit(jax.vmap(ltl.laplacian, in_axes=(None, 0))),
        lambda s, u: ltl.laplacian(s, u.T).T,
    ):
        assert_equal(function(surface, jnp.asarray(batch)), expected, surface)


@pytest.mark.parametrize("width", WIDTHS)
def test_batched_gradients_equal_the_transposed_matrix(case, width):
    surface, matrix = case
    batch = np.random.default_rng(width).normal(size=(width, surface.num_vertices)).astype(surface.dtype)
    energy = jax.grad(lambda u: jnp.sum(ltl.laplacian(surface, u) ** 2) / 2)
    found = jax.jit(jax.vmap(energy))(jnp.asarray(batch))
    assert_equal(found, (matrix.T @ (matrix @ batch.T)).T, surface)


def test_the_jacobian_is_the_matrix(case):
    surface, matrix = case
    u = jnp.zeros(surface.num_vertices, surface.dtype)
    for jacobian in (jax.jacfwd, jax.jacrev):
        found = jax.jit(jacobian(lambda u: ltl.laplacian(surface, u)))(u)
        assert_equal(found, matrix.todense(), surface)
