"""Meshes of standard shapes, and random or jittered meshes to measure accuracy on irregular meshes."""

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
