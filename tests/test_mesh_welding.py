"""Vertices that coincide up to rounding are merged, and others are not."""

import numpy as np
import pytest

from ltljax._mesh import Mesh, MeshError, load_mesh, shapes


def test_vertices_split_by_rounding_are_merged(case_file):
    sphere = load_mesh(case_file("near_twins.stl"))
    assert (sphere.num_vertices, sphere.num_faces, sphere.is_closed) == (162, 320, True)
    assert sphere.report.welded_vertices == 960 - 162
    cylinder = load_mesh(case_file("sewn_cylinder.obj"))
    assert (cylinder.num_vertices, [len(loop) for loop in cylinder.boundary_loops]) == (216, [24, 24])
    assert cylinder.num_vertices - len(cylinder.edges) + cylinder.num_faces == 0


@pytest.mark.parametrize(("gap", "is_closed"), [(1e-12, True), (1e-5, True), (0.01, False)])
def test_the_welding_distance_scales_with_the_edge_lengths(gap, is_closed):
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


def test_a_thin_wall_keeps_its_two_sides():
    plate = shapes.box(sides=(10.0, 10.0, 5e-5), n=4)
    mesh = Mesh(plate.vertices, plate.faces, weld=True)
    assert mesh.num_vertices == plate.num_vertices
    assert mesh.is_closed


def test_a_fine_part_beside_a_coarse_part_is_welded_quickly():
    fine, coarse = shapes.icosphere(5), shapes.icosphere(1, radius=1e5)
    vertices = np.concatenate([fine.vertices[fine.faces].reshape(-1, 3), coarse.vertices[coarse.faces].reshape(-1, 3)])
    faces = np.arange(len(vertices)).reshape(-1, 3)
    mesh = Mesh(vertices + 1e-12 * np.random.default_rng(0).normal(size=vertices.shape), faces, weld=True)
    assert mesh.num_vertices == fine.num_vertices + coarse.num_vertices


@pytest.mark.usefixtures("as_users_call_it")
@pytest.mark.parametrize("weld", [1, None, "yes", -1.0, np.nan])
def test_weld_is_a_distance_or_a_boolean(weld):
    sphere = shapes.icosphere(1)
    with pytest.raises(ValueError, match="weld"):
        Mesh(sphere.vertices, sphere.faces, weld=weld)
