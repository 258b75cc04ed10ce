"""The intrinsic lift: bending a surface changes nothing, and creases, cones and boxes are as good as a plane."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robust_laplacian
import scipy.sparse
import scipy.sparse.linalg

import ltljax as ltl
from ltljax._lifting import support
from ltljax._lifting.weighing import weigh


def strip(n, degrees, amount=0.3, diagonals="random"):
    """The strip [0, 2] x [0, 1] bent along x = 1, jittered in its own plane, and x before bending."""
    random = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(2 * n + 1) / n, np.arange(n + 1) / n, indexing="ij")
    dx, dy = random.uniform(-amount / n, amount / n, (2, *x.shape))
    dx[[0, n, -1]], dy[:, [0, -1]] = 0, 0
    x, y = (x + dx).ravel(), (y + dy).ravel()
    corner = np.arange(x.size).reshape(2 * n + 1, n + 1)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
    flips = random.random(len(a)) < 0.5 if diagonals == "random" else np.zeros(len(a), bool)
    one = np.where(flips[:, None], np.stack([a, b, d], axis=1), np.stack([a, b, c], axis=1))
    other = np.where(flips[:, None], np.stack([b, c, d], axis=1), np.stack([a, c, d], axis=1))
    angle, beyond = np.radians(degrees), np.maximum(x - 1, 0)
    bent = np.stack([np.minimum(x, 1) + beyond * np.cos(angle), y, beyond * np.sin(angle)], axis=1)
    return ltl.Mesh(bent, np.concatenate([one, other])), x


def cone(half_angle, rings):
    """A cone with generators of length 1 and its tip at the origin; r along the generators, and the angle about it."""
    vertices, radius, angle = [np.zeros(3)], [0.0], [0.0]
    for ring in range(1, rings + 1):
        for k in range(6 * rings):
            t = 2 * np.pi * (k + ring / 2) / (6 * rings)
            r = ring / rings
            vertices.append(r * np.array([np.sin(half_angle) * np.cos(t), np.sin(half_angle) * np.sin(t), 0]))
            vertices[-1][2] = -r * np.cos(half_angle)
            radius.append(r)
            angle.append(t)
    count = 6 * rings
    k = np.arange(count)
    faces = [np.stack([0 * k, 1 + k, 1 + (k + 1) % count], axis=1)]
    for ring in range(rings - 1):
        own, after = 1 + ring * count + k, 1 + ring * count + (k + 1) % count
        faces += [np.stack([own, own + count, after], axis=1), np.stack([after, own + count, after + count], axis=1)]
    return ltl.Mesh(np.array(vertices), np.concatenate(faces)), np.array(radius), np.array(angle)


def largest_difference(one, other):
    return abs(one - other).max() / abs(other).max()


FLAT, X = strip(16, 0)
FOLDS = [20, 90, 170]


@pytest.mark.parametrize("degrees", FOLDS)
def test_bending_changes_no_operator(degrees):
    flat, bent = ltl.Surface.from_mesh(FLAT), ltl.Surface.from_mesh(strip(16, degrees)[0])
    assert largest_difference(ltl.laplacian_matrix(bent), ltl.laplacian_matrix(flat)) < 1e-9
    u = np.cos(np.pi * X / 2)
    np.testing.assert_allclose(size(ltl.gradient(bent, u)), size(ltl.gradient(flat, u)), atol=1e-9)
    np.testing.assert_allclose(size(ltl.hessian(bent, u)), size(ltl.hessian(flat, u)), atol=1e-7)
    ours, plane = (np.asarray(ltl.divergence(surface, ltl.gradient(surface, u))) for surface in (bent, flat))
    if degrees > 40:
        np.testing.assert_allclose(ours, plane, atol=1e-7)
    # Below the angle of a crease vectors are transported in space, as on smooth surfaces.
    exact = -((np.pi / 2) ** 2) * u
    assert np.linalg.norm(ours - exact) < 1.25 * np.linalg.norm(plane - exact)
    # A flux through the rim, and a stencil with coefficients that vary.
    with_flux = [ltl.laplacian(surface, jnp.asarray(u), flux=jnp.asarray(X)) for surface in (bent, flat)]
    np.testing.assert_allclose(*with_flux, atol=1e-7)
    stencils = [ltl.operators.elliptic_stencil(surface, 1 + X).matrix() for surface in (bent, flat)]
    assert largest_difference(*stencils) < 1e-9


def size(tensors):
    return np.sqrt(np.sum(np.asarray(tensors) ** 2, axis=tuple(range(1, tensors.ndim))))


def test_heat_and_poisson_on_a_fold_are_as_good_as_cotangents_on_a_plane():
    mesh, x = strip(48, 90)
    u, rate = np.cos(np.pi * x / 2), (np.pi / 2) ** 2
    stiffness, mass = robust_laplacian.mesh_laplacian(mesh.vertices, mesh.faces)
    theirs = scipy.sparse.csc_matrix(-scipy.sparse.diags_array(1 / mass.diagonal()) @ stiffness)
    ours = ltl.laplacian_matrix(ltl.Surface.from_mesh(mesh)).tocsc()
    heat, poisson = zip(*[(heat_error(L, u, rate), poisson_error(L, u, rate)) for L in (ours, theirs)], strict=True)
    assert heat[0] < 1.1 * heat[1]
    assert poisson[0] < 1.1 * poisson[1]


def heat_error(matrix, u, rate, time=0.1, steps=16):
    """The relative error of u at the time, by the fourth-order Pade step."""
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


def test_eigenvalues_of_the_cube():
    modes = ltl.eigenmodes(ltl.Surface.from_mesh(ltl.shapes.box(n=40)), 7)
    np.testing.assert_allclose(modes.values[1:], np.repeat([4.16609, 11.49918], 3), rtol=7e-4)


@pytest.mark.parametrize(("degrees", "power_bound"), [(30, 1.2), (15, 2.5)])
def test_cones_are_as_good_as_with_cotangents(degrees, power_bound):
    half_angle = np.radians(degrees)
    mesh, r, t = cone(half_angle, 24)
    nu = 1 / np.sin(half_angle)
    surface = ltl.Surface.from_mesh(mesh)
    stiffness, mass = robust_laplacian.mesh_laplacian(mesh.vertices, mesh.faces)
    matrices = ltl.laplacian_matrix(surface), -scipy.sparse.diags_array(1 / mass.diagonal()) @ stiffness
    held = np.isclose(r, 1)
    for u, right, bound in ((1 - r**2, np.full(len(r), -4.0), 1.2), (r**nu * np.cos(t), np.zeros(len(r)), power_bound)):
        ours, theirs = (dirichlet_error(scipy.sparse.csr_array(matrix), u, right, held) for matrix in matrices)
        assert ours < bound * theirs


def dirichlet_error(matrix, u, right, held):
    free = ~held
    inside = scipy.sparse.csc_matrix(matrix[free][:, free])
    solved = scipy.sparse.linalg.spsolve(inside, right[free] - matrix[free][:, held] @ u[held])
    return np.linalg.norm(solved - u[free]) / np.linalg.norm(u)


def test_normals_beside_a_crease_are_those_of_the_sides():
    mesh, x = strip(12, 90)
    normals = np.asarray(ltl.Surface.from_mesh(mesh).normals)
    on_crease = np.isclose(x, 1)
    expected = np.where(
        on_crease[:, None], [-np.sqrt(0.5), 0, np.sqrt(0.5)], np.where(x[:, None] < 1, [0, 0, 1], [-1, 0, 0])
    )
    np.testing.assert_allclose(normals, expected, atol=1e-12)


@pytest.mark.parametrize("scheme", [ltl.Monotone(), ltl.Polynomial(4)])
def test_a_vector_that_is_parallel_across_a_crease_has_no_laplacian(scheme):
    mesh, x = strip(12, 90)
    surface = ltl.Surface.from_mesh(mesh, scheme)
    across = np.where(x[:, None] < 1, [1.0, 0, 0], [0.0, 0, 1])
    across[np.isclose(x, 1)] = [np.sqrt(0.5), 0, np.sqrt(0.5)]
    np.testing.assert_allclose(ltl.vector_laplacian(surface, jnp.asarray(across)), 0, atol=1e-8)
    np.testing.assert_allclose(ltl.vectors.covariant_derivative(surface, jnp.asarray(across)), 0, atol=1e-9)


@pytest.mark.parametrize("degree", [3, 4])
def test_polynomials_at_a_crease_are_differentiated_as_in_the_plane(degree):
    mesh, x = strip(12, 90)
    surface = ltl.Surface.from_mesh(mesh, ltl.Polynomial(degree))
    np.testing.assert_allclose(size(ltl.gradient(surface, x**degree)), degree * x ** (degree - 1), atol=1e-8)
    second = degree * (degree - 1) * x ** (degree - 2)
    np.testing.assert_allclose(size(ltl.hessian(surface, x**degree)), second, atol=1e-6)


MESHES = {
    "fold": lambda: strip(8, 90)[0],
    "jittered torus": lambda: ltl.shapes.jittered_torus(24, 12, 0.3, seed=0),
    "folded torus": lambda: ltl.shapes.jittered_torus(24, 12, 0.45, seed=0),
    "random sphere": lambda: ltl.shapes.random_sphere(162, seed=0),
    "disk": lambda: ltl.shapes.jittered(ltl.shapes.disk(rings=6), 0.4, seed=0),
}


@pytest.mark.parametrize("name", MESHES)
def test_moved_vertices_give_the_weights_of_a_new_build(name):
    mesh = MESHES[name]()
    surface = ltl.Surface.from_mesh(mesh)
    moved = mesh.vertices * [1, 1.01, 1.02]
    again, built = surface.with_vertices(moved), jax.tree.map(np.asarray, surface.topology)
    expected = weigh(surface.scheme, moved, built)
    for field in dataclasses.fields(expected):
        ours, theirs = (jax.tree.leaves(getattr(geometry, field.name)) for geometry in (again.geometry, expected))
        for one, other in zip(ours, theirs, strict=True):
            size = 100 if field.name == "laplacian_residual" else np.abs(other).max(initial=0)
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11 * size)


def test_operators_are_differentiable_at_creases_flip_ties_and_boundaries():
    # Both diagonals of a square tie, and the flips of the sheared cells are replayed.
    mesh, x = strip(4, 90, 0.0, "same")
    vertices = mesh.vertices + [0, 1, 0] * (0.8 * x[:, None])
    surface = ltl.Surface.from_mesh(ltl.Mesh(vertices, mesh.faces))
    assert surface.report.flips > 0
    u, direction = jnp.sin(3 * x), np.random.default_rng(0).normal(size=vertices.shape)

    @jax.jit
    @jax.value_and_grad
    def total(vertices):
        moved = surface.with_vertices(vertices)
        rate = ltl.laplacian(moved, u, flux=u)
        return jnp.sum(rate**2) + jnp.sum(ltl.gradient(moved, u) ** 2) + jnp.sum(ltl.divergence(moved, moved.normals))

    value, slope = total(surface.vertices)
    steps = 1e-4 * 0.5 ** np.arange(4)
    rest = [abs(total(surface.vertices + h * direction)[0] - value - h * jnp.sum(slope * direction)) for h in steps]
    assert np.polyfit(np.log(steps), np.log(rest), 1)[0] == pytest.approx(2, abs=0.05)


def test_a_flat_face_gives_finite_weights_and_derivatives():
    # A vertex inside is moved onto the opposite edge of one of its faces, leaving just enough area for the mesh check.
    mesh = ltl.shapes.square(n=4)
    vertices, face = mesh.vertices.copy(), next(f for f in mesh.faces if not mesh.boundary_vertices[f].any())
    vertices[face[2]] = vertices[face[:2]].mean(axis=0) + 1e-9 * (vertices[face[2]] - vertices[face[0]])
    surface = ltl.Surface.from_mesh(ltl.Mesh(vertices, mesh.faces))
    slope = jax.grad(lambda v: jnp.sum(ltl.laplacian(surface.with_vertices(v), v[:, 0])))(surface.vertices)
    assert np.isfinite(slope).all()
    assert all(np.isfinite(w).all() and (np.asarray(w) >= 0).all() for w in surface.geometry.laplacian_weights)


def saddle(turns):
    """A vertex whose faces have angles that sum to 2 pi times ``turns``, in rings around it."""
    count, rings = round(12 * turns), 4
    t = 2 * np.pi * np.arange(count) / count
    vertices, faces = [np.zeros((1, 3))], []
    height = np.cos(round(turns * 2) * t)
    for ring in range(1, rings + 1):
        r = ring / rings
        vertices.append(r * np.stack([np.cos(t), np.sin(t), 1.6 * turns * height], axis=1))
    k, after = np.arange(count), (np.arange(count) + 1) % count
    faces.append(np.stack([0 * k, 1 + k, 1 + after], axis=1))
    for ring in range(rings - 1):
        a, b = 1 + ring * count + k, 1 + ring * count + after
        faces += [np.stack([a, a + count, b], axis=1), np.stack([b, a + count, b + count], axis=1)]
    return ltl.Mesh(np.concatenate(vertices), np.concatenate(faces))


def blade(n, thickness):
    """A square plate of almost no thickness, both of its sides and its rim."""
    mesh = ltl.shapes.box(n=n)
    return ltl.Mesh(mesh.vertices * [1, 1, thickness], mesh.faces)


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
    # Fields that are even from side to side have no flux through the rim, odd ones vanish there.
    np.testing.assert_allclose(values, np.pi**2 * np.array([0, 1, 1, 2, 2]), rtol=2e-2, atol=1e-2)


def test_vertices_at_folded_faces_are_laid_out_in_space_and_reported():
    mesh = ltl.shapes.jittered_torus(96, 48, 0.45, seed=0)
    surface = ltl.Surface.from_mesh(mesh)
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
    # As if non-negative least squares never ended: SciPy raises where it needs too many iterations.
    def endless(*_):
        raise RuntimeError("Maximum number of iterations reached.")

    monkeypatch.setattr(support, "nnls", endless)
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
    # They are exact for linear functions inside and for the square of the distance, in the plane.
    inside = rows[~mesh.boundary_vertices[rows]]
    for u, exact in ((mesh.vertices[:, 0], 0), (np.sum(mesh.vertices**2, axis=1), 4)):
        np.testing.assert_allclose(np.asarray(ltl.laplacian(surface, u))[inside], exact, atol=1e-3)
    moved = surface.with_vertices(surface.vertices)
    assert largest_difference(ltl.laplacian_matrix(moved), ltl.laplacian_matrix(surface)) < 1e-12


@pytest.mark.parametrize("make", [lambda: blade(8, 1e-6), lambda: slit(6.25)], ids=["blade", "slit"])
def test_the_stencil_of_the_laplacian_is_the_laplacian_also_at_cotangent_rows(make):
    surface = ltl.Surface.from_mesh(make())
    assert len(surface.report.cotangent) > 0
    stencil = ltl.operators.elliptic_stencil(surface, 2.0)
    assert largest_difference(stencil.matrix(), 2 * ltl.laplacian_matrix(surface)) < 1e-9
    moved = stencil.with_coefficients(surface.with_vertices(2 * surface.vertices), 8.0)
    assert largest_difference(moved.matrix(), stencil.matrix()) < 1e-6


def slit(angle, rings=6):
    """A sector of the unit disk of some angle, with the vertex at its tip."""
    count = 24
    t = np.linspace(0, angle, count + 1)
    r = (np.arange(1, rings + 1) / rings)[:, None]
    points = np.stack([(r * np.cos(t)).ravel(), (r * np.sin(t)).ravel()], axis=1)
    # The first side is nearer, so that both sides of the tip differ.
    points[0] *= 0.6
    k = np.arange(count)
    faces = [np.stack([0 * k, 1 + k, 2 + k], axis=1)]
    for ring in range(rings - 1):
        a = 1 + ring * (count + 1) + k
        b = a + count + 1
        faces += [np.stack([a, b, a + 1], axis=1), np.stack([a + 1, b, b + 1], axis=1)]
    vertices = np.concatenate([np.zeros((1, 2)), points])
    return ltl.Mesh(np.pad(vertices, ((0, 0), (0, 1))), np.concatenate(faces))


@pytest.mark.parametrize("angle", [2.3, 4.0, 6.0, 6.25])
def test_a_flux_through_the_sides_of_a_corner_enters_in_full(angle):
    mesh = slit(angle)
    surface = ltl.Surface.from_mesh(mesh)
    tip = int(np.flatnonzero(np.asarray(surface.topology.boundary) == 0)[0])
    flux = np.asarray(surface.geometry.flux_weights)[tip]
    # In proportion to the lengths of the sides, half of each.
    sides = np.linalg.norm(mesh.vertices[[1, 25]], axis=1)
    np.testing.assert_allclose(flux / flux.sum(), sides / sides.sum())
    total = ltl.integrate(surface, ltl.laplacian(surface, 0 * surface.vertices[:, 0], flux=jnp.ones(mesh.num_vertices)))
    loop = mesh.boundary_loops[0]
    rim = np.linalg.norm(mesh.vertices[loop] - mesh.vertices[np.roll(loop, 1)], axis=1).sum()
    assert float(total) == pytest.approx(rim, rel=0.05)


def test_well_shaped_faces_of_very_different_sizes_are_not_distorted():
    count, radii = 12, np.geomspace(1e-8, 1, 24)
    t = 2 * np.pi * np.arange(count) / count
    points = [np.zeros((1, 2))] + [r * np.stack([np.cos(t), np.sin(t)], axis=1) for r in radii]
    k, after = np.arange(count), (np.arange(count) + 1) % count
    faces = [np.stack([0 * k, 1 + k, 1 + after], axis=1)]
    for ring in range(len(radii) - 1):
        a, b = 1 + ring * count + k, 1 + ring * count + after
        faces += [np.stack([a, a + count, b], axis=1), np.stack([b, a + count, b + count], axis=1)]
    mesh = ltl.Mesh(np.pad(np.concatenate(points), ((0, 0), (0, 1))), np.concatenate(faces))
    surface = ltl.Surface.from_mesh(mesh)
    np.testing.assert_allclose(size(ltl.gradient(surface, mesh.vertices[:, 0])), 1, rtol=1e-6)


@pytest.mark.parametrize("name", ["fold", "jittered torus"])
def test_place_and_unit_of_length_do_not_matter(name):
    mesh = MESHES[name]()
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    matrix = ltl.laplacian_matrix(ltl.Surface.from_mesh(mesh))
    moved = ltl.Mesh(100 * mesh.vertices @ turn.T + [3, 1, -2], mesh.faces)
    assert largest_difference(1e4 * ltl.laplacian_matrix(ltl.Surface.from_mesh(moved)), matrix) < 1e-8


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_batch_of_moved_surfaces(dtype):
    mesh, _ = strip(4, 90)
    surface = ltl.Surface.from_mesh(mesh, dtype=dtype)
    scales = jnp.array([1.0, 2.0])
    u = surface.vertices[:, 1] ** 2
    found = jax.vmap(lambda s: ltl.laplacian(surface.with_vertices(s * surface.vertices.astype(s.dtype)), u))(scales)
    np.testing.assert_allclose(found[0], 4 * found[1], rtol=1e-4 if dtype == "float32" else 1e-10, atol=1e-3)


def test_no_edge_leads_through_a_face_that_is_folded_over():
    mesh = ltl.shapes.jittered_torus(96, 48, 0.45, seed=0)
    surface = ltl.Surface.from_mesh(mesh)
    is_extrinsic = np.zeros(mesh.num_vertices, bool)
    is_extrinsic[surface.report.extrinsic] = True
    assert 0 < is_extrinsic.sum() < 0.3 * mesh.num_vertices
    # All edges of the faces that are folded over are still there.
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    angle, across = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0]), np.hypot(*mesh.vertices[:, :2].T) - 2
    outward = np.stack([across * np.cos(angle), across * np.sin(angle), mesh.vertices[:, 2]], axis=1)
    folded = mesh.faces[np.einsum("fc,fvc->fv", normals, outward[mesh.faces]).max(axis=1) < 0]
    assert len(folded) > 10
    ends = np.asarray(surface.topology.triangulation.tails).reshape(-1, 2)
    edges = {frozenset(edge) for edge in ends.tolist()}
    assert all(frozenset(face[[k, k - 1]].tolist()) in edges for face in folded for k in range(3))
    # And paths of the charts, which begin at other vertices, end at the rim of these places.
    is_closed = is_extrinsic.copy()
    for v, w in mesh.edges:
        is_closed[v] &= is_extrinsic[w]
        is_closed[w] &= is_extrinsic[v]
    assert is_closed[folded].all()
    height = mesh.vertices[:, 2]
    exact = -height - height * across / (2 + across)
    error = np.asarray(ltl.laplacian(surface, surface.vertices[:, 2])) - exact
    assert np.sqrt(np.mean(error**2)) < 0.03
