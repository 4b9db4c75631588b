"""The compiled loop that shifts and scales a wall image; `wall` holds the slow reference."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, fastmath=True)
def expose_shifted(
    out: NDArray[np.float32],
    band: NDArray,
    start: int,
    taps: NDArray[np.float32],
    gain: float,
    ambient: NDArray[np.float32],
) -> None:
    """Write max(0, four-tap sum along the rows) gain + ambient.

    Args:
        out: Frame [H, W], overwritten.
        band: Spline coefficients at the frame's rows [H, C]; zero outside.
        start: Column of `band` that the first tap of pixel 0 reads; any integer.
        taps: The four weights.
        gain: White levels a unit of the band.
        ambient: Ambient light [H, W], white levels.
    """
    height, width = out.shape
    columns = band.shape[1]
    # Between these columns all four taps lie inside the band.
    first = min(max(0, -start), width)
    last = max(first, min(width, columns - 3 - start))
    scale = np.float32(gain)
    for v in range(height):
        row = band[v]
        for u in range(first, last):
            c = u + start
            light = taps[0] * row[c] + taps[1] * row[c + 1] + taps[2] * row[c + 2] + taps[3] * row[c + 3]
            out[v, u] = scale * max(light, np.float32(0)) + ambient[v, u]
        for low, high in ((0, first), (last, width)):
            for u in range(low, high):
                light = np.float32(0)
                for k in range(4):
                    c = u + start + k
                    if 0 <= c < columns:
                        light += taps[k] * np.float32(row[c])
                out[v, u] = scale * max(light, np.float32(0)) + ambient[v, u]
