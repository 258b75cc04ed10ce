"""Images on surfaces for the tests of image filters: a piecewise constant cartoon, and the cartoon with noise."""

import functools
from pathlib import Path

import numpy as np
import pytest

import ltljax as ltl
from ltljax import imaging

SPOT = Path(__file__).parents[2] / "shared" / "meshes" / "spot_low.obj"
NOISE = 0.1


def cartoon(x):
    """An image that is piecewise constant on half spaces and balls."""
    u = np.zeros(len(x))
    u[x[:, 2] > 0.25] = 0.5
    u[np.linalg.norm(x - [0, 0.6, -0.6], axis=1) < 0.63] = 1.0
    u[np.linalg.norm(x - [0.3, -0.2, 0.2], axis=1) < 0.32] = 0.8
    return u


class Scene:
    """A surface, a clean image on it, and the noisy one."""

    def __init__(self, mesh, dtype=None):
        self.surface = ltl.Surface.from_mesh(mesh, dtype=dtype)
        self.x = np.asarray(mesh.vertices)
        self.clean = cartoon(self.x)
        self.noisy = self.clean + NOISE * np.random.default_rng(0).normal(size=len(self.x))
        self.edge = float(self.surface.mesh_size)

    def decibels(self, u):
        return float(imaging.psnr(self.surface, u, self.clean))


@functools.cache
def spot_scene():
    """The scene on Spot."""
    if not SPOT.exists():
        pytest.skip("the mesh spot_low.obj is not available")
    return Scene(ltl.load_mesh(SPOT))


@functools.cache
def sphere_scene():
    """The scene on a jittered sphere."""
    return Scene(ltl.shapes.jittered_sphere(3, 0.3, seed=0))


def excess(after, before):
    """The excess of values beyond their previous range, relative to that range."""
    after, before = np.asarray(after), np.asarray(before)
    beyond = np.maximum(after.max(axis=0) - before.max(axis=0), before.min(axis=0) - after.min(axis=0))
    return float((beyond / np.ptp(before, axis=0)).max())
