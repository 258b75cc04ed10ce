"""The schemes a user chooses from, and the weights each gives to a surface whose topology is frozen.

What enters: positions and `Topology`. What leaves: `Geometry`, a record of every array that depends on the positions.
"""

import dataclasses
from typing import ClassVar

import equinox as eqx
from jaxtyping import Bool, Float, Int

from ..tables import AnyArray, Block, Table, slot_sum
from . import paper, quadratic
from .frames import boundary_frames, tangent_frames, transport
from .ring import Lift, RingTopology, centroid_normals, last_slot, lifted_ring, take_slots


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
    irregular meshes. On a boundary the rows are those of a vanishing normal derivative (homogeneous Neumann).

    Attributes:
        lift: ``"chord"`` keeps the length of every edge; ``"projection"`` is the paper's lift. Chord is better but for
            the lowest modes of spheres.
    """

    lift: Lift = "chord"

    def __post_init__(self):
        if self.lift not in ("chord", "projection"):
            raise ValueError(f'Expected lift="chord" or lift="projection", found {self.lift!r}.')


Scheme = Paper | Monotone
PerBlock = tuple[AnyArray, ...]


class Topology(eqx.Module):
    """What does not change when vertices move.

    Attributes:
        faces: (F, 3) the triangles.
        ring: the one-rings, counter-clockwise.
        ring_blocks: for every block of ``ring``, which slots hold neighbours and faces.
        is_boundary: (V,) whether the vertex lies on the boundary.
        jet: the neighbours of the gradient's fit.
        diffusion: the neighbours of the Laplacian; None where it is the divergence of the gradient.
    """

    faces: Int[AnyArray, "F 3"]
    ring: Table
    ring_blocks: tuple[RingTopology, ...]
    is_boundary: Bool[AnyArray, " V"]
    jet: Table
    diffusion: Table | None


class Geometry(eqx.Module):
    """Everything that depends on the positions. Weights hold one array (K, N) for each block of their table.

    Attributes:
        vertices: (V, 3).
        normals: (V, 3) unit normals.
        frames: (V, 2, 3) orthonormal tangent vectors; on the boundary the second is the outward conormal.
        vertex_areas: (V,) a third of the area of the faces at each vertex.
        gradient_weights: two sets of weights on the jet table, for the two components in the frame.
        divergence_weights: two sets of weights on the jet table, on the two components at the neighbours.
        divergence_centre: (V, 2) the weights on the vertex's own components that the difference form leaves over.
        laplacian_weights: weights on the diffusion table, or None.
        laplacian_residual: (V,) how far each Laplacian row is from consistent, relative, zero to rounding where it is;
            after moving the vertices it tells whether the frozen support still serves. None without such rows.
    """

    vertices: Float[AnyArray, "V 3"]
    normals: Float[AnyArray, "V 3"]
    frames: Float[AnyArray, "V 2 3"]
    vertex_areas: Float[AnyArray, " V"]
    gradient_weights: tuple[PerBlock, PerBlock]
    divergence_weights: tuple[PerBlock, PerBlock]
    divergence_centre: Float[AnyArray, "V 2"]
    laplacian_weights: PerBlock | None
    laplacian_residual: Float[AnyArray, " V"] | None


def ring_normals(
    vertices: Float[AnyArray, "V 3"], ring: Table, ring_blocks: tuple[RingTopology, ...]
) -> Float[AnyArray, "V 3"]:
    """The paper's centroid-weighted unit normals."""
    return ring.map(lambda block, topology: centroid_normals(offsets(vertices, block), topology), ring_blocks)


def offsets(vertices: Float[AnyArray, "V 3"], block: Block) -> Float[AnyArray, "K N 3"]:
    """The neighbours of a block's rows, seen from their vertex."""
    return block.neighbours(vertices) - block.centre(vertices)[None]


def fitted_normals(
    vertices: Float[AnyArray, "V 3"], normals: Float[AnyArray, "V 3"], jet: Table
) -> Float[AnyArray, "V 3"]:
    """The given normals refined by the quadratic height fit on the jet table."""
    return jet.map(lambda block: quadratic.refined_normals(offsets(vertices, block), block.centre(normals)))


def vertex_frames(
    vertices: Float[AnyArray, "V 3"], normals: Float[AnyArray, "V 3"], topology: Topology
) -> Float[AnyArray, "V 2 3"]:
    """Tangent frames; at a boundary vertex the second vector is the outward conormal."""

    xp = vertices.__array_namespace__()

    def frames(block, ring):
        to_neighbours = offsets(vertices, block)
        here = block.centre(normals)
        along = boundary_frames(here, to_neighbours[0], last_slot(to_neighbours, ring))
        return xp.where(ring.is_boundary[:, None, None], along, tangent_frames(here))

    return topology.ring.map(frames, topology.ring_blocks)


def weigh(scheme: Scheme, vertices: Float[AnyArray, "V 3"], topology: Topology) -> Geometry:
    """All weights of a scheme, a pure function of the positions."""
    normals = ring_normals(vertices, topology.ring, topology.ring_blocks)
    if isinstance(scheme, Monotone):
        normals = fitted_normals(vertices, normals, topology.jet)
    return weigh_in_frames(scheme, vertices, topology, normals, vertex_frames(vertices, normals, topology))


def weigh_in_frames(
    scheme: Scheme,
    vertices: Float[AnyArray, "V 3"],
    topology: Topology,
    normals: Float[AnyArray, "V 3"],
    frames: Float[AnyArray, "V 2 3"],
) -> Geometry:
    """The weights of a scheme for given normals and tangent frames; operators do not depend on the choice of frames."""
    xp = vertices.__array_namespace__()
    gradient_weights, divergence_weights = [], []
    for position, block in enumerate(topology.jet.blocks):
        lifted = lifted_ring(offsets(vertices, block), block.centre(frames), scheme.lift)
        if isinstance(scheme, Paper):
            weights = paper.gradient_weights(lifted, topology.ring_blocks[position])
        else:
            weights = quadratic.gradient_weights(lifted)
        # The divergence transports the neighbour's vector here and takes it against the weights; the same number is
        # the neighbour's own components against the weights transported there.
        ambient = xp.einsum("kna,nac->knc", weights, block.centre(frames))
        there = transport(block.centre(normals)[None], block.neighbours(normals), ambient)
        gradient_weights.append(weights)
        divergence_weights.append(xp.einsum("knc,knac->kna", there, block.neighbours(frames)))
    gradient, divergence = _by_component(gradient_weights), _by_component(divergence_weights)
    centre = [slot_sum(topology.jet, d) - slot_sum(topology.jet, g) for d, g in zip(divergence, gradient, strict=True)]
    laplacian, residual = None, None
    if topology.diffusion is not None:
        laplacian, residual = diffusion_rows(scheme.lift, vertices, frames, topology.is_boundary, topology.diffusion)
    return Geometry(
        vertices=vertices,
        normals=normals,
        frames=frames,
        vertex_areas=_vertex_areas(vertices, topology),
        gradient_weights=gradient,
        divergence_weights=divergence,
        divergence_centre=xp.stack(centre, axis=-1),
        laplacian_weights=laplacian,
        laplacian_residual=residual,
    )


def diffusion_rows(
    lift: Lift,
    vertices: Float[AnyArray, "V 3"],
    frames: Float[AnyArray, "V 2 3"],
    is_boundary: Bool[AnyArray, " V"],
    table: Table,
) -> tuple[PerBlock, Float[AnyArray, " V"]]:
    """The non-negative Laplacian weights on a table, and the relative moment residual of every row."""
    rows = []
    for block in table.blocks:
        lifted = lifted_ring(offsets(vertices, block), block.centre(frames), lift)
        rows.append(quadratic.laplacian_weights(lifted, block.centre(is_boundary)))
    weights, residuals = zip(*rows, strict=True)
    return weights, table.rows_from(list(residuals))


def _vertex_areas(vertices, topology):
    xp = vertices.__array_namespace__()

    def area(block, ring):
        to_neighbours = offsets(vertices, block)
        following = take_slots(to_neighbours, ring.following(to_neighbours.shape[0]))
        squared = xp.sum(xp.cross(to_neighbours, following) ** 2, axis=-1)
        return xp.sum(xp.where(squared > 0, xp.sqrt(xp.where(squared > 0, squared, 1)), 0), axis=0) / 6

    return topology.ring.map(area, topology.ring_blocks)


def _by_component(weights: list[Float[AnyArray, "_ _ 2"]]) -> tuple[PerBlock, PerBlock]:
    return tuple(w[..., 0] for w in weights), tuple(w[..., 1] for w in weights)
