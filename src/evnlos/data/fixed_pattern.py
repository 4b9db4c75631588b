"""What a frame camera adds to what it saw, dark signal and uneven response, and how it is taken away.

- A dark frame and a flat field, as a capture's folder holds them; frames on the event camera's pixels.
- The fixed pattern that a calibration found, its file, and where a setup has it.
- The thresholds of the event pixels that a capture uses, where the sensor was measured.
- What is left of frames without the setup's ambient light.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import ArrayLike, NDArray

from evnlos.cameras import PixelMaps
from evnlos.data.capture_info import CaptureInfo, inside
from evnlos.data.frames import FrameSeries, map_points, of_used, read_image, stride_of
from evnlos.data.sampling import frame_homography, reduce_by_area
from evnlos.errors import DataError
from evnlos.events import FrameStack, crop_events, thin_events
from evnlos.files import write_atomically
from evnlos.setups import Setup
from evnlos.tensor_file import check_floats, read_sealed, sealed_bytes
from evnlos.types import Events
from evnlos.untrusted import check_memory


def correct_frames(
    frames: NDArray, peak: float, dark: NDArray | None = None, flat: NDArray | None = None
) -> NDArray[np.float32]:
    """Return frames without dark signal and uneven response, 0..1.

    (F - D) / (peak - mean D), divided by (flat - D) / mean(flat - D) where there is a flat field, and clipped.

    Args:
        frames: [N, H, W], digital numbers.
        peak: Largest digital number.
        dark: Mean of frames with the lens covered, [H, W], digital numbers.
        flat: Mean of frames of an evenly lit surface, [H, W], digital numbers.

    Raises:
        DataError: An image of another size, or a flat field that is nowhere brighter than the dark frame.
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
            raise DataError(f"the flat field is {mean:.1f} brighter than the dark frame; record an even one")
        # A dead pixel would become infinite; below a tenth of the mean response nothing can be said.
        out *= np.where(response > 0.1 * mean, mean / np.maximum(response, 0.1 * mean), 0.0)
    return np.clip(out / max(peak - float(ground.mean()), 1.0), 0.0, 1.0)


def mapped(frames: Any, work: Callable[[NDArray], NDArray]) -> Any:
    """Return frames with `work` done on them; on those that are read as they are asked for, block by block."""
    return frames.mapped(work) if isinstance(frames, FrameStack) else work(frames)


_MAX_SAMPLES = 8  # a side, in a pixel of the event camera


@njit(cache=True)
def _warp(frames, back, samples, out, covered):
    height, width = frames.shape[1], frames.shape[2]
    for row in range(out.shape[1]):
        for column in range(out.shape[2]):
            inside = 0
            for i in range(samples):
                for j in range(samples):
                    x, y = column + (j + 0.5) / samples - 0.5, row + (i + 0.5) / samples - 0.5
                    w = back[2, 0] * x + back[2, 1] * y + back[2, 2]
                    u = (back[0, 0] * x + back[0, 1] * y + back[0, 2]) / w if w != 0 else -1e9
                    v = (back[1, 0] * x + back[1, 1] * y + back[1, 2]) / w if w != 0 else -1e9
                    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
                        continue
                    u, v = min(max(u, 0.0), width - 1.0), min(max(v, 0.0), height - 1.0)
                    left, top = min(int(u), max(width - 2, 0)), min(int(v), max(height - 2, 0))
                    right, low = min(left + 1, width - 1), min(top + 1, height - 1)
                    a, b = u - left, v - top
                    inside += 1
                    for n in range(len(frames)):
                        upper = (1 - a) * frames[n, top, left] + a * frames[n, top, right]
                        lower = (1 - a) * frames[n, low, left] + a * frames[n, low, right]
                        out[n, row, column] += (1 - b) * upper + b * lower
            covered[row, column] = inside / (samples * samples)
            if inside:
                for n in range(len(frames)):
                    out[n, row, column] /= inside


def warp_frames(
    frames: NDArray, matrix: ArrayLike, shape: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return frames on another camera's pixels, and how much of each of these the frames cover.

    A pixel is the mean of bilinear samples on a grid in it, about a source pixel apart (at most 8 x 8).

    Args:
        frames: [N, H, W], any real numbers; pixel centres are at whole coordinates.
        matrix: Homography from frame coordinates (x, y) to those of the result, [3, 3].
        shape: Rows and columns of the result.

    Returns:
        float32 [N, *shape], 0 where nothing is covered, and the covered part, float32 [*shape], 0..1.

    Raises:
        DataError: The matrix cannot be inverted, or the frames cover nothing.
    """
    matrix = np.asarray(matrix, float)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-12:
        raise DataError(f"the homography {matrix.tolist()} cannot be inverted; give 3 rows of 3 numbers")
    back = np.linalg.inv(matrix)
    middle = np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
    steps = map_points(back, middle + np.array([[0, 0], [1, 0], [0, 1]]))
    scale = max(np.hypot(*(steps[1] - steps[0])), np.hypot(*(steps[2] - steps[0])))
    samples = int(np.clip(np.ceil(scale - 1e-9), 1, _MAX_SAMPLES)) if np.isfinite(scale) else 1
    out = np.zeros((len(frames), *shape), np.float64)
    covered = np.zeros(shape, np.float32)
    _warp(np.ascontiguousarray(frames, dtype=np.float32), back, samples, out, covered)
    if not covered.any():
        raise DataError("after registration the frames lie outside the event camera's view; check the points")
    return out.astype(np.float32), covered


_CODED = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")


def prepare_frames(folder: Path, info: CaptureInfo, series: FrameSeries) -> tuple[Any, list[str]]:
    """Return the frames on the event camera's pixels; their digital numbers stay where nothing is to do."""
    frames, notes, white, log = series.images, list[str](), info.camera.white_dn, info.camera.log
    if log is not None:
        frames = mapped(frames, partial(log.levels, what=f"{folder}: "))
        notes.append(
            f"log frames made linear: {log.codes_per_efold:g} codes per e-fold, {log.white_code:g} white"
        )
    path, camera = folder / (info.frames or ""), info.camera
    if camera.tone:
        notes.append(f"frames made linear: {camera.tone} undone")
    elif log is None and (path.suffix.lower() in _CODED or next(path.glob("*.jp*g"), None)):
        notes.append("frames of a video or as JPEG, taken as linear: most need camera: {tone: srgb}")
    size = frames.shape[1:]
    if white is not None and frames.dtype == np.uint8:
        raise DataError(f"{folder}: camera.white_dn is {white}, and frames have 8 bits; leave it out")
    peak = float(white or np.iinfo(frames.dtype).max)
    filters = size, info.camera.colour, info.camera.mosaic, info.camera.tone
    dark, flat = (read_image(inside(folder, one), *filters) if one else None for one in (info.dark, info.flat))
    flat = log.levels(flat, f"{folder}: ") if log is not None and flat is not None else flat
    is_corrected = dark is not None or flat is not None
    if white is not None:
        notes.append(f"frames scaled: white is {white}")
    if is_corrected:
        notes.append(f"frames corrected by {' and '.join(name for name in (info.dark, info.flat) if name)}")
    if info.frames_turned:
        notes.append("frames turned by 180 degrees")
    matrix, shape = None, (info.camera.height, info.camera.width)
    if info.registration is not None:
        matrix, how = frame_homography(folder, info.registration, info)
        if not isinstance(frames, FrameStack):
            needed = 16 * len(frames) * shape[0] * shape[1]
            check_memory(needed, f"{folder}: registering its frames", "leave frames out")
        covered = 100 * float(warp_frames(frames[:1], matrix, shape)[1].mean())
        notes.append(f"frames registered by {how}; they cover {covered:.0f} % of the events' view")

    def prepared(block: NDArray) -> NDArray:
        changed = correct_frames(block, peak, dark, flat) if is_corrected or white else None
        if info.frames_turned:
            block = block[:, ::-1, ::-1]
            changed = None if changed is None else changed[:, ::-1, ::-1]
        if matrix is not None:
            changed = warp_frames(block / np.float32(peak) if changed is None else changed, matrix, shape)[0]
        return block if changed is None else np.round(changed * 65_535).astype(np.uint16)

    return mapped(frames, prepared), notes


def used_pixels(info: CaptureInfo, events: Events, frames: Any) -> tuple[Events, Any, list[str]]:
    """Return events and frames of what is used of the sensor: a region, and every so many pixels of it.

    Of a square of pixels the middle one's events are kept, and the mean of the frames, uint16. The light of the
    wall is smooth: of more than 300,000 pixels, whose light takes gigabytes, about 40,000 are used by default.
    """
    notes, roi = list[str](), info.roi
    if roi is not None:
        events = crop_events(events, roi.x, roi.y, roi.width, roi.height)
        frames = mapped(frames, lambda one: one[:, roi.y : roi.y + roi.height, roi.x : roi.x + roi.width])
        notes.append(f"region {roi.width} x {roi.height} at ({roi.x}, {roi.y})")
    if (side := stride_of(info, events.width * events.height)) > 1:
        rows, columns = (length // side for length in events.shape)
        if not rows or not columns:
            raise DataError(f"every is {side}, and {events.width} x {events.height} pixels are used; give less")
        events = thin_events(crop_events(events, 0, 0, columns * side, rows * side), side, side // 2)

        def binned(block: NDArray) -> NDArray:
            squares = block[:, : rows * side, : columns * side].reshape(-1, rows, side, columns, side)
            mean = squares.mean(axis=(2, 4), dtype=np.float64)
            return np.round(mean * (65_535 / np.iinfo(block.dtype).max)).astype(np.uint16)

        frames = mapped(frames, binned)
        notes.append(f"every {side} rows and columns: {columns} x {rows} pixels")
    return events, frames, notes


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
    """Write a fixed pattern as a safetensors file, atomically.

    Args:
        pattern: Sensitivity and offset, [H, W] each.
        path: File to write; its name ends in .safetensors.
    """
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
            f"{path}: sensitivity {sensitivity.shape} and offset {offset.shape} are no images of one size"
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


def used_maps(maps: PixelMaps | None, info: CaptureInfo, shape: tuple[int, int]) -> PixelMaps | None:
    """Return the measured thresholds of the event pixels that a capture uses, [h, w], if there are any.

    Args:
        maps: Those of the whole sensor, or of the pixels that are used.
        info: What is known about the capture.
        shape: Rows and columns of the pixels that are used.

    Raises:
        DataError: They are of another camera.
    """
    if maps is None or maps.hot.shape == shape:
        return maps
    (height, width), camera = maps.hot.shape, info.camera
    if (height, width) != (camera.height, camera.width):
        raise DataError(
            f"the measured thresholds are of {width} x {height} pixels, the event camera has {camera.width} x "
            f"{camera.height}; give the pixel that was fitted to this camera"
        )
    return maps.mapped(partial(of_used, info))


PATTERN_FILE = "pattern.safetensors"
"""Name of the file in a setup's folder."""
_BLOCK = 6  # pixels: single ones tell nothing of the light


def light_path(frames: NDArray) -> NDArray[np.float64]:
    """Return the middle of the light that moves through frames, (x, y) in pixels, [N, 2].

    It is the mean place, weighted by brightness, of what is brighter by more than three tenths of the largest
    rise than it is in the darkest tenth of the time; blocks of six pixels average the noise.

    Args:
        frames: Frames of a resting camera, of any unit, [N, H, W].
    """
    size = frames.shape[1:]
    height, width = (max(1, round(side / _BLOCK)) for side in size)
    blocks = reduce_by_area(frames.astype(np.float32), (height, width))
    rise = blocks - np.quantile(blocks, 0.1, axis=0)
    weight = np.maximum(rise - 0.3 * np.quantile(rise, 0.99), 1e-6)
    x, y = ((np.arange(n) + 0.5) * side / n for n, side in ((width, size[1]), (height, size[0])))
    total = weight.sum(axis=(1, 2))
    return np.stack([weight.sum(axis=1) @ x, weight.sum(axis=2) @ y], axis=1) / total[:, None]


def object_light(
    frames: NDArray,
    peak: float,
    setup: Setup,
    shape: tuple[int, int],
    pattern: FixedPattern | None = None,
) -> torch.Tensor:
    """Return frames less the setup's ambient light, reduced by area averaging.

    Args:
        frames: Digital numbers [N, H, W].
        peak: Digital number of white.
        setup: The setup that says how much ambient light there is.
        shape: Size (h, w) of the result, pixels.
        pattern: The camera's fixed pattern, to be taken off first.

    Returns:
        White levels, float32 [N, h, w]; noise makes some of them negative.
    """
    levels = frames / np.float32(peak) if pattern is None else pattern.correct(frames, peak)
    size = (frames.shape[-2], frames.shape[-1])
    return torch.from_numpy(reduce_by_area(levels - setup.ambient_light(size).numpy(), shape))
