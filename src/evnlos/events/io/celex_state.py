"""The state that a CeleX-V decoder carries from package to package: row, row time, and a tally of faults."""

from __future__ import annotations

import numpy as np
from numba import njit

WIDTH, HEIGHT = 1280, 800
# Slots of the int64 state.
ROW, TICK, STAMP, ROW_SEEN, TIME_SEEN, SKIPPED, UNKNOWN, FIRST_UNKNOWN, OUTSIDE, FIRST_OUTSIDE = range(10)
DIVISOR, TIME_US = 10, 11
STATE_SIZE = 12


@njit(cache=True, inline="always")
def note(state, count, first, place):
    """Count a fault in slot `count`; slot `first` keeps the place of the earliest."""
    if state[count] == 0:
        state[first] = place
    state[count] += 1


@njit(cache=True, inline="always")
def advance(state, stamp, turn):
    """Unwrap the row time: it only ever ascends, so a smaller one has turned over.

    Microseconds are rounded here, once a row: a division an event would be the slowest part of decoding.
    """
    if state[TIME_SEEN]:
        step = stamp - state[STAMP]
        state[TICK] += step if step >= 0 else step + turn
        state[TIME_US] = (state[TICK] * 2048 + state[DIVISOR]) // (2 * state[DIVISOR])
    state[STAMP] = stamp
    state[TIME_SEEN] = 1


@njit(cache=True)
def lanes_of(data, at):
    """Return the four lanes of 14 bits of the group of 7 bytes that begins at `at`."""
    b5, b6, b7 = np.int64(data[at + 4]), np.int64(data[at + 5]), np.int64(data[at + 6])
    return (
        (np.int64(data[at]) << 6) | (b5 & 0x3F),
        (np.int64(data[at + 1]) << 6) | (b5 >> 6) | ((b6 & 0xF) << 2),
        (np.int64(data[at + 2]) << 6) | (b6 >> 4) | ((b7 & 3) << 4),
        (np.int64(data[at + 3]) << 6) | (b7 >> 2),
    )
