"""Every format gives the same surface, real meshes give their known counts, and damaged files give a `MeshError`."""

import base64
import gzip
import importlib.util
import json
import os
import resource
import sys
import time
import warnings
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings, strategies as st
from mesh_files import WRITERS, damaged

from ltljax._mesh import Mesh, MeshError, load_mesh, one_rings, readers, shapes
from ltljax._mesh.polygons import triangulated


def written(folder: Path, name: str, data: bytes | str) -> Path:
    path = folder / name
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("shape", [shapes.icosphere(2), shapes.disk(rings=4)], ids=["closed", "open"])
def test_every_format_gives_the_surface_back(kind, shape, tmp_path):
    ending, write = WRITERS[kind]
    mesh = load_mesh(written(tmp_path, f"mesh.{ending.upper()}", write(shape.vertices, shape.faces)))
    assert (mesh.num_vertices, mesh.num_faces) == (shape.num_vertices, shape.num_faces)
    assert [len(loop) for loop in mesh.boundary_loops] == [len(loop) for loop in shape.boundary_loops]
    assert mesh.report.reoriented_faces == 0
    # Single precision is all that some formats hold.
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


def test_a_moebius_strip_is_refused_with_an_edge(real_mesh):
    with pytest.raises(MeshError, match=r"moebius\.obj: The surface is not orientable: .* edge \(\d+, \d+\)"):
        load_mesh(real_mesh("moebius.obj"))


def test_obj_with_seams_groups_polygons_and_relative_indices(tmp_path):
    n = 5
    grid = [(i, j) for i in range(n) for j in range(n)]
    lines = ["# a square of quads, as programs for drawing write it", "mtllib none.mtl", "o thing"]
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


def test_ply_and_off_with_polygons_and_further_columns(tmp_path):
    square = shapes.square(n=3)
    quads = [[i * 4 + j, i * 4 + j + 1, i * 4 + j + 5, i * 4 + j + 4] for i in range(3) for j in range(3)]
    hexagon = [1, 2, 6, 5, 4, 0]  # the first two quads, from a corner that sees all others
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
def test_binary_ply_with_mixed_polygons_and_further_properties(tmp_path, order):
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


def test_a_scene_is_joined_with_its_transforms(tmp_path):
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


def gltf(uri: str, change=None) -> str:
    """An icosphere of 42 vertices and 80 faces as text glTF, with its buffer at ``uri``."""
    tree = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 42 * 12 + 80 * 12, "uri": uri}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 42 * 12},
            {"buffer": 0, "byteOffset": 42 * 12, "byteLength": 80 * 12},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 42, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 80 * 3, "type": "SCALAR"},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "nodes": [{"mesh": 0, "children": []}],
        "scenes": [{"nodes": [0]}],
    }
    if change:
        change(tree)
    return json.dumps(tree)


def gltf_buffer() -> bytes:
    ball = shapes.icosphere(1)
    return ball.vertices.astype("<f4").tobytes() + ball.faces.astype("<u4").tobytes()


def test_text_gltf_with_its_buffer_inside_or_beside(tmp_path):
    inside = "data:application/octet-stream;base64," + base64.b64encode(gltf_buffer()).decode()
    assert load_mesh(written(tmp_path, "inside.gltf", gltf(inside))).num_vertices == 42
    path = written(tmp_path, "beside.gltf", gltf("data%201.bin"))
    with pytest.raises(MeshError, match=r"the buffer 'data%201.bin' is missing"):
        load_mesh(path)
    written(tmp_path, "data 1.bin", gltf_buffer())
    assert load_mesh(path).num_faces == 80


@pytest.mark.parametrize(
    "change",
    [
        lambda tree: tree["accessors"][0].update(count=10**12),
        lambda tree: [tree["accessors"][0].update(count=10**12), tree["accessors"][0].pop("bufferView")],
        lambda tree: tree["accessors"][0].update(sparse={}),
        lambda tree: tree["nodes"][0].update(children=[0]),
        lambda tree: tree["nodes"][0].update(children=[5]),
        lambda tree: tree["bufferViews"][0].update(byteStride=-4),
        lambda tree: tree["bufferViews"][0].update(byteStride=10**12),
        lambda tree: tree.update(asset={"version": "1.0"}),
        lambda tree: tree.update(accessors=5),
        lambda tree: tree["meshes"][0]["primitives"][0].update(mode=0),
    ],
)
def test_gltf_that_claims_more_than_it_holds_is_refused(tmp_path, change):
    inside = "data:application/octet-stream;base64," + base64.b64encode(gltf_buffer()).decode()
    with pytest.raises(MeshError, match=r"bad\.gltf: "):
        load_mesh(written(tmp_path, "bad.gltf", gltf(inside, change)))


@pytest.mark.parametrize("ending", ["vtk", "vtu", "msh"])
def test_scientific_formats_are_read_through_meshio(tmp_path, ending, capsys):
    meshio = pytest.importorskip("meshio")
    shape = shapes.icosphere(1)
    cells = [("line", np.array([[0, 1]])), ("triangle", shape.faces[:40]), ("triangle", shape.faces[40:])]
    kind = {"msh": "gmsh22"}.get(ending, ending)
    meshio.Mesh(shape.vertices, cells).write(tmp_path / f"mesh.{ending}", file_format=kind)
    mesh = load_mesh(tmp_path / f"mesh.{ending}")
    np.testing.assert_array_equal(mesh.vertices, shape.vertices)
    np.testing.assert_array_equal(mesh.faces, shape.faces)
    meshio.Mesh(shape.vertices, [("tetra", np.array([[0, 1, 2, 3]]))]).write(
        tmp_path / f"solid.{ending}", file_format=kind
    )
    capsys.readouterr()
    with pytest.raises(MeshError, match="expected triangles, found tetra"):
        load_mesh(tmp_path / f"solid.{ending}")
    path = written(tmp_path, f"cut.{ending}", (tmp_path / f"mesh.{ending}").read_bytes()[:700])
    with pytest.raises(MeshError, match="could not be read"):
        load_mesh(path)
    assert capsys.readouterr() == ("", "")  # what the reader says on the console is in the message


def test_quads_and_curved_elements_become_triangles(tmp_path):
    meshio = pytest.importorskip("meshio")
    square = shapes.square(n=4)
    quads = np.array([[i * 5 + j, i * 5 + j + 1, i * 5 + j + 6, i * 5 + j + 5] for i in range(4) for j in range(4)])
    meshio.Mesh(square.vertices, [("quad", quads)]).write(tmp_path / "quads.vtu")
    assert load_mesh(tmp_path / "quads.vtu").area == pytest.approx(1.0)
    ends = square.vertices[square.faces]
    middles = (ends + np.roll(ends, -1, axis=1)).reshape(-1, 3) / 2
    curved = np.concatenate([square.faces, 25 + np.arange(len(middles)).reshape(-1, 3)], axis=1)
    meshio.Mesh(np.concatenate([square.vertices, middles]), [("triangle6", curved)]).write(tmp_path / "curved.vtu")
    mesh = load_mesh(tmp_path / "curved.vtu")
    assert (mesh.num_vertices, mesh.num_faces) == (25, 32)


def test_vtk_surfaces_are_read_through_pyvista(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    shape = shapes.disk(rings=3)
    surface = pyvista.PolyData.from_regular_faces(shape.vertices, shape.faces)
    for name in ("surface.vtp", "surface.vtk"):
        surface.save(str(tmp_path / name))
        mesh = load_mesh(tmp_path / name)
        np.testing.assert_allclose(mesh.vertices, shape.vertices, atol=1e-7)
        np.testing.assert_array_equal(mesh.faces, shape.faces)


def test_a_damaged_vtk_surface_does_not_end_the_process(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    shape = shapes.disk(rings=3)
    pyvista.PolyData.from_regular_faces(shape.vertices, shape.faces).save(str(tmp_path / "surface.vtk"))
    data = (tmp_path / "surface.vtk").read_bytes()
    assert data.count(b"POLYGONS 54 216") + data.count(b"POLYGONS 55 162") == 1
    worse = data.replace(b"POLYGONS 5", b"POLYGONS 9000005")
    with pytest.raises(MeshError, match=r"worse\.vtk: "):
        load_mesh(written(tmp_path, "worse.vtk", worse))
    pyvista.ImageData(dimensions=(3, 3, 3)).save(str(tmp_path / "image.vti"))
    (tmp_path / "image.vti").rename(tmp_path / "image.vtp")
    with pytest.raises(MeshError, match=r"image\.vtp: "):
        load_mesh(tmp_path / "image.vtp")


def test_gifti_surfaces_are_read_through_nibabel(tmp_path):
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
def test_a_missing_reader_names_the_extra(tmp_path, monkeypatch, name, extra):
    monkeypatch.setattr(importlib.util, "find_spec", lambda module: None)
    with pytest.raises(MeshError) as caught:
        load_mesh(written(tmp_path, name, "x"))
    assert f'pip install "ltljax[{extra}]"' in str(caught.value)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("a.xyz", "0 0 0", r"the kind '\.xyz' is not known.*\.obj, \.ply, \.stl"),
        ("noending", "0 0 0", "kind '.' is not known"),
        ("empty.ply", "", "the file is empty"),
        ("points.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\np 1 2\nl 1 2 3\n", r"no faces \(and 3 vertices\)"),
        ("line.obj", "v 0 0 0\nv 1 0\n", "line 2 is not readable: 'v 1 0'"),
        ("word.obj", "v 0 0 0\nf 1 2 three\n", "line 2 is not readable"),
        ("two.obj", "v 0 0 0\nv 1 0 0\nf 1 2\n", "face 0 has 2 corners"),
        ("zero.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "Face 0 refers to vertex -1"),
        ("far.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 1000000000000\n", "Face 0 refers to vertex 999999999999"),
        ("huge.obj", "v 1e400 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "Vertex 0 has the position .inf, 0, 0."),
        ("not.off", "solid x\n", "expected the head OFF, found 'solid'"),
        ("head.off", "OFF\n", "expected the numbers of vertices and faces"),
        ("claims.off", "OFF\n1 1000000000 0\n0 0 0\n3 0 1 2\n", "announces 1000000000 rows of faces, but holds 1"),
        ("cut.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "face 0 announces 3 corners, but has 2"),
        (
            "claims.ply",
            "ply\nformat ascii 1.0\nelement vertex 1000000000000\nproperty float x\nproperty float y\n"
            "property float z\nend_header\n0 0 0\n",
            "announces 1000000000000 rows of vertex, but holds 1",
        ),
        (
            "claims2.ply",
            "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000000\nproperty float x\nproperty float y\n"
            "property float z\nend_header\n0000",
            "announces 1000000000000 rows of vertex, but its 4 bytes",
        ),
        ("claims.stl", bytes(80) + b"\xff\xff\xff\xff" + bytes(50), "announces 4294967295 triangles.* but has 134"),
        ("cut.stl", "solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n", "without 'endsolid'"),
    ],
)  # fmt: skip
def test_files_that_hold_no_surface_are_refused(tmp_path, name, data, message):
    with pytest.raises(MeshError, match=f"{name}: .*{message}"):
        load_mesh(written(tmp_path, name, data))


def test_a_path_that_is_no_file_is_refused(tmp_path):
    with pytest.raises(MeshError, match="there is no file at"):
        load_mesh(tmp_path / "missing.obj")
    with pytest.raises(MeshError, match="is a directory"):
        load_mesh(tmp_path)
    with pytest.raises(MeshError):
        load_mesh("a\0b.obj")
    with pytest.raises(MeshError):
        load_mesh("x" * 5000 + ".obj")


@pytest.mark.parametrize("kind", WRITERS)
def test_a_truncated_file_is_refused_at_every_length(tmp_path, kind):
    ending, write = WRITERS[kind]
    ball = shapes.icosphere(1)
    data = write(ball.vertices, ball.faces).rstrip()
    for length in np.linspace(0, len(data) - 3, 40).astype(int):
        path = written(tmp_path, f"cut.{ending}", data[:length])
        try:
            mesh = load_mesh(path)
        except MeshError:
            continue
        # OBJ announces no counts: cut between two lines it is a smaller surface, with a boundary that the report shows.
        assert kind == "obj"
        assert not mesh.is_closed


def test_damaged_files_give_a_mesh_or_a_mesh_error(tmp_path):
    """200 files in seven formats, with flipped bytes, lost lines, foreign numbers and cut ends; warnings are errors."""
    random = np.random.default_rng(20240501)
    good = [
        (ending, write(shape.vertices, shape.faces))
        for shape in (shapes.icosphere(1), shapes.disk(rings=3))
        for ending, write in WRITERS.values()
    ]
    accepted = refused = 0
    for index in range(200):
        ending, data = good[index % len(good)]
        path = written(tmp_path, f"damaged{index}.{ending}", damaged(data, random))
        began = time.perf_counter()
        try:
            mesh = load_mesh(path, repair=index % 3 == 0)
            accepted += 1
            assert isinstance(mesh, Mesh)
            assert np.isfinite([mesh.area, mesh.mesh_size, mesh.report.min_angle]).all()
            one_rings(mesh.faces, mesh.num_vertices)
        except MeshError:
            refused += 1
        assert time.perf_counter() - began < 5
    assert accepted + refused == 200
    assert accepted > 10
    assert refused > 50


def area_of(points, triangles):
    corners = points[triangles]
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(4, 14))
def test_a_polygon_of_any_shape_is_covered_once_by_its_triangles(seed, count):
    chance = np.random.default_rng(seed)
    angle = (np.arange(count) + chance.uniform(0.1, 0.9, count)) * 2 * np.pi / count
    place = chance.uniform(0.05, 1, count) * np.exp(1j * angle)
    turn, _ = np.linalg.qr(chance.normal(size=(3, 3)))
    points = np.roll(np.stack([place.real, place.imag, 0 * angle], axis=1) @ turn.T, chance.integers(count), axis=0)
    triangles = triangulated(points, np.arange(count), [count])
    exact = 0.5 * np.imag(np.conj(place) * np.roll(place, -1)).sum()
    assert area_of(points, triangles).sum() == pytest.approx(exact)
    assert sorted(np.unique(triangles)) == list(range(count))


def test_corners_on_a_straight_side_stay_corners_of_triangles_with_an_area():
    points = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 2, 0], [1, 2, 0], [0, 2, 0]], float)
    for shift in range(6):
        moved = np.roll(points, shift, axis=0)
        triangles = triangulated(moved, np.arange(6), [6])
        assert area_of(moved, triangles).min() > 0.5
        assert area_of(moved, triangles).sum() == pytest.approx(4)


def test_a_polygon_that_crosses_itself_is_refused_by_its_number():
    angle = np.arange(5) * 4 * np.pi / 5
    star = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    with pytest.raises(MeshError, match="face 1 crosses itself"):
        triangulated(star, [0, 1, 2, 0, 1, 2, 3, 4], [3, 5])


@pytest.mark.parametrize(("name", "area"), [("l_prism.obj", 14), ("l_prism.off", 14), ("dart.obj", 25)])
def test_faces_that_are_not_convex_keep_their_area(name, area, case_file):
    assert load_mesh(case_file(name)).area == pytest.approx(area)


@pytest.mark.parametrize("name", [
    "glued_head.off", "lower_head.off", "bom.off", "no_head.off", "wrapped.off", "int64.ply", "upper_types.ply",
    "tristrips.ply", "sphere.gii.gz", "sphere.obj.gz", "lh.pial",
])  # fmt: skip
def test_files_load_as_programs_write_them(name, case_file):
    mesh = load_mesh(case_file(name))
    assert (mesh.num_vertices, mesh.num_faces) == (162, 320)
    assert mesh.is_closed
    assert mesh.report.reoriented_faces == 0


def test_a_file_that_announces_less_than_it_holds_is_refused(case_file, tmp_path):
    with pytest.raises(MeshError, match="more rows than its head announces, by 20"):
        load_mesh(case_file("announces_fewer.ply"))
    text = "OFF\n4 3 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
    with pytest.raises(MeshError, match="by 1\\."):
        load_mesh(written(tmp_path, "less.off", text))


def in_every_format(shape, folder):
    """The shape as a file of every kind that is read, by ending."""
    pyvista, meshio, nibabel = (pytest.importorskip(name) for name in ("pyvista", "meshio", "nibabel"))
    for name in ("a.vtk", "a.vtu"):
        meshio.Mesh(shape.vertices, [("triangle", shape.faces)]).write(folder / name)
    meshio.Mesh(shape.vertices, [("triangle", shape.faces)]).write(folder / "a.msh", file_format="gmsh22")
    surface = pyvista.PolyData.from_regular_faces(shape.vertices, shape.faces)
    for name in ("b.vtk", "a.vtp"):
        surface.save(str(folder / name))
    arrays = [
        nibabel.gifti.GiftiDataArray(shape.vertices.astype(np.float32), intent="NIFTI_INTENT_POINTSET"),
        nibabel.gifti.GiftiDataArray(shape.faces.astype(np.int32), intent="NIFTI_INTENT_TRIANGLE"),
    ]
    nibabel.save(nibabel.gifti.GiftiImage(darrays=arrays), folder / "a.gii")
    nibabel.freesurfer.write_geometry(folder / "lh.pial", shape.vertices, shape.faces)
    rows = [f"{x} {y} {z} 0" for x, y, z in shape.vertices] + [f"{a} {b} {c} 0" for a, b, c in shape.faces]
    written(folder, "a.asc", f"#!ascii\n{shape.num_vertices} {shape.num_faces}\n" + "\n".join(rows) + "\n")
    inside = "data:application/octet-stream;base64," + base64.b64encode(gltf_buffer()).decode()
    written(folder, "a.gltf", gltf(inside))
    written(folder, "a.obj.gz", gzip.compress(WRITERS["obj"][1](shape.vertices, shape.faces)))
    others = [(path.name.split(".", 1)[1], path.read_bytes()) for path in folder.iterdir()]
    return others + [(ending, write(shape.vertices, shape.faces)) for ending, write in WRITERS.values()]


@pytest.mark.slow
def test_three_thousand_damaged_files_of_every_format_stay_within_their_bounds(tmp_path):
    """Each is a mesh or an error in one line, within 4 GB and 20 s."""
    random = np.random.default_rng(20261129)
    (tmp_path / "good").mkdir()
    good = in_every_format(shapes.icosphere(1), tmp_path / "good")
    paths = [
        written(tmp_path, f"{index}.{good[index % len(good)][0]}", damaged(good[index % len(good)][1], random))
        for index in range(3000)
    ]

    def outcome(path):
        began = time.perf_counter()
        try:
            load_mesh(path)
            message = ""
        except MeshError as error:
            message = str(error)
        assert time.perf_counter() - began < 20, path
        assert message == "" or (message.isprintable() and "SystemExit" not in message), message
        return message

    with ThreadPoolExecutor(2) as pool:
        messages = list(pool.map(outcome, paths))
    assert 300 < sum(message == "" for message in messages) < 2500
    for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN):
        assert resource.getrusage(who).ru_maxrss < 4e6  # in kilobytes


def test_a_packed_file_that_is_damaged_is_one_sentence(tmp_path):
    with pytest.raises(MeshError, match="could not be read as OBJ"):
        load_mesh(written(tmp_path, "a.obj.gz", b"\x1f\x8b nothing"))


def test_freesurfers_text_is_read(tmp_path):
    shape = shapes.icosphere(1)
    rows = [f"{x} {y} {z} 0" for x, y, z in shape.vertices] + [f"{a} {b} {c} 0" for a, b, c in shape.faces]
    text = f"#!ascii version of lh.pial\n{shape.num_vertices} {shape.num_faces}\n" + "\n".join(rows) + "\n"
    mesh = load_mesh(written(tmp_path, "lh.pial.asc", text))
    np.testing.assert_allclose(mesh.vertices, shape.vertices)


def test_vertices_that_rounding_has_split_are_one(case_file):
    sphere = load_mesh(case_file("near_twins.stl"))
    assert (sphere.num_vertices, sphere.num_faces, sphere.is_closed) == (162, 320, True)
    assert sphere.report.welded_vertices == 960 - 162
    cylinder = load_mesh(case_file("sewn_cylinder.obj"))
    assert (cylinder.num_vertices, [len(loop) for loop in cylinder.boundary_loops]) == (216, [24, 24])
    assert cylinder.num_vertices - len(cylinder.edges) + cylinder.num_faces == 0


@pytest.mark.parametrize(("gap", "is_closed"), [(1e-12, True), (1e-5, True), (0.01, False)])
def test_what_is_welded_follows_the_lengths_of_edges(gap, is_closed):
    sphere = shapes.icosphere(2)
    for scale in (1e-6, 1.0, 1e6):
        corners = scale * sphere.vertices[sphere.faces].reshape(-1, 3)
        moved = corners + scale * gap * np.random.default_rng(0).uniform(-1, 1, corners.shape)
        faces = np.arange(len(corners)).reshape(-1, 3)
        if is_closed:
            mesh = Mesh(moved, faces, weld=True)
            assert (mesh.num_vertices, mesh.is_closed) == (162, True)
        else:
            with pytest.raises(MeshError):
                Mesh(moved, faces, weld=True)
            assert Mesh(moved, faces, weld=0.04 * scale).num_vertices == 162


def test_a_pool_of_threads_loads_what_a_row_of_calls_does(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    ball = shapes.icosphere(1)
    paths = [
        written(tmp_path, f"{kind}{index}.{ending}", write(ball.vertices * (index + 1), ball.faces))
        for index in range(27)
        for kind, (ending, write) in WRITERS.items()
    ]
    arrays = [
        nibabel.gifti.GiftiDataArray(ball.vertices.astype(np.float32), intent="NIFTI_INTENT_POINTSET"),
        nibabel.gifti.GiftiDataArray(ball.faces.astype(np.int32), intent="NIFTI_INTENT_TRIANGLE"),
    ]
    for index in range(4):
        nibabel.save(nibabel.gifti.GiftiImage(darrays=arrays), tmp_path / f"{index}.gii")
        paths.append(tmp_path / f"{index}.gii")
    streams, filters = (sys.stdout, sys.stderr), list(warnings.filters)
    with ThreadPoolExecutor(32) as pool:
        together = list(pool.map(load_mesh, paths))
    assert (sys.stdout, sys.stderr) == streams
    assert list(warnings.filters) == filters
    for path, mesh in zip(paths, together, strict=True):
        alone = load_mesh(path) if path.suffix != ".gii" or path.stem == "0" else mesh
        np.testing.assert_array_equal(mesh.vertices, alone.vertices)
        np.testing.assert_array_equal(mesh.faces, alone.faces)


@pytest.mark.parametrize("spelt", ["ExternalFileBinary", "&#69;xternalFileBinary"])
def test_a_gifti_file_reads_no_other_file(tmp_path, spelt):
    pytest.importorskip("nibabel")
    written(tmp_path, "secret.bin", np.arange(9, dtype="<f4").tobytes())
    array = (
        '<DataArray Intent="NIFTI_INTENT_POINTSET" DataType="NIFTI_TYPE_FLOAT32" ArrayIndexingOrder="RowMajorOrder" '
        f'Dimensionality="2" Dim0="3" Dim1="3" Encoding="{spelt}" Endian="LittleEndian" '
        'ExternalFileName="secret.bin" ExternalFileOffset="0"><Data></Data></DataArray>'
    )
    text = f'<?xml version="1.0"?><GIFTI Version="1.0" NumberOfDataArrays="1">{array}</GIFTI>'
    with pytest.raises(MeshError, match="another file, which is not read"):
        load_mesh(written(tmp_path, "a.gii", text))


def test_a_gltf_file_reads_no_file_of_another_folder(tmp_path):
    (tmp_path / "inner").mkdir()
    written(tmp_path, "data.bin", gltf_buffer())
    with pytest.raises(MeshError, match="outside the file's own folder"):
        load_mesh(written(tmp_path / "inner", "a.gltf", gltf("../data.bin")))
    os.mkfifo(tmp_path / "inner" / "pipe.bin")
    with pytest.raises(MeshError, match="missing"):
        load_mesh(written(tmp_path / "inner", "a.gltf", gltf("pipe.bin")))


def test_a_small_file_that_asks_for_much_memory_is_refused(tmp_path, monkeypatch):
    pytest.importorskip("meshio")
    monkeypatch.setattr(readers, "_MEMORY", 6e8)
    zeros = zlib.compress(bytes(1 << 29), 9)
    head = np.array([1, 1 << 29, 0, len(zeros)], "<u4").tobytes()
    data = base64.b64encode(head).decode() + base64.b64encode(zeros).decode()
    text = (
        '<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian" header_type="UInt32" '
        'compressor="vtkZLibDataCompressor"><UnstructuredGrid><Piece NumberOfPoints="44739242" NumberOfCells="0">'
        f'<Points><DataArray type="Float32" NumberOfComponents="3" format="binary">{data}</DataArray></Points>'
        '<Cells><DataArray type="Int32" Name="connectivity" format="ascii"></DataArray></Cells>'
        "</Piece></UnstructuredGrid></VTKFile>"
    )
    with pytest.raises(MeshError, match=r"far more memory than a file of its size should"):
        load_mesh(written(tmp_path, "bomb.vtu", text))


@pytest.mark.skipif(sys.platform == "win32", reason="bounds the time of computing by the operating system")
def test_a_file_that_takes_too_long_to_read_is_refused(tmp_path, monkeypatch):
    pytest.importorskip("pyvista")
    monkeypatch.setattr(readers, "_SECONDS", 2)
    attributes = " ".join(f'a{index}="1"' for index in range(150_000))
    with pytest.raises(MeshError, match=r"slow\.vtp: .*was stopped after"):
        load_mesh(written(tmp_path, "slow.vtp", f"<VTKFile {attributes}></VTKFile>"))


@pytest.mark.parametrize("name", ["\x1b[31mred.obj", "two\nlines.obj"])
def test_messages_hold_no_control_characters(tmp_path, name):
    path = written(tmp_path, name, "v 0 0 \x1b[2J\n")
    with pytest.raises(MeshError) as caught:
        load_mesh(path)
    assert str(caught.value).isprintable()


def test_a_thin_wall_keeps_its_two_sides():
    plate = shapes.box(sides=(10.0, 10.0, 5e-5), n=4)
    mesh = Mesh(plate.vertices, plate.faces, weld=True)
    assert mesh.num_vertices == plate.num_vertices
    assert mesh.is_closed


def test_a_fine_part_beside_a_coarse_one_is_welded_in_no_time():
    fine, coarse = shapes.icosphere(5), shapes.icosphere(1, radius=1e5)
    vertices = np.concatenate([fine.vertices[fine.faces].reshape(-1, 3), coarse.vertices[coarse.faces].reshape(-1, 3)])
    faces = np.arange(len(vertices)).reshape(-1, 3)
    mesh = Mesh(vertices + 1e-12 * np.random.default_rng(0).normal(size=vertices.shape), faces, weld=True)
    assert mesh.num_vertices == fine.num_vertices + coarse.num_vertices


@pytest.mark.usefixtures("as_users_call_it")
@pytest.mark.parametrize("weld", [1, None, "yes", -1.0, np.nan])
def test_a_distance_of_welding_is_a_positive_number_or_a_flag(weld):
    sphere = shapes.icosphere(1)
    with pytest.raises(ValueError, match="weld"):
        Mesh(sphere.vertices, sphere.faces, weld=weld)


def test_a_polygon_of_many_corners_is_covered_once():
    angle = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    radius = 1 + 0.3 * np.cos(50 * angle)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)
    triangles = triangulated(points, np.arange(1000), [1000])
    assert area_of(points, triangles).sum() == pytest.approx(
        0.5 * abs(np.sum(points[:, 0] * np.roll(points[:, 1], -1) - points[:, 1] * np.roll(points[:, 0], -1)))
    )


def test_a_polygon_that_winds_around_a_corner_or_runs_back_on_itself_is_refused():
    turns = np.radians([0, 100, 200, 300, 400])
    spiral = np.concatenate([[[0, 0]], (np.linspace(1, 1.4, 5) * np.stack([np.cos(turns), np.sin(turns)])).T])
    spike = np.array([[0, 0], [2, 0], [2, 1], [3, 1], [2, 1], [2, 2], [0, 2.0]])
    for corners in (spiral, spike):
        points = np.c_[corners, np.zeros(len(corners))]
        with pytest.raises(MeshError, match="face 0 crosses itself"):
            triangulated(points, np.arange(len(points)), [len(points)])


@pytest.mark.parametrize(
    ("head", "extra"), [("OFF", ""), ("COFF", " 255 0 0 255"), ("COFF", " 255 0 0"), ("NOFF", " 0 0 1")]
)
def test_off_numbers_may_flow_over_lines(tmp_path, head, extra):
    shape = shapes.icosphere(1)
    rows = [f"{x!r} {y!r} {z!r}{extra}" for x, y, z in shape.vertices.tolist()]
    rows += [f"3 {a} {b} {c}" for a, b, c in shape.faces.tolist()]
    text = f"{head}\n{shape.num_vertices} {shape.num_faces} 0\n" + "\n".join(
        " ".join(rows[index : index + 2]) for index in range(0, len(rows), 2)
    )
    mesh = load_mesh(written(tmp_path, "a.off", text))
    np.testing.assert_array_equal(mesh.vertices, shape.vertices)
    np.testing.assert_array_equal(mesh.faces, shape.faces)
