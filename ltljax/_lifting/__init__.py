"""The method: from vertex positions to weights.

Inputs: positions, and the frozen topology (which neighbours each row uses). Outputs: normals, tangent frames, the
lifted neighbours of every vertex, and the weights of the gradient and the Laplacian on them, as pure functions of the
positions. Three modules run on the host and choose the frozen topology: `delaunay` chooses the edge flips of the
intrinsic triangulation, `charts` and `support` choose the neighbours of every row.
"""
