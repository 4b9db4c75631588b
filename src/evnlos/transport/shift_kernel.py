"""The compiled loop that shifts and scales a wall image; `wall` holds the slow reference.

Indices are unsigned: an index that can't be negative needs no test, and a loop becomes vectors without slices.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, error_model="numpy")
def _inside(out, k, to, count, band, v, start, tap_0, tap_1, tap_2, tap_3, scale, ambient, u, white):
    """Write `count` pixels whose taps all lie inside; the taps are numbers, so that the loop is vectors."""
    k, to, v, start, u = np.uint64(k), np.uint64(to), np.uint64(v), np.uint64(start), np.uint64(u)
    for i in range(np.uint64(count)):
        c = start + i
        light = (
            tap_0 * band[v, c]
            + tap_1 * band[v, c + np.uint64(1)]
            + tap_2 * band[v, c + np.uint64(2)]
            + tap_3 * band[v, c + np.uint64(3)]
        )
        out[k, to + i] = np.float32(scale * max(light, np.float32(0)) + ambient[v, u + i]) * white


@njit(cache=True, error_model="numpy")
def _border(out, k, to, count, band, v, start, taps, scale, ambient, u, white):
    """Write `count` pixels that have taps outside, where the band is zero."""
    columns = band.shape[1]
    for i in range(count):
        light = np.float32(0)
        for c in range(max(0, start + i), min(columns, start + i + 4)):
            light += taps[k, c - start - i] * np.float32(band[v, c])
        out[k, to + i] = (scale * max(light, np.float32(0)) + ambient[v, u + i]) * white


@njit(cache=True, error_model="numpy")
def _dark(out, k, to, count, ambient, v, u, white):
    """Write `count` pixels that no tap reaches."""
    k, to, v, u = np.uint64(k), np.uint64(to), np.uint64(v), np.uint64(u)
    for i in range(np.uint64(count)):
        out[k, to + i] = ambient[v, u + i] * white


@njit(cache=True, error_model="numpy", nogil=True)
def expose_shifted(
    out: NDArray[np.float32],
    first: int,
    band: NDArray,
    starts: NDArray[np.int64],
    taps: NDArray[np.float32],
    gain: float,
    ambient: NDArray[np.float32],
    white: float,
) -> None:
    """Write (max(0, four-tap sum along the rows) gain + ambient) white, for some pixels at several instants.

    A row is written at all instants before the next one, so that what is read stays in the cache.

    Args:
        out: Light [T, N] of the pixels first..first + N - 1, counted along the rows; overwritten.
        first: The first of these pixels.
        band: Spline coefficients at the frame's rows [H, C]; zero outside.
        starts: Column of `band` that the first tap of a row's pixel 0 reads at each instant [T]; any integers.
        taps: The four weights at each instant [T, 4].
        gain: White levels a unit of the band.
        ambient: Ambient light [H, W], white levels.
        white: What a white level is written as.
    """
    width, columns = ambient.shape[1], band.shape[1]
    scale, unit = np.float32(gain), np.float32(white)
    done = 0
    while done < out.shape[1]:
        v, u = divmod(first + done, width)
        count = min(width - u, out.shape[1] - done)
        for k in range(len(starts)):
            start = starts[k] + u
            # From `near` to `far` some taps lie inside the band, from `begin` to `end` all four.
            near = min(max(0, -start - 3), count)
            far = max(near, min(count, columns - start))
            begin = min(max(near, -start), far)
            end = max(begin, min(far, columns - 3 - start))
            _dark(out, k, done, near, ambient, v, u, unit)
            _border(
                out, k, done + near, begin - near, band, v, start + near, taps, scale, ambient, u + near, unit
            )
            _inside(
                out, k, done + begin, end - begin, band, v, start + begin, taps[k, 0], taps[k, 1], taps[k, 2],
                taps[k, 3], scale, ambient, u + begin, unit,
            )  # fmt: skip
            _border(out, k, done + end, far - end, band, v, start + end, taps, scale, ambient, u + end, unit)
            _dark(out, k, done + far, count - far, ambient, v, u + far, unit)
        done += count
