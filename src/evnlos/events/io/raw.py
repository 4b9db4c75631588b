"""Prophesee RAW files: which of EVT2, EVT2.1 and EVT3 a header names, reading and writing them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from evnlos.errors import DataError
from evnlos.events.io import evt2, evt3, evt3_encode, evt21
from evnlos.events.io.raw_header import (
    RawHeader,
    parse_raw_header,
    raw_format_names,
    raw_geometry,
    read_raw_header,
    write_raw_header,
)
from evnlos.events.io.report import ReadReport
from evnlos.events.io.words import WordCodec, WordSource
from evnlos.types import Events

CODECS = {
    "EVT2": WordCodec(np.dtype("<u4"), evt2.bound_evt2, evt2.decode_evt2, 28),
    "EVT21": WordCodec(np.dtype("<i8"), evt21.bound_evt21, evt21.decode_evt21, 60, most_events=32),
    "EVT3": WordCodec(np.dtype("<u2"), evt3.bound_evt3, evt3.decode_evt3, 12, most_events=12),
}
_SWAPPED_EVT21 = WordCodec(
    np.dtype("<i8"), evt21.bound_evt21_swapped, evt21.decode_evt21_swapped, 28, most_events=32
)
_ENCODERS = {
    "EVT2": ("2.0", np.dtype("<u4"), evt2.WRAP_US, evt2.encoded_size_evt2, evt2.encode_evt2),
    "EVT21": ("2.1", np.dtype("<i8"), evt21.WRAP_US, evt21.encoded_size_evt21, evt21.encode_evt21),
    "EVT3": ("3.0", np.dtype("<u2"), evt3.WRAP_US, evt3_encode.encoded_size_evt3, evt3_encode.encode_evt3),
}
_MAX_SIDE = 2048
_MAX_TURNS = 1 << 16


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
        codec = CODECS[name]
        if name == "EVT21" and _is_swapped(path, header):
            codec = _SWAPPED_EVT21
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


def write_raw(path: Path, events: Events, format: str) -> None:
    """Write a RAW file of `format` "EVT2", "EVT21" or "EVT3"; intensities are left out."""
    version, dtype, wrap_us, encoded_size, encode = _ENCODERS[format]
    if max(events.width, events.height) > _MAX_SIDE:
        raise DataError(
            f"{format} holds sensors up to {_MAX_SIDE} x {_MAX_SIDE}, not {events.width} x {events.height}; "
            "write .h5 or .npz"
        )
    if events.polarity_known is not None and not events.polarity_known.all():
        raise DataError(
            f"{format} has no mark for an unknown polarity; use keep_known_polarity(events) first, or write .h5"
        )
    first = int(events.t_us[0]) if len(events) else 0
    t0_us = first - first % wrap_us
    if len(events):
        turns = (int(events.t_us[-1]) - t0_us) // wrap_us
        if turns > _MAX_TURNS:
            raise DataError(
                f"{format} would turn its clock {turns} times over {events.duration_us} us, at most "
                f"{_MAX_TURNS} are written; write .h5 or .npz"
            )
    t_us = events.t_us - t0_us
    words = np.empty(encoded_size(t_us), dtype)
    count = encode(t_us, events.x, events.y, events.p, words)
    header = write_raw_header(format, version, events.width, events.height, t0_us, len(events))
    with path.open("wb") as file:
        file.write(header)
        words[:count].tofile(file)
