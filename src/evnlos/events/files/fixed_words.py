"""DAT and Event Stream: formats with as many bytes for each event.

- DAT, Prophesee's decoded events: a text header, two bytes, then 8 bytes per event; only read.

Event Stream (`.es`) version 2, the DVS type: five bytes per event, of which the first holds time and
polarity.

The first byte is the time since the event before (seven bits, microseconds) and the polarity in its lowest bit;
then column and row, 16 bits each. 255 in its place adds 127 us and is no event, 254 is a mark that means
nothing. Rows count from the bottom.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.events.files.columns import (
    SALVAGE,
    Columns,
    ReadReport,
    allocate,
    cut,
    is_ascending,
    join,
    unreadable,
)
from evnlos.events.files.raw import parse_raw_header, raw_format_names, raw_geometry, read_raw_header
from evnlos.events.files.words import (
    BACKWARDS,
    BASE,
    CHUNK,
    CLOCK,
    NEWEST,
    OUT_OF_RANGE,
    UNKNOWN,
    WordCodec,
    WordSource,
    note,
)

_EVENT_TYPES = (0, 12)  # a generic 2-D event, a contrast detection
_EVENT_SIZE = 8
_MAX_SIDE = 16_384  # 14 bits


def sniff_dat(start: bytes) -> bool:
    """Return whether a text header that names no RAW format is followed by type and size of an event."""
    if not start.startswith(b"%"):
        return False
    header = parse_raw_header(start)
    tail = start[header.size : header.size + 2]
    named_raw = raw_format_names(header)
    return not named_raw and (
        b"Data file containing" in start[: header.size] or tail[1:] == bytes([_EVENT_SIZE])
    )


def _bound(words: NDArray[np.int64]) -> int:
    return len(words)


@njit(cache=True)
def _decode_carefully(words, first, state, t_us, x, y, p, width, height):
    """Decode word by word and note every fault; `first` is the number of the first word in its block."""
    clock, newest, base = state[CLOCK], state[NEWEST], state[BASE]
    count = 0
    for index in range(len(words)):
        word = words[index]
        stamp = word & 0xFFFFFFFF
        column, row, sign = (word >> 32) & 0x3FFF, (word >> 46) & 0x3FFF, (word >> 60) & 0xF
        if sign > 1:
            note(state, UNKNOWN, first + index)
            continue
        if column >= width or row >= height:
            note(state, OUT_OF_RANGE, first + index)
            continue
        if clock - stamp > 0x80000000:  # 32 bits of microseconds turn over after 71 minutes
            base += 0x100000000
        clock = stamp
        time = base + stamp
        if time < newest:
            note(state, BACKWARDS, first + index)
        newest = time
        t_us[count] = time
        x[count] = column
        y[count] = row
        p[count] = sign == 1
        count += 1
    state[CLOCK], state[NEWEST], state[BASE] = clock, newest, base
    return count


@njit(cache=True)
def _unpack(words, base, t_us, x, y, p):
    """Split words into columns, then look at the columns; every loop becomes vector code.

    Returns the largest x and y, the bits that any polarity has, and whether the times ascend.
    """
    bits = np.int64(0)
    for index in range(len(words)):
        word = words[index]
        t_us[index] = base + (word & 0xFFFFFFFF)
        x[index] = (word >> 32) & 0x3FFF
        y[index] = (word >> 46) & 0x3FFF
        p[index] = ((word >> 60) & 0xF) != 0
        bits |= word
    largest_x, largest_y = np.uint16(0), np.uint16(0)
    for index in range(len(words)):
        largest_x = max(largest_x, x[index])
    for index in range(len(words)):
        largest_y = max(largest_y, y[index])
    return largest_x, largest_y, (bits >> 60) & 0xF, is_ascending(t_us)


@njit(cache=True)
def decode_dat(words, state, t_us, x, y, p, width, height):
    """Decode a block: quickly, and once more with care where a chunk holds anything unusual."""
    count = 0
    for first in range(0, len(words), CHUNK):
        chunk = words[first : first + CHUNK]
        size = len(chunk)
        out = (
            t_us[count : count + size],
            x[count : count + size],
            y[count : count + size],
            p[count : count + size],
        )
        base = state[BASE]
        largest_x, largest_y, signs, ascend = _unpack(chunk, base, *out)
        if ascend and t_us[count] >= state[NEWEST] and largest_x < width and largest_y < height and signs <= 1:
            state[NEWEST] = t_us[count + size - 1]
            state[CLOCK] = state[NEWEST] - base
            count += size
        else:
            count += _decode_carefully(chunk, first, state, *out, width, height)
    return count


_CODEC = WordCodec(np.dtype("<i8"), _bound, decode_dat, 60)


class DatSource(WordSource):
    """An open DAT file of version 2."""

    def __init__(self, path: Path, report: ReadReport, width: int | None, height: int | None) -> None:
        report.format = "DAT"
        with path.open("rb") as file:
            header = read_raw_header(file, report)
            event = file.read(2)
        if len(event) < 2:
            raise unreadable(path, header.size, "a DAT file that ends after its header", "copy it again")
        version = header.integer("version", report)
        if version not in (None, 2):
            raise unreadable(
                path, 0, f"DAT of version {version}", "version 2 is read: convert it to RAW or HDF5"
            )
        if event[0] not in _EVENT_TYPES or event[1] != _EVENT_SIZE:
            found = f"events of type {event[0]} and {event[1]} bytes"
            raise unreadable(path, header.size, found, "types 0 and 12 of 8 bytes are read")
        raw_geometry(header, report, width, height, _MAX_SIDE)
        super().__init__(path, _CODEC, header.size + 2, report)


SIGNATURE = b"Event Stream"
_HEADER_BYTES = 20
_EVENT_BYTES = 5
_BLOCK_BYTES = 1 << 20
_TYPES = ("generic", "DVS", "ATIS", "display", "colour")
_DVS = 1
_SALVAGE = f"the file is damaged there: {SALVAGE}"
TIME, OUTSIDE, FIRST_OUTSIDE = range(3)  # slots of the state


@njit(cache=True)
def decode_es(data, state, t_us, x, y, p, width, height):
    """Decode whole events; return their number and the bytes that were used."""
    at, count, time = 0, 0, state[TIME]
    while at < len(data):
        first = data[at]
        if first == 255:
            time += 127
            at += 1
        elif first == 254:
            at += 1
        elif at + 5 > len(data):
            break
        else:
            time += first >> 1
            column = np.int64(data[at + 1]) | (np.int64(data[at + 2]) << 8)
            row = np.int64(data[at + 3]) | (np.int64(data[at + 4]) << 8)
            if column < width and row < height:
                t_us[count] = time
                x[count] = column
                y[count] = height - 1 - row
                p[count] = (first & 1) == 1
                count += 1
            else:
                if state[OUTSIDE] == 0:
                    state[FIRST_OUTSIDE] = at
                state[OUTSIDE] += 1
            at += 5
    state[TIME] = time
    return count, at


class EsSource:
    """An open Event Stream file of DVS events."""

    def __init__(self, path: Path, report: ReadReport, width: int | None, height: int | None) -> None:
        self.path, self.report = path, report
        report.format = "ES"
        with path.open("rb") as file:
            header = file.read(_HEADER_BYTES)
        if len(header) < _HEADER_BYTES:
            raise unreadable(
                path, 0, f"an ES header of {len(header)} bytes", "20 are needed: copy the file again"
            )
        if header[12] != 2:
            raise unreadable(path, 12, f"ES of version {header[12]}", "version 2 is read: convert it to HDF5")
        if header[15] != _DVS:
            kind = _TYPES[header[15]] if header[15] < len(_TYPES) else str(header[15])
            raise unreadable(path, 15, f"an ES file of {kind} events", "DVS events are read")
        size = int.from_bytes(header[16:18], "little"), int.from_bytes(header[18:20], "little")
        if width is None:
            report.set_geometry(*size, "header", offset=16)
        else:
            report.set_geometry(width, height, "caller")

    def blocks(self) -> Iterator[Columns]:
        """Yield the events of about a megabyte at a time."""
        report = self.report
        state = np.zeros(3, np.int64)
        offset, tail = _HEADER_BYTES, b""
        with self.path.open("rb") as file:
            file.seek(offset)
            while data := file.read(_BLOCK_BYTES):
                text = tail + data
                out = allocate(len(text) // _EVENT_BYTES + 1)
                count, used = decode_es(
                    np.frombuffer(text, np.uint8), state, out["t_us"], out["x"], out["y"], out["p"],
                    report.width, report.height,
                )  # fmt: skip
                if state[OUTSIDE]:
                    found = "an event outside the sensor"
                    cure = f"the sensor is {report.width} x {report.height}: {_SALVAGE}"
                    place = offset + int(state[FIRST_OUTSIDE])
                    report.fault("out_of_range", place, found, cure, count=int(state[OUTSIDE]))
                    state[OUTSIDE] = 0
                offset += used
                tail = text[used:]
                yield cut(out, 0, count)
        if tail:
            found = f"the file ends {len(tail)} bytes into an event of {_EVENT_BYTES}"
            cure = f"the file was cut: copy it again or {SALVAGE}"
            report.fault("truncated", offset, found, cure, lost_bytes=len(tail))

    def read(self) -> Columns:
        """Return all events."""
        return join(list(self.blocks()))
