"""A pixel whose voltage is a drifting Brownian motion: the equation of DVS-Voltmeter, sampled exactly.

With L(t) the light in DN, x the log light since the last event, and W a Brownian motion,

    dx = d ln(L + k) + theta_on (r + s L) dt + (a sqrt(L) / (L + k) + b) dW,
    ON at x = theta_on, OFF at x = -theta_off, then x = 0

(Lin, Ma, Guo and Wen, "DVS-Voltmeter: Stochastic Process-based Event Simulator for Dynamic Vision Sensors",
ECCV 2022, where x is counted in thresholds). Between two instants of the light, L is taken at their mean in all
but the first term; x is then a Brownian motion with constant drift, and nothing depends on how a stretch of
constant light is cut into frames. The published code draws from another law (its spread depends on the frame
distance); this module draws from the equation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import ConfigError
from evnlos.sensor._brownian import Law, State, run_tiles, settled
from evnlos.sensor._order import Columns, joined, sort_times
from evnlos.sensor._tiles import check_tiling, map_shares, pixel_thresholds
from evnlos.sensor.event_model import (
    EVENT_MODELS,
    EventModel,
    LogCurve,
    Phase,
    ThresholdPixel,
    check_pattern_seed,
    check_phase,
    require,
)
from evnlos.sensor.light import Light

_SAFE = 8.0
"""Standard deviations from a threshold at which a pixel cannot have met it: chance below 2e-15."""
_STRIDE = 0.2
"""Standard deviation of a sub-step of the walk, in thresholds: rarely more than one barrier is near."""


@EVENT_MODELS.register
@dataclass(frozen=True)
class BrownianPixel(ThresholdPixel):
    """A pixel with noise that grows in dim light and leak that grows with light; defaults are a DAVIS346's.

    Times of events jitter the more, the slower the light changes. The model has no bandwidth, no refractory
    period and no memory in its noise: with the default numbers noise does little but jitter the leak, and it is
    no model of the noise of a dim pixel.

    Args:
        threshold_on: Mean contrast threshold of ON events, log units (e-fold), at least 0.01; 1/k1.
        threshold_off: The same for OFF events.
        threshold_sigma: Standard deviation of both thresholds over the pixels, log units; 0 = none.
        dark_dn: Offset k of the logarithm, DN, more than 0; k2.
        leak_rate_hz: Rate r of the leak's ON events in the dark, hertz a pixel; k4.
        leak_rate_per_dn_hz: What each DN of light adds to that rate, hertz per DN; k5.
        photon_noise: Strength a of the noise of the light, log units times sqrt(DN / s); k3/k1.
        dark_noise: Strength b of the noise in the dark, log units per sqrt(s); k6/k1.
        exposure: DN of the pixel per DN of the light that it is fed, more than 0.
        initial_phase: "random" = each pixel in a state of long constant light, "rest" = just after an event.
        increments: What the first term of the equation is between two instants: "log" = the change of
            ln(L + k), so that a change of light counts alike however it is cut; "linear" = that of L over the
            mean of L + k, as in the publication.
        pattern_seed: Seed of the thresholds: one sensor for all recordings; None = a new one for each.

    Raises:
        ConfigError: A value outside its range.

    Example:
        >>> round(BrownianPixel.voltmeter(5.265, 20, 1e-4, 1e-7, 5e-9, 1e-5).threshold_on, 4)
        0.1899
    """

    threshold_on: float = 0.18993
    """Mean contrast threshold of ON events, log units (e-fold)."""
    threshold_off: float = 0.18993
    """Mean contrast threshold of OFF events, log units (e-fold)."""
    threshold_sigma: float = 0.0
    """Standard deviation of both thresholds over the pixels, log units; 0 = none."""
    dark_dn: float = 20.0
    """Offset of the logarithm, DN."""
    leak_rate_hz: float = 0.1
    """Rate of the leak's ON events in the dark, hertz a pixel."""
    leak_rate_per_dn_hz: float = 0.005
    """What each DN of light adds to the leak's rate, hertz per DN."""
    photon_noise: float = 0.018993
    """Strength of the noise of the light, log units times sqrt(DN / s)."""
    dark_noise: float = 0.0018993
    """Strength of the noise in the dark, log units per sqrt(s)."""
    exposure: float = 1.0
    """DN of the pixel per DN of the light that it is fed."""
    initial_phase: Phase = "random"
    """State before the first frame: random = that of long constant light, rest = just after an event."""
    increments: Literal["log", "linear"] = "log"
    """Change of ln(L + k), or of L over the mean of L + k as in the publication."""
    pattern_seed: int | None = None
    """Seed of the thresholds: one sensor for all recordings; None = a new one for each."""
    kind: Literal["brownian"] = "brownian"
    """The event model."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("dark_dn", "exposure"):
            require(self, name, 1e-6, 1e9, "(DN, or DN per DN)")
        for name in ("leak_rate_hz", "leak_rate_per_dn_hz"):
            require(self, name, 0.0, math.inf, "hertz; 0 switches it off")
        for name in ("photon_noise", "dark_noise"):
            require(self, name, 0.0, math.inf, "log units per sqrt(s); 0 switches it off")
        check_phase(self.initial_phase)
        if self.increments not in ("log", "linear"):
            raise ConfigError(f'increments is {self.increments!r}; give "log" or "linear"')
        check_pattern_seed(self.pattern_seed)

    @classmethod
    def voltmeter(cls, k1: float, k2: float, k3: float, k4: float, k5: float, k6: float) -> BrownianPixel:
        """Return the pixel with parameters as DVS-Voltmeter states them, in thresholds, DN and microseconds.

        Args:
            k1: Thresholds per log unit.
            k2: Offset, DN.
            k3: Noise of the light, thresholds times sqrt(DN / us).
            k4: Leak in the dark, thresholds per us.
            k5: Leak by light, thresholds per us and DN.
            k6: Noise in the dark, thresholds per sqrt(us).
        """
        return cls(1 / k1, 1 / k1, 0.0, k2, k4 * 1e6, k5 * 1e6, k3 * 1e3 / k1, k6 * 1e3 / k1)

    def model(
        self,
        shape: tuple[int, int],
        seed: int = 0,
        thresholds: object = None,
        *,
        tile_px: int | None = None,
        threads: int | None = None,
    ) -> EventModel:
        """Return an array of such pixels; arguments as in `PixelSettings.model`."""
        return BrownianArray(self, shape, seed, thresholds, 1024 if tile_px is None else tile_px, threads)

    @property
    def log_curve(self) -> LogCurve:
        """The logarithm of the light over the dark offset, which lies above the knee throughout."""
        factor = 40.0 / self.dark_dn
        return LogCurve(factor * self.exposure, 40.0)

    def drift_and_noise(self, light_dn: float) -> tuple[float, float]:
        """Return the drift by leak, log units per s, and the noise, log units per sqrt(s), in constant light.

        Args:
            light_dn: Light at the pixel, DN.
        """
        drift = self.threshold_on * (self.leak_rate_hz + self.leak_rate_per_dn_hz * light_dn)
        noise = self.photon_noise * math.sqrt(light_dn) / (light_dn + self.dark_dn) + self.dark_noise
        return drift, noise


class BrownianArray(EventModel):
    """An array of `BrownianPixel`s."""

    def __init__(
        self,
        pixel: BrownianPixel,
        shape: tuple[int, int],
        seed: int,
        thresholds: object = None,
        tile_px: int = 1024,
        threads: int | None = None,
    ) -> None:
        self.pixel = pixel
        self._tile_px, self._threads = check_tiling(tile_px, threads)
        self._on, self._off = pixel_thresholds(pixel, shape, seed, thresholds)
        self._law = Law(
            dark=float(pixel.dark_dn),
            leak=float(pixel.threshold_on * pixel.leak_rate_hz),
            leak_light=float(pixel.threshold_on * pixel.leak_rate_per_dn_hz),
            photon=float(pixel.photon_noise),
            floor=float(pixel.dark_noise),
            exposure=float(pixel.exposure),
            linear=pixel.increments == "linear",
            seed=np.uint64(seed),
        )

    def start(self, frame: NDArray, time_s: float) -> None:
        """Let all pixels have seen the first light, DN [N], for long, or have just sent an event."""
        light = self.pixel.exposure * frame.astype(np.float64)
        count = len(light)
        mean = np.zeros(count)
        if self.pixel.initial_phase == "random":
            mean = settled(light, self._on, self._off, self._law)
        counters = np.zeros(count, np.uint32), np.zeros(count, np.uint32)
        self._state = State(light, mean, mean.copy(), mean.copy(), np.zeros(count), *counters)
        self._time = time_s

    def advance(self, light: Light, times_s: NDArray[np.float64]) -> Columns:
        """Take the next light at `times_s` [T] and return the events in order."""
        times = np.concatenate([[self._time], times_s])

        def work(first: int, last: int) -> Columns:
            frames, origin = light.pixels(first, last)
            return run_tiles(
                frames, origin, times, first, last, self._tile_px, self._state, self._on, self._off, self._law
            )

        count = len(self._state.light)
        tiles = list(map_shares(work, count, self._tile_px, self._threads, light.most_px))
        self._time = float(times_s[-1])
        return sort_times(*joined(tiles))
