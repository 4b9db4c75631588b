"""The frames of a capture, in whatever form they lie in its folder."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from evnlos.cameras.video import open_video
from evnlos.data.capture_info import CaptureInfo
from evnlos.errors import DataError
from evnlos.events import read_timed_frames
from evnlos.untrusted import check_memory, memory_left, open_image, open_regular

_RECORDINGS = (".aedat4", ".aedat", ".bag", ".db3", ".mcap", ".bin")


@dataclass(frozen=True, eq=False)
class FrameSeries:
    """Frames in the order of time.

    Args:
        images: uint8 or uint16 [N, H, W], digital numbers.
        times_us: Times on the frames' own clock, int64 [N], microseconds.
        what: What they were read from, for a message.
    """

    images: NDArray
    times_us: NDArray[np.int64]
    what: str


def inside(folder: Path, name: str, by: str = "capture.yaml") -> Path:
    """Return the path of a file or folder of the capture; a name never leads out of its folder.

    Args:
        folder: The capture's or scan's folder.
        name: Path of the file below it.
        by: File of that folder that names it, for the message.

    Raises:
        DataError: It is no name, lies outside the folder, or does not exist.
    """
    try:
        path = (folder / name).resolve()
        there = path.exists()
    except (OSError, ValueError) as error:
        raise DataError(f"{folder}: {name[:80]!r} is no name of a file ({error})") from None
    if not path.is_relative_to(folder.resolve()):
        raise DataError(f"{folder}: {name!r} lies outside the capture folder; put the file into it")
    if not there:
        raise DataError(f"{path} does not exist; {folder / by} names it, or leaves its name to the default")
    return path


def read_image(path: Path, size: tuple[int, int] | None = None) -> NDArray:
    """Read a grey picture as uint8 or uint16 [H, W]; `size` is (rows, columns)."""
    try:
        with open_image(path) as image:
            if size is not None and image.size != (size[1], size[0]):
                wide, high = image.size
                raise DataError(f"{path} is {wide} x {high} pixels; the camera has {size[1]} x {size[0]}")
            if image.mode == "F" and not np.isfinite(np.asarray(image)).all():
                raise DataError(f"{path} holds NaN or infinity; leave it out or mend it")
            array = np.asarray(image if image.mode.startswith("I;16") else image.convert("L"))
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
        raise DataError(f"{path} can't be read as a picture: {error}") from None
    return array


def read_frame_series(folder: Path, info: CaptureInfo, most_bytes: int | None = None) -> FrameSeries:
    """Read the frames that a capture names.

    Args:
        folder: The capture's folder.
        info: Its description.
        most_bytes: Memory that they may take, bytes; None = a quarter of what is free, at most 2 GiB.

    Raises:
        DataError: A file is missing or unreadable, the frames take too much memory, or they carry no time and
            no rate is stated.
        EventFileError: A recording of the camera is damaged.
    """
    path = inside(folder, info.frames)
    most = min(memory_left() // 4, 1 << 31) if most_bytes is None else most_bytes
    size = None if info.registration is not None else (info.camera.height, info.camera.width)
    if path.suffix.lower() == ".csv":
        return _from_table(folder, path, size, most)
    if path.suffix.lower() in _RECORDINGS:
        found = read_timed_frames(path, topic=info.frames_topic)
        times = found.t_us if found.t_us is not None else _at_rate(path, len(found.images), info)
        series = FrameSeries(found.images, times, path.name)
    else:
        series = _from_video(folder, path, info, most)
    _check_times(path, series.times_us)
    if size is not None and series.images.shape[1:] != size:
        high, wide = series.images.shape[1:]
        raise DataError(
            f"{path} is {wide} x {high} pixels; the camera has {size[1]} x {size[0]}: state a registration"
        )
    return series


def _rate(path: Path, info: CaptureInfo) -> float:
    rate = info.camera.frame_rate_hz
    if rate is None or not rate > 0:
        raise DataError(f"{path}: its frames carry no times; state camera.frame_rate_hz in capture.yaml")
    return rate


def _at_rate(path: Path, count: int, info: CaptureInfo) -> NDArray[np.int64]:
    return np.round(np.arange(count) * (1e6 / _rate(path, info))).astype(np.int64)


def _from_video(folder: Path, path: Path, info: CaptureInfo, most: int) -> FrameSeries:
    """Read a video, animation, array or folder of pictures as 16 bits."""
    if path.is_dir():
        for one in path.iterdir():
            inside(folder, str(one.relative_to(folder.resolve())), f"{info.frames}")
    timed = path.is_file() and path.suffix.lower() != ".npy"
    video = open_video(path, fps=None if timed else _rate(path, info))
    _check_size(path, (video.frames or 1) * video.width * video.height * 2, most)
    times_s, images = [], []
    for time_s, light in video:
        _check_size(path, (len(images) + 1) * light.size * 2, most)
        if not np.isfinite(light).all():
            raise DataError(f"{path}: frame {len(images)} holds NaN or infinity; give finite values")
        times_s.append(time_s)
        images.append(np.clip(np.round(light * (65_535 / 255)), 0, 65_535).astype(np.uint16))
    if not images:
        raise DataError(f"{path} holds no frames; give another file")
    return FrameSeries(np.stack(images), np.round(np.array(times_s) * 1e6).astype(np.int64), path.name)


def _from_table(folder: Path, path: Path, size: tuple[int, int] | None, most: int) -> FrameSeries:
    try:
        with open_regular(path) as opened, TextIOWrapper(opened, encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path} can't be read as a table: {error}") from None
    if not rows or not {"t_us", "file"} <= rows[0].keys():
        raise DataError(f"{path} holds no frames; give a header 't_us,file' and one line per frame")
    try:
        times = np.array([int(row["t_us"]) for row in rows], dtype=np.int64)
    except (TypeError, ValueError, OverflowError):
        raise DataError(f"{path} holds a time that is not a whole number of microseconds") from None
    _check_times(path, times)
    named: dict[str, int] = {}
    for k, row in enumerate(rows):
        before = named.setdefault(row["file"] or "", k)
        if before != k:
            raise DataError(f"{path}: frames {before} and {k} are both {row['file']}; name every picture once")
    first = read_image(inside(folder, rows[0]["file"] or "", path.name), size)
    _check_size(path, len(rows) * first.nbytes, most)
    images = np.empty((len(rows), *first.shape), first.dtype)
    for k, row in enumerate(rows):
        image = read_image(inside(folder, row["file"] or "", path.name), size) if k else first
        if image.shape != first.shape or image.dtype != first.dtype:
            raise DataError(
                f"{path}: frame {k} is {image.dtype} {image.shape}, frame 0 {first.dtype} "
                f"{first.shape}; give frames of one camera"
            )
        images[k] = image
    return FrameSeries(images, times, path.name)


def _check_size(path: Path, needed: int, most: int) -> None:
    check_memory(needed, f"{path}: its frames", "leave frames out, or make them smaller", most)


def _check_times(path: Path, times: NDArray[np.int64]) -> None:
    if len(times) and max(abs(int(times[0])), abs(int(times[-1]))) > 2**62:
        raise DataError(f"{path}: times leave +-2^62 us; give microseconds")
    if (np.diff(times) <= 0).any():
        i = int(np.argmax(np.diff(times) <= 0))
        raise DataError(f"{path}: frame {i + 1} at {times[i + 1]} us follows {times[i]} us; times must ascend")
