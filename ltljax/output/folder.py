"""The folder of a run or of another command: copies of the files it was made from, and nothing of the user's replaced.

What enters: the folder, the name of the run, the files it reads. What leaves: copies of these under ``inputs``, or an
`OutputError` before anything is computed.
"""

import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

# What a run writes beside its series, by ending.
_ENDINGS = ("html", "pvd", "ply", "glb", "png", "mp4", "gif")
_COPIES = "inputs"


class OutputError(ValueError):
    """A folder in which the results would replace what is no result."""


def check_folder(out: Path, name: str, inputs: Iterable[Path], copies: Mapping[str, Path]) -> None:
    """Raise where the results would replace one of the inputs, or a file that no run has written.

    Args:
        out: the folder, which may be absent.
        name: of the run, with which the names of its results begin.
        inputs: the files that are read.
        copies: those of them of which copies will be kept, as of `keep_inputs`.

    Raises:
        OutputError: it names the file and what to do.
    """
    textured = [f"textured/{name}.{ending}" for ending in ("obj", "mtl", "png")]
    results = [f"{name}.{ending}" for ending in _ENDINGS]
    results += [f"{name}-displaced.glb", "summary.json", "scenario.toml", *textured]
    there = [path for path in (out / result for result in results) if path.exists()]
    there += sorted((out / "series").glob(f"{name}_*.vtp"))
    targets = {out / _copy(key, file): file for key, file in copies.items()}
    _spare_inputs(out, there, inputs)
    # A copy in its place may be what is read.
    _spare_inputs(out, [copy for copy, file in targets.items() if not (copy.exists() and copy.samefile(file))], inputs)
    if there and not _is_of_a_run(out):
        raise OutputError(f"The results would replace {there[0]}, which no run has written. Name another --out.")


def check_fit_folder(out: Path, inputs: Iterable[Path]) -> None:
    """Raise where the results of a fit would replace one of the inputs, or a file that no fit has written.

    Args:
        out: the folder, which may be absent.
        inputs: the files that are read.

    Raises:
        OutputError: it names the file and what to do.
    """
    there = [out / name for name in ("fit.json", "fitted.toml", "fit.png") if (out / name).exists()]
    _spare_inputs(out, there, inputs)
    if there and not _has_keys(out / "fit.json", {"found", "loss", "reason"}):
        raise OutputError(f"The results would replace {there[0]}, which no fit has written. Name another --out.")


def check_results(out: Path, marker: str, results: Iterable[str], inputs: Iterable[Path]) -> None:
    """Raise where the results of a command would replace one of the inputs, or a file that it has not written.

    Args:
        out: the folder, which may be absent.
        marker: the name of the JSON file by which the command knows what it has written, as of `written_before`.
        results: the names of the other files that it may write.
        inputs: the files that are read.

    Raises:
        OutputError: it names the file and what to do.
    """
    there = [path for path in (out / name for name in (marker, *results)) if path.exists()]
    _spare_inputs(out, there, inputs)
    own = {out / name for name in written_before(out, marker)}
    foreign = [path for path in there if path not in own]
    if foreign:
        raise OutputError(
            f"The results would replace {foreign[0]}, which no such command has written. Name another --out."
        )


def written_before(out: Path, marker: str) -> list[str]:
    """The files that a command has written to a folder, the marker first; none without a marker of its own."""
    record = _record(out / marker)
    if not {"command", "measured", "versions"} <= record.keys():
        return []
    lists = [record.get(key) for key in ("files", "earlier_files")]
    return [marker, *(name for names in lists if isinstance(names, list) for name in names if isinstance(name, str))]


def _spare_inputs(out: Path, results: Iterable[Path], inputs: Iterable[Path]) -> None:
    read = [path for path in inputs if path.exists()]
    for path in results:
        if path.exists() and any(path.samefile(file) for file in read):
            raise OutputError(f"The results in {out} would replace {path}, which the run reads. Name another --out.")


def keep_inputs(out: Path, files: Mapping[str, Path]) -> dict[str, str]:
    """Copy files into the folder; returns their names relative to it.

    Args:
        out: the folder.
        files: by the dotted key that names each, as ``{"mesh.file": Path("spot.obj")}``. Each goes into a folder of
            its own, so that equal names stay apart.
    """
    kept = {key: _copy(key, file) for key, file in files.items()}
    for key, file in files.items():
        target = out / kept[key]
        target.parent.mkdir(parents=True, exist_ok=True)
        if not (target.exists() and target.samefile(file)):
            shutil.copyfile(file, target)
    return kept


def _copy(key: str, file: Path) -> str:
    """Where the copy of an input lies: in a folder named by the tables that name the input."""
    return "/".join([_COPIES, "-".join(key.split(".")[:-1]), file.name])


def _is_of_a_run(out: Path) -> bool:
    """Whether a run has written to a folder, or was interrupted there."""
    return (out / "restart" / "run.json").exists() or _has_keys(out / "summary.json", {"scenario", "versions", "files"})


def _has_keys(path: Path, keys: set[str]) -> bool:
    """Whether a file holds a JSON object with these keys."""
    return keys <= _record(path).keys()


def _record(path: Path) -> dict[str, Any]:
    """The JSON object of a file; empty where it holds none."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
