"""Meshes with creases, cone points and corners, whose exact geometry is known."""

import numpy as np

import ltljax as ltl


def strip(n, degrees, amount=0.3, diagonals="random"):
    """The strip [0, 2] x [0, 1], bent along x = 1 by an angle and jittered in its own plane, and x before bending."""
    random = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(2 * n + 1) / n, np.arange(n + 1) / n, indexing="ij")
    dx, dy = random.uniform(-amount / n, amount / n, (2, *x.shape))
    dx[[0, n, -1]], dy[:, [0, -1]] = 0, 0
    x, y = (x + dx).ravel(), (y + dy).ravel()
    corner = np.arange(x.size).reshape(2 * n + 1, n + 1)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
    flips = random.random(len(a)) < 0.5 if diagonals == "random" else np.zeros(len(a), bool)
    lower = np.where(flips[:, None], np.stack([a, b, d], axis=1), np.stack([a, b, c], axis=1))
    upper = np.where(flips[:, None], np.stack([b, c, d], axis=1), np.stack([a, c, d], axis=1))
    angle, beyond = np.radians(degrees), np.maximum(x - 1, 0)
    bent = np.stack([np.minimum(x, 1) + beyond * np.cos(angle), y, beyond * np.sin(angle)], axis=1)
    return ltl.Mesh(bent, np.concatenate([lower, upper])), x


def cone(half_angle, rings):
    """A cone with generators of length 1 and its tip at the origin, the distances from the tip, and the azimuths."""
    vertices, radius, azimuth = [np.zeros(3)], [0.0], [0.0]
    for ring in range(1, rings + 1):
        for k in range(6 * rings):
            t = 2 * np.pi * (k + ring / 2) / (6 * rings)
            r = ring / rings
            vertices.append(r * np.array([np.sin(half_angle) * np.cos(t), np.sin(half_angle) * np.sin(t), 0]))
            vertices[-1][2] = -r * np.cos(half_angle)
            radius.append(r)
            azimuth.append(t)
    count = 6 * rings
    k = np.arange(count)
    faces = [np.stack([0 * k, 1 + k, 1 + (k + 1) % count], axis=1)]
    for ring in range(rings - 1):
        own, after = 1 + ring * count + k, 1 + ring * count + (k + 1) % count
        faces += [np.stack([own, own + count, after], axis=1), np.stack([after, own + count, after + count], axis=1)]
    return ltl.Mesh(np.array(vertices), np.concatenate(faces)), np.array(radius), np.array(azimuth)


def saddle(turns):
    """Four rings around a vertex whose face angles sum to 3.2 (turns = 1.8) or 5.2 (turns = 3) times 2 pi."""
    count, rings = round(12 * turns), 4
    t = 2 * np.pi * np.arange(count) / count
    height = np.cos(round(turns * 2) * t)
    ring = np.stack([np.cos(t), np.sin(t), 1.6 * turns * height], axis=1)
    vertices = [np.zeros((1, 3))] + [r / rings * ring for r in range(1, rings + 1)]
    return ltl.Mesh(np.concatenate(vertices), _closed_ring_faces(count, rings))


def graded_disk(radii, count=12):
    """A flat disk with rings of vertices at the given radii."""
    t = 2 * np.pi * np.arange(count) / count
    ring = np.stack([np.cos(t), np.sin(t), 0 * t], axis=1)
    vertices = [np.zeros((1, 3))] + [r * ring for r in radii]
    return ltl.Mesh(np.concatenate(vertices), _closed_ring_faces(count, len(radii)))


def _closed_ring_faces(count, rings):
    """The faces of vertex 0 and rings of ``count`` vertices around it."""
    k, after = np.arange(count), (np.arange(count) + 1) % count
    faces = [np.stack([0 * k, 1 + k, 1 + after], axis=1)]
    for ring in range(rings - 1):
        a, b = 1 + ring * count + k, 1 + ring * count + after
        faces += [np.stack([a, a + count, b], axis=1), np.stack([b, a + count, b + count], axis=1)]
    return np.concatenate(faces)


def slit(angle, rings=6):
    """A sector of the unit disk with the given angle and a vertex at its tip."""
    count = 24
    t = np.linspace(0, angle, count + 1)
    r = (np.arange(1, rings + 1) / rings)[:, None]
    points = np.stack([(r * np.cos(t)).ravel(), (r * np.sin(t)).ravel()], axis=1)
    # The two boundary edges at the tip get different lengths.
    points[0] *= 0.6
    k = np.arange(count)
    faces = [np.stack([0 * k, 1 + k, 2 + k], axis=1)]
    for ring in range(rings - 1):
        a = 1 + ring * (count + 1) + k
        b = a + count + 1
        faces += [np.stack([a, b, a + 1], axis=1), np.stack([a + 1, b, b + 1], axis=1)]
    vertices = np.concatenate([np.zeros((1, 2)), points])
    return ltl.Mesh(np.pad(vertices, ((0, 0), (0, 1))), np.concatenate(faces))


def union(*meshes):
    """One mesh with the given meshes as its connected components."""
    starts = np.cumsum([0, *(mesh.num_vertices for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    return ltl.Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def blade(n, thickness):
    """A square plate of very small thickness, with both of its sides and its rim."""
    mesh = ltl.shapes.box(n=n)
    return ltl.Mesh(mesh.vertices * [1, 1, thickness], mesh.faces)
