"""From what the cameras recorded to the maps a network sees: one sample a position.

- Where the pixels of the frame camera lie on those of the event camera.
- Samples at a working resolution: a frame, a time surface and the truth of each position.
- What a capture's description says of its targets and their motions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from evnlos.config import check_made
from evnlos.data.capture_info import CaptureInfo, MotionInfo, RegistrationInfo, TargetInfo, inside
from evnlos.data.frames import find_dots, homography_from_points, read_image, registration_error
from evnlos.errors import ConfigError, DataError, UnknownNameError
from evnlos.events import (
    FrameStack,
    event_histogram,
    event_trace,
    frame_blocks,
    iter_time_surfaces,
    read_events,
    surface_with_trace,
)
from evnlos.scene import LineMotion, Motion, Scene, SeveralTargets, Target
from evnlos.types import Colour, Events, Plane

_TRACES = {"trace": event_trace, "sae-trace": surface_with_trace}
_BLOCK_BYTES = 1 << 26  # of frames and surfaces at the sensor's resolution
SOLVED = ("likelihood", "corrected", "so-far")
"""Surfaces that are the target which the events show through the light path of a setup."""


def frame_homography(
    folder: Path, info: RegistrationInfo, capture: CaptureInfo
) -> tuple[NDArray[np.float64], str]:
    """Return the matrix from frame to event pixels, float64 [3, 3], and how it was found."""
    if info.homography is not None:
        return np.array(info.homography), "the homography stated"
    if info.points is not None:
        pairs = np.array(info.points, float).reshape(-1, 4)
        frame, event, how = pairs[:, :2], pairs[:, 2:], f"{len(pairs)} points"
    else:
        dots = info.dots
        assert dots is not None
        picture = read_image(inside(folder, dots.frame))
        picture = picture[::-1, ::-1] if capture.frames_turned else picture
        width, height = capture.camera.width, capture.camera.height
        seen = read_events(inside(folder, dots.events), width=width, height=height)
        frame = find_dots(picture, dots.rows, dots.columns)
        event = find_dots(event_histogram(seen)[0].sum(axis=0), dots.rows, dots.columns)
        how = f"{dots.rows} x {dots.columns} dots"
    matrix = homography_from_points(frame, event)
    return matrix, f"{how} (rms error {registration_error(matrix, frame, event):.2f} pixels)"


@dataclass(frozen=True)
class Sampling:
    """How recordings become samples; the defaults are the standard sample, so that figures compare."""

    height: int = 64
    """Rows of every stored map, pixels."""
    width: int = 96
    """Columns of every stored map, pixels."""
    pitch_m: float = 0.0025
    """Size of a pixel of the truth on the target's plane, metres."""
    scored_rows: int = 48
    """Rows in the middle of the canvas that are scored; the target never leaves them, pixels."""
    surface: Literal["sae", "context", "hots", "trace", "sae-trace", "likelihood", "corrected", "so-far"] = (
        "sae"
    )
    """Kind of the time surface; `trace` = log light smoothed over all events, also later ones; `sae-trace` =
    `sae` and, for networks of single time steps, the trace so far of 10 `tau_s`; `likelihood` = the target that
    the events of the sequence make most likely through the light path of `setup`; `corrected` = the same of
    captures, less what other captures showed that the setup gets wrong of events; `so-far` = the same of the
    events up to each time step alone."""
    tau_s: float = 0.2
    """Time constant of the time surface, seconds; of `trace`, the time in which the light changes: 1 to 5."""
    radius: int = 3
    """Radius of the neighbourhood of the surfaces `context` and `hots`, pixels."""
    setup: str = ""
    """Setup whose light path the surface `likelihood`, and networks with `frames: likelihood`, undo: a folder
    of `evnlos calibrate`, a settings file, or a name."""

    def __post_init__(self) -> None:
        for name in ("height", "width", "scored_rows"):
            if getattr(self, name) < 1:
                raise ConfigError(f"Sampling.{name} is {getattr(self, name)}; give at least 1 pixel")
        if self.scored_rows > self.height:
            raise ConfigError(f"Sampling.scored_rows is {self.scored_rows}; the canvas has {self.height} rows")
        for name in ("pitch_m", "tau_s"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"Sampling.{name} is {getattr(self, name)}; give a positive number")
        check_made(self)

    @property
    def surface_maps(self) -> int:
        """Maps of the surface: ON and OFF, and those of the trace where it stands beside them."""
        return 4 if self.surface == "sae-trace" else 2

    @property
    def is_solved(self) -> bool:
        """Whether the surface is the target that the events show through the light path of `setup`."""
        return self.surface in SOLVED

    def shown_as(self, other: Sampling) -> Sampling:
        """Return it with the surface of another where both show what events say of the target."""
        return replace(self, surface=other.surface) if self.is_solved and other.is_solved else self

    def of_frames(self) -> Sampling:
        """Return it as far as frames alone are concerned: the surface is the usual one."""
        usual = Sampling()
        return replace(self, surface=usual.surface, tau_s=usual.tau_s, radius=usual.radius)

    @property
    def canvas(self) -> Plane:
        """The part of the target's plane that the truth shows, centred on the middle of the travel."""
        return Plane(self.height, self.width, self.pitch_m)

    @property
    def scored(self) -> slice:
        """The scored rows of the canvas."""
        first = (self.height - self.scored_rows) // 2
        return slice(first, first + self.scored_rows)


@dataclass(frozen=True)
class Samples:
    """All positions of one object, in the order of time.

    Args:
        frame: What the frame camera saw, float32 [N, H, W], 0..1 (1 = the largest digital number).
        surface: Surface of the events, float32 [N, 2, H, W]: ON, OFF; 4 maps of `sae-trace`.
        truth: The target on the canvas, float32 [N, H, W], 0..1; None where the target is unknown.
        time_s: Instant of each position, float64 [N], seconds.
        position_m: Target's centre (x, y), float64 [N, 2], metres; None where the motion is unknown.
        event_count: Events behind each surface, int64 [N].
    """

    frame: NDArray[np.float32]
    surface: NDArray[np.float32]
    truth: NDArray[np.float32] | None
    time_s: NDArray[np.float64]
    position_m: NDArray[np.float64] | None
    event_count: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.frame)


def edges_from(times_s: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the instants between positions, int64 [N + 1], microseconds: 0, then those of the positions."""
    return np.concatenate([[0], np.round(times_s * 1e6)]).astype(np.int64)


def make_samples(
    frames: NDArray,
    peak: float,
    events: Events,
    edges_us: NDArray[np.int64],
    sampling: Sampling,
    *,
    motion: Motion | None = None,
    target: Target | None = None,
    several: SeveralTargets | None = None,
) -> Samples:
    """Turn one recording into samples: surfaces at sensor resolution, then all reduced by area averaging.

    Args:
        frames: One frame a position, unsigned integers [N, H, W], digital numbers.
        peak: Largest digital number of the frames.
        events: The events of the whole recording.
        edges_us: N + 1 ascending instants, microseconds; position k has the events in (edge k, edge k + 1].
        sampling: Resolution and representation.
        motion: The target's motion on the events' clock; None where it is unknown.
        target: The target; there is a truth only where motion and target are known.
        several: All targets where there are others too: the truth then shows all of them.

    Raises:
        DataError: The number of frames and of edges disagree.
    """
    known: dict[str, Any] = {"motion": motion, "target": target, "several": several}
    return join_samples(iter_samples(frames, peak, events, edges_us, sampling, **known))


def join_samples(blocks: Iterable[Samples]) -> Samples:
    """Return blocks of samples, at least one, as one."""
    parts = list(blocks)
    columns = {one.name: [getattr(part, one.name) for part in parts] for one in fields(Samples)}
    joined: Any = {name: None if of[0] is None else np.concatenate(of) for name, of in columns.items()}
    return Samples(**joined)


def iter_samples(
    frames: NDArray | FrameStack,
    peak: float,
    events: Events,
    edges_us: NDArray[np.int64],
    sampling: Sampling,
    *,
    motion: Motion | None = None,
    target: Target | None = None,
    several: SeveralTargets | None = None,
    capture: str | None = None,
    path: Motion | None = None,
) -> Iterator[Samples]:
    """Yield what `make_samples` returns in blocks, at least one, whose memory does not grow with the positions.

    Of traces and what is solved for the target all are held at once. `capture` is the name of a recording,
    which `corrected` takes, see `event_images`; `path` is a motion that was found, the truth is at `motion`.
    """
    if len(edges_us) != len(frames) + 1:
        raise DataError(f"{len(frames)} frames need {len(frames) + 1} edges, not {len(edges_us)}")
    shape, seen = (sampling.height, sampling.width), path or motion
    steps = max(1, _BLOCK_BYTES // (4 * (2 * events.width * events.height + math.prod(frames.shape[1:]))))
    tau_us, mode = sampling.tau_s * 1e6, cast(Any, sampling.surface)
    if sampling.is_solved:
        from evnlos.inverse.event_images import event_images  # which compiles

        corrects = capture if mode == "corrected" else None
        those = events, edges_us, seen, sampling.setup, sampling.canvas, corrects
        images = event_images(*those, so_far=mode == "so-far")
        surfaces = frame_blocks(images, steps)
    elif mode in _TRACES:
        surfaces = frame_blocks(_TRACES[mode](events, edges_us, tau_us), steps)
    else:
        surfaces = iter_time_surfaces(events, edges_us, tau_us, mode, radius=sampling.radius, grids=steps)
    counts = np.diff(np.searchsorted(events.t_us, edges_us, side="right")).astype(np.int64)
    blocks = frame_blocks(frames, steps) if len(frames) else iter([np.asarray(frames)])
    for k, (block, surface) in enumerate(zip(blocks, surfaces, strict=True)):
        part = slice(k * steps, k * steps + len(block))
        time_s = np.asarray(edges_us[1:][part], dtype=np.float64) * 1e-6
        position, truth = None if seen is None else seen.position_m(time_s), None
        if target is not None and motion is not None:
            truth = (several or Scene(target, motion)).truth(sampling.canvas, time_s)
        light = reduce_by_area(block / np.float32(peak), shape)
        maps = surface if sampling.is_solved else reduce_by_area(surface, shape)
        yield Samples(light, maps, truth, time_s, position, counts[part])


def reduce_by_area(images: NDArray, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Resample images [..., H, W] to [..., *shape] by exact area averaging, also at fractional ratios.

    Each output pixel is the mean of the input over its cell; the mean of the image is kept.

    Args:
        images: Real images, [..., H, W].
        shape: Rows and columns of the result, pixels.

    Example:
        >>> reduce_by_area(np.arange(6.0).reshape(1, 6), (1, 4)).round(2)
        array([[0.33, 1.67, 3.33, 4.67]], dtype=float32)
    """
    images = np.asarray(images, dtype=np.float32)
    if images.shape[-2:] == tuple(shape):
        return images
    over_y, over_x = (area_weights(a, b) for a, b in zip(images.shape[-2:], shape, strict=True))
    return np.ascontiguousarray((over_y @ images) @ over_x.T)  # [..., *shape]


def area_weights(inside: int, outside: int) -> NDArray[np.float32]:
    """Return the fraction of each of `outside` equal cells that each of `inside` equal cells covers."""
    cell = inside / outside
    low = np.maximum(np.arange(outside)[:, None] * cell, np.arange(inside))
    high = np.minimum(np.arange(1, outside + 1)[:, None] * cell, np.arange(1, inside + 1))
    return (np.maximum(high - low, 0.0) / cell).astype(np.float32)


_STEPS_HZ, _MOST_STEPS = 30.0, 1_000_000


def time_steps(folder: Path, info: CaptureInfo, events: Events) -> tuple[NDArray, NDArray[np.int64]]:
    """Return black frames, which take no memory, and their times, over the time of the events.

    Args:
        folder: The capture's folder, for messages.
        info: Its description; `camera.frame_rate_hz` is the rate of the time steps, 30 Hz by default.
        events: Its events, at least one.

    Raises:
        DataError: There would be more than a million time steps.
    """
    first, last = int(events.t_us[0]), int(events.t_us[-1])
    step_us = 1e6 / (info.camera.frame_rate_hz or _STEPS_HZ)
    if (last - first) / step_us > _MOST_STEPS:
        raise DataError(f"{folder}: events over {(last - first) / 1e6:.0f} s; cut them, or lower frame_rate_hz")
    times_us = first + np.round(np.arange(int((last - first) / step_us) + 1) * step_us).astype(np.int64)
    return np.broadcast_to(np.uint8(0), (len(times_us), *events.shape)), times_us


def split_of(names: list[str], test: list[str], validation: list[str]) -> dict[str, list[str]]:
    """Return which captures are learned from, and which are held out, by name or character.

    Raises:
        UnknownNameError: No capture, or a held-out name that none has.
        DataError: One that is held out twice.
    """
    if not names:
        raise UnknownNameError("no captures given; name a capture folder, before flags that take several words")
    split: dict[str, list[str]] = {"train": [], "validation": [], "test": []}
    for wanted in (*test, *validation):
        if not any(wanted in (name, character_of(name)) for name in names):
            there = ", ".join(sorted(names))
            raise UnknownNameError(f"no capture is named {wanted} or shows it; hold out some of {there[:300]}")
    for name in names:
        keys = {name, character_of(name)}
        in_test, in_validation = bool(keys & set(test)), bool(keys & set(validation))
        if in_test and in_validation:
            raise DataError(f"{name} is held out for testing and for validation; choose one")
        split["test" if in_test else "validation" if in_validation else "train"].append(name)
    return split


def character_of(name: str) -> str:
    """Return what an object shows, from its name: the part behind the last underscore.

    Args:
        name: Name of an object or capture, e.g. "near_R".

    Example:
        >>> character_of("near_R"), character_of("writer03_A")
        ('R', 'A')
    """
    return name.rsplit("_", 1)[-1]


def line_of(motion: MotionInfo | None, distance_m: float | None) -> LineMotion | None:
    """Return the motion that a `capture.yaml` states, on the events' clock; None where it states none.

    Args:
        motion: What it states.
        distance_m: Distance from target to wall that it notes, metres; None where it notes none.
    """
    if motion is None:
        return None
    direction, start = np.asarray(motion.direction, dtype=float), motion.start_m
    if not isinstance(start, tuple):
        along = start * direction / np.hypot(*direction)
        start = (float(along[0]), float(along[1]))
    line = LineMotion(start, motion.speed_m_s, motion.direction, motion.start_us * 1e-6)
    away_m = distance_m if motion.retreat_m_s else None
    return replace(line, z_m=away_m, retreat_m_s=motion.retreat_m_s, spin_deg_s=motion.spin_deg_s)


def stated_targets(name: str, scenes: Sequence[Scene], cover: bool) -> dict[str, Any]:
    """Return what a `capture.yaml` states of its targets and their motions; `line_of` reads the motions.

    Args:
        name: Name of the capture.
        scenes: Each target and its motion.
        cover: Whether later targets hide earlier ones.
    """
    told = []
    for k, scene in enumerate(scenes):
        motion: Any = scene.motion
        pose = {n: getattr(motion, n) for n in ("retreat_m_s", "spin_deg_s") if getattr(motion, n)}
        start, line = list(motion.start_m), {"speed_m_s": motion.speed_m_s, "direction": list(motion.direction)}
        line = {"start_m": start, **line, "start_us": round(motion.start_s * 1e6), **pose}
        shown = character_of(scene.target.name if k else name)
        told.append({"name": shown, "mask": mask_file(k), "size_m": scene.target.size_m, "motion": line})
    first = {"target": told[0], "motion": told[0].pop("motion")}
    return {**first, "others": told[1:], "cover": cover} if told[1:] else first


def mask_file(number: int) -> str:
    """Return the name of the mask of target 0, 1, ... in a capture's folder."""
    return f"other{number}.png" if number else "target.png"


def read_target(folder: Path, info: TargetInfo | None, colour: Colour | None) -> Target | None:
    """Return the target of a capture with its mask in one colour, or as grey; None where there is none."""
    if info is None or info.mask is None:
        return None
    mask = read_image(inside(folder, info.mask), colour=colour)
    if colour is None and not mask.any():
        raise DataError(f"{folder / info.mask} is black all over; what is white shines")
    return Target(info.name, mask.astype(np.float32) / np.float32(np.iinfo(mask.dtype).max), info.size_m)


def read_others(folder: Path, info: CaptureInfo, times_us: NDArray[np.int64]) -> tuple[Scene, ...]:
    """Return the other targets of a capture with their motions, as far as both are known."""
    z_m, colour = noted_distance_m(info), info.camera.colour
    found = [(read_target(folder, one, colour), line_of(one.motion, z_m)) for one in info.others]
    known = [(one, line) for one, line in found if one is not None and line is not None]
    return tuple(Scene.watched(one, line, times_us) for one, line in known)


def noted_distance_m(info: CaptureInfo) -> float | None:
    """Return the distance from hidden object to wall that a capture notes, metres; None without one."""
    noted = info.setup.get("distance_m")
    return None if noted is None else float(noted)
