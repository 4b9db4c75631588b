"""The frame camera's noise, from what is left of the frames when the fitted light is taken off."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evnlos.calibration.captures import Shots
from evnlos.dataset.fixed_pattern import FixedPattern
from evnlos.sensor import FrameCamera

_BINS = 24
_LARGEST_WELL_E = 1e6
_OPEN = 0.9  # share of the largest number above which noise may be clipped


@dataclass(frozen=True)
class FrameNoise:
    """What the residual says about the frame camera.

    Args:
        camera: The frame camera that makes this noise.
        temporal: Standard deviation of the noise that changes from frame to frame, white levels.
        pattern: Sensitivity and offset of each pixel, the most probable ones.
        remaining: Standard deviations of sensitivity (fraction) and offset (electrons) that stay after
            correction by the pattern.
    """

    camera: FrameCamera
    temporal: float
    pattern: FixedPattern
    remaining: tuple[float, float]


def fit_frame_noise(shots: Shots, model: NDArray, start: FrameCamera) -> FrameNoise:
    """Fit full well, read noise and fixed pattern to the residual of the frames.

    The variance of the temporal noise is a line over the signal (photon transfer, EMVA 1288): its slope is the
    digital number an electron makes, its intercept read noise and rounding. The noise comes from second
    differences of the residual in time, the pattern from second differences over the sensor, so that a smooth
    misfit of the model takes no part. The black level is taken as 0: frames cannot tell it from ambient light.

    Args:
        shots: The captures.
        model: Predicted frames, white levels, [N, H, W], in the order of `shots.frames()`.
        start: Camera whose other settings are kept.
    """
    peak = float(shots.peak)
    frames = shots.frames().astype(np.float64)
    signal = model.astype(np.float64) * peak
    residual = frames - signal
    mean_signal = signal.mean(axis=0)
    swing = signal - mean_signal
    power = np.maximum((swing**2).sum(axis=0), 1e-9)
    tilt = (swing * residual).sum(axis=0) / power  # a of residual = a signal + b, for each pixel
    noise, level = _temporal(residual - tilt * swing, signal, shots.frame_of())
    open_ = level < _OPEN * peak
    noise, level = noise[open_], level[open_]
    slope, floor = _photon_transfer(noise, level)
    full_well = min(_LARGEST_WELL_E, peak / slope) if slope > 0 else _LARGEST_WELL_E
    dn_per_e = peak / full_well
    read_e = math.sqrt(max(floor - 1 / 12, 0.0)) / dn_per_e
    temporal = float(np.sqrt(np.mean(noise**2)))
    prnu, dsnu = _fixed_pattern(residual.mean(axis=0), mean_signal, tilt, power, temporal**2, len(frames))
    exposure = shots.captures[0].info.camera.exposure_s
    camera = replace(
        start,
        exposure_s=start.exposure_s if exposure is None else exposure,
        full_well_e=full_well,
        read_noise_e=read_e,
        prnu=prnu,
        dsnu_e=dsnu / dn_per_e,
        bit_depth=int(peak + 1).bit_length() - 1,
        gain=1.0,
        black_level=0.0,
    )
    pattern, (left, offset_left) = most_probable_pattern(residual, signal, temporal, prnu, dsnu, peak)
    return FrameNoise(camera, temporal / peak, pattern, (left, offset_left / dn_per_e))


def most_probable_pattern(
    residual: NDArray, signal: NDArray, temporal: float, prnu: float, dsnu: float, peak: float
) -> tuple[FixedPattern, tuple[float, float]]:
    """Return each pixel's sensitivity and offset, given the frames and how far the pixels spread.

    residual_k = g signal_k + h + noise_k over the frames k, with normal g, h and noise: a linear regression
    with priors for each pixel, two equations for (g, h).

    Args:
        residual: Camera minus model, DN [N, H, W].
        signal: The model, DN [N, H, W].
        temporal: Standard deviation of the noise, DN.
        prnu: Standard deviation of g.
        dsnu: Standard deviation of h, DN.
        peak: Largest digital number.

    Returns:
        The pattern, and the root mean squares of what stays unknown: of g, over the light's swing, and of
        g signal + h at a pixel's mean signal, DN.
    """
    s0, s1, s2 = len(signal), signal.sum(axis=0), (signal**2).sum(axis=0)
    r0, r1 = residual.sum(axis=0), (residual * signal).sum(axis=0)
    # In units of 1 / temporal^2; a spread of 0 leaves nothing to find.
    a = s2 + (temporal / max(prnu, 1e-9)) ** 2
    d = s0 + (temporal / max(dsnu, 1e-9)) ** 2
    determinant = a * d - s1**2
    g, h = (d * r1 - s1 * r0) / determinant, (a * r0 - s1 * r1) / determinant
    pattern = FixedPattern((1 + g).astype(np.float32), (h / peak).astype(np.float32))
    # The error at light s is e_mean + e_g (s - mean): what is left of g counts where the light swings.
    mean, swing = s1 / s0, np.maximum(s2 - s1**2 / s0, 1e-12)
    left_g = float(np.average(d / determinant, weights=swing))
    left_mean = float(np.mean((a - 2 * mean * s1 + mean**2 * d) / determinant))
    return pattern, (min(prnu, temporal * math.sqrt(left_g)), min(dsnu, temporal * math.sqrt(left_mean)))


def _temporal(residual: NDArray, signal: NDArray, capture: NDArray) -> tuple[NDArray, NDArray]:
    """Return samples of the temporal noise and the signal there: second differences within each capture."""
    inside = (capture[2:] == capture[:-2])[:, None, None]
    noise = (residual[2:] - 2 * residual[1:-1] + residual[:-2]) / math.sqrt(6)
    level = (signal[2:] + 4 * signal[1:-1] + signal[:-2]) / 6  # weights of the variances
    chosen = np.broadcast_to(inside, noise.shape)
    return noise[chosen], level[chosen]


def _photon_transfer(noise: NDArray, level: NDArray) -> tuple[float, float]:
    """Return slope (DN) and intercept (DN^2) of the noise's variance over the signal."""
    order = np.argsort(level, kind="stable")
    parts = np.array_split(order, _BINS)
    x = np.array([level[part].mean() for part in parts])
    y = np.array([np.mean(noise[part] ** 2) for part in parts])
    # A variance's own error grows with it: equal relative weights.
    slope, floor = np.polyfit(x, y, 1, w=1 / np.maximum(y, 1e-6))
    return float(slope), float(floor)


def _fixed_pattern(
    residual: NDArray, signal: NDArray, tilt: NDArray, power: NDArray, variance: float, frames: int
) -> tuple[float, float]:
    """Return the standard deviations of sensitivity (fraction) and offset (DN) over the pixels.

    Args:
        residual: Mean residual of each pixel, DN.
        signal: Mean signal of each pixel, DN.
        tilt: Slope of the residual over the signal, for each pixel.
        power: Sum of the squares of the signal's swing, DN^2.
        variance: Variance of the temporal noise, DN^2.
        frames: Number of frames behind the means.
    """
    sure = power >= np.quantile(power, 0.8)
    prnu2 = max(0.0, float(np.mean((local_square(tilt) - variance / power)[sure])))
    dim = power <= np.quantile(power, 0.5)
    offset2 = local_square(residual) - variance / frames - prnu2 * signal**2
    return math.sqrt(prnu2), math.sqrt(max(0.0, float(np.mean(offset2[dim]))))


def local_square(image: NDArray) -> NDArray[np.float64]:
    """Return the square of an image's difference from its neighbours, scaled to a white image's variance.

    Args:
        image: Real [H, W], at least 3 x 3.

    Example:
        >>> float(local_square(np.arange(25.0).reshape(5, 5)).max())
        0.0
    """
    padded = np.pad(np.asarray(image, dtype=np.float64), 1, mode="reflect", reflect_type="odd")
    around = padded[1:-1, :-2] + padded[1:-1, 2:] + padded[:-2, 1:-1] + padded[2:, 1:-1]
    return (2 * padded[1:-1, 1:-1] - around / 2) ** 2 / 5
