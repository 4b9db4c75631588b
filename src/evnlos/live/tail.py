"""Decoding an event file that still grows: whole words or lines as they come, the rest when it is complete."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Protocol

import numpy as np

from evnlos.errors import EventFileError
from evnlos.events.io.columns import Columns, allocate, cut, keep_after, keep_in_order
from evnlos.events.io.csv_kernels import FAULTS as CSV_FAULTS
from evnlos.events.io.csv_kernels import parse_rows
from evnlos.events.io.csv_layout import Layout, find_layout
from evnlos.events.io.dat import sniff_dat
from evnlos.events.io.kernel_state import FAULTS, KINDS, STATE_SIZE, new_state
from evnlos.events.io.raw import sniff_raw
from evnlos.events.io.raw_header import parse_raw_header
from evnlos.events.io.read import open_source
from evnlos.events.io.words import WordSource
from evnlos.types import Events

_FOLLOWED = "RAW (EVT2, EVT2.1, EVT3), DAT and CSV can be followed while they grow"
_START_BYTES = 65_536
_UNPRINTABLE = re.compile(rb"[^\t-\r -~]")


class Tail(Protocol):
    """A decoder of a file's bytes in their order."""

    start: int
    """Byte of the file with which the events begin."""

    def feed(self, data: bytes) -> tuple[Columns, int]:
        """Return the events that further bytes complete, and how many faults were met."""
        ...


class OrderedTail:
    """Events of a growing file, checked: inside the sensor, in the order of time.

    Args:
        tail: The decoder.
        width: Sensor width, pixels.
        height: Sensor height, pixels.

    Attributes:
        faults: Words, lines and events that were left out.
    """

    def __init__(self, tail: Tail, width: int, height: int) -> None:
        self.start, self.width, self.height = tail.start, width, height
        self.faults = 0
        self._tail = tail
        self._newest = np.iinfo(np.int64).min

    def feed(self, data: bytes) -> Events:
        """Return the events that further bytes complete."""
        columns, faults = self._tail.feed(data)
        self.faults += faults
        inside = (columns["x"] < self.width) & (columns["y"] < self.height)
        if not inside.all():
            self.faults += int((~inside).sum())
            columns = {name: column[inside] for name, column in columns.items()}
        t_us = columns["t_us"]
        if len(t_us) and (int(t_us[0]) < self._newest or (t_us[1:] < t_us[:-1]).any()):
            columns = keep_after(keep_in_order(columns), self._newest)
            self.faults += len(t_us) - len(columns["t_us"])
        if len(columns["t_us"]):
            self._newest = int(columns["t_us"][-1])
        return Events(**columns, width=self.width, height=self.height)


class _WordTail:
    def __init__(self, source: WordSource) -> None:
        self.start, self._source = source.start, source
        self._state, self._rest = new_state(), b""

    def feed(self, data: bytes) -> tuple[Columns, int]:
        codec, report = self._source.codec, self._source.report
        data = self._rest + data
        whole = len(data) // codec.dtype.itemsize * codec.dtype.itemsize
        # Arrays that may be written, as when a whole file is read: others would compile the decoder once more.
        words, self._rest = np.frombuffer(bytearray(data[:whole]), codec.dtype), data[whole:]
        out = allocate(codec.bound(words))
        places = out["t_us"], out["x"], out["y"], out["p"]
        count = int(codec.decode(words, self._state, *places, report.width, report.height))
        faults = int(self._state[FAULTS : FAULTS + 2 * len(KINDS) : 2].sum())
        self._state[FAULTS:STATE_SIZE] = 0
        columns = cut(out, 0, count)
        columns["t_us"] = columns["t_us"] + self._source.t0_us
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
        start = file.read(_START_BYTES)
    if not start or _is_cut_header(start):
        return None
    named = sniff_raw(start) is not None or sniff_dat(start)
    layout = None if named else find_layout(start[: start.rfind(b"\n") + 1])
    if layout is not None:
        return _csv_tail(path, layout, width, height)
    if not named and not _UNPRINTABLE.search(start):
        return None  # text without a row
    source, report = open_source(path, "salvage", width, height)
    if not isinstance(source, WordSource):
        raise EventFileError(f"{path} is {report.format}; {_FOLLOWED}: leave out --follow to replay it")
    return OrderedTail(_WordTail(source), report.width, report.height)


def _is_cut_header(start: bytes) -> bool:
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
