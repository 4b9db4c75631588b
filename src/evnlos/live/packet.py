"""Events in UDP packets: 24 bytes of header, then 8 bytes per event, all little endian.

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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import DataError
from evnlos.events.files.columns import Columns, allocate, cut, trusted_events
from evnlos.types import Events

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
