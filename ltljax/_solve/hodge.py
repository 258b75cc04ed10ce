"""Helmholtz and Hodge: a tangent field as a gradient, a rotation and what is neither.

What enters: a surface and a field. What leaves: its three parts, orthogonal to each other in the measure that diffusion
conserves, and the functions they come from.
"""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float

from .._equations import Dirichlet, Neumann
from .._operators import check_vectors, curl, curvature, divergence, gradient, tangential
from .._surface import Surface, on_surface
from .._tables import AnyArray
from .direct import Factorized
from .multigrid import Multigrid
from .stationary import IncompatibleSourceWarning, poisson
from .vector_heat import connection_matrix, lowest


class HodgeParts(eqx.Module):
    """A tangent field as the sum of three, which are orthogonal in the measure that diffusion conserves.

    Attributes:
        gradient: (V, 3) the gradient of the potential.
        rotation: (V, 3) the part that flows around: n x grad of the stream function, to second order.
        harmonic: (V, 3) the part with neither divergence nor curl, which flows around the handles.
        potential: (V,) its mean is zero.
        stream: (V,) the stream function, of mean zero, or zero on a boundary.
    """

    gradient: Float[Array, "V 3"]
    rotation: Float[Array, "V 3"]
    harmonic: Float[Array, "V 3"]
    potential: Float[Array, " V"]
    stream: Float[Array, " V"]


class HarmonicFields(eqx.Module):
    """The harmonic fields of a surface: what `harmonic_fields` returned.

    Attributes:
        fields: (n, V, 3) tangent, orthonormal in the measure.
        measure: (V,) the mass that diffusion conserves.
    """

    fields: Float[Array, "n V 3"]
    measure: Float[Array, " V"]


@on_surface
def harmonic_fields(surface: Surface) -> HarmonicFields:
    """The tangent fields with neither divergence nor curl: two for every handle (host). Second order.

    The lowest eigenvectors of the Hodge Laplacian, as of `hodge_laplacian`.

    Args:
        surface: a closed `Monotone` surface, or one with the topology of a disk, which has none.

    Raises:
        ValueError: the surface has a boundary and handles or several boundary loops, or is being traced.
    """
    if surface.is_traced:
        raise ValueError(
            "Harmonic fields are found on the host, but the surface is being traced by a JAX transformation. Compute "
            "them outside and hand them to ltl.vectors.helmholtz_hodge."
        )
    with jax.ensure_compile_time_eval():  # inside jit too, of a surface that is not traced
        return _harmonic(surface, _number_of_handles(surface))


def _harmonic(surface: Surface, number: int) -> HarmonicFields:
    if number == 0:
        return HarmonicFields(jnp.zeros((0, surface.num_vertices, 3), surface.dtype), surface.mass)
    gauss = np.asarray(curvature(surface).gauss, np.float64)
    matrix = scipy.sparse.csc_array(-connection_matrix(surface) + scipy.sparse.diags_array(gauss))
    vectors = lowest(matrix, number, 1 / float(np.asarray(surface.vertex_areas).sum()))
    # With a field the one turned by a right angle is harmonic too.
    components = np.stack([[z.real, z.imag] for z in (*vectors, *(1j * vectors))])
    fields = np.einsum("nav,vac->nvc", components, np.asarray(surface.geometry.frames, np.float64))
    weight = np.sqrt(np.asarray(surface.mass, np.float64))[:, None]
    basis = np.linalg.qr((weight * fields).reshape(len(fields), -1).T)[0].T.reshape(fields.shape)
    fields = basis / np.where(weight > 0, weight, 1)
    return HarmonicFields(jnp.asarray(fields, surface.dtype), surface.mass)


@on_surface
def helmholtz_hodge(
    surface: Surface,
    X: Float[AnyArray, "V 3"],
    harmonic: HarmonicFields | None = None,
    preconditioner: Multigrid | Factorized | None = None,
) -> HodgeParts:
    """A tangent field as the sum of a gradient, a rotation and a harmonic field, orthogonal to each other.

    Potential and stream function solve Poisson's equations for divergence and curl; the potential is then scaled so
    that what is left of X is orthogonal to its gradient (a factor of one to second order), the part of the rest along
    the harmonic fields is taken off, and what remains is the rotation. So the parts sum to X exactly and are orthogonal
    to rounding, and second order for smooth fields. Of a field that is rough on the scale of the mesh the derivatives
    see only a part, and what they do not see counts as rotation. On a boundary the rotation flows along it.

    Args:
        surface: a closed `Monotone` surface, or one with the topology of a disk.
        X: (V, 3); the tangent part counts.
        harmonic: what `harmonic_fields` returned for this surface, which is asked where none is given.
        preconditioner: as of `poisson`. Where the surface is being traced this and ``harmonic`` must be handed in.

    Raises:
        SolveError: a potential was not found.
        ValueError: X does not fit the surface, or the surface has a boundary and handles or several boundary loops.

    Source: Helmholtz (1858), doi:10.1515/crll.1858.55.25; Bhatia and others (2013), The Helmholtz-Hodge decomposition:
    a survey, doi:10.1109/TVCG.2012.316.
    """
    check_vectors(surface, X)
    harmonic = harmonic_fields(surface) if harmonic is None else harmonic
    X = tangential(surface, jnp.asarray(X, surface.dtype))
    is_open = surface.topology.num_loops > 0
    sources = jnp.stack([divergence(surface, X), curl(surface, X)], axis=1)
    if is_open:
        potential = poisson(surface, sources[:, 0], Neumann(X), preconditioner=preconditioner)
        stream = poisson(surface, sources[:, 1], Dirichlet(0.0), preconditioner=preconditioner)
    else:
        with warnings.catch_warnings():
            # Of a rough field these means are no derivative's.
            warnings.simplefilter("ignore", IncompatibleSourceWarning)
            potential, stream = poisson(surface, sources, preconditioner=preconditioner).T
    return _parts(surface, X, potential, stream, harmonic)


@eqx.filter_jit
def _parts(surface: Surface, X: Array, potential: Array, stream: Array, harmonic: HarmonicFields) -> HodgeParts:
    def product(X, Y):
        return jnp.einsum("v,...vc,...vc->...", harmonic.measure, X, Y)

    slope = gradient(surface, potential)
    size = product(slope, slope)
    is_flat = size == 0
    scale = jnp.where(is_flat, 0, product(slope, X) / jnp.where(is_flat, 1, size))
    rest = X - scale * slope
    # The basis, to second order orthogonal to the gradient, made so exactly.
    across = product(harmonic.fields, slope[None]) / jnp.where(is_flat, 1, size)
    fields = harmonic.fields - across[:, None, None] * slope[None]
    gram = jax.vmap(lambda X: product(fields, X[None]))(fields)
    shares = jnp.linalg.solve(gram, product(fields, rest[None])) if len(fields) else jnp.zeros(0, X.dtype)
    around = jnp.einsum("n,nvc->vc", shares, fields)
    return HodgeParts(scale * slope, rest - around, around, scale * potential, stream)


def _number_of_handles(surface: Surface) -> int:
    """Of all components together, which are closed or disks."""
    topology = surface.topology
    faces, components = np.asarray(topology.faces), np.asarray(topology.components)
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    vertices, edges_of, faces_of = (
        np.bincount(part, minlength=topology.num_components)
        for part in (components, components[edges[:, 0]], components[faces[:, 0]])
    )
    rims = np.unique(np.stack([np.asarray(topology.loops), components[np.asarray(topology.boundary)]]), axis=1)
    loops = np.bincount(rims[1], minlength=topology.num_components)
    handles = (2 - loops - (vertices - edges_of + faces_of)) // 2
    is_bad = (loops > 1) | ((loops > 0) & (handles > 0))
    if is_bad.any():
        first = int(np.argmax(is_bad))
        rim, handle = int(loops[first]), int(handles[first])
        where = f" on component {first}" if topology.num_components > 1 else ""
        raise ValueError(
            f"Expected closed surfaces or disks, found {rim} boundary loop{'s' * (rim > 1)} and {handle} "
            f"handle{'s' * (handle != 1)}{where}."
        )
    return int(handles.sum())
