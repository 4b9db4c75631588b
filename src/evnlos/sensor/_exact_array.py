"""The array of continuous-time pixels: state, constants and noise processes of `mode="exact"`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from evnlos.sensor import _exact
from evnlos.sensor._exact_pass import log_row
from evnlos.sensor._exact_send import DIM_MAX
from evnlos.sensor._order import Columns, joined, sort_times
from evnlos.sensor._random import (
    STREAM_HOT,
    STREAM_LEAK_PHASE,
    STREAM_LEAK_RATE,
    STREAM_SHOT_GAP,
    exponential_field,
    normal_field,
    uniform_field,
)
from evnlos.sensor._tiles import check_tiling, map_shares, pattern_key, pixel_thresholds
from evnlos.sensor.event_model import EventModel
from evnlos.sensor.light import Light
from evnlos.sensor.pixel import EventPixel


class ExactArray(EventModel):
    """Pixels that see light which is linear in time between the frames; `advance` them frame by frame."""

    def __init__(
        self,
        pixel: EventPixel,
        shape: tuple[int, int],
        seed: int,
        thresholds: object = None,
        tile_px: int = 1024,
        threads: int | None = None,
    ) -> None:
        self.pixel, self.seed = pixel, np.uint64(seed)
        self._tile_px, self._threads = check_tiling(tile_px, threads)
        count = shape[0] * shape[1]
        self._on, self._off = pixel_thresholds(pixel, shape, seed, thresholds)
        self._leak = np.zeros(count)
        if pixel.leak_rate_hz > 0:
            factor = 10.0 ** (0.1 * normal_field(pattern_key(pixel, seed), STREAM_LEAK_RATE, count))
            self._leak = pixel.leak_rate_hz * factor * self._on
        half = 0.5 * pixel.shot_noise_rate_hz
        self._rate_on, self._rate_off = (
            half * pixel.threshold_on / self._on,
            half * pixel.threshold_off / self._off,
        )
        self._rate_hot = np.zeros(count)
        if pixel.hot_pixel_fraction > 0:
            hot = uniform_field(pattern_key(pixel, seed), STREAM_HOT, count) < pixel.hot_pixel_fraction
            self._rate_hot[hot] = pixel.hot_pixel_rate_hz
        self._curve = pixel.curve()
        white = 255.0 + pixel.cutoff_floor_dn
        self._rate = 2.0 * math.pi * pixel.cutoff_hz / white / self._curve.stretch
        self._last_event = np.full(count, -np.inf)
        self._sent = np.zeros(count, np.uint32)

    def start(self, frame: NDArray, time_s: float) -> None:
        """Let all pixels have settled to the first light, DN [N], with references in their first phase."""
        count = len(frame)
        self._light = self._curve.scale * frame.astype(np.float64) + self._curve.offset
        self._filtered = np.empty(count)
        log_row(self._light, self._filtered)
        self._base = self._filtered.copy()
        if self.pixel.initial_phase == "random":
            # each pixel has been leaking since its last event, at a time of its own
            self._base -= self._on * uniform_field(self.seed, STREAM_LEAK_PHASE, count)
        self._time, self._window = time_s, (time_s, math.inf)
        rate = (self._rate_on + self._rate_off) * DIM_MAX + self._rate_hot
        self._candidate = np.zeros(0)
        if rate.any():
            gap = exponential_field(self.seed, STREAM_SHOT_GAP, count)
            self._candidate = time_s + np.divide(gap, rate, out=np.full(count, np.inf), where=rate > 0)
        self._drawn = np.zeros(count, np.uint32)

    def advance(self, light: Light, times_s: NDArray[np.float64]) -> Columns:
        """Take the next light at `times_s` [T] and return the events in order."""
        times = np.concatenate([[self._time], times_s])

        def work(first: int, last: int) -> Columns:
            frames, origin = light.pixels(first, last)
            return _exact.run_tiles(
                frames, origin, times, first, last, self._tile_px, self._light, self._filtered, self._base,
                self._last_event, self._candidate, self._drawn, self._sent, self._on, self._off, self._leak,
                self._rate_on, self._rate_off, self._rate_hot, self._rate, self._curve, self.pixel.refractory_s,
                self.pixel.jitter_s, self._window, self.seed,
            )  # fmt: skip

        tiles = list(map_shares(work, len(self._light), self._tile_px, self._threads, light.most_px))
        self._time = float(times_s[-1])
        return sort_times(*joined(tiles))
