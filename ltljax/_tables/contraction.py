"""The hot loop: a trilinear form over the slots of a table, and all of its derivatives.

    T(w, u, y) = sum_v y[v] sum_k w[k, v] (u[neighbour k of v] - u[v])

T is linear in each argument, so leaving one argument open gives a linear map into the space of that argument. With y
open, it is the weighted sum of differences of u; with u open, the transpose of that sum, applied to y; with w open, the
derivative with respect to the weights. The derivatives of each form are again T with one argument open: the product
rule replaces an argument by its tangent, and a transpose replaces the open argument by the cotangent and opens the
argument that was linear. One primitive therefore has derivatives of every order. All three forms gather (the transpose
by means of the table's reverse), so no derivative scatters.

Why the loop has this shape (CPU, two cores; docs/hot_loop.md has the figures):

- A slot-major sum that is unrolled over slots compiles to one kernel, with one pass over indices and weights and no
  (K, N) intermediate.
- It sums differences, and not the entries of a matrix with a diagonal. Rounding errors are then relative to
  u[k] - u[v], which float32 needs on fine meshes.
- Inputs and outputs are held in memory. Otherwise XLA fuses the computation of u into each of the K gathers and repeats
  it K times: two consecutive sums take four times as long, and a Runge-Kutta step with its derivative forty times.
- Indices are promised to be in bounds and non-negative: the check for negative indices alone takes a fifth of the time.
"""

import functools
import itertools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

from .table import AnyArray, Block, ReverseWeights, Table, reverse_weights, take

# The loop is unrolled up to this many slots, or up to the larger number if there are many rows. An unrolled loop is ten
# times as fast, which the wide coarse levels of multigrid need, but takes longer to compile.
_UNROLL, _UNROLL_MANY = 32, 64
_MANY = 256

Argument = Literal["weights", "field", "rows"]
_ARGUMENTS: tuple[Argument, ...] = ("weights", "field", "rows")


class _Operands(NamedTuple):
    """The arguments of T; the open one is None. The reverse of the weights is optional."""

    table: Table
    weights: Any = None
    field: Any = None
    rows: Any = None
    reverse: Any = None


def difference_sum(
    table: Table, weights: tuple[AnyArray, ...], u: Float[AnyArray, "V *S"], reverse: ReverseWeights | None = None
) -> Float[Array, "V *S"]:
    """``sum_k w[k, v] * (u[neighbour k of v] - u[v])`` for every vertex v: the hot loop.

    Args:
        table: the neighbours.
        weights: one array (K, N) per block of the table.
        u: (V,) or (V, S).
        reverse: the result of `reverse_weights` for these weights, if it is known; otherwise reverse-mode derivatives
            compute it. It counts as a function of the weights, so no derivative is taken with respect to it.
    """
    dtype = jnp.result_type(u, *weights)
    weights = tuple(jnp.asarray(block, dtype) for block in weights)
    reverse = jax.tree.map(lambda values: jnp.asarray(values, dtype), reverse)
    (out,) = _contract(_Operands(table, weights, field=jnp.asarray(u, dtype), reverse=reverse), "rows")
    return out


def differences(table: Table, u: Float[AnyArray, " V"]) -> tuple[Array, ...]:
    """``u[neighbour] - u[v]`` in every slot, one array (K, N) per block; zero in an empty slot."""
    u = jnp.asarray(u)
    if u.ndim != 1:
        raise ValueError(
            f"Expected one field of shape (V,), found {u.shape}. Take the differences of each field separately."
        )
    return tuple(_contract(_Operands(table, field=u, rows=jnp.ones_like(u)), "weights"))


# Levels of batching, outermost first: the size of each and the names of the operands with a leading axis for it.
_Levels = tuple[tuple[int, frozenset[str]], ...]


def _contract(operands: _Operands, open_: Argument, levels: _Levels = ()) -> list[Array]:
    leaves, structure = jax.tree.flatten(operands)
    return contraction_p.bind(*_varying(leaves), structure=structure, open_=open_, levels=levels)


def _varying(leaves: list[Any]) -> list[Any]:
    """The leaves, cast so that inside `jax.shard_map` all of them vary over the same axes.

    JAX's own operations cast their arguments, and so sum the cotangents of replicated arguments over the devices. A
    primitive must be given arguments that are cast already.
    """
    axes_of_leaves = [jax.typeof(leaf).mat.varying for leaf in leaves]
    all_axes = frozenset().union(*axes_of_leaves)
    return [
        jax.lax.pcast(leaf, tuple(all_axes - axes), to="varying") if all_axes - axes else leaf
        for leaf, axes in zip(leaves, axes_of_leaves, strict=True)
    ]


def _evaluate(*leaves, structure, open_: Argument, levels: _Levels, settle: Callable[..., Any]) -> list[Array]:
    """The contraction in plain JAX, from which the primitive's abstract evaluation and compilation follow."""
    function = functools.partial(_form, open_=open_, settle=settle)
    for size, level in reversed(levels):
        axes: Any = _Operands._make(0 if name in level else None for name in _Operands._fields)
        function = jax.vmap(function, in_axes=(axes,), axis_size=size)
    # Convert to JAX arrays, since NumPy arrays would be processed in pieces on the host.
    return function(structure.unflatten(map(jnp.asarray, leaves)))


def _form(operands: _Operands, open_: Argument, settle: Callable[..., Any]) -> list[Array]:
    table, weights, u, y, reverse = operands
    hold = functools.partial(settle, table)
    if open_ == "weights":
        return hold(table.each(functools.partial(_products, u=hold(u), y=hold(y))))
    if open_ == "rows":
        return hold([table.map(functools.partial(_row_sums, u=hold(u)), weights)])
    if table.reverse is None:
        return hold(_scattered(table, weights, hold(y)))
    reverse, y = hold(reverse_weights(table, weights)) if reverse is None else reverse, hold(y)
    transposed = table.reverse.users.map(functools.partial(_row_sums, u=y), reverse.slots)
    return hold([transposed + _over_species(reverse.imbalance, y) * y])


def _settled(table: Table, values: Any) -> Any:
    """The values, held in memory so that XLA fuses nothing across this point."""
    del table
    return jax.lax.optimization_barrier(values)


def _settled_on_cpu(table: Table, values: Any) -> Any:
    """The same by a loop that is never entered: the compiler cannot know that no index is negative."""
    start = (table.blocks[0].indices[0, 0], values)
    return jax.lax.while_loop(
        lambda state: state[0] < 0, lambda state: (state[0] + 1, jax.tree.map(jnp.negative, state[1])), start
    )[1]


def _scattered(table: Table, weights: Any, y: Any) -> list[Array]:
    """The transposed sum for a table without reverse, which scatters."""
    forward = lambda u: table.map(functools.partial(_row_sums, u=u), weights)  # noqa: E731
    return list(jax.linear_transpose(forward, jax.ShapeDtypeStruct(y.shape, y.dtype))(y))


def _row_sums(block: Block, weights: Array, u: Array) -> Array:
    centre = block.centre(u)
    if not _is_unrolled(block):
        return jnp.sum(_over_species(weights, u) * (block.neighbours(u) - centre[None]), axis=0)
    # The unrolled slots fuse into one pass over u, without a (K, N) intermediate.
    total = jnp.zeros_like(centre)
    for slot in range(weights.shape[0]):
        total = total + _over_species(weights[slot], u) * (take(u, block.indices[slot]) - centre)
    return total


def _is_unrolled(block: Block) -> bool:
    slots, rows = block.indices.shape
    return slots <= (_UNROLL_MANY if rows >= _MANY else _UNROLL)


def _products(block: Block, u: Array, y: Array) -> Array:
    own, centre = block.centre(y), block.centre(u)
    if not _is_unrolled(block):
        return jnp.sum(own[None] * (block.neighbours(u) - centre[None]), axis=tuple(range(2, u.ndim + 1)))
    species = tuple(range(1, u.ndim))
    return jnp.stack([jnp.sum(own * (take(u, neighbours) - centre), axis=species) for neighbours in block.indices])


def _over_species(weights: Array, u: Array) -> Array:
    return weights.reshape(*weights.shape, *(1,) * (u.ndim - 1))


contraction_p = Primitive("table_contraction")
contraction_p.multiple_results = True
# Outside of jit there is nothing to fuse with.
_evaluate_alone = functools.partial(_evaluate, settle=lambda table, values: values)
contraction_p.def_impl(jax.jit(_evaluate_alone, static_argnames=("structure", "open_", "levels")))
# On CPU these releases of JAX drop optimization barriers before fusion; the loop used instead costs a copy of u.
_DROPS_BARRIERS = jax.__version_info__ < (0, 11)
for platform, settle in ((None, _settled), ("cpu", _settled_on_cpu))[: 1 + _DROPS_BARRIERS]:
    lowering = mlir.lower_fun(functools.partial(_evaluate, settle=settle), multiple_results=True)
    mlir.register_lowering(contraction_p, lowering, platform=platform)


@contraction_p.def_abstract_eval
def _(*leaves, **params):
    shapes = jax.eval_shape(functools.partial(_evaluate_alone, **params), *leaves)
    return [jax.typeof(shape) for shape in shapes]


def _by_name(structure, values) -> dict[str, list[Any]]:
    """One value per leaf, grouped by operand."""
    values = iter(values)
    children = zip(_Operands._fields, structure.children(), strict=True)
    return {name: list(itertools.islice(values, child.num_leaves)) for name, child in children}


def _filled(operands: _Operands, name: Argument, values: list[Any], open_: Argument) -> _Operands:
    """The operands with one argument filled in and another one opened; the reverse of other weights is dropped."""
    value = tuple(values) if name == "weights" else values[0]
    operands = operands._replace(**{open_: None, name: value})
    return operands._replace(reverse=None) if "weights" in (name, open_) else operands


def _jvp(primals, tangents, *, structure, open_, levels):
    operands = structure.unflatten(primals)
    outs = _contract(operands, open_, levels)
    changes: list[Any] = [ad.Zero(jax.typeof(out)) for out in outs]
    for name, tangent in _by_name(structure, tangents).items():
        if name not in _ARGUMENTS or all(isinstance(part, ad.Zero) for part in tangent):
            continue
        filled = _filled(operands, name, [ad.instantiate_zeros(part) for part in tangent], open_)
        changes = list(map(ad.add_tangents, changes, _contract(filled, open_, levels)))
    return outs, changes


def _transpose(cotangents, *primals, structure, open_, levels):
    by_name = _by_name(structure, primals)
    linear: Any = next(name for name in _ARGUMENTS if any(map(ad.is_undefined_primal, by_name[name])))
    if all(isinstance(part, ad.Zero) for part in cotangents):
        parts = [ad.Zero(part.aval) if ad.is_undefined_primal(part) else None for part in by_name[linear]]
    else:
        cotangents = [ad.instantiate_zeros(part) for part in cotangents]
        operands = _filled(structure.unflatten(primals), open_, cotangents, linear)
        parts = _contract(operands, linear, tuple((size, level - {linear} | {open_}) for size, level in levels))
        # If the linear argument has no axis for a level, its cotangents are summed over the level.
        shared = tuple(axis for axis, (_, level) in enumerate(levels) if linear not in level)
        parts = [jnp.sum(part, axis=shared) for part in parts] if shared else parts
    cotangent_parts = iter(parts)
    return [next(cotangent_parts) if name == linear else None for name, leaves in by_name.items() for _ in leaves]


def _batch(leaves, axes, *, structure, open_, levels):
    size = next(leaf.shape[axis] for leaf, axis in zip(leaves, axes, strict=True) if axis is not None)
    batched = frozenset(
        name for name, own in _by_name(structure, axes).items() if any(axis is not None for axis in own)
    )
    names = [
        name
        for name, child in zip(_Operands._fields, structure.children(), strict=True)
        for _ in range(child.num_leaves)
    ]
    moved = [
        leaf if name not in batched else batching.bdim_at_front(leaf, axis, size)
        for name, leaf, axis in zip(names, leaves, axes, strict=True)
    ]
    levels = ((size, batched), *levels)
    outs = contraction_p.bind(*_varying(moved), structure=structure, open_=open_, levels=levels)
    return outs, [0] * len(outs)


ad.primitive_jvps[contraction_p] = _jvp
ad.primitive_transposes[contraction_p] = _transpose
batching.primitive_batchers[contraction_p] = _batch
