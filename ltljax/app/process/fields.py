"""Which directions does a picture of lines show? Those of curvature, of a field of crosses, or of a rotation.

What enters: a `Subject` and the name of a field. What leaves: tangent vectors on its vertices.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import sparse
from scipy.sparse import csgraph

from ..._lifting.frames import transport
from ..._operators import curvature, rotated, tangential
from ..._solve import direction_field
from ..._surface import Surface
from .subject import Subject

FIELDS = ("smallest", "largest", "cross", "rotation")
# For how long directions of curvature are smoothed, in squared edge lengths.
_SMOOTHING = 1.0
# Of the largest curvature, how far apart the two are that count as equal: files round positions to six digits.
_EQUAL = 3e-3


def line_fields(subject: Subject, name: str) -> list[Float[Array, "V 3"]]:
    """The fields that a name stands for: one, or the two of the crosses.

    Directions are unit vectors; the rotation is about the vertical through the middle, longer the farther from it, and
    zero on it.

    Directions of curvature are smoothed over an edge, each with the weight of the difference of the two curvatures:
    where both are equal there is no direction, and its surroundings decide.

    Raises:
        ValueError: a direction of curvature, and the two are equal everywhere, as on a sphere.
    """
    surface = subject.surface
    if name == "cross":
        X = combed(surface, np.asarray(direction_field(surface, 4)))
        return [X, rotated(surface, X)]
    if name == "rotation":
        middle = (jnp.max(surface.vertices, axis=0) + jnp.min(surface.vertices, axis=0)) / 2
        # About the vertical, as pictures have it.
        axis = jnp.broadcast_to(jnp.asarray([0.0, 1.0, 0.0], surface.dtype), surface.vertices.shape)
        return [tangential(surface, jnp.cross(axis, surface.vertices - middle[None]))]
    bent = curvature(surface)
    apart = bent.principal[:, 0] - bent.principal[:, 1]
    _check_directions(surface, np.asarray(bent.principal), np.asarray(apart), name)
    guide = tangential(surface, apart[:, None] * bent.directions[:, 0 if name == "largest" else 1])
    return [direction_field(surface, 2, guide, _SMOOTHING * subject.edge**2)]


def _check_directions(surface: Surface, principal: np.ndarray, apart: np.ndarray, name: str) -> None:
    components = np.asarray(surface.topology.components)
    # That of a sphere of the same area counts where nothing bends.
    scale = np.abs(principal).max() + np.sqrt(4 * np.pi / np.asarray(surface.vertex_areas).sum())
    of_components = np.zeros(surface.topology.num_components)
    np.maximum.at(of_components, components, apart)
    if apart.max() > _EQUAL * scale and (of_components > 0).all():
        return
    where = "everywhere" if apart.max() <= _EQUAL * scale else f"on all of component {int(np.argmin(of_components))}"
    raise ValueError(
        f"There is no direction of {name} curvature: the surface bends alike in all directions {where}, as a sphere or "
        "a plane does. Choose another field, such as --field cross."
    )


def combed(surface: Surface, X: np.ndarray) -> Float[Array, "V 3"]:
    """One arm of every cross, chosen so that neighbours agree but for the sign, except along cuts.

    Along the edges of a spanning tree each vertex takes the arm nearest to that of the one before.
    """
    normals, faces, count = np.asarray(surface.normals, np.float64), np.asarray(surface.faces), len(X)
    X = np.asarray(X, np.float64)
    arms = [X, np.cross(normals, X)]

    def angle(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """From the arm at j to that at i, in right angles."""
        carried = transport(normals[i], normals[j], X[i])
        cosine, sine = (np.sum(carried * arm[j], axis=1) for arm in arms)
        return np.arctan2(sine, cosine) / (np.pi / 2)

    i, j = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    # Of all trees that along which neighbours differ the least: a cut goes where they differ most.
    apart = np.abs(angle(i, j) - np.round(angle(i, j))) + 1e-9
    tree = csgraph.minimum_spanning_tree(sparse.csr_matrix((apart, (i, j)), shape=(count, count)))
    _, part = csgraph.connected_components(tree, directed=False)
    turns = np.zeros(count, np.int64)
    for root in np.unique(part, return_index=True)[1]:
        order, before = csgraph.breadth_first_order(tree, root, directed=False)
        later = order[1:]
        previous = before[later]
        more = np.round(angle(previous, later)).astype(np.int64)
        for vertex, where, turn in zip(later.tolist(), previous.tolist(), more.tolist(), strict=True):
            turns[vertex] = turns[where] + turn
    return jnp.asarray(np.where((turns % 2 == 1)[:, None], arms[1], X), surface.dtype)
