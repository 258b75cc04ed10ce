"""Images and shapes on surfaces: denoising, inpainting, segmentation; fairing of meshes; pictures of vector fields."""

from .anisotropic import (
    AnisotropicDiffusion,
    anisotropic_diffusion,
    coherence_enhancing,
    diffusion_tensor,
    edge_enhancing,
    structure_tensor,
)
from .directions import denoise_chromaticity, diffuse_directions
from .fairing import fair, mean_curvature_flow
from .inpainting import inpaint
from .lines import lic_picture, line_integral_convolution
from .noise import SolidNoise, solid_noise
from .quality import mse, psnr, ssim
from .relief import Ridges, ridges, shape_index
from .scans import denoise_mesh
from .segmentation import Segmentation, segment
from .smoothing import PeronaMalik, diffuse, perona_malik, sharpen, smoothed
from .textures import from_texture, project_image, to_texture
from .tracing import Streamlines, streamlines
from .variation import denoise, noise_strength
from .volume import enclosed_volume

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
    "denoise_mesh",
    "diffuse",
    "diffuse_directions",
    "diffusion_tensor",
    "edge_enhancing",
    "enclosed_volume",
    "fair",
    "from_texture",
    "inpaint",
    "lic_picture",
    "line_integral_convolution",
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
    "smoothed",
    "solid_noise",
    "ssim",
    "streamlines",
    "structure_tensor",
    "to_texture",
]
