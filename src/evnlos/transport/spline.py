"""Cubic B-splines: interpolation whose value and first two derivatives are continuous."""

from __future__ import annotations

import math

import torch

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


def spline_weights(fraction: torch.Tensor) -> torch.Tensor:
    """Return the weights [4, ...] of knots -1, 0, 1, 2 at `fraction` [...] past knot 0; their sum is 1."""
    f = fraction
    g = 1 - f
    near_left = (4 - 6 * f**2 + 3 * f**3) / 6
    near_right = (4 - 6 * g**2 + 3 * g**3) / 6
    return torch.stack([g**3 / 6, near_left, near_right, f**3 / 6])


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
