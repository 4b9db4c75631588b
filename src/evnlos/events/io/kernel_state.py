"""The state that a word decoder carries from block to block: clock, row, and a tally of faults."""

from __future__ import annotations

import numpy as np
from numba import njit

# Slots of the int64 state array.
CLOCK, NEWEST, BASE, STARTED, ROW, COLUMN, POLARITY, TRIGGERS = range(8)
FAULTS = 16  # two slots a kind: how many, index of the first word
UNKNOWN, UNDATED, OUT_OF_RANGE, BACKWARDS, CLOCK_BACK = range(5)
KINDS = ("unknown", "undated", "out_of_range", "backwards", "backwards")
STATE_SIZE = 32

# Words that are decoded at once, on the assumption that nothing is wrong with them; they stay in the cache.
CHUNK = 4096

# Real cameras send a time a few microseconds (11 at most) below the one before it: that is no fault.
JITTER_US = 64


def new_state() -> np.ndarray:
    """Return the state before the first word: no time seen, no fault."""
    state = np.zeros(STATE_SIZE, np.int64)
    state[NEWEST] = np.iinfo(np.int64).min
    return state


@njit(cache=True, inline="always")
def note(state: np.ndarray, kind: int, index: int) -> None:
    """Count a fault of `kind` at word `index` of this block."""
    slot = FAULTS + 2 * kind
    if state[slot] == 0:
        state[slot + 1] = index
    state[slot] += 1
