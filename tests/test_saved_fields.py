"""`load_fields`, `load_mesh` and other programs read the files that `save` writes."""

import zipfile
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import ltljax as ltl
from ltljax._mesh.columns import DataError

MESH = ltl.shapes.icosphere(2)
FIELDS = {"height": MESH.vertices[:, 2], "normal": MESH.vertices.astype(np.float32)}


def split_components(fields):
    return {"height": fields["height"]} | {f"normal_{i}": fields["normal"][:, i] for i in range(3)}


@pytest.mark.parametrize(
    ("name", "is_split", "tolerance"),
    [
        ("ball.vtp", False, 0),
        ("ball.vtu", False, 0),
        ("ball.npz", False, 0),
        ("ball.zarr", False, 0),
        ("ball.ply", True, 0),
        ("ball.gii", True, 1e-6),
        ("ball.func.gii", True, 1e-6),
    ],
)
def test_saved_fields_are_loaded_by_name(tmp_path, name, is_split, tolerance):
    if name.endswith(".zarr"):
        pytest.importorskip("zarr")
    ltl.save(tmp_path / name, MESH, FIELDS)
    loaded, expected = ltl.load_fields(tmp_path / name), split_components(FIELDS) if is_split else FIELDS
    assert set(loaded) == set(expected)
    for key, values in expected.items():
        np.testing.assert_allclose(loaded[key], values, rtol=0, atol=tolerance)


@pytest.mark.parametrize("name", ["a.vtp", "a.vtu", "a.ply", "a.glb", "a.obj", "a.stl", "a.gii"])
def test_the_saved_mesh_is_loaded(tmp_path, name):
    ltl.save(tmp_path / name, MESH, FIELDS)
    loaded = ltl.load_mesh(tmp_path / name)
    assert (loaded.num_vertices, loaded.num_faces) == (MESH.num_vertices, MESH.num_faces)
    assert loaded.area == pytest.approx(MESH.area, rel=1e-6)
    if name != "a.stl":
        np.testing.assert_allclose(loaded.vertices, MESH.vertices, atol=1e-6)


def test_a_field_may_have_any_name(tmp_path):
    ltl.save(tmp_path / "a.npz", MESH, {"file": MESH.vertices[:, 0], "allow_pickle": MESH.vertices[:, 1]})
    np.testing.assert_array_equal(ltl.load_fields(tmp_path / "a.npz")["file"], MESH.vertices[:, 0])


@pytest.mark.parametrize("name", ["a.pvd", "a.npz", "a.zarr", "a.gii"])
def test_a_saved_series_is_loaded_with_its_times(tmp_path, name):
    if name.endswith(".zarr"):
        pytest.importorskip("zarr")
    times = np.array([0.0, 0.5, 2.0])
    series = {"u": np.stack([t + MESH.vertices[:, 0] for t in times])}
    ltl.save(tmp_path / name, MESH, series, times=times)
    loaded = ltl.load_fields(tmp_path / name)
    np.testing.assert_allclose(loaded["u"], series["u"], atol=1e-6)
    if name != "a.gii":  # GIfTI does not store times
        np.testing.assert_array_equal(loaded["times"], times)


def test_formats_without_times_store_the_last_field(tmp_path):
    series = {"u": np.stack([np.zeros(MESH.num_vertices), MESH.vertices[:, 0]])}
    ltl.save(tmp_path / "a.curv", MESH, series, times=[0, 1])
    np.testing.assert_allclose(ltl.load_fields(tmp_path / "a.curv")["curv"], MESH.vertices[:, 0], atol=1e-6)
    with pytest.raises(ValueError, match="stores a single scalar field"):
        ltl.save(tmp_path / "a.curv", MESH, FIELDS)


def test_the_displacement_follows_the_values_of_a_field(tmp_path):
    for name in ("a.stl", "a.3mf", "a.ply"):
        ltl.save(tmp_path / name, MESH, {"height": MESH.vertices[:, 2]}, displacement=0.5)
    radii = np.linalg.norm(ltl.load_mesh(tmp_path / "a.ply").vertices, axis=1)
    np.testing.assert_allclose(radii, 1 + 0.25 * (1 + MESH.vertices[:, 2]), atol=1e-3)
    assert ltl.load_mesh(tmp_path / "a.stl").is_closed
    with zipfile.ZipFile(tmp_path / "a.3mf") as archive:
        assert archive.read("3D/3dmodel.model").count(b"<triangle ") == MESH.num_faces
    with pytest.raises(ValueError, match="displacement needs a scalar field"):
        ltl.save(tmp_path / "a.stl", MESH, displacement=0.5)


def test_trimesh_opens_the_3mf(tmp_path):
    pytest.importorskip("lxml")
    pytest.importorskip("networkx")
    ltl.save(tmp_path / "a.3mf", MESH)
    assert trimesh.load(tmp_path / "a.3mf", force="mesh").volume == pytest.approx(
        trimesh.Trimesh(MESH.vertices, MESH.faces).volume, rel=1e-6
    )


def test_a_surface_is_saved_with_its_current_positions(tmp_path):
    surface = ltl.Surface.from_mesh(MESH)
    moved = surface.with_vertices(2 * surface.vertices)
    ltl.save(tmp_path / "a.ply", moved, {"u": np.arange(MESH.num_vertices)})
    np.testing.assert_allclose(ltl.load_mesh(tmp_path / "a.ply").vertices, 2 * MESH.vertices, atol=1e-6)


def test_an_obj_with_texture_coordinates_gets_a_texture(tmp_path):
    square = ltl.shapes.square(1.0, 8)
    flat = square.vertices[:, :2] - square.vertices[:, :2].min(axis=0)
    mesh = ltl.Mesh(square.vertices, square.faces, uv=flat[square.faces])
    ltl.save(tmp_path / "a.obj", mesh, {"u": flat[:, 0]})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mtl", "a.obj", "a.png"]
    ltl.save(tmp_path / "a.obj", mesh, {"u": flat[:, 1]})
    (tmp_path / "a.mtl").write_text("mine")
    picture = (tmp_path / "a.png").read_bytes()
    with pytest.raises(ValueError, match="is in the way"):
        ltl.save(tmp_path / "a.obj", mesh, {"u": flat[:, 0]})
    assert ((tmp_path / "a.mtl").read_text(), (tmp_path / "a.png").read_bytes()) == ("mine", picture)


@pytest.mark.parametrize(
    ("name", "fields", "message"),
    [
        ("a.xyz", {}, r"ends in \.vtp"),
        ("a.vtp", {"u": np.zeros(5)}, r"'u' as numbers of shape \(162,\)"),
        ("a.vtp", {"u": np.array(["x"] * 162)}, "found type <U1"),
        ("a.npz", {"vertices": np.zeros(162)}, "reserved for the mesh or its times"),
        ("a.vtp", {"": np.zeros(162)}, "printable text without slashes"),
        ("a.vtp", {"a\x01": np.zeros(162)}, "printable text without slashes"),
        ("a.zarr", {"u/v": np.zeros(162)}, "printable text without slashes"),
        ("a.ply", {"end_header": np.zeros(162)}, "without spaces"),
        ("a.ply", {"höhe": np.zeros(162)}, "in ASCII"),
        ("a.ply", {"a_0": np.zeros(162), "a": np.zeros((162, 2))}, "Two columns would have the name 'a_0'"),
        ("a.gii", {"labels": np.arange(162) + 2**24}, "does not represent the integers of 'labels' exactly"),
        ("a.vtp", {"u": np.ma.masked_array(np.zeros(162), np.ones(162, bool))}, "whose mask would be lost"),
        ("a.ply", {"x": np.zeros(162)}, "PLY reserves the name 'x'"),
        ("a.ply", {"two words": np.zeros(162)}, "without spaces"),
    ],
)
def test_fields_that_a_format_cannot_store_are_rejected(tmp_path, name, fields, message):
    with pytest.raises(ValueError, match=message):
        ltl.save(tmp_path / name, MESH, fields)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "text"),
    [("a.csv", "u,v\n1\n"), ("a.npz", "x"), ("a.vtp", "x"), ("a.pvd", "<VTKFile>"), ("a.gii", "x"), ("a.xyz", "x")],
)
def test_a_damaged_file_of_fields_raises_an_error_of_a_single_line(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(DataError, match=r"a\.\w+: expected") as caught:
        ltl.load_fields(tmp_path / name)
    assert "\n" not in str(caught.value)
    with pytest.raises(DataError, match="there is none at"):
        ltl.load_fields(tmp_path / f"missing{(tmp_path / name).suffix if name != 'a.xyz' else '.csv'}")


def test_meshes_of_other_packages_are_converted_with_their_data():
    pyvista, meshio = pytest.importorskip("pyvista"), pytest.importorskip("meshio")
    height = MESH.vertices[:, 2]
    ball = trimesh.Trimesh(MESH.vertices, MESH.faces, process=False)
    ball.vertex_attributes["height"] = height
    poly = pyvista.PolyData.from_regular_faces(MESH.vertices, MESH.faces)
    poly["height"] = height
    grid = meshio.Mesh(MESH.vertices, [("triangle", MESH.faces)], point_data={"height": height})
    for source in (ball, poly, grid):
        mesh = ltl.as_mesh(source)
        np.testing.assert_allclose(mesh.vertices, MESH.vertices, atol=1e-7)
        np.testing.assert_array_equal(mesh.faces, MESH.faces)
        np.testing.assert_array_equal(ltl.io.vertex_data(source, mesh)["height"], height)
    tensor = lambda array: SimpleNamespace(numpy=lambda: array)  # noqa: E731
    for source in (
        (MESH.vertices, MESH.faces),
        {"vertices": MESH.vertices, "faces": MESH.faces},
        SimpleNamespace(vertices=MESH.vertices, triangles=MESH.faces),
        SimpleNamespace(vertex={"positions": tensor(MESH.vertices)}, triangle={"indices": tensor(MESH.faces)}),
    ):
        mesh = ltl.as_mesh(source)
        np.testing.assert_array_equal(mesh.faces, MESH.faces)
        assert ltl.io.vertex_data(source, mesh) == {}
    assert ltl.as_mesh(MESH) is MESH


def test_polygons_of_other_packages_become_triangles():
    pyvista, meshio = pytest.importorskip("pyvista"), pytest.importorskip("meshio")
    points = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2.0]])
    grid = meshio.Mesh(points, [("polygon", np.array([[1, 2, 3, 4, 5, 0]]))])
    poly = pyvista.PolyData(np.c_[points, np.zeros(6)], [6, 1, 2, 3, 4, 5, 0])
    for source in (grid, poly):
        assert ltl.as_mesh(source).area == pytest.approx(3)


@pytest.mark.parametrize("source", [None, "ball.obj", {"vertices": np.zeros((3, 3))}, np.zeros((5, 3))])
def test_the_error_for_an_object_that_is_not_a_mesh_lists_the_accepted_kinds(source):
    with pytest.raises(ltl.MeshError, match="a mesh of trimesh, PyVista, meshio or Open3D"):
        ltl.as_mesh(source)


@pytest.mark.usefixtures("as_users_call_it")
def test_the_error_for_fields_without_names_shows_how_to_name_them(tmp_path):
    with pytest.raises(TypeError, match=r'Expected fields by name, such as \{"u": u\}'):
        ltl.save(tmp_path / "a.vtp", MESH, MESH.vertices[:, 0])
    with pytest.raises(ValueError, match=r"times of shape \(T,\) with at least one time"):
        ltl.save(tmp_path / "a.vtp", MESH, {"u": np.zeros((0, 162))}, times=[])


def test_an_existing_file_stays_until_the_new_file_is_complete(tmp_path):
    for name in ("a.npz", "a.ply", "a.zarr"):
        if name == "a.zarr":
            pytest.importorskip("zarr")
        ltl.save(tmp_path / name, MESH, FIELDS)
        with pytest.raises(ValueError, match="times"):
            ltl.save(tmp_path / name, MESH, {"times": MESH.vertices[:, 0]})
        ltl.save(tmp_path / name, MESH, {"height": MESH.vertices[:, 0]})
        np.testing.assert_array_equal(ltl.load_fields(tmp_path / name)["height"], MESH.vertices[:, 0])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "a.ply", "a.zarr"]


@pytest.mark.parametrize(("name", "folder"), [("a.zarr", "a.zarr"), ("a.pvd", "a_series")])
def test_a_folder_of_the_user_is_rejected_and_not_changed(tmp_path, name, folder):
    pytest.importorskip("zarr")
    (tmp_path / folder).mkdir()
    (tmp_path / folder / "thesis.txt").write_text("mine")
    with pytest.raises(ValueError, match="which save did not write"):
        ltl.save(tmp_path / name, MESH, FIELDS)
    assert (tmp_path / folder / "thesis.txt").read_text() == "mine"
    (tmp_path / folder / "thesis.txt").unlink()
    (tmp_path / folder).rmdir()
    for _ in range(2):
        ltl.save(tmp_path / name, MESH, FIELDS)
    (tmp_path / folder / "thesis.txt").write_text("mine")
    with pytest.raises(ValueError, match="which save did not write"):
        ltl.save(tmp_path / name, MESH, FIELDS)


@pytest.mark.parametrize("name", ["a.stl", "a.gii", "a.vtp", "a.ply", "a.glb"])
def test_files_of_a_mesh_far_from_the_origin_preserve_its_shape(tmp_path, name):
    far = ltl.Mesh(MESH.vertices + np.array([5e6, 4e6, 0]), MESH.faces)
    ltl.save(tmp_path / name, far)
    loaded = ltl.load_mesh(tmp_path / name)
    assert loaded.num_vertices == far.num_vertices
    shift = 0 if name == "a.stl" else np.array([5e6, 4e6, 0])
    order = slice(None) if name != "a.stl" else np.lexsort(np.round(loaded.vertices, 4).T)
    expected = MESH.vertices if name != "a.stl" else MESH.vertices[np.lexsort(np.round(MESH.vertices, 4).T)]
    middle = np.round(expected.mean(axis=0) - (loaded.vertices[order] - shift).mean(axis=0), 6)
    np.testing.assert_allclose(loaded.vertices[order] - shift + middle, expected, atol=2e-6)


def test_a_malicious_file_of_fields_cannot_read_another_file(tmp_path):
    np.arange(9, dtype="<f4").tofile(tmp_path / "secret.bin")
    text = (
        '<?xml version="1.0"?><GIFTI Version="1.0" NumberOfDataArrays="1"><DataArray Intent="NIFTI_INTENT_SHAPE" '
        'DataType="NIFTI_TYPE_FLOAT32" ArrayIndexingOrder="RowMajorOrder" Dimensionality="1" Dim0="9" '
        'Encoding="&#69;xternalFileBinary" Endian="LittleEndian" ExternalFileName="secret.bin" '
        'ExternalFileOffset="0"><Data></Data></DataArray></GIFTI>'
    )
    (tmp_path / "a.gii").write_text(text)
    with pytest.raises(DataError, match="another file, which is not read"):
        ltl.load_fields(tmp_path / "a.gii")


def test_integers_and_booleans_in_columns_are_preserved(tmp_path):
    flags, labels = MESH.vertices[:, 0] > 0, np.arange(162, dtype=np.int32)
    ltl.save(tmp_path / "a.ply", MESH, {"flags": flags, "labels": labels, "long": np.arange(162)})
    loaded = ltl.load_fields(tmp_path / "a.ply")
    assert loaded["labels"].dtype.kind == "i"
    for name, values in (("flags", flags), ("labels", labels), ("long", np.arange(162))):
        np.testing.assert_array_equal(loaded[name], values)


def test_grids_strips_and_quadrangles_of_other_packages_are_handled():
    pyvista = pytest.importorskip("pyvista")
    poly = pyvista.PolyData.from_regular_faces(MESH.vertices, MESH.faces)
    with pytest.raises(ltl.MeshError, match="extract_surface"):
        ltl.as_mesh(poly.cast_to_unstructured_grid())
    assert ltl.as_mesh(poly.strip()).area == pytest.approx(MESH.area)
    quads = np.array([[0, 1, 4, 3], [1, 2, 5, 4], [3, 4, 7, 6], [4, 5, 8, 7]])
    points = np.array([[i, j, 0.0] for j in range(3) for i in range(3)])
    assert ltl.as_mesh((points, quads)).area == pytest.approx(4)
