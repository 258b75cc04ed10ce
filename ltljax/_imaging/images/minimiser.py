"""Where is the total variation, weighed against data, least? By the primal-dual Newton method.

What enters: a surface, data with their weights, which vertices are free, and how much the total variation weighs. What
leaves: the minimiser, with derivatives by the implicit function theorem. The field is piecewise linear over the faces,
so its gradient is one vector g on each of them, and the functional

    1/2 sum_v m_v |u_v - f_v|^2 + strength sum_F A_F sqrt(|g_F|^2 + rounding^2)

is convex. The gradient of a colour image is a matrix g with the norm sqrt(sum_c |g_c|^2): one edge for all colours.

Newton's method for the optimality condition alone converges only from nearby; with the dual variable
``p = g / sqrt(|g|^2 + rounding^2)`` as an unknown of its own it takes 8 to 23 steps on Spot, of 829 and of 11,533
vertices alike, for roundings from 0.1 to 1e-4 and tolerances from 1e-4 to 1e-10.

Source: Chan, Golub and Mulet (1999), A nonlinear primal-dual method for total variation-based image restoration,
doi:10.1137/S1064827596299767; with p projected onto the unit ball, Hintermueller and Stadler (2006),
doi:10.1137/040613263.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..._surface import Surface

# Linear systems are solved to this share of their right side within Newton's method, and to this one for derivatives.
_FORCING = 1e-2
_EXACT = {jnp.dtype("float64"): 1e-11, jnp.dtype("float32"): 1e-5}
_MAX_ITERATIONS = 2000
_MAX_HALVINGS = 12


class Faces(eqx.Module):
    """The gradient of piecewise linear fields: constant on each face, in a frame of its own.

    Attributes:
        corners: (F, 3) the vertices.
        hats: (2, 2, F) the gradients of the hat functions of the second and third corner; that of the first is minus
            their sum. Zero on a face without area.
        areas: (F,).
    """

    corners: Int[Array, "F 3"]
    hats: Float[Array, "2 2 F"]
    areas: Float[Array, " F"]

    @classmethod
    def of(cls, surface: Surface) -> "Faces":
        """Those of a surface."""
        a, b, c = jnp.moveaxis(surface.vertices[surface.faces], 1, 0)
        ab, ac = b - a, c - a
        length_squared = jnp.sum(ab**2, axis=1)
        tiny = jnp.finfo(ab.dtype).tiny
        length = jnp.sqrt(jnp.where(length_squared > tiny, length_squared, 1))
        # In the frame whose first axis is the first edge: b = (length, 0), c = (x, y).
        x = jnp.sum(ab * ac, axis=1) / length
        height_squared = jnp.sum((ac - (x / length)[:, None] * ab) ** 2, axis=1)
        is_flat = height_squared <= 1e3 * tiny
        y = jnp.sqrt(jnp.where(is_flat, 1, height_squared))
        hats = jnp.stack([jnp.stack([1 / length, -x / (length * y)]), jnp.stack([jnp.zeros_like(y), 1 / y])])
        return cls(surface.faces, jnp.where(is_flat, 0, hats), jnp.where(is_flat, 0, length * y / 2))

    def gradient(self, u: Float[Array, "V C"]) -> Float[Array, "2 F C"]:
        """The gradient on every face."""
        a, b, c = (u[self.corners[:, corner]] for corner in range(3))
        return self.hats[0][..., None] * (b - a)[None] + self.hats[1][..., None] * (c - a)[None]

    def transposed(self, q: Float[Array, "2 F C"], size: int) -> Float[Array, "V C"]:
        """The transpose of `gradient`."""
        second, third = (jnp.sum(hat[..., None] * q, axis=0) for hat in self.hats)
        return self._gathered(jnp.stack([-second - third, second, third], axis=1), size)

    def diagonal(self, weights: Float[Array, " F"], size: int) -> Float[Array, "V 1"]:
        """The diagonal of ``transposed(weights gradient(u))``."""
        second, third = self.hats
        squares = [jnp.sum(hat**2, axis=0) * weights for hat in (-second - third, second, third)]
        return self._gathered(jnp.stack(squares, axis=1)[..., None], size)

    def _gathered(self, values: Float[Array, "F 3 C"], size: int) -> Float[Array, "V C"]:
        return jax.ops.segment_sum(values.reshape(-1, values.shape[-1]), self.corners.reshape(-1), size)


class Functional(eqx.Module):
    """What is made least.

    Attributes:
        faces: where gradients live.
        masses: (V,) the weights of the data.
        is_free: (V,) 1 where u may change, 0 where it is held.
        f: (V, C) the data.
        strength: of the total variation.
        rounding: slopes well below this count as flat.
    """

    faces: Faces
    masses: Float[Array, " V"]
    is_free: Float[Array, " V"]
    f: Float[Array, "V C"]
    strength: Float[Array, ""]
    rounding: Float[Array, ""]

    def lengths(self, g: Float[Array, "2 F C"]) -> Float[Array, " F"]:
        """sqrt(|g|^2 + rounding^2) on every face."""
        return jnp.sqrt(jnp.sum(g**2, axis=(0, 2)) + self.rounding**2)

    def rise(self, u: Array, change: Array) -> Array:
        """What a change of u adds to the functional, without the cancellation of subtracting two values."""
        g, step = self.faces.gradient(u), self.faces.gradient(change)
        before, after = self.lengths(g), self.lengths(g + step)
        lengthened = jnp.sum(step * (2 * g + step), axis=(0, 2)) / (before + after)
        data = jnp.sum(self.masses[:, None] * change * (u - self.f + change / 2))
        return data + self.strength * jnp.sum(self.faces.areas * lengthened)

    def slope(self, u: Float[Array, "V C"]) -> Float[Array, "V C"]:
        """The derivative of the functional: zero at the minimiser. Where u is held, its distance from the data."""
        free = self.is_free[:, None]
        # What is held enters as the data, so that the derivative of this in u is symmetric.
        g = self.faces.gradient(free * u + (1 - free) * self.f)
        p = g / self.lengths(g)[None, :, None]
        pull = self.faces.transposed((self.strength * self.faces.areas)[None, :, None] * p, len(u))
        return free * (self.masses[:, None] * (u - self.f) + pull) + (1 - free) * (u - self.f)

    def curvature(self, g: Array, p: Array) -> tuple[Callable[[Array], Array], Array]:
        """The second derivative, with the dual variable as an unknown of its own, and its diagonal (about)."""
        lengths, size = self.lengths(g), len(self.masses)
        along = g / lengths[None, :, None]
        weights = self.strength * self.faces.areas / lengths
        free, masses = self.is_free[:, None], self.masses[:, None]

        def apply(d: Array) -> Array:
            step = self.faces.gradient(free * d)
            over_p, over_g = (jnp.sum(q * step, axis=(0, 2))[None, :, None] for q in (p, along))
            turned = weights[None, :, None] * (step - (p * over_g + along * over_p) / 2)
            return free * (masses * d + self.faces.transposed(turned, size)) + (1 - free) * d

        return apply, free * (masses + self.faces.diagonal(weights, size)) + (1 - free)


def minimise(
    functional: Functional, start: Float[Array, "V C"], tolerance: Any, max_steps: int
) -> tuple[Float[Array, "V C"], Bool[Array, ""], Int[Array, ""]]:
    """The minimiser, whether it was found, and the number of steps; differentiable in the functional.

    Ends when a full step changes the root mean square of u over the vertices by at most ``tolerance``. Derivatives are
    NaN where their linear system was not solved.
    """
    fixed, start = jax.lax.stop_gradient((functional, start))
    u, found, steps = _newton(fixed, start, jnp.asarray(tolerance, start.dtype), max_steps)
    g = fixed.faces.gradient(u)
    _, diagonal = fixed.curvature(g, g)
    share = _EXACT[jnp.dtype(u.dtype)]

    def exactly(apply, b):
        x, missed = conjugate_gradients(apply, b, lambda r: r / diagonal, share, _MAX_ITERATIONS)
        return jnp.where(missed <= 1, x, jnp.nan)

    def tangent_solve(apply, b):
        return jax.lax.custom_linear_solve(apply, b, exactly, symmetric=True)

    # Newton's method has found the root; what is left for this is its derivative.
    root = jax.lax.custom_root(lambda u: functional.slope(u), u, lambda _, u: u, tangent_solve)
    return root, found, steps


def conjugate_gradients(
    apply: Callable[[Array], Array],
    b: Array,
    inverse: Callable[[Array], Array],
    share: Any,
    max_steps: int = _MAX_ITERATIONS,
) -> tuple[Array, Array]:
    """The x with ``apply(x) = b`` for a symmetric positive operator, up to a share of b in the norm of the inverse; and
    the square of what is left over that share, at most one where x was found.

    Args:
        apply: the operator.
        b: the right side.
        inverse: about the inverse of the operator, symmetric and positive.
        share: of the residual that may be left.
        max_steps: after which the iteration ends, wherever it is.
    """

    def goes_on(carry):
        _, _, _, rho, steps = carry
        return (rho > goal) & (steps < max_steps)

    def step(carry):
        x, r, p, rho, steps = carry
        q = apply(p)
        along = rho / jnp.maximum(jnp.sum(p * q), tiny)
        x, r = x + along * p, r - along * q
        z = inverse(r)
        rho_next = jnp.sum(r * z)
        return x, r, z + rho_next / rho * p, rho_next, steps + 1

    tiny = jnp.finfo(b.dtype).tiny
    z = inverse(b)
    rho = jnp.sum(b * z)
    goal = jnp.maximum(jnp.asarray(share, b.dtype) ** 2 * rho, tiny)
    x, _, _, rho, _ = jax.lax.while_loop(goes_on, step, (jnp.zeros_like(b), b, z, rho, jnp.zeros((), jnp.int32)))
    return x, rho / goal


def _newton(functional: Functional, start: Array, tolerance: Array, max_steps: int) -> tuple[Array, Array, Array]:
    faces = functional.faces

    def goes_on(carry):
        _, _, change, steps = carry
        # Not "is larger": what is no number ends the loop.
        return (change > tolerance) & (steps < max_steps)

    def step(carry):
        u, p, _, steps = carry
        g = faces.gradient(u)
        apply, diagonal = functional.curvature(g, p)
        du, _ = conjugate_gradients(apply, -functional.slope(u), lambda r: r / diagonal, _FORCING)
        lengths = functional.lengths(g)[None, :, None]
        dg = faces.gradient(du)
        p = (g + dg - p * jnp.sum(g * dg, axis=(0, 2))[None, :, None] / lengths) / lengths
        p = p / jnp.maximum(jnp.sqrt(jnp.sum(p**2, axis=(0, 2))), 1)[None, :, None]
        along = _halved(lambda along: functional.rise(u, along * du), u.dtype)
        # A step that was shortened says nothing of the distance that is left.
        size = jnp.sqrt(jnp.mean(du**2))
        return u + along * du, p, jnp.where(along < 1, jnp.maximum(size, 2 * tolerance), size), steps + 1

    g = faces.gradient(start)
    begin = (
        start,
        g / functional.lengths(g)[None, :, None],
        jnp.full((), jnp.inf, start.dtype),
        jnp.zeros((), jnp.int32),
    )
    u, _, change, steps = jax.lax.while_loop(goes_on, step, begin)
    return u, change <= tolerance, steps


def _halved(rise: Callable[[Array], Array], dtype: Any) -> Array:
    """The longest of 1, 1/2, 1/4, ... that does not let the functional rise."""
    start = jnp.ones((), dtype)
    least = 0.5**_MAX_HALVINGS
    return jax.lax.while_loop(lambda along: (rise(along) > 0) & (along > least), lambda along: along / 2, start)
