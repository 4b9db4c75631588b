"""CeleX-V payloads of event formats 0 and 2 to events, and lanes back to bytes."""

from __future__ import annotations

import numpy as np
from numba import njit

from evnlos.events.io.celex_format_1 import decode_format_1
from evnlos.events.io.celex_state import (
    FIRST_OUTSIDE,
    FIRST_UNKNOWN,
    HEIGHT,
    OUTSIDE,
    ROW,
    ROW_SEEN,
    SKIPPED,
    TIME_SEEN,
    TIME_US,
    UNKNOWN,
    WIDTH,
    advance,
    lanes_of,
    note,
)

GROUP_BYTES = (3, 7, 7)
EVENTS_A_GROUP = (1, 2, 4)


@njit(cache=True)
def decode_format_0(data, state, t_us, x, y, p, adc, known, last, scratch):
    """Decode groups of 3 bytes (intensity, 8 bits); return the number of events.

    `last` [H, W] holds each pixel's last intensity, -1 before its first event: the sensor sends no
    polarity, it is the sign of the change, unknown at a first event and where nothing changed.
    """
    count = 0
    for group in range(len(data) // 3):
        v1, v2, v3 = np.int64(data[3 * group]), np.int64(data[3 * group + 1]), np.int64(data[3 * group + 2])
        kind = v3 & 3
        if kind == 2:
            state[ROW] = (v2 << 2) | (v3 >> 6)
            state[ROW_SEEN] = 1
            advance(state, ((v3 & 0x30) << 6) | (v1 << 2) | ((v3 >> 2) & 3), 1 << 12)
        elif kind == 1:
            column = ((v3 & 0xF0) << 3) | (v1 >> 1)
            if not state[ROW_SEEN]:
                state[SKIPPED] += 1
            elif column >= WIDTH or state[ROW] >= HEIGHT:
                note(state, OUTSIDE, FIRST_OUTSIDE, 3 * group)
            else:
                t_us[count], x[count], y[count], adc[count] = state[TIME_US], column, state[ROW], v2
                before = last[state[ROW], column]
                known[count] = before >= 0 and before != v2
                p[count] = known[count] and v2 > before
                last[state[ROW], column] = v2
                count += 1
        elif kind == 3:
            note(state, UNKNOWN, FIRST_UNKNOWN, 3 * group)
    return count


@njit(cache=True)
def decode_format_2(data, state, t_us, x, y, p, adc, known, last, scratch):
    """Decode groups of 7 bytes into four lanes of 14 bits; return the number of events."""
    count = 0
    for group in range(len(data) // 7):
        at = 7 * group
        for lane in lanes_of(data, at):
            kind = lane & 3
            if kind == 1:
                column = lane >> 3
                if not (state[ROW_SEEN] and state[TIME_SEEN]):
                    state[SKIPPED] += 1
                elif column >= WIDTH or state[ROW] >= HEIGHT:
                    note(state, OUTSIDE, FIRST_OUTSIDE, at)
                else:
                    t_us[count], x[count], y[count] = state[TIME_US], column, state[ROW]
                    p[count], known[count] = False, False
                    count += 1
            elif kind == 2:
                state[ROW] = lane >> 4
                state[ROW_SEEN] = 1
            elif kind == 3:
                advance(state, lane >> 2, 1 << 12)
    return count


DECODERS = (decode_format_0, decode_format_1, decode_format_2)


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
