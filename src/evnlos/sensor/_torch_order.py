"""From crossings on a device to events in order, without leaving it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evnlos.sensor._v2e_array import instants_within
from evnlos.sensor.event_tensors import EventTensors


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


def events_in_order(
    sent: Sent, peaks: Tensor, times_s: NDArray[np.float64], shape: tuple[int, int]
) -> list[EventTensors]:
    """Return each clip's events by time, then pixel, then OFF before ON.

    `peaks` [clips, steps] is the number of thresholds that the busiest pixel crossed: it sets the sub-times.
    """
    pixels = shape[0] * shape[1]
    clip, order = torch.sort(sent.flat // pixels, stable=True)
    lengths = torch.bincount(clip, minlength=len(peaks)).tolist()
    columns = [column[order].split(lengths) for column in sent]
    return [
        _one_clip(Sent(step, flat - n * pixels, number, place), peak, times_s, shape)
        for n, (peak, step, flat, number, place) in enumerate(
            zip(peaks.clamp(min=1).cpu().numpy(), *columns, strict=True)
        )
    ]


def _one_clip(
    sent: Sent, peak: NDArray[np.int64], times_s: NDArray[np.float64], shape: tuple[int, int]
) -> EventTensors:
    """Return the events of one clip in order, given the peak of each step."""
    device, pixels = sent.step.device, shape[0] * shape[1]
    # equal time stamps are one place in the order
    stamps, ranks = np.unique(step_stamps(times_s, peak), return_inverse=True)
    stamp, rank, most, first = (
        torch.from_numpy(column).to(device) for column in (stamps, ranks, peak, np.cumsum(peak) - peak)
    )
    count = sent.number.abs()
    entry = torch.repeat_interleave(torch.arange(len(count), device=device), count)
    following = torch.arange(len(entry), device=device) - (torch.cumsum(count, 0) - count)[entry]
    step, pixel, number, place = (column[entry] for column in sent)
    place = torch.where(place < 0, most[step] - 1, place + following)
    key = rank[first[step] + place] * (2 * pixels) + 2 * pixel + (number > 0)
    key = torch.sort(key).values
    where = (key >> 1) % pixels
    return EventTensors(stamp[key // (2 * pixels)], where, (key & 1).bool(), shape[0], shape[1])


def step_stamps(times_s: NDArray[np.float64], peak: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the time stamps of all sub-steps in microseconds, ascending, int64 [sum of peak]."""
    start, delta = times_s[:-1], np.diff(times_s)
    seconds = np.repeat((start + delta).astype(np.float32), peak)
    first = np.cumsum(peak) - peak
    for step in np.flatnonzero(peak > 1).tolist():
        within = instants_within(start[step], delta[step], times_s[step + 1], int(peak[step]))
        seconds[first[step] : first[step] + peak[step]] = within
    return np.maximum.accumulate(np.rint(seconds.astype(np.float64) * 1e6).astype(np.int64))
