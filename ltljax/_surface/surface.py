"""`Surface`: the pytree a user holds. The only place where host meets device.

What enters: a checked `Mesh` and a scheme. What leaves: topology tables and weights as JAX arrays; from here on
everything is a pure function of them.
"""

import contextlib
import dataclasses
import functools
import inspect
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from .._base import cache
from .._base.arguments import as_numbers, kind_of
from .._base.progress import Laps, watched
from .._base.records import read_record, write_record
from .._lifting.schemes import Geometry, Monotone, Scheme, Topology, weigh
from .._mesh import Mesh, far_middle
from .._tables import AnyArray, difference_matrix, slot_sum
from .building import SurfaceReport, freeze, warn_of_coarse_mesh, warn_of_rows, with_reverse
from .conservation import stationary_measure

P = ParamSpec("P")
R = TypeVar("R")


class FarFromOriginWarning(UserWarning):
    """The mesh lies far from the origin, so that the positions of its surface are relative to ``surface.centre``."""


class Surface(eqx.Module):
    """A triangle mesh with everything the operators need, as a pytree.

    Positions are relative to ``centre``, so that they keep their digits in float32 wherever the mesh lies. The centre
    is the origin, and positions are those of the mesh, unless the middle of the mesh is farther from the origin than
    twice its size. This holds for ``surface.vertices``, for what `with_vertices` is given, for the positions that
    sources, boundary data and motions are called with, and for the positions that a function of a surface returns.

    Attributes:
        topology: the tables that stay when vertices move.
        geometry: the arrays that depend on the positions.
        scheme: `Monotone`, `Polynomial` or `Paper`.
        centre_parts: (2, 3), whose sum is the centre: float32 holds it in double precision so.
        report: what the construction found (host).
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
                so small or large that its weights leave the range of the dtype.

        Warns:
            InconsistentRowsWarning: at some vertices `Monotone` found no consistent non-negative row and could not use
                the cotangent row, or `Polynomial` found no neighbours that determine its fit.
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
        dtype = _float_dtype(dtype)
        laps = Laps()
        topology, angles, report = freeze(mesh, scheme, functools.partial(watched, progress=progress), laps)
        if differentiable:
            topology = with_reverse(topology)
            laps.end("reversed tables")
        centre = far_middle(mesh.vertices)
        # On the host in NumPy, where float64 is always at hand and nothing has to be compiled for the mesh's size.
        with np.errstate(over="ignore"):  # an overflow of the cast is found below
            geometry = weigh(scheme, mesh.vertices - centre, topology, angles)
            geometry = jax.tree.map(lambda leaf: leaf.astype(dtype), geometry)
        if not _is_in_range(geometry):
            raise ValueError(
                f"Weights go with 1 / length^2, and at a mesh size of {mesh.mesh_size:.3g} they leave the range of "
                f"{jnp.dtype(dtype).name}. Rescale the mesh (mesh.scaled(factor)) or use float64."
            )
        warn_of_rows(report, scheme, stacklevel=2)
        warn_of_coarse_mesh(topology, geometry.normals, scheme, stacklevel=2)
        if centre.any():
            warnings.warn(
                f"The mesh lies far from the origin: the positions of its surface are relative to surface.centre, "
                f"{_in_words(centre)}.",
                FarFromOriginWarning,
                stacklevel=2,
            )
        coarse = centre.astype(dtype)
        centre_parts = np.stack([coarse, (centre - coarse).astype(dtype)])
        topology, geometry, centre_parts = jax.device_put((topology, geometry, centre_parts))
        laps.end("weights")
        report = dataclasses.replace(report, seconds=laps.seconds)
        return cls(topology, geometry, centre_parts, scheme, report)

    def save(self, path: str | Path) -> None:
        """Write the surface to a file, with all its tables and weights; one that is there is replaced.

        The file is an NPZ archive of arrays; it holds no code. Building a surface again takes far longer than loading.

        Args:
            path: the file; by custom it ends in ``.npz``.

        Raises:
            ValueError: the surface is being traced by a JAX transformation.
            TypeError: its scheme is none of ltljax.

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
        """The surface in a file that `save` wrote, bit for bit.

        Args:
            path: the file.

        Raises:
            ValueError: there is no such file, it is damaged, it was written by another version of ltljax, or it holds
                float64 while JAX has 64-bit numbers switched off.
        """
        return read_record(Path(path), cls)

    def with_vertices(self, vertices: Float[AnyArray, "V 3"]) -> "Surface":
        """The surface with its vertices moved and every weight recomputed, on the same support.

        Pure, differentiable in the vertices and jit-compiled, without work on the host. The support, with the flips of
        the intrinsic triangulation, is the one chosen for the mesh it was built from: after a large deformation build a
        new surface. In float32, rows whose edges differ in length by more than a thousand times lose their accuracy.

        Args:
            vertices: the new positions, relative to ``surface.centre``.

        Raises:
            ValueError: there are not as many vertices as before, or they lie far from where they are taken from, which
                positions relative to another point do.
        """
        if vertices.shape != self.vertices.shape:
            raise ValueError(f"Expected vertices of shape {self.vertices.shape}, found {vertices.shape}.")
        is_known = not isinstance(vertices, Tracer) and not self.is_traced
        if is_known and self.centre.any() and (middle := far_middle(np.asarray(vertices))).any():
            raise ValueError(
                f"Expected positions relative to surface.centre, found positions about {_in_words(middle)}. Take the "
                "centre from them in double precision, or build a new surface of a mesh."
            )
        # In the widest float that JAX has switched on, and cast last.
        vertices = jnp.asarray(vertices, _float_dtype(None))
        geometry = _weigh(self.scheme, vertices, self.topology)
        geometry = jax.tree.map(lambda leaf: leaf.astype(self.dtype), geometry)
        geometry = dataclasses.replace(geometry, spectral_width=self._width_in_proportion(geometry))
        return eqx.tree_at(lambda surface: surface.geometry, self, geometry)

    def _width_in_proportion(self, geometry: Geometry) -> Array | None:
        """The spectral width of the moved surface: it is measured once, and grows like the rows."""
        table, width, weights = self.topology.diffusion, self.geometry.spectral_width, self.geometry.laplacian_weights
        if table is None or width is None or weights is None or geometry.laplacian_weights is None:
            return None
        return width * jnp.mean(slot_sum(table, geometry.laplacian_weights)) / jnp.mean(slot_sum(table, weights))

    @property
    def centre(self) -> np.ndarray:
        """The point from which positions are taken, (3,) in the coordinates of the mesh, in double precision (host)."""
        return np.asarray(self.centre_parts, np.float64).sum(axis=0)

    @property
    def vertices(self) -> Float[Array, "V 3"]:
        """Positions, relative to ``centre``."""
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
        return cache.remembered(weights, name, compute)

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


def on_surface(function: Callable[P, R]) -> Callable[P, R]:
    """The function, with an error that says what was expected if its argument ``surface`` is not a `Surface`.

    Raises:
        TypeError: the argument is no `Surface`.
    """
    place = list(inspect.signature(function).parameters).index("surface")

    @functools.wraps(function)
    def checked(*arguments: P.args, **named: P.kwargs) -> R:
        # Where the argument is missing, the call itself says so.
        is_given = "surface" in named or place < len(arguments)
        given = named.get("surface", arguments[place] if place < len(arguments) else None)
        if is_given and not isinstance(given, Surface):
            advice = " Build one: ltl.Surface.from_mesh(mesh)." if isinstance(given, Mesh) else ""
            raise TypeError(f"{function.__name__} expected a Surface as surface, found {kind_of(given)}.{advice}")
        return function(*arguments, **named)

    return checked


def on_device(function: Callable) -> Callable:
    """The function jit-compiled, and checked by `on_surface` if it has a parameter ``surface``. Masked arrays, which
    would become arrays without their masks, are refused.

    Raises:
        TypeError: an argument that should be an array is None, a sequence, a mapping, a set, a function or a text.
        ValueError: an argument is a masked array.
    """
    parameters = inspect.signature(function).parameters
    names = list(parameters)
    are_arrays = {name for name, p in parameters.items() if p.default is p.empty and p.annotation is not str} - {
        "surface"
    }
    compiled = eqx.filter_jit(function)

    @functools.wraps(function)
    def checked(*arguments, **named):
        for name, value in (*zip(names, arguments, strict=False), *named.items()):
            if isinstance(value, np.ma.MaskedArray):
                as_numbers(f"the argument of {function.__name__}", value)
            is_no_array = name in are_arrays and (value is None or isinstance(value, str | tuple))
            if is_no_array or isinstance(value, list | dict | set) or inspect.isroutine(value):
                raise TypeError(f"{function.__name__} expected an array as {name}, found {kind_of(value)}.")
        return compiled(*arguments, **named)

    return on_surface(checked) if "surface" in names else checked


_weigh = eqx.filter_jit(weigh)


def _is_in_range(geometry: Geometry) -> bool:
    """Whether all numbers are finite, and those that go with the squared length large enough to have all digits."""
    # All blocks and components of a kind together, as all numbers of one of them may be zero.
    squares = (geometry.laplacian_weights, geometry.hessian_weights, geometry.vertex_areas)
    is_finite = all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(geometry))
    largest = [
        max(np.abs(leaf).max(initial=0) for leaf in jax.tree.leaves(group)) for group in squares if group is not None
    ]
    precision = np.finfo(geometry.vertices.dtype)
    return is_finite and all(size > precision.tiny / precision.eps for size in largest)


def _in_words(point: np.ndarray) -> str:
    return f"({', '.join(f'{x:.6g}' for x in point)})"


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
