"""Images on surfaces: filters, inpainting and segmentation.

What enters: a surface and an image, one value per vertex (V,) or several colours (V, C). What leaves: an image of the
same shape, a segmentation, or a number that compares two images. The vertices do not move.
"""
