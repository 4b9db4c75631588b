"""Bit errors in the clock words (TIME_HIGH) of EVT3, which cameras are known to send.

A reader that takes such a word for a turn of the clock shifts all that follows by 2^24 us, 16.77 s.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from evnlos.events.files.words import JITTER_US

_ENOUGH = 8  # clock words in a row that were near each other: only a clock that runs on can jump
NEAR = 10
"""Steps of TIME_HIGH, 4.096 ms each, that a clock makes in a recording without long silences."""
_MOST_WRONG = 3  # clock words in a row that a bit error spoils


@njit(cache=True)
def _likeliest(wrong, high, span, is_low_back):
    """Return the one of high..high + span that the fewest wrong bits make `wrong`.

    Of equal ones it is `high` itself, or, where the low part of the time began anew, the next.
    """
    best, fewest = high, 99
    for step in range(span + 1):
        value = (high + step) & 0xFFF
        bits, count = value ^ wrong, 0
        while bits:
            bits &= bits - 1
            count += 1
        if count < fewest or (count == fewest and step == 1 and is_low_back):
            best, fewest = value, count
    return best


@njit(cache=True)
def mend_clock(words, index, high, low, dense):
    """Return the high part of the time where the TIME_HIGH at `index` is a bit error of the camera.

    It is one where the clock jumps there, and the next clock words stand where it was. A turn of the clock
    is no such jump, nor are the two words 0xfff and 0x000 by which a writer tells of a turn without events.

    Args:
        words: EVT3 words.
        index: Number of the TIME_HIGH.
        high: High part of the time before it.
        low: Low part of the time before it.
        dense: Clock words in a row before it that were near each other.

    Returns:
        The right high part; -1 where the word is good, -2 where that is to be seen in words that follow.
    """
    new = np.int64(words[index]) & 0xFFF
    if (new - high) & 0xFFF <= NEAR or dense < _ENOUGH:
        return -1
    if new == 0xFFF and index + 1 < len(words) and words[index + 1] == 0x8000:
        return -1
    wrong, next_low = 1, np.int64(-1)
    for place in range(index + 1, len(words)):
        kind, value = words[place] >> 12, np.int64(words[place]) & 0xFFF
        if kind == 6 and next_low < 0:
            next_low = value
        elif kind == 8:
            if (value - high) & 0xFFF <= NEAR:
                return _likeliest(new, high, (value - high) & 0xFFF, 0 <= next_low < low - JITTER_US)
            wrong += 1
            if wrong > _MOST_WRONG or (value - new) & 0xFFF > 1:
                return -1
    return -2
