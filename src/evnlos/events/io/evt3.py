"""EVT3: words of 16 bits that change one thing at a time (row, column, time) or add 8 or 12 pixels at once."""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.events.io.kernel_state import (
    BACKWARDS,
    BASE,
    CLOCK,
    CLOCK_BACK,
    COLUMN,
    JITTER_US,
    NEWEST,
    OUT_OF_RANGE,
    POLARITY,
    ROW,
    STARTED,
    TRIGGERS,
    UNDATED,
    UNKNOWN,
    note,
)

WRAP_US = 1 << 24
_HIGH_TURN = 1 << 12
_ROW_SEEN, _BASE_SEEN = 8, 9  # further slots of the state


@cache
def _events_per_word() -> NDArray[np.uint8]:
    """Return how many events each 16-bit word stands for."""
    words = np.arange(65_536, dtype=np.uint32)
    kind = words >> 12
    count = np.where(kind == 2, 1, 0)
    count = np.where(kind == 4, np.bitwise_count(words & 0xFFF), count)
    return np.where(kind == 5, np.bitwise_count(words & 0xFF), count).astype(np.uint8)


@njit(cache=True)
def _sum_table(words, table):
    total = 0
    for word in words:
        total += table[word]
    return total


def bound_evt3(words: NDArray[np.uint16]) -> int:
    """Return how many events `words` can hold at most."""
    return int(_sum_table(words, _events_per_word()))


@njit(cache=True)
def decode_evt3(words, state, t_us, x, y, p, width, height):  # noqa: D103 - see decode_words
    clock, newest, base = state[CLOCK], state[NEWEST], state[BASE]  # clock = high << 12 | low
    row, column, polarity = state[ROW], state[COLUMN], state[POLARITY] != 0
    started, row_seen, base_seen = state[STARTED] != 0, state[_ROW_SEEN] != 0, state[_BASE_SEEN] != 0
    never = np.iinfo(np.int64).min
    time = max(base + clock, newest)
    count = 0
    for index in range(len(words)):
        word = np.int64(words[index])
        kind = word >> 12
        if kind == 2:
            if not (started and row_seen):
                note(state, UNDATED, index)
                continue
            column = word & 0x7FF
            if column >= width or row >= height:
                note(state, OUT_OF_RANGE, index)
                continue
            t_us[count] = time
            x[count] = column
            y[count] = row
            p[count] = (word & 0x800) != 0
            newest = time
            count += 1
        elif kind == 0:
            row = word & 0x7FF
            row_seen = True
        elif kind == 4 or kind == 5:
            span = 12 if kind == 4 else 8
            bits = word & ((1 << span) - 1)
            if not (started and row_seen and base_seen):
                note(state, UNDATED, index)
                continue
            at = column
            while bits:
                if bits & 1:
                    if at >= width or row >= height:
                        note(state, OUT_OF_RANGE, index)
                    else:
                        t_us[count] = time
                        x[count] = at
                        y[count] = row
                        p[count] = polarity
                        newest = time
                        count += 1
                bits >>= 1
                at += 1
            column += span
        elif kind == 3:
            column = word & 0x7FF
            polarity = (word & 0x800) != 0
            base_seen = True
        elif kind == 6 or kind == 8:
            if kind == 6:
                new = word & 0xFFF
                if (clock & 0xFFF) - new > JITTER_US:
                    note(state, BACKWARDS, index)
                    newest = never
                clock = (clock & ~np.int64(0xFFF)) | new
            else:
                new = word & 0xFFF
                high = clock >> 12
                if started and new < high:
                    if high - new > _HIGH_TURN // 2:
                        base += WRAP_US
                    else:
                        note(state, CLOCK_BACK, index)
                        newest = never  # one fault, not one more for each event behind it
                if new != high or not started:
                    clock = new << 12
                started = True
            if not started:
                continue
            time = base + clock
            if time < newest:
                if time < newest - JITTER_US:
                    note(state, BACKWARDS, index)
                    newest = never
                else:
                    time = newest
        elif kind == 10:
            state[TRIGGERS] += 1
        elif kind != 7 and kind != 14 and kind != 15:
            note(state, UNKNOWN, index)
    state[CLOCK], state[NEWEST], state[BASE], state[STARTED] = clock, newest, base, started
    state[ROW], state[COLUMN], state[POLARITY] = row, column, polarity
    state[_ROW_SEEN], state[_BASE_SEEN] = row_seen, base_seen
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
def encode_evt3(t_us, x, y, p, words):
    """Write EVT3 words for times that start below one turn of the clock; return how many."""
    high, low, row = np.int64(-1), np.int64(-1), np.int64(-1)
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
def encoded_size_evt3(t_us) -> int:
    """Return an upper bound of the number of words that `encode_evt3` writes."""
    count = 4 * len(t_us) + 4
    for index in range(1, len(t_us)):
        count += 2 * ((t_us[index] >> 24) - (t_us[index - 1] >> 24))
    return count
