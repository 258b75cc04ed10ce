"""The weights that a scheme gives to a surface whose topology is frozen.

What enters: positions and a `Topology`. What leaves: a `Geometry`, the record of every array that depends on the
positions. Pure functions of the positions, on the host in NumPy and in JAX alike.
"""

import equinox as eqx
from jaxtyping import Bool, Float, Int

from .._tables import AnyArray, ReverseWeights, Table, reverse_weights, slot_sum
from . import intrinsic, jets, paper
from .frames import boundary_frames, corner_conormals, tangent_frames
from .intrinsic import CotangentRows, Directions, Paths, RingAngles, Triangulation
from .layout import PerBlock, Places, rows_last
from .ring import (
    RingTopology,
    angle_weighted_normals,
    centroid_normals,
    inverted_normals,
    last_slot,
    offsets,
    take_slots,
)
from .schemes import Monotone, Paper, Polynomial, Scheme


class Topology(eqx.Module):
    """The part of a surface that does not change when vertices move.

    Attributes:
        faces: (F, 3) the triangles.
        ring: the one-rings, counter-clockwise.
        ring_blocks: for every block of ``ring``, which slots hold neighbours and faces.
        kinds: (V,) `INTERIOR`, `SMOOTH` boundary, `RIGHT_CORNER` or `OTHER_CORNER`; see `jets`.
        boundary: (B,) the boundary vertices, loop by loop.
        loops: (B,) the number of the boundary loop that each boundary vertex lies on.
        components: (V,) the connected component of each vertex.
        num_loops: number of boundary loops.
        num_components: number of connected components.
        jet: the neighbours used by the fit of the gradient.
        diffusion: the neighbours used by the Laplacian; None if the Laplacian is the divergence of the gradient.
        jet_paths: for each block of ``jet``, the half-edges that lead to its neighbours; None if all rows are laid out
            in space.
        diffusion_paths: the same for ``diffusion``.
        cotangent_rows: for each block of ``diffusion``, its rows that are rows of the cotangent Laplacian; None if
            there are none.
        triangulation: the intrinsic Delaunay triangulation; None if all rows are laid out in space.
        is_extrinsic: (V,) whether the row of a vertex is laid out in space; None if all rows are laid out alike.
        is_creased: (V,) whether the neighbours of a vertex lie across a crease, so that no height fit is made there;
            None if there are no such vertices.
    """

    faces: Int[AnyArray, "F 3"]
    ring: Table
    ring_blocks: tuple[RingTopology, ...]
    kinds: Int[AnyArray, " V"]
    boundary: Int[AnyArray, " B"]
    loops: Int[AnyArray, " B"]
    jet: Table
    diffusion: Table | None
    components: Int[AnyArray, " V"]
    jet_paths: tuple[Paths, ...] | None = None
    diffusion_paths: tuple[Paths, ...] | None = None
    cotangent_rows: tuple[CotangentRows, ...] | None = None
    triangulation: Triangulation | None = None
    is_extrinsic: Bool[AnyArray, " V"] | None = None
    is_creased: Bool[AnyArray, " V"] | None = None
    num_loops: int = eqx.field(static=True, default=0)
    num_components: int = eqx.field(static=True, default=1)


class Geometry(eqx.Module):
    """The part of a surface that depends on the positions. Weights are one array (K, N) per block of their table.

    Attributes:
        vertices: (V, 3) the positions.
        normals: (V, 3) unit normals.
        frames: (V, 2, 3) orthonormal tangent vectors, aligned with the chart of the vertex; on a smooth boundary the
            second vector is the outward conormal.
        vertex_areas: (V,) a third of the area of the faces at each vertex.
        gradient_weights: two sets of weights on the jet table, one for each component in the frame.
        hessian_weights: three sets of weights on the jet table, for the components xx, xy and yy; None for `Paper`.
        divergence_weights: two sets of weights on the jet table, one for each component at the neighbours.
        divergence_centre: (V, 2) the weights of the vertex's own components, which differences do not account for.
        laplacian_weights: weights on the diffusion table; None if there is no such table.
        laplacian_reverse: the same weights in the order of the table's reverse, which reverse-mode derivatives read in
            every step; None if the table has no reverse.
        laplacian_residual: (V,) the relative moment residual of each Laplacian row: zero up to rounding if the row is
            consistent, and zero for cotangent rows. After the vertices have moved it shows whether the frozen
            neighbours still serve. None if there is no diffusion table.
        directions: lengths and directions in the charts of the vertices; None if all rows are laid out in space.
        conormals: (B, 2, 3) the outward conormals of both sides of each boundary vertex, equal if the boundary is
            smooth there.
        flux_weights: (B, 2) the change of the Laplacian per unit flux through each side of a boundary vertex; None if
            there is no diffusion table.
        spectral_width: the measured distance of the Laplacian's eigenvalues from the real axis; None if it has not been
            measured.
    """

    vertices: Float[AnyArray, "V 3"]
    normals: Float[AnyArray, "V 3"]
    frames: Float[AnyArray, "V 2 3"]
    vertex_areas: Float[AnyArray, " V"]
    gradient_weights: tuple[PerBlock, PerBlock]
    hessian_weights: tuple[PerBlock, PerBlock, PerBlock] | None
    divergence_weights: tuple[PerBlock, PerBlock]
    divergence_centre: Float[AnyArray, "V 2"]
    laplacian_weights: PerBlock | None
    laplacian_reverse: ReverseWeights | None
    laplacian_residual: Float[AnyArray, " V"] | None
    directions: Directions | None
    conormals: Float[AnyArray, "B 2 3"]
    flux_weights: Float[AnyArray, "B 2"] | None
    spectral_width: Float[AnyArray, ""] | None = None


# Two conormals count as one direction if the sine of the angle between them is below this.
_PARALLEL = 0.1


def ring_normals(
    scheme: Scheme, vertices: Float[AnyArray, "V 3"], ring: Table, ring_blocks: tuple[RingTopology, ...]
) -> Float[AnyArray, "V 3"]:
    """The first-order unit normals that a scheme starts from. `Paper` weighs faces by their centroids and goes no
    further."""
    mean = centroid_normals if isinstance(scheme, Paper) else inverted_normals
    return ring.map(lambda block, topology: mean(offsets(vertices, block), topology), ring_blocks)


def surface_normals(scheme: Scheme, vertices: Float[AnyArray, "V 3"], topology: Topology) -> Float[AnyArray, "V 3"]:
    """The unit normals of a scheme: the paper's, or normals refined by a height fit of the scheme's degree.

    At creased vertices the normal is the angle-weighted mean of the face normals. On the crease itself that mean
    bisects the angle between both sides on any mesh.
    """
    ring, ring_blocks = topology.ring, topology.ring_blocks
    normals = ring_normals(scheme, vertices, ring, ring_blocks)
    if isinstance(scheme, Paper):
        return normals

    def refined(block):
        return jets.refined_normals(offsets(vertices, block), block.centre(normals), scheme.degree)

    fitted = topology.jet.map(refined)
    if topology.is_creased is None:
        return fitted
    mean = ring.map(lambda block, rings: angle_weighted_normals(offsets(vertices, block), rings), ring_blocks)
    return vertices.__array_namespace__().where(topology.is_creased[:, None], mean, fitted)


def vertex_frames(
    vertices: Float[AnyArray, "V 3"],
    normals: Float[AnyArray, "V 3"],
    topology: Topology,
    angles: RingAngles | None = None,
) -> tuple[Float[AnyArray, "V 2 3"], Float[AnyArray, "B 2 3"]]:
    """Tangent frames, and the outward conormals of both sides of each boundary vertex.

    On a smooth boundary the second vector of the frame is the conormal; at a corner it is the conormal of the first
    side. In the interior, if ring angles are given, the frame is rotated so that the ring in the chart is as close as
    possible to the ring in the tangent plane.
    """

    def frames(block, ring, kinds, *in_chart):
        to_neighbours = offsets(vertices, block)
        normal = block.centre(normals)
        xp = normal.__array_namespace__()
        sides = corner_conormals(normal, to_neighbours[0], last_slot(to_neighbours, ring))
        smooth = boundary_frames(normal, to_neighbours[0], last_slot(to_neighbours, ring))
        is_corner = (kinds >= jets.RIGHT_CORNER)[:, None, None]
        first = xp.stack([xp.cross(sides[:, 0], normal), sides[:, 0]], axis=1)
        along = xp.where(is_corner, first, smooth)
        inside = tangent_frames(normal)
        if in_chart:
            inside = intrinsic.aligned_frames(inside, normal, to_neighbours, ring, *in_chart)
        frame = xp.where((kinds == jets.INTERIOR)[:, None, None], inside, along)
        both = xp.where(is_corner, sides, xp.stack([smooth[:, 1]] * 2, axis=1))
        return xp.concatenate([frame, both], axis=1)

    kinds = tuple(block.centre(topology.kinds) for block in topology.ring.blocks)
    # `map` splits its arguments along the last axis, so one entry per row must be last.
    chart = [] if angles is None else [angles.corners, tuple(b.centre(angles.sums) for b in topology.ring.blocks)]
    vectors = topology.ring.map(frames, topology.ring_blocks, kinds, *chart)
    return vectors[:, :2], vectors[topology.boundary, 2:]


def places(scheme: Scheme, topology: Topology, geometry: Geometry) -> Places:
    """The layout of neighbours on a surface."""
    return places_in(scheme, topology, geometry.vertices, geometry.normals, geometry.frames, geometry.directions)


def places_in(
    scheme: Scheme,
    topology: Topology,
    vertices: Float[AnyArray, "V 3"],
    normals: Float[AnyArray, "V 3"],
    frames: Float[AnyArray, "V 2 3"],
    directions: Directions | None,
) -> Places:
    """The layout of neighbours under a scheme, for given normals, frames and directions."""
    # Under the intrinsic lift, rows in space use the chord lift, whose edges have their true lengths as well.
    lift = "projection" if scheme.lift == "projection" else "chord"
    return Places(vertices, normals, frames, directions, topology.is_creased, lift, scheme.transport)


def weigh(
    scheme: Scheme, vertices: Float[AnyArray, "V 3"], topology: Topology, angles: RingAngles | None = None
) -> Geometry:
    """All weights of a scheme, as a pure function of the positions.

    The ring angles at these positions may be passed to avoid computing them again.
    """
    normals, triangulation = surface_normals(scheme, vertices, topology), topology.triangulation
    if triangulation is None:
        frames, conormals = vertex_frames(vertices, normals, topology)
        return weigh_in_frames(scheme, vertices, topology, normals, frames, conormals, None)
    if angles is None:
        angles = intrinsic.ring_angles(vertices, triangulation, topology.ring, topology.ring_blocks)
    frames, conormals = vertex_frames(vertices, normals, topology, angles)
    directions = intrinsic.directions(angles, triangulation, topology.kinds)
    return weigh_in_frames(scheme, vertices, topology, normals, frames, conormals, directions)


def weigh_in_frames(
    scheme: Scheme,
    vertices: Float[AnyArray, "V 3"],
    topology: Topology,
    normals: Float[AnyArray, "V 3"],
    frames: Float[AnyArray, "V 2 3"],
    conormals: Float[AnyArray, "B 2 3"],
    directions: Directions | None,
) -> Geometry:
    """The weights of a scheme for given normals, tangent frames and directions in the charts.

    Operators do not depend on the choice of frames, provided that the charts are rotated with them.
    """
    xp = vertices.__array_namespace__()
    layout = places_in(scheme, topology, vertices, normals, frames, directions)
    lifted = layout.lifted(topology.jet, topology.jet_paths)
    gradient, second = _jet_rows(scheme, vertices, normals, topology, lifted)
    # The divergence applies the gradient weights to the neighbour's components, rotated into the vertex's frame.
    x, y = gradient
    turns = layout.turns(topology.jet, topology.jet_paths)
    along = [
        tuple(wx * turn[..., 0] + wy * turn[..., 1] for wx, wy, turn in zip(x, y, turns, strict=True)),
        tuple(wy * turn[..., 0] - wx * turn[..., 1] for wx, wy, turn in zip(x, y, turns, strict=True)),
    ]
    centre = [slot_sum(topology.jet, d) - slot_sum(topology.jet, g) for d, g in zip(along, gradient, strict=True)]
    laplacian, reverse, residual, flux = None, None, None, None
    if not isinstance(scheme, Paper) and topology.diffusion is not None:
        laplacian, residual, first_moments, areas = diffusion_rows(scheme, layout, topology)
        reverse = reverse_weights(topology.diffusion, laplacian)
        flux = flux_weights(
            first_moments[topology.boundary], conormals_in_frame(topology, frames, conormals, directions)
        )
        if areas is not None:
            # A cotangent row receives half of the flux through each side.
            area = areas[topology.boundary][:, None]
            flux = xp.where(area > 0, _side_lengths(vertices, topology) / (2 * xp.where(area > 0, area, 1)), flux)
    return Geometry(
        vertices=vertices,
        normals=normals,
        frames=frames,
        vertex_areas=_vertex_areas(vertices, topology),
        gradient_weights=gradient,
        hessian_weights=second,
        divergence_weights=(along[0], along[1]),
        divergence_centre=xp.stack(centre, axis=-1),
        laplacian_weights=laplacian,
        laplacian_reverse=reverse,
        laplacian_residual=residual,
        directions=directions,
        conormals=conormals,
        flux_weights=flux,
    )


def _jet_rows(
    scheme: Scheme, vertices: AnyArray, normals: AnyArray, topology: Topology, lifted: PerBlock
) -> tuple[tuple[PerBlock, PerBlock], tuple[PerBlock, PerBlock, PerBlock] | None]:
    """The weights of the two first and three second derivatives on the jet table; `Paper` has no second derivatives."""
    if isinstance(scheme, Paper):
        blocks = [paper.gradient_weights(*row) for row in zip(lifted, topology.ring_blocks, strict=True)]
        return (tuple(w[..., 0] for w in blocks), tuple(w[..., 1] for w in blocks)), None

    def jet(block, lifted):
        xp = lifted.__array_namespace__()
        weights = jets.jet_weights(xp.moveaxis(lifted, -1, 1), scheme.degree)
        if isinstance(scheme, Polynomial):
            weights = jets.covariant(_height(vertices, normals, topology, block, weights), weights)
        return tuple(weights)

    x, y, xx, xy, yy = zip(*topology.jet.each(jet, rows_last(lifted)), strict=True)
    return (x, y), (xx, xy, yy)


def _height(vertices, normals, topology: Topology, block, weights):
    """The jet of the height over the tangent plane of each row of a block; zero for rows laid out in charts."""
    height = jets.height_jet(offsets(vertices, block), block.centre(normals), weights)
    if topology.triangulation is None:
        return height
    assert topology.is_extrinsic is not None
    return height.__array_namespace__().where(block.centre(topology.is_extrinsic)[None], height, 0)


def diffusion_rows(
    scheme: Monotone | Polynomial, layout: Places, topology: Topology
) -> tuple[PerBlock, Float[AnyArray, " V"], Float[AnyArray, "V 2"], Float[AnyArray, " V"] | None]:
    """The Laplacian weights on their table.

    Returns:
        The weights; the relative moment residual of each row; its first moments; and the dual areas of cotangent rows,
        which are zero for other rows, or None if there are no cotangent rows.
    """
    table = topology.diffusion
    assert table is not None
    lifted = layout.lifted(table, topology.diffusion_paths)

    def rows(block, lifted):
        xp = lifted.__array_namespace__()
        lifted = xp.moveaxis(lifted, -1, 1)
        targets = xp.asarray(jets.LAPLACIAN, dtype=lifted.dtype)[..., None]
        if isinstance(scheme, Polynomial):
            weights = jets.jet_weights(lifted, scheme.degree)
            targets = jets.laplacian_targets(_height(layout.vertices, layout.normals, topology, block, weights))
        c, residual = jets.operator_weights(
            lifted, block.centre(topology.kinds), targets, scheme.degree, nonnegative=isinstance(scheme, Monotone)
        )
        return c[0], residual[0]

    weights, residuals = zip(*table.each(rows, rows_last(lifted)), strict=True)
    areas = None
    if topology.cotangent_rows is not None and layout.directions is not None:
        weights, residuals, areas = _with_cotangent_rows(topology.cotangent_rows, layout.directions, weights, residuals)
        areas = table.rows_from(list(areas))
    xp = layout.vertices.__array_namespace__()
    moments = [xp.einsum("kn,kna->na", w, positions) for w, positions in zip(weights, lifted, strict=True)]
    return weights, table.rows_from(list(residuals)), table.rows_from(moments), areas


def _with_cotangent_rows(
    rows: tuple[CotangentRows, ...], directions: Directions, weights: PerBlock, residuals: PerBlock
) -> tuple[PerBlock, PerBlock, PerBlock]:
    """Weights and residuals with the cotangent rows filled in, and the dual areas of these rows."""
    blocks = []
    for row, weight, residual in zip(rows, weights, residuals, strict=True):
        cotangent, area = intrinsic.cotangent_weights(directions, row)
        zeros = 0 * residual[None]
        blocks.append(
            (
                intrinsic.with_columns(weight, row.columns, cotangent),
                intrinsic.with_columns(residual[None], row.columns, 0 * area[None])[0],
                intrinsic.with_columns(zeros, row.columns, area[None])[0],
            )
        )
    replaced, exact, areas = zip(*blocks, strict=True)
    return replaced, exact, areas


def conormals_in_frame(
    topology: Topology,
    frames: Float[AnyArray, "V 2 3"],
    conormals: Float[AnyArray, "B 2 3"],
    directions: Directions | None,
) -> Float[AnyArray, "B 2 2"]:
    """The conormals (B, 2, 2) of both sides of each boundary vertex, in the coordinates of its row."""
    xp = frames.__array_namespace__()
    in_space = xp.einsum("bsc,bac->bsa", conormals, frames[topology.boundary])
    if directions is None:
        return in_space
    in_chart = intrinsic.boundary_conormals(directions, topology.kinds, topology.boundary)
    if topology.is_extrinsic is None:
        return in_chart
    return xp.where(topology.is_extrinsic[topology.boundary][:, None, None], in_space, in_chart)


def _side_lengths(vertices, topology: Topology):
    """The lengths (B, 2) of the edges to the next and previous boundary vertices."""
    xp = vertices.__array_namespace__()

    def ends(block, ring):
        edges = offsets(vertices, block)
        return xp.stack([edges[0], last_slot(edges, ring)], axis=1)

    both = topology.ring.map(ends, topology.ring_blocks)[topology.boundary]
    return xp.sqrt(xp.sum(both**2, axis=-1))


def flux_weights(first_moments: Float[AnyArray, "B 2"], conormals: Float[AnyArray, "B 2 2"]) -> Float[AnyArray, "B 2"]:
    """The weights (B, 2) of the fluxes through both sides of each boundary vertex.

    A boundary row has the error ``first_moments . grad u``, which the fluxes cancel. On a smooth boundary the
    tangential part of the gradient has no weight; at a corner the gradient g solves ``conormal . g = flux`` for both
    sides.

    Args:
        first_moments: (B, 2) the first moments of the rows.
        conormals: (B, 2, 2) the conormals of both sides, in the frame.
    """
    xp, m = first_moments.__array_namespace__(), first_moments
    a, b = xp.moveaxis(conormals, 1, 0)
    determinant = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    is_corner = xp.abs(determinant) > _PARALLEL
    safe = xp.where(is_corner, determinant, 1)
    corner = xp.stack([m[:, 1] * b[:, 0] - m[:, 0] * b[:, 1], m[:, 0] * a[:, 1] - m[:, 1] * a[:, 0]], axis=-1)
    smooth = -m[:, 1:] / 2
    return xp.where(is_corner[:, None], corner / safe[:, None], smooth)


def _vertex_areas(vertices, topology):
    xp = vertices.__array_namespace__()

    def area(block, ring):
        to_neighbours = offsets(vertices, block)
        following = take_slots(to_neighbours, ring.following(to_neighbours.shape[0]))
        squared = xp.sum(xp.cross(to_neighbours, following) ** 2, axis=-1)
        return xp.sum(xp.where(squared > 0, xp.sqrt(xp.where(squared > 0, squared, 1)), 0), axis=0) / 6

    return topology.ring.map(area, topology.ring_blocks)
