"""The method: from vertex positions to weights.

What enters: positions, and the frozen topology (which neighbours a row uses). What leaves: normals, tangent frames, the
lifted neighbours of every vertex, and the weights of the gradient and the Laplacian on them, as pure functions of the
positions. Three host files choose what is frozen: `delaunay` the flips of the intrinsic triangulation, `charts` and
`support` the neighbours of every row.
"""
