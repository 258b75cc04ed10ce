"""Eigenfunctions of the Laplacian on seven families of meshes, with their gradients, and the exact spectra."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
import scipy.linalg
import scipy.special

import ltljax as ltl


class Mode(NamedTuple):
    """An eigenfunction at the vertices, Delta values = -eigenvalue * values, and its tangential gradient."""

    eigenvalue: float
    values: np.ndarray
    gradient: np.ndarray


class Family(NamedTuple):
    """Meshes of one surface. Refinement 0 has about 640 vertices, and each refinement has four times as many."""

    make: Callable[[int], ltl.Mesh]
    modes: Callable[[np.ndarray], list[Mode]]
    spectrum: Callable[[], np.ndarray]


# Harmonic polynomials by eigenvalue. Restricted to the unit sphere they are all eigenfunctions up to 12 = 3 (3 + 1).
HARMONICS = {
    2.0: (lambda x, y, z: x, lambda x, y, z: y, lambda x, y, z: z),
    6.0: (
        lambda x, y, z: x * y,
        lambda x, y, z: y * z,
        lambda x, y, z: z * x,
        lambda x, y, z: x**2 - y**2,
        lambda x, y, z: 2 * z**2 - x**2 - y**2,
    ),
    12.0: (
        lambda x, y, z: x * y * z,
        lambda x, y, z: x * (x**2 - 3 * y**2),
        lambda x, y, z: y * (3 * x**2 - y**2),
        lambda x, y, z: z * (x**2 - y**2),
        lambda x, y, z: x * (4 * z**2 - x**2 - y**2),
        lambda x, y, z: y * (4 * z**2 - x**2 - y**2),
        lambda x, y, z: z * (2 * z**2 - 3 * x**2 - 3 * y**2),
    ),
}


def sphere_modes(vertices):
    """Spherical harmonics of degrees 1 to 3."""
    modes = []
    for eigenvalue, polynomials in HARMONICS.items():
        for polynomial in polynomials:
            gradient = np.stack(jax.vmap(jax.grad(polynomial, argnums=(0, 1, 2)))(*vertices.T), axis=1)
            gradient -= np.sum(gradient * vertices, axis=1, keepdims=True) * vertices
            modes.append(Mode(eigenvalue, polynomial(*vertices.T), gradient))
    return modes


def hemisphere_modes(vertices):
    """Spherical harmonics of degrees 1 to 3 that are even in z, whose flux through the equator is zero."""
    mirrored = sphere_modes(vertices * [1, 1, -1])
    return [
        mode
        for mode, mirror in zip(sphere_modes(vertices), mirrored, strict=True)
        if np.allclose(*(m.values for m in (mode, mirror)))
    ]


def sphere_spectrum():
    return np.repeat([degree * (degree + 1.0) for degree in range(1, 8)], [2 * degree + 1 for degree in range(1, 8)])


def hemisphere_spectrum():
    return np.repeat([degree * (degree + 1.0) for degree in range(1, 8)], [degree + 1 for degree in range(1, 8)])


def disk_modes(vertices):
    """J_m(k r) times cos(m theta) or sin(m theta), with J_m'(k) = 0 (zero flux through the rim) and k^2 <= 30."""
    r, theta = np.hypot(vertices[:, 0], vertices[:, 1]), np.arctan2(vertices[:, 1], vertices[:, 0])
    outward = np.stack([np.cos(theta), np.sin(theta), 0 * theta], axis=1)
    around = np.stack([-np.sin(theta), np.cos(theta), 0 * theta], axis=1)
    modes = []
    for m in range(6):
        for k in scipy.special.jnp_zeros(m, 3):
            for wave, slope_of_wave in waves_around(m, theta) if k**2 <= 30 else ():
                slope = k * scipy.special.jvp(m, k * r) * wave
                # m J_m(k r) / r is written as k (J_(m-1) + J_(m+1)) / 2, which is finite at the centre.
                turn = k * (scipy.special.jv(m - 1, k * r) + scipy.special.jv(m + 1, k * r)) / 2 * slope_of_wave
                modes.append(
                    Mode(k**2, scipy.special.jv(m, k * r) * wave, slope[:, None] * outward + turn[:, None] * around)
                )
    return modes


def waves_around(m, angle):
    """cos(m angle) and sin(m angle), each with its derivative divided by m."""
    return [(np.cos(m * angle), -np.sin(m * angle)), (np.sin(m * angle), np.cos(m * angle))][: 2 if m else 1]


def disk_spectrum():
    squares = [np.repeat(scipy.special.jnp_zeros(m, 6) ** 2, 2 if m else 1) for m in range(10)]
    return np.sort(np.concatenate(squares))


MAJOR, MINOR = 2.0, 1.0
FREQUENCIES = np.fft.fftfreq(65, 1 / 65)


@functools.cache
def torus_profiles(m):
    """Eigenvalues, and Fourier coefficients (N, 65) of w, for eigenfunctions w(p) cos(m q) of the torus.

    They solve -(s w')' / r^2 + m^2 w / s = eigenvalue * s w with s = a + r cos p. Fourier collocation is exact to
    rounding.
    """
    p = 2 * np.pi * np.arange(len(FREQUENCIES)) / len(FREQUENCIES)
    s = MAJOR + MINOR * np.cos(p)
    derive = np.fft.ifft(1j * FREQUENCIES[:, None] * np.fft.fft(np.eye(len(p)), axis=0), axis=0).real
    stiffness = derive.T @ np.diag(s) @ derive / MINOR**2 + np.diag(m**2 / s)
    eigenvalues, profiles = scipy.linalg.eigh(stiffness, np.diag(s))
    profiles = profiles * np.sign(profiles[1]) / np.abs(profiles).max(axis=0)
    return eigenvalues, np.fft.fft(profiles, axis=0).T / len(p)


def torus_modes(vertices):
    """Eigenfunctions w(p) times cos(m q) or sin(m q) up to 2.1, with p around the tube and q around the axis."""
    x, y, z = vertices.T
    p, q = np.arctan2(z, np.hypot(x, y) - MAJOR), np.arctan2(y, x)
    up = np.stack([-np.sin(p) * np.cos(q), -np.sin(p) * np.sin(q), np.cos(p)], axis=1)
    around = np.stack([-np.sin(q), np.cos(q), 0 * q], axis=1)
    waves = np.exp(1j * p[:, None] * FREQUENCIES)
    modes = []
    for m in range(4):
        for eigenvalue, coefficients in zip(*torus_profiles(m), strict=True):
            if not 1e-8 < eigenvalue <= 2.1:
                continue
            w, w_p = (waves @ coefficients).real, (waves @ (1j * FREQUENCIES * coefficients)).real / MINOR
            for wave, slope_of_wave in waves_around(m, q):
                turn = m * w * slope_of_wave / (MAJOR + MINOR * np.cos(p))
                modes.append(Mode(eigenvalue, w * wave, (w_p * wave)[:, None] * up + turn[:, None] * around))
    return modes


def torus_spectrum():
    values = [np.repeat(torus_profiles(m)[0][:12], 2 if m else 1) for m in range(10)]
    return np.sort(np.concatenate(values))[1:]  # without the eigenvalue 0


def jittered_hemisphere(refinement):
    smooth = ltl.shapes.hemisphere(rings=14 * 2**refinement)
    return ltl.shapes.jittered(smooth, 0.2, seed=0, project=lambda x: x / np.linalg.norm(x, axis=1, keepdims=True))


FAMILIES = {
    "icosphere": Family(lambda k: ltl.shapes.icosphere(3 + k), sphere_modes, sphere_spectrum),
    "jittered sphere": Family(lambda k: ltl.shapes.jittered_sphere(3 + k, 0.5, seed=0), sphere_modes, sphere_spectrum),
    "random sphere": Family(lambda k: ltl.shapes.random_sphere(640 * 4**k + 2, seed=0), sphere_modes, sphere_spectrum),
    "torus": Family(lambda k: ltl.shapes.torus(MAJOR, MINOR, 36 * 2**k, 18 * 2**k), torus_modes, torus_spectrum),
    # The vertices move but not the faces, so that about one face in a hundred is folded over.
    "jittered torus": Family(
        lambda k: ltl.shapes.jittered_torus(36 * 2**k, 18 * 2**k, amount=0.45, seed=0, major=MAJOR, minor=MINOR),
        torus_modes,
        torus_spectrum,
    ),
    "disk": Family(
        lambda k: ltl.shapes.jittered(ltl.shapes.disk(rings=14 * 2**k), 0.2, seed=0), disk_modes, disk_spectrum
    ),
    "hemisphere": Family(jittered_hemisphere, hemisphere_modes, hemisphere_spectrum),
}
