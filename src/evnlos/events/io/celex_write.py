"""Synthetic CeleX-V recordings, for tests and demonstrations: the layout of the camera's own files."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import DataError, EventFileError
from evnlos.events.io.celex import PICTURE_BYTES
from evnlos.events.io.celex_kernels import HEIGHT, WIDTH, pack_lanes
from evnlos.events.io.celex_options import clock_from_name, tick_divisor
from evnlos.types import Events

_PAYLOAD = 357_000
_LANES = _PAYLOAD // 7 * 4
_MAX_TURNS = 1 << 20


@njit(cache=True)
def _words_of_format_1(ticks, x, y, adc, lanes):
    """Write low and high lanes of 28-bit words, a row wherever row or time changes; return how many lanes."""
    count = 0
    row, tick = np.int64(-1), np.int64(0)
    for index in range(len(ticks)):
        if y[index] != row or ticks[index] != tick:
            while ticks[index] - tick > 0xFFFF:  # rows without events keep the wraps of the clock visible
                tick += 0xFFFF
                word = (np.int64(y[index]) << 18) | ((tick & 0xFFFF) << 2) | 2
                lanes[count], lanes[count + 1] = word & 0x3FFF, word >> 14
                count += 2
            row, tick = np.int64(y[index]), ticks[index]
            word = (row << 18) | ((tick & 0xFFFF) << 2) | 2
            lanes[count], lanes[count + 1] = word & 0x3FFF, word >> 14
            count += 2
        word = ((4095 - np.int64(adc[index])) << 16) | (np.int64(x[index]) << 5) | 1
        lanes[count], lanes[count + 1] = word & 0x3FFF, word >> 14
        count += 2
    return count


@njit(cache=True)
def _words_of_format_2(ticks, x, y, adc, lanes):
    """Write lanes: row and time wherever one changes, then columns; return how many lanes."""
    count = 0
    row, tick = np.int64(-1), np.int64(0)
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
    return count


def write_celex(path: Path, events: Events, target: Path) -> None:
    """Write events with intensities as format 1 (EI), others as format 2 (off-pixel, no polarity).

    The clock is the one in the name of `target`; times are rounded to its ticks and start at 0.
    """
    if events.shape != (HEIGHT, WIDTH):
        raise DataError(
            f"CeleX-V has {WIDTH} x {HEIGHT} pixels, not {events.width} x {events.height}; write .h5"
        )
    clock = clock_from_name(target)
    if clock is None:
        raise EventFileError(f"{target}: the name must end in the sensor's clock; name it ..._EI_100M.bin")
    adc = events.adc
    if adc is not None and len(adc) and int(adc.max()) > 4095:
        raise DataError(f"Events.adc holds {int(adc.max())}; CeleX-V has 12 bits, at most 4095")
    first = int(events.t_us[0]) if len(events) else 0
    divisor = tick_divisor(clock)
    if events.duration_us > 2**40:
        raise DataError(f"{events.duration_us} us are too long for a CeleX-V recording; write .h5")
    ticks = ((events.t_us - first) * divisor * 2 + 1024) // 2048
    event_format, step, encode = (
        (2, 0xFFF, _words_of_format_2) if adc is None else (1, 0xFFFF, _words_of_format_1)
    )
    turns = int(ticks[-1]) // step if len(ticks) else 0
    if turns > _MAX_TURNS:
        raise DataError(f"the row clock would turn {turns} times, at most {_MAX_TURNS} are written; write .h5")
    lanes = np.zeros(4 * len(events) + 2 * turns + 8, np.int64)
    count = encode(ticks, events.x, events.y, events.x if adc is None else adc, lanes)
    packages = max(1, -(-count // _LANES))
    payload = np.zeros(packages * _PAYLOAD, np.uint8)  # kind 0 fills the last package: neither row nor event
    groups = -(-count // 4) * 4
    pack_lanes(lanes[:groups], payload)
    mode = 0 if adc is None else 2
    with path.open("wb") as file:
        file.write(struct.pack("<8BI", 0, mode, 255, 255, event_format, 0, 0, 0, packages))
        for package in payload.reshape(packages, _PAYLOAD):  # [packages, bytes]
            file.write(struct.pack("<I", _PAYLOAD + 1) + package.tobytes() + b"\1")


def write_celex_frames(path: Path, frames: NDArray[np.uint8]) -> None:
    """Write pictures [T, 800, 1280] of 8 bits as a recording of mode F, each with a time stamp of 0.

    Raises:
        DataError: Pictures of another size or type.
    """
    if frames.ndim != 3 or frames.shape[1:] != (HEIGHT, WIDTH) or frames.dtype != np.uint8:
        raise DataError(
            f"frames of shape {frames.shape} and type {frames.dtype}; give uint8 [T, {HEIGHT}, {WIDTH}]"
        )
    with Path(path).open("wb") as file:
        file.write(struct.pack("<8BI", 2, 3, 255, 255, 1, 0, 0, 0, len(frames)))
        for frame in frames:
            groups = np.zeros((PICTURE_BYTES // 3, 3), np.uint8)
            groups[:, :2] = 255 - frame.reshape(-1, 2)
            file.write(
                struct.pack("<I", PICTURE_BYTES + 1) + groups.tobytes() + b"\0" + struct.pack("<qI", 0, 0)
            )
