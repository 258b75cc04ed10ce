"""The polynomial fit through a vertex: weights of its derivatives, and of every operator made of them.

With lifted coordinates (x, y) of the neighbours, weights c give an operator at the vertex when their moments
``sum c x, sum c y, sum c xy, sum c x^2, sum c y^2`` are what the operator makes of these monomials: (1, 0, 0, 0, 0) for
d/dx, (0, 0, 0, 2, 2) for the Laplacian; and zero for every further monomial of the degree. Among all such weights
those of least ``sum c^2 / w`` are taken: the rows of the least-squares fit of a polynomial through the vertex with
weights w. With w = r^-4, r the distance, diffusion is most accurate; fits of degree 3 and 4 have twice the neighbours
they need, and are best with w = r^-2. The first and second derivatives of the fit are the jet of the field.

Source: the configuration equation of Wu, Chen and Chi, arXiv 1310.4807; here as a constrained least norm, of any
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

# What an operator makes of x, y, xy, x^2 and y^2 at the vertex. The jet is u_x, u_y, u_xx, u_xy, u_yy.
JET = np.array([[1, 0, 0, 0, 0], [0, 1, 0, 0, 0], [0, 0, 0, 2, 0], [0, 0, 1, 0, 0], [0, 0, 0, 0, 2]], float)
LAPLACIAN = np.array([[0, 0, 0, 2, 2]], float)
# What is known of a field at a vertex besides its neighbours: nothing inside, the flux on a smooth boundary, both
# fluxes at a corner, of about a right angle or of another.
INTERIOR, SMOOTH, RIGHT_CORNER, OTHER_CORNER = range(4)
_REFINEMENTS = 2


def num_monomials(degree: int) -> int:
    """The number of monomials of degree 1 to ``degree``: the fewest neighbours that can determine a fit."""
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

    At a vertex of a smooth boundary the second axis is the outward conormal, and the condition on ``sum c y`` is
    dropped: the row is then exact for fields whose normal derivative vanishes, and a flux q adds -q sum c y. At a
    corner both fluxes determine the gradient, and where they vanish also the mixed derivative along the sides of a
    right angle; at another angle a smooth field without flux has u_xx = u_yy and u_xy = 0. So a right corner keeps the
    conditions on ``sum c x^2`` and ``sum c y^2``, and another one only that on their sum.

    Args:
        lifted: the neighbours; an empty slot holds zero.
        kinds: `INTERIOR` to `OTHER_CORNER` for every row.
        targets: what each operator makes of x, y, xy, x^2, y^2 at the vertex.
        degree: of the polynomial; a support that does not determine it leaves the highest terms unmatched.
        nonnegative: cut weights off below zero. On a support where the fit is negative or has no solution this makes
            the row inconsistent, and the residual says so.
        emphasis: how much more the conditions on sum c x and sum c y count where not all can be met.

    Returns:
        The weights, and the largest error of a condition over the largest target: rounding, where a row is exact.
    """
    xp = lifted.__array_namespace__()
    moments, weights, scale = ring_moments(lifted, kinds, degree, emphasis)
    wanted = conditions(scaled_targets(targets, scale, emphasis), kinds, 1)
    rest = xp.zeros((targets.shape[0], moments.shape[0] - 5, wanted.shape[2]), dtype=lifted.dtype)
    wanted = xp.concatenate([wanted, rest], axis=1)
    c = _least_norm(moments, weights, wanted)
    if nonnegative:
        c = xp.maximum(c, 0)
    return c / scale[None, None] ** 2, relative_residual(wanted, _products(moments, c), emphasis)


def jet_weights(lifted: Float[AnyArray, "K N 2"], degree: int) -> Float[AnyArray, "5 K N"]:
    """Weights of u_x, u_y, u_xx, u_xy and u_yy in the coordinates of the frame.

    Of order ``degree`` for the first derivatives and ``degree - 1`` for the second; on symmetric rings the order is
    rounded up to the next even number.
    """
    xp = lifted.__array_namespace__()
    inside = xp.zeros(lifted.shape[1], dtype=np.int8)
    return operator_weights(lifted, inside, xp.asarray(JET, dtype=lifted.dtype)[..., None], degree)[0]


def refined_normals(
    offsets: Float[AnyArray, "K N 3"], normals: Float[AnyArray, "N 3"], degree: int
) -> Float[AnyArray, "N 3"]:
    """Unit normals of the polynomial height fit over the planes of the given normals: of order ``degree``.

    Over the plane of a first-order normal n the surface is z(x, y); the fit's slope (z_x, z_y) at the vertex turns n
    into the direction of n - z_x e1 - z_y e2.
    """
    xp = offsets.__array_namespace__()
    frames = tangent_frames(normals)
    height = height_jet(offsets, normals, jet_weights(lifted_ring(offsets, frames, "projection"), degree))
    return unit(normals - xp.einsum("an,nac->nc", height[:2], frames))


def height_jet(
    offsets: Float[AnyArray, "K N 3"], normals: Float[AnyArray, "N 3"], weights: Float[AnyArray, "5 K N"]
) -> Float[AnyArray, "5 N"]:
    """The jet of the surface's height over its tangent planes: two slopes, and the second fundamental form."""
    xp = offsets.__array_namespace__()
    return xp.sum(weights * xp.sum(offsets * normals[None], axis=-1)[None], axis=1)


def laplacian_targets(height: Float[AnyArray, "5 N"]) -> Float[AnyArray, "1 5 N"]:
    """The Laplace-Beltrami operator in the coordinates of a plane that need not be quite tangent.

    Where the surface is the graph of z its metric is g_ij = delta_ij + z_i z_j, and
    Delta u = g^ij (u_ij - z_ij z_k u_k / (1 + |grad z|^2)). Returns what that makes of x, y, xy, x^2 and y^2.
    """
    xp = height.__array_namespace__()
    zx, zy, zxx, zxy, zyy = height
    determinant = 1 + zx**2 + zy**2
    gxx, gxy, gyy = (1 + zy**2) / determinant, -zx * zy / determinant, (1 + zx**2) / determinant
    bend = (gxx * zxx + 2 * gxy * zxy + gyy * zyy) / determinant
    return xp.stack([-bend * zx, -bend * zy, 2 * gxy, 2 * gxx, 2 * gyy])[None]


def covariant(height: Float[AnyArray, "5 N"], weights: Float[AnyArray, "5 K N"]) -> Float[AnyArray, "5 K N"]:
    """The weights of a jet with second derivatives made covariant: u_ij - z_ij z_k u_k / (1 + |grad z|^2)."""
    xp = height.__array_namespace__()
    along = xp.einsum("an,akn->kn", height[:2] / (1 + xp.sum(height[:2] ** 2, axis=0))[None], weights[:2])
    return xp.concatenate([weights[:2], weights[2:] - height[2:, None] * along[None]])


def ring_moments(
    lifted: Float[AnyArray, "K N 2"], kinds: Int[AnyArray, " N"], degree: int, emphasis: float = 1.0
) -> tuple[Float[AnyArray, "M K N"], Float[AnyArray, "K N"], Float[AnyArray, " N"]]:
    """The moments (M, K, N) of the ring scaled to mean square radius one, the weights of the fit, and the scale."""
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
    # By products: NumPy raises to a power one logarithm at a time.
    further, highest = [], [x**2, x * y, y**2]
    for _ in range(3, degree + 1):
        highest = [x * monomial for monomial in highest] + [y * highest[-1]]
        further += highest
    return xp.concatenate([moments, xp.stack(further)]) if further else moments, weights, scale


def scaled_targets(
    targets: Float[AnyArray, "R 5 #N"], scale: Float[AnyArray, " N"], emphasis: float = 1.0
) -> Float[AnyArray, "R 5 N"]:
    """The targets in the terms of `ring_moments`: for weights times scale^2, on rings divided by scale."""
    xp = targets.__array_namespace__()
    factors = xp.stack([emphasis * scale] * 2 + [xp.ones_like(scale)] * 3)
    return targets * factors[None]


def relative_residual(
    wanted: Float[AnyArray, "R M N"], found: Float[AnyArray, "R M N"], emphasis: float = 1.0
) -> Float[AnyArray, "R N"]:
    """The largest error of a moment over the largest target of the row, both without the emphasis."""
    xp = wanted.__array_namespace__()

    def largest(values):
        first, rest = xp.max(xp.abs(values[:, :2]), axis=1) / emphasis, xp.max(xp.abs(values[:, 2:]), axis=1)
        return xp.maximum(first, rest)

    size = largest(wanted)
    return largest(wanted - found) / xp.where(size > 0, size, 1)


def conditions(values: AnyArray, kinds: Int[AnyArray, " N"], axis: int) -> AnyArray:
    """What a row of each kind is held to, from values over x, y, xy, x^2, y^2 along an axis; zero where it is not."""
    xp = values.__array_namespace__()
    x, y, xy, xx, yy = xp.moveaxis(values, axis, 0)
    kinds = kinds.reshape((1,) * (x.ndim - 1) + kinds.shape)
    is_other = kinds == OTHER_CORNER
    mean = (xx + yy) / 2
    kept = (
        xp.where(kinds >= RIGHT_CORNER, 0, x),
        xp.where(kinds >= SMOOTH, 0, y),
        xp.where(kinds >= RIGHT_CORNER, 0, xy),
        xp.where(is_other, mean, xx),
        xp.where(is_other, mean, yy),
    )
    return xp.stack(kept, axis=axis)


def _products(a: Float[AnyArray, "I K N"], b: Float[AnyArray, "R K N"]) -> Float[AnyArray, "R I N"]:
    """The sums over k of a[i, k] b[r, k], for every vertex at once."""
    if isinstance(a, np.ndarray):
        return np.einsum("ikn,rkn->rin", a, b)
    # XLA fuses the sum with what surrounds it; on CPU a batched matrix product takes three times as long.
    return jnp.sum(a[None] * b[:, None], axis=2)


def moment_matrix(moments: Float[AnyArray, "M K N"], weights: Float[AnyArray, "K N"]) -> Float[AnyArray, "M M N"]:
    """The matrix A W A^T of every row; a ring determines a polynomial where it has full rank."""
    return _products(moments, moments * weights[None])


def _least_norm(
    moments: Float[AnyArray, "M K N"], weights: Float[AnyArray, "K N"], targets: Float[AnyArray, "R M #N"]
) -> Float[AnyArray, "R K N"]:
    """c = W A^T (A W A^T)^-1 b by a ridge and refinement, so that a matrix without full rank is no special case."""
    xp = moments.__array_namespace__()
    matrix = moment_matrix(moments, weights)
    size, eps = matrix.shape[0], xp.finfo(matrix.dtype).eps
    mean = xp.trace(matrix) / size
    unscaled = 1 / xp.where(mean > 0, mean, 1)
    # Small enough for the refinement to restore full accuracy, large enough that a matrix without full rank (four
    # neighbours, a mirrored ring) does not magnify rounding.
    ridge = eps ** (2 / 3) * xp.eye(size, dtype=matrix.dtype)[..., None]
    inverse = _inverse(matrix * unscaled[None, None] + ridge) * unscaled[None, None]
    columns = xp.moveaxis(moments * weights[None], 0, 1)
    c = xp.zeros((targets.shape[0], *weights.shape), dtype=weights.dtype)
    for _ in range(1 + _REFINEMENTS):
        c = c + _products(columns, _products(inverse, targets - _products(moments, c)))
    return c


def _inverse(matrix: Float[AnyArray, "M M N"]) -> Float[AnyArray, "M M N"]:
    """The inverses of symmetric positive definite matrices of mean diagonal one, one for every vertex at once."""
    return _sweep(matrix) if isinstance(matrix, np.ndarray) else _differentiable_inverse(matrix)


@jax.custom_jvp
def _differentiable_inverse(matrix: Float[Array, "M M N"]) -> Float[Array, "M M N"]:
    return _sweep(matrix)


@_differentiable_inverse.defjvp
def _(primals, tangents):
    inverse = _differentiable_inverse(*primals)
    return inverse, -_products(inverse, _products(tangents[0], inverse))


def _sweep(matrix: AnyArray) -> Any:
    """Gauss-Jordan elimination by rank-one updates, without pivots (Goodnight 1979, A tutorial on the sweep operator).

    A handful of passes over whole arrays, where a batched factorisation would call LAPACK once a vertex.
    """
    xp = matrix.__array_namespace__()
    identity = xp.eye(matrix.shape[0], dtype=matrix.dtype)

    def eliminated(k, swept):
        pivot, own = swept[k, k], identity[k]
        # With pivot - 1 in its own place the update also divides the pivot's row and column by the pivot.
        row = swept[k] - own[:, None]
        return swept - row[:, None] * (row / pivot[None])[None] - 2 * (own[:, None] * own[None])[..., None]

    if not isinstance(matrix, np.ndarray):
        return -jax.lax.fori_loop(0, len(matrix), eliminated, matrix)
    swept = matrix
    for k in range(len(matrix)):
        swept = eliminated(k, swept)
    return -swept
