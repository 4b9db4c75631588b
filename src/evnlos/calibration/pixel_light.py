"""Recordings under known light: what a fit of the event pixel starts from.

The light is known in one of five ways (`KnownLight`): constant,
a sine, a square wave, an edge that moves over the sensor, or frames of the same pixels. Light is in DN, 255 =
white. Chosen pixels stand side by side in one row: light [T, 1, N], events on a sensor of N x 1 pixels, so that
whole pixels can be left out or held out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from evnlos.calibration.event_statistics import Recording
from evnlos.cameras.event_model import require
from evnlos.errors import ConfigError, DataError
from evnlos.events import find_hot_pixels
from evnlos.types import Events

LightKind = Literal["unknown", "static", "sine", "square", "edge", "frames"]
"""How the light of a recording is known."""

_WORDS = {
    "unknown": (),
    "static": ("level",),
    "sine": ("frequency_hz", "contrast", "level"),
    "square": ("frequency_hz", "contrast", "level"),
    "edge": ("ratio", "speed_px_s", "direction_deg"),
    "frames": ("frames",),
}
_NEEDED = {"static": 0, "sine": 2, "square": 2, "edge": 2, "frames": 0, "unknown": 0}
_STEPS = 24  # instants of a period: its extremes are among them
_RAMP = 1 / 512  # of a period, for the flanks of a square wave
_BLOCK_PX = 8  # blocks of pixels that are fitted or held out together
_MOST_LIGHT = 1 << 26  # numbers of light of a recording


@dataclass(frozen=True)
class KnownLight:
    """The light of a recording.

    Args:
        kind: static: constant. sine, square: level (1 +- contrast). edge: the light goes from level /
            sqrt(ratio) to level sqrt(ratio) where the edge passes, once. frames: the video, or the frames of
            the capture. unknown: it is not known, and no threshold is either.
        level: Light, on the scale of `white`; of a modulation its mean.
        frequency_hz: Frequency of the modulation, hertz.
        contrast: Its amplitude, a fraction of the level, above 0 and below 1.
        ratio: Light behind the edge over light before it; below 1 for an edge that darkens.
        speed_px_s: Speed of the edge, pixels per second.
        direction_deg: Where the edge moves: 0 = to the right, 90 = down.
        blur_px: Distance over which the edge passes, pixels.
        frames: Video, folder of images or array with frames on the events' pixels and clock.
        first_frame_s: Time of the first frame, seconds after the first event.
        fps: Frames per second, where the frames carry no times.

    Raises:
        ConfigError: A value outside its range.

    Example:
        >>> KnownLight.of(("sine", "10", "0.5")).contrast
        0.5
    """

    kind: LightKind = "unknown"
    """How the light is known: static, sine, square, edge, frames or unknown."""
    level: float = 60.0
    """Light, on the scale of `white`; of a modulation its mean."""
    frequency_hz: float = 10.0
    """Frequency of the modulation, hertz."""
    contrast: float = 0.5
    """Amplitude of the modulation, a fraction of the level."""
    ratio: float = 2.0
    """Light behind the edge over light before it."""
    speed_px_s: float = 100.0
    """Speed of the edge, pixels per second."""
    direction_deg: float = 0.0
    """Where the edge moves: 0 = to the right, 90 = down."""
    blur_px: float = 1.0
    """Distance over which the edge passes, pixels."""
    frames: str = ""
    """Video, folder of images or array with frames on the events' pixels and clock."""
    first_frame_s: float = 0.0
    """Time of the first frame, seconds after the first event."""
    fps: float | None = None
    """Frames per second, where the frames carry no times."""

    def __post_init__(self) -> None:
        if self.kind not in get_args(LightKind):
            raise ConfigError(f"light is {self.kind!r}; give one of {', '.join(get_args(LightKind))}")
        require(self, "level", 0.0 if self.kind == "static" else 1e-6, 1e9, "on the scale of white")
        require(self, "frequency_hz", 1e-3, 1e5, "hertz")
        require(self, "contrast", 1e-3, 0.999, "a fraction of the level")
        require(self, "ratio", 1e-4, 1e4, "light behind the edge over light before it")
        require(self, "speed_px_s", 1e-3, 1e7, "pixels per second")
        require(self, "direction_deg", -360.0, 360.0, "degrees")
        require(self, "blur_px", 0.01, 1e4, "pixels")
        if self.kind == "edge" and abs(math.log(self.ratio)) < 1e-3:
            raise ConfigError(f"the edge's ratio is {self.ratio:g}; give one above or below 1")

    @classmethod
    def of(cls, words: Sequence[str]) -> KnownLight:
        """Return the light that words of a command line describe.

        Args:
            words: The kind, then its numbers: static LEVEL, sine HZ CONTRAST [LEVEL], square HZ CONTRAST
                [LEVEL], edge RATIO PX_PER_S [DIRECTION_DEG], frames FILE, unknown.

        Raises:
            ConfigError: An unknown kind, or words that are no numbers, too few or too many.
        """
        kind, values = (words[0] if words else ""), list(words[1:])
        if kind not in _WORDS:
            raise ConfigError(f"--light is {kind!r}; give one of {', '.join(_WORDS)}")
        names = _WORDS[kind]
        if not _NEEDED[kind] <= len(values) <= len(names):
            raise ConfigError(
                f"--light {' '.join(words)}: {len(values)} values; give {' '.join(n.upper() for n in names)}"
            )
        if kind == "frames":
            return cls("frames", frames=values[0] if values else "")
        try:
            numbers = [float(value) for value in values]
        except ValueError:
            raise ConfigError(f"--light {' '.join(words)}: not all are numbers after {kind}") from None
        return replace(cls(kind=kind), **dict(zip(names, numbers, strict=False)))  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class LitEvents:
    """A recording that was read: its events and its light.

    Args:
        name: Name of the file.
        events: Its events; times from 0.
        light: Its light, level in DN.
        seconds: Its length.
        frames: With frames: light in DN, float32 [T, H, W].
        frame_times_s: Their instants, [T], seconds on the events' clock.
        inside: Pixels under that light, bool [H, W].
    """

    name: str
    events: Events
    light: KnownLight
    seconds: float
    inside: NDArray[np.bool_]
    frames: NDArray[np.float32] | None = None
    frame_times_s: NDArray[np.floating[Any]] | None = None


@dataclass(frozen=True)
class LitRecording(Recording):
    """The light and the events of chosen pixels, side by side.

    Args:
        known: Its light.
        crossing_s: With an edge: when it would be at each pixel if it passed pixel (0, 0) at 0, seconds [N].
    """

    known: KnownLight = field(default_factory=KnownLight)
    crossing_s: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class Panel:
    """Pixels that are fitted, and pixels that are held out; flat indices.

    Args:
        fitted: int [N].
        held: int [M], of other blocks of the sensor.
        hot: Pixels that fire without cause, bool [H, W]; neither fitted nor held out.
        shape: Size of the sensor, (H, W).
    """

    fitted: NDArray[np.int64]
    held: NDArray[np.int64]
    hot: NDArray[np.bool_]
    shape: tuple[int, int]


def choose_panel(sources: Sequence[LitEvents], most: int, seed: int) -> Panel:
    """Choose pixels to fit and to hold out, by blocks of 8 x 8; hot pixels are neither.

    Args:
        sources: Recordings of one sensor.
        most: Pixels to fit, at most; half as many are held out.
        seed: Seed of the choice.

    Raises:
        DataError: Recordings of different sensors, or too few pixels under known light.
    """
    shape = sources[0].events.shape
    hot, usable = np.zeros(shape, np.bool_), np.ones(shape, np.bool_)
    for one in sources:
        if one.events.shape != shape:
            raise DataError(
                f"{one.name} is of a sensor of {one.events.width} x {one.events.height} pixels, "
                f"{sources[0].name} of {shape[1]} x {shape[0]}; fit one sensor at a time"
            )
        hot |= find_hot_pixels(one.events)
        usable &= one.inside
    usable &= ~hot
    y, x = np.mgrid[: shape[0], : shape[1]] // _BLOCK_PX
    is_held = ((x + y) % 3 == 0).ravel()
    draw = np.random.default_rng(seed)
    parts = []
    for which, count in ((~is_held, most), (is_held, max(most // 2, 1))):
        pixels = np.flatnonzero(usable.ravel() & which)
        if len(pixels) < 24:
            raise DataError(
                f"{len(pixels)} pixels are under known light and not hot, in one part of two; 24 or more are "
                "needed: widen the box, or brighten frames that are nearly black or white"
            )
        parts.append(np.sort(draw.permutation(pixels)[:count]))
    return Panel(parts[0], parts[1], hot, shape)


def lit_recording(one: LitEvents, pixels: NDArray[np.int64], most_s: float) -> LitRecording:
    """Return the light and the events of some pixels of a recording.

    Args:
        one: The recording.
        pixels: Flat indices, ascending.
        most_s: What of it is taken, seconds at most, from its start.
    """
    known, height, width = one.light, *one.events.shape
    y, x = pixels // width, pixels % width
    seconds = min(one.seconds, most_s)
    crossing = None
    if one.frames is not None and one.frame_times_s is not None:
        count = max(3, min(len(one.frame_times_s), int(np.searchsorted(one.frame_times_s, seconds, "right"))))
        times = np.asarray(one.frame_times_s[:count], np.float64)
        light = one.frames[:count, y, x]
        seconds = float(times[-1])
    elif known.kind == "edge":
        angle = math.radians(known.direction_deg)
        crossing = (x * math.cos(angle) + y * math.sin(angle)) / known.speed_px_s
        times, light = _edge_light(known, crossing, seconds, _first_crossing(one, crossing, pixels))
    else:
        times, level = waveform(known, seconds)
        times = times[: max(3, _MOST_LIGHT // len(pixels))]
        light = np.repeat(level[: len(times), None], len(pixels), axis=1)
        seconds = float(times[-1])
    place = np.full(height * width, -1, np.int64)
    place[pixels] = np.arange(len(pixels))
    events = one.events
    column = place[events.y.astype(np.int64) * width + events.x]
    kept = (column >= 0) & (events.t_us <= round(seconds * 1e6))
    row = np.zeros(int(kept.sum()), np.uint16)
    few = Events(events.t_us[kept], column[kept].astype(np.uint16), row, events.p[kept], len(pixels), 1)
    lit = np.ascontiguousarray(light[:, None, :], np.float32)
    return LitRecording(lit, times, few, known=known, crossing_s=crossing)


def waveform(known: KnownLight, seconds: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return instants [T], seconds, and the light there [T], DN: linear in between.

    Args:
        known: Constant light, a sine or a square wave.
        seconds: Its length.
    """
    if known.kind == "static" or known.kind == "unknown":
        return np.array([0.0, 0.5 * seconds, seconds]), np.full(3, known.level)
    period = 1.0 / known.frequency_hz
    cycles = max(1, math.floor(seconds / period))
    if known.kind == "sine":
        phase = np.arange(cycles * _STEPS + 1) / _STEPS
        return phase * period, known.level * (1.0 + known.contrast * np.sin(2 * np.pi * phase))
    corners = np.array([_RAMP, 0.5, 0.5 + _RAMP, 1.0])
    phase = np.concatenate([[0.0], (np.arange(cycles)[:, None] + corners).ravel()])
    sign = np.concatenate([[-1.0], np.tile([1.0, 1.0, -1.0, -1.0], cycles)])
    return phase * period, known.level * (1.0 + known.contrast * sign)


def _first_crossing(one: LitEvents, crossing: NDArray, pixels: NDArray) -> float:
    """Return when the edge passes pixel (0, 0), seconds: where most events of its sign agree."""
    events, known = one.events, one.light
    angle = math.radians(known.direction_deg)
    along = (events.x * math.cos(angle) + events.y * math.sin(angle)) / known.speed_px_s
    start = (events.t_us * 1e-6 - along)[events.p == (known.ratio > 1)]
    if not len(start):
        raise DataError(f"{one.name}: no event of the edge's sign; check the ratio {known.ratio:g}")
    width = max(known.blur_px / known.speed_px_s, 2e-3)
    bins, edges = np.histogram(start, max(10, math.ceil(np.ptp(start) / width)))
    return float(edges[int(bins.argmax())] + 0.5 * (edges[1] - edges[0]))


def _edge_light(
    known: KnownLight, crossing: NDArray, seconds: float, start: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return instants and the light of each pixel while an edge passes, a line in log light over its blur."""
    blur = known.blur_px / known.speed_px_s
    first, last = start + crossing.min() - blur, start + crossing.max() + blur
    count = int(min(8 * (last - first) / blur + 2, max(64, _MOST_LIGHT // len(crossing))))
    moving = np.linspace(max(first, 0.0), min(last, seconds), count)
    times = np.unique(np.concatenate([[0.0], moving, [seconds]]))
    passed = np.clip((times[:, None] - start - crossing) / blur + 0.5, 0.0, 1.0)
    return times, known.level * np.exp((passed - 0.5) * math.log(known.ratio))
