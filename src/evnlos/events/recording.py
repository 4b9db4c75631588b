"""Recordings on disk: read block by block, and summed up in one go.

- A recording on disk, read block by block: a stretch of time, a part of the sensor, a report of faults.
- What a recording holds, in one pass over it and in memory that does not grow with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import astuple, dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import ConfigError, DataError
from evnlos.events.files.celex import CelexOptions
from evnlos.events.files.columns import OnError, ReadReport, trusted_events
from evnlos.events.files.read import in_order, open_source
from evnlos.events.filters import check_box, crop_events, keep_known_polarity
from evnlos.types import Events
from evnlos.untrusted import MOST_SENSOR_PIXELS


@dataclass(frozen=True)
class Box:
    """A part of the sensor, pixels.

    Args:
        x: Its first column, from 0.
        y: Its first row, from 0.
        width: Columns, at least 1.
        height: Rows, at least 1.

    Raises:
        ConfigError: A negative corner or a side below 1.
    """

    x: int
    y: int
    width: int
    height: int

    def __post_init__(self) -> None:
        if min(self.x, self.y) < 0 or min(self.width, self.height) < 1:
            given = f"{self.x} {self.y} {self.width} {self.height}"
            raise ConfigError(f"the box {given} is X Y WIDTH HEIGHT in pixels; give X, Y >= 0 and sides >= 1")


@dataclass(frozen=True)
class CropOptions:
    """What to take of a recording.

    Args:
        start_s: Begin, seconds after the first event.
        stop_s: End, seconds after the first event; None = to the last. Events at this instant are left out.
        box: Part of the sensor; its corner becomes the pixel (0, 0). None = all.
        known_polarity: Whether to leave out events whose polarity the camera did not give.

    Raises:
        ConfigError: A start below 0 or an end that is not after it.
    """

    start_s: float = 0.0
    stop_s: float | None = None
    box: Box | None = None
    known_polarity: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.start_s < np.inf:
            raise ConfigError(f"start is {self.start_s} s; give 0 or more, seconds after the first event")
        if self.stop_s is not None and not self.stop_s > self.start_s:
            raise ConfigError(f"stop is {self.stop_s} s, start {self.start_s} s; give a stop after the start")


class Recording:
    """An event file that is read block by block; `report` fills while it is read.

    Args:
        path: The file; its format is found from its content.
        on_error: "strict" raises at the first fault, "salvage" leaves out what is damaged.
        width: Sensor width, pixels, where the file does not say or is wrong; give both or neither.
        height: Sensor height, pixels.
        celex: What a CeleX-V recording does not say about itself.
        topic: Name of the stream, of a file that holds several.

    Raises:
        EventFileError: The file is absent, of no known format, or damaged at its start.
        MissingDependencyError: The format needs an optional package.

    Example:
        >>> import tempfile
        >>> from evnlos.events import write_events
        >>> name = tempfile.mkdtemp() + "/three.npz"
        >>> write_events(name, Events([5, 9, 12], [0, 3, 1], [1, 1, 0], [1, 0, 1], width=4, height=2))
        >>> recording = Recording(name)
        >>> list(recording.pieces(CropOptions(start_s=2e-6, box=Box(1, 0, 3, 2))))
        [Events(2 events, 3 x 2, 9..12 us, 50 % ON)]
    """

    def __init__(
        self,
        path: str | PathLike[str],
        on_error: OnError = "strict",
        *,
        width: int | None = None,
        height: int | None = None,
        celex: CelexOptions | None = None,
        topic: str | None = None,
    ) -> None:
        self.path = Path(path)
        self._options = (on_error, width, height, celex, topic)
        self.report: ReadReport = open_source(self.path, *self._options)[1]

    @property
    def shape(self) -> tuple[int, int]:
        """Sensor size (height, width), pixels; of some formats known when their first events were read."""
        return self.report.height, self.report.width

    def pieces(self, cut: CropOptions | None = None) -> Iterator[Events]:
        """Yield the events in the order of time, as pieces of bounded size; each call reads the file anew.

        Args:
            cut: What to take; None = everything.

        Raises:
            EventFileError: In strict mode, at the first fault, after the pieces before it.
            ConfigError: The box leaves the sensor.
        """
        cut = cut or CropOptions()
        source, self.report = open_source(self.path, *self._options)
        first: int | None = None
        for columns in in_order(source.blocks(), self.report):
            events = trusted_events(columns, self.report.width, self.report.height)
            self.report.events += len(events)
            if first is None:
                first = int(events.t_us[0])
                if cut.box is not None:  # some formats state the sensor size with their first events
                    check_box(events.shape, *astuple(cut.box))
            over = cut.stop_s is not None and int(events.t_us[-1]) >= first + cut.stop_s * 1e6
            events = _stretch(events, first, cut)
            if cut.known_polarity:
                events = keep_known_polarity(events)
            if cut.box is not None:
                events = crop_events(events, *astuple(cut.box))
            if len(events):
                yield events
            if over:
                return

    def blank(self, cut: CropOptions | None = None) -> Events:
        """Return no events on the sensor, or on the part of it, that `pieces` yields events of."""
        box = cut.box if cut else None
        height, width = self.shape if box is None else (box.height, box.width)
        return Events.empty(width, height)


def _stretch(events: Events, first_us: int, cut: CropOptions) -> Events:
    if cut.start_s == 0 and cut.stop_s is None:
        return events
    start_us = first_us + int(np.ceil(cut.start_s * 1e6))
    start = int(np.searchsorted(events.t_us, start_us))
    stop = len(events)
    if cut.stop_s is not None and np.isfinite(cut.stop_s):
        stop = int(np.searchsorted(events.t_us, first_us + int(np.ceil(cut.stop_s * 1e6))))
    return events[start:stop]


WINDOW_US = 10_000
"""Length of the windows in which the peak rate is counted, microseconds."""
_BYTES = {"t_us": 8, "x": 2, "y": 2, "p": 1, "adc": 2, "polarity_known": 1}


@dataclass(frozen=True)
class EventGap:
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
        peak_hz: Rate in the busiest window of 10 ms, events per second.
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
    longest_silence: EventGap
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
        """Mean rate, events per second; 0 where the recording has no duration."""
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
    """Events of each pixel; of a sensor of very many pixels, only of pixels that sent one."""

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
        (2, (1, 0, 2), 200.0, EventGap(length_us=30000, start_us=10), 39)
    """
    width = height = total = on = unknown = silences = 0
    first = last = 0
    longest, peak = EventGap(), _Peak()
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
            longest = EventGap(int(gaps[widest]), int(since[widest] - gaps[widest]))
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


class EventWindows:
    """Windows of a stream as a data set: `torch.utils.data.DataLoader` takes it, with workers too.

    Window k holds the events with start + k stride < t_us <= start + k stride + window, as `Events.between`;
    what is left at the end and fills no window is left out.

    Args:
        events: The stream.
        window_us: Length of a window, microseconds.
        representation: What an item is: a map of `event_batch`, or None for the `Events` themselves.
        stride_us: From one window's begin to the next one's, microseconds; by default the windows join.
        start_us: Begin of the first window; by default just before the first event.
        transform: Called with each item.
        **options: Options of the representation.

    Raises:
        DataError: No event, a length that is not positive, or a representation or option that there is not.

    Example:
        >>> events = Events([1, 5, 9, 14], [0, 1, 0, 1], [0, 0, 0, 0], [1, 0, 1, 1], width=2, height=1)
        >>> windows = EventWindows(events, 5, "histogram")
        >>> len(windows), windows[0].shape, [len(one) for one in EventWindows(events, 5)]
        (2, (2, 1, 2), [2, 1])
    """

    def __init__(
        self,
        events: Events,
        window_us: int,
        representation: str | None = None,
        *,
        stride_us: int | None = None,
        start_us: int | None = None,
        transform: Callable[[Any], Any] | None = None,
        **options: Any,
    ) -> None:
        if not isinstance(events, Events):
            raise DataError(f"{events!r:.80} is no stream of events; give evnlos.read_events(FILE)")
        self.events, self.window_us, self.stride_us = events, window_us, stride_us or window_us
        if not len(events) or window_us <= 0 or self.stride_us <= 0:
            raise DataError(
                f"{len(events)} events in windows of {window_us} us; give events and positive lengths"
            )
        self.start_us = int(events.t_us[0]) - 1 if start_us is None else start_us
        self.representation, self.transform, self.options = representation, transform, options
        self._made(events[:1])  # a wrong name or option is told here, not by a worker

    def __len__(self) -> int:
        span = int(self.events.t_us[-1]) - self.start_us - self.window_us
        return max(0, span // self.stride_us + 1)

    def __getitem__(self, index: int) -> Any:
        if not -len(self) <= index < len(self):
            raise IndexError(f"window {index} of {len(self)}")
        begin = self.start_us + index % len(self) * self.stride_us
        item = self._made(self.events.between(begin, begin + self.window_us))
        return item if self.transform is None else self.transform(item)

    def _made(self, events: Events) -> Any:
        if self.representation is None:
            return events
        from evnlos.events.batch import event_batch  # whose kernels a recording does not need

        return event_batch([events], self.representation, **self.options)[0].numpy()  # type: ignore[arg-type]
