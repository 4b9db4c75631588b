"""AEDAT4, the format of iniVation's cameras, read through the optional package `aedat`."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import EventFileError, MissingDependencyError
from evnlos.events.io.columns import ColumnCheck, Columns, join
from evnlos.events.io.report import ReadReport, unreadable
from evnlos.untrusted import Child

SIGNATURE = b"#!AER-DAT4.0\r\n"
_CHILD_BYTES = 2 << 30  # address space of numpy and the package
_MAX_RATIO = 300  # LZ4 expands at most 255 times
_CURE = "the file is damaged or not complete: copy it again"


def _require_package() -> None:
    try:
        import aedat  # noqa: F401
    except ImportError:
        raise MissingDependencyError(
            "reading AEDAT4 needs the package aedat: pip install evnlos[aedat], "
            "or convert the file elsewhere to HDF5 (DSEC columns), NPZ or RAW"
        ) from None


class _Decoder(Child):
    """The package at work in a process of its own, whose memory and time grow with the file only."""

    def __init__(self, path: Path, kind: str) -> None:
        self._path = path
        size = path.stat().st_size
        limits = [str(_CHILD_BYTES + _MAX_RATIO * size), str(30 + size // 500_000)]
        super().__init__(Path(__file__).with_name("_aedat4_child.py"), [str(path.absolute()), *limits, kind])

    def stream_size(self) -> tuple[int, int] | None:
        """Return width and height of the stream, None where there is none; the first thing to take."""
        size = self.take_json()
        return None if size is None else (size[0], size[1])

    def failure(self, found: str) -> EventFileError:
        """Return the error of a decoder that stopped before the end of the file."""
        return unreadable(self._path, 0, f"AEDAT4 cannot be decoded ({found})", _CURE)


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
        _require_package()
        check_packets(path, report)
        if width is not None:
            report.set_geometry(width, height, "caller")

    def _read_size(self, decoder: _Decoder) -> None:
        size = decoder.stream_size()
        if size is None:
            raise unreadable(self.path, 0, "an AEDAT4 file without an event stream", "record events as well")
        if not self.report.geometry_from:
            self.report.set_geometry(size[0], size[1], "header")

    def blocks(self) -> Iterator[Columns]:
        """Yield the columns packet by packet."""
        check = ColumnCheck(self.report)
        with _Decoder(self.path, "events") as decoder:
            self._read_size(decoder)
            while True:
                count = struct.unpack("<q", decoder.take(8))[0]
                if count < 0:
                    return
                data = decoder.take(13 * count)
                times = np.frombuffer(data, "<i8", count)
                x, y = (
                    np.frombuffer(data, "<u2", count, 8 * count),
                    np.frombuffer(data, "<u2", count, 10 * count),
                )
                yield check(
                    {"t_us": times, "x": x, "y": y, "p": np.frombuffer(data, np.bool_, count, 12 * count)}
                )

    def read(self) -> Columns:
        """Return all events of the stream."""
        return join(list(self.blocks()))


def read_aedat4_frames(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Return the pictures of the first frame stream as grey [T, H, W], and their times [T], microseconds.

    Raises:
        EventFileError: The file is damaged, has no frames, or frames of several sizes.
        MissingDependencyError: The package `aedat` is not installed.
    """
    _require_package()
    check_packets(path, ReadReport(path))
    frames: list[NDArray[np.uint8]] = []
    times: list[int] = []
    with _Decoder(path, "frame") as decoder:
        if decoder.stream_size() is None:
            raise unreadable(path, 0, "an AEDAT4 file without frames", "record frames as well")
        while True:
            t_us = struct.unpack("<q", decoder.take(8))[0]
            if t_us == -1:
                break
            height, width, channels = struct.unpack("<3q", decoder.take(24))
            pixels = np.frombuffer(decoder.take(height * width * channels), np.uint8)
            frames.append(_grey(pixels.reshape(height, width, channels)))  # [H, W]
            times.append(t_us)
            if frames[-1].shape != frames[0].shape:
                found = (
                    f"a frame of {width} x {height} pixels after {frames[0].shape[1]} x {frames[0].shape[0]}"
                )
                raise unreadable(path, 0, found, "record frames of one size")
    if not frames:
        raise unreadable(path, 0, "an AEDAT4 file whose frame stream is empty", "record frames as well")
    return np.stack(frames), np.array(times, np.int64)


def _grey(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return [H, W] of [H, W, channels]: grey as it is, colours by ITU-R BT.601, transparency left out."""
    if pixels.shape[2] < 3:
        return pixels[:, :, 0]
    weights = np.array([0.299, 0.587, 0.114])
    return np.round(pixels[:, :, :3] @ weights).astype(np.uint8)
