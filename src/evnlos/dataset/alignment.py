"""How far the frames' clock is from the events' clock, found from what both saw move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evnlos.errors import DataError
from evnlos.types import Events

_DARK = 0.02  # of the peak: added to frames before the logarithm, or black noise would count most
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
    step_us: int = 5_000,
    blocks: int = 8,
    min_correlation: float = 0.6,
    min_ratio: float = 1.5,
    max_lobe_frames: float = 2.0,
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
        step_us: Distance between offsets looked at, microseconds.
        blocks: Blocks along the longer side, 1 to 64; 1 for cameras that are not registered to each other.
        min_correlation: Correlation below which the answer is refused.
        min_ratio: Ratio of the best lobe to the next below which the answer is refused.
        max_lobe_frames: Width of the lobe, in times between frames, above which the answer is refused.

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
    clock_us, sums = running_sums(events, grid, step_us, signed)  # [T], [T, B]
    offsets = np.arange(-search_us, search_us + 1, step_us, dtype=np.int64)
    scores = np.array([agreement(changes, times_us + offset, clock_us, sums) for offset in offsets])
    if np.isnan(scores).all():
        raise DataError(
            f"no offset up to {search_us} us puts frames at {times_us[0]}..{times_us[-1]} us over events at "
            f"{events.t_us[0]}..{events.t_us[-1]} us; state offset_us, or search further"
        )
    found = _peak(offsets, np.nan_to_num(scores, nan=0.0))
    widest = round(max_lobe_frames * float(np.median(np.diff(times_us))))
    if found.correlation < min_correlation or found.ratio < min_ratio or found.lobe_us > widest:
        raise DataError(
            f"the clock offset is uncertain: correlation {found.correlation:.2f} (at least {min_correlation:g} "
            f"is needed), {found.ratio:.2f} times the next best (at least {min_ratio:g}), in a lobe "
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
    before = np.log(frames[0].astype(np.float64).ravel() / peak + _DARK)
    for k in range(1, len(frames)):
        now = np.log(frames[k].astype(np.float64).ravel() / peak + _DARK)
        change = now - before
        out[k - 1] = np.bincount(block, change if signed else np.abs(change)) / size
        before = now
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
    ours = np.diff(at_edges, axis=0)[whole]
    theirs = changes[whole]
    ours = ours - ours.mean(axis=0)
    theirs = theirs - theirs.mean(axis=0)
    norm = np.sqrt((ours**2).sum() * (theirs**2).sum())
    # A chance correlation of few intervals is large: it counts as if spread over all.
    share = np.sqrt(whole.mean())
    return float((ours * theirs).sum() / norm * share) if norm > 0 else 0.0


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
