"""The commands on a mesh: denoise, smooth, lic, curvature, distance.

What enters: the name of a mesh and the options of a command. What leaves: a folder with pictures, data and a record.
"""

from .images import denoise
from .shapes import curvature, distance, lic, smooth

__all__ = ["curvature", "denoise", "distance", "lic", "smooth"]
