"""Tangent frames, and the transport of tangent vectors between the tangent planes of neighbouring vertices."""

from jaxtyping import Float

from .._tables import AnyArray

# There is no unique shortest rotation between opposite normals; this bound keeps the formula finite there.
_NEARLY_OPPOSITE = 1e-9


def unit(vectors: Float[AnyArray, "*N 3"]) -> Float[AnyArray, "*N 3"]:
    """The vectors divided by their lengths. A zero vector becomes e3, with zero derivative."""
    xp = vectors.__array_namespace__()
    squared = xp.sum(vectors**2, axis=-1, keepdims=True)
    is_zero = squared == 0
    return xp.where(
        is_zero,
        xp.broadcast_to(xp.eye(3, dtype=vectors.dtype)[2], vectors.shape),
        vectors / xp.sqrt(xp.where(is_zero, 1, squared)),
    )


def tangent_frames(normals: Float[AnyArray, "N 3"]) -> Float[AnyArray, "N 2 3"]:
    """An orthonormal basis (e1, e2) of every tangent plane, with e1 x e2 = n.

    The frames are discontinuous where n_z changes sign. No operator depends on the choice of frame.

    Source: Duff and others (2017), Building an orthonormal basis, revisited (the branch-free construction).
    """
    xp = normals.__array_namespace__()
    x, y, z = normals[:, 0], normals[:, 1], normals[:, 2]
    sign = xp.where(z >= 0, 1, -1).astype(normals.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    e1 = xp.stack([1 + sign * x**2 * a, sign * b, -sign * x], axis=-1)
    e2 = xp.stack([b, sign + y**2 * a, -y], axis=-1)
    return xp.stack([e1, e2], axis=1)


def boundary_frames(
    normals: Float[AnyArray, "N 3"], to_next: Float[AnyArray, "N 3"], to_previous: Float[AnyArray, "N 3"]
) -> Float[AnyArray, "N 2 3"]:
    """Frames whose second vector is the outward conormal.

    The boundary tangent is the tangent of the parabola through the vertex and its two neighbours along the boundary, so
    the conormal is second order in the spacing even where the spacing is uneven.

    Args:
        normals: unit normals.
        to_next: offsets to the next vertex along the boundary.
        to_previous: offsets to the previous vertex along the boundary.
    """
    xp = normals.__array_namespace__()
    # The tangent is scaled by both squared lengths, which avoids a division and keeps empty rows finite.
    next_squared = xp.sum(to_next**2, axis=-1, keepdims=True)
    previous_squared = xp.sum(to_previous**2, axis=-1, keepdims=True)
    tangent = to_next * previous_squared - to_previous * next_squared
    conormal = unit(xp.cross(tangent, normals))
    return xp.stack([unit(xp.cross(conormal, normals)), conormal], axis=1)


def corner_conormals(
    normals: Float[AnyArray, "N 3"], to_next: Float[AnyArray, "N 3"], to_previous: Float[AnyArray, "N 3"]
) -> Float[AnyArray, "N 2 3"]:
    """The outward conormals of the two sides of a boundary corner.

    The first conormal belongs to the side towards the next vertex, the second to the side towards the previous one.
    """
    xp = normals.__array_namespace__()
    return xp.stack([unit(xp.cross(to_next, normals)), unit(xp.cross(-to_previous, normals))], axis=1)


def transport(
    source: Float[AnyArray, "*#N 3"], target: Float[AnyArray, "*#N 3"], vectors: Float[AnyArray, "*#N 3"]
) -> Float[AnyArray, "*#N 3"]:
    """Tangent vectors transported from the plane with normal ``source`` to the plane with normal ``target``.

    The transport is the shortest rotation that takes the source normal s to the target normal t. For X tangent at the
    source it is X - (t.X) / (1 + s.t) (s + t). The paper transports along an edge instead: see `layout.Places`.
    """
    xp = vectors.__array_namespace__()
    cosine = xp.sum(source * target, axis=-1, keepdims=True)
    along = xp.sum(target * vectors, axis=-1, keepdims=True)
    return vectors - along / xp.maximum(1 + cosine, _NEARLY_OPPOSITE) * (source + target)
