"""Which measure does a diffusion conserve? (host)

What enters: the matrix L of a diffusion, with non-negative weights off the diagonal and rows that sum to zero, and the
vertex areas. What leaves: weights m with ``m^T L = 0``, so that ``sum(m * u)`` is constant in time.
"""

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from scipy.sparse import csgraph


def stationary_measure(generator: scipy.sparse.csr_array, areas: np.ndarray) -> np.ndarray:
    """The limit of ``exp(t L)^T areas`` for large t, (V,) non-negative.

    L is the generator of a random walk, and the limit is the distribution of a walker that starts in proportion to the
    areas. It satisfies ``m^T L = 0``, has the same sum as the areas on every connected component, and is zero at a
    vertex that no other vertex's row uses. The walk ends in classes of vertices that it never leaves, usually one for
    each component; each class has one stationary measure, scaled by the area that ends up in it.
    """
    # Recompute the diagonal: in float32 the rows sum to zero only approximately.
    rates = scipy.sparse.csr_array(generator, dtype=np.float64)
    rates.setdiag(0)
    rates.eliminate_zeros()
    generator = scipy.sparse.csr_array(rates - scipy.sparse.diags_array(rates.sum(axis=1)))
    num_classes, label = csgraph.connected_components(generator, directed=True, connection="strong")
    rows, columns = generator.nonzero()
    is_closed = np.ones(num_classes, bool)
    is_closed[label[rows[label[rows] != label[columns]]]] = False
    is_recurrent = is_closed[label]
    final_areas = areas.astype(np.float64).copy()
    if not is_recurrent.all():
        transposed = scipy.sparse.csc_array(generator.T)
        transient = np.flatnonzero(~is_recurrent)
        # The expected time at each transient vertex gives the flow from there to the recurrent ones.
        times = _solve(transposed[transient][:, transient], -final_areas[transient])
        final_areas = np.where(is_recurrent, final_areas + transposed[:, transient] @ times, 0)
    area_of_class = np.bincount(label, weights=final_areas, minlength=num_classes)

    measure = np.zeros(len(areas))
    # Setting one vertex of each class to one makes the system of the other vertices regular.
    _, first = np.unique(np.where(is_recurrent, label, -1), return_index=True)
    first = first[is_recurrent[first]]
    measure[first] = 1
    is_free = is_recurrent.copy()
    is_free[first] = False
    free = np.flatnonzero(is_free)
    transposed = scipy.sparse.csc_array(generator.T)[free]
    measure[free] = _solve(transposed[:, free], -(transposed[:, first] @ measure[first]))
    total = np.bincount(label, weights=measure, minlength=num_classes)
    return np.maximum(measure * (area_of_class / np.where(total > 0, total, 1))[label], 0)


def _solve(matrix, right_hand_side: np.ndarray) -> np.ndarray:
    """The solution by sparse elimination, with one step of iterative refinement."""
    if not len(right_hand_side):
        return right_hand_side
    factors = scipy.sparse.linalg.splu(scipy.sparse.csc_matrix(matrix))
    solution = factors.solve(right_hand_side)
    return solution + factors.solve(right_hand_side - matrix @ solution)
