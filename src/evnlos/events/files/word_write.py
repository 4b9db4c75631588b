"""Writing words: EVT2, EVT2.1, EVT3, and CeleX-V.

- EVT2, EVT2.1 and EVT3: the words of Prophesee's RAW files, which `raw` puts behind their header.
- Synthetic CeleX-V recordings, for tests and demonstrations: the layout of the camera's own files.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import DataError, EventFileError
from evnlos.events.files.celex import IMAGE_BYTES, clock_from_name, tick_divisor
from evnlos.events.files.celex_kernels import HEIGHT, WIDTH, pack_lanes
from evnlos.events.files.columns import FileSink
from evnlos.files import new_file
from evnlos.types import Events

_PAYLOAD = 357_000
_LANES = _PAYLOAD // 7 * 4
_GROUPS = 307_200 // 3  # of format 0 in a package
_MAX_TURNS = 1 << 20
_STEPS = (0xFFF, 0xFFFF, 0xFFF)  # longest step of the row time, by event format
_MAX_ADC = (255, 4095)


@njit(cache=True)
def _groups_of_format_0(ticks, x, y, adc, row, tick, groups):
    """Write groups of 3 bytes, a row wherever row or time changes; return how many, the row and the tick."""
    count = 0
    for index in range(len(ticks)):
        if y[index] != row or ticks[index] != tick:
            row = np.int64(y[index])
            while True:  # rows without events keep the turns of the clock visible
                tick = min(tick + 0xFFF, ticks[index])
                stamp = tick & 0xFFF
                groups[count, 0] = (stamp >> 2) & 0xFF
                groups[count, 1] = row >> 2
                groups[count, 2] = ((row & 3) << 6) | ((stamp >> 10) << 4) | ((stamp & 3) << 2) | 2
                count += 1
                if tick == ticks[index]:
                    break
        column = np.int64(x[index])
        groups[count, 0] = (column & 0x7F) << 1
        groups[count, 1] = adc[index]
        groups[count, 2] = ((column >> 7) << 4) | 1
        count += 1
    return count, row, tick


@njit(cache=True)
def _words_of_format_1(ticks, x, y, adc, row, tick, lanes):
    """Write low and high lanes of 28-bit words, a row wherever row or time changes; return as format 0."""
    count = 0
    for index in range(len(ticks)):
        if y[index] != row or ticks[index] != tick:
            row = np.int64(y[index])
            while True:
                tick = min(tick + 0xFFFF, ticks[index])
                word = (row << 18) | ((tick & 0xFFFF) << 2) | 2
                lanes[count], lanes[count + 1] = word & 0x3FFF, word >> 14
                count += 2
                if tick == ticks[index]:
                    break
        word = ((4095 - np.int64(adc[index])) << 16) | (np.int64(x[index]) << 5) | 1
        lanes[count], lanes[count + 1] = word & 0x3FFF, word >> 14
        count += 2
    return count, row, tick


@njit(cache=True)
def _words_of_format_2(ticks, x, y, adc, row, tick, lanes):
    """Write lanes: row and time wherever one changes, then columns; return as format 0."""
    count = 0
    for index in range(len(ticks)):
        if y[index] != row or ticks[index] != tick:
            while ticks[index] - tick > 0xFFF:
                tick += 0xFFF
                lanes[count] = ((tick & 0xFFF) << 2) | 3
                count += 1
            row, tick = np.int64(y[index]), ticks[index]
            lanes[count] = (row << 4) | 2
            lanes[count + 1] = ((tick & 0xFFF) << 2) | 3
            count += 2
        lanes[count] = (np.int64(x[index]) << 3) | 1
        count += 1
    return count, row, tick


class CelexSink(FileSink):
    """A CeleX-V recording that grows: format 1 (EI) for events with intensities, 2 (off-pixel) for others.

    The clock is the one in the name of `target`; times are rounded to its ticks and start at 0. Format 0, with
    intensities of 8 bits, is that of the camera's first firmware.
    """

    def __init__(self, path: Path, first: Events, target: Path, event_format: int | None = None) -> None:
        if first.shape != (HEIGHT, WIDTH):
            raise DataError(
                f"CeleX-V has {WIDTH} x {HEIGHT} pixels, not {first.width} x {first.height}; write .h5"
            )
        clock = clock_from_name(target)
        if clock is None:
            raise EventFileError(f"{target}: the name must end in the sensor's clock; name it ..._EI_100M.bin")
        if event_format is None:
            event_format = 2 if first.adc is None else 1
        elif first.adc is None:
            raise DataError(f"CeleX-V format {event_format} needs intensities; give Events with adc")
        super().__init__(path)
        self._format, self._divisor = event_format, tick_divisor(clock)
        self._start = int(first.t_us[0]) if len(first) else 0
        self._row, self._tick = -1, 0
        self._left = np.zeros((0, 3), np.uint8) if event_format == 0 else np.zeros(0, np.int64)
        self._packages = 0
        self._header()

    def _header(self) -> None:
        mode = 0 if self._format == 2 else 2
        self.file.write(struct.pack("<8BI", 0, mode, 255, 255, self._format, 0, 0, 0, self._packages))

    def append(self, events: Events) -> None:
        """Write the packages that a piece fills, and keep the rest for the next."""
        adc = events.adc
        if adc is not None and len(adc) and self._format < 2 and int(adc.max()) > _MAX_ADC[self._format]:
            most = _MAX_ADC[self._format]
            raise DataError(
                f"Events.adc holds {int(adc.max())}; CeleX-V format {self._format} has at most {most}"
            )
        if not len(events):
            return
        last_us = int(events.t_us[-1]) - self._start
        if last_us > 2**40:
            raise DataError(f"{last_us} us are too long for a CeleX-V recording; write .h5")
        ticks = ((events.t_us - self._start) * self._divisor * 2 + 1024) // 2048
        turns = (int(ticks[-1]) - self._tick) // _STEPS[self._format] + 1
        if turns > _MAX_TURNS:
            raise DataError(
                f"the row clock would turn {turns} times, at most {_MAX_TURNS} are written; write .h5"
            )
        room = 4 * len(events) + 2 * turns + 8
        if self._format == 0:
            new, encode = np.zeros((room, 3), np.uint8), _groups_of_format_0
        else:
            new = np.zeros(room, np.int64)
            encode = _words_of_format_1 if self._format == 1 else _words_of_format_2
        intensity = events.x if adc is None else adc
        count, self._row, self._tick = encode(ticks, events.x, events.y, intensity, self._row, self._tick, new)
        self._left = np.concatenate([self._left, new[:count]])
        size = _GROUPS if self._format == 0 else _LANES
        while len(self._left) >= size:
            self._package(self._left[:size])
            self._left = self._left[size:]

    def _package(self, content: NDArray) -> None:
        """Write one package; zeros, neither row nor event, fill the last."""
        if self._format == 0:
            payload = content if len(content) else np.zeros((1, 3), np.uint8)
        else:
            lanes = np.zeros(_LANES, np.int64)
            lanes[: len(content)] = content
            payload = np.zeros(_PAYLOAD, np.uint8)
            pack_lanes(lanes, payload)
        self.file.write(struct.pack("<I", payload.size + 1) + payload.tobytes() + b"\1")
        self._packages += 1

    def finish(self) -> None:
        """Write the last package, and the number of packages into the header."""
        if len(self._left) or not self._packages:
            self._package(self._left)
        self.file.seek(0)
        self._header()


def write_celex_frames(path: Path, frames: NDArray[np.uint8 | np.uint16]) -> None:
    """Write images [T, 800, 1280] as a recording of mode F, each with a time stamp of 0.

    Args:
        path: The file.
        frames: Images, brighter = greater: uint8, or uint16 of 12 bits.

    Raises:
        DataError: Images of another size or type, or of more than 12 bits.
    """
    if frames.ndim != 3 or frames.shape[1:] != (HEIGHT, WIDTH) or frames.dtype not in (np.uint8, np.uint16):
        raise DataError(
            f"frames of shape {frames.shape} and type {frames.dtype}; give uint8 or uint16 "
            f"[T, {HEIGHT}, {WIDTH}]"
        )
    if frames.size and frames.dtype == np.uint16 and int(frames.max()) > 4095:
        raise DataError(f"frames holds {int(frames.max())}; CeleX-V has 12 bits, at most 4095")
    with new_file(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<8BI", 2, 3, 255, 255, 1, 0, 0, 0, len(frames)))
        for frame in frames:
            groups = np.zeros((IMAGE_BYTES // 3, 3), np.uint8)
            if frame.dtype == np.uint8:
                groups[:, :2] = 255 - frame.reshape(-1, 2)
            else:
                words = 4095 - frame.reshape(-1, 2)
                groups[:, :2] = words >> 4
                groups[:, 2] = (words[:, 0] & 0xF) | ((words[:, 1] & 0xF) << 4)
            file.write(struct.pack("<I", IMAGE_BYTES + 1) + groups.tobytes() + b"\0" + struct.pack("<qI", 0, 0))


@njit(cache=True)
def encode_evt2(t_us, x, y, p, high, words):
    """Write EVT2 words; `high` is the high part of the time before them, -1 at the start; return how many."""
    count = 0
    for index in range(len(t_us)):
        new = t_us[index] >> 6
        if new != high:
            while high >= 0 and (new >> 28) > (high >> 28):
                words[count] = np.uint32(0x8FFFFFFF)
                words[count + 1] = np.uint32(0x80000000)
                count += 2
                high = ((high >> 28) + 1) << 28
            high = new
            words[count] = np.uint32(0x80000000 | (new & 0xFFFFFFF))
            count += 1
        low = t_us[index] & 0x3F
        words[count] = np.uint32(
            (np.int64(p[index]) << 28) | (low << 22) | (np.int64(x[index]) << 11) | np.int64(y[index])
        )
        count += 1
    return count


@njit(cache=True)
def encoded_size_evt2(t_us, before) -> int:
    """Return an upper bound of the words that `encode_evt2` writes after an event at `before`."""
    count = len(t_us)
    for index in range(len(t_us)):
        count += 2 * ((t_us[index] >> 34) - (before >> 34)) + ((t_us[index] >> 6) != (before >> 6))
        before = t_us[index]
    return count + 1


@njit(cache=True)
def encode_evt21(t_us, x, y, p, high, words):
    """Write words; `high` is the high part of the time before them, -1 at the start; return how many."""
    count = 0
    index = 0
    while index < len(t_us):
        new = t_us[index] >> 6
        if new != high:
            while high >= 0 and (new >> 28) > (high >> 28):
                words[count] = (np.int64(0x8FFFFFFF) - (np.int64(1) << 32)) << 32
                words[count + 1] = (np.int64(0x80000000) - (np.int64(1) << 32)) << 32
                count += 2
                high = ((high >> 28) + 1) << 28
            high = new
            words[count] = ((np.int64(0x80000000) | (new & 0xFFFFFFF)) - (np.int64(1) << 32)) << 32
            count += 1
        # A word starts at a multiple of 32, as the sensors send it.
        start = np.int64(x[index]) & ~np.int64(31)
        fields = (np.int64(p[index]) << 28) | ((t_us[index] & 0x3F) << 22) | (start << 11) | np.int64(y[index])
        mask = np.int64(0)
        last = np.int64(-1)
        first = index
        while (
            index < len(t_us)
            and t_us[index] == t_us[first]
            and y[index] == y[first]
            and p[index] == p[first]
            and last < np.int64(x[index]) < start + 32
        ):
            last = np.int64(x[index])
            mask |= np.int64(1) << (last - start)
            index += 1
        words[count] = (fields << 32) | mask
        count += 1
    return count


@njit(cache=True)
def encoded_size_evt21(t_us, before) -> int:
    """Return an upper bound of the words that `encode_evt21` writes after an event at `before`."""
    count = 2 * len(t_us) + 2
    for index in range(len(t_us)):
        count += 2 * ((t_us[index] >> 34) - (before >> 34))
        before = t_us[index]
    return count


@njit(cache=True)
def _run_length(t_us, x, y, p, start):
    """Return how many events from `start` fit one 12-pixel vector: same time, row, sign, columns ascending."""
    stop = start + 1
    while (
        stop < len(t_us)
        and t_us[stop] == t_us[start]
        and y[stop] == y[start]
        and p[stop] == p[start]
        and x[stop] > x[stop - 1]
        and x[stop] - x[start] < 12
    ):
        stop += 1
    return stop - start


@njit(cache=True)
def encode_evt3(t_us, x, y, p, high, words):
    """Write EVT3 words; `high` is the high part of the time before them, -1 at the start; return how many."""
    low, row = np.int64(-1), np.int64(-1)
    count = 0
    index = 0
    while index < len(t_us):
        new = t_us[index] >> 12
        if new != high:
            while high >= 0 and (new >> 12) > (high >> 12):
                words[count] = np.uint16(0x8FFF)
                words[count + 1] = np.uint16(0x8000)
                count += 2
                high = ((high >> 12) + 1) << 12
            high = new
            words[count] = np.uint16(0x8000 | (new & 0xFFF))
            count += 1
            low = np.int64(-1)
        if (t_us[index] & 0xFFF) != low:
            low = t_us[index] & 0xFFF
            words[count] = np.uint16(0x6000 | low)
            count += 1
        if y[index] != row:
            row = np.int64(y[index])
            words[count] = np.uint16(row)
            count += 1
        sign = np.int64(0x800) if p[index] else np.int64(0)
        run = _run_length(t_us, x, y, p, index)
        if run > 2:
            bits = np.int64(0)
            for step in range(run):
                bits |= np.int64(1) << np.int64(x[index + step] - x[index])
            words[count] = np.uint16(0x3000 | sign | np.int64(x[index]))
            words[count + 1] = np.uint16(0x4000 | bits)
            count += 2
            index += run
        else:
            words[count] = np.uint16(0x2000 | sign | np.int64(x[index]))
            count += 1
            index += 1
    return count


@njit(cache=True)
def encoded_size_evt3(t_us, before) -> int:
    """Return an upper bound of the words that `encode_evt3` writes after an event at `before`."""
    count = 4 * len(t_us) + 4
    for index in range(len(t_us)):
        count += 2 * ((t_us[index] >> 24) - (before >> 24))
        before = t_us[index]
    return count
