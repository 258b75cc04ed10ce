"""Transport of vectors over a whole surface by a short diffusion, and direction fields smoothed by diffusion.

What enters: a surface, and vectors at some vertices or everywhere. What leaves: tangent fields.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from .._equations import VectorDiffusion
from .._lifting.frames import transport
from .._mesh import k_ring, one_rings
from .._operators import check_tangent, connection, from_frame, laplacian_matrix, power, to_frame
from .._surface import Surface, on_surface
from .._tables import AnyArray
from .distance import checked_sources
from .evolve import solve

# Default time of the heat step, in multiples of `_shortest_time`.
_STEP = 4
# A source is spread over a bell of this width, in mean lengths of its edges. The row of one vertex does not see a
# source exactly where it is, but many rows together do.
_WIDTH = 1.5
# Number of rings around a source that the bell covers.
_RINGS = 6
# The heat at a distance d is about exp(-d / sqrt(time)). Across the surface it must stay within the range of float64.
_DECAY = 500
# Eigenvalues are searched next to minus this number over the area.
_SHIFT = 1e-3


@on_surface
def transport_vectors(
    surface: Surface,
    sources: Int[AnyArray, " n"] | Sequence[int] | int,
    vectors: Float[AnyArray, "*n 3"],
    time: float | None = None,
) -> Float[Array, "V 3"]:
    """The tangent field of vectors at some vertices, carried to every vertex from the nearest of them (host).

    This is parallel transport along shortest paths. The directions are those of one backward Euler step of vector heat,
    and the lengths come from scalar heat. Each source is spread over a few edges, because the row of one vertex does
    not see it exactly where it is. On spheres of 2,562 to 10,242 vertices the errors are 0.05 to 0.4 degrees
    (benchmarks/imaging.md). They fall more slowly than the mesh size, because the time of the step is tied to it.

    The response to each source is computed on the host by sparse elimination, which keeps its relative accuracy where
    heat is tiny. Its combination with the vectors runs in JAX and is differentiable in the vectors. It takes 24 bytes
    for each vertex and source, and a multiple of that while the response is computed.

    Args:
        surface: a `Monotone` surface.
        sources: (n,) indices of vertices, or one index.
        vectors: (n, 3) tangent vectors at the sources, or (3,) for one source.
        time: positive time of the heat step; by default four times the square of the mean edge length.

    Returns:
        (V, 3) tangent field, zero on a component without a source.

    Raises:
        ValueError: a source is not on the surface, the vectors do not match the sources or are not tangent, the time is
            not positive, or the surface is being traced.

    Source: Sharp, Soliman and Crane (2019), The vector heat method, doi:10.1145/3243651.
    """
    if surface.is_traced:
        raise ValueError(
            "Vector heat is computed on the host, but the surface is being traced by a JAX transformation. Call "
            "ltl.vectors.transport_vectors outside."
        )
    sources = checked_sources(surface, sources)
    if time is not None and not time > 0:
        raise ValueError(f"Expected a positive time, found {time}.")
    vectors = jnp.asarray(vectors, surface.dtype)
    vectors = vectors[None] if vectors.shape == (3,) else vectors
    if vectors.shape != (len(sources), 3):
        raise ValueError(f"Expected a vector for each of {len(sources)} sources, found shape {vectors.shape}.")
    everywhere = jnp.zeros((surface.num_vertices, 3), surface.dtype).at[sources].set(vectors)
    check_tangent(surface, everywhere)
    time = _STEP * _shortest_time(surface) if time is None else time
    with jax.ensure_compile_time_eval():  # A surface that is not traced has responses inside jit as well.
        carried, heat = _responses(surface, sources, time)
    return _combined(surface, sources, vectors, carried, heat)


@eqx.filter_jit
def _combined(surface: Surface, sources: Any, vectors: Array, carried: Array, heat: Array) -> Array:
    """The field (V, 3) of vectors at the sources, from the responses to unit vectors and to heat at each source."""
    frames = surface.geometry.frames[sources]
    x, y = jnp.einsum("nc,nac->an", vectors, frames)
    real, imaginary = carried[..., 0], carried[..., 1]
    z = jnp.stack([real @ x - imaginary @ y, real @ y + imaginary @ x], axis=-1)
    squared = x**2 + y**2
    lengths = jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)
    total = jnp.sum(heat, axis=1)
    length = heat @ lengths / jnp.where(total > 0, total, 1)
    size = jnp.sum(z**2, axis=-1)
    unit = z / jnp.sqrt(jnp.where(size > 0, size, 1))[:, None]
    return from_frame(surface, length[:, None] * unit)


def _shortest_time(surface: Surface) -> float:
    """The shortest useful time of a heat step (host): the squared mesh size, or more if float64 would underflow."""
    diameter = float(np.linalg.norm(np.ptp(np.asarray(surface.vertices, np.float64), axis=0)))
    return max(float(surface.mesh_size), 2 * diameter / _DECAY) ** 2


def _responses(surface: Surface, sources: np.ndarray, time: float) -> tuple[Array, Array]:
    """The responses to a heat step from each source: to the first vector of its frame (V, n, 2) and to heat (V, n).

    Both are divided at every vertex by the heat of the warmest source there.
    """
    size = surface.num_vertices
    near, owner, share = _spread(surface, sources)
    normals, frames = (np.asarray(a, np.float64) for a in (surface.normals, surface.geometry.frames))
    first = transport(normals[sources[owner]], normals[near], frames[sources[owner], 0])
    z = np.einsum("nc,nac->na", first, frames[near])
    shape = (size, len(sources))
    vector_heat: Any = scipy.sparse.csc_array((share * (z[:, 0] + 1j * z[:, 1]), (near, owner)), shape).toarray()
    scalar_heat: Any = scipy.sparse.csc_array((share, (near, owner)), shape).toarray()
    scalar = _factorized_step(laplacian_matrix(surface).astype(np.float64), time).solve(scalar_heat)
    vector = _factorized_step(connection_matrix(surface), time).solve(vector_heat)
    warmest = scalar.max(axis=1, keepdims=True)
    scale = np.where(warmest > 0, warmest, 1)
    vector, scalar = vector / scale, np.maximum(scalar, 0) / scale
    carried = np.stack([vector.real, vector.imag], axis=-1)
    return jnp.asarray(carried, surface.dtype), jnp.asarray(scalar, surface.dtype)


def _spread(surface: Surface, sources: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A bell around each source whose centre of mass, in the measure that diffusion conserves, is the source.

    The operator is not symmetric, so the rows that use a vertex see it slightly displaced. The bell averages over many
    vertices.

    Returns:
        The vertices of the bells, the number of the source that each belongs to, and their shares.
    """
    vertices, normals, frames = (
        np.asarray(a, np.float64) for a in (surface.vertices, surface.normals, surface.geometry.frames)
    )
    size, number = surface.num_vertices, len(sources)
    rings = one_rings(np.asarray(surface.faces), size)
    starts, members = k_ring(rings, size, sources, _RINGS)
    owner = np.concatenate([np.repeat(np.arange(number), np.diff(starts)), np.arange(number)])
    near = np.concatenate([members, sources])
    starts, members = k_ring(rings, size, sources, 1)
    beside = np.repeat(np.arange(number), np.diff(starts))
    edges = np.linalg.norm(vertices[members] - vertices[sources[beside]], axis=1)
    width = (_WIDTH * np.bincount(beside, edges) / np.bincount(beside))[owner]
    away = vertices[near] - vertices[sources[owner]]
    bell = np.exp(-np.sum(away**2, axis=1) / (2 * width**2))
    # Vertices on the opposite side of a thin part are near in space but not along the surface.
    bell = bell * (np.sum(normals[near] * normals[sources[owner]], axis=1) > 0)
    place = np.einsum("nc,nac->an", away, frames[sources[owner]])
    weight = np.asarray(surface.mass, np.float64)[near] * bell
    second = np.stack([[np.bincount(owner, weight * p * q) for p in place] for q in place])
    tilt = np.linalg.solve(
        np.moveaxis(second, -1, 0), -np.stack([np.bincount(owner, weight * p) for p in place], axis=1)[..., None]
    )[..., 0]
    return near, owner, bell * np.maximum(1 + np.sum(tilt[owner] * place.T, axis=1), 0)


def _factorized_step(operator: Any, time: float) -> Any:
    """The factors of a backward Euler step, without pivoting, so that elimination involves no cancellation."""
    stepped = scipy.sparse.eye_array(operator.shape[0]) - time * operator
    return scipy.sparse.linalg.splu(scipy.sparse.csc_matrix(stepped), diag_pivot_thresh=0.0)


@on_surface
def connection_matrix(surface: Surface, symmetry: int = 1) -> scipy.sparse.csr_array:
    """The vector Laplacian as a complex sparse matrix (V, V) that acts on components in the frames (host)."""
    with jax.ensure_compile_time_eval():
        return connection(surface, symmetry).matrix()


@on_surface
def direction_field(
    surface: Surface, symmetry: int = 4, guide: Float[AnyArray, "V 3"] | None = None, time: float | None = None
) -> Float[Array, "V 3"]:
    """A smooth direction field with rotational symmetry, as one of its unit vectors (an arm) at every vertex.

    The power of the field, which is the same for all arms, is smoothed. With a guide, the guide's power diffuses for a
    time: lengths count as weights, and where the guide vanishes its surroundings decide. Without a guide, the smoothest
    field is the lowest eigenvector of the power's Laplacian (host).

    Args:
        surface: a `Monotone` or `Polynomial` surface.
        symmetry: number of arms: 1 for vectors, 2 for lines, 4 for crosses, as for quadrilaterals.
        guide: (V, 3) tangent field, such as a principal direction times the difference of the principal curvatures.
        time: duration of the guide's diffusion, which removes details finer than its square root.

    Raises:
        ValueError: a guide is given without a time or a time without a guide; the guide does not fit the surface, is
            not tangent, or vanishes on a component; or there is no guide and the surface is being traced.

    Source: Knoppel, Crane, Pinkall and Schroder (2013), Globally optimal direction fields,
    doi:10.1145/2461912.2462005.
    """
    if guide is None and time is None:
        return _arm(surface, jnp.asarray(_smoothest(surface, symmetry), surface.dtype), symmetry)
    if guide is None or time is None:
        raise ValueError("Expected a guide and the time for which it diffuses, or neither for the smoothest field.")
    check_tangent(surface, guide)
    _check_nonzero(surface, guide)
    z = to_frame(surface, jnp.asarray(guide, surface.dtype))
    size = jnp.sqrt(jnp.maximum(jnp.sum(z**2, axis=-1, keepdims=True), jnp.finfo(z.dtype).tiny))
    raised = from_frame(surface, size * power(z / size, symmetry))
    smooth = solve(VectorDiffusion(symmetry=symmetry), surface, raised, t1=time).u_end
    return _arm(surface, to_frame(surface, smooth), symmetry)


@eqx.filter_jit
def _arm(surface: Surface, z: Array, symmetry: int) -> Array:
    """The unit vectors whose powers have the directions of z."""
    angle = jnp.arctan2(z[:, 1], z[:, 0]) / symmetry
    return from_frame(surface, jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1))


def _smoothest(surface: Surface, symmetry: int) -> np.ndarray:
    """The components (V, 2) of the power of the smoothest field (host)."""
    if surface.is_traced:
        raise ValueError(
            "The smoothest field is computed on the host, but the surface is being traced by a JAX transformation. "
            "Compute it outside, or hand in a guide."
        )
    matrix, components = -connection_matrix(surface, symmetry), np.asarray(surface.topology.components)
    areas = np.bincount(components, np.asarray(surface.vertex_areas))
    z = np.zeros(len(components), np.complex128)
    for component, area in enumerate(areas):
        members = np.flatnonzero(components == component)
        z[members] = lowest(matrix[members][:, members], 1, _SHIFT / area)[0]
    return np.stack([z.real, z.imag], axis=-1)


def _check_nonzero(surface: Surface, guide: AnyArray) -> None:
    """Raise if a guide vanishes on a whole component, where it would determine no direction."""
    if isinstance(guide, Tracer) or surface.is_traced:
        return
    components = np.asarray(surface.topology.components)
    longest = np.zeros(surface.topology.num_components)
    np.maximum.at(longest, components, np.linalg.norm(np.asarray(guide, np.float64), axis=1))
    if not (longest > 0).all():
        where = f"component {int(np.argmin(longest))}" if len(longest) > 1 else "the surface"
        raise ValueError(
            f"Expected a guide that is not zero everywhere, found zero on all of {where}. Leave out guide and time "
            "for the smoothest field."
        )


def lowest(matrix: Any, number: int, shift: float) -> Any:
    """The eigenvectors (number, V) of a complex sparse matrix whose eigenvalues are nearest to ``-shift`` (host)."""
    size = matrix.shape[0]
    factors = scipy.sparse.linalg.splu(scipy.sparse.csc_matrix(matrix + shift * scipy.sparse.eye_array(size)))
    operator: Any = scipy.sparse.linalg.LinearOperator
    inverse = operator(matrix.shape, matvec=factors.solve, dtype=np.complex128)
    start = np.random.default_rng(0).normal(size=(size, 2)) @ [1, 1j]
    options: Any = dict(k=number, sigma=-shift, OPinv=inverse, v0=start)
    return scipy.sparse.linalg.eigs(matrix, **options)[1].T
