"""Payloads of CeleX-V recordings to events and back, for each event format.

- The state that a CeleX-V decoder carries from package to package: row, row time, and a tally of faults.

CeleX-V payloads of event format 1 (intensity of 12 bits, time in the pixel): the paper's camera.

A chunk is decoded in stages, each a short loop that is vector code or waits for memory as little as it can.

- CeleX-V payloads of event formats 0 and 2 to events, and lanes back to bytes.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from evnlos.events.volume import prefetch

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

    The map is larger than the nearest caches, and what is written out pushes it from them: a place is requested
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
