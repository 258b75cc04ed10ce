"""Smooth a mesh, or show what it is like: lines on it, how it bends, how far it is from a vertex.

What enters: the name of a mesh and what is asked of it. What leaves: numbers on its vertices, and pictures.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ... import imaging
from ..._mesh.columns import read_colors
from ..._operators import curvature as curvature_of
from ..._solve import geodesic_distance
from .fields import FIELDS, line_fields
from .results import Results, symmetric, usual
from .subject import Subject, check_choice, check_positive, load

SMOOTHINGS = ("flow", "fair", "features")
# What is smoothed where nothing is said, in squared edge lengths: waves of an edge or two go.
_TIME, _STRENGTH = 0.25, 0.5
# From where pictures of lines are taken: both sides, as all others.
_VIEWS = ((0.55, 0.35, 1.0), (-0.55, 0.35, -1.0))
# Bands in a picture of distance, at most.
_BANDS = 24


def smooth(
    mesh: str,
    out: Path,
    *,
    method: str = "flow",
    time: float | None = None,
    strength: float | None = None,
    steps: int | None = None,
    keep_volume: bool = False,
    repair: bool = False,
) -> None:
    """Smooth a mesh, and write it.

    Args:
        mesh: a built-in shape or a mesh file.
        out: the folder to write to.
        method: ``"flow"`` (`imaging.mean_curvature_flow`), ``"fair"`` (`imaging.fair`) or ``"features"``
            (`imaging.filter_normals`), which keeps edges.
        time: of the flow, in units of a length squared; by default a quarter of the squared mean edge length.
        strength: of ``fair``, in units of a length squared, by default half the squared mean edge length; of
            ``features``, how far apart normals may be and still count as the same, by default 0.35.
        steps: of the flow, by default 10; of ``features``, rounds of the filter, by default 5.
        keep_volume: whether each component keeps its volume; not of ``features``, which changes it little.
        repair: mend a mesh file that is not acceptable.

    Raises:
        ValueError: the mesh is not acceptable, or the method does not take what is given.
        SolveError: a step could not be solved, as where the surface collapses.
    """
    check_choice("method", method, SMOOTHINGS)
    check_positive(time=time, strength=strength, steps=steps)
    takes = dict(
        flow=("time", "steps", "keep_volume"), fair=("strength", "keep_volume"), features=("strength", "steps")
    )
    given = dict(time=time, strength=strength, steps=steps, keep_volume=keep_volume or None)
    for name, value in given.items():
        if value is not None and name not in takes[method]:
            flags = ", ".join(f"--{flag.replace('_', '-')}" for flag in takes[method])
            raise ValueError(f"--{name.replace('_', '-')} does not belong to --method {method}, which takes {flags}.")
    subject = load(mesh, repair)
    results = Results("smooth", subject, out, ("before", "after"))
    surface, square = subject.surface, subject.edge**2
    how: dict[str, Any]
    if method == "flow":
        how = dict(time=_TIME * square if time is None else time, steps=10 if steps is None else steps)
        moved = imaging.mean_curvature_flow(surface, how["time"], how["steps"], keep_volume)
    elif method == "fair":
        how = dict(strength=_STRENGTH * square if strength is None else strength)
        moved = imaging.fair(surface, how["strength"], keep_volume=keep_volume)
    else:
        how = dict(strength=0.35 if strength is None else strength, steps=5 if steps is None else steps)
        moved = imaging.filter_normals(surface, how["strength"], normal_iterations=how["steps"])
    after = np.asarray(moved, np.float64) + surface.centre
    bends = [np.asarray(curvature_of(at).mean) for at in (surface, surface.with_vertices(moved))]
    way = np.linalg.norm(np.asarray(moved - surface.vertices), axis=1)
    results.numbers({"mean_before": bends[0], "mean_after": bends[1], "way": way}, after)
    kind = subject.path.suffix.lower() if subject.path else ".ply"
    own = read_colors(subject.path) if subject.path else None
    own = None if own is None else np.clip(subject.pulled(own, subject.name), 0, 1)
    if kind == ".obj":
        results.shape(after, own)
    else:
        grey = np.full((len(after), 3), 200, np.uint8)
        results.colors(grey if own is None else np.round(255 * own).astype(np.uint8), after)
    # The noise of the mesh before bends far more than its shape does.
    limits = symmetric(bends[1])
    for name, values, at in (("before", bends[0], None), ("after", bends[1], after)):
        results.picture(name, values, "mean curvature", limits, "coolwarm", at)
    measured: dict[str, Any] = how | dict(largest_way=float(way.max()), mean_way=float(way.mean()))
    measured |= dict(area_before=subject.mesh.area, area_after=_area(after, subject.mesh.faces))
    if subject.mesh.is_closed:
        for name, at in (("before", surface.vertices), ("after", moved)):
            measured[f"volume_{name}"] = float(imaging.enclosed_volume(at, surface.faces))
    results.finish(dict(method=method, keep_volume=keep_volume, repair=repair, **how), measured)


def lic(mesh: str, out: Path, *, field: str = "smallest", resolution: int = 600, repair: bool = False) -> None:
    """Draw the lines of a field on a mesh by line integral convolution.

    Args:
        mesh: a built-in shape or a mesh file.
        out: the folder to write to.
        field: one of `fields.FIELDS`.
        resolution: pixels of the height of the picture.
        repair: mend a mesh file that is not acceptable.

    Raises:
        ValueError: the mesh is not acceptable, there is no such field, or it has no direction on this mesh.
    """
    check_choice("field", field, FIELDS)
    subject = load(mesh, repair)
    results = Results("lic", subject, out, ("",))
    surface, is_directed = subject.surface, field == "rotation"
    fields = line_fields(subject, field)
    lines = [imaging.line_integral_convolution(surface, X, is_directed=is_directed) for X in fields]
    grey = np.mean([np.asarray(line) for line in lines], axis=0)
    named = {"direction" + "_across" * index: X for index, X in enumerate(fields)}
    results.numbers({**named, "lic": grey})
    from ..._output.colors import vertex_colors

    results.colors(vertex_colors(grey, usual(grey), "gray"))
    if results.draws:
        sides = [_drawn(subject, fields, view, resolution, is_directed) for view in _VIEWS]
        results.image("", np.concatenate(sides, axis=1))
    results.finish(dict(field=field, resolution=resolution, repair=repair), dict(field=field))


def curvature(mesh: str, out: Path, *, repair: bool = False) -> None:
    """Draw how a mesh bends: mean and Gauss curvature, ridges and valleys; and write all numbers.

    Args:
        mesh: a built-in shape or a mesh file.
        out: the folder to write to.
        repair: mend a mesh file that is not acceptable.

    Raises:
        ValueError: the mesh is not acceptable.
    """
    subject = load(mesh, repair)
    surface = subject.surface
    results = Results("curvature", subject, out, ("mean", "gauss", "ridges"))
    bent, lines = curvature_of(surface), imaging.ridges(surface)
    mean, gauss, ridge, valley = (np.asarray(x) for x in (bent.mean, bent.gauss, lines.ridge, lines.valley))
    fields = dict(mean=mean, gauss=gauss, largest=bent.principal[:, 0], smallest=bent.principal[:, 1])
    fields |= dict(direction_of_largest=bent.directions[:, 0], direction_of_smallest=bent.directions[:, 1])
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
        out: the folder to write to.
        sources: vertices, as the file numbers them, from 0.
        repair: mend a mesh file that is not acceptable.

    Raises:
        ValueError: the mesh is not acceptable or has no such vertex.
    """
    subject = load(mesh, repair)
    results = Results("distance", subject, out, ("",))
    far = np.asarray(geodesic_distance(subject.surface, subject.vertices_of_file(list(sources))))
    # On a component without a source there is none.
    far = np.where(np.isfinite(far), far, np.nan)
    most = float(np.nanmax(far))
    band = _band(most)
    count = int(np.ceil(most / band))
    from ..._output.colors import striped, vertex_colors

    results.numbers({"distance": far})
    results.colors(vertex_colors(far, (0.0, most)))
    results.picture("", far, "distance", (0.0, count * band), striped("viridis", count))
    results.finish(
        dict(sources=list(sources), repair=repair),
        dict(largest_distance=most, width_of_a_band=band, vertices_out_of_reach=int(np.isnan(far).sum()) or None),
    )


def _band(most: float) -> float:
    """A width of 1, 2 or 5 times a power of ten, of which a length has not too many."""
    least = most / _BANDS
    power = 10.0 ** np.floor(np.log10(least))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= least))


def _area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def _drawn(
    subject: Subject,
    fields: Sequence[jnp.ndarray],
    view: tuple[float, float, float],
    resolution: int,
    is_directed: bool,
) -> np.ndarray:
    """The picture of a field from one side, or the mean of those of several."""
    how: dict[str, Any] = dict(view=view, resolution=resolution, is_directed=is_directed)
    drawn = [imaging.lic_picture(subject.surface, X, **how)[0] for X in fields]
    return np.mean(drawn, axis=0).astype(np.uint8)
