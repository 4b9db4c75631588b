"""Interpolation and quadrature: cubic B-splines, the shift of a wall image, points and weights over a cell.

- Cubic B-splines: interpolation whose value and first two derivatives are continuous.

The compiled loop that shifts and scales a wall image; `wall` holds the slow reference.

Indices are unsigned: an index that can't be negative needs no test, and a loop becomes vectors without slices.

- Deterministic quadrature over square cells: Gauss-Legendre points on one side of a cell.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

MARGIN = 12  # samples of zeros round an image: the prefilter's tail, 0.268^n, has died out by then


def spline_coefficients(samples: torch.Tensor, axes: tuple[int, ...] = (-2, -1)) -> torch.Tensor:
    """Return the coefficients whose cubic B-spline passes through `samples`, periodic along `axes`.

    The B-spline's own samples are (1, 4, 1) / 6, so the coefficients are the samples divided by (2 + cos w) / 3
    in the Fourier domain. Data that end within the array should carry a margin of zeros (`MARGIN`).

    Args:
        samples: Values at the knots, real [...].
        axes: Axes along which to interpolate.
    """
    coefficients = samples
    for axis in axes:
        n = samples.shape[axis]
        omega = 2 * math.pi * torch.arange(n // 2 + 1, dtype=samples.dtype, device=samples.device) / n
        gain = (3 / (2 + torch.cos(omega))).movedim(0, -1)
        shape = [1] * samples.ndim
        shape[axis] = -1
        spectrum = torch.fft.rfft(coefficients, dim=axis) * gain.reshape(shape)
        coefficients = torch.fft.irfft(spectrum, n=n, dim=axis)
    return coefficients


def box_average(samples: torch.Tensor, height: float, width: float) -> torch.Tensor:
    """Average over a box of any size round each sample, periodic along the last two axes.

    Args:
        samples: Values, real [..., H, W].
        height: Side of the box along rows, samples, 0 or more.
        width: Side of the box along columns, samples, 0 or more.
    """
    rows, columns = samples.shape[-2:]
    fy = torch.fft.fftfreq(rows, dtype=samples.dtype, device=samples.device)
    fx = torch.fft.rfftfreq(columns, dtype=samples.dtype, device=samples.device)
    spectrum = torch.fft.rfft2(samples) * torch.sinc(fy * height)[:, None] * torch.sinc(fx * width)
    return torch.fft.irfft2(spectrum, s=(rows, columns))


def point_samples(means: NDArray, size: tuple[float, float]) -> NDArray:
    """Return an image at the middles of the blocks over which it was averaged, from their means.

    A mean over a block of side b is more than the value in its middle by b^2 / 24 of each second derivative,
    and what the pixels inside the block average themselves, the image has already.

    Args:
        means: Means [..., h, w].
        size: Sides (height, width) of a block, pixels, 1 or more.

    Example:
        >>> fine = np.arange(12.0) ** 2
        >>> round(float(point_samples(fine.reshape(1, 4, 3).mean(axis=-1), (1, 3))[0, 1]), 9)
        16.0
    """
    down, across = ((1 - 1 / side**2) / 24 for side in size)
    around = np.pad(means, [(0, 0)] * (means.ndim - 2) + [(1, 1), (1, 1)], mode="edge")
    rows, columns = around[..., 1:-1], around[..., 1:-1, :]
    second_down = rows[..., 2:, :] - 2 * means + rows[..., :-2, :]
    second_across = columns[..., 2:] - 2 * means + columns[..., :-2]
    return means - down * second_down - across * second_across


def spline_weights(fraction: torch.Tensor) -> torch.Tensor:
    """Return the weights [4, ...] of knots -1, 0, 1, 2 at `fraction` [...] past knot 0; their sum is 1."""
    f = fraction
    g = 1 - f
    near_left = (4 - 6 * f**2 + 3 * f**3) / 6
    near_right = (4 - 6 * g**2 + 3 * g**3) / 6
    return torch.stack([g**3 / 6, near_left, near_right, f**3 / 6])


def spline_slopes(fraction: torch.Tensor) -> torch.Tensor:
    """Return the derivatives [4, ...] of the `spline_weights` by the fraction [...]; their sum is 0."""
    f = fraction
    g = 1 - f
    return torch.stack([-g * g / 2, 1.5 * f * f - 2 * f, 2 * g - 1.5 * g * g, f * f / 2])


def spline_sample(coefficients: torch.Tensor, row: torch.Tensor, column: torch.Tensor) -> torch.Tensor:
    """Evaluate a two-dimensional cubic B-spline at any points; zero outside the array.

    Args:
        coefficients: From `spline_coefficients`, [h, w].
        row: Rows, real [...].
        column: Columns, real [...].

    Returns:
        Values [...] in the dtype of the coefficients.
    """
    if row.ndim == 2 and bool((row == row[:, :1]).all()) and bool((column == column[:1]).all()):
        return _on_grid(_on_grid(coefficients.mT, column[0]).mT, row[:, 0])
    return spline_scattered(coefficients, row, column)


def _on_grid(coefficients: torch.Tensor, row: torch.Tensor) -> torch.Tensor:
    """Evaluate splines along the first axis [h, n] at `row` [m]: [m, n]."""
    top = row.floor()
    weights = spline_weights(row - top).to(coefficients.dtype)
    value = coefficients.new_zeros(len(row), coefficients.shape[1])
    for k in range(4):
        index = top.long() + (k - 1)
        inside = (index >= 0) & (index < len(coefficients))
        value = value + (weights[k] * inside)[:, None] * coefficients[index.clamp(0, len(coefficients) - 1)]
    return value


def spline_scattered(coefficients: torch.Tensor, row: torch.Tensor, column: torch.Tensor) -> torch.Tensor:
    """Do what `spline_sample` does, point by point: the slow reference, and the way of tilted grids."""
    height, width = coefficients.shape
    flat = coefficients.reshape(-1)
    top, left = row.floor(), column.floor()
    wy = spline_weights(row - top).to(flat.dtype)
    wx = spline_weights(column - left).to(flat.dtype)
    value = torch.zeros(row.shape, dtype=flat.dtype, device=flat.device)
    for j in range(4):
        r = top.long() + (j - 1)
        for i in range(4):
            c = left.long() + (i - 1)
            inside = (r >= 0) & (r < height) & (c >= 0) & (c < width)
            index = r.clamp(0, height - 1) * width + c.clamp(0, width - 1)
            value = value + flat[index] * (wy[j] * wx[i] * inside)
    return value


class _Sheet(NamedTuple):
    """What is written, and what is read.

    Args:
        out: Light [T, N], overwritten.
        band: Spline coefficients at the frame's rows [H, C]; zero outside.
        taps: The four weights at each instant [T, 4].
        ambient: Ambient light [H, W], white levels.
        scale: White levels per unit of the band.
        white: What a white level is written as.
    """

    out: NDArray[np.float32]
    band: NDArray
    taps: NDArray[np.float32]
    ambient: NDArray[np.float32]
    scale: np.float32
    white: np.float32


@njit(cache=True, error_model="numpy")
def _inside(sheet, k, to, count, v, start, u):
    """Write `count` pixels whose taps all lie inside, from column `to` on.

    out[k, to + i] = white (scale max(0, sum_j taps[k, j] band[v, start + i + j]) + ambient[v, u + i])
    """
    out, band, ambient, scale, white = sheet.out, sheet.band, sheet.ambient, sheet.scale, sheet.white
    # The taps are numbers, so that the loop is vectors.
    tap_0, tap_1, tap_2, tap_3 = sheet.taps[k, 0], sheet.taps[k, 1], sheet.taps[k, 2], sheet.taps[k, 3]
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
def _border(sheet, k, to, count, v, start, u):
    """Write `count` pixels that have taps outside, where the band is zero; else as `_inside`."""
    band, columns = sheet.band, sheet.band.shape[1]
    for i in range(count):
        light = np.float32(0)
        for c in range(max(0, start + i), min(columns, start + i + 4)):
            light += sheet.taps[k, c - start - i] * np.float32(band[v, c])
        sheet.out[k, to + i] = (sheet.scale * max(light, np.float32(0)) + sheet.ambient[v, u + i]) * sheet.white


@njit(cache=True, error_model="numpy")
def _dark(sheet, k, to, count, v, u):
    """Write `count` pixels that no tap reaches: their ambient light."""
    out, ambient, white = sheet.out, sheet.ambient, sheet.white
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
        gain: White levels per unit of the band.
        ambient: Ambient light [H, W], white levels.
        white: What a white level is written as.
    """
    width, columns = ambient.shape[1], band.shape[1]
    sheet = _Sheet(out, band, taps, ambient, np.float32(gain), np.float32(white))
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
            _dark(sheet, k, done, near, v, u)
            _border(sheet, k, done + near, begin - near, v, start + near, u + near)
            _inside(sheet, k, done + begin, end - begin, v, start + begin, u + begin)
            _border(sheet, k, done + end, far - end, v, start + end, u + end)
            _dark(sheet, k, done + far, count - far, v, u + far)
        done += count


_MAX_POINTS = 16


def gauss_points(count: int) -> tuple[list[float], list[float]]:
    """Return `count` Gauss-Legendre offsets in -0.5..0.5 and their weights, which add up to 1.

    Example:
        >>> gauss_points(1)
        ([0.0], [1.0])
    """
    x, w = np.polynomial.legendre.leggauss(count)
    return (x / 2).tolist(), (w / 2).tolist()


def points_for(step: float, feature: float) -> int:
    """Return how many points per side resolve a feature of width `feature` on cells of width `step` (same
    unit).

    The error of n points on a Gaussian lobe of standard deviation `feature` stays below about 1e-3 of its peak:
    one point up to a tenth of it, two up to its width, three up to twice that, then in proportion.
    """
    if not math.isfinite(feature):
        return 1
    ratio = step / feature
    for count, limit in ((1, 0.1), (2, 1.0), (3, 2.0)):
        if ratio <= limit:
            return count
    return min(_MAX_POINTS, math.ceil(1.5 * ratio))
