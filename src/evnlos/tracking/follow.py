"""From a recording to a track.

- Frames give places, events velocities, a smoother joins them; of several targets too.
- Events alone: their likelihood is asked for the target and its path at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.data.capture import Capture
from evnlos.data.fixed_pattern import FixedPattern
from evnlos.errors import ConfigError, DataError
from evnlos.inverse import TRACKED_ROOM, SequenceOperator, SequenceProblem, SeveralSequences
from evnlos.inverse.sequence_problem import matrix_of, strip_of
from evnlos.setups import Setup
from evnlos.tracking.event_motion import EventVelocity, event_velocity, fit_motion_to_events
from evnlos.tracking.motion_fit import (
    MOST_TARGETS,
    MotionFit,
    count_targets,
    first_paths,
    fit_motion,
    smooth_together,
)
from evnlos.tracking.registration import (
    Registration,
    plane_map,
    reduced,
    register,
    static_light,
    temporal_noise,
)
from evnlos.tracking.track import (
    FEIGNED,
    Distance,
    Measurements,
    Track,
    Tracks,
    Turn,
    most_likely_acceleration,
    smooth,
)
from evnlos.types import Events, Plane

_FINER = 8  # instants of a track by events, for each that the path was found at
_IMAGE_CELLS = 32  # a side of an image of one of several objects
_PRIOR, _STATIC = 4.0, 1.0  # weight of its prior, as `evnlos invert` takes it; a pixel's offset over its noise


@dataclass(frozen=True)
class Tracking:
    """How a recording is followed."""

    columns: int | None = None
    """Columns to which frames and counts are reduced, pixels; none = 80, and 40 with depth, whose light takes
    minutes and gigabytes at 80."""
    window_s: float = 0.05
    """Length of a window of events that gives one velocity, seconds."""
    events: bool = True
    """Use the events; without them only the frames speak."""
    frames: bool = True
    """Use the frames; without them, as where the capture has none, the events speak alone, through a setup."""
    step_s: float = 0.5
    """Events alone: distance of the instants between which the path is a cubic spline, seconds."""
    target_size_m: float | None = None
    """With a setup: side of a square that holds the object, metres; none = 1.25 of capture.yaml's target."""
    cells: int = 20
    """With a setup: cells per side of that square."""
    depth: bool = False
    """With a setup: also find how far the object is from the wall in each frame, and if that surely changes."""
    turning: bool = False
    """With a setup: also find how the object turns about the wall's normal."""
    targets: int | Literal["auto"] = 1
    """Number of objects on paths of their own, or auto: by evidence beyond what an error of the setup could
    make. Other than 1 needs a setup, and looks at frames alone."""
    degree: int = 2
    """Degree of the ambient light over the wall, as a polynomial."""

    def __post_init__(self) -> None:
        if self.columns is not None and self.columns < 16:
            raise ConfigError(f"Tracking.columns is {self.columns}; give 16 pixels or more")
        if not (self.events or self.frames):
            raise ConfigError("Tracking.events and Tracking.frames are both off; leave one of them on")
        if self.targets != "auto" and not 1 <= self.targets <= MOST_TARGETS:
            raise ConfigError(f"Tracking.targets is {self.targets}; give 1 to {MOST_TARGETS}, or auto")
        for name, least in (
            ("cells", 2),
            ("degree", 0),
            ("window_s", 1e-6),
            ("step_s", 1e-6),
            ("target_size_m", 1e-6),
        ):
            if not ((value := getattr(self, name)) is None or value >= least):
                raise ConfigError(f"Tracking.{name} is {value}; give {least} or more")

    @property
    def most_columns(self) -> int:
        """Columns to which frames are reduced, pixels."""
        return self.columns or (40 if self.depth else 80)

    def of(self, capture: Capture | None) -> float:
        """Return the side of a square that surely holds the object, metres."""
        stated = 0.08 if capture is None else capture.info.target_size_m
        return TRACKED_ROOM * stated if self.target_size_m is None else self.target_size_m


def track_several(
    capture: Capture, setup: Setup | None, settings: Tracking, pattern: FixedPattern | None = None
) -> Tracks:
    """Return where several hidden objects were, what they look like, and how many they are.

    Args:
        capture: The recording.
        setup: The calibrated setup.
        settings: How to follow; `targets` says how many, or auto.
        pattern: The frame camera's fixed pattern, to be taken off first.

    Raises:
        ConfigError: There is no setup, there are no frames, or depth or turning is asked for.
        DataError: Too few frames.
    """
    if setup is None:
        raise ConfigError(f"Tracking.targets is {settings.targets} and needs a setup: give its file (--setup)")
    if settings.depth or settings.turning:
        raise ConfigError(f"Tracking.targets is {settings.targets}; depth and turning are found of one alone")
    if not (capture.has_frames and settings.frames):
        raise ConfigError(
            f"{capture.name}: Tracking.targets is {settings.targets}; several are found by frames alone"
        )
    small = reduced(_levels(capture, pattern), settings.most_columns)
    times_s, noise = capture.frame_times_us.astype(np.float64) * 1e-6, temporal_noise(small)
    if not noise > 0:
        raise DataError(f"{capture.name}: its frames show no noise; give a recording that is not clipped")
    light = torch.from_numpy(small - static_light(small, settings.degree))
    size_m, gains = settings.of(capture), list[float]()
    if settings.targets == "auto":
        number = count_targets(light, setup, times_s, noise, size_m, settings.cells, degree=settings.degree)
        if not number.found:
            return Tracks((), np.zeros((0, _IMAGE_CELLS, _IMAGE_CELLS)), size_m, tuple(number.gains))
        start_m, gains, bend_m = number.fits[number.found - 1].position_m, number.gains, 0.0
    else:
        start_m, bend_m = first_paths(light, setup, noise, size_m, settings.targets), size_m / 50
    fit = fit_motion(
        light, setup, start_m, noise, size_m, settings.cells, bend_m=bend_m, degree=settings.degree
    )
    count, many = fit.covariance.shape[:2]
    values, variance = fit.position_m.reshape(count, many), np.einsum("nknk->nk", fit.covariance)
    blank = np.full(count, np.nan)
    axes = [Measurements(times_s, *one, blank, blank) for one in zip(values.T, variance.T, strict=True)]
    speeds = [most_likely_acceleration(axes[k - k % 2 :][:2]) for k in range(many)]
    mean, spread = smooth_together(times_s, values, fit.covariance, [None] * many, speeds, times_s)
    sigma, pairs = np.sqrt(variance), [slice(k, k + 2) for k in range(0, many, 2)]
    told = [(mean[..., p], spread[..., p], (values[:, p], sigma[:, p])) for p in pairs]
    tracks = tuple(_track(times_s, a, b, "m", times_s, by, misfit=fit.misfit) for a, b, by in told)
    return Tracks(tracks, images_of_targets(light, setup, tracks, noise, size_m), size_m, tuple(gains))


def images_of_targets(
    light: torch.Tensor, setup: Setup, tracks: Sequence[Track], noise: float, size_m: float
) -> NDArray[np.float64]:
    """Return the images of targets on known paths, all at once, [K, n, n]: Tikhonov over the whole sequence.

    Args:
        light: Frames without ambient light, white levels, [N, h, w].
        setup: The setup.
        tracks: Their paths at the frames' instants.
        noise: Standard deviation of a sample's noise, white levels.
        size_m: Side of an image, metres.
    """
    plane, shape = Plane(_IMAGE_CELLS, _IMAGE_CELLS, size_m / _IMAGE_CELLS), (light.shape[1], light.shape[2])
    strip = strip_of(np.concatenate([one.position for one in tracks]), plane)
    transport = matrix_of(setup.seen_by(shape).operator(strip, shape))
    parts = tuple(SequenceOperator(transport, plane, one.position) for one in tracks)
    problem = SequenceProblem(SeveralSequences(parts), _STATIC)
    return problem.tikhonov(light.double(), _PRIOR * noise**2).image.numpy()


def _levels(capture: Capture, pattern: FixedPattern | None) -> NDArray:
    if pattern is not None:
        return pattern.correct(capture.frames, capture.peak)
    return capture.frames / np.float32(capture.peak)


def track_capture(
    capture: Capture,
    setup: Setup | None = None,
    settings: Tracking | None = None,
    pattern: FixedPattern | None = None,
) -> Track:
    """Return where the hidden object was; whatever `capture.yaml` says of its motion is not looked at.

    Args:
        capture: The recording.
        setup: The calibrated setup; with it the track is in metres on the target's plane.
        settings: How to follow.
        pattern: The frame camera's fixed pattern, to be taken off first.

    Raises:
        DataError: Too few frames, or the object does not stand out.
    """
    times_s = capture.frame_times_us.astype(np.float64) * 1e-6
    settings = replace(settings or Tracking(), target_size_m=(settings or Tracking()).of(capture))
    if not (capture.has_frames and settings.frames):
        capture.info.check_cameras(capture.name, frames=False, events=True)
        if setup is None:
            raise ConfigError(f"{capture.name}: events alone need a setup to be followed; give one (--setup)")
        return track_events(capture.events, (float(times_s[0]), float(times_s[-1])), setup, settings)
    events = capture.events if capture.has_events else None
    return track_frames(_levels(capture, pattern), times_s, events, setup, settings)


def track_frames(
    frames: NDArray,
    times_s: NDArray[np.float64],
    events: Events | None = None,
    setup: Setup | None = None,
    settings: Tracking | None = None,
) -> Track:
    """Return the track of one moving object.

    Args:
        frames: White levels, real [N, H, W].
        times_s: Their instants, [N], seconds, on the events' clock.
        events: The events of the same pixels, or None.
        setup: The calibrated setup, or None.
        settings: How to follow.

    Raises:
        DataError: Too few frames, or the object does not stand out.
    """
    settings = settings or Tracking()
    for name in ("depth", "turning"):
        if getattr(settings, name) and setup is None:
            raise ConfigError(f"Tracking.{name} needs a setup: give its file (--setup), or leave {name} out")
    if settings.targets != 1:
        raise ConfigError(f"Tracking.targets is {settings.targets}; `track_several` follows several, this one")
    small = reduced(frames, settings.most_columns)
    noise = temporal_noise(small)
    found = register(small, static_light(small, settings.degree), noise)
    by_events = None
    if events is not None and settings.events:
        by_events = event_velocity(events, found, times_s, settings.window_s)
    if setup is None:
        return _in_pixels(found, by_events, times_s, frames.shape[2] / small.shape[2])
    return _in_metres(found, by_events, times_s, small, setup, noise, settings)


def track_events(
    events: Events, span_s: tuple[float, float], setup: Setup, settings: Tracking | None = None
) -> Track:
    """Return the track of one moving object by its events alone: their likelihood through the setup.

    Args:
        events: The stream.
        span_s: First and last instant, seconds.
        setup: The calibrated setup, with its event pixel.
        settings: How to follow.

    Raises:
        ConfigError: The setup's event model states no law of its crossings, or several targets are asked for.
        DataError: Too few events, or they do not tell where the object was.
    """
    settings = settings or Tracking()
    if settings.targets != 1:
        raise ConfigError(f"Tracking.targets is {settings.targets}; several are found by frames alone")
    ways = {"depth": settings.depth, "turning": settings.turning}
    how = settings.cells, settings.step_s, settings.most_columns
    times_s, fitted = fit_motion_to_events(events, span_s, setup, settings.of(None), *how, **ways)
    finer = np.linspace(*span_s, _FINER * (len(times_s) - 1) + 1)
    track = _smoothed(fitted, times_s, setup, np.unique(np.concatenate([times_s, finer])), [])
    return replace(track, events=len(events))


def _in_metres(
    found: Registration,
    by_events: EventVelocity | None,
    times_s: NDArray[np.float64],
    small: NDArray,
    setup: Setup,
    noise: float,
    settings: Tracking,
) -> Track:
    shape = (small.shape[1], small.shape[2])
    size_m = settings.of(None)
    to_plane = plane_map(setup, shape, size_m)
    light = torch.from_numpy(small - found.background)
    start_m = to_plane(found.place_px)
    fitted = fit_motion(
        light, setup, start_m, noise, size_m, settings.cells,
        depth=settings.depth, turning=settings.turning, degree=settings.degree, image_cells=_IMAGE_CELLS,
    )  # fmt: skip
    rates: list[Any] = []
    if by_events is not None:
        where = np.stack(
            [np.interp(by_events.time_s, times_s, found.place_px[:, k]) for k in range(2)], axis=-1
        )
        slope = to_plane.slope(where)  # [M, 2, 2]
        velocity = np.einsum("mab,mb->ma", slope, by_events.velocity)
        rough = np.einsum("mab,mb->ma", slope**2, by_events.variance)
        rates = [(by_events.time_s, velocity[:, k], rough[:, k]) for k in range(2)]
    track = _smoothed(fitted, times_s, setup, _instants(times_s, by_events), rates, found, by_events)
    return replace(track, misfit=fitted.misfit)


def _smoothed(
    fitted: MotionFit,
    times_s: NDArray[np.float64],
    setup: Setup,
    instants: NDArray[np.float64],
    rates: list[Any],
    found: Registration | None = None,
    by_events: EventVelocity | None = None,
) -> Track:
    """Return the track through fitted poses, and, where they are measured, rates (instants, rate, variance)."""
    variance = np.einsum("nknk->nk", fitted.covariance)
    values = np.column_stack(
        [fitted.position_m, *(one for one in (fitted.log_distance, fitted.rotation_rad) if one is not None)]
    )
    blank = np.full(len(times_s), np.nan)
    axes = [Measurements(times_s, *one, blank, blank) for one in zip(values.T, variance.T, strict=True)]
    speeds = [most_likely_acceleration(axes[:2])] * 2 + [most_likely_acceleration([one]) for one in axes[2:]]
    rates = rates + [None] * (values.shape[1] - len(rates))
    by_frames = fitted.position_m, np.sqrt(variance[:, :2])
    mean, spread = smooth_together(times_s, values, fitted.covariance, rates, speeds, instants)
    track = _track(instants, mean, spread, "m", times_s, by_frames, found, by_events)
    at = np.searchsorted(instants, times_s)
    curves = [(mean[at, 0, k], spread[at, 0, k], mean[at, 1, k], spread[at, 1, k]) for k in range(len(axes))]
    distance = turn = None
    if fitted.log_distance is not None:
        log, log_sigma, rate, rate_sigma = curves[2]
        away = (own_m := setup.default_distance_m or 1.0) * np.exp(log)
        feigned_m = FEIGNED["events" if found is None else "frames"] * setup.recording_error * own_m
        distance = Distance(times_s, away, away * log_sigma, away * rate, away * rate_sigma, feigned_m)
    if fitted.rotation_rad is not None:
        turn = Turn(times_s, *(np.degrees(one) for one in curves[-1]))
    return replace(track, distance=distance, turn=turn, image=fitted.target.numpy(), size_m=fitted.size_m)


def _instants(times_s: NDArray[np.float64], by_events: EventVelocity | None) -> NDArray[np.float64]:
    """Return the instants of frames and windows, in order."""
    return np.unique(np.concatenate([times_s, [] if by_events is None else by_events.time_s]))


def _in_pixels(
    found: Registration, by_events: EventVelocity | None, times_s: NDArray[np.float64], pixel: float
) -> Track:
    """Return the smoothed track over the instants of frames and windows."""
    place = (found.place_px - found.place_px.mean(axis=0)) * pixel
    sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)[:, :2]) * pixel
    instants, axes = _instants(times_s, by_events), []
    at_frames = np.searchsorted(instants, times_s)
    for axis in range(2):
        columns = np.full((4, len(instants)), np.nan)
        columns[0, at_frames], columns[1, at_frames] = place[:, axis], sigma[:, axis] ** 2
        if by_events is not None:
            at_windows = np.searchsorted(instants, by_events.time_s)
            columns[2, at_windows] = by_events.velocity[:, axis] * pixel
            columns[3, at_windows] = by_events.variance[:, axis] * pixel**2
        axes.append(Measurements(instants, *columns))
    acceleration = most_likely_acceleration(axes)
    smoothed = [smooth(one, acceleration) for one in axes]
    mean = np.stack([one.mean for one in smoothed], axis=-1)  # [T, 2 (value, rate), 2 (x, y)]
    spread = np.stack([np.sqrt(np.diagonal(one.covariance, axis1=1, axis2=2)) for one in smoothed], axis=-1)
    return _track(instants, mean, spread, "px", times_s, (place, sigma), found, by_events)


def _track(
    instants: NDArray[np.float64],
    mean: NDArray[np.float64],
    spread: NDArray[np.float64],
    unit: Literal["m", "px"],
    times_s: NDArray[np.float64],
    by_frames: tuple[NDArray[np.float64], NDArray[np.float64]],
    found: Registration | None = None,
    by_events: EventVelocity | None = None,
    misfit: float | None = None,
) -> Track:
    """Return the track of smoothed values and rates [T, 2, K] of x and y, beside what frames alone say."""
    unknown = np.full(len(times_s), np.nan)
    return Track(
        instants,
        mean[:, 0, :2],
        mean[:, 1, :2],
        spread[:, 0, :2],
        spread[:, 1, :2],
        unit,
        times_s,
        *by_frames,
        unknown if found is None else found.size,
        unknown if found is None else found.size * np.sqrt(found.covariance[:, 2, 2]),
        0 if by_events is None else len(by_events.time_s),
        misfit=misfit,
    )
