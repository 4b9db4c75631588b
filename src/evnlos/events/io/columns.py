"""Blocks of event columns on their way from a file to `Events`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.events.io.report import ReadReport
from evnlos.types import Events

Columns = dict[str, NDArray]
DTYPES = {
    "t_us": np.int64,
    "x": np.uint16,
    "y": np.uint16,
    "p": np.bool_,
    "adc": np.uint16,
    "polarity_known": np.bool_,
}


def allocate(count: int, names: Iterable[str] = ("t_us", "x", "y", "p")) -> Columns:
    """Return uninitialised columns for `count` events."""
    return {name: np.empty(count, DTYPES[name]) for name in names}


def cut(columns: Columns, start: int, stop: int) -> Columns:
    """Return a view of the events start..stop."""
    return {name: column[start:stop] for name, column in columns.items()}


def enlarge(columns: Columns, count: int, room: int) -> None:
    """Put columns of `room` places in place of these, with their first `count` events."""
    for name, column in columns.items():
        larger = np.empty(room, column.dtype)
        larger[:count] = column[:count]
        columns[name] = larger


def shorten(columns: Columns, count: int) -> None:
    """Give the memory behind the first `count` events back; nothing is copied."""
    for column in columns.values():
        column.resize(count, refcheck=False)


def join(blocks: list[Columns]) -> Columns:
    """Return the blocks as one; no block gives empty columns."""
    if not blocks:
        return allocate(0)
    if len(blocks) == 1:
        return blocks[0]
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


def trusted_events(columns: Columns, width: int, height: int) -> Events:
    """Return `Events` of columns that a decoder has checked already."""
    return Events._trusted(columns, width, height)


@njit(cache=True)
def _is_clean(t_us, x, y, width, height, newest):
    """Return whether all events are inside the sensor and in order, in loops for vector code."""
    largest_x, largest_y = np.uint16(0), np.uint16(0)
    for value in x:
        largest_x = max(largest_x, value)
    for value in y:
        largest_y = max(largest_y, value)
    backwards = len(t_us) > 0 and t_us[0] < newest
    for index in range(1, len(t_us)):
        backwards |= t_us[index] < t_us[index - 1]
    return largest_x < width and largest_y < height and not backwards


@njit(cache=True)
def _check_columns(t_us, x, y, width, height, newest):
    """Return index and kind (0 none, 1 out of range, 2 backwards) of the first fault and both tallies."""
    first, kind, outside, backwards = -1, 0, 0, 0
    for index in range(len(t_us)):
        if x[index] >= width or y[index] >= height:
            outside += 1
            if first < 0:
                first, kind = index, 1
            continue
        if t_us[index] < newest:
            backwards += 1
            if first < 0:
                first, kind = index, 2
        newest = t_us[index]
    return first, kind, outside, backwards, newest


class ColumnCheck:
    """Checks blocks of a file that stores columns (HDF5, NPZ, CSV, AEDAT4): coordinates and order of time."""

    def __init__(self, report: ReadReport, locate: Callable[[int], int] | None = None) -> None:
        """`locate` gives the byte of the file where an event, by its number, stands."""
        self._report, self._locate = report, locate
        self._newest = np.iinfo(np.int64).min
        self._events = 0

    def __call__(self, columns: Columns, offsets: NDArray[np.int64] | None = None) -> Columns:
        """Return the block without events outside the sensor; report them, and times that run backwards.

        `offsets` are the bytes of the file where the events stand, where that is known.
        """
        report, count = self._report, len(columns["t_us"])
        sides = report.width, report.height
        if _is_clean(columns["t_us"], columns["x"], columns["y"], *sides, self._newest):
            self._events += count
            self._newest = columns["t_us"][-1] if count else self._newest
            return columns
        first, kind, outside, backwards, self._newest = _check_columns(
            columns["t_us"], columns["x"], columns["y"], *sides, self._newest
        )
        if kind:
            number = self._events + first
            offset = int(offsets[first]) if offsets is not None else self._locate(number) if self._locate else 0
            order = ((1, outside), (2, backwards)) if kind == 1 else ((2, backwards), (1, outside))
            for which, many in order:
                if many and which == 1:
                    found = f"event {number} at x={columns['x'][first]}, y={columns['y'][first]}"
                    cure = f"the sensor is {report.width} x {report.height}; give width= and height="
                    report.fault("out_of_range", offset, found, cure, count=many)
                elif many:
                    found = f"event {number} at {columns['t_us'][first]} us is earlier than the one before it"
                    cure = 'sort the file by time or read with on_error="salvage"'
                    report.fault("backwards", offset, found, cure, count=many)
        self._events += count
        if outside:
            inside = (columns["x"] < report.width) & (columns["y"] < report.height)
            columns = {name: column[inside] for name, column in columns.items()}
        return columns


@njit(cache=True)
def _longest_ascent(t_us):
    """Return a mask of the longest non-decreasing subsequence (patience sorting, n log n)."""
    count = len(t_us)
    tails = np.empty(count, np.int64)  # index of the smallest end of a subsequence of each length
    before = np.full(count, -1, np.int64)
    length = 0
    for index in range(count):
        low, high = 0, length
        if length and t_us[tails[length - 1]] <= t_us[index]:
            low = length
        else:
            while low < high:
                middle = (low + high) // 2
                if t_us[tails[middle]] <= t_us[index]:
                    low = middle + 1
                else:
                    high = middle
        before[index] = tails[low - 1] if low else -1
        tails[low] = index
        length = max(length, low + 1)
    kept = np.zeros(count, np.bool_)
    index = tails[length - 1] if length else -1
    while index >= 0:
        kept[index] = True
        index = before[index]
    return kept


def keep_in_order(columns: Columns) -> Columns:
    """Return the largest set of events in the order of time, so that one outlier costs one event."""
    kept = _longest_ascent(columns["t_us"])
    return {name: column[kept] for name, column in columns.items()}


def keep_after(columns: Columns, newest_us: int) -> Columns:
    """Return the events not earlier than `newest_us`."""
    if not len(columns["t_us"]) or columns["t_us"][0] >= newest_us:
        return columns
    return cut(columns, int(np.searchsorted(columns["t_us"], newest_us)), len(columns["t_us"]))


def in_order(blocks: Iterable[Columns], report: ReadReport) -> Iterator[Columns]:
    """Yield the blocks, in salvage mode without events that are earlier than one before them."""
    newest = np.iinfo(np.int64).min
    for block in blocks:
        if report.faults.get("backwards"):
            block = keep_after(keep_in_order(block), newest)
        if len(block["t_us"]):
            newest = int(block["t_us"][-1])
            yield block
