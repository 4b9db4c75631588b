"""What a recording holds, in one pass over it and in memory that does not grow with it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evnlos.types import Events
from evnlos.untrusted import MOST_SENSOR_PIXELS

WINDOW_US = 10_000
"""Length of the windows in which the peak rate is counted, microseconds."""
_BYTES = {"t_us": 8, "x": 2, "y": 2, "p": 1, "adc": 2, "polarity_known": 1}


@dataclass(frozen=True)
class Silence:
    """A time without an event anywhere: its length and its begin after the first event, microseconds."""

    length_us: int = 0
    start_us: int = 0


@dataclass(frozen=True)
class Summary:
    """What a recording holds.

    Args:
        width: Sensor width, pixels; 0 without events.
        height: Sensor height, pixels; 0 without events.
        events: Number of events.
        first_us: Time of the first event, microseconds; 0 without events.
        last_us: Time of the last event, microseconds.
        on: Events that are brighter.
        unknown: Events whose polarity the camera did not give.
        peak_hz: Rate in the busiest window of 10 ms, events a second.
        peak_us: Begin of that window after the first event, microseconds.
        longest_silence: The longest time without an event.
        silences: Number of times of more than 10 ms without an event.
        active_pixels: Pixels that sent at least one event.
        busiest: Column, row and number of events of the busiest pixel; None without events.
        columns: Names of the columns.
    """

    width: int
    height: int
    events: int
    first_us: int
    last_us: int
    on: int
    unknown: int
    peak_hz: float
    peak_us: int
    longest_silence: Silence
    silences: int
    active_pixels: int
    busiest: tuple[int, int, int] | None
    columns: tuple[str, ...]

    @property
    def duration_us(self) -> int:
        """Time from the first to the last event, microseconds."""
        return self.last_us - self.first_us

    @property
    def rate_hz(self) -> float:
        """Mean rate, events a second; 0 where the recording has no duration."""
        return 1e6 * self.events / self.duration_us if self.duration_us else 0.0

    @property
    def memory_bytes(self) -> int:
        """Memory that the whole recording takes as `Events`, bytes."""
        return self.events * sum(_BYTES[name] for name in self.columns)


class _Peak:
    """The busiest window; windows that pieces share are counted on."""

    def __init__(self) -> None:
        self.window = self.count = 0
        self._open, self._have = 0, 0

    def add(self, since_us: NDArray[np.int64]) -> None:
        windows, counts = np.unique(since_us // WINDOW_US, return_counts=True)
        if windows[0] == self._open:
            counts[0] += self._have
        best = int(np.argmax(counts))
        if counts[best] > self.count:
            self.window, self.count = int(windows[best]), int(counts[best])
        self._open, self._have = int(windows[-1]), int(counts[-1])


class _Counts:
    """Events of each pixel; of a sensor of very many pixels, only of those that sent one."""

    def __init__(self, pixels: int) -> None:
        self._where = None if pixels <= MOST_SENSOR_PIXELS else np.zeros(0, np.int64)
        self._counts = np.zeros(pixels if self._where is None else 0, np.int64)

    def add(self, where: NDArray[np.int64]) -> None:
        if self._where is None:
            self._counts += np.bincount(where, minlength=len(self._counts))
            return
        new, counts = np.unique(where, return_counts=True)
        merged, places = np.unique(np.concatenate([self._where, new]), return_inverse=True)
        both = np.concatenate([self._counts, counts])
        self._where, self._counts = merged, np.bincount(places, both, len(merged)).astype(np.int64)

    def active(self) -> int:
        return int(np.count_nonzero(self._counts))

    def busiest(self) -> tuple[int, int]:
        """Return the first of the pixels with the most events, and how many these are."""
        if not len(self._counts):
            return 0, 0
        top = int(np.argmax(self._counts))
        return (top if self._where is None else int(self._where[top])), int(self._counts[top])


def summarise(pieces: Iterable[Events]) -> Summary:
    """Return what a recording holds; pieces come in the order of time, as `iter_events` yields them.

    Args:
        pieces: The events, all of one sensor.

    Example:
        >>> found = summarise([Events([0, 10, 30_010], [1, 1, 0], [0, 0, 0], [1, 0, 1], 2, 1)])
        >>> found.on, found.busiest, found.peak_hz, found.longest_silence, found.memory_bytes
        (2, (1, 0, 2), 200.0, Silence(length_us=30000, start_us=10), 39)
    """
    width = height = total = on = unknown = silences = 0
    first = last = 0
    longest, peak = Silence(), _Peak()
    counts = _Counts(0)
    columns: tuple[str, ...] = ("t_us", "x", "y", "p")
    for events in pieces:
        if not len(events):
            continue
        if not total:
            first = last = int(events.t_us[0])
            columns = tuple(events.columns())
            height, width = events.shape
            counts = _Counts(height * width)
        since = events.t_us - first
        gaps = np.diff(since, prepend=last - first)
        silences += int(np.count_nonzero(gaps > WINDOW_US))
        widest = int(np.argmax(gaps))
        if gaps[widest] > longest.length_us:
            longest = Silence(int(gaps[widest]), int(since[widest] - gaps[widest]))
        peak.add(since)
        where = events.y.astype(np.int64) * width + events.x
        counts.add(where)
        total += len(events)
        on += int(np.count_nonzero(events.p))
        if events.polarity_known is not None:
            unknown += len(events) - int(np.count_nonzero(events.polarity_known))
        last = int(events.t_us[-1])
    top, most = counts.busiest()
    return Summary(
        width=width,
        height=height,
        events=total,
        first_us=first,
        last_us=last,
        on=on,
        unknown=unknown,
        peak_hz=peak.count * 1e6 / WINDOW_US,
        peak_us=peak.window * WINDOW_US,
        longest_silence=longest,
        silences=silences,
        active_pixels=counts.active(),
        busiest=(top % width, top // width, most) if total else None,
        columns=columns,
    )
