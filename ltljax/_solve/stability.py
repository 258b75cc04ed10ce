"""Whether a uniform state is stable, and which modes grow out of it: Turing's analysis for any kinetics and surface.

What enters: kinetics, diffusivities and a uniform steady state; for `explain` an equation and a surface. What leaves:
growth rates as a function of the eigenvalues of -Delta, and a text that predicts what a run will show.
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

# Number of samples of the growth rate between which changes of sign are detected.
_SAMPLES = 2000
# With fewer edges per wavelength the error of the eigenvalue is five percent or more.
_EDGES = 8
# A pattern that grows this many times as fast as uniform perturbations is visible before them.
_FASTER = 2.0
# A growth rate below this share of the reaction's own rates is rounding error.
_ROUNDING = 1e-12
# Larger numbers of modes are estimated by Weyl's law.
_MODES = 150


class Dispersion(eqx.Module):
    """The linear growth of small perturbations of a uniform steady state: exp(sigma t) times a mode of -Delta.

    Attributes:
        jacobian: (S, S) Jacobian of the rates at the steady state.
        diffusivity: (S,) diffusivity of each species.
        steady_state: (S,) uniform steady state.
    """

    jacobian: Float[Array, "S S"]
    diffusivity: Float[Array, " S"]
    steady_state: Float[Array, " S"]

    def growth(self, eigenvalue: Float[AnyArray, "..."] | float) -> Float[Array, "..."]:
        """The growth rate: the largest real part of the eigenvalues of J - lambda D at an eigenvalue lambda of -Delta.

        It is differentiable in the parameters and in lambda.

        Source: Turing (1952), The chemical basis of morphogenesis, doi:10.1098/rstb.1952.0012.
        """
        matrices = self._matrices(eigenvalue)
        if self.diffusivity.size > 2:
            return jnp.max(jnp.linalg.eigvals(matrices).real, axis=-1)
        if self.diffusivity.size == 1:
            return matrices[..., 0, 0]
        half = (matrices[..., 0, 0] + matrices[..., 1, 1]) / 2
        square = ((matrices[..., 0, 0] - matrices[..., 1, 1]) / 2) ** 2 + matrices[..., 0, 1] * matrices[..., 1, 0]
        # The root is real or imaginary. The inner `where` keeps the derivative of the unused branch finite.
        return half + jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)

    def frequency(self, eigenvalue: Float[AnyArray, "..."] | float) -> Float[Array, "..."]:
        """The angular frequency of the fastest growing mode, zero if it does not oscillate (host)."""
        values = np.linalg.eigvals(np.asarray(self._matrices(eigenvalue)))
        leading = np.argmax(np.real(values), axis=-1, keepdims=True)
        return jnp.asarray(np.abs(np.take_along_axis(np.imag(values), leading, axis=-1))[..., 0], self.jacobian.dtype)

    @functools.cached_property
    def band(self) -> tuple[float, float] | None:
        """The interval of eigenvalues of -Delta at which modes grow, or None (host).

        Its upper end is infinite if modes grow at all large eigenvalues.
        """
        samples = self._samples()
        is_growing = np.asarray(self.growth(samples)) > self.rounding
        if not is_growing.any():
            return None
        first, last = np.flatnonzero(is_growing)[[0, -1]]
        low = 0.0 if first == 0 else self._root(samples[first - 1], samples[first])
        high = float("inf") if last == len(samples) - 1 else self._root(samples[last], samples[last + 1])
        return low, high

    @functools.cached_property
    def fastest(self) -> tuple[float, float]:
        """The eigenvalue of -Delta whose mode grows fastest, or decays slowest, and its growth rate (host)."""
        samples = self._samples()
        best = int(np.argmax(self.growth(samples)))
        ends = samples[max(best - 1, 0)], samples[min(best + 1, len(samples) - 1)]
        result: Any = scipy.optimize.minimize_scalar(lambda x: -float(self.growth(x)), bounds=ends, method="bounded")
        eigenvalue = max((float(result.x), float(samples[best])), key=lambda x: float(self.growth(x)))
        return eigenvalue, float(self.growth(eigenvalue))

    @property
    def wavelength(self) -> float:
        """2 pi / sqrt(lambda) of the fastest growing mode, infinite if that mode is uniform (host)."""
        eigenvalue, _ = self.fastest
        return 2 * np.pi / np.sqrt(eigenvalue) if eigenvalue > 0 else float("inf")

    @property
    def forms_pattern(self) -> bool:
        """Whether this is a Turing instability (host).

        The uniform state is then stable without diffusion, and with diffusion a stationary mode grows fastest.
        """
        return self.band is not None and float(self.growth(0.0)) <= self.rounding and not self.makes_waves

    @property
    def makes_waves(self) -> bool:
        """Whether the mode that grows fastest, or decays slowest, oscillates (host)."""
        return float(self.frequency(self.fastest[0])) > self.rounding

    @property
    def rounding(self) -> float:
        """The growth rate up to which a mode counts as neutral, because rounding can cause it (host)."""
        rounding = max(_ROUNDING, 8 * float(jnp.finfo(self.jacobian.dtype).eps))
        return rounding * float(np.abs(np.asarray(self.jacobian)).sum(axis=1).max())

    def _matrices(self, eigenvalue: Float[AnyArray, "..."] | float) -> Float[Array, "... S S"]:
        eigenvalue = jnp.asarray(eigenvalue, self.jacobian.dtype)
        decay = jnp.tensordot(eigenvalue, jnp.diag(self.diffusivity), axes=0)
        return jnp.broadcast_to(self.jacobian, decay.shape) - decay

    def _samples(self) -> np.ndarray:
        diffusivity, size = np.asarray(self.diffusivity), float(np.abs(np.asarray(self.jacobian)).sum(axis=1).max())
        moving = diffusivity[diffusivity > 0]
        # By Gershgorin's theorem no mode grows beyond `largest` if every species diffuses.
        largest = size / moving.min() if len(moving) else 1.0
        return np.concatenate([[0.0], np.geomspace(1e-7 * largest, 1.01 * largest, _SAMPLES)])

    def _root(self, low: Any, high: Any) -> float:
        root: Any = scipy.optimize.brentq(lambda x: float(self.growth(x)) - self.rounding, low, high)
        return float(root)


def dispersion(
    kinetics: Kinetics,
    diffusivity: Float[AnyArray, " S"] | Sequence[float],
    steady_state: Float[AnyArray, " S"] | Sequence[float] | None = None,
) -> Dispersion:
    """The growth rates of small perturbations of a uniform steady state, from the Jacobian of the rates there.

    Args:
        kinetics: the reaction. A parameter that is a field counts with its mean.
        diffusivity: (S,) diffusivity of each species.
        steady_state: (S,) guess from which Newton's method finds the steady state; by default the closed form.

    Raises:
        ValueError: no closed form of the steady state is known, Newton's method finds none near the guess, or shapes
            do not match.
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
    """The steady state near a guess, with the derivatives of the implicit function theorem."""
    state = jnp.asarray(guess, jnp.result_type(float))
    for _ in range(20):
        state = state - jnp.linalg.solve(jax.jacfwd(rates)(state), rates(state))
    residual = rates(state)
    if not isinstance(residual, Tracer) and not bool(jnp.max(jnp.abs(residual)) < 1e-4):
        raise ValueError(
            f"Newton's method found no steady state near {guess}: the rates at its last iterate are {residual}. Give a "
            "guess closer to the steady state."
        )
    return state


@dataclasses.dataclass(frozen=True)
class Explanation:
    """What linear theory predicts for a run; prints as text.

    Attributes:
        forms_pattern: whether a stationary pattern (not waves) grows out of the uniform state on this surface.
        dispersion: growth rates.
        num_modes: number of modes of the surface that grow.
        wavelength: wavelength of the fastest growing mode, infinite if none grows.
        edges_per_wavelength: wavelength in mean edge lengths of the mesh.
        message: the prediction in words.
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
    """Whether a pattern can form on a surface, its wavelength, and whether the mesh resolves it (host).

    This is linear theory of small perturbations of the uniform steady state. It cannot predict what a large
    perturbation does to a stable state (the spots of Gray and Scott, the waves of Barkley), and the text says so.

    Args:
        equation: the equation. A diffusivity that varies counts with its mean.
        surface: the surface. Its modes are computed if they are few and estimated by Weyl's law if they are many.
        steady_state: guess of the steady state, as for `dispersion`.
    """
    diffusivity = equation.diffusivities(jnp.zeros((surface.num_vertices, equation.num_species), surface.dtype))
    growth = dispersion(equation.reaction, diffusivity, steady_state)
    uniform_rate, (_, rate) = float(growth.growth(0.0)), growth.fastest
    if uniform_rate > growth.rounding and not _outgrows_uniform_perturbations(growth):
        message = _unstable_message(growth, uniform_rate)
    elif uniform_rate >= -growth.rounding and growth.band is None:
        message = _neutral_message(growth)
    elif growth.band is None or rate <= 0:
        message = (
            f"No pattern: every small perturbation of the uniform state {_state(growth)} decays, the slowest at the "
            f"rate {-rate:.3g}. {_required_ratio(growth)}A finite push may still start something."
        )
    else:
        return _explain_growth(growth, growth.band, surface)
    return Explanation(False, growth, 0, float("inf"), float("inf"), message)


def _state(growth: Dispersion) -> str:
    return f"({', '.join(f'{x:.4g}' for x in np.asarray(growth.steady_state))})"


def _outgrows_uniform_perturbations(growth: Dispersion) -> bool:
    """Whether a stationary mode grows so fast that its pattern is visible before the uniform state is left."""
    eigenvalue, rate = growth.fastest
    return eigenvalue > 0 and rate > _FASTER * float(growth.growth(0.0)) and not growth.makes_waves


def _unstable_message(growth: Dispersion, uniform_rate: float) -> str:
    return (
        f"The uniform state {_state(growth)} is unstable without diffusion, at the rate {uniform_rate:.3g}: it changes "
        "everywhere at the same time, by oscillation or towards another state."
    )


def _neutral_message(growth: Dispersion) -> str:
    frequency = float(growth.frequency(0.0))
    oscillation = f"oscillate in the time {2 * np.pi / frequency:.4g} and " if frequency > growth.rounding else ""
    return (
        f"No pattern: the uniform state {_state(growth)} is neutral. Small uniform perturbations {oscillation}neither "
        "grow nor decay, and no perturbation that varies over the surface grows. Linear theory does not predict the "
        "effect of larger ones."
    )


def _explain_growth(growth: Dispersion, band: tuple[float, float], surface: Surface) -> Explanation:
    """The explanation of modes that grow: which, how many on this surface, and whether the mesh resolves them."""
    (eigenvalue, rate), wavelength = growth.fastest, growth.wavelength
    edges = wavelength / float(surface.mesh_size)
    count, is_exact = _count_modes(surface, band)
    modes = (
        f"modes with eigenvalues of -Delta from {band[0]:.4g} to {band[1]:.4g} grow out of the uniform state "
        f"{_state(growth)}, fastest at {eigenvalue:.4g} (rate {rate:.3g}, wavelength {wavelength:.4g})"
    )
    if count == 0:
        message = f"No pattern: {modes}, but this surface has no such mode: it is too small for the wavelength."
        return Explanation(False, growth, 0, wavelength, edges, message)
    is_wave = growth.makes_waves
    if is_wave:
        period = 2 * np.pi / float(growth.frequency(eigenvalue))
        result, subject = f"Waves, and no stationary pattern, form (period {period:.4g})", "the waves"
    else:
        result, subject = "A pattern forms", "the pattern"
    uniform_rate = float(growth.growth(0.0))
    if uniform_rate > growth.rounding:
        modes += f"; uniform perturbations grow too, but more slowly (rate {uniform_rate:.3g})"
    if edges >= _EDGES:
        resolution = f"resolves {subject}, with {edges:.0f} edges per wavelength."
    else:
        resolution = (
            f"does not resolve {subject}: it has {edges:.1f} edges per wavelength, and {_EDGES} are needed. Refine the "
            "mesh or increase the diffusivities."
        )
    number = f"{'' if is_exact else 'about '}{count}"
    message = f"{result}: {modes}. This surface has {number} such modes. The mesh {resolution}"
    return Explanation(not is_wave, growth, count, wavelength, edges, message)


def _required_ratio(growth: Dispersion) -> str:
    """A sentence with the ratio of diffusivities above which two species form a pattern."""
    if growth.diffusivity.size != 2:
        return ""
    (a, b), (c, d) = np.asarray(growth.jacobian)
    if a + d > 0 or a * d - b * c <= 0:
        return ""
    if max(a, d) <= 0:
        return "Neither species promotes itself there, so no diffusivities would make one. "
    activator, self_rate = ("first", a) if a > 0 else ("second", d)
    ratio = ((np.sqrt(a * d - b * c) + np.sqrt(-b * c)) / self_rate) ** 2
    first, second = growth.diffusivity
    actual = float(second / first if a > 0 else first / second)
    return (
        f"The {activator} species promotes itself: a pattern needs the other species to diffuse more than {ratio:.4g} "
        f"times as fast, and it diffuses {actual:.4g} times as fast. "
    )


def _count_modes(surface: Surface, band: tuple[float, float]) -> tuple[int, bool]:
    """The number of modes of the surface with eigenvalues in a band, and whether it is exact rather than estimated."""
    low, high = band
    area = float(np.asarray(surface.vertex_areas, np.float64).sum())
    estimate = area * (high - low) / (4 * np.pi)
    needed = int(1.3 * area * high / (4 * np.pi)) + 12 if np.isfinite(high) else _MODES + 1
    if needed > min(_MODES, surface.num_vertices - 2):
        return round(min(estimate, surface.num_vertices)), False
    values = np.asarray(eigenmodes(surface, needed).values)
    return int(((values > low) & (values < high)).sum()), True
