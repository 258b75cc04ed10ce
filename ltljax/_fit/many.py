"""Many fits at once, from many starts or to many data sets; and starts for losses with many valleys."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from .._base.deprecated import renamed_arguments, warn_deprecated
from .observations import Observations, refuse_infinite
from .problem import FitResiduals, Model, Problem, Residuals, first_unknowns, forward_adjoint, prepare
from .scan import distance_to
from .unknowns import Unknowns


class ManyFits(eqx.Module):
    """The results of fits that ran at once.

    Attributes:
        params: fitted parameters, with the fits along a new first axis.
        losses: (N,) loss of each fit; infinite if the model fails at the start.
        num_iterations: (N,) number of iterations of each fit.
        converged: (N,) whether each fit has settled. Whether the model explains the data is not checked.
        calibration: fitted scale, offset and background of the data, by name, with the fits along a new first axis.
    """

    params: Any
    losses: Float[Array, " N"]
    num_iterations: Array
    converged: Bool[Array, " N"]
    calibration: dict[str, Array]

    @property
    def num_steps(self) -> Array:
        """Deprecated name of ``num_iterations``."""
        warn_deprecated("ManyFits.num_steps", "num_iterations")
        return self.num_iterations

    @property
    def best(self) -> Any:
        """The parameters of the fit with the least loss."""
        return jax.tree.map(lambda leaf: leaf[jnp.nanargmin(self.losses)], self.params)


@renamed_arguments(max_steps="max_iterations")
def fit_many(
    model: Model,
    starts: Any,
    data: Observations,
    *,
    values: Any = None,
    transforms: Any = None,
    penalty: Residuals | None = None,
    method: Any = None,
    rtol: float = 1e-5,
    atol: float = 1e-7,
    max_iterations: int = 60,
) -> ManyFits:
    """Many fits at once, from many starts or to many data sets, by `jax.vmap` over all iterations of a fit.

    Args:
        model: model, as of `fit`.
        starts: first guesses along a first axis (N, ...) of every leaf; with ``values`` a single one.
        data: the `Observations`; with ``values`` only their shape, noise, times and vertices count.
        values: (N, ...) values of many data sets, in place of those of ``data``.
        transforms: ranges of the parameters, as of `fit`.
        penalty: penalty, as of `fit`.
        method: method of optimistix, as of `fit`.
        rtol: relative tolerance, as of `fit`.
        atol: absolute tolerance, as of `fit`.
        max_iterations: largest number of iterations of each fit.

    Returns:
        The `ManyFits`.

    Raises:
        ValueError: as of `fit`, or the first axes do not match.
    """
    if data.has_moving_spread:
        raise ValueError(
            "fit_many needs known noise: give Observations(..., noise=...) with a robust loss, and no relative_noise; "
            "or call ltl.fit for each."
        )
    data_sets = None if values is None else _data_sets(values, data)
    space, z = _first_vectors(starts, transforms, data, None if data_sets is None else data_sets[0])
    problem = prepare(model, space, data, penalty, method, z[0], rtol, atol)

    def run(start_or_data_set):
        if data_sets is None:
            return _fit_one(problem, start_or_data_set, None, max_iterations)
        return _fit_one(problem, z[0], start_or_data_set, max_iterations)

    mapped_over = z if data_sets is None else data_sets
    # The arrays that `run` reads become arguments: as constants of the program, XLA would slowly fold them.
    converted = eqx.filter_closure_convert(run, jax.tree.map(lambda leaf: leaf[0], mapped_over))
    arrays, rest = eqx.partition(converted, eqx.is_array)
    vmapped = jax.vmap(lambda arrays, x: eqx.combine(arrays, rest)(x), in_axes=(None, 0))
    return ManyFits(*jax.jit(vmapped, compiler_options=_compiler_options())(arrays, mapped_over))


def _fit_one(problem: Problem, z: Array, data_set: tuple[Array, Array] | None, max_iterations: int) -> tuple[Any, ...]:
    """One of many fits: the fields of `ManyFits`."""
    residuals = problem.program
    if data_set is not None:
        residuals = eqx.tree_at(lambda r: (r.arrays.data.values, r.arrays.data.mask), residuals, data_set)
    objective, _ = problem.objective(residuals, z)
    minimise = optx.least_squares if problem.is_least_squares else optx.minimise
    solution = minimise(objective, problem.solver, z, has_aux=True, throw=False, max_steps=max_iterations)
    loss = 0.5 * jnp.sum(residuals(solution.value) ** 2)
    converged = (solution.result == optx.RESULTS.successful) & jnp.isfinite(loss)
    params, calibration = problem.space.values(solution.value)
    return params, loss, solution.stats["num_steps"], converged, calibration


def _data_sets(values: Any, data: Observations) -> tuple[Array, Array]:
    """The values (N, ...) of many data sets, zero where nothing was measured, and their masks."""
    is_given = ~np.ma.getmaskarray(values) if isinstance(values, np.ma.MaskedArray) else True
    values = values.filled(0) if isinstance(values, np.ma.MaskedArray) else values
    many = jnp.asarray(values, data.values.dtype)
    if many.shape[1:] != data.values.shape:
        raise ValueError(f"Expected values of shape (N, *{data.values.shape}), found {many.shape}.")
    refuse_infinite(np.asarray(many))
    mask = ~jnp.isnan(many) & data.mask[None] & jnp.asarray(np.broadcast_to(is_given, many.shape))
    many = jnp.where(mask, many, 0)
    counts = np.asarray(mask).reshape(len(many), -1).sum(axis=1)
    if not counts.all():
        raise ValueError(f"Data set {int(np.argmin(counts))} has no measured values. Leave it out.")
    if data.is_count and bool(jnp.any(many < 0)):
        raise ValueError('Expected counts from 0 with noise="poisson", found a negative value.')
    return many, mask


def _first_vectors(starts: Any, transforms: Any, data: Observations, values: Array | None) -> tuple[Unknowns, Array]:
    """The unknowns and their first vectors (N, n), or (1, n) if many data sets have one start.

    The transforms check every start; the scales are those of the first.
    """
    if values is not None:
        typical_size = float(np.sqrt(np.mean(np.asarray(values, np.float64) ** 2))) or 1.0
        space, z = first_unknowns(starts, transforms, data, typical_size)
        return space, z[None]
    leaves = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(starts)]
    shapes = {leaf.shape[:1] for leaf in leaves}
    if len(shapes) != 1 or shapes == {()}:
        raise ValueError(f"Expected starts with one first axis of equal length in every leaf, found {sorted(shapes)}.")
    each = [jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], starts) for k in range(len(leaves[0]))]
    spaces, vectors = zip(*(first_unknowns(start, transforms, data) for start in each), strict=True)
    space = spaces[0]
    return space, jnp.stack([space.free(own.values(vector)) for own, vector in zip(spaces, vectors, strict=True)])


def _compiler_options() -> dict[str, str] | None:
    """Options that avoid a deadlock of a batch of Levenberg-Marquardt iterations on CPU with jax before 0.12.

    The scheduler that runs independent operations concurrently waits for ever at some sizes (8 fits of 3855 residuals
    with jaxlib 0.10.1); tests/test_backend.py checks for it.
    """
    has_deadlock = jax.default_backend() == "cpu" and jax.__version_info__ < (0, 12)
    return {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"} if has_deadlock else None


def explore(
    model: Model,
    low: Any,
    high: Any,
    data: Observations,
    *,
    count: int = 64,
    keep: int = 8,
    batch: int = 16,
    seed: int = 0,
    logarithmic: bool = True,
) -> tuple[Any, np.ndarray]:
    """First guesses by a global search: the best of many points that fill a box evenly (host).

    It helps with losses that have many valleys, such as those of statistics of patterns. The guesses are starts of
    `fit_many`. The points are a scrambled Sobol sequence.

    Args:
        model: model, as of `fit`.
        low: least values of the parameters: a pytree of floats.
        high: largest values of the parameters.
        data: the `Observations`.
        count: number of points; a power of two fills the box best.
        keep: number of guesses to return.
        batch: number of points to run at once.
        seed: seed of the scrambling.
        logarithmic: whether positive ranges are filled evenly in the logarithm.

    Returns:
        The guesses along a first axis of every leaf, in ascending order of their losses; and the losses, infinite if
        the model fails. If a scale, an offset or the noise of a robust loss is unknown, the losses are mean distances
        from the data with the best scale and offset instead.

    Raises:
        ValueError: a range is empty, or data and model do not match.
    """
    points, rebuild = _points_in_box(low, high, count, seed, logarithmic)
    space, first = first_unknowns(rebuild(jnp.asarray(points[0])), None, data)
    guesses = space.calibration(first)
    spread = jnp.ones(data.spread_shape, jnp.result_type(float))
    residuals = FitResiduals(model, data, space, None, forward_adjoint(model), spread)
    free = jax.vmap(lambda point: space.free((rebuild(point), guesses)))
    z = np.asarray(free(jnp.asarray(points, jnp.result_type(float))))
    data.check(eqx.filter_eval_shape(lambda z: residuals.predicted(z), z[0]))
    # If scale or noise is unknown, each point has its own best one, and points are compared by their distance.
    by_distance = bool(guesses) or data.has_moving_spread

    def evaluate(z: Array) -> Array:
        return data.of(residuals.predicted(z)) if by_distance else 0.5 * jnp.sum(residuals(z) ** 2)

    converted = eqx.filter_closure_convert(evaluate, jnp.asarray(z[0]))
    several = eqx.filter_jit(lambda c, z: jax.vmap(c)(z))
    batch = min(batch, count)
    losses = np.empty(count)
    for begin in range(0, count, batch):
        # The last batch overlaps the one before, so that all have the same shape.
        begin = min(begin, count - batch)
        values = np.asarray(several(converted, jnp.asarray(z[begin : begin + batch])), np.float64)
        if by_distance:
            values = [distance_to(data, value) if np.isfinite(value).all() else np.inf for value in values]
        losses[begin : begin + batch] = values
    best = np.argsort(losses)[:keep]
    return jax.vmap(rebuild)(jnp.asarray(points[best])), losses[best]


def _points_in_box(low: Any, high: Any, count: int, seed: int, logarithmic: bool) -> tuple[np.ndarray, Any]:
    """The points (count, n) of a scrambled Sobol sequence in a box, and the function from a point to parameters."""
    from scipy.stats import qmc

    flat_low, rebuild = ravel_pytree(jax.tree.map(np.float64, low))
    flat_high, _ = ravel_pytree(jax.tree.map(np.float64, high))
    least, most = np.asarray(flat_low), np.asarray(flat_high)
    if least.shape != most.shape or not (least < most).all():
        raise ValueError(f"Expected low < high for every parameter, found {low} and {high}.")
    share = qmc.Sobol(len(least), rng=seed).random(count)
    in_log = (least > 0) & logarithmic
    safe_least, safe_most = np.where(in_log, least, 1.0), np.where(in_log, most, 1.0)
    points = np.where(in_log, safe_least * (safe_most / safe_least) ** share, least + (most - least) * share)
    return points, rebuild
