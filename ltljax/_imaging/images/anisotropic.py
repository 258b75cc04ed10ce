"""An image is diffused along its edges and lines, and not across them.

What enters: a surface and an image. What leaves: its structure tensor, diffusion tensors made of that, and the image
after diffusion with them. The neighbours and weights of such a diffusion are chosen on the host and are not negative,
so that values stay within those of the image, which symmetric differences do not promise.

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
from .signals import number, signal
from .smoothing import evolved, smoothed

# Weickert's constant: with it the flux grows with the slope up to the contrast, and falls beyond.
_STEEPNESS = 3.31488
# Of diffusion across lines, to that along them.
_LEAST = 1e-3


class AnisotropicDiffusion(Equation):
    """u_t = D : Hess u + b . grad u, or with b = div D, u_t = div(D grad u).

    Attributes:
        stencil: the operator, as `elliptic_stencil` makes it.
    """

    stencil: EllipticStencil

    def rate(self, t, surface: Surface, u):
        """The operator applied to u."""
        del t, surface
        return self.stencil(u)

    def spectral_bound(self, t, surface: Surface, u):
        """That of the operator."""
        del t, surface
        return self.stencil.spectral_bound().astype(u.dtype)

    def spectral_width(self, t, surface: Surface, u):
        """That of the operator."""
        del t, surface
        return self.stencil.spectral_width().astype(u.dtype)

    def diffusivities(self, u):
        """The mean of the tensor's eigenvalues."""
        return jnp.broadcast_to(self.stencil.mean_diffusion.astype(u.dtype), u.shape[1:])

    @property
    def is_affine(self) -> bool:
        """It is."""
        return True


@on_surface
def structure_tensor(
    surface: Surface,
    u: Float[AnyArray, "V *C"],
    scale: float | AnyArray,
    integration_scale: float | AnyArray,
) -> Float[Array, "V 3 3"]:
    """The mean of grad u_s grad u_s^T over a window, symmetric, non-negative and tangent, in ambient coordinates.

    Its first eigenvector is the direction in which the image changes most, its eigenvalues the mean squares of the
    slopes along and across; of colours the tensors are added. The image is averaged over a window of radius ``scale``
    first, the products over one of radius ``integration_scale``. That second mean is taken of ambient components and
    projected to the tangent plane, which is right to the order of (window times curvature)^2.

    Args:
        surface: the surface.
        u: (V,) or (V, C).
        scale: a length; noise below it is not seen.
        integration_scale: a length, of a few lines.

    Raises:
        ValueError: u does not fit the surface or is not finite, or a length is negative.
    """
    slopes = gradient(surface, smoothed(surface, u, scale)).reshape(surface.num_vertices, -1, 3)
    products = jnp.einsum("vci,vcj->vij", slopes, slopes).reshape(-1, 9)
    return _onto_tangent_planes(surface, smoothed(surface, products, integration_scale).reshape(-1, 3, 3))


@on_device
def diffusion_tensor(
    surface: Surface, structure: Float[AnyArray, "..."], contrast: float | AnyArray, enhancing: str = "edges"
) -> Float[Array, "V 3 3"]:
    """The tensor of a diffusion that enhances edges or lines, with eigenvalues from 0.001 to 1.

    With mu_1 >= mu_2 the eigenvalues of the structure tensor. Edges: along the edge 1, across it
    ``1 - exp(-3.31488 / (mu_1 / contrast^2)^4)``, near 1 where slopes are well below the contrast and near 0 above.
    Coherence: across lines 0.001, along them ``0.001 + 0.999 exp(-(contrast^2 / (mu_1 - mu_2))^2)``, near 1 where one
    direction prevails and 0.001 where none does.

    Args:
        surface: the surface.
        structure: (V, 3, 3), of `structure_tensor`.
        contrast: a slope, in units of u over a length.
        enhancing: ``"edges"`` or ``"coherence"``.

    Raises:
        ValueError: an unknown kind of tensor, or one that does not fit the surface.

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
        # At a tenth the exponential is zero, in any float; below, its derivative would be zero times infinity.
        ratio = jnp.maximum((half + root) / squared, 0.1)
        across, along = jnp.maximum(1 - jnp.exp(-_STEEPNESS / ratio**4), _LEAST), 1.0
    else:
        ratio = jnp.minimum(squared / (2 * root), 100)
        across, along = _LEAST, _LEAST + (1 - _LEAST) * jnp.exp(-(ratio**2))
    # The unit tensor of the plane, and that of the two directions, the first with the sign of plus.
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
    """The image after u_t = div(D grad u) (host): values stay within those of u.

    As D : Hess u + (div D) . grad u, with the non-negative weights of `elliptic_stencil`. Where D changes by much from
    one vertex to the next these add diffusion, as little as weights without negative ones allow.

    Args:
        surface: the surface, not traced; u may be.
        u: (V,) or (V, C).
        tensor: D, (V, 3, 3), symmetric and non-negative, of which the tangent part counts.
        time: in units of a length squared, over that of D.
        rtol: relative tolerance of a step.
        progress: whether to show how far the choice of neighbours is.

    Raises:
        ValueError: something does not fit the surface or is not finite, D is not symmetric or not non-negative, the
            time is negative, or the surface or D is being traced.
    """
    u = signal(surface, u)
    _check_tensor(surface, tensor)
    if isinstance(tensor, Tracer):
        raise ValueError(
            "The neighbours of a diffusion are chosen on the host, but its tensor is being traced by a JAX "
            "transformation. Call this function outside, or use ltl.operators.elliptic_stencil and its `with_coefficients`."
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
    """The image smoothed where it is flat, and along its edges (host).

    Args:
        surface: the surface.
        u: (V,) or (V, C); colours have their edges in common.
        time: in units of a length squared.
        contrast: slopes above it are edges.
        scale: the radius of the window that slopes are taken of; by default the mean length of the edges of the mesh.
        rounds: how often the tensor is computed anew.
        **options: of `anisotropic_diffusion`.

    Raises:
        ValueError: as `anisotropic_diffusion`.
    """
    scale = surface.mesh_size if scale is None else scale
    # Edges are where they are: the products are not averaged.
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
    """The image smoothed along its lines, whose gaps close (host).

    Args:
        surface: the surface.
        u: (V,) or (V, C).
        time: in units of a length squared.
        contrast: where the slopes in both directions differ by more there is a line; those of noise should be below.
        scale: the radius of the window that slopes are taken of; by default the mean length of the edges of the mesh.
        integration_scale: that over which directions are averaged; by default three times ``scale``.
        rounds: how often the tensor is computed anew.
        **options: of `anisotropic_diffusion`.

    Raises:
        ValueError: as `anisotropic_diffusion`.
    """
    scale = surface.mesh_size if scale is None else number(surface, "scale", scale)
    wide = 3 * scale if integration_scale is None else integration_scale
    return _in_rounds(
        surface, u, time, rounds, lambda u: _tensor(surface, u, contrast, scale, wide, "coherence"), options
    )


def _tensor(surface, u, contrast, scale, integration_scale, enhancing: str) -> Array:
    structure = structure_tensor(surface, u, scale, integration_scale)
    return diffusion_tensor(surface, structure, number(surface, "contrast", contrast), enhancing)


def _in_rounds(
    surface: Surface, u: AnyArray, time: float | AnyArray, rounds: int, tensor: Callable[[Array], Array], options
) -> Array:
    if rounds < 1:
        raise ValueError(f"Expected at least one round, found {rounds}.")
    u, share = signal(surface, u), number(surface, "time", time, may_be_zero=True) / rounds
    for _ in range(rounds):
        found = tensor(u)
        if isinstance(found, Tracer):
            raise ValueError(
                "The neighbours are chosen on the host, anew in every round, but the surface, the image or a number is "
                "being traced by a JAX transformation. Call this function outside; or compute a tensor outside, with "
                "ltl.imaging.diffusion_tensor, for ltl.imaging.anisotropic_diffusion, whose image may be traced."
            )
        u = anisotropic_diffusion(surface, u, found, share, **options)
    return u


def _onto_tangent_planes(surface: Surface, tensor: Array) -> Array:
    plane = jnp.einsum("vai,vaj->vij", surface.geometry.frames, surface.geometry.frames)
    tensor = jnp.einsum("vij,vjk,vkl->vil", plane, tensor, plane)
    return (tensor + jnp.swapaxes(tensor, 1, 2)) / 2


def _check_tensor(surface: Surface, tensor: AnyArray) -> None:
    if jnp.shape(tensor) != (surface.num_vertices, 3, 3):
        raise ValueError(f"Expected a tensor of shape ({surface.num_vertices}, 3, 3), found {jnp.shape(tensor)}.")
