"""Commands that make events: `events` from a video, `clean` from a recording.

- `evnlos events`: a video in, the events of an event camera that watches it out.
- `evnlos clean`: a recording in, the same without what the scene did not cause out.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray

from evnlos.cameras.event_model import Phase, PixelMaps, PixelSettings
from evnlos.cameras.pixel import Logarithm, Mode
from evnlos.cameras.pixels.arrays import load_pixel_maps
from evnlos.cameras.sensors import load_pixel
from evnlos.cameras.video import Tone, Video, check_paths, check_video, open_video, video_events
from evnlos.cli.parsing import UnfitWordsError, check_files, refuse_existing, say
from evnlos.cli.recordings import (
    EventFile,
    Flat,
    Force,
    ReadOptions,
    SelectionOptions,
    amount,
    events_counted,
    look_of,
    result,
    say_of,
    write_preview,
)
from evnlos.config import to_dict
from evnlos.errors import ConfigError, DataError
from evnlos.events import Cleaner, CleanOptions, EventWriter
from evnlos.events.files.columns import OnError
from evnlos.events.recording import CropOptions, Recording
from evnlos.machine import Progress, ProgressBars, Step, counted
from evnlos.types import Events, OutFile
from evnlos.untrusted import no_file


@dataclass(frozen=True)
class PixelChanges:
    """Parameters in place of the preset's, which stands where none is given."""

    threshold_on: float | None = None
    """Mean contrast threshold of ON events, log units (e-fold)."""
    threshold_off: float | None = None
    """Mean contrast threshold of OFF events, log units (e-fold)."""
    threshold_sigma: float | None = None
    """Standard deviation of both thresholds over the pixels, log units; 0 = none."""
    cutoff_hz: float | None = None
    """Corner frequency of the low-pass filter at white, hertz; 0 = no filter."""
    leak_rate_hz: float | None = None
    """Rate of ON events from the leaking reference, hertz per pixel."""
    shot_noise_rate_hz: float | None = None
    """Rate of noise events in the dark limit, ON and OFF together, hertz per pixel."""
    refractory_s: float | None = None
    """Dead time of a pixel after each of its events, seconds."""
    hot_pixel_fraction: float | None = None
    """Fraction of pixels that fire without cause, 0 to 1 (mode exact only)."""
    hot_pixel_rate_hz: float | None = None
    """Rate of events of a hot pixel, hertz (mode exact only)."""
    jitter_s: float | None = None
    """Standard deviation of the time stamps, seconds (mode exact only)."""
    initial_phase: Phase | None = None
    """State before the first frame: random = between two events, rest = just after one (mode exact only)."""
    pattern_seed: int | None = None
    """Seed of thresholds, leak rates and hot pixels: one sensor for all recordings."""
    logarithm: Logarithm | None = None
    """lin-log: a line below 20 DN, as in v2e; true: of the light over --pixel.dark-dn (mode exact only)."""
    exposure: float | None = None
    """DN at the pixel per DN of the video (mode exact only)."""
    dark_dn: float | None = None
    """Dark level of a true logarithm, DN at the pixel."""
    cutoff_floor_dn: float | None = None
    """What the filter's bandwidth keeps in the dark, DN (mode exact only)."""

    def applied(self, pixel: PixelSettings) -> PixelSettings:
        """Return the pixel with these changes.

        Raises:
            ConfigError: A change that this kind of pixel has not.
        """
        changes = {name: value for name, value in asdict(self).items() if value is not None}
        known = {item.name for item in fields(pixel)}  # type: ignore[arg-type]
        if unknown := sorted(changes.keys() - known):
            flag = "--pixel." + unknown[0].replace("_", "-")
            raise ConfigError(f"{flag} is nothing that a {type(pixel).__name__} has; leave it out")
        return replace(pixel, **changes)  # type: ignore[type-var]


_VIDEO_ENDINGS = (".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".gif", ".npy")


@dataclass(frozen=True)
class EventsCommand:
    """Turn any video into the events that an event camera would send: files, animations, images, arrays."""

    video: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="VIDEO", help_behavior_hint="(required)"),
    ]
    """Video file (mp4, avi, mkv, ...), GIF, APNG, WebP, images or a folder of them, .npy [T, H, W(, 3)]; or a
    folder of videos (files of FFmpeg's, GIF, .npy)."""
    out: Path
    """The event file; its ending says the format: .h5, .npz, .raw (EVT3), .mcap, .aedat4, .csv. Of a folder of
    videos a folder, with an .h5 file for each; those that are there already are kept."""
    pixel: str = "davis346"
    """paper, v2e_clean, v2e_noisy, davis346, prophesee_gen3, prophesee_gen4, celex_v, voltmeter_dvs346,
    voltmeter_dvs240, or a YAML file with the settings of any event model (`kind`). Where `evnlos pixel fit`
    measured the thresholds of each pixel of a sensor of the video's size, it is this sensor that sees it."""
    changes: Annotated[PixelChanges, tyro.conf.arg(name="pixel")] = field(default_factory=PixelChanges)
    """Parameters in place of the preset's, which stand where none is given."""
    mode: Mode = "exact"
    """exact: in continuous time; v2e: stepped from frame to frame, as v2e does."""
    seed: int = 0
    """Seed of mismatch and noise: same seed, same bytes."""
    fps: float | None = None
    """Frames per second; needed for images and arrays, otherwise in place of the times in the file."""
    start: float = 0.0
    """First frame to take, seconds in the video; the events keep the video's times."""
    stop: float | None = None
    """Last frame to take, seconds in the video; by default the last one."""
    slow_motion: float = 1.0
    """How many times slower than life the video plays, e.g. 8 for 240 Hz shown at 30 Hz."""
    tone: Tone = "as-is"
    """as-is: numbers are light, as in v2e; srgb, rec709: undo that curve first (2.2 times the contrast)."""
    white: float | None = None
    """Value of white in the video; by default 255, or 65535 for 16 bits."""
    scale: str | None = None
    """Size of the sensor, WIDTHxHEIGHT, or a factor such as 0.5; by default that of the video."""
    format: str | None = None
    """Format to write where the ending does not say, e.g. EVT2 for .raw."""
    preview: Path | None = None
    """Also show the events: an animation (.gif) or a sheet of images (.png)."""
    force: bool = False
    """Replace the file where it exists, and begin although the machine's memory will hardly do."""
    json: bool = False
    """Print one JSON object."""

    def check_names(self) -> None:
        """Refuse, before any is opened, paths that are not there, no one video, or frames without times."""
        check_files(*self.video)
        try:
            if self.video:
                check_paths(_videos_in(self.video)[:1] or self.video, self.fps)
        except DataError as error:
            raise UnfitWordsError(str(error)) from None

    def run(self) -> None:
        """Simulate, with a progress bar over the frames, and print what came out."""
        self.check_names()
        if videos := _videos_in(self.video):
            if self.preview is not None:
                raise ConfigError("--preview shows one video; leave it out for a folder of videos")
            for path in videos:
                out = self.out / f"{path.name}.h5"
                if out.exists() and not self.force:
                    say(f"{out}: there already")
                    continue
                replace(self, video=(path,), out=out).run()
            return
        refuse_existing(self.force, self.out, *([self.preview] if self.preview else []))
        look = look_of(self.preview) if self.preview else None
        pixel = self.changes.applied(load_pixel(self.pixel))
        video = open_video(
            self.video,
            fps=self.fps,
            slow_motion=self.slow_motion,
            tone=self.tone,
            white=self.white,
            scale=self.scale,
        )
        if not self.force:
            check_video(video, pixel)
        maps = self._measured((video.height, video.width))
        on = instants = 0
        last_us = -1
        clock = _Clock(self.start, self.stop)
        writer = EventWriter(self.out, format=self.format)
        with writer, ProgressBars() as progress:
            writer.write(Events.empty(video.width, video.height))
            watched = clock.watched(video, self.out.name, progress)
            for piece in video_events(watched, pixel, self.mode, self.seed, maps):
                writer.write(piece)
                on += int(piece.p.sum())
                if len(piece):
                    instants += int((np.diff(piece.t_us, prepend=last_us) != 0).sum())
                    last_us = int(piece.t_us[-1])
        found = _found(self, video, pixel, clock, writer.events, on)
        found |= {"instants": instants, "measured_thresholds": maps is not None}
        if self.preview and look:
            if writer.events:
                write_preview(Recording(self.out), CropOptions(), self.preview, look)
            else:
                say(f"note: no events, so no {self.preview}")
        print(json.dumps(found) if self.json else _text(found))

    def _measured(self, shape: tuple[int, int]) -> PixelMaps | None:
        """Return measured thresholds of a sensor of the video's size, unless flags say others."""
        maps, own = load_pixel_maps(self.pixel), self.changes
        if maps is None or maps.hot.shape == shape:
            stated = (own.threshold_on, own.threshold_off, own.threshold_sigma, own.pattern_seed)
            return maps if all(one is None for one in stated) else None
        height, width = maps.hot.shape
        say(f"note: thresholds are drawn: those of {self.pixel} were measured on {width} x {height} pixels")
        return None


class _Clock:
    """Takes the frames of a time, counts them and keeps first and last time."""

    def __init__(self, start_s: float, stop_s: float | None) -> None:
        if not 0 <= start_s < (math.inf if stop_s is None else stop_s):
            raise ConfigError(f"--start {start_s} --stop {stop_s}: give 0 or more, and a later stop")
        self.start_s, self.stop_s = start_s, math.inf if stop_s is None else stop_s
        self.frames, self.first_s, self.last_s = 0, 0.0, 0.0

    def watched(self, video: Video, name: str, progress: Progress) -> Iterator[tuple[float, NDArray]]:
        time_s = 0.0
        for time_s, light in counted(video, progress, name, video.frames or 0):
            if time_s > self.stop_s:
                break
            if time_s >= self.start_s:
                self.first_s = self.first_s if self.frames else time_s
                self.frames, self.last_s = self.frames + 1, time_s
                yield time_s, light
        progress(Step(name, self.frames, 0, "frames", within="their events"))
        if self.frames < 2 and self.start_s > 0:
            found = f"--start {self.start_s:g} leaves {self.frames} of the frames of a video that ends at"
            raise ConfigError(f"{found} {time_s:.6g} s; give an earlier one")


def _videos_in(paths: tuple[Path, ...]) -> list[Path]:
    """Return the videos of a folder of videos; nothing where it is none."""
    if len(paths) != 1 or not paths[0].is_dir():
        return []
    return sorted(one for one in paths[0].iterdir() if one.suffix.lower() in _VIDEO_ENDINGS)


def _found(
    command: EventsCommand, video: Video, pixel: PixelSettings, clock: _Clock, events: int, on: int
) -> dict[str, Any]:
    pixels = video.width * video.height
    seconds = clock.last_s - clock.first_s
    return {
        "out": str(command.out),
        "width": video.width,
        "height": video.height,
        "frames": clock.frames,
        "duration_s": seconds,
        "times_from": "fps" if video.fps else "file",
        "events": events,
        "on": on,
        "off": events - on,
        "on_off_ratio": on / (events - on) if events > on else None,
        "rate_hz": events / seconds,
        "rate_per_pixel_hz": events / seconds / pixels,
        "pixel": to_dict(pixel),
        "pixel_name": command.pixel,
        "mode": command.mode,
        "seed": command.seed,
        "tone": command.tone,
        "bytes": command.out.stat().st_size,
    }


def _text(found: dict[str, Any]) -> str:
    ratio = f"{found['on_off_ratio']:.2f}" if found["on_off_ratio"] is not None else "no OFF events"
    sensor = ", its measured thresholds" if found["measured_thresholds"] else ""
    rate = f"{amount(found['rate_hz'], 'ev/s')}, {found['rate_per_pixel_hz']:.3g} Hz per pixel"
    times = "from --fps" if found["times_from"] == "fps" else "from the file"
    return (
        f"{found['out']}: {found['events']:,} events ({rate}), ON/OFF {ratio}, {amount(found['bytes'], 'B')}\n"
        f"  {100 * found['instants'] / max(found['events'], 1):.0f} different times per 100 events\n"
        f"  {found['frames']} frames of {found['width']} x {found['height']} in {found['duration_s']:.6g} s, "
        f"times {times}, tone {found['tone']}\n"
        f"  pixel {found['pixel_name']}{sensor}, mode {found['mode']}, seed {found['seed']}; "
        f"to look at it: evnlos preview {found['out']}"
    )


@dataclass(frozen=True)
class CleanCommand:
    """Leave out of a recording what the scene did not cause: hot pixels, lamp flicker, background activity.

    The file is read twice, block by block: to find what is wrong with it, and to write the events that stay.
    """

    file: EventFile
    """Event file of any format that is read; it may be larger than memory."""
    out: OutFile
    """The file to write; its ending says the format: .h5, .npz, .raw (EVT3), .mcap, .aedat4, .csv."""
    hot_factor: float | Literal["none"] = 10.0
    """Pixels with more than that many times the events of the median pixel around them go; none keeps all."""
    flicker: float | Literal["auto", "none"] = "auto"
    """Frequency of flickering light, hertz, whose events go: twice that of the mains; auto finds it between 90
    and 132 Hz and takes nothing away where there is none."""
    background_ms: float | Literal["auto", "none"] = "none"
    """Events go to which too few of the 4 pixels beside sent one of that polarity that near in time,
    milliseconds; auto: so near that of noise as dense as the median pixel's events 1 of 10 stays by chance."""
    background_sides: int = 2
    """How many of the 4 pixels beside must have sent one, 1 to 4; 3 where the light has no edges, 1 for single
    lines of pixels."""
    format: str | None = None
    """Format to write where the ending does not say, e.g. EVT2 for .raw."""
    on_error: OnError = "strict"
    """strict: damage ends it, and nothing is written; salvage: damage is left out and told."""
    reading: Flat[ReadOptions] = field(default_factory=ReadOptions)
    taking: Flat[SelectionOptions] = field(default_factory=SelectionOptions)
    force: Force = False
    json: bool = False
    """Print one JSON object."""

    def check_names(self) -> None:
        """Refuse a recording that is not there, or a folder."""
        check_files(self.file)
        if self.file.is_dir():
            raise UnfitWordsError(no_file(self.file))

    def run(self) -> None:
        """Look and clean, with a progress bar over the events of each."""
        if self.out.exists() and self.file.exists() and self.out.samefile(self.file):
            raise ConfigError(f"{self.out} is the file that is read; give another name")
        cleaner = Cleaner(
            CleanOptions(
                None if self.hot_factor == "none" else self.hot_factor,
                None if self.flicker == "none" else self.flicker,
                _microseconds(self.background_ms),
                self.background_sides,
            )
        )
        recording, cut = self.reading.open(self.file, self.on_error), self.taking.cut()
        with EventWriter(self.out, format=self.format) as writer:
            cleaner.look(events_counted(recording.pieces(cut), f"look at {self.file.name}"))
            total = recording.report.events
            for piece in cleaner.clean(events_counted(recording.pieces(cut), self.out.name, total)):
                writer.write(piece)
            if not writer.events:
                writer.write(recording.blank(cut))
        say_of(recording.report, self.out)
        found, size = cleaner.report, self.out.stat().st_size
        about = {"out": str(self.out), "bytes": size, **asdict(found)}
        text = f"{self.out}: {found.kept:,} of {found.events:,} events, {amount(size, 'B')}; left out: {found}"
        result(self.json, about, text)


def _microseconds(window_ms: float | Literal["auto", "none"]) -> int | Literal["auto"] | None:
    if isinstance(window_ms, str):
        return "auto" if window_ms == "auto" else None
    if not 1e-3 <= window_ms <= 1e6:
        raise ConfigError(f"--background-ms is {window_ms:g}; give 0.001 ms to 1000 s")
    return round(1e3 * window_ms)
