"""A scenario becomes results: time stepping with a progress bar, what was measured, and files.

What enters: a `Scenario` and how to run it. What leaves: a folder with pictures, data and ``summary.json``.
"""

import copy
import dataclasses
import itertools
import json
import platform
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tomli_w

from .._base.folder import Folder, OutputError, copies
from .._base.progress import noted, watched
from .._lifting.schemes import Monotone, Scheme
from .._mesh import Mesh, vertex_normals
from .._operators import integrate
from .._solve import GrowingModesWarning, SolveError, solve
from .._solve.fingerprint import fingerprint
from .._solve.restart import Keeper
from .._surface import FarFromOriginWarning, Surface
from .scenario import Scenario

_PACKAGES = ("ltljax", "jax", "jaxlib", "numpy", "scipy", "trimesh", "equinox", "diffrax", "pyvista")
_RESTART = "restart"
_WAYS = "Continue it with --resume, start over with --overwrite, or name another --out."
# Vertices from which on building a surface takes long enough to be watched.
_LONG_BUILD = 100_000
# Bytes of a viewer's page from which on it is said.
_LARGE_PAGE = 15_000_000


@dataclasses.dataclass
class _Progress:
    """What a run has reached."""

    times: list[float]
    states: list[np.ndarray]
    compile_seconds: float = 0.0
    step_seconds: float = 0.0
    counts: dict[str, int] = dataclasses.field(default_factory=dict)


def run(
    example: Scenario,
    options: dict[str, Any],
    *,
    scheme: Scheme,
    dtype: str,
    frames: int,
    out: Path,
    inputs: Iterable[Path] = (),
    resume: bool = False,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Solve a scenario and write its results.

    While it runs, every state is put on disk in ``out/restart``, so that a run that is killed can be taken up again.
    Results that are there from before stay as they are until all new ones are complete.

    Args:
        example: the scenario.
        options: what it was made from, for the record; ``mesh`` among it.
        scheme: the scheme.
        dtype: ``"float32"`` or ``"float64"``.
        frames: how many states to keep, evenly spaced in time, besides the first.
        out: the folder to write to; made if absent.
        inputs: files that the run is made from, besides those the scenario names.
        resume: whether to go on from what ``out/restart`` holds of the same run.
        overwrite: whether to start over although ``out/restart`` holds a run that has not ended.

    Returns:
        What ``summary.json`` holds.

    Raises:
        SolveError: the run could not be carried to its end. What it had reached is written all the same.
        RestartError: ``out/restart`` holds the states of another run, or of one that has not ended, and it was neither
            to be resumed nor to be overwritten.
        OutputError: results would replace what the run reads, or what ltljax has not written; or another run is writing
            to ``out``; or the disk is full.
    """
    folder = Folder(out)
    folder.check(_result_names(example, frames), (*inputs, *example.files.values()))
    # The copies of inputs may be what is read: a run is repeated from its own folder.
    folder.check(copies(example.files).values())
    with folder.locked():
        start = time.perf_counter()
        # Results are written where the mesh lies, wherever the surface takes positions from.
        with noted(FarFromOriginWarning):
            surface = Surface.from_mesh(example.mesh, scheme, dtype, progress=example.mesh.num_vertices > _LONG_BUILD)
        build_seconds = time.perf_counter() - start
        print(
            f"{example.name} on {options['mesh']}: {example.mesh.num_vertices} vertices, {example.mesh.num_faces} "
            f"faces, {scheme}"
        )
        for note in example.notes:
            print(f"note: {note}")
        reached = _Progress([0.0], [example.u0])
        times = np.linspace(0, example.t1, frames + 1)
        same = dict(
            mesh=fingerprint((example.mesh.vertices, example.mesh.faces)),
            scenario=fingerprint((example.name, example.parameters, example.u0, options)),
            numbers=fingerprint((times, repr(scheme), dtype)),
        )
        keeper = Keeper(folder, same, resume, _RESTART, overwrite, _WAYS)
        failure = None
        try:
            _advance(example, surface, times, reached, keeper)
        except SolveError as error:
            failure = error
        except OSError as error:
            raise _no_room(error, out) from error
        measured = _measure(example, surface, reached)
        measured["build_seconds"] = build_seconds
        for name, value in measured.items():
            print(f"{name.replace('_', ' '):32} {_readable(value)}")
        summary: dict[str, Any] = dict(
            scenario=example.name,
            options=options,
            parameters=example.parameters,
            scheme=repr(surface.scheme),
            dtype=dtype,
            frames=frames,
            t1=example.t1,
            tolerances=dict(rtol=example.settings.rtol, atol=example.settings.atol),
            notes=example.notes,
            failure=None if failure is None else str(failure),
            measured=measured,
            mesh=example.mesh.report.as_dict(),
            surface=str(surface.report).splitlines(),
            files=[],
            versions=_versions(),
            device=str(jax.devices()[0]),
        )
        try:
            _put(example, np.asarray(surface.normals), folder, reached, summary)
        except OSError as error:
            raise _no_room(error, out) from error
        keeper.remove()
    print(f"{'written to':32} {out}: {', '.join([*summary['files'], 'summary.json'])}")
    if failure is not None:
        raise failure
    return summary


def _no_room(error: OSError, out: Path) -> OutputError:
    """What to say of states or results that could not be written."""
    return OutputError(
        f"The results could not be written: {error}. What was computed is kept in {out / _RESTART}: make room, and "
        "give the same command with --resume."
    )


def _result_names(example: Scenario, frames: int) -> list[str]:
    """The names of all files that a run may write."""
    name = example.name
    names = [f"{name}.{ending}" for ending in ("html", "pvd", "ply", "glb", "png", "mp4", "gif")]
    names += [f"textured/{name}.{ending}" for ending in ("obj", "mtl", "png")]
    names += [f"series/{name}_{index:04d}.vtp" for index in range(frames + 1)]
    if example.resolved is not None:
        names.append("scenario.toml")
    return [*names, f"{name}-displaced.glb", "summary.json"]


def _put(example: Scenario, normals: np.ndarray, folder: Folder, reached: _Progress, summary: dict[str, Any]) -> None:
    """Write all results, which take the places of those of an earlier run together."""
    with folder.draft() as draft:
        files = _write(example, normals, draft, reached)
        if example.resolved is not None:
            files += _keep_scenario(example.resolved, folder.keep_inputs(draft, example.files), draft)
        summary["files"] = files
        (draft / "summary.json").write_text(json.dumps(summary, indent=2, default=_as_json) + "\n", encoding="utf-8")
        written = {path.relative_to(draft).as_posix() for path in draft.rglob("*") if path.is_file()}
    # What an earlier run wrote, and this one does not.
    own = {name for name in folder.recorded() if name.startswith(f"series/{example.name}_")}
    folder.remove((own | set(_result_names(example, 0))) - written)


def _advance(example: Scenario, surface: Surface, times: np.ndarray, reached: _Progress, keeper: Keeper) -> None:
    """Carry the state from each time to the next, so that it can be shown, kept, and stopped in between."""
    equation, settings = example.make_equation(surface), example.settings
    how: dict[str, Any] = dict(
        solver=settings.solver, rtol=settings.rtol, atol=settings.atol, dt=settings.dt, throw=False
    )
    # Where the state of a frame is damaged or gone, the run goes on from before it.
    is_next = [record["frame"] == index for index, record in enumerate(keeper.done, start=1)]
    keeper.keep_first(is_next.index(False) if False in is_next else len(is_next))
    for path in keeper.passed_over:
        print(f"note: {path} is damaged and passed over")
    for state, record in zip(keeper.states(), keeper.done, strict=True):
        reached.times.append(record["t"])
        reached.states.append(state)
        reached.counts, reached.step_seconds = record["counts"], record["seconds"]
    if keeper.done:
        print(f"note: going on from t = {reached.times[-1]:g}")
    u = jnp.asarray(reached.states[-1], surface.dtype)
    start = time.perf_counter()
    with noted():
        # From a time to itself: nothing to step, everything to compile.
        jax.block_until_ready(solve(equation, surface, u, 0.0, t0=0.0, **how).us)
    reached.compile_seconds = time.perf_counter() - start
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GrowingModesWarning)  # said once
        for t0, t1 in watched("time", unit="frame")(list(itertools.pairwise(times.tolist()))[len(keeper.done) :]):
            start = time.perf_counter()
            solution = solve(equation, surface, u, t1, t0=t0, **how)
            u = jax.block_until_ready(solution.u_end)
            reached.step_seconds += time.perf_counter() - start
            for name, count in solution.counts.items():
                reached.counts[name] = reached.counts.get(name, 0) + int(count)
            reached.times.append(float(solution.t_end))
            reached.states.append(np.asarray(u))
            solution.check(surface)
            frame = dict(
                frame=len(reached.times) - 1,
                t=reached.times[-1],
                counts=dict(reached.counts),
                seconds=reached.step_seconds,
            )
            keeper.keep(reached.states[-1], frame)


def _measure(example: Scenario, surface: Surface, reached: _Progress) -> dict[str, Any]:
    first, last, t_end = reached.states[0], reached.states[-1], reached.times[-1]
    columns = last.reshape(len(last), -1)
    measured: dict[str, Any] = {"reached_time": t_end}
    if example.exact is not None:
        error = np.abs(last - example.exact(t_end))
        scale = np.abs(example.exact(t_end))
        measured["exact_solution"] = example.exact_is
        measured["relative_error_L2"] = float(np.sqrt((error**2).sum() / (scale**2).sum()))
        measured["relative_error_max"] = float(error.max() / scale.max())
    for name, values in zip(example.species, columns.T, strict=True):
        measured[f"range_of_{name}"] = (float(values.min()), float(values.max()))
    if len(example.species) > 1:
        name = example.species[example.shown]
        measured[f"maxima_of_{name}"] = count_maxima(example.mesh, columns[:, example.shown])
        measured[f"minima_of_{name}"] = count_maxima(example.mesh, -columns[:, example.shown])
    # Diffusion conserves the one exactly, the other up to the discretisation error.
    measure = surface.mass if isinstance(surface.scheme, Monotone) else surface.vertex_areas
    for name, state in (("start", first), ("end", last)):
        mass = integrate(surface, jnp.asarray(state, surface.dtype), measure)
        measured[f"mass_at_{name}"] = np.atleast_1d(np.asarray(mass)).tolist()
    counts = reached.counts
    measured["steps"] = counts.get("num_steps", 0)
    if "num_evaluations" in counts:
        measured["evaluations_of_the_rate"] = counts["num_evaluations"]
    measured["compile_seconds"] = reached.compile_seconds
    measured["step_seconds"] = reached.step_seconds
    measured["vertex_steps_per_second"] = counts.get("num_steps", 0) * len(last) / max(reached.step_seconds, 1e-9)
    return measured


def count_maxima(mesh: Mesh, values: np.ndarray) -> int:
    """The number of vertices above the mean whose value no neighbour reaches: spots of a pattern.

    A field that varies by less than a thousandth of its size is uniform and has none.
    """
    if not np.ptp(values) > 1e-3 * np.abs(values).max():
        return 0
    i, j = mesh.edges.T
    highest = np.full(len(values), -np.inf)
    np.maximum.at(highest, i, values[j])
    np.maximum.at(highest, j, values[i])
    return int(np.sum((values > highest) & (values > values.mean())))


def _write(example: Scenario, normals: np.ndarray, out: Path, reached: _Progress) -> list[str]:
    """Write the series and pictures to an empty folder; returns what to call them."""
    from .._output import colors, files, pictures, texture, viewer

    # What was computed in an order that keeps neighbours together is written in that of the source.
    order = example.mesh.source_order
    vertices, faces = example.mesh.vertices[order], np.argsort(order)[example.mesh.faces].astype(np.int32)
    name, times, settings = example.name, np.array(reached.times), example.settings
    states = [u.reshape(len(u), -1) for u in reached.states]
    (out / "series").mkdir()
    frames = [f"series/{name}_{index:04d}.vtp" for index in range(len(times))]
    for frame, state in zip(frames, states, strict=True):
        files.write_vtp(out / frame, vertices, faces, dict(zip(example.species, state[order].T, strict=True)))
    files.write_series(out / f"{name}.pvd", times, frames)

    shown, last = example.species[example.shown], states[-1][order, example.shown]
    limits, colormap = _limits(state[:, example.shown] for state in reversed(states)), settings.colormap
    shades = colors.vertex_colors(last, limits, colormap)
    files.write_ply(out / f"{name}.ply", vertices, faces, shades)
    files.write_glb(out / f"{name}.glb", vertices, faces, shades, normals[order])
    written = [f"{name}.html", f"{name}.pvd", f"series ({len(frames)} states)", f"{name}.ply", f"{name}.glb"]
    if settings.displacement and np.isfinite(last).all():
        moved = texture.displaced(vertices, normals[order], last, settings.displacement)
        files.write_glb(out / f"{name}-displaced.glb", moved, faces, shades, vertex_normals(moved, faces))
        written.append(f"{name}-displaced.glb")
    columns = {s: column for column, s in enumerate(example.species)}
    whole = _Series(states, order, {shown: columns[shown]} | columns)
    viewer.write_viewer(out / f"{name}.html", vertices, faces, times, whole, example.title or name, colormap)
    if (size := (out / f"{name}.html").stat().st_size) > _LARGE_PAGE:
        print(f"note: the viewer's page has {size / 1e6:.0f} MB, much for a phone. Fewer frames make it smaller.")
    if not pictures.can_draw():
        print('note: pictures need the extra "viz": pip install "ltljax[viz]"')
        return written
    if example.mesh.uv is not None:
        try:
            baked = texture.bake(example.mesh.uv, faces, last, settings.texture)
        except ValueError as error:
            print(f"note: no texture is written. {error}")
        else:
            (out / "textured").mkdir(exist_ok=True)
            image = colors.vertex_colors(baked.ravel(), limits, colormap)[:, :3].reshape(*baked.shape, 3)
            texture.write_textured_obj(out / "textured" / f"{name}.obj", vertices, faces, example.mesh.uv, image)
            written.append(f"textured/{name}.obj")
    picture = pictures.Picture(vertices, faces, shown, limits, colormap, settings.view)
    captions = [f"{name}   t = {_short(t)}" for t in times]
    images = (picture.draw(u[order, example.shown], text) for u, text in zip(states, captions, strict=True))
    animation = pictures.write_animation(out / f"{name}.mp4", images)
    pictures.write_png(out / f"{name}.png", picture.draw(last, captions[-1]))
    picture.close()
    return [*written, f"{name}.png", animation.name]


@dataclasses.dataclass(frozen=True)
class _Series(Mapping[str, np.ndarray]):
    """The species over all times, (T, V) in the order of the source, each put together when it is asked for.

    Attributes:
        states: (V, S) of each time.
        order: (V,) of the source.
        columns: of the species by name.
    """

    states: list[np.ndarray]
    order: np.ndarray
    columns: dict[str, int]

    def __getitem__(self, species: str) -> np.ndarray:
        return np.stack([state[self.order, self.columns[species]] for state in self.states])

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)


def _keep_scenario(resolved: dict[str, Any], kept: dict[str, str], out: Path) -> list[str]:
    """The scenario with every value, naming the copies of its files: run it again, and the same comes out."""
    tables = copy.deepcopy({key: value for key, value in resolved.items() if value not in ({}, [])})
    for key, file in kept.items():
        *path, last = key.split(".")
        inner: Any = tables
        for part in path:
            inner = inner[int(part)] if isinstance(inner, list) else inner[part]
        inner[last] = file
    text = f"# Every value of this run: ltljax run scenario.toml\n{tomli_w.dumps(tables)}"
    (out / "scenario.toml").write_text(text, encoding="utf-8")
    return ["scenario.toml", *kept.values()]


def _short(number: float) -> str:
    """A number with three digits, without an exponent where people write none."""
    if number and not 1e-4 <= abs(number) < 1e6:
        return f"{number:.3g}"
    return np.format_float_positional(number, precision=3, fractional=False, trim="-")


def _limits(states: Iterable[np.ndarray]) -> tuple[float, float]:
    """The range of the first of the states that is finite, a little of it even where that is uniform."""
    last = next(values for values in states if np.isfinite(values).all())
    low, high = float(last.min()), float(last.max())
    margin = 1e-3 * max(abs(low), abs(high), 1e-12)
    return (low, high) if high - low > margin else (low - margin, high + margin)


def _versions() -> dict[str, str | None]:
    versions: dict[str, str | None] = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = None
    return versions


def _as_json(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


def _readable(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple | list):
        return (
            " .. ".join(f"{v:.6g}" for v in value) if isinstance(value, tuple) else ", ".join(f"{v:.6g}" for v in value)
        )
    return str(value)
