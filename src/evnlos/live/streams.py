"""Streams of other programs: words of a camera on standard input, a connection to dv.

- Words of a camera on standard input, taken up anew where bytes are missing.
- The TCP stream of dv-processing's NetworkWriter: a header and packets as in an AEDAT4 file.
"""

from __future__ import annotations

import logging
import os
import select
import socket
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from evnlos.errors import ConfigError, EventFileError
from evnlos.events.files.aedat4 import EVENT, SIGNATURE, described, field_of
from evnlos.events.files.columns import Columns, ReadReport
from evnlos.events.files.mcap import MOST_CHUNK_BYTES, unpack
from evnlos.events.files.raw import parse_raw_header, raw_codec, raw_format_names, raw_geometry
from evnlos.events.files.words import WordCodec
from evnlos.live.growing_file import (
    BLOCK_BYTES,
    START_BYTES,
    UNPRINTABLE,
    OrderedEvents,
    OrderedTail,
    WordTail,
    is_cut_header,
)
from evnlos.live.packet import UNKNOWN_US, Chunk, Clock, SystemClock
from evnlos.types import Events

_LOG = logging.getLogger("evnlos")
_SLICE_BYTES = 1 << 14  # decoded at a time: a break spoils one slice, the next one shows how to go on
_JUDGED_WORDS = 64  # fewest words by which a stream is judged
_FORMATS = {"evt2": "EVT2", "evt21": "EVT21", "evt3": "EVT3"}
_LINE_BYTES = 1024
_NAP_S = 0.05
_ANSWER_S = 3.0  # a server of dv is waited for: to answer, then to say what it streams
_HOW = "pipe a RAW file with its header, or give --format evt3 --width 1280 --height 720 (as the camera has)"


class WordStream:
    """Words of a camera without an end, decoded; a stream that lost bytes is entered anew.

    Where more than 1 in 16 of at least 64 words can't be and another place to begin leaves a quarter of the
    faults or less, words begin there: a new stream, with a clock of its own.

    Args:
        codec: How words become events.
        size: Sensor width and height, pixels.
        t0_us: Time of the clock's zero, microseconds.

    Attributes:
        faults: How many events were left out as damaged, streams were taken up anew, and bytes of them lost.
    """

    def __init__(self, codec: WordCodec, size: tuple[int, int], t0_us: int = 0) -> None:
        self._codec, self._size, self._t0_us = codec, size, t0_us
        self.faults: Counter[str] = Counter()
        self._begin()

    def _begin(self) -> None:
        self._words = WordTail(self._codec, self._size, self._t0_us)
        self._tail = OrderedTail(self._words, *self._size)
        self._suspect, self._grave = b"", 0

    def feed(self, data: bytes) -> Iterator[tuple[Events, bool]]:
        """Yield the events that further bytes complete, and whether a new stream begins with them."""
        for at in range(0, len(data), _SLICE_BYTES):
            piece = data[at : at + _SLICE_BYTES]
            events = self._decode(piece)
            begun = self._anew(piece)
            if begun is not None:
                self.faults["damaged events"] += len(events)  # of before the break, or never there
            yield begun or (events, False)

    def end(self) -> None:
        """Count the bytes of a word that was cut."""
        self.faults["bytes left out"] += self._words.unused

    def _decode(self, data: bytes) -> Events:
        before = self._tail.faults
        events = self._tail.feed(data)
        self.faults["damaged events"] += self._tail.faults - before
        return events

    def _anew(self, data: bytes) -> tuple[Events, bool] | None:
        """Return what a new stream begins with, where bytes that were just decoded are better read as one."""
        self._grave += self._words.grave
        if not self._grave:
            return None
        self._suspect += data
        suspect, grave, size = self._suspect, self._grave, self._codec.dtype.itemsize
        if len(suspect) < _JUDGED_WORDS * size:
            return None
        self._suspect, self._grave = b"", 0
        if 16 * grave * size < len(suspect):
            return None
        fewest, start = min((self._grave_from(suspect[start:]), start) for start in range(size))
        if 4 * fewest >= grave:
            return None  # no words at all: to begin anew would not mend it
        self.faults["streams taken up anew"] += 1
        self.faults["bytes left out"] += start
        _LOG.warning("%d of %d words can't be: the stream is taken up anew", grave, len(suspect) // size)
        self._begin()
        return self._decode(suspect[start:]), True

    def _grave_from(self, data: bytes) -> int:
        words = WordTail(self._codec, self._size)
        words.feed(data)
        return words.grave


class WordInput:
    """A source that reads words of a camera from a pipe, until the program behind it ends.

    Args:
        handle: Number of the open file, 0 for standard input.
        format: "evt2", "evt21" or "evt3" for words alone; None where a RAW header precedes them.
        width: Sensor width, pixels, where no header says it; give both or neither.
        height: Sensor height, pixels.
        clock: The clock that arrivals are told by.

    Raises:
        ConfigError: The format is unknown or comes without a sensor size, or nobody writes to the input.
    """

    def __init__(
        self,
        handle: int = 0,
        *,
        format: str | None = None,
        width: int | None = None,
        height: int | None = None,
        clock: Clock | None = None,
    ) -> None:
        if format is not None and format not in _FORMATS:
            raise ConfigError(f"format is {format!r}; give one of {', '.join(_FORMATS)}")
        if format is not None and (width is None or height is None):
            raise ConfigError(f"words of {format} say no sensor size; give --width and --height too")
        if os.isatty(handle):
            raise ConfigError(f"standard input is a terminal, no stream of events; {_HOW}")
        self.name, self.has_frames, self.waits = "standard input", False, False
        self._handle, self._format, self._size = handle, format, (width, height)
        self._clock = clock or SystemClock()
        self._stream: WordStream | None = None

    def faults(self) -> dict[str, int]:
        """Return how many events and bytes were left out, and how often a broken stream was taken up anew."""
        found = self._stream.faults if self._stream else Counter()
        return {name: found[name] for name in ("damaged events", "bytes left out", "streams taken up anew")}

    def close(self) -> None:
        """Do nothing: the input is closed with the process."""

    def chunks(self, stop: Callable[[], bool]) -> Iterator[Chunk]:
        """Yield what came since the chunk before.

        Raises:
            EventFileError: The input ends before its header does, or says neither format nor sensor size.
        """
        data = self._opened(stop)
        while data and not stop():
            assert self._stream is not None
            now = self._clock.now()
            for events, begins in self._stream.feed(data):
                if len(events) or begins:
                    until = int(events.t_us[-1]) if len(events) else UNKNOWN_US
                    yield Chunk(events, until, now, now, restart=begins)
            data = self._read(stop)
        if self._stream is not None:
            self._stream.end()

    def _read(self, stop: Callable[[], bool]) -> bytes:
        """Return what came, nothing at the end or where `stop` came first."""
        while not stop():
            # Elsewhere a pipe can't be asked, and `stop` is heard when something comes.
            if os.name != "posix" or select.select([self._handle], [], [], _NAP_S)[0]:
                return os.read(self._handle, BLOCK_BYTES)
        return b""

    def _opened(self, stop: Callable[[], bool]) -> bytes:
        """Choose the decoder and return the first words."""
        start = b""
        while len(start) < 4 or (is_cut := _begins_header(start)) is None or (is_cut and is_cut_header(start)):
            more = self._read(stop)
            if stop():
                return b""
            if not more:
                raise EventFileError(f"standard input ends after {len(start)} bytes without an event; {_HOW}")
            if len(start) > START_BYTES:
                raise EventFileError(f"the header on standard input is longer than {START_BYTES} bytes; {_HOW}")
            start += more
        header = parse_raw_header(start if _begins_header(start) else b"")
        named = next((name for name in raw_format_names(header) if name in _FORMATS.values()), None)
        given = None if self._format is None else _FORMATS[self._format]
        if named and given and named != given:
            raise ConfigError(f"standard input says {named}, --format {self._format}; leave --format out")
        name = named or given
        if name is None:
            raise EventFileError(
                f"standard input begins with {start[:8].hex(' ')}, no header of a RAW file; {_HOW}"
            )
        report = ReadReport(Path(self.name), strict=False)
        raw_geometry(header, report, *self._size)
        size, words = (report.width, report.height), start[header.size :]
        codec = raw_codec(name, header, words)
        WordTail(codec, size).feed(
            bytes(codec.dtype.itemsize)
        )  # compiles the decoder before it has to be quick
        self._stream = WordStream(codec, size, header.integer("t0", report) or 0)
        return words


def _begins_header(start: bytes) -> bool | None:
    """Return whether bytes begin with a line of a RAW header; None where more of them must tell."""
    line, newline, _ = start[:_LINE_BYTES].partition(b"\n")
    if not line.startswith(b"%") or UNPRINTABLE.search(line):
        return False  # an EVT3 word may begin with the same byte
    return True if newline else None if len(start) < _LINE_BYTES else False


def _stream_header(header: bytes) -> tuple[str, int, int, int]:
    """Return compression, number, width and height of the first event stream of a header (without its size).

    Raises:
        ValueError: It is damaged, or describes no event stream.
    """
    method, streams = described(header)
    for stream in streams:
        if stream.identifier == "EVTS" and stream.width and stream.height:
            return method, stream.number, stream.width, stream.height
    raise ValueError("a stream without events of a stated sensor size")


def _packet_columns(packet: bytes | memoryview) -> Columns:
    """Return the events of an unpacked packet, as they stand in it.

    Raises:
        ValueError: It is damaged.
    """
    data = bytes(packet)
    try:
        vector = field_of(data, 0, 4)
        if vector:
            vector += struct.unpack_from("<I", data, vector)[0]
            count = struct.unpack_from("<I", data, vector)[0]
        else:
            vector, count = len(data) - 4, 0
        rows = np.frombuffer(data, EVENT, count, vector + 4)
    except (struct.error, ValueError):
        raise ValueError("a packet that is damaged") from None
    sides = {name: rows[name].astype(np.uint16) for name in ("x", "y")}  # -1 becomes a pixel outside
    return {"t_us": rows["t"].astype(np.int64), **sides, "p": rows["on"].astype(bool)}


class DvSource:
    """A source that connects to a server of dv-processing and takes its event stream, packed or not.

    Args:
        host: Address of the server.
        port: Its port.
        idle_s: End after so many seconds without a byte once the header came; None = never.
        clock: The clock that arrivals are told by.

    Raises:
        ConfigError: Nobody answers there within 3 s.
    """

    def __init__(
        self, host: str, port: int, *, idle_s: float | None = None, clock: Clock | None = None
    ) -> None:
        self.name, self.has_frames, self.waits = f"dv://{host}:{port}", False, False
        self._clock, self._idle_s = clock or SystemClock(), idle_s
        self._socket = self._connected(host, port)
        self._socket.setblocking(False)
        self._held = bytearray()
        self._heard_s = 0.0
        self._faults: Counter[str] = Counter()
        self._events: OrderedEvents | None = None

    def _connected(self, host: str, port: int) -> socket.socket:
        """Return a connection; a server that is only starting is tried again until `_ANSWER_S` are over."""
        until_s = self._clock.now() + _ANSWER_S
        while True:
            try:
                return socket.create_connection((host, port), timeout=max(until_s - self._clock.now(), 0.1))
            except (OSError, OverflowError) as error:
                if not isinstance(error, ConnectionRefusedError) or self._clock.now() > until_s:
                    found = f"{self.name} did not answer within {_ANSWER_S:g} s ({error})"
                    raise ConfigError(f"{found}; start the server first, and check host and port") from None
            self._clock.sleep(0.1)

    def faults(self) -> dict[str, int]:
        """Return how many packets and events were damaged, and bytes of a packet that was cut."""
        late = self._events.faults if self._events else 0
        names = ("damaged packets", "bytes left out")
        return {"damaged or late events": late} | {name: self._faults[name] for name in names}

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def chunks(self, stop: Callable[[], bool]) -> Iterator[Chunk]:
        """Yield the events of each packet until the server closes the connection.

        Raises:
            EventFileError: What the server sends is no stream of events, nothing comes within 3 s, or a packet
                has an impossible length.
            MissingDependencyError: The packets are packed and the package that unpacks them is missing.
        """
        try:
            opened = self._open(stop)
            while opened is not None and (head := self._take(8, stop)) is not None:
                method, stream = opened
                number, length = struct.unpack("<ii", head)
                body = self._take(length, stop)
                if body is None:
                    return
                if number != stream:
                    continue
                now = self._clock.now()
                try:
                    columns = _packet_columns(unpack(method, body, None if method != "none" else length))
                except ValueError:
                    self._faults["damaged packets"] += 1
                    continue
                assert self._events is not None
                events = self._events.sound(columns)
                if len(events):
                    yield Chunk(events, int(events.t_us[-1]), now, now)
        finally:
            self.close()

    def _open(self, stop: Callable[[], bool]) -> tuple[str, int] | None:
        """Return how packets are packed and the number of the event stream; None where `stop` came first."""
        self._heard_s = self._clock.now()
        start = self._take(4, stop)
        if start == SIGNATURE[:4]:  # as files begin; dv-processing leaves it out
            self._take(len(SIGNATURE) - 4, stop)
            start = self._take(4, stop)
        header = None if start is None else self._take(struct.unpack("<I", start)[0], stop)
        if header is None and stop():
            return None
        if header is None:
            found = f"{self.name} closed, or sent nothing for {_ANSWER_S:g} s, before it said what it streams"
            raise EventFileError(f"{found}; give the port of a dv NetworkWriter")
        try:
            method, stream, width, height = _stream_header(header)
        except ValueError as error:
            raise EventFileError(f"{self.name} sends {error}; stream events by dv's NetworkWriter") from None
        report = ReadReport(Path(self.name))
        report.set_geometry(width, height, "header")
        self._events = OrderedEvents(report.width, report.height)
        return method, stream

    def _take(self, count: int, stop: Callable[[], bool]) -> bytes | None:
        """Return that many bytes; None at the end of the stream."""
        if not 0 <= count <= MOST_CHUNK_BYTES:
            raise EventFileError(
                f"{self.name} sends a packet of {count} bytes, at most {MOST_CHUNK_BYTES} are read"
            )
        while len(self._held) < count:
            if stop():
                return None
            # What waits in the socket is taken first: the time that its events take here is no silence.
            if not select.select([self._socket], [], [], _NAP_S)[0]:
                idle_s = _ANSWER_S if self._events is None else self._idle_s
                if idle_s and self._clock.now() - self._heard_s > idle_s:
                    self._faults["bytes left out"] += len(self._held)
                    return None
                continue
            try:
                more = self._socket.recv(BLOCK_BYTES)
            except OSError:
                more = b""
            if not more:
                self._faults["bytes left out"] += len(self._held)
                return None
            self._heard_s = self._clock.now()
            self._held += more
        taken = bytes(self._held[:count])
        del self._held[:count]
        return taken
