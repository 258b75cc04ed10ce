"""The viewer: a run as one HTML file that any browser opens, offline too.

What enters: NumPy arrays of a surface and of its states in time. What leaves: a page with the surface to turn, a time
slider, a choice of species and colours, the value under the pointer, and pictures to save.

The page stores the geometry once: positions in 16 bits of the bounding box, faces in 32. The states of each species are
stored in 16 bits of the range they take over all times (65535 where not finite), as differences from the frame before,
low bytes apart from high ones, deflated. It is drawn by three.js (MIT licence, beside this file); viewer.js says how
the bundle is made.
"""

import base64
import html
import json
import zlib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

import numpy as np

from ..colors import COLORMAPS, colormap_samples

_MISSING = 65535


def viewer_html(
    vertices: np.ndarray,
    faces: np.ndarray,
    times: np.ndarray,
    fields: Mapping[str, np.ndarray],
    title: str = "",
    colormap: str = "viridis",
) -> str:
    """The page, as a text.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        times: (T,) ascending.
        fields: (T, V) for each species by name.
        title: what stands at the top.
        colormap: the one it opens with, of `ltljax.output.colors.COLORMAPS`.

    Raises:
        ValueError: shapes do not fit, there is no state, or the colour map is not known.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    times = np.asarray(times, np.float64)
    colormap_samples(colormap)
    if not fields or len(times) == 0:
        raise ValueError("Expected at least one species at one time, found none.")
    for name, values in fields.items():
        if np.shape(values) != (len(times), len(vertices)):
            raise ValueError(f"Expected {name} of shape {(len(times), len(vertices))}, found {np.shape(values)}.")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    arrays = dict(
        positions=np.round((vertices - low) / span * 65535).astype("<u2").tobytes(),
        faces=faces.astype("<u4").tobytes(),
    )
    species = []
    for index, (name, values) in enumerate(fields.items()):
        limits, arrays[f"field-{index}"] = _packed(np.asarray(values, np.float64))
        species.append(dict(name=name, low=limits[0], high=limits[1]))
    header = dict(
        title=title,
        vertices=len(vertices),
        times=times.tolist(),
        species=species,
        low=low.tolist(),
        span=span.tolist(),
        colormap=colormap,
        colormaps={name: samples.tolist() for name, samples in COLORMAPS.items()},
    )
    scripts = [_script("header", "application/json", json.dumps(header).replace("<", "\\u003c"))]
    for name, data in arrays.items():
        text = base64.b64encode(zlib.compress(data, 9)).decode("ascii")
        scripts.append(_script(name, "text/plain", text))
    room = files("ltljax.output.viewer")
    page = room.joinpath("viewer.html").read_text(encoding="utf-8")
    # Nothing in the bundle may end the script it stands in.
    bundle = room.joinpath("bundle.js").read_text(encoding="utf-8").replace("</script", "<\\/script")
    return page.replace("@data@", "\n".join(scripts)).replace("@bundle@", bundle)


def write_viewer(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    times: np.ndarray,
    fields: Mapping[str, np.ndarray],
    title: str = "",
    colormap: str = "viridis",
) -> None:
    """Write the page; arguments as of `viewer_html`."""
    path.write_text(viewer_html(vertices, faces, times, fields, title, colormap), encoding="utf-8")


class Inline:
    """A page inside a notebook: what a cell shows that ends with this.

    Args:
        page: its HTML.
        height: in pixels.
    """

    def __init__(self, page: str, height: int = 560):
        self.page, self.height = page, height

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {self.height}px; border: 1px solid #ddd"
        return f'<iframe srcdoc="{html.escape(self.page, quote=True)}" style="{style}"></iframe>'


def _script(name: str, kind: str, text: str) -> str:
    return f'<script id="{name}" type="{kind}">{text}</script>'


def _packed(values: np.ndarray) -> tuple[tuple[float, float], bytes]:
    """The range of the values (T, V), and their bytes as the page reads them."""
    is_finite = np.isfinite(values)
    low, high = (float(values[is_finite].min()), float(values[is_finite].max())) if is_finite.any() else (0.0, 1.0)
    if not high > low:
        high = low + max(abs(low), 1.0) * 1e-3
    share = (np.where(is_finite, values, low) - low) / (high - low)
    whole = np.where(is_finite, np.round(share * (_MISSING - 1)), _MISSING).astype(np.uint16)
    change = np.diff(whole, axis=0, prepend=np.zeros((1, values.shape[1]), np.uint16))
    return (low, high), (change & 255).astype(np.uint8).tobytes() + (change >> 8).astype(np.uint8).tobytes()
