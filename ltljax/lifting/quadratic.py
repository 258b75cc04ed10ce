"""The quadratic fit through a vertex: weights of least norm that are exact on quadratic polynomials of the lifted ring.

With lifted coordinates (x, y) of the neighbours, weights c give a derivative at the vertex when their moments
``sum c x, sum c y, sum c xy, sum c x^2, sum c y^2`` are those of the derivative: (0, 0, 0, 2, 2) for the Laplacian,
(1, 0, 0, 0, 0) and (0, 1, 0, 0, 0) for the gradient. Among all such weights the ones with least ``sum c^2 r^2`` are
taken; they are the row of the least-squares fit of a quadratic with weights r^-2.

Source: the configuration equation of Wu, Chen and Chi, arXiv 1310.4807; here as a constrained least norm.
"""

from jaxtyping import Bool, Float

from ..tables import AnyArray
from .frames import tangent_frames, unit
from .ring import lifted_ring

_REFINEMENTS = 2


def laplacian_weights(
    lifted: Float[AnyArray, "K N 2"], is_boundary: Bool[AnyArray, " N"]
) -> tuple[Float[AnyArray, "K N"], Float[AnyArray, " N"]]:
    """Weights c with Delta u(v) = sum_k c[k] (u(v_k) - u(v)), non-negative, and the moment residual of each row.

    At a boundary vertex the second frame vector is the conormal and the condition ``sum c y = 0`` is dropped: the row
    is then exact for fields whose normal derivative vanishes (homogeneous Neumann); a flux q adds -q sum c y.

    Rounding below zero is cut off. On a support where the fit is negative, or has no solution, the cut makes the row
    inconsistent, and the residual says so: half the largest error of a moment, zero to rounding where a row is exact.
    Pointwise first order on irregular meshes, second where rings are symmetric; second order in solved problems.
    """
    xp = lifted.__array_namespace__()
    moments, weights, scale = ring_moments(lifted, is_boundary)
    target = xp.array([0, 0, 0, 2, 2], lifted.dtype)
    c = xp.maximum(_least_norm(moments, weights, target[None]), 0)
    error = target[:, None] - _apply_moments(moments, c)[0]
    residual = xp.max(xp.abs(error), axis=0) / 2
    return c[0] / scale[None] ** 2, residual


def gradient_weights(lifted: Float[AnyArray, "K N 2"]) -> Float[AnyArray, "K N 2"]:
    """Weights w with grad u(v) = sum_k w[k] (u(v_k) - u(v)), in the coordinates of the frame. Second order.

    The support must hold five neighbours in general position; fewer leave the quadratic terms unmatched.
    """
    xp = lifted.__array_namespace__()
    moments, weights, scale = ring_moments(lifted, xp.zeros(lifted.shape[1], bool))
    rows = _least_norm(moments, weights, xp.eye(2, 5, dtype=lifted.dtype))
    return xp.moveaxis(rows, 0, -1) / scale[None, :, None]


def refined_normals(offsets: Float[AnyArray, "K N 3"], normals: Float[AnyArray, "N 3"]) -> Float[AnyArray, "N 3"]:
    """Unit normals of the quadratic height fit over the planes of the given normals: second order in the mesh size.

    Over the plane of a first-order normal n the surface is z(x, y); the fit's slope (z_x, z_y) at the vertex turns n
    into the direction of n - z_x e1 - z_y e2.
    """
    xp = offsets.__array_namespace__()
    frames = tangent_frames(normals)
    weights = gradient_weights(lifted_ring(offsets, frames, "projection"))
    heights = xp.einsum("knc,nc->kn", offsets, normals)
    slope = xp.einsum("kna,kn->na", weights, heights)
    return unit(normals - xp.einsum("na,nac->nc", slope, frames))


def ring_moments(
    lifted: Float[AnyArray, "K N 2"], is_boundary: Bool[AnyArray, " N"]
) -> tuple[Float[AnyArray, "5 K N"], Float[AnyArray, "K N"], Float[AnyArray, " N"]]:
    """The five moments (5, K, N) of the ring scaled to mean square radius one, the weights r^-2, and the scale."""
    xp = lifted.__array_namespace__()
    squared = xp.sum(lifted**2, axis=-1)
    is_used = squared > 0
    count = xp.maximum(xp.sum(is_used, axis=0), 1).astype(lifted.dtype)
    mean_square = xp.sum(squared, axis=0) / count
    scale = xp.sqrt(xp.where(mean_square > 0, mean_square, 1))
    x, y = lifted[..., 0] / scale[None], lifted[..., 1] / scale[None]
    weights = xp.where(is_used, scale[None] ** 2 / xp.where(is_used, squared, 1), 0)
    return xp.stack([x, xp.where(is_boundary[None], 0, y), x * y, x**2, y**2]), weights, scale


def _apply_moments(moments, c):
    return moments.__array_namespace__().einsum("ikn,rkn->rin", moments, c)


def moment_matrix(moments: Float[AnyArray, "5 K N"], weights: Float[AnyArray, "K N"]) -> Float[AnyArray, "5 5 N"]:
    """The matrix A W A^T of every row; a ring determines a quadratic where it has full rank."""
    return moments.__array_namespace__().einsum("ikn,jkn->ijn", moments * weights[None], moments)


def _least_norm(
    moments: Float[AnyArray, "5 K N"], weights: Float[AnyArray, "K N"], targets: Float[AnyArray, "R 5"]
) -> Float[AnyArray, "R K N"]:
    """c = W A^T (A W A^T)^-1 b by a ridge and refinement, so that a matrix without full rank is no special case."""
    xp = moments.__array_namespace__()
    matrix = moment_matrix(moments, weights)
    trace = xp.trace(matrix)
    # Small enough for the refinement to restore full accuracy, large enough that a matrix without full rank (four
    # neighbours, a mirrored ring) does not magnify rounding.
    ridge = xp.where(trace > 0, xp.finfo(matrix.dtype).eps ** (2 / 3) * trace / 5, 1)
    identity = xp.eye(5, dtype=matrix.dtype)[:, :, None]
    inverse = _inverse(matrix + ridge[None, None] * identity)
    weighted = moments * weights[None]
    c = xp.zeros((targets.shape[0], *weights.shape), dtype=weights.dtype)
    for _ in range(1 + _REFINEMENTS):
        multipliers = xp.einsum("ijn,rjn->rin", inverse, targets[:, :, None] - _apply_moments(moments, c))
        c = c + xp.einsum("ikn,rin->rkn", weighted, multipliers)
    return c


def _inverse(matrix: Float[AnyArray, "M M N"]) -> Float[AnyArray, "M M N"]:
    """The inverses of symmetric positive definite matrices, by Cholesky.

    Five unknowns for every vertex at once: written out over rows of length N it fuses, where a batched factorisation
    would call LAPACK once a vertex.
    """
    xp = matrix.__array_namespace__()
    size = matrix.shape[0]
    factor: list[list[AnyArray]] = []
    for i in range(size):
        row: list[AnyArray] = []
        for j in range(i):
            row.append((matrix[i, j] - _dot(row, factor[j][:j])) / factor[j][j])
        factor.append([*row, xp.sqrt(matrix[i, i] - _dot(row, row))])
    # The inverse of the factor, column by column; the columns' upper parts are zero.
    columns = []
    for j in range(size):
        column = [1 / factor[j][j]]
        for i in range(j + 1, size):
            column.append(-_dot(factor[i][j:i], column) / factor[i][i])
        columns.append(xp.stack([xp.zeros_like(matrix[0, 0])] * j + column))
    inverse_factor = xp.stack(columns)
    return xp.einsum("imn,jmn->ijn", inverse_factor, inverse_factor)


def _dot(left: list[AnyArray], right: list[AnyArray]) -> AnyArray | float:
    return sum((a * b for a, b in zip(left, right, strict=True)), 0.0)
