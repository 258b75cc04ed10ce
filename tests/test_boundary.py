"""Boundary conditions against exact solutions, on smooth boundaries and at corners."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import jn_zeros, jnp_zeros, jv

import ltljax as ltl

SHARP = dict(rtol=1e-8, atol=1e-10)
RINGS = (20, 40)


@functools.cache
def disk(rings):
    """A disk with jittered vertices, and their polar coordinates."""
    mesh = ltl.shapes.jittered(ltl.shapes.disk(rings=rings), 0.2, seed=0)
    x, y, _ = mesh.vertices.T
    return ltl.Surface.from_mesh(mesh), np.hypot(x, y), np.arctan2(y, x)


def relative_error(u, exact):
    return float(np.linalg.norm(np.asarray(u) - exact) / np.linalg.norm(exact))


def assert_second_order(errors, last):
    assert np.log2(errors[0] / errors[-1]) / (len(errors) - 1) >= 1.8
    assert errors[-1] < last


def decay_errors(conditions, mode, rate, t1):
    """Errors of u = mode exp(-rate t) on two disks."""
    errors = []
    for rings in RINGS:
        surface, r, angle = disk(rings)
        start = mode(r, angle)
        u = ltl.solve(ltl.Diffusion(boundary=conditions), surface, start, t1, **SHARP).us[-1]
        errors.append(relative_error(u, start * np.exp(-rate * t1)))
    return errors


@pytest.mark.parametrize("order", [0, 1])
def test_neumann_modes_of_a_disk(order):
    zero = jnp_zeros(order, 1)[0]
    errors = decay_errors((), lambda r, angle: jv(order, zero * r) * np.cos(order * angle), zero**2, 0.1)
    assert_second_order(errors, 2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("order", [0, 1])
def test_dirichlet_modes_of_a_disk(order):
    zero = jn_zeros(order, 1)[0]
    errors = decay_errors(ltl.Dirichlet(), lambda r, angle: jv(order, zero * r) * np.cos(order * angle), zero**2, 0.1)
    assert_second_order(errors, 2e-3)


@pytest.mark.slow
def test_robin_modes_of_a_disk():
    # u + 2 du/dr = 0 at r = 1.
    k = brentq(lambda k: jv(0, k) - 2 * k * jv(1, k), 0.5, 2)
    errors = decay_errors(ltl.Robin(a=1.0, b=2.0), lambda r, angle: jv(0, k * r), k**2, 0.5)
    assert_second_order(errors, 1e-4)


@pytest.mark.slow
def test_a_flux_through_the_boundary_of_a_disk():
    # exp(x) cos y is harmonic, so its flux is steady, while a Neumann mode decays on top of it.
    zero, errors = jnp_zeros(0, 1)[0], []
    for rings in RINGS:
        surface, r, angle = disk(rings)
        x, y = r * np.cos(angle), r * np.sin(angle)
        steady, mode = np.exp(x) * np.cos(y), jv(0, zero * r)
        flux = jnp.asarray(np.exp(x) * (x * np.cos(y) - y * np.sin(y)))
        u = ltl.solve(ltl.Diffusion(boundary=ltl.Neumann(flux)), surface, steady + mode, 0.1, **SHARP).us[-1]
        errors.append(relative_error(u, steady + mode * np.exp(-(zero**2) * 0.1)))
    assert_second_order(errors, 2e-4)


def test_a_flux_that_depends_on_time():
    # u = exp(x / 2 - y / 3 + k t), k = 1/4 + 1/9, solves the heat equation.
    surface, r, angle = disk(20)
    x, y = r * np.cos(angle), r * np.sin(angle)

    def flux(t, v):
        return jnp.exp(v[:, 0] / 2 - v[:, 1] / 3 + 13 / 36 * t) * (v[:, 0] / 2 - v[:, 1] / 3)

    start = np.exp(x / 2 - y / 3)
    u = ltl.solve(ltl.Diffusion(boundary=ltl.Neumann(flux)), surface, start, 1.0, rtol=1e-7, atol=1e-9).us[-1]
    assert relative_error(u, start * np.exp(13 / 36)) < 1e-4


def test_held_values_that_depend_on_time_are_held_exactly():
    errors = []
    for rings in RINGS:
        surface, r, _ = disk(rings)
        condition = ltl.Dirichlet(lambda t, v: jv(0, 2.0) * jnp.exp(-4 * t))
        solution = ltl.solve(ltl.Diffusion(boundary=condition), surface, jv(0, 2 * r), 0.5, **SHARP)
        np.testing.assert_allclose(solution.us[-1][surface.topology.boundary], jv(0, 2.0) * np.exp(-2), rtol=1e-12)
        errors.append(relative_error(solution.us[-1], jv(0, 2 * r) * np.exp(-2)))
    assert_second_order(errors, 1e-3)


def test_the_rate_at_held_values_is_the_time_derivative_of_their_data():
    surface, r, _ = disk(6)
    condition = ltl.Dirichlet(lambda t, v: jnp.sin(3 * t) * v[:, 0])
    rate = ltl.Diffusion(boundary=condition).rate(jnp.asarray(0.4), surface, jnp.asarray(1 - r**2))
    rim = surface.topology.boundary
    np.testing.assert_allclose(rate[rim], 3 * np.cos(1.2) * surface.vertices[rim, 0], rtol=1e-12, atol=1e-14)


def test_a_gradient_gives_the_flux_on_both_sides_of_the_corners_of_a_square():
    errors, modes = [], []
    for n in (24, 48):
        mesh = ltl.shapes.jittered(ltl.shapes.square(n=n), 0.2, seed=0)
        surface = ltl.Surface.from_mesh(mesh)
        assert (np.bincount(surface.topology.kinds) == [(n - 1) ** 2, 4 * (n - 1), 4]).all()
        x, y, _ = mesh.vertices.T

        steady = np.exp(x / 2) * np.cos(y / 2)
        gradient = np.stack([steady, -np.exp(x / 2) * np.sin(y / 2), 0 * x], axis=1) / 2
        u = ltl.solve(ltl.Diffusion(boundary=ltl.Neumann(jnp.asarray(gradient))), surface, steady, 0.5, **SHARP).us[-1]
        errors.append(relative_error(np.asarray(u) - np.mean(u), steady - steady.mean()))
        start = np.cos(np.pi * x) * np.cos(2 * np.pi * y)
        u = ltl.solve(ltl.Diffusion(), surface, start, 0.02, **SHARP).us[-1]
        modes.append(relative_error(u, start * np.exp(-5 * np.pi**2 * 0.02)))
    assert_second_order(errors, 1e-3)
    assert_second_order(modes, 2e-3)


def test_a_condition_applies_where_it_is_specified():
    mesh = ltl.shapes.cylinder(radius=1.0, height=2.0, n_around=24, n_along=12)
    surface = ltl.Surface.from_mesh(mesh)
    z = mesh.vertices[:, 2]
    loops = mesh.boundary_loops
    low = int(z[loops[1]].mean() < 0)
    equivalent = [
        (ltl.Dirichlet(-1.0, where=low), ltl.Dirichlet(1.0, where=1 - low)),
        (ltl.Dirichlet(-1.0, where=lambda v: v[:, 2] < 0), ltl.Dirichlet(1.0, where=lambda v: v[:, 2] > 0)),
        (ltl.Dirichlet(-1.0, where=jnp.asarray(z == -1)), ltl.Dirichlet(1.0, where=jnp.asarray(z == 1))),
        (ltl.Dirichlet(-1.0), ltl.Dirichlet(1.0, where=lambda v: v[:, 2] > 0)),
    ]
    state, t = jnp.asarray(np.cos(3 * z) + mesh.vertices[:, 0]), jnp.zeros(())
    rates = [ltl.Diffusion(boundary=conditions).rate(t, surface, state) for conditions in equivalent]
    for rate in rates[1:]:
        np.testing.assert_array_equal(rate, rates[0])
    mixed = (ltl.Dirichlet(-1.0, where=low), ltl.Neumann(1.0, where=1 - low))
    for conditions in (equivalent[0], mixed):
        u = ltl.solve(ltl.Diffusion(boundary=conditions), surface, 0 * z, 20.0).us[-1]
        np.testing.assert_allclose(u, z, atol=1e-3)


def test_a_mask_can_hold_values_at_interior_vertices():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(3))
    z = np.asarray(surface.vertices[:, 2])
    held = jnp.asarray(np.abs(z) > 0.9)
    condition = ltl.Dirichlet(lambda t, v: jnp.sign(v[:, 2]), where=held)
    u = np.asarray(ltl.solve(ltl.Diffusion(boundary=condition), surface, 0 * z, 5.0).us[-1])
    np.testing.assert_array_equal(u[held], np.sign(z)[held])
    # The zonal harmonic function is a multiple of atanh z.
    ring = np.abs(z) < 0.5
    np.testing.assert_allclose(u[ring], np.arctanh(z[ring]) / np.arctanh(0.9), atol=0.06)


def test_boundary_data_can_differ_between_species():
    surface, r, _ = disk(8)
    equation = ltl.ReactionDiffusion(
        (1.0, 2.0), lambda state, params: (0 * state[0], 0 * state[1]), boundary=ltl.Dirichlet(jnp.asarray([1.0, 3.0]))
    )
    u = ltl.solve(equation, surface, np.zeros((len(r), 2)), 4.0).us[-1]
    np.testing.assert_allclose(u, np.broadcast_to([1.0, 3.0], u.shape), atol=1e-3)
    equation = ltl.Diffusion(boundary=ltl.Robin(a=1.0, b=1.0, g=jnp.asarray([1.0, 3.0])))
    u = ltl.solve(equation, surface, np.zeros((len(r), 2)), 10.0).us[-1]
    np.testing.assert_allclose(u, np.broadcast_to([1.0, 3.0], u.shape), atol=1e-3)


@pytest.mark.slow
def test_boundary_data_can_be_differentiated():
    surface, r, _ = disk(6)

    def heat(flux, value):
        conditions = (ltl.Neumann(flux), ltl.Dirichlet(value, where=lambda v: v[:, 0] > 0.5))
        u = ltl.solve(ltl.Diffusion(boundary=conditions), surface, jnp.zeros(len(r)), 0.3, **SHARP).us[-1]
        return jnp.sum(u**2)

    data = (jnp.asarray(0.7), jnp.asarray(0.4))
    step = 1e-4
    for index, slope in enumerate(jax.grad(heat, argnums=(0, 1))(*data)):
        ahead, behind = ([x + s * step * (i == index) for i, x in enumerate(data)] for s in (1, -1))
        assert float(slope) == pytest.approx(float(heat(*ahead) - heat(*behind)) / (2 * step), rel=1e-5)


def test_conditions_that_do_not_fit_are_rejected():
    surface, r, _ = disk(3)
    u, t = jnp.zeros(len(r)), jnp.zeros(())
    with pytest.raises(TypeError, match="Neumann"):
        ltl.Diffusion(boundary="dirichlet")
    with pytest.raises(ValueError, match=r"boundary data as a number or of shape \(37,\).*found \(5,\)"):
        ltl.Diffusion(boundary=ltl.Dirichlet(jnp.zeros(5))).rate(t, surface, u)
    with pytest.raises(ValueError, match="to give booleans"):
        ltl.Diffusion(boundary=ltl.Neumann(where=jnp.zeros(5, bool))).rate(t, surface, u)
    with pytest.raises(ValueError, match=r"boundary loop below 1 .* found 1"):
        ltl.Diffusion(boundary=ltl.Neumann(where=1)).rate(t, surface, u)
    closed = ltl.Surface.from_mesh(ltl.shapes.icosphere(1))
    with pytest.raises(ValueError, match="the surface is closed"):
        ltl.Diffusion(boundary=ltl.Dirichlet()).rate(t, closed, jnp.zeros(closed.num_vertices))
    with pytest.raises(ValueError, match="Expected a flux of shape"):
        ltl.laplacian(surface, u, flux=jnp.zeros((len(r), 2)))


@pytest.mark.parametrize("angle", [60.0, 120.0, 150.0, 250.0])
def test_rows_at_corners_of_any_angle_are_non_negative_and_exact(angle):
    # At the tip of a sector, a smooth field without flux is c + r^2 to second order.
    count = max(3, round(angle / 15))
    turns = np.radians(np.linspace(0, angle, count + 1))
    radii = np.linspace(0, 1, 7)[1:]
    points = np.array([[0, 0]] + [[r * np.cos(a), r * np.sin(a)] for r in radii for a in turns])
    faces = [[0, 1 + i, 2 + i] for i in range(count)]
    for ring in range(len(radii) - 1):
        a, b = 1 + ring * (count + 1), 1 + (ring + 1) * (count + 1)
        for i in range(count):
            faces += [[a + i, b + i, b + i + 1], [a + i, b + i + 1, a + i + 1]]
    mesh = ltl.Mesh(np.column_stack([points, np.zeros(len(points))]), np.array(faces))
    surface = ltl.Surface.from_mesh(mesh)
    squared = np.sum(points**2, axis=1)
    assert float(ltl.laplacian(surface, squared)[0]) == pytest.approx(4)
    assert min(float(w.min()) for w in surface.geometry.laplacian_weights) >= 0
    # A linear field has flux through both sides, and its Laplacian is zero.
    linear = points @ np.array([2.0, -3.0])
    flux = np.broadcast_to([2.0, -3.0, 0.0], (len(points), 3))
    assert float(ltl.laplacian(surface, linear, flux)[0]) == pytest.approx(0, abs=1e-9)


def test_rows_at_right_corners_are_exact_for_both_second_derivatives():
    mesh = ltl.shapes.jittered(ltl.shapes.square(n=8), 0.2, seed=0)
    vertices = mesh.vertices * [1.0, 0.6, 1.0]
    surface = ltl.Surface.from_mesh(ltl.Mesh(vertices, mesh.faces))
    for corner in (0, 8, 72, 80):
        for squared in (vertices - vertices[corner]).T[:2] ** 2:
            assert float(ltl.laplacian(surface, jnp.asarray(squared))[corner]) == pytest.approx(2)


@pytest.mark.parametrize("lift", ["intrinsic", "chord"])
def test_linear_fields_have_their_exact_gradient_where_the_boundary_is_spaced_unevenly(lift):
    mesh = ltl.shapes.disk(rings=4)
    radius, angle = np.hypot(*mesh.vertices[:, :2].T), np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0])
    angle = angle + 0.4 * np.sin(angle)
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * radius], axis=1)
    surface = ltl.Surface.from_mesh(ltl.Mesh(vertices, mesh.faces), ltl.Monotone(lift=lift))
    expected = np.broadcast_to([1.0, 0.0, 0.0], vertices.shape)
    np.testing.assert_allclose(ltl.gradient(surface, surface.vertices[:, 0]), expected, atol=1e-12)
