"""The fast decoder of CeleX-V's event format 1 against the format's description, word by word."""

import numpy as np
import pytest

from evnlos.events.files import celex_kernels as slots
from evnlos.events.files.celex_kernels import CHUNK, SCRATCH, decode_format_1, pack_lanes

WIDTH, HEIGHT = slots.WIDTH, slots.HEIGHT
GROUPS = CHUNK + 1001  # a whole chunk and a part of one
LATE = 2**38 - 2**29  # ticks: the last that are turned into microseconds in floats


def random_words(draw: np.random.Generator, longest_step: int) -> np.ndarray:
    """Return words of 28 bits: rows of a few events on a few pixels, and words that say nothing."""
    count = 2 * GROUPS
    kind = draw.choice([0, 1, 2], count, p=[0.05, 0.8, 0.15])
    kind[0] = 2
    stamps = np.cumsum(draw.integers(0, longest_step, count) * (kind == 2)) & 0xFFFF
    rows = draw.integers(0, 3, count) * (HEIGHT // 2 - 1)
    columns = draw.integers(0, 5, count) * ((WIDTH - 1) // 4)
    intensity = draw.integers(0, 3, count) * 2047  # often no change
    events, starts = intensity << 16 | columns << 5 | 1, rows << 18 | stamps << 2 | 2
    return np.where(kind == 1, events, np.where(kind == 2, starts, 0))


def slowly(words: np.ndarray, divisor: int, tick: int) -> tuple[list[tuple], int, int]:
    """Return (time, column, row, intensity, sign, whether it is known), words of no kind, events outside."""
    found: list[tuple] = []
    last: dict[tuple[int, int], int] = {}
    row, stamp, unknown, outside = 0, 0, 0, 0
    for word in words.tolist():
        if word & 3 == 2:
            row, new = word >> 18, word >> 2 & 0xFFFF
            tick, stamp = tick + (new - stamp) % 65_536, new
        elif word & 3 == 1:
            column, intensity = word >> 5 & 0x7FF, 4095 - (word >> 16)
            if column >= WIDTH or row >= HEIGHT:
                outside += 1
                continue
            before = last.get((row, column), intensity)
            last[row, column] = intensity
            time = (2048 * tick + divisor) // (2 * divisor)  # rounded, in whole numbers
            found.append((time, column, row, intensity, intensity > before, intensity != before))
        else:
            unknown += word & 3 == 3
    return found, unknown, outside


def quickly(words: np.ndarray, divisor: int, tick: int) -> tuple[list[tuple], int, int]:
    """Return the same from `decode_format_1`, in packages that end anywhere."""
    lanes = np.stack([words & 0x3FFF, words >> 14], axis=1).ravel()
    data = np.empty(7 * GROUPS, np.uint8)
    pack_lanes(lanes, data)
    state = np.zeros(slots.STATE_SIZE, np.int64)
    state[slots.DIVISOR], state[slots.TICK] = divisor, tick
    state[slots.ROW_SEEN] = state[slots.TIME_SEEN] = 1
    last = np.full((HEIGHT, WIDTH), -1, np.int16)
    out = [np.empty(2 * GROUPS, dtype) for dtype in (np.int64, np.uint16, np.uint16, bool, np.uint16, bool)]
    scratch, count = np.empty(SCRATCH, np.uint64), 0
    for first, stop in ((0, 7 * (CHUNK + 3)), (7 * (CHUNK + 3), 7 * GROUPS)):
        part = [column[count:] for column in out]
        count += decode_format_1(data[first:stop].copy(), state, *part, last, scratch)
    t_us, x, y, p, adc, known = (column[:count].tolist() for column in out)
    return list(zip(t_us, x, y, adc, p, known, strict=True)), state[slots.UNKNOWN], state[slots.OUTSIDE]


@pytest.mark.parametrize(
    ("divisor", "tick"), [(80, 0), (90, LATE), (100, 0), (100, LATE), (120, 0), (140, LATE)]
)
def test_events_equal_the_description(divisor, tick):
    words = random_words(np.random.default_rng(divisor), 65_536)
    assert quickly(words, divisor, tick) == slowly(words, divisor, tick)
    assert len(slowly(words, divisor, tick)[0]) > CHUNK


@pytest.mark.parametrize("place", [0, 2 * CHUNK - 1, 2 * CHUNK, 2 * GROUPS - 1])
@pytest.mark.parametrize("fault", [3, WIDTH << 5 | 1, HEIGHT << 18 | 2])
def test_a_fault_anywhere_costs_no_other_event(place, fault):
    words = random_words(np.random.default_rng(place), 90)
    words[place] = fault
    expected = slowly(words, 100, 0)
    assert quickly(words, 100, 0) == expected
    assert expected[1] or expected[2] or place == 2 * GROUPS - 1 or words[place + 1] & 3 != 1


def test_ticks_beyond_what_is_exact_in_floats():
    words = random_words(np.random.default_rng(1), 65_536)
    assert quickly(words, 140, 2**46) == slowly(words, 140, 2**46)
