"""From a mesh to the arrays of a surface.

What enters: a checked `Mesh` and a scheme. What leaves: its topology, with neighbours chosen once and then frozen; its
geometry, weighed in float64 and cast last; and a report. This is the only place where host meets device.
"""

import dataclasses
import functools
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._base.progress import Laps, watched
from .._lifting.frames import tangent_frames
from .._lifting.intrinsic import RingAngles
from .._lifting.paper import dropped_faces
from .._lifting.ring import RingTopology, lifted_ring, offsets
from .._lifting.schemes import Paper, Scheme
from .._lifting.weighing import Geometry, Topology, ring_normals, weigh
from .._mesh import Mesh, far_middle, one_rings
from .._tables import Table, build_table, reversible
from .creases import boundary_kinds
from .neighbours import Watching, choose_neighbours
from .report import SurfaceReport, warn_of_coarse_mesh, warn_of_rows


class FarFromOriginWarning(UserWarning):
    """The mesh lies far from the origin, so positions of its surface are relative to ``surface.centre``."""


def build(
    mesh: Mesh, scheme: Scheme, dtype: Any, progress: bool, differentiable: bool, stacklevel: int
) -> tuple[Topology, Geometry, jax.Array, SurfaceReport]:
    """The parts of the surface of a mesh, on the device: topology, geometry, the centre in two parts, and the report.

    See `Surface.from_mesh` for the arguments, errors and warnings; ``stacklevel`` is that of its caller.
    """
    dtype = float_dtype(dtype)
    laps = Laps()
    topology, angles, report = freeze(mesh, scheme, functools.partial(watched, progress=progress), laps)
    if differentiable:
        topology = _with_reverse(topology)
        laps.end("reversed tables")
    centre = far_middle(mesh.vertices)
    # NumPy on the host always has float64, and compiles nothing for the size of the mesh.
    with np.errstate(over="ignore"):  # `_is_in_range` finds casts that overflow
        geometry = weigh(scheme, mesh.vertices - centre, topology, angles)
        geometry = jax.tree.map(lambda leaf: leaf.astype(dtype), geometry)
    if not _is_in_range(geometry):
        raise ValueError(
            f"Weights scale with 1 / length^2, and at a mesh size of {mesh.mesh_size:.3g} they leave the range of "
            f"{jnp.dtype(dtype).name}. Rescale the mesh (mesh.scaled(factor)) or use float64."
        )
    warn_of_rows(report, scheme, stacklevel + 1)
    warn_of_coarse_mesh(topology, geometry.normals, scheme, stacklevel + 1)
    if centre.any():
        warnings.warn(
            f"The mesh lies far from the origin, so positions of its surface are relative to surface.centre, "
            f"{as_text(centre)}.",
            FarFromOriginWarning,
            stacklevel=stacklevel + 1,
        )
    coarse = centre.astype(dtype)
    centre_parts = np.stack([coarse, (centre - coarse).astype(dtype)])
    topology, geometry, centre_parts = jax.device_put((topology, geometry, centre_parts))
    laps.end("weights")
    return topology, geometry, centre_parts, dataclasses.replace(report, seconds=laps.seconds)


def freeze(
    mesh: Mesh, scheme: Scheme, watch: Watching, laps: Laps
) -> tuple[Topology, RingAngles | None, SurfaceReport]:
    """The topology of a mesh under a scheme, in NumPy: its rings, and neighbours chosen from the positions.

    Args:
        mesh: the mesh.
        scheme: the scheme that the neighbours are chosen for.
        watch: a function from the name of a task to the function that reports its progress.
        laps: the stopwatch of the construction.

    Returns:
        The topology; the ring angles, or None if no row is laid out in a chart; and the report.
    """
    rings = one_rings(mesh.faces, mesh.num_vertices)
    ring = build_table(rings.offsets, rings.neighbours)
    ring_blocks = _ring_blocks(ring, rings.valences, mesh.boundary_vertices)
    loops = mesh.boundary_loops
    topology = Topology(
        faces=mesh.faces.astype(np.int32),
        ring=ring,
        ring_blocks=ring_blocks,
        kinds=boundary_kinds(mesh, ring, ring_blocks),
        boundary=np.concatenate([np.zeros(0, np.int32), *loops]),
        loops=np.repeat(np.arange(len(loops), dtype=np.int32), [len(loop) for loop in loops]),
        jet=ring,
        diffusion=None,
        components=mesh.components,
        num_loops=len(loops),
        num_components=int(mesh.components.max()) + 1,
    )
    laps.end("rings")
    if isinstance(scheme, Paper):
        return topology, None, SurfaceReport(dropped_faces=_dropped_faces(mesh, topology))
    return choose_neighbours(mesh, rings, topology, scheme, watch, laps)


def float_dtype(dtype: Any) -> Any:
    """The float type of a surface: float32 or float64, and JAX's default float for None.

    Raises:
        ValueError: the dtype is not one of them, or is float64 while JAX has 64-bit numbers switched off.
    """
    if dtype is None:
        return jnp.zeros(0).dtype
    dtype = jnp.dtype(dtype)
    if dtype not in (jnp.float32, jnp.float64):
        raise ValueError(f"Expected dtype float32 or float64, found {dtype}.")
    if dtype == jnp.float64 and not jax.config.read("jax_enable_x64"):
        raise ValueError(
            'dtype float64 needs 64-bit numbers in JAX: call jax.config.update("jax_enable_x64", True) first.'
        )
    return dtype


def as_text(point: np.ndarray) -> str:
    """A point as text, with six digits."""
    return f"({', '.join(f'{x:.6g}' for x in point)})"


def _is_in_range(geometry: Geometry) -> bool:
    """Whether all numbers are finite and none of the kinds of weights has become subnormal."""
    # All blocks and components of a kind are checked together, since one component may vanish.
    kinds = (geometry.laplacian_weights, geometry.hessian_weights, geometry.vertex_areas)
    is_finite = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(geometry))
    largest = [max(np.abs(leaf).max(initial=0) for leaf in jax.tree.leaves(kind)) for kind in kinds if kind is not None]
    precision = np.finfo(geometry.vertices.dtype)
    return is_finite and all(size > precision.tiny / precision.eps for size in largest)


def _with_reverse(topology: Topology) -> Topology:
    """The topology with the reverse of the tables that operators sum over."""
    jet = reversible(topology.jet)
    diffusion = topology.diffusion
    if diffusion is topology.jet:
        diffusion = jet
    elif diffusion is not None:
        diffusion = reversible(diffusion)
    return dataclasses.replace(topology, jet=jet, diffusion=diffusion)


def _dropped_faces(mesh: Mesh, topology: Topology) -> np.ndarray:
    """The number of faces at each vertex that the lift of `Paper` makes degenerate, (V,)."""
    frames = tangent_frames(ring_normals(Paper(), mesh.vertices, topology.ring, topology.ring_blocks))

    def dropped(block, ring):
        lifted = lifted_ring(offsets(mesh.vertices, block), block.centre(frames), "projection")
        return dropped_faces(lifted, ring)

    return topology.ring.map(dropped, topology.ring_blocks)


def _ring_blocks(ring: Table, valences: np.ndarray, is_boundary: np.ndarray) -> tuple[RingTopology, ...]:
    """The ring topology of every block; rows that belong to a tail block are empty in the bulk."""
    blocks = []
    for block in ring.blocks:
        rows = np.arange(len(valences)) if block.rows is None else block.rows
        own = np.where(valences[rows] <= block.indices.shape[0], valences[rows], 0)
        blocks.append(RingTopology(own.astype(np.int32), is_boundary[rows]))
    return tuple(blocks)
