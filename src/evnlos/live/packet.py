"""Events on their way from a source to the network: chunks of a stream, and UDP packets.

- The clock that a live reconstruction goes by; tests give it one that they turn themselves.
- What a source hands on: events, the instants at which they came, and now and then a frame.
- A queue of bounded length between source and network: what does not fit is counted, never waited for.
- UDP packets: 24 bytes of header, then 8 bytes per event, all little endian.

| bytes | header field |
|---|---|
| 0-3 | magic, the letters EVNL |
| 4 | version, 1 |
| 5 | flags: bit 0 = the stream ends with this packet, the other bits 0 |
| 6-7 | number of events in the packet, uint16 |
| 8-11 | sequence number, uint32, one more each packet; 0 begins a new stream |
| 12-15 | sensor width and height, pixels, uint16 each, 1 to 32768, together at most 4194304 pixels |
| 16-23 | time base, microseconds, int64 |

An event is its time after the base (uint32, microseconds, non-decreasing), its column (uint16), and its row
(uint16) with the polarity in the highest bit (1 = brighter).
"""

from __future__ import annotations

import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import ConfigError, DataError
from evnlos.events.files.columns import Columns, allocate, cut, trusted_events
from evnlos.types import Events


class Clock(Protocol):
    """Instants in seconds from an arbitrary origin, and waiting."""

    def now(self) -> float:
        """Return the instant, seconds; it never runs backwards."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait; nothing happens for 0 or less."""
        ...


class SystemClock:
    """The machine's monotonic clock."""

    def now(self) -> float:
        """Return the instant, seconds."""
        return time.perf_counter()

    def sleep(self, seconds: float) -> None:
        """Wait; nothing happens for 0 or less."""
        if seconds > 0:
            time.sleep(seconds)


UNKNOWN_US = -(1 << 62)
"""The event time of a stretch that has no event and says nothing of time."""


@dataclass(frozen=True, eq=False)
class Chunk:
    """A stretch of the stream, short beside the latency that is aimed at.

    Args:
        events: Its events, in the order of time; there may be none.
        until_us: Event time that the stretch reaches, microseconds; no later event is in it.
        first_s: Instant at which its first event came, seconds on the `Clock`: in a replay the one at which it
            is due, else that of its arrival.
        last_s: Instant at which its last event came, seconds.
        frame: What the frame camera saw at `until_us`, float32 [H, W], 0..1; None where it took no frame.
        restart: Whether a new stream begins: what came before, and its clock, is forgotten.
        frame_us: When the frame was taken, microseconds; None = at `until_us`. A camera sends it later.
    """

    events: Events
    until_us: int
    first_s: float
    last_s: float
    frame: NDArray[np.float32] | None = None
    restart: bool = False
    frame_us: int | None = None


class EventSource(Protocol):
    """Where events come from, as they come."""

    name: str
    """What it is, for a message."""
    has_frames: bool
    """Whether chunks can carry frames."""
    waits: bool
    """Whether it begins when it is asked to, and not when something happens."""

    def chunks(self, stop: Callable[[], bool]) -> Iterator[Chunk]:
        """Yield chunks as time goes by, until the stream ends or `stop` says so."""
        ...

    def faults(self) -> dict[str, int]:
        """Return how many of each kind of fault were met so far; what is damaged is left out."""
        ...

    def close(self) -> None:
        """Give back what it holds, such as a port."""
        ...


class ChunkQueue:
    """Chunks on their way to the network; the oldest ones are dropped where they would be too many.

    A source never waits. A dropped chunk's frame goes to the next chunk that has none: frames are few, and
    fusion needs one. The newest chunk is kept whatever its size.

    Args:
        most_events: Most events held; a chunk without events counts as one.

    Attributes:
        arrived_events: Events put in so far.
        dropped_events: Events dropped so far.
        dropped_chunks: Chunks dropped so far.

    Raises:
        ConfigError: The bound is below 1.
    """

    def __init__(self, most_events: int) -> None:
        if most_events < 1:
            raise ConfigError(f"the queue is to hold {most_events} events; give at least 1")
        self.most_events = most_events
        self.arrived_events = self.dropped_events = self.dropped_chunks = 0
        self._held: deque[Chunk] = deque()
        self._size = 0
        self._ready = threading.Condition()
        self._closed = False
        self._error: Exception | None = None

    def put(self, chunk: Chunk) -> None:
        """Add a chunk at once."""
        with self._ready:
            self.arrived_events += len(chunk.events)
            self._held.append(chunk)
            self._size += _size(chunk)
            while self._size > self.most_events and len(self._held) > 1:
                self._drop()
            self._ready.notify()

    def _drop(self) -> None:
        oldest = self._held.popleft()
        self._size -= _size(oldest)
        self.dropped_chunks += 1
        self.dropped_events += len(oldest.events)
        following = self._held[0]
        if following.restart:
            return
        if oldest.restart or (oldest.frame is not None and following.frame is None):
            kept = following if following.frame is not None else oldest
            when = kept.until_us if kept.frame_us is None else kept.frame_us
            self._held[0] = replace(following, frame=kept.frame, frame_us=when, restart=oldest.restart)

    def take(self, timeout_s: float) -> list[Chunk]:
        """Return all chunks held, in their order; none where nothing came in time or the queue was closed.

        Raises:
            Exception: What ended the source, once everything before it was taken.
        """
        with self._ready:
            self._ready.wait_for(lambda: self._held or self._closed, timeout_s)
            chunks = list(self._held)
            self._held.clear()
            self._size = 0
            if not chunks and self._error is not None:
                raise self._error
            return chunks

    def close(self, error: Exception | None = None) -> None:
        """Say that nothing more will come, and why."""
        with self._ready:
            self._closed, self._error = True, error
            self._ready.notify()

    @property
    def ended(self) -> bool:
        """Whether nothing is held and nothing more will come."""
        with self._ready:
            return self._closed and not self._held


def _size(chunk: Chunk) -> int:
    return max(len(chunk.events), 1)


MAGIC, VERSION, LAST = b"EVNL", 1, 1
MOST_EVENTS = 8_000
"""Events that fit into the largest UDP packet."""
USUAL_EVENTS = 180
"""Events that fit into a packet that no network has to split (1500 bytes with the network's own headers)."""
MAX_SIDE = 32_768
MAX_PIXELS = 1 << 22
"""Pixels of the largest sensor: state is kept for each, and one packet may claim any size."""
_HEADER = struct.Struct("<4sBBHIHHq")
_EVENT = np.dtype([("dt", "<u4"), ("x", "<u2"), ("y", "<u2")])
_WORD = np.dtype("<u8")  # an event as one number
_BRIGHTER = np.uint16(0x8000)
_FAR_US = 1 << 60  # times are subtracted from each other


class PacketError(DataError):
    """A packet is not of this format, or is damaged."""


@dataclass(frozen=True, eq=False)
class Packet:
    """What one packet says.

    Args:
        sequence: Its number.
        events: Its events.
        is_last: Whether the stream ends with it.
    """

    sequence: int
    events: Events
    is_last: bool = False


def pack(packet: Packet) -> bytes:
    """Return a packet as bytes.

    Raises:
        DataError: Too many events, too large a sensor, or too long a time for one packet.

    Example:
        >>> data = pack(Packet(7, Events([5], [1], [0], [True], width=4, height=2)))
        >>> len(data), unpack(data).events
        (32, Events(1 events, 4 x 2, 5..5 us, 100 % ON))
    """
    events = packet.events
    if len(events) > MOST_EVENTS:
        raise DataError(f"a packet of {len(events)} events; give at most {MOST_EVENTS}")
    if max(events.width, events.height) > MAX_SIDE or events.width * events.height > MAX_PIXELS:
        raise DataError(
            f"a sensor of {events.width} x {events.height}; packets take sides to {MAX_SIDE} "
            f"and {MAX_PIXELS} pixels"
        )
    if events.duration_us >= 1 << 32:
        raise DataError(f"a packet of {events.duration_us} us; give events within 4294 seconds")
    base = int(events.t_us[0]) if len(events) else 0
    if not -_FAR_US < base < _FAR_US:
        raise DataError(f"an event at {base} us; give times within 2^60 us")
    body = np.empty(len(events), _EVENT)
    body["dt"] = events.t_us - base
    body["x"] = events.x
    body["y"] = events.y | np.where(events.p, _BRIGHTER, np.uint16(0))
    flags = LAST if packet.is_last else 0
    sides = events.width, events.height
    header = _HEADER.pack(MAGIC, VERSION, flags, len(events), packet.sequence & 0xFFFFFFFF, *sides, base)
    return header + body.tobytes()


class Heading(NamedTuple):
    """What the header of a packet says."""

    sequence: int
    length: int
    width: int
    height: int
    base_us: int
    is_last: bool


@dataclass(frozen=True, eq=False)
class Batch:
    """Whole packets that were decoded together, in the order in which they came.

    Args:
        headings: Their headers.
        columns: Their events, one packet after the other.
        edges: Where the events of each begin, and the last ones end, int64 [packets + 1].
    """

    headings: list[Heading]
    columns: Columns
    edges: NDArray[np.int64]

    def events(self, first: int, last: int) -> Events:
        """Return the events of the packets first..last - 1, which follow each other on one sensor."""
        columns = self.columns
        if last - first < len(self.headings):
            columns = cut(columns, int(self.edges[first]), int(self.edges[last]))
        return trusted_events(columns, self.headings[first].width, self.headings[first].height)


@njit(cache=True)
def _split(words, edges, bases, widths, heights, t_us, x, y, p, good):
    """Split words into columns; mark packets whose events are inside their sensor and in the order of time."""
    for packet in range(len(bases)):
        is_good, newest = True, np.int64(0)
        base, width, height = bases[packet], widths[packet], heights[packet]
        for index in range(edges[packet], edges[packet + 1]):
            word = words[index]
            after = np.int64(word & np.uint64(0xFFFFFFFF))
            column, row = np.int64((word >> np.uint64(32)) & np.uint64(0xFFFF)), np.int64(word >> np.uint64(48))
            is_good &= after >= newest and column < width and (row & 0x7FFF) < height
            newest = after
            t_us[index] = base + after
            x[index] = column
            y[index] = row & 0x7FFF
            p[index] = row > 0x7FFF
        good[packet] = is_good


def _heading(data: bytes) -> Heading:
    if len(data) < _HEADER.size:
        raise PacketError(f"a packet of {len(data)} bytes; at least {_HEADER.size} are needed")
    magic, version, flags, count, sequence, width, height, base = _HEADER.unpack_from(data)
    if magic != MAGIC or version != VERSION or flags > LAST:
        raise PacketError(f"a packet that starts with {data[:6].hex(' ')}; EVNL, version {VERSION} is read")
    if len(data) != _HEADER.size + count * _EVENT.itemsize:
        raise PacketError(f"a packet of {len(data)} bytes that announces {count} events")
    is_sensor = 1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE and width * height <= MAX_PIXELS
    if not (is_sensor and -_FAR_US < base < _FAR_US):
        raise PacketError(f"a packet of a sensor of {width} x {height} from {base} us")
    return Heading(sequence, count, width, height, base, bool(flags & LAST))


def _decode(headings: list[Heading], bodies: list[bytes]) -> tuple[Batch, NDArray[np.bool_]]:
    """Return the events behind headers that are in order, and which packets' events are so too."""
    _, lengths, widths, heights, bases, _ = (np.array(field, np.int64) for field in zip(*headings, strict=True))
    edges = np.concatenate([[0], np.cumsum(lengths)])
    c, good = allocate(int(edges[-1])), np.empty(len(headings), np.bool_)
    words = np.frombuffer(b"".join(bodies), _WORD)
    _split(words, edges, bases, widths, heights, c["t_us"], c["x"], c["y"], c["p"], good)
    return Batch(headings, c, edges), good


def unpack(data: bytes) -> Packet:
    """Return what the bytes of a packet say.

    Raises:
        PacketError: They are no packet of this format, or a damaged one.
    """
    heading = _heading(data)
    batch, good = _decode([heading], [data[_HEADER.size :]])
    if not good[0]:
        raise PacketError("a packet with an event outside its sensor, or with times that run backwards")
    return Packet(heading.sequence, batch.events(0, 1), heading.is_last)


def unpack_all(datagrams: Sequence[bytes]) -> tuple[Batch | None, int]:
    """Return the packets that are whole, decoded together, and how many are not; None where none is.

    To decode packets one by one costs ten times as much.
    """
    headings, bodies = [], []
    for data in datagrams:
        try:
            headings.append(_heading(data))
        except PacketError:
            continue
        bodies.append(data[_HEADER.size :])
    if not headings:
        return None, len(datagrams)
    batch, good = _decode(headings, bodies)
    if good.all():
        return batch, len(datagrams) - len(headings)
    kept = [data for data, is_good in zip(bodies, good, strict=True) if is_good]
    left = [heading for heading, is_good in zip(headings, good, strict=True) if is_good]
    return _decode(left, kept)[0] if left else None, len(datagrams) - len(left)
