"""A scenario with a table ``[fit]`` becomes the numbers that explain what was seen, and files.

What enters: a `Scenario`. What leaves: a folder with a report, a picture, and the scenario with the numbers found.
"""

import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import tomli_w

from .._base.folder import Folder
from .._base.progress import noted
from .._fit import Experiment, Fit, Observations, Positive, Real, fit, observe_at, observe_patches
from .._lifting.schemes import Scheme
from .._solve.restart import RestartError
from .._surface import FarFromOriginWarning, Surface
from .scenario import Places, Scenario, ScenarioError, Wanted

_RESULTS = ("fit.json", "fitted.toml", "fit.png")
_UNKNOWNS = "unknowns.npz"
_WAYS = "Continue it with --resume, start over with --overwrite, or name another --out."


def recover(
    example: Scenario,
    *,
    scheme: Scheme,
    out: Path,
    inputs: Iterable[Path] = (),
    resume: bool = False,
    overwrite: bool = False,
) -> Fit:
    """Fit the numbers that a scenario leaves free, and write what was found.

    In the folder ``out``: ``fit.json`` (numbers, intervals, singular values), ``fit.png`` with the extra `viz`,
    ``fitted.toml``, the scenario with the numbers found, to be run; and ``restart/unknowns.npz``, to resume from, until
    the fit has settled.

    Args:
        example: the scenario.
        scheme: of the operators.
        out: the folder to write to; made if absent.
        inputs: files that are read beside those the scenario names, and must not be replaced.
        resume: whether to begin with what an interrupted fit of the same data left there.
        overwrite: whether to start over although the folder holds a fit that has not settled.

    Raises:
        ValueError: the scenario has no table ``[fit]``.
        OutputError: the results would replace one of the files that are read, or one that ltljax has not written; or
            another fit is writing there.
        RestartError: the folder holds another fit, or one that has not settled and neither ``resume`` nor
            ``overwrite`` was given.
        FitError: the run fails at the first guess.
    """
    wanted = example.wanted
    if wanted is None:
        raise ValueError(
            f"{example.name} has no table [fit]: name the numbers to find as free = [...] and files of data as "
            "[[fit.data]] with file and time."
        )
    folder, restart = Folder(out), Folder(out / "restart")
    folder.check(_RESULTS, (*inputs, *example.files.values(), *wanted.files))
    if restart.owns(_UNKNOWNS) and not resume and not overwrite:
        raise RestartError(f"{restart.path} holds a fit that has not converged. {_WAYS}")
    settings = example.settings
    with noted(FarFromOriginWarning):
        surface = Surface.from_mesh(example.mesh, scheme, settings.dtype)
    try:
        data = _observations(wanted, surface)
    except ValueError as error:
        raise ScenarioError(f"{example.name}: fit: {error}") from None
    with folder.locked():
        experiment = Experiment(
            lambda free: example.make_equation(surface, free), surface, jnp.asarray(example.u0, surface.dtype),
            solver=settings.solver, dt=settings.dt, rtol=settings.rtol, atol=settings.atol,
        )  # fmt: skip
        found = fit(
            experiment, wanted.start, data, transforms=Positive(), max_iterations=wanted.max_steps, progress=True,
            checkpoint=restart.path / _UNKNOWNS, resume=resume and restart.owns(_UNKNOWNS),
        )  # fmt: skip
        numbers = np.argsort(example.mesh.source_order)
        print(found.summary(numbers))
        with folder.draft() as draft:
            files = _write(example, found, _rows(wanted, found, numbers), draft)
        if found.has_settled:
            with restart.locked():
                restart.remove_itself()
    print(f"written to {out}: {', '.join(files)}")
    return found


def _observations(wanted: Wanted, surface: Surface) -> Observations:
    """The data on the surface.

    Raises:
        ValueError: a point is far from the surface, a patch has no vertices, or the values do not suit the noise.
    """
    options = dict(wanted.options)
    for key, unknown in (("scale", Positive(1.0)), ("offset", Real(0.0))):
        if options.get(key) is True:
            options[key] = unknown
    places = wanted.places
    if places.points is not None:
        options["operator"] = observe_at(surface, places.points)
    elif places.operator is not None:
        options["operator"] = places.operator
    elif places.patches is not None:
        options["operator"] = observe_patches(surface, places.patches)
    else:
        options["vertices"] = places.vertices
    return Observations(wanted.values, times=wanted.times, species=wanted.species, **options)


def _rows(wanted: Wanted, found: Fit, numbers: np.ndarray) -> list[dict[str, Any]]:
    """The outliers by time, by the row of their file, from 0, and by species."""
    is_whole = wanted.places.is_same(Places())
    return [
        dict(
            time=float(wanted.times[when]),
            row=int(numbers[where] if is_whole else where),
            species=int(wanted.species[s]),
        )
        for when, where, s in found.agreement.outliers.tolist()
    ]


def _write(example: Scenario, found: Fit, outliers: list[dict[str, Any]], out: Path) -> list[str]:
    numbers = {key: float(value) for key, value in found.params.items()}
    record: dict[str, Any] = dict(
        scenario=example.name, found=numbers, loss=found.loss, steps=found.num_iterations, runs=found.num_runs,
        reason=found.reason, status=found.status, converged=found.converged, method=found.method,
        scanned=found.scanned, explanation=found.agreement.sentence(),
        agreement=dataclasses.asdict(found.agreement) | dict(outliers=outliers),
        calibration={name: np.asarray(value).tolist() for name, value in found.calibration.items()},
    )  # fmt: skip
    if (known := found.evidence) is not None:
        low, high = known.intervals
        record |= dict(
            std=dict(zip(known.names, known.std.tolist(), strict=True)),
            confidence=known.confidence,
            intervals={key: (float(low[key]), float(high[key])) for key in numbers},
            ends=dict(zip(known.names, known.ends.T.tolist(), strict=True)),
            singular_values=known.singular_values.tolist(),
            noise=known.noise,
            cannot_tell=known.cannot_tell,
        )
    record = json.loads(json.dumps(record), parse_constant=lambda _: None)  # NaN and infinity are no JSON
    (out / "fit.json").write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    files = ["fit.json"]
    tables = json.loads(json.dumps(example.resolved))  # a copy of plain values
    tables.pop("fit", None)
    for key, value in numbers.items():
        table, name = key.split(".")
        tables[table][name] = value
    text = tomli_w.dumps({key: value for key, value in tables.items() if value not in ({}, [])})
    head = "# With the numbers found: ltljax run fitted.toml, beside the files it names\n"
    (out / "fitted.toml").write_text(head + text, encoding="utf-8")
    files.append("fitted.toml")
    try:
        figure = found.plot()
    except ImportError:
        print('note: pictures need the extra "viz": pip install "ltljax[viz]"')
    else:
        figure.savefig(out / "fit.png", dpi=110)
        files.append("fit.png")
    return files
