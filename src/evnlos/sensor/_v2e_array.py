"""The array of frame-stepped pixels: state, constants and noise processes of `mode="v2e"`."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.sensor import _v2e
from evnlos.sensor._order import Columns, expand, sort_events
from evnlos.sensor._random import (
    STREAM_LEAK_RATE,
    STREAM_SHOT_GAP,
    exponential_field,
    jitter_table,
    normal_field,
)
from evnlos.sensor._tiles import check_tiling, map_shares, pattern_key, pixel_thresholds
from evnlos.sensor.event_model import EventModel
from evnlos.sensor.light import Light
from evnlos.sensor.pixel import V2ePixel

_DIM_MAX = 1.0 - 0.75 * 20.0 / 275.0


class V2eArray(EventModel):
    """Pixels that see the light at the instants of the frames only, as v2e does; `advance` them by frames."""

    def __init__(
        self,
        pixel: V2ePixel,
        shape: tuple[int, int],
        seed: int,
        thresholds: object = None,
        tile_px: int = 2048,
        threads: int | None = None,
    ) -> None:
        self.pixel, self.seed = pixel, np.uint64(seed)
        self._tile_px, self._threads = check_tiling(tile_px, threads)
        count = shape[0] * shape[1]
        on, off = pixel_thresholds(pixel, shape, seed, thresholds)
        # v2e keeps drawn thresholds in single precision and equal ones as a double
        self._step_on, self._step_off = on.astype(np.float32), off.astype(np.float32)
        if thresholds is not None or pixel.threshold_sigma > 0:
            on, off = self._step_on.astype(np.float64), self._step_off.astype(np.float64)
        self._state_type = np.float64 if pixel.cutoff_hz > 0 else np.float32
        self._on, self._off = on.astype(self._state_type), off.astype(self._state_type)
        self._ratio_on, self._ratio_off = pixel.threshold_on / on, pixel.threshold_off / off
        self._most = float((self._ratio_on + self._ratio_off).max())
        self._leak = np.zeros(0, np.float32)
        if pixel.leak_rate_hz > 0:
            factor = 10.0 ** (0.1 * normal_field(pattern_key(pixel, seed), STREAM_LEAK_RATE, count))
            self._leak = (factor * on).astype(np.float32)
        self._hazard = np.zeros(0)
        if pixel.shot_noise_rate_hz > 0:
            self._hazard = exponential_field(self.seed, STREAM_SHOT_GAP, count)
        self._drawn = np.zeros(len(self._hazard), np.uint32)
        self._hazard_sum = 0.0
        self._steps = 0
        self._last_event = np.full(count if pixel.refractory_s > 0 else 0, -pixel.refractory_s, np.float32)

    def start(self, frame: NDArray, time_s: float) -> None:
        """Set all pixels to rest at the first frame, [N] DN."""
        logs = np.empty(len(frame), np.float32)
        _v2e.log_row(frame, logs)
        self._lp, self._base = logs.astype(self._state_type), logs.astype(self._state_type)
        self._time = time_s

    def advance(self, light: Light, times_s: NDArray[np.float64]) -> Columns:
        """Take the next light at `times_s` [T] and return the events in order."""
        if self.pixel.refractory_s == 0:
            return self._advance(light, times_s)
        blocks = [self._advance(light[k : k + 1], times_s[k : k + 1]) for k in range(len(times_s))]
        return tuple(np.concatenate(column) for column in zip(*blocks, strict=True))  # type: ignore[return-value]

    def _advance(self, light: Light, times_s: NDArray[np.float64]) -> Columns:
        pixel, steps, count = self.pixel, len(times_s), len(self._lp)
        starts = np.concatenate([[self._time], times_s[:-1]])
        delta = times_s - starts
        if pixel.cutoff_hz > 0:
            rate = delta / (1.0 / (math.pi * 2.0 * pixel.cutoff_hz))
        else:
            rate = np.zeros(steps)
        table = np.empty(256 if light.dtype == np.uint8 else 0, np.float32)
        _v2e.log_row(np.arange(len(table)), table)
        chance = np.zeros((steps, 2))
        chance[:, 0] = 0.5 * pixel.shot_noise_rate_hz * delta
        chance[:, 1] = np.minimum(chance[:, 0] * self._most * _DIM_MAX, 1.0 - 1e-9)
        hazard_sum = np.cumsum(np.concatenate([[self._hazard_sum], -np.log1p(-chance[:, 1])]))
        defer = pixel.refractory_s > 0

        def work(first: int, last: int) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
            peak = np.zeros(steps, np.int32)
            frames, origin = light.pixels(first, last)
            records = _v2e.run_tiles(
                frames, origin, first, last, self._tile_px, self._lp, self._base, self._on, self._off,
                self._step_on, self._step_off,
                self._leak, self._hazard, self._drawn, table, rate, pixel.leak_rate_hz * delta,
                hazard_sum[1:], chance, self._ratio_on, self._ratio_off, jitter_table(), self.seed, self._steps,
                defer, peak,
            )  # fmt: skip
            return (*records, peak)

        tiles = list(map_shares(work, count, self._tile_px, self._threads, light.most_px))
        peak = np.max([tile[4] for tile in tiles], axis=0)
        sub_times = [instants_within(starts[k], delta[k], times_s[k], int(peak[k])) for k in range(steps)]
        self._time, self._steps = float(times_s[-1]), self._steps + steps
        self._hazard_sum = float(hazard_sum[-1])
        stamps = np.rint(np.concatenate(sub_times).astype(np.float64) * 1e6).astype(np.int64)
        stamps = np.maximum.accumulate(stamps)
        if defer:
            return self._settle(tiles, sub_times[0], float(delta[0]), stamps)
        first_bucket = np.concatenate([[0], np.cumsum([len(times) for times in sub_times])])
        total = sum(int(np.abs(tile[2]).sum()) + int(np.count_nonzero(tile[3])) for tile in tiles)
        bucket, where, on = np.empty(total, np.int64), np.empty(total, np.int32), np.empty(total, np.bool_)
        filled = 0
        for step, place, crossings, shot, _ in tiles:
            rest = slice(filled, None)
            filled += expand(
                step, place, crossings, shot, first_bucket, peak, bucket[rest], where[rest], on[rest]
            )
        return sort_events(bucket, where, on, stamps)

    def _settle(self, tiles: list, sub_times: NDArray[np.float32], delta: float, stamps: NDArray) -> Columns:
        """Send the events of one step through the refractory period."""
        active = self.pixel.refractory_s > delta / len(sub_times)
        period = np.float32(self.pixel.refractory_s if active else 0.0)
        step, place, crossings, shot = (np.concatenate([tile[n] for tile in tiles]) for n in range(4))
        bucket, where, on = _v2e.settle(
            step, place, crossings, shot, sub_times, period, self._last_event, self._base,
            self._step_on, self._step_off,
        )  # fmt: skip
        return sort_events(bucket, where, on, stamps)


def instants_within(start_s: float, delta_s: float, stop_s: float, peak: int) -> NDArray[np.float32]:
    """Return the time stamps of a step whose busiest pixel crossed `peak` thresholds, float32 [>= 1]."""
    if peak <= 1:
        return np.array([start_s + delta_s], np.float32)
    return torch.linspace(start_s + delta_s / peak, stop_s, peak, dtype=torch.float32).numpy()
