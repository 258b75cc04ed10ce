"""Which measure does a diffusion conserve?

What enters: the matrix L of a diffusion, with non-negative weights off the diagonal and rows that sum to zero, and the
vertex areas (host). What leaves: weights m with ``m^T L = 0``, so that ``sum(m * u)`` stays what it is.
"""

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from scipy.sparse import csgraph


def stationary_measure(generator: scipy.sparse.csr_array, areas: np.ndarray) -> np.ndarray:
    """Where the areas end up when they are carried along by the random walk of the generator, (V,) non-negative.

    The limit of ``exp(t L)^T areas``: it satisfies ``m^T L = 0``, sums to the area on every connected component, and is
    zero at a vertex that no other vertex's row uses. The walk ends in classes of vertices that it does not leave, as a
    rule one for each component; each class has one stationary measure, scaled by the area that ends there.
    """
    # Rows are made to sum to zero anew: in float32 they only nearly do.
    rates = scipy.sparse.csr_array(generator, dtype=np.float64)
    rates.setdiag(0)
    rates.eliminate_zeros()
    generator = scipy.sparse.csr_array(rates - scipy.sparse.diags_array(rates.sum(axis=1)))
    num_classes, label = csgraph.connected_components(generator, directed=True, connection="strong")
    rows, columns = generator.nonzero()
    is_closed = np.ones(num_classes, bool)
    is_closed[label[rows[label[rows] != label[columns]]]] = False
    stays = is_closed[label]
    ending = areas.astype(np.float64).copy()
    if not stays.all():
        transposed = scipy.sparse.csc_array(generator.T)
        passing = np.flatnonzero(~stays)
        # The time spent at each vertex that is left for good, then what flows from there to where it stays.
        spent = _solve(transposed[passing][:, passing], -ending[passing])
        ending = np.where(stays, ending + transposed[:, passing] @ spent, 0)
    per_class = np.bincount(label, weights=ending, minlength=num_classes)

    measure = np.zeros(len(areas))
    # One vertex of each class is set to one, which makes the rest of the class a regular system.
    _, first = np.unique(np.where(stays, label, -1), return_index=True)
    first = first[stays[first]]
    measure[first] = 1
    is_free = stays.copy()
    is_free[first] = False
    free = np.flatnonzero(is_free)
    transposed = scipy.sparse.csc_array(generator.T)[free]
    measure[free] = _solve(transposed[:, free], -(transposed[:, first] @ measure[first]))
    total = np.bincount(label, weights=measure, minlength=num_classes)
    return np.maximum(measure * (per_class / np.where(total > 0, total, 1))[label], 0)


def _solve(matrix, right: np.ndarray) -> np.ndarray:
    """The solution by sparse elimination, with one step of refinement."""
    if not len(right):
        return right
    factors = scipy.sparse.linalg.splu(scipy.sparse.csc_matrix(matrix))
    solution = factors.solve(right)
    return solution + factors.solve(right - matrix @ solution)
