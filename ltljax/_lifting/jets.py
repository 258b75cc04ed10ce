"""The polynomial fit through a vertex: weights of its derivatives, and of every operator composed of them.

Let (x, y) be the lifted coordinates of the neighbours. Weights c represent an operator at the vertex if their moments
``sum c x, sum c y, sum c xy, sum c x^2, sum c y^2`` equal the values of the operator on these monomials, and if all
moments of higher degree are zero. The values are (1, 0, 0, 0, 0) for d/dx and (0, 0, 0, 2, 2) for the Laplacian.

Among all such weights, the ones that minimise ``sum c^2 / w`` are taken. They are the rows of the least-squares fit of
a polynomial through the vertex with weights w. With r the distance from the vertex, quadratic fits use w = r^-4, which
gives the most accurate diffusion. Fits of degree 3 and 4 use twice as many neighbours as necessary, and are most
accurate with w = r^-2. The first and second derivatives of the fit are called the jet of the field.

Source: Wu, Chen and Chi, arXiv 1310.4807 (the configuration equation), here as a constrained least-norm problem of any
degree.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._tables import AnyArray
from .frames import tangent_frames, unit
from .ring import lifted_ring

# Values of operators on x, y, xy, x^2 and y^2 at the vertex. The jet is u_x, u_y, u_xx, u_xy, u_yy.
JET = np.array([[1, 0, 0, 0, 0], [0, 1, 0, 0, 0], [0, 0, 0, 2, 0], [0, 0, 1, 0, 0], [0, 0, 0, 0, 2]], float)
LAPLACIAN = np.array([[0, 0, 0, 2, 2]], float)
# Kinds of vertices. Besides the values at the neighbours, a row knows the flux on a smooth boundary, and the fluxes of
# both sides at a corner, whose angle is either close to a right angle or not.
INTERIOR, SMOOTH, RIGHT_CORNER, OTHER_CORNER = range(4)
_REFINEMENTS = 2


def num_monomials(degree: int) -> int:
    """Number of monomials of degree 1 to ``degree``, the fewest neighbours that can determine a fit."""
    return (degree + 1) * (degree + 2) // 2 - 1


def operator_weights(
    lifted: Float[AnyArray, "K N 2"],
    kinds: Int[AnyArray, " N"],
    targets: Float[AnyArray, "R 5 #N"],
    degree: int = 2,
    *,
    nonnegative: bool = False,
    emphasis: float = 1.0,
) -> tuple[Float[AnyArray, "R K N"], Float[AnyArray, "R N"]]:
    """Weights c of R operators, each as sum_k c[k] (u(v_k) - u(v)), and the moment residual of each row.

    On a smooth boundary the second axis is the outward conormal, and the condition on ``sum c y`` is dropped. The row
    is then exact for fields whose normal derivative vanishes, and a flux q adds -q sum c y.

    At a corner the two fluxes determine the gradient. If they vanish, a right angle also implies that the mixed
    derivative along its sides is zero, and any other angle implies u_xx = u_yy and u_xy = 0 for smooth fields.
    Therefore a right corner keeps the conditions on ``sum c x^2`` and ``sum c y^2``, and another corner keeps only the
    condition on their sum.

    Args:
        lifted: lifted neighbours; an empty slot holds zero.
        kinds: kind of every vertex, from `INTERIOR` to `OTHER_CORNER`.
        targets: values of each operator on x, y, xy, x^2, y^2 at the vertex.
        degree: degree of the polynomial. If the support does not determine it, the highest terms stay unmatched.
        nonnegative: whether to clip negative weights to zero. This makes a row inconsistent if its fit has negative
            weights, which the residual shows.
        emphasis: factor by which the conditions on sum c x and sum c y count more where not all conditions can be met.

    Returns:
        The weights, and for each row the largest error of a condition divided by the largest target. For consistent
        rows this is rounding error.
    """
    xp = lifted.__array_namespace__()
    moments, weights, scale = ring_moments(lifted, kinds, degree, emphasis)
    quadratic = conditions(scaled_targets(targets, scale, emphasis), kinds, 1)
    higher = xp.zeros((targets.shape[0], moments.shape[0] - 5, quadratic.shape[2]), dtype=lifted.dtype)
    right_hand_sides = xp.concatenate([quadratic, higher], axis=1)
    c = _least_norm(moments, weights, right_hand_sides)
    if nonnegative:
        c = xp.maximum(c, 0)
    return c / scale[None, None] ** 2, relative_residual(right_hand_sides, _products(moments, c), emphasis)


def jet_weights(lifted: Float[AnyArray, "K N 2"], degree: int) -> Float[AnyArray, "5 K N"]:
    """Weights of u_x, u_y, u_xx, u_xy and u_yy in the coordinates of the frame.

    The order of accuracy is ``degree`` for first derivatives and ``degree - 1`` for second derivatives. On symmetric
    rings an odd order increases by one.
    """
    xp = lifted.__array_namespace__()
    kinds = xp.full(lifted.shape[1], INTERIOR, dtype=np.int8)
    return operator_weights(lifted, kinds, xp.asarray(JET, dtype=lifted.dtype)[..., None], degree)[0]


def refined_normals(
    offsets: Float[AnyArray, "K N 3"], normals: Float[AnyArray, "N 3"], degree: int
) -> Float[AnyArray, "N 3"]:
    """Unit normals of order ``degree``, from a polynomial fit to the height over the planes of the given normals.

    Over the plane of a first-order normal n the surface is a graph z(x, y). With the slopes (z_x, z_y) of the fit at
    the vertex, the refined normal is n - z_x e1 - z_y e2, normalised.
    """
    xp = offsets.__array_namespace__()
    frames = tangent_frames(normals)
    height = height_jet(offsets, normals, jet_weights(lifted_ring(offsets, frames, "projection"), degree))
    return unit(normals - xp.einsum("an,nac->nc", height[:2], frames))


def height_jet(
    offsets: Float[AnyArray, "K N 3"], normals: Float[AnyArray, "N 3"], weights: Float[AnyArray, "5 K N"]
) -> Float[AnyArray, "5 N"]:
    """The jet of the surface's height over its tangent planes: two slopes and the second fundamental form."""
    xp = offsets.__array_namespace__()
    return xp.sum(weights * xp.sum(offsets * normals[None], axis=-1)[None], axis=1)


def laplacian_targets(height: Float[AnyArray, "5 N"]) -> Float[AnyArray, "1 5 N"]:
    """The values of the Laplace-Beltrami operator on x, y, xy, x^2, y^2, coordinates of a nearly tangent plane.

    If the surface is the graph of z, its metric is g_ij = delta_ij + z_i z_j, and
    Delta u = g^ij (u_ij - z_ij z_k u_k / (1 + |grad z|^2)).
    """
    xp = height.__array_namespace__()
    zx, zy, zxx, zxy, zyy = height
    determinant = 1 + zx**2 + zy**2
    gxx, gxy, gyy = (1 + zy**2) / determinant, -zx * zy / determinant, (1 + zx**2) / determinant
    bend = (gxx * zxx + 2 * gxy * zxy + gyy * zyy) / determinant
    return xp.stack([-bend * zx, -bend * zy, 2 * gxy, 2 * gxx, 2 * gyy])[None]


def covariant(height: Float[AnyArray, "5 N"], weights: Float[AnyArray, "5 K N"]) -> Float[AnyArray, "5 K N"]:
    """The weights of a jet whose second derivatives are covariant: u_ij - z_ij z_k u_k / (1 + |grad z|^2)."""
    xp = height.__array_namespace__()
    along = xp.einsum("an,akn->kn", height[:2] / (1 + xp.sum(height[:2] ** 2, axis=0))[None], weights[:2])
    return xp.concatenate([weights[:2], weights[2:] - height[2:, None] * along[None]])


def ring_moments(
    lifted: Float[AnyArray, "K N 2"], kinds: Int[AnyArray, " N"], degree: int, emphasis: float = 1.0
) -> tuple[Float[AnyArray, "M K N"], Float[AnyArray, "K N"], Float[AnyArray, " N"]]:
    """The moments of the ring scaled to mean square radius one, the weights of the fit, and the scale."""
    xp = lifted.__array_namespace__()
    squared = xp.sum(lifted**2, axis=-1)
    is_used = squared > 0
    count = xp.maximum(xp.sum(is_used, axis=0), 1).astype(lifted.dtype)
    mean_square = xp.sum(squared, axis=0) / count
    scale = xp.sqrt(xp.where(mean_square > 0, mean_square, 1))
    x, y = lifted[..., 0] / scale[None], lifted[..., 1] / scale[None]
    weights = xp.where(is_used, scale[None] ** 2 / xp.where(is_used, squared, 1), 0)
    weights = weights**2 if degree == 2 else weights
    moments = conditions(xp.stack([emphasis * x, emphasis * y, x * y, x**2, y**2]), kinds, 0)
    # Products, because powers are slow in NumPy.
    higher, highest = [], [x**2, x * y, y**2]
    for _ in range(3, degree + 1):
        highest = [x * monomial for monomial in highest] + [y * highest[-1]]
        higher += highest
    return xp.concatenate([moments, xp.stack(higher)]) if higher else moments, weights, scale


def scaled_targets(
    targets: Float[AnyArray, "R 5 #N"], scale: Float[AnyArray, " N"], emphasis: float = 1.0
) -> Float[AnyArray, "R 5 N"]:
    """The targets rescaled like `ring_moments`, for weights times scale^2 on rings divided by scale."""
    xp = targets.__array_namespace__()
    factors = xp.stack([emphasis * scale] * 2 + [xp.ones_like(scale)] * 3)
    return targets * factors[None]


def relative_residual(
    targets: Float[AnyArray, "R M N"], moments: Float[AnyArray, "R M N"], emphasis: float = 1.0
) -> Float[AnyArray, "R N"]:
    """The largest error of a moment divided by the largest target of the row, both without the emphasis."""
    xp = targets.__array_namespace__()

    def largest(values):
        linear, others = xp.max(xp.abs(values[:, :2]), axis=1) / emphasis, xp.max(xp.abs(values[:, 2:]), axis=1)
        return xp.maximum(linear, others)

    size = largest(targets)
    return largest(targets - moments) / xp.where(size > 0, size, 1)


def conditions(values: AnyArray, kinds: Int[AnyArray, " N"], axis: int) -> AnyArray:
    """The conditions that a row of each kind keeps, from values for x, y, xy, x^2, y^2 along an axis.

    A condition that is dropped becomes zero. `OTHER_CORNER` replaces the last two conditions by their mean.
    """
    xp = values.__array_namespace__()
    x, y, xy, xx, yy = xp.moveaxis(values, axis, 0)
    kinds = kinds.reshape((1,) * (x.ndim - 1) + kinds.shape)
    is_other = kinds == OTHER_CORNER
    mean = (xx + yy) / 2
    rows = (
        xp.where(kinds >= RIGHT_CORNER, 0, x),
        xp.where(kinds >= SMOOTH, 0, y),
        xp.where(kinds >= RIGHT_CORNER, 0, xy),
        xp.where(is_other, mean, xx),
        xp.where(is_other, mean, yy),
    )
    return xp.stack(rows, axis=axis)


def _products(a: Float[AnyArray, "I K N"], b: Float[AnyArray, "R K N"]) -> Float[AnyArray, "R I N"]:
    """The sums over k of a[i, k] b[r, k], for all vertices."""
    if isinstance(a, np.ndarray):
        return np.einsum("ikn,rkn->rin", a, b)
    # XLA fuses this sum into its surroundings. A batched matrix product takes three times as long on a CPU.
    return jnp.sum(a[None] * b[:, None], axis=2)


def moment_matrix(moments: Float[AnyArray, "M K N"], weights: Float[AnyArray, "K N"]) -> Float[AnyArray, "M M N"]:
    """The matrix A W A^T of every row. A ring determines a polynomial if this matrix has full rank."""
    return _products(moments, moments * weights[None])


def _least_norm(
    moments: Float[AnyArray, "M K N"], weights: Float[AnyArray, "K N"], targets: Float[AnyArray, "R M #N"]
) -> Float[AnyArray, "R K N"]:
    """c = W A^T (A W A^T)^-1 b. A ridge with iterative refinement handles rank-deficient matrices without branches."""
    xp = moments.__array_namespace__()
    matrix = moment_matrix(moments, weights)
    size, eps = matrix.shape[0], xp.finfo(matrix.dtype).eps
    mean = xp.trace(matrix) / size
    unscaled = 1 / xp.where(mean > 0, mean, 1)
    # The ridge is small enough for refinement to restore full accuracy, and large enough to keep a rank-deficient
    # matrix (four neighbours, a mirror-symmetric ring) from amplifying rounding errors.
    ridge = eps ** (2 / 3) * xp.eye(size, dtype=matrix.dtype)[..., None]
    inverse = _inverse(matrix * unscaled[None, None] + ridge) * unscaled[None, None]
    columns = xp.moveaxis(moments * weights[None], 0, 1)
    c = xp.zeros((targets.shape[0], *weights.shape), dtype=weights.dtype)
    for _ in range(1 + _REFINEMENTS):
        c = c + _products(columns, _products(inverse, targets - _products(moments, c)))
    return c


def _inverse(matrix: Float[AnyArray, "M M N"]) -> Float[AnyArray, "M M N"]:
    """The inverses of symmetric positive definite matrices with mean diagonal one, for all vertices."""
    return _sweep(matrix) if isinstance(matrix, np.ndarray) else _differentiable_inverse(matrix)


@jax.custom_jvp
def _differentiable_inverse(matrix: Float[Array, "M M N"]) -> Float[Array, "M M N"]:
    return _sweep(matrix)


@_differentiable_inverse.defjvp
def _(primals, tangents):
    inverse = _differentiable_inverse(*primals)
    return inverse, -_products(inverse, _products(tangents[0], inverse))


def _sweep(matrix: AnyArray) -> Any:
    """The inverses by Gauss-Jordan elimination without pivoting, as rank-one updates of whole arrays.

    A batched factorisation would call LAPACK once per vertex.

    Source: Goodnight (1979), A tutorial on the sweep operator.
    """
    xp = matrix.__array_namespace__()
    identity = xp.eye(matrix.shape[0], dtype=matrix.dtype)

    def eliminate(k, swept):
        pivot, unit_vector = swept[k, k], identity[k]
        # Subtracting one from the pivot makes the update also divide the pivot's row and column by the pivot.
        row = swept[k] - unit_vector[:, None]
        outer = (unit_vector[:, None] * unit_vector[None])[..., None]
        return swept - row[:, None] * (row / pivot[None])[None] - 2 * outer

    if not isinstance(matrix, np.ndarray):
        return -jax.lax.fori_loop(0, len(matrix), eliminate, matrix)
    swept = matrix
    for k in range(len(matrix)):
        swept = eliminate(k, swept)
    return -swept
