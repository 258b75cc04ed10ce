"""The files of a run: a series for ParaView, surfaces with colours, a viewer, pictures and an animation.

What enters: a `Scenario` and its states. What leaves: files in an empty folder, and their names.
"""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from .._mesh import vertex_normals
from .record import NO_PICTURES
from .scenario import Scenario

# Size of a viewer in bytes above which the user is told.
_LARGE_VIEWER = 15_000_000


def result_names(scenario: Scenario) -> list[str]:
    """The names of all files that a run may write. `Folder.check` refuses those that ltljax did not write."""
    name = scenario.name
    names = [f"{name}.{ending}" for ending in ("html", "pvd", "ply", "glb", "png", "mp4", "gif")]
    names += [f"textured/{name}.{ending}" for ending in ("obj", "mtl", "png")]
    names += [_frame_name(name, index) for index in range(scenario.frames + 1)]
    return [*names, f"{name}-displaced.glb", "scenario.toml", "summary.json"]


def _frame_name(name: str, index: int) -> str:
    return f"series/{name}_{index:04d}.vtp"


def write_results(
    scenario: Scenario, normals: np.ndarray, out: Path, times: np.ndarray, states: list[np.ndarray]
) -> list[str]:
    """Write the states and pictures of a run to an empty folder; returns the names of the files.

    Args:
        scenario: the scenario.
        normals: (V, 3) normals.
        out: the folder.
        times: (T,) times of the states.
        states: (V, S) state at each time.
    """
    return _Writer(scenario, normals, out, times, states).write()


class _Writer:
    """Writes states in the order of the mesh file, which differs from that of the computation."""

    def __init__(self, scenario: Scenario, normals: np.ndarray, out: Path, times: np.ndarray, states: list[np.ndarray]):
        from .._output import colors

        self.scenario, self.settings, self.name, self.out = scenario, scenario.settings, scenario.name, out
        self.times, self.states, self.order = times, states, scenario.mesh.source_order
        self.vertices, self.normals = scenario.mesh.vertices[self.order], normals[self.order]
        self.faces = np.argsort(self.order)[scenario.mesh.faces].astype(np.int32)
        self.values = states[-1][self.order, scenario.shown]
        self.limits = _limits(state[:, scenario.shown] for state in reversed(states))
        self.colors = colors.vertex_colors(self.values, self.limits, self.settings.colormap)

    def write(self) -> list[str]:
        """Write all files; returns their names."""
        from .._output import pictures

        names = [self.viewer(), *self.series(), *self.surfaces()]
        if not pictures.can_draw():
            print(NO_PICTURES)
            return names
        return [*names, *self.texture(), *self.pictures()]

    def series(self) -> list[str]:
        """The states for ParaView."""
        from .._output import files

        (self.out / "series").mkdir()
        frames = [_frame_name(self.name, index) for index in range(len(self.times))]
        for frame, state in zip(frames, self.states, strict=True):
            fields = dict(zip(self.scenario.species, state[self.order].T, strict=True))
            files.write_vtp(self.out / frame, self.vertices, self.faces, fields)
        files.write_series(self.out / f"{self.name}.pvd", self.times, frames)
        return [f"{self.name}.pvd", f"series ({len(frames)} states)"]

    def surfaces(self) -> list[str]:
        """The surface with the colours of the last state, and its relief."""
        from .._output import files, texture

        vertices, name, height = self.vertices, self.name, self.settings.displacement
        files.write_ply(self.out / f"{name}.ply", vertices, self.faces, self.colors)
        files.write_glb(self.out / f"{name}.glb", vertices, self.faces, self.colors, self.normals)
        if not height or not np.isfinite(self.values).all():
            return [f"{name}.ply", f"{name}.glb"]
        relief = texture.displaced(vertices, self.normals, self.values, height)
        path = self.out / f"{name}-displaced.glb"
        files.write_glb(path, relief, self.faces, self.colors, vertex_normals(relief, self.faces))
        return [f"{name}.ply", f"{name}.glb", path.name]

    def viewer(self) -> str:
        """The viewer, a page for the browser."""
        from .._output import viewer

        columns = {s: column for column, s in enumerate(self.scenario.species)}
        shown = self.settings.show  # comes first
        fields = _Series(self.states, self.order, {shown: columns[shown]} | columns)
        path = self.out / f"{self.name}.html"
        viewer.write_viewer(
            path, self.vertices, self.faces, self.times, fields, self.scenario.title, self.settings.colormap
        )
        if (size := path.stat().st_size) > _LARGE_VIEWER:
            print(f"note: the viewer has {size / 1e6:.0f} MB, which is much for a phone. Use fewer frames.")
        return path.name

    def texture(self) -> list[str]:
        """The surface with the last state as a texture, if the mesh has a UV map."""
        from .._output import colors, texture

        uv, name = self.scenario.mesh.uv, self.name
        if uv is None:
            return []
        try:
            baked = texture.bake(uv, self.faces, self.values, self.settings.texture)
        except ValueError as error:
            print(f"note: no texture is written. {error}")
            return []
        (self.out / "textured").mkdir(exist_ok=True)
        shades = colors.vertex_colors(baked.ravel(), self.limits, self.settings.colormap)
        image = shades[:, :3].reshape(*baked.shape, 3)
        texture.write_textured_obj(self.out / "textured" / f"{name}.obj", self.vertices, self.faces, uv, image)
        return [f"textured/{name}.obj"]

    def pictures(self) -> list[str]:
        """A picture of the last state and an animation of all states."""
        from .._output import pictures

        settings = self.settings
        picture = pictures.Picture(
            self.vertices, self.faces, settings.show, self.limits, settings.colormap, settings.view
        )
        captions = [f"{self.name}   t = {short_number(t)}" for t in self.times]
        columns = (state[self.order, self.scenario.shown] for state in self.states)
        images = (picture.draw(values, caption) for values, caption in zip(columns, captions, strict=True))
        animation = pictures.write_animation(self.out / f"{self.name}.mp4", images)
        pictures.write_png(self.out / f"{self.name}.png", picture.draw(self.values, captions[-1]))
        picture.close()
        return [f"{self.name}.png", animation.name]


@dataclasses.dataclass(frozen=True)
class _Series(Mapping[str, np.ndarray]):
    """The species over all times, (T, V) in the order of the mesh file. Each is stacked only when it is asked for.

    Attributes:
        states: (V, S) state at each time.
        order: (V,) order of the mesh file.
        columns: column of each species.
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


def short_number(number: float) -> str:
    """A number with three digits, without an exponent unless it is very small or very large."""
    if number and not 1e-4 <= abs(number) < 1e6:
        return f"{number:.3g}"
    return np.format_float_positional(number, precision=3, fractional=False, trim="-")


def _limits(states: Iterable[np.ndarray]) -> tuple[float, float]:
    """The range of the first finite one of the states, widened a little if the state is uniform."""
    values = next(values for values in states if np.isfinite(values).all())
    low, high = float(values.min()), float(values.max())
    margin = 1e-3 * max(abs(low), abs(high), 1e-12)
    return (low, high) if high - low > margin else (low - margin, high + margin)
