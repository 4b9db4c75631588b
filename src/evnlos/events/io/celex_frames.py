"""Full pictures of CeleX-V recordings (mode F)."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import DataError, EventFileError
from evnlos.events.io.celex import parse_header, walk_packages
from evnlos.events.io.celex_options import CelexOptions
from evnlos.events.io.celex_state import HEIGHT, WIDTH
from evnlos.events.io.report import OnError, ReadReport, unreadable


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


def read_celex_frames(
    path: Path,
    bits: int,
    pattern: NDArray | str | PathLike[str] | None,
    on_error: OnError,
    options: CelexOptions,
) -> NDArray:
    """Return the full pictures [T, 800, 1280] of a CeleX-V recording; arguments as those of `read_frames`."""
    if bits not in (8, 12):
        raise DataError(f"bits is {bits}; give 8 or 12")
    fixed = _fixed_pattern(pattern)
    with path.open("rb", buffering=0) as file:
        report = ReadReport(path, strict=on_error == "strict")
        packages = walk_packages(file, parse_header(path, options), report)
        pictures = [package for package in packages if package.is_picture]
        if not pictures and report.clean:
            raise unreadable(path, 0, "a recording without pictures", "read its events with read_events")
        frames = np.empty((len(pictures), HEIGHT, WIDTH), np.uint8 if bits == 8 else np.uint16)
        for frame, package in zip(frames, pictures, strict=True):
            file.seek(package.offset)
            picture = _decode_picture(np.frombuffer(file.read(package.length), np.uint8), bits)
            if fixed is not None:
                picture = np.clip(picture.astype(np.int64) - fixed, 0, 2**bits - 1)
            frame[:] = picture
    return frames
