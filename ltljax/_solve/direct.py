"""Linear systems by a sparse factorisation, for many right-hand sides of one small or medium system.

What enters: a surface, a screening and boundary conditions. What leaves: a `Preconditioner` that is the exact inverse.
SciPy's SuperLU factorises the matrix on the host, and compiled programs reach the factors through a callback.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from .._base.cache import new_handle, release_with, value_of
from .._equations import Diffusion, boundary as bounds
from .._lifting.schemes import Paper
from .._operators import laplacian_matrix
from .._surface import Surface, on_surface
from .._tables import AnyArray
from .krylov import Preconditioner
from .preconditioning import fixed_by_conditions

# Number of factors that a surface keeps.
_CACHED = 4


class Factorized(Preconditioner):
    """The inverse of ``screening - Delta`` under boundary conditions, made by `factorized`.

    Attributes:
        number: number by which the host finds the factors, which live as long as this array.
        smallest: eigenvalue to which constants are moved where nothing fixes them.
        num_vertices: number of vertices of the surface.
    """

    number: Int[Array, ""]
    smallest: Float[Array, ""]
    num_vertices: int = eqx.field(static=True)

    def null_shift(self):
        """The eigenvalue to which constants are moved where nothing fixes them."""
        return self.smallest

    def __call__(self, r, transposed):
        """The solution of the system, or of the transposed one, for the right-hand side r."""

        def solve_on_host(number: Any, r: Any) -> np.ndarray:
            lu = value_of(int(np.ravel(number)[0]))
            if lu is None:
                raise RuntimeError(
                    "The factors no longer exist. Keep the result of ltl.solvers.factorized for as long as it is used."
                )
            # Under vmap r has leading batch axes. SuperLU solves all columns of the batch in one call.
            r = np.asarray(r)
            columns = np.moveaxis(r.reshape(-1, self.num_vertices, r.shape[-1]), 1, 0).reshape(self.num_vertices, -1)
            padded = np.zeros((lu.shape[0], columns.shape[1]))
            padded[: self.num_vertices] = columns
            x = lu.solve(padded, "T" if transposed else "N")[: self.num_vertices]
            x = np.moveaxis(x.reshape(self.num_vertices, -1, r.shape[-1]), 0, 1)
            return x.reshape(r.shape).astype(r.dtype)

        columns = r.reshape(self.num_vertices, -1)
        like = jax.ShapeDtypeStruct(columns.shape, columns.dtype)
        solution = jax.pure_callback(solve_on_host, like, self.number, columns, vmap_method="expand_dims")
        return solution.reshape(r.shape)


@on_surface
def factorized(
    surface: Surface, screening: AnyArray | float = 0.0, boundary: bounds.Conditions | None = None
) -> Factorized:
    """The factorised matrix of `poisson` or `screened_poisson`, to be handed to it as ``preconditioner`` (host).

    The iteration then ends with its first step, whatever the scheme, and derivatives and `jax.vmap` go through it. A
    different system (another screening, moved vertices) is still solved to the tolerance, in more steps. On small and
    medium surfaces on CPU `poisson` factorises the matrix by itself: ``benchmarks/direct.md`` has the times. No extra
    is needed.

    Args:
        surface: surface of the scheme `Monotone` or `Polynomial`.
        screening: c of ``Delta u - c u = f``, a number or (V,); 0 for Poisson's equation.
        boundary: boundary conditions of one field, as for `poisson`. Robin conditions absorb as they do at time 0.

    Raises:
        ValueError: the surface or the conditions are being traced by a JAX transformation, the scheme is `Paper`, the
            screening is negative or does not fit the surface, or the matrix is singular.
    """
    if isinstance(surface.scheme, Paper):
        raise ValueError(
            "Expected a surface of the scheme Monotone or Polynomial, found Paper, whose Laplacian may vanish on more "
            "than constants. Its systems can be solved by iteration only."
        )
    equation = Diffusion(boundary=() if boundary is None else boundary)
    is_traced = surface.is_traced or isinstance(screening, Tracer)
    fixed = (
        None
        if is_traced
        else fixed_by_conditions(equation, surface, jnp.zeros(surface.num_vertices, surface.dtype), 0.0)
    )
    if fixed is None:
        raise ValueError(
            "The matrix is factorised on the host, but the surface, the screening or the conditions are being traced "
            "by a JAX transformation. Call ltl.solvers.factorized outside and hand in its result; the factors of a "
            "similar system work too."
        )
    absorption, is_held = fixed
    screening = np.asarray(screening, np.float64)
    if screening.shape not in ((), (surface.num_vertices,)) or not (screening >= 0).all():
        raise ValueError(
            f"Expected a screening that is nowhere negative, a number or of shape ({surface.num_vertices},), found "
            f"shape {screening.shape} and the least value {screening.min()}."
        )
    try:
        return factor(surface, screening + absorption, is_held)
    except RuntimeError as error:
        raise ValueError(
            "Expected a system with one solution (up to constants), found a singular matrix. Check the boundary "
            f"conditions and surface.report. SuperLU says: {error}."
        ) from None


def factor(surface: Surface, absorption: np.ndarray, is_held: np.ndarray) -> Factorized:
    """The inverse of ``absorption - Delta`` at the vertices that are not held (host).

    A surface keeps its last few factors.

    Raises:
        RuntimeError: the matrix is singular.
    """
    cache: dict[Any, Factorized] = surface.remembered("factors", dict)
    key = hash((absorption.tobytes(), is_held.tobytes()))
    if key not in cache:
        with jax.ensure_compile_time_eval():  # A surface that is not traced can be factorised inside jit as well.
            inverse = _factorize(surface, absorption, is_held)
        while len(cache) >= _CACHED:
            del cache[next(iter(cache))]
        cache[key] = inverse
    return cache[key]


def _factorize(surface: Surface, absorption: np.ndarray, is_held: np.ndarray) -> Factorized:
    if not np.isfinite(absorption).all():
        raise RuntimeError("the absorption is not finite")
    free = scipy.sparse.diags_array((~is_held).astype(np.float64))
    matrix = free @ (scipy.sparse.diags_array(absorption) - laplacian_matrix(surface).astype(np.float64)) @ free
    matrix = matrix + scipy.sparse.diags_array(is_held.astype(np.float64))
    # The order of magnitude of the smallest eigenvalue: exact on a sphere of this area, and arbitrary in principle.
    smallest = 8 * np.pi / float(np.asarray(surface.vertex_areas, np.float64).sum())
    matrix = _with_fixed_means(surface, matrix, np.where(is_held, 1.0, np.abs(absorption)), smallest)
    lu = scipy.sparse.linalg.splu(scipy.sparse.csc_array(matrix), permc_spec="MMD_AT_PLUS_A")
    # Compiled programs know the factors by a number, so that one program serves all factors of a size.
    handle = new_handle(lu)
    number_on_device = jnp.asarray(handle, jnp.int32)
    release_with(handle, number_on_device)
    return Factorized(number_on_device, jnp.asarray(smallest, surface.dtype), surface.num_vertices)


def _with_fixed_means(surface: Surface, matrix: Any, fixed_by: np.ndarray, smallest: float) -> Any:
    """The matrix, extended so that it is regular on every connected component.

    A component on which ``fixed_by`` vanishes gets an unknown of its own. It equals ``smallest`` times the component's
    mean, and every vertex of the component adds it, which moves the eigenvalue of constants from zero to ``smallest``.
    """
    components, areas = np.asarray(surface.topology.components), np.asarray(surface.vertex_areas, np.float64)
    num_components, size = surface.topology.num_components, surface.num_vertices
    strongest = np.zeros(num_components)
    np.maximum.at(strongest, components, fixed_by)
    singular = np.flatnonzero(strongest <= 0)
    if len(singular) == 0:
        return matrix
    ones = (np.ones(size), (np.arange(size), components))
    is_member = scipy.sparse.csc_array(ones, (size, num_components))[:, singular]
    totals = np.bincount(components, areas, num_components)[singular]
    means = smallest * scipy.sparse.diags_array(1 / totals) @ (is_member.T @ scipy.sparse.diags_array(areas))
    return scipy.sparse.block_array([[matrix, is_member], [means, -scipy.sparse.eye_array(len(singular))]])
