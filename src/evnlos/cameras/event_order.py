"""Events in their one order, in memory and on a device.

- Put events into their one order: by time stamp, then row, then column, then OFF before ON.
- Events that stay on the device on which they were simulated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from evnlos.types import Events

_DENSE_LIMIT = 1 << 20


@njit(cache=True, error_model="numpy")
def grown(column: NDArray) -> NDArray:
    """Return a copy of a column with twice its length."""
    longer = np.empty(2 * len(column), column.dtype)
    longer[: len(column)] = column
    return longer


@njit(cache=True, nogil=True)
def expand(step, pixel, crossings, shot, first_bucket, peak, out_bucket, out_pixel, out_on):
    """Write one entry for each event of a tile's records; crossing j of step k goes to bucket first[k] + j."""
    n = 0
    for i in range(len(step)):
        k = step[i]
        bucket = first_bucket[k]
        for j in range(abs(crossings[i])):
            out_bucket[n] = bucket + j
            out_pixel[n] = pixel[i]
            out_on[n] = crossings[i] > 0
            n += 1
        if shot[i] != 0:
            out_bucket[n] = bucket + max(peak[k], 1) - 1
            out_pixel[n] = pixel[i]
            out_on[n] = shot[i] > 0
            n += 1
    return n


@njit(cache=True, nogil=True)
def _counting_sort(bucket, pixel, on, time_us, out_time, out_pixel, out_on):
    """Sort stably by bucket; bucket b has the time stamp time_us[b]."""
    place = np.zeros(len(time_us) + 1, np.int64)
    for i in range(len(bucket)):
        place[bucket[i] + 1] += 1
    for b in range(len(time_us)):
        place[b + 1] += place[b]
    for i in range(len(bucket)):
        n = place[bucket[i]]
        place[bucket[i]] = n + 1
        out_time[n] = time_us[bucket[i]]
        out_pixel[n] = pixel[i]
        out_on[n] = on[i]


@njit(cache=True, nogil=True)
def settle_ties(time, pixel, on):
    """Sort events of one time stamp by pixel and polarity, in place; the time stamps must ascend already."""
    start = 0
    while start < len(time):
        stop = start + 1
        tidy = True
        while stop < len(time) and time[stop] == time[start]:
            before = 2 * np.int64(pixel[stop - 1]) + on[stop - 1]
            if 2 * np.int64(pixel[stop]) + on[stop] < before:
                tidy = False
            stop += 1
        if not tidy:
            key = np.empty(stop - start, np.int64)
            for i in range(start, stop):
                key[i - start] = 2 * np.int64(pixel[i]) + on[i]
            key.sort()
            for i in range(start, stop):
                pixel[i] = key[i - start] >> 1
                on[i] = (key[i - start] & 1) == 1
        start = stop


Columns = tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.bool_]]
"""Time stamps in microseconds, flat pixel indices, polarities."""


def sort_events(bucket: NDArray, pixel: NDArray, on: NDArray, time_us: NDArray) -> Columns:
    """Return (t_us, pixel, on) in order, given each event's bucket and each bucket's time stamp (ascending)."""
    count = len(bucket)
    if len(time_us) <= max(_DENSE_LIMIT, 4 * count):
        columns = _columns(count)
        _counting_sort(bucket, pixel, on, time_us, *columns)
    else:
        rank = np.argsort(bucket, kind="stable")
        columns = time_us[bucket[rank]], pixel[rank], on[rank]
    settle_ties(*columns)
    return columns


@njit(cache=True, nogil=True)
def _two_level_sort(time, pixel, on, first, spans, shift, coarse, out):
    """Sort stably by time stamp: all events into `spans` of 2^shift microseconds, then each span by itself.

    Both steps stay in the cache, which one table of all microseconds does not. `coarse` and `out` are columns
    for the result of each step.
    """
    coarse_time, coarse_pixel, coarse_on = coarse
    out_time, out_pixel, out_on = out
    edges = np.zeros(spans + 1, np.int64)
    for i in range(len(time)):
        edges[((time[i] - first) >> shift) + 1] += 1
    for span in range(spans):
        edges[span + 1] += edges[span]
    fill = edges.copy()
    for i in range(len(time)):
        span = (time[i] - first) >> shift
        n = fill[span]
        fill[span] = n + 1
        coarse_time[n], coarse_pixel[n], coarse_on[n] = time[i], pixel[i], on[i]
    width = 1 << shift
    place = np.empty(width + 1, np.int64)
    for span in range(spans):
        start, stop = edges[span], edges[span + 1]
        if start == stop:
            continue
        begin = first + (span << shift)
        place[:] = 0
        place[0] = start
        for i in range(start, stop):
            place[coarse_time[i] - begin + 1] += 1
        for b in range(width):
            place[b + 1] += place[b]
        for i in range(start, stop):
            b = coarse_time[i] - begin
            n = place[b]
            place[b] = n + 1
            out_time[n], out_pixel[n], out_on[n] = coarse_time[i], coarse_pixel[i], coarse_on[i]


def _columns(count: int) -> Columns:
    return np.empty(count, np.int64), np.empty(count, np.int32), np.empty(count, np.bool_)


def sort_times(time_us: NDArray, pixel: NDArray, on: NDArray) -> Columns:
    """Return (t_us, pixel, on) in order, given events in any order."""
    if not len(time_us):
        return time_us, pixel, on
    first = int(time_us.min())
    span = int(time_us.max()) - first + 1
    if span <= max(_DENSE_LIMIT, 4 * len(time_us)):
        columns, coarse = _columns(len(time_us)), _columns(len(time_us))
        shift = (span.bit_length() + 1) // 2
        _two_level_sort(time_us, pixel, on, first, ((span - 1) >> shift) + 1, shift, coarse, columns)
    else:
        rank = np.argsort(time_us, kind="stable")
        columns = time_us[rank], pixel[rank], on[rank]
    settle_ties(*columns)
    return columns


def joined(tiles: Sequence[Columns]) -> Columns:
    """Return the columns of several shares of pixels one after the other."""
    return (
        np.concatenate([tile[0] for tile in tiles]),
        np.concatenate([tile[1] for tile in tiles]),
        np.concatenate([tile[2] for tile in tiles]),
    )


def join(blocks: list[Columns]) -> Columns:
    """Join the columns of successive blocks, settling the order where one block ends and the next begins.

    The list is emptied on the way, so that no more than one column exists twice at a time.
    """
    if not blocks:
        return np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros(0, np.bool_)
    lengths = [len(block[0]) for block in blocks]
    edges = np.cumsum(lengths)[:-1]
    parts = [list(column) for column in zip(*blocks, strict=True)]
    blocks.clear()
    time, pixel, on = (np.concatenate(parts.pop(0)) for _ in range(3))
    for edge in edges:
        if 0 < edge < len(time) and time[edge - 1] >= time[edge]:
            first = int(np.searchsorted(time, time[edge], "left"))
            last = int(np.searchsorted(time, time[edge], "right"))
            settle_ties(time[first:last], pixel[first:last], on[first:last])
    return time, pixel, on


@dataclass(frozen=True, eq=False)
class EventTensors:
    """A stream of events as tensors on one device, ordered by time, then pixel, then OFF before ON.

    Args:
        t_us: Times, int64 [N], microseconds.
        pixel: Flat pixels y width + x, int64 [N].
        on: Polarities, bool [N], True = brighter.
        height: Sensor height, pixels.
        width: Sensor width, pixels.
    """

    t_us: Tensor
    pixel: Tensor
    on: Tensor
    height: int
    width: int

    def __len__(self) -> int:
        return len(self.t_us)

    def to_events(self) -> Events:
        """Return the same events in main memory."""
        time_us, pixel, on = (column.cpu().numpy() for column in (self.t_us, self.pixel, self.on))
        y, x = np.divmod(pixel, self.width)
        return Events(time_us, x.astype(np.uint16), y.astype(np.uint16), on, self.width, self.height)
