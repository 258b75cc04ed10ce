"""A slow NumPy transcription of Chen, Chi and Wu, "A new intrinsic numerical method for PDE on surfaces".

The paper is arXiv 0907.1817 (2009), and all formulas are from its Section 2. Each function handles one vertex at a time
and was written from the formulas alone, without reading the package, so that the tests compare `ltl.Paper()` with an
independent implementation.

In all functions `vertices` is an array (V, 3), `faces` is an array (F, 3), and all faces have the same orientation.
`angles` (V,) rotates the basis used in each tangent plane, which changes no result. `at` lists the vertices at which
the operator is evaluated, by default all of them; the result is NaN at every other vertex.
"""

import numpy as np


def faces_at(faces, num_vertices):
    """For each vertex v, the list of pairs (i, j) such that (v, i, j) is a face in its given orientation."""
    pairs = [[] for _ in range(num_vertices)]
    for a, b, c in faces:
        pairs[a].append((b, c))
        pairs[b].append((c, a))
        pairs[c].append((a, b))
    return pairs


def normal(vertices, v, pairs):
    """Unit normal N(v): the mean of the face normals around v, normalised (paper, Section 2.1).

    The weight of a face is |G - v|^-2, where G is the centroid of the face.
    """
    total = np.zeros(3)
    for i, j in pairs:
        face_normal = np.cross(vertices[i] - vertices[v], vertices[j] - vertices[v])
        face_normal /= np.linalg.norm(face_normal)
        centroid = (vertices[v] + vertices[i] + vertices[j]) / 3
        total += face_normal / np.sum((centroid - vertices[v]) ** 2)
    return total / np.linalg.norm(total)


def basis(n, angle=0.0):
    """Orthonormal basis (2, 3) of the plane orthogonal to the unit vector n, rotated by `angle` about n.

    The paper allows any basis of TS(v) (Section 2), and no result depends on the choice.
    """
    axis = np.eye(3)[np.argmin(np.abs(n))]
    e1 = np.cross(n, axis)
    e1 /= np.linalg.norm(e1)
    e2 = np.cross(n, e1)
    return np.array([np.cos(angle) * e1 + np.sin(angle) * e2, np.cos(angle) * e2 - np.sin(angle) * e1])


def lifted_faces(vertices, v, pairs, frame):
    """The lifted polygon around v: the orthogonal projection of the faces onto TS(v) (paper, Section 2).

    Returns one tuple (i, j, corners, weight) per face. The origin of TS(v) is v, the rows of `corners` (2, 2) are the
    coordinates of the lifted vertices i and j in `frame`, and `weight` is |lifted centroid|^-2. The weights are
    normalised to sum to one.
    """
    lifted = []
    for i, j in pairs:
        corners = np.array([frame @ (vertices[i] - vertices[v]), frame @ (vertices[j] - vertices[v])])
        centroid = (corners[0] + corners[1]) / 3
        lifted.append((i, j, corners, 1 / np.sum(centroid**2)))
    total = sum(weight for _, _, _, weight in lifted)
    return [(i, j, corners, weight / total) for i, j, corners, weight in lifted]


def gradients(vertices, faces, u, angles=None, at=None):
    """Gradient (V, 3) of the scalar field u (V,) (paper, Section 2).

    On each lifted face, u is the affine function with the given values at v, i and j. The gradient g of that function
    solves g . p_i = u_i - u_v and g . p_j = u_j - u_v, where p_i and p_j are the lifted vertices. The gradient at v is
    the mean of these gradients with the weights of the lifted faces.
    """
    all_pairs = faces_at(faces, len(vertices))
    result = np.full((len(vertices), 3), np.nan)
    for v in range(len(vertices)) if at is None else at:
        frame = basis(normal(vertices, v, all_pairs[v]), 0.0 if angles is None else angles[v])
        gradient = np.zeros(2)
        for i, j, corners, weight in lifted_faces(vertices, v, all_pairs[v], frame):
            gradient += weight * np.linalg.solve(corners, [u[i] - u[v], u[j] - u[v]])
        result[v] = gradient @ frame
    return result


def edge_basis(edge, n):
    """Orthonormal basis (e1, e2) of the plane orthogonal to n, with e1 along the projection of `edge` onto it."""
    e1 = edge - (edge @ n) * n
    e1 /= np.linalg.norm(e1)
    return e1, np.cross(n, e1)


def transport(edge, normal_from, normal_to, X):
    """The transport L: TS(v_i) -> TS(v) of the paper (Section 2), applied to the vector X (3,) at v_i.

    `edge` is v_i - v, `normal_from` is N(v_i) and `normal_to` is N(v). With e1~ and e1 the normalised projections of
    the edge onto TS(v_i) and TS(v), e2~ = N(v_i) x e1~ and e2 = N(v) x e1, the transport is

        L(a e1~ + b e2~) = a e1 + b e2.

    The component of X normal to TS(v_i) is dropped. In general L is not the shortest rotation of N(v_i) to N(v). The
    two agree only if the edge lies in the plane spanned by the two normals.
    """
    e1_from, e2_from = edge_basis(edge, normal_from)
    e1, e2 = edge_basis(edge, normal_to)
    return (X @ e1_from) * e1 + (X @ e2_from) * e2


def divergences(vertices, faces, X, angles=None, at=None):
    """Divergence (V,) of the vector field X (V, 3) (paper, Section 2).

    The vectors at the neighbours of v are transported to TS(v), and their components in a fixed basis of TS(v) are
    differentiated like scalar fields. The divergence is the trace of the resulting Jacobian. At every vertex, only the
    tangential part of X contributes.
    """
    all_pairs = faces_at(faces, len(vertices))
    result = np.full(len(vertices), np.nan)
    for v in range(len(vertices)) if at is None else at:
        normal_v = normal(vertices, v, all_pairs[v])
        frame = basis(normal_v, 0.0 if angles is None else angles[v])
        components = {v: frame @ X[v]}
        for i in {i for pair in all_pairs[v] for i in pair}:
            edge = vertices[i] - vertices[v]
            components[i] = frame @ transport(edge, normal(vertices, i, all_pairs[i]), normal_v, X[i])
        # Row a and column b of the Jacobian hold the derivative of component b in direction a.
        jacobian = np.zeros((2, 2))
        for i, j, corners, weight in lifted_faces(vertices, v, all_pairs[v], frame):
            differences = np.array([components[i] - components[v], components[j] - components[v]])
            jacobian += weight * np.linalg.solve(corners, differences)
        result[v] = np.trace(jacobian)
    return result


def laplacians(vertices, faces, u, angles=None, at=None):
    """Laplacian (V,) of the scalar field u (V,): the divergence of its gradient (paper, Section 2)."""
    at = range(len(vertices)) if at is None else at
    all_pairs = faces_at(faces, len(vertices))
    # The divergence at v needs the gradients at v and at its neighbours.
    needed = {int(k) for v in at for k in {v}.union(*all_pairs[v])}
    return divergences(vertices, faces, gradients(vertices, faces, u, angles, needed), angles, at)
