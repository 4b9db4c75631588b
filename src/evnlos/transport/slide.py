"""A band of the wall that slides under the sensor: many frames in a few operations, on any device."""

from __future__ import annotations

import torch
from torch.nn.functional import pad


def slide(band: torch.Tensor, starts: torch.Tensor, taps: torch.Tensor, width: int) -> torch.Tensor:
    """Return windows of a band at sub-sample places: sum over k of taps[t, k] band[:, starts[t] + k + column].

    Args:
        band: Spline coefficients at the sensor's rows, real [H, B]; zero beyond its ends.
        starts: First column of each window, int64 [T]; it may lie outside the band.
        taps: Weights of four neighbours, [T, 4].
        width: Columns of a window.

    Returns:
        Frames [T, H, width].
    """
    # a window beyond the band is as dark wherever it is
    place = starts.clamp(-width - 3, band.shape[1]) + width + 3
    windows = pad(band, (width + 3, width + 3)).unfold(1, width, 1).transpose(0, 1)  # [place, H, width]
    weights = taps[:, :, None, None]
    frames = weights[:, 0] * windows[place]
    for k in range(1, 4):
        frames.add_(weights[:, k] * windows[place + k])
    return frames
