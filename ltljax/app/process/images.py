"""Denoise the values that a mesh carries: an image on its UV map, numbers of a file, or the colours of its own file.

What enters: names of files, and the amount of noise. What leaves: the values before and after, and pictures.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from ... import imaging
from ..._imaging.images.total_variation import deviation
from ..._mesh.columns import DataError, colors_of, from_zero_to_one, read_colors, read_columns
from ..._operators import gradient
from ..choices import DENOISING_METHODS
from .results import Results, usual
from .subject import Subject, check_choice, check_positive, load

# A slope counts as noise up to this multiple of the median slope.
_CONTRAST = 2.0
# The time of diffusion is found by trials: the residual must match the noise up to this share, within so many trials.
# The time is multiplied by the stride until the residual is large enough.
_MATCH, _TRIALS, _STRIDE = 1e-2, 40, 4.0
# The largest side of the image that is written, in pixels.
_LARGEST_IMAGE = 4096


@dataclasses.dataclass(frozen=True)
class _Values:
    """The values to be denoised.

    Attributes:
        u: (V,) numbers, or (V, 3) colours, in the order of the mesh.
        name: name of the values.
        image_size: larger side of the image that they come from, in pixels; None if they come from no image.
    """

    u: np.ndarray
    name: str
    image_size: int | None = None

    @property
    def are_colors(self) -> bool:
        """Whether the values are colours."""
        return self.u.ndim == 2


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
    """Denoise an image, numbers or colours on a mesh, and write the results.

    Args:
        mesh: a built-in shape or a mesh file.
        out: folder for the results.
        image: an image on the UV map of the mesh.
        data: a CSV, NPZ, PLY or VTP file with numbers for every vertex. Without image and data the colours of the mesh
            file are denoised.
        name: column of the data; by default the only column, or red, green and blue.
        noise: standard deviation of the noise; by default, if there is no strength, `estimated_noise`.
        strength: in place of the noise: for ``"tv"`` the weight of the total variation, in units of the values times
            length; for the other methods the time of diffusion, in units of length squared.
        method: ``"tv"`` (`imaging.denoise`), ``"heat"`` (`imaging.diffuse`) or ``"perona-malik"``
            (`imaging.perona_malik`).
        repair: whether to repair a mesh file with defects.

    Raises:
        ValueError: a file or an option does not fit, there is nothing to denoise, or the noise explains all values.
        SolveError: the denoised image was not found.
    """
    check_choice("method", method, DENOISING_METHODS)
    check_positive(noise=noise, strength=strength)
    for first, second, both in (("noise", "strength", (noise, strength)), ("image", "data", (image, data))):
        if None not in both:
            raise ValueError(f"Expected {first} or {second}, not both. Leave one of them out.")
    subject = load(mesh, repair)
    values = _values(subject, image, data, name)
    inputs = [path for path in (image, data) if path is not None]
    results = Results("denoise", subject, out, ("before", "after"), inputs)
    is_estimated = noise is None and strength is None
    level = _estimate(subject, values) if is_estimated else noise
    after = _denoised(subject, values.u, level, strength, method)
    if is_estimated:
        how = "from the differences between values and the means of their neighbours"
        print(f"note: the noise is estimated {how}: {level:.4g}")
    _show(results, values, after, "viridis" if image is None else "gray")
    residual = float(np.sqrt(_mean_square(subject, after - values.u)))
    results.finish(
        dict(
            image=_file_name(image), data=_file_name(data), name=name, noise=noise, strength=strength, method=method,
            repair=repair,
        ),
        dict(
            values=values.name, noise=level, removed_root_mean_square=residual, range_before=_range(values.u),
            range_after=_range(after),
        ),
    )  # fmt: skip


def _show(results: Results, values: _Values, after: np.ndarray, colormap: str) -> None:
    """Prepare the numbers, the surface with colours, the pictures and the texture."""
    u = values.u
    results.numbers({"before": u, "after": after, "removed": u - after})
    limits = None if values.are_colors else usual(u)
    colors = [_colors(each, limits, colormap) for each in (u, after)]
    results.colors(colors[1])
    for label, each, shades in zip(("before", "after"), (u, after), colors, strict=True):
        results.picture(label, shades if values.are_colors else each, values.name, limits, colormap)
    if values.image_size is not None:
        try:
            results.textured(_baked(results.subject, after, values.image_size))
        except ValueError as error:  # A UV map that repeats the image can be read from but not written to.
            print(f"note: no texture is written. {error}")


def _estimate(subject: Subject, values: _Values) -> float:
    noise = estimated_noise(subject, values.u)
    if not noise > 0:
        raise ValueError(
            f"The noise of {values.name} cannot be estimated: most values are the means of their neighbours. Give "
            "--noise or --strength."
        )
    return noise


def estimated_noise(subject: Subject, u: np.ndarray) -> float:
    """The standard deviation of independent noise in values (V,) or (V, C), if most of the image is smooth.

    The median of ``|u - mean of its n neighbours| / sqrt(1 + 1 / n)``, divided by 0.6745, its value for a standard
    normal distribution. The median ignores edges, but variation from vertex to vertex everywhere counts as noise.

    Source: Donoho and Johnstone (1994), doi:10.1093/biomet/81.3.425, who apply it to wavelet coefficients.
    """
    columns, (i, j) = u.reshape(len(u), -1), subject.mesh.edges.T
    valence = np.bincount(np.concatenate([i, j]), minlength=len(u))
    sums = np.stack(
        [np.bincount(i, column[j], len(u)) + np.bincount(j, column[i], len(u)) for column in columns.T], axis=1
    )
    differences = np.abs(columns - sums / valence[:, None]) / np.sqrt(1 + 1 / valence)[:, None]
    return float(np.median(differences)) / 0.6745


def _values(subject: Subject, image: Path | None, data: Path | None, name: str | None) -> _Values:
    """The values of an image or of a file of data, or the colours of the mesh file."""
    if name is not None and data is None:
        raise ValueError(f"--name {name} is for a file of data: give --data FILE too.")
    if image is not None:
        if subject.mesh.uv is None:
            raise ValueError(
                f"{subject.name} has no UV map to find {image.name} by: its file has no texture coordinates. Unwrap "
                "the mesh, for example in Blender, or give numbers for the vertices as --data."
            )
        pixels = _read_image(image)
        size = min(max(pixels.shape[:2]), _LARGEST_IMAGE)
        return _Values(imaging.from_texture(subject.mesh, pixels), image.name, size)
    if data is not None:
        in_file, column = _column(data, name)
        u = subject.from_file_order(in_file, data.name)
        if not np.isfinite(u).all():
            first = int(np.flatnonzero(~np.isfinite(u.reshape(len(u), -1)).all(axis=1))[0])
            raise ValueError(f"{data.name}: expected finite values of {column}, found NaN or infinity at {first}.")
        return _Values(u, column)
    colors = None if subject.path is None else read_colors(subject.path)
    if colors is None:
        raise ValueError(
            f"{subject.name} has no colours to denoise. Give an image on its UV map (--image IMAGE) or numbers for its "
            "vertices (--data FILE)."
        )
    return _Values(subject.from_file_order(colors, subject.name), "colours")


def _column(path: Path, name: str | None) -> tuple[np.ndarray, str]:
    """The values (V,) or colours (V, 3) of a file, in the order of the vertices, and their name."""
    columns = read_columns(path)
    numbers = columns.pop("vertex", None)
    names = ", ".join(columns)
    if name is not None and name not in columns:
        raise ValueError(f"{path.name}: expected a column named {name}, found {names or 'none'}.")
    colors = colors_of(columns) if all(values.ndim == 1 for values in columns.values()) else None
    if name is not None or len(columns) == 1:
        column = name or next(iter(columns))
        values = columns[column]
    elif colors is not None:
        values, column = colors, "colours"
    else:
        raise ValueError(f"{path.name}: expected one column, or red, green and blue; found {names}. Choose by --name.")
    if values.ndim != 1 and values.shape[1:] != (3,):
        raise DataError(path, f"{column} of shape (V,), or (V, 3) for colours, not {values.shape}")
    values = from_zero_to_one(values) if values.ndim == 2 else np.asarray(values, np.float64)
    if numbers is not None:
        if not np.array_equal(np.sort(numbers), np.arange(len(numbers))) or len(numbers) != len(values):
            raise DataError(path, "each vertex once in its column vertex, counted from 0")
        values = values[np.argsort(numbers)]
    return values, column


def _read_image(path: Path) -> np.ndarray:
    """The pixels (H, W) or (H, W, 3) of an image."""
    try:
        import imageio.v3
    except ImportError:
        raise ValueError('Reading images needs the extra "viz": pip install "ltljax[viz]".') from None
    if not path.is_file():
        raise DataError(path, f"an image, and there is no file at {path}")
    try:
        pixels = np.asarray(imageio.v3.imread(path))
    except Exception as error:
        raise DataError(path, f"an image that can be read ({' '.join(str(error).split())[:200]})") from None
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] > 4) or pixels.dtype.kind not in "uf":
        raise DataError(path, f"one image, not {pixels.dtype} of shape {pixels.shape}")
    if pixels.ndim == 2:
        return pixels
    # Transparency is dropped; grey images may have it too, as their second channel.
    return pixels[..., :3] if pixels.shape[2] >= 3 else pixels[..., 0]


def _denoised(subject: Subject, u: np.ndarray, noise: float | None, strength: float | None, method: str) -> np.ndarray:
    surface, f = subject.surface, jnp.asarray(u)
    if method == "tv":
        return np.asarray(imaging.denoise(surface, f, noise=noise, strength=strength))
    if method == "heat":
        return _diffused(subject, u, noise, strength, lambda time: imaging.diffuse(surface, f, time))
    averaged = imaging.local_mean(surface, f, subject.mean_edge)
    slopes = np.asarray(gradient(surface, averaged)).reshape(len(u), -1)
    contrast = _CONTRAST * float(np.median(np.linalg.norm(slopes, axis=1)))
    if not contrast > 0:
        raise ValueError("Most of the image is flat, so there is no slope to recognise edges by. Use --method tv.")
    return _diffused(subject, u, noise, strength, lambda time: imaging.perona_malik(surface, f, time, contrast))


def _diffused(
    subject: Subject,
    u: np.ndarray,
    noise: float | None,
    strength: float | None,
    diffuse: Callable[[float], jnp.ndarray],
) -> np.ndarray:
    """The values after a time of diffusion: the strength, or the time in which the noise is removed."""
    if noise is None:
        assert strength is not None
        return np.asarray(diffuse(strength))
    largest = float(deviation(subject.surface, jnp.asarray(u).reshape(len(u), -1)))
    too_noisy = ValueError(
        f"Expected noise below the standard deviation of the values, which is {largest:.4g}, found {noise:.4g}: this "
        "noise explains all of them. Give less noise, or a strength."
    )
    if noise >= largest:
        raise too_noisy
    low, high = 0.0, np.inf
    time = subject.mean_edge**2 / _STRIDE
    for _ in range(_TRIALS):
        after = np.asarray(diffuse(time))
        removed = np.sqrt(_mean_square(subject, after - u))
        if abs(removed - noise) <= _MATCH * noise:
            return after
        low, high = (time, high) if removed < noise else (low, time)
        if low > subject.mesh.area:
            break  # The values are constant by now.
        time = _STRIDE * time if np.isinf(high) else float(np.sqrt(max(low, high / _STRIDE**2) * high))
    raise too_noisy


def _mean_square(subject: Subject, values: np.ndarray) -> float:
    """The mean square over the area and the colours."""
    areas = np.asarray(subject.surface.vertex_areas)
    return float(areas @ (values.reshape(len(values), -1) ** 2).mean(axis=1) / areas.sum())


def _colors(values: np.ndarray, limits: tuple[float, float] | None, colormap: str) -> np.ndarray:
    from ..._output.colors import vertex_colors

    return vertex_colors(values, limits, colormap) if limits else np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)


def _baked(subject: Subject, values: np.ndarray, size: int) -> np.ndarray:
    image = imaging.to_texture(subject.mesh, values, size, fill=0.5, as_bytes=True)
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)


def _file_name(path: Path | None) -> str | None:
    return None if path is None else path.name


def _range(values: np.ndarray) -> str:
    return f"{values.min():.6g} .. {values.max():.6g}"
