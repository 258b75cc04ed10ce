"""The error for an argument of the wrong type says what was expected."""

import inspect

import jax.numpy as jnp
import pytest

import ltljax as ltl

pytestmark = pytest.mark.usefixtures("as_users_call_it")
MESH = ltl.shapes.icosphere(2)


@pytest.fixture(scope="module")
def surface():
    return ltl.Surface.from_mesh(MESH)


def functions_of_a_surface():
    for module in (ltl, ltl.imaging):
        for name in module.__all__:
            function = getattr(module, name)
            # plot and view accept a mesh too.
            if inspect.isroutine(function) and name not in ("plot", "view"):
                parameters = list(inspect.signature(function).parameters.values())
                if any(parameter.name == "surface" for parameter in parameters):
                    yield pytest.param(function, parameters, id=name)


@pytest.mark.parametrize(("function", "parameters"), list(functions_of_a_surface()))
def test_the_error_for_a_mesh_in_place_of_a_surface_shows_how_to_build_a_surface(function, parameters):
    required = [p for p in parameters if p.default is p.empty and p.kind is not p.VAR_KEYWORD]
    arguments = {p.name: MESH if p.name == "surface" else jnp.zeros(MESH.num_vertices) for p in required}
    with pytest.raises(TypeError, match=r"expected a Surface as surface, found a Mesh\. Build one: ltl\.Surface"):
        function(**arguments)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(equation="heat"), r"Expected an equation such as ltl\.Diffusion\(\), found 'heat'"),
        (dict(solver="euler"), r"Expected solver as an instance such as ltl\.RKL2\(\), found 'euler'"),
        (dict(solver=ltl.RKL2), r"Expected solver as an instance .* found the class RKL2"),
        (dict(adjoint="reverse"), "Expected adjoint as an instance"),
        (dict(t1=(0, 1)), r"Expected t1 as one number, found an array of shape \(2,\)"),
        (dict(t1="1"), "Expected t1 as real numbers, found type <U1"),
        (dict(t1=None), "Expected t1 as real numbers, found None"),
        (dict(dt=(0.1,)), r"Expected dt as one number"),
        (dict(rtol="fine"), "Expected rtol as real numbers"),
        (dict(max_steps=-1), "max_steps must be at least 1, found -1"),
        (dict(max_steps=1.5), "max_steps must be an integer, found 1.5"),
        (dict(stop_when=5), r"Expected stop_when as a function \(t, u, rate\) -> bool, found 5"),
        (dict(u0=lambda x: x), "Expected u0 as real numbers, found a function"),
        (dict(u0={"u": 1.0}), "Expected u0 as real numbers, found a dict"),
        (dict(u0=None), "Expected u0 as real numbers, found None"),
    ],
)
def test_errors_of_solve_say_what_was_expected(surface, change, message):
    arguments = dict(equation=ltl.Diffusion(), surface=surface, u0=surface.vertices[:, 0], t1=0.1)
    with pytest.raises((TypeError, ValueError), match=message):
        ltl.solve(**(arguments | change))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: ltl.laplacian(s, [0.0] * s.num_vertices), "laplacian expected an array as u, found a list"),
        (lambda s: ltl.gradient(s, lambda x: x), "gradient expected an array as u, found a function"),
        (lambda s: ltl.laplacian(s, None), "laplacian expected an array as u, found None"),
        (lambda s: ltl.laplacian(s, "x"), "laplacian expected an array as u, found a str"),
        (lambda s: ltl.laplacian(None, s.vertices), "laplacian expected a Surface as surface, found None"),
        (lambda s: ltl.poisson(None, s.vertices[:, 0]), "poisson expected a Surface as surface, found None"),
        (lambda s: ltl.poisson(s, lambda x: x), "as real numbers, found a function"),
        (lambda s: ltl.eigenmodes(s, 3.5), "Expected a whole number of modes, found 3.5"),
        (lambda s: ltl.geodesic_distance(s, 0.5), "Expected the indices of source vertices"),
        (lambda s: ltl.load_mesh(MESH), "Expected the path of a file, found a Mesh. It needs no loading"),
        (lambda s: ltl.load_mesh(None), "Expected the path of a file, found a NoneType"),
    ],
)
def test_errors_of_other_functions_say_what_was_expected(surface, call, message):
    with pytest.raises((TypeError, ValueError), match=message):
        call(surface)


def test_the_error_for_a_boundary_function_of_a_single_argument_shows_its_signature():
    disk = ltl.Surface.from_mesh(ltl.shapes.disk(rings=4))
    equation = ltl.Diffusion(1.0, boundary=ltl.Dirichlet(lambda t: 1.0))
    with pytest.raises(TypeError, match=r"a function \(t, vertices\) -> array, found a function \(t\)"):
        ltl.solve(equation, disk, disk.vertices[:, 0], 0.1)
