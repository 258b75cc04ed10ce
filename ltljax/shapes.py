"""Meshes of standard shapes: sphere, ellipsoid, torus, disk, hemisphere, square, cylinder, box, and irregular
meshes of the sphere and the torus for tests of convergence.
"""

from ._mesh.shapes import (
    box,
    cylinder,
    disk,
    ellipsoid,
    hemisphere,
    icosphere,
    jittered,
    jittered_sphere,
    jittered_torus,
    random_sphere,
    square,
    torus,
)

__all__ = [
    "box",
    "cylinder",
    "disk",
    "ellipsoid",
    "hemisphere",
    "icosphere",
    "jittered",
    "jittered_sphere",
    "jittered_torus",
    "random_sphere",
    "square",
    "torus",
]


def __dir__() -> list[str]:
    return sorted(__all__)
