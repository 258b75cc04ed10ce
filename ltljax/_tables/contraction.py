"""The hot loop: a trilinear form over the slots of a table, what it is with one argument left open, and derivatives.

    T(w, u, y) = sum_v y[v] sum_k w[k, v] (u[neighbour k of v] - u[v])

With y left open it is the weighted sum of differences, applied to the field u; with u left open the transpose of that,
applied to y; with w left open the derivative with respect to the weights. Derivatives of each are again T with one
argument left open: the product rule fills a tangent in, and a transpose puts the cotangent where the output was and
leaves open what was linear. So one primitive holds every derivative of every order, and because each of its three
forms gathers (the transpose over the table's reverse, where there is one) no derivative ever adds by scattering.

Why the loop has this shape (CPU, two cores; docs/hot_loop.md has the figures):

- Slot-major and unrolled over slots, a sum is one kernel: one pass over indices and weights, no (K, N) intermediate.
- Differences, not a matrix with a diagonal: rounding is then relative to u[k] - u[v], which float32 needs on fine
  meshes.
- What goes in and what comes out is settled in memory. Left to itself XLA fuses whatever computes u into every one of
  the K gathers and computes it K times; two sums in a row take four times as long as they should, a Runge-Kutta step
  with its derivative forty times.
- Indices are promised to be in bounds and not negative: the check for negative ones alone takes a fifth of the time.
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

# Beyond so many slots, of few rows or of any, a loop unrolled over slots costs more compile time than it is worth. One
# that is not takes ten times as long (the coarse levels of multigrid are wide, and made a cycle twice as long).
_UNROLL, _UNROLL_MANY = 32, 64
_MANY = 256

Argument = Literal["weights", "field", "rows"]
_ARGUMENTS: tuple[Argument, ...] = ("weights", "field", "rows")


class _Operands(NamedTuple):
    """The arguments of T; the one left open is None. The reverse of the weights may be there or not."""

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
        reverse: what `reverse_weights` makes of these weights, where it is at hand; derivatives in reverse mode compute
            it where it is not. Its own derivative is not taken: it counts as a function of the weights.
    """
    dtype = jnp.result_type(u, *weights)
    weights = tuple(jnp.asarray(block, dtype) for block in weights)
    reverse = jax.tree.map(lambda values: jnp.asarray(values, dtype), reverse)
    (out,) = _contract(_Operands(table, weights, field=jnp.asarray(u, dtype), reverse=reverse), "rows")
    return out


def differences(table: Table, u: Float[AnyArray, " V"]) -> tuple[Array, ...]:
    """``u[neighbour] - u[v]`` in every slot, one array per block; zero in an empty slot."""
    u = jnp.asarray(u)
    if u.ndim != 1:
        raise ValueError(
            f"Expected one field of shape (V,), found {u.shape}: take the differences of each field apart."
        )
    return tuple(_contract(_Operands(table, field=u, rows=jnp.ones_like(u)), "weights"))


# Levels of batching, outermost first; each has its size and the names of the operands with an axis for it, in front.
_Levels = tuple[tuple[int, frozenset[str]], ...]


def _contract(operands: _Operands, open_: Argument, levels: _Levels = ()) -> list[Array]:
    leaves, structure = jax.tree.flatten(operands)
    return contraction_p.bind(*_varying(leaves), structure=structure, open_=open_, levels=levels)


def _varying(leaves: list[Any]) -> list[Any]:
    """The leaves, inside `jax.shard_map` all varying over the axes that one of them varies over.

    Operations of JAX see to that themselves, and so sum the cotangents of what was the same on every device; a
    primitive must be handed it.
    """
    axes = [jax.typeof(leaf).mat.varying for leaf in leaves]
    wanted = frozenset().union(*axes)
    return [
        jax.lax.pcast(leaf, tuple(wanted - here), to="varying") if wanted - here else leaf
        for leaf, here in zip(leaves, axes, strict=True)
    ]


def _evaluate(*leaves, structure, open_: Argument, levels: _Levels, settle: Callable[..., Any]) -> list[Array]:
    """The contraction in plain JAX: what the primitive computes, abstractly and compiled."""
    function = functools.partial(_form, open_=open_, settle=settle)
    for size, level in reversed(levels):
        axes: Any = _Operands._make(0 if name in level else None for name in _Operands._fields)
        function = jax.vmap(function, in_axes=(axes,), axis_size=size)
    # As JAX's arrays: those of NumPy are for the host, which works on them piece by piece.
    return function(structure.unflatten(map(jnp.asarray, leaves)))


def _form(operands: _Operands, open_: Argument, settle: Callable[..., Any]) -> list[Array]:
    table, weights, u, y, reverse = operands
    here = functools.partial(settle, table)
    if open_ == "weights":
        return here(table.each(functools.partial(_products, u=here(u), y=here(y))))
    if open_ == "rows":
        return here([table.map(functools.partial(_row_sums, u=here(u)), weights)])
    if table.reverse is None:
        return here(_scattered(table, weights, here(y)))
    reverse, y = here(reverse_weights(table, weights)) if reverse is None else reverse, here(y)
    transposed = table.reverse.users.map(functools.partial(_row_sums, u=y), reverse.slots)
    return here([transposed + _over_species(reverse.imbalance, y) * y])


def _settled(table: Table, values: Any) -> Any:
    """The same values, held in memory: XLA fuses nothing across."""
    del table
    return jax.lax.optimization_barrier(values)


def _settled_on_cpu(table: Table, values: Any) -> Any:
    """The same, by a loop that is never entered; that no index is negative the compiler cannot know."""
    start = (table.blocks[0].indices[0, 0], values)
    return jax.lax.while_loop(
        lambda state: state[0] < 0, lambda state: (state[0] + 1, jax.tree.map(jnp.negative, state[1])), start
    )[1]


def _scattered(table: Table, weights: Any, y: Any) -> list[Array]:
    """The transpose without a reverse."""
    forward = lambda u: table.map(functools.partial(_row_sums, u=u), weights)  # noqa: E731
    return list(jax.linear_transpose(forward, jax.ShapeDtypeStruct(y.shape, y.dtype))(y))


def _row_sums(block: Block, weights: Array, u: Array) -> Array:
    centre = block.centre(u)
    if not _is_unrolled(block):
        return jnp.sum(_over_species(weights, u) * (block.neighbours(u) - centre[None]), axis=0)
    # Unrolled, the slots fuse into one pass over u with no (K, N) intermediate.
    total = jnp.zeros_like(centre)
    for slot in range(weights.shape[0]):
        total = total + _over_species(weights[slot], u) * (take(u, block.indices[slot]) - centre)
    return total


def _is_unrolled(block: Block) -> bool:
    slots, rows = block.indices.shape
    return slots <= (_UNROLL_MANY if rows >= _MANY else _UNROLL)


def _products(block: Block, u: Array, y: Array) -> Array:
    here, centre = block.centre(y), block.centre(u)
    if not _is_unrolled(block):
        return jnp.sum(here[None] * (block.neighbours(u) - centre[None]), axis=tuple(range(2, u.ndim + 1)))
    species = tuple(range(1, u.ndim))
    return jnp.stack([jnp.sum(here * (take(u, neighbours) - centre), axis=species) for neighbours in block.indices])


def _over_species(weights: Array, u: Array) -> Array:
    return weights.reshape(*weights.shape, *(1,) * (u.ndim - 1))


contraction_p = Primitive("table_contraction")
contraction_p.multiple_results = True
# Alone, outside of jit, there is nothing to be fused with.
_evaluate_alone = functools.partial(_evaluate, settle=lambda table, values: values)
contraction_p.def_impl(jax.jit(_evaluate_alone, static_argnames=("structure", "open_", "levels")))
# On CPU these releases drop barriers before they fuse; the loop that holds there costs a copy of u.
_DROPS_BARRIERS = jax.__version_info__ < (0, 11)
for platform, settle in ((None, _settled), ("cpu", _settled_on_cpu))[: 1 + _DROPS_BARRIERS]:
    lowering = mlir.lower_fun(functools.partial(_evaluate, settle=settle), multiple_results=True)
    mlir.register_lowering(contraction_p, lowering, platform=platform)


@contraction_p.def_abstract_eval
def _(*leaves, **params):
    shapes = jax.eval_shape(functools.partial(_evaluate_alone, **params), *leaves)
    return [jax.typeof(shape) for shape in shapes]


def _by_name(structure, values) -> dict[str, list[Any]]:
    """Values given for each leaf, for each operand."""
    values = iter(values)
    children = zip(_Operands._fields, structure.children(), strict=True)
    return {name: list(itertools.islice(values, child.num_leaves)) for name, child in children}


def _filled(operands: _Operands, name: Argument, values: list[Any], open_: Argument) -> _Operands:
    """The operands with one argument filled in and one left open; other weights have another reverse."""
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
        # Where the linear argument had no axis for a level, all of the level add up in it.
        shared = tuple(axis for axis, (_, level) in enumerate(levels) if linear not in level)
        parts = [jnp.sum(part, axis=shared) for part in parts] if shared else parts
    found = iter(parts)
    return [next(found) if name == linear else None for name, leaves in by_name.items() for _ in leaves]


def _batch(leaves, axes, *, structure, open_, levels):
    size = next(leaf.shape[axis] for leaf, axis in zip(leaves, axes, strict=True) if axis is not None)
    batched = frozenset(name for name, here in _by_name(structure, axes).items() if any(a is not None for a in here))
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
