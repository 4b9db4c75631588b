"""What a fit of the pixel reads, and the maps that it writes of each pixel.

- Files of recordings under known light: manifests, event files, captures, frames; doubts about the light.
- Thresholds of each pixel, by a regression that simulated pixels of known thresholds teach.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evnlos.calibration.event_statistics import count_map, simulated
from evnlos.calibration.pixel_fit import CandidateFit, Panels, PixelFitSettings
from evnlos.calibration.pixel_light import KnownLight, LitEvents, LitRecording, lit_recording
from evnlos.calibration.pixel_statistics import Array
from evnlos.cameras import PixelMaps, PixelSettings
from evnlos.cameras.event_model import MIN_THRESHOLD, require
from evnlos.cameras.pixels.arrays import pixel_thresholds
from evnlos.cameras.streams import WHITE_DN
from evnlos.cameras.video import open_video
from evnlos.config import load_yaml
from evnlos.data.capture import read_capture
from evnlos.data.capture_info import inside
from evnlos.errors import ConfigError, DataError
from evnlos.events import read_events, read_timed_frames
from evnlos.events.recording import Box
from evnlos.types import Events, derive_seed

_DARKEST, _BRIGHTEST = 0.02, 0.97  # of white, between which a frame counts as linear
_LAMPS_HZ = (100.0, 120.0)
_LINE = 3.0  # times the strength of the frequencies beside it that makes a line


@dataclass(frozen=True)
class LitFile:
    """A recording and its light, as a manifest names them."""

    file: str
    """Event file, or capture folder with events and registered frames; relative to the manifest."""
    light: KnownLight = field(default_factory=KnownLight)
    """Its light; of a capture folder, frames."""
    start_s: float = 0.0
    """Begin of what counts, seconds after the first event."""
    stop_s: float | None = None
    """End of what counts; None = the last event."""
    box: tuple[int, int, int, int] | None = None
    """Part of the sensor under that light: X Y WIDTH HEIGHT, pixels."""


@dataclass(frozen=True)
class Manifest:
    """Recordings of one sensor, each with its light: `pixel_fit.yaml`."""

    recordings: tuple[LitFile, ...]
    """The recordings; they share one sensor and its settings."""
    white: float = WHITE_DN
    """The level that counts as 255 DN: levels may be lux or any linear unit."""

    def __post_init__(self) -> None:
        if not self.recordings:
            raise ConfigError("the manifest lists no recordings; give at least one")
        require(self, "white", 1e-9, 1e12, "in the unit of the levels")


def read_manifest(path: Path, light: KnownLight | None = None, white: float = WHITE_DN) -> Manifest:
    """Return the recordings that a path names: a manifest, an event file, or a capture folder.

    Args:
        path: A YAML file with `recordings`, an event file, or the folder of a capture.
        light: Light of an event file or capture; None = unknown, of a capture its frames.
        white: The level that counts as 255 DN.

    Raises:
        ConfigError: The manifest does not fit, or light is stated beside it.
    """
    if path.suffix in (".yaml", ".yml"):
        if light is not None:
            raise ConfigError(f"{path} states the light of its recordings; leave --light out")
        found = load_yaml(Manifest, path)
        for one in found.recordings:
            inside(path.parent, one.file, path.name)
        return replace(
            found, recordings=tuple(replace(one, file=str(path.parent / one.file)) for one in found.recordings)
        )
    if light is None:
        light = KnownLight("frames" if path.is_dir() else "unknown")
    return Manifest((LitFile(str(path), light),), white)


def read_lit_events(one: LitFile, white: float = WHITE_DN) -> LitEvents:
    """Read a recording and its light.

    Args:
        one: What the manifest says of it.
        white: The level that counts as 255 DN.

    Raises:
        DataError: No events, frames of another size, or a box outside the sensor.
        EventFileError: The event file can't be read.
    """
    path, known = Path(one.file), one.light
    frames = times = None
    if path.is_dir():
        capture = read_capture(path)
        events = capture.events
        if known.kind == "frames":
            frames = capture.frames.astype(np.float32) * np.float32(WHITE_DN / capture.peak)
            times = capture.frame_times_us * 1e-6
    else:
        events = read_events(path)
        if known.kind == "frames":
            frames, times = _frames_of(path, known, events)
    if not len(events):
        raise DataError(f"{path} holds no events; record longer, or a scene that moves")
    first = float(events.t_us[0]) * 1e-6
    if frames is not None and times is not None:
        if frames.shape[1:] != events.shape:
            high, wide = frames.shape[1:]
            raise DataError(
                f"{path}: frames are {wide} x {high} pixels, the events' sensor {events.width} x "
                f"{events.height}; register the frames, or give a capture folder with a registration"
            )
        low, high_s = first + one.start_s, first + (math.inf if one.stop_s is None else one.stop_s)
        kept = (times >= low) & (times <= high_s)
        if kept.sum() < 3:
            raise DataError(f"{path}: {int(kept.sum())} frames in the time of the events; 3 or more are needed")
        frames, times = frames[kept], times[kept]
        first, last = float(times[0]), float(times[-1])
        times = times - first
    else:
        last = float(events.t_us[-1]) * 1e-6 if one.stop_s is None else first + one.stop_s
        first += one.start_s
    low_us, high_us = round(first * 1e6), round(last * 1e6)
    events = events[(events.t_us >= low_us) & (events.t_us <= high_us)]
    if not len(events) or high_us - low_us < 1000:
        raise DataError(f"{path}: {len(events)} events in {(high_us - low_us) * 1e-6:g} s of it; choose more")
    events = Events(events.t_us - low_us, events.x, events.y, events.p, events.width, events.height)
    chosen = np.ones(events.shape, np.bool_)
    if one.box is not None:
        box = Box(*one.box)
        if box.x + box.width > events.width or box.y + box.height > events.height:
            raise ConfigError(f"{path}: the box {one.box} leaves the {events.width} x {events.height} sensor")
        chosen[:] = False
        chosen[box.y : box.y + box.height, box.x : box.x + box.width] = True
    if frames is not None:
        chosen &= (frames.min(axis=0) >= _DARKEST * WHITE_DN) & (frames.max(axis=0) <= _BRIGHTEST * WHITE_DN)
    known = replace(known, level=known.level * WHITE_DN / white)
    return LitEvents(path.name, events, known, (high_us - low_us) * 1e-6, chosen, frames, times)


def _frames_of(path: Path, known: KnownLight, events: Events) -> tuple[NDArray, NDArray[np.floating[Any]]]:
    """Return frames in DN and their times on the events' clock, seconds."""
    if not known.frames:
        found = read_timed_frames(path)
        if found.t_us is None:
            raise DataError(f"{path}: its frames carry no times; give them as --light frames FILE")
        peak = float(np.iinfo(found.images.dtype).max)
        return found.images.astype(np.float32) * np.float32(WHITE_DN / peak), found.t_us * 1e-6
    video = open_video(known.frames, fps=known.fps)
    pairs = list(video)
    start = float(events.t_us[0]) * 1e-6 + known.first_frame_s if len(events) else 0.0
    times = start + np.array([time for time, _ in pairs])
    return np.stack([light for _, light in pairs]).astype(np.float32), times


def doubts_of(one: LitEvents) -> list[str]:
    """Return what speaks against the stated light of a recording, a line each.

    Constant light whose event rate varies much more than Poisson counts in twentieths of the recording, and a
    line at 100 or 120 Hz, which lamps on the mains make.

    Args:
        one: Events with the light that is stated.
    """
    found, time_s = [], one.events.t_us * 1e-6
    count = len(time_s)
    if one.light.kind == "static":
        bins = np.histogram(time_s, 20, (0.0, one.seconds))[0]
        excess = math.sqrt(max(float(bins.var() - bins.mean()), 0.0)) / max(float(bins.mean()), 1e-9)
        if excess > 0.3 and bins.mean() >= 10:
            found.append(
                f"{one.name}: the event rate varies by {100 * excess:.0f} % over the recording; its light was "
                "not constant, or the scene moved"
            )
    if one.light.kind in ("static", "unknown") and count > 100 and one.seconds > 0.1:
        for hertz in _LAMPS_HZ:
            strength = [
                float(abs(np.exp(2j * np.pi * (hertz + shift / one.seconds) * time_s).mean()))
                for shift in (0, -8, -6, -4, 4, 6, 8)
            ]
            if strength[0] > max(0.1, 5 / math.sqrt(count), _LINE * max(strength[1:])):
                found.append(
                    f"{one.name}: events come at {hertz:.0f} Hz (strength {strength[0]:.2f}); lamps flicker"
                )
    return found


_TOLD = 0.3  # share of a map's variance that events must explain
_TAUGHT = 0.15  # least mismatch of the pixels that teach, of the threshold: their regression then pulls nothing


def maps_of(
    fit: CandidateFit,
    sources: Sequence[LitEvents],
    panels: Panels,
    hot: NDArray[np.bool_],
    settings: PixelFitSettings,
) -> PixelMaps | None:
    """Return each pixel's thresholds, by a regression that simulated pixels of known thresholds teach.

    The pixels that teach differ widely, so that the regression measures a threshold, and its residual is the
    error e. How much the sensor's own differ, v, is the variance of what was measured less e^2: all its pixels
    tell that better than the fit does. The map is the mean of the posterior, m + v / (v + e^2) (measured - m),
    of variance v e^2 / (v + e^2): nobody has to shrink it. What is regressed on is the log of the way that the
    log light goes up and down, over the events of either sign, of each recording whose light moves.

    Args:
        fit: The model.
        sources: The recordings, all pixels.
        panels: Recordings of the fitted pixels.
        hot: Pixels that fire without cause.
        settings: Seeds.
    """
    moving = [k for k, one in enumerate(panels.recordings) if one.known.kind not in ("static", "unknown")]
    if not moving:
        return None
    pixel, pixels = fit.pixel, panels.recordings[0].light.shape[2]
    few = [panels.recordings[k] for k in moving]
    known, looked = [], []
    law = pixel.known_law(WHITE_DN)
    wide = max(law.threshold_sigma, _TAUGHT * 0.5 * (law.threshold_on + law.threshold_off))
    settled: dict[str, Any] = {"threshold_sigma": wide, "initial_phase": "random"}
    for n in range(4):
        seed = derive_seed(settings.seed, "maps", n)
        sensor: PixelSettings = replace(pixel, pattern_seed=seed, **settled)  # type: ignore[type-var]
        events = simulated(few, sensor, seed)
        known.append(np.log(np.stack(pixel_thresholds(sensor, (1, pixels), seed, None))))  # type: ignore[arg-type]
        looked.append(_ratios([(one, found) for one, found in zip(few, events, strict=True)]))
    truth, given = np.concatenate(known, axis=1).T, np.concatenate(looked, axis=0)
    design = np.concatenate([np.ones((len(given), 1)), given], axis=1)
    pull = np.diag([0.0, *np.full(given.shape[1], 1e-5 * len(given))])
    weights = np.linalg.solve(design.T @ design + pull, design.T @ truth)
    left = (truth - design @ weights).std(axis=0).tolist()
    shape = sources[0].events.shape
    inside = np.logical_and.reduce([sources[k].inside for k in moving]) & ~hot
    place = np.flatnonzero(inside)
    seen = []
    for block in np.array_split(place, max(1, len(place) // 4096)):
        lit = [lit_recording(sources[k], block, settings.most_s) for k in moving]
        seen.append(_ratios([(one, one.events) for one in lit]))
    made = np.concatenate(seen, axis=0)
    measured = np.concatenate([np.ones((len(made), 1)), made], axis=1) @ weights
    maps, told = list[NDArray[np.float64]](), list[float]()
    means = math.log(law.threshold_on), math.log(law.threshold_off)
    for column, error, mean in zip(measured.T, left, means, strict=True):
        between = max(float(column.var()) - error**2, 0.0)
        share = between / (between + error**2)
        told.append(share if share >= _TOLD else 0.0)
        value, deviation = np.full(shape, math.exp(mean)), np.full(shape, law.threshold_sigma)
        if told[-1]:
            middle = float(column.mean())
            value[:], deviation[:] = math.exp(middle), math.exp(middle) * math.sqrt(between)
            own = np.maximum(np.exp(middle + share * (column - middle)), MIN_THRESHOLD)
            value.ravel()[place], deviation.ravel()[place] = own, own * error * math.sqrt(share)
        maps += [value, deviation]
    return PixelMaps(maps[0], maps[2], maps[1], maps[3], hot, (told[0], told[1]))


def _ratios(pairs: Sequence[tuple[LitRecording, Events]]) -> Array:
    """Return log(way of the log light / events) of each pixel, ON and OFF, [N, 2 R]."""
    columns = []
    for recording, events in pairs:
        steps = np.diff(np.log(recording.light[:, 0].astype(np.float64) + 1.0), axis=0)
        for sign, polarity in ((1.0, True), (-1.0, False)):
            way = np.maximum(sign * steps, 0.0).sum(axis=0)
            count = count_map(events, polarity, recording.settled_us).ravel()
            columns.append(np.log((way + 0.1) / (count + 0.5)))
    return np.stack(columns, axis=1)
