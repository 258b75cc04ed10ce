"""One-rings list the faces in order, k-rings agree with breadth-first search, and edges and loops are complete."""

import time

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ltljax._mesh import Mesh, k_ring, one_rings, shapes
from ltljax._mesh.topology import OneRings, boundary_loops, unique_edges

SHAPES = {
    "closed": shapes.icosphere(2),
    "torus": shapes.torus(n_major=7, n_minor=5),
    "random": shapes.random_sphere(300, seed=1),
    "disk": shapes.disk(rings=4),
    "two boundaries": shapes.cylinder(n_around=9, n_along=3),
    "corners of valence two": shapes.square(n=3),
}


def two_poles(valence: int) -> Mesh:
    """A double cone whose apexes have the given valence."""
    angle = 2 * np.pi * np.arange(valence) / valence
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(valence)], axis=1)
    i = np.arange(valence)
    following = (i + 1) % valence
    up = np.stack([i, following, np.full(valence, valence)], axis=1)
    down = np.stack([following, i, np.full(valence, valence + 1)], axis=1)
    return Mesh(np.concatenate([rim, [[0, 0, 1]], [[0, 0, -1]]]), np.concatenate([up, down]))


def assert_rings_match(mesh: Mesh, rings: OneRings) -> None:
    vertex = np.repeat(np.arange(mesh.num_vertices), rings.valences)
    has_face = rings.successors != vertex
    # The rings contain each face once for each of its corners, with its orientation.
    ring_faces = np.stack([vertex, rings.neighbours, rings.successors], axis=1)[has_face]
    rolled = np.concatenate([np.roll(mesh.faces, -corner, axis=1) for corner in range(3)])
    np.testing.assert_array_equal(ring_faces[np.lexsort(ring_faces.T)], rolled[np.lexsort(rolled.T)])
    # The rings contain each edge once for each of its ends.
    directed = np.concatenate([mesh.edges, mesh.edges[:, ::-1]])
    pairs = np.stack([vertex, rings.neighbours], axis=1)
    np.testing.assert_array_equal(pairs[np.lexsort(pairs.T)], directed[np.lexsort(directed.T)])
    # The face of each slot is followed by that of the next, and the last slot of a boundary vertex has no face.
    first, last = rings.offsets[:-1], rings.offsets[1:] - 1
    is_last = np.zeros(len(vertex), bool)
    is_last[last] = True
    np.testing.assert_array_equal(rings.successors[~is_last], rings.neighbours[1:][~is_last[:-1]])
    expected = np.where(mesh.boundary_vertices, np.arange(mesh.num_vertices), rings.neighbours[first])
    np.testing.assert_array_equal(rings.successors[last], expected)


@pytest.mark.parametrize("name", SHAPES)
def test_one_rings_contain_the_faces_in_cyclic_order(name):
    mesh = SHAPES[name]
    assert_rings_match(mesh, one_rings(mesh.faces, mesh.num_vertices))


@given(st.integers(0, 10**6), st.integers(6, 60), st.integers(0, 10))
@settings(max_examples=30, deadline=None)
def test_one_rings_are_complete_on_random_surfaces_with_holes(seed, num_vertices, holes):
    random = np.random.default_rng(seed)
    full = shapes.random_sphere(num_vertices, seed)
    remaining = random.permutation(full.num_faces)[holes:]
    try:
        mesh = Mesh(full.vertices, full.faces[remaining])
    except ValueError:  # the holes touch at a vertex, or too few vertices remain
        return
    assert_rings_match(mesh, one_rings(mesh.faces, mesh.num_vertices))
    # Every face has three edges; inner edges have two faces, and boundary edges have one.
    assert 3 * mesh.num_faces == 2 * len(mesh.edges) - sum(map(len, mesh.boundary_loops))


@given(st.randoms(use_true_random=False))
@settings(max_examples=15, deadline=None)
def test_one_rings_do_not_depend_on_the_order_of_the_faces(random):
    mesh = SHAPES["disk"]
    order = list(range(mesh.num_faces))
    random.shuffle(order)
    turns = [random.randrange(3) for _ in order]
    faces = np.array([np.roll(mesh.faces[face], turn) for face, turn in zip(order, turns, strict=True)])
    rings, shuffled_rings = one_rings(mesh.faces, mesh.num_vertices), one_rings(faces, mesh.num_vertices)
    np.testing.assert_array_equal(rings.neighbours, shuffled_rings.neighbours)
    np.testing.assert_array_equal(rings.successors, shuffled_rings.successors)


def test_the_ring_of_a_pole_of_valence_500_is_in_order():
    mesh = two_poles(500)
    rings = one_rings(mesh.faces, mesh.num_vertices)
    assert rings.valences.max() == 500
    assert_rings_match(mesh, rings)
    north = rings.neighbours[rings.offsets[500] : rings.offsets[501]]
    np.testing.assert_array_equal(north, np.arange(500))  # counter-clockwise from above
    south = rings.neighbours[rings.offsets[501] : rings.offsets[502]]
    np.testing.assert_array_equal(south, np.roll(np.arange(500)[::-1], 1))


def test_rings_are_counter_clockwise_seen_from_outside():
    mesh = SHAPES["random"]
    rings = one_rings(mesh.faces, mesh.num_vertices)
    vertex = np.repeat(np.arange(mesh.num_vertices), rings.valences)
    a, b, c = mesh.vertices[vertex], mesh.vertices[rings.neighbours], mesh.vertices[rings.successors]
    assert np.all(np.sum(a * np.cross(b - a, c - a), axis=1) > 0)


def test_rings_of_touching_fans_are_rejected():
    with pytest.raises(ValueError, match="faces around vertex 0 do not form a single fan"):
        one_rings(np.array([[0, 1, 2], [0, 2, 3], [0, 4, 5], [0, 5, 6]]), 7)
    with pytest.raises(ValueError, match="do not form a single fan"):
        one_rings(np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [0, 4, 5], [0, 5, 6], [0, 6, 4]]), 7)


def breadth_first(neighbours: list[set[int]], start: int, k: int) -> list[int]:
    reached, front = {start}, {start}
    for _ in range(k):
        front = {neighbour for vertex in front for neighbour in neighbours[vertex]} - reached
        reached |= front
    return sorted(reached - {start})


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("k", [1, 2, 3])
def test_k_rings_agree_with_breadth_first_search(name, k):
    mesh = SHAPES[name]
    neighbours: list[set[int]] = [set() for _ in range(mesh.num_vertices)]
    for a, b in mesh.edges.tolist():
        neighbours[a].add(b)
        neighbours[b].add(a)
    vertices = np.random.default_rng(k).integers(mesh.num_vertices, size=20)  # in any order, with repetitions
    for source in (mesh.faces, one_rings(mesh.faces, mesh.num_vertices)):
        offsets, indices = k_ring(source, mesh.num_vertices, vertices, k)
        rows = [row.tolist() for row in np.split(indices, offsets[1:-1])]
        assert rows == [breadth_first(neighbours, vertex, k) for vertex in vertices.tolist()]
        assert indices.dtype == np.int32


def test_k_rings_of_no_vertices_are_empty():
    mesh = SHAPES["closed"]
    offsets, indices = k_ring(mesh.faces, mesh.num_vertices, np.zeros(0, np.int64), 2)
    assert offsets.tolist() == [0]
    assert len(indices) == 0


def test_the_k_ring_for_k_equal_to_one_is_the_one_ring():
    mesh = SHAPES["disk"]
    rings = one_rings(mesh.faces, mesh.num_vertices)
    offsets, indices = k_ring(mesh.faces, mesh.num_vertices, np.arange(mesh.num_vertices), 1)
    np.testing.assert_array_equal(offsets, rings.offsets)
    for row, ring in zip(np.split(indices, offsets[1:-1]), np.split(rings.neighbours, offsets[1:-1]), strict=True):
        np.testing.assert_array_equal(row, np.sort(ring))


def test_edges_are_unique_and_sorted():
    for mesh in SHAPES.values():
        expected = sorted({(min(e), max(e)) for f in mesh.faces.tolist() for e in zip(f, f[1:] + f[:1], strict=True)})
        assert mesh.edges.tolist() == [list(edge) for edge in expected]
        assert mesh.edges.dtype == np.int32
    assert unique_edges(np.zeros((0, 3), int)).shape == (0, 2)


def test_boundary_loops_have_the_surface_on_the_left():
    mesh = shapes.disk(rings=5)
    (loop,) = mesh.boundary_loops
    assert loop.dtype == np.int32
    x, y, _ = mesh.vertices[loop].T
    angle = np.unwrap(np.arctan2(y, x))
    np.testing.assert_allclose(np.diff(angle), 2 * np.pi / 30)  # counter-clockwise, every vertex once
    np.testing.assert_array_equal(np.flatnonzero(mesh.boundary_vertices), np.sort(loop))
    top, bottom = sorted(shapes.cylinder(n_around=9).boundary_loops, key=lambda loop: -int(loop[-1]))
    assert len(top) == len(bottom) == 9
    assert boundary_loops(SHAPES["closed"].faces, 162) == []


def test_components_are_numbered_by_their_first_vertices():
    ball, ring = shapes.icosphere(1), shapes.torus(n_major=6, n_minor=5)
    faces = np.concatenate([ring.faces + 42, ball.faces])
    mesh = Mesh(np.concatenate([ball.vertices, ring.vertices + 9]), faces)
    np.testing.assert_array_equal(mesh.components, np.repeat([0, 1], [42, 30]))
    assert (mesh.report.components, mesh.report.genus, mesh.report.euler_number) == (2, 1, 2)


def test_a_mesh_of_100000_vertices_takes_less_than_ten_seconds():
    began = time.perf_counter()
    mesh = shapes.torus(n_major=500, n_minor=200)
    rings = one_rings(mesh.faces, mesh.num_vertices)
    k_ring(rings, mesh.num_vertices, np.arange(0, 100_000, 10), 3)
    assert mesh.report.edges == 300_000
    assert time.perf_counter() - began < 10  # half a second in practice


def shuffled(mesh: Mesh, seed: int) -> Mesh:
    order = np.random.default_rng(seed).permutation(mesh.num_vertices)
    normals = None if mesh.normals is None else mesh.normals[order]
    return Mesh(mesh.vertices[order], np.argsort(order)[mesh.faces], normals=normals)


@pytest.mark.parametrize("name", SHAPES)
def test_reordering_changes_only_the_vertex_order(name):
    mesh = shuffled(SHAPES[name], seed=4)
    for new in (mesh.reordered(), mesh.reordered().reordered(), mesh.reordered().scaled(2).scaled(0.5)):
        order = new.source_order
        np.testing.assert_array_equal(new.vertices[order], mesh.vertices)
        np.testing.assert_array_equal(np.argsort(order)[new.faces], mesh.faces)
        if mesh.normals is not None:
            np.testing.assert_array_equal(new.normals[order], mesh.normals)
        # The numbers and first vertices of the loops do not change.
        for loop, expected in zip(new.boundary_loops, mesh.boundary_loops, strict=True):
            np.testing.assert_array_equal(np.argsort(order)[loop], expected)
        data = np.arange(mesh.num_vertices)
        np.testing.assert_array_equal(new.pull(data)[order], data)
        np.testing.assert_array_equal(new.push(new.pull(data)), data)


def test_push_after_reordering_handles_welded_and_dropped_vertices():
    sphere = shapes.icosphere(1)
    doubled = np.concatenate([sphere.vertices, [[9, 9, 9]], sphere.vertices])
    mesh = Mesh(doubled, np.where(sphere.faces % 2, sphere.faces, sphere.faces + len(sphere.vertices) + 1), weld=True)
    new = mesh.reordered()
    np.testing.assert_array_equal(new.vertices, doubled[new.original_index])
    pushed = new.push(new.vertices[:, 0])
    np.testing.assert_array_equal(pushed, mesh.push(mesh.vertices[:, 0]))
    assert 0 < np.isnan(pushed).sum() < len(pushed)


def test_reordering_puts_neighbours_close_together():
    mesh = shuffled(shapes.icosphere(5), seed=0)
    before, after = (np.abs(np.diff(m.edges, axis=1)).mean() for m in (mesh, mesh.reordered()))
    assert before > mesh.num_vertices / 4
    assert after < 2 * np.sqrt(mesh.num_vertices)
