"""Padded neighbour tables: rows of neighbours of any length become a few arrays of fixed width.

Tables are slot-major: ``indices[k, v]`` is the neighbour of vertex v in slot k. An empty slot holds v's own index and
weight 0, so a sum of ``w * (u[neighbour] - u[v])`` needs no mask and has finite derivatives. A few long rows do not
widen the whole table: the bulk has the width that needs the least memory, and longer rows are in tail blocks, of which
at most half is padding. A small tail block is joined with the next wider one, which adds at most a twentieth of the
bulk.

A table can carry its reverse: for every vertex, the rows that use it. With the reverse a transposed sum gathers; the
plain transpose of a gather scatters, which is several times slower.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float, Int

# Tables are built and weighed on the host in NumPy and used on the device. Code for both asks the array for its
# namespace (`x.__array_namespace__()`, the array API standard). A type checker cannot tell which of the two an array
# is; with LTLJAX_CHECK_SHAPES=1 the tests check that it is one of them.
if TYPE_CHECKING:
    AnyArray = Any
else:
    AnyArray = Array | np.ndarray

# Number of rows that the host processes at once.
_PIECE = 1 << 13


def take(values: AnyArray, indices: AnyArray) -> AnyArray:
    """The values at indices that the host has checked, so that XLA checks neither bounds nor signs."""
    if isinstance(values, np.ndarray):
        return values[indices]
    return values.at[indices].get(mode="promise_in_bounds", wrap_negative_indices=False)


class Block(eqx.Module):
    """Rows of one width.

    Attributes:
        indices: the neighbour in each slot of each row.
        rows: the vertex of each row; None for the bulk, which has a row for every vertex in order.
    """

    indices: Int[AnyArray, "K N"]
    rows: Int[AnyArray, " N"] | None

    @property
    def is_used(self) -> AnyArray:
        """Whether each slot holds a neighbour, (K, N) bool; an empty slot holds the row's own vertex."""
        own = np.arange(self.indices.shape[1], dtype=np.int32) if self.rows is None else self.rows
        return self.indices != own[None]

    def part(self, columns: Int[AnyArray, " n"]) -> "Block":
        """The block with a selection of its columns."""
        return Block(self.indices[:, columns], columns if self.rows is None else self.rows[columns])

    def centre(self, values: AnyArray) -> AnyArray:
        """The values at the vertices of this block's rows: (V, ...) -> (N, ...)."""
        return values if self.rows is None else take(values, self.rows)

    def neighbours(self, values: AnyArray) -> AnyArray:
        """The values at the neighbours: (V, ...) -> (K, N, ...)."""
        return take(values, self.indices)


class Table(eqx.Module):
    """Neighbours of every vertex: the bulk block, then tail blocks that replace the rows too long for it.

    Attributes:
        blocks: the bulk block, then the tail blocks.
        reverse: the rows that use each vertex; None if transposed sums scatter.
    """

    blocks: tuple[Block, ...]
    reverse: "Reverse | None" = None

    @property
    def num_vertices(self) -> int:
        """Number of vertices V."""
        return self.blocks[0].indices.shape[1]

    @property
    def num_slots(self) -> int:
        """Number of slots including empty ones, which is the number of weights."""
        return sum(block.indices.size for block in self.blocks)

    def rows_from(self, values: list[AnyArray]) -> AnyArray:
        """One array (V, ...) from one array (N, ...) per block."""
        out = values[0]
        for block, value in zip(self.blocks[1:], values[1:], strict=True):
            if isinstance(out, np.ndarray):
                out = out.copy()
                out[block.rows] = value
            else:
                out = out.at[block.rows].set(
                    value, mode="promise_in_bounds", unique_indices=True, wrap_negative_indices=False
                )
        return out

    def map(self, function: Callable[..., AnyArray], *per_block) -> AnyArray:
        """Apply ``function(block, *arguments_of_block) -> (N, ...)`` to every block and combine the rows."""
        return self.rows_from(self._apply(function, per_block, axis=0))

    def each(self, function: Callable[..., Any], *per_block) -> list[Any]:
        """The results of a function for every block, as a list; each is a pytree of arrays (..., N)."""
        return self._apply(function, per_block, axis=-1)

    def _apply(self, function, per_block, axis):
        results = []
        for block, *arguments in zip(self.blocks, *per_block, strict=True):
            parts = [function(*part) for part in _pieces(block, arguments)]
            results.append(parts[0] if len(parts) == 1 else jax.tree.map(lambda *p: np.concatenate(p, axis), *parts))
        return results


class Reverse(eqx.Module):
    """A table read backwards.

    Attributes:
        users: for every vertex, the rows that use it.
        positions: for each block of ``users``, the positions of the corresponding slots in the concatenation of all
            slots of the table, block after block. An empty slot of ``users`` holds the total number of slots.
    """

    users: Table
    positions: tuple[AnyArray, ...]


class ReverseWeights(eqx.Module):
    """Weights of a table in the order of its reverse.

    Attributes:
        slots: one array (K, N) for each block of ``reverse.users``.
        imbalance: (V,) the sum of the weights that other rows give to each vertex, minus the sum of its own row.
    """

    slots: tuple[AnyArray, ...]
    imbalance: Float[AnyArray, " V"]


def _pieces(block: Block, arguments: list[Any]):
    """A block and its arguments, pytrees of arrays (..., N); on the host in pieces of a few thousand rows.

    Intermediate arrays are many times the size of the block, and in pieces they fit into the processor's cache.
    """
    count = block.indices.shape[1]
    if not isinstance(block.indices, np.ndarray) or count <= _PIECE:
        yield block, *arguments
        return
    for start in range(0, count, _PIECE):
        stop = min(start + _PIECE, count)
        rows = np.arange(start, stop, dtype=np.int32) if block.rows is None else block.rows[start:stop]
        piece = Block(block.indices[:, start:stop], rows)
        yield piece, *jax.tree.map(lambda values: values[..., start:stop], arguments)  # noqa: B023


# Tail blocks are joined while the slots added by all joins are at most this share of the slots of the bulk.
_FEWER_BLOCKS = 0.05


def build_table(offsets: np.ndarray, neighbours: np.ndarray) -> Table:
    """The table with the rows ``neighbours[offsets[v]:offsets[v + 1]]``, in NumPy.

    It has at most 1.05 V K + 2 L slots, where L is the total length of the rows longer than K, and K is the width that
    minimises V K + 2 L.

    Args:
        offsets: (V + 1,) the start of each row.
        neighbours: (sum of lengths,) vertex indices.
    """
    lengths = np.diff(offsets)
    return Table(tuple(_laid_out(rows, offsets, neighbours, lengths) for rows in _division(lengths)))


def weighted_table(matrix: scipy.sparse.csr_array) -> tuple[Table, tuple[np.ndarray, ...]]:
    """The off-diagonal entries of a square sparse matrix, as a table and its weights (host)."""
    entries: Any = scipy.sparse.coo_array(matrix)
    is_off = (entries.row != entries.col) & (entries.data != 0)
    rows, columns, values = entries.row[is_off], entries.col[is_off], entries.data[is_off]
    order = np.argsort(rows, kind="stable")
    lengths = np.bincount(rows, minlength=entries.shape[0])
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    return build_table(offsets, columns[order]), slot_values(offsets, values[order], 0.0)


def slot_values(offsets: np.ndarray, values: np.ndarray, empty: float | int) -> tuple[np.ndarray, ...]:
    """Values of entries in the layout of `build_table`: one array (K, N) per block (host).

    Args:
        offsets: (V + 1,) integers, as for `build_table`.
        values: (sum of lengths,) one value per entry.
        empty: the value of an empty slot.
    """
    lengths = np.diff(offsets)
    return tuple(_slots(part, offsets, values, lengths, empty) for part in _division(lengths))


def reversible(table: Table) -> Table:
    """The table with its reverse (host)."""
    owners, users, positions, start = [], [], [], 0
    for block in table.blocks:
        row = np.broadcast_to(block.centre(np.arange(table.num_vertices, dtype=np.int32)), block.indices.shape)
        is_used = block.indices != row
        owners.append(block.indices[is_used])
        users.append(row[is_used])
        positions.append(start + np.flatnonzero(is_used))
        start += block.indices.size
    owners, users, positions = map(np.concatenate, (owners, users, positions))
    order = np.argsort(owners, kind="stable")
    lengths = np.bincount(owners, minlength=table.num_vertices)
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    division = list(_division(lengths))
    blocks = tuple(_laid_out(rows, offsets, users[order], lengths) for rows in division)
    where = tuple(_laid_out(rows, offsets, positions[order], lengths, empty=start).indices for rows in division)
    return Table(table.blocks, Reverse(Table(blocks), where))


def reverse_weights(table: Table, weights: tuple[AnyArray, ...]) -> ReverseWeights | None:
    """The weights in the order of the table's reverse; None if the table has no reverse.

    The reverse pass of a loop needs them in every step, so compute them once before the loop.
    """
    if table.reverse is None:
        return None
    xp = weights[0].__array_namespace__()
    zero = xp.zeros(1, dtype=weights[0].dtype)
    flat = xp.concatenate([*(block.reshape(-1) for block in weights), zero])
    slots = tuple(take(flat, positions) for positions in table.reverse.positions)
    own = xp.arange(table.num_vertices, dtype=np.int32)
    # Weights of a surface are zero in empty slots, but tangents and cotangents of weights need not be.
    used = table.map(lambda block, w: xp.where(block.indices == block.centre(own)[None], 0, w).sum(axis=0), weights)
    return ReverseWeights(slots, slot_sum(table.reverse.users, slots) - used)


def _bulk_width(lengths: np.ndarray) -> int:
    """The width K that minimises V * K plus twice the total length of the rows longer than K."""
    counts = np.bincount(lengths, minlength=2)
    widths = np.arange(len(counts))
    longer = (counts * widths).sum() - np.cumsum(counts * widths)
    return max(1, int(np.argmin(len(lengths) * widths + 2 * longer)))


def _division(lengths: np.ndarray):
    """The rows and the width of every block; the rows of the bulk are all rows, written as None."""
    width = _bulk_width(lengths)
    yield None, width
    spare, rows = _FEWER_BLOCKS * width * len(lengths), np.zeros(0, np.int64)
    while width < lengths.max(initial=0):
        rows = np.union1d(rows, np.flatnonzero((lengths > width) & (lengths <= 2 * width)))
        width *= 2
        wider = lengths[(lengths > width) & (lengths <= 2 * width)]
        widest = int(lengths[rows].max(initial=0))
        # Every block adds about a second to the compile time of a program, so small tail blocks join the next wider
        # one.
        added = (int(wider.max(initial=0)) - widest) * len(rows)
        if len(wider) and added <= spare:
            spare -= added
        elif len(rows):
            yield rows, widest
            rows = rows[:0]


def _laid_out(part, offsets, values, lengths, empty=None) -> Block:
    """A block of integer values; an empty slot holds ``empty``, by default the row's own index."""
    rows, _ = part
    empty = (np.arange(len(lengths)) if rows is None else rows) if empty is None else empty
    slots = _slots(part, offsets, values, lengths, empty)
    return Block(slots.astype(np.int32), None if rows is None else rows.astype(np.int32))


def _slots(part, offsets, values, lengths, empty) -> np.ndarray:
    """The values in the slots of a block, (K, N)."""
    rows, width = part
    own = np.arange(len(lengths)) if rows is None else rows
    slot = np.arange(width)[:, None]
    used = slot < np.where(lengths[own] <= width, lengths[own], 0)
    position = np.minimum(offsets[own] + slot, max(len(values) - 1, 0))
    return np.where(used, values[position] if len(values) else 0, empty)


def slot_sum(table: Table, weights: tuple[AnyArray, ...]) -> AnyArray:
    """The sum of each row's weights, (V,)."""
    return table.map(lambda block, w: w.sum(axis=0), weights)


def coordinates(table: Table, weights: tuple[AnyArray, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns and values of the used slots, as in a sparse matrix of the sum over neighbours (host)."""
    rows, columns, values = [], [], []
    for block, weight in zip(table.blocks, weights, strict=True):
        index, value = jax.device_get((block.indices, weight))
        row = np.broadcast_to(np.arange(index.shape[1]) if block.rows is None else np.asarray(block.rows), index.shape)
        used = index != row
        rows.append(row[used])
        columns.append(index[used])
        values.append(value[used])
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)


def difference_matrix(table: Table, weights: tuple[AnyArray, ...]) -> scipy.sparse.csr_array:
    """The sparse matrix (V, V) of `difference_sum` (host)."""
    rows, columns, values = coordinates(table, weights)
    size = table.num_vertices
    neighbours = scipy.sparse.csr_array((values, (rows, columns)), shape=(size, size))
    return scipy.sparse.csr_array(neighbours - scipy.sparse.diags_array(np.asarray(slot_sum(table, weights))))
