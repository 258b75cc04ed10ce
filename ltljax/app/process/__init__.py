"""Commands on a mesh file: denoise, smooth, lic, curvature, distance.

What enters: the name of a mesh and what to do with it. What leaves: a folder with pictures, data and a record of both.
"""

from .images import denoise
from .shapes import curvature, distance, lic, smooth

__all__ = ["curvature", "denoise", "distance", "lic", "smooth"]
