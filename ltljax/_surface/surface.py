"""`Surface`: the pytree that a user holds. `building` makes it from a mesh; from here on everything is pure JAX."""

import contextlib
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from .._base import cache
from .._base.records import read_record, write_record
from .._lifting.schemes import Monotone, Scheme
from .._lifting.weighing import Geometry, Topology, weigh
from .._mesh import Mesh, far_middle
from .._tables import AnyArray, ComposedStencil, Stencil, slot_sum
from .building import SurfaceReport, as_text, build, float_dtype
from .conservation import stationary_measure


class Surface(eqx.Module):
    """A triangle mesh with everything that operators need, as a pytree.

    Positions are relative to ``centre``, so that they keep their digits in float32 wherever the mesh lies. The centre
    is the origin, and positions are those of the mesh, unless the middle of the mesh is farther from the origin than
    twice its size. The same holds for ``surface.vertices``, for the argument of `with_vertices`, for the positions
    passed to sources, boundary data and motions, and for positions returned by functions of a surface.

    Attributes:
        topology: the tables, which stay the same when vertices move.
        geometry: the arrays that depend on the positions.
        scheme: `Monotone`, `Polynomial` or `Paper`.
        centre_parts: (2, 3) two vectors whose sum is the centre, so that float32 holds it in double precision.
        report: the report of the construction (host).
    """

    topology: Topology
    geometry: Geometry
    centre_parts: Float[Array, "2 3"]
    scheme: Scheme = eqx.field(static=True)
    report: SurfaceReport = eqx.field(static=True)

    @classmethod
    def from_mesh(
        cls, mesh: Mesh, scheme: Scheme | None = None, dtype=None, progress: bool = False, differentiable: bool = True
    ) -> "Surface":
        """The surface of a mesh. Weights are computed in float64 and cast last.

        Args:
            mesh: the mesh.
            scheme: `Monotone()` (the default), `Polynomial()` or `Paper()`.
            dtype: float32 or float64; JAX's default float by default.
            progress: whether to show the progress of the choice of neighbours, which takes seconds for 100,000
                vertices.
            differentiable: whether to keep the tables with which reverse-mode derivatives gather. Without them such
                derivatives scatter and take several times longer; the surface is about a tenth smaller.

        Raises:
            TypeError: the mesh is not a `Mesh`, or the scheme is not a scheme.
            ValueError: the dtype is not a float type or is float64 while JAX has 64-bit numbers switched off, or the
                mesh is so small or large that its weights leave the range of the dtype.

        Warns:
            InconsistentRowsWarning: at some vertices `Monotone` has neither a consistent non-negative row nor a
            cotangent
                row, or no choice of neighbours determines the fit of `Polynomial`.
            CoarseMeshWarning: `Polynomial` is less accurate than `Monotone` on so coarse a mesh.
            FarFromOriginWarning: positions are relative to ``surface.centre``.
        """
        if not isinstance(mesh, Mesh):
            raise TypeError(
                f"Expected a Mesh, found {type(mesh).__name__}. Use ltl.load_mesh(path) or ltl.Mesh(vertices, faces)."
            )
        scheme = Monotone() if scheme is None else scheme
        if not isinstance(scheme, Scheme):
            raise TypeError(f"Expected a scheme such as ltl.Monotone() or ltl.Paper(), found {scheme!r}.")
        topology, geometry, centre_parts, report = build(mesh, scheme, dtype, progress, differentiable, stacklevel=2)
        return cls(topology, geometry, centre_parts, scheme, report)

    def save(self, path: str | Path) -> None:
        """Write the surface to a file with all its tables and weights, replacing an existing file.

        The file is an NPZ archive of arrays and contains no code. Loading is far faster than building the surface
        again.

        Args:
            path: the path of the file, usually ending in ``.npz``.

        Raises:
            ValueError: the surface is being traced by a JAX transformation.
            TypeError: the scheme is not one of ltljax's own.

        Example:
            >>> import ltljax as ltl
            >>> surface = ltl.Surface.from_mesh(ltl.shapes.icosphere(2))
            >>> surface.save("ball.npz")
            >>> ltl.Surface.load("ball.npz").num_vertices
            162
        """
        if self.is_traced:
            raise ValueError("A surface that is being traced by a JAX transformation cannot be saved.")
        write_record(Path(path), self)

    @classmethod
    def load(cls, path: str | Path) -> "Surface":
        """The surface that `save` wrote to a file, equal bit for bit.

        Args:
            path: the path of the file.

        Raises:
            ValueError: the file does not exist, is damaged, was written by another version of ltljax, or contains
                float64 while JAX has 64-bit numbers switched off.
        """
        return read_record(Path(path), cls)

    def with_vertices(self, vertices: Float[AnyArray, "V 3"]) -> "Surface":
        """The surface with moved vertices: every weight is recomputed for the same neighbours.

        A pure, compiled function, differentiable in the vertices, without work on the host. The neighbours and the
        flips of the intrinsic triangulation are those chosen for the original mesh: after a large deformation, build a
        new surface. In float32, rows whose edge lengths differ by a factor of more than a thousand lose their accuracy.

        Args:
            vertices: (V, 3) the new positions, relative to ``surface.centre``.

        Raises:
            ValueError: the number of vertices differs, or the positions lie so far from the centre that they must be
                relative to another point.
        """
        if vertices.shape != self.vertices.shape:
            raise ValueError(f"Expected vertices of shape {self.vertices.shape}, found {vertices.shape}.")
        is_known = not isinstance(vertices, Tracer) and not self.is_traced
        if is_known and self.centre.any() and (middle := far_middle(np.asarray(vertices))).any():
            raise ValueError(
                f"Expected positions relative to surface.centre, found positions around {as_text(middle)}. "
                "Subtract the centre in double precision, or build a new surface from a mesh."
            )
        # Compute in the widest float type that is switched on, and cast last.
        vertices = jnp.asarray(vertices, float_dtype(None))
        geometry = _weigh(self.scheme, vertices, self.topology)
        geometry = jax.tree.map(lambda leaf: leaf.astype(self.dtype), geometry)
        geometry = dataclasses.replace(geometry, spectral_width=self._width_in_proportion(geometry))
        return eqx.tree_at(lambda surface: surface.geometry, self, geometry)

    def _width_in_proportion(self, geometry: Geometry) -> Array | None:
        """The spectral width of a moved surface: the measured one, scaled like the mean row sum."""
        table, width, weights = self.topology.diffusion, self.geometry.spectral_width, self.geometry.laplacian_weights
        if table is None or width is None or weights is None or geometry.laplacian_weights is None:
            return None
        return width * jnp.mean(slot_sum(table, geometry.laplacian_weights)) / jnp.mean(slot_sum(table, weights))

    @property
    def centre(self) -> np.ndarray:
        """The point that positions are relative to, (3,) in the coordinates of the mesh, in double precision (host)."""
        return np.asarray(self.centre_parts, np.float64).sum(axis=0)

    @property
    def vertices(self) -> Float[Array, "V 3"]:
        """Vertex positions, relative to ``centre``."""
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
        """A third of the area of the faces at each vertex. The vertex areas sum to the area of the mesh."""
        return self.geometry.vertex_areas

    @property
    def laplacian_stencil(self) -> Stencil | ComposedStencil:
        """The Laplacian without boundary flux, as an operator: ``surface.laplacian_stencil(u)``."""
        table, weights = self.topology.diffusion, self.geometry.laplacian_weights
        if table is None or weights is None:
            return ComposedStencil(self.divergence_stencils, self.gradient_stencils)
        return Stencil(table, weights, self.geometry.laplacian_reverse)

    @property
    def gradient_stencils(self) -> tuple[Stencil, Stencil]:
        """The two components of the gradient in the frame of each vertex."""
        x, y = (Stencil(self.topology.jet, weights) for weights in self.geometry.gradient_weights)
        return x, y

    @property
    def divergence_stencils(self) -> tuple[Stencil, Stencil]:
        """Operators on the two components of a field in the frames; the divergence is the sum of their results."""
        weights, centre = self.geometry.divergence_weights, self.geometry.divergence_centre
        x, y = (Stencil(self.topology.jet, weights[axis], centre=centre[:, axis]) for axis in (0, 1))
        return x, y

    @property
    def hessian_stencils(self) -> tuple[Stencil, Stencil, Stencil]:
        """The second derivatives xx, xy and yy in the frame of each vertex.

        Raises:
            ValueError: the scheme is `Paper`, which has no second derivatives of its own.
        """
        if self.geometry.hessian_weights is None:
            raise ValueError("Paper() has no second derivatives of its own. Use ltl.Monotone() or ltl.Polynomial().")
        xx, xy, yy = (Stencil(self.topology.jet, weights) for weights in self.geometry.hessian_weights)
        return xx, xy, yy

    @property
    def mass(self) -> Float[Array, " V"]:
        """The measure that diffusion conserves: ``sum(mass * u)`` is constant while u diffuses without flux.

        It is the stationary measure of the random walk whose generator is the Laplacian: non-negative, close to the
        vertex areas, and with the same sum on every connected component. It is zero at a vertex that no other vertex's
        row uses. The first access takes one sparse solve on the host; the result is cached as long as the weights live.

        Raises:
            ValueError: the scheme is not `Monotone`, or the surface is being traced: compute the mass outside of jit
                and pass it as an argument.
        """
        if not self.scheme.is_monotone:
            raise ValueError(
                f"{self.scheme} has no conserved measure, since its weights have both signs. Use Monotone()."
            )
        if self.is_traced:
            raise ValueError(
                "The mass is computed on the host, but the surface is being traced by a JAX transformation. Compute "
                "`mass = surface.mass` outside and pass it as an argument."
            )
        # Inside jit, a surface that is not traced is still computed with at once.
        with jax.ensure_compile_time_eval():
            return self.remembered("mass", self._stationary_measure)

    def _stationary_measure(self) -> Float[Array, " V"]:
        generator, areas = self.laplacian_stencil.matrix(), np.asarray(self.vertex_areas)
        return jnp.asarray(stationary_measure(generator, areas), self.dtype)

    @property
    def quadrature(self) -> Float[Array, " V"]:
        """The weights of integrals in time-dependent problems: the conserved `mass`, or the vertex areas.

        The vertex areas stand in if the scheme conserves no measure or the surface is being traced.
        """
        return self.mass if self.scheme.is_monotone and not self.is_traced else self.vertex_areas

    @property
    def is_traced(self) -> bool:
        """Whether a JAX transformation is tracing the surface, so that its values are not known yet."""
        return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(self.geometry))

    def remembered(self, name: str, compute: Callable[[], Any]) -> Any:
        """The result of ``compute()``, computed once for these weights and cached on the host while they are alive."""
        weights = (self.geometry.laplacian_weights or self.geometry.gradient_weights[0])[0]
        return cache.remembered(weights, name, compute)

    @property
    def mesh_size(self) -> Float[Array, ""]:
        """The mean edge length of the faces, in which interior edges count twice."""
        # Inside jit, evaluate the length at once if the surface is not traced, so that it is a constant.
        is_known = not (self.is_traced or isinstance(self.faces, Tracer))
        with jax.ensure_compile_time_eval() if is_known else contextlib.nullcontext():
            corners = self.vertices[self.faces]
            return jnp.mean(jnp.linalg.norm(corners - jnp.roll(corners, 1, axis=1), axis=-1))

    @property
    def num_vertices(self) -> int:
        """Number of vertices."""
        return self.topology.ring.num_vertices

    @property
    def dtype(self):
        """The float type of the positions and weights."""
        return self.geometry.vertices.dtype


_weigh = eqx.filter_jit(weigh)
