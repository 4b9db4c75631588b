"""The state that a CeleX-V decoder carries from package to package: row, row time, and a tally of faults."""

from __future__ import annotations

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
