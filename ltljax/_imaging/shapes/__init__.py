"""The shape of the surface itself: mesh smoothing, and pictures of how the surface bends.

What enters: a surface. What leaves: new positions of its vertices (V, 3), with the faces unchanged, or fields that show
its ridges and valleys.
"""
