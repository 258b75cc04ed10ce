"""A self-check of the backend, because some releases of jaxlib return wrong results for jit(vmap(...)), or hang.

jaxlib 0.10.2 silently returns wrong results for padded gathers on CPU (jax-ml/jax#39103), and jaxlib 0.10.1 hangs in
batched fits. The releases known to return wrong results are excluded in pyproject.toml.
"""

import os
import subprocess
import sys

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


def assert_equal(actual, expected, surface):
    tolerance = 20 * jnp.finfo(surface.dtype).eps
    np.testing.assert_allclose(actual, expected, rtol=0, atol=float(tolerance * np.abs(expected).max()))


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
    gradients = jax.jit(jax.vmap(energy))(jnp.asarray(batch))
    assert_equal(gradients, (matrix.T @ (matrix @ batch.T)).T, surface)


def test_the_jacobian_is_the_matrix(case):
    surface, matrix = case
    u = jnp.zeros(surface.num_vertices, surface.dtype)
    for jacobian in (jax.jacfwd, jax.jacrev):
        dense = jax.jit(jacobian(lambda u: ltl.laplacian(surface, u)))(u)
        assert_equal(dense, matrix.todense(), surface)


def test_batched_fits_terminate():
    """Runs at the size at which jaxlib 0.10.1 hangs under its default schedule, in a process with a time limit."""
    program = """
import jax.numpy as jnp, numpy as np, ltljax as ltl
x = np.linspace(0, 3, 3855)
model = lambda p: jnp.sin(p["a"] * x) + p["b"] * x + jnp.exp(-p["d"] * x)
truth = dict(a=1.0, b=2.0, d=0.5)
starts = {key: value * np.linspace(0.8, 1.2, 8) for key, value in truth.items()}
data = ltl.Observations(np.asarray(model(truth)), 0.1)
fits = ltl.inverse.fit_many(model, starts, data, transforms=ltl.inverse.Positive())
assert fits.losses.max() < 1e-3, fits.losses
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=100, env=os.environ | {"JAX_ENABLE_X64": "1"})
