"""Sources of a live run: recordings replayed, growing files, standard input, packets.

- A recording as if it happened now: its events and frames come when they are due.
- From the words of a command line to a source: a capture, a recording, a file that grows, or a port.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import ConfigError, DataError, UnknownNameError
from evnlos.events.files.columns import cut, join, trusted_events
from evnlos.events.recording import CropOptions, Recording
from evnlos.live.device import DEVICES, DeviceSource, NeuromorphicDriver, device_of
from evnlos.live.growing_file import GrowingFile
from evnlos.live.packet import Chunk, Clock, EventSource, SystemClock
from evnlos.live.run import Beside, FilmImages, ImagesSoFar, check_sequence
from evnlos.live.streams import DvSource, WordInput
from evnlos.live.udp import AestreamSource, UdpSource
from evnlos.types import Events, Evidence, Plane

if TYPE_CHECKING:
    from evnlos.data import Capture
    from evnlos.data.fixed_pattern import FixedPattern
    from evnlos.setups import Setup

_NAP_S = 0.05  # longest sleep before `stop` is asked again


@dataclass(frozen=True, eq=False)
class TimedFrame:
    """A frame of the frame camera.

    Args:
        t_us: When it was taken, microseconds on the events' clock.
        image: What it shows, float32 [H, W], 0..1.
    """

    t_us: int
    image: NDArray[np.float32]


class Replay:
    """A source that replays a recording at true speed, or at a multiple of it.

    A chunk is what falls into a step of time, cut where a frame was taken. Its instants are those at which the
    events are due, so that the wait for the end of a step counts as latency.

    Args:
        pieces: Events in the order of time, such as `iter_events` yields; or what returns them, for a replay
            that begins again.
        frames: Frames in the order of time; none for events alone.
        speed: How many times faster than life, 0.001 to 1000.
        step_s: Length of a chunk, seconds of the clock.
        clock: The clock that it goes by.
        name: What it is, for a message.
        repeat: Whether it begins again when it has ended.

    Attributes:
        again: Set it, and the replay begins again.
        capture: The capture that is replayed; None of any other recording.

    Raises:
        ConfigError: Speed or step are outside their range.
    """

    def __init__(
        self,
        pieces: Iterable[Events] | Callable[[], Iterable[Events]],
        frames: Sequence[TimedFrame] = (),
        *,
        speed: float = 1.0,
        step_s: float = 0.002,
        clock: Clock | None = None,
        name: str = "replay",
        repeat: bool = False,
    ) -> None:
        if not 1e-3 <= speed <= 1e3:
            raise ConfigError(f"speed is {speed}; give 0.001 to 1000 times true speed")
        if not 0 < step_s <= 10:
            raise ConfigError(f"step_s is {step_s}; give a step of up to 10 seconds")
        self.name, self.has_frames, self.waits = name, bool(frames), True
        self._pieces, self._frames, self._clock = pieces, list(frames), clock or SystemClock()
        self._speed, self._step_us = speed, max(round(step_s * 1e6 * speed), 1)
        self._repeat, self.again = repeat, threading.Event()
        self.capture: Capture | None = None

    def faults(self) -> dict[str, int]:
        """Return nothing: a recording is checked when it is opened."""
        return {}

    def close(self) -> None:
        """Do nothing: nothing is held."""

    def chunks(self, stop: Callable[[], bool]) -> Iterator[Chunk]:
        """Yield the chunks when they are due; where it begins again, the first one says so."""
        is_new = False
        while True:
            self.again.clear()
            is_empty = True
            for chunk in self._once(stop):
                yield replace(chunk, restart=is_new)
                is_new = is_empty = False
                if self.again.is_set():
                    break
            is_new = True
            if stop() or is_empty or not (self._repeat or self.again.is_set()):
                return

    def _once(self, stop: Callable[[], bool]) -> Iterator[Chunk]:
        reader, frames = _Reader(self._pieces() if callable(self._pieces) else self._pieces), self._frames
        starts = [t for t in (reader.next_us, frames[0].t_us if frames else None) if t is not None]
        if not starts:
            return
        begin_us, start_s, shown = min(starts), self._clock.now(), 0
        due_s: Callable[[int], float] = lambda t_us: start_s + (t_us - begin_us) / 1e6 / self._speed  # noqa: E731
        step = begin_us
        while reader.next_us is not None or shown < len(frames):
            frame = frames[shown] if shown < len(frames) else None
            until = step + self._step_us
            if frame is not None and frame.t_us <= until:
                until, shown = frame.t_us, shown + 1
            else:
                frame, step = None, until
            events = reader.until(until)
            if not self._wait(due_s(until), stop):
                return
            first, last = (int(events.t_us[0]), int(events.t_us[-1])) if len(events) else (until, until)
            yield Chunk(events, until, due_s(first), due_s(last), None if frame is None else frame.image)

    def _wait(self, until_s: float, stop: Callable[[], bool]) -> bool:
        """Wait for an instant; return whether to go on."""
        while not stop():
            left = until_s - self._clock.now()
            if left <= 0:
                return True
            self._clock.sleep(min(left, _NAP_S))
        return False


class _Reader:
    """Pieces of a stream, taken up to one instant after the other."""

    def __init__(self, pieces: Iterable[Events]) -> None:
        self._pieces = iter(pieces)
        self._held: Events | None = None
        self._at = 0
        self._size = 1, 1
        self._advance()

    def _advance(self) -> None:
        self._held, self._at = next((piece for piece in self._pieces if len(piece)), None), 0
        if self._held is not None:
            self._size = self._held.width, self._held.height

    @property
    def next_us(self) -> int | None:
        """Time of the next event; None at the end."""
        return None if self._held is None else int(self._held.t_us[self._at])

    def until(self, t_us: int) -> Events:
        """Return the events up to and with an instant that no call before returned."""
        parts = []
        while self._held is not None:
            stop = self._at + int(np.searchsorted(self._held.t_us[self._at :], t_us, "right"))
            parts.append(cut(_plain(self._held), self._at, stop))
            self._at = stop
            if stop < len(self._held):
                break
            self._advance()
        # Checked when they were read: a second check of every step would cost more than the surface.
        return trusted_events(join(parts), *self._size)


def _plain(events: Events) -> dict[str, NDArray]:
    """Return the four columns that every stream has."""
    return {"t_us": events.t_us, "x": events.x, "y": events.y, "p": events.p}


@dataclass(frozen=True)
class SourceOptions:
    """How a source is opened."""

    follow: bool = False
    """Read a file while it grows, in place of replaying it."""
    speed: float = 1.0
    """Speed of a replay: 1 = as it happened, 10 = ten times faster."""
    repeat: bool = False
    """Begin a replay again when it ends, until Ctrl-C."""
    idle: float = 10.0
    """End when a growing file or, after the first packet, a network brought nothing for so many seconds, or a
    camera that went away does not come back; 0 = wait for ever."""
    format: str | None = None
    """Words on standard input without a RAW header: evt2, evt21 or evt3, with --width and --height."""
    width: int | None = None
    """Sensor width, pixels, where a file or stream does not say; give both or neither."""
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


def open_live(
    source: str, how: SourceOptions = SourceOptions(), pattern: FixedPattern | None = None
) -> EventSource:
    """Return a source of events by its name.

    Args:
        source: A camera (`evk4`, `davis346:SERIAL`), `udp://HOST:PORT`, `aestream://HOST:PORT` or
            `dv://HOST:PORT`, `-` for words on standard input, the folder of a capture, or an event file.
        how: Whether a file grows, how fast a replay goes, when to give up.
        pattern: Fixed pattern of the frame camera, to be taken from a capture's frames.

    Raises:
        DataError: There is no such capture, or it is damaged.
        EventFileError: There is no such event file, or it is damaged.
        ConfigError: The address can't be listened at, or an option does not fit.
    """
    if source == "-":
        return WordInput(format=how.format, width=how.width, height=how.height)
    if how.format is not None:
        raise ConfigError(f"--format is for words on standard input; {source} says its own, or give -")
    scheme = source.partition("://")[0] if "://" in source else ""
    if scheme == "udp":
        return UdpSource(*_address(source), idle_s=how.idle_s)
    if scheme == "aestream":
        return AestreamSource(*_address(source), how.width, how.height, idle_s=how.idle_s)
    if scheme == "dv":
        return DvSource(*_address(source), idle_s=how.idle_s)
    device = device_of(source)
    if device is not None:
        return DeviceSource(lambda: NeuromorphicDriver(*device), source, idle_s=how.idle_s)
    check_source(source, how.follow)
    path = Path(source)
    if path.is_dir():
        if how.follow:
            raise ConfigError(f"{source} is a folder; --follow takes the event file that grows")
        return capture_replay(path, how.speed, pattern, repeat=how.repeat)
    if how.follow:
        return GrowingFile(path, width=how.width, height=how.height, idle_s=how.idle_s)
    recording = Recording(path, width=how.width, height=how.height)
    pieces = partial(recording.pieces, CropOptions(known_polarity=True))
    return Replay(pieces, speed=how.speed, name=str(path), repeat=how.repeat)


def check_source(source: str, follow: bool = False) -> None:
    """Refuse a source that is no address, no camera, and no path of a file.

    Args:
        source: As for `open_live`.
        follow: Whether the file may come later.

    Raises:
        UnknownNameError: It is none.
    """
    path, is_elsewhere = Path(source), source == "-" or "://" in source or device_of(source) is not None
    if not (is_elsewhere or path.exists() or path.suffix or path.name != source or follow):
        raise UnknownNameError(
            f"{source} is neither a file nor one of the cameras {', '.join(DEVICES)}; check the name"
        )


def capture_replay(
    folder: Path,
    speed: float = 1.0,
    pattern: FixedPattern | None = None,
    clock: Clock | None = None,
    repeat: bool = False,
) -> Replay:
    """Return a replay of a capture, events and frames.

    Args:
        folder: The capture's folder.
        speed: How many times faster than life.
        pattern: Fixed pattern to take from the frames.
        clock: The clock to go by.
        repeat: Whether it begins again when it has ended.

    Raises:
        DataError: The capture is damaged.
    """
    from evnlos.data.capture import read_capture

    capture = read_capture(folder, needs_frames=False)
    if not capture.has_frames:
        images = []
    elif pattern is not None:
        images = pattern.correct(capture.frames, capture.peak)
    else:
        images = capture.frames / np.float32(capture.peak)
    times = capture.frame_times_us[: len(images)]
    frames = [TimedFrame(int(t), image) for t, image in zip(times, images, strict=True)]
    replay = Replay([capture.events], frames, speed=speed, clock=clock, name=str(folder), repeat=repeat)
    replay.capture = capture
    return replay


def so_far_of(weights: str | Path, source: EventSource) -> Beside:
    """Return what makes the image of all that was seen so far of a capture that is replayed.

    Args:
        weights: Weights of whole sequences: a file, a run's folder, or a name.
        source: The replay.

    Raises:
        ConfigError: The source is no capture.
        DataError: The capture states no motion, or lacks what the network sees; or the weights do not fit.
    """
    from evnlos.inverse.event_images import WORTH  # which compiles
    from evnlos.models import load_weights

    capture = source.capture if isinstance(source, Replay) else None
    if capture is None:
        raise ConfigError(
            f"--so-far with {source.name}: an image of all seen so far has to know the motion; give the folder "
            "of a capture that states it"
        )
    loaded = load_weights(weights)
    check_sequence(loaded)
    eyes = loaded.modality
    capture.info.check_cameras(capture.name, frames=eyes.needs_frames, events=eyes.needs_events)
    if capture.motion is None:
        raise DataError(f"{source.name} states no motion; --so-far needs it (`evnlos track` finds it)")
    span_us = int(capture.frame_times_us[0]), int(capture.frame_times_us[-1])
    about = loaded, capture.motion, span_us, capture.events.shape
    worth = WORTH if eyes.needs_events else 1.0
    shape = loaded.sampling.canvas.shape
    return Beside("of all so far", ImagesSoFar, about, shape, eyes.needs_events, worth)


def film_of(
    setup: Setup,
    plane: Plane,
    source: EventSource,
    evidence: Evidence = "frames",
    newest_s: float = 3.0,
) -> Beside:
    """Return what makes the newest image of a hidden plane that changes, beside a run.

    Args:
        setup: The setup, linear.
        plane: The hidden plane, about the middle of the setup's.
        source: What is reconstructed.
        evidence: What the film is made of.
        newest_s: How much of the past an image knows, seconds.

    Raises:
        ConfigError: The seconds are too few, or the event model states no law of its crossings.
        DataError: The source has no frames, and they are to be seen.
    """
    from evnlos.inverse.event_film import QUICK_MODES  # which compiles
    from evnlos.models import FilmSolver, RunningFilm

    if evidence != "events" and not source.has_frames:
        raise DataError(f"{source.name} has no frames; give --from events, or a source with frames")
    if evidence != "frames":
        setup.pixel.known_law(1.0)
    about = FilmSolver(setup, plane, modes=QUICK_MODES), evidence, newest_s
    RunningFilm(*about)  # refuses what cannot be
    size = source.capture.events.shape if isinstance(source, Replay) and source.capture else None
    return Beside("plane that changes", FilmImages, (*about, size), plane.shape, evidence == "events")


def _address(source: str) -> tuple[str, int]:
    try:
        parts = urlsplit(source)
        host, port = parts.hostname or "127.0.0.1", parts.port
        stray = parts.path
    except ValueError:
        host, port, stray = "", None, source
    if port is None or stray:
        scheme = source.partition("://")[0]
        raise ConfigError(f"{source} is no address; give one such as {scheme}://127.0.0.1:7000")
    return host, port
