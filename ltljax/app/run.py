"""A scenario becomes results: time stepping with a progress bar, measurements, and files.

What enters: a `Scenario`. What leaves: a folder with pictures, data and ``summary.json``.
"""

import dataclasses
import itertools
import json
import time
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._base.owned_folder import Folder, OutputError, copies
from .._base.progress import noted, watched
from .._mesh import Mesh
from .._operators import integrate
from .._solve import GrowingModesWarning, SolveError, solve
from .._solve.fingerprint import fingerprint
from .._solve.restart import Keeper
from .._surface import Surface
from .record import INTERRUPTED, as_json, print_measured, scenario_toml, versions
from .run_files import result_names, write_results
from .scenario import Scenario

_RESTART = "restart"


@dataclasses.dataclass
class _Progress:
    """What a run has computed so far.

    Attributes:
        times: times of the states.
        states: (V, S) state at each time.
        compile_seconds: seconds spent on compiling.
        step_seconds: seconds spent on time steps.
        counts: numbers of steps and evaluations.
    """

    times: list[float]
    states: list[np.ndarray]
    compile_seconds: float = 0.0
    step_seconds: float = 0.0
    counts: dict[str, int] = dataclasses.field(default_factory=dict)


def run(
    scenario: Scenario,
    options: dict[str, Any],
    *,
    out: Path,
    inputs: Iterable[Path] = (),
    resume: bool = False,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Solve a scenario and write its results; returns the contents of ``summary.json``.

    During the run every state is saved in ``out/restart``, so that a run that is killed can be resumed. Results of an
    earlier run stay as they are until all new ones are complete.

    Args:
        scenario: the scenario.
        options: options of the command line, for the record; one of them is ``mesh``.
        out: folder for the results; made if absent.
        inputs: files that the run depends on, besides those that the scenario names.
        resume: whether to continue the same run from the states in ``out/restart``.
        overwrite: whether to start over although ``out/restart`` holds a run that has not ended.

    Raises:
        SolveError: the run failed before its end. The results up to then are written.
        RestartError: ``out/restart`` holds another run, or one that has not ended and is neither to be resumed nor to
            be overwritten.
        OutputError: results would replace an input or a file that ltljax did not write, another run is writing to
            ``out``, or the disk is full.
    """
    folder = Folder(out)
    folder.check(result_names(scenario), (*inputs, *scenario.files.values()))
    # Copies of inputs may coincide with the inputs: a run can be repeated from its own folder.
    folder.check(copies(scenario.files).values())
    with folder.locked():
        start = time.perf_counter()
        surface = scenario.make_surface()
        build_seconds = time.perf_counter() - start
        _print_head(scenario, surface, options)
        times = np.linspace(0, scenario.t1, scenario.frames + 1)
        identity = dict(
            mesh=fingerprint((scenario.mesh.vertices, scenario.mesh.faces)),
            scenario=fingerprint((scenario.name, scenario.tables, scenario.u0, options)),
            numbers=fingerprint((times, repr(surface.scheme), scenario.settings.dtype)),
        )
        keeper = Keeper(folder, identity, resume, _RESTART, overwrite, INTERRUPTED)
        progress, failure = _Progress([0.0], [scenario.u0]), None
        try:
            _advance(scenario, surface, times, progress, keeper)
        except SolveError as error:
            failure = error
        except OSError as error:
            raise _disk_error(error, out) from error
        measured = _measure(scenario, surface, progress) | dict(build_seconds=build_seconds)
        print_measured(measured)
        summary = _summary(scenario, surface, options, measured, failure)
        try:
            _write(scenario, np.asarray(surface.normals), folder, progress, summary)
        except OSError as error:
            raise _disk_error(error, out) from error
        keeper.remove()
    print(f"{'written to':32} {out}: {', '.join([*summary['files'], 'summary.json'])}")
    if failure is not None:
        raise failure
    return summary


def _print_head(scenario: Scenario, surface: Surface, options: dict[str, Any]) -> None:
    mesh = scenario.mesh
    print(
        f"{scenario.name} on {options['mesh']}: {mesh.num_vertices} vertices, {mesh.num_faces} faces, {surface.scheme}"
    )
    for note in scenario.notes:
        print(f"note: {note}")


def _disk_error(error: OSError, out: Path) -> OutputError:
    return OutputError(
        f"The results could not be written: {error}. What was computed is in {out / _RESTART}. Make room on the disk, "
        "and give the same command with --resume."
    )


def _summary(
    scenario: Scenario, surface: Surface, options: dict[str, Any], measured: dict[str, Any], failure: Exception | None
) -> dict[str, Any]:
    return dict(
        scenario=scenario.name,
        options=options,
        parameters=scenario.tables,
        scheme=repr(surface.scheme),
        dtype=scenario.settings.dtype,
        frames=scenario.frames,
        t1=scenario.t1,
        tolerances=dict(rtol=scenario.settings.rtol, atol=scenario.settings.atol),
        notes=scenario.notes,
        failure=None if failure is None else str(failure),
        measured=measured,
        mesh=scenario.mesh.report.as_dict(),
        surface=str(surface.report).splitlines(),
        files=[],
        versions=versions(),
        device=str(jax.devices()[0]),
    )


def _write(
    scenario: Scenario, normals: np.ndarray, folder: Folder, progress: _Progress, summary: dict[str, Any]
) -> None:
    """Write all results, which replace those of an earlier run together."""
    with folder.draft() as draft:
        files = write_results(scenario, normals, draft, np.array(progress.times), progress.states)
        copied = folder.keep_inputs(draft, scenario.files)
        text = scenario_toml(scenario.tables, copied, "Every value of this run: ltljax run scenario.toml")
        (draft / "scenario.toml").write_text(text, encoding="utf-8")
        summary["files"] = [*files, "scenario.toml", *copied.values()]
        (draft / "summary.json").write_text(json.dumps(summary, indent=2, default=as_json) + "\n", encoding="utf-8")
        written = {path.relative_to(draft).as_posix() for path in draft.rglob("*") if path.is_file()}
    # Remove what an earlier run wrote and this one does not, such as further frames.
    earlier_frames = {name for name in folder.recorded() if name.startswith(f"series/{scenario.name}_")}
    folder.remove((earlier_frames | set(result_names(scenario))) - written)


def _advance(scenario: Scenario, surface: Surface, times: np.ndarray, progress: _Progress, keeper: Keeper) -> None:
    """Solve from frame to frame, and save the state at each of them."""
    equation, settings = scenario.make_equation(surface), scenario.settings
    arguments: dict[str, Any] = dict(
        solver=settings.solver, rtol=settings.rtol, atol=settings.atol, dt=settings.dt, throw=False
    )
    _restore(progress, keeper)
    u = jnp.asarray(progress.states[-1], surface.dtype)
    start = time.perf_counter()
    with noted():
        # A run of no duration compiles everything and takes no step.
        jax.block_until_ready(solve(equation, surface, u, 0.0, t0=0.0, **arguments).us)
    progress.compile_seconds = time.perf_counter() - start
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GrowingModesWarning)  # It was noted while compiling.
        for t0, t1 in watched("time", unit="frame")(list(itertools.pairwise(times.tolist()))[len(keeper.done) :]):
            start = time.perf_counter()
            solution = solve(equation, surface, u, t1, t0=t0, **arguments)
            u = jax.block_until_ready(solution.u_end)
            progress.step_seconds += time.perf_counter() - start
            for name, count in solution.counts.items():
                progress.counts[name] = progress.counts.get(name, 0) + int(count)
            progress.times.append(float(solution.t_end))
            progress.states.append(np.asarray(u))
            solution.check(surface)
            record = dict(
                frame=len(progress.times) - 1,
                t=progress.times[-1],
                counts=dict(progress.counts),
                seconds=progress.step_seconds,
            )
            keeper.keep(progress.states[-1], record)


def _restore(progress: _Progress, keeper: Keeper) -> None:
    """Take over the saved states of a run that is resumed."""
    # The run continues from the frame before the first one whose state is damaged or missing.
    is_next = [record["frame"] == index for index, record in enumerate(keeper.done, start=1)]
    keeper.keep_first(is_next.index(False) if False in is_next else len(is_next))
    for path in keeper.skipped:
        print(f"note: {path} is damaged and is not used")
    for state, record in zip(keeper.states(), keeper.done, strict=True):
        progress.times.append(record["t"])
        progress.states.append(state)
        progress.counts, progress.step_seconds = record["counts"], record["seconds"]
    if keeper.done:
        print(f"note: continuing from t = {progress.times[-1]:g}")


def _measure(scenario: Scenario, surface: Surface, progress: _Progress) -> dict[str, Any]:
    """Errors, ranges, extrema and masses of the last state, and what the run cost."""
    first, last, t_end = progress.states[0], progress.states[-1], progress.times[-1]
    measured: dict[str, Any] = {"reached_time": t_end}
    if scenario.exact is not None:
        exact = scenario.exact(t_end)
        error = np.abs(last - exact)
        measured["exact_solution"] = scenario.exact_is
        measured["relative_error_L2"] = float(np.sqrt((error**2).sum() / (exact**2).sum()))
        measured["relative_error_max"] = float(error.max() / np.abs(exact).max())
    for name, values in zip(scenario.species, last.T, strict=True):
        measured[f"range_of_{name}"] = (float(values.min()), float(values.max()))
    if len(scenario.species) > 1:
        name, values = scenario.settings.show, last[:, scenario.shown]
        measured[f"maxima_of_{name}"] = count_maxima(scenario.mesh, values)
        measured[f"minima_of_{name}"] = count_maxima(scenario.mesh, -values)
    # Diffusion conserves the mass of Monotone() exactly, and the vertex areas up to the discretisation error.
    measure = surface.quadrature
    for name, state in (("start", first), ("end", last)):
        mass = integrate(surface, jnp.asarray(state, surface.dtype), measure)
        measured[f"mass_at_{name}"] = np.atleast_1d(np.asarray(mass)).tolist()
    num_steps = progress.counts.get("num_steps", 0)
    measured["steps"] = num_steps
    if "num_evaluations" in progress.counts:
        measured["evaluations_of_the_rate"] = progress.counts["num_evaluations"]
    measured["compile_seconds"] = progress.compile_seconds
    measured["step_seconds"] = progress.step_seconds
    measured["vertex_steps_per_second"] = num_steps * len(last) / max(progress.step_seconds, 1e-9)
    return measured


def count_maxima(mesh: Mesh, values: np.ndarray) -> int:
    """The number of vertices above the mean whose value exceeds those of all neighbours: the spots of a pattern.

    A field that varies by less than a thousandth of its size counts as uniform and has none.
    """
    if not np.ptp(values) > 1e-3 * np.abs(values).max():
        return 0
    i, j = mesh.edges.T
    highest_neighbor = np.full(len(values), -np.inf)
    np.maximum.at(highest_neighbor, i, values[j])
    np.maximum.at(highest_neighbor, j, values[i])
    return int(np.sum((values > highest_neighbor) & (values > values.mean())))
