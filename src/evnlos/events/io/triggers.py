"""External triggers: edges that another instrument, such as a frame camera, put into a RAW recording."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import EventFileError
from evnlos.events.io import evt2, evt3
from evnlos.events.io.raw import RawSource
from evnlos.events.io.read import open_source
from evnlos.events.io.report import OnError, unreadable

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
