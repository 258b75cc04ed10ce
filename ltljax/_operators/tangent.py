"""The calculus of tangent vector fields: ``(surface, field) -> field``.

What enters: a surface, and vectors (V, 3) in ambient coordinates, or (V, S, 3) for several fields at once; only their
tangent part matters. What leaves: scalar, vector or tensor fields, again in ambient coordinates. A neighbour's vector
is moved into the tangent plane of the vertex by parallel transport, and differentiated there with the weights of the
gradient or of the Laplacian. In frames, a vector is a complex number and parallel transport is a rotation.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from .._lifting.frames import transport
from .._lifting.intrinsic import Paths
from .._lifting.layout import PerBlock
from .._lifting.weighing import places
from .._surface import Surface, on_device, on_surface
from .._tables import AnyArray, Stencil, Table, reverse_weights, slot_sum
from .curvature import curvature, polyhedral_curvature
from .scalar import divergence, gradient, laplacian

# A vector counts as tangent if its normal part is at most this share of its length.
_NORMAL_SHARE = 1e-3


class Connection(eqx.Module):
    """An operator on vector fields in frames, such as the vector Laplacian returned by `connection`.

    Components in frames are complex numbers, and so are the weights: a scalar weight times the rotation from the
    neighbour's frame to the vertex's.

    Attributes:
        cosine: the real parts of the weights.
        sine: their imaginary parts.
    """

    cosine: Stencil
    sine: Stencil

    def __call__(self, z: Float[AnyArray, "V *S 2"]) -> Float[Array, "V *S 2"]:
        """The operator applied to a field with components z in the frames."""
        flat = z.reshape(z.shape[0], -1)
        cosine, sine = self.cosine(flat).reshape(z.shape), self.sine(flat).reshape(z.shape)
        return jnp.stack([cosine[..., 0] - sine[..., 1], cosine[..., 1] + sine[..., 0]], axis=-1)

    def matrix(self) -> scipy.sparse.csr_array:
        """The operator as a complex SciPy sparse matrix (V, V) (host)."""
        return scipy.sparse.csr_array(self.cosine.matrix().astype(np.float64) + 1j * self.sine.matrix())


@on_device
def connection(surface: Surface, symmetry: int = 1) -> Connection:
    """The vector Laplacian of a surface with its weights computed once, for many applications as in time stepping.

    It is a pure function of the surface's geometry, differentiable in the vertices.

    Args:
        surface: a `Monotone` or `Polynomial` surface.
        symmetry: the number n of rotations that leave the field unchanged: 1 for vectors, 2 for lines, 4 for crosses.
            The n-th power of the field is transported, which rotates by n times the angle.

    Raises:
        ValueError: the scheme is `Paper`, whose Laplacian has no weights of its own, or the symmetry is less than 1.
    """
    table, weights = surface.topology.diffusion, surface.geometry.laplacian_weights
    if table is None or weights is None:
        raise ValueError("Paper() has no vector Laplacian. Use ltl.Monotone() or ltl.Polynomial().")
    if symmetry < 1:
        raise ValueError(f"Expected a symmetry of 1 or more, found {symmetry}.")
    rotations = tuple(power(r, symmetry) for r in _rotations(surface, table, surface.topology.diffusion_paths))
    connected = _connected(table, weights, rotations)
    # Time stepping differentiates the same weights in every step, so their reverse is computed here.
    cosine, sine = (
        eqx.tree_at(lambda s: s.reverse, part, reverse_weights(table, part.weights), is_leaf=lambda leaf: leaf is None)
        for part in (connected.cosine, connected.sine)
    )
    return Connection(cosine, sine)


def _connected(table: Table, weights: PerBlock, rotations: PerBlock) -> Connection:
    """The operator ``sum_k w[k] (rotation[k] z[k] - z)`` on complex fields."""
    x, y = (tuple(w * r[..., i] for w, r in zip(weights, rotations, strict=True)) for i in (0, 1))
    return Connection(
        Stencil(table, x, centre=slot_sum(table, x) - slot_sum(table, weights)),
        Stencil(table, y, centre=slot_sum(table, y)),
    )


@on_device
def to_frame(surface: Surface, X: Float[AnyArray, "V *S 3"]) -> Float[Array, "V *S 2"]:
    """The components of vectors in the frames of the vertices; the normal part is ignored."""
    check_vectors(surface, X)
    return jnp.einsum("v...c,vac->v...a", X, surface.geometry.frames)


@on_device
def from_frame(surface: Surface, z: Float[AnyArray, "V *S 2"]) -> Float[Array, "V *S 3"]:
    """The tangent vectors that have the given components in the frames of the vertices."""
    if z.ndim < 2 or z.shape[-1] != 2 or z.shape[0] != surface.num_vertices:
        raise ValueError(f"Expected components of shape ({surface.num_vertices}, 2) or (V, S, 2), found {z.shape}.")
    return jnp.einsum("v...a,vac->v...c", z, surface.geometry.frames)


@on_device
def tangential(surface: Surface, X: Float[AnyArray, "V *S 3"]) -> Float[Array, "V *S 3"]:
    """The tangent part of vectors."""
    return from_frame(surface, to_frame(surface, X))


@on_device
def rotated(surface: Surface, X: Float[AnyArray, "V *S 3"]) -> Float[Array, "V *S 3"]:
    """The tangent part of X rotated by 90 degrees, counter-clockwise seen from outside: n x X."""
    check_vectors(surface, X)
    return jnp.cross(_broadcast(surface.normals, X), X)


@on_device
def rotated_gradient(surface: Surface, u: Float[AnyArray, "V *S"]) -> Float[Array, "V *S 3"]:
    """n x grad u: tangent to the contours of u with larger values on its right, and free of divergence."""
    return rotated(surface, gradient(surface, u))


@on_device
def curl(surface: Surface, X: Float[AnyArray, "V *S 3"]) -> Float[Array, "V *S"]:
    """The scalar curl of a tangent field, n . (rot X), positive where the field rotates counter-clockwise.

    It is the divergence of X rotated clockwise by 90 degrees, and has the order of the divergence.

    Args:
        surface: the surface.
        X: (V, 3) or (V, S, 3).

    Returns:
        (V,) or (V, S).
    """
    return -divergence(surface, rotated(surface, X))


@on_device
def covariant_derivative(surface: Surface, X: Float[AnyArray, "V *S 3"]) -> Float[Array, "V *S 3 3"]:
    """The covariant derivative of a tangent field, a tangent tensor: ``D @ w`` is the derivative of X along w.

    The neighbours' vectors are transported into the tangent plane of the vertex and differentiated there with the
    weights of the gradient: second order with ``Monotone``. The trace of D is the divergence of X, and twice its skew
    part is the curl.

    Args:
        surface: the surface.
        X: (V, 3) or (V, S, 3).

    Returns:
        (V, 3, 3) or (V, S, 3, 3).

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 2, which gives its trace.
    """
    z = to_frame(surface, X)
    table, frames = surface.topology.jet, surface.geometry.frames
    rotations = _rotations(surface, table, surface.topology.jet_paths)
    parts = [_connected(table, weights, rotations)(z) for weights in surface.geometry.gradient_weights]
    components = jnp.stack(parts, axis=-1)
    return jnp.einsum("v...ab,vac,vbd->v...cd", components, frames, frames)


@on_device
def vector_laplacian(
    surface: Surface, X: Float[AnyArray, "V *S 3"], along: Connection | None = None
) -> Float[Array, "V *S 3"]:
    """The Laplacian of a tangent field: the trace of its second covariant derivative (the Bochner or rough Laplacian).

    The neighbours' vectors are transported into the tangent plane of the vertex and summed with the weights of the
    scalar Laplacian. With ``Monotone`` these are non-negative, so diffusion never lengthens the longest vector.
    Transport is the shortest rotation between the refined normals; at creases it follows the charts. The operator is
    pointwise first order on irregular meshes and second order in solved problems. On the unit sphere it maps X to -X
    both for a Killing field and for the gradient of a linear function. On a boundary the derivative of X along the
    conormal is assumed to vanish.

    Args:
        surface: a `Monotone` or `Polynomial` surface.
        X: (V, 3) or (V, S, 3).
        along: the `connection` of this surface, to avoid computing its weights again.

    Raises:
        ValueError: the scheme is `Paper`, or X does not fit the surface.

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 2, for the idea; the weights are those of `laplacian`.
    """
    along = connection(surface) if along is None else along
    return from_frame(surface, along(to_frame(surface, X)))


@on_surface
def hodge_laplacian(surface: Surface, X: Float[AnyArray, "V *S 3"]) -> Float[Array, "V *S 3"]:
    """The Hodge Laplacian, grad div X + n x grad curl X, which maps the gradient of u to the gradient of Delta u.

    It has the sign of `laplacian`. By Weitzenboeck's formula it is the vector Laplacian minus K X, where K is the Gauss
    curvature. K comes from a fit, and near creases from the angle defect over the vertex area. Pointwise first order.

    Args:
        surface: a `Monotone` or `Polynomial` surface.
        X: (V, 3) or (V, S, 3).

    Source: Petersen (2016), Riemannian Geometry, doi:10.1007/978-3-319-26654-1, section 9.3.
    """
    return _hodge_laplacian(surface, curvature(surface).gauss, X)


@on_device
def _hodge_laplacian(surface: Surface, gauss: Array, X: AnyArray) -> Array:
    is_creased = surface.topology.is_creased
    if is_creased is not None:
        gauss = jnp.where(is_creased, polyhedral_curvature(surface).gauss, gauss)
    return vector_laplacian(surface, X) - _broadcast(gauss, X) * tangential(surface, X)


@on_device
def tensor_laplacian(surface: Surface, T: Float[AnyArray, "V *S 3 3"]) -> Float[Array, "V *S 3 3"]:
    """The Laplacian of a field of symmetric tangent tensors, such as Hessians or structure tensors.

    A symmetric tensor is its trace, which is a scalar, plus a trace-free part, which is a line field with a magnitude
    and is transported with symmetry 2. With ``Monotone`` both diffuse with non-negative weights, so the largest
    eigenvalue cannot grow and the smallest cannot fall.

    Args:
        surface: a `Monotone` or `Polynomial` surface.
        T: (V, 3, 3) or (V, S, 3, 3), symmetric; only the tangent part matters.
    """
    if T.ndim < 3 or T.shape[-2:] != (3, 3) or T.shape[0] != surface.num_vertices:
        raise ValueError(f"Expected tensors of shape ({surface.num_vertices}, 3, 3) or (V, S, 3, 3), found {T.shape}.")
    frames = surface.geometry.frames
    t = jnp.einsum("vac,v...cd,vbd->v...ab", frames, T, frames)
    mean = laplacian(surface, (t[..., 0, 0] + t[..., 1, 1]) / 2)
    line = jnp.stack([(t[..., 0, 0] - t[..., 1, 1]) / 2, (t[..., 0, 1] + t[..., 1, 0]) / 2], -1)
    line = connection(surface, 2)(line)
    rows = [[mean + line[..., 0], line[..., 1]], [line[..., 1], mean - line[..., 0]]]
    components = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    return jnp.einsum("v...ab,vac,vbd->v...cd", components, frames, frames)


@on_device
def lie_derivative(surface: Surface, X: Float[AnyArray, "V 3"], u: Float[AnyArray, "V *S"]) -> Float[Array, "V *S"]:
    """X . grad u, the derivative of u along the flow of X. It has the order of the gradient.

    To advect a field, u_t = -X . grad u, use the upwind stencil
    ``ltl.operators.elliptic_stencil(surface, 0.0, drift=-X)``, which is stable.

    Args:
        surface: the surface.
        X: (V, 3).
        u: (V,) or (V, S).
    """
    _check_one(surface, X)
    return jnp.einsum("vc,v...c->v...", X, gradient(surface, u))


@on_device
def lie_bracket(surface: Surface, X: Float[AnyArray, "V 3"], Y: Float[AnyArray, "V 3"]) -> Float[Array, "V 3"]:
    """The Lie bracket [X, Y], the derivative of Y along X minus that of X along Y; zero where their flows commute."""
    _check_one(surface, X)
    _check_one(surface, Y)
    along = jnp.einsum("vcd,vd->vc", covariant_derivative(surface, Y), X)
    return along - jnp.einsum("vcd,vd->vc", covariant_derivative(surface, X), Y)


@on_surface
def transport_along(
    surface: Surface, path: Int[AnyArray, " n"], vector: Float[AnyArray, "*S 3"]
) -> Float[Array, "n *S 3"]:
    """A tangent vector at each vertex of a path, moved along the path by parallel transport.

    Each step is the shortest rotation between the normals, so lengths and angles are preserved. After a closed path the
    vector has rotated to the left by the integral of the Gauss curvature to the left of the path, to second order. On
    the unit sphere that is the enclosed area.

    Args:
        surface: the surface.
        path: (n,) vertices, each near the previous one.
        vector: (3,) or (S, 3), the vector at the first vertex; only the tangent part matters.

    Raises:
        ValueError: the vector has another shape, or the path contains an index that is not a vertex.
    """
    vector = jnp.asarray(vector, surface.dtype)
    if vector.ndim not in (1, 2) or vector.shape[-1] != 3:
        raise ValueError(f"Expected a vector of shape (3,) or (S, 3), found {vector.shape}.")
    if not isinstance(path, Tracer):
        path = np.asarray(path)
        is_off = (path < 0) | (path >= surface.num_vertices)
        if path.ndim != 1 or not path.size or is_off.any():
            problem = path[is_off][0] if is_off.any() else f"shape {path.shape}"
            raise ValueError(f"Expected a path of vertices from 0 to {surface.num_vertices - 1}, found {problem}.")
    return _carried(surface, jnp.asarray(path), vector)


@on_device
def _carried(surface: Surface, path: Array, vector: Array) -> Array:
    normals = surface.normals[path].reshape(-1, *(1,) * (vector.ndim - 1), 3)

    def step(vector, planes):
        source, target = planes
        moved = transport(source, target, vector)
        return moved, moved

    start = vector - jnp.sum(vector * normals[0], axis=-1, keepdims=True) * normals[0]
    _, after = jax.lax.scan(step, start, (normals[:-1], normals[1:]))
    return jnp.concatenate([start[None], after])


@on_device
def singularities(surface: Surface, X: Float[AnyArray, "V 3"], symmetry: int = 1) -> Float[Array, " F"]:
    """The index of a field in every face: the number of counter-clockwise turns around the face, zero in most faces.

    Indices are multiples of 1 / symmetry. On a closed surface they sum to the Euler characteristic for every field
    (Poincare and Hopf), so every field on a sphere has a singularity. Fields at neighbouring vertices are compared by
    the shortest rotation between the normals.

    Args:
        surface: the surface.
        X: (V, 3), one direction of the field at every vertex, nowhere zero.
        symmetry: the number of directions: 1 for vectors, 2 for lines, 4 for crosses.

    Source: Knoppel, Crane, Pinkall and Schroder (2013), Globally optimal direction fields,
    doi:10.1145/2461912.2462005, section 6.
    """
    _check_one(surface, X)
    z, corners = to_frame(surface, X), surface.faces
    normals, frames = surface.normals, surface.geometry.frames

    def angle(z):
        return jnp.arctan2(z[..., 1], z[..., 0])

    def rotation(v, k):
        return angle(_rotation(normals[v], frames[v], normals[k], frames[k]))

    own, after = corners, jnp.roll(corners, -1, axis=1)
    across = rotation(after, own)  # from the frame of each corner to the frame of the next
    # The rotation of the frames around the face is its curvature, which is small.
    holonomy = _wrapped(jnp.sum(across, axis=1))
    turning = _wrapped(symmetry * (angle(z[after]) - angle(z[own]) - across))
    return (jnp.sum(turning, axis=1) + symmetry * holonomy) / (2 * jnp.pi * symmetry)


def check_vectors(surface: Surface, X: AnyArray) -> None:
    """Raise a ValueError if X does not have the shape of one or several vector fields."""
    if X.ndim not in (2, 3) or X.shape[-1] != 3 or X.shape[0] != surface.num_vertices:
        raise ValueError(
            f"Expected vectors of shape ({surface.num_vertices}, 3) or ({surface.num_vertices}, S, 3), found {X.shape}."
        )


def _check_one(surface: Surface, X: AnyArray) -> None:
    if X.shape != (surface.num_vertices, 3):
        raise ValueError(f"Expected one field of shape ({surface.num_vertices}, 3), found {X.shape}.")


def check_tangent(surface: Surface, X: AnyArray) -> None:
    """Raise a ValueError if vectors are not finite or not tangent; nothing is checked while they are traced."""
    check_vectors(surface, X)
    if isinstance(X, Tracer) or surface.is_traced:
        return
    vectors, normals = np.asarray(X, np.float64), np.asarray(surface.normals, np.float64)
    rows = vectors.reshape(len(vectors), -1)
    if not np.isfinite(rows).all():
        raise ValueError(
            f"Expected finite vectors, found NaN or infinity at vertex {np.argmin(np.isfinite(rows).all(axis=1))}."
        )
    along = np.abs(np.einsum("v...c,vc->v...", vectors, normals)).reshape(len(rows), -1)
    length = np.linalg.norm(vectors, axis=-1).reshape(len(rows), -1)
    is_normal = (along > _NORMAL_SHARE * np.maximum(length, length.max() * 1e-6)).any(axis=1)
    if is_normal.any():
        first = int(np.argmax(is_normal))
        raise ValueError(
            f"Expected tangent vectors, found a normal part of {along[first].max():.3g} in a vector of length "
            f"{length[first].max():.3g} at vertex {first}. Use ltl.vectors.tangential(surface, X)."
        )


def _rotation(normal: AnyArray, frame: AnyArray, from_normal: AnyArray, from_frame: AnyArray) -> Array:
    """The rotation (..., 2), as cosine and sine, from components in one frame to another after transport."""
    moved = transport(from_normal, normal, from_frame[..., 0, :])
    return jnp.einsum("...ac,...c->...a", frame, moved)


def _rotations(surface: Surface, table: Table, paths: tuple[Paths, ...] | None) -> PerBlock:
    """The rotation (K, N, 2) from the neighbour's frame to the vertex's, for every slot of every block."""
    return places(surface.scheme, surface.topology, surface.geometry).turns(table, paths)


def power(z: Float[AnyArray, "*N 2"], exponent: int) -> Float[Array, "*N 2"]:
    """The power of complex numbers (..., 2), by repeated multiplication."""
    out = z
    for _ in range(exponent - 1):
        real = out[..., 0] * z[..., 0] - out[..., 1] * z[..., 1]
        out = jnp.stack([real, out[..., 0] * z[..., 1] + out[..., 1] * z[..., 0]], axis=-1)
    return out


def _wrapped(angle: Array) -> Array:
    """The angle, shifted by a multiple of 2 pi into [-pi, pi]."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def _broadcast(values: AnyArray, X: AnyArray) -> AnyArray:
    """Scalars (V,) or vectors (V, 3) at the vertices, reshaped to broadcast against one or several vector fields."""
    return values.reshape(-1, *(1,) * (X.ndim - 2), values.size // len(values))
