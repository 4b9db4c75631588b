"""The frames that an event camera's own file holds beside, or in place of, events."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evnlos.events.files.celex import CelexOptions, read_celex_frames
from evnlos.events.files.columns import OnError, ReadReport, check_on_error, unreadable
from evnlos.events.files.registry import find_format


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames and, where the file says, their times.

    Args:
        images: Grey pictures [T, H, W], uint8, or uint16 where they have more bits; brighter is larger.
        t_us: Their times, int64 [T], microseconds, on the events' clock; None where the file has none
            (CeleX-V). Those of a ROS bag are the stamps of its images.
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
    topic: str | None = None,
) -> Frames:
    """Return the frames of a file with their times; arguments as those of `read_frames`."""
    path = Path(path)
    check_on_error(on_error)
    options = celex or CelexOptions()
    format = find_format(path, options)
    report = ReadReport(path, strict=on_error == "strict", format=format.name)
    format.check_topic(path, topic)
    if format.frames is not None:
        return Frames(*format.frames(path, report, topic))
    if format.name != "CELEX":
        found = f"{format.name}, which holds no frames"
        raise unreadable(
            path,
            0,
            found,
            "frames are read from CeleX-V .bin of mode F, .aedat4, AEDAT 2.0 and 3.1, and ROS bags",
        )
    return Frames(read_celex_frames(path, bits, fpn, on_error, options), None)


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

    Pixels are in the order of the file, which is that of the events: row and column of a picture are y and x of
    an event. The CeleX-V camera's own viewer turns pictures, not events, by 180 degrees; turn pictures that it
    exported back before laying them over events.

    Args:
        path: The recording; for CeleX-V mode F or a loop with pictures in it.
        bits: 8 or 12 bits per pixel, for CeleX-V; other formats have their own, and colours become grey.
        fpn: CeleX-V's fixed pattern to subtract: [800, 1280] or the text file of the camera's program; the
            result is clipped to the range of `bits`.
        on_error: "strict" raises at the first fault, "salvage" returns the whole pictures (CeleX-V).
        celex: What a CeleX-V recording does not say about itself.
        topic: Name of the stream of frames, of a file that holds several.

    Returns:
        [T, H, W], uint8 or, for 12 bits, uint16; brighter is larger.

    Raises:
        EventFileError: The file is damaged or holds no pictures.
        MissingDependencyError: AEDAT4 needs the optional package aedat.
        DataError: `bits` or the size of `fpn` is wrong.
    """
    return read_timed_frames(path, bits=bits, fpn=fpn, on_error=on_error, celex=celex, topic=topic).images
