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

from ..equations import boundary as bounds
from ..lifting.schemes import Paper
from ..operators import laplacian_matrix
from ..surface import Surface
from ..tables import AnyArray
from .krylov import Preconditioner


class Factorized(Preconditioner):
    """The inverse of ``screening - Delta`` under conditions, as what `factorized` returned.

    Attributes:
        smallest: the eigenvalue that constants are moved to where nothing fixes them.
        lu: SuperLU's factor, on the host.
        num_vertices: of the surface.
    """

    smallest: float = eqx.field(static=True)
    lu: Any = eqx.field(static=True)
    num_vertices: int = eqx.field(static=True)

    def __call__(self, r, transposed):
        """What solves the system, or the transposed one, for r."""

        def on_host(r: Any) -> np.ndarray:
            # Of a batch the leading axes; columns go to SuperLU together.
            r = np.asarray(r)
            columns = np.moveaxis(r.reshape(-1, self.num_vertices, r.shape[-1]), 1, 0).reshape(self.num_vertices, -1)
            padded = np.zeros((self.lu.shape[0], columns.shape[1]))
            padded[: self.num_vertices] = columns
            x = self.lu.solve(padded, "T" if transposed else "N")[: self.num_vertices]
            x = np.moveaxis(x.reshape(self.num_vertices, -1, r.shape[-1]), 0, 1)
            return x.reshape(r.shape).astype(r.dtype)

        columns = r.reshape(self.num_vertices, -1)
        like = jax.ShapeDtypeStruct(columns.shape, columns.dtype)
        return jax.pure_callback(on_host, like, columns, vmap_method="expand_dims").reshape(r.shape)


def factorized(
    surface: Surface, screening: AnyArray | float = 0.0, boundary: bounds.Conditions | None = None
) -> Factorized:
    """A factor of the matrix of `poisson` (or `screened_poisson`), to be handed to it as ``preconditioner`` (host).

    The iteration then ends with its first step, whatever the scheme, and derivatives and `jax.vmap` go through it; a
    system that differs (another screening, moved vertices) is still solved to the tolerance, in more steps. On CPU, up
    to 50,000 vertices, `poisson` does so by itself: ``benchmarks/direct.md`` has the times. No extra is needed.

    Args:
        surface: the surface.
        screening: c of ``Delta u - c u = f``, a number or (V,); 0 for Poisson's equation.
        boundary: as of `poisson`; what Robin conditions absorb is taken at the time 0.

    Raises:
        ValueError: the surface is being traced by a JAX transformation, its scheme is `Paper`, or the screening is
            negative.
    """
    if surface.is_traced:
        raise ValueError(
            "The matrix is factorised on the host, but the surface is being traced by a JAX transformation. Call "
            "ltl.factorized(surface) outside and hand in what it returns; that of a similar surface does as well."
        )
    if isinstance(surface.scheme, Paper):
        raise ValueError(
            "Expected a surface of the scheme Monotone or Polynomial, found Paper, whose Laplacian may vanish on more "
            "than constants; its systems are left to iteration."
        )
    lost = np.broadcast_to(np.asarray(screening, np.float64), (surface.num_vertices,))
    if not (lost >= 0).all():
        raise ValueError(f"Expected a screening that is nowhere negative, found {lost.min()}.")
    conditions, u = bounds.as_tuple(boundary), jnp.zeros(surface.num_vertices, surface.dtype)
    absorption = bounds.absorption(surface, conditions, jnp.zeros((), surface.dtype), u)
    return factor(surface, lost + np.asarray(absorption), np.asarray(bounds.held_vertices(surface, conditions)))


def factor(surface: Surface, lost: np.ndarray, is_held: np.ndarray) -> Factorized:
    """The inverse of ``lost - Delta`` where nothing is held (host), factorised once and kept like `multigrid`'s."""
    key = f"factor {hash((lost.tobytes(), is_held.tobytes()))}"
    return surface.remembered(key, lambda: _factorize(surface, lost, is_held))


def _factorize(surface: Surface, lost: np.ndarray, is_held: np.ndarray) -> Factorized:
    free = scipy.sparse.diags_array((~is_held).astype(np.float64))
    matrix = free @ (scipy.sparse.diags_array(lost) - laplacian_matrix(surface).astype(np.float64)) @ free
    matrix = matrix + scipy.sparse.diags_array(is_held.astype(np.float64))
    components, areas = np.asarray(surface.topology.components), np.asarray(surface.vertex_areas, np.float64)
    number = surface.topology.num_components
    fixes = np.zeros(number)
    np.maximum.at(fixes, components, np.where(is_held, 1.0, lost))
    # The smallest eigenvalue of a sphere of this area, relative to which it is arbitrary.
    smallest = 8 * np.pi / float(areas.sum())
    # A component that nothing fixes gets an unknown of its own, smallest times its mean, which its vertices add.
    singular = np.flatnonzero(fixes <= 0)
    if len(singular):
        belongs = scipy.sparse.csr_array(components[:, None] == singular[None]).astype(np.float64)
        totals = np.bincount(components, areas, number)[singular]
        means = smallest * scipy.sparse.diags_array(1 / totals) @ (belongs.T @ scipy.sparse.diags_array(areas))
        own = scipy.sparse.eye_array(len(singular))
        matrix = scipy.sparse.block_array([[matrix, belongs], [means, -own]])
    lu = scipy.sparse.linalg.splu(scipy.sparse.csc_array(matrix), permc_spec="MMD_AT_PLUS_A")
    return Factorized(smallest, lu, surface.num_vertices)
