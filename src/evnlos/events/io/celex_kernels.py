"""CeleX-V payloads to rows, columns, ticks and intensities, and back."""

from __future__ import annotations

import numpy as np
from numba import njit

WIDTH, HEIGHT = 1280, 800
# Slots of the int64 state.
ROW, TICK, STAMP, ROW_SEEN, TIME_SEEN, SKIPPED, UNKNOWN, FIRST_UNKNOWN, OUTSIDE, FIRST_OUTSIDE = range(10)
STATE_SIZE = 10
TURNS = (1 << 12, 1 << 16, 1 << 12)  # of the row time, for event formats 0, 1, 2
GROUP_BYTES = (3, 7, 7)
EVENTS_A_GROUP = (1, 2, 4)


@njit(cache=True, inline="always")
def _note(state, count, first, place):
    if state[count] == 0:
        state[first] = place
    state[count] += 1


@njit(cache=True, inline="always")
def _advance(state, stamp, turn):
    """Unwrap the row time: it only ever ascends, so a smaller one has turned over."""
    if state[TIME_SEEN]:
        step = stamp - state[STAMP]
        state[TICK] += step if step >= 0 else step + turn
    state[STAMP] = stamp
    state[TIME_SEEN] = 1


@njit(cache=True)
def decode_format_0(data, state, ticks, x, y, adc):
    """Decode groups of 3 bytes; return the number of events."""
    count = 0
    for group in range(len(data) // 3):
        v1, v2, v3 = np.int64(data[3 * group]), np.int64(data[3 * group + 1]), np.int64(data[3 * group + 2])
        kind = v3 & 3
        if kind == 2:
            state[ROW] = (v2 << 2) | (v3 >> 6)
            state[ROW_SEEN] = 1
            _advance(state, ((v3 & 0x30) << 6) | (v1 << 2) | ((v3 >> 2) & 3), 1 << 12)
        elif kind == 1:
            column = ((v3 & 0xF0) << 3) | (v1 >> 1)
            if not state[ROW_SEEN]:
                state[SKIPPED] += 1
            elif column >= WIDTH or state[ROW] >= HEIGHT:
                _note(state, OUTSIDE, FIRST_OUTSIDE, 3 * group)
            else:
                ticks[count], x[count], y[count], adc[count] = state[TICK], column, state[ROW], v2
                count += 1
        elif kind == 3:
            _note(state, UNKNOWN, FIRST_UNKNOWN, 3 * group)
    return count


@njit(cache=True)
def decode_format_1(data, state, ticks, x, y, adc):
    """Decode groups of 7 bytes into two words of 28 bits; return the number of events."""
    row, row_seen = state[ROW], state[ROW_SEEN] != 0
    tick = state[TICK]
    count = 0
    for group in range(len(data) // 7):
        at = 7 * group
        b1, b2, b3, b4 = (
            np.int64(data[at]),
            np.int64(data[at + 1]),
            np.int64(data[at + 2]),
            np.int64(data[at + 3]),
        )
        b5, b6, b7 = np.int64(data[at + 4]), np.int64(data[at + 5]), np.int64(data[at + 6])
        s0 = (b1 << 6) | (b5 & 0x3F)
        s1 = (b2 << 6) | (b5 >> 6) | ((b6 & 0xF) << 2)
        s2 = (b3 << 6) | (b6 >> 4) | ((b7 & 3) << 4)
        s3 = (b4 << 6) | (b7 >> 2)
        for half in range(2):
            word = (s3 << 14) | s2 if half else (s1 << 14) | s0
            kind = word & 3
            if kind == 1:
                column = (word >> 5) & 0x7FF
                if not row_seen:
                    state[SKIPPED] += 1
                elif column >= WIDTH or row >= HEIGHT:
                    _note(state, OUTSIDE, FIRST_OUTSIDE, at)
                else:
                    ticks[count] = tick
                    x[count] = column
                    y[count] = row
                    adc[count] = 4095 - (word >> 16)
                    count += 1
            elif kind == 2:
                row = word >> 18
                row_seen = True
                _advance(state, (word >> 2) & 0xFFFF, 1 << 16)
                tick = state[TICK]
            elif kind == 3:
                _note(state, UNKNOWN, FIRST_UNKNOWN, at)
    state[ROW], state[ROW_SEEN] = row, row_seen
    return count


@njit(cache=True)
def decode_format_2(data, state, ticks, x, y, adc):
    """Decode groups of 7 bytes into four lanes of 14 bits; return the number of events."""
    lanes = np.empty(4, np.int64)
    count = 0
    for group in range(len(data) // 7):
        at = 7 * group
        b1, b2, b3, b4 = (
            np.int64(data[at]),
            np.int64(data[at + 1]),
            np.int64(data[at + 2]),
            np.int64(data[at + 3]),
        )
        b5, b6, b7 = np.int64(data[at + 4]), np.int64(data[at + 5]), np.int64(data[at + 6])
        lanes[0] = (b1 << 6) | (b5 & 0x3F)
        lanes[1] = (b2 << 6) | (b5 >> 6) | ((b6 & 0xF) << 2)
        lanes[2] = (b3 << 6) | (b6 >> 4) | ((b7 & 3) << 4)
        lanes[3] = (b4 << 6) | (b7 >> 2)
        for lane in lanes:
            kind = lane & 3
            if kind == 1:
                column = lane >> 3
                if not (state[ROW_SEEN] and state[TIME_SEEN]):
                    state[SKIPPED] += 1
                elif column >= WIDTH or state[ROW] >= HEIGHT:
                    _note(state, OUTSIDE, FIRST_OUTSIDE, at)
                else:
                    ticks[count], x[count], y[count], adc[count] = state[TICK], column, state[ROW], 0
                    count += 1
            elif kind == 2:
                state[ROW] = lane >> 4
                state[ROW_SEEN] = 1
            elif kind == 3:
                _advance(state, lane >> 2, 1 << 12)
    return count


DECODERS = (decode_format_0, decode_format_1, decode_format_2)


@njit(cache=True)
def sign_of_change(x, y, adc, last, p, known):
    """Set p and known from the change of intensity since each pixel's last event; `last` [H, W], -1 is none."""
    for index in range(len(x)):
        before = last[y[index], x[index]]
        now = np.int32(adc[index])
        known[index] = before >= 0 and now != before
        p[index] = known[index] and now > before
        last[y[index], x[index]] = now


@njit(cache=True)
def pack_lanes(lanes, data):
    """Write lanes of 14 bits, four to 7 bytes; `lanes` has a multiple of four."""
    for group in range(len(lanes) // 4):
        s0, s1, s2, s3 = lanes[4 * group], lanes[4 * group + 1], lanes[4 * group + 2], lanes[4 * group + 3]
        at = 7 * group
        data[at] = s0 >> 6
        data[at + 1] = s1 >> 6
        data[at + 2] = s2 >> 6
        data[at + 3] = s3 >> 6
        data[at + 4] = (s0 & 0x3F) | ((s1 & 3) << 6)
        data[at + 5] = ((s1 >> 2) & 0xF) | ((s2 & 0xF) << 4)
        data[at + 6] = ((s2 >> 4) & 3) | ((s3 & 0x3F) << 2)
