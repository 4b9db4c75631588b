"""Writing Prophesee RAW files piece by piece."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evnlos.errors import DataError
from evnlos.events.io import evt2, evt3, evt3_encode, evt21
from evnlos.events.io.raw_header import write_raw_header
from evnlos.events.io.sink import FileSink
from evnlos.types import Events

_MAX_SIDE = 2048
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
    "EVT2": _Encoder("2.0", np.dtype("<u4"), evt2.WRAP_US, 1 << 6, evt2.encoded_size_evt2, evt2.encode_evt2),
    "EVT21": _Encoder(
        "2.1", np.dtype("<i8"), evt21.WRAP_US, 1 << 6, evt21.encoded_size_evt21, evt21.encode_evt21
    ),
    "EVT3": _Encoder(
        "3.0", np.dtype("<u2"), evt3.WRAP_US, 1 << 12, evt3_encode.encoded_size_evt3, evt3_encode.encode_evt3
    ),
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
        words[:count].tofile(self.file)
        self._last = int(t_us[-1])
        self._high = self._last // self._encoder.high_us
        self._events += len(events)

    def finish(self) -> None:
        """Announce the number of events in the header."""
        self.file.seek(0)
        self.file.write(self._header())
