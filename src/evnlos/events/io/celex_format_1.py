"""CeleX-V payloads of event format 1 (intensity of 12 bits, time in the pixel): the paper's camera.

A chunk is decoded in stages, each a short loop that is vector code or waits for memory as little as it can.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from evnlos.events.io.celex_state import (
    DIVISOR,
    FIRST_OUTSIDE,
    FIRST_UNKNOWN,
    HEIGHT,
    OUTSIDE,
    ROW,
    ROW_SEEN,
    SKIPPED,
    STAMP,
    TICK,
    TIME_SEEN,
    TIME_US,
    UNKNOWN,
    WIDTH,
    advance,
    lanes_of,
    note,
)
from evnlos.events.prefetch import prefetch

CHUNK = 8192  # groups that are decoded at once, on the assumption that nothing is wrong with them
SCRATCH = 3 * CHUNK  # 64-bit integers
_MAX_TICK = 1 << 38  # three weeks and more
_AHEAD = 128  # events between asking for a pixel and using it
U64 = tuple(np.uint64(value) for value in range(256))  # a signed constant would make signed arithmetic


@njit(cache=True)
def _carefully_1(data, first, state, t_us, x, y, p, adc, known, last):
    """Decode group by group and note every fault; `first` is the place of the data in the package."""
    row, row_seen = state[ROW], state[ROW_SEEN] != 0
    time = state[TIME_US]
    count = 0
    for group in range(len(data) // 7):
        at = 7 * group
        s0, s1, s2, s3 = lanes_of(data, at)
        for half in range(2):
            word = (s3 << 14) | s2 if half else (s1 << 14) | s0
            kind = word & 3
            if kind == 1:
                column = (word >> 5) & 0x7FF
                if not row_seen:
                    state[SKIPPED] += 1
                elif column >= WIDTH or row >= HEIGHT:
                    note(state, OUTSIDE, FIRST_OUTSIDE, first + at)
                else:
                    intensity = 4095 - (word >> 16)
                    before = np.int64(last[row, column])
                    last[row, column] = intensity
                    t_us[count] = time
                    x[count] = column
                    y[count] = row
                    adc[count] = intensity
                    known[count] = (before >= 0) & (before != intensity)
                    p[count] = (before >= 0) & (before < intensity)
                    count += 1
            elif kind == 2:
                row = word >> 18
                row_seen = True
                advance(state, (word >> 2) & 0xFFFF, 1 << 16)
                time = state[TIME_US]
            elif kind == 3:
                note(state, UNKNOWN, FIRST_UNKNOWN, first + at)
    state[ROW], state[ROW_SEEN] = row, row_seen
    return count


@njit(cache=True)
def _unpack_words(data, words, groups):
    """Put the two words of 28 bits of each group of 7 bytes into `words`.

    The first four bytes of a group are the high 8 bits of its lanes, the other three their low 6 bits. Eight
    groups are seven integers of 64 bits: taking them apart by shifts is what becomes vector code. The halves of
    a group are moved apart first, so that one shift then serves both words. `groups` is scratch.
    """
    count = len(data) // 7
    whole = count // 8 * 8
    eight = data[: 7 * whole].view(np.uint64)
    for block in range(whole // 8):
        first, place = np.uint64(7 * block), np.uint64(8 * block)
        w0, w1, w2, w3 = eight[first], eight[first + U64[1]], eight[first + U64[2]], eight[first + U64[3]]
        w4, w5, w6 = eight[first + U64[4]], eight[first + U64[5]], eight[first + U64[6]]
        groups[place] = w0
        groups[place + U64[1]] = (w0 >> U64[56]) | (w1 << U64[8])
        groups[place + U64[2]] = (w1 >> U64[48]) | (w2 << U64[16])
        groups[place + U64[3]] = (w2 >> U64[40]) | (w3 << U64[24])
        groups[place + U64[4]] = (w3 >> U64[32]) | (w4 << U64[32])
        groups[place + U64[5]] = (w4 >> U64[24]) | (w5 << U64[40])
        groups[place + U64[6]] = (w5 >> U64[16]) | (w6 << U64[48])
        groups[place + U64[7]] = w6 >> U64[8]
    for group in range(whole, count):
        value = U64[0]
        for step in range(7):
            value |= np.uint64(data[7 * group + step]) << np.uint64(8 * step)
        groups[group] = value
    pairs = words.view(np.uint64)
    two_bytes, two_lows = np.uint64(0xFFFF), np.uint64(0xFFF)
    for group in range(count):
        v = groups[group]
        high = (v & two_bytes) | ((v << U64[16]) & (two_bytes << U64[32]))
        low = (v >> U64[32]) | ((v >> U64[12]) & (two_lows << U64[32]))
        pair = (low & np.uint64(0x3F_0000_003F)) | ((low & np.uint64(0xFC0_0000_0FC0)) << U64[8])
        pair |= (high & np.uint64(0xFF_0000_00FF)) << U64[6]
        pairs[group] = pair | ((high & np.uint64(0xFF00_0000_FF00)) << U64[12])


@njit(cache=True)
def _place_words(words, state, events, t_us, y):
    """Give the events among `words` their row and time; return how many, or -1 where anything is unusual.

    `events` receives the words that are events.
    """
    row, time = np.uint32(state[ROW]), state[TIME_US]
    tick, stamp = state[TICK], np.uint32(state[STAMP])
    lowest, strange = row, np.uint32(0)
    microseconds = 1024.0 / np.float64(state[DIVISOR])  # a tick
    count = np.uint64(0)  # without a sign no access is checked for a negative index
    for word in words:
        kind = word & np.uint32(3)
        if kind == 1:
            events[count], t_us[count], y[count] = word, time, row
            count += U64[1]
        elif kind == 2:
            row = word >> np.uint32(18)
            lowest = max(lowest, row)
            new = (word >> np.uint32(2)) & np.uint32(0xFFFF)
            tick += np.int64((new - stamp) & np.uint32(0xFFFF))
            stamp = new
            # Exact below _MAX_TICK: x + 1/2 is 1 / 280 or more from a whole number, its error below 1 / 800.
            time = np.int64(np.float64(tick) * microseconds + 0.5)
        else:
            strange |= kind
    unusual = (strange != 0) | (lowest >= HEIGHT) | (tick >= _MAX_TICK)
    if unusual or state[ROW_SEEN] == 0 or state[TIME_SEEN] == 0:
        return np.int64(-1)
    state[ROW], state[TIME_US], state[TICK], state[STAMP] = row, time, tick, stamp
    return np.int64(count)


@njit(cache=True)
def _unpack_events(events, x, adc):
    """Split events into column and intensity, one loop each for vector code; return the largest column."""
    largest = np.uint16(0)
    for index in range(len(events)):
        column = np.uint16((events[index] >> np.uint32(5)) & np.uint32(0x7FF))
        x[index] = column
        largest = max(largest, column)
    for index in range(len(events)):
        adc[index] = np.uint16(4095) - np.uint16(events[index] >> np.uint32(16))
    return largest


@njit(cache=True)
def _exchange(pixels, adc, flat, before):
    """Put each event's intensity into the map and what stood there into `before`.

    The map is larger than the nearest caches, and what is written out pushes it from them: a place is asked for
    some time before its turn. Rows are longer than four events, mostly.
    """
    count, four = np.uint64(len(pixels)), U64[4]
    near = (max(count, U64[_AHEAD]) - U64[_AHEAD]) // four * four
    for first in range(U64[0], near, four):
        prefetch(flat, np.uint64(pixels[first + U64[_AHEAD]]))
        for step in range(four):
            pixel = pixels[first + step]
            before[first + step] = flat[pixel]
            flat[pixel] = np.int16(adc[first + step])
    for index in range(near, count):
        pixel = pixels[index]
        before[index] = flat[pixel]
        flat[pixel] = np.int16(adc[index])


@njit(cache=True)
def _sign_of_change(x, y, adc, flat, p, known, pixels, before):
    """Set p and known from the change since each pixel's last intensity, and keep the new one in `flat`.

    `pixels` and `before`, as long as the events, are scratch.
    """
    for index in range(len(x)):
        pixels[index] = np.uint32(y[index]) * np.uint32(WIDTH) + np.uint32(x[index])
    _exchange(pixels, adc, flat, before)
    for index in range(len(x)):
        then, now = before[index], np.int16(adc[index])
        known[index] = (then >= 0) & (then != now)
        p[index] = (then >= 0) & (then < now)


@njit(cache=True)
def decode_format_1(data, state, t_us, x, y, p, adc, known, last, scratch):
    """Decode groups of 7 bytes (intensity, 12 bits): quickly, and with care where a chunk is unusual.

    `scratch`, uint64 [SCRATCH], is the caller's: memory that is taken anew for each package is mapped anew.
    """
    groups, words = scratch[:CHUNK], scratch[CHUNK : 2 * CHUNK].view(np.uint32)
    events = scratch[2 * CHUNK : 3 * CHUNK].view(np.uint32)
    pixels, before = words, groups.view(np.int16)  # in the place of what is used no more
    flat = last.ravel()
    count, step = 0, 7 * CHUNK
    for first in range(0, len(data) // 7 * 7, step):
        chunk = data[first : first + step]
        _unpack_words(chunk, words, groups)
        held = state[ROW], state[TIME_US], state[TICK], state[STAMP]
        found = _place_words(words[: len(chunk) // 7 * 2], state, events, t_us[count:], y[count:])
        end = count + found
        if found >= 0 and _unpack_events(events[:found], x[count:end], adc[count:end]) < WIDTH:
            columns = x[count:end], y[count:end], adc[count:end], flat, p[count:end], known[count:end]
            _sign_of_change(*columns, pixels[:found], before[:found])
            count = end
        else:
            state[ROW], state[TIME_US], state[TICK], state[STAMP] = held
            out = t_us[count:], x[count:], y[count:], p[count:], adc[count:], known[count:]
            count += _carefully_1(chunk, first, state, *out, last)
    return count
