"""The intrinsic lift: bending a surface changes no operator, so creases and boxes are as accurate as a plane."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robust_laplacian
import scipy.sparse
import scipy.sparse.linalg
from sharp_shapes import blade, cone, graded_disk, saddle, slit, strip, union

import ltljax as ltl
from ltljax._lifting import support
from ltljax._lifting.weighing import weigh


def largest_difference(actual, expected):
    return abs(actual - expected).max() / abs(expected).max()


def norms(tensors):
    """The Frobenius norm of the tensor at each vertex."""
    return np.sqrt(np.sum(np.asarray(tensors) ** 2, axis=tuple(range(1, tensors.ndim))))


@pytest.fixture(scope="module")
def flat_strip():
    mesh, x = strip(16, 0)
    return ltl.Surface.from_mesh(mesh), x


@pytest.mark.parametrize("degrees", [20, 90, 170])
def test_bending_changes_no_operator(degrees, flat_strip):
    flat, x = flat_strip
    bent = ltl.Surface.from_mesh(strip(16, degrees)[0])
    assert largest_difference(ltl.laplacian_matrix(bent), ltl.laplacian_matrix(flat)) < 1e-9
    u = np.cos(np.pi * x / 2)
    np.testing.assert_allclose(norms(ltl.gradient(bent, u)), norms(ltl.gradient(flat, u)), atol=1e-9)
    np.testing.assert_allclose(norms(ltl.hessian(bent, u)), norms(ltl.hessian(flat, u)), atol=1e-7)
    on_bent, on_flat = (np.asarray(ltl.divergence(surface, ltl.gradient(surface, u))) for surface in (bent, flat))
    # At smaller angles than a crease, vectors are transported in space as on smooth surfaces.
    if degrees > 40:
        np.testing.assert_allclose(on_bent, on_flat, atol=1e-7)
    exact = -((np.pi / 2) ** 2) * u
    assert np.linalg.norm(on_bent - exact) < 1.25 * np.linalg.norm(on_flat - exact)
    with_flux = [ltl.laplacian(surface, jnp.asarray(u), flux=jnp.asarray(x)) for surface in (bent, flat)]
    np.testing.assert_allclose(*with_flux, atol=1e-7)
    stencils = [ltl.operators.elliptic_stencil(surface, 1 + x).matrix() for surface in (bent, flat)]
    assert largest_difference(*stencils) < 1e-9


def test_heat_and_poisson_on_a_fold_are_as_accurate_as_cotangents_on_a_plane():
    mesh, x = strip(48, 90)
    u, rate = np.cos(np.pi * x / 2), (np.pi / 2) ** 2
    stiffness, mass = robust_laplacian.mesh_laplacian(mesh.vertices, mesh.faces)
    theirs = scipy.sparse.csc_matrix(-scipy.sparse.diags_array(1 / mass.diagonal()) @ stiffness)
    ours = ltl.laplacian_matrix(ltl.Surface.from_mesh(mesh)).tocsc()
    heat, poisson = zip(*[(heat_error(L, u, rate), poisson_error(L, u, rate)) for L in (ours, theirs)], strict=True)
    assert heat[0] < 1.1 * heat[1]
    assert poisson[0] < 1.1 * poisson[1]


def heat_error(matrix, u, rate, time=0.1, steps=16):
    """The relative error of heat flow from u, with fourth-order Pade steps."""
    identity, dt, start = scipy.sparse.eye_array(len(u), format="csc"), time / steps, u
    factor = scipy.sparse.linalg.splu(
        scipy.sparse.csc_matrix(identity - dt / 2 * matrix + dt**2 / 12 * matrix @ matrix)
    )
    for _ in range(steps):
        u = factor.solve(u + dt / 2 * (matrix @ u) + dt**2 / 12 * (matrix @ (matrix @ u)))
    return np.linalg.norm(u - start * np.exp(-rate * time)) / np.linalg.norm(start)


def poisson_error(matrix, u, rate):
    """The relative error of the solution of Delta v - v = -(1 + rate) u."""
    operator = scipy.sparse.csc_matrix(matrix - scipy.sparse.eye_array(len(u)))
    return np.linalg.norm(scipy.sparse.linalg.spsolve(operator, -(1 + rate) * u) - u) / np.linalg.norm(u)


def test_eigenvalues_of_the_cube_are_accurate():
    modes = ltl.eigenmodes(ltl.Surface.from_mesh(ltl.shapes.box(n=40)), 7)
    np.testing.assert_allclose(modes.values[1:], np.repeat([4.16609, 11.49918], 3), rtol=7e-4)


@pytest.mark.parametrize(("degrees", "power_bound"), [(30, 1.2), (15, 2.5)])
def test_poisson_on_cones_is_about_as_accurate_as_with_cotangents(degrees, power_bound):
    half_angle = np.radians(degrees)
    mesh, r, t = cone(half_angle, 24)
    nu = 1 / np.sin(half_angle)
    surface = ltl.Surface.from_mesh(mesh)
    stiffness, mass = robust_laplacian.mesh_laplacian(mesh.vertices, mesh.faces)
    matrices = ltl.laplacian_matrix(surface), -scipy.sparse.diags_array(1 / mass.diagonal()) @ stiffness
    is_rim = np.isclose(r, 1)
    solutions = (1 - r**2, np.full(len(r), -4.0), 1.2), (r**nu * np.cos(t), np.zeros(len(r)), power_bound)
    for u, laplacian, bound in solutions:
        ours, theirs = (dirichlet_error(scipy.sparse.csr_array(matrix), u, laplacian, is_rim) for matrix in matrices)
        assert ours < bound * theirs


def dirichlet_error(matrix, u, laplacian, is_boundary):
    """The relative error of the solution of Poisson's equation with the values of u on the boundary."""
    is_free = ~is_boundary
    interior = scipy.sparse.csc_matrix(matrix[is_free][:, is_free])
    right_hand_side = laplacian[is_free] - matrix[is_free][:, is_boundary] @ u[is_boundary]
    solution = scipy.sparse.linalg.spsolve(interior, right_hand_side)
    return np.linalg.norm(solution - u[is_free]) / np.linalg.norm(u)


def test_normals_beside_a_crease_are_the_normals_of_its_sides():
    mesh, x = strip(12, 90)
    normals = np.asarray(ltl.Surface.from_mesh(mesh).normals)
    on_crease = np.isclose(x, 1)
    expected = np.where(
        on_crease[:, None], [-np.sqrt(0.5), 0, np.sqrt(0.5)], np.where(x[:, None] < 1, [0, 0, 1], [-1, 0, 0])
    )
    np.testing.assert_allclose(normals, expected, atol=1e-12)


@pytest.mark.parametrize("scheme", [ltl.Monotone(), ltl.Polynomial(4)])
def test_the_laplacian_of_a_vector_field_parallel_across_a_crease_is_zero(scheme):
    mesh, x = strip(12, 90)
    surface = ltl.Surface.from_mesh(mesh, scheme)
    X = np.where(x[:, None] < 1, [1.0, 0, 0], [0.0, 0, 1])
    X[np.isclose(x, 1)] = [np.sqrt(0.5), 0, np.sqrt(0.5)]
    np.testing.assert_allclose(ltl.vector_laplacian(surface, jnp.asarray(X)), 0, atol=1e-8)
    np.testing.assert_allclose(ltl.vectors.covariant_derivative(surface, jnp.asarray(X)), 0, atol=1e-9)


@pytest.mark.parametrize("degree", [3, 4])
def test_polynomials_at_a_crease_are_differentiated_as_in_the_plane(degree):
    mesh, x = strip(12, 90)
    surface = ltl.Surface.from_mesh(mesh, ltl.Polynomial(degree))
    np.testing.assert_allclose(norms(ltl.gradient(surface, x**degree)), degree * x ** (degree - 1), atol=1e-8)
    second = degree * (degree - 1) * x ** (degree - 2)
    np.testing.assert_allclose(norms(ltl.hessian(surface, x**degree)), second, atol=1e-6)


@pytest.fixture(scope="module")
def components():
    """A fold, a torus, a torus with folded faces, random points and a disk, as components of one mesh."""
    mesh = union(
        strip(8, 90)[0],
        ltl.shapes.jittered_torus(24, 12, 0.3, seed=0),
        ltl.shapes.jittered_torus(24, 12, 0.45, seed=0),
        ltl.shapes.random_sphere(162, seed=0),
        ltl.shapes.jittered(ltl.shapes.disk(rings=6), 0.4, seed=0),
    )
    return mesh, ltl.Surface.from_mesh(mesh)


def test_weights_of_moved_vertices_are_the_same_in_jax_and_numpy(components):
    mesh, surface = components
    assert surface.topology.num_components == 5
    assert len(surface.report.extrinsic) > 0
    vertices = mesh.vertices * [1, 1.01, 1.02]
    moved, topology = surface.with_vertices(vertices), jax.tree.map(np.asarray, surface.topology)
    geometry = weigh(surface.scheme, vertices, topology)
    for field in dataclasses.fields(geometry):
        arrays, expected_arrays = (jax.tree.leaves(getattr(g, field.name)) for g in (moved.geometry, geometry))
        for array, expected in zip(arrays, expected_arrays, strict=True):
            size = 100 if field.name == "laplacian_residual" else np.abs(expected).max(initial=0)
            np.testing.assert_allclose(array, expected, rtol=1e-9, atol=1e-12 * size)


@pytest.mark.parametrize(
    "operator",
    [
        lambda surface, u: ltl.laplacian(surface, u, flux=u),
        pytest.param(lambda surface, u: ltl.gradient(surface, u), marks=pytest.mark.slow),
        pytest.param(lambda surface, u: ltl.divergence(surface, surface.vertices), marks=pytest.mark.slow),
    ],
    ids=["laplacian", "gradient", "divergence"],
)
def test_operators_are_differentiable_at_creases_flip_ties_and_boundaries(operator):
    # Both diagonals of a square are Delaunay, and shearing the cells causes flips.
    mesh, x = strip(4, 90, 0.0, "same")
    vertices = mesh.vertices + [0, 1, 0] * (0.8 * x[:, None])
    surface = ltl.Surface.from_mesh(ltl.Mesh(vertices, mesh.faces))
    assert surface.report.flips > 0
    u, direction = jnp.sin(3 * x), np.random.default_rng(0).normal(size=vertices.shape)

    @jax.jit
    @jax.value_and_grad
    def total(vertices):
        return jnp.sum(operator(surface.with_vertices(vertices), u) ** 2)

    value, gradient = total(surface.vertices)
    slope, steps = jnp.sum(gradient * direction), 1e-4 * 0.5 ** np.arange(4)
    remainders = [abs(total(surface.vertices + h * direction)[0] - value - h * slope) for h in steps]
    assert np.polyfit(np.log(steps), np.log(remainders), 1)[0] == pytest.approx(2, abs=0.05)


def test_a_flat_face_gives_finite_weights_and_derivatives():
    # An interior vertex is moved to the opposite edge of one of its faces, almost: the mesh check rejects zero area.
    mesh = ltl.shapes.square(n=4)
    vertices, face = mesh.vertices.copy(), next(f for f in mesh.faces if not mesh.boundary_vertices[f].any())
    vertices[face[2]] = vertices[face[:2]].mean(axis=0) + 1e-9 * (vertices[face[2]] - vertices[face[0]])
    surface = ltl.Surface.from_mesh(ltl.Mesh(vertices, mesh.faces))
    total = lambda v: jnp.sum(ltl.laplacian(surface.with_vertices(v), v[:, 0]))  # noqa: E731
    assert np.isfinite(jax.jit(jax.grad(total))(surface.vertices)).all()
    assert all(np.isfinite(w).all() and (np.asarray(w) >= 0).all() for w in surface.geometry.laplacian_weights)


@pytest.mark.parametrize(
    "make",
    [
        lambda: ltl.shapes.box(n=8),
        lambda: strip(8, 179)[0],
        lambda: blade(8, 1e-4),
        lambda: blade(8, 1e-8),
        lambda: cone(np.radians(5), 6)[0],
        lambda: saddle(1.8),
        lambda: saddle(3.0),
        lambda: ltl.shapes.jittered_torus(24, 12, 0.45, seed=0),
    ],
    ids=[
        "cube",
        "nearly closed fold",
        "thin blade",
        "thinner blade",
        "needle",
        "saddle",
        "steep saddle",
        "folded torus",
    ],
)
def test_no_weight_is_negative_and_no_mode_grows_on_sharp_shapes(make):
    surface = ltl.Surface.from_mesh(make())
    assert min(float(w.min()) for w in surface.geometry.laplacian_weights) >= 0
    assert len(surface.report.inconsistent) == 0
    eigenvalues = np.linalg.eigvals(ltl.laplacian_matrix(surface).todense())
    assert eigenvalues.real.max() < 1e-10 * np.abs(eigenvalues).max()
    np.testing.assert_allclose(surface.mass.sum(), surface.vertex_areas.sum())


@pytest.mark.parametrize("thickness", [1e-3, 1e-6])
def test_a_blade_has_the_eigenvalues_of_its_two_sides_glued_at_the_rim(thickness):
    matrix = -ltl.laplacian_matrix(ltl.Surface.from_mesh(blade(16, thickness))).tocsc()
    values = np.sort(scipy.sparse.linalg.eigs(matrix, k=5, sigma=-1.0, return_eigenvectors=False).real)
    # Modes that are equal on both sides satisfy Neumann conditions at the rim. Odd modes vanish there.
    np.testing.assert_allclose(values, np.pi**2 * np.array([0, 1, 1, 2, 2]), rtol=2e-2, atol=1e-2)


@pytest.fixture(scope="module")
def folded_torus():
    mesh = ltl.shapes.jittered_torus(96, 48, 0.45, seed=0)
    return mesh, ltl.Surface.from_mesh(mesh)


def test_vertices_at_folded_faces_are_laid_out_in_space_and_reported(folded_torus):
    mesh, surface = folded_torus
    assert 0 < len(surface.report.extrinsic) < mesh.num_vertices / 3
    assert f"folded faces {len(surface.report.extrinsic)}" in " ".join(str(surface.report).split())
    x, y, z = mesh.vertices.T
    poloidal, w = np.arctan2(z, np.hypot(x, y) - 2), np.hypot(x, y)
    u = np.sin(poloidal)
    f = -2 * u - u * np.cos(poloidal) / w
    stiffness, mass = robust_laplacian.mesh_laplacian(mesh.vertices, mesh.faces)
    operators = ltl.laplacian_matrix(surface), -scipy.sparse.diags_array(1 / mass.diagonal()) @ stiffness
    ours, theirs = (
        np.linalg.norm(
            scipy.sparse.linalg.spsolve(scipy.sparse.csc_matrix(matrix - scipy.sparse.eye_array(len(u))), f) - u
        )
        for matrix in operators
    )
    assert ours < 0.5 * theirs


def test_rows_without_a_fit_are_cotangent_rows(monkeypatch):
    # Non-negative least squares fails here in the way SciPy fails after too many iterations.
    def failing_nnls(*_):
        raise RuntimeError("Maximum number of iterations reached.")

    monkeypatch.setattr(support, "nnls", failing_nnls)
    mesh = ltl.shapes.jittered(ltl.shapes.square(n=16), 0.3, seed=0)
    surface = ltl.Surface.from_mesh(mesh)
    rows = surface.report.cotangent
    assert len(rows) > 10
    assert len(surface.report.inconsistent) == 0
    assert f"cotangent Laplacian rows {len(rows)}" in " ".join(str(surface.report).split())
    stiffness, _ = robust_laplacian.mesh_laplacian(mesh.vertices, mesh.faces)
    theirs, ours = -stiffness.tocsr()[rows].todense(), ltl.laplacian_matrix(surface).tocsr()[rows].todense()
    own = np.arange(len(rows)), rows
    np.testing.assert_allclose(ours / ours[own][..., None], theirs / np.asarray(theirs[own]).reshape(-1, 1), atol=1e-4)
    # In the plane, interior rows are exact for linear functions and for the squared distance.
    interior_rows = rows[~mesh.boundary_vertices[rows]]
    for u, exact in ((mesh.vertices[:, 0], 0), (np.sum(mesh.vertices**2, axis=1), 4)):
        np.testing.assert_allclose(np.asarray(ltl.laplacian(surface, u))[interior_rows], exact, atol=1e-3)
    moved = jax.jit(lambda v: surface.with_vertices(v).geometry.laplacian_weights)(surface.vertices)
    for weights, expected in zip(moved, surface.geometry.laplacian_weights, strict=True):
        assert largest_difference(weights, expected) < 1e-12


def test_the_stencil_of_the_laplacian_is_the_laplacian_also_at_cotangent_rows():
    plate = blade(8, 1e-6)
    surface = ltl.Surface.from_mesh(union(plate, slit(6.25)))
    assert min(surface.report.cotangent) < plate.num_vertices <= max(surface.report.cotangent)
    stencil = ltl.operators.elliptic_stencil(surface, 2.0)
    assert largest_difference(stencil.matrix(), 2 * ltl.laplacian_matrix(surface)) < 1e-9

    @eqx.filter_jit
    def scaled(stencil, surface):
        return stencil.with_coefficients(surface.with_vertices(2 * surface.vertices), 8.0)

    assert largest_difference(scaled(stencil, surface).matrix(), stencil.matrix()) < 1e-6


@pytest.mark.parametrize("angle", [2.3, 4.0, 6.0, 6.25])
def test_a_flux_through_the_sides_of_a_corner_enters_in_full(angle):
    mesh = slit(angle)
    surface = ltl.Surface.from_mesh(mesh)
    tip = int(np.flatnonzero(np.asarray(surface.topology.boundary) == 0)[0])
    flux = np.asarray(surface.geometry.flux_weights)[tip]
    # Each side of the corner contributes in proportion to its length.
    sides = np.linalg.norm(mesh.vertices[[1, 25]], axis=1)
    np.testing.assert_allclose(flux / flux.sum(), sides / sides.sum())
    total = ltl.integrate(surface, ltl.laplacian(surface, 0 * surface.vertices[:, 0], flux=jnp.ones(mesh.num_vertices)))
    loop = mesh.boundary_loops[0]
    rim = np.linalg.norm(mesh.vertices[loop] - mesh.vertices[np.roll(loop, 1)], axis=1).sum()
    assert float(total) == pytest.approx(rim, rel=0.05)


def test_well_shaped_faces_of_very_different_sizes_are_not_distorted():
    mesh = graded_disk(np.geomspace(1e-8, 1, 24))
    surface = ltl.Surface.from_mesh(mesh)
    np.testing.assert_allclose(norms(ltl.gradient(surface, mesh.vertices[:, 0])), 1, rtol=1e-6)


@pytest.mark.parametrize(
    "make", [lambda: strip(8, 90)[0], lambda: ltl.shapes.jittered_torus(24, 12, 0.3, seed=0)], ids=["fold", "torus"]
)
def test_rigid_motions_and_the_unit_of_length_do_not_matter(make):
    mesh = make()
    rotation = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    matrix = ltl.laplacian_matrix(ltl.Surface.from_mesh(mesh))
    moved = ltl.Mesh(100 * mesh.vertices @ rotation.T + [3, 1, -2], mesh.faces)
    assert largest_difference(1e4 * ltl.laplacian_matrix(ltl.Surface.from_mesh(moved)), matrix) < 1e-8


@pytest.mark.parametrize("dtype", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_moved_surfaces_can_be_batched(dtype):
    mesh, _ = strip(4, 90)
    surface = ltl.Surface.from_mesh(mesh, dtype=dtype)
    scales = jnp.array([1.0, 2.0])
    u = surface.vertices[:, 1] ** 2

    @jax.jit
    @jax.vmap
    def scaled_laplacian(scale):
        return ltl.laplacian(surface.with_vertices(scale * surface.vertices.astype(scale.dtype)), u)

    rates = scaled_laplacian(scales)
    np.testing.assert_allclose(rates[0], 4 * rates[1], rtol=1e-4 if dtype == "float32" else 1e-10, atol=1e-3)


def test_no_edge_leads_through_a_face_that_is_folded_over(folded_torus):
    mesh, surface = folded_torus
    is_extrinsic = np.zeros(mesh.num_vertices, bool)
    is_extrinsic[surface.report.extrinsic] = True
    assert 0 < is_extrinsic.sum() < 0.3 * mesh.num_vertices
    # No edge of a face that is folded over has been flipped.
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    angle, across = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0]), np.hypot(*mesh.vertices[:, :2].T) - 2
    outward = np.stack([across * np.cos(angle), across * np.sin(angle), mesh.vertices[:, 2]], axis=1)
    folded = mesh.faces[np.einsum("fc,fvc->fv", normals, outward[mesh.faces]).max(axis=1) < 0]
    assert len(folded) > 10
    ends = np.asarray(surface.topology.triangulation.tails).reshape(-1, 2)
    edges = {frozenset(edge) for edge in ends.tolist()}
    assert all(frozenset(face[[k, k - 1]].tolist()) in edges for face in folded for k in range(3))
    # All neighbours of a folded face are laid out in space, so that no path in a chart leads through the face.
    is_surrounded = is_extrinsic.copy()
    for v, w in mesh.edges:
        is_surrounded[v] &= is_extrinsic[w]
        is_surrounded[w] &= is_extrinsic[v]
    assert is_surrounded[folded].all()
    height = mesh.vertices[:, 2]
    exact = -height - height * across / (2 + across)
    error = np.asarray(ltl.laplacian(surface, surface.vertices[:, 2])) - exact
    assert np.sqrt(np.mean(error**2)) < 0.03
