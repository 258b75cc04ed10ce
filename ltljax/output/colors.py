"""Values become colours, without a plotting library."""

import numpy as np

# Nine samples of matplotlib's perceptually uniform map "viridis" (Smith and van der Walt, CC0).
_VIRIDIS = np.array(
    [
        (68, 1, 84), (71, 44, 122), (59, 81, 139), (44, 113, 142), (33, 144, 141),
        (39, 173, 129), (92, 200, 99), (170, 220, 50), (253, 231, 37),
    ]
)  # fmt: skip


def vertex_colors(values: np.ndarray, limits: tuple[float, float] | None = None) -> np.ndarray:
    """RGBA colours (V, 4) of unsigned bytes, from dark violet at the lower limit to yellow at the upper.

    Args:
        values: (V,) numbers; one that is not finite becomes grey.
        limits: the two ends; by default the least and the largest finite value.
    """
    is_finite = np.isfinite(values)
    if limits is None:
        limits = (values[is_finite].min(), values[is_finite].max()) if is_finite.any() else (0.0, 1.0)
    low, high = limits
    position = np.clip((np.where(is_finite, values, low) - low) / (high - low if high > low else 1), 0, 1)
    samples = np.linspace(0, 1, len(_VIRIDIS))
    channels = [np.interp(position, samples, _VIRIDIS[:, channel]) for channel in range(3)]
    colors = np.stack([*channels, np.full(len(values), 255.0)], axis=1)
    colors[~is_finite] = (128, 128, 128, 255)
    return np.round(colors).astype(np.uint8)
