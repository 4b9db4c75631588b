"""The clocks of frames and events: how far they are apart, and whether a capture says so.

- How far the frames' clock is from the events' clock, found from what both saw move.
- How far the frames of a capture are from its events, told by the course of the light in both, and beside
  what other captures by the same camera tell.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import DataError
from evnlos.events import frame_blocks
from evnlos.types import Events

_DARK = 0.02  # of the peak: added to frames before the logarithm, or black noise would count most
_OFFSET_STEP_US = 5_000  # between offsets that are looked at
_LIKENESS, _DISTINCT = 0.6, 1.5  # least correlation of an answer, and its ratio to the next best
_WIDEST = 2.0  # of the lobe around it, in times between frames
_EDGES_NEEDED = 4  # intervals between frames that lie inside the recording of events


@dataclass(frozen=True)
class ClockOffset:
    """A found offset and how sure it is.

    Args:
        offset_us: Event time minus frame time, microseconds.
        correlation: Correlation at that offset, -1..1.
        ratio: That correlation over the best one outside its own lobe; infinite where no other is positive.
        lobe_us: Width of the lobe at half of its height, microseconds: the offset is known far better than
            that.
    """

    offset_us: int
    correlation: float
    ratio: float
    lobe_us: int


def find_offset(
    events: Events,
    frames: NDArray,
    times_us: NDArray[np.int64],
    *,
    search_us: int = 1_000_000,
    blocks: int = 8,
) -> ClockOffset:
    """Return the offset at which the events between two frames explain the frames' difference best.

    For each block of pixels b and each pair of frames k the change of the mean logarithm is compared with the
    sum of the polarities of the events between their (shifted) times, both without their mean over time:

        r(offset) = corr_(k, b)(log F_(k+1, b) - log F_(k, b), sum of p over t_k + offset < t <= t_(k+1) +
        offset)

    The greatest r, refined by a parabola, gives the offset. Without known polarities changes and events are
    counted without their sign. Something must happen at once: a blink of the light, a jerk of the target. A
    slow and steady motion correlates well over a second and more, and events come late where the light changes
    slowly (by the time in which it changes by a threshold): such a recording is refused, because its lobe is
    too wide.

    Args:
        events: The events; times relative to any zero.
        frames: Frames on the same pixels as the events (or one block is used), [N, H, W], N at least 5.
        times_us: Their times on their own clock, [N], microseconds, ascending.
        search_us: Largest offset looked at, either sign, microseconds.
        blocks: Blocks along the longer side, 1 to 64; 1 for cameras that are not registered to each other.

    Raises:
        DataError: Too few frames, or no offset stands out: the correlation, its ratio and the cures are named.

    Example:
        >>> t = np.arange(0, 3_000_000, 1_000)  # a lamp that is dimmed and brightened irregularly
        >>> level = np.cumsum(np.random.default_rng(1).normal(size=3000)) / 20
        >>> steps = np.diff(np.round(level * 20), prepend=0).astype(int)
        >>> nowhere = np.zeros(abs(steps).sum(), int)
        >>> events = Events(np.repeat(t, abs(steps)), nowhere, nowhere, np.repeat(steps > 0, abs(steps)), 1, 1)
        >>> frames = np.exp(level[::50, None, None])
        >>> round(find_offset(events, frames, t[::50] - 300_000, blocks=1).offset_us, -4)
        300000
    """
    if len(frames) <= _EDGES_NEEDED or len(times_us) != len(frames):
        raise DataError(
            f"{len(frames)} frames and {len(times_us)} times; an offset needs 5 frames, a time each"
        )
    if not len(events):
        raise DataError("no events to find the clock offset from; state offset_us")
    signed = events.polarity_known is None or bool(events.polarity_known.any())
    same = frames.shape[1:] == events.shape
    grid = grid_of(events.shape, blocks) if same else (1, 1)
    changes = _changes(frames, grid, signed)  # [N - 1, B]
    clock_us, sums = running_sums(events, grid, _OFFSET_STEP_US, signed)  # [T], [T, B]
    offsets = np.arange(-search_us, search_us + 1, _OFFSET_STEP_US, dtype=np.int64)
    scores = np.array([agreement(changes, times_us + offset, clock_us, sums) for offset in offsets])
    if np.isnan(scores).all():
        raise DataError(
            f"no offset up to {search_us} us puts frames at {times_us[0]}..{times_us[-1]} us over events at "
            f"{events.t_us[0]}..{events.t_us[-1]} us; state offset_us, or search further"
        )
    found = _peak(offsets, np.nan_to_num(scores, nan=0.0))
    widest = round(_WIDEST * float(np.median(np.diff(times_us))))
    if found.correlation < _LIKENESS or found.ratio < _DISTINCT or found.lobe_us > widest:
        raise DataError(
            f"the clock offset is uncertain: correlation {found.correlation:.2f} (at least {_LIKENESS:g} is "
            f"needed), {found.ratio:.2f} times the next best (at least {_DISTINCT:g}), in a lobe "
            f"{found.lobe_us} us wide (at most {widest}); state offset_us, or record a blink of the light or a "
            "jerk of the target"
        )
    return found


def grid_of(shape: tuple[int, int], blocks: int) -> tuple[int, int]:
    """Return rows and columns of nearly square blocks."""
    if not 1 <= blocks <= 64:
        raise DataError(f"blocks is {blocks}; give 1 to 64")
    return tuple(max(1, min(side, round(blocks * side / max(shape)))) for side in shape)  # type: ignore[return-value]


def blocks_of(grid: tuple[int, int], shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the block of each pixel of an image of `shape` (H, W), [H * W]."""
    rows, columns = (np.arange(side) * count // side for count, side in zip(grid, shape, strict=True))
    return (rows[:, None] * grid[1] + columns).ravel()


def _changes(frames: NDArray, grid: tuple[int, int], signed: bool) -> NDArray[np.float64]:
    """Return the change of the blocks' mean logarithm from frame to frame, [N - 1, B]."""
    peak = float(np.iinfo(frames.dtype).max) if frames.dtype.kind == "u" else float(np.max(frames)) or 1.0
    block = blocks_of(grid, frames.shape[1:])
    size = np.bincount(block)
    out = np.empty((len(frames) - 1, len(size)))
    levels = (
        np.log(one.astype(np.float64).ravel() / peak + _DARK) for part in frame_blocks(frames) for one in part
    )
    for k, (before, now) in enumerate(itertools.pairwise(levels)):
        change = now - before
        out[k] = np.bincount(block, change if signed else np.abs(change)) / size
    return out


def running_sums(
    events: Events, grid: tuple[int, int], step_us: int, signed: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return instants [T] and, for each block, the sum of all polarities up to them, [T, B]."""
    first, last = int(events.t_us[0]), int(events.t_us[-1])
    bins = int((last - first) // step_us) + 1
    block = blocks_of(grid, events.shape)[events.y.astype(np.int64) * events.width + events.x]
    count = grid[0] * grid[1]
    weight = np.where(events.p, 1.0, -1.0) if signed else np.ones(len(events))
    if signed and events.polarity_known is not None:
        weight[~events.polarity_known] = 0.0
    place = (events.t_us - first) // step_us * count + block
    sums = np.bincount(place, weight, bins * count).astype(np.float64).reshape(bins, count)
    clock = first + step_us * np.arange(bins + 1, dtype=np.float64)
    return clock, np.concatenate([np.zeros((1, count)), np.cumsum(sums, axis=0)])


def agreement(
    changes: NDArray[np.float64], edges_us: NDArray, clock_us: NDArray[np.float64], sums: NDArray[np.float64]
) -> float:
    """Return the correlation over the intervals inside the recording, NaN where there are too few."""
    step = clock_us[1] - clock_us[0]
    place = (edges_us - clock_us[0]) / step
    inside = (place >= 0) & (place <= len(clock_us) - 1)
    whole = inside[1:] & inside[:-1]
    if whole.sum() < max(_EDGES_NEEDED, len(whole) // 2):
        return float("nan")
    place = np.clip(place, 0, len(clock_us) - 1)
    low = np.minimum(place.astype(np.int64), len(clock_us) - 2)
    part = (place - low)[:, None]
    at_edges = sums[low] * (1 - part) + sums[low + 1] * part  # [N, B]
    counted = np.diff(at_edges, axis=0)[whole]
    seen = changes[whole]
    counted = counted - counted.mean(axis=0)
    seen = seen - seen.mean(axis=0)
    norm = np.sqrt((counted**2).sum() * (seen**2).sum())
    # A chance correlation of few intervals is large: it counts as if spread over all.
    share = np.sqrt(whole.mean())
    return float((counted * seen).sum() / norm * share) if norm > 0 else 0.0


def _peak(offsets: NDArray[np.int64], scores: NDArray[np.float64]) -> ClockOffset:
    best = int(np.argmax(scores))
    top = float(scores[best])
    low = high = best
    while low > 0 and scores[low - 1] > top / 2:
        low -= 1
    while high + 1 < len(scores) and scores[high + 1] > top / 2:
        high += 1
    # A slope of the lobe is no rival; a maximum of its own is.
    inner = np.flatnonzero((scores[1:-1] >= scores[:-2]) & (scores[1:-1] >= scores[2:])) + 1
    rivals = [float(scores[i]) for i in (0, *inner, len(scores) - 1) if i < low or i > high]
    second = max(rivals, default=0.0)
    offset = float(offsets[best])
    if 0 < best < len(scores) - 1:
        left, right = scores[best - 1], scores[best + 1]
        bend = left - 2 * top + right
        if bend < 0:
            offset += 0.5 * (left - right) / bend * float(offsets[1] - offsets[0])
    ratio = top / second if second > 0 else float("inf")
    if best in (0, len(scores) - 1):
        ratio = 0.0  # the true maximum may lie beyond
    return ClockOffset(round(offset), top, ratio, int(offsets[high] - offsets[low]))


LEAST_AGREEMENT, LEAST_RATIO = 0.2, 1.2
"""Agreement below which nothing is told, and how far one order of the frames must be ahead of the other."""
_THRESHOLDS = (0.1, 0.15, 0.2, 0.3)  # log units: what sensors are set to
_EVEN, _MOST_UNEVEN = 2.0, 20.0  # of ON to OFF events: a ratio that says nothing, and the largest used
_CELLS = 24  # along the longer side
_PHASES = 8  # pixels of a cell, their references spread evenly over the dead zone
_STEPS = 8  # of the light between two frames
_MOST_FRAMES, _MOST_BINS, _FINEST_BIN_US = 400, 4_000, 5_000
_LAGS = 201
_LOBE, _SHARE_OF_LOBE, _SENSORS_SHARE = 0.9, 0.1, 0.05
_NEARLY = 0.7  # of the best threshold's agreement: low thresholds agree best whatever the sensor's is
_LIKELY = 0.85  # of the agreement of even thresholds: uneven ones that reach it are as likely
_FEWEST_FRAMES = 6
_USUAL_US = 20_000
FEWEST_LAGS = 8
"""Recordings of which the middle tells what is usual."""
_DARK_SHARE = 1e-3  # of the peak


@dataclass(frozen=True)
class ClockLag:
    """How frames and events agree.

    Args:
        lag_us: What to add to the frames' times, microseconds.
        limit_us: What is usual where the clocks agree, microseconds: the largest of half a time between frames
            (a whole one where one polarity tells it alone, from one flank), a tenth of the lobe's width,
            and half of what the lag differs by between likely thresholds.
        unsure_us: What slow pixels (late) or noisy ones (early) make at most by themselves, so that it can't be
            told from clocks that differ, microseconds: a twentieth of the lobe's width more.
        agreement: Correlation at that lag, -1..1.
        backwards: Greatest correlation of the frames in reversed order, -1..1.
    """

    lag_us: int
    limit_us: int
    unsure_us: int
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
    four thresholds that agree nearly as well as the best one: a threshold too high makes it too early, one too
    low too late. Where one polarity is much the more frequent, either its threshold is the lower one by that
    ratio, or noise and leak send the surplus: what agrees better counts, but even thresholds, which agree well
    with any sensor, count alone only where they do so clearly.

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

    courses = []
    for ratio_on, ratio_off in _ratios(events):
        pairs = [(lower * ratio_on, lower * ratio_off) for lower in _THRESHOLDS]
        curves = [curve(expected_counts(level, *pair)) for pair in pairs]
        courses.append((max(one.max() for one in curves), pairs, curves))
    top, pairs, curves = best_of = max(courses, key=lambda course: course[0])
    best = int(np.argmax([one.max() for one in curves]))
    backwards = curve(expected_counts(level[::-1], *pairs[best]))
    is_even = best_of is courses[0]
    likely = [one for one in courses if one[0] >= min(_LIKELY * top, top)] if is_even else [best_of]
    near = [one for _, _, several in likely for one in several if one.max() >= min(_NEARLY * top, top)]
    middles, widths = zip(*(_middle(lags, one) for one in near), strict=True)
    lag, width, left_open = np.mean(middles), np.mean(widths), 0.5 * float(np.ptp(middles))
    between = float(np.median(np.diff(times_us)))
    limit = max((0.5 if is_even else 1.0) * between, _SHARE_OF_LOBE * float(width), left_open)
    unsure = limit + _SENSORS_SHARE * float(width)
    return ClockLag(round(float(lag)), round(limit), round(unsure), float(top), float(backwards.max()))


def beside_others(lags_us: Sequence[int]) -> tuple[NDArray[np.float64], float]:
    """Return how far the lag of each recording is from the middle of the others', [N], and what is usual.

    A lag that one has alone is not what pixels do by themselves. Usual are 20 ms, or 4 + 28 / N deviations
    (from the median distance from the median), which one set of normal lags in a hundred passes.

    Args:
        lags_us: Lags of N recordings by one camera at one speed, `FEWEST_LAGS` or more, microseconds.
    """
    lags = np.asarray(lags_us, np.float64)
    away = np.array([lag - np.median(np.delete(lags, number)) for number, lag in enumerate(lags)])
    deviation = 1.4826 * float(np.median(np.abs(lags - np.median(lags))))
    return away, max(_USUAL_US, (4 + 28 / len(lags)) * deviation)


def _ratios(events: Events) -> list[tuple[float, float]]:
    """Return the ratios (ON, OFF) of the thresholds to the lower of both that the polarities allow."""
    on = np.count_nonzero(events.p)
    ratio = (on + 1) / (len(events) - on + 1)
    uneven = min(max(ratio, 1 / ratio), _MOST_UNEVEN)
    if uneven < _EVEN:
        return [(1.0, 1.0)]
    return [(1.0, 1.0), (1.0, uneven) if ratio > 1 else (uneven, 1.0)]


def expected_counts(
    level: NDArray[np.float64], threshold_on: float, threshold_off: float | None = None
) -> NDArray[np.float64]:
    """Return what pixels with thresholds send while their light goes from frame to frame, a pixel's mean.

    A pixel that has waited is anywhere between its thresholds, but never further from the lower one than by
    that: leak and noise take it there.

    Args:
        level: Logarithm of the cells' light, [N, B]; straight between frames.
        threshold_on: Of ON events, log units, above 0.
        threshold_off: Of OFF events, log units, above 0; by default that of ON events.

    Returns:
        ON less OFF events of each interval and cell, [N - 1, B].

    Example:
        >>> expected_counts(np.array([[0.0], [0.4], [0.4], [0.0]]), 0.1).round(2).ravel().tolist()
        [3.5, 0.0, -3.0]
    """
    off = threshold_on if threshold_off is None else threshold_off
    lower = min(threshold_on, off)
    phase = (2 * np.arange(_PHASES) + 1) / _PHASES - 1  # -1..1 of the lower threshold
    if threshold_on != off:
        phase = 0.5 * (phase - 1) if threshold_on < off else 0.5 * (phase + 1)
    reference = level[0][:, None] + lower * phase
    sent = np.zeros((len(level) - 1, level.shape[1]))
    for k, (before, after) in enumerate(itertools.pairwise(level)):
        for part in np.arange(1, _STEPS + 1) / _STEPS:
            away = (before + (after - before) * part)[:, None] - reference
            up = np.floor(np.maximum(away, 0.0) / threshold_on)
            down = np.floor(np.maximum(-away, 0.0) / off)
            reference = reference + threshold_on * up - off * down
            sent[k] += (up - down).mean(axis=1)
    return sent


def _levels(frames: NDArray, grid: tuple[int, int]) -> NDArray[np.float64]:
    """Return the logarithm of the cells' mean light in each frame, [N, B]."""
    peak = float(np.iinfo(frames.dtype).max)
    cell = blocks_of(grid, frames.shape[1:])
    sums = np.array([np.bincount(cell, frame.ravel().astype(np.float64)) for frame in frames])
    return np.log(sums / np.bincount(cell) / peak + _DARK_SHARE)


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
