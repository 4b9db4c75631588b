"""An event file that is still written, read and decoded as it grows.

- Decoding an event file that still grows: whole words or lines as they come, the rest when it is complete.
- An event file that a camera's program still writes, read as it grows.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

import numpy as np

from evnlos.errors import EventFileError
from evnlos.events.files.columns import Columns, allocate, cut
from evnlos.events.files.csv import FAULTS as CSV_FAULTS
from evnlos.events.files.csv import Layout, find_layout, parse_rows
from evnlos.events.files.fixed_words import sniff_dat
from evnlos.events.files.raw import parse_raw_header, sniff_raw
from evnlos.events.files.read import keep_in_order, open_source
from evnlos.events.files.words import (
    FAULTS,
    KINDS,
    OUT_OF_RANGE,
    STATE_SIZE,
    UNDATED,
    WordCodec,
    WordSource,
    new_state,
)
from evnlos.live.packet import Chunk, Clock, SystemClock
from evnlos.types import Events

_FOLLOWED = "RAW (EVT2, EVT2.1, EVT3), DAT and CSV can be followed while they grow"
START_BYTES = 65_536
UNPRINTABLE = re.compile(rb"[^\t-\r -~]")


class Tail(Protocol):
    """A decoder of a file's bytes in their order."""

    start: int
    """Byte of the file with which the events begin."""

    def feed(self, data: bytes) -> tuple[Columns, int]:
        """Return the events that further bytes complete, and how many faults were met."""
        ...


class OrderedEvents:
    """What of a stream's events is sound: inside the sensor, in the order of time.

    Args:
        width: Sensor width, pixels.
        height: Sensor height, pixels.

    Attributes:
        faults: Events that were left out.
    """

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height, self.faults = width, height, 0
        self._newest = np.iinfo(np.int64).min

    def sound(self, columns: Columns) -> Events:
        """Return the next events of the stream that are sound."""
        inside = (columns["x"] < self.width) & (columns["y"] < self.height)
        if not inside.all():
            self.faults += int((~inside).sum())
            columns = {name: column[inside] for name, column in columns.items()}
        t_us = columns["t_us"]
        if len(t_us) and (int(t_us[0]) < self._newest or (t_us[1:] < t_us[:-1]).any()):
            on_time = t_us >= self._newest
            columns = keep_in_order({name: column[on_time] for name, column in columns.items()})
            self.faults += len(t_us) - len(columns["t_us"])
        if len(columns["t_us"]):
            self._newest = int(columns["t_us"][-1])
        return Events(**columns, width=self.width, height=self.height)


class OrderedTail(OrderedEvents):
    """Events of a growing file, checked.

    Args:
        tail: The decoder.
        width: Sensor width, pixels.
        height: Sensor height, pixels.

    Attributes:
        faults: Words, lines and events that were left out.
    """

    def __init__(self, tail: Tail, width: int, height: int) -> None:
        super().__init__(width, height)
        self.start, self._tail = tail.start, tail

    def feed(self, data: bytes) -> Events:
        """Return the events that further bytes complete."""
        columns, faults = self._tail.feed(data)
        self.faults += faults
        return self.sound(columns)


class WordTail:
    """Words of one format, decoded as they come.

    Args:
        codec: How words become events.
        size: Sensor width and height, pixels.
        t0_us: Time of the clock's zero, microseconds.
        start: Byte of the file with which they begin.

    Attributes:
        grave: Faults of the last bytes that neither a stream entered in the middle nor a wrong size explains.
    """

    def __init__(self, codec: WordCodec, size: tuple[int, int], t0_us: int = 0, start: int = 0) -> None:
        self.start, self._codec, self._size, self._t0_us = start, codec, size, t0_us
        self._state, self._rest = new_state(), b""
        self.grave = 0

    @property
    def unused(self) -> int:
        """Bytes of a word that is not complete."""
        return len(self._rest)

    def feed(self, data: bytes) -> tuple[Columns, int]:
        """Return the events that further bytes complete, and how many faults were met."""
        codec = self._codec
        data = self._rest + data
        whole = len(data) // codec.dtype.itemsize * codec.dtype.itemsize
        # Arrays that may be written, as when a whole file is read: others would compile the decoder once more.
        words, self._rest = np.frombuffer(bytearray(data[:whole]), codec.dtype), data[whole:]
        out = allocate(codec.bound(words))
        places = out["t_us"], out["x"], out["y"], out["p"]
        count = int(codec.decode(words, self._state, *places, *self._size))
        noted = self._state[FAULTS : FAULTS + 2 * len(KINDS) : 2]
        faults = int(noted.sum())
        self.grave = faults - int(noted[UNDATED] + noted[OUT_OF_RANGE])
        self._state[FAULTS:STATE_SIZE] = 0
        columns = cut(out, 0, count)
        columns["t_us"] = columns["t_us"] + self._t0_us
        return columns, faults


class _CsvTail:
    def __init__(self, layout: Layout) -> None:
        self.start, self._layout, self._rest = layout.start, layout, b""

    def feed(self, data: bytes) -> tuple[Columns, int]:
        data, names = self._rest + data, self._layout.names
        most = len(data) // (2 * len(names)) + 1
        values, starts = np.empty((most, len(names)), np.int64), np.empty(most, np.int64)
        state = np.zeros(3, np.int64)
        seconds = names.index("t_us") if self._layout.in_seconds else -1
        lines = np.frombuffer(data, np.uint8)
        rows, used = parse_rows(lines, len(names), seconds, values, starts, state)
        self._rest = data[used:]
        values = values[:rows]
        t_us, x, y, p = (values[:, names.index(name)] for name in ("t_us", "x", "y", "p"))
        good = (x >= 0) & (x < 1 << 16) & (y >= 0) & (y < 1 << 16) & (np.abs(p) <= 1)
        columns = {
            "t_us": t_us[good].copy(),
            "x": x[good].astype(np.uint16),
            "y": y[good].astype(np.uint16),
            "p": p[good] > 0,
        }
        return columns, int(state[CSV_FAULTS]) + int((~good).sum())


def open_tail(path: Path, width: int | None = None, height: int | None = None) -> OrderedTail | None:
    """Return the decoder of a file that may have just begun; None while its header is not complete.

    Args:
        path: The file.
        width: Sensor width, pixels, where the file does not say; give both or neither.
        height: Sensor height, pixels.

    Raises:
        EventFileError: The file is of a format that can't be followed, or says no sensor size.
    """
    if not path.is_file():
        return None
    with path.open("rb") as file:
        start = file.read(START_BYTES)
    if not start or is_cut_header(start):
        return None
    named = sniff_raw(start) is not None or sniff_dat(start)
    layout = None if named else find_layout(start[: start.rfind(b"\n") + 1])
    if layout is not None:
        return _csv_tail(path, layout, width, height)
    if not named and not UNPRINTABLE.search(start):
        return None  # text without a row
    source, report = open_source(path, "salvage", width, height)
    if not isinstance(source, WordSource):
        raise EventFileError(f"{path} is {report.format}; {_FOLLOWED}: leave out --follow to replay it")
    size = report.width, report.height
    return OrderedTail(WordTail(source.codec, size, source.t0_us, source.start), *size)


def is_cut_header(start: bytes) -> bool:
    """Return whether a file begins with a header of which more may come."""
    if not start.startswith(b"%"):
        return False
    header = parse_raw_header(start)
    rest = start[header.size :]
    return len(rest) < 2 or (header.find("end") is None and rest.startswith(b"%"))


def _csv_tail(path: Path, layout: Layout, width: int | None, height: int | None) -> OrderedTail:
    if layout.is_celex or "p" not in layout.names:
        raise EventFileError(f"{path}: its rows hold no polarity or are the CeleX-V program's; {_FOLLOWED}")
    size = layout.size if width is None or height is None else (width, height)
    if size is None:
        raise EventFileError(f"{path} says no sensor size; give --width and --height")
    return OrderedTail(_CsvTail(layout), *size)


_POLL_S = 0.002
BLOCK_BYTES = 1 << 16


class GrowingFile:
    """A source that follows a file from its first event on, until it stops growing.

    The file may not be there yet. What it already holds is decoded first, because formats with running clocks
    can't be entered in the middle. An event's instant is the one at which its bytes were read.

    Args:
        path: The file: RAW (EVT2, EVT2.1, EVT3), DAT or CSV.
        width: Sensor width, pixels, where the file does not say; give both or neither.
        height: Sensor height, pixels.
        idle_s: End after so many seconds without a new byte; None = never.
        clock: The clock that it goes by.
    """

    def __init__(
        self,
        path: Path,
        *,
        width: int | None = None,
        height: int | None = None,
        idle_s: float | None = 10.0,
        clock: Clock | None = None,
    ) -> None:
        self.path, self.name, self.has_frames, self.waits = path, str(path), False, False
        self._size, self._idle_s, self._clock = (width, height), idle_s, clock or SystemClock()
        self._tail: OrderedTail | None = None

    def faults(self) -> dict[str, int]:
        """Return how many words, lines or events were left out as damaged."""
        return {"damaged events": self._tail.faults if self._tail else 0}

    def close(self) -> None:
        """Do nothing: the file is closed when its last chunk is taken."""

    def chunks(self, stop: Callable[[], bool]) -> Iterator[Chunk]:
        """Yield what was written since the chunk before.

        Raises:
            EventFileError: The file can't be followed, never came, or became shorter.
        """
        self._tail = tail = self._opened(stop)
        if tail is None:
            return
        place, heard_s = tail.start, self._clock.now()
        with self.path.open("rb", buffering=0) as file:
            file.seek(place)
            while not stop():
                data = file.read(BLOCK_BYTES)
                now = self._clock.now()
                if not data:
                    if self.path.stat().st_size < place:
                        raise EventFileError(f"{self.path} became shorter; follow a file that only grows")
                    if self._idle_s is not None and now - heard_s > self._idle_s:
                        return
                    self._clock.sleep(_POLL_S)
                    continue
                place, heard_s = place + len(data), now
                events = tail.feed(data)
                if len(events):
                    yield Chunk(events, int(events.t_us[-1]), now, now)

    def _opened(self, stop: Callable[[], bool]) -> OrderedTail | None:
        """Return the decoder as soon as the header is there; None where `stop` came first."""
        begun_s = self._clock.now()
        while not stop():
            tail = open_tail(self.path, *self._size)
            if tail is not None:
                return tail
            if self._idle_s is not None and self._clock.now() - begun_s > self._idle_s:
                what = "holds no event" if self.path.is_file() else "does not exist"
                raise EventFileError(f"{self.path} {what} after {self._idle_s} s; start the recording first")
            self._clock.sleep(_POLL_S)
        return None
