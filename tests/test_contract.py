"""The contract of every operator under every scheme: jit, vmap, columns, derivatives in the field and the vertices."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import ltljax as ltl

SCHEMES = {
    "paper": ltl.Paper(),
    "monotone": ltl.Monotone(),
    "projection": ltl.Monotone(lift="projection"),
    "polynomial": ltl.Polynomial(degree=3),
}
OPERATORS = {
    "gradient": ltl.gradient,
    "divergence": ltl.divergence,
    "laplacian": ltl.laplacian,
    "integrate": ltl.integrate,
    "hessian": ltl.hessian,
    "conduction": lambda surface, u: ltl.weighted_laplacian(surface, 1 + surface.vertices[:, 0] ** 2, u),
}
MESHES = {"closed": lambda: ltl.shapes.jittered_sphere(1, 0.3, seed=2), "open": lambda: bent_disk()}


def bent_disk():
    disk = ltl.shapes.disk(rings=3)
    flat = disk.vertices + np.random.default_rng(0).uniform(-0.03, 0.03, disk.vertices.shape)
    flat[:, 2] += 0.3 * flat[:, 0] ** 2 - 0.2 * flat[:, 0] * flat[:, 1]
    return ltl.Mesh(flat, disk.faces)


# Each scheme and each mesh is in one quick pair; the other pairs are slow.
QUICK = {("paper", "closed"), ("monotone", "open"), ("polynomial", "closed")}


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(pair, id="-".join(pair), marks=[] if pair in QUICK else pytest.mark.slow)
        for pair in itertools.product(SCHEMES, MESHES)
    ],
)
def surface(request):
    scheme, mesh = request.param
    return ltl.Surface.from_mesh(MESHES[mesh](), SCHEMES[scheme])


def field(surface, name, seed=0):
    shape = (surface.num_vertices, 3) if name == "divergence" else (surface.num_vertices,)
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


@pytest.fixture(params=list(OPERATORS))
def name(request, surface):
    if request.param == "hessian" and isinstance(surface.scheme, ltl.Paper):
        return "gradient"  # Paper has no second derivatives
    return request.param


def test_jit_equals_eager(surface, name):
    u, operator = field(surface, name), OPERATORS[name]
    with jax.disable_jit():
        eager = operator(surface, u)
    np.testing.assert_allclose(jax.jit(operator)(surface, u), eager, rtol=0, atol=1e-12 * float(jnp.abs(eager).max()))


def test_vmap_and_columns_equal_the_loop(surface, name):
    operator = OPERATORS[name]
    fields = jnp.stack([field(surface, name, seed) for seed in range(3)])
    one_by_one = np.stack([operator(surface, u) for u in fields])
    tolerance = 1e-12 * np.abs(one_by_one).max()
    np.testing.assert_allclose(jax.vmap(lambda u: operator(surface, u))(fields), one_by_one, rtol=0, atol=tolerance)
    columns = np.asarray(operator(surface, jnp.moveaxis(fields, 0, 1)))
    axis = 0 if name == "integrate" else 1
    np.testing.assert_allclose(np.moveaxis(columns, axis, 0), one_by_one, rtol=0, atol=tolerance)


def test_the_laplacian_equals_its_matrix(surface):
    u = field(surface, "laplacian")
    expected = ltl.laplacian_matrix(surface) @ np.asarray(u)
    np.testing.assert_allclose(ltl.laplacian(surface, u), expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["gradient", "divergence", "laplacian"])
def test_derivatives_in_the_field(surface, name):
    u = field(surface, name)
    check_grads(lambda u: OPERATORS[name](surface, u), (u,), order=2, modes=("fwd", "rev"), rtol=1e-6, atol=1e-6)


def dented_sphere():
    # All rows have nearly the same length, so there is little to compile.
    sphere = ltl.shapes.icosphere(1)
    return ltl.Mesh(sphere.vertices + 0.05 * np.random.default_rng(0).normal(size=sphere.vertices.shape), sphere.faces)


@pytest.mark.parametrize("make", [dented_sphere, pytest.param(bent_disk, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["paper", "monotone", pytest.param("polynomial", marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore::ltljax.errors.InconsistentRowsWarning")
def test_derivatives_of_gradient_and_laplacian_in_the_vertices(make, name):
    surface = ltl.Surface.from_mesh(make(), SCHEMES[name])
    u = field(surface, "laplacian")

    @jax.jit
    def moved(vertices):
        surface_of_vertices = surface.with_vertices(vertices)
        return ltl.gradient(surface_of_vertices, u), ltl.laplacian(surface_of_vertices, u)

    check_grads(moved, (surface.vertices,), order=1, modes=("fwd", "rev"), rtol=1e-5, atol=1e-5, eps=1e-6)


def test_weighing_on_the_device_equals_building_on_the_host(surface):
    reweighed = jax.jit(lambda s, v: s.with_vertices(v))(surface, surface.vertices)
    for built, weighed in zip(jax.tree.leaves(surface.geometry), jax.tree.leaves(reweighed.geometry), strict=True):
        scale = max(float(jnp.abs(built).max(initial=0)), 1.0)
        np.testing.assert_allclose(weighed, built, rtol=0, atol=1e-12 * scale)


def test_empty_slots_have_no_weight(surface):
    num_empty, laplacian = 0, surface.laplacian_stencil
    single = (laplacian,) if isinstance(laplacian, ltl.operators.Stencil) else ()
    for stencil in (*surface.gradient_stencils, *surface.divergence_stencils, *single):
        for block, weight in zip(stencil.table.blocks, stencil.weights, strict=True):
            owners = np.arange(surface.num_vertices) if block.rows is None else np.asarray(block.rows)
            is_empty = np.asarray(block.indices) == owners
            num_empty += is_empty.sum()
            assert not np.asarray(weight)[is_empty].any()
    assert num_empty > 0 or isinstance(surface.scheme, ltl.Polynomial)


def test_a_surface_moves_with_its_mesh(surface):
    turn, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    u = field(surface, "laplacian")
    turned = surface.with_vertices(2 * surface.vertices @ jnp.asarray(turn).T + 5)
    expected = ltl.laplacian(surface, u) / 4
    np.testing.assert_allclose(ltl.laplacian(turned, u), expected, rtol=0, atol=1e-9 * float(jnp.abs(expected).max()))
    expected = ltl.gradient(surface, u) @ turn.T / 2
    np.testing.assert_allclose(ltl.gradient(turned, u), expected, rtol=0, atol=1e-9 * float(jnp.abs(expected).max()))


@pytest.mark.parametrize("scheme", list(SCHEMES.values()), ids=list(SCHEMES))
def test_float32_is_within_1e_4_of_float64(scheme):
    mesh = ltl.shapes.icosphere(4)
    u = mesh.vertices.prod(axis=1) + (mesh.vertices[:, 0] ** 2 - mesh.vertices[:, 1] ** 2) / 2
    double, single = (ltl.Surface.from_mesh(mesh, scheme, dtype) for dtype in (jnp.float64, jnp.float32))
    for operator in (ltl.gradient, ltl.laplacian):
        exact, rounded = np.asarray(operator(double, u)), np.asarray(operator(single, u.astype(np.float32)))
        assert rounded.dtype == np.float32
        assert np.abs(rounded - exact).max() < 1e-4 * np.abs(exact).max()


def test_fields_that_do_not_fit_are_refused(surface):
    with pytest.raises(ValueError, match=r"one row per vertex.*found shape \(5,\)"):
        ltl.laplacian(surface, jnp.zeros(5))
    with pytest.raises(ValueError, match=r"vector field of shape.*found"):
        ltl.divergence(surface, jnp.zeros(surface.num_vertices))
    with pytest.raises(ValueError, match="Expected vertices of shape"):
        surface.with_vertices(jnp.zeros((5, 3)))


def test_float_types_that_are_not_available_are_refused():
    mesh = ltl.shapes.icosphere(1)
    with pytest.raises(ValueError, match="found int32"):
        ltl.Surface.from_mesh(mesh, dtype=jnp.int32)
    with jax.enable_x64(False):
        with pytest.raises(ValueError, match="jax_enable_x64"):
            ltl.Surface.from_mesh(mesh, dtype=jnp.float64)
        assert ltl.Surface.from_mesh(mesh).dtype == jnp.float32


@pytest.mark.parametrize("scheme", [ltl.Paper(), ltl.Monotone(), ltl.Polynomial(degree=4)], ids=str)
def test_weights_do_not_depend_on_whether_positions_are_computed_in_the_same_jit(scheme):
    # XLA may recompute such positions for each use, so differences that vanish in exact arithmetic need not vanish.
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2), scheme)

    def moved(surface):
        return surface.vertices * (1 + 0.1 * surface.vertices[:, :1])

    traced = jax.jit(lambda surface: surface.with_vertices(moved(surface)).geometry)(surface)
    eager = surface.with_vertices(moved(surface)).geometry
    for (path, weights), expected in zip(
        jax.tree_util.tree_leaves_with_path(traced), jax.tree.leaves(eager), strict=True
    ):
        if weights.size and "residual" not in jax.tree_util.keystr(path):
            scale = np.abs(expected).max()
            np.testing.assert_allclose(weights / scale, expected / scale, atol=1e-9, err_msg=jax.tree_util.keystr(path))
