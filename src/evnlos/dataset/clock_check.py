"""How far the frames of a capture are from its events, told by the course of the light in both."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evnlos.dataset.alignment import agreement, blocks_of, grid_of, running_sums
from evnlos.types import Events

LEAST_AGREEMENT, LEAST_RATIO = 0.2, 1.2
"""Agreement below which nothing is told, and how far one order of the frames must be ahead of the other."""
_THRESHOLDS = (0.05, 0.1, 0.15, 0.2, 0.3)  # log units
_CELLS = 24  # along the longer side
_PHASES = 8  # pixels of a cell, their references spread evenly over the dead zone
_STEPS = 8  # of the light between two frames
_MOST_FRAMES, _MOST_BINS, _FINEST_BIN_US = 400, 4_000, 5_000
_LAGS = 201
_LOBE, _SHARE_OF_LOBE = 0.9, 0.1
_NEARLY = 0.9  # of the best threshold's agreement
_FEWEST_FRAMES = 6
_DARK = 1e-3  # of the peak


@dataclass(frozen=True)
class ClockLag:
    """How frames and events agree.

    Args:
        lag_us: What to add to the frames' times, microseconds.
        limit_us: What can be told, microseconds: half a time between frames, or a tenth of the lobe's width
            where that is more.
        agreement: Correlation at that lag, -1..1.
        backwards: Greatest correlation of the frames in reversed order, -1..1.
    """

    lag_us: int
    limit_us: int
    agreement: float
    backwards: float

    @property
    def reversed(self) -> bool:
        """Whether the events fit the frames in reversed order clearly better."""
        return self.backwards >= max(LEAST_AGREEMENT, LEAST_RATIO * self.agreement)

    @property
    def told(self) -> bool:
        """Whether the events fit the frames well enough, and clearly better than in reversed order."""
        return self.agreement >= max(LEAST_AGREEMENT, LEAST_RATIO * self.backwards)


def find_lag(events: Events, frames: NDArray, times_us: NDArray[np.int64]) -> ClockLag | None:
    """Return how far the frames' times are from the events', from a slow and steady motion too.

    `find_offset` compares changes of the light, which events of a slowly changing wall follow late. Here
    pixels with a threshold are led along the frames' light, and what they would send is compared with what was
    sent, so that the lateness is on both sides. The lag is the middle of the lobe's top, a mean over those of
    five thresholds that agree nearly as well as the best one: a threshold too high makes it too early.

    Args:
        events: The events.
        frames: Frames on the events' pixels, [N, H, W], digital numbers.
        times_us: Their times, [N], microseconds, ascending.

    Returns:
        The lag; None where it can't be looked for: other pixels, too few frames, or no polarities.
    """
    known = events.polarity_known
    if frames.shape[1:] != events.shape or len(frames) < _FEWEST_FRAMES or not len(events):
        return None
    if known is not None and not known.all():
        return None
    every = math.ceil(len(frames) / _MOST_FRAMES)
    times = times_us[::every].astype(np.int64)
    grid = grid_of(events.shape, _CELLS)
    level = _levels(frames[::every], grid)
    step = max(_FINEST_BIN_US, math.ceil((int(events.t_us[-1]) - int(events.t_us[0])) / _MOST_BINS))
    clock, sums = running_sums(events, grid, step, True)
    half = (int(times[-1]) - int(times[0])) / 2
    lags = np.linspace(-half, half, _LAGS)

    def curve(expected: NDArray[np.float64]) -> NDArray[np.float64]:
        found = np.array([agreement(expected, times + lag, clock, sums) for lag in lags])
        return np.nan_to_num(found, nan=-1.0)

    curves = [curve(expected_counts(level, threshold)) for threshold in _THRESHOLDS]
    tops = np.array([one.max() for one in curves])
    best, top = int(np.argmax(tops)), float(tops.max())
    backwards = curve(expected_counts(level[::-1], _THRESHOLDS[best]))
    near = [_middle(lags, one) for one in curves if one.max() >= _NEARLY * top]
    lag, width = np.mean(near, axis=0)
    limit = max(0.5 * float(np.median(np.diff(times_us))), _SHARE_OF_LOBE * float(width))
    return ClockLag(round(float(lag)), round(limit), top, float(backwards.max()))


def expected_counts(level: NDArray[np.float64], threshold: float) -> NDArray[np.float64]:
    """Return what pixels with a threshold send while their light goes from frame to frame, a pixel's mean.

    Args:
        level: Logarithm of the cells' light, [N, B]; straight between frames.
        threshold: Of either polarity, log units, above 0.

    Returns:
        ON less OFF events of each interval and cell, [N - 1, B].

    Example:
        >>> expected_counts(np.array([[0.0], [0.4], [0.4], [0.0]]), 0.1).round(2).ravel().tolist()
        [3.5, 0.0, -3.0]
    """
    phase = (2 * np.arange(_PHASES) + 1) / _PHASES - 1  # -1..1 of the threshold
    reference = level[0][:, None] + threshold * phase
    start = [reference.mean(axis=1)]
    for before, after in itertools.pairwise(level):
        for part in np.arange(1, _STEPS + 1) / _STEPS:
            away = (before + (after - before) * part)[:, None] - reference
            reference = reference + threshold * np.trunc(away / threshold)
        start.append(reference.mean(axis=1))
    sent: NDArray[np.float64] = np.diff(np.array(start), axis=0)
    return sent / threshold


def _levels(frames: NDArray, grid: tuple[int, int]) -> NDArray[np.float64]:
    """Return the logarithm of the cells' mean light in each frame, [N, B]."""
    peak = float(np.iinfo(frames.dtype).max)
    cell = blocks_of(grid, frames.shape[1:])
    sums = np.array([np.bincount(cell, frame.ravel().astype(np.float64)) for frame in frames])
    return np.log(sums / np.bincount(cell) / peak + _DARK)


def _middle(lags: NDArray[np.float64], curve: NDArray[np.float64]) -> tuple[float, float]:
    """Return the middle of the lobe's top, weighted by its height, and the width of the top."""
    best = low = high = int(np.argmax(curve))
    floor = _LOBE * float(curve[best])
    while low > 0 and curve[low - 1] > floor:
        low -= 1
    while high + 1 < len(curve) and curve[high + 1] > floor:
        high += 1
    weight = np.maximum(curve[low : high + 1] - floor, 1e-12)
    return float(np.average(lags[low : high + 1], weights=weight)), float(lags[high] - lags[low])
