"""The compiled loop that shifts and scales a wall image; `wall` holds the slow reference."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, fastmath=True)
def _inside(
    out: NDArray[np.float32],
    row: NDArray,
    tap_0: float,
    tap_1: float,
    tap_2: float,
    tap_3: float,
    scale: np.float32,
    ambient: NDArray[np.float32],
) -> None:
    """Write the part of a row whose taps all lie inside; the taps are numbers, so that the loop is vectors."""
    for u in range(len(out)):
        light = tap_0 * row[u] + tap_1 * row[u + 1] + tap_2 * row[u + 2] + tap_3 * row[u + 3]
        out[u] = scale * max(light, np.float32(0)) + ambient[u]


@njit(cache=True, fastmath=True)
def _outside(
    out: NDArray[np.float32],
    row: NDArray,
    start: int,
    taps: NDArray[np.float32],
    scale: np.float32,
    ambient: NDArray[np.float32],
) -> None:
    """Write the part of a row that has taps outside, where the band is zero."""
    columns = len(row)
    for u in range(len(out)):
        light = np.float32(0)
        for c in range(max(0, u + start), min(columns, u + start + 4)):
            light += taps[c - u - start] * np.float32(row[c])
        out[u] = scale * max(light, np.float32(0)) + ambient[u]


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
        if last > first:
            row = band[v, first + start : last + start + 3]
            _inside(out[v, first:last], row, taps[0], taps[1], taps[2], taps[3], scale, ambient[v, first:last])
        _outside(out[v, :first], band[v], start, taps, scale, ambient[v, :first])
        _outside(out[v, last:], band[v], start + last, taps, scale, ambient[v, last:])
