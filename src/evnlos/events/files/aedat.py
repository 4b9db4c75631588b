"""AEDAT 2.0, written by jAER for DVS128 and DAVIS cameras.

Comment lines, then pairs of big-endian words: an address and a time in microseconds, read without a sign; it
turns over at 2^32. What an address means is told by the class that the line `# AEChip:` names. Rows and columns
are those that are stored: jAER shows row 0 at the bottom and columns from the right. Source: jAER's DavisChip,
DavisBaseCamera and DVS128.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.events.files.columns import (
    SALVAGE,
    ColumnCheck,
    Columns,
    ReadReport,
    allocate,
    collect,
    cut,
    unreadable,
)
from evnlos.untrusted import open_regular

SIGNATURE = b"#!AER-DAT2"
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
        with open_regular(path) as file:
            lines = read_comments(file)
            self._start = file.tell()
            self._size = file.seek(0, 2)
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


COUNTS, FIRST = slice(3, 5), 5  # further slots: samples of each kind, time of the first signal sample


@njit(cache=True)
def _sample(pairs, start, state, samples, seen):
    """Take frame samples; return the number of the pair behind a complete frame, or -1 at the end of the block.

    `samples` and `seen` are [2, H, W]: the level after reset, then the level after the exposure.
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
