"""Variable diffusion: fields, stencils, one diffusivity per species, and conditions for some species only."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ltljax as ltl

# The exact solutions below are polynomials on the unit square.
SQUARE = ltl.shapes.jittered(ltl.shapes.square(n=24), 0.3, seed=0)
SURFACE = ltl.Surface.from_mesh(SQUARE, dtype=jnp.float64)
X, Y, _ = SURFACE.vertices.T
NOW = jnp.zeros(())
INSIDE = ~np.asarray(SQUARE.boundary_vertices)


def conductivity():
    return 1 + X + 0.5 * Y


def spreads(kind):
    """div(g grad u) with g = 1 + x + y / 2 in three forms."""
    g = conductivity()
    if kind == "field":
        return g
    if kind == "stencil":
        return ltl.operators.elliptic_stencil(SURFACE, g, divergence_form=True)
    return ltl.operators.elliptic_stencil(SURFACE, g[:, None, None] * jnp.eye(3)[None], divergence_form=True)


def quadratic():
    """A field u, div(g grad u), and grad u."""
    u = X**2 + X * Y + 2 * Y
    gradient = jnp.stack([2 * X + Y, X + 2, 0 * X], axis=1)
    return u, gradient[:, 0] + 0.5 * gradient[:, 1] + 2 * conductivity(), gradient


@pytest.mark.parametrize(
    ("kind", "condition"), [("field", "neumann"), ("field", "robin"), ("stencil", "robin"), ("tensor", "neumann")]
)
def test_boundary_fluxes_are_accurate_for_variable_diffusion(kind, condition):
    u, exact, gradient = quadratic()
    boundary = ltl.Neumann(gradient)
    if condition == "robin":
        # Corners, which have two normal derivatives, are excluded below.
        is_across = jnp.abs(X - 0.5) > jnp.abs(Y - 0.5)
        normal = jnp.where(is_across, jnp.sign(X - 0.5) * gradient[:, 0], jnp.sign(Y - 0.5) * gradient[:, 1])
        boundary = ltl.Robin(2.0, 3.0, 2 * u + 3 * normal)
    is_corner = (jnp.abs(X - 0.5) > 0.49) & (jnp.abs(Y - 0.5) > 0.49)
    spread = spreads(kind)
    error, without = (
        jnp.max(jnp.where(is_corner, 0, jnp.abs(ltl.Diffusion(spread, boundary=b).rate(NOW, SURFACE, u) - exact)))
        for b in (boundary, ())
    )
    # Stencils are exact for polynomials; the mean of two conductivities is second order.
    assert error < (0.1 if kind == "field" else 1e-9)
    assert without > 100


@pytest.mark.parametrize("kind", ["field", "tensor", pytest.param("stencil", marks=pytest.mark.slow)])
def test_the_spectral_bound_holds_for_variable_diffusion(kind):
    equation = ltl.Diffusion(spreads(kind), boundary=ltl.Robin(5.0, 1.0, 0.0))
    zero = jnp.zeros(SURFACE.num_vertices)
    matrix = jax.jacfwd(lambda u: equation.rate(NOW, SURFACE, u))(zero)
    values = np.linalg.eigvals(np.asarray(matrix))
    assert values.real.max() < 0
    assert np.abs(values).max() <= float(equation.spectral_bound(NOW, SURFACE, zero))


def test_a_constant_field_diffuses_like_the_number():
    u = jnp.sin(3 * X) * Y
    boundary = ltl.Robin(1.0, 2.0, 0.5)
    rates = [ltl.Diffusion(d, boundary=boundary).rate(NOW, SURFACE, u) for d in (0.3, jnp.full(u.shape, 0.3))]
    np.testing.assert_allclose(rates[1], rates[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "equation", [ltl.Diffusion, lambda d, **more: ltl.ReactionDiffusion(d, lambda s, _: (0 * s[0],) * 3, **more)]
)
def test_every_species_can_have_its_own_form_of_diffusivity(equation):
    stencil = ltl.operators.elliptic_stencil(SURFACE, conductivity())
    u = jnp.stack([jnp.sin(X), jnp.cos(Y), X * Y], axis=1)
    boundary = ltl.Neumann(1.5)
    rate = equation((0.5, conductivity(), stencil), boundary=boundary).rate(NOW, SURFACE, u)
    alone = [
        ltl.Diffusion(d, boundary=boundary).rate(NOW, SURFACE, u[:, i])
        for i, d in enumerate((0.5, conductivity(), stencil))
    ]
    np.testing.assert_allclose(rate, jnp.stack(alone, axis=1), rtol=1e-12, atol=1e-9)


def test_a_condition_for_one_species_does_not_affect_the_rates_of_the_others():
    both = jnp.stack([jnp.sin(X), jnp.cos(Y)], axis=1)
    rate = ltl.Diffusion((1.0, 0.5), boundary=ltl.Dirichlet(2.0, species=1)).rate(NOW, SURFACE, both)
    free = ltl.Diffusion(1.0).rate(NOW, SURFACE, both[:, 0])
    fixed = ltl.Diffusion(0.5, boundary=ltl.Dirichlet(2.0)).rate(NOW, SURFACE, both[:, 1])
    np.testing.assert_allclose(rate, jnp.stack([free, fixed], axis=1), atol=1e-9)


@pytest.mark.slow
def test_a_condition_for_one_species_does_not_affect_the_others():
    both = jnp.stack([jnp.sin(X), jnp.cos(Y)], axis=1)
    held = ltl.Dirichlet(2.0, species=1)
    together = ltl.solve(ltl.Diffusion((1.0, 0.5), boundary=held), SURFACE, both, 0.05, rtol=1e-8).u_end
    free = ltl.solve(ltl.Diffusion(1.0), SURFACE, both[:, 0], 0.05, rtol=1e-8).u_end
    fixed = ltl.solve(ltl.Diffusion(0.5, boundary=ltl.Dirichlet(2.0)), SURFACE, both[:, 1], 0.05, rtol=1e-8).u_end
    np.testing.assert_allclose(together, jnp.stack([free, fixed], axis=1), atol=1e-6)


def test_a_flux_for_one_species_does_not_affect_the_others():
    both = jnp.stack([jnp.sin(X), jnp.cos(Y)], axis=1)
    boundary = (ltl.Neumann(3.0, species=(0,)), ltl.Robin(1.0, 1.0, 2.0, species=1))
    rate = ltl.Diffusion(1.0, boundary=boundary).rate(NOW, SURFACE, both)
    alone = [
        ltl.Diffusion(1.0, boundary=b).rate(NOW, SURFACE, both[:, i])
        for i, b in enumerate((ltl.Neumann(3.0), ltl.Robin(1.0, 1.0, 2.0)))
    ]
    np.testing.assert_allclose(rate, jnp.stack(alone, axis=1), atol=1e-9)


def test_the_steady_state_across_a_jump_of_the_conductivity():
    # The flux g u' is the same in both conductors.
    mesh = ltl.shapes.square(n=40)
    surface = ltl.Surface.from_mesh(mesh, dtype=jnp.float64)
    x = surface.vertices[:, 0]
    ends = tuple(ltl.Dirichlet(1.0 - at, where=jnp.abs(x - at) < 1e-9) for at in (0, 1))
    equation = ltl.Diffusion(jnp.where(x < 0.5 + 1e-9, 4.0, 1.0), boundary=ends)
    u = ltl.steady_state(equation, surface, 1 - x)
    # The jump lies half an edge to the right of the middle, between two rows of vertices.
    jump = 0.5 + 1 / 80
    resistance = jump / 4 + (1 - jump)
    exact = 1 - jnp.where(x < jump, x / 4, jump / 4 + (x - jump)) / resistance
    np.testing.assert_allclose(u, exact, atol=1e-6)


def test_the_divergence_form_of_a_rotating_tensor_converges():
    # A = R diag(2, 1/2) R^T with the angle x + y; automatic differentiation gives the exact div(A grad u).
    def flux(p):
        turn = jnp.asarray([[jnp.cos(p.sum()), -jnp.sin(p.sum())], [jnp.sin(p.sum()), jnp.cos(p.sum())]])
        return turn @ jnp.diag(jnp.asarray([2.0, 0.5])) @ turn.T

    def u(p):
        return jnp.sin(2 * p[0]) * p[1]

    def exact(p):
        return jnp.trace(jax.jacfwd(lambda q: flux(q) @ jax.grad(u)(q))(p))

    errors = []
    for n in (12, 24):
        mesh = ltl.shapes.jittered(ltl.shapes.square(n=n), 0.2, seed=0)
        surface = ltl.Surface.from_mesh(mesh, dtype=jnp.float64)
        points = surface.vertices[:, :2]
        tensor = jnp.zeros((len(points), 3, 3)).at[:, :2, :2].set(jax.vmap(flux)(points))
        stencil = ltl.operators.elliptic_stencil(surface, tensor, divergence_form=True)
        inside = ~np.asarray(mesh.boundary_vertices)
        errors.append(float(jnp.max(jnp.abs(stencil(jax.vmap(u)(points)) - jax.vmap(exact)(points))[inside])))
        rebuilt = stencil.with_coefficients(surface, tensor, divergence_form=True)
        np.testing.assert_allclose(rebuilt(points), stencil(points), atol=1e-8)
    assert errors[1] < 0.65 * errors[0]


def test_diffusivities_and_conditions_that_do_not_fit_are_rejected():
    two = jnp.zeros((SURFACE.num_vertices, 2))
    with pytest.raises(ValueError, match="one diffusivity for each of 2 species, found 3"):
        ltl.solve(ltl.Diffusion((1.0, conductivity(), 2.0)), SURFACE, two, 0.1)
    with pytest.raises(ValueError, match=r"found shape \(3,\)"):
        ltl.solve(ltl.Diffusion((1.0, 2.0, 3.0)), SURFACE, two, 0.1)
    with pytest.raises(ValueError, match="species from 0 to 1, found 2"):
        ltl.solve(ltl.Diffusion(boundary=ltl.Dirichlet(0.0, species=2)), SURFACE, two, 0.1)
    with pytest.raises(ValueError, match="needs a state of several species"):
        ltl.solve(ltl.Diffusion(boundary=ltl.Dirichlet(0.0, species=0)), SURFACE, two[:, 0], 0.1)
    with pytest.raises(ValueError, match="Solve each of them with a call of its own"):
        ltl.poisson(SURFACE, two, ltl.Dirichlet(0.0, species=0))


def test_the_steady_state_of_a_variable_diffusivity_is_accurate_and_differentiable():
    surface = ltl.Surface.from_mesh(ltl.shapes.square(n=16))
    x = surface.vertices[:, 0]
    ends = ltl.Dirichlet(lambda t, x: x[:, 0], where=lambda x: (x[:, 0] < 1e-9) | (x[:, 0] > 1 - 1e-9))

    def state(scale):
        equation = ltl.Diffusion(jnp.exp(scale * x), boundary=ends)
        return ltl.steady_state(equation, surface, jnp.zeros_like(x))

    # (exp(s x) u')' = 0.
    exact = (1 - jnp.exp(-3 * x)) / (1 - jnp.exp(-3.0))
    np.testing.assert_allclose(state(3.0), exact, atol=2e-3)
    middle = int(jnp.argmin(jnp.linalg.norm(surface.vertices - jnp.array([[0.5, 0.5, 0]]), axis=1)))
    slope = jax.grad(lambda s: state(s)[middle])(3.0)
    assert float(slope) == pytest.approx(float(state(3.01)[middle] - state(2.99)[middle]) / 0.02, rel=1e-3)


def test_a_single_rate_may_be_a_plain_number():
    surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(1))
    u0 = jnp.ones((surface.num_vertices, 1))
    growing = ltl.ReactionDiffusion([1.0], lambda species, params: 1.0)
    np.testing.assert_allclose(ltl.solve(growing, surface, u0, 0.5).u_end, 1.5, rtol=1e-5)
