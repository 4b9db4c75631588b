"""The frame camera's noise, from what is left of the frames when the fitted light is taken off."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from evnlos.calibration.captures import Shots
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
        pattern: Mean residual of each pixel, white levels, float64 [H, W]: fixed pattern and misfit.
    """

    camera: FrameCamera
    temporal: float
    pattern: NDArray[np.float64]


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
    return FrameNoise(camera, temporal / peak, residual.mean(axis=0) / peak)


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
