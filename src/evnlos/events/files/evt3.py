"""Writing EVT3 words.

- EVT3: words of 16 bits that change one thing at a time (row, column, time) or add 8 or 12 pixels at once.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.events.files.words import (
    BACKWARDS,
    BASE,
    CHUNK,
    CLOCK,
    CLOCK_BACK,
    CLOCK_JUMP,
    COLUMN,
    JITTER_US,
    NEAR,
    NEWEST,
    OUT_OF_RANGE,
    POLARITY,
    ROW,
    STARTED,
    TRIGGERS,
    UNDATED,
    UNKNOWN,
    mend_clock,
    note,
)


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


WRAP_US = 1 << 24
_HIGH_TURN = 1 << 12
SLACK = 12
_ROW_SEEN, _BASE_SEEN = 8, 9  # further slots of the state
# Clock before a jump of which it is not known yet whether it comes back; high + 1, 0 = none.
_OLD_HIGH, _OLD_BASE = 10, 11
_DENSE = 12  # clock words in a row that were near the one before: only a camera's clock that runs on can jump


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
    """Return how many events `words` can hold at most, and the room that decoding needs behind them."""
    return int(_sum_table(words, _events_per_word())) + SLACK


@njit(cache=True)
def _decode_carefully(words, first, stop, state, t_us, x, y, p, width, height):
    """Decode the words first..stop one by one and note every fault."""
    clock, newest, base = state[CLOCK], state[NEWEST], state[BASE]  # clock = high << 12 | low
    row, column, polarity = state[ROW], state[COLUMN], state[POLARITY] != 0
    started, row_seen, base_seen = state[STARTED] != 0, state[_ROW_SEEN] != 0, state[_BASE_SEEN] != 0
    never = np.iinfo(np.int64).min
    time = max(base + clock, newest)
    count = 0
    old_high, old_base, dense = state[_OLD_HIGH] - 1, state[_OLD_BASE], state[_DENSE]
    for index in range(first, stop):
        word = np.int64(words[index])
        kind = word >> 12
        if kind == 2:
            if not (started and row_seen):
                note(state, UNDATED, index)
                continue
            at = word & 0x7FF  # a single event leaves the base of the vectors where it is
            if at >= width or row >= height:
                note(state, OUT_OF_RANGE, index)
                continue
            t_us[count] = time
            x[count] = at
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
                if old_high >= 0 and (new - old_high) & 0xFFF <= NEAR:
                    note(state, CLOCK_JUMP, index)
                    base, high, clock = old_base, old_high, old_high << 12
                    newest, old_high = never, -1
                elif started:
                    old_high = -1
                    right = mend_clock(words, index, high, clock & 0xFFF, dense)
                    if right >= 0:
                        note(state, CLOCK_JUMP, index)
                        new = right
                    elif right == -2:
                        old_high, old_base = high, base
                        if 0 < high - new <= _HIGH_TURN // 2:
                            new = high  # backwards: a fault in any case, of which the next clock word tells
                dense = dense + 1 if (new - high) & 0xFFF <= NEAR else 0
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
    state[_OLD_HIGH], state[_OLD_BASE], state[_DENSE] = old_high + 1, old_base, dense
    return count


@njit(cache=True)
def _largest(values):
    largest = np.uint16(0)
    for value in values:
        largest = max(largest, value)
    return largest


@njit(cache=True)
def _decode_chunk(words, state, places, counts, t_us, x, y, p, width, height):
    """Decode words among which nothing is unusual; return the number of events, or -1 where something is.

    A vector writes all twelve places of its mask's table, which is faster than looking at each bit; that needs
    `SLACK` places behind the last event. Places are counted without a sign, or every access would be checked
    for a negative index.
    """
    newest, base = state[NEWEST], state[BASE]
    high, low = base + (state[CLOCK] & ~np.int64(0xFFF)), state[CLOCK] & 0xFFF
    row, column, polarity = np.uint16(state[ROW]), state[COLUMN], state[POLARITY] != 0
    unusual = (state[STARTED] == 0) | (state[_ROW_SEEN] == 0) | (state[_OLD_HIGH] != 0)
    base_seen, dense = state[_BASE_SEEN] != 0, state[_DENSE]
    time = max(high + low, newest)
    count = np.uint64(0)
    for index in range(len(words)):
        word = words[index]
        kind = word >> 12
        value = np.int64(word & 0xFFF)
        if kind == 2:
            t_us[count] = time
            x[count] = np.uint16(value & 0x7FF)
            y[count] = row
            p[count] = value > 0x7FF
            newest = time
            count += np.uint64(1)
        elif kind == 0:
            row = np.uint16(value & 0x7FF)
        elif kind == 6:
            unusual |= low - value > JITTER_US
            low = value
            time = max(high + low, newest)
        elif kind == 4 or kind == 5:
            unusual |= not base_seen
            mask = value if kind == 4 else value & 0xFF
            end = count + np.uint64(SLACK)
            start = np.uint16(column)
            t_out, x_out, y_out, p_out = t_us[count:end], x[count:end], y[count:end], p[count:end]
            for place in range(SLACK):
                t_out[place] = time
            for place in range(SLACK):
                x_out[place] = start + np.uint16(places[mask, place])
            for place in range(SLACK):
                y_out[place] = row
            for place in range(SLACK):
                p_out[place] = polarity
            newest = time if mask else newest
            column += 12 if kind == 4 else 8
            count += counts[mask]
        elif kind == 3:
            column = value & 0x7FF
            polarity = value > 0x7FF
            base_seen = True
        elif kind == 8:
            new = base + (value << 12)
            unusual |= (new < high) | (new > high + (NEAR << 12))
            dense += 1
            low = low if new == high else np.int64(0)
            high = new
            time = max(high + low, newest)
        else:
            unusual |= kind != 7 and kind != 14 and kind != 15
    events = np.int64(count)
    if unusual or _largest(x[:events]) >= width or _largest(y[:events]) >= height:
        return np.int64(-1)
    state[CLOCK], state[NEWEST] = (high - base) | low, newest
    state[ROW], state[COLUMN], state[POLARITY], state[_BASE_SEEN] = row, column, polarity, base_seen
    state[_DENSE] = dense
    return events


@njit(cache=True)
def _decode_block(words, state, places, counts, t_us, x, y, p, width, height):
    count = 0
    for first in range(0, len(words), CHUNK):
        chunk = words[first : first + CHUNK]
        out = t_us[count:], x[count:], y[count:], p[count:]
        found = _decode_chunk(chunk, state, places, counts, *out, width, height)
        if found < 0:
            found = _decode_carefully(words, first, first + len(chunk), state, *out, width, height)
        count += found
    return count


@cache
def _mask_table() -> tuple[NDArray[np.uint8], NDArray[np.uint64]]:
    """Return the places of the bits set in each mask of 12, and how many they are."""
    places = np.zeros((4096, SLACK), np.uint8)
    for mask in range(4096):
        bits = [bit for bit in range(12) if mask >> bit & 1]
        places[mask, : len(bits)] = bits
    return places, np.bitwise_count(np.arange(4096, dtype=np.uint16)).astype(np.uint64)


def decode_evt3(words, state, t_us, x, y, p, width, height):
    """Decode a block: quickly, and once more with care where a chunk holds anything unusual."""
    return _decode_block(words, state, *_mask_table(), t_us, x, y, p, width, height)
