"""Tracks: a smoother over positions and velocities, and its result.

- A Kalman smoother that fuses positions and velocities, and finds by itself how much the motion may change.
- A track: where the hidden object was at any time of a recording, how fast it went, and how sure that is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from evnlos.data.capture import Capture
from evnlos.errors import DataError
from evnlos.scene import PathMotion, Scene
from evnlos.setups import Setup

_LIKELY = np.logspace(-3, 3, 25)  # of (spread of the positions / duration^1.5)^2
_WIDE = 1e3  # the first guess's standard deviation over the spread of the positions


@dataclass(frozen=True, eq=False)
class Measurements:
    """One coordinate, measured at ascending instants: its value, its rate, or both.

    Args:
        time_s: Instants, [T], seconds.
        position: Values [T]; NaN where none was measured.
        position_variance: Their variances [T].
        velocity: Rates [T], a second; NaN where none was measured.
        velocity_variance: Their variances [T].
    """

    time_s: NDArray[np.float64]
    position: NDArray[np.float64]
    position_variance: NDArray[np.float64]
    velocity: NDArray[np.float64]
    velocity_variance: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Means [T, 2] and covariances [T, 2, 2] of value and rate, and the logarithm of the likelihood."""

    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    log_likelihood: float


def smooth(measured: Measurements, acceleration: float) -> Smoothed:
    """Return value and rate given all measurements: Kalman (1960), and Rauch, Tung and Striebel (1965).

    The rate is a random walk: d rate = sqrt(acceleration) dW, so that
    Q(dt) = acceleration [[dt^3 / 3, dt^2 / 2], [dt^2 / 2, dt]].

    Args:
        measured: The measurements.
        acceleration: Spectral density of the acceleration, squared unit a cubic second, above 0.

    Raises:
        DataError: The instants do not ascend, or fewer than two values were measured.

    Example:
        >>> t = np.arange(3.0)
        >>> line = Measurements(t, 2 * t, np.full(3, 1e-4), np.full(3, np.nan), np.full(3, np.nan))
        >>> smooth(line, 1e-6).mean[1].round(3)
        array([2., 2.])
    """
    times, known = measured.time_s, np.isfinite(measured.position)
    if known.sum() < 2 or not (np.diff(times) > 0).all():
        raise DataError(
            f"{int(known.sum())} positions at {len(times)} instants; give two or more, in ascending order"
        )
    wide = (
        _WIDE
        * max(float(np.ptp(measured.position[known])), float(measured.position_variance[known].max()) ** 0.5)
    ) ** 2
    mean = np.array([measured.position[known][0], 0.0])
    covariance = np.diag([wide, wide / max(float(np.ptp(times)), 1e-12) ** 2])
    predicted, updated = [], []
    steps = np.concatenate([[0.0], np.diff(times)])
    score = 0.0
    for k, dt in enumerate(steps):
        move = np.array([[1.0, dt], [0.0, 1.0]])
        grown = acceleration * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        mean, covariance = move @ mean, move @ covariance @ move.T + grown
        predicted.append((mean, covariance))
        pairs = (
            (0, measured.position[k], measured.position_variance[k]),
            (1, measured.velocity[k], measured.velocity_variance[k]),
        )
        for axis, value, variance in pairs:
            if np.isnan(value):
                continue
            spread = covariance[axis, axis] + variance
            surprise = value - mean[axis]
            gain = covariance[:, axis] / spread
            mean = mean + gain * surprise
            covariance = covariance - np.outer(gain, covariance[axis])
            covariance = (covariance + covariance.T) / 2
            score -= 0.5 * (surprise**2 / spread + np.log(2 * np.pi * spread))
        updated.append((mean, covariance))
    means, covariances = np.array([m for m, _ in updated]), np.array([c for _, c in updated])
    for k in range(len(times) - 2, -1, -1):
        dt = steps[k + 1]
        move = np.array([[1.0, dt], [0.0, 1.0]])
        ahead_mean, ahead = predicted[k + 1]
        back = np.linalg.solve(ahead, move @ updated[k][1]).T
        means[k] = updated[k][0] + back @ (means[k + 1] - ahead_mean)
        covariances[k] = updated[k][1] + back @ (covariances[k + 1] - ahead) @ back.T
    return Smoothed(means, covariances, float(score))


def most_likely_acceleration(axes: list[Measurements]) -> float:
    """Return the spectral density of the acceleration, one for all axes, that makes the measurements likeliest.

    Args:
        axes: The measurements of each coordinate.
    """
    spread = max(float(np.nanmax(one.position) - np.nanmin(one.position)) for one in axes)
    noise = max(float(np.sqrt(np.nanmedian(one.position_variance))) for one in axes)
    duration = max(float(np.ptp(one.time_s)) for one in axes)
    unit = max(spread, noise) ** 2 / duration**3
    scores = [sum(smooth(one, unit * factor).log_likelihood for one in axes) for factor in _LIKELY]
    return float(unit * _LIKELY[int(np.argmax(scores))])


def walk_covariance(
    t: NDArray[np.float64], is_rate: NDArray[np.bool_], acceleration: float
) -> NDArray[np.float64]:
    """Return the covariance of values and rates at instants t >= 0, both 0 at 0; the rate walks at random."""
    s, r = t[:, None], t[None, :]
    low = np.minimum(s, r)
    value = low**2 * (np.maximum(s, r) / 2 - low / 6)
    rate_value = low * r - low**2 / 2  # rate at s, value at r
    row, column = is_rate[:, None], is_rate[None, :]
    both = np.where(row, np.where(column, low, rate_value), np.where(column, rate_value.T, value))
    return acceleration * both


_KNOWN_DISTANCE, _KNOWN_TURN_DEG = 0.03, 5.0  # standard deviations up to which a pose counts as known
FEIGNED = {"frames": 0.1, "events": 2.0}
"""Change of the distance, share of it, that an error of the light, share of it, may make where there is none.

Captures of constant distance show 0.04 (frames) and 1.3 (events) at most."""


@dataclass(frozen=True, eq=False)
class Distance:
    """How far the object was from the wall, smoothed.

    Its mean is the setup's, which no sequence tells: a target that is nearer and one that is larger look alike.
    Deviations are those of the distance over its mean by the noise; what the setup gets wrong comes on top.

    Args:
        time_s: Instants of the frames, [N], seconds.
        distance_m: Distance, [N], metres.
        distance_sigma: Its standard deviation, [N], metres.
        retreat_m_s: Speed away from the wall, [N], metres per second; below 0 the object approaches.
        retreat_sigma: Its standard deviation, [N].
        feigned_m: Change, rms, that errors of the setup may make of a constant distance, metres.
    """

    time_s: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    distance_sigma: NDArray[np.float64]
    retreat_m_s: NDArray[np.float64]
    retreat_sigma: NDArray[np.float64]
    feigned_m: float = 0.0

    @property
    def is_identified(self) -> bool:
        """Whether the distance is known within 3 %, and changes by more than its error and the setup's."""
        known = float((self.distance_sigma / self.distance_m).mean()) < _KNOWN_DISTANCE
        return known and float(self.distance_m.std()) > float(self.distance_sigma.mean()) + self.feigned_m

    def true_m(self, scene: Scene) -> NDArray[np.float64]:
        """Return the true distance, [N], metres; of a scene at the setup's own distance that of this mean."""
        return np.nan_to_num(scene.pose(self.time_s).z_m, nan=float(self.distance_m.mean()))


@dataclass(frozen=True, eq=False)
class Turn:
    """How the object turned about the wall's normal, smoothed; its mean is 0, as nobody knows which way is up.

    Args:
        time_s: Instants of the frames, [N], seconds.
        rotation_deg: Turn, clockwise as the camera's rows and columns run, [N], degrees.
        rotation_sigma: Its standard deviation, [N], degrees.
        spin_deg_s: Rate, [N], degrees per second.
        spin_sigma: Its standard deviation, [N].
    """

    time_s: NDArray[np.float64]
    rotation_deg: NDArray[np.float64]
    rotation_sigma: NDArray[np.float64]
    spin_deg_s: NDArray[np.float64]
    spin_sigma: NDArray[np.float64]

    @property
    def is_identified(self) -> bool:
        """Whether the turn is known within 5 degrees: that of a round target never is."""
        return float(self.rotation_sigma.mean()) < _KNOWN_TURN_DEG

    def true_deg(self, scene: Scene) -> NDArray[np.float64]:
        """Return the true turn about its mean, [N], degrees."""
        turn = np.degrees(scene.pose(self.time_s).rotation_rad)
        return turn - turn.mean()


@dataclass(frozen=True, eq=False)
class Track:
    """Position and velocity over time, from a smoother, with their standard deviations.

    The position is that of the middle of the object's light; which point of the target that is, only the
    object's shape could tell. In pixels the origin is its mean over the frames, as an image has no other.

    Args:
        time_s: Instants, float64 [T], seconds, ascending.
        position: (x, y), float64 [T, 2], in `unit`.
        velocity: (x, y), float64 [T, 2], `unit` a second.
        position_sigma: Standard deviation of each coordinate, [T, 2].
        velocity_sigma: Standard deviation of each component, [T, 2].
        unit: "m" on the target's plane where the setup is known, else "px" on the sensor.
        frame_time_s: Instants of the frames, [N], seconds.
        frame_position: What the frames alone say, [N, 2], in `unit`.
        frame_sigma: Its standard deviation, [N, 2].
        size: Size of the object's image in each frame over its mean size, [N]; it falls as the object moves
            away from the wall. NaN where several objects were followed.
        size_sigma: Standard deviation of the size, [N].
        event_windows: Number of velocities that came from events.
        distance: Distance from the wall, where it was looked for.
        turn: Turn about the wall's normal, where it was looked for.
        misfit: With a setup: what it leaves of the frames' changes over their noise, rms; deviations hold it.
        image: Likewise, one object's brightness at its mean distance and turn, as in `Tracks`, float64 [n, n].
        size_m: Side of the image, metres.
        events: Number of events where they alone were followed; frame_... are then of the path's knots.
    """

    time_s: NDArray[np.float64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    position_sigma: NDArray[np.float64]
    velocity_sigma: NDArray[np.float64]
    unit: Literal["m", "px"]
    frame_time_s: NDArray[np.float64]
    frame_position: NDArray[np.float64]
    frame_sigma: NDArray[np.float64]
    size: NDArray[np.float64]
    size_sigma: NDArray[np.float64]
    event_windows: int
    distance: Distance | None = None
    turn: Turn | None = None
    misfit: float | None = None
    image: NDArray[np.float64] | None = None
    size_m: float = 0.0
    events: int = 0

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def speed(self) -> NDArray[np.float64]:
        """Speed, [T], `unit` a second."""
        return np.hypot(self.velocity[:, 0], self.velocity[:, 1])

    @property
    def speed_sigma(self) -> NDArray[np.float64]:
        """Standard deviation of the velocity's component along itself, [T]."""
        along = self.velocity / np.maximum(self.speed, 1e-300)[:, None]
        return np.sqrt(np.square(along * self.velocity_sigma).sum(axis=1)) + (self.speed == 0) * np.hypot(
            self.velocity_sigma[:, 0], self.velocity_sigma[:, 1]
        )

    @property
    def direction_deg(self) -> NDArray[np.float64]:
        """Direction of the velocity, [T], degrees from x (right) towards y (down); meaningless at rest."""
        return np.degrees(np.arctan2(self.velocity[:, 1], self.velocity[:, 0]))

    @property
    def motion(self) -> PathMotion:
        """The path through the positions, in `unit`, upright at the setup's own distance."""
        return PathMotion(tuple(self.time_s.tolist()), tuple((x, y) for x, y in self.position.tolist()))

    def errors(self, scene: Scene) -> dict[str, Any]:
        """Return how far a track in metres is from the truth: rms about the mean error, which is the offset.

        Args:
            scene: The target and its motion.
        """
        true = scene.light_m(self.time_s)
        error = self.position - true
        speed = np.linalg.norm(np.gradient(true, self.time_s, axis=0), axis=1)
        slow = np.sqrt(np.mean(np.square(self.speed - speed)) / np.mean(np.square(speed)))
        found = {"position_offset": error.mean(axis=0).tolist(), "speed_error_percent": float(100 * slow)}
        found["position_error"] = float(np.sqrt(np.square(error - error.mean(axis=0)).sum(axis=1).mean()))
        if self.distance is not None:
            found["distance_error"] = float(np.std(self.distance.distance_m - self.distance.true_m(scene)))
        if self.turn is not None:
            found["turn_error_deg"] = float(np.std(self.turn.rotation_deg - self.turn.true_deg(scene)))
        return found

    def summary(self) -> dict[str, Any]:
        """Return everything as plain lists and numbers, for JSON."""
        courses = "time_s position velocity position_sigma velocity_sigma speed speed_sigma direction_deg"
        names = f"{courses} frame_time_s frame_position frame_sigma size size_sigma".split()
        arrays = {name: np.round(getattr(self, name), 7).tolist() for name in names}
        if np.isnan(self.size).any():
            arrays = {name: values for name, values in arrays.items() if not name.startswith("size")}
        found = {"unit": self.unit, "event_windows": self.event_windows, **arrays}
        if self.misfit is not None:
            found["misfit"] = round(self.misfit, 3)
        for name, part in {"distance": self.distance, "turn": self.turn}.items():
            if part is not None:
                found[name] = {key: np.round(values, 7).tolist() for key, values in vars(part).items()}
        return found


_MARGIN, _STRIP, _CORNERS = 0.3, 0.4, 0.21  # around places, of a step, of a turn's corners: sides of a target


def strip_corners(places_m: NDArray[np.float64], size_m: float, turning: bool) -> NDArray[np.float64]:
    """Return the corners [2, 2] of all that a target of a side near places [N, 2] may cover, metres."""
    margin, step = (_MARGIN + _CORNERS * turning) * size_m, _STRIP * size_m
    low, high = places_m.min(axis=0) - margin, places_m.max(axis=0) + margin
    return np.stack([np.floor(low / step), np.ceil(high / step)]) * step  # recordings alike share matrices


def straightened(
    step: NDArray[np.float64], covariance: NDArray[np.float64], pose: NDArray[np.float64], bend: float
) -> NDArray[np.float64]:
    """Return the step [N, K] to poses whose second differences are small too: one update of a Kalman filter."""
    count, kinds = step.shape
    bends = np.kron(np.diff(np.eye(count), n=2, axis=0), np.eye(kinds))
    flat = covariance.reshape(count * kinds, -1)
    gain = flat @ bends.T @ np.linalg.inv(bends @ flat @ bends.T + bend**2 * np.eye(len(bends)))
    return step - (gain @ (bends @ (pose + step).ravel())).reshape(step.shape)


@dataclass(frozen=True, eq=False)
class Tracks:
    """Paths and images of several hidden objects, followed at once.

    Args:
        tracks: The path of each.
        images: Each one's brightness, its light's middle in the array's middle, float64 [K, n, n].
        size_m: Side of an image, metres.
        gains: Where the number was looked for: ln of the evidence of 1, 2, ... objects over that of one less
            and the setup's own error; the last is that of one more than were found, or of the most.
    """

    tracks: tuple[Track, ...]
    images: NDArray[np.float64]
    size_m: float
    gains: tuple[float, ...] = ()


_SAME_DISTANCE = 0.03  # share by which a capture's stated distance may differ from its setup's
_MOST_MISFIT = 1.2  # times the noise: calibrated setups leave 0.95 to 1.05 of captures of their own


def track_warnings(capture: Capture, setup: Setup | None, track: Track) -> list[str]:
    """Return why a track in metres may be wrong by more than it states, a line each; none where nothing is odd.

    Args:
        capture: The recording.
        setup: The setup that it was followed with; None: nothing is known.
        track: What was found.
    """
    warnings = []
    stated, motion = capture.distance_m, capture.motion
    if stated is not None and motion is not None:  # of the start; the setup's is the mean
        stated += motion.retreat_m_s * (float(np.mean(capture.frame_times_us)) * 1e-6 - motion.start_s)
    known_m = None if setup is None else setup.default_distance_m
    if known_m is not None and stated is not None and abs(stated / known_m - 1) > _SAME_DISTANCE:
        warnings.append(
            f"capture.yaml states a distance of {stated:g} m, the setup {known_m:g} m, more than "
            f"{100 * _SAME_DISTANCE:.0f} % apart: lengths and their deviations are wrong; take the setup of "
            "that distance"
        )
    if track.misfit is not None and track.misfit > _MOST_MISFIT:
        warnings.append(
            f"the setup leaves {track.misfit:.2f} times the noise in the frames, {_MOST_MISFIT:g} is the most: "
            "positions are worse than their stated deviations; calibrate this very setup (`evnlos calibrate`)"
        )
    return warnings
