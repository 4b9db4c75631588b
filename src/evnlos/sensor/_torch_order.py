"""From crossings on a device to events in order on the host."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.sensor._order import Columns
from evnlos.sensor._v2e_array import instants_within


class Sent(NamedTuple):
    """What pixels sent, unordered: int64 columns of one length."""

    step: Tensor
    flat: Tensor
    number: Tensor
    """Signed number of events that follow each other at successive sub-times; 0 = none."""
    place: Tensor
    """Index of the sub-time of the first of them; -1 = the last sub-time of the step, for shot noise."""

    @staticmethod
    def join(parts: list[Sent]) -> Sent:
        """Return all entries of one or more parts."""
        return Sent(*(torch.cat(column) for column in zip(*parts, strict=True)))


def events_in_order(sent: Sent, peaks: Tensor, times_s: NDArray[np.float64], pixels: int) -> list[Columns]:
    """Return each clip's events by time, then pixel, then OFF before ON, on the host.

    `peaks` [clips, steps] is the number of thresholds that the busiest pixel crossed: it sets the sub-times.
    """
    clip, order = torch.sort(sent.flat.cpu() // pixels, stable=True)
    lengths = torch.bincount(clip, minlength=len(peaks)).tolist()
    columns = [column.cpu()[order].split(lengths) for column in sent]
    return [
        _one_clip(Sent(step, flat - n * pixels, number, place), peak, times_s, pixels)
        for n, (peak, step, flat, number, place) in enumerate(
            zip(peaks.clamp(min=1).cpu().numpy(), *columns, strict=True)
        )
    ]


def _one_clip(sent: Sent, peak: NDArray[np.int64], times_s: NDArray[np.float64], pixels: int) -> Columns:
    """Return the events of one clip in order, given the peak of each step."""
    first = torch.from_numpy(np.cumsum(peak) - peak)
    count = sent.number.abs()
    entry = torch.repeat_interleave(torch.arange(len(count)), count)
    following = torch.arange(len(entry)) - (torch.cumsum(count, 0) - count)[entry]
    step, pixel, number, place = (column[entry] for column in sent)
    place = torch.where(place < 0, torch.from_numpy(peak)[step] - 1, place + following)
    # equal time stamps are one place in the order
    distinct, rank = np.unique(step_stamps(times_s, peak), return_inverse=True)
    key = torch.from_numpy(rank)[first[step] + place] * (2 * pixels) + 2 * pixel + (number > 0)
    key = torch.sort(key).values.numpy()
    where = (key >> 1) % pixels
    return distinct[key // (2 * pixels)], where.astype(np.int32), (key & 1).astype(np.bool_)


def step_stamps(times_s: NDArray[np.float64], peak: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the time stamps of all sub-steps in microseconds, ascending, int64 [sum of peak]."""
    start, delta = times_s[:-1], np.diff(times_s)
    if (peak == 1).all():
        seconds = (start + delta).astype(np.float32)
    else:
        parts = [instants_within(*step) for step in zip(start, delta, times_s[1:], peak.tolist(), strict=True)]
        seconds = np.concatenate(parts)
    return np.maximum.accumulate(np.rint(seconds.astype(np.float64) * 1e6).astype(np.int64))
