"""What was seen, and what was done to see it: data with their noise, and the run that is to reproduce them."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..equations import Equation
from ..mesh.arguments import as_numbers
from ..solve import Multigrid, Solution, solve
from ..surface import Surface
from ..tables import AnyArray


class Observations(eqx.Module):
    """Measured values of some species at some vertices and times, or of any statistic.

    Attributes:
        values: (T, N, S) at T times, N vertices and S species; without an axis where the model has none: (T, N) of a
            scalar equation, (N, S) of a stationary state, any shape of a statistic.
        noise: the standard deviation of the values' noise, a number or anything that broadcasts to them; None where
            it is not known: the fit then estimates it from what remains.
        times: (T,), ascending; None where the model gives one state, or a statistic.
        vertices: (N,) indices, or a mask (V,); None for all.
        species: the columns of the state that were seen; None for all.
    """

    values: Float[Array, "..."]
    noise: Float[Array, "..."] | None
    times: np.ndarray | None
    vertices: np.ndarray | None
    species: tuple[int, ...] | None = eqx.field(static=True)
    _mask_size: int | None = eqx.field(static=True)

    def __init__(
        self,
        values: Any,
        noise: Any = None,
        times: Any = None,
        vertices: Any = None,
        species: int | tuple[int, ...] | None = None,
    ):
        dtype = jnp.result_type(float)
        for name, given in (("values", values), ("noise", noise), ("times", times)):
            as_numbers(name, given)
        self.values = jnp.asarray(values, dtype)
        host = np.asarray(self.values)
        if host.size == 0:
            raise ValueError("Expected at least one observed value, found none.")
        refuse_non_finite(host)
        self.noise = None if noise is None else jnp.asarray(noise, dtype)
        if self.noise is not None:
            if not bool(jnp.all(jnp.isfinite(self.noise) & (self.noise > 0))):
                raise ValueError("Expected a positive noise level; for values without noise leave it out.")
            try:
                fits = np.broadcast_shapes(self.noise.shape, host.shape) == host.shape
            except ValueError:
                fits = False
            if not fits:
                raise ValueError(
                    f"A noise of shape {self.noise.shape} does not fit values {host.shape}: expected one number, or a "
                    "shape that broadcasts to the values'."
                )
        self.times = None if times is None else np.atleast_1d(np.asarray(times, np.float64))
        if self.times is not None:
            if self.times.ndim != 1 or not np.isfinite(self.times).all() or (np.diff(self.times) <= 0).any():
                raise ValueError(f"Expected finite ascending times, found {times}.")
            if host.shape[0] != len(self.times):
                raise ValueError(f"Expected values for {len(self.times)} times, found values of shape {host.shape}.")
        seen = None if vertices is None else np.asarray(vertices)
        self._mask_size = None
        if seen is not None:
            if seen.dtype == bool:
                self._mask_size, seen = seen.size, np.flatnonzero(seen) if seen.ndim == 1 else seen
            if seen.ndim != 1 or not np.issubdtype(seen.dtype, np.integer):
                raise ValueError(f"Expected vertices as indices (N,) or a mask (V,), found {vertices!r}.")
            if (seen < 0).any():
                raise ValueError(f"Expected vertices from 0, found {seen.min()}.")
        self.vertices = seen
        self.species = None if species is None else tuple(int(s) for s in np.atleast_1d(species))
        if self.species is not None and (not self.species or min(self.species) < 0):
            raise ValueError(f"Expected species as columns of the state, from 0, found {species!r}.")

    def of(self, prediction: Any) -> Array:
        """What a model's prediction, a `Solution`, states or a statistic, says of the values observed."""
        if isinstance(prediction, Solution):
            # A run that failed predicts nothing.
            failed = prediction.overflowed | (prediction.result != diffrax.RESULTS.successful)
            states = prediction.u_end if self.times is None else prediction.us
            prediction = jnp.where(failed & ~prediction.stopped, jnp.nan, states)
        seen, axis = jnp.asarray(prediction), 0 if self.times is None else 1
        if self.vertices is not None:
            seen = jnp.take(seen, self.vertices, axis=axis)
        if self.species is not None:
            seen = jnp.take(seen, np.array(self.species), axis=axis + 1)
            seen = seen[..., 0] if seen.ndim == self.values.ndim + 1 and len(self.species) == 1 else seen
        return seen

    def check(self, prediction: Any) -> None:
        """Raise `ValueError` where the shapes of a prediction (arrays or their shapes) do not fit the data."""
        is_solution = isinstance(prediction, Solution)
        states = prediction.us if is_solution and self.times is not None else prediction
        shape = (states.u_end if isinstance(states, Solution) else states).shape
        axis = 0 if self.times is None else 1
        if self._mask_size is not None and len(shape) > axis and self._mask_size != shape[axis]:
            raise ValueError(
                f"Expected a mask of the model's {shape[axis]} vertices, found one of {self._mask_size}."
            )  # fmt: skip
        if self.vertices is not None and len(shape) > axis and (self.vertices >= shape[axis]).any():
            raise ValueError(f"Vertex {self.vertices.max()} was observed; the model has {shape[axis]} vertices.")
        if self.species is not None and len(shape) <= axis + 1:
            raise ValueError(f"Species {max(self.species)} was observed; the model has but one: leave species= out.")
        if self.species is not None and max(self.species) >= shape[axis + 1]:
            raise ValueError(f"Species {max(self.species)} was observed; the model has {shape[axis + 1]} species.")
        found = jax.eval_shape(self.of, prediction).shape
        if found != self.values.shape:
            raise ValueError(
                f"The model predicts an array of shape {found} for observations of shape {self.values.shape}: expected "
                "(times, vertices, species), or what the model returns, with the same vertices and species."
            )

    def misfit(self, prediction: Any) -> Float[Array, " M"]:
        """(prediction - value) / noise, of every value."""
        noise = 1.0 if self.noise is None else self.noise
        return jnp.ravel((self.of(prediction) - self.values) / noise)


def refuse_non_finite(values: np.ndarray) -> None:
    """Raise `ValueError` where a value is NaN or infinite."""
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        first = tuple(int(i) for i in bad[0])
        raise ValueError(
            f"Expected finite observations, found {values[first]} at index {first} ({len(bad)} such values in all). "
            "Leave these vertices out with vertices=."
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
