"""`Stencil`: a linear operator on fields, as weights on the differences to the neighbours of a table.

What enters: a table and its weights. What leaves: the operator applied to a field, its transpose, its matrix, its
diagonal and a bound of its spectrum. `ComposedStencil` is a sum of products of stencils, with the methods that solvers
and equations need.
"""

from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float

from .contraction import difference_sum, differences
from .table import AnyArray, ReverseWeights, Table, difference_matrix, slot_sum

Mean = Literal["arithmetic", "harmonic"]


class Stencil(eqx.Module):
    """The operator ``(S u)[v] = sum_k weights[k, v] (u[neighbour k of v] - u[v]) + centre[v] u[v]``.

    Attributes:
        table: the neighbours.
        weights: one array (K, N) per block of the table.
        reverse: the weights in the order of the table's reverse, which reverse-mode derivatives read; None to compute
            it from the weights when it is needed.
        centre: (V,) the weight of the vertex's own value; None for an operator that maps constants to zero.
    """

    # The means of a conductivity that `with_conductivity` accepts; the last one suits conductivities that jump.
    means: ClassVar[tuple[Mean, ...]] = ("arithmetic", "harmonic")

    table: Table
    weights: tuple[AnyArray, ...]
    reverse: ReverseWeights | None = None
    centre: Float[AnyArray, " V"] | None = None

    def __call__(self, u: Float[AnyArray, "V *S"]) -> Float[Array, "V *S"]:
        """The operator applied to u, (V,) or (V, S)."""
        change = difference_sum(self.table, self.weights, u, self.reverse)
        return change if self.centre is None else change + _times_rows(self.centre, u)

    def transpose(self, y: Float[Array, "V *S"]) -> Float[Array, "V *S"]:
        """The transposed operator applied to y."""
        (transposed,) = jax.linear_transpose(self, y)(y)
        return transposed

    def matrix(self) -> scipy.sparse.csr_array:
        """The operator as a SciPy sparse matrix (V, V) (host)."""
        matrix = difference_matrix(self.table, self.weights)
        if self.centre is None:
            return matrix
        return scipy.sparse.csr_array(matrix + scipy.sparse.diags_array(np.asarray(self.centre)))

    def row_sums(self) -> Float[AnyArray, " V"]:
        """The sum of the weights of each row, without the centre."""
        return slot_sum(self.table, self.weights)

    def diagonal(self) -> Float[AnyArray, " V"]:
        """The diagonal of the matrix."""
        return -self.row_sums() if self.centre is None else self.centre - self.row_sums()

    def spectral_bound(self) -> Float[Array, ""]:
        """An upper bound of the magnitude of the eigenvalues: the largest absolute row sum (Gershgorin).

        If the weights are not negative and there is no centre, every eigenvalue lies in the disc between minus the
        bound and zero.
        """
        sizes = slot_sum(self.table, tuple(jnp.abs(block) for block in self.weights))
        return 2 * jnp.max(sizes) + (0 if self.centre is None else jnp.max(jnp.abs(self.centre)))

    def rough_spectral_width(self) -> Float[Array, ""]:
        """A spectral width that needs no measurement: half the mean row sum, usually several times too large."""
        return jnp.mean(self.row_sums()) / 2

    def with_rows_scaled(self, factor: Float[AnyArray, " V"]) -> "Stencil":
        """The operator ``factor * (S u)``."""
        scaled = self.table.each(lambda block, w: w * block.centre(factor)[None], self.weights)
        return Stencil(self.table, tuple(scaled), centre=None if self.centre is None else self.centre * factor)

    def with_conductivity(self, g: Float[AnyArray, " V"], mean: Mean) -> "Stencil":
        """The operator with each weight multiplied by a mean of g at the vertex and at the neighbour.

        For a Laplacian this is ``div(g grad u)``. The harmonic mean is ``2 a b / (a + b)``, and zero where a or b is
        not positive.

        Raises:
            ValueError: the mean is unknown, or the stencil has a centre, which a conductivity between vertices cannot
                scale.
        """
        if mean not in self.means:
            raise ValueError(f"Expected a mean of {' or '.join(map(repr, self.means))}, found {mean!r}.")
        if self.centre is not None:
            raise ValueError("Expected a stencil of differences only, found one with a weight of the vertex itself.")
        rises = differences(self.table, g)
        if mean == "harmonic":
            means = self.table.each(lambda block, rise: _harmonic(block.centre(g)[None], rise), rises)
        else:
            means = self.table.each(lambda block, rise: block.centre(g)[None] + rise / 2, rises)
        return Stencil(self.table, tuple(w * m for w, m in zip(self.weights, means, strict=True)))


class ComposedStencil(eqx.Module):
    """The operator ``u -> sum_i outer[i](inner[i](u))``, such as the divergence of a gradient.

    Attributes:
        outer: the stencils that are applied last.
        inner: the stencils that are applied first, as many.
    """

    means: ClassVar[tuple[Mean, ...]] = ("arithmetic",)

    outer: tuple[Stencil, ...]
    inner: tuple[Stencil, ...]

    def __call__(self, u: Float[AnyArray, "V *S"]) -> Float[Array, "V *S"]:
        """The operator applied to u, (V,) or (V, S)."""
        parts = [outer(inner(u)) for outer, inner in zip(self.outer, self.inner, strict=True)]
        return sum(parts[1:], start=parts[0])

    def transpose(self, y: Float[Array, "V *S"]) -> Float[Array, "V *S"]:
        """The transposed operator applied to y."""
        (transposed,) = jax.linear_transpose(self, y)(y)
        return transposed

    def matrix(self) -> scipy.sparse.csr_array:
        """The operator as a SciPy sparse matrix (V, V) (host)."""
        parts = [outer.matrix() @ inner.matrix() for outer, inner in zip(self.outer, self.inner, strict=True)]
        return scipy.sparse.csr_array(sum(parts[1:], start=parts[0]))

    def diagonal(self) -> Float[Array, " V"]:
        """A stand-in for the diagonal, whose entries no table holds: minus half the spectral bound, (V,)."""
        return jnp.full(self.inner[0].table.num_vertices, -self.spectral_bound() / 2)

    def spectral_bound(self) -> Float[Array, ""]:
        """An upper bound of the magnitude of the eigenvalues: the product of bounds of both factors."""

        def largest(stencils: tuple[Stencil, ...]) -> Float[Array, ""]:
            sizes = sum(slot_sum(s.table, tuple(jnp.abs(block) for block in s.weights)) for s in stencils)
            centres = [jnp.max(jnp.abs(s.centre)) for s in stencils if s.centre is not None]
            return 2 * jnp.max(sizes) + (jnp.max(jnp.stack(centres)) if centres else 0)

        return largest(self.outer) * largest(self.inner)

    def rough_spectral_width(self) -> Float[Array, ""]:
        """A spectral width that needs no measurement: half the spectral bound."""
        return self.spectral_bound() / 2

    def with_conductivity(self, g: Float[AnyArray, " V"], mean: Mean) -> "ComposedStencil":
        """The operator with the result of the inner stencils multiplied by g.

        Raises:
            ValueError: the harmonic mean was asked for, which is a mean of two neighbours.
        """
        if mean == "harmonic":
            raise ValueError(
                "The harmonic mean is a mean of two neighbours, and the Laplacian of Paper() has no weights between "
                'neighbours. Use mean="arithmetic" or another scheme.'
            )
        return ComposedStencil(self.outer, tuple(stencil.with_rows_scaled(g) for stencil in self.inner))


def _times_rows(factor: Float[AnyArray, " V"], u: Float[AnyArray, "V *S"]) -> Float[Array, "V *S"]:
    return factor.reshape(-1, *(1,) * (u.ndim - 1)) * u


def _harmonic(first: AnyArray, rise: AnyArray) -> Array:
    """The harmonic mean of two numbers, the second larger by the rise; zero where either is not positive."""
    second = first + rise
    are_positive = (first > 0) & (second > 0)
    total = jnp.where(are_positive, first + second, 1)
    return jnp.where(are_positive, 2 * (first / total) * second, 0)
