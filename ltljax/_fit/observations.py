"""What was measured, and the run that is to reproduce it: data with their noise, and an experiment."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import lambertw

from .._base.arguments import as_numbers, positive
from .._equations import Equation
from .._solve import Multigrid, Solution, solve
from .._surface import Surface
from .._tables import AnyArray
from .calibration import Calibration, broadcasts, calibration
from .losses import Loss, as_loss
from .sampling import Sampling, as_sampling

# Standard deviation of a normal distribution over the median of its absolute values.
_NORMAL_OVER_MEDIAN = 1.4826


class Observations(eqx.Module):
    """Measured values of some species at some places and times, or of any statistic.

    A value is compared with ``scale * field + offset + amount * background``, where the field is the model's prediction
    at the vertex, or a weighted sum of its values at several. Scale and offset are known numbers, or unknown:
    ``scale=Positive(1.0)`` gives the fit an unknown factor for each species that was seen. Values that are NaN or
    masked were not measured, and are left out.

    Example:
        >>> import numpy as np
        >>> import ltljax as ltl
        >>> values = np.array([[1.0, 2.0, np.nan], [3.0, 60.0, 5.0]])
        >>> data = ltl.Observations(values, noise=0.1, times=[0.5, 1.0], loss="huber")
        >>> data.num_values
        5

    Attributes:
        values: (T, N, S) at T times, N places and S species; without an axis where the model has none: (T, N) of a
            scalar equation, (N, S) of a stationary state, any shape of a statistic. Zero where nothing was measured.
            The last of two axes without times, and of three with times, counts as that of species.
        mask: which values were measured, in the shape of the values.
        noise: standard deviation of the noise where the signal is zero, a number or anything that broadcasts to the
            values; None where it is not known, and for counts.
        relative_noise: standard deviation of the part of the noise that grows with the signal, as a share of it.
        is_count: whether the values are counts, with Poisson's distribution.
        times: (T,), ascending; None where the model gives one state, or a statistic.
        vertices: (N,) indices; None for all, or where ``sampling`` says where.
        sampling: weighted sums of values at vertices; None where values at single vertices were measured.
        species: columns of the state that were seen; None for all.
        calibration: scale, offset and background of the values.
        loss: loss function.
    """

    values: Float[Array, "..."]
    mask: Bool[Array, "..."]
    noise: Float[Array, "..."] | None
    relative_noise: Float[Array, ""] | None
    times: np.ndarray | None
    vertices: np.ndarray | None
    sampling: Sampling | None
    calibration: Calibration
    loss: Loss
    is_count: bool = eqx.field(static=True)
    species: tuple[int, ...] | None = eqx.field(static=True)
    _mask_size: int | None = eqx.field(static=True)

    def __init__(
        self,
        values: Any,
        noise: Any = None,
        times: Any = None,
        vertices: Any = None,
        species: int | tuple[int, ...] | None = None,
        *,
        mask: Any = None,
        loss: Any = "linear",
        relative_noise: float | None = None,
        scale: Any = None,
        offset: Any = None,
        background: Any = None,
        operator: Any = None,
    ):
        """Check the data.

        Args:
            values: what was measured; NaN or masked where nothing was.
            noise: standard deviation of the noise, a number or anything that broadcasts to the values; ``"poisson"``
                for counts; None where it is not known: the fit then estimates it from the residuals.
            times: times of the measurements, ascending.
            vertices: (N,) indices or a mask (V,); None for all.
            species: columns of the state that were seen; None for all.
            mask: False where a value is to be left out; it broadcasts to the values.
            loss: ``"linear"``, least squares; ``"huber"``, ``"soft_l1"`` or ``"cauchy"``, which limit what wrong values
                can do, with the scale of the residuals from the data where no noise is given; or a function rho(z) of
                squared residuals z in units of the noise.
            relative_noise: standard deviation of the noise as a share of the signal, beside ``noise``.
            scale: factor between field and data: a number, one for each species, or unknown as ``Positive(1.0)``.
            offset: constant beside it: likewise, or unknown as ``Real(0.0)``.
            background: known pattern that broadcasts to the values, of which they hold an unknown amount.
            operator: weighted sums that were measured in place of values at vertices: from `observe_at` or
                `observe_patches`, or a matrix (N, V), dense or sparse.

        Raises:
            ValueError: there is no value left, one is infinite, a noise, a loss or an operator is not usable, or shapes
                do not go together.
        """
        dtype = jnp.result_type(float)
        is_given = ~np.ma.getmaskarray(values) if isinstance(values, np.ma.MaskedArray) else True
        values = values.filled(0) if isinstance(values, np.ma.MaskedArray) else values
        for name, given in (("values", values), ("times", times)):
            as_numbers(name, given)
        host = np.asarray(jnp.asarray(values, dtype))
        self.mask = jnp.asarray(_measured(host, mask, is_given))
        self.values = jnp.where(self.mask, jnp.asarray(host), 0)
        self.is_count = isinstance(noise, str) and noise == "poisson"
        self.noise = None if noise is None or self.is_count else _noise(noise, np.asarray(self.mask), dtype)
        if self.is_count and bool(jnp.any(self.values < 0)):
            raise ValueError('Expected counts from 0 with noise="poisson", found a negative value.')
        self.relative_noise = None
        if relative_noise is not None:
            if self.noise is None:
                raise ValueError(
                    "Expected noise= beside relative_noise=: the standard deviation that is left where the signal is "
                    "zero."
                )
            self.relative_noise = jnp.asarray(positive("relative_noise", relative_noise), dtype)
        self.loss = as_loss(loss)
        self.times = None if times is None else np.atleast_1d(np.asarray(times, np.float64))
        if self.times is not None:
            if self.times.ndim != 1 or not np.isfinite(self.times).all() or (np.diff(self.times) <= 0).any():
                raise ValueError(f"Expected finite ascending times, found {times}.")
            if host.shape[:1] != self.times.shape:
                raise ValueError(f"Expected values for {len(self.times)} times, found values of shape {host.shape}.")
        self._mask_size, self.vertices = _vertices(vertices)
        self.sampling = None if operator is None else as_sampling(operator)
        if self.sampling is not None and vertices is not None:
            raise ValueError("Expected either vertices= or operator=, found both.")
        self.species = None if species is None else tuple(int(s) for s in np.atleast_1d(species))
        if self.species is not None and (not self.species or min(self.species) < 0):
            raise ValueError(f"Expected species as columns of the state, from 0, found {species!r}.")
        columns = host.shape[-1:] if host.ndim == self._axis + 2 else ()
        self.calibration = calibration(scale, offset, background, columns, host.shape)

    @property
    def num_values(self) -> int:
        """Number of values that were measured."""
        return int(np.sum(np.asarray(self.mask)))

    @property
    def typical_size(self) -> float:
        """Root mean square of the values that were measured; 1 where all are zero."""
        return float(np.sqrt(np.mean(np.asarray(self.values, np.float64)[np.asarray(self.mask)] ** 2))) or 1.0

    @property
    def has_species(self) -> bool:
        """Whether the last axis of the values is that of species."""
        return self.values.ndim == self._axis + 2

    @property
    def columns(self) -> list[tuple[Any, ...]]:
        """Index of the values of each species; of all values where there is no axis of species."""
        return [(..., k) for k in range(self.values.shape[-1])] if self.has_species else [(...,)]

    @property
    def knows_noise(self) -> bool:
        """Whether the noise was given, as numbers or as that of counts."""
        return self.noise is not None or self.is_count

    @property
    def _axis(self) -> int:
        """The axis of places."""
        return 0 if self.times is None else 1

    def of(self, prediction: Any, calibration: dict[str, Array] | None = None) -> Array:
        """What a model's prediction, a `Solution`, states or a statistic, says of the values observed.

        Args:
            prediction: what the model returns.
            calibration: unknown scale, offset and background, by name; the values of the field itself without them.
        """
        if isinstance(prediction, Solution):
            # A run that failed predicts nothing.
            failed = prediction.overflowed | (prediction.result != diffrax.RESULTS.successful)
            states = prediction.u_end if self.times is None else prediction.us
            prediction = jnp.where(failed & ~prediction.stopped, jnp.nan, states)
        seen, axis = jnp.asarray(prediction), self._axis
        if self.sampling is not None:
            seen = self.sampling(seen, axis)
        if self.vertices is not None:
            seen = jnp.take(seen, self.vertices, axis=axis)
        if self.species is not None:
            seen = jnp.take(seen, np.array(self.species), axis=axis + 1)
            seen = seen[..., 0] if seen.ndim == self.values.ndim + 1 and len(self.species) == 1 else seen
        return self.calibration(seen, calibration or {})

    def check(self, prediction: Any) -> None:
        """Raise `ValueError` where the shapes of a prediction (arrays or their shapes) do not fit the data."""
        is_solution = isinstance(prediction, Solution)
        states = prediction.us if is_solution and self.times is not None else prediction
        shape = (states.u_end if isinstance(states, Solution) else states).shape
        axis = self._axis
        if self._mask_size is not None and len(shape) > axis and self._mask_size != shape[axis]:
            raise ValueError(
                f"Expected a mask of the model's {shape[axis]} vertices, found one of {self._mask_size}."
            )  # fmt: skip
        if self.sampling is not None and (len(shape) <= axis or self.sampling.num_vertices != shape[axis]):
            raise ValueError(
                f"The operator reads {self.sampling.num_vertices} vertices; the model predicts the shape {shape}."
            )
        if self.vertices is not None and len(shape) > axis and (self.vertices >= shape[axis]).any():
            raise ValueError(f"Vertex {self.vertices.max()} was observed; the model has {shape[axis]} vertices.")
        if self.species is not None and len(shape) <= axis + 1:
            raise ValueError(f"Species {max(self.species)} was observed; the model has only one: leave species= out.")
        if self.species is not None and max(self.species) >= shape[axis + 1]:
            raise ValueError(f"Species {max(self.species)} was observed; the model has {shape[axis + 1]} species.")
        predicted = jax.eval_shape(lambda prediction: self.of(prediction), prediction).shape
        if predicted != self.values.shape:
            raise ValueError(
                f"The model predicts an array of shape {predicted} for observations of shape {self.values.shape}. "
                "Expected (times, vertices, species), or what the model returns, with the same vertices and species."
            )

    def misfit(
        self, prediction: Any, calibration: dict[str, Array] | None = None, spread: Array | float = 1.0
    ) -> Float[Array, " M"]:
        """(prediction - value) / noise of every value; zero where nothing was measured.

        Of counts it is the signed root of the deviance, whose squares sum to twice the logarithm of a likelihood ratio.

        Args:
            prediction: what the model returns.
            calibration: unknown scale, offset and background, by name.
            spread: standard deviation of the residuals in units of the noise, as the data themselves show it.
        """
        seen = self.of(prediction, calibration)
        if self.is_count:
            # A safe rate where nothing was measured: derivatives of infinite roots would be NaN there.
            rates = jnp.where(self.mask, seen, 1)
            return jnp.ravel(jnp.where(self.mask, root_of_deviance(self.values, rates), 0))
        noise = jnp.broadcast_to(1.0 if self.noise is None else self.noise, seen.shape)
        spread = jnp.broadcast_to(jnp.asarray(spread, seen.dtype), seen.shape)
        return jnp.ravel(jnp.where(self.mask, (seen - self.values) / (noise * spread), 0))

    def predicted(self, misfit: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """What the model predicts for the values, from their misfit (host).

        Args:
            misfit: misfit in the shape of the values.
            spread: spread that it was computed with.
        """
        values = np.asarray(self.values, np.float64)
        if not self.is_count:
            noise = np.broadcast_to(1.0 if self.noise is None else np.asarray(self.noise, np.float64), values.shape)
            return values + misfit * noise * spread
        # With the deviance d = r^2 / 2 of a count n the rate solves rate / n - 1 - log(rate / n) = d / n.
        safe = np.where(values > 0, values, 1)
        inner = -np.exp(-1 - misfit**2 / (2 * safe))
        above, below = (-safe * np.real(lambertw(inner, branch)) for branch in (-1, 0))
        return np.where(values > 0, np.where(misfit > 0, above, below), misfit**2 / 2)

    def spread(self, misfit: np.ndarray, spread: np.ndarray, num_unknowns: int) -> np.ndarray:
        """Standard deviation of the misfit in units of the noise, to be used by `misfit` (host).

        It follows the prediction where the noise grows with the signal. With a robust loss and unknown noise it is
        1.4826 times the median of the absolute residuals of each species, which outliers hardly change. Elsewhere it
        is one.

        Args:
            misfit: (M,) misfit with a spread that was used before.
            spread: that spread.
            num_unknowns: number of unknowns of the fit.
        """
        values = np.asarray(self.values, np.float64)
        residuals = np.reshape(np.asarray(misfit, np.float64), values.shape) * spread
        if self.relative_noise is not None:
            noise = np.broadcast_to(np.asarray(self.noise, np.float64), values.shape)
            return np.sqrt(1 + (float(self.relative_noise) * (values / noise + residuals)) ** 2)
        if not self.estimates_spread:
            return np.ones(())
        return self.median_spread(residuals, num_unknowns)

    def median_spread(self, residuals: np.ndarray, num_unknowns: int) -> np.ndarray:
        """The standard deviation () or (S,) of residuals in the shape of the values, from their median (host).

        The smallest residuals are left out, as many as there are unknowns, which may fit that many values exactly; and
        those that are nothing but rounding.
        """
        mask = np.asarray(self.mask)
        noise = np.broadcast_to(1.0 if self.noise is None else np.asarray(self.noise, np.float64), mask.shape)
        size = np.sqrt(np.mean((np.asarray(self.values, np.float64) / noise)[mask] ** 2))
        least = max(10 * float(jnp.finfo(self.values.dtype).eps) * size, float(jnp.finfo(self.values.dtype).tiny))
        sizes = []
        for column in self.columns:
            off = np.sort(np.abs(residuals[column][mask[column]]))
            off = off[min(round(num_unknowns * off.size / self.num_values), max(off.size - 1, 0)) :]
            off = off[off > least]
            sizes.append(_NORMAL_OVER_MEDIAN * np.median(off) if off.size else least)
        return np.reshape(np.array(sizes), mask.shape[-1:] if self.has_species else ())

    @property
    def spread_shape(self) -> tuple[int, ...]:
        """Shape of `spread`."""
        if self.relative_noise is not None:
            return self.values.shape
        return self.values.shape[-1:] if self.estimates_spread and self.has_species else ()

    @property
    def estimates_spread(self) -> bool:
        """Whether the scale of the residuals is taken from the data: with a robust loss, where no noise is given."""
        return self.loss.is_robust and self.noise is None and not self.is_count

    @property
    def has_moving_spread(self) -> bool:
        """Whether the spread depends on the parameters, so that a fit must go on until both agree."""
        return self.estimates_spread or self.relative_noise is not None


def _measured(values: np.ndarray, mask: Any, is_given: Any) -> np.ndarray:
    """Which values count."""
    if values.size == 0:
        raise ValueError("Expected at least one observed value, found none.")
    counts = np.broadcast_to(is_given, values.shape) & ~np.isnan(values)
    if mask is not None:
        mask = np.asarray(mask)
        if mask.dtype != bool or not broadcasts(mask.shape, values.shape):
            raise ValueError(
                f"Expected mask as booleans of a shape that broadcasts to the values' {values.shape}, found the type "
                f"{mask.dtype} and the shape {mask.shape}."
            )
        counts = counts & mask
    refuse_infinite(np.where(counts, values, 0))
    if not counts.any():
        raise ValueError(f"None of the {values.size} values was measured: all are NaN or masked.")
    return counts


def _noise(noise: Any, mask: np.ndarray, dtype: Any) -> Array:
    """The standard deviation of the noise, checked."""
    if isinstance(noise, str):
        raise ValueError(f'Expected noise as a number, an array or "poisson", found {noise!r}.')
    shape, levels = mask.shape, jnp.asarray(as_numbers("noise", noise), dtype)
    fits = broadcasts(levels.shape, shape)
    if fits and levels.ndim:
        # It does not matter where nothing was measured.
        levels = jnp.where(jnp.asarray(mask), jnp.broadcast_to(levels, shape), 1)
    if not bool(jnp.all(jnp.isfinite(levels) & (levels > 0))):
        raise ValueError("Expected a positive noise level; for values without noise leave it out.")
    if not fits:
        raise ValueError(
            f"A noise of shape {levels.shape} does not fit values {shape}: expected one number, or a shape that "
            "broadcasts to the values'."
        )
    return levels


def _vertices(vertices: Any) -> tuple[int | None, np.ndarray | None]:
    """The size of a mask of vertices, None for indices, and the indices."""
    if vertices is None:
        return None, None
    seen, size = np.asarray(vertices), None
    if seen.dtype == bool:
        size, seen = seen.size, np.flatnonzero(seen) if seen.ndim == 1 else seen
    if seen.ndim != 1 or not np.issubdtype(seen.dtype, np.integer):
        raise ValueError(f"Expected vertices as indices (N,) or a mask (V,), found {vertices!r}.")
    if (seen < 0).any():
        raise ValueError(f"Expected vertices from 0, found {seen.min()}.")
    return size, seen


def root_of_deviance(counts: Array, rates: Array) -> Array:
    """The signed root of 2 (rate - count + count log(count / rate)); NaN where a rate is not positive, but for a count
    and a rate of zero.

    McCullagh and Nelder 1989, Generalized Linear Models, section 2.3.
    """
    is_seen = counts > 0
    is_rate = (rates > 0) | ((rates == 0) & ~is_seen)
    rates = jnp.where(rates > 0, rates, jnp.where(is_rate, jnp.finfo(rates.dtype).tiny, 1))
    off = rates / jnp.where(is_seen, counts, 1) - 1
    is_near = jnp.abs(off) < 0.05
    # 2 (off - log(1 + off)) / off^2, which loses its digits next to zero, by its power series there.
    series = sum(2 * (-1.0) ** k / (k + 2) * jnp.where(is_near, off, 0) ** k for k in range(14))
    far = jnp.where(is_near, 1.0, off)
    ratio = jnp.where(is_near, series, 2 * (far - jnp.log1p(far)) / far**2)
    some = jnp.sqrt(jnp.where(is_seen, counts, 1)) * off * jnp.sqrt(ratio)
    none = jnp.sqrt(2 * rates)
    return jnp.where(is_rate, jnp.where(is_seen, some, none), jnp.nan)


def refuse_infinite(values: np.ndarray) -> None:
    """Raise `ValueError` where a value is infinite."""
    bad = np.argwhere(np.isinf(values))
    if len(bad):
        first = tuple(int(i) for i in bad[0])
        raise ValueError(
            f"Expected finite observations, found {values[first]} at index {first} ({len(bad)} such values in all). "
            "Mark what was not measured as NaN."
        )


class Experiment(eqx.Module):
    """A run as a function of what is unknown about it: ``experiment(params, times)`` is its `Solution`.

    Attributes:
        equation: ``params -> Equation``.
        surface: where.
        u0: the initial state, or ``params -> state``.
        t1: the end; by default the last time observed.
        t0: the beginning.
        vertices: ``params -> (V, 3)`` where the shape is unknown too.
        solver: as of `solve`.
        dt: as of `solve`.
        rtol: as of `solve`.
        atol: as of `solve`.
        max_steps: a run of more steps counts as diverged.
        preconditioner: as of `solve`.
    """

    equation: Callable[[Any], Equation]
    surface: Surface
    u0: Float[AnyArray, "V *S"] | Callable[[Any], Float[AnyArray, "V *S"]]
    t1: float | None = None
    t0: float = 0.0
    vertices: Callable[[Any], Array] | None = None
    solver: diffrax.AbstractSolver | None = None
    dt: float | None = None
    rtol: float = 1e-5
    atol: float | None = None
    max_steps: int = 100_000
    preconditioner: Multigrid | None = None

    def __call__(self, params: Any, times: Any = None, adjoint: diffrax.AbstractAdjoint | None = None) -> Solution:
        """The run of some parameters."""
        surface = self.surface if self.vertices is None else self.surface.with_vertices(self.vertices(params))
        u0 = self.u0(params) if callable(self.u0) else self.u0
        times = None if times is None else np.asarray(times, np.float64)
        end = self.t1 if self.t1 is not None else times[-1] if times is not None else None
        if end is None:
            raise ValueError("Expected an end of the run: give Experiment(t1=...), or observations with times.")
        if times is not None and (times[0] < self.t0 or times[-1] > end * (1 + 1e-12)):
            raise ValueError(
                f"Observations at times from {times[0]:g} to {times[-1]:g} lie outside the run, from {self.t0:g} to "
                f"{end:g}."
            )
        return solve(
            self.equation(params), surface, u0, end, times, self.solver, adjoint, t0=self.t0, dt=self.dt,
            rtol=self.rtol, atol=self.atol, max_steps=self.max_steps, preconditioner=self.preconditioner, throw=False,
        )  # fmt: skip
