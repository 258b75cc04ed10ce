"""Pictures and animations of fields on a surface, rendered off-screen by PyVista (the extra `viz`)."""

import importlib.util
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from .colors import colormap_samples

# The direction from the surface to the camera in the left half of a picture, and the upward direction. The right half
# shows the opposite side. The y axis points upwards, as in most mesh files. In the view `aslant`, both cameras are
# slightly above the surface.
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
    """Whether the extra `viz` is installed."""
    return importlib.util.find_spec("pyvista") is not None


class Picture:
    """A picture of a surface from two opposite sides, with a field or with colours, drawn off-screen.

    Use it to draw several fields on the same surface, such as the frames of an animation; `ltljax.plot` draws a single
    picture. Drawing needs the extra `viz`.

    Args:
        vertices: (V, 3) positions.
        faces: (F, 3) vertex indices.
        title: name of the field, shown beside the colour bar.
        limits: values at the ends of the colour bar; None to draw colours instead of a field.
        colormap: name of a colour map, a key of `ltl.io.COLORMAPS`, or samples (N, 3) of a colour map, unsigned bytes.
        view: direction of the camera: aslant, front, back, right, left, top or bottom; y points upwards.

    Example:
        >>> import ltljax as ltl
        >>> mesh = ltl.shapes.icosphere(3)
        >>> picture = ltl.io.Picture(mesh.vertices, mesh.faces, "height", limits=(-1.0, 1.0))
        >>> picture.draw(mesh.vertices[:, 2]).shape
        (640, 1280, 3)
        >>> picture.close()
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
        # Without a display, VTK warns although it can render off-screen.
        self._verbosity = pyvista.vtk_verbosity
        with self._verbosity("error"):
            self._plotter = self._compose(pyvista.Plotter, limits, colormap, view)

    def _compose(
        self, plotter_class: Any, limits: tuple[float, float] | None, colormap: str | np.ndarray, view: str
    ) -> Any:
        from matplotlib.colors import LinearSegmentedColormap  # a dependency of PyVista

        plotter = plotter_class(off_screen=True, window_size=list(_SIZE), shape=(1, 2), border=False)
        bar = dict(color="black", fmt="%.3g", n_labels=2, position_x=0.3, position_y=0.02, width=0.65, height=0.08)
        coloring: dict[str, Any] = dict(rgb=True)
        if limits is not None:
            samples = colormap_samples(colormap) if isinstance(colormap, str) else colormap
            shades = LinearSegmentedColormap.from_list("samples", samples / 255, max(len(samples), 256))
            coloring = dict(clim=limits, cmap=shades, n_colors=shades.N, interpolate_before_map=True)
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
                **coloring,
            )
            plotter.view_vector(direction, viewup=up)
        plotter.subplot(0, 0)
        return plotter

    def draw(self, values: np.ndarray, caption: str = "") -> np.ndarray:
        """The picture (height, width, 3), unsigned bytes.

        Args:
            values: (V,) values of the field, or (V, 3) colours, unsigned bytes.
            caption: text in the lower left corner.
        """
        self._surface[self._title][:] = values
        if self._text is not None:
            self._plotter.remove_actor(self._text)
        self._text = self._plotter.add_text(caption, position="lower_left", font_size=11, color="black")
        with self._verbosity("error"):
            return np.asarray(self._plotter.screenshot(return_img=True))

    def close(self) -> None:
        """Free the renderer."""
        self._plotter.close()


def write_png(path: Path, image: np.ndarray) -> None:
    """Write a picture (height, width, 3) as a PNG."""
    import imageio.v3

    imageio.v3.imwrite(path, image)


def write_animation(path: Path, images: Iterable[np.ndarray]) -> Path:
    """Write at least one picture as an MP4, or as a GIF if no encoder is installed; returns the path of the file."""
    import imageio.v2

    frames = iter(images)
    first = next(frames)
    formats: list[tuple[Path, dict[str, Any]]] = [
        (path, dict(fps=_FRAMES_PER_SECOND, quality=8)),
        (path.with_suffix(".gif"), dict(duration=1000 / _FRAMES_PER_SECOND, loop=0)),
    ]
    with warnings.catch_warnings():
        # Starting the encoder forks this process. JAX warns about forks, but this one only executes the encoder.
        warnings.filterwarnings("ignore", message="os.fork", category=RuntimeWarning)
        for file, options in formats:
            try:
                writer: Any = imageio.v2.get_writer(file, **options)
                writer.append_data(first)
            except (ValueError, ImportError, OSError, RuntimeError):
                if file == formats[-1][0]:
                    raise
                continue
            # Pictures are drawn and written one at a time, so that memory holds a single picture.
            with writer:
                for image in frames:
                    writer.append_data(image)
            return file
    raise AssertionError("unreachable: the last format returns or raises")
