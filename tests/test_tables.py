"""Padded tables hold exactly the rows given, at a memory that follows the rows and not the longest of them."""

import jax
import jax.numpy as jnp
import numpy as np
import paper_reference
import pytest
from hypothesis import given, settings, strategies as st

import ltljax as ltl
from ltljax._tables import build_table, difference_sum


def poles(valence):
    """A closed surface with two vertices of the given valence: a drum of two caps and a strip of rings between."""
    angle = 2 * np.pi * np.arange(valence) / valence
    heights = np.linspace(-0.6, 0.6, 4)
    rings = [
        np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), 0 * angle + z], 1)
        for z in heights
    ]
    vertices = np.concatenate([[[0, 0, -1.0], [0, 0, 1.0]], *rings])
    ring = 2 + np.arange(valence)
    after = 2 + (np.arange(valence) + 1) % valence
    faces = [np.stack([np.zeros_like(ring), after, ring], 1)]
    for level in range(3):
        low, high = level * valence, (level + 1) * valence
        faces += [
            np.stack([ring + low, after + low, ring + high], 1),
            np.stack([after + low, after + high, ring + high], 1),
        ]
    faces.append(np.stack([np.ones_like(ring), ring + 3 * valence, after + 3 * valence], 1))
    return ltl.Mesh(vertices, np.concatenate(faces))


def test_a_vertex_of_valence_500_does_not_widen_the_tables():
    mesh = poles(500)
    assert mesh.report.max_valence == 500
    for scheme in (ltl.Paper(), ltl.Monotone()):
        topology = ltl.Surface.from_mesh(mesh, scheme).topology
        assert topology.ring.blocks[0].indices.shape[0] <= 8
        assert topology.ring.num_slots <= 2 * mesh.faces.size
        if topology.diffusion is not None:
            assert topology.diffusion.num_slots <= 2 * mesh.faces.size


@pytest.mark.parametrize("valence", [12, 50, 500])
def test_the_memory_of_the_ring_table_follows_the_sum_of_valences(valence):
    mesh = poles(valence)
    assert ltl.Surface.from_mesh(mesh, ltl.Paper()).topology.ring.num_slots <= 1.5 * mesh.faces.size


@pytest.mark.slow
def test_operators_are_right_on_long_rows():
    mesh = poles(60)
    u = mesh.vertices.prod(axis=1) + mesh.vertices[:, 2] ** 2
    surface = ltl.Surface.from_mesh(mesh, ltl.Paper())
    assert len(surface.topology.ring.blocks) > 1
    expected = paper_reference.laplacians(mesh.vertices, mesh.faces, u)
    np.testing.assert_allclose(ltl.laplacian(surface, u), expected, atol=1e-12 * np.abs(expected).max())
    monotone = ltl.Surface.from_mesh(mesh)
    np.testing.assert_allclose(ltl.laplacian(monotone, u), ltl.laplacian_matrix(monotone) @ u, atol=1e-9)
    at = jax.grad(lambda v: jnp.sum(ltl.laplacian(monotone.with_vertices(v), jnp.asarray(u)) ** 2))(monotone.vertices)
    assert jnp.isfinite(at).all()


rows_of_neighbours = st.integers(2, 12).flatmap(
    lambda n: st.lists(st.lists(st.integers(0, n - 1), max_size=40), min_size=n, max_size=n)
)


@settings(deadline=None, max_examples=60)
@given(rows_of_neighbours)
def test_a_table_holds_exactly_the_rows_given(rows):
    rows = [[j for j in row if j != v] for v, row in enumerate(rows)]
    offsets = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
    table = build_table(offsets, np.array([j for row in rows for j in row], np.int32))
    held = {}
    for block in table.blocks:
        owners = range(len(rows)) if block.rows is None else block.rows.tolist()
        for owner, column in zip(owners, block.indices.T.tolist(), strict=True):
            held.setdefault(owner, []).extend(j for j in column if j != owner)
            assert all(0 <= j < len(rows) for j in column)
    assert [held[v] for v in range(len(rows))] == rows
    assert table.num_slots <= len(rows) + 2 * offsets[-1]


@settings(deadline=None, max_examples=10)
@given(rows_of_neighbours, st.integers(0, 2**31))
def test_the_loop_is_the_sum_over_the_rows(rows, seed):
    random = np.random.default_rng(seed)
    rows = [[j for j in row if j != v] for v, row in enumerate(rows)]
    offsets = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
    table = build_table(offsets, np.array([j for row in rows for j in row], np.int32))
    dense = np.zeros((len(rows), len(rows)))
    weights = []
    for block in table.blocks:
        owners = np.arange(len(rows)) if block.rows is None else block.rows
        w = random.normal(size=block.indices.shape) * (block.indices != owners)
        np.add.at(dense, (np.broadcast_to(owners, w.shape), block.indices), w)
        np.add.at(dense, (owners, owners), -w.sum(axis=0))
        weights.append(jnp.asarray(w))
    for u in (random.normal(size=len(rows)), random.normal(size=(len(rows), 3))):
        found, back = jax.vjp(lambda u: difference_sum(table, tuple(weights), u), jnp.asarray(u))
        np.testing.assert_allclose(found, dense @ u, atol=1e-11)
        np.testing.assert_allclose(back(found)[0], dense.T @ np.asarray(found), atol=1e-9)


def test_small_tail_blocks_are_joined_and_large_ones_are_not():
    def blocks(*tails):
        lengths = np.array([6] * 1000 + [length for length, count in tails for _ in range(count)])
        offsets = np.concatenate([[0], np.cumsum(lengths)])
        table = build_table(offsets, np.zeros(offsets[-1], np.int32))
        longer = lengths[lengths > 6].sum()
        assert table.num_slots <= 1.05 * 6 * len(lengths) + 2 * longer
        return [block.indices.shape for block in table.blocks[1:]]

    assert blocks((9, 20), (14, 5)) == [(14, 25)]
    assert blocks((9, 20), (50, 1)) == [(9, 20), (50, 1)]  # of no neighbouring widths
    assert blocks((9, 100), (14, 100)) == [(9, 100), (14, 100)]
    assert blocks((7, 1), (13, 1), (25, 1), (49, 1)) == [(49, 4)]
