"""Flow visualisation: streamlines and line integral convolution.

What enters: a surface and a tangent vector field (V, 3). What leaves: points along the field lines, one grey value per
vertex, or a picture.
"""
