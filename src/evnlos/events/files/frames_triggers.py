"""What an event camera's file holds beside, or in place of, events: frames, and external triggers.

- Frames and their times, one by one or all at once; frames that stay in their file until they are asked for.
- External triggers: edges that another instrument, such as a frame camera, put into a recording.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import DataError, EventFileError
from evnlos.events.files import evt2, evt3
from evnlos.events.files.celex import CelexOptions, read_celex_frames
from evnlos.events.files.columns import OnError, ReadReport, check_on_error, unreadable
from evnlos.events.files.raw import RawSource
from evnlos.events.files.read import open_source
from evnlos.events.files.registry import find_format
from evnlos.events.files.words import mend_clock
from evnlos.untrusted import check_memory, memory_left


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames and, where the file says, their times.

    Args:
        images: Grey images [T, H, W], uint8, or uint16 where they have more bits; brighter is larger.
        t_us: Their times, int64 [T], microseconds, on the events' clock; None where the file has none
            (CeleX-V). Those of a ROS bag are the stamps of its images.
    """

    images: NDArray
    t_us: NDArray[np.int64] | None


class FrameStack:
    """Frames [N, H, W] that are read in the order of time, as often as they are asked for, and not held.

    One frame and a slice are read alone, `blocks` goes through all in bounded memory; `numpy.asarray`, and what
    an array can do besides, reads them all, if memory allows.

    Args:
        count: How many they are.
        first: The first of them, [H, W].
        read: Begins anew and yields them one by one.
        what: What they are read from, for a message.
    """

    def __init__(self, count: int, first: NDArray, read: Callable[[], Iterator[NDArray]], what: str) -> None:
        self.shape, self.dtype, self.ndim = (count, *first.shape), first.dtype, 1 + first.ndim
        self._first, self._read, self._what = first, read, what

    def __len__(self) -> int:
        return self.shape[0]

    def blocks(self, size: int = 32) -> Iterator[NDArray]:
        """Yield the frames, [size, H, W] at a time; the last block may be shorter.

        Raises:
            DataError: The file has changed since it was counted.
        """
        held: list[NDArray] = []
        left = len(self)
        for image in self._read():
            held.append(image)
            left -= 1
            if left < 0 or image.shape != self._first.shape:
                break
            if len(held) == size or not left:
                yield np.stack(held)
                held = []
        if left:
            raise DataError(f"{self._what} has changed while it was read; begin again")

    def mapped(self, work: Callable[[NDArray], NDArray]) -> FrameStack:
        """Return the frames with `work` done on each block [n, H, W]."""
        images = lambda: (image for block in self.blocks() for image in work(block))  # noqa: E731
        return FrameStack(len(self), work(self._first[None])[0], images, self._what)

    def _part(self, start: int, stop: int) -> Iterator[NDArray]:
        if stop <= start:
            return
        for k, image in enumerate(image for block in self.blocks(1) for image in block):
            if k >= start:
                yield image
            if k + 1 == stop:
                return

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, slice) and key.step in (None, 1):
            start, stop, _ = key.indices(len(self))
            read = lambda: self._part(start, stop)  # noqa: E731
            return FrameStack(max(stop - start, 0), self._first, read, self._what)
        if isinstance(key, (int, np.integer)):
            k = range(len(self))[key]
            return next(self._part(k, k + 1))
        return np.asarray(self)[key]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray:
        needed = len(self) * self._first.nbytes
        check_memory(needed, f"{self._what}: its frames", "look at fewer of them at a time")
        whole = np.empty(self.shape, self.dtype if dtype is None else dtype)
        at = 0
        for block in self.blocks():
            whole[at : at + len(block)] = block
            at += len(block)
        return whole

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(np.asarray(self), name)


def frame_blocks(frames: NDArray | FrameStack, size: int = 32) -> Iterator[NDArray]:
    """Yield frames [N, H, W] in blocks of at most `size`, whether they are held or read.

    Args:
        frames: The frames, [N, H, W].
        size: Most frames of a block.
    """
    if isinstance(frames, FrameStack):
        return frames.blocks(size)
    return (frames[at : at + size] for at in range(0, len(frames), size))


def iter_frames(
    path: str | PathLike[str],
    *,
    bits: int = 8,
    fpn: NDArray | str | PathLike[str] | None = None,
    on_error: OnError = "strict",
    celex: CelexOptions | None = None,
    topic: str | None = None,
) -> Iterator[tuple[int | None, NDArray]]:
    """Yield time (microseconds, None where the file has none) and image of each frame of a file.

    Memory does not grow with the number of frames, but for CeleX-V. Errors are those of `read_frames`.

    Args:
        path: The file.
        bits: As of `read_frames`, like all that follow.
        fpn: See there.
        on_error: See there.
        celex: See there.
        topic: See there.
    """
    path = Path(path)
    check_on_error(on_error)
    options = celex or CelexOptions()
    format = find_format(path, options)
    report = ReadReport(path, strict=on_error == "strict", format=format.name)
    format.check_topic(path, topic)
    if format.name == "CELEX":
        yield from ((None, image) for image in read_celex_frames(path, bits, fpn, on_error, options))
        return
    if format.frames is None:
        found = f"{format.name}, which holds no frames"
        cure = "frames are read from CeleX-V .bin of mode F, .aedat4, AEDAT 2.0 and 3.1, and ROS bags"
        raise unreadable(path, 0, found, cure)
    first: NDArray | None = None
    for t_us, image in format.frames(path, report, topic):
        first = image if first is None else first
        if image.shape != first.shape or image.dtype != first.dtype:
            found = f"a frame {image.shape} {image.dtype} after {first.shape} {first.dtype}"
            raise EventFileError(f"{path}: {found}; record frames of one size")
        yield t_us, image
    if first is None:
        raise EventFileError(f"{path}: holds no whole frame; record frames as well")


FrameReader = Callable[[], Iterator[tuple[int | None, NDArray]]]
"""Begins anew, and yields time (microseconds, or None) and image of each frame."""


def gather_frames(
    read: FrameReader, path: Path, most: int, is_lazy: bool = False
) -> tuple[NDArray | FrameStack, NDArray[np.int64] | None]:
    """Return frames and their times; None where they have none.

    Args:
        read: Reads them.
        path: What is read.
        most: Memory that they may take, bytes.
        is_lazy: Whether frames that take more are a `FrameStack`, in place of an error.

    Raises:
        DataError: There is no frame, or they take too much memory.
    """
    held, times = list[NDArray](), list[int | None]()
    first: NDArray | None = None
    for t_us, image in read():
        first = image if first is None else first
        times.append(t_us)
        needed = len(times) * image.nbytes
        if needed <= most:
            held.append(image)
        elif is_lazy:
            held.clear()
        else:
            cure = "leave frames out, or read them one by one (evnlos.events.iter_frames)"
            check_memory(needed, f"{path}: its frames", cure, most)
    if first is None:
        raise DataError(f"{path} holds no frames; give another file")
    images = lambda: (image for _, image in read())  # noqa: E731
    frames = np.stack(held) if held else FrameStack(len(times), first, images, str(path))
    return frames, None if None in times else np.array(times, np.int64)


def read_timed_frames(
    path: str | PathLike[str],
    *,
    bits: int = 8,
    fpn: NDArray | str | PathLike[str] | None = None,
    on_error: OnError = "strict",
    celex: CelexOptions | None = None,
    topic: str | None = None,
) -> Frames:
    """Return the frames of a file with their times; arguments as those of `read_frames`."""
    how: dict[str, Any] = {"bits": bits, "fpn": fpn, "on_error": on_error, "celex": celex, "topic": topic}
    if next(iter_frames(path, **how), None) is None:
        raise unreadable(Path(path), 0, "no whole frame in it", "give another file")
    images, t_us = gather_frames(lambda: iter_frames(path, **how), Path(path), memory_left() // 4)
    return Frames(np.asarray(images), t_us)


def read_frames(
    path: str | PathLike[str],
    *,
    bits: int = 8,
    fpn: NDArray | str | PathLike[str] | None = None,
    on_error: OnError = "strict",
    celex: CelexOptions | None = None,
    topic: str | None = None,
) -> NDArray:
    """Return the frames of a CeleX-V recording (mode F), an AEDAT file, or an image topic of a ROS bag.

    Pixels are in the order of the file, which is that of the events: row and column of an image are y and x of
    an event. The CeleX-V camera's own viewer turns images, not events, by 180 degrees; turn images that it
    exported back before laying them over events.

    Args:
        path: The recording; for CeleX-V mode F or a loop with images in it.
        bits: 8 or 12 bits per pixel, for CeleX-V; other formats have their own, and colours become grey.
        fpn: CeleX-V's fixed pattern to subtract: [800, 1280] or the text file of the camera's program; the
            result is clipped to the range of `bits`.
        on_error: "strict" raises at the first fault, "salvage" returns the whole images (CeleX-V).
        celex: What a CeleX-V recording does not say about itself.
        topic: Name of the stream of frames, of a file that holds several.

    Returns:
        [T, H, W], uint8 or, for 12 bits, uint16; brighter is larger.

    Raises:
        EventFileError: The file is damaged or holds no images.
        MissingDependencyError: AEDAT4 needs the optional package aedat.
        DataError: `bits` or the size of `fpn` is wrong.
    """
    return read_timed_frames(path, bits=bits, fpn=fpn, on_error=on_error, celex=celex, topic=topic).images


CLOCK, BASE, STARTED, DENSE = range(4)  # slots of the state


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
            right = mend_clock(words, index, old, state[CLOCK] & 0xFFF, state[DENSE])
            high = right if right >= 0 else high
            state[DENSE] = state[DENSE] + 1 if (high - old) & 0xFFF <= 1 else 0
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


@runtime_checkable
class _Words(Protocol):
    """A source of EVT2, EVT2.1 or EVT3 words."""

    def words_of_file(self) -> Iterator[NDArray]: ...


@runtime_checkable
class _Edges(Protocol):
    """A source that knows its edges: (times [us], channels, whether rising)."""

    def edges(self) -> Iterator[tuple[NDArray, NDArray, NDArray]]: ...


def read_triggers(
    path: str | PathLike[str], on_error: OnError = "strict", *, topic: str | None = None
) -> Triggers:
    """Return the external trigger edges of a recording that holds some.

    Prophesee RAW (EVT2, EVT2.1, EVT3) and HDF5, EVT3 packets of ROS, and AEDAT 2.0 and 3.1 do. A frame camera
    whose exposure output is wired to the event camera gives its frames' times that way: the rising edges of its
    channel are the starts of the exposures. AEDAT 2.0 does not say which edge it saw: all count as rising.

    Args:
        path: The file.
        on_error: "strict" raises at the first fault of the file, "salvage" reads what is good.
        topic: Name of the stream of events, of a file that holds several.

    Raises:
        EventFileError: The file is damaged or of a format without triggers.
    """
    source, report = open_source(Path(path), on_error, None, None, None, topic)
    try:
        if isinstance(source, _Words):
            parts = list(_from_words(source, report.format))
        elif isinstance(source, _Edges):
            parts = list(source.edges())
        else:
            found, cure = f"{report.format} without external triggers", "they are read from Prophesee RAW files"
            raise unreadable(Path(path), 0, found, f"{cure}, ROS packets of EVT3, and AEDAT 2.0 and 3.1")
    except OSError as error:
        raise EventFileError(f"{path}: reading failed ({error.strerror}); copy the file again") from None
    if not parts:
        return Triggers(np.zeros(0, np.int64), np.zeros(0, np.uint8), np.zeros(0, np.bool_))
    t_us, channel, rising = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Triggers(t_us + (source.t0_us if isinstance(source, RawSource) else 0), channel, rising)


def _from_words(source: _Words, format: str) -> Iterator[tuple[NDArray, NDArray, NDArray]]:
    state = np.zeros(4, np.int64)
    for words in source.words_of_file():
        kernel, turn = _triggers_3, evt3.WRAP_US >> 12
        if format in ("EVT2", "EVT21"):
            kernel, turn = _triggers_2, evt2.WRAP_US >> 6
        if format == "EVT21":  # its fields lie in one half of the word, as those of EVT2, but narrower
            is_swapped = isinstance(source, RawSource) and source.is_swapped
            words = np.ascontiguousarray(words.view(np.uint32)[0 if is_swapped else 1 :: 2])
        out = np.empty(len(words), np.int64), np.empty(len(words), np.uint8), np.empty(len(words), np.bool_)
        count = kernel(words, state, turn, *out)
        yield out[0][:count].copy(), out[1][:count].copy(), out[2][:count].copy()
