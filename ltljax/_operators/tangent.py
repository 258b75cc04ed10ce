"""The calculus of tangent vector fields: ``(surface, field) -> field``.

What enters: a surface, and vectors (V, 3) in ambient coordinates, of which the tangent part counts; or (V, S, 3),
several fields at once. What leaves: fields of numbers, of vectors or of tensors, again in ambient coordinates. A
neighbour's vector is carried into the vertex's tangent plane by parallel transport and differentiated there with the
weights of the gradient or of the Laplacian. In the frame of a vertex that transport is a rotation, and a vector one
complex number.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from .._lifting.frames import transport
from .._lifting.intrinsic import Paths
from .._lifting.layout import PerBlock
from .._lifting.schemes import places
from .._surface.surface import Surface, on_device, on_surface
from .._tables import AnyArray, ReverseWeights, Table, difference_sum, reverse_weights, slot_sum
from .curvature import curvature, polyhedral_curvature
from .scalar import divergence, gradient, laplacian

# The share of a vector that may stand on its tangent plane before it counts as a mistake.
_NORMAL_SHARE = 1e-3


class Connection(eqx.Module):
    """The Laplacian of tangent vectors, as weights on a table: what `connection` returns. Call it on a field in frames.

    Attributes:
        table: the neighbours.
        turned: two sets of weights on the table: the Laplacian's times cosine and sine of the angle by which the
            neighbour's frame is turned against the vertex's, times the symmetry.
        centre: (2, V) the weights on the vertex's own vector that the difference form leaves over.
        reverse: the same weights in the order of the table's reverse, for derivatives in reverse mode.
    """

    table: Table
    turned: tuple[PerBlock, PerBlock]
    centre: Float[Array, "2 V"]
    reverse: tuple[ReverseWeights | None, ReverseWeights | None]

    def __call__(self, z: Float[AnyArray, "V *S 2"]) -> Float[Array, "V *S 2"]:
        """The Laplacian of the field whose components in the frames are z."""
        return _turned_sum(self, z)


@on_device
def connection(surface: Surface, symmetry: int = 1) -> Connection:
    """The vector Laplacian of a surface, weighed once: for many applications, as in time stepping.

    A pure function of the surface's geometry, differentiable in the vertices.

    Args:
        surface: a `Monotone` or `Polynomial` surface.
        symmetry: n of a field that looks the same after a turn by 1/n: its n-th power is transported, which turns n
            times as far. 1 for vectors, 2 for lines, 4 for crosses.

    Raises:
        ValueError: the scheme is `Paper`, whose Laplacian has no weights of its own, or the symmetry is less than 1.
    """
    table, weights = surface.topology.diffusion, surface.geometry.laplacian_weights
    if table is None or weights is None:
        raise ValueError("Paper() has no vector Laplacian. Use ltl.Monotone() or ltl.Polynomial().")
    if symmetry < 1:
        raise ValueError(f"Expected a symmetry of 1 or more, found {symmetry}.")
    turns = tuple(power(turn, symmetry) for turn in _turns(surface, table, surface.topology.diffusion_paths))
    x, y = (tuple(w * turn[..., i] for w, turn in zip(weights, turns, strict=True)) for i in (0, 1))
    centre = jnp.stack([slot_sum(table, x) - slot_sum(table, weights), slot_sum(table, y)])
    return Connection(table, (x, y), centre, (reverse_weights(table, x), reverse_weights(table, y)))


@on_device
def to_frame(surface: Surface, X: Float[AnyArray, "V *S 3"]) -> Float[Array, "V *S 2"]:
    """The components of vectors in the frames of the vertices; their normal part is left out."""
    check_vectors(surface, X)
    return jnp.einsum("v...c,vac->v...a", X, surface.geometry.frames)


@on_device
def from_frame(surface: Surface, z: Float[AnyArray, "V *S 2"]) -> Float[Array, "V *S 3"]:
    """The tangent vectors of components in the frames of the vertices."""
    if z.ndim < 2 or z.shape[-1] != 2 or z.shape[0] != surface.num_vertices:
        raise ValueError(f"Expected components of shape ({surface.num_vertices}, 2) or (V, S, 2), found {z.shape}.")
    return jnp.einsum("v...a,vac->v...c", z, surface.geometry.frames)


@on_device
def tangential(surface: Surface, X: Float[AnyArray, "V *S 3"]) -> Float[Array, "V *S 3"]:
    """The tangent part of vectors."""
    return from_frame(surface, to_frame(surface, X))


@on_device
def rotated(surface: Surface, X: Float[AnyArray, "V *S 3"]) -> Float[Array, "V *S 3"]:
    """The tangent part of X turned by a right angle, counter-clockwise seen from outside: n x X."""
    check_vectors(surface, X)
    return jnp.cross(_beside(surface.normals, X), X)


@on_device
def rotated_gradient(surface: Surface, u: Float[AnyArray, "V *S"]) -> Float[Array, "V *S 3"]:
    """n x grad u, which follows the contours of u with larger values to its right, and has no divergence."""
    return rotated(surface, gradient(surface, u))


@on_device
def curl(surface: Surface, X: Float[AnyArray, "V *S 3"]) -> Float[Array, "V *S"]:
    """The curl of a tangent field, a number: n . (rot X), positive where it turns counter-clockwise.

    The divergence of X turned by a right angle clockwise; of its order.

    Args:
        surface: the surface.
        X: (V, 3) or (V, S, 3).

    Returns:
        (V,) or (V, S).
    """
    return -divergence(surface, rotated(surface, X))


@on_device
def covariant_derivative(surface: Surface, X: Float[AnyArray, "V *S 3"]) -> Float[Array, "V *S 3 3"]:
    """The derivative of a tangent field along the surface, a tangent tensor: ``D @ w`` is that of X in the direction w.

    The neighbours' vectors are transported into the vertex's plane and differentiated there with the weights of the
    gradient: second order with ``Monotone``. Its trace is the divergence of X, twice its skew part the curl.

    Args:
        surface: the surface.
        X: (V, 3) or (V, S, 3).

    Returns:
        (V, 3, 3) or (V, S, 3, 3).

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 2, of whose divergence it is the tensor.
    """
    z = to_frame(surface, X)
    table, frames = surface.topology.jet, surface.geometry.frames
    turns = _turns(surface, table, surface.topology.jet_paths)

    def along(weights):
        x, y = (tuple(w * turn[..., i] for w, turn in zip(weights, turns, strict=True)) for i in (0, 1))
        centre = jnp.stack([slot_sum(table, x) - slot_sum(table, weights), slot_sum(table, y)])
        return _turned_sum(Connection(table, (x, y), centre, (None, None)), z)

    components = jnp.stack([along(weights) for weights in surface.geometry.gradient_weights], axis=-1)
    return jnp.einsum("v...ab,vac,vbd->v...cd", components, frames, frames)


@on_device
def vector_laplacian(
    surface: Surface, X: Float[AnyArray, "V *S 3"], along: Connection | None = None
) -> Float[Array, "V *S 3"]:
    """The Laplacian of a tangent field, the trace of its second covariant derivative (Bochner's, or the rough one).

    The neighbours' vectors are transported into the vertex's plane and summed with the weights of the scalar
    Laplacian. With ``Monotone`` those are not negative, and diffusion cannot make any vector longer than the longest.
    Pointwise first order on irregular meshes, second order in solved problems. On the unit sphere a Killing field and
    the gradient of a linear function both give -X. On a boundary it is for fields whose derivative along the conormal
    vanishes.

    Args:
        surface: a `Monotone` or `Polynomial` surface.
        X: (V, 3) or (V, S, 3).
        along: what `connection` returned for this surface; saves to weigh it anew.

    Raises:
        ValueError: the scheme is `Paper`, or X does not fit the surface.

    Transport is the shortest rotation between the refined normals, and at creases that of the charts.

    Source: Chen, Chi and Wu, arXiv 0907.1817, section 2, for the idea; the weights as of `laplacian`.
    """
    along = connection(surface) if along is None else along
    return from_frame(surface, along(to_frame(surface, X)))


@on_surface
def hodge_laplacian(surface: Surface, X: Float[AnyArray, "V *S 3"]) -> Float[Array, "V *S 3"]:
    """grad div X + n x grad curl X, the Laplacian that takes the gradient of u to that of Delta u; sign as `laplacian`.

    By Weitzenboeck's formula the vector Laplacian less K X, where K is the Gauss curvature. K is fitted, except near
    creases, where it is the angle defect over the vertex area. Pointwise first order.

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
    return vector_laplacian(surface, X) - _beside(gauss, X) * tangential(surface, X)


@on_device
def tensor_laplacian(surface: Surface, T: Float[AnyArray, "V *S 3 3"]) -> Float[Array, "V *S 3 3"]:
    """The Laplacian of a field of symmetric tangent tensors, such as Hessians or structure tensors.

    The trace is a scalar, and what is left is a line with a strength: a vector at twice the angle, which is transported
    with symmetry 2. Both diffuse with non-negative weights (``Monotone``), and so the largest eigenvalue cannot grow
    nor the smallest fall.

    Args:
        surface: a `Monotone` or `Polynomial` surface.
        T: (V, 3, 3) or (V, S, 3, 3), symmetric; the tangent part counts.
    """
    if T.ndim < 3 or T.shape[-2:] != (3, 3) or T.shape[0] != surface.num_vertices:
        raise ValueError(f"Expected tensors of shape ({surface.num_vertices}, 3, 3) or (V, S, 3, 3), found {T.shape}.")
    frames = surface.geometry.frames
    inside = jnp.einsum("vac,v...cd,vbd->v...ab", frames, T, frames)
    mean = laplacian(surface, (inside[..., 0, 0] + inside[..., 1, 1]) / 2)
    line = jnp.stack([(inside[..., 0, 0] - inside[..., 1, 1]) / 2, (inside[..., 0, 1] + inside[..., 1, 0]) / 2], -1)
    line = connection(surface, 2)(line)
    rows = [[mean + line[..., 0], line[..., 1]], [line[..., 1], mean - line[..., 0]]]
    changed = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    return jnp.einsum("v...ab,vac,vbd->v...cd", changed, frames, frames)


@on_device
def lie_derivative(surface: Surface, X: Float[AnyArray, "V 3"], u: Float[AnyArray, "V *S"]) -> Float[Array, "V *S"]:
    """X . grad u: how fast u changes for one who is carried along by X. Of the gradient's order.

    For a field that is carried along, u_t = -X . grad u, take the upwind stencil
    ``ltl.operators.elliptic_stencil(surface, 0.0, drift=-X)``, which is stable.

    Args:
        surface: the surface.
        X: (V, 3).
        u: (V,) or (V, S), numbers.
    """
    _check_one(surface, X)
    return jnp.einsum("vc,v...c->v...", X, gradient(surface, u))


@on_device
def lie_bracket(surface: Surface, X: Float[AnyArray, "V 3"], Y: Float[AnyArray, "V 3"]) -> Float[Array, "V 3"]:
    """[X, Y], the derivative of Y along X less that of X along Y: zero where their flows commute."""
    _check_one(surface, X)
    _check_one(surface, Y)
    along = jnp.einsum("vcd,vd->vc", covariant_derivative(surface, Y), X)
    return along - jnp.einsum("vcd,vd->vc", covariant_derivative(surface, X), Y)


@on_surface
def transport_along(
    surface: Surface, path: Int[AnyArray, " n"], vector: Float[AnyArray, "*S 3"]
) -> Float[Array, "n *S 3"]:
    """A tangent vector carried along a path of vertices by parallel transport: the vector at each of them.

    From vertex to vertex by the shortest rotation between the normals. Lengths and angles stay. Around a closed path
    the vector comes back turned, to the left by the integral of the Gauss curvature to the left of the path: its area
    on the unit sphere, to second order.

    Args:
        surface: the surface.
        path: vertices, each near the one before.
        vector: (3,) or (S, 3) at the first of them; the tangent part counts.

    Raises:
        ValueError: the vector has another shape, or the path leaves the surface.

    """
    vector = jnp.asarray(vector, surface.dtype)
    if vector.ndim not in (1, 2) or vector.shape[-1] != 3:
        raise ValueError(f"Expected a vector of shape (3,) or (S, 3), found {vector.shape}.")
    if not isinstance(path, Tracer):
        path = np.asarray(path)
        is_off = (path < 0) | (path >= surface.num_vertices)
        if path.ndim != 1 or not path.size or is_off.any():
            found = path[is_off][0] if is_off.any() else f"shape {path.shape}"
            raise ValueError(f"Expected a path of vertices from 0 to {surface.num_vertices - 1}, found {found}.")
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
    """The index of a field in every face: how often it turns, counter-clockwise, on the way around; mostly zero.

    A multiple of 1 / symmetry. On a closed surface the indices sum to its Euler characteristic, whatever the field
    (Poincare and Hopf), so that a sphere has no field without one.

    Args:
        surface: the surface.
        X: (V, 3), one arm of the field at every vertex, nowhere zero.
        symmetry: how many arms it has: 1 for vectors, 2 for lines, 4 for crosses.

    The field is compared along the edges of the mesh by the shortest rotation between the normals.

    Source: Knoppel, Crane, Pinkall and Schroder (2013), Globally optimal direction fields,
    doi:10.1145/2461912.2462005, section 6.
    """
    _check_one(surface, X)
    z, corners = to_frame(surface, X), surface.faces
    normals, frames = surface.normals, surface.geometry.frames

    def angle(z):
        return jnp.arctan2(z[..., 1], z[..., 0])

    def turn(v, k):
        return angle(_turn(normals[v], frames[v], normals[k], frames[k]))

    own, after = corners, jnp.roll(corners, -1, axis=1)
    across = turn(after, own)  # from the frame of each corner to that of the next
    # The frames' own turning: the curvature of the face, which is small.
    holonomy = _wrapped(jnp.sum(across, axis=1))
    turning = _wrapped(symmetry * (angle(z[after]) - angle(z[own]) - across))
    return (jnp.sum(turning, axis=1) + symmetry * holonomy) / (2 * jnp.pi * symmetry)


def check_vectors(surface: Surface, X: AnyArray) -> None:
    """Raise where X has not the shape of one or several vector fields."""
    if X.ndim not in (2, 3) or X.shape[-1] != 3 or X.shape[0] != surface.num_vertices:
        raise ValueError(
            f"Expected vectors of shape ({surface.num_vertices}, 3) or ({surface.num_vertices}, S, 3), found {X.shape}."
        )


def _check_one(surface: Surface, X: AnyArray) -> None:
    if X.shape != (surface.num_vertices, 3):
        raise ValueError(f"Expected one field of shape ({surface.num_vertices}, 3), found {X.shape}.")


def check_tangent(surface: Surface, X: AnyArray) -> None:
    """Raise where vectors are not finite or stand on their tangent planes; nothing while their numbers are traced."""
    check_vectors(surface, X)
    if isinstance(X, Tracer) or surface.is_traced:
        return
    vectors, normals = np.asarray(X, np.float64), np.asarray(surface.normals, np.float64)
    rows = vectors.reshape(len(vectors), -1)
    if not np.isfinite(rows).all():
        raise ValueError(f"Expected finite vectors, found others at vertex {np.argmin(np.isfinite(rows).all(axis=1))}.")
    along = np.abs(np.einsum("v...c,vc->v...", vectors, normals)).reshape(len(rows), -1)
    length = np.linalg.norm(vectors, axis=-1).reshape(len(rows), -1)
    stands = (along > _NORMAL_SHARE * np.maximum(length, length.max() * 1e-6)).any(axis=1)
    if stands.any():
        first = int(np.argmax(stands))
        raise ValueError(
            f"Expected tangent vectors, but at vertex {first} the normal part is {along[first].max():.3g} of a length "
            f"of {length[first].max():.3g}. Take ltl.vectors.tangential(surface, X)."
        )


def _turn(normal: AnyArray, frame: AnyArray, from_normal: AnyArray, from_frame: AnyArray) -> Array:
    """The turn (..., 2), as cosine and sine, that takes components in one frame to those in another after transport."""
    moved = transport(from_normal, normal, from_frame[..., 0, :])
    return jnp.einsum("...ac,...c->...a", frame, moved)


def _turns(surface: Surface, table: Table, paths: tuple[Paths, ...] | None) -> PerBlock:
    """For every slot the turn (K, N, 2) from the neighbour's frame to the vertex's."""
    return places(surface.scheme, surface.topology, surface.geometry).turns(table, paths)


def power(z: Float[AnyArray, "*N 2"], exponent: int) -> Float[Array, "*N 2"]:
    """The power of complex numbers (..., 2), by as many multiplications."""
    out = z
    for _ in range(exponent - 1):
        real = out[..., 0] * z[..., 0] - out[..., 1] * z[..., 1]
        out = jnp.stack([real, out[..., 0] * z[..., 1] + out[..., 1] * z[..., 0]], axis=-1)
    return out


def _wrapped(angle: Array) -> Array:
    """The angle between -pi and pi."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def _turned_sum(connection: Connection, z: AnyArray) -> Array:
    """``sum_k w[k] (turn[k] z[k] - z)``, as complex numbers."""
    flat = z.reshape(z.shape[0], -1)
    cosine, sine = (
        difference_sum(connection.table, weights, flat, reverse).reshape(z.shape)
        for weights, reverse in zip(connection.turned, connection.reverse, strict=True)
    )
    x, y = (part.reshape(-1, *(1,) * (z.ndim - 2)) for part in connection.centre)
    real = cosine[..., 0] - sine[..., 1] + x * z[..., 0] - y * z[..., 1]
    return jnp.stack([real, cosine[..., 1] + sine[..., 0] + x * z[..., 1] + y * z[..., 0]], axis=-1)


def _beside(values: AnyArray, X: AnyArray) -> AnyArray:
    """Numbers (V,) or vectors (V, 3) at the vertices, shaped to meet the vectors of one or several fields."""
    return values.reshape(-1, *(1,) * (X.ndim - 2), values.size // len(values))
