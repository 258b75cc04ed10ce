"""Many fits at once, from many starts or to many data sets; and where to start when a loss has many valleys."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from .observations import Observations, refuse_infinite
from .problem import FitResiduals, Model, Residuals, first_unknowns, forward_adjoint, prepare
from .scan import distance_to


class ManyFits(eqx.Module):
    """Fits that ran at once.

    Attributes:
        params: the parameters, with the fits along a new first axis.
        losses: (N,) of each; infinite where the model fails at the start.
        num_steps: (N,).
        converged: (N,) whether each has settled; whether the model explains the data is not asked here.
        calibration: unknown scale, offset and background of the data, by name, with the fits along a new first axis.
    """

    params: Any
    losses: Float[Array, " N"]
    num_steps: Array
    converged: Bool[Array, " N"]
    calibration: dict[str, Array]

    @property
    def best(self) -> Any:
        """The parameters of the least loss."""
        return jax.tree.map(lambda leaf: leaf[jnp.nanargmin(self.losses)], self.params)


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
    max_steps: int = 60,
) -> ManyFits:
    """Many fits at once, from many starts or to many data sets, by `jax.vmap` over the whole of `fit`'s iteration.

    Args:
        model: as of `fit`.
        starts: the first guesses, along a first axis (N, ...) of every leaf; with ``values`` one for all.
        data: the `Observations`; with ``values`` their shape, noise, times and vertices.
        values: (N, ...) the values of many data sets, in place of those of ``data``.
        transforms: as of `fit`.
        penalty: as of `fit`.
        method: as of `fit`, of optimistix.
        rtol: as of `fit`.
        atol: as of `fit`.
        max_steps: as of `fit`.

    Raises:
        ValueError: as of `fit`, or the first axes do not fit.
    """
    is_given = ~np.ma.getmaskarray(values) if isinstance(values, np.ma.MaskedArray) else True
    values = values.filled(0) if isinstance(values, np.ma.MaskedArray) else values
    many = None if values is None else jnp.asarray(values, data.values.dtype)
    if many is not None and many.shape[1:] != data.values.shape:
        raise ValueError(f"Expected values of shape (N, *{data.values.shape}), found {many.shape}.")
    if data.has_moving_spread:
        raise ValueError(
            "fit_many takes the noise as given: give Observations(..., noise=...) beside a robust loss, and no "
            "relative_noise; or call ltl.fit for each."
        )
    measured = None
    if many is not None:
        refuse_infinite(np.asarray(many))
        measured = ~jnp.isnan(many) & data.mask[None] & jnp.asarray(np.broadcast_to(is_given, many.shape))
        many = jnp.where(measured, many, 0)
        counts = np.asarray(measured).reshape(len(many), -1).sum(axis=1)
        if not counts.all():
            raise ValueError(f"Data set {int(np.argmin(counts))} has no value that was measured. Leave it out.")
        if data.is_count and bool(jnp.any(many < 0)):
            raise ValueError('Expected counts from 0 with noise="poisson", found a negative value.')
    leaves = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(starts)]
    shapes = {leaf.shape[:1] for leaf in leaves}
    if values is None and (len(shapes) != 1 or shapes == {()}):
        raise ValueError(f"Expected starts with one first axis of equal length in every leaf, found {sorted(shapes)}.")
    rows = len(leaves[0]) if many is None else None
    # The ranges are asked of every start, the scales are those of the first.
    each = (
        [starts] if rows is None else [jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k], starts) for k in range(rows)]
    )
    size = None if many is None else float(np.sqrt(np.mean(np.asarray(many, np.float64) ** 2))) or 1.0
    spaces, vectors = zip(*(first_unknowns(start, transforms, data, size) for start in each), strict=True)
    space = spaces[0]
    z = jnp.stack([space.free(own.values(vector)) for own, vector in zip(spaces, vectors, strict=True)])
    problem = prepare(model, space, data, penalty, method, z[0], rtol, atol)

    def one(z, values):
        residuals = problem.program
        if values is not None:
            residuals = eqx.tree_at(lambda r: (r.arrays.data.values, r.arrays.data.mask), residuals, values)
        function, _ = problem.function(residuals, z)
        call = optx.least_squares if problem.is_least_squares else optx.minimise
        out = call(function, problem.solver, z, has_aux=True, throw=False, max_steps=max_steps)
        loss = 0.5 * jnp.sum(residuals(out.value) ** 2)
        converged = (out.result == optx.RESULTS.successful) & jnp.isfinite(loss)
        params, calibration = space.values(out.value)
        return params, loss, out.stats["num_steps"], converged, calibration

    def whole(given):
        return one(given, None) if many is None else one(z[0], given)

    along = z if many is None else (many, measured)
    # With the arrays it reads as leaves: as constants of the program they would be folded, slowly.
    converted = eqx.filter_closure_convert(whole, jax.tree.map(lambda leaf: leaf[0], along))
    arrays, rest = eqx.partition(converted, eqx.is_array)
    mapped = jax.jit(
        jax.vmap(lambda arrays, one: eqx.combine(arrays, rest)(one), in_axes=(None, 0)), compiler_options=_options()
    )
    return ManyFits(*mapped(arrays, along))


def _options() -> dict[str, str] | None:
    """What keeps a batch of Levenberg-Marquardt steps from never ending on CPU with jax before 0.12.

    The scheduler that lets independent operations run side by side then waits for ever, at some sizes (8 fits of 3855
    residuals with jaxlib 0.10.1); tests/test_backend.py watches for it.
    """
    waits = jax.default_backend() == "cpu" and jax.__version_info__ < (0, 12)
    return {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"} if waits else None


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
    """First guesses by a global search: the model at points that fill a box evenly, the best kept (host).

    For losses with many valleys, such as statistics of patterns; the guesses are starts of `fit_many`. The points are
    Sobol's sequence, scrambled.

    Args:
        model: as of `fit`.
        low: the least values: a pytree of floats.
        high: the largest ones.
        data: the `Observations`.
        count: of points; a power of two fills best.
        keep: how many to return.
        batch: how many to run at once.
        seed: of the scrambling.
        logarithmic: whether positive ranges are filled evenly in the logarithm.

    Returns:
        The guesses, along a first axis of every leaf, the best first; and their losses, infinite where the model fails.
        Where a scale, an offset or the noise of a robust loss is unknown, these are mean distances from the data
        instead, after scale and offset are set to their best values.

    Raises:
        ValueError: a range is empty, or data and model do not go together.
    """
    from scipy.stats import qmc

    (least, rebuild), (most, _) = (
        ravel_pytree(jax.tree.map(np.float64, low)),
        ravel_pytree(jax.tree.map(np.float64, high)),
    )
    least, most = np.asarray(least), np.asarray(most)
    if least.shape != most.shape or not (least < most).all():
        raise ValueError(f"Expected low < high for every parameter, found {low} and {high}.")
    share = qmc.Sobol(len(least), rng=seed).random(count)
    in_log = (least > 0) & logarithmic
    safe = np.where(in_log, least, 1.0), np.where(in_log, most, 1.0)
    points = np.where(in_log, safe[0] * (safe[1] / safe[0]) ** share, least + (most - least) * share)
    space, first = first_unknowns(rebuild(jnp.asarray(points[0])), None, data)
    guesses = space.calibration(first)
    spread = jnp.ones(data.spread_shape, jnp.result_type(float))
    residuals = FitResiduals(model, data, space, None, forward_adjoint(model), spread)
    free = jax.vmap(lambda point: space.free((rebuild(point), guesses)))
    z = np.asarray(free(jnp.asarray(points, jnp.result_type(float))))
    data.check(eqx.filter_eval_shape(lambda z: residuals.predicted(z), z[0]))
    # If scale or noise is unknown each point has its own best one, and points are compared by their distance.
    by_distance = bool(guesses) or data.has_moving_spread

    def asked(z: Array) -> Array:
        return data.of(residuals.predicted(z)) if by_distance else 0.5 * jnp.sum(residuals(z) ** 2)

    converted = eqx.filter_closure_convert(asked, jnp.asarray(z[0]))
    several = eqx.filter_jit(lambda c, z: jax.vmap(c)(z))
    batch = min(batch, count)
    losses = np.empty(count)
    for begin in range(0, count, batch):
        # The last batch reaches back, so that all have one shape.
        begin = min(begin, count - batch)
        values = np.asarray(several(converted, jnp.asarray(z[begin : begin + batch])), np.float64)
        if by_distance:
            values = [distance_to(data, value) if np.isfinite(value).all() else np.inf for value in values]
        losses[begin : begin + batch] = values
    best = np.argsort(losses)[:keep]
    return jax.vmap(rebuild)(jnp.asarray(points[best])), losses[best]
