"""Anisotropic diffusion of images: along edges and lines, and not across them.

What enters: a surface and an image. What leaves: its structure tensor, the diffusion tensors derived from it, and the
image after diffusion. The neighbours and weights of the diffusion are chosen on the host. The weights are non-negative,
so values stay within those of the image, which symmetric differences do not guarantee.

Source: Weickert (1998), Anisotropic diffusion in image processing, Teubner, chapter 5 for both tensors.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from ..._equations import Equation
from ..._operators import EllipticStencil, divergence, elliptic_stencil, gradient
from ..._surface import Surface, on_device, on_surface
from ..._tables import AnyArray
from .checks import number, signal
from .diffusion import evolved, local_mean

# Weickert's constant, for which the flux increases with the slope up to the contrast and decreases beyond it.
_STEEPNESS = 3.31488
# Smallest eigenvalue of a diffusion tensor.
_LEAST = 1e-3


class AnisotropicDiffusion(Equation):
    """u_t = D : Hess u + b . grad u; with b = div D this is u_t = div(D grad u).

    Attributes:
        stencil: the operator, built by `elliptic_stencil`.
    """

    stencil: EllipticStencil

    def rate(self, t, surface: Surface, u):
        """The operator applied to u."""
        del t, surface
        return self.stencil(u)

    def spectral_bound(self, t, surface: Surface, u):
        """The bound of the operator's eigenvalues."""
        del t, surface
        return self.stencil.spectral_bound().astype(u.dtype)

    def spectral_width(self, t, surface: Surface, u):
        """The bound of the imaginary parts of the operator's eigenvalues."""
        del t, surface
        return self.stencil.spectral_width().astype(u.dtype)

    def diffusivities(self, u):
        """The mean of the tensor's eigenvalues."""
        return jnp.broadcast_to(self.stencil.mean_diffusion.astype(u.dtype), u.shape[1:])

    @property
    def is_affine(self) -> bool:
        """True: the rate is linear in u."""
        return True


@on_surface
def structure_tensor(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    scale: float | AnyArray,
    integration_scale: float | AnyArray,
) -> Float[Array, "V 3 3"]:
    """The local mean of grad u_s grad u_s^T: a symmetric, non-negative, tangent tensor in ambient coordinates.

    Its leading eigenvector is the direction in which the image changes most; its eigenvalues are the mean squares of
    the slopes along that direction and across it. The tensors of several colours are added. First the image is averaged
    over windows of ``scale``, then the products over windows of ``integration_scale`` (see `local_mean`). The second
    mean is taken component by component and projected to the tangent plane, with an error of the order of (window times
    curvature)^2.

    Args:
        surface: the surface.
        u: image, (V,) or (V, C).
        scale: length below which noise is ignored.
        integration_scale: length over which directions are averaged, a few lines wide.

    Raises:
        ValueError: u does not fit the surface or is NaN or infinite, or a length is negative.
    """
    slopes = gradient(surface, local_mean(surface, u, scale)).reshape(surface.num_vertices, -1, 3)
    products = jnp.einsum("vci,vcj->vij", slopes, slopes).reshape(-1, 9)
    return _onto_tangent_planes(surface, local_mean(surface, products, integration_scale).reshape(-1, 3, 3))


@on_device
def diffusion_tensor(
    surface: Surface, structure: Float[AnyArray, "..."], contrast: float | AnyArray, enhancing: str = "edges"
) -> Float[Array, "V 3 3"]:
    """The tensor (V, 3, 3) of a diffusion that enhances edges or lines, with eigenvalues from 0.001 to 1.

    Let mu_1 >= mu_2 be the eigenvalues of the structure tensor.

    - ``"edges"``: the eigenvalue is 1 along the edge and ``1 - exp(-3.31488 / (mu_1 / contrast^2)^4)`` across it, which
      is near 1 where slopes are well below the contrast and near 0 above it.
    - ``"coherence"``: the eigenvalue is 0.001 across lines and ``0.001 + 0.999 exp(-(contrast^2 / (mu_1 - mu_2))^2)``
      along them, which is near 1 where one direction dominates and 0.001 where none does.

    Args:
        surface: the surface.
        structure: (V, 3, 3) tensor from `structure_tensor`.
        contrast: threshold of the slope, in units of u over a length.
        enhancing: ``"edges"`` or ``"coherence"``.

    Raises:
        ValueError: ``enhancing`` is unknown, or the tensor does not fit the surface.

    Source: Weickert (1998), sections 5.1 and 5.2.
    """
    if enhancing not in ("edges", "coherence"):
        raise ValueError(f"Expected enhancing 'edges' or 'coherence', found {enhancing!r}.")
    _check_tensor(surface, structure)
    squared = jnp.asarray(contrast, surface.dtype) ** 2
    frames, tiny = surface.geometry.frames, jnp.finfo(surface.dtype).tiny ** 0.25
    planar = jnp.einsum("vai,vij,vbj->vab", frames, jnp.asarray(structure, surface.dtype), frames)
    half = (planar[:, 0, 0] + planar[:, 1, 1]) / 2
    x, y = (planar[:, 0, 0] - planar[:, 1, 1]) / 2, planar[:, 0, 1]
    root = jnp.sqrt(x**2 + y**2 + tiny**2)
    if enhancing == "edges":
        # At 0.1 the exponential underflows to zero; below, its derivative would be zero times infinity.
        ratio = jnp.maximum((half + root) / squared, 0.1)
        across, along = jnp.maximum(1 - jnp.exp(-_STEEPNESS / ratio**4), _LEAST), 1.0
    else:
        ratio = jnp.minimum(squared / (2 * root), 100)
        across, along = _LEAST, _LEAST + (1 - _LEAST) * jnp.exp(-(ratio**2))
    # The identity of the tangent plane, and the reflection that is +1 across the edge and -1 along it.
    plane = jnp.einsum("vai,vaj->vij", frames, frames)
    reflection = jnp.stack([jnp.stack([x, y], axis=1), jnp.stack([y, -x], axis=1)], axis=1) / root[:, None, None]
    reflection = jnp.einsum("vai,vab,vbj->vij", frames, reflection, frames)
    mean, difference = ((jnp.asarray(value) / 2)[..., None, None] for value in (across + along, across - along))
    tensor = mean * plane + difference * reflection
    return (tensor + jnp.swapaxes(tensor, 1, 2)) / 2


@on_surface
def anisotropic_diffusion(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    tensor: Float[AnyArray, "..."],
    time: float | AnyArray,
    *,
    rtol: float = 1e-3,
    progress: bool = False,
) -> Float[Array, "V *C"]:
    """The image after u_t = div(D grad u), with values within those of u (host).

    Discretises D : Hess u + (div D) . grad u with the non-negative weights of `elliptic_stencil`. Where D varies
    strongly from vertex to vertex, these add the smallest diffusion that non-negative weights allow.

    Args:
        surface: the surface; it must not be traced, but u may be.
        u: image, (V,) or (V, C).
        tensor: D, (V, 3, 3), symmetric and non-negative; only its tangent part is used.
        time: duration, in units of length squared divided by the unit of D.
        rtol: relative tolerance of a time step.
        progress: whether to show the progress of the choice of neighbours.

    Raises:
        ValueError: an array does not fit the surface or is NaN or infinite, D is not symmetric or has a negative
            eigenvalue, the time is negative, or the surface or D is being traced.
    """
    u = signal(surface, u)
    _check_tensor(surface, tensor)
    if isinstance(tensor, Tracer):
        raise ValueError(
            "The neighbours of a diffusion are chosen on the host, but its tensor is being traced by a JAX "
            "transformation. Call this function outside the transformation, or use ltl.operators.elliptic_stencil and "
            "its `with_coefficients`."
        )
    tensor = jnp.asarray(tensor, surface.dtype)
    drift = divergence(surface, tensor)
    stencil = elliptic_stencil(surface, tensor, drift, progress)
    return evolved(AnisotropicDiffusion(stencil), surface, u, time, None, rtol)


@on_surface
def edge_enhancing(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    time: float | AnyArray,
    contrast: float | AnyArray,
    scale: float | AnyArray | None = None,
    rounds: int = 4,
    **options,
) -> Float[Array, "V *C"]:
    """The image diffused where it is flat, and along its edges (host).

    Args:
        surface: the surface.
        u: image, (V,) or (V, C); its colours share their edges.
        time: duration, in units of length squared.
        contrast: slopes above this are edges.
        scale: standard deviation of the window over which slopes are averaged; by default the mean edge length.
        rounds: number of times that the tensor is computed.
        **options: ``rtol`` and ``progress``, as in `anisotropic_diffusion`.

    Raises:
        ValueError: as in `anisotropic_diffusion`, or there is less than one round.
    """
    scale = surface.mesh_size if scale is None else scale
    # An integration scale of zero keeps edges sharply localised.
    return _in_rounds(surface, u, time, rounds, lambda u: _tensor(surface, u, contrast, scale, 0.0, "edges"), options)


@on_surface
def coherence_enhancing(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    time: float | AnyArray,
    contrast: float | AnyArray,
    scale: float | AnyArray | None = None,
    integration_scale: float | AnyArray | None = None,
    rounds: int = 4,
    **options,
) -> Float[Array, "V *C"]:
    """The image diffused along its lines, which closes gaps in them (host).

    Args:
        surface: the surface.
        u: image, (V,) or (V, C).
        time: duration, in units of length squared.
        contrast: slopes in the two principal directions that differ by more than this mark a line; choose it above the
            slopes of the noise.
        scale: standard deviation of the window over which slopes are averaged; by default the mean edge length.
        integration_scale: standard deviation of the window over which directions are averaged; by default three times
            ``scale``.
        rounds: number of times that the tensor is computed.
        **options: ``rtol`` and ``progress``, as in `anisotropic_diffusion`.

    Raises:
        ValueError: as in `anisotropic_diffusion`, or there is less than one round.
    """
    scale = surface.mesh_size if scale is None else number(surface, "scale", scale)
    integration_scale = 3 * scale if integration_scale is None else integration_scale
    return _in_rounds(
        surface,
        u,
        time,
        rounds,
        lambda u: _tensor(surface, u, contrast, scale, integration_scale, "coherence"),
        options,
    )


def _tensor(surface, u, contrast, scale, integration_scale, enhancing: str) -> Array:
    structure = structure_tensor(surface, u, scale, integration_scale)
    return diffusion_tensor(surface, structure, number(surface, "contrast", contrast), enhancing)


def _in_rounds(
    surface: Surface, u: AnyArray, time: float | AnyArray, rounds: int, tensor: Callable[[Array], Array], options
) -> Array:
    if rounds < 1:
        raise ValueError(f"Expected at least one round, found {rounds}.")
    u, duration = signal(surface, u), number(surface, "time", time, may_be_zero=True) / rounds
    for _ in range(rounds):
        diffusion = tensor(u)
        if isinstance(diffusion, Tracer):
            raise ValueError(
                "The neighbours are chosen on the host in every round, but the surface, the image or a number is being "
                "traced by a JAX transformation. Call this function outside the transformation. To trace the image "
                "alone, compute a tensor with ltl.imaging.diffusion_tensor and call ltl.imaging.anisotropic_diffusion."
            )
        u = anisotropic_diffusion(surface, u, diffusion, duration, **options)
    return u


def _onto_tangent_planes(surface: Surface, tensor: Array) -> Array:
    plane = jnp.einsum("vai,vaj->vij", surface.geometry.frames, surface.geometry.frames)
    tensor = jnp.einsum("vij,vjk,vkl->vil", plane, tensor, plane)
    return (tensor + jnp.swapaxes(tensor, 1, 2)) / 2


def _check_tensor(surface: Surface, tensor: AnyArray) -> None:
    if jnp.shape(tensor) != (surface.num_vertices, 3, 3):
        raise ValueError(f"Expected a tensor of shape ({surface.num_vertices}, 3, 3), found {jnp.shape(tensor)}.")
