"""AEDAT 2.0, written by jAER for DVS128 and DAVIS cameras, and AEDAT 3.1, written by cAER.

2.0: comment lines, then pairs of big-endian words: an address and a time in microseconds, read without a sign;
it turns over at 2^32. What an address means is told by the class that the line `# AEChip:` names. Rows and
columns are those that are stored: jAER shows row 0 at the bottom and columns from the right. Source: jAER's
DavisChip, DavisBaseCamera and DVS128.

3.1: a text header, then packets of one kind of event each. A packet is 28 bytes of header, then events of one
size. Polarity events are libcaer's eight bytes; times are 31 bits and a count of their turns. Row 0 is the top.
Source: iniVation's page and libcaer's headers.
"""

from __future__ import annotations

import logging
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

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

SIGNATURE_2, SIGNATURE_3 = b"#!AER-DAT2", b"#!AER-DAT3"
_BLOCK = 1 << 17  # pairs
_MOST_HEADER_BYTES = 1 << 20
_MOST_LINE_BYTES = 4096
_LOG = logging.getLogger("evnlos")
_SIZES = (
    (re.compile(r"dvs128|davis128", re.I), (128, 128)),
    (re.compile(r"davis208|sensdavis", re.I), (208, 192)),
    (re.compile(r"davis240|sbret10", re.I), (240, 180)),
    (re.compile(r"davis346", re.I), (346, 260)),
    (re.compile(r"davis640|davisrgb", re.I), (640, 480)),
)
SAMPLE_BITS = 10  # of a frame's samples


def size_of_chip(name: str) -> tuple[int, int] | None:
    """Return width and height of a camera of iniVation by its name, in pixels; None for another name.

    Example:
        >>> size_of_chip("eu.seebetter.ini.chips.davis.Davis346red"), size_of_chip("DAVIS240C")
        ((346, 260), (240, 180))
    """
    last = name.rsplit(".", 1)[-1]
    return next((size for pattern, size in _SIZES if pattern.search(last)), None)


def read_comments(file: BinaryIO) -> list[str]:
    """Read the lines that begin with #, and leave the file at the first byte behind them."""
    lines: list[str] = []
    file.seek(0)
    while file.tell() < _MOST_HEADER_BYTES:
        start = file.tell()
        line = file.readline(_MOST_LINE_BYTES)
        text = line.rstrip(b"\r\n")
        if (
            not line.startswith(b"#")
            or not line.endswith(b"\n")
            or any(byte < 32 and byte != 9 for byte in text)
        ):
            file.seek(start)  # data, which may begin with the byte of #
            break
        lines.append(text.decode("latin-1"))
        if text == b"#!END-HEADER":
            break
    return lines


def _opened(path: Path) -> tuple[list[str], int, int]:
    """Return the header's lines, the byte behind them, and the size of the file."""
    with open_regular(path) as file:
        return read_comments(file), file.tell(), file.seek(0, 2)


def set_size(report: ReadReport, chip: str, width: int | None, height: int | None) -> None:
    """Put the sensor size into the report: the caller's, else that of the camera that the header names.

    Raises:
        EventFileError: The header names no known camera, and the caller gives no size.
    """
    size = size_of_chip(chip)
    if width is not None:
        report.set_geometry(width, height, "caller")
    elif size is not None:
        report.set_geometry(*size, "camera")
    else:
        found = f"a header that names {'the camera ' + repr(chip[:60]) if chip else 'no camera'}"
        raise unreadable(report.path, 0, found, "give width= and height= (--width, --height)")


CLOCK, BASE, STARTED = range(3)  # slots of the state
_SIGNAL_MASK, _SIGNAL = np.uint32(1 << 31 | 3 << 10), np.uint32(1 << 31 | 1 << 10)


@njit(cache=True)
def _unwrap(stamp, state):
    """Return the time of a stamp of 32 bits; words of several kinds may be a little out of order."""
    if state[STARTED]:
        if state[CLOCK] - stamp > 1 << 31:
            state[BASE] += 1 << 32
        elif stamp - state[CLOCK] > 1 << 31:
            return state[BASE] - (np.int64(1) << 32) + stamp  # before the turn
    state[CLOCK], state[STARTED] = stamp, 1
    return state[BASE] + stamp


@njit(cache=True)
def _decode(pairs, state, is_davis, t_us, x, y, p, places, edges):
    """Decode pairs of words; return the number of events and of external inputs."""
    count, inputs = 0, 0
    for index in range(len(pairs) // 2):
        word = np.int64(pairs[2 * index])
        time = _unwrap(np.int64(pairs[2 * index + 1]), state)
        if is_davis:
            if word >> 31:
                continue
            is_input = (word >> 10) & 1
            column, row, sign = (word >> 12) & 0x3FF, (word >> 22) & 0x1FF, (word >> 11) & 1
        else:
            is_input = (word >> 15) & 1
            column, row, sign = (word >> 1) & 0x7F, (word >> 8) & 0x7F, 1 - (word & 1)
        if is_input:
            edges[inputs] = time
            inputs += 1
            continue
        t_us[count], x[count], y[count], p[count], places[count] = time, column, row, sign, index
        count += 1
    return count, inputs


class Aedat2Source:
    """An open AEDAT 2.0 file."""

    def __init__(self, path: Path, report: ReadReport, width: int | None, height: int | None) -> None:
        self.path, self.report = path, report
        report.format = "AEDAT2"
        lines, self._start, _ = _opened(path)
        if not lines or not lines[0].startswith("#!AER-DAT2"):
            raise unreadable(path, 0, "an AEDAT file whose first line is damaged", "#!AER-DAT2.0 belongs there")
        chip = next((line.partition("AEChip:")[2].strip() for line in lines if "AEChip:" in line), "")
        set_size(report, chip, width, height)
        self._is_davis, self._signals = "dvs128" not in chip.lower(), 0
        if not self._is_davis:
            _LOG.warning(
                "%s: a DVS128; a polarity bit of 0 counts as ON, as in jAER (iniVation's page says 1)", path
            )

    def pairs(self) -> Iterator[tuple[int, NDArray[np.uint32]]]:
        """Yield blocks of words (addresses and times in turn), and the byte where each block begins."""
        with open_regular(self.path) as file:
            file.seek(self._start)
            at = self._start
            while data := file.read(8 * _BLOCK):
                whole = len(data) // 8 * 8
                yield at, np.frombuffer(data, ">u4", whole // 4).astype(np.uint32)
                at += whole
                if whole < len(data):
                    found = f"the file ends {len(data) - whole} bytes into a pair of words"
                    cure = f"the file was cut: copy it again or {SALVAGE}"
                    self.report.fault("truncated", at, found, cure, lost_bytes=len(data) - whole)
                    return

    def _decoded(self) -> Iterator[tuple[int, Columns, NDArray[np.int64], NDArray[np.int64]]]:
        """Yield (byte, events, number of the pair of each, times of external inputs) of each block."""
        self._signals = 0
        state = np.zeros(3, np.int64)
        for at, pairs in self.pairs():
            out, many = allocate(len(pairs) // 2), len(pairs) // 2
            places, edges = np.empty(many, np.int64), np.empty(many, np.int64)
            columns = out["t_us"], out["x"], out["y"], out["p"]
            if self._is_davis:  # bit 31 and 1 in bits 10 and 11: a pixel's signal; each image has one of each
                self._signals += int(np.count_nonzero(pairs[::2] & _SIGNAL_MASK == _SIGNAL))
                self.report.frames = self._signals // (self.report.width * self.report.height)
            count, inputs = _decode(pairs, state, self._is_davis, *columns, places, edges)
            yield at, cut(out, 0, count), places[:count], edges[:inputs]

    def blocks(self) -> Iterator[Columns]:
        """Yield the events in blocks of bounded size."""
        check = ColumnCheck(self.report)
        for at, columns, places, edges in self._decoded():
            self.report.triggers += len(edges)
            if len(places):
                yield check(columns, at + 8 * places)

    def read(self) -> Columns:
        """Return all events."""
        return collect(self.blocks(), self.path.stat().st_size)

    def edges(self) -> Iterator[tuple[NDArray, NDArray, NDArray]]:
        """Yield times [us], channels and levels of the external inputs; the file does not tell edges apart."""
        for _, _, _, times in self._decoded():
            yield times, np.zeros(len(times), np.uint8), np.ones(len(times), np.bool_)


@njit(cache=True)
def _sample(pairs, start, state, samples, seen):
    """Take frame samples; return the number of the pair behind a complete frame, or -1 at the end of the block.

    `samples` and `seen` are [2, H, W]: the level after reset, then the level after the exposure. Slots 3 and 4
    of `state` count the samples of each kind, slot 5 is the time of the first one after the exposure.
    """
    height, width = samples.shape[1:]
    for index in range(start, len(pairs) // 2):
        word = np.int64(pairs[2 * index])
        kind = (word >> 10) & 3
        time = _unwrap(np.int64(pairs[2 * index + 1]), state)
        row, column = (word >> 22) & 0x1FF, (word >> 12) & 0x3FF
        if not word >> 31 or kind > 1 or row >= height or column >= width:
            continue
        if seen[kind, row, column]:  # the sensor is read anew: what was not complete is given up
            seen[:] = False
            state[3:5] = 0
        if kind == 1 and state[4] == 0:
            state[5] = time
        seen[kind, row, column] = True
        samples[kind, row, column] = word & 0x3FF
        state[3 + kind] += 1
        if state[3] == height * width and state[4] == height * width:
            seen[:] = False
            state[3:5] = 0
            return index + 1
    return -1


def aedat2_frames(
    path: Path, report: ReadReport, topic: str | None
) -> Iterator[tuple[int, NDArray[np.uint16]]]:
    """Yield the time [us] and the image, uint16 [H, W], of each complete frame of a DAVIS.

    A pixel is its level after reset minus that after the exposure: 10 bits, in the upper ones of 16. A frame's
    time is that of its first sample after the exposure. Frames that are not complete are left out.
    """
    source = Aedat2Source(path, report, None, None)
    state = np.zeros(6, np.int64)
    samples = np.zeros((2, report.height, report.width), np.int32)
    seen = np.zeros(samples.shape, np.bool_)
    for _, pairs in source.pairs():
        at = _sample(pairs, 0, state, samples, seen)
        while at >= 0:
            levels = np.clip(samples[0] - samples[1], 0, (1 << SAMPLE_BITS) - 1)  # [H, W]
            yield int(state[5]), (levels << (16 - SAMPLE_BITS)).astype(np.uint16)
            at = _sample(pairs, at, state, samples, seen)


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
        lines, self._start, self._size = _opened(path)
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
