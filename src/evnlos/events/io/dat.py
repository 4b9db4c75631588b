"""DAT, Prophesee's decoded events: a text header, two bytes, then 8 bytes an event; only read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.events.io.kernel_state import BACKWARDS, BASE, CHUNK, CLOCK, NEWEST, OUT_OF_RANGE, UNKNOWN, note
from evnlos.events.io.raw_header import parse_raw_header, raw_format_names, raw_geometry, read_raw_header
from evnlos.events.io.report import ReadReport, unreadable
from evnlos.events.io.words import WordCodec, WordSource

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
    backwards = False
    for index in range(1, len(words)):
        backwards |= t_us[index] < t_us[index - 1]
    return largest_x, largest_y, (bits >> 60) & 0xF, not backwards


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
