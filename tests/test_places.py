"""Results do not depend on where the mesh lies, even in float32."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import Phase, given, settings, strategies as st

import ltljax as ltl

pytestmark = pytest.mark.filterwarnings("ignore::ltljax.errors.FarFromOriginWarning")

MAP = np.array([4e5, 5e6, 300.0])
SHIFTS = st.tuples(*[st.floats(-7, 7).map(lambda power: np.sign(power) * 10 ** abs(power))] * 3).map(np.array)

SPHERE = ltl.shapes.icosphere(3)
# On a symmetric mesh, rounding would decide between equivalent neighbours.
JITTERED = ltl.shapes.jittered(ltl.shapes.icosphere(2), 0.2, seed=0)


def surface_at(shift, size=1.0, scheme=None, mesh=SPHERE):
    return ltl.Surface.from_mesh(ltl.Mesh(mesh.vertices * size + shift, mesh.faces), scheme, dtype=jnp.float32)


@pytest.mark.parametrize("radius", [1.0, 50.0])
def test_float32_at_map_coordinates_is_as_accurate_as_at_the_origin(radius):
    at_origin, shifted = surface_at(np.zeros(3), radius), surface_at(MAP, radius)
    np.testing.assert_allclose(shifted.centre, MAP, rtol=1e-12)
    angles = jnp.asarray(np.arccos(np.clip(SPHERE.vertices @ SPHERE.vertices[0], -1, 1)), jnp.float32)
    errors = []
    for surface in (at_origin, shifted):
        curvature = np.abs(ltl.curvature(surface).mean * radius - 1)
        laplacian = jnp.abs(ltl.laplacian(surface, surface.vertices) * radius + 2 * surface.normals)
        distance = jnp.abs(ltl.geodesic_distance(surface, 0) / radius - angles)
        errors.append([float(np.max(x)) for x in (curvature, laplacian, distance)])
    np.testing.assert_allclose(errors[1], errors[0], rtol=0.05, atol=1e-3)
    assert max(errors[1]) < 0.08


@pytest.mark.parametrize(
    "scheme", [ltl.Monotone(), ltl.Monotone(lift="chord"), ltl.Polynomial(), ltl.Paper()], ids=repr
)
@settings(max_examples=2, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(shift=SHIFTS)
def test_a_shift_of_the_mesh_does_not_change_results(scheme, shift):
    at_origin, shifted = (surface_at(position, scheme=scheme, mesh=JITTERED) for position in (0, shift))
    u = jnp.asarray(np.sin(3 * np.asarray(at_origin.vertices[:, 0])))
    curvature = [] if isinstance(scheme, ltl.Paper) else [lambda s: ltl.curvature(s).mean]
    for function in (
        *curvature,
        lambda s: ltl.laplacian(s, u),
        lambda s: ltl.gradient(s, u),
        lambda s: ltl.geodesic_distance(s, 0),
        lambda s: ltl.laplacian(s, s.vertices),
        lambda s: ltl.integrate(s, u**2),
        lambda s: s.mesh_size,
    ):
        expected, value = np.asarray(function(at_origin)), np.asarray(function(shifted))
        # Positions closer to the origin than twice the size are not centred, and lose a few digits.
        assert np.max(np.abs(value - expected)) <= 5e-3 * np.max(np.abs(expected))


def test_positions_of_a_far_mesh_are_relative_to_its_centre():
    with pytest.warns(ltl.errors.FarFromOriginWarning, match=r"surface\.centre, \(400000, 5e\+06, 300\)"):
        surface = surface_at(MAP)
    np.testing.assert_allclose(surface.vertices, SPHERE.vertices, atol=1e-6)
    # Positions passed to and returned by the surface are relative to the centre. The mesh of a relief is not.
    moved = surface.with_vertices(2 * surface.vertices)
    np.testing.assert_allclose(moved.vertex_areas, 4 * surface.vertex_areas, rtol=1e-4)
    relief = ltl.imaging.displaced(surface, surface.vertices[:, 0], 0.1)
    np.testing.assert_allclose(relief.vertices.mean(axis=0), MAP, atol=0.1)
    flow = ltl.imaging.mean_curvature_flow(surface, 0.1)
    np.testing.assert_allclose(jnp.linalg.norm(flow, axis=1), np.sqrt(1 - 0.4), atol=0.02)


def test_positions_that_are_not_relative_to_the_centre_are_rejected():
    surface = surface_at(MAP)
    with pytest.raises(ValueError, match=r"relative to surface\.centre"):
        surface.with_vertices(SPHERE.vertices + MAP)


def test_a_mesh_near_the_origin_keeps_its_positions():
    surface = surface_at(np.array([5.0, 0, 0]))
    assert not surface.centre.any()
    np.testing.assert_allclose(surface.vertices, SPHERE.vertices + np.array([5.0, 0, 0]), atol=1e-5)


@pytest.mark.parametrize("kind", ["obj", "ply", "glb"])
def test_files_of_a_far_mesh_preserve_its_shape(tmp_path, kind):
    from ltljax._output import files

    path, far, grey = tmp_path / f"far.{kind}", SPHERE.vertices + MAP, np.full((SPHERE.num_vertices, 4), 200, np.uint8)
    if kind == "obj":
        files.write_obj(path, far, SPHERE.faces)
    elif kind == "ply":
        files.write_ply(path, far, SPHERE.faces, grey)
    else:
        files.write_glb(path, far, SPHERE.faces, grey)
    np.testing.assert_allclose(ltl.load_mesh(path).vertices - MAP, SPHERE.vertices, atol=1e-5)


def test_smoothing_a_mesh_at_map_coordinates_does_not_move_it(tmp_path, capsys):
    from ltljax._output import files
    from ltljax.app.cli import main

    path, out = tmp_path / "far.ply", tmp_path / "out"
    files.write_ply(path, SPHERE.vertices + MAP, SPHERE.faces, np.full((SPHERE.num_vertices, 3), 200, np.uint8))
    assert main(["smooth", str(path), "--method", "fair", "--out", str(out)]) == 0
    assert "surface.centre" not in capsys.readouterr().out
    radii = np.linalg.norm(ltl.load_mesh(out / "smooth.ply").vertices - MAP, axis=1)
    assert 0.9 < radii.min() <= radii.max() < 1
    assert np.ptp(radii) < 1e-3
