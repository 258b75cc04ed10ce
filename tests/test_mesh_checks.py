"""Invalid meshes raise an error that names the first offending index, and `repair=True` repairs what it can."""

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


def assert_rejected(message: str, *args, **kwargs):
    with pytest.raises(MeshError, match=message):
        Mesh(*args, **kwargs)


def octahedron(centre=(0.0, 0.0, 0.0)):
    axes = np.concatenate([np.eye(3), -np.eye(3)]) + centre
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    return axes, np.array(faces)


def test_mesh_error_is_a_value_error():
    assert issubclass(MeshError, ValueError)
    assert ltl.MeshError is MeshError


def test_messages_name_the_place_and_a_remedy(ball):
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
def test_arrays_that_are_not_a_triangle_mesh_are_rejected(ball, change, message):
    assert_rejected(message, *change(*ball))


@pytest.mark.parametrize("index", [-1, 42, 10**12])
def test_the_error_for_an_index_out_of_range_names_the_face(ball, index):
    vertices, faces = ball
    faces = faces.astype(np.int64)
    faces[3, 2] = index
    assert_rejected(f"Face 3 refers to vertex {index}", vertices, faces)


def test_an_unsigned_index_does_not_wrap_around(ball):
    vertices, faces = ball
    faces = faces.astype(np.uint64)
    faces[3, 2] = 2**64 - 1
    assert_rejected("Face 3 refers to vertex", vertices, faces)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_the_error_for_positions_that_are_not_finite_names_the_first_vertex(ball, value):
    vertices, faces = ball
    vertices[[9, 5]] = value
    assert_rejected("Vertex 5 has the position .* not finite", vertices, faces)


def test_positions_whose_powers_overflow_or_underflow_are_rejected(ball):
    vertices, faces = ball
    assert_rejected("Vertex 0 has a coordinate of size 1e[+]61", vertices * 1e61, faces)
    assert_rejected("Face 0 has a longest edge of .*e-62", vertices * 1e-61, faces)
    for factor in (1e59, 1e-59):
        assert np.isfinite(list(Mesh(vertices * factor, faces).report.as_dict().values())[9:18]).all()


def test_degenerate_faces_are_rejected(ball):
    vertices, faces = ball
    repeated = faces.copy()
    repeated[4, 1] = repeated[4, 0]
    assert_rejected("Face 4 names a vertex twice", vertices, repeated)
    flat = vertices.copy()
    a, b, c = faces[6]
    flat[c] = (flat[a] + flat[b]) / 2
    assert_rejected(r"Face 6 \(.*\) has no area", flat, faces)
    coincident = vertices.copy()
    coincident[b] = coincident[a]
    with pytest.raises(MeshError, match="has no area"):
        Mesh(coincident, faces)


def test_a_thin_face_with_a_normal_is_accepted(ball):
    vertices, faces = ball
    a, b, c = faces[6]
    vertices[c] = (vertices[a] + vertices[b]) / 2 + 1e-9 * vertices[c]
    assert Mesh(vertices, faces).report.max_angle > 179.9


@pytest.mark.parametrize("order", [[0, 1, 2], [1, 2, 0], [0, 2, 1]])
def test_duplicate_faces_are_rejected_in_either_orientation(ball, order):
    vertices, faces = ball
    assert_rejected("Faces 11 and 80 have the same corners", vertices, np.concatenate([faces, faces[11:12, order]]))


def test_the_error_for_an_edge_of_three_faces_names_the_edge(ball):
    vertices, faces = ball
    a, b = sorted(faces[0, :2].tolist())
    extra = np.concatenate([faces, [[a, b, 42]]])
    assert_rejected(
        rf"Edge \({a}, {b}\) belongs to 3 faces.*Separate the sheets", np.concatenate([vertices, [[3, 3, 3]]]), extra
    )


def touching_octahedra():
    """Two octahedra that share the vertex 0 at (1, 0, 0)."""
    vertices, faces = octahedron()
    shifted, _ = octahedron((2.0, 0, 0))
    joined = np.concatenate([faces, faces + 6])
    joined[joined == 6 + 3] = 0
    return np.concatenate([vertices, shifted]), joined


def test_the_error_for_a_vertex_of_two_fans_names_the_vertex():
    assert_rejected("The faces at vertex 0 form 2 fans", *touching_octahedra())


def test_a_moebius_strip_and_a_klein_bottle_are_not_orientable():
    n = 12
    strip = [[2 * i, 2 * i + 1, 2 * i + 2] for i in range(n)] + [[2 * i + 1, 2 * i + 3, 2 * i + 2] for i in range(n)]
    strip = np.array(strip)
    twisted = {2 * n: 1, 2 * n + 1: 0}
    faces = np.vectorize(lambda v: twisted.get(v, v))(strip)
    angle = np.repeat(np.arange(n), 2) * 2 * np.pi / n
    width = np.tile([-0.3, 0.3], n)
    radius = 1 + width * np.cos(angle / 2)
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), width * np.sin(angle / 2)], axis=1)
    with pytest.raises(MeshError, match=r"not orientable .* a curve through edge \(\d+, \d+\)") as caught:
        Mesh(vertices, faces)
    a, b = map(int, re.findall(r"\((\d+), (\d+)\)", str(caught.value))[0])
    assert {tuple(sorted((a, b)))} <= {
        tuple(sorted(e)) for f in faces.tolist() for e in zip(f, f[1:] + f[:1], strict=True)
    }
    # A single cut turns it into a twisted strip with one boundary and two more vertices.
    repaired = Mesh(vertices, faces, repair=True)
    assert (repaired.num_vertices, repaired.num_faces, len(repaired.boundary_loops)) == (2 * n + 2, 2 * n, 1)
    assert [text.split(" (")[0] for text in repaired.report.repairs] == [
        "cut along 1 edge where the surface was one-sided"
    ]
    # A Klein bottle is a torus lattice whose last row joins the reflected first row. Its positions do not matter.
    i, j = np.divmod(np.arange(36), 6)

    def at(i, j):
        return 6 * (i % 6) + np.where(i >= 6, -j, j) % 6

    quads = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]
    klein = np.concatenate([np.stack([quads[k] for k in corners], axis=1) for corners in ([0, 1, 2], [0, 2, 3])])
    positions = np.random.default_rng(0).normal(size=(36, 3))
    assert_rejected("not orientable", positions, klein)
    repaired = Mesh(positions, klein, repair=True)
    assert (repaired.num_faces, repaired.report.components) == (72, 1)
    assert repaired.boundary_loops
    assert repaired.area == pytest.approx(face_areas(positions, klein).sum())


@pytest.mark.parametrize("repair", [False, True])
def test_surfaces_of_fewer_than_six_vertices_are_rejected(repair):
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    with pytest.raises(
        MeshError, match="left no faces" if repair else "component of vertex 0 has 4 vertices; at least 6"
    ):
        Mesh(corners, tetrahedron, repair=repair)


def test_surfaces_of_six_vertices_are_accepted():
    assert Mesh(*octahedron()).is_closed
    angles = np.arange(5) * 2 * np.pi / 5
    fan = np.concatenate([[[0, 0, 0]], np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)])
    assert not Mesh(fan, [[0, 1 + i, 1 + (i + 1) % 5] for i in range(5)]).is_closed


def test_inconsistent_orientation_is_corrected_and_reported(ball, sheet):
    vertices, faces = ball
    expected = np.sort(np.sort(faces), axis=0)
    for count in (1, 17, 60, 80):
        mixed = faces.copy()
        mixed[:count] = mixed[:count, ::-1]
        mesh = Mesh(vertices, mixed)
        assert mesh.report.reoriented_faces == count  # outwards, even against the majority
        assert volume(mesh) > 0
        np.testing.assert_array_equal(np.sort(np.sort(mesh.faces), axis=0), expected)
    vertices, faces = sheet
    for count, reported in ((1, 1), (len(faces) - 2, 2)):
        mixed = faces.copy()
        mixed[:count] = mixed[:count, ::-1]
        mesh = Mesh(vertices, mixed)
        assert mesh.report.reoriented_faces == reported  # a surface without an outside follows the majority
        one_rings(mesh.faces, mesh.num_vertices)


def volume(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(np.sum(a * np.cross(b, c)) / 6)


def test_a_closed_component_far_from_the_origin_faces_outwards(ball):
    vertices, faces = ball
    for shift in (1e3, 1e7):
        assert Mesh(vertices + shift, faces).report.reoriented_faces == 0
        assert Mesh(vertices + shift, faces[:, ::-1]).report.reoriented_faces == 80


def test_unreferenced_vertices_are_dropped_even_if_not_finite(ball):
    vertices, faces = ball
    mesh = Mesh(np.concatenate([[[np.nan] * 3], vertices, [[9.0, 9, 9]]]), faces + 1)
    assert mesh.report.dropped_vertices == 2
    np.testing.assert_array_equal(mesh.original_index, np.arange(1, 43))
    assert mesh.welded_index[0] == mesh.welded_index[-1] == -1


def test_pull_and_push_map_data_from_and_to_the_source(ball):
    vertices, faces = ball
    # The source has two copies of every vertex, each used by half of the faces, and an unused vertex 0.
    original = np.concatenate([[[5.0, 5, 5]], vertices, vertices[::-1]])
    faces = np.concatenate([faces[:40] + 1, 84 - faces[40:]])
    mesh = Mesh(original, faces, weld=True)
    used = len(np.unique(faces))
    assert (mesh.num_vertices, mesh.report.dropped_vertices) == (42, 85 - used)
    assert mesh.report.welded_vertices == used - 42
    pushed = mesh.push(mesh.vertices)
    is_used = mesh.welded_index >= 0
    np.testing.assert_array_equal(pushed[is_used], original[is_used])
    assert np.isnan(pushed[~is_used]).all()
    np.testing.assert_array_equal(mesh.pull(original), mesh.vertices)
    assert mesh.push(np.arange(42), fill=-1).dtype == np.int64
    assert mesh.push(np.arange(42, dtype=np.float32)).dtype == np.float32
    with pytest.raises(ValueError, match="one entry for each of 42 vertices"):
        mesh.push(np.zeros(43))
    with pytest.raises(ValueError, match=r"found shape \(42,\)"):
        mesh.pull(np.zeros(42))


def test_positive_and_negative_zero_are_the_same_position():
    mesh = shapes.square(n=4)
    vertices = mesh.vertices[mesh.faces].reshape(-1, 3)
    vertices[::2] = np.where(vertices[::2] == 0, -0.0, vertices[::2])
    welded = Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3), weld=True)
    assert welded.num_vertices == 25
    assert welded.report.welded_vertices == len(vertices) - 25


def test_repair_drops_bad_faces_and_reports_them(ball):
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
    mesh = Mesh(*touching_octahedra(), repair=True)
    assert (mesh.num_vertices, mesh.report.components, mesh.report.euler_number) == (12, 2, 4)
    assert mesh.report.repairs == ("split 1 vertex where separate fans touched",)
    assert np.sum(mesh.original_index == 0) == 2
    assert mesh.welded_index[0] == 0


def test_repair_drops_small_components(ball):
    vertices, faces = ball
    extra = np.eye(3) + 5
    assert_rejected(
        "component of vertex 42 has 3 vertices",
        np.concatenate([vertices, extra]),
        np.concatenate([faces, [[42, 43, 44]]]),
    )
    mesh = Mesh(np.concatenate([vertices, extra]), np.concatenate([faces, [[42, 43, 44]]]), repair=True)
    assert mesh.num_vertices == 42
    assert mesh.report.repairs == ("dropped 1 face of components too small to differentiate on",)


def test_repair_of_random_triangles_gives_a_valid_mesh_or_an_error():
    random = np.random.default_rng(3)
    outcomes = {"mesh": 0, "error": 0}
    for _ in range(150):
        vertices = random.integers(0, 4, size=(30, 3)).astype(float)
        faces = random.integers(-1, 31, size=(int(random.integers(5, 200)), 3))
        try:
            mesh = Mesh(vertices, faces, repair=True, weld=bool(random.integers(2)))
        except MeshError:
            outcomes["error"] += 1
            continue
        outcomes["mesh"] += 1
        checked = Mesh(mesh.vertices, mesh.faces)  # the repaired mesh passes the checks
        assert checked.report.reoriented_faces == 0
        np.testing.assert_array_equal(mesh.vertices, checked.vertices)
        one_rings(mesh.faces, mesh.num_vertices)
    assert min(outcomes.values()) > 5, outcomes


def test_a_mesh_is_immutable(ball):
    mesh = Mesh(*ball)
    with pytest.raises(AttributeError):
        mesh.vertices = mesh.vertices  # pyright: ignore
    for name in ("vertices", "faces", "original_index", "welded_index", "edges", "boundary_vertices", "components"):
        assert not getattr(mesh, name).flags.writeable
    ball[0][0] = 7  # the mesh has its own copy of the array
    assert mesh.vertices[0, 0] != 7


def test_scaling_changes_lengths_only():
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
    assert_rejected(
        "Normals must have length 1, found length 0 at vertex 3",
        vertices,
        faces,
        normals=vertices * (np.arange(42) != 3)[:, None],
    )
    assert_rejected("Normals must have the shape of the vertices", vertices, faces, normals=vertices[:-1])


def test_the_report_prints_as_a_table_and_converts_to_json():
    mesh = shapes.cylinder(n_around=8, n_along=2)
    assert json.loads(json.dumps(mesh.report.as_dict()))["boundary_loops"] == [8, 8]
    lines = str(mesh.report).splitlines()
    assert "2 loops of 8, 8 edges" in str(mesh.report)
    assert len({len(re.match(r"[^0-9]*?\s\s+", line).group()) for line in lines[:4]}) == 1
    assert repr(mesh) == "Mesh(24 vertices, 32 faces, 2 boundary loops)"


def test_masked_positions_and_faces_are_rejected():
    tetrahedron = np.eye(4, 3), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    for index in (0, 1):
        arrays = list(tetrahedron)
        arrays[index] = np.ma.masked_array(arrays[index], np.zeros(arrays[index].shape, bool))
        with pytest.raises(ltl.MeshError, match="whose mask would be lost"):
            ltl.Mesh(*arrays)
