"""A capture: a recording as a folder of frames, events and what is known about them; datasets of captures."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from evnlos.config import config_hash, to_dict
from evnlos.data.capture_info import CaptureInfo, FilterInfo, inside, read_capture_info
from evnlos.data.clocks import find_offset
from evnlos.data.fixed_pattern import FixedPattern, mapped, prepare_frames, used_pixels
from evnlos.data.frames import from_start, read_frame_series
from evnlos.data.pool import run_tasks
from evnlos.data.sampling import (
    Samples,
    Sampling,
    iter_samples,
    join_samples,
    line_of,
    noted_distance_m,
    read_others,
    read_target,
    split_of,
    time_steps,
)
from evnlos.data.store import Dataset, claim_dataset, write_shard
from evnlos.errors import DataError, UnknownNameError, absent, printable
from evnlos.events import CelexOptions, FrameStack, keep_known_polarity, read_events, read_triggers
from evnlos.machine import Progress, Step, silent
from evnlos.scene import LineMotion, Motion, Scene, SeveralTargets, Target
from evnlos.types import Colour, Events, matching_paths
from evnlos.untrusted import no_file

_HELD_BYTES = 1 << 26  # frames of an import that take more are read as they are asked for
_LATER_KEYS = "mosaic colour white_balance event_mosaic white_dn log tone"  # of camera, in no capture of before
_MOST_US = 2**62  # of a time stamp: differences of two fit into 64 bits


@dataclass(frozen=True, eq=False)
class Capture:
    """One capture, read and checked: frames and events on the same pixels and the same clock.

    Args:
        name: Name of the capture, that of its folder.
        info: What `capture.yaml` says.
        events: The event stream.
        frames: Frames, uint8 or uint16 [N, H, W], digital numbers.
        frame_times_us: Time of each frame, int64 [N], microseconds, on the events' clock.
        target: The hidden target, or None where it is unknown.
        notes: What reading did to the recordings, a line each.
        others: Other targets that were there too, with their motions, where they are known.
        path: A motion that was found, for samples to take for the stated one; their truth stays.
    """

    name: str
    info: CaptureInfo
    events: Events
    frames: NDArray[np.uint8] | NDArray[np.uint16]
    frame_times_us: NDArray[np.int64]
    target: Target | None
    notes: tuple[str, ...] = ()
    others: tuple[Scene, ...] = ()
    path: Motion | None = None

    @property
    def has_frames(self) -> bool:
        """Whether a frame camera was there; else the frames are black and only mark the time steps."""
        return self.info.frames is not None

    @property
    def has_events(self) -> bool:
        """Whether an event camera was there; else there is no event."""
        return self.info.events is not None

    @property
    def peak(self) -> int:
        """Largest digital number that a frame can hold."""
        return int(np.iinfo(self.frames.dtype).max)

    @property
    def distance_m(self) -> float | None:
        """From hidden object to wall, metres, as noted in `setup`; None where it is not."""
        return noted_distance_m(self.info)

    @property
    def motion(self) -> LineMotion | None:
        """The target's motion on the events' clock; None where it is unknown."""
        return line_of(self.info.motion, self.distance_m)

    @property
    def scene(self) -> Scene | None:
        """The target and its motion on the events' clock; None where either is unknown."""
        motion = self.motion
        if self.target is None or motion is None:
            return None
        return Scene.watched(self.target, motion, self.frame_times_us)

    @property
    def several(self) -> SeveralTargets | None:
        """All targets with their motions, where there is more than one and they are known; else None."""
        if (first := self.scene) is None or not self.others:
            return None
        return SeveralTargets((first, *self.others), self.info.cover)


def captures_in(given: Iterable[Path]) -> list[Path]:
    """Return the capture folders among some paths or patterns, and in folders among them; files are left out.

    Args:
        given: Paths, or patterns of names.

    Raises:
        UnknownNameError: A path does not exist, or there is no capture in any.
    """
    found, paths = list[Path](), matching_paths(given)
    for path in paths:
        is_one = (path / "capture.yaml").is_file()
        inside = [path] if is_one else [file.parent for file in path.glob("*/capture.yaml")]
        if not inside and not path.is_file():
            what = f"{path} holds no capture.yaml" if path.exists() else absent(path, " does not exist")
            raise UnknownNameError(f"{what}; give capture folders, or the folder above them")
        found += inside
    if paths and not found:
        raise UnknownNameError(f"{paths[0]} is no capture folder; give folders with a capture.yaml")
    return sorted(found)


def read_capture(
    folder: str | Path,
    most_frame_bytes: int | None = None,
    *,
    events_topic: str | None = None,
    frames_topic: str | None = None,
    needs_frames: bool = True,
    needs_events: bool = True,
    lazy_frames: bool = False,
    colour: Colour | None = None,
) -> Capture:
    """Read a capture folder (`capture.yaml`, event file, frames, mask), or one file of events and frames.

    The order is: dark frame and flat field, registration, filters of the events, clock, region of interest.

    Args:
        folder: The folder of one capture; or a ROS bag or AEDAT file with events and frames of one camera.
        most_frame_bytes: Memory that its frames may take, bytes; None = a quarter of what is free, up to 2 GiB.
        events_topic: Stream of the events, of a file that holds several.
        frames_topic: Stream of its frames.
        needs_frames: Whether a capture of an event camera alone is refused; else black frames mark its steps.
        needs_events: Whether a capture of a frame camera alone is refused; else it has no events.
        lazy_frames: Whether frames that take more memory are a `FrameStack`, in place of an error.
        colour: Colour of the frames and of the target to take; None is what capture.yaml says.

    Raises:
        DataError: A file is missing, a frame has another size than the camera, clock or pixels do not fit, or
            there are no frames or events where they are needed.
        ConfigError: `capture.yaml` has an unknown key or a wrong type.
        EventFileError: The event file is damaged.
        MissingDependencyError: A file needs an optional package.
    """
    folder = Path(folder)
    if not folder.is_dir() and not folder.is_file():
        raise UnknownNameError(
            f"{absent(folder, ' is not a folder')}; give the folder of a capture (it holds capture.yaml)"
        )
    info = read_capture_info(folder, events_topic=events_topic, frames_topic=frames_topic).in_colour(colour)
    name, folder = _name_of(folder), folder.parent if folder.is_file() else folder
    info.check_cameras(folder, frames=needs_frames, events=needs_events)
    series = None if info.frames is None else read_frame_series(folder, info, most_frame_bytes, lazy_frames)
    events, told = _read_events(folder, info)
    if series is None:
        frames, times_us = time_steps(folder, info, events)
        notes = [f"no frames: {len(frames)} time steps", *told]
    else:
        notes = [f"{len(series.images)} frames from {series.what}", *told]
        frames, told = prepare_frames(folder, info, series)
        times_us, in_time = _place_in_time(folder, info, events, frames, series.times_us)
        notes += told + in_time
    events, frames, told = used_pixels(info, events, frames)
    info, events, times_us, counted = from_start(folder, info, events, times_us)
    notes += told + counted
    if info.events is not None and not len(events):
        raise DataError(f"{folder}: no event is left; check the region and the filters in capture.yaml")
    target = read_target(folder, info.target, info.camera.colour)
    is_held = series is None or isinstance(frames, FrameStack)
    held = cast(Any, frames) if is_held else np.ascontiguousarray(frames)
    others = read_others(folder, info, times_us)
    return Capture(name, info, events, held, times_us, target, tuple(map(printable, notes)), others)


def by_name(paths: Collection[Path]) -> dict[str, Path]:
    """Return captures by name; refuse those that share one."""
    named = {_name_of(path): path for path in paths}
    if len(named) < len(paths):
        raise DataError(f"{len(paths)} folders have {len(named)} different names; rename those that share one")
    return named


def _name_of(path: Path) -> str:
    """Return the name of a capture: that of its folder, or of its file without the ending."""
    return path.stem if path.is_file() else path.name


def _read_events(folder: Path, info: CaptureInfo) -> tuple[Events, list[str]]:
    camera = info.camera
    if info.events is None:
        return Events.empty(camera.width, camera.height), ["no events"]
    path = inside(folder, info.events)
    options = CelexOptions(clock_mhz=camera.clock_mhz) if camera.clock_mhz is not None else None
    events = read_events(path, width=camera.width, height=camera.height, celex=options, topic=info.events_topic)
    if not len(events):
        raise DataError(f"{path} holds no event; check the camera's thresholds and the recording")
    notes = [f"{len(events):,} events from {path.name}"]
    if events.polarity_known is not None and not events.polarity_known.any():
        notes.append("the camera gave no polarity: all events count as darker")
        events = replace(events, polarity_known=None)
    elif events.polarity_known is not None:
        notes.append(f"{int((~events.polarity_known).sum()):,} events without polarity left out")
        events = keep_known_polarity(events)
    filters = info.filters
    if filters != FilterInfo():
        from evnlos.events import CleanOptions, clean_events

        how = CleanOptions(filters.hot_pixel_factor, filters.flicker_hz, filters.background_us)
        events, found = clean_events(events, how)
        notes.append(f"left out: {found}")
    if not len(events):
        raise DataError(f"{path}: no event is left; check the filters in capture.yaml")
    return events, notes


def _place_in_time(
    folder: Path, info: CaptureInfo, events: Events, frames: NDArray, times_us: NDArray[np.int64]
) -> tuple[NDArray[np.int64], list[str]]:
    """Return the frames' times on the events' clock."""
    alignment, channel = info.alignment, info.alignment.trigger_channel
    if channel is not None:
        assert info.events is not None
        triggers = read_triggers(inside(folder, info.events), topic=info.events_topic)
        chosen = triggers.t_us[triggers.rising & (triggers.channel == channel)]
        if len(chosen) != len(frames):
            raise DataError(
                f"{folder / info.events}: {len(chosen)} rising edges on channel {channel} "
                f"for {len(frames)} frames; check the channel, or leave out frames without an edge"
            )
        if len(chosen) and max(abs(int(chosen[0])), abs(int(chosen[-1]))) > _MOST_US // 2:
            raise DataError(f"{folder / info.events}: its triggers are later than {_MOST_US // 2} us")
        return chosen + int(alignment.offset_us), [f"frame times from trigger channel {channel}"]
    if alignment.offset_us != "auto":
        offset = int(alignment.offset_us)
        if max(abs(int(one) + offset) for one in times_us[[0, -1]]) > _MOST_US:
            raise DataError(f"{folder}: frames shifted by {offset} us leave +-{_MOST_US} us; check offset_us")
        return times_us + offset, [f"frames' clock shifted by {offset} us"] if offset else []
    try:
        found = find_offset(
            events, frames, times_us, search_us=round(alignment.search_s * 1e6), blocks=alignment.blocks
        )
    except DataError as error:
        raise DataError(f"{folder}: {error}") from None
    return times_us + found.offset_us, [
        f"frames' clock shifted by {found.offset_us} us, found: correlation {found.correlation:.2f}, "
        f"{found.ratio:.1f} times the next best, lobe {found.lobe_us / 1000:.0f} ms wide"
    ]


def capture_samples(capture: Capture, sampling: Sampling, pattern: FixedPattern | None = None) -> Samples:
    """Return one sample for each frame but the first: the frame, and the events since the frame before.

    Args:
        capture: The capture.
        sampling: Resolution and representation.
        pattern: Fixed pattern to take from the frames.

    Raises:
        DataError: The capture has fewer than two frames.
    """
    return join_samples(_samples_of(capture, sampling, pattern))


def _samples_of(capture: Capture, sampling: Sampling, pattern: FixedPattern | None) -> Iterator[Samples]:
    if (count := len(capture.frames)) < 2:
        raise DataError(f"{capture.name} has {count} frame(s); a sample needs two, with events between")
    frames, peak = capture.frames[1:], float(capture.peak)
    if not capture.has_frames:
        frames = frames[:, :1, :1]
    elif pattern is not None:
        frames, peak = mapped(frames, partial(pattern.correct, peak=peak)), 1.0
    if not capture.has_events:  # nothing is in its maps, of whatever kind they are
        sampling = replace(sampling, surface="sae")
    known: Any = {n: getattr(capture, n) for n in ("motion", "target", "several", "path")}
    known["capture"] = capture.name
    yield from iter_samples(frames, peak, capture.events, capture.frame_times_us, sampling, **known)


def import_captures(
    folders: str | Path | Iterable[str | Path],
    out: str | Path,
    sampling: Sampling = Sampling(),
    *,
    test: Iterable[str] = (),
    validation: Iterable[str] = (),
    pattern: FixedPattern | None = None,
    events_topic: str | None = None,
    frames_topic: str | None = None,
    look: Callable[[Capture], None] | None = None,
    progress: Progress = silent,
    workers: int = 1,
) -> Dataset:
    """Import capture folders as a dataset, or what is missing of it, and return it.

    Args:
        folders: Capture folders, or files with events and frames; the name without its ending becomes the
            object's, the part behind the last underscore its character (`near_R` -> R).
        out: The dataset's folder; new, or begun with the same captures and settings.
        sampling: Resolution and representation.
        test: Names of captures, or characters, that are held out for testing.
        validation: The same for validation.
        pattern: Fixed pattern of the frame camera, to be taken from all frames.
        events_topic: Stream of the events, of files that hold several.
        frames_topic: Stream of their frames.
        look: Called with each capture that was read, before its samples are made: to tell of it, or to draw it.
            Its frames are a `FrameStack` where they take more than 64 MiB.
        progress: Called when the work begins and as each shard is in place, with the capture's name.
        workers: Processes, 0 is one for each core; where `look` is given, this one.

    Returns:
        The dataset.

    Raises:
        ConfigError: The surface is solved through a setup, and none is named.
        DataError: No folder, two captures of one name, or a held-out name that no capture has.
    """
    folders = [folders] if isinstance(folders, (str, Path)) else folders
    paths = by_name([Path(folder).resolve() for folder in folders])
    split = split_of(list(paths), list(test), list(validation))
    if sampling.is_solved:
        from evnlos.inverse.event_images import check_named  # which compiles

        check_named(sampling.setup)
    # Read every description first: a wrong folder is an error before anything is written.
    for path in paths.values():
        if not path.exists():
            raise DataError(no_file(path))
        if not path.is_file() and not (path / "capture.yaml").is_file():
            raise DataError(f"{path} is no capture: capture.yaml is missing; see `evnlos import --help`")
    topics: dict[str, Any] = {"events_topic": events_topic, "frames_topic": frames_topic}
    optional = {"needs_frames": False, "needs_events": False}
    read = partial(read_capture, most_frame_bytes=_HELD_BYTES, **topics, **optional, lazy_frames=True)
    infos = {name: read_capture_info(path, **topics) for name, path in sorted(paths.items())}
    described = {name: _digest_of(paths[name], info) for name, info in infos.items()}
    config = {"captures": described, "sampling": to_dict(sampling), "pattern": pattern and pattern.digest}
    lacks = {n: kind for n, one in infos.items() for kind in ("frames", "events") if not getattr(one, kind)}
    config |= {"lacks": lacks} if lacks else {}
    dataset = Dataset(Path(out), "captures", sampling, split, config=config, config_hash=config_hash(sampling))
    with claim_dataset(dataset):
        what, total, missing = f"import {dataset.folder.name}", len(paths), dataset.missing()
        progress(Step(what, total - len(missing), total, "captures"))
        write = partial(_write, dataset, pattern, read, look)
        todo = [paths[name] for name in missing]
        with closing(run_tasks(write, todo, 1 if look else workers)) as written:
            for done, name in enumerate(written, start=total - len(missing) + 1):
                progress(Step(what, done, total, "captures", name))
    return dataset


def _write(
    dataset: Dataset,
    pattern: FixedPattern | None,
    read: Callable[[Path], Capture],
    look: Callable[[Capture], None] | None,
    path: Path,
) -> str:
    """Write the shard of a capture and return its name."""
    capture = read(path)
    if look is not None:
        look(capture)
    samples = _samples_of(capture, dataset.sampling, pattern)
    attributes = {"object": capture.name, "config_hash": dataset.config_hash}
    attributes["camera"] = capture.info.camera.name
    write_shard(dataset.shard(capture.name), samples, attributes, count=len(capture.frames) - 1)
    return capture.name


def _digest_of(path: Path, info: CaptureInfo) -> str:
    """Return the hash of a description and of the sizes of its files; streams count where they are named."""
    values, folder = to_dict(info), path if path.is_dir() else path.parent
    later = ((values, "events_topic frames_topic recording"), (values["camera"], _LATER_KEYS))
    for place, key in [(place, key) for place, keys in later for key in keys.split()]:
        if place[key] is None:  # as captures had it before there was such a key
            del place[key]
    named = [folder / name for name in (info.events, info.frames, info.target and info.target.mask) if name]
    files = [one for there in named for one in (sorted(there.glob("*")) if there.is_dir() else [there])]
    own = [one for one in files if one.is_file() and one.resolve().is_relative_to(folder.resolve())]
    return config_hash(values | {"bytes": [one.stat().st_size for one in own]})
