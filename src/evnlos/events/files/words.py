"""Files that are a text header and then a row of words (RAW, DAT), and the state of their decoders.

- The state that a word decoder carries from block to block: clock, row, and a tally of faults.
- Reading files that are a text header and then a row of words: RAW (EVT2, EVT2.1, EVT3) and DAT.
- Bit errors in the clock words (TIME_HIGH) of EVT3, which cameras are known to send. A reader that takes such a
  word for a turn of the clock shifts all that follows by 2^24 us, 16.77 s. And the jitter of its low words.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.events.files.columns import (
    SALVAGE,
    Columns,
    ReadReport,
    allocate,
    cut,
    enlarge,
    shorten,
    unreadable,
)

# Slots of the int64 state array.
CLOCK, NEWEST, BASE, STARTED, ROW, COLUMN, POLARITY, TRIGGERS = range(8)
FAULTS = 16  # two slots a kind: how many, index of the first word
UNKNOWN, UNDATED, OUT_OF_RANGE, BACKWARDS, CLOCK_BACK, CLOCK_JUMP = range(6)
KINDS = ("unknown", "undated", "out_of_range", "backwards", "backwards", "clock")
STATE_SIZE = 32

# Words that are decoded at once, on the assumption that nothing is wrong with them; they stay in the cache.
CHUNK = 4096

# Real cameras send a time a few microseconds (11 at most) below the one before it: that is no fault.
JITTER_US = 64


def new_state() -> np.ndarray:
    """Return the state before the first word: no time seen, no fault."""
    state = np.zeros(STATE_SIZE, np.int64)
    state[NEWEST] = np.iinfo(np.int64).min
    return state


@njit(cache=True, inline="always")
def note(state: np.ndarray, kind: int, index: int) -> None:
    """Count a fault of `kind` at word `index` of this block."""
    slot = FAULTS + 2 * kind
    if state[slot] == 0:
        state[slot + 1] = index
    state[slot] += 1


_ROOM = 16  # a decoder may write that many places behind its last event
_BLOCK_BYTES = 1 << 18  # with its events it stays in the second-level cache between reading and decoding

# (words, state, t_us, x, y, p, width, height) -> number of events written
Decode = Callable[..., Any]

_FOUND = (
    "an unknown word type {kind:#x} ({word:#x})",
    "an event ({word:#x}) before the first time or row",
    "an event outside the sensor ({word:#x})",
    "an event ({word:#x}) earlier than the one before it",
    "a clock that runs backwards ({word:#x})",
    "a clock that jumps and comes back, up to 16.77 s: a bit error of the camera's TIME_HIGH ({word:#x})",
)
_SALVAGE = f"the file is damaged there: {SALVAGE}"


@dataclass(frozen=True)
class WordCodec:
    """How the words of one format become events.

    Args:
        dtype: One word, little endian.
        bound: Largest number of events that words can hold.
        decode: The kernel: fills the columns, carries the state on, returns how many events it wrote.
        kind_shift: Place of the lowest bit of a word's type.
        most_events: Most events that one word can hold.
    """

    dtype: np.dtype
    bound: Callable[[NDArray], int]
    decode: Decode
    kind_shift: int
    most_events: int = 1


def report_faults(
    report: ReadReport,
    state: NDArray[np.int64],
    words: NDArray,
    codec: WordCodec,
    locate: Callable[[int], int],
) -> None:
    """Pass the faults that a kernel noted to the report, the earliest first, and forget them.

    Args:
        report: Takes them.
        state: The kernel's state.
        words: The block that it decoded.
        codec: How.
        locate: Gives the byte of the file where a word of the block stands.
    """
    counts = state[FAULTS : FAULTS + 2 * len(KINDS) : 2]
    indices = state[FAULTS + 1 : FAULTS + 2 * len(KINDS) : 2]
    for kind in sorted(np.flatnonzero(counts), key=lambda kind: indices[kind]):
        word = int(words[indices[kind]]) & ((1 << 8 * codec.dtype.itemsize) - 1)
        found = _FOUND[kind].format(word=word, kind=(word >> codec.kind_shift) & 15)
        cure = _SALVAGE
        if KINDS[kind] == "out_of_range":
            cure = f"the sensor is {report.width} x {report.height}; give width= and height="
        elif KINDS[kind] == "clock":
            cure = f"its events get their times back: {SALVAGE}"
        # A clock fault is counted as one; the events that it misplaces are dropped by their order.
        report.fault(KINDS[kind], locate(int(indices[kind])), found, cure, count=int(counts[kind]))
    state[FAULTS:STATE_SIZE] = 0


class WordSource:
    """The words of an open file, decoded block by block."""

    def __init__(self, path: Path, codec: WordCodec, start: int, report: ReadReport, t0_us: int = 0) -> None:
        self.path, self.codec, self.start, self.report, self.t0_us = path, codec, start, report, t0_us
        size = path.stat().st_size
        self.words = max(size - start, 0) // codec.dtype.itemsize
        self._left = max(size - start, 0) % codec.dtype.itemsize
        self._state = new_state()

    def _word_blocks(self, file: FileIO) -> Iterator[tuple[int, NDArray]]:
        """Yield (index of the first word, words); the buffer is used again for the next block."""
        itemsize = self.codec.dtype.itemsize
        buffer = np.empty(min(self.words, _BLOCK_BYTES // itemsize), self.codec.dtype)
        file.seek(self.start)
        done = 0
        while done < self.words:
            want = min(len(buffer), self.words - done)
            got = file.readinto(memoryview(buffer[:want].view(np.uint8))) // itemsize  # type: ignore[arg-type]
            if not got:
                raise unreadable(
                    self.path, self.start + done * itemsize, "the file became shorter", "read it again"
                )
            yield done, buffer[:got]
            done += got

    def words_of_file(self) -> Iterator[NDArray]:
        """Yield blocks of words, as they stand in the file; a block is valid until the next."""
        with self.path.open("rb", buffering=0) as file:
            for _, words in self._word_blocks(file):
                yield words
        self._finish_words()

    def _decode(self, words: NDArray, first: int, columns: Columns, at: int) -> int:
        out = cut(columns, at, len(columns["t_us"]))
        report, state = self.report, self._state
        count = self.codec.decode(
            words, state, out["t_us"], out["x"], out["y"], out["p"], report.width, report.height
        )
        if state[FAULTS:STATE_SIZE:2].any():
            itemsize = self.codec.dtype.itemsize
            report_faults(
                report, state, words, self.codec, lambda index: self.start + (first + index) * itemsize
            )
        return count

    def _finish(self) -> None:
        self.report.triggers = int(self._state[TRIGGERS])
        self._finish_words()

    def _finish_words(self) -> None:
        if self._left:
            offset = self.start + self.words * self.codec.dtype.itemsize
            cure = f"the file was cut: copy it again or {SALVAGE}"
            found = f"the file ends {self._left} bytes into a word of {self.codec.dtype.itemsize}"
            self.report.fault("truncated", offset, found, cure, lost_bytes=self._left)

    def _dated(self, columns: Columns) -> Columns:
        if self.t0_us and len(columns["t_us"]):
            newest = int(columns["t_us"].max()) + self.t0_us
            if not -(2**63) <= newest < 2**63:
                found = f"a clock that starts at t0 = {self.t0_us} us"
                self.report.fault("header", 0, found, "times have 63 bits: repair the header line t0")
                return columns
            columns["t_us"] += self.t0_us
        return columns

    def blocks(self) -> Iterator[Columns]:
        """Yield columns of bounded size until the file ends."""
        with self.path.open("rb", buffering=0) as file:
            for first, words in self._word_blocks(file):
                columns = allocate(self.codec.bound(words))
                count = self._decode(words, first, columns, 0)
                yield self._dated(cut(columns, 0, count))
        self._finish()

    def read(self) -> Columns:
        """Return all events, decoded straight into columns of the whole size."""
        columns = allocate(self.words + _ROOM)  # pages that no event reaches are never used
        count = 0
        with self.path.open("rb", buffering=0) as file:
            for first, words in self._word_blocks(file):
                self._make_room(columns, count, words, first)
                count += self._decode(words, first, columns, count)
        self._finish()
        shorten(columns, count)
        return self._dated(columns)

    def _make_room(self, columns: Columns, count: int, words: NDArray, first: int) -> None:
        """Enlarge the columns where a block may hold more events than they have room for.

        Before the first event nothing has to be copied: then for the whole file, if it goes on as it begins.
        """
        room = len(columns["t_us"]) - count
        is_start = not count and self.codec.most_events > 1
        if room >= self.codec.most_events * len(words) + _ROOM and not is_start:
            return
        need, done = self.codec.bound(words), first + len(words)
        expected = (count + need) * self.words // done
        if room < need or (is_start and room < expected):
            enlarge(columns, count, max(count + need, expected + expected // 16))


@njit(cache=True)
def sum_table(words, table):
    """Return the sum of table[word] over all words."""
    total = 0
    for word in words:
        total += table[word]
    return total


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


@njit(cache=True)
def hold_back(clock, latest, events, newest):
    """Let no event be earlier than the one before it (`newest` at the start).

    Args:
        clock: Words of the low time.
        latest: Low time before them, microseconds.
        events: What holds at each event.
        newest: The last event before them, microseconds since the high time.

    Returns:
        Whether a low time is later than one that follows by more than cameras' jitter: that is a fault.
    """
    latest, is_fault = max(latest, newest), newest > 0xFFF
    for word in clock:
        low = np.int64(word & 0xFFF)
        latest = max(latest, low)
        is_fault |= latest - low > JITTER_US
    for index in range(len(events)):
        newest = max(newest, np.int64(events[index] >> np.uint64(32) & np.uint64(0xFFF)))
        events[index] = events[index] & ~np.uint64(0xFFF << 32) | np.uint64(newest) << np.uint64(32)
    return is_fault
