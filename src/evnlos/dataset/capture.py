"""A capture: one real (or pseudo-real) shot as a folder of frames, events and what is known about them."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from evnlos.config import from_dict, read_yaml
from evnlos.errors import DataError
from evnlos.events import read_events
from evnlos.scene import LineMotion, Scene, Target
from evnlos.types import Events


@dataclass(frozen=True)
class CameraInfo:
    """The camera that watched the wall."""

    width: int
    """Sensor width, pixels."""
    height: int
    """Sensor height, pixels."""
    name: str = "unknown"
    """Maker and model."""
    frame_rate_hz: float | None = None
    """Frames a second, hertz."""
    exposure_s: float | None = None
    """Exposure of a frame, seconds."""


@dataclass(frozen=True)
class TargetInfo:
    """The hidden plate, where it is known."""

    name: str
    """What it shows, e.g. a letter."""
    mask: str | None = None
    """Picture of the plate, a file in the folder; white shines."""
    plate_m: float = 0.08
    """Side of the plate, metres."""


@dataclass(frozen=True)
class MotionInfo:
    """A straight, steady motion: the plate's centre is at start_m + speed (t - start_us) along `direction`."""

    start_m: float | tuple[float, float]
    """Centre at `start_us` relative to the middle of the travel: along the direction, or (x, y), metres."""
    speed_m_s: float
    """Speed, metres a second."""
    direction: tuple[float, float] = (1.0, 0.0)
    """Direction (x to the right, y downwards)."""
    start_us: int = 0
    """Instant of the start on the events' clock, microseconds."""


@dataclass(frozen=True)
class CaptureInfo:
    """What `capture.yaml` holds."""

    camera: CameraInfo
    """The camera."""
    events: str = "events.raw"
    """The event file, as the camera wrote it."""
    frames: str = "frames.csv"
    """Table of the frames: t_us,file."""
    target: TargetInfo | None = None
    """The target, where it is known."""
    motion: MotionInfo | None = None
    """Its motion, where it is known."""
    rig: dict[str, Any] = field(default_factory=dict)
    """Notes about the rig: distance_m, wall, ambient."""


@dataclass(frozen=True, eq=False)
class Capture:
    """One shot, read and checked.

    Args:
        name: Name of the capture, that of its folder.
        info: What `capture.yaml` says.
        events: The event stream.
        frames: Frames, uint8 or uint16 [N, H, W], digital numbers.
        frame_times_us: Time of each frame, int64 [N], microseconds, on the events' clock.
        target: The hidden plate, or None where it is unknown.
    """

    name: str
    info: CaptureInfo
    events: Events
    frames: NDArray[np.uint8] | NDArray[np.uint16]
    frame_times_us: NDArray[np.int64]
    target: Target | None

    @property
    def peak(self) -> int:
        """Largest digital number that a frame can hold."""
        return int(np.iinfo(self.frames.dtype).max)

    @property
    def scene(self) -> Scene | None:
        """The target and its motion on the events' clock; None where either is unknown."""
        motion = self.info.motion
        if self.target is None or motion is None:
            return None
        direction = np.asarray(motion.direction, dtype=float)
        start = motion.start_m
        if not isinstance(start, tuple):
            along = start * direction / np.hypot(*direction)
            start = (float(along[0]), float(along[1]))
        line = LineMotion(start, motion.speed_m_s, motion.direction, motion.start_us * 1e-6)
        return Scene(self.target, line, duration_s=max(float(self.frame_times_us[-1]) * 1e-6, 1e-6))


def read_capture(folder: str | Path) -> Capture:
    """Read a capture folder: `capture.yaml`, the event file, the frames and the target's mask.

    Args:
        folder: The folder of one shot.

    Raises:
        DataError: A file is missing, or a frame has another size than the camera.
        ConfigError: `capture.yaml` has an unknown key or a wrong type.
        EventFileError: The event file is damaged.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(f"{folder} is not a folder; give the folder of a capture (it holds capture.yaml)")
    described = folder / "capture.yaml"
    info = from_dict(CaptureInfo, read_yaml(described), source=str(described))
    size = (info.camera.height, info.camera.width)
    frames, times = _read_frames(folder, info.frames, size)
    events = read_events(_inside(folder, info.events), width=size[1], height=size[0])
    if not len(events):
        raise DataError(
            f"{folder / info.events} holds no event; check the camera's thresholds and the recording"
        )
    return Capture(folder.name, info, events, frames, times, _read_target(folder, info.target))


def _inside(folder: Path, name: str) -> Path:
    """Return the path of a file of the capture; a name never leads out of the folder."""
    path = (folder / name).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise DataError(f"{folder}: {name!r} lies outside the capture folder; put the file into it")
    if not path.is_file():
        raise DataError(f"{path} does not exist; {folder / 'capture.yaml'} names it")
    return path


def _read_frames(folder: Path, table: str, size: tuple[int, int]) -> tuple[NDArray, NDArray[np.int64]]:
    path = _inside(folder, table)
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if not rows or not {"t_us", "file"} <= rows[0].keys():
        raise DataError(f"{path} holds no frames; give a header 't_us,file' and one line a frame")
    try:
        times = np.array([int(row["t_us"]) for row in rows], dtype=np.int64)
    except (TypeError, ValueError):
        raise DataError(f"{path} holds a time that is not a whole number of microseconds") from None
    if (np.diff(times) <= 0).any():
        i = int(np.argmax(np.diff(times) <= 0))
        raise DataError(f"{path}: frame {i + 1} at {times[i + 1]} us follows {times[i]} us; times must ascend")
    return np.stack([_read_image(_inside(folder, row["file"]), size) for row in rows]), times


def _read_image(path: Path, size: tuple[int, int] | None = None) -> NDArray:
    """Read a grey picture as uint8 or uint16 [H, W]."""
    try:
        with Image.open(path) as image:
            if size is not None and image.size != (size[1], size[0]):
                wide, high = image.size
                raise DataError(f"{path} is {wide} x {high} pixels; the camera has {size[1]} x {size[0]}")
            array = np.asarray(image if image.mode.startswith("I;16") else image.convert("L"))
    except (UnidentifiedImageError, OSError) as error:
        raise DataError(f"{path} can't be read as a picture: {error}") from None
    return array


def _read_target(folder: Path, info: TargetInfo | None) -> Target | None:
    if info is None or info.mask is None:
        return None
    mask = _read_image(_inside(folder, info.mask))
    return Target(info.name, mask.astype(np.float32) / np.float32(np.iinfo(mask.dtype).max), info.plate_m)
