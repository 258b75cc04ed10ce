"""Damaged, incomplete and malicious files raise a `MeshError`, within limits on time and memory."""

import base64
import os
import resource
import sys
import time
import zlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from mesh_files import WRITERS, damaged, gltf, gltf_buffer, in_every_format, written

from ltljax._mesh import Mesh, MeshError, load_mesh, one_rings, readers, shapes


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
        ("not.off", "solid x\n", "expected the header OFF, found 'solid'"),
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
def test_files_without_a_valid_surface_are_rejected(tmp_path, name, data, message):
    with pytest.raises(MeshError, match=f"{name}: .*{message}"):
        load_mesh(written(tmp_path, name, data))


def test_paths_that_are_not_files_are_rejected(tmp_path):
    with pytest.raises(MeshError, match="there is no file at"):
        load_mesh(tmp_path / "missing.obj")
    with pytest.raises(MeshError, match="is a directory"):
        load_mesh(tmp_path)
    with pytest.raises(MeshError):
        load_mesh("a\0b.obj")
    with pytest.raises(MeshError):
        load_mesh("x" * 5000 + ".obj")


def test_files_with_more_rows_than_announced_are_rejected(case_file, tmp_path):
    with pytest.raises(MeshError, match="has 20 rows more than its header announces"):
        load_mesh(case_file("announces_fewer.ply"))
    text = "OFF\n4 3 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
    with pytest.raises(MeshError, match="has 1 row more than its header announces"):
        load_mesh(written(tmp_path, "less.off", text))


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
def test_inconsistent_gltf_files_are_rejected(tmp_path, change):
    inside = "data:application/octet-stream;base64," + base64.b64encode(gltf_buffer()).decode()
    with pytest.raises(MeshError, match=r"bad\.gltf: "):
        load_mesh(written(tmp_path, "bad.gltf", gltf(inside, change)))


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


def test_a_damaged_compressed_file_raises_a_mesh_error(tmp_path):
    with pytest.raises(MeshError, match="could not be read as OBJ"):
        load_mesh(written(tmp_path, "a.obj.gz", b"\x1f\x8b nothing"))


@pytest.mark.parametrize("name", ["\x1b[31mred.obj", "two\nlines.obj"])
def test_messages_contain_no_control_characters(tmp_path, name):
    path = written(tmp_path, name, "v 0 0 \x1b[2J\n")
    with pytest.raises(MeshError) as caught:
        load_mesh(path)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("kind", WRITERS)
def test_truncated_files_are_rejected_at_every_length(tmp_path, kind):
    suffix, write = WRITERS[kind]
    ball = shapes.icosphere(1)
    data = write(ball.vertices, ball.faces).rstrip()
    for length in np.linspace(0, len(data) - 3, 40).astype(int):
        path = written(tmp_path, f"cut.{suffix}", data[:length])
        try:
            mesh = load_mesh(path)
        except MeshError:
            continue
        # An OBJ does not announce counts. Truncated between two lines, it is a surface with a boundary.
        assert kind == "obj"
        assert not mesh.is_closed


def test_damaged_files_give_a_mesh_or_a_mesh_error(tmp_path):
    """200 damaged files in seven formats; warnings are errors."""
    random = np.random.default_rng(20240501)
    intact = [
        (suffix, write(shape.vertices, shape.faces))
        for shape in (shapes.icosphere(1), shapes.disk(rings=3))
        for suffix, write in WRITERS.values()
    ]
    accepted = rejected = 0
    for index in range(200):
        suffix, data = intact[index % len(intact)]
        path = written(tmp_path, f"damaged{index}.{suffix}", damaged(data, random))
        began = time.perf_counter()
        try:
            mesh = load_mesh(path, repair=index % 3 == 0)
            accepted += 1
            assert isinstance(mesh, Mesh)
            assert np.isfinite([mesh.area, mesh.mesh_size, mesh.report.min_angle]).all()
            one_rings(mesh.faces, mesh.num_vertices)
        except MeshError:
            rejected += 1
        assert time.perf_counter() - began < 5
    assert accepted + rejected == 200
    assert accepted > 10
    assert rejected > 50


@pytest.mark.slow
def test_three_thousand_damaged_files_of_every_format_stay_within_their_limits(tmp_path):
    """Each file gives a mesh or an error of a single line, within 4 GB and 20 s."""
    random = np.random.default_rng(20261129)
    (tmp_path / "intact").mkdir()
    intact = in_every_format(shapes.icosphere(1), tmp_path / "intact")
    paths = [
        written(tmp_path, f"{index}.{intact[index % len(intact)][0]}", damaged(intact[index % len(intact)][1], random))
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
    for processes in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN):
        assert resource.getrusage(processes).ru_maxrss < 4e6  # in kilobytes


@pytest.mark.parametrize("spelling", ["ExternalFileBinary", "&#69;xternalFileBinary"])
def test_a_gifti_file_cannot_read_another_file(tmp_path, spelling):
    pytest.importorskip("nibabel")
    written(tmp_path, "secret.bin", np.arange(9, dtype="<f4").tobytes())
    array = (
        '<DataArray Intent="NIFTI_INTENT_POINTSET" DataType="NIFTI_TYPE_FLOAT32" ArrayIndexingOrder="RowMajorOrder" '
        f'Dimensionality="2" Dim0="3" Dim1="3" Encoding="{spelling}" Endian="LittleEndian" '
        'ExternalFileName="secret.bin" ExternalFileOffset="0"><Data></Data></DataArray>'
    )
    text = f'<?xml version="1.0"?><GIFTI Version="1.0" NumberOfDataArrays="1">{array}</GIFTI>'
    with pytest.raises(MeshError, match="another file, which is not read"):
        load_mesh(written(tmp_path, "a.gii", text))


def test_a_gltf_file_cannot_read_a_file_outside_its_folder(tmp_path):
    (tmp_path / "inner").mkdir()
    written(tmp_path, "data.bin", gltf_buffer())
    with pytest.raises(MeshError, match="outside the file's own folder"):
        load_mesh(written(tmp_path / "inner", "a.gltf", gltf("../data.bin")))
    os.mkfifo(tmp_path / "inner" / "pipe.bin")
    with pytest.raises(MeshError, match="missing"):
        load_mesh(written(tmp_path / "inner", "a.gltf", gltf("pipe.bin")))


def test_a_small_file_that_needs_much_memory_is_rejected(tmp_path, monkeypatch):
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


@pytest.mark.skipif(sys.platform == "win32", reason="needs the limit on computing time of the operating system")
def test_a_file_that_takes_too_long_to_read_is_rejected(tmp_path, monkeypatch):
    pytest.importorskip("pyvista")
    monkeypatch.setattr(readers, "_SECONDS", 1)
    monkeypatch.setattr(readers, "_PATIENCE", 100)  # the process may get little of a busy processor
    attributes = " ".join(f'a{index}="1"' for index in range(150_000))
    with pytest.raises(MeshError, match=r"slow\.vtp: .*was stopped after"):
        load_mesh(written(tmp_path, "slow.vtp", f"<VTKFile {attributes}></VTKFile>"))
