"""Files and pictures of results.

All functions take NumPy arrays. This package is not needed to compute, and is imported only to write or draw.
"""
