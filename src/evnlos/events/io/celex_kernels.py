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
CHUNK = 4096  # groups that are decoded at once, on the assumption that nothing is wrong with them
EVENTS_A_GROUP = (1, 2, 4)
SCRATCH = 9 * CHUNK + 16  # 64-bit integers
_MAX_TICK = 1 << 39  # three weeks and more
U64 = tuple(np.uint64(value) for value in range(256))  # a signed constant would make signed arithmetic


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
def _unpack_words(data, words, groups):
    """Put the two words of 28 bits of each group of 7 bytes into `words`.

    The first four bytes of a group are the high 8 bits of its lanes, the other three their low 6 bits. Eight
    groups are seven integers of 64 bits: taking them apart by shifts is what becomes vector code. `groups` is
    scratch.
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
    low, high = U64[0x3F], U64[0xFF]
    for group in range(count):
        v = groups[group]
        first = ((v >> U64[32]) & low) | ((v & high) << U64[6])
        first |= (((v >> U64[38]) & low) << U64[14]) | (((v >> U64[8]) & high) << U64[20])
        second = ((v >> U64[44]) & low) | (((v >> U64[16]) & high) << U64[6])
        second |= (((v >> U64[50]) & low) << U64[14]) | (((v >> U64[24]) & high) << U64[20])
        pairs[group] = first | (second << U64[32])


@njit(cache=True)
def _spread(row_times, row_words, row_starts, t_us, y):
    """Write time and place of each row to its events, 16 at a time.

    Few rows are longer, so that hardly a branch is taken wrongly; what is written beyond a row's end is
    overwritten by the next.
    """
    room = np.uint64(min(len(t_us), len(y)))
    for row in range(np.uint64(len(row_times))):
        start, stop = row_starts[row], row_starts[row + U64[1]]
        time, line = row_times[row], np.uint16(row_words[row])
        if start + U64[16] <= room:
            block_t, block_y = t_us[start : start + U64[16]], y[start : start + U64[16]]
            for place in range(16):
                block_t[place] = time
            for place in range(16):
                block_y[place] = line
            start += U64[16]
        for event in range(start, stop):
            t_us[event] = time
            y[event] = line


@njit(cache=True)
def _place_words(words, state, events, t_us, y, row_words, row_times, row_starts):
    """Give the events among `words` their row and time; return how many, or -1 where anything is unusual.

    Nobody can predict where the next row starts, so the first loop has no branch: it counts events and rows.
    Places are counted without a sign, or every access would be checked for a negative index. `row_starts`
    receives the first event of each row. It, `row_words` and `row_times` are scratch, two longer than `words`.
    """
    one = U64[1]
    count, rows = np.uint64(0), np.uint64(1)  # row 0 is the one that goes on from before
    strange = np.uint64(0)
    for pair in range(np.uint64(len(words) // 2)):  # by twos: half as many sums that wait for the one before
        first, second = words[pair + pair], words[pair + pair + one]
        is_event, is_row = np.uint64(first) & one, (np.uint64(first) >> one) & one
        is_event_2, is_row_2 = np.uint64(second) & one, (np.uint64(second) >> one) & one
        count_2, rows_2 = count + is_event, rows + is_row
        events[count], row_words[rows], row_starts[rows] = first, first, count
        events[count_2], row_words[rows_2], row_starts[rows_2] = second, second, count_2
        strange |= (is_event & is_row) | (is_event_2 & is_row_2)
        count += is_event + is_event_2
        rows += is_row + is_row_2
    row_starts[0], row_starts[rows] = U64[0], count
    row_words[0] = np.uint32(state[ROW]) << np.uint32(18)
    row_times[0] = state[TIME_US]
    tick, stamp = state[TICK], state[STAMP]
    for row in range(U64[1], rows):
        new = np.int64((row_words[row] >> np.uint32(2)) & np.uint32(0xFFFF))
        tick += (new - stamp) & 0xFFFF
        stamp = new
        row_times[row] = tick
    divisor = np.float64(state[DIVISOR])
    for row in range(U64[1], rows):  # exact below _MAX_TICK: x + 1/2 is at least 1 / 280 from a whole number
        row_times[row] = np.int64(np.float64(row_times[row]) * 1024.0 / divisor + 0.5)
    lowest = np.uint32(0)
    for row in range(rows):
        row_words[row] = row_words[row] >> np.uint32(18)
        lowest = max(lowest, row_words[row])
    _spread(row_times[:rows], row_words[:rows], row_starts, t_us, y)
    last = rows - U64[1]
    unusual = (strange != 0) | (lowest >= HEIGHT) | (tick >= _MAX_TICK)
    if unusual or state[ROW_SEEN] == 0 or state[TIME_SEEN] == 0:
        return np.int64(-1)
    state[ROW], state[TIME_US] = np.int64(row_words[last]), row_times[last]
    state[TICK], state[STAMP] = tick, stamp
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
def _sign_of_change(x, y, adc, last, p, known, scratch, row_starts, before_all):
    """Set p and known from the change since each pixel's last intensity, and keep the new one.

    The map is larger than the nearest caches, and nothing is known about where the next row of events lies: its
    first place is fetched beforehand for many rows, all under way at once. Comparing in the next loop would
    be a branch that nobody can predict.
    """
    flat = last.ravel()
    for index in range(len(x)):
        scratch[index] = np.uint32(y[index]) * np.uint32(WIDTH) + np.uint32(x[index])
    fetched, row = np.int64(0), np.uint64(0)
    while row_starts[row] < np.uint64(len(x)):
        fetched += flat[scratch[row_starts[row]]]
        row += U64[1]
    row_starts[0] = np.uint64(fetched)  # or the loop would be left out as useless
    for index in range(len(x)):
        pixel = scratch[index]
        before_all[index] = flat[pixel]
        flat[pixel] = np.int16(adc[index])
    for index in range(len(x)):
        before, now = before_all[index], np.int16(adc[index])
        known[index] = (before >= 0) & (before != now)
        p[index] = (before >= 0) & (before < now)


@njit(cache=True)
def decode_format_1(data, state, t_us, x, y, p, adc, known, last, scratch):
    """Decode groups of 7 bytes (intensity, 12 bits): quickly, and with care where a chunk is unusual.

    `scratch`, uint64 [SCRATCH], is the caller's: memory that is taken anew for each package is mapped anew.
    """
    step, room = 7 * CHUNK, 2 * CHUNK + 4
    words, events = scratch[:CHUNK].view(np.uint32), scratch[CHUNK : 2 * CHUNK].view(np.uint32)
    groups = scratch[2 * CHUNK : 3 * CHUNK]
    row_times, row_starts = scratch[3 * CHUNK :][:room].view(np.int64), scratch[3 * CHUNK + room :][:room]
    row_words = scratch[3 * CHUNK + 2 * room :][: room // 2].view(np.uint32)
    before_all = scratch[3 * CHUNK + 2 * room + room // 2 :][: room // 4].view(np.int16)
    count = 0
    for first in range(0, len(data) // 7 * 7, step):
        chunk = data[first : first + step]
        size = len(chunk) // 7 * 2
        _unpack_words(chunk, words, groups)
        before = state[ROW], state[TIME_US], state[TICK], state[STAMP]
        out = t_us[count:], y[count:], row_words, row_times, row_starts
        found = _place_words(words[:size], state, events, *out)
        end = count + found
        if found >= 0 and _unpack_events(events[:found], x[count:end], adc[count:end]) < WIDTH:
            out = x[count:end], y[count:end], adc[count:end], last, p[count:end], known[count:end]
            _sign_of_change(*out, events, row_starts, before_all)
            count = end
        else:
            state[ROW], state[TIME_US], state[TICK], state[STAMP] = before
            out = t_us[count:], x[count:], y[count:], p[count:], adc[count:], known[count:]
            count += _carefully_1(chunk, first, state, *out, last)
    return count


@njit(cache=True)
def decode_format_2(data, state, t_us, x, y, p, adc, known, last, scratch):
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
