"""A fit ready to run: residuals of a vector of unknowns, their derivatives, and the method that steps on them."""

import collections
import dataclasses
import inspect
import threading
from collections.abc import Callable, Hashable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from .._solve.fingerprint import fingerprint, read_from_modules
from .methods import MANY, method_of
from .observations import Experiment, Observations
from .unknowns import Unknowns, unknowns

# The first damping, relative to the Jacobian's norm: after Marquardt (1963), who begins with a hundredth of its square.
_DAMPING = 0.1

# Traced programs kept for a second fit of the same model.
_KEPT = 8

Model = Experiment | Callable[..., Any]
Residuals = Callable[[Any], Any]


class FitResiduals(eqx.Module):
    """The residuals of a vector of unknowns: misfit to the data, then penalties.

    Attributes:
        model: model.
        data: data.
        space: unknowns.
        penalty: function from parameters to residuals that are added to those of the data.
        adjoint: adjoint that makes time stepping differentiable in the mode needed.
        spread: standard deviation of the misfit in units of the noise.
    """

    model: Model | None
    data: Observations
    space: Unknowns
    penalty: Residuals | None
    adjoint: diffrax.AbstractAdjoint | None
    spread: Array

    def predicted(self, z: Array) -> Any:
        """What the model gives."""
        params = self.space.params(z)
        assert self.model is not None, "what differs from fit to fit has no model"
        if isinstance(self.model, Experiment):
            return self.model(params, self.data.times, self.adjoint)
        return self.model(params) if self.adjoint is None else self.model(params, adjoint=self.adjoint)

    def both(self, z: Array) -> tuple[Array, Array]:
        """Residuals (M + P,) whose squared halves sum to the loss, infinite where the model fails; the misfit (M,)."""
        misfit = self.data.misfit(self.predicted(z), self.space.calibration(z), self.spread)
        residuals = self.data.loss.root(misfit)
        if self.penalty is not None:
            penalties = ravel_pytree(self.penalty(self.space.params(z)))[0]
            residuals = jnp.concatenate([residuals, penalties.astype(misfit.dtype)])
        return jnp.where(jnp.all(jnp.isfinite(residuals)), residuals, jnp.inf), misfit

    def __call__(self, z: Array) -> Array:
        """The residuals."""
        return self.both(z)[0]


class Program(eqx.Module):
    """The residuals as a traced program, which a second fit of the same model finds compiled.

    Attributes:
        run: program, from the arrays and a vector of unknowns to residuals and misfit.
        arrays: `FitResiduals` reduced to its arrays.
    """

    run: Callable[[Any, Array], tuple[Array, Array]]
    arrays: Any

    def both(self, z: Array) -> tuple[Array, Array]:
        """As of `FitResiduals`."""
        return self.run(self.arrays, z)

    def __call__(self, z: Array) -> Array:
        """The residuals."""
        return self.both(z)[0]

    @property
    def num_unknowns(self) -> int:
        """Number of unknowns."""
        return len(self.arrays.space.names)

    def with_spread(self, spread: Array) -> "Program":
        """The same with another spread of the misfit."""
        return eqx.tree_at(lambda program: program.arrays.spread, self, spread)


AnyResiduals = FitResiduals | Program


def _jacobian(residuals: AnyResiduals, z: Array, reverse: bool) -> tuple[tuple[Array, Array], Array]:
    """Residuals and misfit, and the residuals' Jacobian (M + P, n), from one run of the model and its derivatives."""
    if reverse:
        value, pull, misfit = jax.vjp(residuals.both, z, has_aux=True)
        return (value, misfit), jax.vmap(lambda row: pull(row)[0])(jnp.eye(value.size, dtype=value.dtype))
    push = lambda column: jax.jvp(residuals.both, (z,), (column,), has_aux=True)  # noqa: E731
    value, jacobian, misfit = jax.vmap(push, out_axes=(None, -1, None))(jnp.eye(z.size, dtype=z.dtype))
    return (value, misfit), jacobian


@eqx.filter_custom_jvp
def _linearised(z, residuals, reverse):
    """Residuals whose derivative is a Jacobian that is formed once, beside them: one run of the model for a step."""
    del reverse
    return residuals(z)


@_linearised.def_jvp
def _(primals, tangents):
    z, residuals, reverse = primals
    (value, _), jacobian = _jacobian(residuals, z, reverse)
    return value, jacobian @ tangents[0]


class _LeastSquares(eqx.Module):
    """What optimistix's least-squares solvers see."""

    residuals: AnyResiduals
    scale: Array
    reverse: bool = eqx.field(static=True)

    def __call__(self, z, args):
        del args
        return self.scale * _linearised(z, self.residuals, self.reverse), None


class _Loss(eqx.Module):
    """What optimistix's minimisers see."""

    residuals: AnyResiduals
    scale: Array

    def __call__(self, z, args):
        del args
        return 0.5 * jnp.sum((self.scale * self.residuals(z)) ** 2), None


class Problem(eqx.Module):
    """A fit ready to run.

    Attributes:
        residuals: residuals of a vector of unknowns.
        program: the same, traced.
        solver: optimiser.
        reverse: whether derivatives are taken in reverse mode.
        method: method and kind of derivatives, in words.
    """

    residuals: FitResiduals
    program: Program
    solver: Any
    reverse: bool = eqx.field(static=True)
    method: str = eqx.field(static=True)

    @property
    def space(self) -> Unknowns:
        """The unknowns."""
        return self.residuals.space

    @property
    def data(self) -> Observations:
        """What is fitted."""
        return self.residuals.data

    @property
    def model(self) -> Model:
        """What is fitted to it."""
        assert self.residuals.model is not None
        return self.residuals.model

    @property
    def is_least_squares(self) -> bool:
        """Whether the method sees residuals, not their loss alone."""
        return isinstance(self.solver, optx.AbstractLeastSquaresSolver)

    def function(self, residuals: AnyResiduals, z: Array) -> tuple[Any, tuple[Array, Array]]:
        """What the solver steps on, scaled so that its first damping, 1, suits the problem; residuals and misfit."""
        if not self.is_least_squares:
            # A first step along the gradient then has the length of one.
            slope, values = _gradient(residuals, z)
            return _Loss(residuals, 1 / jnp.sqrt(_or_one(jnp.linalg.norm(slope)))), values
        values, jacobian = jacobian_of(residuals, z, self.reverse)
        scale = 1 / _or_one(_DAMPING * jnp.linalg.norm(jacobian))
        return _LeastSquares(residuals, scale, self.reverse), values

    def profile(
        self, residuals: Program, z0: Array, name: str, values: np.ndarray, max_steps: int
    ) -> np.ndarray:  # fmt: skip
        """(P,) the least losses with one parameter held at each of some values, from the optimum outwards."""
        if name not in self.space.names:
            raise ValueError(f"There is no parameter {name!r}; there are {', '.join(self.space.names)}.")
        if not self.is_least_squares:
            raise ValueError("Profiles need a least-squares method: ltl.fit(..., method=optx.LevenbergMarquardt(...)).")
        index = self.space.names.index(name)
        flat, rebuild = ravel_pytree(self.space.values(z0))
        scale, solver = self.function(residuals, z0)[0].scale, self.solver
        if getattr(solver, "reach", None) is not None:
            solver = eqx.tree_at(lambda s: s.reach, solver, jnp.delete(solver.reach, index))
        if len(z0) == 1:
            at = [residuals(self.space.free(rebuild(flat.at[index].set(value)))) for value in values]
            return np.array([0.5 * float(jnp.sum(r**2)) for r in at])
        losses = np.empty(len(values))
        rest = jnp.delete(z0, index)
        # Outwards from the optimum, each from its neighbour's.
        order = np.argsort(np.abs(values - float(flat[index])))
        known: dict[int, Array] = {}
        for k in order:
            held = self.space.free(rebuild(flat.at[index].set(values[k])))[index]
            if not np.isfinite(held):
                raise ValueError(f"{name} = {values[k]:g} is outside the range of the parameter.")
            near = min(known, key=lambda j: abs(values[j] - values[k]), default=None)
            z = rest if near is None else known[near]
            solution = _profiled(residuals, solver, scale, z, held, index, self.reverse, max_steps)
            known[int(k)] = solution.value
            losses[k] = 0.5 * float(jnp.sum(solution.aux**2))
        return losses


def _or_one(norm: Array) -> Array:
    """A norm to scale by; one of a problem without slope."""
    return jnp.where(norm == 0, 1.0, norm)


@eqx.filter_jit
def jacobian_of(residuals, z, reverse):
    """Residuals and misfit, and the residuals' Jacobian, compiled once for a problem."""
    return _jacobian(residuals, z, reverse)


@eqx.filter_jit
def values_of(residuals, z):
    """Residuals and misfit, compiled once for a problem."""
    return residuals.both(z)


@eqx.filter_jit
def _gradient(residuals, z):
    def loss(z):
        values = residuals.both(z)
        return 0.5 * jnp.sum(values[0] ** 2), values

    return jax.grad(loss, has_aux=True)(z)


@eqx.filter_jit
def _profiled(residuals, solver, scale, rest, held, index, reverse, max_steps):
    def scaled(rest, args):
        del args
        z = jnp.concatenate([rest[:index], held[None], rest[index:]])
        value = _linearised(z, residuals, reverse)
        return scale * value, value

    return optx.least_squares(scaled, solver, rest, has_aux=True, throw=False, max_steps=max_steps)


def prepare(
    model: Model, space: Unknowns, data: Observations, penalty: Residuals | None, method: Any, z: Array,
    rtol: float, atol: float,
) -> Problem:  # fmt: skip
    """The problem, its method and derivatives chosen, its shapes checked."""
    spread = jnp.ones(data.spread_shape, z.dtype)
    plain = FitResiduals(model, data, space, penalty, forward_adjoint(model), spread)
    solver, name = method_of(method, z.size, rtol, atol, space.reach)
    is_least_squares = isinstance(solver, optx.AbstractLeastSquaresSolver)
    key = _key(plain, z, is_least_squares)
    with _LOCK:
        traced = _TRACED.pop(key, None)
    if traced is None:
        traced = _traced(plain, z, is_least_squares)
    if key is not None:
        with _LOCK:
            _TRACED[key] = traced
            while len(_TRACED) > _KEPT:
                _TRACED.popitem(last=False)
    run, adjoint, reverse, num_residuals, how = traced
    num_values = num_residuals - data.values.size + data.num_values
    if num_values < z.size:
        raise ValueError(
            f"Expected at least as many values as unknowns, found {num_values} for {z.size}. Observe more, fit "
            "fewer parameters, or add what is known as penalty= (ltl.inverse.smoothness, say)."
        )
    residuals = dataclasses.replace(plain, adjoint=adjoint)
    program = Program(run, eqx.filter(_without_model(plain), is_on_device))
    return Problem(residuals, program, solver, reverse, f"{name}, {how}")


def is_on_device(leaf: Any) -> bool:
    """Whether a leaf is an argument of the program; NumPy arrays, such as times, belong to the program itself."""
    return isinstance(leaf, jax.Array)


def _without_model(residuals: FitResiduals) -> FitResiduals:
    """What differs from fit to fit of the same model: data, unknowns and spread."""
    return dataclasses.replace(residuals, model=None, penalty=None, adjoint=None)


_LOCK = threading.Lock()
_TRACED: collections.OrderedDict[Hashable, tuple[Any, Any, bool, int, str]] = collections.OrderedDict()


def _traced(plain: FitResiduals, z: Array, is_least_squares: bool) -> tuple[Any, Any, bool, int, str]:
    """The program of the residuals, its adjoint, whether derivatives are in reverse mode, the number of residuals, and
    how derivatives are taken, in words.

    The model's arrays are known while it is traced, since what is measured of a surface on the host is only known of
    such; then they become arguments, so that none is a constant of the program.
    """
    takes_adjoint = plain.adjoint is not None
    plain.data.check(eqx.filter_eval_shape(lambda z: plain.predicted(z), z))
    num_residuals = eqx.filter_eval_shape(lambda z: plain(z), z).size
    reverse, how = True, f"gradients in reverse mode{' with checkpoints' if takes_adjoint else ''}"
    if is_least_squares:
        reverse, how = False, f"its Jacobian in forward mode, {z.size} tangents beside each run"
        if not _goes_forward(plain, z):
            if num_residuals > MANY:
                raise ValueError(
                    "The model cannot be differentiated in forward mode. Let it take adjoint= and hand it to "
                    "ltl.solve, or choose a method that needs gradients alone: method=optx.BFGS(rtol, atol)."
                )
            reverse, how = True, f"its Jacobian in reverse mode, {num_residuals} rows"
    else:
        plain = dataclasses.replace(plain, adjoint=None)
    arrays, rest = eqx.partition(_without_model(plain), is_on_device)
    own = dict(model=plain.model, penalty=plain.penalty, adjoint=plain.adjoint)
    run = eqx.filter_closure_convert(
        lambda arrays, z: dataclasses.replace(eqx.combine(arrays, rest), **own).both(z), arrays, z
    )
    return run, plain.adjoint, reverse, num_residuals, how


def _key(plain: FitResiduals, z: Array, is_least_squares: bool) -> Hashable:
    """What the program of the residuals depends on beside the numbers of data, unknowns and spread; None where that
    cannot be told.

    Model and penalty count by their arrays, by the source of their functions, and by the values that these read from
    the functions and modules around them, so that a changed value is seen.
    """
    arrays, rest = eqx.partition(_without_model(plain), is_on_device)
    shapes = tuple((leaf.shape, str(leaf.dtype), bool(leaf.weak_type)) for leaf in jax.tree.leaves(arrays))
    leaves, structure = jax.tree.flatten(rest)
    try:
        own = plain.model, plain.penalty, leaves
        key = shapes, structure, fingerprint((*own, read_from_modules(own))), z.shape, str(z.dtype), is_least_squares
        hash(key)
    except TypeError:
        return None
    return key


def first_unknowns(
    start: Any, transforms: Any, data: Observations, size: float | None = None
) -> tuple[Unknowns, Array]:
    """The unknowns of a fit, those of the measurement among them, and their first vector.

    Args:
        start: first guess of the parameters.
        transforms: ranges of the parameters, as of `fit`.
        data: data.
        size: typical size of the data, where it is not that of ``data``.
    """
    calibration = data.calibration.unknowns(data.typical_size if size is None else size)
    space = unknowns(start, transforms, calibration)
    return space, space.free((start, {name: guess for name, (guess, *_) in calibration.items()}))


def forward_adjoint(model: Model) -> diffrax.AbstractAdjoint | None:
    """What makes time stepping differentiable in forward mode, for models that take an adjoint."""
    takes_adjoint = isinstance(model, Experiment) or "adjoint" in inspect.signature(model).parameters
    return diffrax.ForwardMode() if takes_adjoint else None


def steps_adaptively(model: Model) -> bool:
    """Whether a model may take adaptive steps, as far as can be seen from outside."""
    return model.dt is None if isinstance(model, Experiment) else forward_adjoint(model) is not None


def _goes_forward(residuals: FitResiduals, z: Array) -> bool:
    try:
        # All tangents, not one: JAX notices a function that has reverse mode alone when it maps over tangents.
        jax.eval_shape(lambda z: _jacobian(residuals, z, False), z)
    except TypeError:  # what JAX says of functions that define reverse mode alone
        return False
    return True
