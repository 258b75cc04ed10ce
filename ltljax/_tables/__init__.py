"""Padded neighbour tables, and the one loop that everything runs through: a weighted sum over the slots of a row.

What enters: rows of neighbours of any length, on the host. What leaves: a `Table`, and a `Stencil` of weights on it: a
linear operator with all derivatives. This room knows no geometry.
"""

from .contraction import difference_sum, differences
from .stencil import ComposedStencil, Mean, Stencil
from .table import (
    AnyArray,
    Block,
    Reverse,
    ReverseWeights,
    Table,
    build_table,
    coordinates,
    difference_matrix,
    reverse_weights,
    reversible,
    slot_sum,
    slot_values,
    take,
    weighted_table,
)

__all__ = [
    "AnyArray",
    "Block",
    "ComposedStencil",
    "Mean",
    "Reverse",
    "ReverseWeights",
    "Stencil",
    "Table",
    "build_table",
    "coordinates",
    "difference_matrix",
    "difference_sum",
    "differences",
    "reverse_weights",
    "reversible",
    "slot_sum",
    "slot_values",
    "take",
    "weighted_table",
]
