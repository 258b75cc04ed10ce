"""Pictures of what was computed, one call each, for notebooks and scripts (drawing comes with the extra `viz`).

What enters: a surface and fields on it, a solution, a dispersion relation. What leaves: what a notebook shows when a
cell ends with it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ._mesh import Mesh
from ._solve import Dispersion, Solution
from ._surface import Surface, on_surface
from ._tables import AnyArray


def plot(
    surface: Surface,
    u: Float[AnyArray, " V"],
    title: str = "u",
    colormap: str = "viridis",
    limits: tuple[float, float] | None = None,
) -> Any:
    """A picture of a field from two sides, as a `PIL.Image` (host).

    Args:
        surface: the surface.
        u: (V,).
        title: beside the colour bar.
        colormap: one of `ltl.io.COLORMAPS`.
        limits: the ends of the colours; by default the field's.

    Raises:
        ValueError: the field does not fit the surface, or the colour map is not known.
        ImportError: the extra `viz` is not installed.
    """
    from ._output import pictures

    values = _fitting(surface, u)
    if not pictures.can_draw():
        raise ImportError('Pictures need the extra "viz": pip install "ltljax[viz]". ltl.view does without.')
    from PIL import Image

    limits = limits or (float(np.nanmin(values)), float(np.nanmax(values)))
    picture = pictures.Picture(np.asarray(surface.vertices), np.asarray(surface.faces), title, limits, colormap)
    image = Image.fromarray(picture.draw(values))
    picture.close()
    return image


def view(
    surface: Surface,
    solution: Solution | Float[AnyArray, " V"],
    species: Sequence[str] = (),
    title: str = "",
    colormap: str = "viridis",
    height: int = 560,
) -> Any:
    """The viewer of a solution, or of one field, inside a notebook (host); ``.page`` is its HTML.

    Args:
        surface: the surface.
        solution: what `solve` returned, with the times asked for; or a field (V,).
        species: the names of the columns of the state; by default u, v, w or u0, u1, ...
        title: at the top.
        colormap: one of `ltl.io.COLORMAPS`.
        height: in pixels.

    Raises:
        ValueError: shapes do not fit, or the colour map is not known.
    """
    from ._output.viewer import Inline, viewer_html

    if isinstance(solution, Solution):
        reached = np.isfinite(np.asarray(solution.ts))
        times, states = np.asarray(solution.ts)[reached], np.asarray(solution.us)[reached]
    else:
        times, states = np.zeros(1), _fitting(surface, solution)[None]
    states = states.reshape(*states.shape[:2], -1)
    count = states.shape[2]
    names = species or (("u", "v", "w")[:count] if count <= 3 else [f"u{s}" for s in range(count)])
    if len(names) != count:
        raise ValueError(f"Expected {count} names of species, found {len(names)}: {', '.join(names)}.")
    fields = {name: states[:, :, s] for s, name in enumerate(names)}
    page = viewer_html(np.asarray(surface.vertices), np.asarray(surface.faces), times, fields, title, colormap)
    return Inline(page, height)


@on_surface
def displaced(surface: Surface, u: Float[AnyArray, " V"], amount: float = 0.1) -> Mesh:
    """The surface with a field as its relief, to be printed or rendered: a mesh (host).

    Args:
        surface: the surface.
        u: (V,). Vertices move along the normals, by nothing where it is least and by ``amount`` where it is largest.
        amount: a length; a negative one moves inwards.

    Raises:
        ValueError: the field does not fit the surface, or is not finite.
        MeshError: the relief is so high that faces fall together.
    """
    from ._output import texture

    values = _fitting(surface, u)
    if not np.isfinite(values).all():
        raise ValueError(f"Expected finite values, found {values[~np.isfinite(values)][0]}.")
    vertices, normals = (np.asarray(array, np.float64) for array in (surface.vertices, surface.normals))
    relief = texture.displaced(vertices, normals, values, amount) + surface.centre
    return Mesh(relief, np.asarray(surface.faces))


def plot_dispersion(dispersion: Dispersion, eigenvalues: AnyArray | None = None, axes: Any = None) -> Any:
    """The growth rate against the eigenvalue of -Delta, as matplotlib axes (host).

    Args:
        dispersion: what `dispersion` returned, or the one of `explain`.
        eigenvalues: of the surface, such as ``ltl.eigenmodes(surface, 60).values``; marked on the curve.
        axes: matplotlib axes to draw into; new ones by default.
    """
    import matplotlib.pyplot as plt

    if axes is None:
        _, axes = plt.subplots(figsize=(6, 3.5))
    band, (fastest, _) = dispersion.band, dispersion.fastest
    end = band[1] if band is not None and np.isfinite(band[1]) else max(fastest, 1.0)
    curve = np.linspace(0, 1.6 * end, 400)
    axes.axhline(0, color="gray", linewidth=0.8)
    axes.plot(curve, dispersion.growth(curve))
    if eigenvalues is not None:
        marked = np.asarray(eigenvalues)
        marked = marked[marked <= curve[-1]]
        axes.plot(marked, dispersion.growth(marked), "o", markersize=4, label="modes of the surface")
        axes.legend()
    axes.set(xlabel="eigenvalue of -Δ", ylabel="growth rate")
    return axes


def _fitting(surface: Surface, u: Any) -> np.ndarray:
    values = np.asarray(u, np.float64)
    if values.shape != (surface.num_vertices,):
        raise ValueError(f"Expected a field of shape ({surface.num_vertices},), found {values.shape}.")
    return values
