"""Reading event files: whole, or piece by piece in memory that does not grow with the file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from os import PathLike
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import EventFileError
from evnlos.events.files.celex import CelexOptions
from evnlos.events.files.columns import (
    Columns,
    OnError,
    ReadReport,
    allocate,
    check_on_error,
    cut,
    is_ascending,
    join,
    trusted_events,
)
from evnlos.events.files.registry import FileSource, find_format
from evnlos.types import Events


def open_source(
    path: Path,
    on_error: OnError,
    width: int | None,
    height: int | None,
    celex: CelexOptions | None = None,
    topic: str | None = None,
) -> tuple[FileSource, ReadReport]:
    """Return an open file and the report that reading it fills."""
    check_on_error(on_error)
    if (width is None) != (height is None):
        raise EventFileError(f"width={width} with height={height}; give both or neither")
    for name, side in (("width", width), ("height", height)):
        if side is not None and not 1 <= side <= 65_536:
            raise EventFileError(f"{name}={side}; give 1 to 65536 pixels")
    report = ReadReport(path, strict=on_error == "strict")
    try:
        format = find_format(path, celex)
        format.check_topic(path, topic)
        source = format.open(path, report, width, height, celex, topic)
    except OSError as error:
        raise EventFileError(f"{path}: cannot be opened ({error.strerror}); check its permissions") from None
    return source, report


def read_events_report(
    path: str | PathLike[str],
    on_error: OnError = "salvage",
    *,
    width: int | None = None,
    height: int | None = None,
    celex: CelexOptions | None = None,
    topic: str | None = None,
) -> tuple[Events, ReadReport]:
    """Return the events of a file, and what was found wrong with it.

    Args:
        path: The file; its format is found from its content.
        on_error: "salvage" skips what is damaged and reports it; "strict" raises at the first fault.
        width: Sensor width, pixels, where the file does not say or is wrong; give both or neither.
        height: Sensor height, pixels.
        celex: What a CeleX-V recording does not say about itself.
        topic: Name of the stream, of a file that holds several (`report.streams`, `evnlos info`).

    Raises:
        EventFileError: Nothing can be read, or in strict mode anything is wrong.
        MissingDependencyError: The format needs an optional package.
    """
    source, report = open_source(Path(path), on_error, width, height, celex, topic)
    try:
        columns = source.read()
    except OSError as error:
        raise EventFileError(f"{path}: reading failed ({error.strerror}); copy the file again") from None
    if not columns:
        columns = allocate(0)
    if report.faults.get("backwards"):
        columns = keep_in_order(columns)
    report.events = len(columns["t_us"])
    return trusted_events(columns, report.width, report.height), report


def read_events(
    path: str | PathLike[str],
    on_error: OnError = "strict",
    *,
    width: int | None = None,
    height: int | None = None,
    celex: CelexOptions | None = None,
    topic: str | None = None,
) -> Events:
    """Return the events of a file.

    Read are HDF5 (DSEC columns, M3ED, EVIMO, Prophesee with ECF), NPZ, CSV, Prophesee RAW (EVT2, EVT2.1, EVT3)
    and DAT, CeleX-V `.bin` and CSV, AEDAT 2.0 and 3.1, ROS bags (`.bag`, `.db3`, `.mcap`) and, with the extra
    `aedat`, AEDAT4.

    Args:
        path: The file; its format is found from its content, whatever its name.
        on_error: "strict" raises at the first fault with the byte offset, what was found and what to do;
            "salvage" returns what is good (`read_events_report` returns the tally of faults beside it).
        width: Sensor width, pixels, where the file does not say or is wrong; give both or neither.
        height: Sensor height, pixels.
        celex: What a CeleX-V recording does not say about itself.
        topic: Name of the stream, of a file that holds several (`report.streams`, `evnlos info`).

    Raises:
        EventFileError: The file is damaged, contradicts itself or is of no known format.
        MissingDependencyError: The format needs an optional package.

    Example:
        >>> import tempfile, pathlib
        >>> from evnlos.events import write_events
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "two.raw"
        >>> write_events(path, Events([5, 9], [0, 3], [1, 1], [True, False], width=4, height=2))
        >>> read_events(path)
        Events(2 events, 4 x 2, 5..9 us, 50 % ON)
    """
    return read_events_report(path, on_error, width=width, height=height, celex=celex, topic=topic)[0]


def iter_events(
    path: str | PathLike[str],
    *,
    window_us: int | None = None,
    n_events: int | None = None,
    on_error: OnError = "strict",
    width: int | None = None,
    height: int | None = None,
    celex: CelexOptions | None = None,
    topic: str | None = None,
) -> Iterator[Events]:
    """Yield the events of a file in pieces: of equal time, or of equal count.

    Joined, the pieces are what `read_events` returns; in memory are one block of the file and one piece.

    Args:
        path: The file.
        window_us: Length of a piece, microseconds, at least 1. Piece k holds the events with
            first + k window_us <= t_us < first + (k + 1) window_us; pieces without events are left out.
        n_events: Events a piece, at least 1; the last one may hold fewer. Give this or `window_us`.
        on_error: "strict" raises at the first fault, after the pieces before it; "salvage" leaves out what
            is damaged, and events that are earlier than one that was yielded.
        width: Sensor width, pixels, where the file does not say; give both or neither.
        height: Sensor height, pixels.
        celex: What a CeleX-V recording does not say about itself.
        topic: Name of the stream, of a file that holds several (`report.streams`, `evnlos info`).

    Raises:
        EventFileError: As `read_events`, or neither or both of `window_us` and `n_events` are given.
    """
    if (window_us is None) == (n_events is None):
        raise EventFileError(f"window_us={window_us} and n_events={n_events}; give one of them")
    size = n_events if window_us is None else window_us
    if size is None or size < 1:
        raise EventFileError(f"a piece of {size}; give at least 1")
    source, report = open_source(Path(path), on_error, width, height, celex, topic)
    blocks = in_order(source.blocks(), report)
    pieces = _by_count(blocks, int(size)) if window_us is None else _by_time(blocks, int(size))
    return (trusted_events(columns, report.width, report.height) for columns in pieces)


def _by_count(blocks: Iterable[Columns], size: int) -> Iterator[Columns]:
    held: list[Columns] = []
    have = 0
    for block in blocks:
        held.append(block)
        have += len(block["t_us"])
        if have < size:
            continue
        joined = join(held)
        whole = have // size * size
        for start in range(0, whole, size):
            yield cut(joined, start, start + size)
        held, have = [cut(joined, whole, have)], have - whole
    if have:
        yield join(held)


def _by_time(blocks: Iterable[Columns], size: int) -> Iterator[Columns]:
    held: list[Columns] = []
    first: int | None = None
    window = 0  # number of the window that the held events are in
    for block in blocks:
        if first is None:
            first = int(block["t_us"][0])
        windows = (block["t_us"] - first) // size
        starts = np.flatnonzero(np.diff(windows)) + 1
        for start, stop in zip([0, *starts.tolist()], [*starts.tolist(), len(windows)], strict=True):
            if windows[start] != window and held:
                yield join(held)
                held = []
            window = int(windows[start])
            held.append(cut(block, start, stop))
    if held:
        yield join(held)


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


_LOOK_AHEAD = 1 << 17
"""Events that salvage reads before it lets go of those in front of them."""


def _kept(t_us: NDArray[np.int64], newest_us: int) -> NDArray[np.bool_]:
    """Return a mask of the largest set of events in order that are not earlier than `newest_us`."""
    kept = t_us >= newest_us
    kept[kept] = _longest_ascent(t_us[kept])
    return kept


def in_order(blocks: Iterable[Columns], report: ReadReport) -> Iterator[Columns]:
    """Yield the blocks, in salvage mode without events that are out of order.

    Where some are, those in front and the next `_LOOK_AHEAD` are judged together, and of them the largest set
    in order stays: events dated too late cost themselves, not all that follow. None is earlier than one that
    was yielded.
    """
    if report.strict:
        yield from (block for block in blocks if len(block["t_us"]))
        return
    held: list[Columns] = []
    newest = last = np.iinfo(np.int64).min
    total, are_ordered = 0, True
    for block in blocks:
        t_us = block["t_us"]
        if not len(t_us):
            continue
        are_ordered = are_ordered and bool(t_us[0] >= last) and is_ascending(t_us)
        held.append(block)
        total, last = total + len(t_us), t_us[-1]
        while are_ordered and total - len(held[0]["t_us"]) >= _LOOK_AHEAD:
            newest = held[0]["t_us"][-1]
            total -= len(held[0]["t_us"])
            yield held.pop(0)
        if not are_ordered and total >= 2 * _LOOK_AHEAD:
            joined, split = join(held), total - _LOOK_AHEAD
            kept = _kept(joined["t_us"], newest)[:split]
            front, rest = cut(joined, 0, split), cut(joined, split, total)
            front = {name: column[kept] for name, column in front.items()}
            if len(front["t_us"]):
                newest = front["t_us"][-1]
                yield front
            held, total = [rest], _LOOK_AHEAD
            are_ordered = bool(rest["t_us"][0] >= newest) and is_ascending(rest["t_us"])
    if are_ordered:
        yield from held
    elif held:
        joined = join(held)
        kept = _kept(joined["t_us"], newest)
        if kept.any():
            yield {name: column[kept] for name, column in joined.items()}
