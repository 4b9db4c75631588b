"""Arrays of pixels: thresholds, tiles and threads; the state of the continuous and of the frame-stepped pixel.

- What both pixel arrays share: thresholds per pixel, tiles, threads.
- The file of a sensor's measured thresholds.
- The array of continuous-time pixels: state, constants and noise processes of `mode="exact"`.
- The array of frame-stepped pixels: state, constants and noise processes of `mode="v2e"`.
"""

from __future__ import annotations

import math
import os
from abc import abstractmethod
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.cameras.event_model import MIN_THRESHOLD, EventModel, PixelMaps
from evnlos.cameras.pixel import EventPixel, V2ePixel
from evnlos.cameras.pixels import continuous, continuous_math, v2e
from evnlos.cameras.pixels.continuous import DIM_MAX
from evnlos.cameras.pixels.continuous_math import log_row
from evnlos.cameras.random_numbers import (
    BLOCK,
    STREAM_HOT,
    STREAM_LEAK_PHASE,
    STREAM_LEAK_RATE,
    STREAM_SHOT_GAP,
    STREAM_THRESHOLD_OFF,
    STREAM_THRESHOLD_ON,
    exponential_field,
    jitter_table,
    normal_field,
    uniform_field,
)
from evnlos.cameras.streams import Columns, Light, check_threshold_maps, expand, joined, sort_events, sort_times
from evnlos.errors import ConfigError, DataError
from evnlos.machine import cores
from evnlos.untrusted import NUMPY_ERRORS, check_memory, open_regular

_T = TypeVar("_T")
_SHARES = 8
PIXEL_MAPS_FILE = "pixel_maps.npz"
"""Name of the file of a sensor's thresholds, beside its pixel.yaml and in a calibrated setup's folder."""


class ContrastSettings(Protocol):
    """Settings of pixels with thresholds of their own."""

    @property
    def threshold_on(self) -> float:
        """Mean threshold of ON events, log units."""
        ...

    @property
    def threshold_off(self) -> float:
        """Mean threshold of OFF events, log units."""
        ...

    @property
    def threshold_sigma(self) -> float:
        """Standard deviation of both over the pixels, log units."""
        ...

    @property
    def pattern_seed(self) -> int | None:
        """Seed of the sensor; None = that of the recording."""
        ...


def pixel_thresholds(
    pixel: ContrastSettings, shape: tuple[int, int], seed: int, thresholds: object
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return each pixel's thresholds (on, off), float64 [H * W], log units: given, or drawn and clamped.

    Of measured ones what is not known is drawn: mean + error n, as without any it is threshold + mismatch n.
    """
    count = shape[0] * shape[1]
    if isinstance(thresholds, PixelMaps):
        check_threshold_maps((thresholds.on, thresholds.off), shape)
        law = (
            (thresholds.on.ravel(), thresholds.error_on.ravel()),
            (thresholds.off.ravel(), thresholds.error_off.ravel()),
        )
    elif thresholds is not None:
        on, off = check_threshold_maps(thresholds, shape)
        return on.ravel(), off.ravel()
    else:
        law = (pixel.threshold_on, pixel.threshold_sigma), (pixel.threshold_off, pixel.threshold_sigma)
    drawn = []
    for (mean, deviation), stream in zip(law, (STREAM_THRESHOLD_ON, STREAM_THRESHOLD_OFF), strict=True):
        field = np.full(count, mean, np.float64)
        if np.any(deviation):
            field += deviation * normal_field(pattern_key(pixel, seed), stream, count)
            np.maximum(field, MIN_THRESHOLD, out=field)
        drawn.append(field)
    return drawn[0], drawn[1]


def load_pixel_maps(word: str | Path) -> PixelMaps | None:
    """Return what was measured of each pixel of the sensor that a word stands for; None where nothing was.

    Args:
        word: A pixel's YAML file, as `--pixel` takes it, or a setup's, or the folder of either: the maps lie
            beside it, in `pixel_maps.npz`. The name of a preset stands for no sensor.

    Raises:
        DataError: The file of the maps is damaged, or holds something else.
    """
    folder = Path(word) if Path(word).is_dir() else Path(word).parent
    path = folder / PIXEL_MAPS_FILE
    if not (Path(word).is_dir() or Path(word).suffix in (".yaml", ".yml")) or not path.is_file():
        return None
    try:
        with open_regular(path) as opened, np.load(opened, allow_pickle=False) as file:
            sizes = [info.file_size for info in file.zip.infolist()]
            check_memory(2 * sum(sizes), f"{path}", "give that of a smaller sensor")
            numbers = [file[f"{kind}_{sign}"] for kind in ("threshold", "error") for sign in ("on", "off")]
            numbers, hot = [np.asarray(one, np.float64) for one in numbers], np.asarray(file["hot"], np.bool_)
        check_threshold_maps((numbers[0], numbers[1]), hot.shape)
        if hot.ndim != 2 or not all(one.shape == hot.shape and (one >= 0).all() for one in numbers):
            raise ValueError("its maps are not of one size, or negative")
    except (ConfigError, *NUMPY_ERRORS):
        cure = "give the one that `evnlos pixel fit` wrote, or take it out of the folder"
        raise DataError(f"{path} holds no thresholds of a sensor, or is damaged; {cure}") from None
    on, off, error_on, error_off = numbers
    return PixelMaps(on, off, error_on, error_off, hot)


def pattern_key(pixel: ContrastSettings, seed: int) -> np.uint64:
    """Return the seed of what belongs to the sensor: the pixel's own, or that of the recording."""
    return np.uint64(seed if pixel.pattern_seed is None else pixel.pattern_seed)


def check_tiling(tile_px: int, threads: int | None) -> tuple[int, int]:
    """Return the tile size rounded up to whole blocks of random numbers, and the number of threads."""
    if tile_px < 1:
        raise ConfigError(f"tile_px is {tile_px}; give at least 1 pixel")
    if threads is None:
        threads = min(torch.get_num_threads(), cores())
    if threads < 1:
        raise ConfigError(f"threads is {threads}; give at least 1, or None for torch's number")
    return -(-tile_px // BLOCK) * BLOCK, threads


def map_shares(
    work: Callable[[int, int], _T], count: int, tile_px: int, threads: int, most_px: int | None = None
) -> Iterator[_T]:
    """Yield work(first, last) for each share of whole tiles, in the order of the pixels.

    A share has at most `most_px` pixels, but at least one tile.
    """
    # a few shares a thread, so that a busy part of the image does not keep the others waiting
    tiles = -(-count // (tile_px * (1 if threads == 1 else _SHARES * threads)))
    if most_px is not None:
        tiles = min(tiles, max(1, most_px // tile_px))
    share = tiles * tile_px
    starts = range(0, count, share)
    each = map if threads == 1 or len(starts) == 1 else _pool(threads).map
    yield from each(lambda first: work(first, min(first + share, count)), starts)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Return threads that stay: to start them for each block of frames costs much of what they save."""
    return ThreadPoolExecutor(threads, thread_name_prefix="evnlos")


# A forked process has the pool's queue, but none of its threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)


class TiledArray(EventModel):
    """Pixels that run tile by tile; a derived class keeps `_state`, arrays of all pixels, and has `_run`."""

    _state: tuple
    _tile_px: int
    _threads: int
    _time: float

    @abstractmethod
    def _run(self, times: NDArray[np.float64]) -> Callable[..., Columns]:
        """Return what makes events of the frames at these instants, their first pixel, and a share's ends."""

    def advance(self, light: Light, times_s: NDArray[np.float64]) -> Columns:
        """Take the next light at `times_s` [T] and return the events in order."""
        run = self._run(np.concatenate([[self._time], times_s]))

        def work(first: int, last: int) -> Columns:
            return run(*light.pixels(first, last), first, last)

        tiles = list(map_shares(work, len(self._state[0]), self._tile_px, self._threads, light.most_px))
        self._time = float(times_s[-1])
        return sort_times(*joined(tiles))


class ExactArray(TiledArray):
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
        on, off = pixel_thresholds(pixel, shape, seed, thresholds)
        leak = np.zeros(count)
        if pixel.leak_rate_hz > 0:
            factor = 10.0 ** (0.1 * normal_field(pattern_key(pixel, seed), STREAM_LEAK_RATE, count))
            leak = pixel.leak_rate_hz * factor * on
        half = 0.5 * pixel.shot_noise_rate_hz
        rate_hot = np.zeros(count)
        if pixel.hot_pixel_fraction > 0:
            hot = uniform_field(pattern_key(pixel, seed), STREAM_HOT, count) < pixel.hot_pixel_fraction
            rate_hot[hot] = pixel.hot_pixel_rate_hz
        rates = half * pixel.threshold_on / on, half * pixel.threshold_off / off, rate_hot
        self._pixels = continuous_math.Pixels(on, off, leak, *rates)
        self._curve = pixel.curve()
        white = 255.0 + pixel.cutoff_floor_dn
        self._rate = 2.0 * math.pi * pixel.cutoff_hz / white / self._curve.stretch
        self._last_event = np.full(count, -np.inf)
        self._sent = np.zeros(count, np.uint32)

    def start(self, frame: NDArray, time_s: float) -> None:
        """Let all pixels have settled to the first light, DN [N], with references in their first phase."""
        count = len(frame)
        light = self._curve.scale * frame.astype(np.float64) + self._curve.offset
        filtered = np.empty(count)
        log_row(light, filtered)
        base = filtered.copy()
        if self.pixel.initial_phase == "random":
            # each pixel has been leaking since its last event, at a time of its own
            base -= self._pixels.on * uniform_field(self.seed, STREAM_LEAK_PHASE, count)
        rate = (self._pixels.rate_on + self._pixels.rate_off) * DIM_MAX + self._pixels.rate_hot
        candidate = np.zeros(0)
        if rate.any():
            gap = exponential_field(self.seed, STREAM_SHOT_GAP, count)
            candidate = time_s + np.divide(gap, rate, out=np.full(count, np.inf), where=rate > 0)
        drawn = np.zeros(count, np.uint32)
        self._state = continuous_math.State(
            light, filtered, base, self._last_event, candidate, drawn, self._sent
        )
        pixel = self.pixel
        self._law = continuous_math.Law(
            self._rate, self._curve, pixel.refractory_s, pixel.jitter_s, (time_s, math.inf), self.seed
        )
        self._time = time_s

    def _run(self, times: NDArray[np.float64]) -> Callable[..., Columns]:
        what = self._tile_px, self._state, self._pixels, self._law
        return lambda frames, origin, first, last: continuous.run_tiles(
            frames, origin, times, first, last, *what
        )


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
        step_on, step_off = on.astype(np.float32), off.astype(np.float32)
        if thresholds is not None or pixel.threshold_sigma > 0:
            on, off = step_on.astype(np.float64), step_off.astype(np.float64)
        self._state_type = np.float64 if pixel.cutoff_hz > 0 else np.float32
        leak = np.zeros(0, np.float32)
        if pixel.leak_rate_hz > 0:
            factor = 10.0 ** (0.1 * normal_field(pattern_key(pixel, seed), STREAM_LEAK_RATE, count))
            leak = (factor * on).astype(np.float32)
        ratio_on, ratio_off = pixel.threshold_on / on, pixel.threshold_off / off
        self._most = float((ratio_on + ratio_off).max())
        own_on, own_off = on.astype(self._state_type), off.astype(self._state_type)
        self._pixels = v2e.Pixels(own_on, own_off, step_on, step_off, leak, ratio_on, ratio_off)
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
        v2e.log_row(frame, logs)
        low_pass, base = logs.astype(self._state_type), logs.astype(self._state_type)
        self._state = v2e.State(low_pass, base, self._hazard, self._drawn)
        self._time = time_s

    def advance(self, light: Light, times_s: NDArray[np.float64]) -> Columns:
        """Take the next light at `times_s` [T] and return the events in order."""
        if self.pixel.refractory_s == 0:
            return self._advance(light, times_s)
        blocks = [self._advance(light[k : k + 1], times_s[k : k + 1]) for k in range(len(times_s))]
        return tuple(np.concatenate(column) for column in zip(*blocks, strict=True))  # type: ignore[return-value]

    def _advance(self, light: Light, times_s: NDArray[np.float64]) -> Columns:
        pixel, steps, count = self.pixel, len(times_s), len(self._state.base)
        starts = np.concatenate([[self._time], times_s[:-1]])
        delta = times_s - starts
        if pixel.cutoff_hz > 0:
            rate = delta / (1.0 / (math.pi * 2.0 * pixel.cutoff_hz))
        else:
            rate = np.zeros(steps)
        table = np.empty(256 if light.dtype == np.uint8 else 0, np.float32)
        v2e.log_row(np.arange(len(table)), table)
        chance = np.zeros((steps, 2))
        chance[:, 0] = 0.5 * pixel.shot_noise_rate_hz * delta
        chance[:, 1] = np.minimum(chance[:, 0] * self._most * _DIM_MAX, 1.0 - 1e-9)
        hazard_sum = np.cumsum(np.concatenate([[self._hazard_sum], -np.log1p(-chance[:, 1])]))
        leaked = pixel.leak_rate_hz * delta
        law = v2e.Law(table, jitter_table(), self.seed, pixel.refractory_s > 0)

        def work(first: int, last: int) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
            peak = np.zeros(steps, np.int32)
            frames, origin = light.pixels(first, last)
            records = v2e.run_tiles(
                frames, origin, first, last, self._tile_px, self._steps, self._state, self._pixels,
                v2e.Steps(rate, leaked, hazard_sum[1:], chance, peak), law,
            )  # fmt: skip
            return (*records, peak)

        tiles = list(map_shares(work, count, self._tile_px, self._threads, light.most_px))
        peak = np.max([tile[4] for tile in tiles], axis=0)
        sub_times = [instants_within(starts[k], delta[k], times_s[k], int(peak[k])) for k in range(steps)]
        self._time, self._steps = float(times_s[-1]), self._steps + steps
        self._hazard_sum = float(hazard_sum[-1])
        stamps = np.rint(np.concatenate(sub_times).astype(np.float64) * 1e6).astype(np.int64)
        stamps = np.maximum.accumulate(stamps)
        if law.defer:
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
        record = tuple(np.concatenate([tile[n] for tile in tiles]) for n in range(4))
        bucket, where, on = v2e.settle(record, sub_times, period, self._last_event, self._state, self._pixels)
        return sort_events(bucket, where, on, stamps)


def instants_within(start_s: float, delta_s: float, stop_s: float, peak: int) -> NDArray[np.float32]:
    """Return the time stamps of a step whose busiest pixel crossed `peak` thresholds, float32 [>= 1]."""
    if peak <= 1:
        return np.array([start_s + delta_s], np.float32)
    return torch.linspace(start_s + delta_s / peak, stop_s, peak, dtype=torch.float32).numpy()
