"""Pictures of how a surface bends: ridges and valleys, and the shape index.

What enters: a surface. What leaves: fields on its vertices, made to be looked at.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._operators import curvature, gradient, hessian
from ..._surface import Surface, on_device, on_surface
from ..._tables import AnyArray
from ..images.signals import number


class Ridges(eqx.Module):
    """Where a surface bends most, across the line of bending.

    Attributes:
        ridge: (V,) from 0 to 1, of lines where it bends away from the normal.
        valley: (V,) from 0 to 1, of lines where it bends towards it.
    """

    ridge: Float[Array, " V"]
    valley: Float[Array, " V"]


@on_surface
def ridges(surface: Surface, width: float | AnyArray = 1.0) -> Ridges:
    """Ridges and valleys as fields from 0 to 1.

    A vertex is on a ridge where the larger principal curvature k, positive and larger than the other in magnitude, is
    greatest along its own direction t: dk/dt = 0 and d2k/dt2 < 0. By Newton's method the greatest lies at the distance
    (dk/dt) / (d2k/dt2), whose square in edge lengths is put into a bell. That is weighed with (k - |other|) / k and
    with k^2 / (k^2 + s^2), where s is the root mean square of all curvatures. Valleys are the ridges of the other side.
    All this takes fourth derivatives of positions: smooth a noisy surface before, with `fair` or `denoise_mesh`.

    Args:
        surface: the surface, `Monotone` or `Polynomial`.
        width: of the lines, in mean edge lengths.

    Raises:
        ValueError: the width is not positive, or `Paper` has no second derivatives of its own.

    Source: Ohtake, Belyaev and Seidel (2004), Ridge-valley lines on meshes via implicit surface fitting,
    doi:10.1145/1015706.1015768.
    """
    return _ridges(surface, number(surface, "width", width))


@eqx.filter_jit
def _ridges(surface: Surface, width: Array) -> Ridges:
    bent = curvature(surface)
    size = jnp.sqrt(jnp.mean(bent.principal**2))
    tiny = jnp.finfo(surface.dtype).tiny
    # Of regular triangles.
    edge = jnp.sqrt(2 * jnp.mean(surface.vertex_areas) / np.sqrt(3))

    def along(k: Array, other: Array, t: Array) -> Array:
        slope = jnp.sum(gradient(surface, k) * t, axis=1)
        second = jnp.einsum("va,vab,vb->v", t, hessian(surface, k), t)
        is_most = (k > jnp.abs(other)) & (second < 0)
        away = slope / jnp.where(is_most, second, -1) / (width * edge)
        strength = (k - jnp.abs(other)) / jnp.maximum(k, tiny) * k**2 / (k**2 + size**2 + tiny)
        return jnp.where(is_most, jnp.exp(-jnp.minimum(away**2, 100) / 2) * strength, 0)

    (large, small), (first, last) = bent.principal.T, jnp.swapaxes(bent.directions, 0, 1)
    return Ridges(along(large, small, first), along(-small, -large, last))


@on_device
def shape_index(surface: Surface) -> Float[Array, " V"]:
    """The shape index (2 / pi) arctan((k1 + k2) / (k1 - k2)), from -1 to 1, whatever the size of the shape.

    A cap (which bends away from the normal all around) has 1, a ridge 1/2, a saddle 0, a rut -1/2 and a cup -1; a
    plane, which has none, counts as 0. First order on irregular meshes, like the curvature; without derivative where
    both curvatures vanish.

    Args:
        surface: the surface, `Monotone` or `Polynomial`.

    Raises:
        ValueError: `Paper` has no second derivatives of its own.

    Source: Koenderink and van Doorn (1992), Surface shape and curvature scales, doi:10.1016/0262-8856(92)90076-F.
    """
    large, small = curvature(surface).principal.T
    return 2 / np.pi * jnp.arctan2(large + small, large - small)
