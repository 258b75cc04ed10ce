"""On every mesh that is accepted, operators are finite and no Laplacian weight is negative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mesh_files import WRITERS, damaged

import ltljax as ltl
from ltljax._lifting import paper
from ltljax._lifting.ring import RingTopology

SCHEMES = [ltl.Paper(), ltl.Monotone(), ltl.Monotone(lift="projection"), ltl.Polynomial(3), ltl.Polynomial(4)]
# These meshes are meant to have rows without consistent non-negative weights.
pytestmark = pytest.mark.filterwarnings("ignore::ltljax.errors.InconsistentRowsWarning")


def assert_sound(mesh, dtype=jnp.float64):
    for scheme in SCHEMES:
        surface = ltl.Surface.from_mesh(mesh, scheme, dtype)
        assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(surface.geometry))
        if isinstance(scheme, ltl.Monotone):
            assert all((np.asarray(w) >= 0).all() for w in surface.geometry.laplacian_weights)
        np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1, rtol=1e-5)


def test_damaged_files_that_are_accepted_give_finite_operators(tmp_path):
    random = np.random.default_rng(11)
    shapes = [ltl.shapes.jittered_sphere(1, 0.3, seed=0), ltl.shapes.disk(rings=3)]
    good = [(ending, write(s.vertices, s.faces)) for s in shapes for ending, write in WRITERS.values()]
    num_accepted = 0
    for index in range(60):
        ending, data = good[index % len(good)]
        path = tmp_path / f"damaged{index}.{ending}"
        path.write_bytes(damaged(data, random))
        try:
            mesh = ltl.load_mesh(path, repair=index % 3 == 0)
        except ltl.MeshError:
            continue
        num_accepted += 1
        assert_sound(mesh)
    assert num_accepted > 5


@pytest.mark.parametrize("seed", range(8))
def test_crumpled_spheres_give_finite_operators(seed):
    random = np.random.default_rng(seed)
    sphere = ltl.shapes.icosphere(2)
    scale = 10.0 ** random.uniform(-2, 1)
    vertices = sphere.vertices + scale * random.normal(size=sphere.vertices.shape)
    try:
        mesh = ltl.Mesh(vertices, sphere.faces)
    except ltl.MeshError:
        return
    assert_sound(mesh)


@pytest.mark.parametrize(
    ("lift", "height", "inconsistent"), [("chord", 0.0, False), ("chord", -0.99, True), ("intrinsic", -0.99, False)]
)
@pytest.mark.filterwarnings("ignore::ltljax.errors.InconsistentRowsWarning")
def test_a_pit_is_counted_and_stays_stable(lift, height, inconsistent):
    sphere = ltl.shapes.icosphere(2)
    vertices = sphere.vertices.copy()
    vertices[0] *= 1 + height
    surface = ltl.Surface.from_mesh(ltl.Mesh(vertices, sphere.faces), ltl.Monotone(lift=lift))
    assert (len(surface.report.inconsistent) > 0) == inconsistent
    assert ("worst moment residual" in str(surface.report)) == inconsistent
    eigenvalues = np.linalg.eigvals(ltl.laplacian_matrix(surface).todense())
    assert eigenvalues.real.max() < 1e-10 * np.abs(eigenvalues).max()


@pytest.mark.parametrize("factor", [1e-8, 1e8])
def test_the_laplacian_scales_with_the_mesh(factor):
    mesh = ltl.shapes.jittered_sphere(2, 0.3, seed=1)
    small = ltl.Surface.from_mesh(mesh.scaled(factor))
    u = mesh.vertices[:, 0]
    expected = ltl.laplacian(ltl.Surface.from_mesh(mesh), u)
    np.testing.assert_allclose(ltl.laplacian(small, u) * factor**2, expected, rtol=1e-8, atol=1e-10)


def test_a_mesh_too_small_for_float32_is_refused_with_advice():
    mesh = ltl.shapes.icosphere(1).scaled(1e-25)
    assert_sound(mesh)
    with pytest.raises(ValueError, match=r"leave the range of float32\. Rescale"):
        ltl.Surface.from_mesh(mesh, dtype=jnp.float32)


@pytest.mark.parametrize(
    "name", ["hand_open.obj", "spot_low.obj", pytest.param("stanford_bunny.obj", marks=pytest.mark.slow)]
)
def test_real_meshes_are_sound(name, real_mesh):
    assert_sound(ltl.load_mesh(real_mesh(name)))


def test_faces_that_the_lift_makes_degenerate_are_dropped_and_counted():
    topology = RingTopology(valences=np.array([4]), is_boundary=np.array([False]))
    # A face becomes a line in the first ring. In the second, opposite corners put the centroid of a face at the vertex.
    for ring, count in (([(1, 0), (2, 0), (0, 1), (-1, -1)], 1), ([(1, 0), (-1, 0), (-1, -1), (0, -1)], 1)):
        lifted = np.array(ring, float)[:, None]
        assert paper.dropped_faces(lifted, topology) == count
        weights = paper.gradient_weights(lifted, topology)
        linear = lifted @ np.array([2.0, -3.0])
        np.testing.assert_allclose(np.einsum("kna,kn->na", weights, linear), [[2, -3]], atol=1e-14)
    report = ltl.Surface.from_mesh(ltl.shapes.icosphere(1), ltl.Paper()).report
    first, *rest = str(report).splitlines()
    assert first.split() == ["degenerate", "lifted", "faces", "0"]
    assert list(report.seconds) == ["rings", "reversed tables", "weights"]
    assert [line.startswith("seconds for ") for line in rest] == [True] * 3
