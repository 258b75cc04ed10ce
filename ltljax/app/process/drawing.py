"""Draw the properties of a mesh: lines of a field, curvature, and distance from vertices.

What enters: the name of a mesh and options. What leaves: numbers at its vertices, and pictures.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ... import imaging
from ..._operators import curvature as curvature_of
from ..._solve import geodesic_distance
from ..choices import LINE_FIELDS
from .line_fields import line_fields
from .results import Results, symmetric, usual
from .subject import Subject, check_choice, load

# Pictures of lines show both sides, as other pictures do.
_VIEWS = ((0.55, 0.35, 1.0), (-0.55, 0.35, -1.0))
# Maximum number of bands in a picture of distance.
_MOST_BANDS = 24


def lic(mesh: str, out: Path, *, field: str = "smallest", resolution: int = 600, repair: bool = False) -> None:
    """Draw the lines of a field on a mesh by line integral convolution.

    Args:
        mesh: a built-in shape or a mesh file.
        out: folder for the results.
        field: the directions of ``"smallest"`` or ``"largest"`` curvature, ``"cross"`` for a smooth field of crosses,
            or ``"rotation"`` about the vertical axis.
        resolution: height of the picture in pixels.
        repair: whether to repair a mesh file with defects.

    Raises:
        ValueError: the mesh is not acceptable, there is no such field, or it has no direction on this mesh.
    """
    check_choice("field", field, LINE_FIELDS)
    subject = load(mesh, repair)
    results = Results("lic", subject, out, ("",))
    surface, is_directed = subject.surface, field == "rotation"
    fields = line_fields(subject, field)
    lines = [imaging.line_integral_convolution(surface, X, is_directed=is_directed) for X in fields]
    grey = np.mean([np.asarray(line) for line in lines], axis=0)
    directions = {"direction" + "_across" * index: X for index, X in enumerate(fields)}
    results.numbers({**directions, "lic": grey})
    from ..._output.colors import vertex_colors

    results.colors(vertex_colors(grey, usual(grey), "gray"))
    if results.draws:
        sides = [_drawn(subject, fields, view, resolution, is_directed) for view in _VIEWS]
        results.image("", np.concatenate(sides, axis=1))
    results.finish(dict(field=field, resolution=resolution, repair=repair), dict(field=field))


def curvature(mesh: str, out: Path, *, repair: bool = False) -> None:
    """Draw the mean and Gauss curvature, ridges and valleys of a mesh, and write all curvatures.

    Args:
        mesh: a built-in shape or a mesh file.
        out: folder for the results.
        repair: whether to repair a mesh file with defects.

    Raises:
        ValueError: the mesh is not acceptable.
    """
    subject = load(mesh, repair)
    surface = subject.surface
    results = Results("curvature", subject, out, ("mean", "gauss", "ridges"))
    bend, lines = curvature_of(surface), imaging.ridges(surface)
    mean, gauss, ridge, valley = (np.asarray(x) for x in (bend.mean, bend.gauss, lines.ridge, lines.valley))
    fields = dict(mean=mean, gauss=gauss, largest=bend.principal[:, 0], smallest=bend.principal[:, 1])
    fields |= dict(direction_of_largest=bend.directions[:, 0], direction_of_smallest=bend.directions[:, 1])
    fields |= dict(ridge=ridge, valley=valley, shape_index=imaging.shape_index(surface))
    results.numbers(fields)
    from ..._output.colors import vertex_colors

    results.colors(vertex_colors(mean, symmetric(mean), "coolwarm"))
    results.picture("mean", mean, "mean curvature", symmetric(mean), "coolwarm")
    results.picture("gauss", gauss, "Gauss curvature", symmetric(gauss), "coolwarm")
    results.picture("ridges", ridge - valley, "ridge - valley", (-1.0, 1.0), "coolwarm")
    measured = {f"median_{name}_curvature": float(np.median(x)) for name, x in (("mean", mean), ("gauss", gauss))}
    results.finish(dict(repair=repair), measured)


def distance(mesh: str, out: Path, *, sources: Sequence[int], repair: bool = False) -> None:
    """Draw the distance along a mesh from some of its vertices, in bands.

    Args:
        mesh: a built-in shape or a mesh file.
        out: folder for the results.
        sources: vertices, counted from 0 in the order of the file.
        repair: whether to repair a mesh file with defects.

    Raises:
        ValueError: the mesh is not acceptable or has no such vertex.
    """
    subject = load(mesh, repair)
    results = Results("distance", subject, out, ("",))
    distances = np.asarray(geodesic_distance(subject.surface, subject.vertices_of_file(list(sources))))
    # A component without a source is out of reach.
    distances = np.where(np.isfinite(distances), distances, np.nan)
    largest = float(np.nanmax(distances))
    width = _band_width(largest)
    num_bands = int(np.ceil(largest / width))
    from ..._output.colors import striped, vertex_colors

    results.numbers({"distance": distances})
    results.colors(vertex_colors(distances, (0.0, largest)))
    results.picture("", distances, "distance", (0.0, num_bands * width), striped("viridis", num_bands))
    num_unreached = int(np.isnan(distances).sum())
    results.finish(
        dict(sources=list(sources), repair=repair),
        dict(largest_distance=largest, width_of_a_band=width, vertices_out_of_reach=num_unreached or None),
    )


def _band_width(largest: float) -> float:
    """The smallest width of 1, 2 or 5 times a power of ten that makes no more than the maximum number of bands."""
    least = largest / _MOST_BANDS
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= least))


def _drawn(
    subject: Subject,
    fields: Sequence[jnp.ndarray],
    view: tuple[float, float, float],
    resolution: int,
    is_directed: bool,
) -> np.ndarray:
    """The picture of a field from one side; for several fields the mean of their pictures."""
    options: dict[str, Any] = dict(view=view, resolution=resolution, is_directed=is_directed)
    pictures = [imaging.lic_picture(subject.surface, X, **options)[0] for X in fields]
    return np.mean(pictures, axis=0).astype(np.uint8)
