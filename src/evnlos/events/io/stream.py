"""Reading event files piece by piece, in memory that does not grow with the file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from os import PathLike
from pathlib import Path

import numpy as np

from evnlos.errors import EventFileError
from evnlos.events.io.celex_options import CelexOptions
from evnlos.events.io.columns import Columns, cut, in_order, join, trusted_events
from evnlos.events.io.read import open_source
from evnlos.events.io.report import OnError
from evnlos.types import Events


def iter_events(
    path: str | PathLike[str],
    *,
    window_us: int | None = None,
    n_events: int | None = None,
    on_error: OnError = "strict",
    width: int | None = None,
    height: int | None = None,
    celex: CelexOptions | None = None,
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

    Raises:
        EventFileError: As `read_events`, or neither or both of `window_us` and `n_events` are given.
    """
    if (window_us is None) == (n_events is None):
        raise EventFileError(f"window_us={window_us} and n_events={n_events}; give one of them")
    size = n_events if window_us is None else window_us
    if size is None or size < 1:
        raise EventFileError(f"a piece of {size}; give at least 1")
    source, report = open_source(Path(path), on_error, width, height, celex)
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
