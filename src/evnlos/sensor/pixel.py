"""The parameters of one event pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass

from evnlos.errors import ConfigError

MIN_THRESHOLD = 0.01
"""Smallest threshold that mismatch can leave a pixel with, log units."""


@dataclass(frozen=True)
class EventPixel:
    """Parameters of a logarithmic change-detecting pixel; the defaults are the paper's table of settings.

    The pixel takes the logarithm of the light (linear below 20 DN), smooths it with a low-pass filter whose
    bandwidth grows with the light, and sends an event whenever the result has moved by a threshold since the
    last event (Hu, Liu and Delbruck, "v2e: From Video Frames to Realistic DVS Events", CVPRW 2021).

    Args:
        threshold_on: Mean contrast threshold of ON events, log units (e-fold), at least 0.01.
        threshold_off: Mean contrast threshold of OFF events, log units (e-fold), at least 0.01.
        threshold_sigma: Standard deviation of both thresholds over the pixels, log units; 0 = none.
        cutoff_hz: Corner frequency of the low-pass filter at white (255 DN), hertz; 0 = no filter. At black
            it is 20/275 of this.
        leak_rate_hz: Rate of the ON events that the leaking reference makes, events a second a pixel.
        shot_noise_rate_hz: Rate of noise events, ON and OFF together, of a pixel in the dark limit, hertz.
        refractory_s: Time after an event in which a pixel cannot send another one, seconds.
        hot_pixel_fraction: Fraction of pixels that fire without cause, 0 to 1 (`mode="exact"` only).
        hot_pixel_rate_hz: Rate of events of a hot pixel, ON and OFF together, hertz (`mode="exact"` only).
        jitter_s: Standard deviation of the time stamps, seconds (`mode="exact"` only).

    Raises:
        ConfigError: A value outside its range.

    Example:
        >>> EventPixel(threshold_on=0.2).threshold_on
        0.2
    """

    threshold_on: float = 0.15
    """Mean contrast threshold of ON events, log units (e-fold)."""
    threshold_off: float = 0.15
    """Mean contrast threshold of OFF events, log units (e-fold)."""
    threshold_sigma: float = 0.03
    """Standard deviation of both thresholds over the pixels, log units; 0 = none."""
    cutoff_hz: float = 15.0
    """Corner frequency of the low-pass filter at white, hertz; 0 = no filter."""
    leak_rate_hz: float = 0.01
    """Rate of ON events from the leaking reference, hertz a pixel."""
    shot_noise_rate_hz: float = 0.0015
    """Rate of noise events in the dark limit, ON and OFF together, hertz a pixel."""
    refractory_s: float = 0.0
    """Dead time of a pixel after each of its events, seconds."""
    hot_pixel_fraction: float = 0.0
    """Fraction of pixels that fire without cause, 0 to 1 (mode "exact" only)."""
    hot_pixel_rate_hz: float = 10.0
    """Rate of events of a hot pixel, hertz (mode "exact" only)."""
    jitter_s: float = 0.0
    """Standard deviation of the time stamps, seconds (mode "exact" only)."""

    def __post_init__(self) -> None:
        for name in ("threshold_on", "threshold_off"):
            _require(name, getattr(self, name), MIN_THRESHOLD, math.inf, "log units; the paper's value is 0.15")
        for name in ("threshold_sigma",):
            _require(
                name, getattr(self, name), 0.0, math.inf, "log units; 0 gives every pixel the same threshold"
            )
        for name in ("cutoff_hz", "leak_rate_hz", "shot_noise_rate_hz", "hot_pixel_rate_hz"):
            _require(name, getattr(self, name), 0.0, math.inf, "hertz; 0 switches it off")
        for name in ("refractory_s", "jitter_s"):
            _require(name, getattr(self, name), 0.0, math.inf, "seconds; 0 switches it off")
        _require("hot_pixel_fraction", self.hot_pixel_fraction, 0.0, 1.0, "a fraction; 0 switches it off")


def _require(name: str, value: object, low: float, high: float, unit: str) -> None:
    """Refuse a setting that is not a finite number in [low, high]."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ConfigError(f"EventPixel.{name} is {value!r}; give a number in {unit}")
    if not (math.isfinite(value) and low <= value <= high):
        limit = f"at least {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"
        raise ConfigError(f"EventPixel.{name} is {value:g}; give {limit} {unit}")
