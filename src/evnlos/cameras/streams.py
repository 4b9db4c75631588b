"""What streams into an array of pixels and out of it: light, and events in their one order.

- Checks of the light and the instants that come in from outside.
- Light on its way to an array of pixels: whole frames, or strips that are rendered when they are needed.
- Events in their one order: by time stamp, then row, then column, then OFF before ON.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from numba import njit
from numpy.typing import ArrayLike, NDArray

from evnlos.cameras.event_model import MIN_THRESHOLD
from evnlos.errors import ConfigError, DataError

_LIGHT_DTYPES = (np.uint8, np.float32, np.float64)


def check_light(frames: ArrayLike | torch.Tensor) -> NDArray:
    """Return a video as an array [T, H, W] of uint8, float32 or float64, refusing what is not light."""
    if isinstance(frames, torch.Tensor):
        frames = frames.detach().cpu().numpy()
    light = np.asarray(frames)
    if light.ndim != 3 or 0 in light.shape[1:]:
        raise DataError(f"frames has shape {light.shape}; give [T, H, W] with at least one pixel")
    if light.dtype.kind not in "uif" and light.dtype != np.bool_:
        raise DataError(f"frames has dtype {light.dtype}; give numbers, 255 = white")
    if light.dtype not in _LIGHT_DTYPES:
        light = light.astype(np.float32 if light.dtype == np.float16 else np.float64)
    if light.dtype != np.uint8 and light.size and not _is_light(light):
        lowest, highest = float(light.min()), float(light.max())
        if not (np.isfinite(lowest) and np.isfinite(highest)):
            raise DataError("frames holds NaN or infinity; light must be finite, 255 = white")
        if lowest < 0:
            raise DataError(f"frames holds {lowest:g}; light cannot be negative, black is 0")
    return light


def _is_light(light: NDArray) -> bool:
    """Return whether all numbers are finite and without a minus sign, by one pass over their bits."""
    word = np.uint32 if light.dtype == np.float32 else np.uint64
    return light.flags.c_contiguous and bool(light.view(word).max() < np.array(np.inf, light.dtype).view(word))


def check_times(times_s: ArrayLike | torch.Tensor, count: int, after_s: float = -np.inf) -> NDArray[np.float64]:
    """Return instants as float64 [T], refusing a wrong number, NaN, and times that do not ascend."""
    if isinstance(times_s, torch.Tensor):
        times_s = times_s.detach().cpu().numpy()
    try:
        times = np.asarray(times_s, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"times_s is not a list of numbers ({error}); give seconds") from None
    if times.shape != (count,):
        raise DataError(
            f"times_s has shape {times.shape} for {count} frames; give one time in seconds per frame"
        )
    if not np.isfinite(times).all():
        raise DataError("times_s holds NaN or infinity; give finite seconds")
    behind = np.flatnonzero(np.diff(times, prepend=after_s) <= 0)
    if len(behind):
        k = int(behind[0])
        before = times[k - 1] if k else after_s
        raise DataError(f"times_s[{k}] is {times[k]:.9g} s after {before:.9g} s; times must ascend")
    return times


def check_threshold_maps(thresholds: object, shape: tuple[int, int]) -> tuple[NDArray, NDArray]:
    """Return the threshold maps (on, off) as float64 [H, W], refusing other shapes and values below 0.01."""
    if not isinstance(thresholds, (tuple, list)) or len(thresholds) != 2:
        raise ConfigError("thresholds must be a pair (on, off) of maps [H, W] in log units, or None")
    maps = []
    for name, values in zip(("on", "off"), thresholds, strict=True):
        if isinstance(values, torch.Tensor):
            values = values.detach().cpu().numpy()
        field = np.asarray(values, dtype=np.float64)
        if field.shape != shape:
            raise ConfigError(
                f"thresholds[{name}] has shape {field.shape}; the sensor is {shape[0]} x {shape[1]}"
            )
        lowest = float(field.min())
        if not (np.isfinite(field).all() and lowest >= MIN_THRESHOLD * (1 - 1e-6)):
            raise ConfigError(f"thresholds[{name}] holds {lowest:g}; give at least {MIN_THRESHOLD} log units")
        maps.append(field)
    return maps[0], maps[1]


WHITE_DN = 255.0
"""The white level of a wall (irradiance 1.0) in the pixel's digital numbers."""

_STRIP_BYTES = 2 << 20  # of light at once: it is made and used while the cache still holds it


class Light(Protocol):
    """Light in DN at some instants [T], of which an array of pixels takes what it works on."""

    def __len__(self) -> int:
        """Number of instants."""
        ...

    def __getitem__(self, instants: slice) -> Light:
        """Return the light at some of the instants."""
        ...

    @property
    def dtype(self) -> np.dtype:
        """Type of the numbers: uint8, float32 or float64."""
        ...

    @property
    def most_px(self) -> int | None:
        """How many pixels should be taken at once; None = any number."""
        ...

    def pixels(self, first: int, last: int) -> tuple[NDArray, int]:
        """Return light [T, M] that holds the pixels first..last - 1, and which pixel its first column is."""
        ...


class Frames:
    """Light that is there as a whole.

    Args:
        rows: Light in DN, [T, H * W], checked.
    """

    most_px = None

    def __init__(self, rows: NDArray) -> None:
        self._rows = rows.view()
        self._rows.flags.writeable = False  # one type of input: the kernels compile once, not twice
        self.dtype = rows.dtype

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, instants: slice) -> Frames:
        return Frames(self._rows[instants])

    def pixels(self, first: int, last: int) -> tuple[NDArray, int]:
        """Return all frames."""
        return self._rows, 0


class ImageStrips(Protocol):
    """A wall's light at some instants, of which any pixels can be had without the others."""

    def __len__(self) -> int:
        """Number of instants."""
        ...

    def __getitem__(self, instants: slice) -> ImageStrips:
        """Return the light at some of the instants."""
        ...

    def write(self, first: int, out: NDArray[np.float32], white: float) -> None:
        """Write the irradiance of the pixels first, first + 1, ... to `out` [T, N]; 1.0 becomes `white`."""
        ...


class StripLight:
    """Light that is rendered for the pixels that are requested, and forgotten.

    Args:
        strips: The wall's light.
    """

    dtype = np.dtype(np.float32)

    def __init__(self, strips: ImageStrips) -> None:
        self._strips = strips
        self.most_px = max(1, _STRIP_BYTES // (4 * max(1, len(strips))))

    def __len__(self) -> int:
        return len(self._strips)

    def __getitem__(self, instants: slice) -> StripLight:
        return StripLight(self._strips[instants])

    def pixels(self, first: int, last: int) -> tuple[NDArray, int]:
        """Return the light of these pixels alone.

        Raises:
            DataError: The wall returned NaN or negative light.
        """
        light = np.empty((len(self._strips), last - first), np.float32)
        self._strips.write(first, light, WHITE_DN)
        check_light(light[None])
        light.flags.writeable = False
        return light, first


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
    time, pixel, on = [t for t, _, _ in tiles], [p for _, p, _ in tiles], [o for _, _, o in tiles]
    return np.concatenate(time), np.concatenate(pixel), np.concatenate(on)


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
