"""Prophesee RAW files: header, reading and writing.

- The text header of Prophesee files: lines that start with a per cent sign.
- Prophesee RAW files: which of EVT2, EVT2.1 and EVT3 a header names, and reading them.
- Writing Prophesee RAW files piece by piece.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from evnlos.errors import DataError
from evnlos.events.files import evt2, evt3
from evnlos.events.files import word_write as write
from evnlos.events.files.columns import SALVAGE, FileSink, ReadReport
from evnlos.events.files.words import WordCodec, WordSource
from evnlos.types import Events

_MAX_HEADER_BYTES = 65_536
_MAX_SIDE = 2048  # coordinates of every Prophesee format have 11 bits, DAT has 14
_LOG = logging.getLogger("evnlos")

# Sensor generations by the words that their plug-ins and headers use: width, height.
_CAMERAS = (
    (re.compile(r"gen3(?!\d)|gen31|psee_?vga", re.I), (640, 480)),
    (re.compile(r"gen4|imx636|evk4|evk3_hd|_hd\b", re.I), (1280, 720)),
    (re.compile(r"genx320", re.I), (320, 320)),
    (re.compile(r"atis|gen1|gen2", re.I), (304, 240)),
)
_USUAL_SENSOR = (1280, 720)


@dataclass(frozen=True)
class RawHeader:
    """The header of a RAW or DAT file.

    Args:
        entries: (key, value, byte offset) of each line, keys in lower case.
        size: Length of the header, bytes.
    """

    entries: tuple[tuple[str, str, int], ...]
    size: int
    faults: tuple[tuple[int, str], ...] = field(default=())

    def find(self, key: str) -> tuple[str, int] | None:
        """Return the value and byte offset of the first line with `key`."""
        for name, value, offset in self.entries:
            if name == key:
                return value, offset
        return None

    def integer(self, key: str, report: ReadReport) -> int | None:
        """Return the whole number that a line gives, None where it is absent or damaged."""
        found = self.find(key)
        if found is None:
            return None
        value, offset = found
        if not re.fullmatch(r"[+-]?\d{1,19}", value) or not -(2**63) <= int(value) < 2**63:
            report.fault(
                "header", offset, f"header line {key!r} says {value[:40]!r}", "a whole number belongs there"
            )
            return None
        return int(value)


def parse_raw_header(start: bytes) -> RawHeader:
    """Return the header at the start of a file; `start` holds its first bytes (64 KiB suffice)."""
    entries: list[tuple[str, str, int]] = []
    faults: list[tuple[int, str]] = []
    offset = 0
    while start[offset : offset + 2] in (b"% ", b"%\n", b"%\r") and offset < _MAX_HEADER_BYTES:
        end = start.find(b"\n", offset)
        if end < 0:
            break
        line = start[offset + 1 : end].strip()
        if any(byte < 9 or 13 < byte < 32 or byte == 127 for byte in line):
            faults.append((offset, f"control characters in the header line {line[:40]!r}"))
        key, _, value = line.decode("latin-1").partition(" ")
        if key:
            entries.append((key.lower(), value.strip(), offset))
        offset = end + 1
        if key.lower() == "end" and not value:
            break
    return RawHeader(tuple(entries), offset, tuple(faults))


def read_raw_header(file: BinaryIO, report: ReadReport) -> RawHeader:
    """Read the header of an open file, leave the file at its first byte of data, report damaged lines."""
    file.seek(0)
    header = parse_raw_header(file.read(_MAX_HEADER_BYTES))
    for offset, found in header.faults:
        report.fault("header", offset, found, f"repair the header or {SALVAGE}")
    file.seek(header.size)
    return header


def raw_format_names(header: RawHeader) -> tuple[str, ...]:
    """Return the formats that the header names, such as ("EVT3",); more than one contradict each other."""
    names = []
    found = header.find("evt")
    if found:
        version = re.fullmatch(r"(\d)(?:\.(\d))?", found[0])
        if version:
            names.append("EVT" + version[1] + ("" if version[2] in (None, "0") else version[2]))
    found = header.find("format")
    if found:
        name = found[0].split(";")[0].strip().upper().replace(".", "")
        names.append({"EVT20": "EVT2", "EVT30": "EVT3"}.get(name, name))
    return tuple(dict.fromkeys(names))


def _stated_sizes(header: RawHeader, report: ReadReport) -> list[tuple[int, int, int]]:
    """Return every (width, height, byte offset) that the header states."""
    sizes = []
    found = header.find("geometry")
    if found:
        match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", found[0])
        if match:
            sizes.append((int(match[1]), int(match[2]), found[1]))
        else:
            report.fault("header", found[1], f"geometry says {found[0][:40]!r}", "WIDTHxHEIGHT belongs there")
    found = header.find("format")
    if found:
        width = re.search(r"width=(\d{1,5})(?:;|$)", found[0])
        height = re.search(r"height=(\d{1,5})(?:;|$)", found[0])
        if width and height:
            sizes.append((int(width[1]), int(height[1]), found[1]))
    width, height = header.integer("width", report), header.integer("height", report)
    if width is not None and height is not None:
        sizes.append((width, height, 0))
    return sizes


def raw_geometry(
    header: RawHeader, report: ReadReport, width: int | None, height: int | None, max_side: int = _MAX_SIDE
) -> None:
    """Put the sensor size and its origin into the report: the caller's, the header's, the camera's."""
    if width is not None and height is not None:
        return report.set_geometry(width, height, "caller")
    for stated_width, stated_height, offset in _stated_sizes(header, report):
        if not (1 <= stated_width <= max_side and 1 <= stated_height <= max_side):
            report.fault(
                "header",
                offset,
                f"a sensor of {stated_width} x {stated_height}",
                f"sides run from 1 to {max_side}; give width= and height=",
            )
        elif not report.geometry_from:
            report.width, report.height, report.geometry_from = stated_width, stated_height, "header"
        elif (report.width, report.height) != (stated_width, stated_height):
            report.fault(
                "header",
                offset,
                f"a sensor of {stated_width} x {stated_height} after one of {report.width} x {report.height}",
                "give width= and height=",
            )
    return None if report.geometry_from else _guess_geometry(header, report)


def _guess_geometry(header: RawHeader, report: ReadReport) -> None:
    """Take the size from the camera's name, else the usual sensor, and say so."""
    text = " ".join(value for key, value, _ in header.entries if key not in ("date", "serial_number"))
    for pattern, (width, height) in _CAMERAS:
        if pattern.search(text):
            report.width, report.height, report.geometry_from = width, height, "camera"
            return
    report.width, report.height = _USUAL_SENSOR
    report.geometry_from = "assumed"
    _LOG.warning(
        "%s: the header names no sensor size; took %d x %d, give width= and height= if that is wrong",
        report.path,
        *_USUAL_SENSOR,
    )


def write_raw_header(format_name: str, version: str, width: int, height: int, t0_us: int, events: int) -> bytes:
    """Return the header of a RAW file; the number of events lets a reader see that a file was cut.

    Its length does not depend on that number, so that it can be written again when all events are.
    """
    layout = "endianness=little;" if format_name == "EVT21" else ""
    lines = [
        f"evt {version}",
        f"format {format_name};{layout}width={width};height={height}",
        f"geometry {width}x{height}",
        f"t0 {t0_us}",
        f"events {events:<19}",
        "end",
    ]
    return "".join(f"% {line}\n" for line in lines).encode("ascii")


CODECS = {
    "EVT2": WordCodec(np.dtype("<u4"), evt2.bound_evt2, evt2.decode_evt2, 28),
    "EVT21": WordCodec(np.dtype("<i8"), evt2.bound_evt21, evt2.decode_evt21, 60, most_events=32),
    "EVT3": WordCodec(np.dtype("<u2"), evt3.bound_evt3, evt3.decode_evt3, 12, most_events=12),
}
_SWAPPED_EVT21 = WordCodec(
    np.dtype("<i8"), evt2.bound_evt21_swapped, evt2.decode_evt21_swapped, 28, most_events=32
)


def sniff_raw(start: bytes) -> str | None:
    """Return the format that a RAW header names, or None."""
    if not start.startswith(b"%"):
        return None
    names = raw_format_names(parse_raw_header(start))
    return next((name for name in names if name in CODECS), None)


class RawSource(WordSource):
    """An open RAW file."""

    def __init__(self, path: Path, report: ReadReport, width: int | None, height: int | None) -> None:
        with path.open("rb") as file:
            header = read_raw_header(file, report)
        names = raw_format_names(header)
        if len(names) > 1:
            report.fault(
                "header",
                0,
                f"the header names {' and '.join(names)}",
                f"repair the header or {SALVAGE}",
            )
        name = next(name for name in names if name in CODECS)
        report.format = name
        raw_geometry(header, report, width, height, _MAX_SIDE)
        with path.open("rb") as file:
            file.seek(header.size)
            codec = raw_codec(name, header, file.read(_LOOK_BYTES))
        self.is_swapped = codec is _SWAPPED_EVT21
        super().__init__(path, codec, header.size, report, header.integer("t0", report) or 0)
        self._announced = _announced_events(header, report)
        self._decoded = 0

    def _decode(self, words, first, columns, at) -> int:
        count = super()._decode(words, first, columns, at)
        self._decoded += count
        return count

    def _finish(self) -> None:
        super()._finish()
        if self._announced is not None and self._announced != self._decoded and self.report.clean:
            size = self.path.stat().st_size
            kind = "truncated" if self._decoded < self._announced else "count"
            found = f"{self._decoded} events where the header announces {self._announced}"
            self.report.fault(kind, size, found, f"copy the file again or {SALVAGE}")


_LOOK_BYTES = 8 * 4096


def raw_codec(name: str, header: RawHeader, data: bytes) -> WordCodec:
    """Return how words are decoded; halves of EVT2.1 words are exchanged as the header says or as they look.

    Args:
        name: "EVT2", "EVT21" or "EVT3".
        header: The header before the words.
        data: The first of the words, 32 KiB suffice.
    """
    found = header.find("format")
    stated = re.search(r"endianness=(\w+)", found[0]) if found else None
    if stated:
        is_swapped = stated[1] == "legacy"
    else:
        data = data[: len(data) // 8 * 8]
        is_swapped = name == "EVT21" and evt2.looks_swapped(np.frombuffer(data, "<i8"))
    return _SWAPPED_EVT21 if is_swapped and name == "EVT21" else CODECS[name]


def _announced_events(header: RawHeader, report: ReadReport) -> int | None:
    return header.integer("events", report)


_MAX_TURNS = 1 << 16


@dataclass(frozen=True)
class _Encoder:
    """How events become the words of one format; the clock turns over after `wrap_us`."""

    version: str
    dtype: np.dtype
    wrap_us: int
    high_us: int
    size: Callable[..., int]
    encode: Callable[..., int]


_ENCODERS = {
    "EVT2": _Encoder("2.0", np.dtype("<u4"), evt2.WRAP_US, 1 << 6, write.encoded_size_evt2, write.encode_evt2),
    "EVT21": _Encoder(
        "2.1", np.dtype("<i8"), evt2.WRAP_US, 1 << 6, write.encoded_size_evt21, write.encode_evt21
    ),
    "EVT3": _Encoder("3.0", np.dtype("<u2"), evt3.WRAP_US, 1 << 12, write.encoded_size_evt3, write.encode_evt3),
}


class RawSink(FileSink):
    """A RAW file of "EVT2", "EVT21" or "EVT3" that grows; intensities are left out."""

    def __init__(self, path: Path, first: Events, format: str) -> None:
        if max(first.width, first.height) > _MAX_SIDE:
            raise DataError(
                f"{format} holds sensors up to {_MAX_SIDE} x {_MAX_SIDE}, not {first.width} x {first.height}; "
                "write .h5 or .npz"
            )
        super().__init__(path)
        self._format, self._encoder = format, _ENCODERS[format]
        start = int(first.t_us[0]) if len(first) else 0
        self._t0_us = start - start % self._encoder.wrap_us
        self._size = (first.width, first.height)
        self._events, self._last, self._high = 0, 0, -1  # last is the time before, since t0
        self.file.write(self._header())

    def _header(self) -> bytes:
        return write_raw_header(self._format, self._encoder.version, *self._size, self._t0_us, self._events)

    def append(self, events: Events) -> None:
        """Write the words of a piece."""
        if events.polarity_known is not None and not events.polarity_known.all():
            raise DataError(
                f"{self._format} has no mark for an unknown polarity; use keep_known_polarity(events) first, "
                "or write .h5"
            )
        if not len(events):
            return
        turns = (int(events.t_us[-1]) - self._t0_us) // self._encoder.wrap_us
        if turns > _MAX_TURNS:
            raise DataError(
                f"{self._format} would turn its clock {turns} times, at most {_MAX_TURNS} are written; "
                "write .h5 or .npz"
            )
        t_us = events.t_us - self._t0_us
        words = np.empty(self._encoder.size(t_us, self._last), self._encoder.dtype)
        count = self._encoder.encode(t_us, events.x, events.y, events.p, self._high, words)
        self.file.write(words[:count].data)
        self._last = int(t_us[-1])
        self._high = self._last // self._encoder.high_us
        self._events += len(events)

    def finish(self) -> None:
        """Announce the number of events in the header."""
        self.file.seek(0)
        self.file.write(self._header())
