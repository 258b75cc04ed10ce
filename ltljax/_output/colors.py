"""Colour maps, without a plotting library."""

import difflib

import numpy as np


def _samples(digits: str) -> np.ndarray:
    return np.frombuffer(bytes.fromhex(digits), np.uint8).reshape(-1, 3)


# Evenly spaced samples, with two hexadecimal digits for each channel. Taken from matplotlib: viridis, plasma, magma and
# inferno (Smith and van der Walt, CC0), cividis (Nunez, Anderton and Renslow 2018), turbo (Mikhailov 2019) and coolwarm
# (Moreland 2009).
COLORMAPS: dict[str, np.ndarray] = {
    "viridis": _samples(
        "44015448186a472d7b4240863b528b33638d2c728e26828e21918c1fa08828ae803fbc735ec96284d44baddc30d8e219fde725"
    ),
    "plasma": _samples(
        "0d08873105974c02a16600a77e03a89511a1aa2395bc3587cc4778da5a6ae66c5cf0804ef89540fdac33fdc527f8df25f0f921"
    ),
    "magma": _samples(
        "0000040a08221d114736106b51127c6a1c818326819c2e7fb73779d0416fe75263f56b5cfc8961fea772fec488fde2a3fcfdbf"
    ),
    "inferno": _samples(
        "0000040b0724210c4a3d096557106e71196e8a226aa32c61bc3754d24644e45a31f1731df98e09fcac11f9cb35f2ea69fcffa4"
    ),
    "cividis": _samples(
        "00224e002e6a1a386f32436d434e6c535a6d61656f6f70737d7c788c88789b9476aba072bcae6ccdbb63dec958f0d846fee838"
    ),
    "turbo": _samples(
        "30123b3b2f80434eba466be34685fa3ba0fd28bceb1ad2d21ae4b632f29855fa7680ff53a4fc3cbef434d9e436eecf3a"
        "faba39fe9e2ffb7e21f26014e4450ad02f05b91e029b0f017a0403"
    ),
    "coolwarm": _samples(
        "3b4cc04e68d86282ea779af78db0fea3c2feb9d0f9ccd9eddddcdcecd3c5f5c4acf7b093f4987aeb7d62dd5f4bca3b37b40426"
    ),
    "gray": _samples("000000ffffff"),
    "zebra": _samples("14110f" * 6 + "6b655e" + "f2ead9" * 6),
    "leopard": _samples("2a1708" * 4 + "6e3f12" + "d99a3d" * 3 + "e9bd6a" * 4),
}


def colormap_samples(name: str) -> np.ndarray:
    """The evenly spaced samples (N, 3) of a colour map, from low to high values.

    Raises:
        ValueError: there is no colour map of this name.
    """
    if name not in COLORMAPS:
        matches = difflib.get_close_matches(name, COLORMAPS, n=1)
        hint = f" (did you mean {matches[0]}?)" if matches else ""
        raise ValueError(f"Expected one of the colour maps {', '.join(COLORMAPS)}, found {name!r}{hint}.")
    return COLORMAPS[name]


def striped(colormap: str, count: int) -> np.ndarray:
    """Samples (N, 3) of a colour map in ``count`` bands, alternately light and dark, whose edges look like contours."""
    table = colormap_samples(colormap)
    per_band = 64  # enough samples for sharp edges
    position = np.linspace(0, 1, per_band * count)
    samples = np.stack([np.interp(position, np.linspace(0, 1, len(table)), channel) for channel in table.T], axis=1)
    is_dark = np.arange(len(position)) // per_band % 2 == 1
    return np.round(np.where(is_dark[:, None], 0.6, 1.0) * samples).astype(np.uint8)


def vertex_colors(
    values: np.ndarray, limits: tuple[float, float] | None = None, colormap: str = "viridis"
) -> np.ndarray:
    """The RGBA colours (V, 4), unsigned bytes, of values on a colour map.

    Args:
        values: (V,) values; NaN and infinite values become grey.
        limits: values at the ends of the colour map; by default, the smallest and the largest finite value.
        colormap: name of a colour map, a key of `COLORMAPS`.
    """
    table = colormap_samples(colormap)
    is_finite = np.isfinite(values)
    if limits is None:
        limits = (values[is_finite].min(), values[is_finite].max()) if is_finite.any() else (0.0, 1.0)
    low, high = limits
    position = np.clip((np.where(is_finite, values, low) - low) / (high - low if high > low else 1), 0, 1)
    samples = np.linspace(0, 1, len(table))
    channels = [np.interp(position, samples, table[:, channel]) for channel in range(3)]
    colors = np.stack([*channels, np.full(len(values), 255.0)], axis=1)
    colors[~is_finite] = (128, 128, 128, 255)
    return np.round(colors).astype(np.uint8)
