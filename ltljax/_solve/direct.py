"""Linear systems by a factor of their matrix: where many right sides meet one small or medium system.

What enters: a surface, screening and conditions. What leaves: a `Preconditioner` that is the inverse itself, made by
SciPy's SuperLU on the host and asked through a callback.
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
from .evolve import what_is_fixed
from .krylov import Preconditioner

# How many a surface keeps.
_KEPT = 4


class Factorized(Preconditioner):
    """The inverse of ``screening - Delta`` under conditions, as what `factorized` returned.

    Attributes:
        number: by which the host knows the factor, which lives as long as this array.
        smallest: the eigenvalue that constants are moved to where nothing fixes them.
        num_vertices: of the surface.
    """

    number: Int[Array, ""]
    smallest: Float[Array, ""]
    num_vertices: int = eqx.field(static=True)

    def __call__(self, r, transposed):
        """What solves the system, or the transposed one, for r."""

        def on_host(number: Any, r: Any) -> np.ndarray:
            lu = value_of(int(np.ravel(number)[0]))
            if lu is None:
                raise RuntimeError(
                    "The factor is gone: keep what ltl.solvers.factorized returned as long as it is used."
                )
            # Of a batch the leading axes; columns go to SuperLU together.
            r = np.asarray(r)
            columns = np.moveaxis(r.reshape(-1, self.num_vertices, r.shape[-1]), 1, 0).reshape(self.num_vertices, -1)
            padded = np.zeros((lu.shape[0], columns.shape[1]))
            padded[: self.num_vertices] = columns
            x = lu.solve(padded, "T" if transposed else "N")[: self.num_vertices]
            x = np.moveaxis(x.reshape(self.num_vertices, -1, r.shape[-1]), 0, 1)
            return x.reshape(r.shape).astype(r.dtype)

        columns = r.reshape(self.num_vertices, -1)
        like = jax.ShapeDtypeStruct(columns.shape, columns.dtype)
        return jax.pure_callback(on_host, like, self.number, columns, vmap_method="expand_dims").reshape(r.shape)


@on_surface
def factorized(
    surface: Surface, screening: AnyArray | float = 0.0, boundary: bounds.Conditions | None = None
) -> Factorized:
    """A factor of the matrix of `poisson` (or `screened_poisson`), to be handed to it as ``preconditioner`` (host).

    The iteration then ends with its first step, whatever the scheme, and derivatives and `jax.vmap` go through it; a
    system that differs (another screening, moved vertices) is still solved to the tolerance, in more steps. On small
    and medium surfaces on CPU `poisson` does so by itself: ``benchmarks/direct.md`` has the times. No extra is needed.

    Args:
        surface: the surface.
        screening: c of ``Delta u - c u = f``, a number or (V,); 0 for Poisson's equation.
        boundary: as of `poisson`, for one field; what Robin conditions absorb is taken at the time 0.

    Raises:
        ValueError: the surface or the conditions are being traced by a JAX transformation, the scheme is `Paper`, the
            screening is negative or does not fit the surface, or the matrix is singular.
    """
    if isinstance(surface.scheme, Paper):
        raise ValueError(
            "Expected a surface of the scheme Monotone or Polynomial, found Paper, whose Laplacian may vanish on more "
            "than constants; its systems are left to iteration."
        )
    equation = Diffusion(boundary=() if boundary is None else boundary)
    is_traced = surface.is_traced or isinstance(screening, Tracer)
    fixed = None if is_traced else what_is_fixed(equation, surface, jnp.zeros(surface.num_vertices, surface.dtype), 0.0)
    if fixed is None:
        raise ValueError(
            "The matrix is factorised on the host, but the surface, the screening or the conditions are being traced "
            "by a JAX transformation. Call ltl.solvers.factorized outside and hand in what it returns; the factor of a similar "
            "system does as well."
        )
    lost = np.asarray(screening, np.float64)
    if lost.shape not in ((), (surface.num_vertices,)) or not (lost >= 0).all():
        raise ValueError(
            f"Expected a screening that is nowhere negative, a number or of shape ({surface.num_vertices},), found "
            f"shape {lost.shape} and the least value {lost.min()}."
        )
    try:
        return factor(surface, lost + fixed[0], fixed[1])
    except RuntimeError as error:
        raise ValueError(
            "Expected a system with one solution (up to constants), found a singular matrix. Look at the conditions "
            f"and at surface.report. SuperLU says: {error}."
        ) from None


def factor(surface: Surface, lost: np.ndarray, is_held: np.ndarray) -> Factorized:
    """The inverse of ``lost - Delta`` where nothing is held (host); a surface keeps the last few.

    Raises:
        RuntimeError: the matrix is singular.
    """
    kept: dict[Any, Factorized] = surface.remembered("factors", dict)
    key = hash((lost.tobytes(), is_held.tobytes()))
    if key not in kept:
        with jax.ensure_compile_time_eval():  # inside jit too, of a surface that is not traced
            found = _factorize(surface, lost, is_held)
        while len(kept) >= _KEPT:
            del kept[next(iter(kept))]
        kept[key] = found
    return kept[key]


def _factorize(surface: Surface, lost: np.ndarray, is_held: np.ndarray) -> Factorized:
    if not np.isfinite(lost).all():
        raise RuntimeError("what is absorbed is not finite")
    free = scipy.sparse.diags_array((~is_held).astype(np.float64))
    matrix = free @ (scipy.sparse.diags_array(lost) - laplacian_matrix(surface).astype(np.float64)) @ free
    matrix = matrix + scipy.sparse.diags_array(is_held.astype(np.float64))
    components, areas = np.asarray(surface.topology.components), np.asarray(surface.vertex_areas, np.float64)
    number, size = surface.topology.num_components, surface.num_vertices
    fixes = np.zeros(number)
    np.maximum.at(fixes, components, np.where(is_held, 1.0, np.abs(lost)))
    # The smallest eigenvalue of a sphere of this area, relative to which it is arbitrary.
    smallest = 8 * np.pi / float(areas.sum())
    # A component that nothing fixes gets an unknown of its own, smallest times its mean, which its vertices add.
    singular = np.flatnonzero(fixes <= 0)
    if len(singular):
        belongs = scipy.sparse.csc_array((np.ones(size), (np.arange(size), components)), (size, number))[:, singular]
        totals = np.bincount(components, areas, number)[singular]
        means = smallest * scipy.sparse.diags_array(1 / totals) @ (belongs.T @ scipy.sparse.diags_array(areas))
        own = scipy.sparse.eye_array(len(singular))
        matrix = scipy.sparse.block_array([[matrix, belongs], [means, -own]])
    lu = scipy.sparse.linalg.splu(scipy.sparse.csc_array(matrix), permc_spec="MMD_AT_PLUS_A")
    # Compiled programs know the factor by a number, so that one program serves all factors of a size.
    handle = new_handle(lu)
    number_on_device = jnp.asarray(handle, jnp.int32)
    release_with(handle, number_on_device)
    return Factorized(number_on_device, jnp.asarray(smallest, surface.dtype), size)
