"""A video as light, frame by frame, from files, animations, folders and arrays; its events; its making.

- A video on disk as light, frame by frame; a part of its images where only that is looked at.
- The events that an event camera would send of it, in memory that does not grow with its length.
- The video that a frame camera would make of light that is simulated.
"""

from __future__ import annotations

import glob
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from evnlos.cameras.event_camera import EventStream
from evnlos.cameras.event_model import PixelMaps, PixelSettings
from evnlos.cameras.frame_camera import FrameCamera
from evnlos.cameras.pixel import EventPixel, Mode
from evnlos.cameras.video_files import (
    AnimationSource,
    ArraySource,
    ContainerSource,
    PictureSource,
    PicturesSource,
    Tone,
    from_light,
    to_light,
)
from evnlos.errors import ConfigError, DataError
from evnlos.types import Colour, Events, Irradiance
from evnlos.untrusted import MOST_SENSOR_PIXELS, check_memory, no_file

_PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp")
_ANIMATIONS = (".gif", ".png", ".apng", ".webp")
_BLOCK_BYTES = 1 << 25
_BLOCK_FRAMES = 64
_USUAL_FPS = 25.0
_UNTIMED = "its frames carry no times; give fps= (--fps)"
_LEAST, _MOST = 1e-3, 1e9  # of frame rate, slow motion and white


@dataclass(frozen=True)
class Video:
    """A video on disk; iterating it reads frame by frame and yields (time in seconds, light [H, W] in DN).

    Args:
        path: The file or folder.
        width: Width of a frame, pixels.
        height: Height of a frame, pixels.
        frames: Number of frames, None where the file does not say.
        fps: Frames per second in place of the times in the file; None = the file's own, whatever their spacing.
        slow_motion: How many times slower than life the video plays.
        tone: Tone curve that is undone.
        white: Value of white in the file.
        box: Part of the frame that is read (left, top, right, bottom), pixels; None = all of it.
        colour: Colour that is taken of coloured frames; None = all of them, as grey.
    """

    path: Path
    width: int
    height: int
    frames: int | None
    fps: float | None
    slow_motion: float
    tone: Tone
    white: float
    source: PictureSource = field(repr=False)
    box: tuple[int, int, int, int] | None = None
    colour: Colour | None = None

    def part(self, box: tuple[int, int, int, int]) -> Video:
        """Return the same video of which only a part (left, top, right, bottom) of each frame becomes light.

        Raises:
            ConfigError: The part is empty or not within the frame, or the video is read at another size.
        """
        left, top, right, bottom = box
        if (self.width, self.height) != self.source.size:
            raise ConfigError("a part is taken of a video at its own size; leave out the scale")
        if not (0 <= left < right <= self.width and 0 <= top < bottom <= self.height):
            raise ConfigError(f"the part {box} is not within a frame of {self.width} x {self.height} pixels")
        return replace(self, width=right - left, height=bottom - top, box=box)

    def __iter__(self) -> Iterator[tuple[float, NDArray[np.float32]]]:
        first = before = -math.inf
        for number, (stated_s, picture) in enumerate(self.source.pictures()):
            if self.fps is not None:
                time_s = number / self.fps
            elif stated_s is None:
                raise DataError(f"{self.path}: frame {number} carries no time; give fps= (--fps)")
            else:
                first = stated_s if number == 0 else first
                time_s = stated_s - first
            if time_s <= before:
                found = f"frame {number} is at {time_s:.6f} s, the one before it at {before:.6f} s"
                raise DataError(f"{self.path}: {found}; give fps= (--fps) in place of the file's times")
            before = time_s
            if self.box is not None:
                left, top, right, bottom = self.box
                picture = picture[top:bottom, left:right]
            light = to_light(picture, self.tone, self.white, self.colour)
            if picture.dtype.kind == "f" and not np.isfinite(light).all():
                raise DataError(f"{self.path}: frame {number} holds NaN or infinity; leave it out or mend it")
            yield time_s / self.slow_motion, _resized(light, self.width, self.height)


def open_video(
    path: str | PathLike[str] | Sequence[str | PathLike[str]],
    *,
    fps: float | None = None,
    slow_motion: float = 1.0,
    tone: Tone = "as-is",
    white: float | None = None,
    scale: str | None = None,
    colour: Colour | None = None,
    white_cure: str = "give white=1 (--white 1) if 1 is white, 255 if not",
) -> Video:
    """Return a video that is read frame by frame, as light with the instants of its frames.

    Args:
        path: Video file (needs the extra `video`), animated GIF, PNG or WebP, folder, list or glob of images,
            NumPy file [T, H, W] or [T, H, W, 3]. Images are ordered by the numbers in their names.
        fps: Frames per second, 0.001 to 1e9; needed for images and arrays, else in place of the file's times.
        slow_motion: How many times slower than life the video plays, 0.001 to 1e9; 8 for 240 Hz shown at 30 Hz.
        tone: "as-is" takes the numbers as light, as v2e does (luma of Rec. 601 for colour); "srgb" and "rec709"
            undo that curve first (luminance of Rec. 709); white stays white.
        white: Value of white in the file, 0.001 to 1e9; by default 255, or 65535 for 16 bits.
        scale: Size to work at, "WIDTHxHEIGHT" or a factor such as "0.5"; by default that of the file.
        colour: Colour to take of coloured frames; None is all of them, as grey.
        white_cure: What to do, says the message, where floating-point frames end at 1 and `white` is not given.

    Raises:
        DataError: The path is absent, no video, or of one frame; or times are needed.
        ConfigError: A number out of its range.
        MissingDependencyError: A video file without PyAV.

    Example:
        >>> import tempfile
        >>> name = tempfile.mkdtemp() + "/ramp.npy"
        >>> np.save(name, np.arange(24, dtype=np.uint8).reshape(4, 2, 3))
        >>> [(time_s, float(light[0, 0])) for time_s, light in open_video(name, fps=2)]
        [(0.0, 0.0), (0.5, 6.0), (1.0, 12.0), (1.5, 18.0)]
    """
    if tone not in get_args(Tone):
        raise ConfigError(f"tone is {tone!r}; give one of {', '.join(get_args(Tone))}")
    for name, value in (("fps", fps), ("slow_motion", slow_motion), ("white", white)):
        if value is not None and not _LEAST <= value <= _MOST:
            raise ConfigError(f"{name} is {value}; give {_LEAST:g} to {_MOST:g}")
    shown, source = _find(path)
    if source.frames is not None and source.frames < 2:
        raise DataError(
            f"{shown}: {source.frames} frame{'s' * (source.frames != 1)}; events need a video of at least two"
        )
    if fps is None and not source.timed:
        raise DataError(f"{shown}: {_UNTIMED}")
    chosen = white or source.white or _white_of_floats(shown, source, white_cure)
    width, height = _working_size(scale, source.size)
    return Video(shown, width, height, source.frames, fps, slow_motion, tone, chosen, source, colour=colour)


def video_events(
    frames: Iterable[tuple[float, NDArray]],
    pixel: PixelSettings | None = None,
    mode: Mode = "exact",
    seed: int = 0,
    maps: PixelMaps | None = None,
) -> Iterator[Events]:
    """Yield the events of a video in order, piece by piece, in memory that does not grow with its length.

    Joined, the pieces are what `simulate_events` returns for all frames at once.

    Args:
        frames: Time in seconds and light [H, W] in DN of each frame, such as a `Video`; times ascend.
        pixel: Settings of the pixels, of any kind; None = the paper's.
        mode: "exact" or "v2e", as in `simulate_events`.
        seed: Seed of mismatch and noise.
        maps: Measured thresholds of the sensor; None draws them.

    Raises:
        DataError: Fewer than two frames, frames of unequal size, or times that do not ascend.

    Example:
        >>> flash = [(0.0, np.full((2, 2), 50.0)), (0.1, np.full((2, 2), 100.0))]
        >>> quiet = EventPixel(0.15, 0.15, 0, 0, 0, 0, initial_phase="rest")
        >>> sum(len(piece) for piece in video_events(flash, quiet))
        16
    """
    pixel = EventPixel() if pixel is None else pixel
    margin_us = math.ceil(pixel.disorder_s * 1e6)
    stream: EventStream | None = None
    held: Events | None = None
    count = 0
    for times_s, block in _blocks(frames):
        if stream is None:
            stream = EventStream(pixel, (block.shape[1], block.shape[2]), mode=mode, seed=seed, thresholds=maps)
        stream.push(block, times_s)
        count += len(block)
        merged = _merged(held, stream.finish())
        # Later events may have this block's last time stamp, or, with jitter, an earlier one.
        sure = int(np.searchsorted(merged.t_us, math.floor(times_s[-1] * 1e6) - margin_us))
        held = merged[sure:]
        yield merged[:sure]
    if count < 2:
        raise DataError(f"a video of {count} frame{'s' * (count != 1)}; events need at least two")
    assert held is not None
    yield held


def film(
    wall: Irradiance, camera: FrameCamera, times_s: Sequence[float], tone: Tone = "srgb", seed: int = 0
) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames of an ordinary video of a wall or a floor, uint8 [H, W], one at a time.

    The camera's digital numbers are light; a video's are codes of a tone curve, rounded to 8 bits. Give a
    camera of 12 bits with a curve: its rounding is then finer than that of the codes, as in cameras that are
    bought.

    Args:
        wall: The light, 1.0 = white.
        camera: Exposure, noise and rounding of the sensor.
        times_s: Middles of the exposures, seconds.
        tone: Curve of the codes; "as-is" = none.
        seed: Seed of the noise.

    Raises:
        DataError: The light is NaN or negative.
    """
    span = camera.white - camera.black_level
    for number, time_s in enumerate(times_s):
        instants, weights = camera.instants(float(time_s))
        light = np.tensordot(weights, wall.irradiance(instants).double().numpy(), 1)
        counts = camera.expose(light[None], seed, number)[0].astype(np.float64)
        yield from_light(255 * np.clip((counts - camera.black_level) / span, 0, 1), tone)


def check_video(video: Video, pixel: PixelSettings) -> None:
    """Refuse a video whose simulation takes more memory than there is, before anything is simulated.

    Counted are the states of the pixels, a block of frames, and the events of the noise in it.

    Args:
        video: The video.
        pixel: Settings of the pixels.

    Raises:
        DataError: Its sensor is larger than any, or its simulation needs more memory than there is.
    """
    pixels = video.width * video.height
    smaller = "give a smaller --scale"
    if pixels > MOST_SENSOR_PIXELS:
        raise DataError(
            f"{video.path} has {video.width} x {video.height} pixels; at most {MOST_SENSOR_PIXELS:,} are "
            f"simulated: {smaller}"
        )
    block_s = _BLOCK_FRAMES / (video.fps or _USUAL_FPS) / video.slow_motion
    noise = pixels * block_s * pixel.noise_hz
    what = f"a sensor of {video.width} x {video.height} pixels"
    cure = f"{smaller}, less noise or more --fps; or force it"
    check_memory(int(100 * pixels + 3 * _BLOCK_BYTES + 2 * 26 * noise), what, cure)


def _find(path: str | PathLike[str] | Sequence[str | PathLike[str]]) -> tuple[Path, PictureSource]:
    """Return what to call a video, and its source."""
    if not isinstance(path, (str, PathLike)):
        paths = [Path(one) for one in path]
        if len(paths) == 1:
            return _find(paths[0])
        if not paths:
            raise DataError("no video; give a file, a folder or images")
        return _named(paths)
    path = Path(path)
    if path.is_dir():
        inside = [one for one in path.iterdir() if one.suffix.lower() in _PICTURES]
        if not inside:
            raise DataError(f"{path}: a folder without images; {', '.join(_PICTURES)} are read")
        return path, _named(inside)[1]
    if not path.exists() and glob.has_magic(str(path)):
        found = [Path(one) for one in glob.glob(str(path))]  # noqa: PTH207 - the pattern may be absolute
        if not found:
            raise DataError(no_file(path))
        return path, _named(found)[1]
    if not path.is_file():
        raise DataError(no_file(path))
    if path.suffix.lower() == ".npy":
        return path, ArraySource(path)
    if path.suffix.lower() in (*_ANIMATIONS, *_PICTURES):
        return path, AnimationSource(path)
    return path, ContainerSource(path)


def check_paths(paths: Sequence[Path], fps: float | None) -> None:
    """Refuse paths that are not one video, or of frames that carry no times, by their names alone.

    Args:
        paths: As of `open_video`.
        fps: Frames per second, where they are stated.

    Raises:
        DataError: There is one.
    """
    first = paths[0]
    if len(paths) > 1:
        _check_images(paths)
    inside = first.iterdir() if first.is_dir() else ()
    images = len(paths) > 1 or any(one.suffix.lower() in _PICTURES for one in inside)
    if first.is_dir() and not images:
        raise DataError(f"{first} holds neither videos nor images; give a folder of videos, or of images")
    if fps is None and (images or first.suffix.lower() == ".npy"):
        raise DataError(f"{first}: {_UNTIMED}")


def _check_images(paths: Sequence[Path]) -> None:
    cure = "several files are the images of one video: give one video, or a folder of videos"
    missing = [path for path in paths if not path.is_file()]
    if missing:
        raise DataError(f"{missing[0]} is a folder; {cure}" if missing[0].is_dir() else no_file(missing[0]))
    if other := next((path for path in paths if path.suffix.lower() not in _PICTURES), None):
        raise DataError(f"{other} is not an image; {cure}")


def _named(paths: list[Path]) -> tuple[Path, PictureSource]:
    _check_images(paths)
    paths = sorted(
        paths, key=lambda path: [int(s) if s.isdigit() else s for s in re.split(r"(\d+)", str(path))]
    )
    return paths[0], PicturesSource(paths)


def _white_of_floats(path: Path, source: PictureSource, cure: str) -> float:
    """Return 255 for floating-point images, unless the first looks as if 1 were white."""
    _, picture = next(source.pictures())
    if 0 < float(np.max(picture)) <= 1.0:
        raise DataError(f"{path}: the largest number of its first frame is {np.max(picture):g}; {cure}")
    return 255.0


def _working_size(scale: str | None, size: tuple[int, int]) -> tuple[int, int]:
    if scale is None:
        return size
    sides = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", scale)
    if sides:
        width, height = int(sides[1]), int(sides[2])
    else:
        try:
            width, height = (round(float(scale) * side) for side in size)
        except (ValueError, OverflowError):
            raise ConfigError(
                f"scale is {scale!r}; give WIDTHxHEIGHT or a factor, e.g. 346x260 or 0.5"
            ) from None
    if not (1 <= width <= 16_384 and 1 <= height <= 16_384):
        raise ConfigError(f"scale {scale} makes {width} x {height} pixels; give sides of 1 to 16384")
    if width * height > MOST_SENSOR_PIXELS:
        raise ConfigError(f"scale {scale} makes {width} x {height} pixels; give at most {MOST_SENSOR_PIXELS:,}")
    return width, height


def _resized(light: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Return light at another size: the mean over the area where it shrinks, linear where it grows."""
    if light.shape == (height, width):
        return np.ascontiguousarray(light)
    shrinks = width <= light.shape[1] and height <= light.shape[0]
    how = Image.Resampling.BOX if shrinks else Image.Resampling.BILINEAR
    return np.asarray(Image.fromarray(np.ascontiguousarray(light)).resize((width, height), how))


def _blocks(frames: Iterable[tuple[float, NDArray]]) -> Iterator[tuple[list[float], NDArray]]:
    """Yield the frames in blocks of bounded size: times [T] and light [T, H, W]."""
    times_s: list[float] = []
    held: list[NDArray] = []
    for time_s, light in frames:
        if held and light.shape != held[0].shape:
            raise DataError(f"a frame of shape {light.shape} after {held[0].shape}; give frames of one size")
        times_s.append(time_s)
        held.append(light)
        if len(held) == _BLOCK_FRAMES or len(held) * light.nbytes >= _BLOCK_BYTES:
            yield times_s, np.stack(held)
            times_s, held = [], []
    if held:
        yield times_s, np.stack(held)


def _merged(held: Events | None, new: Events) -> Events:
    """Return held events and new ones in order: by time, row, column, OFF before ON."""
    if held is None or not len(held):
        return new
    columns = {name: np.concatenate([held.columns()[name], new.columns()[name]]) for name in new.columns()}
    touched = int(np.searchsorted(new.t_us, held.t_us[-1], "right"))  # those after them stay where they are
    first = len(held) + touched
    order = np.lexsort([columns[name][:first] for name in ("p", "x", "y", "t_us")])
    for column in columns.values():
        column[:first] = column[:first][order]
    return Events(width=new.width, height=new.height, **columns)
