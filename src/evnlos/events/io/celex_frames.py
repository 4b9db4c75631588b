"""Full pictures of CeleX-V recordings (mode F), and writing them."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import DataError, EventFileError
from evnlos.events.io.celex import parse_header, sniff_celex, walk_packages
from evnlos.events.io.celex_kernels import HEIGHT, WIDTH
from evnlos.events.io.celex_options import CelexOptions
from evnlos.events.io.report import OnError, ReadReport, check_on_error, unreadable


def _fixed_pattern(fpn: NDArray | str | PathLike[str] | None) -> NDArray | None:
    """Return the fixed pattern [H, W] of an array or of the SDK's text file of whole numbers."""
    if fpn is None:
        return None
    if isinstance(fpn, (str, PathLike)):
        path = Path(fpn)
        try:
            values = np.array(path.read_text("ascii").split(), np.int64)
        except (OSError, ValueError) as error:
            raise EventFileError(
                f"{path}: not a fixed pattern ({error}); whole numbers in text belong there"
            ) from None
    else:
        values = np.asarray(fpn)
    if values.size != WIDTH * HEIGHT:
        raise DataError(f"the fixed pattern has {values.size} values; the sensor has {WIDTH * HEIGHT} pixels")
    return values.reshape(HEIGHT, WIDTH)


def _decode_picture(data: NDArray[np.uint8], bits: int) -> NDArray:
    """Return one picture [H, W]: three bytes are two pixels, inverted; the third holds their low bits."""
    groups = data.reshape(-1, 3)  # [H * W / 2, 3]
    first, second, low = groups[:, 0], groups[:, 1], groups[:, 2]
    if bits == 8:
        pixels = 255 - np.stack([first, second], axis=1)
    else:
        high = np.stack([first, second], axis=1).astype(np.uint16) << 4
        pixels = 4095 - (high | np.stack([low & 0xF, low >> 4], axis=1))
    return pixels.reshape(HEIGHT, WIDTH)  # [H, W]


def read_frames(
    path: str | PathLike[str],
    *,
    bits: int = 8,
    fpn: NDArray | str | PathLike[str] | None = None,
    on_error: OnError = "strict",
    celex: CelexOptions | None = None,
) -> NDArray:
    """Return the full pictures of a CeleX-V recording.

    Pixels are in the order of the file, which is that of the events: row and column of a picture are y and x of
    an event. The camera's own viewer turns pictures, not events, by 180 degrees; turn pictures that it exported
    back before laying them over events.

    Args:
        path: The recording, mode F or a loop with pictures in it.
        bits: 8 or 12 bits a pixel.
        fpn: Fixed pattern to subtract: [800, 1280] or the text file of the camera's program; the result is
            clipped to the range of `bits`.
        on_error: "strict" raises at the first fault, "salvage" returns the whole pictures.
        celex: What the recording does not say about itself.

    Returns:
        [T, 800, 1280], uint8 or, for 12 bits, uint16; brighter is larger.

    Raises:
        EventFileError: The file is damaged or holds no pictures.
        DataError: `bits` or the size of `fpn` is wrong.
    """
    path = Path(path)
    check_on_error(on_error)
    if bits not in (8, 12):
        raise DataError(f"bits is {bits}; give 8 or 12")
    if not path.is_file():
        raise EventFileError(f"{path}: no such file; check the path")
    pattern = _fixed_pattern(fpn)
    options = celex or CelexOptions()
    with path.open("rb", buffering=0) as file:
        if options.event_format is None and not sniff_celex(file.read(64)):
            raise unreadable(path, 0, "not a CeleX-V recording", "pictures are read from .bin files of mode F")
        report = ReadReport(path, strict=on_error == "strict")
        packages = walk_packages(file, parse_header(path, options), report)
        pictures = [package for package in packages if package.is_picture]
        if not pictures and report.clean:
            raise unreadable(path, 0, "a recording without pictures", "read its events with read_events")
        frames = np.empty((len(pictures), HEIGHT, WIDTH), np.uint8 if bits == 8 else np.uint16)
        for frame, package in zip(frames, pictures, strict=True):
            file.seek(package.offset)
            picture = _decode_picture(np.frombuffer(file.read(package.length), np.uint8), bits)
            if pattern is not None:
                picture = np.clip(picture.astype(np.int64) - pattern, 0, 2**bits - 1)
            frame[:] = picture
    return frames
