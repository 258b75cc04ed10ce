"""A fit ready to run: the residuals as a function of the unknowns, their derivatives, and the method."""

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
from .experiment import Experiment
from .methods import MANY, method_of
from .observations import Observations
from .unknowns import Unknowns, unknowns

# Initial damping, relative to the norm of the Jacobian. Marquardt (1963) begins with a hundredth of its square.
_DAMPING = 0.1

# Largest number of traced programs that are kept for another fit of the same model.
_MAX_TRACED = 8

Model = Experiment | Callable[..., Any]
Residuals = Callable[[Any], Any]


class FitResiduals(eqx.Module):
    """The residuals of a vector of unknowns: misfit to the data, then penalties.

    Attributes:
        model: the model.
        data: the data.
        space: the unknowns.
        penalty: function from parameters to residuals that are added to those of the data.
        adjoint: adjoint that makes time stepping differentiable in the required mode.
        spread: standard deviation of the misfit in units of the noise.
    """

    model: Model | None
    data: Observations
    space: Unknowns
    penalty: Residuals | None
    adjoint: diffrax.AbstractAdjoint | None
    spread: Array

    def predicted(self, z: Array) -> Any:
        """The output of the model."""
        params = self.space.params(z)
        assert self.model is not None, "the arrays of a Program have no model"
        if isinstance(self.model, Experiment):
            return self.model(params, self.data.times, self.adjoint)
        return self.model(params) if self.adjoint is None else self.model(params, adjoint=self.adjoint)

    def residuals_and_misfit(self, z: Array) -> tuple[Array, Array]:
        """Residuals (M + P,) and misfit (M,).

        The loss is half the sum of squared residuals. If the model fails, all residuals are infinite.
        """
        misfit = self.data.misfit(self.predicted(z), self.space.calibration(z), self.spread)
        residuals = self.data.loss.root(misfit)
        if self.penalty is not None:
            penalties = ravel_pytree(self.penalty(self.space.params(z)))[0]
            residuals = jnp.concatenate([residuals, penalties.astype(misfit.dtype)])
        return jnp.where(jnp.all(jnp.isfinite(residuals)), residuals, jnp.inf), misfit

    def __call__(self, z: Array) -> Array:
        """The residuals."""
        return self.residuals_and_misfit(z)[0]


class Program(eqx.Module):
    """The residuals as a traced program, which is compiled once for all fits of the same model.

    Attributes:
        run: function from the arrays and a vector of unknowns to residuals and misfit.
        arrays: the arrays of `FitResiduals`.
    """

    run: Callable[[Any, Array], tuple[Array, Array]]
    arrays: Any

    def residuals_and_misfit(self, z: Array) -> tuple[Array, Array]:
        """Residuals and misfit, as of `FitResiduals`."""
        return self.run(self.arrays, z)

    def __call__(self, z: Array) -> Array:
        """The residuals."""
        return self.residuals_and_misfit(z)[0]

    @property
    def num_unknowns(self) -> int:
        """Number of unknowns."""
        return len(self.arrays.space.names)

    def with_spread(self, spread: Array) -> "Program":
        """The same program with another spread of the misfit."""
        return eqx.tree_at(lambda program: program.arrays.spread, self, spread)


AnyResiduals = FitResiduals | Program


def _jacobian(residuals: AnyResiduals, z: Array, reverse: bool) -> tuple[tuple[Array, Array], Array]:
    """Residuals and misfit, and the Jacobian (M + P, n) of the residuals, from one run of the model."""
    if reverse:
        value, pull, misfit = jax.vjp(residuals.residuals_and_misfit, z, has_aux=True)
        return (value, misfit), jax.vmap(lambda row: pull(row)[0])(jnp.eye(value.size, dtype=value.dtype))
    push = lambda column: jax.jvp(residuals.residuals_and_misfit, (z,), (column,), has_aux=True)  # noqa: E731
    value, jacobian, misfit = jax.vmap(push, out_axes=(None, -1, None))(jnp.eye(z.size, dtype=z.dtype))
    return (value, misfit), jacobian


@eqx.filter_custom_jvp
def _linearised(z, residuals, reverse):
    """Residuals whose Jacobian is computed together with them, so that an iteration needs one run of the model."""
    del reverse
    return residuals(z)


@_linearised.def_jvp
def _(primals, tangents):
    z, residuals, reverse = primals
    (value, _), jacobian = _jacobian(residuals, z, reverse)
    return value, jacobian @ tangents[0]


class _LeastSquares(eqx.Module):
    """The scaled residuals, as the least-squares solvers of optimistix expect them."""

    residuals: AnyResiduals
    scale: Array
    reverse: bool = eqx.field(static=True)

    def __call__(self, z, args):
        del args
        return self.scale * _linearised(z, self.residuals, self.reverse), None


class _Loss(eqx.Module):
    """The scaled loss, as the minimisers of optimistix expect it."""

    residuals: AnyResiduals
    scale: Array

    def __call__(self, z, args):
        del args
        return 0.5 * jnp.sum((self.scale * self.residuals(z)) ** 2), None


class Problem(eqx.Module):
    """A fit ready to run.

    Attributes:
        residuals: residuals as a function of the unknowns.
        program: the same residuals as a traced program.
        solver: solver of optimistix.
        reverse: whether derivatives are taken in reverse mode.
        method: method and mode of differentiation, in words.
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
        """The fitted data."""
        return self.residuals.data

    @property
    def model(self) -> Model:
        """The model."""
        assert self.residuals.model is not None
        return self.residuals.model

    @property
    def is_least_squares(self) -> bool:
        """Whether the method uses the residuals, and not only the loss."""
        return isinstance(self.solver, optx.AbstractLeastSquaresSolver)

    def objective(self, residuals: AnyResiduals, z: Array) -> tuple[Any, tuple[Array, Array]]:
        """The scaled objective, and residuals and misfit at ``z``. The scale makes an initial damping of 1 suitable."""
        if not self.is_least_squares:
            # With this scale, the first step along the gradient has length 1.
            slope, values = _gradient(residuals, z)
            return _Loss(residuals, 1 / jnp.sqrt(_or_one(jnp.linalg.norm(slope)))), values
        values, jacobian = jacobian_of(residuals, z, self.reverse)
        scale = 1 / _or_one(_DAMPING * jnp.linalg.norm(jacobian))
        return _LeastSquares(residuals, scale, self.reverse), values

    def profile(self, residuals: Program, z0: Array, name: str, values: np.ndarray, max_iterations: int) -> np.ndarray:
        """The smallest loss (N,) for each given value of one parameter."""
        if name not in self.space.names:
            raise ValueError(f"There is no parameter {name!r}; there are {', '.join(self.space.names)}.")
        if not self.is_least_squares:
            raise ValueError("Profiles need a least-squares method: ltl.fit(..., method=optx.LevenbergMarquardt(...)).")
        index = self.space.names.index(name)
        flat, rebuild = ravel_pytree(self.space.values(z0))
        scale, solver = self.objective(residuals, z0)[0].scale, self.solver
        if getattr(solver, "reach", None) is not None:
            solver = eqx.tree_at(lambda s: s.reach, solver, jnp.delete(solver.reach, index))
        if len(z0) == 1:
            residuals_at_values = [residuals(self.space.free(rebuild(flat.at[index].set(value)))) for value in values]
            return np.array([0.5 * float(jnp.sum(r**2)) for r in residuals_at_values])
        losses = np.empty(len(values))
        other_unknowns = jnp.delete(z0, index)
        # From the optimum outwards, so that each search begins at the solution of the nearest value.
        order = np.argsort(np.abs(values - float(flat[index])))
        solutions: dict[int, Array] = {}
        for k in order:
            held = self.space.free(rebuild(flat.at[index].set(values[k])))[index]
            if not np.isfinite(held):
                raise ValueError(f"{name} = {values[k]:g} is outside the range of the parameter.")
            nearest = min(solutions, key=lambda j: abs(values[j] - values[k]), default=None)
            z = other_unknowns if nearest is None else solutions[nearest]
            solution = _profiled(residuals, solver, scale, z, held, index, self.reverse, max_iterations)
            solutions[int(k)] = solution.value
            losses[k] = 0.5 * float(jnp.sum(solution.aux**2))
        return losses


def _or_one(norm: Array) -> Array:
    """The norm, or 1 where it is zero."""
    return jnp.where(norm == 0, 1.0, norm)


@eqx.filter_jit
def jacobian_of(residuals, z, reverse):
    """Residuals and misfit, and the Jacobian of the residuals, compiled once for a problem."""
    return _jacobian(residuals, z, reverse)


@eqx.filter_jit
def values_of(residuals, z):
    """Residuals and misfit, compiled once for a problem."""
    return residuals.residuals_and_misfit(z)


@eqx.filter_jit
def _gradient(residuals, z):
    def loss(z):
        values = residuals.residuals_and_misfit(z)
        return 0.5 * jnp.sum(values[0] ** 2), values

    return jax.grad(loss, has_aux=True)(z)


@eqx.filter_jit
def _profiled(residuals, solver, scale, other_unknowns, held, index, reverse, max_iterations):
    def scaled(other_unknowns, args):
        del args
        z = jnp.concatenate([other_unknowns[:index], held[None], other_unknowns[index:]])
        value = _linearised(z, residuals, reverse)
        return scale * value, value

    return optx.least_squares(scaled, solver, other_unknowns, has_aux=True, throw=False, max_steps=max_iterations)


def prepare(
    model: Model, space: Unknowns, data: Observations, penalty: Residuals | None, method: Any, z: Array,
    rtol: float, atol: float,
) -> Problem:  # fmt: skip
    """The problem, with its method and mode of differentiation chosen and its shapes checked.

    Raises:
        ValueError: model and data do not match, there are fewer values than unknowns, or the method cannot be used.
    """
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
            while len(_TRACED) > _MAX_TRACED:
                _TRACED.popitem(last=False)
    run, adjoint, reverse, num_residuals, mode_description = traced
    num_values = num_residuals - data.values.size + data.num_values
    if num_values < z.size:
        raise ValueError(
            f"Expected at least as many values as unknowns, found {num_values} values for {z.size} unknowns. Observe "
            "more, fit fewer parameters, or add prior knowledge as penalty= (such as ltl.inverse.smoothness)."
        )
    residuals = dataclasses.replace(plain, adjoint=adjoint)
    program = Program(run, eqx.filter(_without_model(plain), is_on_device))
    return Problem(residuals, program, solver, reverse, f"{name}, {mode_description}")


def is_on_device(leaf: Any) -> bool:
    """Whether a leaf is an argument of the program. NumPy arrays, such as times, are constants of it."""
    return isinstance(leaf, jax.Array)


def _without_model(residuals: FitResiduals) -> FitResiduals:
    """The parts that differ between fits of the same model: data, unknowns and spread."""
    return dataclasses.replace(residuals, model=None, penalty=None, adjoint=None)


_LOCK = threading.Lock()
_TRACED: collections.OrderedDict[Hashable, tuple[Any, Any, bool, int, str]] = collections.OrderedDict()


def _traced(plain: FitResiduals, z: Array, is_least_squares: bool) -> tuple[Any, Any, bool, int, str]:
    """The traced residuals, their adjoint, whether derivatives are taken in reverse mode, the number of residuals, and
    the mode of differentiation in words.

    Host computations on a surface need concrete arrays, so the model's arrays are concrete during tracing. They become
    arguments afterwards, so that the program holds no large constants.
    """
    takes_adjoint = plain.adjoint is not None
    plain.data.check(eqx.filter_eval_shape(lambda z: plain.predicted(z), z))
    num_residuals = eqx.filter_eval_shape(lambda z: plain(z), z).size
    if not is_least_squares:
        plain = dataclasses.replace(plain, adjoint=None)
        reverse = True
        mode_description = f"gradients in reverse mode{' with checkpoints' if takes_adjoint else ''}"
    elif _has_forward_mode(plain, z):
        reverse, mode_description = False, f"Jacobian in forward mode with {z.size} tangents per run"
    elif num_residuals <= MANY:
        reverse, mode_description = True, f"Jacobian in reverse mode with {num_residuals} rows"
    else:
        raise ValueError(
            "The model cannot be differentiated in forward mode. Let it take adjoint= and pass it on to ltl.solve, or "
            "choose a method that needs only gradients: method=optx.BFGS(rtol, atol)."
        )
    arrays, constants = eqx.partition(_without_model(plain), is_on_device)
    model_parts = dict(model=plain.model, penalty=plain.penalty, adjoint=plain.adjoint)

    def residuals_and_misfit(arrays: Any, z: Array) -> tuple[Array, Array]:
        residuals = dataclasses.replace(eqx.combine(arrays, constants), **model_parts)
        return residuals.residuals_and_misfit(z)

    run = eqx.filter_closure_convert(residuals_and_misfit, arrays, z)
    return run, plain.adjoint, reverse, num_residuals, mode_description


def _key(plain: FitResiduals, z: Array, is_least_squares: bool) -> Hashable:
    """A key of everything that the traced residuals depend on except the values of data, unknowns and spread; None if
    there is no such key.

    Model and penalty enter by their arrays, by the source of their functions, and by the values that these functions
    read from enclosing functions and modules, so that a changed value gives another key.
    """
    arrays, constants = eqx.partition(_without_model(plain), is_on_device)
    shapes = tuple((leaf.shape, str(leaf.dtype), bool(leaf.weak_type)) for leaf in jax.tree.leaves(arrays))
    leaves, structure = jax.tree.flatten(constants)
    try:
        key_parts = plain.model, plain.penalty, leaves
        content = fingerprint((*key_parts, read_from_modules(key_parts)))
        key = shapes, structure, content, z.shape, str(z.dtype), is_least_squares
        hash(key)
    except TypeError:
        return None
    return key


def first_unknowns(
    start: Any, transforms: Any, data: Observations, size: float | None = None
) -> tuple[Unknowns, Array]:
    """The unknowns of a fit, including those of the measurement, and their vector at the start.

    Args:
        start: first guess of the parameters.
        transforms: ranges of the parameters, as of `fit`.
        data: data.
        size: typical size of the data; by default that of ``data``.
    """
    calibration = data.calibration.unknowns(data.typical_size if size is None else size)
    space = unknowns(start, transforms, calibration)
    return space, space.free((start, {name: guess for name, (guess, *_) in calibration.items()}))


def forward_adjoint(model: Model) -> diffrax.AbstractAdjoint | None:
    """The adjoint that makes time stepping differentiable in forward mode; None if the model takes no adjoint."""
    takes_adjoint = isinstance(model, Experiment) or "adjoint" in inspect.signature(model).parameters
    return diffrax.ForwardMode() if takes_adjoint else None


def steps_adaptively(model: Model) -> bool:
    """Whether a model may take adaptive time steps, as far as its type or signature tells."""
    return model.dt is None if isinstance(model, Experiment) else forward_adjoint(model) is not None


def _has_forward_mode(residuals: FitResiduals, z: Array) -> bool:
    """Whether the residuals can be differentiated in forward mode."""
    try:
        # For a function that has only a reverse mode, JAX raises when tangents are mapped, not for a single one. So
        # push all of them.
        jax.eval_shape(lambda z: _jacobian(residuals, z, False), z)
    except TypeError:
        return False
    return True
