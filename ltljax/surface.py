"""`Surface`: the pytree a user holds. The only place where host meets device.

What enters: a checked `Mesh` and a scheme. What leaves: topology tables and weights as JAX arrays; from here on
everything is a pure function of them.
"""

import contextlib
import dataclasses
import functools
import warnings
import weakref
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from .conservation import stationary_measure
from .lifting import support
from .lifting.frames import tangent_frames
from .lifting.jets import INTERIOR, LAPLACIAN, OTHER_CORNER, RIGHT_CORNER, SMOOTH
from .lifting.paper import dropped_faces
from .lifting.ring import RingTopology, lifted_ring
from .lifting.schemes import (
    Geometry,
    Monotone,
    Paper,
    Polynomial,
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
from .progress import Laps, watched
from .tables import AnyArray, Table, build_table, difference_matrix, reversible

# A boundary that turns by more than this many degrees at a vertex has a corner there, and within so many degrees of a
# right angle it counts as one.
_CORNER, _RIGHT = 40, 20


class InconsistentRowsWarning(UserWarning):
    """Some vertices have no consistent row of weights, so that the Laplacian is not accurate there."""


@dataclasses.dataclass(frozen=True, eq=False)
class SurfaceReport:
    """What the construction of a surface found.

    Attributes:
        dropped_faces: (V,) of `Paper`: faces at each vertex that its lift makes degenerate, which have no part in the
            mean; else None.
        wide_gradient_rows: vertices whose one-ring (of `Polynomial`: whose nearest neighbours) does not determine the
            fit, so that the gradient uses more; None of `Paper`.
        undetermined: vertices where no choice of neighbours determines the fit: the gradient there is not of its order,
            and of `Polynomial` the Laplacian neither.
        rings: (V,) of `Monotone`: number of rings each Laplacian row was chosen from; else None.
        residual: (V,) of `Monotone`: relative moment residual of each Laplacian row; else None.
        inconsistent: vertices without a consistent non-negative row. Diffusion is stable there, but not accurate.
        seconds: how long each part of the construction took.
    """

    dropped_faces: np.ndarray | None = None
    wide_gradient_rows: np.ndarray | None = None
    undetermined: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    rings: np.ndarray | None = None
    residual: np.ndarray | None = None
    inconsistent: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)

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
            lines.append(("gradient rows wider than usual", f"{len(self.wide_gradient_rows)}"))
        if len(self.undetermined):
            lines.append(("gradient rows not determined", f"{len(self.undetermined)}"))
        if self.rings is not None and self.residual is not None:
            lines += [
                (f"Laplacian rows chosen from {n} ring{'s' * (n > 1)}", f"{np.sum(self.rings == n)}") for n in (1, 2, 3)
            ]
            lines.append(("inconsistent Laplacian rows", f"{len(self.inconsistent)}"))
            if len(self.inconsistent):
                lines.append(("worst moment residual", f"{self.residual.max():.2g}"))
        lines += [(f"seconds for {part}", f"{seconds:.2f}") for part, seconds in self.seconds.items()]
        return "\n".join(f"{name:<36}{value}" for name, value in lines)


class Surface(eqx.Module):
    """A triangle mesh with everything the operators need, as a pytree.

    Attributes:
        topology: the tables that stay when vertices move.
        geometry: the arrays that depend on the positions.
        scheme: `Monotone`, `Polynomial` or `Paper`.
        report: what the construction found (host).
    """

    topology: Topology
    geometry: Geometry
    scheme: Scheme = eqx.field(static=True)
    report: SurfaceReport = eqx.field(static=True)

    @classmethod
    def from_mesh(
        cls, mesh: Mesh, scheme: Scheme | None = None, dtype=None, progress: bool = False, differentiable: bool = True
    ) -> "Surface":
        """The surface of a mesh.

        Weights are computed in float64 and cast last.

        Args:
            mesh: the mesh.
            scheme: `Monotone()` (the default), `Polynomial()` or `Paper()`.
            dtype: float32 or float64; by default JAX's own default float.
            progress: whether to show how far the choice of neighbours is; it takes seconds for 100,000 vertices.
            differentiable: whether to keep the tables that let reverse-mode derivatives gather. Without them, such
                derivatives scatter and take several times longer, and the surface is about a tenth smaller.

        Raises:
            TypeError: no mesh was given.
            ValueError: the dtype is no float, or is float64 while JAX has 64-bit numbers switched off, or the mesh is
                so small that its weights leave the range of the dtype.

        Warns:
            InconsistentRowsWarning: at some vertices `Monotone` found no consistent non-negative row, or `Polynomial`
                no neighbours that determine its fit.
        """
        if not isinstance(mesh, Mesh):
            raise TypeError(
                f"Expected a Mesh, found {type(mesh).__name__}. Use ltl.load_mesh(path) or ltl.Mesh(vertices, faces)."
            )
        scheme = Monotone() if scheme is None else scheme
        if not isinstance(scheme, Scheme):
            raise TypeError(f"Expected a scheme such as ltl.Monotone() or ltl.Paper(), found {scheme!r}.")
        dtype = _float_dtype(dtype)
        laps = Laps()
        topology, report = _freeze(mesh, scheme, functools.partial(watched, progress=progress), laps)
        if differentiable:
            topology = _with_reverse(topology)
            laps.end("reversed tables")
        # On the host in NumPy, where float64 is always at hand and nothing has to be compiled for the mesh's size.
        with np.errstate(over="ignore"):  # an overflow of the cast is found below
            geometry = jax.tree.map(lambda leaf: leaf.astype(dtype), weigh(scheme, mesh.vertices, topology))
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(geometry)):
            raise ValueError(
                f"Weights grow like 1 / length^2, and at a mesh size of {mesh.mesh_size:.3g} they leave the range of "
                f"{jnp.dtype(dtype).name}. Rescale the mesh (mesh.scaled(factor)) or use float64."
            )
        if len(report.inconsistent):
            warnings.warn(_inconsistent(report), InconsistentRowsWarning, stacklevel=2)
        elif isinstance(scheme, Polynomial) and len(report.undetermined):
            warnings.warn(_undetermined(report, scheme), InconsistentRowsWarning, stacklevel=2)
        topology, geometry = jax.tree.map(jnp.asarray, (topology, geometry))
        laps.end("weights")
        report = dataclasses.replace(report, seconds=laps.seconds)
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
        geometry = _weigh(self.scheme, vertices, self.topology)
        geometry = jax.tree.map(lambda leaf: leaf.astype(self.dtype), geometry)
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
    def mass(self) -> Float[Array, " V"]:
        """The measure that diffusion conserves: ``sum(mass * u)`` does not change while u diffuses without flux.

        The stationary measure of the random walk whose generator is the Laplacian: non-negative, close to the vertex
        areas, with the same sum on every connected component; zero at a vertex that no other vertex's row uses. One
        sparse solve on the host when it is first asked for; kept as long as the surface's weights are.

        Raises:
            ValueError: the scheme is not `Monotone`, or the surface is being traced: take the mass outside of jit and
                hand it in.
        """
        weights, diffusion = self.geometry.laplacian_weights, self.topology.diffusion
        if not isinstance(self.scheme, Monotone) or weights is None or diffusion is None:
            raise ValueError(f"Only Monotone() has non-negative weights and so a conserved measure, not {self.scheme}.")
        if self.is_traced:
            raise ValueError(
                "The mass is computed on the host, but the surface is being traced by a JAX transformation. Take "
                "`mass = surface.mass` outside and hand it in as an argument."
            )
        return self.remembered("mass", lambda: self._stationary_measure(difference_matrix(diffusion, weights)))

    def _stationary_measure(self, generator) -> Float[Array, " V"]:
        return jnp.asarray(stationary_measure(generator, np.asarray(self.vertex_areas)), self.dtype)

    @property
    def is_traced(self) -> bool:
        """Whether a JAX transformation is tracing the surface, so that its numbers are not known yet."""
        return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(self.geometry))

    def remembered(self, name: str, compute: Callable[[], Any]) -> Any:
        """What ``compute`` returns, computed once for these weights and kept on the host as long as they live."""
        weights = (self.geometry.laplacian_weights or self.geometry.gradient_weights[0])[0]
        key = id(weights)
        if key not in _REMEMBERED:
            _REMEMBERED[key] = {}
            weakref.finalize(weights, _REMEMBERED.pop, key, None)
        kept = _REMEMBERED[key]
        if name not in kept:
            kept[name] = compute()
        return kept[name]

    @property
    def mesh_size(self) -> Float[Array, ""]:
        """The mean length of the edges of the faces: those inside count twice. A constant where nothing is traced."""
        # Inside jit even the vertices of a surface from outside would give a traced length.
        known = not (self.is_traced or isinstance(self.faces, Tracer))
        with jax.ensure_compile_time_eval() if known else contextlib.nullcontext():
            corners = self.vertices[self.faces]
            return jnp.mean(jnp.linalg.norm(corners - jnp.roll(corners, 1, axis=1), axis=-1))

    @property
    def num_vertices(self) -> int:
        """Number of vertices."""
        return self.topology.ring.num_vertices

    @property
    def dtype(self):
        """The float type of the weights."""
        return self.geometry.vertices.dtype


_weigh = eqx.filter_jit(weigh)

# Results on the host, by the identity of the weights they belong to, for as long as those live.
_REMEMBERED: dict[int, dict[str, Any]] = {}


def _inconsistent(report: SurfaceReport) -> str:
    count = len(report.inconsistent)
    worst = int(np.argmax(np.asarray(report.residual)))
    return (
        f"{count} of {len(np.asarray(report.residual))} vertices have no consistent non-negative row, the worst being "
        f"vertex {worst}. Diffusion stays stable there, but is not accurate. Causes are spikes, folds and slivers: see "
        "surface.report.inconsistent, and remesh around them."
    )


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


def _undetermined(report: SurfaceReport, scheme: Polynomial) -> str:
    return (
        f"At {len(report.undetermined)} vertices, the first being vertex {report.undetermined[0]}, no five rings of "
        f"neighbours determine a polynomial of degree {scheme.degree}. The mesh is too coarse or too thin there: "
        "subdivide it, or use ltl.Monotone()."
    )


def _freeze(
    mesh: Mesh, scheme: Scheme, watch: Callable[[str], support.Watch], laps: Laps
) -> tuple[Topology, SurfaceReport]:
    """The topology of a mesh under a scheme, in NumPy: the rings, and the supports chosen from the positions."""
    rings = one_rings(mesh.faces, mesh.num_vertices)
    ring = build_table(rings.offsets, rings.neighbours)
    ring_blocks = _ring_blocks(ring, rings.valences, mesh.boundary_vertices)
    normals = ring_normals(scheme, mesh.vertices, ring, ring_blocks)
    loops = mesh.boundary_loops
    topology = Topology(
        faces=mesh.faces.astype(np.int32),
        ring=ring,
        ring_blocks=ring_blocks,
        kinds=_kinds(mesh, normals),
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
        frames = tangent_frames(normals)
        return topology, SurfaceReport(
            dropped_faces=ring.map(
                lambda block, rings: dropped_faces(
                    lifted_ring(offsets(mesh.vertices, block), block.centre(frames), scheme.lift), rings
                ),
                topology.ring_blocks,
            )
        )
    return _choose_support(mesh, rings, normals, topology, scheme, watch, laps)


def _choose_support(
    mesh: Mesh,
    rings: OneRings,
    normals: np.ndarray,
    topology: Topology,
    scheme: Monotone | Polynomial,
    watch: Callable[[str], support.Watch],
    laps: Laps,
) -> tuple[Topology, SurfaceReport]:
    vertices, rows = mesh.vertices, (rings.offsets, rings.neighbours)

    def wider(which: np.ndarray, rings_wide: int) -> support.Rows:
        return k_ring(rings, mesh.num_vertices, which, rings_wide)

    jet_rows, wide, undetermined = support.fit_support(
        rows,
        scheme.degree,
        wider,
        support.lift_onto(vertices, tangent_frames(normals), "projection"),
        watch("choosing the neighbours of the gradient"),
    )
    topology = dataclasses.replace(topology, jet=build_table(*jet_rows))
    laps.end("gradient rows")
    if isinstance(scheme, Polynomial):
        return dataclasses.replace(topology, diffusion=topology.jet), SurfaceReport(
            wide_gradient_rows=wide, undetermined=undetermined
        )
    # The Laplacian's rows are laid out in the frames they will be weighed in.
    normals = fitted_normals(vertices, normals, topology.jet, scheme.degree)
    frames, _ = vertex_frames(vertices, normals, topology)
    _, residual, _ = diffusion_rows(scheme, vertices, normals, frames, topology.kinds, topology.ring)
    diffusion, record = support.nonnegative_support(
        rows,
        residual <= support.CONSISTENT,
        topology.kinds,
        LAPLACIAN.T,
        wider,
        support.lift_onto(vertices, frames, scheme.lift),
        watch("choosing the neighbours of the Laplacian"),
    )
    report = SurfaceReport(
        wide_gradient_rows=wide,
        undetermined=undetermined,
        rings=record.rings,
        residual=record.residual,
        inconsistent=record.inconsistent,
    )
    topology = dataclasses.replace(topology, diffusion=build_table(*diffusion))
    laps.end("Laplacian rows")
    return topology, report


def _with_reverse(topology: Topology) -> Topology:
    """The topology with the reverse of the tables that operators sum over."""
    jet, diffusion = topology.jet, topology.diffusion
    reverse = reversible(jet)
    return dataclasses.replace(
        topology,
        jet=reverse,
        diffusion=diffusion if diffusion is None else reverse if diffusion is jet else reversible(diffusion),
    )


def _kinds(mesh: Mesh, normals: np.ndarray) -> np.ndarray:
    """Which vertices lie inside, on a smooth boundary, or at a corner of it, (V,) int8."""
    kinds = np.full(mesh.num_vertices, INTERIOR, np.int8)
    for loop in mesh.boundary_loops:
        kinds[loop] = SMOOTH
        here, frames = mesh.vertices[loop], tangent_frames(normals[loop])
        to_next = np.einsum("bc,bac->ba", np.roll(here, -1, axis=0) - here, frames)
        to_previous = np.einsum("bc,bac->ba", np.roll(here, 1, axis=0) - here, frames)
        # The inner angle: from the next vertex counter-clockwise, over the surface, to the previous one.
        turn = np.arctan2(to_previous[:, 1], to_previous[:, 0]) - np.arctan2(to_next[:, 1], to_next[:, 0])
        angle = np.degrees(turn) % 360
        is_corner = np.abs(angle - 180) > _CORNER
        is_right = np.abs(np.abs(angle - 180) - 90) < _RIGHT
        kinds[loop[is_corner]] = OTHER_CORNER
        kinds[loop[is_corner & is_right]] = RIGHT_CORNER
    return kinds


def _ring_blocks(ring: Table, valences: np.ndarray, is_boundary: np.ndarray) -> tuple[RingTopology, ...]:
    """The ring topology of every block; rows that live in the tail are empty in the bulk."""
    blocks = []
    for block in ring.blocks:
        rows = np.arange(len(valences)) if block.rows is None else block.rows
        here = np.where(valences[rows] <= block.indices.shape[0], valences[rows], 0)
        blocks.append(RingTopology(here.astype(np.int32), is_boundary[rows]))
    return tuple(blocks)
