"""Image processing, mesh processing and flow visualisation on surfaces.

Images: denoising, diffusion, inpainting, segmentation. Meshes: fairing, mean curvature flow, bilateral normal
filtering, ridges. Vector fields: streamlines and line integral convolution.
"""

from ._imaging.flow.lic import lic_picture, line_integral_convolution
from ._imaging.flow.noise import SolidNoise, solid_noise
from ._imaging.flow.tracing import Streamlines, streamlines
from ._imaging.images.anisotropic import (
    AnisotropicDiffusion,
    anisotropic_diffusion,
    coherence_enhancing,
    diffusion_tensor,
    edge_enhancing,
    structure_tensor,
)
from ._imaging.images.diffusion import PeronaMalik, diffuse, local_mean, perona_malik, sharpen, smoothed as smoothed
from ._imaging.images.directions import denoise_chromaticity, diffuse_directions
from ._imaging.images.inpainting import inpaint
from ._imaging.images.quality import mse, psnr, ssim
from ._imaging.images.segmentation import Segmentation, segment
from ._imaging.images.textures import from_texture, project_image, to_texture
from ._imaging.images.total_variation import denoise, noise_strength
from ._imaging.shapes.fairing import fair, mean_curvature_flow
from ._imaging.shapes.normal_filter import denoise_mesh as denoise_mesh, filter_normals
from ._imaging.shapes.relief import Ridges, ridges, shape_index
from ._imaging.shapes.volume import enclosed_volume
from ._show import displaced

__all__ = [
    "AnisotropicDiffusion",
    "PeronaMalik",
    "Ridges",
    "Segmentation",
    "SolidNoise",
    "Streamlines",
    "anisotropic_diffusion",
    "coherence_enhancing",
    "denoise",
    "denoise_chromaticity",
    "diffuse",
    "diffuse_directions",
    "diffusion_tensor",
    "displaced",
    "edge_enhancing",
    "enclosed_volume",
    "fair",
    "filter_normals",
    "from_texture",
    "inpaint",
    "lic_picture",
    "line_integral_convolution",
    "local_mean",
    "mean_curvature_flow",
    "mse",
    "noise_strength",
    "perona_malik",
    "project_image",
    "psnr",
    "ridges",
    "segment",
    "shape_index",
    "sharpen",
    "solid_noise",
    "ssim",
    "streamlines",
    "structure_tensor",
    "to_texture",
]


def __dir__() -> list[str]:
    return sorted(__all__)
