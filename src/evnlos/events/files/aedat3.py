"""AEDAT 3.1, written by cAER: a text header, then packets of one kind of event each.

A packet is 28 bytes of header, then events of one size. Polarity events are libcaer's eight bytes; times are 31
bits and a count of their turns. Row 0 is the top. Source: iniVation's page and libcaer's headers.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evnlos.events.files.aedat import read_comments, set_size
from evnlos.events.files.columns import (
    SALVAGE,
    ColumnCheck,
    Columns,
    ReadReport,
    Stream,
    allocate,
    choose_stream,
    collect,
    cut,
    unreadable,
)
from evnlos.events.files.ros_messages import decode_libcaer, grey_of
from evnlos.untrusted import open_regular

SIGNATURE = b"#!AER-DAT3"
_HEAD = struct.Struct("<hhiiiiii")
_SPECIAL, _POLARITY, _FRAME = 0, 1, 2
_FRAME_HEAD = 36
_MOST_PACKET_BYTES = 1 << 27
_MOST_SIDE = 1 << 14
_MOST_TURNS = 1 << 20  # of the clock: 71 years
_CURE = f"the file is damaged or was cut: copy it again or {SALVAGE}"
_EDGES = {2: True, 3: False, 4: True}  # special events at the input: rising, falling, pulse


class _Packet(NamedTuple):
    """A packet: its kind, place in the file, clock, size and number of its events, their bytes."""

    kind: int
    at: int
    turns: int
    size: int
    events: int
    data: bytes


class Aedat3Source:
    """One camera of an AEDAT 3.1 file."""

    def __init__(
        self,
        path: Path,
        report: ReadReport,
        width: int | None,
        height: int | None,
        topic: str | None,
        kind: str = "events",
    ) -> None:
        self.path, self.report = path, report
        report.format = "AEDAT3"
        with open_regular(path) as file:
            lines = read_comments(file)
            self._start = file.tell()
            self._size = file.seek(0, 2)
        if not lines or lines[0].strip() != "#!AER-DAT3.1":
            found = f"AEDAT of version {lines[0][9:20] if lines else '3 without a header'}"
            raise unreadable(path, 0, found, "2.0, 3.1 and 4 are read: convert it with DV or jAER")
        layout = next((line.partition(":")[2].strip() for line in lines if line.startswith("#Format:")), "RAW")
        if layout != "RAW":
            raise unreadable(
                path, 0, f"AEDAT 3.1 in the format {layout[:30]}", "RAW is read: convert it with cAER"
            )
        if lines[-1] != "#!END-HEADER":
            report.fault("header", self._start, "a header without #!END-HEADER", _CURE)
        named = [re.match(r"#Source (\d{1,5}): *(.*)", line) for line in lines]
        sources = {match[1]: match[2].strip() for match in named if match} or {"0": ""}
        report.streams = tuple(Stream(number, "events", name) for number, name in sources.items())
        report.topic = choose_stream(path, report.streams, topic, "events", report.strict).name
        self._number = int(report.topic) if len(sources) > 1 else None
        if kind == "events":
            set_size(report, sources[report.topic], width, height)

    def _packets(self, kinds: tuple[int, ...]) -> Iterator[_Packet]:
        """Yield the packets of some kinds."""
        at = self._start
        with open_regular(self.path) as file:
            while at < self._size:
                file.seek(at)
                head = file.read(_HEAD.size)
                left = self._size - at - _HEAD.size
                if len(head) < _HEAD.size:
                    found = f"the file ends {len(head)} bytes into a packet's header"
                    return self.report.fault("truncated", at, found, _CURE, lost_bytes=len(head))
                kind, source, size, _, turns, capacity, count, valid = _HEAD.unpack(head)
                is_sound = min(size, kind) >= 0 and 0 <= turns < _MOST_TURNS
                if not (is_sound and 0 <= valid <= count <= capacity):
                    found = f"a packet of {count} events of {size} bytes, {valid} of them valid"
                    return self.report.fault("left_over", at, found, _CURE, lost_bytes=left)
                length = size * count
                if length > left:
                    found = f"a packet of {length} bytes, {left} are left"
                    self.report.fault("truncated", at, found, _CURE, lost_bytes=left)
                    count = left // size if size else 0
                    length = left
                if kind in kinds and self._number in (None, source):
                    if size * count > _MOST_PACKET_BYTES:
                        found = f"a packet of {size * count} bytes, at most {_MOST_PACKET_BYTES} are read"
                        raise unreadable(self.path, at, found, "the file is damaged: copy it again")
                    yield _Packet(kind, at + _HEAD.size, turns, size, count, file.read(size * count))
                at += _HEAD.size + length

    def blocks(self) -> Iterator[Columns]:
        """Yield the valid events packet by packet."""
        check = ColumnCheck(self.report)
        for packet in self._packets((_POLARITY, _SPECIAL, _FRAME)):
            if packet.kind == _FRAME:
                self.report.frames += packet.events
                continue
            if packet.kind == _SPECIAL:
                self.report.triggers += len(self._inputs(packet)[0])
                continue
            if packet.size != 8:
                found = f"polarity events of {packet.size} bytes instead of 8"
                self.report.fault("left_over", packet.at, found, _CURE, lost_bytes=len(packet.data))
                continue
            words = np.frombuffer(packet.data, "<u8", packet.events)
            out = allocate(packet.events)
            columns = out["t_us"], out["x"], out["y"], out["p"]
            count = decode_libcaer(words, (packet.turns << 31) * 1000, False, *columns)
            if count:
                places = packet.at + 8 * np.flatnonzero(words & np.uint64(1))
                yield check(cut(out, 0, count), places)

    def read(self) -> Columns:
        """Return all valid events."""
        return collect(self.blocks(), self.path.stat().st_size)

    def _inputs(self, packet: _Packet) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return times and levels of the edges in a packet of special events."""
        if packet.size != 8:
            found = f"special events of {packet.size} bytes instead of 8"
            self.report.fault("left_over", packet.at, found, _CURE, lost_bytes=len(packet.data))
            return np.zeros(0, np.int64), np.zeros(0, np.bool_)
        rows = np.frombuffer(packet.data, "<u4").reshape(-1, 2)
        kinds = (rows[:, 0] >> 1) & 0x7F
        is_edge = (rows[:, 0] & 1 == 1) & np.isin(kinds, list(_EDGES))
        times = rows[is_edge, 1].astype(np.int64) + (packet.turns << 31)
        return times, kinds[is_edge] != 3

    def edges(self) -> Iterator[tuple[NDArray, NDArray, NDArray]]:
        """Yield times [us], channels and levels of the external inputs."""
        for packet in self._packets((_SPECIAL,)):
            times, rising = self._inputs(packet)
            yield times, np.zeros(len(times), np.uint8), rising

    def frames(self) -> Iterator[tuple[int, NDArray[np.uint16]]]:
        """Yield the middle of the exposure [us] and the grey image, uint16 [H, W], of each valid frame."""
        for packet in self._packets((_FRAME,)):
            for index in range(packet.events):
                data = packet.data[index * packet.size : (index + 1) * packet.size]
                try:
                    frame = _frame(data, packet.turns)
                except ValueError as error:
                    at = packet.at + index * packet.size
                    self.report.fault("left_over", at, str(error), _CURE, lost_bytes=packet.size)
                    continue
                if frame is not None:
                    yield frame


def _frame(data: bytes, turns: int) -> tuple[int, NDArray[np.uint16]] | None:
    """Return time and image of a frame event; None where it is not valid."""
    if len(data) < _FRAME_HEAD:
        raise ValueError(f"a frame of {len(data)} bytes")
    info, _, _, begin, end, width, height, _, _ = struct.unpack_from("<Iiiiiiiii", data)
    if not info & 1:
        return None
    samples = (info >> 1) & 7
    if not (0 < width <= _MOST_SIDE and 0 < height <= _MOST_SIDE and samples in (1, 3, 4)):
        raise ValueError(f"a frame of {width} x {height} pixels with {samples} samples each")
    count = width * height * samples
    if _FRAME_HEAD + 2 * count > len(data):
        raise ValueError(f"a frame of {width} x {height} pixels in {len(data)} bytes")
    pixels = np.frombuffer(data, "<u2", count, _FRAME_HEAD).reshape(height, width, samples)
    return (turns << 31) + (begin + end) // 2, grey_of(pixels)


def aedat3_frames(
    path: Path, report: ReadReport, topic: str | None
) -> Iterator[tuple[int, NDArray[np.uint16]]]:
    """Yield the middle of the exposure [us] and the image, uint16 [H, W], of each frame."""
    return Aedat3Source(path, report, None, None, topic, "frames").frames()
