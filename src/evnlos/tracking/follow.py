"""From a recording to a track: the light that stands still taken off, then the object followed.

- From a recording to a track: frames give places, events give velocities, a smoother joins them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.data.capture import Capture
from evnlos.data.fixed_pattern import FixedPattern
from evnlos.data.sampling import reduce_by_area
from evnlos.errors import ConfigError, DataError
from evnlos.inverse import BackgroundModel
from evnlos.setups import Setup
from evnlos.tracking.motion_fit import fit_motion, smooth_together
from evnlos.tracking.registration import EventVelocity, Registration, event_velocity, register
from evnlos.tracking.track import (
    Distance,
    Measurements,
    Track,
    Turn,
    most_likely_acceleration,
    plane_map,
    smooth,
)
from evnlos.types import Events

_ROUNDS = 20
_ABOVE = 2.5  # standard deviations over the background from which a pixel shows the object
_LEAST_SHARE = 0.1


def temporal_noise(frames: NDArray) -> float:
    """Return the standard deviation of the noise that changes from frame to frame, in the frames' unit.

    Median absolute value of second differences, in time and then over neighbours: a smooth image that moves
    leaves next to nothing there.

    Args:
        frames: Real [N, H, W], three or more along each axis.
    """
    change = (frames[2:] - 2 * frames[1:-1] + frames[:-2]) / np.sqrt(6)
    around = change[:, :-2, 1:-1] + change[:, 2:, 1:-1] + change[:, 1:-1, :-2] + change[:, 1:-1, 2:]
    return float(1.4826 * np.median(np.abs(4 * change[:, 1:-1, 1:-1] - around)) / np.sqrt(20))


def static_light(frames: NDArray, degree: int = 2) -> NDArray[np.float64]:
    """Return ambient light as a polynomial through the pixels and times that the object's light does not reach.

    A mean over time would take a slow object for background, and so would a minimum where the object never
    leaves. The object adds light, so samples above the polynomial by more than their noise are dropped, again
    and again until the fit rests.

    Args:
        frames: Real [N, H, W].
        degree: Total degree of the polynomial.

    Returns:
        float64 [H, W], in the frames' unit.

    Raises:
        DataError: Fewer than a tenth of the pixels are free of the object.
    """
    shape = (int(frames.shape[1]), int(frames.shape[2]))
    columns = BackgroundModel(degree).polynomials(shape).numpy().reshape(-1, shape[0] * shape[1]).T  # [P, K]
    middle = np.median(frames, axis=0).ravel().astype(np.float64)
    swing = frames.max(axis=0).ravel() - middle
    used = swing <= np.quantile(swing, 0.5)
    fitted = middle
    for _ in range(_ROUNDS):
        if used.mean() < _LEAST_SHARE:
            raise DataError(
                f"{100 * used.mean():.0f} % of the wall is free of the object's light, "
                f"{100 * _LEAST_SHARE:.0f} % is the least; show more of the wall"
            )
        known = np.linalg.lstsq(columns[used], middle[used], rcond=None)[0]
        fitted = (columns @ known).astype(np.float64)
        rest = middle - fitted
        # Half of the noise lies below the polynomial, where no object adds light.
        sigma = np.sqrt(np.mean(np.minimum(rest[used], 0.0) ** 2) * 2)
        before, used = used, rest <= _ABOVE * sigma
        if (before == used).all():
            break
    return fitted.reshape(shape)


_LEAST_FRAMES = 4
_SAME_DISTANCE = 0.03  # share by which a capture's stated distance may differ from its setup's
_MOST_MISFIT = 1.2  # times the noise: calibrated setups leave 0.95 to 1.05 of captures of their own


@dataclass(frozen=True)
class Tracking:
    """How a recording is followed."""

    columns: int = 80
    """Columns to which frames and counts are reduced, pixels."""
    window_s: float = 0.05
    """Length of a window of events that gives one velocity, seconds."""
    events: bool = True
    """Use the events; without them only the frames speak."""
    target_size_m: float = 0.1
    """With a setup: side of a square that surely holds the object, metres."""
    cells: int = 20
    """With a setup: cells per side of that square."""
    depth: bool = False
    """With a setup: also find how far the object is from the wall in each frame."""
    turning: bool = False
    """With a setup: also find how the object turns about the wall's normal."""
    degree: int = 2
    """Degree of the ambient light over the wall, as a polynomial."""

    def __post_init__(self) -> None:
        if self.columns < 16:
            raise ConfigError(f"Tracking.columns is {self.columns}; give 16 pixels or more")
        for name in ("window_s", "target_size_m"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"Tracking.{name} is {getattr(self, name)}; give a positive number")


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
    frames = capture.frames / np.float32(capture.peak)
    if pattern is not None:
        frames = pattern.correct(capture.frames, capture.peak)
    events = capture.events if capture.has_events else None
    return track_frames(frames, capture.frame_times_us.astype(np.float64) * 1e-6, events, setup, settings)


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
    if len(frames) < _LEAST_FRAMES:
        raise DataError(f"{len(frames)} frames; tracking needs {_LEAST_FRAMES} or more")
    sensor = (int(frames.shape[1]), int(frames.shape[2]))
    columns = min(settings.columns, sensor[1])
    shape = (max(1, round(sensor[0] * columns / sensor[1])), columns)
    small = reduce_by_area(frames, shape)
    noise = temporal_noise(small)
    found = register(small, static_light(small, settings.degree), noise)
    by_events = None
    if events is not None and settings.events:
        by_events = event_velocity(events, found, times_s, settings.window_s)
    if setup is None:
        return _in_pixels(found, by_events, times_s, sensor[1] / columns)
    return _in_metres(found, by_events, times_s, small, setup, noise, settings)


def track_warnings(capture: Capture, setup: Setup | None, track: Track) -> list[str]:
    """Return why a track in metres may be wrong by more than it states, a line each; none where nothing is odd.

    Args:
        capture: The recording.
        setup: The setup that it was followed with; None: nothing is known.
        track: What was found.
    """
    warnings = []
    stated = capture.distance_m
    known_m = None if setup is None else setup.default_distance_m
    if known_m is not None and stated is not None and abs(stated / known_m - 1) > _SAME_DISTANCE:
        warnings.append(
            f"capture.yaml states a distance of {stated:g} m, the setup {known_m:g} m, more than "
            f"{100 * _SAME_DISTANCE:.0f} % apart: lengths and their deviations are wrong; take the setup of "
            "that distance"
        )
    if track.misfit is not None and track.misfit > _MOST_MISFIT:
        warnings.append(
            f"the setup leaves {track.misfit:.1f} times the noise in the frames, {_MOST_MISFIT:g} is the most: "
            "positions are worse than their stated deviations; calibrate this very setup (`evnlos calibrate`)"
        )
    return warnings


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
    to_plane = plane_map(setup, shape)
    light = torch.from_numpy(small - found.background)
    start_m = to_plane(found.place_px)
    fitted = fit_motion(
        light,
        setup,
        start_m,
        noise,
        settings.target_size_m,
        settings.cells,
        depth=settings.depth,
        turning=settings.turning,
    )
    variance = np.einsum("nknk->nk", fitted.covariance)
    values = np.column_stack(
        [fitted.position_m, *(one for one in (fitted.log_distance, fitted.rotation_rad) if one is not None)]
    )
    rates: list = [None] * values.shape[1]
    if by_events is not None:
        where = np.stack(
            [np.interp(by_events.time_s, times_s, found.place_px[:, k]) for k in range(2)], axis=-1
        )
        slope = to_plane.slope(where)  # [M, 2, 2]
        velocity = np.einsum("mab,mb->ma", slope, by_events.velocity)
        rough = np.einsum("mab,mb->ma", slope**2, by_events.variance)
        rates[:2] = [(by_events.time_s, velocity[:, k], rough[:, k]) for k in range(2)]
    blank = np.full(len(times_s), np.nan)
    axes = [Measurements(times_s, *one, blank, blank) for one in zip(values.T, variance.T, strict=True)]
    speeds = [most_likely_acceleration(axes[:2])] * 2 + [most_likely_acceleration([one]) for one in axes[2:]]
    instants = _instants(times_s, by_events)
    by_frames = fitted.position_m, np.sqrt(variance[:, :2])
    mean, spread = smooth_together(times_s, values, fitted.covariance, rates, speeds, instants)
    track = _track(instants, mean, spread, "m", times_s, by_frames, found, by_events)
    at = np.searchsorted(instants, times_s)
    curves = [(mean[at, 0, k], spread[at, 0, k], mean[at, 1, k], spread[at, 1, k]) for k in range(len(axes))]
    distance = turn = None
    if fitted.log_distance is not None:
        log, log_sigma, rate, rate_sigma = curves[2]
        away = (setup.default_distance_m or 1.0) * np.exp(log)
        distance = Distance(times_s, away, away * log_sigma, away * rate, away * rate_sigma)
    if fitted.rotation_rad is not None:
        turn = Turn(times_s, *(np.degrees(one) for one in curves[-1]))
    return replace(track, distance=distance, turn=turn, misfit=fitted.misfit)


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
    found: Registration,
    by_events: EventVelocity | None,
) -> Track:
    """Return the track of smoothed values and rates [T, 2, K] of x and y, beside what frames alone say."""
    return Track(
        instants,
        mean[:, 0, :2],
        mean[:, 1, :2],
        spread[:, 0, :2],
        spread[:, 1, :2],
        unit,
        times_s,
        *by_frames,
        found.size,
        found.size * np.sqrt(found.covariance[:, 2, 2]),
        0 if by_events is None else len(by_events.time_s),
    )
