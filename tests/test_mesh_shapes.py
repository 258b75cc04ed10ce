"""Shapes lie on the surfaces of their formulas, face outwards, and have exact normals and converging areas."""

import numpy as np
import pytest
from scipy.special import ellipeinc, ellipkinc

from ltljax._mesh import Mesh, MeshError, shapes

# For each shape: the mesh at resolution n, the area, the Euler number, and the numbers of edges of the boundary loops.
SHAPES = {
    "icosphere": (lambda n: shapes.icosphere(n + 1, radius=1.5), 9 * np.pi, 2, lambda n: []),
    "ellipsoid": (lambda n: shapes.ellipsoid((3.0, 2.0, 1.0), n + 2), None, 2, lambda n: []),
    "torus": (lambda n: shapes.torus(3.0, 0.5, 2**n * 12, 2**n * 8), 4 * np.pi**2 * 1.5, 0, lambda n: []),
    "disk": (lambda n: shapes.disk(2.0, 2**n * 2), 4 * np.pi, 1, lambda n: [12 * 2**n]),
    "hemisphere": (lambda n: shapes.hemisphere(2.0, 2**n * 2), 8 * np.pi, 1, lambda n: [12 * 2**n]),
    "square": (lambda n: shapes.square(3.0, 2**n * 2), 9.0, 1, lambda n: [8 * 2**n]),
    "cylinder": (lambda n: shapes.cylinder(0.5, 3.0, 8 * 2**n, 2**n), 3 * np.pi, 0, lambda n: [8 * 2**n] * 2),
}


def ellipsoid_area(a: float, b: float, c: float) -> float:
    """The area of an ellipsoid with a >= b >= c by elliptic integrals (Legendre)."""
    phi = np.arccos(c / a)
    m = a**2 * (b**2 - c**2) / (b**2 * (a**2 - c**2))
    parts = ellipeinc(phi, m) * np.sin(phi) ** 2 + ellipkinc(phi, m) * np.cos(phi) ** 2
    return 2 * np.pi * (c**2 + a * b / np.sin(phi) * parts)


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_have_the_topology_of_the_surface(name):
    make, _, euler_number, loops = SHAPES[name]
    for n in (0, 1, 2):
        report = make(n).report
        assert report.euler_number == euler_number
        assert list(report.boundary_loops) == loops(n)
        assert report.components == 1
        assert (report.reoriented_faces, report.dropped_vertices, report.repairs) == (0, 0, ())


@pytest.mark.parametrize("name", SHAPES)
def test_areas_converge_at_second_order(name):
    make, area, _, _ = SHAPES[name]
    area = ellipsoid_area(3.0, 2.0, 1.0) if area is None else area
    errors = [abs(make(n).area / area - 1) for n in (1, 2, 3)]
    assert errors[-1] < 0.01
    if name != "square":
        assert np.log2(errors[1] / errors[2]) > 1.7


@pytest.mark.parametrize("name", SHAPES)
def test_normals_are_unit_vectors_and_agree_with_the_faces(name):
    mesh = SHAPES[name][0](2)
    assert mesh.normals is not None
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-14)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    faces = np.cross(b - a, c - a)
    faces /= np.linalg.norm(faces, axis=1, keepdims=True)
    assert np.sum(faces[:, None] * mesh.normals[mesh.faces], axis=2).min() > 0.8
    assert not mesh.normals.flags.writeable


def test_normals_are_the_gradients_of_the_implicit_equations():
    sphere = shapes.icosphere(2, radius=3.0)
    np.testing.assert_allclose(sphere.normals, sphere.vertices / 3, atol=1e-15)
    ellipsoid = shapes.ellipsoid((3.0, 2.0, 1.0), 2)
    np.testing.assert_allclose(np.sum((ellipsoid.vertices / [3, 2, 1]) ** 2, axis=1), 1, atol=1e-14)
    gradient = ellipsoid.vertices / [9, 4, 1]
    np.testing.assert_allclose(np.cross(gradient, ellipsoid.normals), 0, atol=1e-14)
    torus = shapes.torus(3.0, 0.5, 20, 10)
    centre = torus.vertices * [1, 1, 0]
    centre *= 3.0 / np.linalg.norm(centre, axis=1, keepdims=True)
    np.testing.assert_allclose(torus.vertices - centre, 0.5 * torus.normals, atol=1e-14)


@pytest.mark.parametrize(("subdivisions", "vertices"), [(0, 12), (2, 162), (3, 642), (4, 2562), (5, 10242)])
def test_the_icosphere_has_its_known_number_of_vertices(subdivisions, vertices):
    mesh = shapes.icosphere(subdivisions)
    assert mesh.num_vertices == vertices
    assert mesh.report.min_valence == 5


def test_the_vertices_of_the_torus_follow_the_documented_formula_and_order():
    mesh = shapes.torus()
    assert mesh.num_vertices == 96 * 48
    i, j = 17, 5
    y, x = 2 * np.pi * i / 96, 2 * np.pi * j / 48
    expected = [(2 + np.cos(x)) * np.cos(y), (2 + np.cos(x)) * np.sin(y), np.sin(x)]
    np.testing.assert_allclose(mesh.vertices[i * 48 + j], expected, atol=1e-15)
    assert (mesh.report.min_valence, mesh.report.max_valence) == (6, 6)


def test_boundaries_lie_exactly_on_the_boundary_of_the_surface():
    disk = shapes.disk(2.0, 7)
    np.testing.assert_allclose(np.linalg.norm(disk.vertices[disk.boundary_vertices], axis=1), 2, rtol=1e-15)
    assert disk.num_vertices == 1 + 3 * 7 * 8
    half = shapes.hemisphere(2.0, 7)
    np.testing.assert_array_equal(half.vertices[half.boundary_vertices][:, 2], 0)
    np.testing.assert_allclose(np.linalg.norm(half.vertices, axis=1), 2, rtol=1e-15)
    assert np.all(half.vertices[~half.boundary_vertices][:, 2] > 0)
    side = shapes.square(3.0, 4)
    assert side.vertices[:, :2].min() == 0
    assert side.vertices[:, :2].max() == 3
    tube = shapes.cylinder(0.5, 3.0, 8, 4)
    assert set(tube.vertices[tube.boundary_vertices][:, 2]) == {-1.5, 1.5}


def test_faces_are_well_shaped():
    for mesh, smallest in [
        (shapes.icosphere(4), 50),
        (shapes.disk(), 40),
        (shapes.hemisphere(), 33),
        (shapes.square(), 44.9),
    ]:
        assert mesh.report.min_angle > smallest


@pytest.mark.parametrize("make", [shapes.random_sphere, shapes.jittered_sphere, shapes.jittered_torus])
def test_irregular_meshes_lie_on_their_surface_with_exact_normals(make):
    mesh = make(seed=3)
    assert mesh.is_closed
    assert mesh.report.genus == (make is shapes.jittered_torus)
    assert mesh.report.reoriented_faces == 0
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-14)
    if make is shapes.jittered_torus:
        radius = np.hypot(np.linalg.norm(mesh.vertices[:, :2], axis=1) - 2, mesh.vertices[:, 2])
        np.testing.assert_allclose(radius, 1, atol=1e-14)
    else:
        np.testing.assert_array_equal(mesh.vertices, mesh.normals)
        assert mesh.num_vertices == 2562


@pytest.mark.parametrize(
    "make", [shapes.random_sphere, shapes.jittered_sphere, shapes.jittered_torus, lambda seed: disturbed(seed)]
)
def test_equal_seeds_give_equal_meshes(make):
    np.testing.assert_array_equal(make(seed=1).vertices, make(seed=1).vertices)
    assert np.any(make(seed=1).vertices != make(seed=2).vertices)


def disturbed(seed: int = 0) -> Mesh:
    return shapes.jittered(shapes.disk(rings=6), 0.2, seed)


def test_jitter_moves_inner_vertices_in_the_tangent_plane_only():
    disk, moved = shapes.disk(rings=6), disturbed()
    shift = moved.vertices - disk.vertices
    assert np.all(shift[disk.boundary_vertices] == 0)
    assert np.all(shift[:, 2] == 0)
    length = np.linalg.norm(shift[~disk.boundary_vertices], axis=1)
    assert 0 < length.min() < length.max() <= 0.2 * disk.mesh_size
    # For a uniform distribution in a disk, the mean squared radius is half the largest.
    many = shapes.jittered(shapes.disk(rings=40), 0.2, 1).vertices - shapes.disk(rings=40).vertices
    inner = ~shapes.disk(rings=40).boundary_vertices
    reach = 0.2 * shapes.disk(rings=40).mesh_size
    assert np.mean(np.sum(many[inner] ** 2, axis=1)) == pytest.approx(reach**2 / 2, rel=0.05)
    np.testing.assert_array_equal(moved.faces, disk.faces)


def test_jitter_projects_vertices_back_onto_the_surface():
    half = shapes.hemisphere(rings=6)
    without_normals = Mesh(half.vertices, half.faces)  # jittered then uses the face normals
    for mesh in (half, without_normals):
        moved = shapes.jittered(mesh, 0.2, 0, lambda x: x / np.linalg.norm(x, axis=1, keepdims=True))
        np.testing.assert_allclose(np.linalg.norm(moved.vertices, axis=1), 1, atol=1e-14)


def test_jitter_by_zero_changes_nothing():
    np.testing.assert_allclose(
        np.sort(shapes.jittered_sphere(2, 0.0).vertices, axis=0),
        np.sort(shapes.icosphere(2).vertices, axis=0),
        atol=1e-15,
    )
    np.testing.assert_allclose(
        shapes.jittered_torus(12, 8, 0.0).vertices, shapes.torus(n_major=12, n_minor=8).vertices, atol=1e-15
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: shapes.icosphere(-1), "subdivisions must be from 0 to 10, found -1"),
        (lambda: shapes.icosphere(11), "subdivisions must be from 0 to 10, found 11"),
        (lambda: shapes.icosphere(1, radius=0.0), "radius must be positive and finite, found 0.0"),
        (lambda: shapes.icosphere(1, radius=float("nan")), "radius must be positive and finite, found nan"),
        (lambda: shapes.ellipsoid((1.0, 2.0, -1.0)), "each of the axes must be positive"),
        (lambda: shapes.torus(1.0, 1.0), "minor must be smaller than major"),
        (lambda: shapes.torus(n_major=2), "n_major must be at least 3, found 2"),
        (lambda: shapes.disk(rings=0), "rings must be at least 1"),
        (lambda: shapes.disk(radius=float("inf")), "radius must be positive and finite"),
        (lambda: shapes.hemisphere(rings=0), "rings must be at least 1"),
        (lambda: shapes.square(n=1), "n must be at least 2"),
        (lambda: shapes.square(side=-1), "side must be positive"),
        (lambda: shapes.cylinder(n_around=2), "n_around must be at least 3"),
        (lambda: shapes.cylinder(height=0), "height must be positive"),
        (lambda: shapes.random_sphere(5), "num_vertices must be at least 6"),
        (lambda: shapes.jittered_sphere(amount=-0.1), "amount must be finite and not negative"),
        (lambda: shapes.jittered_torus(amount=0.5), "amount must be below 0.5"),
        (lambda: shapes.jittered(shapes.disk(), amount=float("nan")), "amount must be finite"),
    ],
)
def test_errors_name_the_invalid_argument(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert not isinstance(caught.value, MeshError)


@pytest.mark.parametrize("sides", [(1.0, 1.0, 1.0), (1.0, 2.0, 0.5)])
def test_a_box_has_the_given_sides(sides):
    mesh = shapes.box(sides, n=8)
    a, b, c = sides
    assert mesh.is_closed
    assert mesh.report.euler_number == 2
    assert mesh.report.reoriented_faces == 0
    assert mesh.area == pytest.approx(2 * (a * b + b * c + c * a))
    np.testing.assert_allclose([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)], [[0, 0, 0], sides])
    x, y, z = np.moveaxis(mesh.vertices[mesh.faces], 2, 0)
    volume = np.linalg.det(np.stack([x, y, z], axis=-1)).sum() / 6
    assert volume == pytest.approx(a * b * c)
