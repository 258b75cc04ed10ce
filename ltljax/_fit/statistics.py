"""Statistics of a pattern that do not depend on the positions of its spots: wavelength, moments and coverage."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._operators import integrate, laplacian
from .._surface import Surface, on_surface
from .._tables import AnyArray


class PatternStatistics(eqx.Module):
    """Differentiable statistics of a field that do not depend on the positions of its spots.

    Attributes:
        wavelength: 2 pi / k, where k^2 is the Rayleigh quotient of the field minus its mean. It is the wavelength of
            the dominant mode, and slightly less for sharp profiles.
        mean: mean over the surface.
        deviation: standard deviation.
        skewness: skewness: positive for peaks on flat ground, negative for holes, near zero for stripes.
        coverage: (L,) shares of the surface where the field is above each level.
    """

    wavelength: Float[Array, ""]
    mean: Float[Array, ""]
    deviation: Float[Array, ""]
    skewness: Float[Array, ""]
    coverage: Float[Array, " L"]

    @property
    def histogram(self) -> Float[Array, " L1"]:
        """(L + 1,) shares of the surface below the first level, between consecutive levels, and above the last."""
        ends = jnp.ones(1, self.coverage.dtype)
        return -jnp.diff(jnp.concatenate([ends, self.coverage, 0 * ends]))

    @property
    def vector(self) -> Float[Array, " N"]:
        """(4 + L,) all statistics as a vector, for `Observations`."""
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
        surface: the surface.
        u: (V,) field of one species.
        mass: (V,) measure, ``surface.mass`` (to be computed outside jit).
        levels: (L,) ascending levels of coverage and histogram; by default none.
        softness: width of the levels as a share of the standard deviation. A sharp level would have no derivatives.
    """
    u = jnp.asarray(u)
    area = jnp.sum(mass)
    mean = integrate(surface, u, mass) / area
    centred = u - mean
    variance = integrate(surface, centred**2, mass) / area
    deviation = jnp.sqrt(variance)
    k2 = -integrate(surface, centred * laplacian(surface, centred), mass) / (area * variance)
    skewness = integrate(surface, centred**3, mass) / (area * deviation**3)
    levels = jnp.zeros(0, u.dtype) if levels is None else jnp.asarray(levels, u.dtype)
    above = jax.nn.sigmoid((u[:, None] - levels[None]) / (softness * deviation))
    coverage = jnp.asarray(mass) @ above / area
    return PatternStatistics(2 * jnp.pi / jnp.sqrt(k2), mean, deviation, skewness, coverage)
