"""Differential operators on scalar fields, their spectra, and the curvature of the surface."""

from ._operators.curvature import Curvature, PolyhedralCurvature, curvature, polyhedral_curvature
from ._operators.elliptic import EllipticStencil, direction_tensor, elliptic_stencil
from ._operators.scalar import (
    divergence,
    gradient,
    growth_rate,
    hessian,
    integrate,
    laplacian,
    laplacian_matrix,
    spectral_bound,
    spectral_width,
    weighted_laplacian,
)

__all__ = [
    "Curvature",
    "EllipticStencil",
    "PolyhedralCurvature",
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
