"""What a pattern is like, whatever its phase: wavelength, moments and coverage."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._operators import integrate, laplacian
from .._surface import Surface, on_surface
from .._tables import AnyArray


class PatternStatistics(eqx.Module):
    """Statistics of a field that do not depend on where its spots are; all differentiable.

    Attributes:
        wavelength: 2 pi / k with k^2 the field's Rayleigh quotient about its mean: that of the dominant mode, and a
            little less for sharp profiles.
        mean: the mean over the surface.
        deviation: the standard deviation.
        skewness: positive for peaks on a flat ground, negative for holes, near zero for stripes.
        coverage: (L,) the shares of the surface above the levels.
    """

    wavelength: Float[Array, ""]
    mean: Float[Array, ""]
    deviation: Float[Array, ""]
    skewness: Float[Array, ""]
    coverage: Float[Array, " L"]

    @property
    def histogram(self) -> Float[Array, " L1"]:
        """(L + 1,) the shares of the surface below the first level, between one and the next, and above the last."""
        ends = jnp.ones(1, self.coverage.dtype)
        return -jnp.diff(jnp.concatenate([ends, self.coverage, 0 * ends]))

    @property
    def vector(self) -> Float[Array, " N"]:
        """All of them in a row, for `Observations`."""
        return jnp.concatenate([jnp.stack([self.wavelength, self.mean, self.deviation, self.skewness]), self.coverage])


@on_surface
def pattern_statistics(
    surface: Surface,
    u: Float[AnyArray, " V"],
    mass: Float[AnyArray, " V"],
    levels: Float[AnyArray, " L"] | Sequence[float] | None = None,
    softness: float = 0.1,
) -> PatternStatistics:
    """The statistics of a pattern.

    Args:
        surface: where.
        u: (V,) one species.
        mass: (V,) the measure, ``surface.mass`` (asked for outside jit).
        levels: ascending values above which the coverage is counted, and between which the histogram; by default none.
        softness: of the counting, as a share of the field's deviation: a step would have no derivatives.
    """
    u = jnp.asarray(u)
    area = jnp.sum(mass)
    mean = integrate(surface, u, mass) / area
    rest = u - mean
    variance = integrate(surface, rest**2, mass) / area
    deviation = jnp.sqrt(variance)
    k2 = -integrate(surface, rest * laplacian(surface, rest), mass) / (area * variance)
    skewness = integrate(surface, rest**3, mass) / (area * deviation**3)
    levels = jnp.zeros(0, u.dtype) if levels is None else jnp.asarray(levels, u.dtype)
    above = jax.nn.sigmoid((u[:, None] - levels[None]) / (softness * deviation))
    coverage = jnp.asarray(mass) @ above / area
    return PatternStatistics(2 * jnp.pi / jnp.sqrt(k2), mean, deviation, skewness, coverage)
