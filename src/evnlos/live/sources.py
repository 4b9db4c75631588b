"""From the words of a command line to a source: a capture, a recording, a file that grows, or a port."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

from evnlos.dataset.capture import read_capture
from evnlos.dataset.fixed_pattern import FixedPattern
from evnlos.errors import ConfigError
from evnlos.events.recording import Cut, Recording
from evnlos.live.chunk import Source
from evnlos.live.clock import Clock
from evnlos.live.growing import GrowingFile
from evnlos.live.replay import Replay, TimedFrame
from evnlos.live.udp import UdpSource

_SCHEME = "udp://"


@dataclass(frozen=True)
class Listening:
    """How a source is opened."""

    follow: bool = False
    """Read a file while it grows, in place of replaying it."""
    speed: float = 1.0
    """Speed of a replay: 1 = as it happened, 10 = ten times faster."""
    idle: float = 10.0
    """End when a growing file or, after the first packet, UDP brought nothing for so many seconds; 0 = wait for
    ever."""
    width: int | None = None
    """Sensor width, pixels, where a file does not say; give both or neither."""
    height: int | None = None
    """Sensor height, pixels."""

    def __post_init__(self) -> None:
        if not self.idle >= 0:
            raise ConfigError(f"idle is {self.idle}; give 0 (for ever) or a number of seconds")
        if (self.width is None) != (self.height is None):
            raise ConfigError(f"width is {self.width}, height {self.height}; give both or neither")

    @property
    def idle_s(self) -> float | None:
        """Seconds without an event that end a source; None = never."""
        return self.idle or None


def open_live(source: str, how: Listening = Listening(), pattern: FixedPattern | None = None) -> Source:
    """Return a source of events by its name.

    Args:
        source: `udp://HOST:PORT`, the folder of a capture, or an event file.
        how: Whether a file grows, how fast a replay goes, when to give up.
        pattern: Fixed pattern of the frame camera, to be taken from a capture's frames.

    Raises:
        DataError: There is no such capture, or it is damaged.
        EventFileError: There is no such event file, or it is damaged.
        ConfigError: The address can't be listened at, or an option does not fit.
    """
    if source.startswith(_SCHEME):
        return UdpSource(*_address(source), idle_s=how.idle_s)
    path = Path(source)
    if path.is_dir():
        if how.follow:
            raise ConfigError(f"{source} is a folder; --follow takes the event file that grows")
        return capture_replay(path, how.speed, pattern)
    if how.follow:
        return GrowingFile(path, width=how.width, height=how.height, idle_s=how.idle_s)
    recording = Recording(path, width=how.width, height=how.height)
    return Replay(recording.pieces(Cut(known_polarity=True)), speed=how.speed, name=str(path))


def capture_replay(
    folder: Path, speed: float = 1.0, pattern: FixedPattern | None = None, clock: Clock | None = None
) -> Replay:
    """Return a replay of a capture, events and frames.

    Args:
        folder: The capture's folder.
        speed: How many times faster than life.
        pattern: Fixed pattern to take from the frames.
        clock: The clock to go by.

    Raises:
        DataError: The capture is damaged.
    """
    shot = read_capture(folder)
    if pattern is not None:
        images = pattern.correct(shot.frames, shot.peak)
    else:
        images = shot.frames / np.float32(shot.peak)
    frames = [TimedFrame(int(t), image) for t, image in zip(shot.frame_times_us, images, strict=True)]
    return Replay([shot.events], frames, speed=speed, clock=clock, name=str(folder))


def _address(source: str) -> tuple[str, int]:
    try:
        parts = urlsplit(source)
        host, port = parts.hostname or "127.0.0.1", parts.port
        stray = parts.path
    except ValueError:
        host, port, stray = "", None, source
    if port is None or stray:
        raise ConfigError(f"{source} is no address; give one such as udp://127.0.0.1:7000")
    return host, port
