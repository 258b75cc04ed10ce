"""Whether a uniform state is stable, and what grows out of it: Turing's analysis for any kinetics, on any surface.

What enters: kinetics, diffusivities, a uniform steady state; for `explain` an equation and a surface. What leaves:
growth rates against the eigenvalues of -Delta, and in words what a run will show.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jax.core import Tracer
from jaxtyping import Array, Float

from .._equations import ReactionDiffusion
from .._equations.kinetics import Kinetics
from .._surface import Surface, on_surface
from .._tables import AnyArray
from .modes import eigenmodes

# Samples of the growth rate in which changes of sign are looked for.
_SAMPLES = 2000
# Fewer edges in a wavelength than this leave an error of five percent and more in the eigenvalue.
_EDGES = 8
# A pattern that grows so many times as fast as uniform departures is seen before them.
_FASTER = 2.0
# Growth rates of less than this share of the reaction's own rates are rounding.
_ROUNDING = 1e-12
# More modes than this are counted by Weyl's law.
_MODES = 150


class Dispersion(eqx.Module):
    """The linear growth of small departures from a uniform steady state, exp(sigma t) times a mode of -Delta.

    Attributes:
        jacobian: (S, S) of the rates at the state.
        diffusivity: (S,).
        steady_state: (S,).
    """

    jacobian: Float[Array, "S S"]
    diffusivity: Float[Array, " S"]
    steady_state: Float[Array, " S"]

    def growth(self, eigenvalue: Float[AnyArray, "..."] | float) -> Float[Array, "..."]:
        """The growth rate: the largest real part of the eigenvalues of J - lambda D, for eigenvalues lambda of -Delta.

        Differentiable with respect to parameters and lambda. Source: Turing (1952), doi:10.1098/rstb.1952.0012.
        """
        matrices = self._matrices(eigenvalue)
        if self.diffusivity.size > 2:
            return jnp.max(jnp.linalg.eigvals(matrices).real, axis=-1)
        if self.diffusivity.size == 1:
            return matrices[..., 0, 0]
        half = (matrices[..., 0, 0] + matrices[..., 1, 1]) / 2
        square = ((matrices[..., 0, 0] - matrices[..., 1, 1]) / 2) ** 2 + matrices[..., 0, 1] * matrices[..., 1, 0]
        # The root is real or imaginary; the inner choice keeps the derivative of the other one finite.
        return half + jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)

    def frequency(self, eigenvalue: Float[AnyArray, "..."] | float) -> Float[Array, "..."]:
        """The angular frequency at which the mode that grows fastest oscillates: zero where it does not (host)."""
        values = np.linalg.eigvals(np.asarray(self._matrices(eigenvalue)))
        leading = np.argmax(np.real(values), axis=-1, keepdims=True)
        return jnp.asarray(np.abs(np.take_along_axis(np.imag(values), leading, axis=-1))[..., 0], self.jacobian.dtype)

    @functools.cached_property
    def band(self) -> tuple[float, float] | None:
        """The eigenvalues of -Delta between which modes grow, or None; infinite where no end is found (host)."""
        samples = self._samples()
        is_growing = np.asarray(self.growth(samples)) > self._rounding
        if not is_growing.any():
            return None
        first, last = np.flatnonzero(is_growing)[[0, -1]]
        low = 0.0 if first == 0 else self._root(samples[first - 1], samples[first])
        high = float("inf") if last == len(samples) - 1 else self._root(samples[last], samples[last + 1])
        return low, high

    @functools.cached_property
    def fastest(self) -> tuple[float, float]:
        """The eigenvalue of -Delta that grows fastest, or decays slowest, and its rate (host)."""
        samples = self._samples()
        best = int(np.argmax(self.growth(samples)))
        ends = samples[max(best - 1, 0)], samples[min(best + 1, len(samples) - 1)]
        found: Any = scipy.optimize.minimize_scalar(lambda x: -float(self.growth(x)), bounds=ends, method="bounded")
        at = max((float(found.x), float(samples[best])), key=lambda x: float(self.growth(x)))
        return at, float(self.growth(at))

    @property
    def wavelength(self) -> float:
        """2 pi / sqrt(lambda) of the mode that grows fastest; infinite where that is the uniform one (host)."""
        at, _ = self.fastest
        return 2 * np.pi / np.sqrt(at) if at > 0 else float("inf")

    @property
    def forms_pattern(self) -> bool:
        """Whether the uniform state is stable by itself and diffusion makes stationary modes grow fastest: Turing's
        instability (host)."""
        return self.band is not None and float(self.growth(0.0)) <= self._rounding and not self.makes_waves

    @property
    def makes_waves(self) -> bool:
        """Whether the mode that grows fastest, or decays slowest, oscillates as it does (host)."""
        return float(self.frequency(self.fastest[0])) > self._rounding

    @property
    def _rounding(self) -> float:
        rounding = max(_ROUNDING, 8 * float(jnp.finfo(self.jacobian.dtype).eps))
        return rounding * float(np.abs(np.asarray(self.jacobian)).sum(axis=1).max())

    def _matrices(self, eigenvalue: Float[AnyArray, "..."] | float) -> Float[Array, "... S S"]:
        eigenvalue = jnp.asarray(eigenvalue, self.jacobian.dtype)
        decay = jnp.tensordot(eigenvalue, jnp.diag(self.diffusivity), axes=0)
        return jnp.broadcast_to(self.jacobian, decay.shape) - decay

    def _samples(self) -> np.ndarray:
        diffusivity, size = np.asarray(self.diffusivity), float(np.abs(np.asarray(self.jacobian)).sum(axis=1).max())
        moving = diffusivity[diffusivity > 0]
        # Beyond the first no mode can grow, by Gershgorin's theorem, if every species diffuses.
        largest = size / moving.min() if len(moving) else 1.0
        return np.concatenate([[0.0], np.geomspace(1e-7 * largest, 1.01 * largest, _SAMPLES)])

    def _root(self, low: Any, high: Any) -> float:
        found: Any = scipy.optimize.brentq(lambda x: float(self.growth(x)) - self._rounding, low, high)
        return float(found)


def dispersion(
    kinetics: Kinetics,
    diffusivity: Float[AnyArray, " S"] | Sequence[float],
    steady_state: Float[AnyArray, " S"] | Sequence[float] | None = None,
) -> Dispersion:
    """How small departures from a uniform steady state grow, by the Jacobian of the rates there.

    Args:
        kinetics: the reaction; parameters that are fields count with their mean.
        diffusivity: one number for each species.
        steady_state: a guess, from which the state is found by Newton's method; by default the closed form.

    Raises:
        ValueError: no steady state is known, or none is near the one given, or shapes do not fit.
    """
    mean = jax.tree.map(lambda p: jnp.mean(jnp.asarray(p, jnp.result_type(float))), kinetics.params)
    local = Kinetics(kinetics.rates, mean)

    def rates(u):
        return local(u[None])[0]

    state = kinetics.steady_state() if steady_state is None else _polished(rates, steady_state)
    diffusivity = jnp.asarray(diffusivity, state.dtype)
    if diffusivity.shape != state.shape:
        raise ValueError(f"Expected one diffusivity for each of {state.size} species, found {diffusivity.shape}.")
    return Dispersion(jax.jacfwd(rates)(state), diffusivity, state)


def _polished(rates, guess) -> Array:
    """The steady state next to a guess, with the derivatives that the implicit function has."""
    state = jnp.asarray(guess, jnp.result_type(float))
    for _ in range(20):
        state = state - jnp.linalg.solve(jax.jacfwd(rates)(state), rates(state))
    residual = rates(state)
    if not isinstance(residual, Tracer) and not bool(jnp.max(jnp.abs(residual)) < 1e-4):
        raise ValueError(f"No steady state was found near {guess}: Newton's method ends with rates {residual}.")
    return state


@dataclasses.dataclass(frozen=True)
class Explanation:
    """What linear theory says of a run before it starts; prints as text.

    Attributes:
        forms_pattern: whether a stationary pattern grows out of the uniform state on this surface; waves are none.
        dispersion: the growth rates.
        num_modes: how many modes of the surface grow.
        wavelength: of the mode that grows fastest; infinite where none does.
        edges_per_wavelength: the wavelength in mean edge lengths of the mesh.
        message: all of it in words.
    """

    forms_pattern: bool
    dispersion: Dispersion
    num_modes: int
    wavelength: float
    edges_per_wavelength: float
    message: str

    def __str__(self) -> str:
        return self.message


@on_surface
def explain(
    equation: ReactionDiffusion,
    surface: Surface,
    steady_state: Float[AnyArray, " S"] | Sequence[float] | None = None,
) -> Explanation:
    """Whether a pattern can form on a surface, of what wavelength, and whether the mesh resolves it (host).

    Linear theory of small departures from the uniform steady state. What a finite push does to a state that is stable
    (spots of Gray and Scott, waves of Barkley) it cannot tell, and says so.

    Args:
        equation: the equation; diffusivities that vary count with their mean.
        surface: the surface. Its modes are computed where they are few, and counted by Weyl's law where they are many.
        steady_state: as of `dispersion`.
    """
    found = dispersion(equation.reaction, _mean_diffusivities(equation, surface), steady_state)
    state = ", ".join(f"{x:.4g}" for x in np.asarray(found.steady_state))
    band, (fastest, rate) = found.band, found.fastest
    alone = float(found.growth(0.0))
    outgrown = alone > found._rounding and fastest > 0 and rate > _FASTER * alone and not found.makes_waves
    if alone > found._rounding and not outgrown:
        reason = f"The uniform state ({state}) is unstable without diffusion already, at the rate {alone:.3g}"
        message = f"{reason}: it is left everywhere at once, by oscillation or for another state."
        return Explanation(False, found, 0, float("inf"), float("inf"), message)
    if alone >= -found._rounding and band is None:
        turning = float(found.frequency(0.0))
        how = f"turn about it in the time {2 * np.pi / turning:.4g} and " if turning > found._rounding else ""
        message = (
            f"No pattern: the uniform state ({state}) is neutral. Small departures that are uniform {how}neither grow "
            "nor decay, and none that varies over the surface grows. What larger ones do linear theory cannot tell."
        )
        return Explanation(False, found, 0, float("inf"), float("inf"), message)
    if band is None or rate <= 0:
        message = (
            f"No pattern: every small departure from the uniform state ({state}) decays, the slowest at the rate "
            f"{-rate:.3g}. {_remedy(found)}A finite push may still start something."
        )
        return Explanation(False, found, 0, float("inf"), float("inf"), message)
    count, known = _count_modes(surface, band)
    wavelength, edge = found.wavelength, float(surface.mesh_size)
    edges = wavelength / edge
    shape = (
        f"modes with eigenvalues of -Delta from {band[0]:.4g} to {band[1]:.4g} grow out of the uniform state "
        f"({state}), fastest at {fastest:.4g} (rate {rate:.3g}, wavelength {wavelength:.4g})"
    )
    if count == 0:
        message = f"No pattern: {shape}, but this surface has no such mode: it is too small for the wavelength."
        return Explanation(False, found, 0, wavelength, edges, message)
    waves = found.makes_waves
    if waves:
        begins = f"Waves, and no stationary pattern, form (period {2 * np.pi / float(found.frequency(fastest)):.4g})"
    else:
        begins = "A pattern forms"
    if edges >= _EDGES:
        seen = f"resolves {'them' if waves else 'the pattern'}, with {edges:.0f} edges in a wavelength."
    else:
        seen = (
            f"does not resolve {'them' if waves else 'it'}: {edges:.1f} edges in a wavelength, {_EDGES} are wanted. "
            "Refine the mesh or enlarge the diffusivities."
        )
    if outgrown:
        shape += f"; without them it would be left more slowly, everywhere at once (rate {alone:.3g})"
    message = f"{begins}: {shape}. This surface has {'' if known else 'about '}{count} such modes. The mesh {seen}"
    return Explanation(not waves, found, count, wavelength, edges, message)


def _mean_diffusivities(equation: ReactionDiffusion, surface: Surface) -> Array:
    return equation.diffusivities(jnp.zeros((surface.num_vertices, equation.num_species), surface.dtype))


def _remedy(found: Dispersion) -> str:
    """The ratio of diffusivities beyond which two species make a pattern, as a sentence."""
    if found.diffusivity.size != 2:
        return ""
    (a, b), (c, d) = np.asarray(found.jacobian)
    if a + d > 0 or a * d - b * c <= 0:
        return ""
    if max(a, d) <= 0:
        return "Neither species promotes itself there, so no diffusivities would make one. "
    slow, promotes = ("first", a) if a > 0 else ("second", d)
    ratio = ((np.sqrt(a * d - b * c) + np.sqrt(-b * c)) / promotes) ** 2
    actual = found.diffusivity[1] / found.diffusivity[0] if a > 0 else found.diffusivity[0] / found.diffusivity[1]
    return (
        f"The {slow} species promotes itself: a pattern needs the other one to diffuse more than {ratio:.4g} times as "
        f"fast, and it diffuses {float(actual):.4g} times as fast. "
    )


def _count_modes(surface: Surface, band: tuple[float, float]) -> tuple[int, bool]:
    """How many modes of the surface grow, and whether they were computed rather than estimated."""
    low, high = band
    area = float(np.asarray(surface.vertex_areas, np.float64).sum())
    estimate = area * (high - low) / (4 * np.pi)
    wanted = int(1.3 * area * high / (4 * np.pi)) + 12 if np.isfinite(high) else _MODES + 1
    if wanted > min(_MODES, surface.num_vertices - 2):
        return round(min(estimate, surface.num_vertices)), False
    values = np.asarray(eigenmodes(surface, wanted).values)
    return int(((values > low) & (values < high)).sum()), True
