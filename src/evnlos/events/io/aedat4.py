"""AEDAT4, the format of iniVation's cameras, read through the optional package `aedat`."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from evnlos.errors import EventFileError, MissingDependencyError
from evnlos.events.io.columns import ColumnCheck, Columns, join
from evnlos.events.io.report import ReadReport, unreadable

SIGNATURE = b"#!AER-DAT4.0\r\n"
_CURE = "the file is damaged or not complete: copy it again"


def _decoder_class() -> Any:
    try:
        import aedat
    except ImportError:
        raise MissingDependencyError(
            "reading AEDAT4 needs the package aedat: pip install evnlos[aedat], "
            "or convert the file elsewhere to HDF5 (DSEC columns), NPZ or RAW"
        ) from None
    return aedat.Decoder


@contextmanager
def _aedat_errors(path: Path) -> Iterator[None]:
    """Turn what the decoder raises, its panics among them, into one error."""
    try:
        yield
    except (EventFileError, MissingDependencyError):
        raise
    except BaseException as error:
        panic = type(error).__name__ == "PanicException"  # derives from BaseException on purpose
        if not panic and not isinstance(error, Exception):
            raise
        found = " ".join(str(error).split())[:160]
        raise unreadable(path, 0, f"AEDAT4 cannot be decoded ({found})", _CURE) from None


def check_packets(path: Path, report: ReadReport) -> None:
    """Walk the packets' lengths from the header to the data table, which shows where a file was cut."""
    size = path.stat().st_size
    with path.open("rb") as file:
        start = len(SIGNATURE)
        file.seek(start)
        prefix = file.read(4)
        length = struct.unpack("<I", prefix)[0] if len(prefix) == 4 else 0
        if length < 16 or start + 4 + length > size:
            raise unreadable(path, start, f"a header of {length} bytes in a file of {size}", _CURE)
        end = _data_table_position(file.read(length))
        if end is None:
            end = size
        at = start + 4 + length
        if not at <= end <= size:
            raise unreadable(path, start, f"a data table at byte {end} of {size}", _CURE)
        while at < end:
            file.seek(at)
            head = file.read(8)
            length = struct.unpack("<ii", head)[1] if len(head) == 8 else -1
            if length < 0 or at + 8 + length > end:
                raise unreadable(path, at, f"a packet of {length} bytes, {end - at} are left", _CURE)
            at += 8 + length


def _data_table_position(header: bytes) -> int | None:
    """Return the second field of the header's flat buffer, None where it is absent or -1."""
    try:
        root = struct.unpack_from("<I", header, 0)[0]
        vtable = root - struct.unpack_from("<i", header, root)[0]
        if vtable < 0 or struct.unpack_from("<H", header, vtable)[0] < 8:
            return None
        field = struct.unpack_from("<H", header, vtable + 6)[0]
        position = struct.unpack_from("<q", header, root + field)[0] if field else -1
    except struct.error:
        return 2**63 - 1  # outside every file: the caller reports it
    return None if position < 0 else position


class Aedat4Source:
    """The first event stream of an AEDAT4 file."""

    def __init__(self, path: Path, report: ReadReport, width: int | None, height: int | None) -> None:
        self.path, self.report = path, report
        report.format = "AEDAT4"
        self._class = _decoder_class()
        check_packets(path, report)
        with _aedat_errors(path):
            streams = self._class(str(path)).id_to_stream()
        chosen = [(number, stream) for number, stream in streams.items() if stream.get("type") == "events"]
        if not chosen:
            raise unreadable(path, 0, "an AEDAT4 file without an event stream", "record events as well")
        self._stream, stream = chosen[0]
        if width is not None:
            report.set_geometry(width, height, "caller")
        else:
            report.set_geometry(stream["width"], stream["height"], "header")

    def blocks(self) -> Iterator[Columns]:
        """Yield the columns packet by packet."""
        check = ColumnCheck(self.report)
        with _aedat_errors(self.path):
            for packet in self._class(str(self.path)):
                if packet["stream_id"] != self._stream or "events" not in packet:
                    continue
                events = packet["events"]
                yield check(
                    {
                        "t_us": events["t"].astype(np.int64),
                        "x": np.ascontiguousarray(events["x"]),
                        "y": np.ascontiguousarray(events["y"]),
                        "p": np.ascontiguousarray(events["on"]),
                    }
                )

    def read(self) -> Columns:
        """Return all events of the stream."""
        return join(list(self.blocks()))
