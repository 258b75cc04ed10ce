"""The schemes a user chooses from, and the weights each gives to a surface whose topology is frozen.

What enters: positions and `Topology`. What leaves: `Geometry`, a record of every array that depends on the positions.
"""

import dataclasses
from typing import ClassVar, cast

import equinox as eqx
from jaxtyping import Float, Int

from ..tables import AnyArray, Block, ReverseWeights, Table, reverse_weights, slot_sum
from . import jets, paper
from .frames import boundary_frames, corner_conormals, tangent_frames, transport
from .ring import Lift, RingTopology, centroid_normals, inverted_normals, last_slot, lifted_ring, take_slots


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

    The same two steps as the paper (lift the ring to the tangent plane, differentiate scattered data there), with
    refined normals. Non-negative weights give diffusion a maximum principle and its matrix no eigenvalue with
    positive real part. Solutions are second order in the mesh size; the pointwise Laplacian is first order on
    irregular meshes.

    Attributes:
        lift: ``"chord"`` keeps the length of every edge; ``"projection"`` is the paper's lift. Chord is better but for
            the lowest modes of spheres.
    """

    lift: Lift = "chord"
    degree: ClassVar[int] = 2

    def __post_init__(self):
        if self.lift not in ("chord", "projection"):
            raise ValueError(f'Expected lift="chord" or lift="projection", found {self.lift!r}.')


@dataclasses.dataclass(frozen=True)
class Polynomial:
    """Polynomial fits of degree 3 or 4 on about twice the neighbours they need, for smooth solutions on good meshes.

    Normals, gradient and Hessian come from the same fit, and the Laplacian takes the metric of the fitted surface into
    account. Stationary solutions are of order 2 for degree 3 and 4 for degree 4. Weights of both signs: there is no
    maximum principle, and on bad meshes the Laplacian can have growing modes; `solve` looks for them before it steps.

    Attributes:
        degree: 3 or 4.
    """

    degree: int = 4
    lift: ClassVar[Lift] = "projection"

    def __post_init__(self):
        if self.degree not in (3, 4):
            raise ValueError(f"Expected degree 3 or 4, found {self.degree!r}. Degree 2 is ltl.Monotone().")


Scheme = Paper | Monotone | Polynomial
PerBlock = tuple[AnyArray, ...]


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
    num_loops: int = eqx.field(static=True, default=0)
    num_components: int = eqx.field(static=True, default=1)


class Geometry(eqx.Module):
    """Everything that depends on the positions. Weights hold one array (K, N) for each block of their table.

    Attributes:
        vertices: (V, 3).
        normals: (V, 3) unit normals.
        frames: (V, 2, 3) orthonormal tangent vectors; on a smooth boundary the second is the outward conormal.
        vertex_areas: (V,) a third of the area of the faces at each vertex.
        gradient_weights: two sets of weights on the jet table, for the two components in the frame.
        hessian_weights: three sets of weights on the jet table, for the components xx, xy, yy; None of `Paper`.
        divergence_weights: two sets of weights on the jet table, on the two components at the neighbours.
        divergence_centre: (V, 2) the weights on the vertex's own components that the difference form leaves over.
        laplacian_weights: weights on the diffusion table, or None.
        laplacian_reverse: the same weights in the order of the table's reverse, which reverse-mode derivatives read in
            every step; None where the table has no reverse.
        laplacian_residual: (V,) how far each Laplacian row is from consistent, relative, zero to rounding where it is;
            after moving the vertices it tells whether the frozen support still serves. None without such rows.
        conormals: (B, 2, 3) the outward conormals of both sides of each boundary vertex, equal where it is smooth.
        flux_weights: (B, 2) what a unit flux through each side adds to the Laplacian there; None without such rows.
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
    conormals: Float[AnyArray, "B 2 3"]
    flux_weights: Float[AnyArray, "B 2"] | None


# The sine of the angle between two conormals below which they count as one.
_PARALLEL = 0.1


def ring_normals(
    scheme: Scheme, vertices: Float[AnyArray, "V 3"], ring: Table, ring_blocks: tuple[RingTopology, ...]
) -> Float[AnyArray, "V 3"]:
    """The unit normals a scheme starts from: first order. `Paper` weighs faces by their centroids, and stays there."""
    mean = centroid_normals if isinstance(scheme, Paper) else inverted_normals
    return ring.map(lambda block, topology: mean(offsets(vertices, block), topology), ring_blocks)


def offsets(vertices: Float[AnyArray, "V 3"], block: Block) -> Float[AnyArray, "K N 3"]:
    """The neighbours of a block's rows, seen from their vertex; exactly zero in an empty slot.

    Of a vertex whose position is computed in the same jit, XLA may compute the position anew for each side of the
    difference and round it differently, and a slot that is nearly empty would count as a neighbour.
    """
    seen = block.neighbours(vertices) - block.centre(vertices)[None]
    return seen.__array_namespace__().where(block.is_used[..., None], seen, 0)


def fitted_normals(
    vertices: Float[AnyArray, "V 3"], normals: Float[AnyArray, "V 3"], jet: Table, degree: int
) -> Float[AnyArray, "V 3"]:
    """The given normals refined by the polynomial height fit on the jet table."""
    return jet.map(lambda block: jets.refined_normals(offsets(vertices, block), block.centre(normals), degree))


def vertex_frames(
    vertices: Float[AnyArray, "V 3"], normals: Float[AnyArray, "V 3"], topology: Topology
) -> tuple[Float[AnyArray, "V 2 3"], Float[AnyArray, "B 2 3"]]:
    """Tangent frames, and the outward conormals of both sides of the boundary vertices.

    On a smooth boundary the second vector of the frame is the conormal, at a corner it is that of the first side.
    """

    def frames(block, ring, kinds):
        to_neighbours = offsets(vertices, block)
        here = block.centre(normals)
        xp = here.__array_namespace__()
        sides = corner_conormals(here, to_neighbours[0], last_slot(to_neighbours, ring))
        smooth = boundary_frames(here, to_neighbours[0], last_slot(to_neighbours, ring))
        is_corner = (kinds >= jets.RIGHT_CORNER)[:, None, None]
        first = xp.stack([xp.cross(sides[:, 0], here), sides[:, 0]], axis=1)
        along = xp.where(is_corner, first, smooth)
        frame = xp.where((kinds == jets.INTERIOR)[:, None, None], tangent_frames(here), along)
        both = xp.where(is_corner, sides, xp.stack([smooth[:, 1]] * 2, axis=1))
        return xp.concatenate([frame, both], axis=1)

    kinds = tuple(block.centre(topology.kinds) for block in topology.ring.blocks)
    vectors = topology.ring.map(frames, topology.ring_blocks, kinds)
    return vectors[:, :2], vectors[topology.boundary, 2:]


def weigh(scheme: Scheme, vertices: Float[AnyArray, "V 3"], topology: Topology) -> Geometry:
    """All weights of a scheme, a pure function of the positions."""
    normals = ring_normals(scheme, vertices, topology.ring, topology.ring_blocks)
    if not isinstance(scheme, Paper):
        normals = fitted_normals(vertices, normals, topology.jet, scheme.degree)
    return weigh_in_frames(scheme, vertices, topology, normals, *vertex_frames(vertices, normals, topology))


def weigh_in_frames(
    scheme: Scheme,
    vertices: Float[AnyArray, "V 3"],
    topology: Topology,
    normals: Float[AnyArray, "V 3"],
    frames: Float[AnyArray, "V 2 3"],
    conormals: Float[AnyArray, "B 2 3"],
) -> Geometry:
    """The weights of a scheme for given normals and tangent frames; operators do not depend on the choice of frames."""
    xp = vertices.__array_namespace__()

    def jet(block, *ring):
        to_neighbours = offsets(vertices, block)
        lifted = lifted_ring(to_neighbours, block.centre(frames), scheme.lift)
        if isinstance(scheme, Paper):
            weights = xp.moveaxis(paper.gradient_weights(lifted, *ring), -1, 0)
        else:
            weights = jets.jet_weights(lifted, scheme.degree)
        if isinstance(scheme, Polynomial):
            weights = jets.covariant(jets.height_jet(to_neighbours, block.centre(normals), weights), weights)
        # The divergence transports the neighbour's vector here and takes it against the weights; the same number is
        # the neighbour's own components against the weights transported there.
        ambient = xp.einsum("akn,nac->knc", weights[:2], block.centre(frames))
        there = transport(block.centre(normals)[None], block.neighbours(normals), ambient)
        return tuple(weights), tuple(xp.einsum("knc,knac->akn", there, block.neighbours(frames)))

    per_block = topology.jet.each(jet, *([topology.ring_blocks] if isinstance(scheme, Paper) else []))
    x, y, *second = zip(*(weights for weights, _ in per_block), strict=True)
    gradient = (x, y)
    along_x, along_y = zip(*(weights for _, weights in per_block), strict=True)
    divergence = (along_x, along_y)
    centre = [slot_sum(topology.jet, d) - slot_sum(topology.jet, g) for d, g in zip(divergence, gradient, strict=True)]
    laplacian, backwards, residual, flux = None, None, None, None
    if topology.diffusion is not None:
        laplacian, residual, first = diffusion_rows(
            cast(Monotone | Polynomial, scheme), vertices, normals, frames, topology.kinds, topology.diffusion
        )
        backwards = reverse_weights(topology.diffusion, laplacian)
        flux = _flux_weights(first[topology.boundary], frames[topology.boundary], conormals)
    return Geometry(
        vertices=vertices,
        normals=normals,
        frames=frames,
        vertex_areas=_vertex_areas(vertices, topology),
        gradient_weights=gradient,
        hessian_weights=(second[0], second[1], second[2]) if second else None,
        divergence_weights=divergence,
        divergence_centre=xp.stack(centre, axis=-1),
        laplacian_weights=laplacian,
        laplacian_reverse=backwards,
        laplacian_residual=residual,
        conormals=conormals,
        flux_weights=flux,
    )


def diffusion_rows(
    scheme: Monotone | Polynomial,
    vertices: Float[AnyArray, "V 3"],
    normals: Float[AnyArray, "V 3"],
    frames: Float[AnyArray, "V 2 3"],
    kinds: Int[AnyArray, " V"],
    table: Table,
) -> tuple[PerBlock, Float[AnyArray, " V"], Float[AnyArray, "V 2"]]:
    """The Laplacian weights on a table, the relative moment residual of every row, and its first moments."""

    def rows(block):
        to_neighbours = offsets(vertices, block)
        lifted = lifted_ring(to_neighbours, block.centre(frames), scheme.lift)
        xp = lifted.__array_namespace__()
        targets = xp.asarray(jets.LAPLACIAN, dtype=lifted.dtype)[..., None]
        if isinstance(scheme, Polynomial):
            weights = jets.jet_weights(lifted, scheme.degree)
            targets = jets.laplacian_targets(jets.height_jet(to_neighbours, block.centre(normals), weights))
        c, residual = jets.operator_weights(
            lifted, block.centre(kinds), targets, scheme.degree, nonnegative=isinstance(scheme, Monotone)
        )
        return c[0], residual[0], xp.einsum("kn,kna->an", c[0], lifted)

    weights, residuals, first = zip(*table.each(rows), strict=True)
    return weights, table.rows_from(list(residuals)), table.rows_from([moments.T for moments in first])


def _flux_weights(first, frames, conormals):
    """The weights (B, 2) of the fluxes through both sides, from the first moments (B, 2) of the Laplacian rows.

    The rows leave ``-first . grad u`` over. On a smooth boundary the gradient's part along it has no weight; at a
    corner the gradient g solves conormal . g = flux for both sides.
    """
    xp = first.__array_namespace__()
    a, b = xp.moveaxis(xp.einsum("bsc,bac->bsa", conormals, frames), 1, 0)
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
