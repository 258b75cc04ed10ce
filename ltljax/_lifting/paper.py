"""The weights of the paper: the affine gradient on each lifted face, averaged over the faces with centroid weights.

Source: Chen, Chi and Wu, A new intrinsic numerical method for PDE on surfaces, arXiv 0907.1817, sections 2.2 to 2.4.
"""

from jaxtyping import Bool, Float, Int

from .._tables import AnyArray
from .ring import DEGENERATE, RingTopology, take_slots


def gradient_weights(lifted: Float[AnyArray, "K N 2"], topology: RingTopology) -> Float[AnyArray, "K N 2"]:
    """Weights w with grad h(v) = sum_k w[k] (h(v_k) - h(v)), in the coordinates of the frame.

    On the lifted face (0, a, b) the affine gradient g solves a.g = h_a - h_0 and b.g = h_b - h_0. Here a and b are the
    lifted corners, where the paper prints the corners themselves. The gradients of the faces are averaged with weights
    |(a + b) / 3|^-2. First order on irregular rings, second order on symmetric ones. A face is left out of the mean if
    its lift is degenerate or if its lifted centroid coincides with the vertex.
    """
    xp = lifted.__array_namespace__()
    num_slots = lifted.shape[0]
    a, b = lifted, take_slots(lifted, topology.following(num_slots))
    determinant, squared_centroid, has_face = _lifted_faces(a, b)
    centroid_weight = xp.where(has_face, 1 / xp.where(has_face, squared_centroid, 1), 0)
    total = xp.sum(centroid_weight, axis=0)
    face_weight = centroid_weight / xp.where(total > 0, total, 1)[None] / xp.where(has_face, determinant, 1)
    to_a = face_weight[..., None] * xp.stack([b[..., 1], -b[..., 0]], axis=-1)
    to_b = face_weight[..., None] * xp.stack([-a[..., 1], a[..., 0]], axis=-1)
    # Corner b of face k is in slot k + 1, so each slot sums the contributions of its own face and of the preceding one.
    return to_a + take_slots(to_b, topology.preceding(num_slots))


def dropped_faces(lifted: Float[AnyArray, "K N 2"], topology: RingTopology) -> Int[AnyArray, " N"]:
    """Number of faces in each ring that are left out of the mean because their lift is degenerate."""
    xp = lifted.__array_namespace__()
    _, _, has_face = _lifted_faces(lifted, take_slots(lifted, topology.following(lifted.shape[0])))
    num_faces = xp.where(topology.is_boundary, topology.valences - 1, topology.valences).clip(0)
    return num_faces - xp.sum(has_face, axis=0)


def _lifted_faces(
    a: Float[AnyArray, "K N 2"], b: Float[AnyArray, "K N 2"]
) -> tuple[Float[AnyArray, "K N"], Float[AnyArray, "K N"], Bool[AnyArray, "K N"]]:
    """Twice the signed areas of lifted faces (0, a, b), their squared centroid distances, and which enter the mean."""
    xp = a.__array_namespace__()
    determinant = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    squared_edges = xp.sum(a**2, axis=-1) * xp.sum(b**2, axis=-1)
    squared_centroid = xp.sum((a + b) ** 2, axis=-1) / 9
    has_face = determinant**2 > DEGENERATE**2 * squared_edges
    has_face &= squared_centroid > DEGENERATE**2 * xp.sum(a**2 + b**2, axis=-1)
    return determinant, squared_centroid, has_face
