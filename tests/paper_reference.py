"""The formulas of Chen, Chi and Wu (arXiv 0907.1817), transcribed one vertex at a time in NumPy.

Slow on purpose and written without a look at the package: the independent word the tests hold `ltl.Paper()` to.

`angles` turns the basis of each tangent plane; `at` names the vertices to work at (all of them by default), and what
is not asked for is NaN.
"""

import numpy as np


def faces_at(faces, num_vertices):
    """For each vertex the pairs (i, j) of the faces (v, i, j) around it, in the faces' own orientation."""
    around = [[] for _ in range(num_vertices)]
    for a, b, c in faces:
        around[a].append((b, c))
        around[b].append((c, a))
        around[c].append((a, b))
    return around


def normal(vertices, v, pairs):
    """Section 2.1: face normals averaged with weights |G - v|^-2, G the centroid of the face."""
    total = np.zeros(3)
    for i, j in pairs:
        face_normal = np.cross(vertices[i] - vertices[v], vertices[j] - vertices[v])
        centroid = (vertices[v] + vertices[i] + vertices[j]) / 3
        total += face_normal / np.linalg.norm(face_normal) / np.sum((centroid - vertices[v]) ** 2)
    return total / np.linalg.norm(total)


def basis(n, angle=0.0):
    """An orthonormal basis (2, 3) of the plane orthogonal to n, turned by `angle`; no result depends on it."""
    helper = np.eye(3)[np.argmin(np.abs(n))]
    e1 = np.cross(n, helper)
    e1 /= np.linalg.norm(e1)
    e2 = np.cross(n, e1)
    return np.array([np.cos(angle) * e1 + np.sin(angle) * e2, -np.sin(angle) * e1 + np.cos(angle) * e2])


def lifted_faces(vertices, v, pairs, frame):
    """The lifted polygon: for each face its pair, the two lifted corners (2, 2) and its normalised centroid weight."""
    out, total = [], 0.0
    for i, j in pairs:
        corners = np.array([frame @ (vertices[i] - vertices[v]), frame @ (vertices[j] - vertices[v])])
        centroid = corners.sum(axis=0) / 3
        weight = 1 / np.sum(centroid**2)
        out.append((i, j, corners, weight))
        total += weight
    return [(i, j, corners, weight / total) for i, j, corners, weight in out]


def gradients(vertices, faces, u, angles=None, at=None):
    """Gradient (V, 3): the affine gradient of each lifted face, averaged with the centroid weights."""
    around = faces_at(faces, len(vertices))
    out = np.full((len(vertices), 3), np.nan)
    for v in range(len(vertices)) if at is None else at:
        pairs = around[v]
        frame = basis(normal(vertices, v, pairs), 0.0 if angles is None else angles[v])
        out[v] = 0
        for i, j, corners, weight in lifted_faces(vertices, v, pairs, frame):
            out[v] += weight * np.linalg.solve(corners, [u[i] - u[v], u[j] - u[v]]) @ frame
    return out


def transport(n_from, n_to, X):
    """Parallel transport L of a tangent vector X: the rotation that takes n_from to n_to about n_from x n_to."""
    axis = np.cross(n_from, n_to)
    sine, cosine = np.linalg.norm(axis), n_from @ n_to
    if sine < 1e-300:
        return X
    axis = axis / sine
    return cosine * X + sine * np.cross(axis, X) + (1 - cosine) * (axis @ X) * axis


def divergences(vertices, faces, X, angles=None, at=None):
    """Divergence (V,): the trace of the averaged gradient of the transported components."""
    around = faces_at(faces, len(vertices))
    out = np.full(len(vertices), np.nan)
    for v in range(len(vertices)) if at is None else at:
        pairs = around[v]
        normals = {k: normal(vertices, k, around[k]) for k in {v}.union(*pairs)}
        frame = basis(normals[v], 0.0 if angles is None else angles[v])
        here = frame @ X[v]
        out[v] = 0
        for i, j, corners, weight in lifted_faces(vertices, v, pairs, frame):
            there = np.array([frame @ transport(normals[k], normals[v], X[k]) - here for k in (i, j)])
            out[v] += weight * np.trace(np.linalg.solve(corners, there))
    return out


def laplacians(vertices, faces, u, angles=None, at=None):
    """Laplacian (V,): the divergence of the gradient."""
    at = range(len(vertices)) if at is None else at
    around = faces_at(faces, len(vertices))
    nearby = {int(k) for v in at for k in {v}.union(*around[v])}
    return divergences(vertices, faces, gradients(vertices, faces, u, angles, nearby), angles, at)
