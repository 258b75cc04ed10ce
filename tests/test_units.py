"""Results scale with the units of fields and lengths."""

import warnings

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial
from hypothesis import given, settings, strategies as st

import ltljax as ltl

warnings.filterwarnings("ignore", category=ltl.errors.IncompatibleSourceWarning)

# Largest powers of ten by which fields and lengths are scaled. The squares of lengths must stay in range too.
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
UNSCALED = {}


def in_units(name, dtype, power):
    """The value of a linear function at a field scaled by 10^power, divided by 10^power."""
    unit = jnp.asarray(10.0**power, dtype)
    return np.asarray(LINEAR[name](SURFACES[dtype], unit * jnp.asarray(U, dtype)) / unit)


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


def slow_unless(is_quick, *values):
    return values if is_quick else slow(*values)


# The quick tests run each operator in one type, and the solvers in float32, whose range is smaller.
QUICK_FUNCTIONS = {
    ("gradient", "float32"), ("divergence", "float64"), ("laplacian", "float32"), ("laplacian", "float64"),
    ("hessian", "float64"), ("integral", "float32"), ("vector_laplacian", "float64"), ("poisson", "float32"),
    ("screened_poisson", "float32"), ("heat, adaptive", "float32"), ("heat, implicit", "float32"),
}  # fmt: skip
FUNCTIONS = [slow_unless((name, dtype) in QUICK_FUNCTIONS, name, dtype) for name in LINEAR for dtype in FIELDS]
QUICK_SCHEMES = (("Monotone", "float32"), ("Polynomial", "float64"), ("Paper", "float32"))
SCHEMES = [
    slow_unless((type(scheme).__name__, dtype) in QUICK_SCHEMES, scheme, dtype)
    for scheme in (ltl.Monotone(), ltl.Polynomial(), ltl.Paper())
    for dtype in FIELDS
]


@pytest.mark.parametrize(("name", "dtype"), FUNCTIONS)
@settings(max_examples=3, deadline=None)
@given(share=st.sampled_from([-1.0, 1.0]) | st.floats(-1, 1))
def test_linear_functions_scale_with_the_unit_of_a_field(name, dtype, share):
    if (name, dtype) not in UNSCALED:
        UNSCALED[name, dtype] = in_units(name, dtype, 0)
    expected, value = UNSCALED[name, dtype], in_units(name, dtype, round(share * FIELDS[dtype]))
    assert np.max(np.abs(value - expected)) <= ROUNDING[dtype] * np.max(np.abs(expected))


@pytest.mark.parametrize(("scheme", "dtype"), SCHEMES, ids=lambda value: str(value)[:8])
@settings(max_examples=2, deadline=None)
@given(share=st.sampled_from([-1.0, 1.0]) | st.floats(-1, 1))
def test_operators_scale_with_the_unit_of_length(scheme, dtype, share):
    factor = 10.0 ** round(share * LENGTHS[dtype])
    u = jnp.asarray(U, dtype)

    def results(scale):
        surface = ltl.Surface.from_mesh(MESH.scaled(scale), scheme, dtype=jnp.dtype(dtype))
        values = [ltl.laplacian(surface, u) * scale**2, ltl.gradient(surface, u) * scale]
        values += [ltl.integrate(surface, u) / scale**2, ltl.geodesic_distance(surface, 0) / scale]
        if not isinstance(scheme, ltl.Paper):
            values += [ltl.curvature(surface).mean * scale]
        return [np.asarray(x, np.float64) for x in values]

    for value, expected in zip(results(factor), results(1.0), strict=True):
        assert np.max(np.abs(value - expected)) <= 10 * ROUNDING[dtype] * np.max(np.abs(expected))


@pytest.mark.parametrize("factor", [1e18, 1e-20])
def test_lengths_whose_weights_overflow_or_underflow_are_rejected(factor):
    with pytest.raises(ValueError, match="leave the range of float32"):
        ltl.Surface.from_mesh(MESH.scaled(factor), dtype=jnp.float32)


def test_a_mesh_with_a_block_of_zero_weights_is_accepted():
    # If few rows have the same length, all their weights in a component of the Hessian can be zero.
    points = np.random.default_rng(0).random((100, 2))
    points = np.concatenate([points, [[0, 0], [1, 0], [0, 1], [1, 1]]])
    mesh = ltl.Mesh(
        np.column_stack([points, np.zeros(len(points))]), scipy.spatial.Delaunay(points).simplices, repair=True
    )
    assert ltl.Surface.from_mesh(mesh).num_vertices == 104


@pytest.mark.parametrize("size", [1e-12, 1e-9, 1.0, 1e9])
@pytest.mark.parametrize(
    "solver", [None, slow(ltl.TRBDF2()), slow(diffrax.Tsit5())], ids=["default", "TRBDF2", "Tsit5"]
)
def test_a_reaction_in_any_unit_matches_its_closed_form(size, solver):
    surface = SURFACES["float64"]
    decay = ltl.ReactionDiffusion((0.0,), lambda species, k: (-(species[0] ** 2) / k,), params=jnp.array(size))
    u0 = jnp.full((surface.num_vertices, 1), size)
    end = ltl.solve(decay, surface, u0, 50.0, solver=solver).u_end
    np.testing.assert_allclose(end, size / 51, rtol=2e-3)


@pytest.mark.parametrize("solver", [ltl.RKL2(), slow(ltl.TRBDF2())], ids=["RKL2", "TRBDF2"])
def test_the_unit_of_a_species_affects_that_species_only(solver):
    surface = SURFACES["float64"]

    def ends(unit):
        def rotation(species, unit):
            u, v = species
            return -2.0 * v / unit - u**3, 2.0 * u * unit - 0.3 * v

        equation = ltl.ReactionDiffusion((0.05, 0.02), rotation, params=jnp.array(unit))
        u0 = jnp.stack([1 + 0.2 * surface.vertices[:, 0], 0 * surface.vertices[:, 0]], axis=1)
        solution = ltl.solve(equation, surface, u0, 2.0, solver=solver)
        return solution.u_end / jnp.array([[1.0, unit]]), int(solution.counts["num_steps"])

    (expected, num_steps), (end, num_steps_scaled) = ends(1.0), ends(1e-9)
    assert num_steps_scaled <= 1.3 * num_steps
    np.testing.assert_allclose(end, expected, atol=2e-3)


def test_the_heat_equation_in_float32_takes_the_same_number_of_steps_in_any_unit():
    surface = SURFACES["float32"]
    u0 = jnp.asarray(U, jnp.float32)
    counts = [
        int(ltl.solve(ltl.Diffusion(), surface, unit * u0, 0.5).counts["num_steps"]) for unit in (1e-20, 1.0, 1e6, 1e20)
    ]
    assert max(counts) == min(counts)


@pytest.mark.parametrize("solver", [ltl.RKL2(), slow(ltl.TRBDF2())], ids=["RKL2", "TRBDF2"])
def test_a_species_that_grows_from_zero_is_accurate(solver):
    surface = SURFACES["float64"]
    growing = ltl.ReactionDiffusion((0.0, 0.0), lambda species, _: (-species[0], 1e-9 * species[0]))
    u0 = jnp.zeros((surface.num_vertices, 2)).at[:, 0].set(1.0)
    end = ltl.solve(growing, surface, u0, 1.0, solver=solver).u_end
    np.testing.assert_allclose(end[:, 1], 1e-9 * (1 - np.exp(-1)), rtol=1e-3)
