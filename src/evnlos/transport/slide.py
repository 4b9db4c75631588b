"""A band of the wall that slides under the sensor: many frames in a few operations, on any device."""

from __future__ import annotations

import torch
from torch.nn.functional import pad


def slide(band: torch.Tensor, starts: list[int], taps: list[list[float]], width: int) -> torch.Tensor:
    """Return windows of a band at sub-sample places, sum over k of taps[t][k] band[:, starts[t] + k + column].

    Args:
        band: Spline coefficients at the sensor's rows, real [H, B]; zero beyond its ends.
        starts: First column of each window, [T]; it may lie outside the band.
        taps: Weights of four neighbours, [T][4].
        width: Columns of a window.

    Returns:
        Frames [T, H, width].
    """
    taps_of = torch.tensor(taps, dtype=band.dtype, device=band.device).reshape(-1, 4, 1, 1)
    # a window beyond the band is as dark wherever it is
    places = [min(max(start, -width - 3), band.shape[1]) + width + 3 for start in starts]
    windows = pad(band, (width + 3, width + 3)).unfold(1, width, 1).transpose(0, 1)  # [place, H, width]
    place = torch.tensor(places, dtype=torch.int64, device=band.device)
    frames = taps_of[:, 0] * windows[place]
    for k in range(1, 4):
        frames.add_(taps_of[:, k] * windows[place + k])
    return frames
