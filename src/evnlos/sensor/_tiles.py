"""What both pixel arrays share: thresholds a pixel, tiles, threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.errors import ConfigError
from evnlos.sensor._checks import check_threshold_maps
from evnlos.sensor._random import BLOCK, STREAM_THRESHOLD_OFF, STREAM_THRESHOLD_ON, normal_field
from evnlos.sensor.event_model import MIN_THRESHOLD
from evnlos.threads import cores

_T = TypeVar("_T")
_SHARES = 8


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
    """Return each pixel's thresholds (on, off), float64 [H * W], log units: given, or drawn and clamped."""
    if thresholds is not None:
        on, off = check_threshold_maps(thresholds, shape)
        return on.ravel(), off.ravel()
    count = shape[0] * shape[1]
    drawn = []
    for nominal, stream in (
        (pixel.threshold_on, STREAM_THRESHOLD_ON),
        (pixel.threshold_off, STREAM_THRESHOLD_OFF),
    ):
        field = np.full(count, float(nominal))
        if pixel.threshold_sigma > 0:
            field += pixel.threshold_sigma * normal_field(pattern_key(pixel, seed), stream, count)
            np.maximum(field, MIN_THRESHOLD, out=field)
        drawn.append(field)
    return drawn[0], drawn[1]


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
