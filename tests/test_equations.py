"""Equations beyond plain diffusion: variable and anisotropic diffusion, drift, fourth order, moving surfaces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import ltljax as ltl


@pytest.fixture(scope="module")
def sphere():
    return ltl.Surface.from_mesh(ltl.shapes.jittered_sphere(3, 0.3, seed=0))


def no_reaction(count):
    return lambda species, params: tuple(0 * u for u in species)


def test_constant_fields_and_stencils_diffuse_like_the_number(sphere):
    u = jnp.stack([sphere.vertices[:, 0], sphere.vertices[:, 1] ** 2], axis=1)
    field = 0.3 * jnp.ones(sphere.num_vertices)
    stencil = ltl.operators.elliptic_stencil(sphere, 0.2)
    kinetics = ltl.kinetics.schnakenberg()
    variable = ltl.ReactionDiffusion((field, stencil), kinetics)
    constant = ltl.ReactionDiffusion((0.3, 0.2), kinetics)
    t = jnp.array(0.0)
    rate, expected = variable.rate(t, sphere, u), constant.rate(t, sphere, u)
    np.testing.assert_allclose(rate[:, 0], expected[:, 0], atol=1e-10)
    assert jnp.linalg.norm(rate[:, 1] - expected[:, 1]) < 0.05 * jnp.linalg.norm(expected[:, 1])
    np.testing.assert_allclose(variable.diffusivities(u), (0.3, 0.2), rtol=1e-6)


@pytest.mark.parametrize(
    "solver", [None, pytest.param(ltl.TRBDF2(), marks=pytest.mark.slow)], ids=["default", "TRBDF2"]
)
def test_a_variable_diffusivity_nearly_conserves_the_integral(sphere, solver):
    # The rows of div(D grad u) are conservative only approximately with respect to the areas.
    conductivity = 1 + 0.5 * sphere.vertices[:, 2]
    equation = ltl.ReactionDiffusion((conductivity,), no_reaction(1))
    u0 = (1 + sphere.vertices[:, :1]) ** 2
    u = ltl.solve(equation, sphere, u0, 0.3, solver=solver).u_end
    assert float(u.min()) > float(u0.min())
    assert float(u.max()) < float(u0.max())
    assert ltl.integrate(sphere, u)[0] == pytest.approx(float(ltl.integrate(sphere, u0)[0]), rel=0.02)


def test_a_flow_carries_a_field_around_the_sphere():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(4))
    x, y, z = surface.vertices.T
    velocity = jnp.stack([-y, x, 0 * z], axis=1)
    stencil = ltl.operators.elliptic_stencil(surface, 0.01, -velocity)
    equation = ltl.ReactionDiffusion((stencil,), no_reaction(1))
    u = ltl.solve(equation, surface, x[:, None], np.pi / 2, rtol=1e-6, atol=1e-8).u_end[:, 0]
    expected = y * np.exp(-2 * 0.01 * np.pi / 2)
    # Part of the error is the numerical diffusion of upwinding.
    assert jnp.linalg.norm(u - expected) < 0.05 * jnp.linalg.norm(expected)


@pytest.mark.slow
def test_stripes_follow_a_direction_field():
    mesh = ltl.shapes.icosphere(4)
    surface = ltl.Surface.from_mesh(mesh)
    x, y, z = surface.vertices.T
    field = jnp.stack([-y, x, 0 * z], axis=1)
    tensor = ltl.operators.direction_tensor(surface, field, along=1.6, across=0.4)
    # Anisotropy of both species would only stretch the pattern, and stripes would have no preferred direction.
    spreads = (ltl.operators.elliptic_stencil(surface, 0.516 * 0.0045 * tensor), 0.0045)
    kinetics = ltl.kinetics.barrio(cubic=3.5, quadratic=0.0)
    u0 = jnp.asarray(np.random.default_rng(0).uniform(-0.5, 0.5, (surface.num_vertices, 2)))
    u = ltl.solve(ltl.ReactionDiffusion(spreads, kinetics), surface, u0, 300.0, rtol=1e-3, atol=1e-4).u_end[:, 0]
    slope = ltl.gradient(surface, u)
    size = jnp.linalg.norm(slope, axis=1)
    unit = field / jnp.maximum(jnp.linalg.norm(field, axis=1, keepdims=True), 1e-12)
    # Exclude the poles, where the field has no direction, and weight by the steepness of the pattern.
    weight = jnp.where(jnp.abs(z) < 0.8, size, 0)
    angle = jnp.degrees(jnp.arcsin(jnp.clip(jnp.abs(jnp.sum(slope * unit, axis=1)) / jnp.maximum(size, 1e-12), 0, 1)))
    assert float(jnp.sum(weight * angle) / jnp.sum(weight)) < 10


def test_cahn_hilliard_conserves_mass_and_dissipates_energy(sphere):
    equation = ltl.CahnHilliard(width=0.2)
    u0 = jnp.asarray(0.1 + 0.2 * np.random.default_rng(0).uniform(-1, 1, sphere.num_vertices))
    solution = ltl.solve(equation, sphere, u0, 1.0, ts=np.linspace(0, 1, 6))
    masses = [float(ltl.integrate(sphere, u, sphere.mass)) for u in solution.us]
    np.testing.assert_allclose(masses, masses[0], rtol=1e-10)

    def energy(u):
        gradient = -ltl.integrate(sphere, u * ltl.laplacian(sphere, u), sphere.mass)
        return float(0.2**2 * gradient / 2 + ltl.integrate(sphere, (u**2 - 1) ** 2, sphere.mass) / 4)

    assert (np.diff([energy(u) for u in solution.us]) < 1e-8).all()
    assert float(solution.u_end.max()) > 0.7
    assert float(solution.u_end.min()) < -0.7


def test_cahn_hilliard_harmonics_grow_at_the_linear_rate():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(4))
    width, eigenvalue = 0.25, 6.0
    mode = 3 * surface.vertices[:, 2] ** 2 - 1
    u = ltl.solve(ltl.CahnHilliard(width), surface, 1e-5 * mode, 0.2, rtol=1e-8, atol=1e-12).u_end
    rate = float(jnp.log(jnp.vdot(u, mode) / jnp.vdot(1e-5 * mode, mode)) / 0.2)
    assert rate == pytest.approx(eigenvalue * (1 - width**2 * eigenvalue), rel=0.03)


def test_an_amount_is_conserved_on_a_growing_surface(sphere):
    growth = 0.4
    equation = ltl.Moving(ltl.ReactionDiffusion((0.1,), no_reaction(1)), lambda t, x: jnp.exp(growth * t) * x)
    u0 = 1 + sphere.vertices[:, :1]
    u = ltl.solve(equation, sphere, u0, 1.0, rtol=1e-7, atol=1e-9).u_end[:, 0]
    # A harmonic of degree one is diluted by exp(-2 g t) and diffuses on a sphere of radius exp(g t).
    decay = np.exp(-0.1 * 2 * (1 - np.exp(-2 * growth)) / (2 * growth))
    expected = np.exp(-2 * growth) * (1 + sphere.vertices[:, 0] * decay)
    assert jnp.linalg.norm(u - expected) < 2e-3 * jnp.linalg.norm(expected)
    moved = equation.surface_at(jnp.array(1.0), sphere)
    assert ltl.integrate(moved, u) == pytest.approx(float(ltl.integrate(sphere, u0[:, 0])), rel=1e-3)


@pytest.mark.slow
def test_reacting_species_are_diluted_on_a_growing_surface(sphere):
    """Uniform species follow u' = f(u) - 2 g u, because the area of the sphere grows at the rate 2 g."""
    growth, kinetics = 0.3, ltl.kinetics.schnakenberg(rate=1.0)
    equation = ltl.Moving(ltl.ReactionDiffusion((0.05, 0.1), kinetics), lambda t, x: jnp.exp(growth * t) * x)
    u0 = np.array([1.2, 0.7])
    u = ltl.solve(equation, sphere, np.tile(u0, (sphere.num_vertices, 1)), 1.0, rtol=1e-5, atol=1e-7).u_end

    def rate(t, u):
        return np.asarray(kinetics(jnp.asarray(u)[None])[0]) - 2 * growth * u

    expected = scipy.integrate.solve_ivp(rate, (0, 1.0), u0, rtol=1e-9, atol=1e-11).y[:, -1]
    np.testing.assert_allclose(u, np.tile(expected, (sphere.num_vertices, 1)), rtol=1e-3)


def evolving_ellipsoid(level):
    """The problem of Dziuk and Elliott (2007): relative error at t = 1 of u = exp(-6 t) x y."""
    # The neighbours are chosen on the sphere, the mean shape of the motion.
    start = ltl.Surface.from_mesh(ltl.shapes.icosphere(level))

    def squeezed(t, x):
        return x * jnp.stack([jnp.sqrt(1 + jnp.sin(t) / 4), jnp.ones_like(t), jnp.ones_like(t)])[None]

    def exact(t, x):
        return jnp.exp(-6 * t) * x[..., 0] * x[..., 1]

    def source(t, vertices):
        """u_t + u div v - Delta u for the exact solution, by derivatives of its extension and of the level set."""
        a = 1 + jnp.sin(t) / 4
        rate = jnp.cos(t) / 4

        def at_point(x):
            normal_of = lambda x: _unit(jnp.array([x[0] / a, x[1], x[2]]))  # noqa: E731
            n = normal_of(x)
            curvature = jnp.trace(jax.jacfwd(normal_of)(x))
            velocity = lambda x: jnp.array([x[0] * rate / (2 * a), 0.0, 0.0])  # noqa: E731
            steep, bent = jax.grad(exact, 1)(t, x), jax.hessian(exact, 1)(t, x)
            laplacian = jnp.trace(bent) - n @ bent @ n - curvature * (n @ steep)
            strain = jax.jacfwd(velocity)(x)
            divergence = jnp.trace(strain) - n @ strain @ n
            material = jax.grad(exact, 0)(t, x) + velocity(x) @ steep
            return material + exact(t, x) * divergence - laplacian

        return jax.vmap(at_point)(vertices)

    equation = ltl.Moving(ltl.Diffusion(source=source), squeezed)
    u = ltl.solve(equation, start, exact(jnp.array(0.0), start.vertices), 1.0, rtol=1e-7, atol=1e-9).u_end
    expected = exact(1.0, equation.surface_at(jnp.array(1.0), start).vertices)
    return float(jnp.linalg.norm(u - expected) / jnp.linalg.norm(expected))


def _unit(x):
    return x / jnp.linalg.norm(x)


@pytest.mark.slow
def test_the_evolving_ellipsoid_is_solved_to_second_order():
    errors = [evolving_ellipsoid(level) for level in (2, 3)]
    assert np.log2(errors[0] / errors[1]) > 1.8
    assert errors[1] < 0.04


@pytest.mark.parametrize("width", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_wall_of_zero_conductivity_separates_its_sides(width):
    mesh = ltl.shapes.icosphere(3)
    surface = ltl.Surface.from_mesh(mesh)
    height = mesh.vertices[:, 2]
    below = height < 0
    wall = np.zeros(mesh.num_vertices, bool)
    for _ in range(width):
        behind = below | wall
        is_rim = behind[mesh.edges[:, 0]] != behind[mesh.edges[:, 1]]
        wall[mesh.edges[is_rim].ravel()[~behind[mesh.edges[is_rim].ravel()]]] = True
    equation = ltl.ReactionDiffusion((jnp.where(wall, 0.0, 1.0),), lambda species, _: (0 * species[0],))
    # The values inside the wall have no effect outside it.
    u0 = jnp.where(wall, 99.0, jnp.where(below, 1.0, 0.0))[:, None]
    end = ltl.solve(equation, surface, u0, 0.3, solver=ltl.TRBDF2()).u_end[:, 0]
    np.testing.assert_allclose(end[below], 1, atol=1e-6)
    np.testing.assert_allclose(end[~below & ~wall], 0, atol=1e-6)
    np.testing.assert_allclose(end[wall], 99, rtol=1e-6)


def test_arithmetic_and_harmonic_means_of_a_smooth_conductivity_are_second_order():
    errors = {"arithmetic": [], "harmonic": []}
    for level in (3, 4):
        surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(level))
        x, _, z = surface.vertices.T
        # g = 2 + z, u = x: div(g grad u) = g Delta x + grad z . grad x, and the latter is -x z on the unit sphere.
        exact = -2 * (2 + z) * x - x * z
        for mean, by_level in errors.items():
            rate = ltl.weighted_laplacian(surface, 2 + z, x, mean)
            by_level.append(float(jnp.sqrt(jnp.mean((rate - exact) ** 2))))
    for coarse, fine in errors.values():
        assert fine < 0.4 * coarse
        assert fine < 0.02


@pytest.mark.parametrize(
    "function", [ltl.laplacian, ltl.gradient, ltl.hessian, ltl.integrate, ltl.poisson, ltl.vectors.rotated_gradient]
)
def test_operators_reject_masked_fields(function):
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1))
    with pytest.raises(ValueError, match="whose mask would be lost"):
        function(surface, np.ma.masked_greater(np.arange(42.0), 9))
