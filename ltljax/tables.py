"""Padded neighbour tables, and the one loop everything runs through: a weighted sum over the slots of a row.

What enters: rows of neighbours of any length, on the host. What leaves: a `Table`, and sums over its slots. Knows no
geometry.

Tables are slot-major: ``indices[k, v]`` is the neighbour of vertex v in slot k. An empty slot holds v's own index and
weight 0, so a sum of ``w * (u[neighbour] - u[v])`` needs no mask and has finite derivatives. A few rows longer than
most do not widen the table: the bulk has the width that costs the least memory, and longer rows live in tail blocks
whose widths double, so at most half of any tail block is padding.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float, Int

# Tables are built and weighed on the host in NumPy, and used on the device; code that serves both asks the array for
# its namespace (`x.__array_namespace__()`, the array API standard). A type checker cannot follow which of the two an
# array is; while the tests run it is checked to be one of them.
if TYPE_CHECKING:
    AnyArray = Any
else:
    AnyArray = Array | np.ndarray

# Beyond this many slots a loop unrolled over slots only costs compile time.
_UNROLL = 32
# Rows at once on the host.
_PIECE = 1 << 13


class Block(eqx.Module):
    """Rows of one width. ``rows`` is None for the bulk, which has a row for every vertex in order."""

    indices: Int[AnyArray, "K N"]
    rows: Int[AnyArray, " N"] | None

    def centre(self, values: AnyArray) -> AnyArray:
        """The values at this block's own rows: (V, ...) -> (N, ...)."""
        return values if self.rows is None else _take(values, self.rows)

    def neighbours(self, values: AnyArray) -> AnyArray:
        """The values at the neighbours: (V, ...) -> (K, N, ...)."""
        return _take(values, self.indices)


class Table(eqx.Module):
    """Neighbours of every vertex: the bulk block, then tail blocks that replace the rows too long for it."""

    blocks: tuple[Block, ...]

    @property
    def num_vertices(self) -> int:
        """Number of vertices V."""
        return self.blocks[0].indices.shape[1]

    @property
    def num_slots(self) -> int:
        """Number of slots held, empty ones included: what a weight per slot costs."""
        return sum(block.indices.size for block in self.blocks)

    def rows_from(self, values: list[AnyArray]) -> AnyArray:
        """One array (V, ...) from one array (N, ...) per block."""
        out = values[0]
        for block, value in zip(self.blocks[1:], values[1:], strict=True):
            if isinstance(out, np.ndarray):
                out = out.copy()
                out[block.rows] = value
            else:
                out = out.at[block.rows].set(value, unique_indices=True)
        return out

    def map(self, function: Callable[..., AnyArray], *per_block) -> AnyArray:
        """Apply ``function(block, *arguments of that block) -> (N, ...)`` to every block and put the rows together."""
        return self.rows_from(self._apply(function, per_block, axis=0))

    def each(self, function: Callable[..., Any], *per_block) -> list[Any]:
        """Apply a function to every block; what it returns, arrays (..., N) in any nest, comes back one for each."""
        return self._apply(function, per_block, axis=-1)

    def _apply(self, function, per_block, axis):
        results = []
        for block, *arguments in zip(self.blocks, *per_block, strict=True):
            parts = [function(*part) for part in _pieces(block, arguments)]
            results.append(parts[0] if len(parts) == 1 else jax.tree.map(lambda *p: np.concatenate(p, axis), *parts))
        return results


def _pieces(block: Block, arguments: list[Any]):
    """A block and what belongs to it, arrays (..., N) in any nest; on the host a few thousand rows at a time.

    Intermediate arrays are many times the size of the block: in pieces they stay in the cache.
    """
    count = block.indices.shape[1]
    if not isinstance(block.indices, np.ndarray) or count <= _PIECE:
        yield block, *arguments
        return
    for start in range(0, count, _PIECE):
        stop = min(start + _PIECE, count)
        rows = np.arange(start, stop, dtype=np.int32) if block.rows is None else block.rows[start:stop]
        here = Block(block.indices[:, start:stop], rows)
        yield here, *jax.tree.map(lambda values: values[..., start:stop], arguments)  # noqa: B023


def _take(values: AnyArray, indices: AnyArray) -> AnyArray:
    if isinstance(values, np.ndarray):
        return values[indices]
    # The host has checked every index, so the bounds check XLA would add is not needed.
    return values.at[indices].get(mode="promise_in_bounds")


def build_table(offsets: np.ndarray, neighbours: np.ndarray) -> Table:
    """The table of rows given as ``neighbours[offsets[v]:offsets[v + 1]]``, in NumPy.

    The widths are chosen so that the slots held are the fewest: their number is at most the bulk's V * K, with K the
    best width, plus twice the sum of the lengths of the longer rows.

    Args:
        offsets: (V + 1,) integers.
        neighbours: (sum of lengths,) vertex indices.
    """
    num_vertices = len(offsets) - 1
    lengths = np.diff(offsets)
    width = _bulk_width(lengths)
    blocks = [_block(offsets, neighbours, lengths, np.arange(num_vertices), width, is_bulk=True)]
    while width < lengths.max(initial=0):
        longer = np.flatnonzero((lengths > width) & (lengths <= 2 * width))
        width *= 2
        if len(longer):
            widest = int(lengths[longer].max())
            blocks.append(_block(offsets, neighbours, lengths, longer, widest, is_bulk=False))
    return Table(tuple(blocks))


def _bulk_width(lengths: np.ndarray) -> int:
    """The K for which V * K plus twice the lengths of rows longer than K is least."""
    counts = np.bincount(lengths, minlength=2)
    widths = np.arange(len(counts))
    longer = (counts * widths).sum() - np.cumsum(counts * widths)
    return max(1, int(np.argmin(len(lengths) * widths + 2 * longer)))


def _block(offsets, neighbours, lengths, rows, width, *, is_bulk) -> Block:
    slot = np.arange(width)[:, None]
    used = slot < np.where(lengths[rows] <= width, lengths[rows], 0)
    position = np.minimum(offsets[rows] + slot, max(len(neighbours) - 1, 0))
    indices = np.where(used, neighbours[position] if len(neighbours) else 0, rows)
    return Block(indices.astype(np.int32), None if is_bulk else rows.astype(np.int32))


def difference_sum(table: Table, weights: tuple[Array, ...], u: Float[Array, "V *S"]) -> Float[Array, "V *S"]:
    """``sum_k w[k, v] * (u[neighbour k of v] - u[v])`` for every vertex v: the hot loop.

    Args:
        table: the neighbours.
        weights: one array (K, N) per block of the table.
        u: (V,) or (V, S).
    """
    return table.map(lambda block, w: _difference_sum(block, w, u), weights)


def _difference_sum(block: Block, weights: Array, u: Array) -> Array:
    centre = block.centre(u)
    trailing = (1,) * (u.ndim - 1)
    if weights.shape[0] > _UNROLL:
        return jnp.sum(weights.reshape(*weights.shape, *trailing) * (block.neighbours(u) - centre[None]), axis=0)
    # Unrolled, the slots fuse into one pass over u with no (K, N) intermediate.
    total = jnp.zeros_like(centre)
    for slot in range(weights.shape[0]):
        weight = weights[slot].reshape(-1, *trailing)
        total = total + weight * (_take(u, block.indices[slot]) - centre)
    return total


def slot_sum(table: Table, weights: tuple[AnyArray, ...]) -> AnyArray:
    """The sum of each row's weights, (V,)."""
    return table.map(lambda block, w: w.sum(axis=0), weights)


def coordinates(table: Table, weights: tuple[Array, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns and values of the used slots (host), for a sparse matrix of the sum over neighbours."""
    rows, columns, values = [], [], []
    for block, weight in zip(table.blocks, weights, strict=True):
        index, value = jax.device_get((block.indices, weight))
        row = np.broadcast_to(np.arange(index.shape[1]) if block.rows is None else np.asarray(block.rows), index.shape)
        used = index != row
        rows.append(row[used])
        columns.append(index[used])
        values.append(value[used])
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)


def difference_matrix(table: Table, weights: tuple[Array, ...]) -> scipy.sparse.csr_array:
    """The sparse matrix (V, V) of `difference_sum` (host)."""
    rows, columns, values = coordinates(table, weights)
    size = table.num_vertices
    neighbours = scipy.sparse.csr_array((values, (rows, columns)), shape=(size, size))
    return scipy.sparse.csr_array(neighbours - scipy.sparse.diags_array(np.asarray(slot_sum(table, weights))))
