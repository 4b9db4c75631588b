"""CeleX-V payloads to rows, columns, ticks and intensities, and back."""

from __future__ import annotations

import numpy as np
from numba import njit

WIDTH, HEIGHT = 1280, 800
# Slots of the int64 state.
ROW, TICK, STAMP, ROW_SEEN, TIME_SEEN, SKIPPED, UNKNOWN, FIRST_UNKNOWN, OUTSIDE, FIRST_OUTSIDE = range(10)
DIVISOR, TIME_US = 10, 11
STATE_SIZE = 12
TURNS = (1 << 12, 1 << 16, 1 << 12)  # of the row time, for event formats 0, 1, 2
GROUP_BYTES = (3, 7, 7)
CHUNK = 1024  # groups that are decoded at once, on the assumption that nothing is wrong with them
EVENTS_A_GROUP = (1, 2, 4)


@njit(cache=True, inline="always")
def _note(state, count, first, place):
    if state[count] == 0:
        state[first] = place
    state[count] += 1


@njit(cache=True, inline="always")
def _advance(state, stamp, turn):
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
def decode_format_0(data, state, t_us, x, y, p, adc, known, last):
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
            _advance(state, ((v3 & 0x30) << 6) | (v1 << 2) | ((v3 >> 2) & 3), 1 << 12)
        elif kind == 1:
            column = ((v3 & 0xF0) << 3) | (v1 >> 1)
            if not state[ROW_SEEN]:
                state[SKIPPED] += 1
            elif column >= WIDTH or state[ROW] >= HEIGHT:
                _note(state, OUTSIDE, FIRST_OUTSIDE, 3 * group)
            else:
                t_us[count], x[count], y[count], adc[count] = state[TIME_US], column, state[ROW], v2
                before = last[state[ROW], column]
                known[count] = before >= 0 and before != v2
                p[count] = known[count] and v2 > before
                last[state[ROW], column] = v2
                count += 1
        elif kind == 3:
            _note(state, UNKNOWN, FIRST_UNKNOWN, 3 * group)
    return count


@njit(cache=True)
def _carefully_1(data, first, state, t_us, x, y, p, adc, known, last):
    """Decode group by group and note every fault; `first` is the place of the data in the package."""
    row, row_seen = state[ROW], state[ROW_SEEN] != 0
    time = state[TIME_US]
    count = 0
    for group in range(len(data) // 7):
        at = 7 * group
        b1, b2, b3, b4 = (
            np.int64(data[at]),
            np.int64(data[at + 1]),
            np.int64(data[at + 2]),
            np.int64(data[at + 3]),
        )
        b5, b6, b7 = np.int64(data[at + 4]), np.int64(data[at + 5]), np.int64(data[at + 6])
        s0 = (b1 << 6) | (b5 & 0x3F)
        s1 = (b2 << 6) | (b5 >> 6) | ((b6 & 0xF) << 2)
        s2 = (b3 << 6) | (b6 >> 4) | ((b7 & 3) << 4)
        s3 = (b4 << 6) | (b7 >> 2)
        for half in range(2):
            word = (s3 << 14) | s2 if half else (s1 << 14) | s0
            kind = word & 3
            if kind == 1:
                column = (word >> 5) & 0x7FF
                if not row_seen:
                    state[SKIPPED] += 1
                elif column >= WIDTH or row >= HEIGHT:
                    _note(state, OUTSIDE, FIRST_OUTSIDE, first + at)
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
                _advance(state, (word >> 2) & 0xFFFF, 1 << 16)
                time = state[TIME_US]
            elif kind == 3:
                _note(state, UNKNOWN, FIRST_UNKNOWN, first + at)
    state[ROW], state[ROW_SEEN] = row, row_seen
    return count


@njit(cache=True)
def _unpack_words(data, words):
    """Put the two words of 28 bits of each group of 7 bytes into `words`."""
    for group in range(len(data) // 7):
        at = 7 * group
        b5, b6, b7 = np.uint32(data[at + 4]), np.uint32(data[at + 5]), np.uint32(data[at + 6])
        s0 = (np.uint32(data[at]) << np.uint32(6)) | (b5 & np.uint32(0x3F))
        s1 = (
            (np.uint32(data[at + 1]) << np.uint32(6))
            | (b5 >> np.uint32(6))
            | ((b6 & np.uint32(0xF)) << np.uint32(2))
        )
        s2 = (
            (np.uint32(data[at + 2]) << np.uint32(6))
            | (b6 >> np.uint32(4))
            | ((b7 & np.uint32(3)) << np.uint32(4))
        )
        s3 = (np.uint32(data[at + 3]) << np.uint32(6)) | (b7 >> np.uint32(2))
        words[2 * group] = (s1 << np.uint32(14)) | s0
        words[2 * group + 1] = (s3 << np.uint32(14)) | s2


@njit(cache=True)
def _place_words(words, state, events, t_us, y):
    """Give the events among `words` their row and time; return how many, or -1 where anything is unusual.

    Places are counted without a sign, or every access would be checked for a negative index.
    """
    row, time, tick, stamp = np.uint16(state[ROW]), state[TIME_US], state[TICK], state[STAMP]
    divisor = state[DIVISOR]
    unusual = (state[ROW_SEEN] == 0) | (state[TIME_SEEN] == 0) | (state[ROW] >= HEIGHT)
    count = np.uint64(0)
    for word in words:
        kind = word & 3
        if kind == 1:
            events[count] = word
            t_us[count] = time
            y[count] = row
            count += np.uint64(1)
        elif kind == 2:
            row = np.uint16(word >> 18)
            unusual |= row >= HEIGHT
            new = np.int64((word >> 2) & 0xFFFF)
            if new != stamp:
                tick += (new - stamp) & 0xFFFF
                stamp = new
                time = (tick * 2048 + divisor) // (2 * divisor)
        else:
            unusual |= kind == 3
    if not unusual:
        state[ROW], state[TIME_US], state[TICK], state[STAMP] = row, time, tick, stamp
    return np.int64(-1) if unusual else np.int64(count)


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
def _sign_of_change(x, y, adc, last, p, known):
    """Set p and known from the change since each pixel's last intensity, and keep the new one."""
    flat = last.ravel()
    for index in range(len(x)):
        pixel = np.uint32(y[index]) * np.uint32(WIDTH) + np.uint32(x[index])
        before, now = flat[pixel], np.int16(adc[index])
        flat[pixel] = now
        known[index] = (before >= 0) & (before != now)
        p[index] = (before >= 0) & (before < now)


@njit(cache=True)
def decode_format_1(data, state, t_us, x, y, p, adc, known, last):
    """Decode groups of 7 bytes (intensity, 12 bits): quickly, and with care where a chunk is unusual."""
    step = 7 * CHUNK
    words, events = np.empty(2 * CHUNK, np.uint32), np.empty(2 * CHUNK, np.uint32)
    count = 0
    for first in range(0, len(data) // 7 * 7, step):
        chunk = data[first : first + step]
        size = len(chunk) // 7 * 2
        _unpack_words(chunk, words)
        before = state[ROW], state[TIME_US], state[TICK], state[STAMP]
        found = _place_words(words[:size], state, events, t_us[count:], y[count:])
        end = count + found
        if found >= 0 and _unpack_events(events[:found], x[count:end], adc[count:end]) < WIDTH:
            _sign_of_change(x[count:end], y[count:end], adc[count:end], last, p[count:end], known[count:end])
            count = end
        else:
            state[ROW], state[TIME_US], state[TICK], state[STAMP] = before
            out = t_us[count:], x[count:], y[count:], p[count:], adc[count:], known[count:]
            count += _carefully_1(chunk, first, state, *out, last)
    return count


@njit(cache=True)
def decode_format_2(data, state, t_us, x, y, p, adc, known, last):
    """Decode groups of 7 bytes into four lanes of 14 bits; return the number of events."""
    lanes = np.empty(4, np.int64)
    count = 0
    for group in range(len(data) // 7):
        at = 7 * group
        b1, b2, b3, b4 = (
            np.int64(data[at]),
            np.int64(data[at + 1]),
            np.int64(data[at + 2]),
            np.int64(data[at + 3]),
        )
        b5, b6, b7 = np.int64(data[at + 4]), np.int64(data[at + 5]), np.int64(data[at + 6])
        lanes[0] = (b1 << 6) | (b5 & 0x3F)
        lanes[1] = (b2 << 6) | (b5 >> 6) | ((b6 & 0xF) << 2)
        lanes[2] = (b3 << 6) | (b6 >> 4) | ((b7 & 3) << 4)
        lanes[3] = (b4 << 6) | (b7 >> 2)
        for lane in lanes:
            kind = lane & 3
            if kind == 1:
                column = lane >> 3
                if not (state[ROW_SEEN] and state[TIME_SEEN]):
                    state[SKIPPED] += 1
                elif column >= WIDTH or state[ROW] >= HEIGHT:
                    _note(state, OUTSIDE, FIRST_OUTSIDE, at)
                else:
                    t_us[count], x[count], y[count] = state[TIME_US], column, state[ROW]
                    p[count], known[count] = False, False
                    count += 1
            elif kind == 2:
                state[ROW] = lane >> 4
                state[ROW_SEEN] = 1
            elif kind == 3:
                _advance(state, lane >> 2, 1 << 12)
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
