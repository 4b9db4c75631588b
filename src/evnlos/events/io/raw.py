"""Prophesee RAW files: which of EVT2, EVT2.1 and EVT3 a header names, and reading them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from evnlos.events.io import evt2, evt3, evt21
from evnlos.events.io.raw_header import (
    RawHeader,
    parse_raw_header,
    raw_format_names,
    raw_geometry,
    read_raw_header,
)
from evnlos.events.io.report import ReadReport
from evnlos.events.io.words import WordCodec, WordSource

CODECS = {
    "EVT2": WordCodec(np.dtype("<u4"), evt2.bound_evt2, evt2.decode_evt2, 28),
    "EVT21": WordCodec(np.dtype("<i8"), evt21.bound_evt21, evt21.decode_evt21, 60, most_events=32),
    "EVT3": WordCodec(np.dtype("<u2"), evt3.bound_evt3, evt3.decode_evt3, 12, most_events=12),
}
_SWAPPED_EVT21 = WordCodec(
    np.dtype("<i8"), evt21.bound_evt21_swapped, evt21.decode_evt21_swapped, 28, most_events=32
)
_MAX_SIDE = 2048


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
                'repair the header or read with on_error="salvage"',
            )
        name = next(name for name in names if name in CODECS)
        report.format = name
        raw_geometry(header, report, width, height, _MAX_SIDE)
        self.is_swapped = name == "EVT21" and _is_swapped(path, header)
        codec = _SWAPPED_EVT21 if self.is_swapped else CODECS[name]
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
            self.report.fault(kind, size, found, 'copy the file again or read it with on_error="salvage"')


def _is_swapped(path: Path, header: RawHeader) -> bool:
    """Return whether the halves of EVT2.1 words are exchanged: as the header says, else as they look."""
    found = header.find("format")
    stated = re.search(r"endianness=(\w+)", found[0]) if found else None
    if stated:
        return stated[1] == "legacy"
    with path.open("rb") as file:
        file.seek(header.size)
        start = file.read(8 * 4096)
    return evt21.looks_swapped(np.frombuffer(start[: len(start) // 8 * 8], "<i8"))


def _announced_events(header: RawHeader, report: ReadReport) -> int | None:
    return header.integer("events", report)
