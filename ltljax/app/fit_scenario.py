"""A scenario with a table ``[fit]`` is fitted to its measurements.

What enters: a `Scenario`. What leaves: a folder with a report, a picture, and the scenario with the fitted numbers.
"""

import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._base.owned_folder import Folder
from .._fit import Experiment, Fit, Observations, Positive, Real, fit, observe_at, observe_patches
from .._solve.restart import RestartError
from .._surface import Surface
from .record import INTERRUPTED, NO_PICTURES, scenario_toml
from .scenario import FitTask, Places, Scenario, ScenarioError

_RESULTS = ("fit.json", "fitted.toml", "fit.png")
_UNKNOWNS = "unknowns.npz"


def fit_scenario(
    scenario: Scenario,
    *,
    out: Path,
    inputs: Iterable[Path] = (),
    resume: bool = False,
    overwrite: bool = False,
) -> Fit:
    """Fit the unknowns of a scenario and write the results; returns the fit.

    The folder ``out`` receives ``fit.json`` (fitted numbers, intervals, singular values); ``fit.png``, with the extra
    `viz`; ``fitted.toml``, a scenario with the fitted numbers; and, until the fit has settled,
    ``restart/unknowns.npz``, from which it can be resumed.

    Args:
        scenario: the scenario.
        out: folder for the results; made if absent.
        inputs: files that the fit depends on, besides those that the scenario names.
        resume: whether to start from the unknowns that an interrupted fit of the same data left there.
        overwrite: whether to start over although the folder holds a fit that has not settled.

    Raises:
        ValueError: the scenario has no table ``[fit]``.
        OutputError: the results would replace an input or a file that ltljax did not write, or another fit is writing
            to ``out``.
        RestartError: the folder holds another fit, or one that has not settled and is neither to be resumed nor to be
            overwritten.
        FitError: the run fails at the first guess.
    """
    task = scenario.fit_task
    if task is None:
        raise ValueError(
            f"{scenario.name} has no table [fit]. Add one that names the unknowns as free = [...] and the files of "
            "measurements as [[fit.data]] with file and time; ltljax new fit prints an example."
        )
    folder, restart = Folder(out), Folder(out / "restart")
    folder.check(_RESULTS, (*inputs, *scenario.files.values()))
    is_interrupted = restart.owns(_UNKNOWNS)
    if is_interrupted and not resume and not overwrite:
        raise RestartError(f"{restart.path} holds a fit that has not converged. {INTERRUPTED}")
    settings = scenario.settings
    surface = scenario.make_surface()
    try:
        data = _observations(task, surface)
    except ValueError as error:
        raise ScenarioError(f"{scenario.name}: fit: {error}") from None
    with folder.locked():
        experiment = Experiment(
            lambda free: scenario.make_equation(surface, free), surface, jnp.asarray(scenario.u0, surface.dtype),
            solver=settings.solver, dt=settings.dt, rtol=settings.rtol, atol=settings.atol,
        )  # fmt: skip
        result = fit(
            experiment, task.start, data, transforms=Positive(), max_iterations=task.max_iterations, progress=True,
            checkpoint=restart.path / _UNKNOWNS, resume=resume and is_interrupted,
        )  # fmt: skip
        numbers_in_file = np.argsort(scenario.mesh.source_order)
        print(result.summary(numbers_in_file))
        with folder.draft() as draft:
            files = _write(scenario, result, _outliers(task, result, numbers_in_file), draft)
        if result.has_settled:
            with restart.locked():
                restart.remove_itself()
    print(f"written to {out}: {', '.join(files)}")
    return result


def _observations(task: FitTask, surface: Surface) -> Observations:
    """The measurements on the surface.

    Raises:
        ValueError: a point is far from the surface, a patch has no vertices, or the values do not suit the noise.
    """
    options = dict(task.options)
    for key, unknown in (("scale", Positive(1.0)), ("offset", Real(0.0))):
        if options.get(key) is True:
            options[key] = unknown
    places = task.places
    if places.points is not None:
        options["operator"] = observe_at(surface, places.points)
    elif places.operator is not None:
        options["operator"] = places.operator
    elif places.patches is not None:
        options["operator"] = observe_patches(surface, places.patches)
    else:
        options["vertices"] = places.vertices
    return Observations(task.values, times=task.times, species=task.species, **options)


def _outliers(task: FitTask, result: Fit, numbers_in_file: np.ndarray) -> list[dict[str, Any]]:
    """The time, the row in the file (from 0) and the species of every outlier."""
    is_everywhere = task.places.is_same(Places())
    return [
        dict(
            time=float(task.times[time]),
            row=int(numbers_in_file[place] if is_everywhere else place),
            species=int(task.species[s]),
        )
        for time, place, s in result.agreement.outliers.tolist()
    ]


def _write(scenario: Scenario, result: Fit, outliers: list[dict[str, Any]], out: Path) -> list[str]:
    """Write all results; returns the names of the files."""
    numbers = {key: float(value) for key, value in result.params.items()}
    # JSON has no NaN and no infinity.
    record = json.loads(json.dumps(_record(scenario, result, numbers, outliers)), parse_constant=lambda _: None)
    (out / "fit.json").write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    tables = {key: value for key, value in scenario.tables.items() if key != "fit"}
    text = scenario_toml(
        tables, numbers, "The scenario with the fitted numbers: ltljax run fitted.toml, beside its files"
    )
    (out / "fitted.toml").write_text(text, encoding="utf-8")
    files = ["fit.json", "fitted.toml"]
    try:
        figure = result.plot()
    except ImportError:
        print(NO_PICTURES)
    else:
        figure.savefig(out / "fit.png", dpi=110)
        files.append("fit.png")
    return files


def _record(
    scenario: Scenario, result: Fit, numbers: dict[str, float], outliers: list[dict[str, Any]]
) -> dict[str, Any]:
    """The contents of ``fit.json``."""
    record: dict[str, Any] = dict(
        scenario=scenario.name, found=numbers, loss=result.loss, steps=result.num_iterations, runs=result.num_runs,
        reason=result.reason, status=result.status, converged=result.converged, method=result.method,
        scanned=result.scanned, explanation=result.agreement.sentence(),
        agreement=dataclasses.asdict(result.agreement) | dict(outliers=outliers),
        calibration={name: np.asarray(value).tolist() for name, value in result.calibration.items()},
    )  # fmt: skip
    if (evidence := result.evidence) is not None:
        low, high = evidence.intervals
        record |= dict(
            std=dict(zip(evidence.names, evidence.std.tolist(), strict=True)),
            confidence=evidence.confidence,
            intervals={key: (float(low[key]), float(high[key])) for key in numbers},
            ends=dict(zip(evidence.names, evidence.ends.T.tolist(), strict=True)),
            singular_values=evidence.singular_values.tolist(),
            noise=evidence.noise,
            cannot_tell=evidence.cannot_tell,
        )
    return record
