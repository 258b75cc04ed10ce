"""Differential operators: ``(surface, field) -> field``.

What enters: a `Surface` and fields on its vertices. What leaves: fields; `scalar` has the calculus of scalar fields,
`tangent` that of vector fields, `elliptic` general second-order operators, `spectra` where eigenvalues lie, and
`curvature` the curvature of the surface.
"""

from .curvature import Curvature, PolyhedralCurvature, curvature, polyhedral_curvature
from .elliptic import EllipticStencil, direction_tensor, elliptic_stencil
from .scalar import (
    add_flux,
    divergence,
    gradient,
    hessian,
    integrate,
    laplacian,
    laplacian_matrix,
    through_sides,
    weighted_laplacian,
)
from .spectra import growth_rate, spectral_bound, spectral_width
from .tangent import (
    Connection,
    check_tangent,
    check_vectors,
    connection,
    covariant_derivative,
    curl,
    from_frame,
    hodge_laplacian,
    lie_bracket,
    lie_derivative,
    power,
    rotated,
    rotated_gradient,
    singularities,
    tangential,
    tensor_laplacian,
    to_frame,
    transport_along,
    vector_laplacian,
)

__all__ = [
    "Connection",
    "Curvature",
    "EllipticStencil",
    "PolyhedralCurvature",
    "add_flux",
    "check_tangent",
    "check_vectors",
    "connection",
    "covariant_derivative",
    "curl",
    "curvature",
    "direction_tensor",
    "divergence",
    "elliptic_stencil",
    "from_frame",
    "gradient",
    "growth_rate",
    "hessian",
    "hodge_laplacian",
    "integrate",
    "laplacian",
    "laplacian_matrix",
    "lie_bracket",
    "lie_derivative",
    "polyhedral_curvature",
    "power",
    "rotated",
    "rotated_gradient",
    "singularities",
    "spectral_bound",
    "spectral_width",
    "tangential",
    "tensor_laplacian",
    "through_sides",
    "to_frame",
    "transport_along",
    "vector_laplacian",
    "weighted_laplacian",
]
