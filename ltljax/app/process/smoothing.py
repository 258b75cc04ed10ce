"""Smooth a mesh.

What enters: the name of a mesh, a method and its options. What leaves: the smoothed mesh, curvature before and after,
and pictures.
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ... import imaging
from ..._mesh.columns import read_colors
from ..._operators import curvature as curvature_of
from ..choices import SMOOTHING_METHODS
from .results import Results, symmetric
from .subject import Subject, check_choice, check_positive, load

# The options of each way to smooth, and their defaults. Times and strengths of None are multiples of the squared mean
# edge length, at which waves of an edge or two disappear.
_OPTIONS: dict[str, dict[str, Any]] = {
    "mean-curvature-flow": dict(time=None, steps=10, keep_volume=False),
    "fair": dict(strength=None, keep_volume=False),
    "filter-normals": dict(strength=0.35, steps=5),
}
_TIME, _STRENGTH = 0.25, 0.5


def smooth(
    mesh: str,
    out: Path,
    *,
    method: str = "mean-curvature-flow",
    time: float | None = None,
    strength: float | None = None,
    steps: int | None = None,
    keep_volume: bool = False,
    repair: bool = False,
) -> None:
    """Smooth a mesh and write it.

    Args:
        mesh: a built-in shape or a mesh file.
        out: folder for the results.
        method: ``"mean-curvature-flow"`` (`imaging.mean_curvature_flow`), ``"fair"`` (`imaging.fair`) or
            ``"filter-normals"`` (`imaging.filter_normals`), which keeps edges.
        time: duration of the flow, in units of length squared; by default a quarter of the squared mean edge length.
        strength: for ``"fair"`` in units of length squared, by default half the squared mean edge length; for
            ``"filter-normals"`` the difference between unit normals below which they are averaged, by default 0.35.
        steps: number of steps of the flow, by default 10; for ``"filter-normals"`` the number of iterations of the
            filter, by default 5.
        keep_volume: whether to keep the volume of each component; ``"filter-normals"`` changes it little, and does not
            take this option.
        repair: whether to repair a mesh file with defects.

    Raises:
        ValueError: the mesh is not acceptable, or an option does not belong to the method.
        SolveError: a step could not be solved, for example because the surface collapses.
    """
    check_choice("method", method, SMOOTHING_METHODS)
    check_positive(time=time, strength=strength, steps=steps)
    options = dict(time=time, strength=strength, steps=steps, keep_volume=keep_volume or None)
    for name, value in options.items():
        if value is not None and name not in _OPTIONS[method]:
            flags = ", ".join(f"--{option.replace('_', '-')}" for option in _OPTIONS[method])
            raise ValueError(f"--{name.replace('_', '-')} does not belong to --method {method}, which takes {flags}.")
    subject = load(mesh, repair)
    results = Results("smooth", subject, out, ("before", "after"))
    used = _OPTIONS[method] | {name: value for name, value in options.items() if value is not None}
    moved = _smoothed(subject, method, used)
    measured = {name: value for name, value in used.items() if name != "keep_volume"}
    measured |= _show_smoothed(results, moved)
    results.finish(dict(used, method=method, keep_volume=keep_volume, repair=repair), measured)


def _smoothed(subject: Subject, method: str, options: dict[str, Any]) -> jnp.ndarray:
    """The vertices (V, 3) of the smoothed surface. Fills in the options that depend on the mean edge length."""
    surface, square = subject.surface, subject.mean_edge**2
    if method == "mean-curvature-flow":
        options["time"] = _TIME * square if options["time"] is None else options["time"]
        return imaging.mean_curvature_flow(surface, options["time"], options["steps"], options["keep_volume"])
    if method == "fair":
        options["strength"] = _STRENGTH * square if options["strength"] is None else options["strength"]
        return imaging.fair(surface, options["strength"], keep_volume=options["keep_volume"])
    return imaging.filter_normals(surface, options["strength"], normal_iterations=options["steps"])


def _show_smoothed(results: Results, moved: jnp.ndarray) -> dict[str, Any]:
    """Prepare the smoothed mesh and its pictures; returns what was measured."""
    subject, surface = results.subject, results.subject.surface
    after = np.asarray(moved, np.float64) + surface.centre
    bends = [np.asarray(curvature_of(each).mean) for each in (surface, surface.with_vertices(moved))]
    way = np.linalg.norm(np.asarray(moved - surface.vertices), axis=1)
    results.numbers({"mean_before": bends[0], "mean_after": bends[1], "way": way}, after)
    colors = read_colors(subject.path) if subject.path else None
    colors = None if colors is None else np.clip(subject.from_file_order(colors, subject.name), 0, 1)
    if subject.path and subject.path.suffix.lower() == ".obj":
        results.shape(after, colors)
    else:
        grey = np.full((len(after), 3), 200, np.uint8)
        results.colors(grey if colors is None else np.round(255 * colors).astype(np.uint8), after)
    # The limits are those of the smoothed mesh, since noise bends a surface far more than its shape does.
    limits = symmetric(bends[1])
    for name, bend, vertices in (("before", bends[0], None), ("after", bends[1], after)):
        results.picture(name, bend, "mean curvature", limits, "coolwarm", vertices)
    measured: dict[str, Any] = dict(
        largest_way=float(way.max()), mean_way=float(way.mean()), area_before=subject.mesh.area,
        area_after=_area(after, subject.mesh.faces),
    )  # fmt: skip
    if subject.mesh.is_closed:
        for name, vertices in (("before", surface.vertices), ("after", moved)):
            measured[f"volume_{name}"] = float(imaging.enclosed_volume(vertices, surface.faces))
    return measured


def _area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
