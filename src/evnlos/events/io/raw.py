"""Prophesee RAW files: which of EVT2, EVT2.1 and EVT3 a header names, reading and writing them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evnlos.errors import DataError
from evnlos.events.io import evt2, evt3
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
    "EVT2": WordCodec(np.dtype("<u4"), evt2.bound_evt2, evt2.decode_evt2),
    "EVT3": WordCodec(np.dtype("<u2"), evt3.bound_evt3, evt3.decode_evt3, one_event_a_word=False),
}
_ENCODERS = {
    "EVT2": ("2.0", np.dtype("<u4"), evt2.WRAP_US, evt2.encoded_size_evt2, evt2.encode_evt2),
    "EVT3": ("3.0", np.dtype("<u2"), evt3.WRAP_US, evt3.encoded_size_evt3, evt3.encode_evt3),
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
        super().__init__(path, CODECS[name], header.size, report, header.integer("t0", report) or 0)
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


def _announced_events(header: RawHeader, report: ReadReport) -> int | None:
    return header.integer("events", report)


def write_raw(path: Path, events: Events, format: str) -> None:
    """Write a RAW file of `format` "EVT2" or "EVT3"; `path` is overwritten."""
    version, dtype, wrap_us, encoded_size, encode = _ENCODERS[format]
    if max(events.width, events.height) > _MAX_SIDE:
        raise DataError(
            f"{format} holds sensors up to {_MAX_SIDE} x {_MAX_SIDE}, not {events.width} x {events.height}; "
            "write .h5 or .npz"
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
