"""Events in UDP packets: 24 bytes of header, then 8 bytes an event, all little endian.

| bytes | header field |
|---|---|
| 0-3 | magic, the letters EVNL |
| 4 | version, 1 |
| 5 | flags: bit 0 = the stream ends with this packet, the other bits 0 |
| 6-7 | number of events in the packet, uint16 |
| 8-11 | sequence number, uint32, one more each packet; 0 begins a new stream |
| 12-15 | sensor width and height, pixels, uint16 each, 1 to 32768 |
| 16-23 | time base, microseconds, int64 |

An event is its time after the base (uint32, microseconds, non-decreasing), its column (uint16), and its row
(uint16) with the polarity in the highest bit (1 = brighter).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numba import njit

from evnlos.errors import DataError
from evnlos.events.io.columns import allocate, trusted_events
from evnlos.types import Events

MAGIC, VERSION, LAST = b"EVNL", 1, 1
MOST_EVENTS = 8_000
"""Events that fit into the largest UDP packet."""
USUAL_EVENTS = 180
"""Events that fit into a packet that no network has to split (1500 bytes with the network's own headers)."""
MAX_SIDE = 32_768
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
    if max(events.width, events.height) > MAX_SIDE:
        raise DataError(f"a sensor of {events.width} x {events.height}; packets take sides to {MAX_SIDE}")
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


@njit(cache=True)
def _split(words, base, width, height, t_us, x, y, p):
    """Split words into columns; return whether all are inside the sensor and in the order of time."""
    good, newest = True, np.int64(0)
    for index in range(len(words)):
        word = words[index]
        after = np.int64(word & np.uint64(0xFFFFFFFF))
        column, row = np.int64((word >> np.uint64(32)) & np.uint64(0xFFFF)), np.int64(word >> np.uint64(48))
        good &= after >= newest and column < width and (row & 0x7FFF) < height
        newest = after
        t_us[index] = base + after
        x[index] = column
        y[index] = row & 0x7FFF
        p[index] = row > 0x7FFF
    return good


def unpack(data: bytes) -> Packet:
    """Return what the bytes of a packet say.

    Raises:
        PacketError: They are no packet of this format, or a damaged one.
    """
    if len(data) < _HEADER.size:
        raise PacketError(f"a packet of {len(data)} bytes; at least {_HEADER.size} are needed")
    magic, version, flags, count, sequence, width, height, base = _HEADER.unpack_from(data)
    if magic != MAGIC or version != VERSION or flags > LAST:
        raise PacketError(f"a packet that starts with {data[:6].hex(' ')}; EVNL, version {VERSION} is read")
    if len(data) != _HEADER.size + count * _EVENT.itemsize:
        raise PacketError(f"a packet of {len(data)} bytes that announces {count} events")
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE and -_FAR_US < base < _FAR_US):
        raise PacketError(f"a packet of a sensor of {width} x {height} from {base} us")
    columns = allocate(count)
    words = np.frombuffer(data, _WORD, offset=_HEADER.size)
    places = columns["t_us"], columns["x"], columns["y"], columns["p"]
    if not _split(words, base, width, height, *places):
        raise PacketError("a packet with an event outside its sensor, or with times that run backwards")
    events = trusted_events(columns, width, height)
    return Packet(sequence, events, bool(flags & LAST))
