"""Results on disk and pictures. Never needed to compute; imported only where something is written.

What enters: NumPy arrays. What leaves: VTK series for ParaView, PLY with colours, PNG and MP4 (with the extra `viz`).
"""
