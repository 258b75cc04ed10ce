"""`Surface`: the pytree a user holds. The only place where host meets device.

What enters: a checked `Mesh` and a scheme. What leaves: topology tables and weights as JAX arrays; from here on
everything is a pure function of them.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .lifting import support
from .lifting.frames import tangent_frames
from .lifting.paper import dropped_faces
from .lifting.ring import RingTopology, lifted_ring
from .lifting.schemes import (
    Geometry,
    Monotone,
    Paper,
    Scheme,
    Topology,
    diffusion_rows,
    fitted_normals,
    offsets,
    ring_normals,
    vertex_frames,
    weigh,
)
from .mesh import Mesh, OneRings, k_ring, one_rings
from .tables import AnyArray, Table, build_table


@dataclasses.dataclass(frozen=True, eq=False)
class SurfaceReport:
    """What the construction of a surface found.

    Attributes:
        dropped_faces: (V,) of `Paper`: faces at each vertex that its lift makes degenerate, which have no part in the
            mean; else None.
        wide_gradient_rows: of `Monotone`: vertices whose one-ring does not determine a quadratic, so that the gradient
            uses wider rings; else None.
        rings: (V,) of `Monotone`: number of rings each Laplacian row was chosen from; else None.
        residual: (V,) of `Monotone`: relative moment residual of each Laplacian row; else None.
        inconsistent: vertices without a consistent non-negative row. Diffusion is stable there, but not accurate.
    """

    dropped_faces: np.ndarray | None = None
    wide_gradient_rows: np.ndarray | None = None
    rings: np.ndarray | None = None
    residual: np.ndarray | None = None
    inconsistent: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))

    # A report decides no computation, so surfaces that differ only in it share compiled code.
    def __eq__(self, other):
        return isinstance(other, SurfaceReport)

    def __hash__(self):
        return hash(SurfaceReport)

    def __str__(self):
        lines = []
        if self.dropped_faces is not None:
            lines.append(("degenerate lifted faces", f"{self.dropped_faces.sum()}"))
        if self.wide_gradient_rows is not None:
            lines.append(("gradient rows wider than one ring", f"{len(self.wide_gradient_rows)}"))
        if self.rings is not None and self.residual is not None:
            lines += [
                (f"Laplacian rows chosen from {n} ring{'s' * (n > 1)}", f"{np.sum(self.rings == n)}") for n in (1, 2, 3)
            ]
            lines.append(("inconsistent Laplacian rows", f"{len(self.inconsistent)}"))
            if len(self.inconsistent):
                lines.append(("worst moment residual", f"{self.residual.max():.2g}"))
        return "\n".join(f"{name:<36}{value}" for name, value in lines)


class Surface(eqx.Module):
    """A triangle mesh with everything the operators need, as a pytree.

    Attributes:
        topology: the tables that stay when vertices move.
        geometry: the arrays that depend on the positions.
        scheme: `Monotone` or `Paper`.
        report: what the construction found (host).
    """

    topology: Topology
    geometry: Geometry
    scheme: Scheme = eqx.field(static=True)
    report: SurfaceReport = eqx.field(static=True)

    @classmethod
    def from_mesh(cls, mesh: Mesh, scheme: Scheme | None = None, dtype=None) -> "Surface":
        """The surface of a mesh.

        Weights are computed in float64 and cast last.

        Args:
            mesh: the mesh.
            scheme: `Monotone()` (the default) or `Paper()`.
            dtype: float32 or float64; by default JAX's own default float.

        Raises:
            TypeError: no mesh was given.
            ValueError: the dtype is no float, or is float64 while JAX has 64-bit numbers switched off, or the mesh is
                so small that its weights leave the range of the dtype.
        """
        if not isinstance(mesh, Mesh):
            raise TypeError(
                f"Expected a Mesh, found {type(mesh).__name__}. Use ltl.load_mesh(path) or ltl.Mesh(vertices, faces)."
            )
        scheme = Monotone() if scheme is None else scheme
        if not isinstance(scheme, Scheme):
            raise TypeError(f"Expected a scheme such as ltl.Monotone() or ltl.Paper(), found {scheme!r}.")
        dtype = _float_dtype(dtype)
        topology, report = _freeze(mesh, scheme)
        # On the host in NumPy, where float64 is always at hand and nothing has to be compiled for the mesh's size.
        with np.errstate(over="ignore"):  # an overflow of the cast is found below
            geometry = _cast(weigh(scheme, mesh.vertices, topology), dtype)
        if not all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(geometry)):
            raise ValueError(
                f"Weights grow like 1 / length^2, and at a mesh size of {mesh.mesh_size:.3g} they leave the range of "
                f"{jnp.dtype(dtype).name}. Rescale the mesh (mesh.scaled(factor)) or use float64."
            )
        topology = jax.tree.map(jnp.asarray, topology)
        return cls(topology, geometry, scheme, report)

    def with_vertices(self, vertices: Float[AnyArray, "V 3"]) -> "Surface":
        """The surface with its vertices moved and every weight computed anew, on the same support.

        Pure, differentiable in the vertices and jit-compiled; the host is not asked. The support is the one chosen for
        the mesh it was built from: after a large deformation build the surface anew.
        """
        if vertices.shape != self.vertices.shape:
            raise ValueError(f"Expected vertices of shape {self.vertices.shape}, found {vertices.shape}.")
        # In the widest float that JAX has switched on, and cast last.
        vertices = jnp.asarray(vertices, _float_dtype(None))
        geometry = _cast(_weigh(self.scheme, vertices, self.topology), self.dtype)
        return eqx.tree_at(lambda surface: surface.geometry, self, geometry)

    @property
    def vertices(self) -> Float[Array, "V 3"]:
        """Positions."""
        return self.geometry.vertices

    @property
    def faces(self) -> Int[Array, "F 3"]:
        """Triangles."""
        return self.topology.faces

    @property
    def normals(self) -> Float[Array, "V 3"]:
        """Unit normals."""
        return self.geometry.normals

    @property
    def vertex_areas(self) -> Float[Array, " V"]:
        """A third of the area of the faces at each vertex; they sum to the area of the mesh."""
        return self.geometry.vertex_areas

    @property
    def num_vertices(self) -> int:
        """Number of vertices."""
        return self.topology.ring.num_vertices

    @property
    def dtype(self):
        """The float type of the weights."""
        return self.geometry.vertices.dtype


_weigh = eqx.filter_jit(weigh)


def _float_dtype(dtype):
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


def _cast(geometry: Geometry, dtype) -> Geometry:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), geometry)


def _freeze(mesh: Mesh, scheme: Scheme) -> tuple[Topology, SurfaceReport]:
    """The topology of a mesh under a scheme, in NumPy: the rings, and the supports chosen from the positions."""
    rings = one_rings(mesh.faces, mesh.num_vertices)
    ring = build_table(rings.offsets, rings.neighbours)
    topology = Topology(
        faces=mesh.faces.astype(np.int32),
        ring=ring,
        ring_blocks=_ring_blocks(ring, rings.valences, mesh.boundary_vertices),
        is_boundary=mesh.boundary_vertices,
        jet=ring,
        diffusion=None,
    )
    if isinstance(scheme, Paper):
        frames = tangent_frames(ring_normals(mesh.vertices, ring, topology.ring_blocks))
        return topology, SurfaceReport(
            dropped_faces=ring.map(
                lambda block, rings: dropped_faces(
                    lifted_ring(offsets(mesh.vertices, block), block.centre(frames), scheme.lift), rings
                ),
                topology.ring_blocks,
            )
        )
    return _choose_support(mesh, rings, topology, scheme)


def _choose_support(
    mesh: Mesh, rings: OneRings, topology: Topology, scheme: Monotone
) -> tuple[Topology, SurfaceReport]:
    vertices, rows = mesh.vertices, (rings.offsets, rings.neighbours)

    def wider(which: np.ndarray, rings_wide: int) -> support.Rows:
        return k_ring(rings, mesh.num_vertices, which, rings_wide)

    normals = ring_normals(vertices, topology.ring, topology.ring_blocks)
    frames = tangent_frames(normals)
    is_well_placed = topology.ring.map(
        lambda block: support.determines_quadratic(
            lifted_ring(offsets(vertices, block), block.centre(frames), "projection")
        )
    )
    lift_at = support.lift_onto(vertices, frames, "projection")
    topology = dataclasses.replace(
        topology, jet=build_table(*support.fit_support(rows, is_well_placed, wider, lift_at))
    )
    # The Laplacian's rows are laid out in the frames they will be weighed in.
    frames = vertex_frames(vertices, fitted_normals(vertices, normals, topology.jet), topology)
    _, residual = diffusion_rows(scheme.lift, vertices, frames, topology.is_boundary, topology.ring)
    diffusion, record = support.nonnegative_support(
        rows,
        residual <= support.CONSISTENT,
        mesh.boundary_vertices,
        wider,
        support.lift_onto(vertices, frames, scheme.lift),
    )
    report = SurfaceReport(
        wide_gradient_rows=np.flatnonzero(~is_well_placed),
        rings=record.rings,
        residual=record.residual,
        inconsistent=record.inconsistent,
    )
    return dataclasses.replace(topology, diffusion=build_table(*diffusion)), report


def _ring_blocks(ring: Table, valences: np.ndarray, is_boundary: np.ndarray) -> tuple[RingTopology, ...]:
    """The ring topology of every block; rows that live in the tail are empty in the bulk."""
    blocks = []
    for block in ring.blocks:
        rows = np.arange(len(valences)) if block.rows is None else block.rows
        here = np.where(valences[rows] <= block.indices.shape[0], valences[rows], 0)
        blocks.append(RingTopology(here.astype(np.int32), is_boundary[rows]))
    return tuple(blocks)
