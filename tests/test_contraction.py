"""Every derivative of the sum over slots, under every transformation, equals that of the dense trilinear form."""

import itertools
import os
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import lineax  # noqa: F401  (with it JAX can transpose stop_gradient)
import numpy as np
import pytest
from jax.test_util import check_grads

import ltljax as ltl
from ltljax._tables import build_table, difference_sum, differences, reverse_weights, reversible

# Few tables, since every shape is compiled: short rows, no neighbours at all, and rows long enough for a tail.
ROWS = {
    "short": [[1, 2], [2, 0], [0], []],
    "empty": [[], [], []],
    "long": [[1], [0], [1, 3], [2], [0, 1, 2, 3] * 10, [4, 4], [5] * 14],
}


def table_of(rows):
    rows = [[j for j in row if j != v] for v, row in enumerate(rows)]
    offsets = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
    return build_table(offsets, np.array([j for row in rows for j in row], np.int32))


def weights_of(table, random):
    own = [np.arange(table.num_vertices) if block.rows is None else block.rows for block in table.blocks]
    pairs = zip(table.blocks, own, strict=True)
    return tuple(jnp.asarray(random.normal(size=b.indices.shape) * (b.indices != o)) for b, o in pairs)


def dense_of(table, weights):
    """The matrix of the sum, written in plain JAX as an independent, differentiable reference."""
    matrix = jnp.zeros((table.num_vertices,) * 2)
    for block, weight in zip(table.blocks, weights, strict=True):
        own = np.arange(table.num_vertices) if block.rows is None else block.rows
        matrix = matrix.at[np.broadcast_to(own, block.indices.shape), block.indices].add(weight)
    return matrix - jnp.diag(matrix.sum(axis=1))


KINDS = ["reverse given", "reverse computed", "no reverse"]


def sum_of(table, kind):
    """The sum as a function of weights and field."""
    table = table if kind == "no reverse" else reversible(table)
    if kind == "reverse given":
        return lambda w, u: difference_sum(table, w, u, jax.lax.stop_gradient(reverse_weights(table, w)))
    return lambda w, u: difference_sum(table, w, u)


def assert_close(result, expected):
    assert jax.tree.structure(result) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "rows", "species"),
    [
        ("reverse given", "long", (2, 2)),
        ("reverse given", "short", ()),
        ("reverse given", "empty", (3,)),
        ("reverse computed", "long", ()),
        ("reverse computed", "empty", (1,)),
        ("no reverse", "long", (3,)),
        ("no reverse", "short", (2, 2)),
        ("no reverse", "empty", ()),
    ],
)
def test_the_sum_and_its_transposes_equal_the_dense_form(kind, rows, species):
    table, random = table_of(ROWS[rows]), np.random.default_rng(0)
    weights = weights_of(table, random)
    u, y = (jnp.asarray(random.normal(size=(table.num_vertices, *species))) for _ in range(2))
    result, reverse_pass = jax.vjp(sum_of(table, kind), weights, u)
    expected, dense_reverse_pass = jax.vjp(lambda w, u: jnp.tensordot(dense_of(table, w), u, axes=1), weights, u)
    assert_close(result, expected)
    (in_weights, in_field), (dense_in_weights, dense_in_field) = reverse_pass(y), dense_reverse_pass(y)
    assert_close(in_field, dense_in_field)
    for block, derivative, dense in zip(table.blocks, in_weights, dense_in_weights, strict=True):
        own = np.arange(table.num_vertices) if block.rows is None else block.rows
        # The derivative in an empty slot is that of a difference that is always zero.
        np.testing.assert_allclose(derivative, jnp.where(block.indices == own, 0, dense), atol=1e-9)


@pytest.fixture(scope="module")
def case():
    """A table whose rows and reverse both have tail blocks, with weights and a field."""
    random = np.random.default_rng(0)
    rows = [list(random.choice(14, size=random.integers(1, 5), replace=False)) for _ in range(14)]
    rows[3], rows[7] = list(range(14)) * 3, [3, *list(range(8, 14))]
    table = table_of([list(map(int, row)) + ([5] if v != 5 else []) for v, row in enumerate(rows)])
    assert len(table.blocks) > 1
    assert table.blocks[-1].indices.shape[0] > 32  # a row too long to be unrolled
    assert len(reversible(table).reverse.users.blocks) > 1
    return table, weights_of(table, random), jnp.asarray(random.normal(size=(14, 2)))


def run(apply, w, u):
    """A run of three steps that is nonlinear in all arguments, so that no derivative is trivial."""
    u, _ = jax.lax.scan(lambda u, _: (u + 0.1 * jnp.tanh(apply(w, u) * u), None), u, length=3)
    return jnp.sum(u**3)


def checkpointed(apply, w, u):
    u, _ = jax.lax.scan(jax.checkpoint(lambda u, _: (u + 0.1 * jnp.tanh(apply(w, u) * u), None)), u, length=3)
    return jnp.sum(u**3)


def stacked(tree, count):
    return jax.tree.map(lambda leaf: jnp.stack([leaf * (k + 1) for k in range(count)]), tree)


TRANSFORMED = {
    "jit": lambda f, w, u: jax.jit(f)(w, u),
    "vmap over fields": lambda f, w, u: jax.vmap(f, in_axes=(None, 0))(w, stacked(u, 3)),
    "vmap over the last axis": lambda f, w, u: jax.vmap(f, in_axes=(None, -1), out_axes=-1)(w, u),
    "vmap over weights": lambda f, w, u: jax.vmap(f, in_axes=(0, None))(stacked(w, 3), u),
    "vmap over both": lambda f, w, u: jax.vmap(f)(stacked(w, 3), stacked(u, 3)),
    "vmap over one, then the other": lambda f, w, u: jax.vmap(jax.vmap(f, (None, 0)), (0, None))(
        stacked(w, 2), stacked(u, 3)
    ),
    "gradient": lambda f, w, u: jax.grad(run, argnums=(1, 2))(f, w, u),
    "gradient through checkpoints": lambda f, w, u: jax.jit(
        jax.grad(lambda w, u: checkpointed(f, w, u), argnums=(0, 1))
    )(w, u),
    "gradient of a vmap over weights": lambda f, w, u: jax.grad(
        lambda u: jnp.sum(jnp.sin(jax.vmap(f, in_axes=(0, None))(stacked(w, 3), u)))
    )(u),
    "gradient in weights of a vmap over fields": lambda f, w, u: jax.grad(
        lambda w: jnp.sum(jnp.sin(jax.vmap(f, in_axes=(None, 0))(w, stacked(u, 3))))
    )(w),
    "vmap of gradients": lambda f, w, u: jax.vmap(lambda w: jax.grad(lambda w, u: run(f, w, u), argnums=(0, 1))(w, u))(
        stacked(w, 2)
    ),
    "jacfwd": lambda f, w, u: jax.jacfwd(f, argnums=(0, 1))(w, u),
    "jacrev": lambda f, w, u: jax.jacrev(f, argnums=(0, 1))(w, u),
    "hessian": lambda f, w, u: jax.jit(jax.hessian(lambda w, u: run(f, w, u), argnums=(0, 1)))(w, u),
    "reverse over reverse": lambda f, w, u: jax.grad(lambda w: jnp.sum(jax.grad(lambda u: run(f, w, u))(u) ** 2))(w),
    "linear transpose": lambda f, w, u: jax.linear_transpose(lambda u: f(w, u), u)(u),
    "linear transpose in weights": lambda f, w, u: jax.linear_transpose(lambda w: f(w, u), w)(u),
    "linearize": lambda f, w, u: jax.linearize(f, w, u)[1](w, u),
}


# A surface has its reverse, so that kind is checked under every transformation; the slow tests check the full product.
QUICK = {("jit", "no reverse"), ("gradient", "reverse computed"), ("vmap over both", "reverse computed")}


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        pytest.param(*pair, marks=[] if pair[1] == "reverse given" or pair in QUICK else pytest.mark.slow)
        for pair in itertools.product(TRANSFORMED, KINDS)
    ],
)
def test_transformations_equal_those_of_the_dense_form(case, name, kind):
    table, weights, u = case
    used = [b.indices != (np.arange(14) if b.rows is None else b.rows) for b in table.blocks]

    def masked(f):  # without derivatives in empty slots, which the dense form has no counterpart of
        return lambda w, u: f(tuple(jnp.where(m, x, 0) for m, x in zip(used, w, strict=True)), u)

    transform = TRANSFORMED[name]
    result = transform(masked(sum_of(table, kind)), weights, u)
    assert_close(result, transform(masked(lambda w, u: dense_of(table, w) @ u), weights, u))


def test_first_and_second_derivatives_agree_with_differences(case):
    table, weights, u = case
    apply = sum_of(table, "reverse given")
    check_grads(
        lambda w, u: jnp.sin(0.1 * apply(w, u)), (weights, u), order=2, modes=("fwd", "rev"), atol=1e-5, rtol=1e-5
    )


def test_tables_of_the_same_shape_can_be_batched():
    random = np.random.default_rng(1)
    rows = [[[(v + k) % 8 for k in (range(1, 8) if v == 3 else (1, 2 + s, 5))] for v in range(8)] for s in (0, 1)]
    tables = [reversible(table_of(rows_of_table)) for rows_of_table in rows]
    assert len(tables[0].blocks) > 1
    weights = [weights_of(table, random) for table in tables]
    u = jnp.asarray(random.normal(size=8))
    stacked_tables = jax.tree.map(lambda *leaves: jnp.stack(leaves), *tables)
    ws = jax.tree.map(lambda *leaves: jnp.stack(leaves), *weights)
    reverses = jax.vmap(reverse_weights)(stacked_tables, ws)
    energy = lambda table, w, u, reverse: jnp.sum(difference_sum(table, w, u, reverse) ** 2)  # noqa: E731
    for reverse in (None, reverses):
        gradient = jax.vmap(jax.grad(energy, argnums=(1, 2)), in_axes=(0, 0, None, None if reverse is None else 0))
        in_weights, in_field = gradient(stacked_tables, ws, u, reverse)
        for k, (table, w) in enumerate(zip(tables, weights, strict=True)):
            matrix = dense_of(table, w)
            np.testing.assert_allclose(in_field[k], 2 * matrix.T @ (matrix @ u), atol=1e-10)
            expected = jax.grad(lambda w, t=table: jnp.sum((dense_of(t, w) @ u) ** 2))(w)
            for block, derivatives, dense in zip(table.blocks, in_weights, expected, strict=True):
                own = np.arange(8) if block.rows is None else block.rows
                np.testing.assert_allclose(derivatives[k], jnp.where(block.indices == own, 0, dense), atol=1e-10)


def test_a_batch_of_reverses_alone_is_a_batch(case):
    table, w, u = case
    table = reversible(table)
    reverses = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), reverse_weights(table, w))
    energy = lambda w: jnp.sum(jax.vmap(lambda r: difference_sum(table, w, u, r) ** 2)(reverses))  # noqa: E731
    single = jax.grad(lambda w: jnp.sum(difference_sum(table, w, u) ** 2))(w)
    assert_close(jax.grad(energy)(w), jax.tree.map(lambda leaf: 2 * leaf, single))


@pytest.mark.parametrize("argument", ["weights", "field", "reverse"])
def test_gradients_have_the_dtype_of_their_argument(case, argument):
    table, w, u = case
    table = reversible(table)
    data = dict(weights=w, field=u, reverse=reverse_weights(table, w))
    data[argument] = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), data[argument])
    with jax.numpy_dtype_promotion("standard"):
        energy = lambda w, u: jnp.sum(difference_sum(table, w, u, data["reverse"]) ** 2)  # noqa: E731
        in_weights, in_field = jax.grad(energy, argnums=(0, 1))(data["weights"], data["field"])
    assert {leaf.dtype for leaf in in_weights} == {leaf.dtype for leaf in data["weights"]}
    assert in_field.dtype == data["field"].dtype


def test_large_tables_on_the_host_work_without_jit():
    size = 9000  # larger than the pieces that the host processes at once
    table = build_table(np.arange(size + 1), (np.arange(size) + 1) % size)
    w = tuple(np.ones(block.indices.shape) for block in table.blocks)
    u = np.sin(np.arange(size))
    with jax.disable_jit():
        sums = jax.vmap(lambda u: difference_sum(table, w, u))(jnp.stack([u, 2 * u]))
        slope = jax.grad(lambda u: jnp.sum(difference_sum(table, w, u) ** 2))(jnp.asarray(u))
    rise = np.roll(u, -1) - u
    np.testing.assert_allclose(sums[1], 2 * rise, atol=1e-12)
    np.testing.assert_allclose(slope, 2 * (np.roll(rise, 1) - rise), atol=1e-12)


def test_a_row_of_a_thousand_neighbours_is_not_unrolled():
    table = reversible(table_of([list(range(1, 1001)), *[[0]] * 1000]))
    u = jnp.zeros(1001)
    for function in (lambda u: differences(table, u), lambda u: jax.vjp(lambda u: differences(table, u), u)[0]):
        assert len(re.findall(r"\bgather\(", jax.jit(function).lower(u).compile().as_text())) < 100


def test_a_row_of_a_thousand_neighbours_has_the_sum_of_the_dense_form():
    table, random = table_of([list(range(1, 1001)), *[[0]] * 1000]), np.random.default_rng(0)
    weights, u = weights_of(table, random), random.normal(size=1001)
    np.testing.assert_allclose(difference_sum(table, weights, u), dense_of(table, weights) @ u, atol=1e-9)


ON_TWO_DEVICES = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import PartitionSpec as P
from ltljax._tables import build_table, difference_sum, reversible

jax.config.update("jax_enable_x64", True)
table = reversible(build_table(2 * np.arange(11), np.stack([np.roll(np.arange(10), k) for k in (1, 3)], 1).ravel()))
w = (jnp.asarray(np.random.default_rng(0).normal(size=(2, 10))),)
us = jnp.asarray(np.random.default_rng(1).normal(size=(4, 10)))
apply = lambda w, us: jax.vmap(lambda u: difference_sum(table, w, u))(us)
mesh = jax.sharding.Mesh(jax.devices(), "i")
split = jax.shard_map(apply, mesh=mesh, in_specs=(P(), P("i")), out_specs=P("i"))
energy = lambda f: jax.grad(lambda w, us: jnp.sum(jnp.sin(f(w, us))), argnums=(0, 1))(w, us)
assert jax.device_count() == 2
for a, b in zip(jax.tree.leaves(energy(split)), jax.tree.leaves(energy(apply))):
    np.testing.assert_allclose(a, b, atol=1e-12)
"""


def test_fields_can_be_sharded_over_devices():
    flags = "--xla_force_host_platform_device_count=2"
    completed = subprocess.run(
        [sys.executable, "-c", ON_TWO_DEVICES], env={**os.environ, "XLA_FLAGS": flags}, capture_output=True, text=True
    )
    assert completed.returncode == 0, completed.stderr


@pytest.mark.parametrize("kind", KINDS[1:])
def test_differences_are_differences_and_so_is_their_derivative(case, kind):
    table, _, u = case
    used = table if kind == "no reverse" else reversible(table)
    expected = [block.neighbours(u[:, 0]) - block.centre(u[:, 0])[None] for block in table.blocks]
    assert_close(list(differences(used, u[:, 0])), expected)
    plain = lambda u: sum(jnp.sum(jnp.sin(b.neighbours(u) - b.centre(u)[None])) for b in table.blocks)  # noqa: E731
    ours = lambda u: sum(jnp.sum(jnp.sin(d)) for d in differences(used, u))  # noqa: E731
    assert_close(jax.grad(ours)(u[:, 0]), jax.grad(plain)(u[:, 0]))


def compiled_gradient(surface):
    """The HLO of the gradient of a reaction-diffusion run, with respect to the rates and the initial state."""

    def loss(feed, u):
        equation = ltl.ReactionDiffusion((0.1, 0.05), ltl.kinetics.gray_scott(feed))
        rate = lambda u: equation.rate(jnp.zeros(()), surface, u)  # noqa: E731
        u, _ = jax.lax.scan(lambda u, _: (u + 1e-3 * rate(u), None), u, length=5)
        return jnp.sum(u**2)

    lowered = jax.jit(jax.grad(loss, argnums=(0, 1))).lower(jnp.asarray(0.04), jnp.ones((surface.num_vertices, 2)))
    return lowered.compile().as_text()


@pytest.mark.parametrize("scheme", [ltl.Monotone(), ltl.Paper()], ids=str)
def test_the_reverse_pass_of_a_run_gathers_and_never_scatters(scheme):
    mesh = ltl.shapes.icosphere(2)
    surface = ltl.Surface.from_mesh(mesh, scheme)
    # The rows of a tail block are scattered into place, so the test needs a table without one.
    assert len(surface.topology.jet.blocks) == 1
    assert " scatter(" not in compiled_gradient(surface)
    # Without the reverse there is a scatter, and the search finds it.
    assert " scatter(" in compiled_gradient(ltl.Surface.from_mesh(mesh, scheme, differentiable=False))


def test_consecutive_sums_are_not_fused():
    # If they were fused, the first would be computed again for every neighbour of the second.
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(3))
    slots = surface.topology.diffusion.blocks[0].indices.shape[0]
    twice = jax.jit(lambda surface, u: ltl.laplacian(surface, ltl.laplacian(surface, u)))
    text = twice.lower(surface, surface.vertices[:, 0]).compile().as_text()
    gathers = [len(re.findall(r" gather\(", part)) for part in re.split(r"\n\}\n", text)]
    assert max(gathers) == slots
    assert sum(gathers) == 2 * slots
