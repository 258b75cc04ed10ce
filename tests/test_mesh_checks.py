"""What is not a surface is refused with a sentence that names the place; `repair=True` mends what can be mended."""

import json
import re

import numpy as np
import pytest

import ltljax as ltl
from ltljax._mesh import Mesh, MeshError, one_rings, shapes
from ltljax._mesh.report import face_areas


@pytest.fixture
def ball():
    mesh = shapes.icosphere(1)
    return mesh.vertices.copy(), mesh.faces.copy()


@pytest.fixture
def sheet():
    mesh = shapes.disk(rings=3)
    return mesh.vertices.copy(), mesh.faces.copy()


def refused(message: str, *args, **kwargs):
    with pytest.raises(MeshError, match=message):
        Mesh(*args, **kwargs)


def octahedron(centre=(0.0, 0.0, 0.0)):
    axes = np.concatenate([np.eye(3), -np.eye(3)]) + centre
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    return axes, np.array(faces)


def test_mesh_error_is_a_value_error():
    assert issubclass(MeshError, ValueError)
    assert ltl.MeshError is MeshError


def test_every_message_ends_with_what_to_do(ball):
    vertices, faces = ball
    faces[7, 1] = 100
    with pytest.raises(MeshError) as caught:
        Mesh(vertices, faces)
    assert str(caught.value).startswith("Face 7 refers to vertex 100, but there are 42 vertices")
    assert "use repair=True" in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v, f: (v[:, :2], f), r"shape \(V, 3\), found \(42, 2\)"),
        (lambda v, f: (v, f[:, :2]), r"shape \(F, 3\), found \(80, 2\)"),
        (lambda v, f: (v, f.astype(float)), "Faces must be integers, found float64"),
        (lambda v, f: (v.astype(complex), f), "real numbers, found complex128"),
        (lambda v, f: (v.astype(str), f), "real numbers, found <U"),
        (lambda v, f: (v, np.zeros((0, 3), int)), r"no faces \(and 42 vertices\)"),
        (lambda v, f: (np.zeros((0, 3)), []), r"no faces \(and 0 vertices\)"),
        (lambda v, f: ([[0, 1], [2]], f), "must be arrays of numbers"),
    ],
)
def test_arrays_that_are_no_triangle_mesh_are_refused(ball, change, message):
    refused(message, *change(*ball))


@pytest.mark.parametrize("index", [-1, 42, 10**12])
def test_an_index_out_of_range_names_its_face(ball, index):
    vertices, faces = ball
    faces = faces.astype(np.int64)
    faces[3, 2] = index
    refused(f"Face 3 refers to vertex {index}", vertices, faces)


def test_an_unsigned_index_does_not_wrap_around(ball):
    vertices, faces = ball
    faces = faces.astype(np.uint64)
    faces[3, 2] = 2**64 - 1
    refused("Face 3 refers to vertex", vertices, faces)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_position_that_is_not_finite_names_the_first_vertex(ball, value):
    vertices, faces = ball
    vertices[[9, 5]] = value
    refused("Vertex 5 has the position .* not finite", vertices, faces)


def test_positions_whose_powers_overflow_or_underflow_are_refused(ball):
    vertices, faces = ball
    refused("Vertex 0 has a coordinate of size 1e[+]61", vertices * 1e61, faces)
    refused("Face 0 has a longest edge of .*e-62", vertices * 1e-61, faces)
    for factor in (1e59, 1e-59):
        assert np.isfinite(list(Mesh(vertices * factor, faces).report.as_dict().values())[9:18]).all()


def test_degenerate_faces_are_refused(ball):
    vertices, faces = ball
    repeated = faces.copy()
    repeated[4, 1] = repeated[4, 0]
    refused("Face 4 names a vertex twice", vertices, repeated)
    flat = vertices.copy()
    a, b, c = faces[6]
    flat[c] = (flat[a] + flat[b]) / 2
    refused(r"Face 6 \(.*\) has no area", flat, faces)
    coincident = vertices.copy()
    coincident[b] = coincident[a]
    with pytest.raises(MeshError, match="has no area"):
        Mesh(coincident, faces)


def test_a_thin_face_that_still_has_a_normal_passes(ball):
    vertices, faces = ball
    a, b, c = faces[6]
    vertices[c] = (vertices[a] + vertices[b]) / 2 + 1e-9 * vertices[c]
    assert Mesh(vertices, faces).report.max_angle > 179.9


@pytest.mark.parametrize("order", [[0, 1, 2], [1, 2, 0], [0, 2, 1]])
def test_duplicate_faces_are_refused_in_either_orientation(ball, order):
    vertices, faces = ball
    refused("Faces 11 and 80 have the same corners", vertices, np.concatenate([faces, faces[11:12, order]]))


def test_an_edge_of_three_faces_is_named(ball):
    vertices, faces = ball
    a, b = sorted(faces[0, :2].tolist())
    extra = np.concatenate([faces, [[a, b, 42]]])
    refused(
        rf"Edge \({a}, {b}\) belongs to 3 faces.*Separate the sheets", np.concatenate([vertices, [[3, 3, 3]]]), extra
    )


def test_a_vertex_of_two_fans_is_named():
    one, faces = octahedron()
    other, _ = octahedron((2.0, 0, 0))
    joined = np.concatenate([faces, faces + 6])
    joined[joined == 6 + 3] = 0  # (1, 0, 0) belongs to both
    refused("The faces at vertex 0 form 2 fans", np.concatenate([one, other]), joined)


def test_a_moebius_strip_and_a_klein_bottle_are_named_non_orientable():
    n = 12
    strip = [[2 * i, 2 * i + 1, 2 * i + 2] for i in range(n)] + [[2 * i + 1, 2 * i + 3, 2 * i + 2] for i in range(n)]
    strip = np.array(strip)
    twisted = {2 * n: 1, 2 * n + 1: 0}
    faces = np.vectorize(lambda v: twisted.get(v, v))(strip)
    angle = np.repeat(np.arange(n), 2) * 2 * np.pi / n
    width = np.tile([-0.3, 0.3], n)
    radius = 1 + width * np.cos(angle / 2)
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), width * np.sin(angle / 2)], axis=1)
    with pytest.raises(MeshError, match=r"not orientable: .* the two at edge \(\d+, \d+\) disagree") as caught:
        Mesh(vertices, faces)
    a, b = map(int, re.findall(r"\((\d+), (\d+)\)", str(caught.value))[0])
    assert {tuple(sorted((a, b)))} <= {
        tuple(sorted(e)) for f in faces.tolist() for e in zip(f, f[1:] + f[:1], strict=True)
    }
    # Cut across once, it is a twisted strip: one boundary, and two vertices more.
    mended = Mesh(vertices, faces, repair=True)
    assert (mended.num_vertices, mended.num_faces, len(mended.boundary_loops)) == (2 * n + 2, 2 * n, 1)
    assert [text.split(" (")[0] for text in mended.report.repairs] == [
        "cut along 1 edge where the surface was one-sided"
    ]
    # A torus lattice whose rows are reflected where they meet again. Its positions are random: only the faces matter.
    i, j = np.divmod(np.arange(36), 6)

    def at(i, j):
        return 6 * (i % 6) + np.where(i >= 6, -j, j) % 6

    quads = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]
    klein = np.concatenate([np.stack([quads[k] for k in corners], axis=1) for corners in ([0, 1, 2], [0, 2, 3])])
    positions = np.random.default_rng(0).normal(size=(36, 3))
    refused("not orientable", positions, klein)
    mended = Mesh(positions, klein, repair=True)
    assert (mended.num_faces, mended.report.components) == (72, 1)
    assert mended.boundary_loops
    assert mended.area == pytest.approx(face_areas(positions, klein).sum())


@pytest.mark.parametrize("repair", [False, True])
def test_too_small_a_surface_is_refused(repair):
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    with pytest.raises(
        MeshError, match="left no faces" if repair else "component of vertex 0 has 4 vertices; at least 6"
    ):
        Mesh(corners, tetrahedron, repair=repair)


def test_the_smallest_surfaces_pass():
    assert Mesh(*octahedron()).is_closed
    angles = np.arange(5) * 2 * np.pi / 5
    fan = np.concatenate([[[0, 0, 0]], np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)])
    assert not Mesh(fan, [[0, 1 + i, 1 + (i + 1) % 5] for i in range(5)]).is_closed


def test_inconsistent_orientation_is_mended_and_reported(ball, sheet):
    vertices, faces = ball
    expected = np.sort(np.sort(faces), axis=0)
    for count in (1, 17, 60, 80):
        turned = faces.copy()
        turned[:count] = turned[:count, ::-1]
        mesh = Mesh(vertices, turned)
        assert mesh.report.reoriented_faces == count  # outwards, whatever the majority says
        assert volume(mesh) > 0
        np.testing.assert_array_equal(np.sort(np.sort(mesh.faces), axis=0), expected)
    vertices, faces = sheet
    for count, reported in ((1, 1), (len(faces) - 2, 2)):
        turned = faces.copy()
        turned[:count] = turned[:count, ::-1]
        mesh = Mesh(vertices, turned)
        assert mesh.report.reoriented_faces == reported  # no outside: the majority decides
        one_rings(mesh.faces, mesh.num_vertices)


def volume(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6)


def test_a_closed_component_far_from_the_origin_still_faces_out(ball):
    vertices, faces = ball
    for shift in (1e3, 1e7):
        assert Mesh(vertices + shift, faces).report.reoriented_faces == 0
        assert Mesh(vertices + shift, faces[:, ::-1]).report.reoriented_faces == 80


def test_unreferenced_vertices_are_dropped_even_where_not_finite(ball):
    vertices, faces = ball
    mesh = Mesh(np.concatenate([[[np.nan] * 3], vertices, [[9.0, 9, 9]]]), faces + 1)
    assert mesh.report.dropped_vertices == 2
    np.testing.assert_array_equal(mesh.original_index, np.arange(1, 43))
    assert mesh.welded_index[0] == mesh.welded_index[-1] == -1


def test_data_follow_both_ways(ball):
    vertices, faces = ball
    # Every vertex is there twice, half of the faces use the one, half the other; vertex 0 is used by none.
    original = np.concatenate([[[5.0, 5, 5]], vertices, vertices[::-1]])
    faces = np.concatenate([faces[:40] + 1, 84 - faces[40:]])
    mesh = Mesh(original, faces, weld=True)
    used = len(np.unique(faces))
    assert (mesh.num_vertices, mesh.report.dropped_vertices) == (42, 85 - used)
    assert mesh.report.welded_vertices == used - 42
    pushed = mesh.push(mesh.vertices)
    kept = mesh.welded_index >= 0
    np.testing.assert_array_equal(pushed[kept], original[kept])
    assert np.isnan(pushed[~kept]).all()
    np.testing.assert_array_equal(mesh.pull(original), mesh.vertices)
    assert mesh.push(np.arange(42), fill=-1).dtype == np.int64
    assert mesh.push(np.arange(42, dtype=np.float32)).dtype == np.float32
    with pytest.raises(ValueError, match="one entry for each of 42 vertices"):
        mesh.push(np.zeros(43))
    with pytest.raises(ValueError, match=r"found the shape \(42,\)"):
        mesh.pull(np.zeros(42))


def test_zeros_of_either_sign_are_one_position():
    mesh = shapes.square(n=4)
    vertices = mesh.vertices[mesh.faces].reshape(-1, 3)
    vertices[::2] = np.where(vertices[::2] == 0, -0.0, vertices[::2])
    welded = Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3), weld=True)
    assert welded.num_vertices == 25
    assert welded.report.welded_vertices == len(vertices) - 25


def test_repair_drops_bad_faces_and_says_so(ball):
    vertices, faces = ball
    vertices = np.concatenate([vertices, [[np.nan, 0, 0]], [[1e70, 0, 0]]])
    bad = [[0, 0, 1], [0, 1, 42], [0, 1, 43], [5, 6, 99], [-3, 1, 2], faces[9], faces[9][::-1]]
    mesh = Mesh(vertices, np.concatenate([faces, bad]), repair=True)
    assert (mesh.num_vertices, mesh.num_faces, mesh.is_closed) == (42, 80, True)
    assert mesh.report.repairs == (
        "dropped 2 faces that referred to missing vertices",
        "dropped 1 face with a position that is not finite",
        "dropped 1 face with a position too large to compute with",
        "dropped 1 face with fewer than three different corners",
        "dropped 2 faces that duplicated another",
    )
    assert "dropped 2 faces that duplicated another" in str(mesh.report)


def test_repair_keeps_the_two_largest_faces_at_an_edge(ball):
    vertices, faces = ball
    a, b = faces[0, :2]
    fin = (vertices[a] + vertices[b]) * 0.51
    mesh = Mesh(np.concatenate([vertices, [fin]]), np.concatenate([[[a, b, 42]], faces]), repair=True)
    assert mesh.is_closed
    assert mesh.report.repairs == ("dropped 1 face at edges that had more than two (the two largest stay)",)


def test_repair_splits_a_vertex_of_two_fans():
    one, faces = octahedron()
    other, _ = octahedron((2.0, 0, 0))
    joined = np.concatenate([faces, faces + 6])
    joined[joined == 6 + 3] = 0
    mesh = Mesh(np.concatenate([one, other]), joined, repair=True)
    assert (mesh.num_vertices, mesh.report.components, mesh.report.euler_number) == (12, 2, 4)
    assert mesh.report.repairs == ("split 1 vertex where separate fans touched",)
    assert np.sum(mesh.original_index == 0) == 2
    assert mesh.welded_index[0] == 0


def test_repair_drops_small_components(ball):
    vertices, faces = ball
    extra = np.eye(3) + 5
    refused(
        "component of vertex 42 has 3 vertices",
        np.concatenate([vertices, extra]),
        np.concatenate([faces, [[42, 43, 44]]]),
    )
    mesh = Mesh(np.concatenate([vertices, extra]), np.concatenate([faces, [[42, 43, 44]]]), repair=True)
    assert mesh.num_vertices == 42
    assert mesh.report.repairs == ("dropped 1 face of components too small to differentiate on",)


def test_repair_of_random_triangles_ends_in_a_surface_or_an_error():
    random = np.random.default_rng(3)
    ends = {True: 0, False: 0}
    for _ in range(150):
        vertices = random.integers(0, 4, size=(30, 3)).astype(float)
        faces = random.integers(-1, 31, size=(int(random.integers(5, 200)), 3))
        try:
            mesh = Mesh(vertices, faces, repair=True, weld=bool(random.integers(2)))
        except MeshError:
            ends[False] += 1
            continue
        ends[True] += 1
        again = Mesh(mesh.vertices, mesh.faces)  # what came out passes by itself
        assert again.report.reoriented_faces == 0
        np.testing.assert_array_equal(mesh.vertices, again.vertices)
        one_rings(mesh.faces, mesh.num_vertices)
    assert min(ends.values()) > 5, ends


def test_a_mesh_is_immutable(ball):
    mesh = Mesh(*ball)
    with pytest.raises(AttributeError):
        mesh.vertices = mesh.vertices  # pyright: ignore
    for name in ("vertices", "faces", "original_index", "welded_index", "edges", "boundary_vertices", "components"):
        assert not getattr(mesh, name).flags.writeable
    ball[0][0] = 7  # nor does it watch the arrays it came from
    assert mesh.vertices[0, 0] != 7


def test_scaling_scales_lengths_and_keeps_all_else():
    mesh = shapes.ellipsoid((1.0, 2.0, 3.0), subdivisions=2)
    twice = mesh.scaled(2)
    np.testing.assert_array_equal(twice.vertices, 2 * mesh.vertices)
    np.testing.assert_array_equal(twice.normals, mesh.normals)
    assert twice.report.area == pytest.approx(4 * mesh.report.area)
    assert twice.report.min_angle == pytest.approx(mesh.report.min_angle)
    assert mesh.report.mesh_size == mesh.mesh_size == twice.mesh_size / 2
    for factor in (0.0, -1.0, np.nan, np.inf, 1e70, 1e-70):
        with pytest.raises(MeshError):
            mesh.scaled(factor)


def test_normals_must_be_unit_vectors_of_the_vertices(ball):
    vertices, faces = ball
    np.testing.assert_array_equal(Mesh(vertices, faces, normals=vertices).normals, vertices)
    refused(
        "Normals must have length 1, but the one at vertex 3",
        vertices,
        faces,
        normals=vertices * (np.arange(42) != 3)[:, None],
    )
    refused("Normals must have the shape of the vertices", vertices, faces, normals=vertices[:-1])


def test_the_report_is_a_table_and_plain_data():
    mesh = shapes.cylinder(n_around=8, n_along=2)
    assert json.loads(json.dumps(mesh.report.as_dict()))["boundary_loops"] == [8, 8]
    lines = str(mesh.report).splitlines()
    assert "2 loops of 8, 8 edges" in str(mesh.report)
    assert len({len(re.match(r"[^0-9]*?\s\s+", line).group()) for line in lines[:4]}) == 1
    assert repr(mesh) == "Mesh(24 vertices, 32 faces, 2 boundary loops)"


def test_masked_positions_and_faces_are_refused():
    tetrahedron = np.eye(4, 3), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    for which in (0, 1):
        given = list(tetrahedron)
        given[which] = np.ma.masked_array(given[which], np.zeros(given[which].shape, bool))
        with pytest.raises(ltl.MeshError, match="whose mask would be lost"):
            ltl.Mesh(*given)
