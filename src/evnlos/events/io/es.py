"""Event Stream (`.es`) version 2, the DVS type: five bytes an event, of which the first holds time and
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

from evnlos.events.io.columns import Columns, allocate, cut, join
from evnlos.events.io.report import ReadReport, unreadable

SIGNATURE = b"Event Stream"
_HEADER_BYTES = 20
_EVENT_BYTES = 5
_BLOCK_BYTES = 1 << 20
_TYPES = ("generic", "DVS", "ATIS", "display", "colour")
_DVS = 1
_SALVAGE = 'the file is damaged there: read it with on_error="salvage"'
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
            cure = 'the file was cut: copy it again or read it with on_error="salvage"'
            report.fault("truncated", offset, found, cure, lost_bytes=len(tail))

    def read(self) -> Columns:
        """Return all events."""
        return join(list(self.blocks()))
