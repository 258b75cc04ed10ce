"""The intrinsic lift: neighbours are laid into the plane by edge lengths alone, so bending the surface changes nothing.

Inputs: positions, and the frozen intrinsic Delaunay triangulation. Outputs: the length of every edge and the direction
of every half-edge at its tail. They determine the position of each neighbour in the chart of a vertex, and the angle by
which parallel transport rotates its vectors. All are pure functions of the positions, for NumPy and JAX arrays alike.

The chart of a vertex lays its triangles flat, one after another. Let T be the sum of their angles. At interior vertices
directions are multiplied by 2 pi / T, so that the ring closes. The half-edges of edge e are 2 e and 2 e + 1, so that
the twin of half-edge h is h ^ 1.

Sources: the chart is the discrete exponential map of Knoppel, Crane, Pinkall and Schroder (2013), Globally optimal
direction fields, doi:10.1145/2461912.2462005, section 6; flips and the directions of new edges follow Sharp, Soliman
and Crane (2019), Navigating intrinsic triangulations, doi:10.1145/3306346.3322979.
"""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from .._tables import AnyArray, Block, Table, take
from .frames import transport, unit
from .jets import INTERIOR, RIGHT_CORNER
from .ring import RingTopology, offsets, take_slots

# The triangle inequality must hold with a slack of this fraction of a face's shortest edge. Otherwise all edges are
# lengthened by the same amount (Sharp and Crane 2020, A Laplacian for nonmanifold triangle meshes,
# doi:10.1111/cgf.14069, section 4.5).
_SLACK = 1e-6


class Flips(eqx.Module):
    """Edge flips in levels. The flips of one level do not share a face, so all of them can be made at once.

    All levels have the width N of the widest one. Unused entries hold half-edge H, one past the last.

    Attributes:
        flipped: (L, N) half-edge a -> b of each flipped edge. With c the apex on its left and d the apex on its right,
            the flip turns it into d -> c and its twin into c -> d.
        around: (L, 4, N) half-edges b -> c, c -> a, a -> d and d -> b.
    """

    flipped: Int[AnyArray, "L N"]
    around: Int[AnyArray, "L 4 N"]


class Triangulation(eqx.Module):
    """The intrinsic Delaunay triangulation of a mesh, stored as edge flips. It stays frozen when vertices move.

    Attributes:
        ends: (E, 2) vertices of each edge of the mesh; half-edge 2 e leads from the first to the second.
        slots: (H,) position of each half-edge of the mesh in the table of one-rings, its blocks concatenated.
        flips: the flips.
        tails: (H,) vertex at which each half-edge begins after all flips.
    """

    ends: Int[AnyArray, "E 2"]
    slots: Int[AnyArray, " H"]
    flips: Flips
    tails: Int[AnyArray, " H"]


class Directions(eqx.Module):
    """Edge lengths, and the directions of half-edges in the charts of their tails.

    One edge of length zero is appended to the edges of the triangulation. It pads paths that end early, and transport
    along it is the identity.

    Attributes:
        lengths: (E + 1,) length of every edge; the last is zero.
        angles: (H + 2,) direction of every half-edge in the chart of its tail, in radians; the last two belong to the
            edge of length zero.
        angle_sums: (V,) sum of the face angles at each vertex, in radians.
    """

    lengths: Float[AnyArray, " L"]
    angles: Float[AnyArray, " A"]
    angle_sums: Float[AnyArray, " V"]

    @property
    def no_half_edge(self) -> int:
        """The half-edge of length zero."""
        return self.angles.shape[0] - 2


class Paths(eqx.Module):
    """The half-edges along which the neighbours of a block's rows are reached.

    Attributes:
        first: (K, N) first half-edge of every slot.
        columns: (n,) columns of the block that have neighbours beyond the one-ring.
        further: (R, K, n) subsequent half-edges in those columns, padded with the half-edge of length zero.
        in_space: (m,) columns of the block whose neighbours are laid out in space instead.
    """

    first: Int[AnyArray, "K N"]
    columns: Int[AnyArray, " n"]
    further: Int[AnyArray, "R K n"]
    in_space: Int[AnyArray, " m"]


class RingAngles(eqx.Module):
    """Lengths and angles of the mesh itself, before any flip.

    Attributes:
        lengths: (E,) lengths of the edges.
        corners: for each block of the one-rings, the angle (K, N) between the first slot and each slot.
        sums: (V,) sum of the face angles at each vertex.
        first: (V,) direction of the first slot at vertices of a smooth boundary. The second axis of their chart is the
            outward conormal of the parabola through three boundary vertices.
    """

    lengths: Float[AnyArray, " E"]
    corners: tuple[AnyArray, ...]
    sums: Float[AnyArray, " V"]
    first: Float[AnyArray, " V"]


def ring_angles(
    vertices: Float[AnyArray, "V 3"], triangulation: Triangulation, ring: Table, ring_blocks: tuple[RingTopology, ...]
) -> RingAngles:
    """The lengths of the edges of a mesh and the angles around its vertices, in radians."""
    xp = vertices.__array_namespace__()
    ends = triangulation.ends
    lengths = xp.sqrt(xp.sum((take(vertices, ends[:, 1]) - take(vertices, ends[:, 0])) ** 2, axis=-1))
    missing = [xp.max(block) for block in ring.each(lambda *a: _missing(*_sides(vertices, *a)), ring_blocks)]
    added = xp.maximum(xp.max(xp.stack(missing)), 0)

    def angles_of_block(block, topology):
        has_face, ahead, behind, across = _sides(vertices, block, topology)
        # Where no face follows, use the sides of an equilateral triangle, whose angle has finite derivatives.
        sides = (xp.where(has_face, side + added, 1) for side in (across, ahead, behind))
        angles = xp.where(has_face, corner_angle(*sides), 0)
        total = xp.sum(angles, axis=0)
        following = ahead[0] + added
        previous = take_slots(ahead, (topology.valences - 1).clip(0)[None])[0] + added
        # The tangent is, up to a positive factor, next / |next|^2 - previous / |previous|^2 as complex numbers.
        tangent = previous - following * xp.cos(total), -following * xp.sin(total)
        first = np.pi - xp.arctan2(tangent[1], xp.where(topology.is_boundary, tangent[0], 1))
        return xp.cumsum(angles, axis=0) - angles, total, first

    corners, sums, first = zip(*ring.each(angles_of_block, ring_blocks), strict=True)
    return RingAngles(lengths + added, corners, ring.rows_from(list(sums)), ring.rows_from(list(first)))


def directions(angles: RingAngles, triangulation: Triangulation, kinds: Int[AnyArray, " V"]) -> Directions:
    """The lengths of the triangulation's edges, and the directions of its half-edges in the charts of their tails.

    On a smooth boundary the chart is rotated so that its second axis is the outward conormal. At a corner the second
    axis is the conormal of the first side.
    """
    xp = angles.lengths.__array_namespace__()
    lengths, half_edge_angles = flipped(angles, triangulation)
    inside = kinds == INTERIOR
    scale = xp.where(inside, 2 * np.pi / xp.where(inside, angles.sums, 1), 1)
    start = xp.where(inside, 0, xp.where(kinds >= RIGHT_CORNER, -np.pi, angles.first))
    tails = triangulation.tails
    half_edge_angles = take(start, tails) + take(scale, tails) * half_edge_angles
    # The two half-edges of the edge of length zero, with which paths are padded.
    padding = xp.asarray([0, np.pi], dtype=half_edge_angles.dtype)
    lengths = xp.concatenate([lengths, padding[:1]])
    return Directions(lengths, xp.concatenate([half_edge_angles, padding]), angles.sums)


def flipped(angles: RingAngles, triangulation: Triangulation) -> tuple[Float[AnyArray, " E"], Float[AnyArray, " H"]]:
    """The length of each edge after all flips, and the angle of each half-edge from the first slot of its tail."""
    xp = angles.lengths.__array_namespace__()
    flips = triangulation.flips
    lengths = angles.lengths
    half_edge_angles = take(xp.concatenate([block.reshape(-1) for block in angles.corners]), triangulation.slots)
    if not flips.flipped.shape[0]:
        return lengths, half_edge_angles
    # Unused entries of narrow levels flip one additional edge, of length one.
    unit_length = xp.ones(1, dtype=lengths.dtype)
    padded_angles = xp.concatenate([half_edge_angles, 0 * unit_length, 0 * unit_length])
    start = xp.concatenate([lengths, unit_length]), padded_angles
    if isinstance(padded_angles, np.ndarray):
        for level in zip(flips.flipped, flips.around, strict=True):
            start = flip(*start, *level)
        lengths, half_edge_angles = start
    else:
        # Unrolled, even a few levels would take XLA seconds to compile.
        levels = flips.flipped, flips.around
        (lengths, half_edge_angles), _ = jax.lax.scan(lambda carry, level: (flip(*carry, *level), None), start, levels)
    return lengths[:-1], half_edge_angles[:-2]


def flip(
    lengths: Float[AnyArray, " E"],
    angles: Float[AnyArray, " H"],
    flipped: Int[AnyArray, " N"],
    around: Int[AnyArray, "4 N"],
) -> tuple[Float[AnyArray, " E"], Float[AnyArray, " H"]]:
    """Lengths and angles after the flips of one level.

    Each flip lays the two faces of its edge flat and replaces the edge by the other diagonal.
    """
    xp = lengths.__array_namespace__()
    ab, (bc, ca, ad, db) = take(lengths, flipped >> 1), take(lengths, around >> 1)
    # Place a at the origin, b on the positive first axis, c above it and d below it.
    cx, cy = (ab**2 + ca**2 - bc**2) / (2 * ab), double_area(ab, bc, ca) / ab
    dx, dy = (ab**2 + ad**2 - db**2) / (2 * ab), double_area(ab, ad, db) / ab
    along, down = dx - cx, cy + dy
    at_c = xp.arctan2(cx * down + cy * along, cy * down - cx * along)
    at_d = xp.arctan2((ab - dx) * down + dy * along, dy * down - (ab - dx) * along)
    angle_d, angle_c = take(angles, around[3]) + at_d, take(angles, around[1]) + at_c
    lengths = _replace(lengths, flipped >> 1, xp.sqrt(along**2 + down**2))
    return lengths, _replace(_replace(angles, flipped, angle_d), flipped ^ 1, angle_c)


def double_area(a: AnyArray, b: AnyArray, c: AnyArray) -> AnyArray:
    """Twice the area of triangles with sides a, b, c (Heron). Impossible sides give zero, with zero derivative."""
    xp = a.__array_namespace__()
    total = a + b + c
    size = xp.where(total > 0, total, 1)
    # Divide by the perimeter first: powers of a length could overflow or underflow.
    product = ((b + c - a) / size) * ((a + c - b) / size) * ((a + b - c) / size)
    has_area = product > 0
    return xp.where(has_area, size * size * xp.sqrt(xp.where(has_area, product, 1)), 0) / 2


def corner_angle(a: AnyArray, b: AnyArray, c: AnyArray) -> AnyArray:
    """The angle opposite side a in triangles with sides a, b and c, in radians."""
    return a.__array_namespace__().arctan2(2 * double_area(a, b, c), b**2 + c**2 - a**2)


def lay_out(directions: Directions, paths: Paths) -> tuple[Float[AnyArray, "K N 2"], Float[AnyArray, "K N"]]:
    """The neighbours of a block's rows in the charts of their vertices, and the angles that transport their vectors.

    The direction of each half-edge of a path is given in the chart of its tail; the angle accumulated along the path
    rotates it into the chart of the row's vertex. The result is exact if the path and the straight line to its end
    enclose no curvature.
    """
    xp = directions.angles.__array_namespace__()
    zeros = xp.zeros(paths.first.shape, dtype=directions.angles.dtype)
    lifted, turn = _step(directions, xp.zeros((*zeros.shape, 2), dtype=zeros.dtype), zeros, paths.first)
    if not paths.columns.shape[0]:
        return lifted, turn
    far, far_turn = lifted[:, paths.columns], turn[:, paths.columns]
    for half_edges in paths.further:
        far, far_turn = _step(directions, far, far_turn, half_edges)
    return with_columns(lifted, paths.columns, far), with_columns(turn, paths.columns, far_turn)


def _step(directions, lifted, turn, half_edges):
    """Positions and accumulated angles after one more half-edge."""
    xp = turn.__array_namespace__()
    leaving, length = take(directions.angles, half_edges), take(directions.lengths, half_edges >> 1)
    direction = leaving + turn
    lifted = lifted + length[..., None] * xp.stack([xp.cos(direction), xp.sin(direction)], axis=-1)
    return lifted, turn + edge_turn(directions, half_edges)


def edge_turn(directions: Directions, half_edges: Int[AnyArray, "*N"]) -> Float[AnyArray, "*N"]:
    """The angle by which transport from the head of a half-edge to its tail rotates components in the charts.

    Parallel transport preserves the direction of the edge, which points along the half-edge at its tail and against the
    twin at its head.
    """
    return take(directions.angles, half_edges) + np.pi - take(directions.angles, half_edges ^ 1)


class CotangentRows(eqx.Module):
    """The rows of a block that hold the cotangent Laplacian of the triangulation.

    Attributes:
        columns: (n,) columns of these rows in the block.
        edges: (5, K, n) edge of each slot, then the other two edges of the face on its left, then the other two edges
            of the face on its right; the edge of length zero where there is no face.
    """

    columns: Int[AnyArray, " n"]
    edges: Int[AnyArray, "5 K n"]


def cotangent_weights(
    directions: Directions, rows: CotangentRows
) -> tuple[Float[AnyArray, "K n"], Float[AnyArray, " n"]]:
    """Rows of the cotangent Laplacian divided by the areas A of the circumcentric dual cells, and these areas.

    The weights are c = w / A, with w = (cot alpha + cot beta) / 2 and A the sum of w l^2 / 4. In a Delaunay
    triangulation they are non-negative in the interior, where ``sum c p = 0`` and ``sum c |p|^2 = 4`` hold before the
    angles of the chart are rescaled. The row converges only in the weak sense.

    Negative weights are clipped to zero. They occur at boundary edges opposite an obtuse angle, and can occur elsewhere
    after vertices have moved.

    Source: Bobenko and Springborn (2007), A discrete Laplace-Beltrami operator for simplicial surfaces,
    doi:10.1007/s00454-007-9006-1.
    """
    xp = directions.lengths.__array_namespace__()
    own, *others = take(directions.lengths, rows.edges)

    def cotangent(b, c):
        area = double_area(own, b, c)
        has_area = area > 0
        return xp.where(has_area, (b**2 + c**2 - own**2) / xp.where(has_area, 2 * area, 1), 0)

    w = xp.maximum(cotangent(*others[:2]) + cotangent(*others[2:]), 0) / 2
    area = xp.sum(w * own**2, axis=0) / 4
    area = xp.where(area > 0, area, 1)
    return w / area[None], area


def boundary_conormals(
    directions: Directions, kinds: Int[AnyArray, " V"], boundary: Int[AnyArray, " B"]
) -> Float[AnyArray, "B 2 2"]:
    """The outward conormals of both sides of each boundary vertex, in its chart."""
    xp = directions.angles.__array_namespace__()
    is_corner = take(kinds, boundary) >= RIGHT_CORNER
    second = xp.where(is_corner, take(directions.angle_sums, boundary) - np.pi / 2, np.pi / 2)
    sides = xp.stack([xp.full_like(second, np.pi / 2), second], axis=1)
    return xp.stack([xp.cos(sides), xp.sin(sides)], axis=-1)


def aligned_frames(
    frames: Float[AnyArray, "N 2 3"],
    normals: Float[AnyArray, "N 3"],
    offsets: Float[AnyArray, "K N 3"],
    topology: RingTopology,
    corners: Float[AnyArray, "K N"],
    sums: Float[AnyArray, " N"],
) -> Float[AnyArray, "N 2 3"]:
    """Frames rotated in their planes so that the ring in space agrees with the ring in the chart as well as possible.

    Every face is rotated into the tangent plane by the shortest rotation, which is exact beside a crease.
    """
    xp = frames.__array_namespace__()
    following = topology.following(offsets.shape[0])
    scaled = 2 * np.pi / xp.where(sums > 0, sums, 1)[None] * corners
    after = take_slots(offsets, following)
    face_normals = unit(xp.cross(offsets, after))
    real, imaginary = 0, 0
    for edges, theta in ((offsets, scaled), (after, take_slots(scaled, following))):
        rotated = transport(face_normals, normals[None], edges)
        x, y = xp.moveaxis(xp.einsum("knc,nac->kna", rotated, frames), -1, 0)
        # As complex numbers, sum the quotients of the two directions, weighted by length.
        real += xp.sum(x * xp.cos(theta) + y * xp.sin(theta), axis=0)
        imaginary += xp.sum(y * xp.cos(theta) - x * xp.sin(theta), axis=0)
    squared = real**2 + imaginary**2
    has_turn = squared > 0
    size = xp.sqrt(xp.where(has_turn, squared, 1))
    real, imaginary = xp.where(has_turn, real / size, 1), xp.where(has_turn, imaginary / size, 0)
    turn = xp.stack([xp.stack([real, imaginary]), xp.stack([-imaginary, real])])
    return xp.einsum("abn,nbc->nac", turn, frames)


def _sides(vertices, block: Block, topology: RingTopology):
    """Whether a face follows each slot of the one-rings, and the lengths of its sides.

    The sides are the edges from the vertex to the slot's neighbour and to the next neighbour, and the edge between the
    two neighbours.
    """
    xp = vertices.__array_namespace__()
    edges = offsets(vertices, block)
    following = topology.following(edges.shape[0])
    has_face = following != xp.arange(edges.shape[0], dtype=following.dtype)[:, None]
    after = take_slots(edges, following)

    def norm(vectors, is_used):
        squared = xp.sum(vectors**2, axis=-1)
        is_used = is_used & (squared > 0)
        return xp.where(is_used, xp.sqrt(xp.where(is_used, squared, 1)), 0)

    return has_face, norm(edges, block.is_used), norm(after, has_face), norm(after - edges, has_face)


def _missing(has_face, ahead, behind, across):
    """The length each corner lacks to satisfy the triangle inequality with slack; minus infinity without a face."""
    xp = ahead.__array_namespace__()
    shortest = xp.minimum(xp.minimum(ahead, behind), across)
    return xp.where(has_face, _SLACK * shortest - (ahead + behind - across), -np.inf)


def with_columns(
    values: Float[AnyArray, "K N *C"], columns: Int[AnyArray, " n"], new: Float[AnyArray, "K n *C"]
) -> Float[AnyArray, "K N *C"]:
    """The values of a block, with some columns replaced."""
    return _replace(values, columns, new, axis=1) if columns.shape[0] else values


def _replace(values: AnyArray, index: AnyArray, new: AnyArray, axis: int = 0) -> AnyArray:
    """The values, with the entries at some indices along an axis replaced."""
    where = (slice(None),) * axis + (index,)
    if isinstance(values, np.ndarray):
        values = values.copy()
        values[where] = new
        return values
    return values.at[where].set(new, mode="promise_in_bounds", wrap_negative_indices=False)
