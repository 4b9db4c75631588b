"""The sensor of a rendered laboratory: drawn once a rig, from ranges that are not the training simulator's."""

from __future__ import annotations

SENSOR_SPREAD: dict[str, tuple[float, float]] = {
    "setup.pixel.threshold_on": (0.18, 0.28),
    "setup.pixel.threshold_off": (0.20, 0.30),
    "setup.pixel.threshold_sigma": (0.035, 0.06),
    "setup.pixel.cutoff_hz": (25.0, 90.0),
    "setup.pixel.leak_rate_hz": (0.02, 0.15),
    "setup.pixel.shot_noise_rate_hz": (0.03, 0.20),
    "setup.pixel.refractory_s": (2e-4, 1.5e-3),
    "setup.pixel.hot_pixel_fraction": (0.0, 4e-4),
    "setup.pixel.jitter_s": (2e-5, 2e-4),
    "setup.frame_camera.exposure_s": (0.012, 0.030),
    "setup.frame_camera.full_well_e": (6_000.0, 12_000.0),
    "setup.frame_camera.read_noise_e": (8.0, 16.0),
    "setup.frame_camera.prnu": (0.012, 0.025),
    "setup.frame_camera.dsnu_e": (5.0, 15.0),
}
"""Uniform ranges of a rig's sensor.

The training simulator has mismatch 0.03, leak 0.01 Hz, no dead time, no hot pixels, no jitter, 15,000
electrons, 6 electrons of read noise, 1 % and 3 electrons of fixed pattern, 10 ms of exposure. No range holds
these but that of the hot pixels, which begins there. Thresholds, bandwidth and shot noise, which it draws from
wide ranges itself, lie inside those.
"""
