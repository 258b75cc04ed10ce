"""Padded tables hold exactly the given rows, and their memory depends on all rows and not on the longest."""

import jax
import jax.numpy as jnp
import numpy as np
import paper_reference
import pytest
from hypothesis import given, settings, strategies as st

import ltljax as ltl
from ltljax._tables import ComposedStencil, Stencil, build_table


def poles(valence):
    """A closed surface with two vertices of the given valence: two caps with rings between them."""
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


def test_a_vertex_of_large_valence_does_not_widen_the_tables():
    mesh = poles(100)
    assert mesh.report.max_valence == 100
    for scheme in (ltl.Paper(), ltl.Monotone()):
        topology = ltl.Surface.from_mesh(mesh, scheme).topology
        assert topology.ring.blocks[0].indices.shape[0] <= 8
        assert topology.ring.num_slots <= 2 * mesh.faces.size
        if topology.diffusion is not None:
            assert topology.diffusion.num_slots <= 2 * mesh.faces.size


@pytest.mark.parametrize("valence", [12, 50, 500])
def test_the_memory_of_the_ring_table_grows_with_the_sum_of_valences(valence):
    mesh = poles(valence)
    assert ltl.Surface.from_mesh(mesh, ltl.Paper()).topology.ring.num_slots <= 1.5 * mesh.faces.size


@pytest.mark.slow
def test_operators_are_correct_on_long_rows():
    mesh = poles(60)
    u = mesh.vertices.prod(axis=1) + mesh.vertices[:, 2] ** 2
    surface = ltl.Surface.from_mesh(mesh, ltl.Paper())
    assert len(surface.topology.ring.blocks) > 1
    expected = paper_reference.laplacians(mesh.vertices, mesh.faces, u)
    np.testing.assert_allclose(ltl.laplacian(surface, u), expected, atol=1e-12 * np.abs(expected).max())
    monotone = ltl.Surface.from_mesh(mesh)
    np.testing.assert_allclose(ltl.laplacian(monotone, u), ltl.laplacian_matrix(monotone) @ u, atol=1e-9)
    slope = jax.grad(lambda v: jnp.sum(ltl.laplacian(monotone.with_vertices(v), jnp.asarray(u)) ** 2))
    assert jnp.isfinite(slope(monotone.vertices)).all()


rows_of_neighbours = st.integers(2, 12).flatmap(
    lambda n: st.lists(st.lists(st.integers(0, n - 1), max_size=40), min_size=n, max_size=n)
)


@settings(deadline=None, max_examples=60)
@given(rows_of_neighbours)
def test_a_table_holds_exactly_the_given_rows(rows):
    rows = [[j for j in row if j != v] for v, row in enumerate(rows)]
    offsets = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
    table = build_table(offsets, np.array([j for row in rows for j in row], np.int32))
    stored = {}
    for block in table.blocks:
        owners = range(len(rows)) if block.rows is None else block.rows.tolist()
        for owner, column in zip(owners, block.indices.T.tolist(), strict=True):
            stored.setdefault(owner, []).extend(j for j in column if j != owner)
            assert all(0 <= j < len(rows) for j in column)
    assert [stored[v] for v in range(len(rows))] == rows
    assert table.num_slots <= len(rows) + 2 * offsets[-1]


# Every shape of a table is compiled, so there are few: equal rows, empty rows, and long rows in tail blocks.
ROWS = {
    "equal": [[1, 2], [2, 0], [0, 1]],
    "empty": [[], [0, 0, 2], [], [1]],
    "long": [[1], [0], [1, 3], [2], [0, 1, 2, 3] * 8, [4, 4], [5] * 14],
}


@pytest.mark.parametrize("rows", ROWS.values(), ids=ROWS)
def test_a_stencil_is_the_weighted_sum_of_differences_over_its_rows(rows, as_users_call_it):
    random = np.random.default_rng(0)
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
        stencil = Stencil(table, tuple(weights))
        values, reverse_pass = jax.vjp(stencil, jnp.asarray(u))
        np.testing.assert_allclose(values, dense @ u, atol=1e-11)
        np.testing.assert_allclose(reverse_pass(values)[0], dense.T @ np.asarray(values), atol=1e-9)
        np.testing.assert_allclose(stencil.transpose(values), dense.T @ np.asarray(values), atol=1e-9)
    centre = random.normal(size=len(rows))
    centred = Stencil(table, tuple(weights), centre=jnp.asarray(centre))
    expected = dense + np.diag(centre)
    np.testing.assert_allclose(centred.matrix().todense(), expected, atol=1e-12)
    np.testing.assert_allclose(centred(jnp.asarray(u)), expected @ u, atol=1e-11)
    np.testing.assert_allclose(centred.diagonal(), np.diag(expected), atol=1e-12)
    assert np.abs(np.linalg.eigvals(expected)).max() <= float(centred.spectral_bound()) + 1e-12
    scaled = centred.with_rows_scaled(jnp.asarray(centre))
    np.testing.assert_allclose(scaled.matrix().todense(), centre[:, None] * expected, atol=1e-12)
    both = ComposedStencil((centred, stencil), (stencil, stencil))
    np.testing.assert_allclose(both.matrix().todense(), expected @ dense + dense @ dense, atol=1e-10)
    np.testing.assert_allclose(both(jnp.asarray(u)), both.matrix() @ u, atol=1e-10)
    np.testing.assert_allclose(both.transpose(jnp.asarray(u)), both.matrix().T @ u, atol=1e-10)
    assert np.abs(np.linalg.eigvals(both.matrix().todense())).max() <= float(both.spectral_bound()) + 1e-9
    with pytest.raises(ValueError, match="Expected a mean of 'arithmetic' or 'harmonic', found 'geometric'"):
        stencil.with_conductivity(jnp.asarray(centre), "geometric")
    with pytest.raises(ValueError, match="a stencil of differences only"):
        centred.with_conductivity(jnp.asarray(centre), "harmonic")


def test_small_tail_blocks_are_joined_and_large_ones_are_not():
    def blocks(*tails):
        lengths = np.array([6] * 1000 + [length for length, count in tails for _ in range(count)])
        offsets = np.concatenate([[0], np.cumsum(lengths)])
        table = build_table(offsets, np.zeros(offsets[-1], np.int32))
        longer = lengths[lengths > 6].sum()
        assert table.num_slots <= 1.05 * 6 * len(lengths) + 2 * longer
        return [block.indices.shape for block in table.blocks[1:]]

    assert blocks((9, 20), (14, 5)) == [(14, 25)]
    assert blocks((9, 20), (50, 1)) == [(9, 20), (50, 1)]  # the widths are too far apart
    assert blocks((9, 100), (14, 100)) == [(9, 100), (14, 100)]
    assert blocks((7, 1), (13, 1), (25, 1), (49, 1)) == [(49, 4)]
