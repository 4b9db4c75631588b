"""Reading the frames that an event camera's own file holds beside, or in place of, events."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import EventFileError
from evnlos.events.io.aedat4 import SIGNATURE, read_aedat4_frames
from evnlos.events.io.celex import sniff_celex
from evnlos.events.io.celex_frames import read_celex_frames
from evnlos.events.io.celex_options import CelexOptions
from evnlos.events.io.report import OnError, check_on_error, unreadable


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
        raise EventFileError(f"{path}: no such file; check the path")
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
        bits: 8 or 12 bits a pixel, for CeleX-V; AEDAT4 has 8, and colours become grey.
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
