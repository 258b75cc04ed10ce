"""Pictures for notebooks and scripts: of fields and solutions on a surface, and of dispersion relations.

Each function returns an object that a notebook shows. `plot` needs the extra `viz`.
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
    """A picture of a field on a surface from two opposite sides, as a `PIL.Image` (host).

    Args:
        surface: the surface.
        u: (V,) field.
        title: title of the colour bar.
        colormap: name of a colour map, a key of `ltl.io.COLORMAPS`.
        limits: values at the ends of the colour map; by default, the smallest and the largest value of the field.

    Raises:
        ValueError: the field does not match the surface, or the colour map is not known.
        ImportError: the extra `viz` is not installed.
    """
    from ._output import pictures

    values = _checked_field(surface, u)
    if not pictures.can_draw():
        raise ImportError('Pictures need the extra "viz": pip install "ltljax[viz]". ltl.view works without it.')
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
    """An interactive viewer of a solution or a field, for notebooks (host); its attribute ``page`` is the HTML.

    Args:
        surface: the surface.
        solution: result of `solve` with the states at several times, or a field (V,).
        species: names of the species; by default u, v, w, or u0, u1, ... for more than three.
        title: title at the top.
        colormap: name of a colour map, a key of `ltl.io.COLORMAPS`.
        height: height in pixels.

    Raises:
        ValueError: the shapes do not match, or the colour map is not known.
    """
    from ._output.viewer import Inline, viewer_html

    if isinstance(solution, Solution):
        is_reached = np.isfinite(np.asarray(solution.ts))
        times, states = np.asarray(solution.ts)[is_reached], np.asarray(solution.us)[is_reached]
    else:
        times, states = np.zeros(1), _checked_field(surface, solution)[None]
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
    """The surface with a field as its relief, as a mesh for printing or rendering (host).

    Vertices move along the normals, from 0 where the field is smallest to ``amount`` where it is largest.

    Args:
        surface: the surface.
        u: (V,) field.
        amount: largest displacement, a length; negative values move vertices inwards.

    Raises:
        ValueError: the field does not match the surface, or has NaN or infinite values.
        MeshError: the relief is so high that faces degenerate.
    """
    from ._output import texture

    values = _checked_field(surface, u)
    if not np.isfinite(values).all():
        vertex = int(np.argmin(np.isfinite(values)))
        raise ValueError(f"Expected finite values, found {values[vertex]} at vertex {vertex}. Correct it first.")
    vertices, normals = (np.asarray(array, np.float64) for array in (surface.vertices, surface.normals))
    relief = texture.displaced(vertices, normals, values, amount) + surface.centre
    return Mesh(relief, np.asarray(surface.faces))


def plot_dispersion(dispersion: Dispersion, eigenvalues: AnyArray | None = None, axes: Any = None) -> Any:
    """A plot of the growth rate as a function of the eigenvalue of -Delta, as matplotlib axes (host).

    Args:
        dispersion: result of `dispersion`, or the attribute ``dispersion`` of the result of `explain`.
        eigenvalues: eigenvalues of the surface to mark on the curve, such as ``ltl.eigenmodes(surface, 60).values``.
        axes: matplotlib axes to draw into; by default, new axes.
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
        modes = np.asarray(eigenvalues)
        modes = modes[modes <= curve[-1]]
        axes.plot(modes, dispersion.growth(modes), "o", markersize=4, label="modes of the surface")
        axes.legend()
    axes.set(xlabel="eigenvalue of -Δ", ylabel="growth rate")
    return axes


def _checked_field(surface: Surface, u: Any) -> np.ndarray:
    """The field as a float64 array (V,)."""
    values = np.asarray(u, np.float64)
    if values.shape != (surface.num_vertices,):
        raise ValueError(f"Expected a field of shape ({surface.num_vertices},), found {values.shape}.")
    return values
