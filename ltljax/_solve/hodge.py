"""The Helmholtz-Hodge decomposition: a tangent field as the sum of a gradient, a rotation and a harmonic field.

What enters: a surface and a field. What leaves: its three parts, which are orthogonal in the measure that diffusion
conserves, and their potential and stream function.
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
from .poisson_equation import IncompatibleSourceWarning, poisson
from .vector_heat import connection_matrix, lowest


class HodgeParts(eqx.Module):
    """The three parts of a tangent field, which are orthogonal in the measure that diffusion conserves.

    Attributes:
        gradient: (V, 3) gradient of the potential.
        rotation: (V, 3) remainder, which is n x grad of the stream function to second order.
        harmonic: (V, 3) part with neither divergence nor curl, which flows around the handles.
        potential: (V,) potential, whose mean is zero.
        stream: (V,) stream function, which is zero on a boundary and has zero mean without one.
    """

    gradient: Float[Array, "V 3"]
    rotation: Float[Array, "V 3"]
    harmonic: Float[Array, "V 3"]
    potential: Float[Array, " V"]
    stream: Float[Array, " V"]


class HarmonicFields(eqx.Module):
    """The harmonic fields of a surface, made by `harmonic_fields`.

    Attributes:
        fields: (n, V, 3) tangent fields, orthonormal in the measure.
        measure: (V,) measure that diffusion conserves.
    """

    fields: Float[Array, "n V 3"]
    measure: Float[Array, " V"]


@on_surface
def harmonic_fields(surface: Surface) -> HarmonicFields:
    """The tangent fields with neither divergence nor curl, two for every handle (host): second order.

    They are the lowest eigenvectors of the Hodge Laplacian (`hodge_laplacian`).

    Args:
        surface: closed `Monotone` surface, or one with the topology of a disk, which has no harmonic fields.

    Raises:
        ValueError: the surface has several boundary loops or both a boundary and handles, or it is being traced.
    """
    if surface.is_traced:
        raise ValueError(
            "Harmonic fields are computed on the host, but the surface is being traced by a JAX transformation. "
            "Compute them outside and hand them to ltl.vectors.helmholtz_hodge."
        )
    with jax.ensure_compile_time_eval():  # A surface that is not traced has its fields inside jit as well.
        return _harmonic(surface, _number_of_handles(surface))


def _harmonic(surface: Surface, num_handles: int) -> HarmonicFields:
    if num_handles == 0:
        return HarmonicFields(jnp.zeros((0, surface.num_vertices, 3), surface.dtype), surface.mass)
    gauss = np.asarray(curvature(surface).gauss, np.float64)
    matrix = scipy.sparse.csc_array(-connection_matrix(surface) + scipy.sparse.diags_array(gauss))
    vectors = lowest(matrix, num_handles, 1 / float(np.asarray(surface.vertex_areas).sum()))
    # A harmonic field rotated by a right angle is harmonic too.
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
    """The gradient, the rotation and the harmonic field that a tangent field is the sum of, orthogonal to each other.

    Potential and stream function solve Poisson's equation for the divergence and the curl of X. Then

    1. the potential is scaled so that its gradient is orthogonal to the remainder of X (by a factor that is one to
       second order),
    2. the harmonic part is the projection of the remainder on the harmonic fields,
    3. the rotation is the rest.

    The parts therefore sum to X exactly, and they are orthogonal to rounding. For smooth fields they are of second
    order. Divergence and curl see only a part of a field that is rough on the scale of the mesh, and the rest counts as
    rotation. At a boundary the rotation flows along it.

    Args:
        surface: closed `Monotone` surface, or one with the topology of a disk.
        X: (V, 3) field, whose normal part is ignored.
        harmonic: result of `harmonic_fields` for this surface; computed by default.
        preconditioner: as for `poisson`. Where the surface is being traced, this and ``harmonic`` are needed.

    Raises:
        SolveError: a Poisson equation was not solved.
        ValueError: X does not fit the surface, or the surface has several boundary loops or both a boundary and
            handles.

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
            # Divergence and curl of a rough field may have a mean.
            warnings.simplefilter("ignore", IncompatibleSourceWarning)
            potential, stream = poisson(surface, sources, preconditioner=preconditioner).T
    return _parts(surface, X, potential, stream, harmonic)


@eqx.filter_jit
def _parts(surface: Surface, X: Array, potential: Array, stream: Array, harmonic: HarmonicFields) -> HodgeParts:
    def product(X, Y):
        return jnp.einsum("v,...vc,...vc->...", harmonic.measure, X, Y)

    slope = gradient(surface, potential)
    square = product(slope, slope)
    is_flat = square == 0
    square = jnp.where(is_flat, 1, square)
    scale = jnp.where(is_flat, 0, product(slope, X) / square)
    remainder = X - scale * slope
    # The harmonic fields are orthogonal to the gradient to second order. Here they are made so exactly.
    overlap = product(harmonic.fields, slope[None]) / square
    fields = harmonic.fields - overlap[:, None, None] * slope[None]
    gram = jax.vmap(lambda X: product(fields, X[None]))(fields)
    coefficients = jnp.linalg.solve(gram, product(fields, remainder[None])) if len(fields) else jnp.zeros(0, X.dtype)
    projection = jnp.einsum("n,nvc->vc", coefficients, fields)
    return HodgeParts(scale * slope, remainder - projection, projection, scale * potential, stream)


def _number_of_handles(surface: Surface) -> int:
    """The number of handles of all components together.

    Raises:
        ValueError: a component is neither closed nor a disk.
    """
    topology = surface.topology
    faces, components = np.asarray(topology.faces), np.asarray(topology.components)
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    vertices, edges_of, faces_of = (
        np.bincount(part, minlength=topology.num_components)
        for part in (components, components[edges[:, 0]], components[faces[:, 0]])
    )
    loops_of = np.unique(np.stack([np.asarray(topology.loops), components[np.asarray(topology.boundary)]]), axis=1)[1]
    loops = np.bincount(loops_of, minlength=topology.num_components)
    handles = (2 - loops - (vertices - edges_of + faces_of)) // 2
    is_bad = (loops > 1) | ((loops > 0) & (handles > 0))
    if is_bad.any():
        first = int(np.argmax(is_bad))
        num_loops, num_handles = int(loops[first]), int(handles[first])
        place = f" on component {first}" if topology.num_components > 1 else ""
        raise ValueError(
            f"Expected closed surfaces or disks, found {num_loops} boundary loop{'s' * (num_loops > 1)} and "
            f"{num_handles} handle{'s' * (num_handles != 1)}{place}."
        )
    return int(handles.sum())
