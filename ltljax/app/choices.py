"""The words that the command line accepts, in a file of its own so that ``ltljax --help`` loads nothing else."""

# Shapes that can be named in place of a mesh file.
MESHES = ("sphere", "torus", "disk", "box")
SCHEMES = ("monotone", "polynomial", "paper")
DTYPES = ("float32", "float64")
# The sides from which pictures are taken: the keys of ltljax._output.pictures.VIEWS.
VIEWS = ("aslant", "front", "back", "right", "left", "top", "bottom")
DENOISING_METHODS = ("tv", "heat", "perona-malik")
# The functions of ltljax.imaging that smooth a mesh, with hyphens.
SMOOTHING_METHODS = ("mean-curvature-flow", "fair", "filter-normals")
# Their names in version 0.1.
RENAMED_SMOOTHING_METHODS = {"flow": "mean-curvature-flow", "features": "filter-normals"}
LINE_FIELDS = ("smallest", "largest", "cross", "rotation")
