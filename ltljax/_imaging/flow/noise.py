"""Noise that fills space, for pictures whose points are not vertices.

What enters: a random key and a grain size. What leaves: a function of points in space, linear in the random numbers.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._tables import take

# Grains after which the noise repeats.
_PERIOD = 128
# An arbitrary rotation that mixes the axes.
_TILT = np.linalg.qr(np.array([[1.0, 0.31, -0.73], [-0.52, 1.0, 0.17], [0.64, -0.41, 1.0]]))[0]


class SolidNoise(eqx.Module):
    """Noise that fills space: random numbers on a lattice, interpolated linearly and repeated periodically.

    Attributes:
        values: (n, n, n) values on the lattice.
        grain: spacing of the lattice.
    """

    values: Float[Array, "n n n"]
    grain: Float[Array, ""]

    def __call__(self, points: Float[Array, "N 3"]) -> Float[Array, " N"]:
        """The noise at given points."""
        n, values = self.values.shape[0], self.values.astype(points.dtype).reshape(-1)
        # The lattice is tilted because shapes often have faces along the axes.
        position = points @ jnp.asarray(_TILT, points.dtype) / self.grain.astype(points.dtype)
        low = jnp.floor(position)
        fraction, low = position - low, low.astype(jnp.int32)
        total = jnp.zeros(points.shape[:1], points.dtype)
        for corner in np.ndindex(2, 2, 2):
            i, j, k = ((low[:, axis] + offset) % n for axis, offset in enumerate(corner))
            weight = jnp.prod(jnp.where(jnp.asarray(corner, bool)[None], fraction, 1 - fraction), axis=1)
            total = total + weight * take(values, (i * n + j) * n + k)
        return total


def solid_noise(key: Array, grain: float | Array, dtype=None, size: int = _PERIOD) -> SolidNoise:
    """Uniform noise between 0 and 1 that fills space.

    Args:
        key: random key.
        grain: length over which the noise varies.
        dtype: float32 or float64; by default JAX's default float type.
        size: number of grains after which the noise repeats.
    """
    values = jax.random.uniform(key, (size, size, size), jnp.zeros(0).dtype if dtype is None else dtype)
    return SolidNoise(values, jnp.asarray(grain, values.dtype))
