"""Pictures and animations of a field on a surface, rendered off-screen by PyVista (the extra `viz`)."""

import importlib.util
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from .colors import colormap_samples

# From where the left half of a picture looks, and what is up there; the right half looks from the opposite side. y is
# up, as in most mesh files. Seen aslant, both halves look a little from above.
VIEWS: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "aslant": ((0.55, 0.35, 1.0), (0, 1, 0)),
    "front": ((0, 0, 1), (0, 1, 0)),
    "back": ((0, 0, -1), (0, 1, 0)),
    "right": ((1, 0, 0), (0, 1, 0)),
    "left": ((-1, 0, 0), (0, 1, 0)),
    "top": ((0, 1, 0), (0, 0, -1)),
    "bottom": ((0, -1, 0), (0, 0, 1)),
}
_SIZE = (1280, 640)
_FRAMES_PER_SECOND = 20


def can_draw() -> bool:
    """Whether the picture extra is installed."""
    return importlib.util.find_spec("pyvista") is not None


class Picture:
    """A surface with a colour-mapped field on it, or with colours, drawn off-screen.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        title: the name of the field, beside the colour bar.
        limits: the ends of the colour bar; None where what is drawn are colours, (V, 3) of unsigned bytes.
        colormap: one of `ltl.io.COLORMAPS`, or the samples (N, 3) of one.
        view: one of `VIEWS`.
    """

    def __init__(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        title: str,
        limits: tuple[float, float] | None,
        colormap: str | np.ndarray = "viridis",
        view: str = "aslant",
    ):
        import pyvista

        self._surface: Any = pyvista.PolyData.from_regular_faces(vertices - vertices.mean(axis=0), faces)
        count = len(vertices)
        self._surface[title] = np.zeros((count, 3), np.uint8) if limits is None else np.full(count, limits[0])
        self._title = title
        self._text: Any = None
        # Without a display VTK says so before it renders off-screen all the same.
        self._quiet = pyvista.vtk_verbosity
        with self._quiet("error"):
            self._plotter = self._compose(pyvista.Plotter, limits, colormap, view)

    def _compose(
        self, plotter_class: Any, limits: tuple[float, float] | None, colormap: str | np.ndarray, view: str
    ) -> Any:
        from matplotlib.colors import LinearSegmentedColormap  # which PyVista brings

        plotter = plotter_class(off_screen=True, window_size=list(_SIZE), shape=(1, 2), border=False)
        bar = dict(color="black", fmt="%.3g", n_labels=2, position_x=0.3, position_y=0.02, width=0.65, height=0.08)
        painted: dict[str, Any] = dict(rgb=True)
        if limits is not None:
            samples = colormap_samples(colormap) if isinstance(colormap, str) else colormap
            shades = LinearSegmentedColormap.from_list("samples", samples / 255, max(len(samples), 256))
            painted = dict(clim=limits, cmap=shades, n_colors=shades.N, interpolate_before_map=True)
        (x, y, z), up = VIEWS[view]
        opposite = (-x, y, -z) if view == "aslant" else (-x, -y, -z)
        for column, direction in enumerate(((x, y, z), opposite)):
            plotter.subplot(0, column)
            plotter.set_background("white")
            plotter.add_mesh(
                self._surface,
                scalars=self._title,
                smooth_shading=True,
                ambient=0.25,
                show_scalar_bar=limits is not None and column == 1,
                scalar_bar_args=dict(title=self._title, **bar),
                **painted,
            )
            plotter.view_vector(direction, viewup=up)
        plotter.subplot(0, 0)
        return plotter

    def draw(self, values: np.ndarray, caption: str = "") -> np.ndarray:
        """The picture (height, width, 3) of unsigned bytes of the field's values (V,), or of colours (V, 3)."""
        self._surface[self._title][:] = values
        if self._text is not None:
            self._plotter.remove_actor(self._text)
        self._text = self._plotter.add_text(caption, position="lower_left", font_size=11, color="black")
        with self._quiet("error"):
            return np.asarray(self._plotter.screenshot(return_img=True))

    def close(self) -> None:
        """Free the renderer."""
        self._plotter.close()


def write_png(path: Path, image: np.ndarray) -> None:
    """Write a picture as PNG."""
    import imageio.v3

    imageio.v3.imwrite(path, image)


def write_animation(path: Path, images: Iterable[np.ndarray]) -> Path:
    """Write pictures, one at least, as an MP4, or as a GIF where no encoder is installed; returns the file written."""
    import imageio.v2

    frames = iter(images)
    first = next(frames)
    kinds: list[tuple[Path, dict[str, Any]]] = [
        (path, dict(fps=_FRAMES_PER_SECOND, quality=8)),
        (path.with_suffix(".gif"), dict(duration=1000 / _FRAMES_PER_SECOND, loop=0)),
    ]
    with warnings.catch_warnings():
        # The encoder is a program of its own, started by fork and exec; JAX warns of forks that go on in Python.
        warnings.filterwarnings("ignore", message="os.fork", category=RuntimeWarning)
        for file, how in kinds:
            try:
                writer: Any = imageio.v2.get_writer(file, **how)
                writer.append_data(first)
            except (ValueError, ImportError, OSError, RuntimeError):
                if file == kinds[-1][0]:
                    raise
                continue
            # Each is drawn when the last is written: none is held.
            with writer:
                for image in frames:
                    writer.append_data(image)
            return file
    raise AssertionError  # the last kind returns or raises
