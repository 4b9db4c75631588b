"""What a camera adds to what it saw, taken away: dark signal and uneven response, hot pixels, lonely events.

- A camera's fixed pattern, known pixel by pixel: what it does to every frame can be taken away.
- Where the pixels of the frame camera lie on those of the event camera.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

from evnlos.data.capture_info import CaptureInfo, RegistrationInfo, inside
from evnlos.data.frames import find_dots, homography_from_points, read_image, registration_error
from evnlos.errors import DataError
from evnlos.events import event_histogram, read_events
from evnlos.files import write_atomically
from evnlos.tensor_file import check_floats, read_sealed, sealed_bytes
from evnlos.types import Events


def correct_frames(
    frames: NDArray, peak: float, dark: NDArray | None = None, flat: NDArray | None = None
) -> NDArray[np.float32]:
    """Return frames without dark signal and uneven response, 0..1.

    (F - D) / (peak - mean D), divided by (flat - D) / mean(flat - D) where a flat field is given; clipped to
    0..1.

    Args:
        frames: [N, H, W], digital numbers.
        peak: Largest digital number.
        dark: Mean of frames with the lens covered, [H, W], digital numbers.
        flat: Mean of frames of an evenly lit surface, [H, W], digital numbers.

    Raises:
        DataError: A picture of another size, or a flat field that is nowhere brighter than the dark frame.
    """
    ground = np.zeros(frames.shape[1:], np.float32) if dark is None else np.asarray(dark, np.float32)
    for name, picture in (("dark", ground), ("flat", flat)):
        if picture is not None and np.shape(picture) != frames.shape[1:]:
            raise DataError(f"the {name} frame is {np.shape(picture)}, the frames are {frames.shape[1:]}")
    out = frames.astype(np.float32) - ground
    if flat is not None:
        response = np.asarray(flat, np.float32) - ground
        mean = float(response.mean())
        if mean <= 0:
            raise DataError(
                f"the flat field is {mean:.1f} brighter than the dark frame; record an evenly lit one"
            )
        # A dead pixel would become infinite; below a tenth of the mean response nothing can be said.
        out *= np.where(response > 0.1 * mean, mean / np.maximum(response, 0.1 * mean), 0.0)
    return np.clip(out / max(peak - float(ground.mean()), 1.0), 0.0, 1.0)


@njit(cache=True)
def _hot(counts, factor, floor):
    height, width = counts.shape
    hot = np.zeros((height, width), np.bool_)
    around = np.empty(24, np.int64)
    for row in range(height):
        for column in range(width):
            if counts[row, column] <= floor:
                continue
            size = 0
            for v in range(max(0, row - 2), min(height, row + 3)):
                for u in range(max(0, column - 2), min(width, column + 3)):
                    if v != row or u != column:
                        place = size  # sorted as they come
                        while place > 0 and around[place - 1] > counts[v, u]:
                            around[place] = around[place - 1]
                            place -= 1
                        around[place] = counts[v, u]
                        size += 1
            middle = (around[(size - 1) // 2] + around[size // 2]) / 2 if size else 0.0
            hot[row, column] = counts[row, column] > factor * max(middle, 1.0)
    return hot


def find_hot_pixels(events: Events, factor: float = 10.0, floor: int = 20) -> NDArray[np.bool_]:
    """Return which pixels send far more events than those around them.

    Args:
        events: The stream.
        factor: Times the median of the 24 pixels around (at least 1 event) above which a pixel is hot; above 1.
        floor: Events up to which a pixel is never hot.

    Returns:
        bool [H, W].

    Raises:
        DataError: A factor of 1 or less, or a negative floor.
    """
    if not factor > 1 or floor < 0:
        raise DataError(f"factor {factor} and floor {floor}; give a factor above 1 and a floor of 0 or more")
    counts = np.bincount(
        events.y.astype(np.int64) * events.width + events.x, minlength=events.width * events.height
    )
    return hot_by_counts(counts.reshape(events.shape), factor, floor)


def hot_by_counts(counts: NDArray[np.int64], factor: float = 10.0, floor: int = 20) -> NDArray[np.bool_]:
    """Return which pixels sent far more events than those around them, of their counts [H, W]."""
    return _hot(counts, float(factor), floor)


def without_pixels(events: Events, pixels: NDArray[np.bool_]) -> Events:
    """Return the events of the pixels that are not marked; `pixels` is bool [H, W]."""
    return events[~pixels[events.y, events.x]]


@njit(cache=True)
def _supported(t_us, x, y, height, width, window, never):
    latest = np.full((height + 2, width + 2), never, np.int64)  # a margin in place of a look at the border
    kept = np.zeros(len(t_us), np.bool_)
    for index in range(len(t_us)):
        row, column, time = np.int64(y[index]) + 1, np.int64(x[index]) + 1, t_us[index]
        newest = never
        for v in range(row - 1, row + 2):
            for u in range(column - 1, column + 2):
                if v != row or u != column:
                    newest = max(newest, latest[v, u])
        kept[index] = newest != never and time - newest <= window
        latest[row, column] = time
    return kept


def keep_supported(events: Events, window_us: int) -> Events:
    """Return the events that one of the eight pixels around supports: it had an event at most `window_us`
    earlier.

    Noise comes alone, edges do not (Delbruck, "Frame-free dynamic digital vision", 2008). The first event of
    every edge goes too.

    Args:
        events: The stream; it is not changed.
        window_us: Longest time to the supporting event, microseconds, at least 1.

    Raises:
        DataError: A window below 1.

    Example:
        >>> events = Events([1, 5, 6], [0, 1, 9], [0, 0, 0], [1, 1, 1], width=10, height=1)
        >>> keep_supported(events, 4).x.tolist()
        [1]
    """
    if window_us < 1:
        raise DataError(f"window_us is {window_us}; give at least 1 us")
    never = np.iinfo(np.int64).min
    kept = _supported(events.t_us, events.x, events.y, events.height, events.width, int(window_us), never)
    return events[kept]


def crop_events(events: Events, left: int, top: int, width: int, height: int) -> Events:
    """Return the events inside a rectangle, with coordinates from its corner.

    Args:
        events: The stream; it is not changed.
        left: First column, pixels.
        top: First row, pixels.
        width: Columns, pixels.
        height: Rows, pixels.

    Raises:
        DataError: The rectangle leaves the sensor.
    """
    check_rectangle(events.shape, left, top, width, height)
    column, row = events.x.astype(np.int64) - left, events.y.astype(np.int64) - top
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    kept = events[inside]
    columns: dict[str, NDArray] = kept.columns() | {"x": column[inside], "y": row[inside]}
    return Events(width=width, height=height, **columns)


def check_rectangle(shape: tuple[int, int], left: int, top: int, width: int, height: int) -> None:
    """Raise `DataError` unless the rectangle lies on a sensor of `shape` (rows, columns)."""
    if left < 0 or top < 0 or width < 1 or height < 1 or left + width > shape[1] or top + height > shape[0]:
        raise DataError(
            f"the region {width} x {height} at ({left}, {top}) leaves the sensor of {shape[1]} x {shape[0]}"
        )


_LEAST = 0.1  # sensitivity below which a pixel is dead: nothing is divided by less


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """What each pixel of a frame camera makes of the light: DN / peak = sensitivity * light + offset.

    Args:
        sensitivity: Relative sensitivity, about 1, float32 [H, W].
        offset: Offset, white levels, float32 [H, W].
    """

    sensitivity: NDArray[np.float32]
    offset: NDArray[np.float32]

    def correct(self, frames: NDArray, peak: float) -> NDArray[np.float32]:
        """Return the light that frames [N, H, W] (digital numbers up to `peak`) saw, white levels.

        Noise can make a dark pixel slightly negative; nothing is clipped.

        Raises:
            DataError: The frames have another size than the pattern.
        """
        if frames.shape[1:] != self.offset.shape:
            height, width = self.offset.shape
            raise DataError(
                f"the fixed pattern is of {width} x {height} pixels, the frames have {frames.shape[2]} x "
                f"{frames.shape[1]}; calibrate the camera that took them"
            )
        light = frames.astype(np.float32) / np.float32(peak) - self.offset
        return (light / np.maximum(self.sensitivity, _LEAST)).astype(np.float32)

    @property
    def digest(self) -> str:
        """Hash of the pattern: datasets that were corrected by different patterns are not alike."""
        return hashlib.sha256(self.sensitivity.tobytes() + self.offset.tobytes()).hexdigest()[:16]


def save_pattern(pattern: FixedPattern, path: str | Path) -> None:
    """Write a fixed pattern as a safetensors file, atomically."""
    tensors = {"sensitivity": pattern.sensitivity, "offset": pattern.offset}
    content = {name: torch.tensor(value, dtype=torch.float32) for name, value in tensors.items()}
    write_atomically(Path(path), sealed_bytes(content, "fixed pattern"))


def load_pattern(path: str | Path) -> FixedPattern:
    """Read a fixed pattern.

    Args:
        path: The file, or the folder of a calibrated setup that holds it.

    Raises:
        DataError: There is no such file, it is damaged, or it holds something else.
    """
    path = Path(path)
    if path.is_dir():
        path = path / PATTERN_FILE
    if not path.is_file():
        raise DataError(
            f"{path} does not exist; `evnlos calibrate` writes the fixed pattern of a setup's camera"
        )
    try:
        _, tensors, _ = read_sealed(path)
        check_floats(tensors)
        sensitivity, offset = (tensors[name].float().numpy() for name in ("sensitivity", "offset"))
    except (OSError, ValueError, LookupError) as error:
        raise DataError(f"{path} holds no fixed pattern: {' '.join(str(error).split())}") from None
    if sensitivity.ndim != 2 or sensitivity.shape != offset.shape:
        raise DataError(
            f"{path}: sensitivity {sensitivity.shape} and offset {offset.shape} are no pictures of one size"
        )
    return FixedPattern(sensitivity, offset)


def pattern_of(setup: str | Path | None, pattern: str | Path | None = None) -> FixedPattern | None:
    """Return the fixed pattern that a setup stands for to every command: the one in its calibrated folder.

    Args:
        setup: Word of a setup (see `load_setup`): a calibrated folder, a settings file in it, or any other
            word; None for no setup.
        pattern: A file or folder with another pattern, which wins.

    Returns:
        The pattern; None where neither has any.

    Raises:
        DataError: As of `load_pattern`.
    """
    if pattern is not None:
        return load_pattern(pattern)
    if setup is None:
        return None
    folder = Path(setup) if Path(setup).is_dir() else Path(setup).parent
    names_folder = folder == Path(setup) or Path(setup).suffix in (".yaml", ".yml")
    return load_pattern(folder) if names_folder and (folder / PATTERN_FILE).is_file() else None


PATTERN_FILE = "pattern.safetensors"
"""Name of the file in a setup's folder."""


def frame_homography(
    folder: Path, info: RegistrationInfo, capture: CaptureInfo
) -> tuple[NDArray[np.float64], str]:
    """Return the matrix from frame to event pixels, float64 [3, 3], and how it was found."""
    if info.homography is not None:
        return np.array(info.homography), "the homography stated"
    if info.points is not None:
        pairs = np.array(info.points, float).reshape(-1, 4)
        frame, event, how = pairs[:, :2], pairs[:, 2:], f"{len(pairs)} points"
    else:
        dots = info.dots
        assert dots is not None
        picture = read_image(inside(folder, dots.frame))
        if capture.frames_turned:
            picture = picture[::-1, ::-1]
        seen = read_events(
            inside(folder, dots.events), width=capture.camera.width, height=capture.camera.height
        )
        frame = find_dots(picture, dots.rows, dots.columns)
        event = find_dots(event_histogram(seen)[0].sum(axis=0), dots.rows, dots.columns)
        how = f"{dots.rows} x {dots.columns} dots"
    matrix = homography_from_points(frame, event)
    return matrix, f"{how} (rms error {registration_error(matrix, frame, event):.2f} pixels)"
