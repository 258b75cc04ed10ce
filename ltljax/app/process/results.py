"""What a command leaves behind: a folder in which nothing of the user's is replaced.

What enters: numbers, colours and pictures of a `Subject`, in the order of its mesh. What leaves: files, in the order of
the mesh file.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from ..._base.folder import Folder
from .subject import Subject

_NO_PICTURES = 'note: pictures need the extra "viz": pip install "ltljax[viz]"'
# Of the values in a picture, in percent, how many lie within the colours: the few that stand out, which curvature has
# more of, would wash out the rest.
_SHOWN, _SHOWN_ABOUT_ZERO = 98, 90


class Results:
    """The folder of a command, and what it is to hold: everything is written in the end, by `finish`.

    Args:
        command: its name, with which the names of all files begin.
        subject: what it works on.
        out: the folder, which may be absent.
        pictures: the names of the pictures, which follow the command's.
        inputs: the files that are read beside the mesh.

    Raises:
        OutputError: results would replace what is read, or what ltljax has not written.
    """

    def __init__(self, command: str, subject: Subject, out: Path, pictures: Sequence[str], inputs: Sequence[Path] = ()):
        from ..._output.pictures import can_draw

        self.command, self.subject, self.folder = command, subject, Folder(out)
        self._writers: dict[str, Callable[[Path], Any]] = {}
        self.draws = can_draw()
        self._record_name = f"{command}.json"
        names = [self._record_name, *(f"{command}.{ending}" for ending in ("ply", "vtp", "obj"))]
        names += [f"textured/{command}.{ending}" for ending in ("obj", "mtl", "png")]
        names += [self._picture(name) for name in pictures]
        self.folder.check(names, (*inputs, *([subject.path] if subject.path else [])))
        self._possible = names
        mesh = subject.mesh
        self.vertices = subject.in_file_order(mesh.vertices)
        self.faces = np.argsort(mesh.source_order)[mesh.faces].astype(np.int32)
        print(f"{command} on {subject.name}: {mesh.num_vertices} vertices, {mesh.num_faces} faces")

    def numbers(self, fields: Mapping[str, Any], moved: np.ndarray | None = None) -> None:
        """Fields (V,) or (V, C) as VTP, on moved vertices if there are such."""
        from ..._output.files import write_vtp

        ordered = {name: self.subject.in_file_order(np.asarray(values)) for name, values in fields.items()}
        vertices = self._placed(moved)
        self._writers[f"{self.command}.vtp"] = lambda path: write_vtp(path, vertices, self.faces, ordered)

    def colors(self, colors: np.ndarray, moved: np.ndarray | None = None) -> None:
        """The mesh as PLY with colours (V, 3) or (V, 4) of unsigned bytes."""
        from ..._output.files import write_ply

        vertices, ordered = self._placed(moved), self.subject.in_file_order(colors)
        self._writers[f"{self.command}.ply"] = lambda path: write_ply(path, vertices, self.faces, ordered)

    def shape(self, moved: np.ndarray, colors: np.ndarray | None = None) -> None:
        """Moved vertices and the faces as OBJ, with a UV map if there is one, and colours (V, 3) from 0 to 1."""
        from ..._output.files import write_obj

        vertices, uv = self._placed(moved), self.subject.mesh.uv
        ordered = None if colors is None else self.subject.in_file_order(colors)
        self._writers[f"{self.command}.obj"] = lambda path: write_obj(path, vertices, self.faces, uv, colors=ordered)

    def textured(self, image: np.ndarray) -> None:
        """The mesh as OBJ with an image (H, W, 3) of unsigned bytes; nothing where no image can be written."""
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
        """A picture of a field (V,) between limits, or of colours (V, 3); nothing where none can be drawn."""
        from ..._output import pictures

        if not self.draws:
            return
        caption = " ".join(part for part in (self.subject.name, self.command, name) if part)
        drawn = pictures.Picture(self._placed(moved), self.faces, title or "colours", limits, colormap)
        image = drawn.draw(self.subject.in_file_order(values), caption)
        drawn.close()
        self.image(name, image)

    def image(self, name: str, image: np.ndarray) -> None:
        """Pixels as PNG; nothing where none can be written."""
        from ..._output.pictures import write_png

        if self.draws:
            self._writers[self._picture(name)] = lambda path: write_png(path, image)

    def finish(self, options: Mapping[str, Any], measured: Mapping[str, Any]) -> None:
        """Write all files and the record, and say in short what came out. What an earlier command of the same name
        wrote, and this one does not, is removed."""
        for name, value in measured.items():
            if value is None:
                continue
            print(f"{name.replace('_', ' '):32} {_readable(value)}")
        if not self.draws:
            print(_NO_PICTURES)
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
            self.folder.remove(set(self._possible) - {*files, self._record_name})
        print(f"{'written to':32} {self.folder.path}: {', '.join([*files, self._record_name])}")

    def _picture(self, name: str) -> str:
        return f"{self.command}-{name}.png" if name else f"{self.command}.png"

    def _placed(self, moved: np.ndarray | None) -> np.ndarray:
        return self.vertices if moved is None else self.subject.in_file_order(moved)


def symmetric(*fields: np.ndarray) -> tuple[float, float]:
    """Limits about zero between which most of the values lie."""
    most = max(float(np.percentile(np.abs(values), _SHOWN_ABOUT_ZERO)) for values in fields)
    return (-most, most) if most > 0 else (-1.0, 1.0)


def usual(values: np.ndarray) -> tuple[float, float]:
    """Limits between which most of the values lie."""
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, [50 - _SHOWN / 2, 50 + _SHOWN / 2])
    margin = 1e-3 * max(abs(low), abs(high), 1e-12)
    return (float(low), float(high)) if high - low > margin else (float(low - margin), float(high + margin))


def _readable(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
