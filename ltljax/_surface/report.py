"""What the construction of a surface found: the report, and the warnings about rows and meshes."""

import dataclasses
import warnings

import numpy as np

from .._lifting.schemes import Polynomial, Scheme
from .._lifting.weighing import Topology

# `Monotone` is as accurate as `Polynomial(4)` for Poisson's equation, on round and bumpy tori, if at this share of the
# vertices normals turn by more than this many radians between a vertex and the farthest neighbour of its fit.
_COARSE, _COARSE_SHARE = 0.95, 0.05


class CoarseMeshWarning(UserWarning):
    """The mesh is so coarse, compared with its curvature, that a polynomial fit does not pay off."""


class InconsistentRowsWarning(UserWarning):
    """Some vertices have no consistent row of weights, so the Laplacian is not accurate there."""


@dataclasses.dataclass(frozen=True, eq=False)
class SurfaceReport:
    """A report of the construction of a surface.

    Attributes:
        dropped_faces: (V,) the number of faces at each vertex that the lift of `Paper` makes degenerate and its mean
            leaves out; None for other schemes.
        wide_gradient_rows: vertices whose one-ring (for `Polynomial`, whose nearest neighbours) does not determine the
            fit, so that the gradient uses more neighbours; None for `Paper`.
        undetermined: vertices where no choice of neighbours determines the fit. The gradient loses its order there, and
            so does the Laplacian of `Polynomial`.
        rings: (V,) the number of rings that each Laplacian row of `Monotone` was chosen from; None for other schemes.
        residual: (V,) the relative moment residual of each Laplacian row of `Monotone`; None for other schemes.
        cotangent: vertices whose Laplacian row is the cotangent row of the intrinsic Delaunay triangulation. These are
            vertices without a consistent non-negative row; obtuse corners of the boundary, where fields are not smooth;
            and vertices whose edge lengths differ so much that a fit would be lost in rounding. Such a row is correct
            in the weak sense: solutions converge, but the Laplacian of a field at the vertex itself need not.
        inconsistent: vertices that have neither a consistent non-negative row nor a cotangent row. Diffusion is stable
            there, but not accurate.
        extrinsic: corners of folded faces and their neighbours. Their rows are laid out in space.
        creased: vertices whose neighbours lie across a crease, so that no height fit is made there.
        flips: number of edge flips that lead to the intrinsic Delaunay triangulation.
        seconds: the time that each part of the construction took.
    """

    dropped_faces: np.ndarray | None = None
    wide_gradient_rows: np.ndarray | None = None
    undetermined: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    rings: np.ndarray | None = None
    residual: np.ndarray | None = None
    cotangent: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    inconsistent: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    extrinsic: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    creased: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    flips: int = 0
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)

    # All reports compare equal, so that surfaces that differ only in their report share compiled code.
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
            is_fitted = np.ones(len(self.rings), bool)
            is_fitted[np.concatenate([self.cotangent, self.inconsistent]).astype(int)] = False
            lines += [
                (f"Laplacian rows from {n} ring{'s' * (n > 1)}", f"{np.sum(is_fitted & (self.rings == n))}")
                for n in (1, 2, 3)
            ]
            lines.append(("cotangent Laplacian rows", f"{len(self.cotangent)}"))
            lines.append(("inconsistent Laplacian rows", f"{len(self.inconsistent)}"))
            if len(self.inconsistent):
                lines.append(("worst moment residual", f"{self.residual[self.inconsistent].max():.2g}"))
        counts = (
            ("rows laid out in space at folded faces", len(self.extrinsic)),
            ("vertices at creases", len(self.creased)),
            ("edges flipped to intrinsic Delaunay", self.flips),
        )
        lines += [(name, f"{count}") for name, count in counts if count]
        lines += [(f"seconds for {part}", f"{seconds:.2f}") for part, seconds in self.seconds.items()]
        return "\n".join(f"{name:<40}{value}" for name, value in lines)


def warn_of_rows(report: SurfaceReport, scheme: Scheme, stacklevel: int) -> None:
    """Warn if some rows are inconsistent or undetermined."""
    if len(report.inconsistent):
        residual = np.asarray(report.residual)
        worst = report.inconsistent[np.argmax(residual[report.inconsistent])]
        warnings.warn(
            f"{len(report.inconsistent)} of {len(residual)} vertices have no consistent non-negative row; the worst is "
            f"vertex {worst}. Diffusion stays stable there, but is not accurate. Causes are spikes, folds and slivers: "
            "see surface.report.inconsistent, and remesh around them.",
            InconsistentRowsWarning,
            stacklevel=stacklevel + 1,
        )
    elif isinstance(scheme, Polynomial) and len(report.undetermined):
        warnings.warn(
            f"At {len(report.undetermined)} vertices (the first is vertex {report.undetermined[0]}), five rings of "
            f"neighbours do not determine a polynomial of degree {scheme.degree}. The mesh is too coarse or too thin "
            "there: subdivide it, or use ltl.Monotone().",
            InconsistentRowsWarning,
            stacklevel=stacklevel + 1,
        )


def warn_of_coarse_mesh(topology: Topology, normals: np.ndarray, scheme: Scheme, stacklevel: int) -> None:
    """Warn if the surface curves too much over the neighbours of a polynomial fit."""
    if not isinstance(scheme, Polynomial):
        return

    def normal_distance(block):
        return np.linalg.norm(block.neighbours(normals) - block.centre(normals)[None], axis=2).max(axis=0)

    turn = 2 * np.arcsin(np.minimum(topology.jet.map(normal_distance) / 2, 1))
    # The turn across a crease says nothing about the smooth sides.
    smooth = turn if topology.is_creased is None else turn[~topology.is_creased]
    if smooth.size and (most := np.quantile(smooth, 1 - _COARSE_SHARE)) > _COARSE:
        warnings.warn(
            f"The mesh is coarse against its curvature: at {_COARSE_SHARE:.0%} of the vertices normals turn by more "
            f"than {np.degrees(most):.0f} degrees over the neighbours of one fit. Beyond {np.degrees(_COARSE):.0f} "
            "degrees, ltl.Monotone() is at least as accurate for Poisson's equation: use it, or subdivide the mesh.",
            CoarseMeshWarning,
            stacklevel=stacklevel + 1,
        )
