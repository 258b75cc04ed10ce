"""Differential operators on scalar fields, their spectra, and the curvature of the surface."""

from ._operators import (
    Curvature,
    EllipticStencil,
    PolyhedralCurvature,
    curvature,
    direction_tensor,
    divergence,
    elliptic_stencil,
    gradient,
    growth_rate,
    hessian,
    integrate,
    laplacian,
    laplacian_matrix,
    polyhedral_curvature,
    spectral_bound,
    spectral_width,
    weighted_laplacian,
)
from ._tables import ComposedStencil, Stencil

__all__ = [
    "ComposedStencil",
    "Curvature",
    "EllipticStencil",
    "PolyhedralCurvature",
    "Stencil",
    "curvature",
    "direction_tensor",
    "divergence",
    "elliptic_stencil",
    "gradient",
    "growth_rate",
    "hessian",
    "integrate",
    "laplacian",
    "laplacian_matrix",
    "polyhedral_curvature",
    "spectral_bound",
    "spectral_width",
    "weighted_laplacian",
]


def __dir__() -> list[str]:
    return sorted(__all__)
