"""A fit ready to run: residuals of a vector of unknowns, their derivatives, and the method that steps on them."""

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from .methods import MANY, method_of
from .observations import Experiment, Observations
from .unknowns import Unknowns

# The first damping, relative to the Jacobian's norm: after Marquardt (1963), who begins with a hundredth of its square.
_DAMPING = 0.1

Model = Experiment | Callable[..., Any]
Residuals = Callable[[Any], Any]


class FitResiduals(eqx.Module):
    """The residuals of a vector of unknowns: misfit to the data, then penalties."""

    model: Model
    data: Observations
    space: Unknowns
    penalty: Residuals | None
    adjoint: diffrax.AbstractAdjoint | None

    def predicted(self, z: Array) -> Any:
        """What the model gives."""
        params = self.space.params(z)
        if isinstance(self.model, Experiment):
            return self.model(params, self.data.times, self.adjoint)
        return self.model(params) if self.adjoint is None else self.model(params, adjoint=self.adjoint)

    def __call__(self, z: Array) -> Array:
        """(M,) misfit in units of the noise, then penalties; infinite where the model fails."""
        misfit = self.data.misfit(self.predicted(z))
        if self.penalty is not None:
            misfit = jnp.concatenate([misfit, ravel_pytree(self.penalty(self.space.params(z)))[0].astype(misfit.dtype)])
        return jnp.where(jnp.all(jnp.isfinite(misfit)), misfit, jnp.inf)


def _jacobian(residuals: Callable[[Array], Array], z: Array, reverse: bool) -> tuple[Array, Array]:
    """Residuals and their Jacobian (M, n), from one run of the model and its derivatives."""
    if reverse:
        value, pull = jax.vjp(residuals, z)
        return value, jax.vmap(lambda row: pull(row)[0])(jnp.eye(value.size, dtype=value.dtype))
    push = lambda column: jax.jvp(residuals, (z,), (column,))  # noqa: E731
    return jax.vmap(push, out_axes=(None, -1))(jnp.eye(z.size, dtype=z.dtype))


@eqx.filter_custom_jvp
def _linearised(z, residuals, reverse):
    """Residuals whose derivative is a Jacobian that is formed once, beside them: one run of the model for a step."""
    del reverse
    return residuals(z)


@_linearised.def_jvp
def _(primals, tangents):
    z, residuals, reverse = primals
    value, jacobian = _jacobian(residuals, z, reverse)
    return value, jacobian @ tangents[0]


class _LeastSquares(eqx.Module):
    """What optimistix's least-squares solvers see."""

    residuals: Callable[[Array], Array]
    scale: Array
    reverse: bool = eqx.field(static=True)

    def __call__(self, z, args):
        del args
        return self.scale * _linearised(z, self.residuals, self.reverse), None


class _Loss(eqx.Module):
    """What optimistix's minimisers see."""

    residuals: Callable[[Array], Array]
    scale: Array

    def __call__(self, z, args):
        del args
        return 0.5 * jnp.sum((self.scale * self.residuals(z)) ** 2), None


class Problem(eqx.Module):
    """A fit ready to run."""

    residuals: FitResiduals
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
    def is_least_squares(self) -> bool:
        """Whether the method sees residuals, not their loss alone."""
        return isinstance(self.solver, optx.AbstractLeastSquaresSolver)

    def converted(self, z: Array) -> Any:
        """The residuals with all arrays they read as leaves, so that none becomes a constant of the program."""
        return eqx.filter_closure_convert(lambda z: self.residuals(z), z)

    def function(self, converted: Any, z: Array) -> Any:
        """What the solver steps on, scaled so that its first damping, 1, suits the problem."""
        if not self.is_least_squares:
            # A first step along the gradient then has the length of one.
            slope = _gradient(converted, z)
            return _Loss(converted, 1 / jnp.sqrt(_or_one(jnp.linalg.norm(slope))))
        _, jacobian = jacobian_of(converted, z, self.reverse)
        return _LeastSquares(converted, 1 / _or_one(_DAMPING * jnp.linalg.norm(jacobian)), self.reverse)

    def profile(self, params: Any, name: str, values: np.ndarray, max_steps: int) -> np.ndarray:
        """(P,) the least losses with one parameter held at each of some values, from the optimum outwards."""
        if name not in self.space.names:
            raise ValueError(f"There is no parameter {name!r}; there are {', '.join(self.space.names)}.")
        if not self.is_least_squares:
            raise ValueError("Profiles need a least-squares method: ltl.fit(..., method=optx.LevenbergMarquardt(...)).")
        index = self.space.names.index(name)
        flat, rebuild = ravel_pytree(jax.tree.map(jnp.asarray, params))
        z0 = self.space.free(params)
        converted = self.converted(z0)
        scale = self.function(converted, z0).scale
        if len(z0) == 1:
            at = [converted(self.space.free(rebuild(flat.at[index].set(value)))) for value in values]
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
            solution = _profiled(converted, self.solver, scale, z, held, index, self.reverse, max_steps)
            known[int(k)] = solution.value
            losses[k] = 0.5 * float(jnp.sum(solution.aux**2))
        return losses


def _or_one(norm: Array) -> Array:
    """A norm to scale by; one of a problem without slope."""
    return jnp.where(norm == 0, 1.0, norm)


@eqx.filter_jit
def jacobian_of(converted, z, reverse):
    """Residuals and their Jacobian (M, n), compiled once for a problem."""
    return _jacobian(converted, z, reverse)


@eqx.filter_jit
def _gradient(converted, z):
    return jax.grad(lambda z: 0.5 * jnp.sum(converted(z) ** 2))(z)


@eqx.filter_jit
def _profiled(converted, solver, scale, rest, held, index, reverse, max_steps):
    def residuals(rest, args):
        del args
        z = jnp.concatenate([rest[:index], held[None], rest[index:]])
        value = _linearised(z, converted, reverse)
        return scale * value, value

    return optx.least_squares(residuals, solver, rest, has_aux=True, throw=False, max_steps=max_steps)


def prepare(
    model: Model, space: Unknowns, data: Observations, penalty: Residuals | None, method: Any, z: Array,
    rtol: float, atol: float,
) -> Problem:  # fmt: skip
    """The problem, its method and derivatives chosen, its shapes checked."""
    plain = FitResiduals(model, data, space, penalty, forward_adjoint(model))
    takes_adjoint = plain.adjoint is not None
    prediction = eqx.filter_eval_shape(lambda z: plain.predicted(z), z)
    data.check(prediction)
    num_residuals = eqx.filter_eval_shape(lambda z: plain(z), z).size
    if num_residuals < z.size:
        raise ValueError(
            f"Expected at least as many values as unknowns, found {num_residuals} for {z.size}. Observe more, fit "
            "fewer parameters, or add what is known as penalty= (ltl.smoothness, say)."
        )
    solver, name = method_of(method, z.size, rtol, atol)
    if isinstance(solver, optx.AbstractLeastSquaresSolver):
        reverse = False
        how = f"its Jacobian in forward mode, {z.size} tangents beside each run"
        if not _goes_forward(plain, z):
            if num_residuals > MANY:
                raise ValueError(
                    "The model cannot be differentiated in forward mode. Let it take adjoint= and hand it to "
                    "ltl.solve, or choose a method that needs gradients alone: method=optx.BFGS(rtol, atol)."
                )
            reverse, how = True, f"its Jacobian in reverse mode, {num_residuals} rows"
        return Problem(plain, solver, reverse, f"{name}, {how}")
    return Problem(
        dataclasses.replace(plain, adjoint=None), solver, True,
        f"{name}, gradients in reverse mode{' with checkpoints' if takes_adjoint else ''}",
    )  # fmt: skip


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
