"""EVT2 and EVT2.1: words of 32 and of 64 bits.

- EVT2: words of 32 bits, four of them the type; the time is 28 bits of a high word and 6 of the event.
- EVT2.1: words of 64 bits, each up to 32 neighbouring pixels of one row, time and polarity.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.events.files.columns import is_ascending
from evnlos.events.files.words import (
    BACKWARDS,
    BASE,
    CHUNK,
    CLOCK,
    CLOCK_BACK,
    JITTER_US,
    NEWEST,
    OUT_OF_RANGE,
    STARTED,
    TRIGGERS,
    UNDATED,
    UNKNOWN,
    note,
)

WRAP_US = 1 << 34
_HIGH_TURN = 1 << 28


def bound_evt2(words: NDArray[np.uint32]) -> int:
    """Return the largest number of events that `words` can hold."""
    return len(words)


@njit(cache=True)
def _decode_carefully(words, first, state, t_us, x, y, p, width, height):
    """Decode word by word and note every fault; `first` is the number of the first word in its block."""
    high, newest, base = state[CLOCK], state[NEWEST], state[BASE]
    started = state[STARTED] != 0
    count = 0
    for index in range(len(words)):
        word = np.int64(words[index])
        kind = word >> 28
        if kind <= 1:
            column = (word >> 11) & 0x7FF
            row = word & 0x7FF
            time = base + ((word >> 22) & 0x3F)
            if not started:
                note(state, UNDATED, first + index)
                continue
            if column >= width or row >= height:
                note(state, OUT_OF_RANGE, first + index)
                continue
            if time < newest:
                if time < newest - JITTER_US:
                    note(state, BACKWARDS, first + index)
                    newest = time
                else:
                    time = newest
            newest = time
            t_us[count] = time
            x[count] = column
            y[count] = row
            p[count] = kind == 1
            count += 1
        elif kind == 8:
            new = word & 0xFFFFFFF
            if started and new < high:
                if high - new > _HIGH_TURN // 2:
                    base += WRAP_US
                else:
                    note(state, CLOCK_BACK, first + index)
                    newest = base + ((new - high) << 6)  # one fault, not one more for each event behind it
            base += (new - high) << 6
            high = new
            started = True
        elif kind == 10:
            state[TRIGGERS] += 1
        elif kind != 14 and kind != 15:
            note(state, UNKNOWN, first + index)
    state[CLOCK], state[NEWEST], state[BASE], state[STARTED] = high, newest, base, started
    return count


@njit(cache=True)
def _unpack(words, x, y, p):
    """Split events into columns, one loop each for vector code; return the largest x and y."""
    largest_x, largest_y = np.uint16(0), np.uint16(0)
    for index in range(len(words)):
        column = np.uint16((words[index] >> np.uint32(11)) & np.uint32(0x7FF))
        x[index] = column
        largest_x = max(largest_x, column)
    for index in range(len(words)):
        row = np.uint16(words[index] & np.uint32(0x7FF))
        y[index] = row
        largest_y = max(largest_y, row)
    for index in range(len(words)):
        p[index] = (words[index] >> np.uint32(28)) != 0
    return largest_x, largest_y


@njit(cache=True)
def _decode_chunk(words, state, events, t_us, x, y, p, width, height):
    """Decode words among which nothing is unusual; return the number of events, or -1 where something is.

    Order, columns and geometry are looked at afterwards, in vector code.
    """
    high, newest, base = state[CLOCK], state[NEWEST], state[BASE]
    unusual = state[STARTED] == 0
    # Without a sign no access is checked for a negative index.
    size = np.uint64(len(words))
    count = first = np.uint64(0)
    while first < size:
        word = words[first]
        first += np.uint64(1)
        if word < 0x20000000:
            t_us[count] = base + np.int64((word >> np.uint32(22)) & np.uint32(0x3F))
            events[count] = word
            count += np.uint64(1)
        else:
            new = np.int64(word & 0xFFFFFFF)
            unusual |= (word >> 28) != 8 or new < high
            base += (new - high) << 6
            high = new
    found = np.int64(count)
    if found:
        unusual |= t_us[0] < newest
        newest = t_us[found - 1]
    if unusual or not is_ascending(t_us[:found]):
        return np.int64(-1)
    largest_x, largest_y = _unpack(events[:found], x[:found], y[:found], p[:found])
    if largest_x >= width or largest_y >= height:
        return np.int64(-1)
    state[CLOCK], state[NEWEST], state[BASE] = high, newest, base
    return found


@njit(cache=True)
def decode_evt2(words, state, t_us, x, y, p, width, height):
    """Decode a block: quickly, and once more with care where a chunk holds anything unusual."""
    events = np.empty(CHUNK, np.uint32)
    count = 0
    for first in range(0, len(words), CHUNK):
        chunk = words[first : first + CHUNK]
        out = t_us[count:], x[count:], y[count:], p[count:]
        found = _decode_chunk(chunk, state, events, *out, width, height)
        if found < 0:
            found = _decode_carefully(chunk, first, state, *out, width, height)
        count += found
    return count


_KNOWN = (0, 1, 8, 10, 14, 15)


def looks_swapped(words: NDArray[np.int64]) -> bool:
    """Return whether the fields lie in the low half of each word, as some sensors (IMX636) send them."""
    plain = np.isin((words >> 60) & 15, _KNOWN).sum()
    swapped = np.isin((words >> 28) & 15, _KNOWN).sum()
    if plain != swapped or not len(words):
        return bool(swapped > plain)
    return bool(((words[0] >> 28) & 15) == 8 and ((words[0] >> 60) & 15) != 8)


def bound_evt21(words: NDArray[np.int64]) -> int:
    """Return how many events `words` can hold at most."""
    return int(np.bitwise_count(words & 0xFFFFFFFF).sum())


def bound_evt21_swapped(words: NDArray[np.int64]) -> int:
    """Return how many events `words` can hold at most when the fields lie in their low halves."""
    return int(np.bitwise_count((words >> 32) & 0xFFFFFFFF).sum())


@njit(cache=True)
def _decode(words, state, t_us, x, y, p, width, height, swapped):
    high, newest, base = state[CLOCK], state[NEWEST], state[BASE]
    started = state[STARTED] != 0
    count = 0
    for index in range(len(words)):
        word = words[index]
        if swapped:
            fields, mask = word & 0xFFFFFFFF, (word >> 32) & 0xFFFFFFFF
        else:
            fields, mask = (word >> 32) & 0xFFFFFFFF, word & 0xFFFFFFFF
        kind = fields >> 28
        if kind <= 1:
            if not started:
                note(state, UNDATED, index)
                continue
            row, column = fields & 0x7FF, (fields >> 11) & 0x7FF
            time = base + ((fields >> 22) & 0x3F)
            if time < newest:
                if time < newest - JITTER_US:
                    note(state, BACKWARDS, index)
                else:
                    time = newest
            newest = time
            while mask:
                if mask & 1:
                    if column >= width or row >= height:
                        note(state, OUT_OF_RANGE, index)
                    else:
                        t_us[count] = time
                        x[count] = column
                        y[count] = row
                        p[count] = kind == 1
                        count += 1
                mask >>= 1
                column += 1
        elif kind == 8:
            new = fields & 0xFFFFFFF
            if started and new < high:
                if high - new > _HIGH_TURN // 2:
                    base += WRAP_US
                else:
                    note(state, CLOCK_BACK, index)
                    newest = base + ((new - high) << 6)
            base += (new - high) << 6
            high = new
            started = True
        elif kind == 10:
            state[TRIGGERS] += 1
        elif kind != 14 and kind != 15:
            note(state, UNKNOWN, index)
    state[CLOCK], state[NEWEST], state[BASE], state[STARTED] = high, newest, base, started
    return count


def decode_evt21(words, state, t_us, x, y, p, width, height):
    """Decode words whose fields lie in the high half."""
    return _decode(words, state, t_us, x, y, p, width, height, False)


def decode_evt21_swapped(words, state, t_us, x, y, p, width, height):
    """Decode words whose fields lie in the low half."""
    return _decode(words, state, t_us, x, y, p, width, height, True)
