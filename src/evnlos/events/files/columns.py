"""What every format shares: streams, blocks of event columns, reports of reading, pieces in writing.

- Files that hold several streams (topics of a ROS bag, cameras of one file): listed, and one chosen by name.
- What reading an event file found: the strict mode raises at the first fault, salvage keeps a tally.
- What every writer of event files offers: pieces in, one complete file.
- Blocks of event columns on their way from a file to `Events`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import EventFileError
from evnlos.types import Events
from evnlos.untrusted import memory_left

_LOG = logging.getLogger("evnlos")
StreamKind = Literal["events", "frames", "other"]
_MOST_NAMES = 12  # of a message


@dataclass(frozen=True)
class Stream:
    """One stream of a file.

    Args:
        name: How the file calls it, such as "/event_camera/events"; what `topic=` takes.
        kind: "events", "frames", or "other" for what is not read.
        type: What the file says of it: a message type, a camera, a data set.
        count: Messages or packets that the file announces for it; None where it does not say.
    """

    name: str
    kind: StreamKind
    type: str
    count: int | None = None


def choose_stream(
    path: Path, streams: Sequence[Stream], topic: str | None, kind: StreamKind, is_strict: bool
) -> Stream:
    """Return the stream to read: the named one, else the only one of its kind.

    Args:
        path: The file, for messages.
        streams: All that it holds.
        topic: Name of the stream; a unique end of it, such as "left/events", will do. None = the only one.
        kind: What is wanted.
        is_strict: Whether several without a name are an error; else the first is taken, and a warning logged.

    Raises:
        EventFileError: No stream of that kind or name, or several and no name.
    """
    fitting = [stream for stream in streams if stream.kind == kind]
    names = ", ".join(stream.name for stream in fitting[:_MOST_NAMES])
    if not fitting:
        held = ", ".join(f"{stream.name} ({stream.type})" for stream in streams[:_MOST_NAMES])
        found = (
            f"it holds {held}; record {kind} as well" if held else "nothing in it can be read; copy it again"
        )
        raise EventFileError(f"{path}: byte 0: holds no stream of {kind}; {found}")
    if topic is not None:
        exact = [stream for stream in fitting if stream.name == topic]
        ends = exact or [stream for stream in fitting if stream.name.endswith("/" + topic.strip("/"))]
        if len(ends) != 1:
            found = (
                f"{len(ends)} streams of {kind} end in {topic!r}"
                if ends
                else f"no stream of {kind} is {topic!r}"
            )
            raise EventFileError(f"{path}: byte 0: {found}; give one of: {names}")
        return ends[0]
    if len(fitting) > 1:
        told = f"{path}: byte 0: holds {len(fitting)} streams of {kind}; give topic= (--topic), one of: {names}"
        if is_strict:
            raise EventFileError(told)
        _LOG.warning("%s; took %s", told, fitting[0].name)
    return fitting[0]


def refuse_topic(path: Path, name: str, topic: str | None) -> None:
    """Raise where a topic is named for a format that holds one stream."""
    if topic is not None:
        raise EventFileError(
            f"{path}: byte 0: {name} holds one stream, topic {topic!r} is none of it; leave topic out"
        )


OnError = Literal["strict", "salvage"]


SALVAGE = 'read it with on_error="salvage" (evnlos convert --on-error salvage)'
"""Cure of a damaged file, in Python and on the command line."""


def check_on_error(on_error: str) -> None:
    """Raise unless `on_error` is "strict" or "salvage"."""
    if on_error not in ("strict", "salvage"):
        raise EventFileError(f'on_error is {on_error!r}; give "strict" or "salvage"')


MOST_DEFLATED = 1100
"""How many times deflate and lzf shrink data at most; a file that announces more is lying."""


@dataclass
class ReadReport:
    """What was found in one event file.

    Args:
        path: The file.
        strict: Whether the first fault raises.
        format: Name of the format, as in `FORMATS`.
        width: Sensor width, pixels.
        height: Sensor height, pixels.
        geometry_from: Where the size comes from: "caller", "header", "camera" (the model that the header
            names), "format" (it has one sensor only), "events" (one past the largest coordinate) or
            "assumed" (the format's usual sensor).
        events: Events returned.
        triggers: External trigger edges seen.
        frames: Images seen among the events of AEDAT 2.0 and 3.1; other formats list them in `streams`.
        skipped: Events before the first row or time of a recording that starts in the middle; no fault.
        faults: How many faults of each kind: "truncated", "left_over", "out_of_range", "backwards",
            "undated", "unknown", "header", "checksum", "count", "clock" (a jump that bit errors of the camera's
            clock make), "lost" (messages that never reached the file).
        first: One line on the first fault of each kind, with its byte offset.
        bytes_left_over: Bytes that could not be used.
        truncated: Whether the file ends before it should.
        streams: All streams, of a file that can hold several.
        topic: Name of the stream that is read, of such a file.
        place: What faults are counted in: "byte" of the file, or "message" where bytes have no place (SQLite).
    """

    path: Path
    strict: bool = True
    format: str = ""
    width: int = 0
    height: int = 0
    geometry_from: str = ""
    events: int = 0
    triggers: int = 0
    frames: int = 0
    skipped: int = 0
    faults: dict[str, int] = field(default_factory=dict)
    first: dict[str, str] = field(default_factory=dict)
    bytes_left_over: int = 0
    truncated: bool = False
    streams: tuple[Stream, ...] = ()
    topic: str = ""
    place: str = "byte"

    def set_geometry(self, width: object, height: object, source: str, offset: int = 0) -> None:
        """Take over a sensor size and where it comes from.

        Raises:
            EventFileError: A side is not a whole number of pixels between 1 and 65536.
        """
        try:
            sides = int(width), int(height)  # type: ignore[call-overload]
        except (TypeError, ValueError):
            sides = 0, 0
        if not all(1 <= side <= 65_536 for side in sides):
            found = f"a sensor of {str(width)[:20]} x {str(height)[:20]} pixels"
            raise unreadable(self.path, offset, found, "give width= and height=")
        self.width, self.height, self.geometry_from = *sides, source

    @property
    def clean(self) -> bool:
        """Whether no fault was found."""
        return not self.faults

    @property
    def beside(self) -> list[str]:
        """What the file holds beside the events that were read: trigger edges, frames."""
        frames = [stream.name for stream in self.streams if stream.kind == "frames"]
        found = [f"{self.triggers:,} trigger edges (read_triggers)"] if self.triggers else []
        if frames or self.frames:
            held = ", ".join(frames[:_MOST_NAMES]) if frames else f"{self.frames:,} images"
            found.append(f"frames ({held}; evnlos import takes both)")
        return found

    def fault(
        self, kind: str, offset: int, found: str, cure: str, *, count: int = 1, lost_bytes: int = 0
    ) -> None:
        """Note a fault at byte (`place`) `offset`; in strict mode raise it as one line."""
        line = f"{self.path}: {self.place} {offset}: {found}; {cure}"
        if self.strict:
            raise EventFileError(line)
        self.faults[kind] = self.faults.get(kind, 0) + count
        self.first.setdefault(kind, line)
        self.bytes_left_over += lost_bytes
        self.truncated |= kind == "truncated"

    def __str__(self) -> str:
        size = f"{self.width} x {self.height} ({self.geometry_from})"
        head = f"{self.path}: {self.format}, {size}, {self.events:,} events"
        if self.clean:
            return f"{head}, no faults"
        tally = ", ".join(f"{count:,} {kind.replace('_', ' ')}" for kind, count in self.faults.items())
        return f"{head}; {tally}; {self.bytes_left_over:,} bytes left over"


def unreadable(path: Path, offset: int, found: str, cure: str) -> EventFileError:
    """Return the error of a file from which nothing can be taken, strict or not."""
    return EventFileError(f"{path}: byte {offset}: {found}; {cure}")


class Sink(Protocol):
    """An event file that grows; it is complete after `finish`."""

    def append(self, events: Events) -> None:
        """Write a piece: the same sensor and columns as the first, and no time before its predecessor's."""
        ...

    def finish(self) -> None:
        """Complete the file: counts, indices."""
        ...

    def close(self) -> None:
        """Let go of the file, complete or not."""
        ...


class FileSink:
    """A sink on one plain file."""

    def __init__(self, path: Path) -> None:
        self.file = path.open("wb")

    def close(self) -> None:
        """Close the file."""
        self.file.close()


Columns = dict[str, NDArray]
DTYPES = {
    "t_us": np.int64,
    "x": np.uint16,
    "y": np.uint16,
    "p": np.bool_,
    "adc": np.uint16,
    "polarity_known": np.bool_,
}


def allocate(count: int, names: Iterable[str] = ("t_us", "x", "y", "p")) -> Columns:
    """Return uninitialised columns for `count` events."""
    return {name: np.empty(count, DTYPES[name]) for name in names}


def cut(columns: Columns, start: int, stop: int) -> Columns:
    """Return a view of the events start..stop."""
    return {name: column[start:stop] for name, column in columns.items()}


def enlarge(columns: Columns, count: int, room: int) -> None:
    """Put columns of `room` places in place of these, with their first `count` events."""
    for name, column in columns.items():
        larger = np.empty(room, column.dtype)
        larger[:count] = column[:count]
        columns[name] = larger


def shorten(columns: Columns, count: int) -> None:
    """Give the memory behind the first `count` events back; nothing is copied."""
    for column in columns.values():
        column.resize(count, refcheck=False)


def join(blocks: list[Columns]) -> Columns:
    """Return the blocks as one; no block gives empty columns."""
    if not blocks:
        return allocate(0)
    if len(blocks) == 1:
        return blocks[0]
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


def collect(blocks: Iterable[Columns], size: int) -> Columns:
    """Return many blocks as one; each is let go as soon as it is copied.

    Args:
        blocks: Blocks with the same columns.
        size: Length of the file, bytes: a guess of the events that it holds.
    """
    columns: Columns = {}
    count, room = 0, max(min(size, memory_left() // 64), 1 << 16)
    for block in blocks:
        many = len(block["t_us"])
        if not columns:
            columns = allocate(room, block)  # pages that no event reaches are never used
        if count + many > room:
            room = max(2 * room, count + many)
            enlarge(columns, count, room)
        for name, column in columns.items():
            column[count : count + many] = block[name]
        count += many
    columns = columns or allocate(1)
    shorten(columns, count)
    return columns


def trusted_events(columns: Columns, width: int, height: int) -> Events:
    """Return `Events` of columns that a decoder has checked already."""
    return Events._trusted(columns, width, height)


@njit(cache=True)
def is_ascending(t_us):
    """Return whether no time is before its predecessor's, in vector code (`index - 1` would not be)."""
    backwards, later = False, t_us[1:]
    for index in range(len(later)):
        backwards |= later[index] < t_us[index]
    return not backwards


@njit(cache=True)
def _is_clean(t_us, x, y, width, height, newest):
    """Return whether all events are inside the sensor and in order, in loops by index for vector code."""
    largest_x, largest_y = np.uint16(0), np.uint16(0)
    for index in range(len(x)):
        largest_x = max(largest_x, x[index])
    for index in range(len(y)):
        largest_y = max(largest_y, y[index])
    backwards = len(t_us) > 0 and t_us[0] < newest
    return largest_x < width and largest_y < height and not backwards and is_ascending(t_us)


@njit(cache=True)
def _check_columns(t_us, x, y, width, height, newest):
    """Return index and kind (0 none, 1 out of range, 2 backwards) of the first fault and both tallies."""
    first, kind, outside, backwards = -1, 0, 0, 0
    for index in range(len(t_us)):
        if x[index] >= width or y[index] >= height:
            outside += 1
            if first < 0:
                first, kind = index, 1
            continue
        if t_us[index] < newest:
            backwards += 1
            if first < 0:
                first, kind = index, 2
        newest = t_us[index]
    return first, kind, outside, backwards, newest


class ColumnCheck:
    """Checks blocks of a file that stores columns (HDF5, NPZ, CSV, AEDAT4): coordinates and order of time."""

    def __init__(self, report: ReadReport, locate: Callable[[int], int] | None = None) -> None:
        """`locate` gives the byte of the file where an event, by its number, stands."""
        self._report, self._locate = report, locate
        self._newest = np.iinfo(np.int64).min
        self._events = 0

    def __call__(self, columns: Columns, offsets: NDArray[np.int64] | None = None) -> Columns:
        """Return the block without events outside the sensor; report them, and times that run backwards.

        `offsets` are the bytes of the file where the events stand, where that is known.
        """
        report, count = self._report, len(columns["t_us"])
        sides = report.width, report.height
        if _is_clean(columns["t_us"], columns["x"], columns["y"], *sides, self._newest):
            self._events += count
            self._newest = columns["t_us"][-1] if count else self._newest
            return columns
        first, kind, outside, backwards, self._newest = _check_columns(
            columns["t_us"], columns["x"], columns["y"], *sides, self._newest
        )
        if kind:
            number = self._events + first
            offset = int(offsets[first]) if offsets is not None else self._locate(number) if self._locate else 0
            order = ((1, outside), (2, backwards)) if kind == 1 else ((2, backwards), (1, outside))
            for which, many in order:
                if many and which == 1:
                    found = f"event {number} at x={columns['x'][first]}, y={columns['y'][first]}"
                    cure = f"the sensor is {report.width} x {report.height}; give width= and height="
                    report.fault("out_of_range", offset, found, cure, count=many)
                elif many:
                    found = f"event {number} at {columns['t_us'][first]} us is earlier than the one before it"
                    cure = f"sort the file by time or {SALVAGE}"
                    report.fault("backwards", offset, found, cure, count=many)
        self._events += count
        if outside:
            inside = (columns["x"] < report.width) & (columns["y"] < report.height)
            columns = {name: column[inside] for name, column in columns.items()}
        return columns
