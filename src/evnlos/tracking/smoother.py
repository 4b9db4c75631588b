"""A Kalman smoother that fuses positions and velocities, and finds by itself how much the motion may change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import DataError

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
