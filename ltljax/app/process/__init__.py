"""The commands on a mesh: denoise, smooth, lic, curvature, distance.

What enters: the name of a mesh and the options of a command. What leaves: a folder with pictures, data and a record.
"""

from .drawing import curvature, distance, lic
from .images import denoise
from .smoothing import smooth

__all__ = ["curvature", "denoise", "distance", "lic", "smooth"]
