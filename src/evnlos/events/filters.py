"""Filters that leave events out: without polarity, outside a rectangle, of hot pixels, of lamps, of noise.

- Hot pixels send far more events than those around them, over the whole recording.
- Lamps on the mains make a pixel brighter and darker once a period: events that come again a period later,
  with events of the other polarity between.
- Background activity comes alone, edges do not: an event counts where pixels beside sent one near in time.

The last two look at what comes after an event as well as at what came before, so neither the first event of an
edge is lost nor the first period of a lamp is kept; a stream is held back by that time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import ConfigError, DataError
from evnlos.events.files.columns import Columns, join, trusted_events
from evnlos.types import Events


def keep_known_polarity(events: Events) -> Events:
    """Return the events whose polarity is known.

    A CeleX-V sends intensities: a pixel's polarity is the sign of the change since its last event, so it is
    unknown for a pixel's first event and where nothing changed. Off-pixel recordings have no polarity at all.

    Args:
        events: The stream; it is not changed, and returned as it is without the column `polarity_known`.

    Returns:
        The events with a polarity, without the column `polarity_known`; `adc` stays.

    Example:
        >>> events = Events([1, 2], [0, 0], [0, 0], [False, True], 1, 1, polarity_known=[False, True])
        >>> keep_known_polarity(events)
        Events(1 events, 1 x 1, 2..2 us, 100 % ON)
    """
    if events.polarity_known is None:
        return events
    known = events[events.polarity_known]
    return Events(known.t_us, known.x, known.y, known.p, known.width, known.height, adc=known.adc)


def crop_events(events: Events, x: int, y: int, width: int, height: int) -> Events:
    """Return the events inside a rectangle of the sensor, with coordinates from its corner.

    Args:
        events: The stream; it is not changed.
        x: First column, pixels.
        y: First row, pixels.
        width: Columns, pixels, at least 1.
        height: Rows, pixels, at least 1.

    Raises:
        ConfigError: The rectangle leaves the sensor.
    """
    check_box(events.shape, x, y, width, height)
    # Coordinates are unsigned: left of the corner they wrap around to more than the rectangle is wide.
    column, row = events.x - np.uint16(x), events.y - np.uint16(y)
    inside = (column < width) & (row < height)
    columns = {**events.columns(), "x": column, "y": row}
    return trusted_events({name: values[inside] for name, values in columns.items()}, width, height)


def stride_for(pixels: int, enough: int) -> int:
    """Return of which so many rows and columns one leaves about `enough` of the pixels.

    Args:
        pixels: Number of pixels of the sensor.
        enough: Pixels wanted, at least 1.

    Example:
        >>> stride_for(640 * 480, 40_000)
        3
    """
    return max(1, round(math.sqrt(pixels / enough)))


def thin_events(events: Events, stride: int, first: int = 0) -> Events:
    """Return the events of every so many rows and columns, on a sensor of these pixels alone.

    Args:
        events: The stream; it is not changed.
        stride: 1 keeps all.
        first: Row and column of the first pixel that is kept, below the stride.

    Example:
        >>> events = Events.empty(7, 5)
        >>> thin_events(events, 2, 1).shape
        (2, 3)
    """
    row, column = (along.astype(np.int64) - first for along in (events.y, events.x))
    kept = (row % stride == 0) & (column % stride == 0) & (row >= 0) & (column >= 0)
    moved = {"x": (column // stride).astype(np.uint16), "y": (row // stride).astype(np.uint16)}
    columns = events.columns() | moved
    height, width = (max(0, -(-(side - first) // stride)) for side in events.shape)
    return trusted_events({name: values[kept] for name, values in columns.items()}, width, height)


def check_box(shape: tuple[int, int], x: int, y: int, width: int, height: int) -> None:
    """Raise `ConfigError` unless the rectangle lies on a sensor of `shape` (rows, columns)."""
    if min(x, y) < 0 or min(width, height) < 1 or x + width > shape[1] or y + height > shape[0]:
        raise ConfigError(
            f"the box {x} {y} {width} {height} (X Y WIDTH HEIGHT) leaves the sensor of {shape[1]} x {shape[0]} "
            "pixels"
        )


@njit(cache=True)
def _hot(counts, factor, floor):
    """Mark pixels with more than `floor` events and `factor` times the median of the 24 around.

    counts: events of each pixel [H, W]; around: those of the neighbours, sorted as they come.
    """
    height, width = counts.shape
    hot = np.zeros((height, width), np.bool_)
    around = np.empty(24, np.int64)
    for row in range(height):
        for column in range(width):
            if counts[row, column] <= floor:
                continue
            size = 0
            for v in range(max(0, row - 2), min(height, row + 3)):
                for u in range(max(0, column - 2), min(width, column + 3)):
                    if v != row or u != column:
                        place = size
                        while place > 0 and around[place - 1] > counts[v, u]:
                            around[place] = around[place - 1]
                            place -= 1
                        around[place] = counts[v, u]
                        size += 1
            middle = (around[(size - 1) // 2] + around[size // 2]) / 2 if size else 0.0
            hot[row, column] = counts[row, column] > factor * max(middle, 1.0)
    return hot


def find_hot_pixels(events: Events, factor: float = 10.0, floor: int = 20) -> NDArray[np.bool_]:
    """Return which pixels send far more events than those around them.

    Args:
        events: The stream.
        factor: Times the median of the 24 pixels around (at least 1 event) above which a pixel is hot; above 1.
        floor: Events up to which a pixel is never hot.

    Returns:
        bool [H, W].

    Raises:
        DataError: A factor of 1 or less, or a negative floor.
    """
    if not factor > 1 or floor < 0:
        raise DataError(f"factor {factor} and floor {floor}; give a factor above 1 and a floor of 0 or more")
    return hot_by_counts(counts_of(events), factor, floor)


def hot_by_counts(counts: NDArray[np.int64], factor: float = 10.0, floor: int = 20) -> NDArray[np.bool_]:
    """Return which pixels sent far more events than those around them, of their counts [H, W]."""
    return _hot(counts, float(factor), floor)


def without_pixels(events: Events, pixels: NDArray[np.bool_]) -> Events:
    """Return the events of the pixels that are not marked; `pixels` is bool [H, W]."""
    return events[~pixels[events.y, events.x]]


def counts_of(events: Events) -> NDArray[np.int64]:
    """Return the events of each pixel, int64 [H, W]."""
    where = events.y.astype(np.int64) * events.width + events.x
    return np.bincount(where, minlength=events.width * events.height).reshape(events.shape)


class _Chains(NamedTuple):
    """The events that are held back, and chains from a pixel's newest event to older ones.

    Args:
        t_us: Times, int64 [N], microseconds, ascending.
        x: Columns, uint16 [N].
        y: Rows, uint16 [N].
        p: Whether brighter, bool [N].
        before: Number of the event before in the chain, int64 [N]; events are numbered from the first of the
            stream, -1 = none.
        marks: What the filter found, uint8 [N].
        walked: What the filter did already, uint8 [N].
        base: Number of the first event that is held.
    """

    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.bool_]
    before: NDArray[np.int64]
    marks: NDArray[np.uint8]
    walked: NDArray[np.uint8]
    base: int


@njit(cache=True)
def _mark_supported(held, start, newest, window, _):
    """Mark by which of the 4 pixels beside each event is supported: same polarity, |t - t'| <= window.

    held: `_Chains` of events of one pixel and polarity; marks and walked have a bit a side: supported from
    there, and followed from there on, so that all that is older was seen by an earlier walk; start: place of
    the first new event; newest: number of the newest event, [polarity, H + 2, W + 2]; window: microseconds.
    """
    t_us, before, marks, walked, base = held.t_us, held.before, held.marks, held.walked, held.base
    for i in range(start, len(t_us)):
        row, column, time = np.int64(held.y[i]) + 1, np.int64(held.x[i]) + 1, t_us[i]
        sign = np.int64(held.p[i])
        for side in range(4):  # right, left, below, above
            step = 1 - 2 * (side & 1)
            v, u = (row, column + step) if side < 2 else (row + step, column)
            k = newest[sign, v, u] - base
            if k < 0 or time - t_us[k] > window:
                continue
            marks[i] |= np.uint8(1 << side)
            back = np.uint8(1 << (side ^ 1))  # seen from there, this event is on the other side
            while k >= 0 and time - t_us[k] <= window:
                marks[k] |= back
                if walked[k] & back:
                    break
                walked[k] |= back
                k = before[k] - base
        before[i] = newest[sign, row, column]
        newest[sign, row, column] = base + i


_MOST_STEPS = 512  # back along the events of one pixel, of which one period holds far fewer


@njit(cache=True)
def _mark_repeated(held, start, newest, period, slack):
    """Mark events of one pixel and polarity a period apart, |t - t' - period| <= slack, the other between.

    Each event is taken for the repetition of one event only, the nearest to a period before that has none yet.

    held: `_Chains` of events of one pixel; start: place of the first new event; newest: number of the newest
    event, [any, H + 2, W + 2]; period, slack:
    microseconds; repeated: whether a later event was taken for its repetition.
    """
    t_us, p, before, base = held.t_us, held.p, held.before, held.base
    marks, repeated = held.marks, held.walked
    for i in range(start, len(t_us)):
        row, column, time = np.int64(held.y[i]) + 1, np.int64(held.x[i]) + 1, t_us[i]
        before[i] = newest[0, row, column]
        newest[0, row, column] = base + i
        k, turned, steps, best, off_by = before[i] - base, False, 0, -1, slack + 1
        while k >= 0 and time - t_us[k] <= period + slack and steps < _MOST_STEPS:
            if p[k] != p[i]:
                turned = True
            elif turned and not repeated[k] and abs(time - t_us[k] - period) < off_by:
                best, off_by = k, abs(time - t_us[k] - period)
            k = before[k] - base
            steps += 1
        if best >= 0:
            marks[i] = marks[best] = repeated[best] = 1


class HeldEvents:
    """A filter that holds events back until all that can mark them are there.

    Args:
        kernel: Marks the events that are held.
        stays: From the marks, uint8 [N], which events stay, bool [N].
        span_us: How far in time the kernel looks, microseconds: the sum of both.
    """

    def __init__(self, kernel: Callable, stays: Callable, span_us: tuple[int, int]) -> None:
        self._kernel, self._stays, self._span = kernel, stays, span_us
        self._columns: Columns | None = None
        self._before = np.empty(0, np.int64)
        self._marks = self._walked = np.empty(0, np.uint8)
        self._newest = np.empty((2, 0, 0), np.int64)
        self._base, self._shape = 0, (0, 0)
        self.dropped = 0
        """Events that were left out so far."""

    def push(self, events: Events) -> Events:
        """Take a piece, and return the earlier events that are decided and stay."""
        if self._columns is None:
            self._shape = events.shape
            self._newest = np.full((2, events.height + 2, events.width + 2), -1, np.int64)
        blocks = [events.columns()] if self._columns is None else [self._columns, events.columns()]
        columns, new = join(blocks), len(events)
        before = np.concatenate([self._before, np.full(new, -1, np.int64)])
        marks, walked = (np.concatenate([old, np.zeros(new, np.uint8)]) for old in (self._marks, self._walked))
        t_us = columns["t_us"]
        held = _Chains(t_us, columns["x"], columns["y"], columns["p"], before, marks, walked, self._base)
        self._kernel(held, len(t_us) - new, self._newest, *self._span)
        decided = int(np.searchsorted(t_us, t_us[-1] - sum(self._span))) if len(t_us) else 0
        self._columns = {name: values[decided:].copy() for name, values in columns.items()}
        self._before, self._marks, self._walked = before[decided:], marks[decided:], walked[decided:]
        self._base += decided
        return self._kept({name: values[:decided] for name, values in columns.items()}, marks[:decided])

    def rest(self) -> Events:
        """Return what is still held and stays, at the end of the stream."""
        if self._columns is None:
            return Events.empty(1, 1)
        columns, self._columns = self._columns, None
        return self._kept(columns, self._marks)

    def _kept(self, columns: Columns, marks: NDArray[np.uint8]) -> Events:
        kept = self._stays(marks)
        self.dropped += len(kept) - int(np.count_nonzero(kept))
        height, width = self._shape
        return trusted_events({name: values[kept] for name, values in columns.items()}, width, height)


_SIDES = np.array([bin(marks).count("1") for marks in range(256)], np.uint8)


def keep_supported(events: Events, window_us: int, sides: int = 2) -> Events:
    """Return the events that pixels beside support: they sent one of that polarity at most `window_us` apart.

    Noise comes alone, edges do not (Delbruck, "Frame-free dynamic digital vision", 2008). Three things make
    this keep more of the scene where as much of the noise goes: support counts from before and from after,
    only of the same polarity, and from two sides (Guo and Delbruck, "Low cost and latency event camera
    background activity denoising", 2022, count supporters as well).

    Args:
        events: The stream; it is not changed.
        window_us: Longest time to the supporting event, microseconds, at least 1.
        sides: How many of the 4 pixels beside must support an event, 1 to 4.

    Raises:
        DataError: A window below 1, or a number of sides out of its range.

    Example:
        >>> events = Events([1, 5, 6, 7], [0, 1, 2, 9], [0] * 4, [1] * 4, width=10, height=1)
        >>> keep_supported(events, 4, sides=1).x.tolist(), keep_supported(events, 4).x.tolist()
        ([0, 1, 2], [1])
    """
    return _all_of(support_filter(window_us, sides), events)


def support_filter(window_us: int, sides: int = 2) -> HeldEvents:
    """Return the filter of `keep_supported`, for a stream in pieces."""
    if window_us < 1:
        raise DataError(f"window_us is {window_us}; give at least 1 us")
    if not 1 <= sides <= 4:
        raise DataError(f"sides is {sides}; give 1 to 4 of the pixels beside")
    return HeldEvents(_mark_supported, lambda marks: _SIDES[marks] >= sides, (int(window_us), 0))


_SLACK = 0.1  # of a period: how far noise moves an event


def remove_flicker(events: Events, frequency_hz: float) -> Events:
    """Return the events without those that a flickering lamp made: a comb filter on events.

    An event goes where its pixel sent one of its polarity a period earlier or later (to a tenth of a period)
    and one of the other polarity between: the light went up and down and up again. The idea of a comb filter is
    that of Wang et al., "A linear comb filter for event flicker removal" (2022), which makes new events; here
    those that stay are the camera's own.

    Args:
        events: The stream; it is not changed.
        frequency_hz: Frequency of the light, 1 to 5000 Hz: twice that of the mains.

    Raises:
        DataError: A frequency outside its range.

    Example:
        >>> lamp = Events([0, 5000, 10000, 15000, 18000], [0] * 5, [0] * 5, [1, 0, 1, 0, 0], 1, 1)
        >>> remove_flicker(lamp, 100.0).t_us.tolist()
        [18000]
    """
    return _all_of(comb_filter(frequency_hz), events)


def comb_filter(frequency_hz: float) -> HeldEvents:
    """Return the filter of `remove_flicker`, for a stream in pieces."""
    if not 1 <= frequency_hz <= 5000:
        raise DataError(f"the frequency of the light is {frequency_hz:g} Hz; give 1 to 5000 Hz")
    period_us = 1e6 / frequency_hz
    return HeldEvents(_mark_repeated, lambda marks: marks == 0, (round(period_us), round(_SLACK * period_us)))


def _all_of(held: HeldEvents, events: Events) -> Events:
    first = held.push(events)
    rest = held.rest()
    columns = join([first.columns(), rest.columns()])
    return trusted_events(columns, events.width, events.height)
