"""Reading EVT3: words of 16 bits that change one thing at a time (row, column, time) or add 8 or 12 pixels."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.events.files.columns import is_ascending
from evnlos.events.files.words import (
    BACKWARDS,
    BASE,
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
    hold_back,
    mend_clock,
    note,
    sum_table,
)

WRAP_US = 1 << 24
_HIGH_TURN = 1 << 12
_CHUNK = 4096  # words
_GROUPS = 13  # whether the chunk before held vectors or their bases
# Kinds of word, a bit each: unknown; vectors; vectors and their bases.
_UNKNOWN, _VECTORS, _OF_VECTORS = np.uint32(1 << 1), np.uint32(3 << 4), np.uint32(7 << 3)
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


def bound_evt3(words: NDArray[np.uint16]) -> int:
    """Return how many events `words` can hold at most."""
    return int(sum_table(words, _events_per_word()))


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


class _Scratch(NamedTuple):
    """Room for one chunk; what is used of it stays in the first-level cache.

    | symbol | meaning | of |
    |---|---|---|
    | clock | word of the low time that holds | each word |
    | word | the word itself | each word with events |
    | held | columns since the base of vectors, row, low time, base: 16 bits each | each word with events |
    | events | column, row, low time, sign: the words that hold them, 16 bits each | each event |
    | fields, parts | the memory of `held` and `events`, in 16 bits | |
    """

    clock: NDArray[np.uint16]
    word: NDArray[np.uint16]
    held: NDArray[np.uint64]
    events: NDArray[np.uint64]
    fields: NDArray[np.uint16]
    parts: NDArray[np.uint16]


def _scratch() -> _Scratch:
    clock, word = np.empty(_CHUNK, np.uint16), np.empty(_CHUNK, np.uint16)
    held, events = np.empty(_CHUNK, np.uint64), np.empty(12 * (_CHUNK + 1), np.uint64)
    return _Scratch(clock, word, held, events, held.view(np.uint16), events.view(np.uint16))


@njit(cache=True)
def _gather_singles(words, seen, low, row, scratch):
    """Note row and low time of each single event up to the next high time; there are no vectors.

    Every word writes, and an event moves on: a branch would be mispredicted at every third word. Places are
    counted without a sign, or every access would be checked for a negative index. Returned are the words that
    were taken, the events, the kinds of word seen, and the words of low time and row that hold then.
    """
    clock, parts = scratch.clock, scratch.parts
    at, count, size = np.uint64(0), np.uint64(0), np.uint64(len(words))
    while at < size:
        word = words[at]
        if word >= 0x8000:
            break
        kind = word >> 12
        seen |= np.uint32(1) << np.uint32(kind)
        row = word if word < 0x1000 else row
        low = word if kind == 6 else low
        clock[at] = low
        place = np.uint64(4) * count
        parts[place] = word
        parts[place + np.uint64(1)] = row
        parts[place + np.uint64(2)] = low
        count += np.uint64(kind == 2)
        at += np.uint64(1)
    return np.int64(at), np.int64(count), seen, low, row


@njit(cache=True)
def _gather_groups(words, seen, low, row, base, shift, scratch):
    """Note what holds at each word with events, single ones or vectors, up to the next high time.

    Returned are the words that were taken, those with events, the kinds seen, and what holds then.
    """
    clock, fields, kept = scratch.clock, scratch.fields, scratch.word
    at, count, size = np.uint64(0), np.uint64(0), np.uint64(len(words))
    while at < size:
        word = words[at]
        if word >= 0x8000:
            break
        kind = np.uint32(word >> 12)
        seen |= np.uint32(1) << kind
        row = word if word < 0x1000 else row
        low = word if kind == 6 else low
        clock[at] = low
        place = np.uint64(4) * count
        fields[place] = shift
        fields[place + np.uint64(1)] = row
        fields[place + np.uint64(2)] = low
        fields[place + np.uint64(3)] = base
        kept[count] = word
        step = np.uint16(0x8C0000 >> 4 * kind & 0xF)  # kind 4 has 12 columns, kind 5 has 8
        shift = np.uint16(0) if kind == 3 else np.uint16(shift + step)
        base = word if kind == 3 else base
        count += np.uint64(0x34 >> kind & 1)  # kinds 2, 4 and 5
        at += np.uint64(1)
    return np.int64(at), np.int64(count), seen, low, row, base, shift


@njit(cache=True)
def _expand(count, places, counts, scratch):
    """Make events of `count` words with events; return their number.

    Each writes 6 or 12 places of its mask's row, which is faster than looking at each bit.
    """
    masks, held = scratch.word[:count], scratch.held[:count]
    for index in range(count):  # vector code: words become masks, bases columns and signs
        word, value, kind = masks[index], held[index], masks[index] >> 12
        single = (
            value & np.uint64(0xFFFFFFFF0000)
            | np.uint64(word & np.uint16(0x7FF))
            | np.uint64(word) << np.uint64(48)
        )
        held[index] = single if kind == 2 else value + (value >> np.uint64(48) & np.uint64(0x7FF))
        mask = word & np.uint16(0xFFF if kind == 4 else 0xFF)
        masks[index] = np.uint16(1) if kind == 2 else mask
    filled, events = np.uint64(0), scratch.events
    for index in range(np.uint64(count)):
        mask, value = np.uint64(masks[index]), held[index]
        many = np.uint64(counts[mask])
        for place in range(np.uint64(6)):
            events[filled + place] = value + np.uint64(places[mask, place])
        if many > 6:
            for place in range(np.uint64(6), np.uint64(12)):
                events[filled + place] = value + np.uint64(places[mask, place])
        filled += many
    return np.int64(filled)


@njit(cache=True)
def _unpack(events, high, column_mask, sign_place, t_us, x, y, p):
    """Fill the columns, one loop each for vector code; return the largest x and y."""
    largest_x, largest_y = np.uint16(0), np.uint16(0)
    for index in range(len(t_us)):
        t_us[index] = high + np.int64(events[index] >> np.uint64(32) & np.uint64(0xFFF))
    for index in range(len(x)):
        column = np.uint16(events[index] & column_mask)
        x[index] = column
        largest_x = max(largest_x, column)
    for index in range(len(y)):
        row = np.uint16(events[index] >> np.uint64(16) & np.uint64(0x7FF))
        y[index] = row
        largest_y = max(largest_y, row)
    for index in range(len(p)):
        p[index] = (events[index] >> sign_place & np.uint64(1)) != 0
    return largest_x, largest_y


@njit(cache=True)
def _decode_chunk(words, has_vectors, state, places, counts, scratch, t_us, x, y, p, width, height):
    """Decode words among which nothing is unusual, and no vectors unless `has_vectors`.

    Returned is the number of events; -1 where something is unusual, -2 where vectors are.
    """
    if state[STARTED] == 0 or state[_ROW_SEEN] == 0 or state[_OLD_HIGH] != 0 or state[COLUMN] > 0x7FF:
        return np.int64(-1)
    seen = np.uint32(0)
    newest, dense = state[NEWEST], state[_DENSE]
    high = state[BASE] + (state[CLOCK] & ~np.int64(0xFFF))
    low, row = np.uint16(0x6000 | (state[CLOCK] & 0xFFF)), np.uint16(state[ROW])
    base, shift = np.uint16(0x3000 | (state[POLARITY] << 11) | (state[COLUMN] & 0x7FF)), np.uint16(0)
    first = count = 0
    while first < len(words):
        kind = words[first] >> 12
        if 8 < kind < 14:
            return np.int64(-1)
        if kind >= 14:
            first += 1
            continue
        if kind == 8:
            new = state[BASE] + (np.int64(words[first] & 0xFFF) << 12)
            if new < high or new > high + (NEAR << 12):
                return np.int64(-1)
            low = low if new == high else np.uint16(0x6000)
            high = new
            dense += 1
            first += 1
            continue
        before = low
        if has_vectors:
            taken, groups, seen, low, row, base, shift = _gather_groups(
                words[first:], seen, low, row, base, shift, scratch
            )
            found = _expand(groups, places, counts, scratch)
            column_mask, sign_place = np.uint64(0xFFFF), np.uint64(59)
        else:
            taken, found, seen, low, row = _gather_singles(words[first:], seen, low, row, scratch)
            column_mask, sign_place = np.uint64(0x7FF), np.uint64(11)
        first += taken
        events, clock = scratch.events[:found], scratch.clock[:taken]
        latest = np.int64(before & 0xFFF)
        is_behind = newest > high + latest or clock[0] < before or not is_ascending(clock)
        if is_behind and hold_back(clock, latest, events, max(newest - high, np.int64(0))):
            return np.int64(-1)
        end = count + found
        out = t_us[count:end], x[count:end], y[count:end], p[count:end]
        largest_x, largest_y = _unpack(events, high, column_mask, sign_place, *out)
        if largest_x >= width or largest_y >= height:
            return np.int64(-1)
        newest = t_us[end - 1] if found else newest
        count = end
    if seen & _OF_VECTORS and not has_vectors:
        return np.int64(-2)
    if seen & _UNKNOWN or (seen & _VECTORS and not state[_BASE_SEEN]):
        return np.int64(-1)
    state[_GROUPS] = seen & _OF_VECTORS != 0
    state[_BASE_SEEN] |= seen >> 3 & 1
    state[CLOCK], state[NEWEST], state[_DENSE] = (high - state[BASE]) | np.int64(low & 0xFFF), newest, dense
    state[ROW], state[COLUMN], state[POLARITY] = row & 0x7FF, np.int64(base & 0x7FF) + shift, base >> 11 & 1
    return count


@njit(cache=True)
def _decode_block(words, state, places, counts, scratch, t_us, x, y, p, width, height):
    count = 0
    for first in range(0, len(words), _CHUNK):
        chunk = words[first : first + _CHUNK]
        out = t_us[count:], x[count:], y[count:], p[count:]
        found = _decode_chunk(chunk, state[_GROUPS] != 0, state, places, counts, scratch, *out, width, height)
        if found == -2:
            found = _decode_chunk(chunk, True, state, places, counts, scratch, *out, width, height)
        if found < 0:
            found = _decode_carefully(words, first, first + len(chunk), state, *out, width, height)
        count += found
    return count


@cache
def _mask_table() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the places of the bits set in each mask of 12, and how many they are."""
    places = np.zeros((4096, 12), np.uint8)
    for mask in range(4096):
        bits = [bit for bit in range(12) if mask >> bit & 1]
        places[mask, : len(bits)] = bits
    return places, np.bitwise_count(np.arange(4096, dtype=np.uint16))


def decode_evt3(words, state, t_us, x, y, p, width, height):
    """Decode a block: quickly, and once more with care where a chunk holds anything unusual."""
    return _decode_block(words, state, *_mask_table(), _scratch(), t_us, x, y, p, width, height)
