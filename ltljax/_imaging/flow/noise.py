"""Noise that fills space, for pictures whose points are no vertices.

What enters: random numbers and a grain. What leaves: a value at every point, linear in the random numbers.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._tables.table import take

# Grains after which it repeats.
_PERIOD = 128
# A rotation; any that mixes the axes.
_TILT = np.linalg.qr(np.array([[1.0, 0.31, -0.73], [-0.52, 1.0, 0.17], [0.64, -0.41, 1.0]]))[0]


class SolidNoise(eqx.Module):
    """Noise that fills space: random numbers on a lattice, interpolated, and repeated beyond it.

    Attributes:
        values: (n, n, n) on the lattice.
        grain: the spacing of the lattice.
    """

    values: Float[Array, "n n n"]
    grain: Float[Array, ""]

    def __call__(self, points: Float[Array, "N 3"]) -> Float[Array, " N"]:
        """The noise at points."""
        n, values = self.values.shape[0], self.values.astype(points.dtype).reshape(-1)
        # Not along the axes, which shapes often have surfaces along.
        at = points @ jnp.asarray(_TILT, points.dtype) / self.grain.astype(points.dtype)
        low = jnp.floor(at)
        share, low = at - low, low.astype(jnp.int32)
        total = jnp.zeros(points.shape[:1], points.dtype)
        for corner in np.ndindex(2, 2, 2):
            i, j, k = ((low[:, axis] + offset) % n for axis, offset in enumerate(corner))
            weight = jnp.prod(jnp.where(jnp.asarray(corner, bool)[None], share, 1 - share), axis=1)
            total = total + weight * take(values, (i * n + j) * n + k)
        return total


def solid_noise(key: Array, grain: float | Array, dtype=None, size: int = _PERIOD) -> SolidNoise:
    """Uniform noise between 0 and 1 that fills space.

    Args:
        key: of the random numbers.
        grain: the length over which it changes.
        dtype: float32 or float64; by default JAX's own.
        size: grains after which it repeats.
    """
    values = jax.random.uniform(key, (size, size, size), jnp.zeros(0).dtype if dtype is None else dtype)
    return SolidNoise(values, jnp.asarray(grain, values.dtype))
