"""Polygons, convex or not, are split into triangles that cover them once."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ltljax._mesh import MeshError, load_mesh
from ltljax._mesh.polygons import triangulated


def areas_of(points, triangles):
    corners = points[triangles]
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(4, 14))
def test_triangles_cover_a_polygon_of_any_shape_once(seed, count):
    random = np.random.default_rng(seed)
    angle = (np.arange(count) + random.uniform(0.1, 0.9, count)) * 2 * np.pi / count
    corners = random.uniform(0.05, 1, count) * np.exp(1j * angle)
    rotation, _ = np.linalg.qr(random.normal(size=(3, 3)))
    points = np.stack([corners.real, corners.imag, 0 * angle], axis=1) @ rotation.T
    points = np.roll(points, random.integers(count), axis=0)
    triangles = triangulated(points, np.arange(count), [count])
    exact = 0.5 * np.imag(np.conj(corners) * np.roll(corners, -1)).sum()
    assert areas_of(points, triangles).sum() == pytest.approx(exact)
    assert sorted(np.unique(triangles)) == list(range(count))


def test_corners_on_a_straight_side_do_not_make_triangles_without_area():
    points = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 2, 0], [1, 2, 0], [0, 2, 0]], float)
    for shift in range(6):
        polygon = np.roll(points, shift, axis=0)
        triangles = triangulated(polygon, np.arange(6), [6])
        assert areas_of(polygon, triangles).min() > 0.5
        assert areas_of(polygon, triangles).sum() == pytest.approx(4)


def test_the_error_for_a_polygon_that_crosses_itself_names_the_face():
    angle = np.arange(5) * 4 * np.pi / 5
    star = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    with pytest.raises(MeshError, match="face 1 crosses itself"):
        triangulated(star, [0, 1, 2, 0, 1, 2, 3, 4], [3, 5])


def test_polygons_that_wind_around_a_corner_or_overlap_themselves_are_rejected():
    angles = np.radians([0, 100, 200, 300, 400])
    spiral = np.concatenate([[[0, 0]], (np.linspace(1, 1.4, 5) * np.stack([np.cos(angles), np.sin(angles)])).T])
    spike = np.array([[0, 0], [2, 0], [2, 1], [3, 1], [2, 1], [2, 2], [0, 2.0]])
    for corners in (spiral, spike):
        points = np.c_[corners, np.zeros(len(corners))]
        with pytest.raises(MeshError, match="face 0 crosses itself"):
            triangulated(points, np.arange(len(points)), [len(points)])


def test_triangles_cover_a_polygon_of_a_thousand_corners_once():
    angle = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    radius = 1 + 0.3 * np.cos(50 * angle)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)
    triangles = triangulated(points, np.arange(1000), [1000])
    assert areas_of(points, triangles).sum() == pytest.approx(
        0.5 * abs(np.sum(points[:, 0] * np.roll(points[:, 1], -1) - points[:, 1] * np.roll(points[:, 0], -1)))
    )


@pytest.mark.parametrize(("name", "area"), [("l_prism.obj", 14), ("l_prism.off", 14), ("dart.obj", 25)])
def test_faces_of_files_that_are_not_convex_keep_their_area(name, area, case_file):
    assert load_mesh(case_file(name)).area == pytest.approx(area)
