"""The viewer: a run in a single HTML file that any browser opens, even offline.

The page shows the surface, which can be rotated, with a time slider, menus of species and colour maps, the value under
the pointer, and a button that saves a picture.

The geometry is stored once: positions as 16-bit fractions of the bounding box, faces as 32-bit integers. The states of
each species are quantised: the range of its values over all times is divided into 65,534 steps, and 65535 stands for
NaN and infinite values. The differences between successive frames (0, -1, 1, -2, ... stored as 0, 1, 2, 3, ...) are
compressed, low bytes separately from high bytes. If the page would exceed 14 million characters, or 3.5 characters for
each vertex and time if that is more, the steps are coarser: about 10,000 for two species in motion and 150 for five.
With more species the page becomes larger.

The page is drawn by three.js (MIT licence, in this folder). package.json defines how bundle.js is built from viewer.js.
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
# Largest number of characters of a page, which a phone can open, and, for larger runs, for each vertex and time.
_PAGE, _PER_VALUE = 14_000_000, 3.5
# Largest and smallest number of steps of a range.
_FINEST, _COARSEST = 65534, 127


def viewer_html(
    vertices: np.ndarray,
    faces: np.ndarray,
    times: np.ndarray,
    fields: Mapping[str, np.ndarray],
    title: str = "",
    colormap: str = "viridis",
) -> str:
    """The HTML of the page.

    Args:
        vertices: (V, 3) positions.
        faces: (F, 3) vertex indices.
        times: (T,) ascending times; states at infinite times, which the run did not reach, are left out.
        fields: (T, V) states of each species by name.
        title: title at the top of the page.
        colormap: name of the initial colour map, a key of `ltl.io.COLORMAPS`.

    Raises:
        ValueError: the shapes do not match, there is no state, or the colour map is not known.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    times = np.asarray(times, np.float64)
    colormap_samples(colormap)
    is_reached = np.isfinite(times)
    num_states, times = len(times), times[is_reached]
    if not fields or len(times) == 0:
        raise ValueError("Expected at least one species at one time, found none.")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    arrays = dict(
        positions=_compressed(np.round((vertices - low) / span * 65535).astype("<u2").tobytes()),
        faces=_compressed(faces.astype("<u4").tobytes()),
    )
    size_limit = max(_PAGE, _PER_VALUE * len(vertices) * len(times))
    limit_per_species = (size_limit - sum(map(len, arrays.values()))) / len(fields)
    species = []
    for index, (name, values) in enumerate(fields.items()):
        if np.shape(values) != (num_states, len(vertices)):
            raise ValueError(f"Expected {name} of shape {(num_states, len(vertices))}, found {np.shape(values)}.")
        limits, quantised = _quantised(np.asarray(values)[is_reached])
        steps, arrays[f"field-{index}"] = _packed(quantised, limit_per_species)
        species.append(dict(name=name, low=limits[0], high=limits[1], steps=steps))
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
    scripts += [_script(name, "text/plain", text) for name, text in arrays.items()]
    folder = files("ltljax._output.viewer")
    template = folder.joinpath("viewer.html").read_text(encoding="utf-8")
    # An end tag in the bundle would end the script element that contains it.
    bundle = folder.joinpath("bundle.js").read_text(encoding="utf-8").replace("</script", "<\\/script")
    # The template is split before the data are inserted, because a title may contain the placeholders too.
    before, rest = template.split("@data@")
    between, after = rest.split("@bundle@")
    return "".join([before, "\n".join(scripts), between, bundle, after])


def write_viewer(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    times: np.ndarray,
    fields: Mapping[str, np.ndarray],
    title: str = "",
    colormap: str = "viridis",
) -> None:
    """Write the page to a file; the other arguments are those of `viewer_html`."""
    path.write_text(viewer_html(vertices, faces, times, fields, title, colormap), encoding="utf-8")


class Inline:
    """A page that a notebook shows in the output of a cell.

    Args:
        page: HTML of the page.
        height: height in pixels.
    """

    def __init__(self, page: str, height: int = 560):
        self.page, self.height = page, height

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {self.height}px; border: 1px solid #ddd"
        return f'<iframe srcdoc="{html.escape(self.page, quote=True)}" style="{style}"></iframe>'


def _script(name: str, kind: str, text: str) -> str:
    return f'<script id="{name}" type="{kind}">{text}</script>'


def _compressed(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 7)).decode("ascii")


def _quantised(values: np.ndarray) -> tuple[tuple[float, float], np.ndarray]:
    """The range of the values (T, V), and the values in units of the finest step, (T, V)."""
    low, high = np.inf, -np.inf
    for frame in values:
        finite = frame[np.isfinite(frame)]
        low, high = min(low, finite.min(initial=np.inf)), max(high, finite.max(initial=-np.inf))
    low, high = (float(low), float(high)) if low <= high else (0.0, 1.0)
    if not high > low:
        high = low + max(abs(low), 1.0) * 1e-3
    quantised = np.empty(values.shape, np.uint16)
    for frame, target in zip(values, quantised, strict=True):
        is_finite = np.isfinite(frame)
        fraction = (np.where(is_finite, frame, low).astype(np.float64) - low) / (high - low)
        target[:] = np.where(is_finite, np.round(fraction * _FINEST), _MISSING)
    return (low, high), quantised


def _packed(quantised: np.ndarray, limit: float) -> tuple[int, str]:
    """The number of steps of the range, and the packed states (T, V), with at most ``limit`` characters if possible."""
    steps = _FINEST
    while True:
        rounded = (quantised.astype(np.uint32) * steps + _FINEST // 2) // _FINEST
        rounded = np.where(quantised == _MISSING, _MISSING, rounded).astype(np.uint16)
        change = np.diff(rounded, axis=0, prepend=np.zeros((1, quantised.shape[1]), np.uint16))
        signed = change.view(np.int16)
        change = ((signed << 1) ^ (signed >> 15)).view(np.uint16)
        text = _compressed((change & 255).astype(np.uint8).tobytes() + (change >> 8).astype(np.uint8).tobytes())
        if len(text) <= limit or steps == _COARSEST:
            return steps, text
        # The number of bits to save for each value: six bits make a character.
        excess_bits = (len(text) - limit) / quantised.size * 6
        steps = max(_COARSEST, int(steps / 2 ** max(excess_bits, 0.25)))
