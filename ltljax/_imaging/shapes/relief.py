"""Fields that show how a surface bends: ridges and valleys, and the shape index.

What enters: a surface. What leaves: fields on its vertices, for pictures.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._operators import curvature, gradient, hessian
from ..._surface import Surface, on_device, on_surface
from ..._tables import AnyArray
from ..images.checks import number


class Ridges(eqx.Module):
    """Strengths of ridge and valley lines, along which a surface bends most sharply.

    Attributes:
        ridge: (V,) strength from 0 to 1 of lines where the surface bends away from the normal.
        valley: (V,) strength from 0 to 1 of lines where the surface bends towards the normal.
    """

    ridge: Float[Array, " V"]
    valley: Float[Array, " V"]


@on_surface
def ridges(surface: Surface, width: float | AnyArray = 1.0) -> Ridges:
    """Ridges and valleys as fields from 0 to 1.

    On a ridge, the larger principal curvature k is positive, larger in magnitude than the other one, and maximal along
    its own direction t: dk/dt = 0 and d2k/dt2 < 0. One step of Newton's method estimates the distance to the maximum
    as (dk/dt) / (d2k/dt2). The strength is a Gaussian of this distance in edge lengths, times (k - |other|) / k and
    k^2 / (k^2 + s^2), where s is the root mean square of all curvatures. Valleys are the ridges of the surface with the
    opposite orientation. This takes fourth derivatives of positions, so smooth a noisy surface first, with `fair` or
    `filter_normals`.

    Args:
        surface: the surface, built with `Monotone` or `Polynomial`.
        width: width of the lines, in mean edge lengths.

    Raises:
        ValueError: the width is not positive, or the scheme is `Paper`, which has no second derivatives.

    Source: Ohtake, Belyaev and Seidel (2004), Ridge-valley lines on meshes via implicit surface fitting,
    doi:10.1145/1015706.1015768.
    """
    return _ridges(surface, number(surface, "width", width))


@eqx.filter_jit
def _ridges(surface: Surface, width: Array) -> Ridges:
    bent = curvature(surface)
    size = jnp.sqrt(jnp.mean(bent.principal**2))
    tiny = jnp.finfo(surface.dtype).tiny
    # The edge length of equilateral triangles with these areas.
    edge = jnp.sqrt(2 * jnp.mean(surface.vertex_areas) / np.sqrt(3))

    def strength(k: Array, other: Array, t: Array) -> Array:
        slope = jnp.sum(gradient(surface, k) * t, axis=1)
        second = jnp.einsum("va,vab,vb->v", t, hessian(surface, k), t)
        is_ridge = (k > jnp.abs(other)) & (second < 0)
        distance = slope / jnp.where(is_ridge, second, -1) / (width * edge)
        sharpness = (k - jnp.abs(other)) / jnp.maximum(k, tiny) * k**2 / (k**2 + size**2 + tiny)
        return jnp.where(is_ridge, jnp.exp(-jnp.minimum(distance**2, 100) / 2) * sharpness, 0)

    (large, small), (first, last) = bent.principal.T, jnp.swapaxes(bent.directions, 0, 1)
    return Ridges(strength(large, small, first), strength(-small, -large, last))


@on_device
def shape_index(surface: Surface) -> Float[Array, " V"]:
    """The shape index (2 / pi) arctan((k1 + k2) / (k1 - k2)), from -1 to 1, independent of the size of the shape.

    It is 1 for a cap (which bends away from the normal in all directions), 1/2 for a ridge, 0 for a saddle, -1/2 for a
    rut and -1 for a cup. It is undefined for a plane, where this function returns 0. First order on irregular meshes,
    like the curvature. Not differentiable where both curvatures vanish.

    Args:
        surface: the surface, built with `Monotone` or `Polynomial`.

    Raises:
        ValueError: the scheme is `Paper`, which has no second derivatives.

    Source: Koenderink and van Doorn (1992), Surface shape and curvature scales, doi:10.1016/0262-8856(92)90076-F.
    """
    large, small = curvature(surface).principal.T
    return 2 / np.pi * jnp.arctan2(large + small, large - small)
