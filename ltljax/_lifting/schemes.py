"""The schemes a user chooses from, and the weights each gives to a surface whose topology is frozen.

What enters: positions and `Topology`. What leaves: `Geometry`, a record of every array that depends on the positions.
"""

import dataclasses
from typing import ClassVar, Literal

import equinox as eqx
from jaxtyping import Bool, Float, Int

from .._tables import AnyArray, ReverseWeights, Table, reverse_weights, slot_sum
from . import intrinsic, jets, paper
from .frames import boundary_frames, corner_conormals, tangent_frames
from .intrinsic import CotangentRows, Directions, Paths, RingAngles, Triangulation
from .layout import PerBlock, Places, rows_last
from .ring import (
    Lift,
    RingTopology,
    angle_weighted_normals,
    centroid_normals,
    inverted_normals,
    last_slot,
    offsets,
    take_slots,
)


@dataclasses.dataclass(frozen=True)
class Paper:
    """The published method: averaged affine gradients on the one-ring, and a Laplacian that composes them.

    Exact to Chen, Chi and Wu (arXiv 0907.1817) and good on regular meshes. Know before you use it for diffusion: its
    Laplacian does not converge pointwise on irregular meshes, does not see modes that alternate from row to row, and
    has eigenvalues with positive real part, so that diffusion can grow. `Monotone` has none of these faults.
    """

    lift: ClassVar[Lift] = "projection"


@dataclasses.dataclass(frozen=True)
class Monotone:
    """The default: the quadratic fit on the lifted ring, on supports that keep every Laplacian weight non-negative.

    The same two steps as the paper (lift the ring to the tangent plane, differentiate scattered data there).
    Non-negative weights give diffusion a maximum principle and its matrix no eigenvalue with positive real part.
    Solutions are second order in the mesh size; the pointwise Laplacian is first order on irregular meshes. Where no
    consistent non-negative row exists, the cotangent row of the intrinsic Delaunay triangulation takes its place.

    Attributes:
        lift: how the ring is laid into the plane. ``"intrinsic"`` unfolds it by edge lengths, so that bending the
            surface, even along a crease, changes nothing. ``"chord"`` projects the ring to the tangent plane and keeps
            the length of every edge; ``"projection"`` is the paper's lift. These two are accurate on smooth surfaces
            only; chord is the better of the two, except for the lowest modes of spheres.
    """

    lift: Literal["intrinsic", "chord", "projection"] = "intrinsic"
    degree: ClassVar[int] = 2

    def __post_init__(self):
        if self.lift not in ("intrinsic", "chord", "projection"):
            raise ValueError(f'Expected lift="intrinsic", lift="chord" or lift="projection", found {self.lift!r}.')


@dataclasses.dataclass(frozen=True)
class Polynomial:
    """Polynomial fits of degree 3 or 4 on about twice the neighbours they need, for smooth solutions on good meshes.

    Normals, gradient and Hessian come from the same fit, and the Laplacian takes the metric of the fitted surface into
    account. Stationary solutions are of order 2 for degree 3 and 4 for degree 4.

    Degree 4 pays where normals turn by less than a radian over the neighbours of a fit. For Poisson's equation on a
    jittered torus with radii 2 and 1 its error is that of `Monotone` at 800 vertices, 0.4 of it at 1,600 and a tenth
    at 6,300; with bumps on the torus it is 1.6 times that of `Monotone` even at 6,300. On coarser meshes
    `CoarseMeshWarning` says so. Degree 3 has twice the error of `Monotone` there at every size: it is for gradients and
    curvature.

    A fit that would cross a crease is made in the intrinsic chart of the vertex, which is exact where both sides are
    flat and first order where they are curved. Weights have both signs, so that there is no maximum principle, and on
    bad meshes the Laplacian can have growing modes; `solve` looks for them before it steps.

    Attributes:
        degree: 3 or 4.
    """

    degree: int = 4
    lift: ClassVar[Lift] = "projection"

    def __post_init__(self):
        if self.degree not in (3, 4):
            raise ValueError(f"Expected degree 3 or 4, found {self.degree!r}. Degree 2 is ltl.Monotone().")


Scheme = Paper | Monotone | Polynomial


class Topology(eqx.Module):
    """What does not change when vertices move.

    Attributes:
        faces: (F, 3) the triangles.
        ring: the one-rings, counter-clockwise.
        ring_blocks: for every block of ``ring``, which slots hold neighbours and faces.
        kinds: (V,) `INTERIOR`, `SMOOTH` boundary, `RIGHT_CORNER` or `OTHER_CORNER`, see `lifting.jets`.
        boundary: (B,) the vertices on the boundary, loop by loop.
        loops: (B,) the number of the boundary loop each of them lies on.
        components: (V,) the connected component of each vertex.
        num_loops: how many loops there are.
        num_components: how many components there are.
        jet: the neighbours of the gradient's fit.
        diffusion: the neighbours of the Laplacian; None where it is the divergence of the gradient.
        jet_paths: for each block of ``jet`` the half-edges that lead to its neighbours; None where all rows are laid
            out in space.
        diffusion_paths: the same for ``diffusion``.
        cotangent_rows: for each block of ``diffusion`` its rows that are those of the cotangent Laplacian, or None.
        triangulation: the intrinsic Delaunay triangulation; None where all rows are laid out in space.
        is_extrinsic: (V,) the rows that are laid out in space; None where all are laid out one way.
        is_creased: (V,) the vertices whose neighbours lie across a crease, so that no height fit is made there; None
            where there is none.
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
    """Everything that depends on the positions. Weights hold one array (K, N) for each block of their table.

    Attributes:
        vertices: (V, 3).
        normals: (V, 3) unit normals.
        frames: (V, 2, 3) orthonormal tangent vectors, turned like the chart of the vertex; on a smooth boundary the
            second is the outward conormal.
        vertex_areas: (V,) a third of the area of the faces at each vertex.
        gradient_weights: two sets of weights on the jet table, for the two components in the frame.
        hessian_weights: three sets of weights on the jet table, for the components xx, xy, yy; None of `Paper`.
        divergence_weights: two sets of weights on the jet table, on the two components at the neighbours.
        divergence_centre: (V, 2) the weights on the vertex's own components that the difference form leaves over.
        laplacian_weights: weights on the diffusion table, or None.
        laplacian_reverse: the same weights in the order of the table's reverse, which reverse-mode derivatives read in
            every step; None where the table has no reverse.
        laplacian_residual: (V,) how far each Laplacian row is from consistent, relative, zero to rounding where it is
            and zero at cotangent rows. After the vertices have moved it tells whether the frozen support still serves.
            None without such rows.
        directions: lengths and directions in the charts of the vertices; None where all rows are laid out in space.
        conormals: (B, 2, 3) the outward conormals of both sides of each boundary vertex, equal where it is smooth.
        flux_weights: (B, 2) what a unit flux through each side adds to the Laplacian there; None without such rows.
        spectral_width: how far the Laplacian's eigenvalues lie off the real axis, where that was measured.
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


# The sine of the angle between two conormals below which they count as one.
_PARALLEL = 0.1


def ring_normals(
    scheme: Scheme, vertices: Float[AnyArray, "V 3"], ring: Table, ring_blocks: tuple[RingTopology, ...]
) -> Float[AnyArray, "V 3"]:
    """The unit normals a scheme starts from: first order. `Paper` weighs faces by their centroids, and stays there."""
    mean = centroid_normals if isinstance(scheme, Paper) else inverted_normals
    return ring.map(lambda block, topology: mean(offsets(vertices, block), topology), ring_blocks)


def surface_normals(scheme: Scheme, vertices: Float[AnyArray, "V 3"], topology: Topology) -> Float[AnyArray, "V 3"]:
    """The unit normals of a scheme: those of the paper, or else refined by the height fit of its degree.

    Where the fit's neighbours lie across a crease, the mean of the face normals weighted by angle: on the crease it
    halves the angle between both sides, whatever the mesh.
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
    """Tangent frames, and the outward conormals of both sides of the boundary vertices.

    On a smooth boundary the second vector of the frame is the conormal, at a corner it is that of the first side.
    Inside, where the angles of the rings are given, the frame is turned to where the ring in the chart comes closest to
    the ring in the tangent plane.
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
    # `map` hands a batch of rows on with what belongs to them along the last axis.
    chart = [] if angles is None else [angles.corners, tuple(b.centre(angles.sums) for b in topology.ring.blocks)]
    vectors = topology.ring.map(frames, topology.ring_blocks, kinds, *chart)
    return vectors[:, :2], vectors[topology.boundary, 2:]


def places(scheme: Scheme, topology: Topology, geometry: Geometry) -> Places:
    """What lays out the neighbours on a surface."""
    return places_in(scheme, topology, geometry.vertices, geometry.normals, geometry.frames, geometry.directions)


def places_in(
    scheme: Scheme,
    topology: Topology,
    vertices: Float[AnyArray, "V 3"],
    normals: Float[AnyArray, "V 3"],
    frames: Float[AnyArray, "V 2 3"],
    directions: Directions | None,
) -> Places:
    """What lays out neighbours under a scheme, for given normals, frames and directions."""
    lift = "projection" if scheme.lift == "projection" else "chord"
    transport = "paper" if isinstance(scheme, Paper) else "shortest"
    return Places(vertices, normals, frames, directions, topology.is_creased, lift, transport)


def weigh(
    scheme: Scheme, vertices: Float[AnyArray, "V 3"], topology: Topology, angles: RingAngles | None = None
) -> Geometry:
    """All weights of a scheme, a pure function of the positions.

    Angles of the rings at these positions may be handed in, which saves computing them again.
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

    Operators do not depend on the choice of frames, if the charts are turned with them.
    """
    xp = vertices.__array_namespace__()
    laying = places_in(scheme, topology, vertices, normals, frames, directions)
    lifted = laying.lifted(topology.jet, topology.jet_paths)
    gradient, second = _jet_rows(scheme, vertices, normals, topology, lifted)
    # The divergence takes the neighbour's components, turned into the frame of the vertex, against the weights.
    x, y = gradient
    turns = laying.turns(topology.jet, topology.jet_paths)
    along = [
        tuple(wx * turn[..., 0] + wy * turn[..., 1] for wx, wy, turn in zip(x, y, turns, strict=True)),
        tuple(wy * turn[..., 0] - wx * turn[..., 1] for wx, wy, turn in zip(x, y, turns, strict=True)),
    ]
    centre = [slot_sum(topology.jet, d) - slot_sum(topology.jet, g) for d, g in zip(along, gradient, strict=True)]
    laplacian, backwards, residual, flux = None, None, None, None
    if not isinstance(scheme, Paper) and topology.diffusion is not None:
        laplacian, residual, first, areas = diffusion_rows(scheme, laying, topology)
        backwards = reverse_weights(topology.diffusion, laplacian)
        flux = flux_weights(first[topology.boundary], conormals_in_frame(topology, frames, conormals, directions))
        if areas is not None:
            # A cotangent row takes half of each side's flux.
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
        laplacian_reverse=backwards,
        laplacian_residual=residual,
        directions=directions,
        conormals=conormals,
        flux_weights=flux,
    )


def _jet_rows(
    scheme: Scheme, vertices: AnyArray, normals: AnyArray, topology: Topology, lifted: PerBlock
) -> tuple[tuple[PerBlock, PerBlock], tuple[PerBlock, PerBlock, PerBlock] | None]:
    """The weights of the two first and the three second derivatives on the jet table; `Paper` has no second ones."""
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
    """The jet of the surface's height over the tangent planes of a block's rows; zero for those laid out in charts."""
    height = jets.height_jet(offsets(vertices, block), block.centre(normals), weights)
    if topology.triangulation is None:
        return height
    assert topology.is_extrinsic is not None
    return height.__array_namespace__().where(block.centre(topology.is_extrinsic)[None], height, 0)


def diffusion_rows(
    scheme: Monotone | Polynomial, laying: Places, topology: Topology
) -> tuple[PerBlock, Float[AnyArray, " V"], Float[AnyArray, "V 2"], Float[AnyArray, " V"] | None]:
    """The Laplacian weights on their table, the relative moment residual of every row, its first moments, and the dual
    areas of the cotangent rows, zero at other rows."""
    table = topology.diffusion
    assert table is not None
    lifted = laying.lifted(table, topology.diffusion_paths)

    def rows(block, lifted):
        xp = lifted.__array_namespace__()
        lifted = xp.moveaxis(lifted, -1, 1)
        targets = xp.asarray(jets.LAPLACIAN, dtype=lifted.dtype)[..., None]
        if isinstance(scheme, Polynomial):
            weights = jets.jet_weights(lifted, scheme.degree)
            targets = jets.laplacian_targets(_height(laying.vertices, laying.normals, topology, block, weights))
        c, residual = jets.operator_weights(
            lifted, block.centre(topology.kinds), targets, scheme.degree, nonnegative=isinstance(scheme, Monotone)
        )
        return c[0], residual[0]

    weights, residuals = zip(*table.each(rows, rows_last(lifted)), strict=True)
    areas = None
    if topology.cotangent_rows is not None and laying.directions is not None:
        weights, residuals, areas = _with_cotangent_rows(topology.cotangent_rows, laying.directions, weights, residuals)
        areas = table.rows_from(list(areas))
    xp = laying.vertices.__array_namespace__()
    first = [xp.einsum("kn,kna->na", c, places) for c, places in zip(weights, lifted, strict=True)]
    return weights, table.rows_from(list(residuals)), table.rows_from(first), areas


def _with_cotangent_rows(
    rows: tuple[CotangentRows, ...], directions: Directions, weights: PerBlock, residuals: PerBlock
) -> tuple[PerBlock, PerBlock, PerBlock]:
    """Weights and residuals with those of the cotangent rows in their places, and the areas of these rows."""
    blocks = []
    for row, weight, residual in zip(rows, weights, residuals, strict=True):
        cotangent, area = intrinsic.cotangent_weights(directions, row)
        none = 0 * residual[None]
        blocks.append(
            (
                intrinsic.with_columns(weight, row.columns, cotangent),
                intrinsic.with_columns(residual[None], row.columns, 0 * area[None])[0],
                intrinsic.with_columns(none, row.columns, area[None])[0],
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
    """The lengths (B, 2) of the edges to the next and the previous vertex along the boundary."""
    xp = vertices.__array_namespace__()

    def ends(block, ring):
        seen = offsets(vertices, block)
        return xp.stack([seen[0], last_slot(seen, ring)], axis=1)

    both = topology.ring.map(ends, topology.ring_blocks)[topology.boundary]
    return xp.sqrt(xp.sum(both**2, axis=-1))


def flux_weights(first: Float[AnyArray, "B 2"], conormals: Float[AnyArray, "B 2 2"]) -> Float[AnyArray, "B 2"]:
    """The weights (B, 2) of the fluxes through both sides, from what the rows leave of the first moments (B, 2) and
    the conormals (B, 2, 2) of the sides in the frame.

    The rows leave ``-first . grad u`` over. On a smooth boundary the gradient's part along it has no weight; at a
    corner the gradient g solves conormal . g = flux for both sides.
    """
    xp = first.__array_namespace__()
    a, b = xp.moveaxis(conormals, 1, 0)
    determinant = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    is_corner = xp.abs(determinant) > _PARALLEL
    safe = xp.where(is_corner, determinant, 1)
    corner = xp.stack(
        [first[:, 1] * b[:, 0] - first[:, 0] * b[:, 1], first[:, 0] * a[:, 1] - first[:, 1] * a[:, 0]], axis=-1
    )
    smooth = -first[:, 1:] / 2
    return xp.where(is_corner[:, None], corner / safe[:, None], smooth)


def _vertex_areas(vertices, topology):
    xp = vertices.__array_namespace__()

    def area(block, ring):
        to_neighbours = offsets(vertices, block)
        following = take_slots(to_neighbours, ring.following(to_neighbours.shape[0]))
        squared = xp.sum(xp.cross(to_neighbours, following) ** 2, axis=-1)
        return xp.sum(xp.where(squared > 0, xp.sqrt(xp.where(squared > 0, squared, 1)), 0), axis=0) / 6

    return topology.ring.map(area, topology.ring_blocks)
