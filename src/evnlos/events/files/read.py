"""Reading event files: whole, piece by piece, their triggers and their frames.

- Reading event files whole or in pieces.
- Reading event files piece by piece, in memory that does not grow with the file.
- External triggers: edges that another instrument, such as a frame camera, put into a RAW recording.
- Reading the frames that an event camera's own file holds beside, or in place of, events.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import EventFileError
from evnlos.events.files import evt2, evt3
from evnlos.events.files.aedat4 import SIGNATURE, read_aedat4_frames
from evnlos.events.files.celex import CelexOptions, read_celex_frames, sniff_celex
from evnlos.events.files.columns import (
    Columns,
    OnError,
    ReadReport,
    allocate,
    check_on_error,
    cut,
    in_order,
    join,
    keep_in_order,
    trusted_events,
    unreadable,
)
from evnlos.events.files.raw import RawSource
from evnlos.events.files.registry import FileSource, find_format
from evnlos.types import Events
from evnlos.untrusted import no_file


def open_source(
    path: Path, on_error: OnError, width: int | None, height: int | None, celex: CelexOptions | None = None
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
        source = find_format(path, celex).open(path, report, width, height, celex)
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
) -> tuple[Events, ReadReport]:
    """Return the events of a file, and what was found wrong with it.

    Args:
        path: The file; its format is found from its content.
        on_error: "salvage" skips what is damaged and reports it; "strict" raises at the first fault.
        width: Sensor width, pixels, where the file does not say or is wrong; give both or neither.
        height: Sensor height, pixels.
        celex: What a CeleX-V recording does not say about itself.

    Raises:
        EventFileError: Nothing can be read, or in strict mode anything is wrong.
        MissingDependencyError: The format needs an optional package.
    """
    source, report = open_source(Path(path), on_error, width, height, celex)
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
) -> Events:
    """Return the events of a file.

    Read are HDF5 (DSEC columns), NPZ, CSV, Prophesee RAW (EVT2, EVT2.1, EVT3) and DAT, CeleX-V `.bin` and
    CSV and, with the extra `aedat`, AEDAT4.

    Args:
        path: The file; its format is found from its content, whatever its name.
        on_error: "strict" raises at the first fault with the byte offset, what was found and what to do;
            "salvage" returns what is good (`read_events_report` returns the tally of faults beside it).
        width: Sensor width, pixels, where the file does not say or is wrong; give both or neither.
        height: Sensor height, pixels.
        celex: What a CeleX-V recording does not say about itself.

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
    return read_events_report(path, on_error, width=width, height=height, celex=celex)[0]


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


CLOCK, BASE, STARTED = range(3)  # slots of the state


@dataclass(frozen=True, eq=False)
class Triggers:
    """External trigger edges in the order of the file.

    Args:
        t_us: Times, int64 [N], microseconds, on the events' clock.
        channel: Number of the input, uint8 [N].
        rising: True for a rising edge, bool [N].
    """

    t_us: NDArray[np.int64]
    channel: NDArray[np.uint8]
    rising: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.t_us)


@njit(cache=True)
def _triggers_2(words, state, turn, t_us, channel, rising):
    """Collect from 32-bit words: kind 10 has six bits of time, the input in bits 8-12, the level in bit 0."""
    count = 0
    for index in range(len(words)):
        word = np.int64(words[index])
        kind = word >> 28
        if kind == 8:
            high = word & 0xFFFFFFF
            if state[STARTED] and state[CLOCK] - high > turn // 2:
                state[BASE] += turn << 6
            state[CLOCK], state[STARTED] = high, 1
        elif kind == 10 and state[STARTED]:
            t_us[count] = state[BASE] + (state[CLOCK] << 6) + ((word >> 22) & 0x3F)
            channel[count] = (word >> 8) & 0x1F
            rising[count] = (word & 1) == 1
            count += 1
    return count


@njit(cache=True)
def _triggers_3(words, state, turn, t_us, channel, rising):
    """Collect from 16-bit words: kind 10 has the input in bits 8-11, the level in bit 0, the clock as time."""
    count = 0
    for index in range(len(words)):
        word = np.int64(words[index])
        kind = word >> 12
        if kind == 8:
            high = word & 0xFFF
            old = state[CLOCK] >> 12
            if state[STARTED] and old - high > turn // 2:
                state[BASE] += turn << 12
            if high != old or not state[STARTED]:
                state[CLOCK] = high << 12
            state[STARTED] = 1
        elif kind == 6:
            state[CLOCK] = (state[CLOCK] & ~np.int64(0xFFF)) | (word & 0xFFF)
        elif kind == 10 and state[STARTED]:
            t_us[count] = state[BASE] + state[CLOCK]
            channel[count] = (word >> 8) & 0xF
            rising[count] = (word & 1) == 1
            count += 1
    return count


def read_triggers(path: str | PathLike[str], on_error: OnError = "strict") -> Triggers:
    """Return the external trigger edges of a Prophesee RAW file (EVT2, EVT2.1 or EVT3).

    A frame camera whose exposure output is wired to the event camera gives its frames' times that way: the
    rising edges of its channel are the starts of the exposures.

    Args:
        path: The file.
        on_error: "strict" raises at the first fault of the file, "salvage" reads what is good.

    Raises:
        EventFileError: The file is damaged or of a format without triggers.
    """
    source, report = open_source(Path(path), on_error, None, None)
    if not isinstance(source, RawSource):
        raise unreadable(
            Path(path),
            0,
            f"{report.format} without external triggers",
            "they are read from Prophesee RAW files",
        )
    parts: list[list[NDArray]] = []
    state = np.zeros(3, np.int64)
    try:
        for words in source.words_of_file():
            kernel, turn = _triggers_2, evt2.WRAP_US >> 6
            if report.format == "EVT3":
                kernel, turn = _triggers_3, evt3.WRAP_US >> 12
            elif (
                report.format == "EVT21"
            ):  # its fields lie in one half of the word, as those of EVT2, but narrower
                words = np.ascontiguousarray(words.view(np.uint32)[0 if source.is_swapped else 1 :: 2])
            out = np.empty(len(words), np.int64), np.empty(len(words), np.uint8), np.empty(len(words), np.bool_)
            count = kernel(words, state, turn, *out)
            parts.append([column[:count].copy() for column in out])
    except OSError as error:
        raise EventFileError(f"{path}: reading failed ({error.strerror}); copy the file again") from None
    if not parts:
        return Triggers(np.zeros(0, np.int64), np.zeros(0, np.uint8), np.zeros(0, np.bool_))
    t_us, channel, rising = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Triggers(t_us + source.t0_us, channel, rising)


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames and, where the file says, their times.

    Args:
        images: Grey pictures [T, H, W], uint8, or uint16 where they have more bits; brighter is larger.
        t_us: Their times, int64 [T], microseconds, on the events' clock; None where the file has none
            (CeleX-V).
    """

    images: NDArray
    t_us: NDArray[np.int64] | None


def read_timed_frames(
    path: str | PathLike[str],
    *,
    bits: int = 8,
    fpn: NDArray | str | PathLike[str] | None = None,
    on_error: OnError = "strict",
    celex: CelexOptions | None = None,
) -> Frames:
    """Return the frames of a file with their times; arguments as those of `read_frames`."""
    path = Path(path)
    check_on_error(on_error)
    if not path.is_file():
        raise EventFileError(no_file(path))
    options = celex or CelexOptions()
    with path.open("rb") as file:
        start = file.read(64)
    if start.startswith(SIGNATURE):
        return Frames(*read_aedat4_frames(path))
    if options.event_format is None and not sniff_celex(start):
        found = "neither a CeleX-V recording nor AEDAT4"
        raise unreadable(path, 0, found, "frames are read from .bin files of mode F and from .aedat4")
    return Frames(read_celex_frames(path, bits, fpn, on_error, options), None)


def read_frames(
    path: str | PathLike[str],
    *,
    bits: int = 8,
    fpn: NDArray | str | PathLike[str] | None = None,
    on_error: OnError = "strict",
    celex: CelexOptions | None = None,
) -> NDArray:
    """Return the frames of a CeleX-V recording (mode F) or of an AEDAT4 file.

    Pixels are in the order of the file, which is that of the events: row and column of a picture are y and x of
    an event. The CeleX-V camera's own viewer turns pictures, not events, by 180 degrees; turn pictures that it
    exported back before laying them over events.

    Args:
        path: The recording; for CeleX-V mode F or a loop with pictures in it.
        bits: 8 or 12 bits per pixel, for CeleX-V; AEDAT4 has 8, and colours become grey.
        fpn: CeleX-V's fixed pattern to subtract: [800, 1280] or the text file of the camera's program; the
            result is clipped to the range of `bits`.
        on_error: "strict" raises at the first fault, "salvage" returns the whole pictures (CeleX-V).
        celex: What a CeleX-V recording does not say about itself.

    Returns:
        [T, H, W], uint8 or, for 12 bits, uint16; brighter is larger.

    Raises:
        EventFileError: The file is damaged or holds no pictures.
        MissingDependencyError: AEDAT4 needs the optional package aedat.
        DataError: `bits` or the size of `fpn` is wrong.
    """
    return read_timed_frames(path, bits=bits, fpn=fpn, on_error=on_error, celex=celex).images
