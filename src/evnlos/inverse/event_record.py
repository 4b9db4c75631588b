"""Events as differences of log light: which instants of a pixel a threshold lies between, and their rows.

- The level of each pixel: filtered log light at all instants of a sequence.
- A record: the instants of each pixel's events, each with the one that it is measured from.
- The events that a known light would make, for bounds: crossings of the levels, and labelled noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.cameras import CrossingLaw
from evnlos.cameras.streams import WHITE_DN
from evnlos.inverse.sequence_light import Array, SequenceLight, group_blocks
from evnlos.types import Events

_BLOCK = 16_384  # rows at a time: what bounds the memory
_SAFE = 1e-3  # white levels under which no light is taken to lie


@dataclass(frozen=True, eq=False)
class Levels:
    """What pixels make of light: filtered log light, and its derivative by the light.

    Args:
        value: Filtered log light, [P, T].
        slope: Derivative of the log light by the light, per white level, [P, T].
        lag_s: What the filter lags behind, seconds, [P, T].
        fall: By how much the reference falls, log units per second, [P].
    """

    value: Array
    slope: Array
    lag_s: Array
    fall: Array


def levels_of(light: Array, times_s: Array, law: CrossingLaw) -> Levels:
    """Return the levels of light that is a line between equally spaced instants.

    Between two instants the log light counts as a line in time, too, and the filter's speed w is that of their
    middle: P' = P + (1 - e)(L - P) + (1 - (1 - e) / tau) (L' - L) with tau = w dt and e = exp(-tau).

    Args:
        light: White levels, [P, T].
        times_s: Instants, [T], seconds.
        law: The pixel's constants.
    """
    seen = WHITE_DN * np.maximum(light, _SAFE)
    logs = law.level(seen)
    slope = WHITE_DN * law.slope(seen) * (light > _SAFE)
    if law.cutoff_hz == 0:
        lag, value = np.zeros_like(logs), logs
    else:
        speed = law.bandwidth(seen)
        lag, value = 1.0 / speed, np.empty_like(logs)
        value[:, 0] = logs[:, 0]
        for k in range(1, len(times_s)):
            tau = 0.5 * (speed[:, k - 1] + speed[:, k]) * (times_s[k] - times_s[k - 1])
            passed = -np.expm1(-tau)
            before = value[:, k - 1]
            value[:, k] = before + passed * (logs[:, k - 1] - before)
            value[:, k] += (1.0 - passed / tau) * (logs[:, k] - logs[:, k - 1])
    return Levels(value, slope, lag, law.fall(seen.mean(axis=1)))


@dataclass(frozen=True, eq=False)
class EventRecord:
    """Instants of pixels, by pixel and then by time, and what each is measured from.

    Args:
        pixel: Flat index of the pixel, [N].
        t_s: Instants, [N], seconds.
        sign: +1 ON, -1 OFF, 0 = no crossing: a start, a silence, or an event that is known to be noise.
        origin: Index of the instant whose level is the reference, [N]; -1 = none is known.
    """

    pixel: NDArray[np.int64]
    t_s: Array
    sign: NDArray[np.int8]
    origin: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.pixel)

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Whether an instant is a crossing, measured from a known one, [N]."""
        return (self.sign != 0) & (self.origin >= 0)

    def only(self, chosen: NDArray[np.bool_]) -> EventRecord:
        """Return the chosen instants and those that they are measured from, [N] -> a shorter record.

        Args:
            chosen: Which instants stay measured, [N]; those that are only references have no origin any more.
        """
        kept = chosen.copy()
        kept[self.origin[chosen & (self.origin >= 0)]] = True
        index = np.cumsum(kept) - 1
        origin = np.where(chosen & (self.origin >= 0), index[self.origin], -1)
        return EventRecord(self.pixel[kept], self.t_s[kept], self.sign[kept], origin[kept])

    def of_pixels(self, chosen: NDArray[np.bool_]) -> EventRecord:
        """Return the record of some pixels alone.

        Args:
            chosen: Whether the pixel of an instant is one of them, [N].
        """
        index = np.cumsum(chosen) - 1
        origin = np.where(self.origin >= 0, index[self.origin], -1)[chosen]
        return EventRecord(self.pixel[chosen], self.t_s[chosen], self.sign[chosen], origin)

    def every(self, stride: int, width: int) -> EventRecord:
        """Return the record of every so many rows and columns, numbered as by `SequenceLight.every`.

        Args:
            stride: 1 keeps all of them.
            width: Columns of the sensor.
        """
        row, column = np.divmod(self.pixel, width)
        kept = (row % stride == 0) & (column % stride == 0)
        number = row[kept] // stride * -(-width // stride) + column[kept] // stride
        return replace(self.of_pixels(kept), pixel=number)

    def change(self, light: SequenceLight, levels: Levels) -> Array:
        """Return by how much the level moved since the origin, the leak's share included, [N]; NaN = none."""
        level = light.at(levels.value, self.pixel, self.t_s)
        change = level - level[self.origin] + levels.fall[self.pixel] * (self.t_s - self.t_s[self.origin])
        return np.where(self.origin >= 0, change, np.nan)

    def variance(self, light: SequenceLight, seen: Array, law: CrossingLaw, noise: float) -> Array:
        """Return the variance of each change, log units squared, [N]: the event model's own, and an error's.

        Args:
            light: The light.
            seen: Its white levels, [P, T].
            law: The pixel's constants.
            noise: Standard deviation of the error of a crossing beside the model's own, log units.
        """
        waited = np.maximum(self.t_s - self.t_s[self.origin], 0.0)
        walk = law.walk_variance(light.at(seen, self.pixel, self.t_s) * WHITE_DN)
        return law.noise**2 + noise**2 + walk * waited

    def blocks(
        self, light: SequenceLight, levels: Levels, most: int = _BLOCK
    ) -> Iterator[tuple[slice, Array, Array]]:
        """Yield slices of whole pixels, and derivatives of changes and of rates by the coefficients, [n, k].

        The filter counts as a delay there: d P(t) = d L(t - 1 / w). A rate is that between two nodes of the
        light.

        Args:
            light: The light.
            levels: The levels at which the rows are taken.
            most: Instants of a block, about.
        """
        for block in group_blocks(self.pixel, most):
            pixel, t_s = self.pixel[block], self.t_s[block]
            then = t_s - light.at(levels.lag_s, pixel, t_s)
            node, share = light.place(then)
            before, after = light.ends(pixel, then)
            slope = light.at(levels.slope, pixel, then)
            rows = ((1 - share) * slope)[:, None] * before + (share * slope)[:, None] * after
            origin = self.origin[block]
            rows -= np.where(origin[:, None] >= 0, rows[np.maximum(origin - block.start, 0)], 0.0)
            step = light.times_s[1] - light.times_s[0]
            rates = (levels.slope[pixel, node + 1] / step)[:, None] * after
            rates -= (levels.slope[pixel, node] / step)[:, None] * before
            yield block, rows, rates


def record_of(
    events: Events, law: CrossingLaw, span_s: tuple[float, float], gap_s: float = np.inf
) -> EventRecord:
    """Return the record of a stream: each event measured from the one before it in its pixel.

    With pixels that start at rest the first one is measured from the first light. In gaps longer than `gap_s`,
    and at the end, instants without an event stand for the silence. Pixels that are known to fire without cause
    are left out.

    Args:
        events: The stream, on the clock of `span_s`.
        law: The pixel's constants.
        span_s: First and last instant of the sequence, seconds; events outside are left out.
        gap_s: Longest time without an instant, seconds; infinity = no silences but the one at the end.
    """
    t_s = events.t_us * 1e-6
    inside = (t_s > span_s[0]) & (t_s <= span_s[1])
    everywhere = np.arange(events.width * events.height)
    if law.known is not None:
        inside &= ~law.known.hot[events.y, events.x]
        everywhere = np.flatnonzero(~law.known.hot)
    count, pixel = len(everywhere), (events.y.astype(np.int64) * events.width + events.x)[inside]
    sign = np.where(events.p[inside], 1, -1).astype(np.int8)
    return _assembled(
        np.concatenate([everywhere, pixel, everywhere]),
        np.concatenate([np.full(count, span_s[0]), t_s[inside], np.full(count, span_s[1])]),
        np.concatenate([np.zeros(count, np.int8), sign, np.zeros(count, np.int8)]),
        np.concatenate([np.full(count, 0), np.ones(len(pixel), np.int64), np.full(count, 2)]),
        law.starts_at_rest,
        gap_s,
    )


def _assembled(
    pixel: NDArray, t_s: Array, sign: NDArray, part: NDArray, at_rest: bool, gap_s: float
) -> EventRecord:
    """Return the record of starts (part 0), events (1) and ends (2), with silences in gaps."""
    order = np.lexsort((part, t_s, pixel))
    pixel, t_s, sign, part = (column[order] for column in (pixel, t_s, sign, part))
    if np.isfinite(gap_s):
        same = pixel[1:] == pixel[:-1]
        gap = np.where(same, np.diff(t_s), 0.0)
        extra = np.maximum(np.ceil(gap / gap_s).astype(np.int64) - 1, 0)
        before = np.repeat(np.arange(len(extra)), extra)
        number = np.arange(len(before)) - np.repeat(np.cumsum(extra) - extra, extra) + 1
        quiet = t_s[before] + number * gap[before] / (extra[before] + 1)
        zeros = np.zeros(len(before), np.int8)
        pixel = np.concatenate([pixel, pixel[before]])
        t_s, sign = np.concatenate([t_s, quiet]), np.concatenate([sign, zeros])
        part = np.concatenate([part, np.full(len(before), 2)])
        order = np.lexsort((part, t_s, pixel))
        pixel, t_s, sign, part = (column[order] for column in (pixel, t_s, sign, part))
    index = np.arange(len(pixel))
    known = (part == 1) | ((part == 0) & at_rest)
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    # the last instant before each that is a reference, if it is of the same pixel
    last = np.maximum.accumulate(np.where(known, index, -1))
    origin = np.concatenate([[-1], last[:-1]])
    start = np.repeat(first, np.diff(np.append(first, len(pixel))))
    origin = np.where((origin >= start) & (part > 0), origin, -1)
    return EventRecord(pixel, t_s, sign, origin)


@njit(cache=True, error_model="numpy")
def crossings(levels, step, on, off, fall, lift, noise, first_noise, out):
    """Fill the events of levels that are lines between instants; return their number.

    levels      log light at equally spaced instants, [P, T];  step  their distance, seconds
    on, off     thresholds, log units;  fall  of the reference, log units per second [P]
    lift        level less reference at first, [P]
    noise       instants of the noise events, in steps, ascending for each pixel [M]
    first_noise index of each pixel's first one [P + 1]
    out         pixel, instant in steps, sign (0 = noise) of each event; what does not fit is counted only
    """
    pixels, instants, signs = out
    count = 0
    for i in range(len(levels)):
        above, n = lift[i], first_noise[i]
        for k in range(levels.shape[1] - 1):
            slope = levels[i, k + 1] - levels[i, k] + fall[i] * step
            at = 0.0
            while True:
                share, sign = 1.0 - at, 2
                if slope > 0.0 and on - above < slope * share:
                    share, sign = max(on - above, 0.0) / slope, 1
                elif slope < 0.0 and -off - above > slope * share:
                    share, sign = min(-off - above, 0.0) / slope, -1
                if n < first_noise[i + 1] and noise[n] < k + at + share:
                    share, sign = max(noise[n] - k - at, 0.0), 0
                    n += 1
                if sign == 2:
                    above += slope * share
                    break
                at += share
                above = 0.0
                if count < len(pixels):
                    pixels[count], instants[count], signs[count] = i, k + at, sign
                count += 1
    return count


def predicted_record(light: SequenceLight, levels: Levels, law: CrossingLaw, seed: int = 0) -> EventRecord:
    """Return the record of the events that light would make in pixels of the mean thresholds.

    Noise events are drawn and labelled: nothing is learnt from them but the new reference.

    Args:
        light: The light, for its instants.
        levels: Its levels.
        law: The pixel's constants.
        seed: Seed of the noise events, and of the first references of pixels that do not start at rest.
    """
    draw = np.random.default_rng([seed, 1])
    count, steps = levels.value.shape
    times = light.times_s
    step = float(times[1] - times[0])
    number = draw.poisson(law.events_hz * (times[-1] - times[0]), count)
    owner = np.repeat(np.arange(count), number)
    noise = draw.uniform(0.0, steps - 1.0, len(owner))
    noise = noise[np.lexsort((noise, owner))]
    lift = np.zeros(count)
    if not law.starts_at_rest:
        lift = draw.uniform(-law.threshold_off, law.threshold_on, count)
    given = (levels.value, step, law.threshold_on, law.threshold_off, levels.fall, lift, noise)
    first = np.concatenate([[0], np.cumsum(number)])
    columns = (np.empty(0, np.int64), np.empty(0), np.empty(0, np.int8))
    size = crossings(*given, first, columns)
    columns = (np.empty(size, np.int64), np.empty(size), np.empty(size, np.int8))
    crossings(*given, first, columns)
    everywhere, ends = np.arange(count), np.zeros(count, np.int8)
    return _assembled(
        np.concatenate([everywhere, columns[0], everywhere]),
        np.concatenate([np.full(count, times[0]), times[0] + step * columns[1], np.full(count, times[-1])]),
        np.concatenate([ends, columns[2], ends]),
        np.concatenate([np.full(count, 0), np.ones(size, np.int64), np.full(count, 2)]),
        law.starts_at_rest,
        np.inf,
    )
