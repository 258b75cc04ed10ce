"""Tangent vector fields, (V, 3) in ambient coordinates: their derivatives, transport, and decompositions."""

from ._operators import (
    Connection,
    connection,
    covariant_derivative,
    curl,
    from_frame,
    hodge_laplacian,
    lie_bracket,
    lie_derivative,
    rotated,
    rotated_gradient,
    singularities,
    tangential,
    tensor_laplacian,
    to_frame,
    transport_along,
    vector_laplacian,
)
from ._solve.hodge import HarmonicFields, HodgeParts, harmonic_fields, helmholtz_hodge
from ._solve.vector_heat import connection_matrix, direction_field, transport_vectors

__all__ = [
    "Connection",
    "HarmonicFields",
    "HodgeParts",
    "connection",
    "connection_matrix",
    "covariant_derivative",
    "curl",
    "direction_field",
    "from_frame",
    "harmonic_fields",
    "helmholtz_hodge",
    "hodge_laplacian",
    "lie_bracket",
    "lie_derivative",
    "rotated",
    "rotated_gradient",
    "singularities",
    "tangential",
    "tensor_laplacian",
    "to_frame",
    "transport_along",
    "transport_vectors",
    "vector_laplacian",
]


def __dir__() -> list[str]:
    return sorted(__all__)
