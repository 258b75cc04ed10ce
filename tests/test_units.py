"""A change of the unit of a field or of a length changes units, and nothing else."""

import warnings

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial
from hypothesis import given, settings, strategies as st

import ltljax as ltl

warnings.filterwarnings("ignore", category=ltl.errors.IncompatibleSourceWarning)

# Powers of ten that fields are multiplied with, and lengths, whose squares have to stay in range too.
FIELDS = {"float32": 25, "float64": 150}
LENGTHS = {"float32": 14, "float64": 40}
ROUNDING = {"float32": 3e-5, "float64": 1e-12}
MESH = ltl.shapes.jittered_torus(18, 9, 0.3, seed=0)
X = MESH.vertices

LINEAR = {
    "gradient": lambda s, u: ltl.gradient(s, u),
    "divergence": lambda s, u: ltl.divergence(s, u[:, None] * jnp.asarray(X, u.dtype)),
    "laplacian": lambda s, u: ltl.laplacian(s, u),
    "hessian": lambda s, u: ltl.hessian(s, u),
    "integral": lambda s, u: ltl.integrate(s, u),
    "vector_laplacian": lambda s, u: ltl.vector_laplacian(
        s, ltl.vectors.tangential(s, u[:, None] * jnp.asarray(X, u.dtype))
    ),
    "poisson": lambda s, u: ltl.poisson(s, u - ltl.integrate(s, u) / jnp.sum(s.vertex_areas)),
    "screened_poisson": lambda s, u: ltl.screened_poisson(s, u),
    "steady_state": lambda s, u: ltl.steady_state(
        ltl.Diffusion(source=u - ltl.integrate(s, u) / jnp.sum(s.vertex_areas)), s, 0 * u
    ),
    "heat, adaptive": lambda s, u: ltl.solve(ltl.Diffusion(), s, u, 0.5, solver=ltl.RKL2()).u_end,
    "heat, implicit": lambda s, u: ltl.solve(ltl.Diffusion(), s, u, 0.5, solver=ltl.TRBDF2()).u_end,
    "heat, split": lambda s, u: ltl.solve(ltl.Diffusion(source=u), s, u, 0.5, solver=diffrax.KenCarp3()).u_end,
    "heat, fixed steps": lambda s, u: ltl.solve(ltl.Diffusion(), s, u, 0.1, solver=ltl.RKL1(), dt=0.02).u_end,
    "heat from zero": lambda s, u: ltl.solve(ltl.Diffusion(source=u), s, 0 * u, 0.5, solver=ltl.RKL2()).u_end,
}
SURFACES = {name: ltl.Surface.from_mesh(MESH, dtype=jnp.dtype(name)) for name in FIELDS}
U = X[:, 0] + 0.3 * X[:, 2] ** 2
AT_ONE = {}


def in_units(name, dtype, power):
    """What a linear function makes of a field in units 10^power, in these units."""
    unit = jnp.asarray(10.0**power, dtype)
    return np.asarray(LINEAR[name](SURFACES[dtype], unit * jnp.asarray(U, dtype)) / unit)


@pytest.mark.parametrize("dtype", FIELDS)
@pytest.mark.parametrize("name", LINEAR)
@settings(max_examples=3, deadline=None)
@given(share=st.sampled_from([-1.0, 1.0]) | st.floats(-1, 1))
def test_the_unit_of_a_field_changes_units_only(name, dtype, share):
    if (name, dtype) not in AT_ONE:
        AT_ONE[name, dtype] = in_units(name, dtype, 0)
    exact, found = AT_ONE[name, dtype], in_units(name, dtype, round(share * FIELDS[dtype]))
    assert np.max(np.abs(found - exact)) <= ROUNDING[dtype] * np.max(np.abs(exact))


@pytest.mark.parametrize("dtype", FIELDS)
@pytest.mark.parametrize("scheme", [ltl.Monotone(), ltl.Polynomial(), ltl.Paper()], ids=lambda scheme: str(scheme)[:8])
@settings(max_examples=2, deadline=None)
@given(share=st.sampled_from([-1.0, 1.0]) | st.floats(-1, 1))
def test_the_unit_of_length_changes_units_only(scheme, dtype, share):
    factor = 10.0 ** round(share * LENGTHS[dtype])
    u = jnp.asarray(U, dtype)

    def numbers(scale):
        surface = ltl.Surface.from_mesh(MESH.scaled(scale), scheme, dtype=jnp.dtype(dtype))
        found = [ltl.laplacian(surface, u) * scale**2, ltl.gradient(surface, u) * scale]
        found += [ltl.integrate(surface, u) / scale**2, ltl.geodesic_distance(surface, 0) / scale]
        if not isinstance(scheme, ltl.Paper):
            found += [ltl.curvature(surface).mean * scale]
        return [np.asarray(x, np.float64) for x in found]

    for found, exact in zip(numbers(factor), numbers(1.0), strict=True):
        assert np.max(np.abs(found - exact)) <= 10 * ROUNDING[dtype] * np.max(np.abs(exact))


@pytest.mark.parametrize("factor", [1e18, 1e-20])
def test_lengths_whose_weights_leave_the_float_type_are_refused(factor):
    with pytest.raises(ValueError, match="leave the range of float32"):
        ltl.Surface.from_mesh(MESH.scaled(factor), dtype=jnp.float32)


def test_a_mesh_is_not_refused_because_one_block_of_its_weights_is_zero():
    # If few rows have the same length, all their weights in one component of the Hessian can be zero.
    points = np.random.default_rng(0).random((100, 2))
    points = np.concatenate([points, [[0, 0], [1, 0], [0, 1], [1, 1]]])
    mesh = ltl.Mesh(
        np.column_stack([points, np.zeros(len(points))]), scipy.spatial.Delaunay(points).simplices, repair=True
    )
    assert ltl.Surface.from_mesh(mesh).num_vertices == 104


@pytest.mark.parametrize("size", [1e-12, 1e-9, 1.0, 1e9])
@pytest.mark.parametrize("solver", [None, ltl.TRBDF2(), diffrax.Tsit5()], ids=["default", "TRBDF2", "Tsit5"])
def test_a_reaction_of_any_size_has_its_closed_form(size, solver):
    surface = SURFACES["float64"]
    decay = ltl.ReactionDiffusion((0.0,), lambda species, k: (-(species[0] ** 2) / k,), params=jnp.array(size))
    u0 = jnp.full((surface.num_vertices, 1), size)
    end = ltl.solve(decay, surface, u0, 50.0, solver=solver).u_end
    np.testing.assert_allclose(end, size / 51, rtol=2e-3)


@pytest.mark.parametrize("solver", [ltl.RKL2(), ltl.TRBDF2()], ids=["RKL2", "TRBDF2"])
def test_the_unit_of_one_species_changes_that_species_only(solver):
    surface = SURFACES["float64"]

    def ends(unit):
        def turning(species, unit):
            u, v = species
            return -2.0 * v / unit - u**3, 2.0 * u * unit - 0.3 * v

        equation = ltl.ReactionDiffusion((0.05, 0.02), turning, params=jnp.array(unit))
        u0 = jnp.stack([1 + 0.2 * surface.vertices[:, 0], 0 * surface.vertices[:, 0]], axis=1)
        found = ltl.solve(equation, surface, u0, 2.0, solver=solver)
        return found.u_end / jnp.array([[1.0, unit]]), int(found.counts["num_steps"])

    (exact, steps), (found, other_steps) = ends(1.0), ends(1e-9)
    assert other_steps <= 1.3 * steps
    np.testing.assert_allclose(found, exact, atol=2e-3)


def test_heat_in_float32_takes_as_many_steps_in_any_unit():
    surface = SURFACES["float32"]
    u0 = jnp.asarray(U, jnp.float32)
    counts = [
        int(ltl.solve(ltl.Diffusion(), surface, unit * u0, 0.5).counts["num_steps"]) for unit in (1e-20, 1.0, 1e6, 1e20)
    ]
    assert max(counts) == min(counts)


def test_a_species_that_starts_at_zero_and_grows_is_followed():
    surface = SURFACES["float64"]
    growing = ltl.ReactionDiffusion((0.0, 0.0), lambda species, _: (-species[0], 1e-9 * species[0]))
    u0 = jnp.zeros((surface.num_vertices, 2)).at[:, 0].set(1.0)
    for solver in (ltl.RKL2(), ltl.TRBDF2()):
        end = ltl.solve(growing, surface, u0, 1.0, solver=solver).u_end
        np.testing.assert_allclose(end[:, 1], 1e-9 * (1 - np.exp(-1)), rtol=1e-3)
