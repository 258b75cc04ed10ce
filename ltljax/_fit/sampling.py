"""Sampling of a field: at points in space, over patches, or by any weighted sums of its values at vertices."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy import sparse
from scipy.spatial import KDTree

from .._base.arguments import as_numbers
from .._surface import Surface, on_surface
from .._tables import AnyArray


class Sampling(eqx.Module):
    """Weighted sums of a field's values at vertices, one for each measurement.

    Attributes:
        vertices: vertices of each measurement, padded with vertex 0.
        weights: weights of the values at these vertices, padded with zeros.
        num_vertices: number of vertices of the surface.
    """

    vertices: Int[np.ndarray, "M K"]
    weights: Float[Array, "M K"]
    num_vertices: int = eqx.field(static=True)

    def __call__(self, u: Float[AnyArray, "..."], axis: int = 0) -> Float[Array, "..."]:
        """The measurements of a field.

        Args:
            u: field or series of fields with one axis of vertices.
            axis: axis of the vertices, which becomes the axis of the measurements.
        """
        u = jnp.moveaxis(jnp.asarray(u), axis, 0)
        terms = jnp.take(u, self.vertices, axis=0)
        weights = self.weights.astype(u.dtype).reshape(self.weights.shape + (1,) * (u.ndim - 1))
        return jnp.moveaxis(jnp.sum(weights * terms, axis=1), 0, axis)


@on_surface
def observe_at(surface: Surface, points: Float[AnyArray, "M 3"], within: float | None = None) -> Sampling:
    """Measurements at points in space: the field at the closest point of the surface, interpolated over its triangle.

    Linear interpolation has an error of second order in the mesh size. Data on another mesh of the same shape can be
    given at the vertices of that mesh.

    Args:
        surface: surface that carries the field.
        points: points in the coordinates of the mesh.
        within: largest accepted distance from the surface; by default the mesh size.

    Raises:
        ValueError: a point is farther from the surface, or not finite.

    Example:
        >>> import numpy as np
        >>> import ltljax as ltl
        >>> surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(3))
        >>> sampling = ltl.inverse.observe_at(surface, np.array([[0.6, 0.0, 0.8]]))
        >>> print(f"{sampling(surface.vertices[:, 0])[0]:.2f}")
        0.60
    """
    points = np.asarray(as_numbers("points", points), np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise ValueError(f"Expected points of shape (M, 3), found {points.shape}.")
    if not np.isfinite(points).all():
        raise ValueError(f"Point {np.argwhere(~np.isfinite(points))[0][0]} is not finite. Leave it out.")
    corners = np.asarray(surface.vertices, np.float64)[np.asarray(surface.faces)] + surface.centre
    faces, weights, distances = _closest(corners, points)
    reach = float(surface.mesh_size) if within is None else float(within)
    farthest = int(np.argmax(distances))
    if distances[farthest] > reach:
        raise ValueError(
            f"Point {farthest} at {_formatted(points[farthest])} is {distances[farthest]:.4g} from the surface, and "
            f"{int(np.sum(distances > reach))} of {len(points)} points are farther away than {reach:.4g}. Check the "
            "units and the position of the points, leave out those that are far, or allow the distance with within=."
        )
    return Sampling(np.asarray(surface.faces)[faces], jnp.asarray(weights, surface.dtype), surface.num_vertices)


@on_surface
def observe_patches(surface: Surface, patches: Sequence[Any] | AnyArray) -> Sampling:
    """Measurements that are averages over patches of the surface, weighted by the vertex areas.

    Args:
        surface: surface that carries the field.
        patches: vertices of each patch, as indices or masks (V,); or the number of the patch of each vertex (V,),
            counted from 0, and -1 for vertices of no patch.

    Raises:
        ValueError: a patch has no vertices, or a vertex is not one of the surface.

    Example:
        >>> import numpy as np
        >>> import ltljax as ltl
        >>> surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(3))
        >>> north = np.asarray(surface.vertices[:, 2]) > 0
        >>> print(f"{ltl.inverse.observe_patches(surface, [north])(surface.vertices[:, 2])[0]:.2f}")
        0.53
    """
    size = surface.num_vertices
    if isinstance(patches, np.ndarray | Array) and np.ndim(patches) == 1:
        numbers = np.asarray(patches)
        if numbers.shape != (size,) or not np.issubdtype(numbers.dtype, np.integer):
            raise ValueError(f"Expected the number of the patch of each of the {size} vertices, found {patches!r}.")
        members = [np.flatnonzero(numbers == number) for number in range(numbers.max(initial=-1) + 1)]
    else:
        members = [np.asarray(patch) for patch in patches]
        for number, patch in enumerate(members):
            is_mask = patch.dtype == bool and patch.shape == (size,)
            is_indices = np.issubdtype(patch.dtype, np.integer) and patch.ndim == 1
            if patch.size and not is_mask and not is_indices:
                raise ValueError(f"Expected patch {number} as vertices (N,) or a mask ({size},), found {patch!r}.")
        members = [np.flatnonzero(patch) if patch.dtype == bool else np.unique(patch) for patch in members]
    if not members:
        raise ValueError("Expected at least one patch, found none.")
    for number, patch in enumerate(members):
        if not patch.size:
            raise ValueError(f"Patch {number} has no vertices. Leave it out.")
        if patch.min() < 0 or patch.max() >= size:
            raise ValueError(f"Patch {number} has vertices outside 0 to {size - 1}.")
    areas = np.asarray(surface.vertex_areas, np.float64)
    rows = np.repeat(np.arange(len(members)), [len(patch) for patch in members])
    columns = np.concatenate(members)
    matrix = sparse.csr_array((areas[columns], (rows, columns)), shape=(len(members), size))
    return as_sampling(sparse.diags_array(1 / matrix.sum(axis=1)) @ matrix, surface.dtype)


def as_sampling(operator: Any, dtype: Any = None) -> Sampling:
    """The `Sampling` of an operator: a `Sampling`, or a matrix (M, V), dense or sparse.

    Raises:
        ValueError: the operator is not a matrix, an entry is not finite, or a row has no entries.
    """
    if isinstance(operator, Sampling):
        return operator
    if not sparse.issparse(operator):
        operator = np.asarray(as_numbers("operator", operator), np.float64)
        if operator.ndim != 2:
            raise ValueError(f"Expected an operator as a matrix (M, V), found an array of shape {operator.shape}.")
    matrix = sparse.csr_array(operator)
    matrix.eliminate_zeros()
    if not np.isfinite(matrix.data).all():
        raise ValueError("Expected an operator with finite entries.")
    counts = np.diff(np.asarray(matrix.indptr))
    if not len(counts) or not counts.all():
        raise ValueError(f"Row {int(np.argmin(counts)) if len(counts) else 0} of the operator has no entries.")
    slots = np.arange(counts.max()) < counts[:, None]
    vertices, weights = np.zeros(slots.shape, np.int32), np.zeros(slots.shape)
    vertices[slots], weights[slots] = matrix.indices, matrix.data
    return Sampling(vertices, jnp.asarray(weights, dtype or jnp.result_type(float)), int(operator.shape[1]))


def _closest(corners: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The triangle (M,) closest to each point, the barycentric weights (M, 3) of that point, and the distance (M,)."""
    from trimesh.triangles import closest_point, points_to_barycentric

    centroids = corners.mean(axis=1)
    radius = np.linalg.norm(corners - centroids[:, None], axis=2).max()
    tree = KDTree(centroids)
    # The closest triangle is at most as far as the closest corner, and its centroid at most a radius farther.
    reach = KDTree(corners.reshape(-1, 3)).query(points)[0] + radius * (1 + 1e-9)
    faces, weights, distances = [], [], []
    for point, nearby in zip(points, tree.query_ball_point(points, reach), strict=True):
        candidates = np.array(nearby)
        feet = closest_point(corners[candidates], np.broadcast_to(point, (len(candidates), 3)))
        lengths = np.linalg.norm(feet - point, axis=1)
        best = int(np.argmin(lengths))
        faces.append(candidates[best])
        weights.append(points_to_barycentric(corners[candidates[best]][None], feet[best][None])[0])
        distances.append(lengths[best])
    weights = np.clip(np.array(weights), 0, 1)
    return np.array(faces), weights / weights.sum(axis=1, keepdims=True), np.array(distances)


def _formatted(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in point) + ")"
