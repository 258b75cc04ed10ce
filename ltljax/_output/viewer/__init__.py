"""The viewer: a run as one HTML file that any browser opens, offline too.

What enters: NumPy arrays of a surface and of its states in time. What leaves: a page with the surface to turn, a time
slider, a choice of species and colours, the value under the pointer, and pictures to save.

The page stores the geometry once: positions in 16 bits of the bounding box, faces in 32. The states of each species are
stored as whole numbers of steps, into 65,534 of which the range they take over all times is divided (65535 where not
finite), as differences from the frame before (0, -1, 1, -2, ... as 0, 1, 2, 3, ...), low bytes apart from high ones,
deflated. Where this makes a page of more than 14 MB (or, of more vertices and times than 40,000 and 100, more than 3.5
letters for each) the steps are coarser: of two species in motion there are ten thousand left, of five a hundred and
fifty; still more species make larger pages. It is drawn by three.js (MIT licence, beside this file); viewer.js says how
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
# Letters of the states of a page: what opens on a phone, and of larger runs so many for each vertex and time.
_PAGE, _LETTERS = 14_000_000, 3.5
# Into how many steps a range is divided, at the most and at the least.
_FINEST, _COARSEST = 65534, 127


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
        times: (T,) ascending; states at infinite times, which a run has not reached, are left out.
        fields: (T, V) for each species by name.
        title: what stands at the top.
        colormap: the one it opens with, of `ltl.io.COLORMAPS`.

    Raises:
        ValueError: shapes do not fit, there is no state, or the colour map is not known.
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
    room_for_each = (max(_PAGE, _LETTERS * len(vertices) * len(times)) - sum(map(len, arrays.values()))) / len(fields)
    species = []
    for index, (name, values) in enumerate(fields.items()):
        if np.shape(values) != (num_states, len(vertices)):
            raise ValueError(f"Expected {name} of shape {(num_states, len(vertices))}, found {np.shape(values)}.")
        limits, whole = _quantised(np.asarray(values)[is_reached])
        steps, arrays[f"field-{index}"] = _packed(whole, room_for_each)
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
    room = files("ltljax._output.viewer")
    page = room.joinpath("viewer.html").read_text(encoding="utf-8")
    # Nothing in the bundle may end the script it stands in.
    bundle = room.joinpath("bundle.js").read_text(encoding="utf-8").replace("</script", "<\\/script")
    # Split once: a title may spell the marks too.
    before, rest = page.split("@data@")
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


def _compressed(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 7)).decode("ascii")


def _quantised(values: np.ndarray) -> tuple[tuple[float, float], np.ndarray]:
    """The range of the values (T, V), and where in it each lies, in the finest steps."""
    low, high = np.inf, -np.inf
    for frame in values:
        finite = frame[np.isfinite(frame)]
        low, high = min(low, finite.min(initial=np.inf)), max(high, finite.max(initial=-np.inf))
    low, high = (float(low), float(high)) if low <= high else (0.0, 1.0)
    if not high > low:
        high = low + max(abs(low), 1.0) * 1e-3
    whole = np.empty(values.shape, np.uint16)
    for frame, target in zip(values, whole, strict=True):
        is_finite = np.isfinite(frame)
        share = (np.where(is_finite, frame, low).astype(np.float64) - low) / (high - low)
        target[:] = np.where(is_finite, np.round(share * _FINEST), _MISSING)
    return (low, high), whole


def _packed(whole: np.ndarray, most: float) -> tuple[int, str]:
    """Into how many steps the range is divided, and the states (T, V), of at most so many letters if that can be."""
    steps = _FINEST
    while True:
        rounded = (whole.astype(np.uint32) * steps + _FINEST // 2) // _FINEST
        rounded = np.where(whole == _MISSING, _MISSING, rounded).astype(np.uint16)
        change = np.diff(rounded, axis=0, prepend=np.zeros((1, whole.shape[1]), np.uint16))
        signed = change.view(np.int16)
        change = ((signed << 1) ^ (signed >> 15)).view(np.uint16)
        text = _compressed((change & 255).astype(np.uint8).tobytes() + (change >> 8).astype(np.uint8).tobytes())
        if len(text) <= most or steps == _COARSEST:
            return steps, text
        # One bit of each state is an eighth of a byte, and three bytes are four letters.
        excess = (len(text) - most) / whole.size * 6
        steps = max(_COARSEST, int(steps / 2 ** max(excess, 0.25)))
