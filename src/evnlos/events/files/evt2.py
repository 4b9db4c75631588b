"""EVT2 and EVT2.1: words of 32 and of 64 bits.

- EVT2: words of 32 bits, four of them the type; the time is 28 bits of a high word and 6 of the event.
- EVT2.1: words of 64 bits, each up to 32 neighbouring pixels of one row, time and polarity.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite.ir import Constant, IntType
from numba import njit
from numba.extending import intrinsic
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
_NO_EVENT = np.uint32(0x20000000)  # words of events are below
_GROUP = 16  # words that are looked at together
_MASKS = 1024  # words of EVT2.1 that are decoded at once

# Of each byte of a mask: where its bits are, as a column stands in a word.
_BITS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1, bitorder="little")
_COLUMNS = (np.argsort(1 - _BITS, axis=1, kind="stable") << 11).astype(np.uint32)


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
def _find_others(words, places):
    """Put the places of the words that are no events into `places`; return how many they are.

    Groups of words among which there is none are passed over in vector code. `places` has one more place
    than `words`: what is written behind the last one found is overwritten or left.
    """
    # Without a sign no access is checked for a negative index.
    size, group = np.uint64(len(words)), np.uint64(_GROUP)
    found = first = np.uint64(0)
    while first < size:
        bits, whole = np.uint32(0), first + group <= size
        if whole:
            for index in range(_GROUP):
                bits |= words[first + np.uint64(index)]
        if not whole or bits >= _NO_EVENT:
            for index in range(first, min(first + group, size)):
                places[found] = index
                found += np.uint64(words[index] >= _NO_EVENT)
        first += group
    return found


@njit(cache=True)
def _decode_chunk(words, state, places, t_us, x, y, p, width, height):
    """Decode words among which nothing is unusual; return the number of events, or -1 where something is.

    The events between two words of the clock are split into columns in one loop of vector code; their order
    and their places on the sensor are looked at afterwards.
    """
    high, newest, base = state[CLOCK], state[NEWEST], state[BASE]
    unusual = state[STARTED] == 0
    largest_x, largest_y = np.uint16(0), np.uint16(0)
    others = _find_others(words, places)
    places[others] = len(words)
    count = first = np.uint64(0)
    for other in range(others + np.uint64(1)):
        last = np.uint64(places[other])
        shift = first - count
        for index in range(count, last - shift):
            word = words[index + shift]
            column = np.uint16((word >> np.uint32(11)) & np.uint32(0x7FF))
            row = np.uint16(word & np.uint32(0x7FF))
            t_us[index] = base + np.int64((word >> np.uint32(22)) & np.uint32(0x3F))
            x[index] = column
            y[index] = row
            p[index] = (word >> np.uint32(28)) != 0
            largest_x = max(largest_x, column)
            largest_y = max(largest_y, row)
        count = last - shift
        if other < others:
            word = words[last]
            new = np.int64(word & 0xFFFFFFF)
            unusual |= (word >> 28) != 8 or new < high
            base += (new - high) << 6
            high = new
        first = last + np.uint64(1)
    found = np.int64(count)
    if found:
        unusual |= t_us[0] < newest or not is_ascending(t_us[:found])
        newest = t_us[found - 1]
    if unusual or largest_x >= width or largest_y >= height:
        return np.int64(-1)
    state[CLOCK], state[NEWEST], state[BASE] = high, newest, base
    return found


@njit(cache=True)
def decode_evt2(words, state, t_us, x, y, p, width, height):
    """Decode a block: quickly, and once more with care where a chunk holds anything unusual."""
    places = np.empty(CHUNK + 1, np.uint32)
    count = 0
    for first in range(0, len(words), CHUNK):
        chunk = words[first : first + CHUNK]
        out = t_us[count:], x[count:], y[count:], p[count:]
        found = _decode_chunk(chunk, state, places, *out, width, height)
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


def _bit_count(_, mask):
    """Return how many bits of `mask` are set."""

    def generate(_, builder, signature, arguments):
        return builder.ctpop(arguments[0])

    return mask(mask), generate


def _zeros_below(_, mask):
    """Return how many bits are below the lowest one of `mask` that is set."""

    def generate(_, builder, signature, arguments):
        return builder.cttz(arguments[0], Constant(IntType(1), 0))

    return mask(mask), generate


_count_bits: Any = intrinsic(_bit_count)  # (mask)
_count_below: Any = intrinsic(_zeros_below)  # (mask)


@njit(cache=True)
def bound_evt21(words: NDArray[np.int64]) -> Any:
    """Return how many events `words` can hold at most."""
    count = np.int64(0)
    for index in range(len(words)):
        count += np.int64(_count_bits(np.uint32(words[index])))
    return count


@njit(cache=True)
def bound_evt21_swapped(words: NDArray[np.int64]) -> Any:
    """Return how many events `words` can hold at most when the fields lie in their low halves."""
    count = np.int64(0)
    for index in range(len(words)):
        count += np.int64(_count_bits(np.uint32(words[index] >> 32)))
    return count


@njit(cache=True)
def _decode_masks_carefully(words, first, state, t_us, x, y, p, width, height, swapped):
    """Decode word by word and note every fault; `first` is the number of the first word in its block."""
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
                note(state, UNDATED, first + index)
                continue
            row, column = fields & 0x7FF, (fields >> 11) & 0x7FF
            time = base + ((fields >> 22) & 0x3F)
            if time < newest:
                if time < newest - JITTER_US:
                    note(state, BACKWARDS, first + index)
                else:
                    time = newest
            newest = time
            while mask:
                if mask & 1:
                    if column >= width or row >= height:
                        note(state, OUT_OF_RANGE, first + index)
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
                    note(state, CLOCK_BACK, first + index)
                    newest = base + ((new - high) << 6)
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
def _spread(halves, swapped, events):
    """Write one word of EVT2 for each bit of each mask, and every other word as it is; return how many.

    The upper half of a word (the lower, where `swapped`) is a word of EVT2, the other a mask of columns from
    there on. Eight bits write eight places, and the events among them stay. -1 is returned where a column may
    pass the 11 bits that it has, or a mask is empty.
    """
    count, is_unusual = np.uint64(0), False
    upper, lower = np.uint64(not swapped), np.uint64(swapped)
    for index in range(np.uint64(len(halves)) // np.uint64(2)):
        fields = np.uint32(halves[np.uint64(2) * index + upper])
        mask = np.uint32(halves[np.uint64(2) * index + lower])
        if fields >= _NO_EVENT:
            mask = np.uint32(1)
        else:
            is_unusual |= mask == 0 or (fields & np.uint32(0x3FF800)) > np.uint32(2016 << 11)
        if mask & np.uint32(mask - np.uint32(1)):
            for _ in range(4):
                byte = np.uint32(mask & np.uint32(0xFF))
                for place in range(np.uint64(8)):
                    events[count + place] = fields + _COLUMNS[byte, place]
                count += np.uint64(_count_bits(byte))
                fields += np.uint32(8 << 11)
                mask >>= np.uint32(8)
        else:
            events[count] = fields + (_count_below(mask) << np.uint32(11))
            count += np.uint64(1)
    return np.int64(-1) if is_unusual else np.int64(count)


@njit(cache=True)
def _decode_masks(words, state, t_us, x, y, p, width, height, swapped):
    """Decode a block by way of EVT2: quickly, and once more with care where a chunk holds anything unusual."""
    events, places = np.empty(32 * _MASKS + 8, np.uint32), np.empty(32 * _MASKS + 1, np.uint32)
    halves = words.view(np.uint32)
    count = 0
    for first in range(0, len(words), _MASKS):
        chunk = words[first : first + _MASKS]
        out = t_us[count:], x[count:], y[count:], p[count:]
        found = _spread(halves[2 * first : 2 * (first + _MASKS)], swapped, events)
        if found >= 0:
            found = _decode_chunk(events[:found], state, places, *out, width, height)
        if found < 0:
            found = _decode_masks_carefully(chunk, first, state, *out, width, height, swapped)
        count += found
    return count


def decode_evt21(words, state, t_us, x, y, p, width, height):
    """Decode words whose fields lie in the high half."""
    return _decode_masks(words, state, t_us, x, y, p, width, height, False)


def decode_evt21_swapped(words, state, t_us, x, y, p, width, height):
    """Decode words whose fields lie in the low half."""
    return _decode_masks(words, state, t_us, x, y, p, width, height, True)
