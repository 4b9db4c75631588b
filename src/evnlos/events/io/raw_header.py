"""The text header of Prophesee files: lines that start with a per cent sign."""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass, field
from typing import BinaryIO

from evnlos.events.io.report import ReadReport

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
        report.fault("header", offset, found, 'repair the header or read with on_error="salvage"')
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
