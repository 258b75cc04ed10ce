"""Files of every format give the same surface, and real meshes have their known counts."""

import base64
import importlib.util
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import trimesh
from mesh_files import WRITERS, gltf, gltf_buffer, written

from ltljax._mesh import MeshError, load_mesh, one_rings, shapes


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("shape", [shapes.icosphere(2), shapes.disk(rings=4)], ids=["closed", "open"])
def test_every_format_preserves_the_surface(kind, shape, tmp_path):
    suffix, write = WRITERS[kind]
    mesh = load_mesh(written(tmp_path, f"mesh.{suffix.upper()}", write(shape.vertices, shape.faces)))
    assert (mesh.num_vertices, mesh.num_faces) == (shape.num_vertices, shape.num_faces)
    assert [len(loop) for loop in mesh.boundary_loops] == [len(loop) for loop in shape.boundary_loops]
    assert mesh.report.reoriented_faces == 0
    # Some formats store single precision.
    np.testing.assert_allclose(
        mesh.vertices[mesh.faces].mean(axis=1), shape.vertices[shape.faces].mean(axis=1), atol=3e-7
    )
    if kind not in ("stl", "stl text"):
        np.testing.assert_array_equal(mesh.original_index, np.arange(shape.num_vertices))
        np.testing.assert_allclose(mesh.vertices, shape.vertices, atol=1e-7)


def test_stl_is_welded_by_position_and_data_follow(tmp_path):
    shape = shapes.icosphere(2)
    path = written(tmp_path, "mesh.stl", WRITERS["stl"][1](shape.vertices, shape.faces))
    mesh = load_mesh(path)
    assert mesh.report.vertices_in_file == 3 * shape.num_faces
    assert mesh.report.welded_vertices == 3 * shape.num_faces - shape.num_vertices
    np.testing.assert_allclose(mesh.push(mesh.vertices), shape.vertices[shape.faces].reshape(-1, 3), atol=1e-7)
    with pytest.raises(MeshError, match=r"mesh\.stl: .*has 3 vertices; at least 6"):
        load_mesh(path, weld=False)


@pytest.mark.parametrize(
    ("name", "vertices", "faces", "loops", "dropped", "euler_number"),
    [
        ("spot.obj", 11533, 23062, [], 0, 2),
        ("spot_low.obj", 829, 1654, [], 0, 2),
        ("bunny_closed.obj", 3301, 6598, [], 0, 2),
        ("armadillo.obj", 14587, 29170, [], 0, 2),
        ("stanford_bunny.obj", 34834, 69451, [22, 42, 39, 40, 80], 1113, -3),
        ("hand_open.obj", 810, 1602, [16], 0, 1),
    ],
)
def test_real_meshes_have_their_known_counts(real_mesh, name, vertices, faces, loops, dropped, euler_number):
    mesh = load_mesh(real_mesh(name))
    report = mesh.report
    assert (report.vertices, report.faces, report.euler_number) == (vertices, faces, euler_number)
    assert sorted(report.boundary_loops) == sorted(loops)
    assert report.boundary_edges == sum(loops)
    assert report.components == 1
    assert report.dropped_vertices == dropped
    assert report.vertices_in_file == vertices + dropped
    assert one_rings(mesh.faces, mesh.num_vertices).valences.sum() == 2 * report.edges
    np.testing.assert_array_equal(mesh.welded_index[mesh.original_index], np.arange(vertices))


def test_the_vertices_of_an_obj_keep_the_order_of_the_file(real_mesh):
    path = real_mesh("stanford_bunny.obj")
    mesh = load_mesh(path)
    lines = [line.split() for line in path.read_text().splitlines() if line.startswith("v ")]
    positions = np.array([[float(x) for x in line[1:4]] for line in lines])
    np.testing.assert_array_equal(mesh.pull(positions), mesh.vertices)


def test_the_error_for_a_moebius_strip_names_an_edge(real_mesh):
    with pytest.raises(MeshError, match=r"moebius\.obj: The surface is not orientable .* edge \(\d+, \d+\)"):
        load_mesh(real_mesh("moebius.obj"))


def test_obj_with_seams_groups_polygons_and_relative_indices_is_read(tmp_path):
    n = 5
    grid = [(i, j) for i in range(n) for j in range(n)]
    lines = ["# a square of quadrangles, as graphics programs write it", "mtllib none.mtl", "o thing"]
    lines += [f"  v {j}.0 {i}e0 0 1 0.5 0.5 0.5" for i, j in grid]
    lines += ["vt 0 0", "vn 0 0 1", "s off"]
    for i in range(n - 1):
        lines += [f"g row{i}", f"usemtl m{i}"]
        for j in range(n - 1):
            a, b, c, d = i * n + j, i * n + j + 1, (i + 1) * n + j + 1, (i + 1) * n + j
            if i % 2:
                lines.append(f"f {a - n * n} {b - n * n}\\\n {c - n * n} {d - n * n}  # counted from the end")
            else:
                lines.append(f"f {a + 1}/1/1 {b + 1}//1 {c + 1}/1 {d + 1}\r")
    mesh = load_mesh(written(tmp_path, "quads.obj", "\n".join(lines)))
    assert (mesh.num_vertices, mesh.num_faces, mesh.area) == (25, 32, 16.0)
    np.testing.assert_array_equal(mesh.original_index, np.arange(25))


def test_ply_and_off_with_polygons_and_extra_columns_are_read(tmp_path):
    square = shapes.square(n=3)
    quads = [[i * 4 + j, i * 4 + j + 1, i * 4 + j + 5, i * 4 + j + 4] for i in range(3) for j in range(3)]
    hexagon = [1, 2, 6, 5, 4, 0]  # the union of the first two quadrangles
    polygons = [hexagon, *quads[2:]]
    rows = [" ".join(map(str, [len(polygon), *polygon])) for polygon in polygons]
    points = [f"{x} {y} {z}" for x, y, z in square.vertices.tolist()]
    head = ["ply", "format ascii 1.0", "comment x", "element vertex 16", "property float quality"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"element face {len(rows)}", "property uchar flag", "property list uchar int vertex_indices", "end_header"]
    ply = "\r\n".join([*head, *(f"0.5 {p}" for p in points), *(f"7 {row}" for row in rows)])
    off = "\n".join(["COFF", "# comment", f"16 {len(rows)} 0", *(f"{p} 255 0 0 255" for p in points), *rows])
    for name, text in (("p.ply", ply), ("p.off", off), ("q.off", off.replace("COFF\n# comment\n", "OFF "))):
        mesh = load_mesh(written(tmp_path, name, text))
        assert (mesh.num_vertices, mesh.num_faces) == (16, 18)
        assert mesh.area == pytest.approx(1.0)


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply_with_mixed_polygons_and_extra_properties_is_read(tmp_path, order):
    square = shapes.square(n=3)
    quads = [[i * 4 + j, i * 4 + j + 1, i * 4 + j + 5, i * 4 + j + 4] for i in range(3) for j in range(3)]
    polygons = [[1, 2, 6, 5, 4, 0], *quads[2:8], quads[8][:3], [quads[8][0], *quads[8][2:]]]
    kind = {"<": "little", ">": "big"}[order]
    head = f"ply\nformat binary_{kind}_endian 1.0\nobj_info x\nelement camera 2\nproperty list short double pose\n"
    head += "element vertex 16\nproperty uchar red\nproperty double x\nproperty double y\nproperty double z\n"
    head += f"element face {len(polygons)}\nproperty list uchar float texcoord\nproperty ushort flag\n"
    head += "property list uchar uint vertex_indices\nelement edge 1\nproperty int a\nend_header\n"
    body = b"".join(np.array([2], f"{order}i2").tobytes() + np.array([0.5, 2], f"{order}f8").tobytes() for _ in "ab")
    body += b"".join(b"\n" + point.astype(f"{order}f8").tobytes() for point in square.vertices)
    for index, polygon in enumerate(polygons):
        texture = np.zeros(index % 3, f"{order}f4")
        body += bytes([len(texture)]) + texture.tobytes() + b"ab" + bytes([len(polygon)])
        body += np.array(polygon, f"{order}u4").tobytes()
    data = head.encode() + body + b"1234"
    mesh = load_mesh(written(tmp_path, "mixed.ply", data))
    np.testing.assert_array_equal(mesh.vertices, square.vertices)
    assert (mesh.num_faces, mesh.area) == (18, pytest.approx(1.0))
    for length in range(len(head) + 20, len(data) - 3, 37):
        with pytest.raises(MeshError, match="end before them"):
            load_mesh(written(tmp_path, "cut.ply", data[:length]))


def test_the_parts_of_a_scene_are_joined_with_their_transforms(tmp_path):
    ball = shapes.icosphere(1)
    scene = trimesh.Scene()
    part = trimesh.Trimesh(ball.vertices, ball.faces, process=False)
    scene.add_geometry(part, node_name="a", geom_name="ball")
    moved = np.diag([2.0, 2, 2, 1])
    moved[:3, 3] = [10, 0, 0]
    scene.graph.update(frame_to="b", frame_from="a", matrix=moved, geometry="ball")
    mirrored = np.diag([-1.0, 1, 1, 1])
    mirrored[:3, 3] = [0, 10, 0]
    scene.graph.update(frame_to="c", frame_from="b", matrix=mirrored, geometry="ball")
    mesh = load_mesh(written(tmp_path, "scene.glb", scene.export(file_type="glb")))
    assert mesh.report.components == 3
    assert mesh.report.reoriented_faces == 0
    centres = [mesh.vertices[mesh.components == label].mean(axis=0) for label in range(3)]
    np.testing.assert_allclose(
        sorted(map(tuple, np.round(centres, 5))), [(0, 0, 0), (10, 0, 0), (10, 20, 0)], atol=1e-5
    )
    assert mesh.area == pytest.approx(ball.area * (1 + 4 + 4), rel=1e-5)


def test_text_gltf_is_read_with_its_buffer_inside_or_beside_it(tmp_path):
    inside = "data:application/octet-stream;base64," + base64.b64encode(gltf_buffer()).decode()
    assert load_mesh(written(tmp_path, "inside.gltf", gltf(inside))).num_vertices == 42
    path = written(tmp_path, "beside.gltf", gltf("data%201.bin"))
    with pytest.raises(MeshError, match=r"the buffer 'data%201.bin' is missing"):
        load_mesh(path)
    written(tmp_path, "data 1.bin", gltf_buffer())
    assert load_mesh(path).num_faces == 80


@pytest.mark.parametrize("suffix", ["vtk", "vtu", "msh"])
def test_vtk_vtu_and_gmsh_files_are_read_with_meshio(tmp_path, suffix, capsys):
    meshio = pytest.importorskip("meshio")
    shape = shapes.icosphere(1)
    cells = [("line", np.array([[0, 1]])), ("triangle", shape.faces[:40]), ("triangle", shape.faces[40:])]
    kind = {"msh": "gmsh22"}.get(suffix, suffix)
    meshio.Mesh(shape.vertices, cells).write(tmp_path / f"mesh.{suffix}", file_format=kind)
    mesh = load_mesh(tmp_path / f"mesh.{suffix}")
    np.testing.assert_array_equal(mesh.vertices, shape.vertices)
    np.testing.assert_array_equal(mesh.faces, shape.faces)
    meshio.Mesh(shape.vertices, [("tetra", np.array([[0, 1, 2, 3]]))]).write(
        tmp_path / f"solid.{suffix}", file_format=kind
    )
    capsys.readouterr()
    with pytest.raises(MeshError, match="expected triangles, found tetra"):
        load_mesh(tmp_path / f"solid.{suffix}")
    path = written(tmp_path, f"cut.{suffix}", (tmp_path / f"mesh.{suffix}").read_bytes()[:700])
    with pytest.raises(MeshError, match="could not be read"):
        load_mesh(path)
    assert capsys.readouterr() == ("", "")  # the output of the package is in the message instead


def test_quads_and_curved_elements_become_triangles(tmp_path):
    meshio = pytest.importorskip("meshio")
    square = shapes.square(n=4)
    quads = np.array([[i * 5 + j, i * 5 + j + 1, i * 5 + j + 6, i * 5 + j + 5] for i in range(4) for j in range(4)])
    meshio.Mesh(square.vertices, [("quad", quads)]).write(tmp_path / "quads.vtu")
    assert load_mesh(tmp_path / "quads.vtu").area == pytest.approx(1.0)
    ends = square.vertices[square.faces]
    midpoints = (ends + np.roll(ends, -1, axis=1)).reshape(-1, 3) / 2
    curved = np.concatenate([square.faces, 25 + np.arange(len(midpoints)).reshape(-1, 3)], axis=1)
    meshio.Mesh(np.concatenate([square.vertices, midpoints]), [("triangle6", curved)]).write(tmp_path / "curved.vtu")
    mesh = load_mesh(tmp_path / "curved.vtu")
    assert (mesh.num_vertices, mesh.num_faces) == (25, 32)


def test_vtk_surfaces_are_read_with_pyvista(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    shape = shapes.disk(rings=3)
    surface = pyvista.PolyData.from_regular_faces(shape.vertices, shape.faces)
    for name in ("surface.vtp", "surface.vtk"):
        surface.save(str(tmp_path / name))
        mesh = load_mesh(tmp_path / name)
        np.testing.assert_allclose(mesh.vertices, shape.vertices, atol=1e-7)
        np.testing.assert_array_equal(mesh.faces, shape.faces)


def test_gifti_surfaces_are_read_with_nibabel(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    shape = shapes.icosphere(1)
    arrays = [
        nibabel.gifti.GiftiDataArray(shape.vertices.astype(np.float32), intent="NIFTI_INTENT_POINTSET"),
        nibabel.gifti.GiftiDataArray(shape.faces.astype(np.int32), intent="NIFTI_INTENT_TRIANGLE"),
    ]
    nibabel.save(nibabel.gifti.GiftiImage(darrays=arrays), tmp_path / "brain.surf.gii")
    np.testing.assert_array_equal(load_mesh(tmp_path / "brain.surf.gii").faces, shape.faces)
    nibabel.save(nibabel.gifti.GiftiImage(darrays=arrays[:1]), tmp_path / "points.surf.gii")
    with pytest.raises(MeshError, match="found no points or no triangles"):
        load_mesh(tmp_path / "points.surf.gii")


@pytest.mark.parametrize(("name", "extra"), [("m.vtu", "io"), ("m.msh", "io"), ("m.gii", "io"), ("m.vtp", "viz")])
def test_the_error_for_a_missing_package_names_the_extra(tmp_path, monkeypatch, name, extra):
    monkeypatch.setattr(importlib.util, "find_spec", lambda module: None)
    with pytest.raises(MeshError) as caught:
        load_mesh(written(tmp_path, name, "x"))
    assert f'pip install "ltljax[{extra}]"' in str(caught.value)


@pytest.mark.parametrize("name", [
    "glued_head.off", "lower_head.off", "bom.off", "no_head.off", "wrapped.off", "int64.ply", "upper_types.ply",
    "tristrips.ply", "sphere.gii.gz", "sphere.obj.gz", "lh.pial",
])  # fmt: skip
def test_variants_that_other_programs_write_are_read(name, case_file):
    mesh = load_mesh(case_file(name))
    assert (mesh.num_vertices, mesh.num_faces) == (162, 320)
    assert mesh.is_closed
    assert mesh.report.reoriented_faces == 0


def test_text_freesurfer_surfaces_are_read(tmp_path):
    shape = shapes.icosphere(1)
    rows = [f"{x} {y} {z} 0" for x, y, z in shape.vertices] + [f"{a} {b} {c} 0" for a, b, c in shape.faces]
    text = f"#!ascii version of lh.pial\n{shape.num_vertices} {shape.num_faces}\n" + "\n".join(rows) + "\n"
    mesh = load_mesh(written(tmp_path, "lh.pial.asc", text))
    np.testing.assert_allclose(mesh.vertices, shape.vertices)


@pytest.mark.parametrize(
    ("head", "extra"), [("OFF", ""), ("COFF", " 255 0 0 255"), ("COFF", " 255 0 0"), ("NOFF", " 0 0 1")]
)
def test_off_files_may_have_arbitrary_line_breaks(tmp_path, head, extra):
    shape = shapes.icosphere(1)
    rows = [f"{x!r} {y!r} {z!r}{extra}" for x, y, z in shape.vertices.tolist()]
    rows += [f"3 {a} {b} {c}" for a, b, c in shape.faces.tolist()]
    text = f"{head}\n{shape.num_vertices} {shape.num_faces} 0\n" + "\n".join(
        " ".join(rows[index : index + 2]) for index in range(0, len(rows), 2)
    )
    mesh = load_mesh(written(tmp_path, "a.off", text))
    np.testing.assert_array_equal(mesh.vertices, shape.vertices)
    np.testing.assert_array_equal(mesh.faces, shape.faces)


def test_loading_in_parallel_threads_equals_loading_in_sequence(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    ball = shapes.icosphere(1)
    paths = [
        written(tmp_path, f"{kind}{index}.{suffix}", write(ball.vertices * (index + 1), ball.faces))
        for index in range(8)
        for kind, (suffix, write) in WRITERS.items()
    ]
    arrays = [
        nibabel.gifti.GiftiDataArray(ball.vertices.astype(np.float32), intent="NIFTI_INTENT_POINTSET"),
        nibabel.gifti.GiftiDataArray(ball.faces.astype(np.int32), intent="NIFTI_INTENT_TRIANGLE"),
    ]
    for index in range(2):
        nibabel.save(nibabel.gifti.GiftiImage(darrays=arrays), tmp_path / f"{index}.gii")
        paths.append(tmp_path / f"{index}.gii")
    streams, filters = (sys.stdout, sys.stderr), list(warnings.filters)
    with ThreadPoolExecutor(32) as pool:
        meshes = list(pool.map(load_mesh, paths))
    assert (sys.stdout, sys.stderr) == streams
    assert list(warnings.filters) == filters
    for path, mesh in zip(paths, meshes, strict=True):
        expected = load_mesh(path) if path.suffix != ".gii" or path.stem == "0" else mesh
        np.testing.assert_array_equal(mesh.vertices, expected.vertices)
        np.testing.assert_array_equal(mesh.faces, expected.faces)
