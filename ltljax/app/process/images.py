"""Denoise what a mesh carries: an image on its UV map, numbers of a file, or the colours of its own file.

What enters: names of files, and how much noise there is. What leaves: the values before and after, and pictures.
"""

from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from ... import imaging
from ..._imaging.images.variation import deviation
from ..._mesh.columns import DataError, colors_of, from_zero_to_one, read_colors, read_columns
from ..._operators import gradient
from .results import Results, usual
from .subject import Subject, check_choice, check_positive, load

METHODS = ("tv", "heat", "perona-malik")
# Of the median slope, how much a slope may be and still count as noise.
_CONTRAST = 2.0
# Of the noise, how near to it the residual comes; of the trials that find the time for that; and by which factor the
# time grows from one trial to the next until the residual is large enough.
_MATCH, _TRIALS, _STRIDE = 1e-2, 40, 4.0
# The side of the image that is written, in pixels.
_LARGEST_IMAGE = 4096


def denoise(
    mesh: str,
    out: Path,
    *,
    image: Path | None = None,
    data: Path | None = None,
    name: str | None = None,
    noise: float | None = None,
    strength: float | None = None,
    method: str = "tv",
    repair: bool = False,
) -> None:
    """Denoise an image, numbers or colours on a mesh, and write what comes out.

    Args:
        mesh: a built-in shape or a mesh file.
        out: the folder to write to.
        image: on the mesh's UV map.
        data: a CSV, NPZ, PLY or VTP file with numbers for every vertex; without image and data the colours of the mesh
            file are taken.
        name: the column of the data; by default the only one, or red, green and blue.
        noise: the standard deviation of the noise; by default, and without a strength, as of `estimated_noise`.
        strength: in its place, of `tv` the weight of the total variation, in units of the values times a length; of
            the others the time of diffusion, in units of a length squared.
        method: ``"tv"`` (`imaging.denoise`), ``"heat"`` (`imaging.diffuse`) or ``"perona-malik"``.
        repair: mend a mesh file that is not acceptable.

    Raises:
        ValueError: a file or an option does not fit, there is nothing to denoise, or the noise explains all there is.
        SolveError: the image was not found.
    """
    check_choice("method", method, METHODS)
    check_positive(noise=noise, strength=strength)
    for first, second, both in (("noise", "strength", (noise, strength)), ("image", "data", (image, data))):
        if None not in both:
            raise ValueError(f"Expected {first} or {second}, not both. Leave one of them away.")
    subject = load(mesh, repair)
    size, u, what = _values(subject, image, data, name)
    inputs = [path for path in (image, data) if path is not None]
    results = Results("denoise", subject, out, ("before", "after"), inputs)
    is_colors = u.ndim == 2
    found = noise
    if noise is None and strength is None:
        found = estimated_noise(subject, u)
        if not found > 0:
            raise ValueError(
                f"The noise of {what} cannot be told: most values are the means of their neighbours. Give --noise or "
                "--strength."
            )
    after = _denoised(subject, u, found, strength, method)
    if noise is None and strength is None:
        print(f"note: the noise is estimated from how far values are from the means of their neighbours: {found:.4g}")
    residual = float(np.sqrt(_mean_square(subject, after - u)))
    results.numbers({"before": u, "after": after, "removed": u - after})
    limits = None if is_colors else usual(u)
    colormap = "viridis" if image is None else "gray"
    shades = [_painted(values, limits, colormap) for values in (u, after)]
    results.colors(shades[1])
    for label, values, shade in zip(("before", "after"), (u, after), shades, strict=True):
        results.picture(label, shade if is_colors else values, what, limits, colormap)
    if size is not None:
        try:
            results.textured(_baked(subject, after, size))
        except ValueError as error:  # a map that is tiled can be read but not written
            print(f"note: no texture is written. {error}")
    options = dict(
        image=_named(image), data=_named(data), name=name, noise=noise, strength=strength, method=method, repair=repair
    )
    results.finish(
        options,
        dict(
            values=what,
            noise=found,
            removed_root_mean_square=residual,
            range_before=_range(u),
            range_after=_range(after),
        ),
    )


def estimated_noise(subject: Subject, u: np.ndarray) -> float:
    """The standard deviation of independent noise in values (V,) or (V, C), if most of the image is smooth.

    The median of ``|u - mean of its n neighbours| / sqrt(1 + 1 / n)`` over 0.6745, that of a normal distribution. The
    median does not see edges, but what varies from vertex to vertex everywhere counts as noise.

    Source: as Donoho and Johnstone (1994), doi:10.1093/biomet/81.3.425, do of wavelets.
    """
    columns, (i, j) = u.reshape(len(u), -1), subject.mesh.edges.T
    count = np.bincount(np.concatenate([i, j]), minlength=len(u))
    sums = np.stack(
        [np.bincount(i, column[j], len(u)) + np.bincount(j, column[i], len(u)) for column in columns.T], axis=1
    )
    apart = np.abs(columns - sums / count[:, None]) / np.sqrt(1 + 1 / count)[:, None]
    return float(np.median(apart)) / 0.6745


def _values(
    subject: Subject, image: Path | None, data: Path | None, name: str | None
) -> tuple[int | None, np.ndarray, str]:
    """The size of the image they come from, if any, the values (V,) or colours (V, 3), and what they are called."""
    if name is not None and data is None:
        raise ValueError(f"--name {name} is for a file of data: give --data FILE too.")
    if image is not None:
        if subject.mesh.uv is None:
            raise ValueError(
                f"{subject.name} has no UV map to find {image.name} by: its file names no texture coordinates. Unwrap "
                "the mesh, in Blender say, or give numbers for the vertices as --data."
            )
        pixels = _read_image(image)
        return min(max(pixels.shape[:2]), _LARGEST_IMAGE), imaging.from_texture(subject.mesh, pixels), image.name
    if data is not None:
        values, what = _column(data, name)
        values = subject.pulled(values, data.name)
        if not np.isfinite(values).all():
            first = int(np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))[0])
            raise ValueError(f"{data.name}: expected finite values of {what}, found others at {first}.")
        return None, values, what
    colors = None if subject.path is None else read_colors(subject.path)
    if colors is None:
        raise ValueError(
            f"{subject.name} has no colours to denoise. Give an image on its UV map (--image IMAGE) or numbers for its "
            "vertices (--data FILE)."
        )
    return None, subject.pulled(colors, subject.name), "colours"


def _column(path: Path, name: str | None) -> tuple[np.ndarray, str]:
    """The values (V,) or colours (V, 3) of a file, in its order, and their name."""
    columns = read_columns(path)
    numbers = columns.pop("vertex", None)
    names = ", ".join(columns)
    if name is not None and name not in columns:
        raise ValueError(f"{path.name}: expected a column named {name}, found {names or 'none'}.")
    colors = colors_of(columns) if all(values.ndim == 1 for values in columns.values()) else None
    if name is not None or len(columns) == 1:
        what = name or next(iter(columns))
        values = columns[what]
    elif colors is not None:
        values, what = colors, "colours"
    else:
        raise ValueError(f"{path.name}: expected one column, or red, green and blue; found {names}. Choose by --name.")
    if values.ndim != 1 and values.shape[1:] != (3,):
        raise DataError(path, f"{what} of shape (V,), or (V, 3) for colours, not {values.shape}")
    values = from_zero_to_one(values) if values.ndim == 2 else np.asarray(values, np.float64)
    if numbers is not None:
        if not np.array_equal(np.sort(numbers), np.arange(len(numbers))) or len(numbers) != len(values):
            raise DataError(path, "each vertex once in its column vertex, counted from 0")
        values = values[np.argsort(numbers)]
    return values, what


def _read_image(path: Path) -> np.ndarray:
    """The pixels (H, W) or (H, W, 3) of an image."""
    try:
        import imageio.v3
    except ImportError:
        raise ValueError('Images are read with the extra "viz": pip install "ltljax[viz]".') from None
    if not path.is_file():
        raise DataError(path, f"an image, and there is no file at {path}")
    try:
        pixels = np.asarray(imageio.v3.imread(path))
    except Exception as error:
        raise DataError(path, f"a sound image ({' '.join(str(error).split())[:200]})") from None
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] > 4) or pixels.dtype.kind not in "uf":
        raise DataError(path, f"one image, not {pixels.dtype} of shape {pixels.shape}")
    # What is transparent has a colour all the same, and grey images may have a second channel.
    return pixels if pixels.ndim == 2 else pixels[..., :3] if pixels.shape[2] >= 3 else pixels[..., 0]


def _denoised(subject: Subject, u: np.ndarray, noise: float | None, strength: float | None, method: str) -> np.ndarray:
    surface, f = subject.surface, jnp.asarray(u)
    if method == "tv":
        return np.asarray(imaging.denoise(surface, f, noise=noise, strength=strength))
    if method == "heat":
        return _matched(subject, u, noise, strength, lambda time: imaging.diffuse(surface, f, time))
    averaged = imaging.local_mean(surface, f, subject.edge)
    slopes = np.asarray(gradient(surface, averaged)).reshape(len(u), -1)
    contrast = _CONTRAST * float(np.median(np.linalg.norm(slopes, axis=1)))
    if not contrast > 0:
        raise ValueError("Most of the image is flat, which leaves no slope to tell edges by. Use --method tv.")
    return _matched(subject, u, noise, strength, lambda time: imaging.perona_malik(surface, f, time, contrast))


def _matched(
    subject: Subject,
    u: np.ndarray,
    noise: float | None,
    strength: float | None,
    diffused: Callable[[float], jnp.ndarray],
) -> np.ndarray:
    """What diffusion leaves after a time, or after that in which it has removed as much as the noise."""
    if noise is None:
        assert strength is not None
        return np.asarray(diffused(strength))
    most = float(deviation(subject.surface, jnp.asarray(u).reshape(len(u), -1)))
    refused = ValueError(
        f"Expected noise below the standard deviation of the values, which is {most:.4g}, found {noise:.4g}: such "
        "noise explains all of them. Give less noise, or a strength."
    )
    if noise >= most:
        raise refused
    low, high = 0.0, np.inf
    time = subject.edge**2 / _STRIDE
    for _ in range(_TRIALS):
        after = np.asarray(diffused(time))
        removed = np.sqrt(_mean_square(subject, after - u))
        if abs(removed - noise) <= _MATCH * noise:
            return after
        low, high = (time, high) if removed < noise else (low, time)
        if low > subject.mesh.area:
            break  # nothing changes any more
        time = _STRIDE * time if np.isinf(high) else float(np.sqrt(max(low, high / _STRIDE**2) * high))
    raise refused


def _mean_square(subject: Subject, values: np.ndarray) -> float:
    """The mean over the area and the colours."""
    areas = np.asarray(subject.surface.vertex_areas)
    return float(areas @ (values.reshape(len(values), -1) ** 2).mean(axis=1) / areas.sum())


def _painted(values: np.ndarray, limits: tuple[float, float] | None, colormap: str) -> np.ndarray:
    from ..._output.colors import vertex_colors

    return vertex_colors(values, limits, colormap) if limits else np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)


def _baked(subject: Subject, values: np.ndarray, size: int) -> np.ndarray:
    image = imaging.to_texture(subject.mesh, values, size, fill=0.5, as_bytes=True)
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)


def _named(path: Path | None) -> str | None:
    return None if path is None else path.name


def _range(values: np.ndarray) -> str:
    return f"{values.min():.6g} .. {values.max():.6g}"
