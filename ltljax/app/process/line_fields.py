"""The direction fields whose lines a picture shows: directions of curvature, a field of crosses, or a rotation.

What enters: a `Subject` and the name of a field. What leaves: tangent vectors at its vertices.
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

# The time for which directions of curvature are smoothed, in squared edge lengths.
_SMOOTHING = 1.0
# Principal curvatures count as equal if they differ by less than this share of the largest curvature. Files round
# positions to six digits.
_EQUAL = 3e-3


def line_fields(subject: Subject, name: str) -> list[Float[Array, "V 3"]]:
    """The fields with a name: one field, or the two fields of the crosses.

    Directions are unit vectors. The rotation is about the vertical axis through the middle of the mesh; its length is
    proportional to the distance from the axis.

    Directions of curvature are smoothed over an edge, weighted by the difference of the principal curvatures: where
    the two are equal there is no direction, and the neighbourhood determines one.

    Raises:
        ValueError: a direction of curvature, and the principal curvatures are equal everywhere, as on a sphere.
    """
    surface = subject.surface
    if name == "cross":
        X = combed(surface, np.asarray(direction_field(surface, 4)))
        return [X, rotated(surface, X)]
    if name == "rotation":
        middle = (jnp.max(surface.vertices, axis=0) + jnp.min(surface.vertices, axis=0)) / 2
        # The vertical direction of pictures is y.
        axis = jnp.broadcast_to(jnp.asarray([0.0, 1.0, 0.0], surface.dtype), surface.vertices.shape)
        return [tangential(surface, jnp.cross(axis, surface.vertices - middle[None]))]
    bend = curvature(surface)
    difference = bend.principal[:, 0] - bend.principal[:, 1]
    _check_directions(surface, np.asarray(bend.principal), np.asarray(difference), name)
    guide = tangential(surface, difference[:, None] * bend.directions[:, 0 if name == "largest" else 1])
    return [direction_field(surface, 2, guide, _SMOOTHING * subject.mean_edge**2)]


def _check_directions(surface: Surface, principal: np.ndarray, difference: np.ndarray, name: str) -> None:
    components = np.asarray(surface.topology.components)
    # On a plane the curvature of the sphere of the same area sets the scale.
    scale = np.abs(principal).max() + np.sqrt(4 * np.pi / np.asarray(surface.vertex_areas).sum())
    largest_in_component = np.zeros(surface.topology.num_components)
    np.maximum.at(largest_in_component, components, difference)
    is_equal = difference.max() <= _EQUAL * scale
    if not is_equal and (largest_in_component > 0).all():
        return
    where = "everywhere" if is_equal else f"on all of component {int(np.argmin(largest_in_component))}"
    raise ValueError(
        f"There is no direction of {name} curvature: the surface bends alike in all directions {where}, as a sphere or "
        "a plane does. Choose another field, such as --field cross."
    )


def combed(surface: Surface, X: np.ndarray) -> Float[Array, "V 3"]:
    """One arm of every cross, chosen so that neighbouring arms are parallel except along cuts.

    From vertex to vertex along a spanning tree of the edges, the arm nearest to the previous one is taken.
    """
    normals, faces, num_vertices = np.asarray(surface.normals, np.float64), np.asarray(surface.faces), len(X)
    X = np.asarray(X, np.float64)
    arms = [X, np.cross(normals, X)]

    def quarter_turns(i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """The angle from the arm at j to the arm at i, in right angles."""
        transported = transport(normals[i], normals[j], X[i])
        cosine, sine = (np.sum(transported * arm[j], axis=1) for arm in arms)
        return np.arctan2(sine, cosine) / (np.pi / 2)

    i, j = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    # The minimum spanning tree follows edges along which the crosses differ least, so that cuts lie where they differ.
    mismatch = np.abs(quarter_turns(i, j) - np.round(quarter_turns(i, j))) + 1e-9
    shape = (num_vertices, num_vertices)
    tree = csgraph.minimum_spanning_tree(sparse.csr_matrix((mismatch, (i, j)), shape=shape))
    _, component = csgraph.connected_components(tree, directed=False)
    turns = np.zeros(num_vertices, np.int64)
    for root in np.unique(component, return_index=True)[1]:
        order, predecessors = csgraph.breadth_first_order(tree, root, directed=False)
        vertices = order[1:]
        parents = predecessors[vertices]
        increments = np.round(quarter_turns(parents, vertices)).astype(np.int64)
        for vertex, parent, increment in zip(vertices.tolist(), parents.tolist(), increments.tolist(), strict=True):
            turns[vertex] = turns[parent] + increment
    return jnp.asarray(np.where((turns % 2 == 1)[:, None], arms[1], X), surface.dtype)
