"""The method: from vertex positions to weights.

What enters: positions, and the frozen topology (which neighbours a row uses). What leaves: normals, tangent frames, the
lifted one-ring and the weights of the gradient and the Laplacian on it, as pure JAX functions of the positions. One
host file, `support`, chooses which neighbours a row uses.
"""
