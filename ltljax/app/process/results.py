"""The results of a command: a folder in which no file of the user is replaced.

What enters: numbers, colours and pictures of a `Subject`, in the order of its mesh. What leaves: files, in the order of
the mesh file.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from ..._base.owned_folder import Folder
from ..record import NO_PICTURES, print_measured
from .subject import Subject

# The share of the values, in percent, that the colours of a picture resolve. A few outliers, of which curvature has
# more, would otherwise leave no contrast to the rest.
_SHOWN, _SHOWN_ABOUT_ZERO = 98, 90


class Results:
    """The folder of a command and its future contents. All files are written at the end, by `finish`.

    Args:
        command: name of the command, with which the names of all files begin.
        subject: what the command works on.
        out: the folder, which may be absent.
        pictures: names of the pictures, which follow the name of the command.
        inputs: files that are read, besides the mesh.

    Raises:
        OutputError: results would replace an input, or a file that ltljax did not write.
    """

    def __init__(self, command: str, subject: Subject, out: Path, pictures: Sequence[str], inputs: Sequence[Path] = ()):
        from ..._output.pictures import can_draw

        self.command, self.subject, self.folder = command, subject, Folder(out)
        self._writers: dict[str, Callable[[Path], Any]] = {}
        self.draws = can_draw()
        self._record_name = f"{command}.json"
        names = [self._record_name, *(f"{command}.{ending}" for ending in ("ply", "vtp", "obj"))]
        names += [f"textured/{command}.{ending}" for ending in ("obj", "mtl", "png")]
        names += [self._picture_name(name) for name in pictures]
        self.folder.check(names, (*inputs, *([subject.path] if subject.path else [])))
        self._possible_names = names
        mesh = subject.mesh
        self.vertices = subject.in_file_order(mesh.vertices)
        self.faces = np.argsort(mesh.source_order)[mesh.faces].astype(np.int32)
        print(f"{command} on {subject.name}: {mesh.num_vertices} vertices, {mesh.num_faces} faces")

    def numbers(self, fields: Mapping[str, Any], moved: np.ndarray | None = None) -> None:
        """Add fields (V,) or (V, C) as VTP, at moved vertices if there are any."""
        from ..._output.files import write_vtp

        ordered = {name: self.subject.in_file_order(np.asarray(values)) for name, values in fields.items()}
        vertices = self._positions(moved)
        self._writers[f"{self.command}.vtp"] = lambda path: write_vtp(path, vertices, self.faces, ordered)

    def colors(self, colors: np.ndarray, moved: np.ndarray | None = None) -> None:
        """Add the mesh as PLY, with colours (V, 3) or (V, 4) of unsigned bytes."""
        from ..._output.files import write_ply

        vertices, ordered = self._positions(moved), self.subject.in_file_order(colors)
        self._writers[f"{self.command}.ply"] = lambda path: write_ply(path, vertices, self.faces, ordered)

    def shape(self, moved: np.ndarray, colors: np.ndarray | None = None) -> None:
        """Add the mesh with moved vertices as OBJ, with its UV map if it has one, and colours (V, 3) from 0 to 1."""
        from ..._output.files import write_obj

        vertices, uv = self._positions(moved), self.subject.mesh.uv
        ordered = None if colors is None else self.subject.in_file_order(colors)
        self._writers[f"{self.command}.obj"] = lambda path: write_obj(path, vertices, self.faces, uv, colors=ordered)

    def textured(self, image: np.ndarray) -> None:
        """Add the mesh as OBJ with an image (H, W, 3) of unsigned bytes; does nothing if images cannot be written."""
        from ..._output.texture import write_textured_obj

        uv = self.subject.mesh.uv
        if self.draws and uv is not None:
            self._writers[f"textured/{self.command}.obj"] = lambda path: write_textured_obj(
                path, self.vertices, self.faces, uv, image
            )

    def picture(
        self,
        name: str,
        values: np.ndarray,
        title: str = "",
        limits: tuple[float, float] | None = None,
        colormap: str | np.ndarray = "viridis",
        moved: np.ndarray | None = None,
    ) -> None:
        """Add a picture of a field (V,) between limits, or of colours (V, 3); does nothing without PyVista."""
        from ..._output import pictures

        if not self.draws:
            return
        caption = " ".join(part for part in (self.subject.name, self.command, name) if part)
        picture = pictures.Picture(self._positions(moved), self.faces, title or "colours", limits, colormap)
        image = picture.draw(self.subject.in_file_order(values), caption)
        picture.close()
        self.image(name, image)

    def image(self, name: str, image: np.ndarray) -> None:
        """Add pixels as PNG; does nothing if images cannot be written."""
        from ..._output.pictures import write_png

        if self.draws:
            self._writers[self._picture_name(name)] = lambda path: write_png(path, image)

    def finish(self, options: Mapping[str, Any], measured: Mapping[str, Any]) -> None:
        """Write all files and the record, and print what was measured.

        Files of an earlier run of the same command that this one does not write are removed.
        """
        print_measured(measured)
        if not self.draws:
            print(NO_PICTURES)
        with self.folder.locked():
            with self.folder.draft() as draft:
                for name, write in self._writers.items():
                    (draft / name).parent.mkdir(parents=True, exist_ok=True)
                    write(draft / name)
                files = sorted(path.relative_to(draft).as_posix() for path in draft.rglob("*") if path.is_file())
                record = dict(
                    command=self.command,
                    mesh=self.subject.name,
                    options=dict(options),
                    measured=dict(measured),
                    files=files,
                    versions={package: version(package) for package in ("ltljax", "jax", "numpy")},
                )
                (draft / self._record_name).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
            self.folder.remove(set(self._possible_names) - {*files, self._record_name})
        print(f"{'written to':32} {self.folder.path}: {', '.join([*files, self._record_name])}")

    def _picture_name(self, name: str) -> str:
        return f"{self.command}-{name}.png" if name else f"{self.command}.png"

    def _positions(self, moved: np.ndarray | None) -> np.ndarray:
        return self.vertices if moved is None else self.subject.in_file_order(moved)


def symmetric(*fields: np.ndarray) -> tuple[float, float]:
    """Limits about zero between which most of the values lie."""
    largest = max(float(np.percentile(np.abs(values), _SHOWN_ABOUT_ZERO)) for values in fields)
    return (-largest, largest) if largest > 0 else (-1.0, 1.0)


def usual(values: np.ndarray) -> tuple[float, float]:
    """Limits between which most of the values lie."""
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, [50 - _SHOWN / 2, 50 + _SHOWN / 2])
    margin = 1e-3 * max(abs(low), abs(high), 1e-12)
    return (float(low), float(high)) if high - low > margin else (float(low - margin), float(high + margin))
