"""The lifted neighbours of every row, and the rotations that transport vectors from them to the vertex.

Inputs: positions, frames and directions. Outputs, for each block of a table: the lifted neighbours (K, N, 2), and the
cosine and sine (K, N, 2) of the rotation from components in a neighbour's frame to components in the vertex's frame.

A row is laid out in one of two ways: in the chart of its vertex, by edge lengths alone (`intrinsic`), or in space, by
projection to the tangent plane (`ring`). The first is the default. The second is used by the other lifts and near faces
that are folded over.
"""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from .._tables import AnyArray, Block, Table, slot_values
from .frames import transport
from .intrinsic import Directions, Paths, lay_out, with_columns
from .ring import Lift, lifted_ring, offsets

PerBlock = tuple[AnyArray, ...]


class Places(eqx.Module):
    """The arrays of a surface on which the layout of its neighbours depends.

    Attributes:
        vertices: (V, 3) positions.
        normals: (V, 3) unit normals.
        frames: (V, 2, 3) tangent frames, aligned with the charts.
        directions: edge lengths and chart directions; None if all rows are laid out in space.
        is_creased: (V,) mask of the vertices at creases, where vectors are transported in charts; None if there are no
            creases.
        lift: the map from space to the tangent plane, for rows laid out in space.
        transport: the transport of vectors, for rows laid out in space. "shortest" rotates the neighbour's normal to
            the vertex's normal by the shortest rotation. "paper" maps the edge projected to one tangent plane to the
            edge projected to the other (Chen, Chi and Wu, arXiv 0907.1817, section 2).
    """

    vertices: Float[AnyArray, "V 3"]
    normals: Float[AnyArray, "V 3"]
    frames: Float[AnyArray, "V 2 3"]
    directions: Directions | None
    is_creased: Bool[AnyArray, " V"] | None
    lift: Lift = eqx.field(static=True)
    transport: Literal["shortest", "paper"] = eqx.field(static=True, default="shortest")

    def lifted(self, table: Table, paths: tuple[Paths, ...] | None) -> PerBlock:
        """The neighbours in the plane of their vertex, (K, N, 2) for each block.

        Args:
            table: the neighbours.
            paths: for each block, the half-edges that lead to its neighbours; None if all rows are laid out in space.
        """
        if paths is None or self.directions is None:
            # A table joins results along their last axis, so the rows must be there.
            return rows_second(tuple(table.each(lambda block: _moved(self._lifted_in_space(block), 1, -1))))
        blocks = []
        for block, path in zip(table.blocks, paths, strict=True):
            values = lay_out(self.directions, path)[0]
            if path.in_space.shape[0]:
                values = with_columns(values, path.in_space, self._lifted_in_space(block.part(path.in_space)))
            blocks.append(values)
        return tuple(blocks)

    def turns(self, table: Table, paths: tuple[Paths, ...] | None) -> PerBlock:
        """The cosine and sine (K, N, 2) of the angle by which transport rotates components, for each block.

        Transport in space between refined normals converges fast enough for second derivatives of vector fields to
        converge. Transport in charts does not, because all curvature of a polyhedron is concentrated at its vertices.
        Across creases only transport in charts is correct, so it is used there.
        """
        in_space = rows_second(tuple(table.each(lambda block: _moved(self._turns_in_space(block), 1, -1))))
        if paths is None or self.directions is None or self.is_creased is None:
            return in_space
        blocks = []
        for block, path, turn in zip(table.blocks, paths, in_space, strict=True):
            angle = lay_out(self.directions, path)[1]
            xp = angle.__array_namespace__()
            in_chart = xp.stack([xp.cos(angle), xp.sin(angle)], axis=-1)
            is_near = xp.any(block.neighbours(self.is_creased), axis=0) | block.centre(self.is_creased)
            turned = xp.where(is_near[None, :, None], in_chart, turn)
            blocks.append(with_columns(turned, path.in_space, turn[:, path.in_space]))
        return tuple(blocks)

    def _lifted_in_space(self, block: Block) -> AnyArray:
        return lifted_ring(offsets(self.vertices, block), block.centre(self.frames), self.lift)

    def _turns_in_space(self, block: Block) -> AnyArray:
        frame, neighbour_frame = block.centre(self.frames)[None], block.neighbours(self.frames)
        xp = self.vertices.__array_namespace__()
        if self.transport == "shortest":
            e1 = neighbour_frame[..., 0, :]
            transported = transport(block.neighbours(self.normals), block.centre(self.normals)[None], e1)
            return xp.einsum("knac,knc->kna", xp.broadcast_to(frame, neighbour_frame.shape), transported)
        edge = offsets(self.vertices, block)
        leaving, arriving = (
            xp.einsum("knac,knc->kna", xp.broadcast_to(basis, neighbour_frame.shape), edge)
            for basis in (frame, neighbour_frame)
        )
        # As complex numbers: the quotient of the two directions, or the identity if the edge projects to zero.
        real = xp.sum(leaving * arriving, axis=-1)
        imaginary = leaving[..., 1] * arriving[..., 0] - leaving[..., 0] * arriving[..., 1]
        squared = real**2 + imaginary**2
        size = xp.sqrt(xp.where(squared > 0, squared, 1))
        turned = xp.stack([real / size, imaginary / size], axis=-1)
        return xp.where((squared > 0)[..., None], turned, xp.asarray([1, 0], dtype=edge.dtype))


def rows_last(lifted: PerBlock) -> PerBlock:
    """Lifted rings (K, N, 2) of all blocks as (K, 2, N): the layout in which a table passes them on in batches."""
    return tuple(_moved(values, 1, -1) for values in lifted)


def rows_second(lifted: PerBlock) -> PerBlock:
    """Lifted rings (K, 2, N) of all blocks as (K, N, 2)."""
    return tuple(_moved(values, -1, 1) for values in lifted)


def _moved(values: AnyArray, source: int, destination: int) -> AnyArray:
    return values.__array_namespace__().moveaxis(values, source, destination)


def block_paths(
    table: Table, row_offsets: np.ndarray, paths: np.ndarray, no_half_edge: int, is_extrinsic: np.ndarray | None
) -> tuple[Paths, ...]:
    """The paths to the entries of all rows, arranged like the blocks of their table (host).

    Args:
        table: the table of the rows.
        row_offsets: (V + 1,) index of the first entry of each row.
        paths: (n, R) half-edges that lead to each entry.
        no_half_edge: the half-edge of length zero.
        is_extrinsic: (V,) mask of the rows laid out in space; None if there are none.
    """
    steps = [slot_values(row_offsets, hop, no_half_edge) for hop in paths.T]
    blocks = []
    for block, first, *further in zip(table.blocks, *steps, strict=True):
        is_long = [np.any(hop != no_half_edge, axis=0) for hop in further]
        columns = np.flatnonzero(np.any(is_long, axis=0)) if further else np.zeros(0, int)
        used = [hop[:, columns] for hop, mask in zip(further, is_long, strict=True) if mask.any()]
        stacked = np.stack(used) if used else np.zeros((0, len(first), 0))
        in_space = np.zeros(0) if is_extrinsic is None else np.flatnonzero(block.centre(is_extrinsic))
        blocks.append(Paths(*(a.astype(np.int32) for a in (first, columns, stacked, in_space))))
    return tuple(blocks)
