"""Writing EVT3 words."""

from __future__ import annotations

import numpy as np
from numba import njit


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
