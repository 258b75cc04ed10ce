"""`ltl.Monotone()` is consistent, non-negative and stable, and as accurate as measured before."""

import jax
import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
from scipy.sparse.linalg import expm_multiply
from scipy.special import j0

import ltljax as ltl
from ltljax._operators import spectral_bound

# Real meshes have a few inconsistent rows.
pytestmark = pytest.mark.filterwarnings("ignore::ltljax.errors.InconsistentRowsWarning")

SPHERES = {
    "icosphere": lambda: ltl.shapes.icosphere(4),
    "jittered": lambda: ltl.shapes.jittered_sphere(4, 0.5, seed=0),
    "random": lambda: ltl.shapes.random_sphere(2562, seed=0),
}
FAMILIES = {
    **SPHERES,
    "jittered torus": lambda: ltl.shapes.jittered_torus(96, 48, 0.45, seed=0),
    "disk": lambda: ltl.shapes.jittered(ltl.shapes.disk(rings=16), 0.3, seed=0),
    "hemisphere": lambda: ltl.shapes.hemisphere(rings=12),
    "cylinder": lambda: ltl.shapes.cylinder(),
}
# Measured errors on the unit sphere with 2562 vertices: the relative L2 error of heat flow to t = 0.1, and the errors
# (in percent) of the eigenvalues for l = 1, 3 and 5, each a mean over its multiplet.
HEAT = {
    ("icosphere", "projection"): 5.1e-4,
    ("jittered", "projection"): 6.5e-4,
    ("random", "projection"): 1.3e-3,
    ("icosphere", "chord"): 1.2e-3,
    ("jittered", "chord"): 1.5e-3,
    ("random", "chord"): 2.3e-3,
    ("icosphere", "intrinsic"): 1.2e-3,
    ("jittered", "intrinsic"): 1.4e-3,
    ("random", "intrinsic"): 2.2e-3,
}
EIGENVALUES = {
    ("icosphere", "projection"): (0.14, 0.21, 0.85),
    ("random", "projection"): (0.28, 0.38, 1.6),
    ("icosphere", "chord"): (0.0, 0.36, 0.99),
    ("random", "chord"): (0.01, 0.66, 1.9),
}


def relative_error(approximation, exact):
    return float(np.linalg.norm(np.asarray(approximation) - exact) / np.linalg.norm(exact))


def harmonics(vertices):
    """Spherical harmonics of degree 2 and 3."""
    x, y, z = vertices.T
    return (x**2 - y**2) / 2, x * y * z


@pytest.mark.parametrize("lift", ["intrinsic", "chord", "projection"])
@pytest.mark.parametrize("family", FAMILIES)
def test_no_weight_is_negative_and_every_row_is_consistent(family, lift):
    surface = ltl.Surface.from_mesh(FAMILIES[family](), ltl.Monotone(lift=lift))
    assert min(float(w.min()) for w in surface.geometry.laplacian_weights) >= 0
    assert len(surface.report.inconsistent) == 0
    assert float(surface.geometry.laplacian_residual.max()) < 1e-10


@pytest.mark.parametrize(("sphere", "lift"), HEAT)
def test_heat_on_spheres_is_as_accurate_as_measured_before(sphere, lift):
    mesh = SPHERES[sphere]()
    surface = ltl.Surface.from_mesh(mesh, ltl.Monotone(lift=lift))
    e2, e3 = harmonics(mesh.vertices)
    u = expm_multiply(0.1 * ltl.laplacian_matrix(surface), e2 + e3)
    error = relative_error(u, e2 * np.exp(-0.6) + e3 * np.exp(-1.2))
    assert error == pytest.approx(HEAT[sphere, lift], rel=0.2)


@pytest.mark.parametrize(("sphere", "lift"), EIGENVALUES)
def test_eigenvalues_of_spheres_are_as_accurate_as_measured_before(sphere, lift):
    surface = ltl.Surface.from_mesh(SPHERES[sphere](), ltl.Monotone(lift=lift))
    matrix = -ltl.laplacian_matrix(surface).tocsc()
    eigenvalues = scipy.sparse.linalg.eigs(matrix, k=40, sigma=-0.5, return_eigenvectors=False)
    assert (np.abs(eigenvalues.imag) < 0.01 * np.abs(eigenvalues) + 1e-8).all()
    values = np.sort(eigenvalues.real)
    assert abs(values[0]) < 1e-8
    for degree, expected in zip((1, 3, 5), EIGENVALUES[sphere, lift], strict=True):
        error = 100 * abs(values[degree**2 : (degree + 1) ** 2].mean() / (degree * (degree + 1)) - 1)
        assert error == pytest.approx(expected, rel=0.2, abs=0.01)


@pytest.mark.parametrize(
    ("sphere", "lift", "bound"),
    [
        ("jittered", "chord", 2.6e-2),
        ("random", "chord", 3.5e-2),
        ("jittered", "intrinsic", 2.8e-2),
        ("random", "intrinsic", 3.9e-2),
    ],
)
def test_the_pointwise_laplacian_is_close_on_irregular_spheres(sphere, lift, bound):
    mesh = SPHERES[sphere]()
    e2, e3 = harmonics(mesh.vertices)
    surface = ltl.Surface.from_mesh(mesh, ltl.Monotone(lift=lift))
    assert relative_error(ltl.laplacian(surface, e2 + e3), -6 * e2 - 12 * e3) < bound


@pytest.mark.parametrize("lift", ["intrinsic", "chord", "projection"])
def test_normals_and_gradient_are_second_order_and_the_laplacian_first_order_on_jittered_spheres(lift):
    errors = {"normals": [], "gradient": [], "laplacian": []}
    for level in (3, 4, 5):
        mesh = ltl.shapes.jittered_sphere(level, 0.3, seed=0)
        surface = ltl.Surface.from_mesh(mesh, ltl.Monotone(lift=lift))
        x, y, z = mesh.vertices.T
        e2, e3 = harmonics(mesh.vertices)
        gradient = np.stack([y * z + x, x * z - y, x * y], axis=1)
        gradient -= np.sum(gradient * mesh.vertices, axis=1, keepdims=True) * mesh.vertices
        errors["normals"].append(relative_error(surface.normals, mesh.vertices))
        errors["gradient"].append(relative_error(ltl.gradient(surface, e2 + e3), gradient))
        errors["laplacian"].append(relative_error(ltl.laplacian(surface, e2 + e3), -6 * e2 - 12 * e3))
    order = {name: np.log2(e[0] / e[2]) / 2 for name, e in errors.items()}
    assert order["normals"] > 1.8
    assert order["gradient"] > 1.8
    assert order["laplacian"] > 0.9
    assert errors["normals"][-1] < 1e-4
    assert errors["gradient"][-1] < 2e-3
    assert errors["laplacian"][-1] < 1.5e-2


def test_heat_in_an_insulated_disk_is_second_order():
    # u = J_0(j r) exp(-j^2 t), with j the first positive zero of J_0': its normal derivative vanishes at r = 1.
    zero, errors = 3.8317059702075125, []
    for rings in (10, 20, 40):
        mesh = ltl.shapes.jittered(ltl.shapes.disk(rings=rings), 0.2, seed=0)
        surface = ltl.Surface.from_mesh(mesh)
        start = j0(zero * np.hypot(*mesh.vertices[:, :2].T))
        u = expm_multiply(0.1 * ltl.laplacian_matrix(surface), start)
        errors.append(relative_error(u, start * np.exp(-(zero**2) * 0.1)))
        if rings == 10:
            solution = ltl.solve(ltl.Diffusion(), surface, start, 0.1, rtol=1e-8, atol=1e-10)
            assert relative_error(solution.us[-1], u) < 1e-5
    assert np.log2(errors[0] / errors[2]) / 2 > 1.8
    assert errors[-1] < 2e-3


@pytest.mark.parametrize("scheme", [ltl.Monotone(), ltl.Monotone(lift="projection")])
def test_quadratics_in_the_plane_are_differentiated_exactly(scheme):
    mesh = ltl.shapes.jittered(ltl.shapes.square(n=12), 0.3, seed=0)
    surface = ltl.Surface.from_mesh(mesh, scheme)
    x, y, _ = mesh.vertices.T
    u = 2 * x**2 - 3 * x * y + 0.5 * y**2 + x - y
    is_interior = ~mesh.boundary_vertices
    np.testing.assert_allclose(np.asarray(ltl.laplacian(surface, u))[is_interior], 5, atol=1e-9)
    gradient = np.stack([4 * x - 3 * y + 1, -3 * x + y - 1, 0 * x], axis=1)
    np.testing.assert_allclose(ltl.gradient(surface, u), gradient, atol=1e-10)


def torus_spectrum():
    """The published eigenvalues of -Delta on the torus with radii 2 and 1, repeated by multiplicity."""
    simple = {0.9767313135: 1, 1.1222882712: 1}
    double = [0.2493680569, 0.7945678016, 1.2637169467, 1.5451508277, 1.6630145377, 2.0406181488]
    return np.sort(np.repeat([*simple, *double], [*simple.values(), *[2] * len(double)]))


@pytest.mark.parametrize("lift", ["intrinsic", "chord", "projection"])
@pytest.mark.parametrize("amount", [0.0, 0.3])
def test_eigenvalues_of_the_torus_have_the_right_values_and_multiplicities(amount, lift):
    surface = ltl.Surface.from_mesh(ltl.shapes.jittered_torus(96, 48, amount, seed=0), ltl.Monotone(lift=lift))
    exact = torus_spectrum()
    matrix = -ltl.laplacian_matrix(surface).tocsc()
    eigenvalues = scipy.sparse.linalg.eigs(matrix, k=24, sigma=-0.05, return_eigenvectors=False)
    values = np.sort(eigenvalues.real)[: len(exact) + 1]
    assert abs(values[0]) < 1e-8
    np.testing.assert_allclose(values[1:], exact, rtol=5e-3)


@pytest.mark.parametrize("sphere", SPHERES)
def test_eigenvalues_of_spheres_have_the_right_multiplicities(sphere):
    surface = ltl.Surface.from_mesh(SPHERES[sphere]())
    matrix = -ltl.laplacian_matrix(surface).tocsc()
    values = np.sort(scipy.sparse.linalg.eigs(matrix, k=25, sigma=-0.5, return_eigenvectors=False).real)
    exact = np.repeat([degree * (degree + 1.0) for degree in range(4)], [1, 3, 5, 7])
    np.testing.assert_allclose(values[:16], exact, rtol=1e-2, atol=1e-8)
    assert values[16] > 18


def mesh_named(name, real_mesh):
    if name.endswith("obj"):
        return ltl.load_mesh(real_mesh(name))
    small = {
        "icosphere": lambda: ltl.shapes.icosphere(3),
        "jittered": lambda: ltl.shapes.jittered_sphere(3, 0.5, seed=1),
        "random": lambda: ltl.shapes.random_sphere(642, seed=1),
        "torus": lambda: ltl.shapes.torus(n_major=32, n_minor=16),
        "jittered torus": lambda: ltl.shapes.jittered_torus(32, 16, 0.45, seed=0),
        "ellipsoid": lambda: ltl.shapes.ellipsoid((1.0, 2.0, 0.5), subdivisions=3),
        "disk": lambda: ltl.shapes.jittered(ltl.shapes.disk(rings=12), 0.3, seed=0),
        "hemisphere": lambda: ltl.shapes.hemisphere(rings=12),
        "square": lambda: ltl.shapes.jittered(ltl.shapes.square(n=20), 0.3, seed=0),
        "cylinder": lambda: ltl.shapes.cylinder(n_around=32, n_along=12),
    }
    return (small | FAMILIES_OF_3000)[name]()


FAMILIES_OF_3000 = {f"{name} of 3000": make for name, make in FAMILIES.items()}
SMALL = ["icosphere", "jittered", "random", "torus", "jittered torus", "ellipsoid"]
SMALL += ["disk", "hemisphere", "square", "cylinder", "spot_low.obj", "hand_open.obj"]


@pytest.mark.parametrize(
    "name",
    [
        *SMALL,
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in (*FAMILIES_OF_3000, "bunny_closed.obj")
            if name != "jittered torus of 3000"
        ),
    ],
)
def test_no_mode_grows(name, real_mesh):
    surface = ltl.Surface.from_mesh(mesh_named(name, real_mesh))
    eigenvalues = np.linalg.eigvals(ltl.laplacian_matrix(surface).todense())
    assert eigenvalues.real.max() < 1e-10 * np.abs(eigenvalues).max()


@pytest.mark.parametrize("name", ["spot.obj", "armadillo.obj", "stanford_bunny.obj", "jittered torus of 3000"])
def test_no_mode_grows_on_large_meshes(name, real_mesh):
    surface = ltl.Surface.from_mesh(mesh_named(name, real_mesh))
    assert ltl.operators.growth_rate(surface) < 1e-10 * float(spectral_bound(surface))


@pytest.mark.parametrize("name", ["random", "spot_low.obj", "jittered torus", "hand_open.obj"])
def test_implicit_diffusion_keeps_the_maximum_principle(name, real_mesh):
    surface = ltl.Surface.from_mesh(mesh_named(name, real_mesh))
    matrix = ltl.laplacian_matrix(surface).tocsc()
    random = np.random.default_rng(0)
    identity = scipy.sparse.eye_array(surface.num_vertices, format="csc")
    for exponent in random.uniform(-4, 3, 20):
        step = scipy.sparse.linalg.splu(identity - 10.0**exponent * surface.vertex_areas.mean().item() * matrix)
        u = random.uniform(-1, 1, (surface.num_vertices, 50))
        after = step.solve(u)
        assert (after.max(axis=0) <= u.max(axis=0) + 1e-12).all()
        assert (after.min(axis=0) >= u.min(axis=0) - 1e-12).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["stanford_bunny.obj", "armadillo.obj"])
def test_eigenvalues_of_scans_are_close_to_finite_elements(name, real_mesh):
    import robust_laplacian

    mesh = ltl.load_mesh(real_mesh(name))
    surface = ltl.Surface.from_mesh(mesh)
    assert len(surface.report.inconsistent) < mesh.num_vertices / 1000
    shift = -0.1 / mesh.area
    ours = scipy.sparse.linalg.eigs(
        -ltl.laplacian_matrix(surface).tocsc(), k=20, sigma=shift, return_eigenvectors=False
    )
    stiffness, mass = robust_laplacian.mesh_laplacian(mesh.vertices, mesh.faces)
    theirs = scipy.sparse.linalg.eigsh(stiffness, k=20, M=mass, sigma=shift, return_eigenvectors=False)
    ours, theirs = np.sort(ours.real)[1:13], np.sort(theirs)[1:13]
    np.testing.assert_allclose(ours, theirs, rtol=0.08)


@pytest.mark.parametrize(("name", "at_most"), [("armadillo.obj", 3), ("stanford_bunny.obj", 8), ("spot.obj", 2)])
def test_inconsistent_rows_of_real_meshes_are_rare_and_counted(name, at_most, real_mesh):
    report = ltl.Surface.from_mesh(ltl.load_mesh(real_mesh(name))).report
    assert len(report.inconsistent) <= at_most
    assert f"{len(report.inconsistent)}" in str(report).split("inconsistent Laplacian rows")[1].split("\n")[0]


def test_a_closed_surface_has_the_mesh_size_of_its_mesh_and_differentiates_it():
    mesh = ltl.shapes.jittered_sphere(2, 0.4)
    surface = ltl.Surface.from_mesh(mesh)
    np.testing.assert_allclose(surface.mesh_size, mesh.mesh_size, rtol=1e-12)
    # The mesh size is concrete unless the vertices are traced.
    assert jax.jit(lambda x: float(surface.mesh_size) * x)(1.0) == surface.mesh_size
    x = surface.vertices
    slope = jax.jit(jax.grad(lambda s: surface.with_vertices(s * x).mesh_size))(1.0)
    np.testing.assert_allclose(slope, surface.mesh_size, rtol=1e-12)
