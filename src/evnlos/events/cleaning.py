"""A recording of any length cleaned in two passes: what is wrong with it is found, and what stays is written.

- The frequency of lamps on the mains, from the rate of events, and what share of the events they made.
- Hot pixels and the rate of the background, from the counts of all pixels.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import comb
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import ConfigError, DataError
from evnlos.events.files.columns import join, trusted_events
from evnlos.events.filters import comb_filter, counts_of, hot_by_counts, support_filter, without_pixels
from evnlos.types import Events
from evnlos.untrusted import MOST_SENSOR_PIXELS

_MAINS_HZ = (90.0, 132.0)  # twice 50 and 60 Hz, and what generators make of it
_AROUND_HZ = (80.0, 140.0)
_SEGMENT_MS = 4096
_SIGMAS = 6.0  # a chance of 1e-9
_FAINTEST = 6.0  # times its surroundings: a weaker line makes no events to speak of


@dataclass(frozen=True)
class FlickerLine:
    """The strongest line of the events' rate near twice the mains' frequency.

    Args:
        frequency_hz: Its frequency, hertz.
        strength: Its power over the median of its surroundings.
        limit: Strength that noise does not reach.
    """

    frequency_hz: float
    strength: float
    limit: float

    @property
    def is_there(self) -> bool:
        """Whether it is more than noise."""
        return self.strength >= self.limit


def flicker_line(counts: NDArray) -> FlickerLine:
    """Return the strongest line between 90 and 132 Hz of counts of events a millisecond.

    The power spectra of Hann windows of 4.1 s (or of what there is) are summed over windows and polarities:
    once of the whole sensor, and once of each of its parts, whose lamps may hang on other phases of the mains.
    The clearer of the two counts; a parabola through the logarithms gives its peak.

    Args:
        counts: OFF and ON events in each millisecond and part of the sensor, [2, parts, N], N at least 500.

    Raises:
        DataError: Fewer than 500 milliseconds.
    """
    length = counts.shape[-1]
    if length < 500:
        raise DataError(f"{length} ms are too short to find a frequency in; at least 500 ms are needed")
    length = min(length, _SEGMENT_MS)
    starts = range(0, counts.shape[-1] - length + 1, length)
    powers = sum(_powers(counts[..., start : start + length]) for start in starts)
    return _line(np.asarray(powers), len(starts), np.asarray(counts.any(axis=-1)))


def _powers(counts: NDArray) -> NDArray[np.float64]:
    """Return the power spectra [2, F] of counts [2, parts, N], padded to 0.061 Hz: of their sum, and summed."""
    window = np.hanning(counts.shape[-1])

    def power(rows: NDArray) -> NDArray[np.float64]:
        tapered = (rows - rows.mean(axis=-1, keepdims=True)) * window
        spectra = np.abs(np.fft.rfft(tapered, 4 * _SEGMENT_MS, axis=-1)) ** 2
        return spectra.reshape(-1, spectra.shape[-1]).sum(axis=0)

    return np.stack([power(counts.sum(axis=1)), power(counts)])


def _line(powers: NDArray[np.float64], windows: int, seen: NDArray[np.bool_]) -> FlickerLine:
    """Return the clearer of the lines of two sums of spectra.

    Args:
        powers: What `_powers` returned, summed over the windows, [2, F].
        windows: Their number.
        seen: Which polarity sent events in which part of the sensor, [2, parts].
    """
    spectra = windows * seen.any(axis=1).sum(), windows * seen.sum()
    lines = [_line_of(power, int(k)) for power, k in zip(powers, spectra, strict=True)]
    return max(lines, key=lambda line: line.strength / line.limit)


def _line_of(power: NDArray[np.float64], spectra: int) -> FlickerLine:
    """Return the strongest line of a sum of so many spectra.

    The power of noise is then gamma distributed; by Wilson and Hilferty (1931) its quantile at z standard
    deviations is (1 - 1 / 9k + z / (3 sqrt(k)))^3 times the mean, k the number of spectra.
    """
    k = max(spectra, 1)
    limit = (1.0 + _SIGMAS / (3.0 * k**0.5) / (1.0 - 1.0 / (9.0 * k))) ** 3
    frequency = np.fft.rfftfreq(4 * _SEGMENT_MS, 1e-3)
    around = float(np.median(power[(frequency > _AROUND_HZ[0]) & (frequency < _AROUND_HZ[1])]))
    lines = np.flatnonzero((frequency >= _MAINS_HZ[0]) & (frequency <= _MAINS_HZ[1]))
    peak = int(lines[np.argmax(power[lines])])
    strength = float(power[peak] / max(around, 1e-12))
    low, middle, high = np.log(np.maximum(power[peak - 1 : peak + 2], 1e-12))
    bend = low - 2 * middle + high
    shift = 0.5 * (low - high) / bend if bend < 0 else 0.0
    hertz = float(frequency[peak] + shift * (frequency[1] - frequency[0]))
    return FlickerLine(hertz, strength, max(limit, _FAINTEST))


_PARTS = 4  # rows and columns of the parts of the sensor


def find_flicker(events: Events) -> FlickerLine | None:
    """Return the strongest line near twice the mains' frequency; None of a recording of less than 0.5 s."""
    rates = _Rates()
    if len(events):
        rates.add(events)
    return rates.line()


@njit(cache=True)
def _count(t_us, x, y, p, start_us, rows, columns, counts):
    """Count each event in counts[polarity, rows[y] + columns[x], milliseconds since `start_us`]."""
    for i in range(len(t_us)):
        counts[np.int64(p[i]), rows[y[i]] + columns[x[i]], (t_us[i] - start_us) // 1000] += 1


class _Rates:
    """ON and OFF events a millisecond in 4 x 4 parts of the sensor; a spectrum for each 4.1 s of them."""

    def __init__(self) -> None:
        self._powers = np.zeros((2, 2 * _SEGMENT_MS + 1))
        self._open = np.zeros((2, _PARTS**2, _SEGMENT_MS))
        self._seen = np.zeros((2, _PARTS**2), np.bool_)
        self._segment, self._first_us, self._last_ms, self._closed = 0, 0, -1, 0

    def add(self, events: Events) -> None:
        if self._last_ms < 0:
            self._first_us = int(events.t_us[0])
        # The part that a row and a column are in, once each: to divide for every event takes long.
        rows, columns = (np.arange(side) * _PARTS // side for side in events.shape)
        span_us, done = _SEGMENT_MS * 1000, 0
        while done < len(events):
            segment = (int(events.t_us[done]) - self._first_us) // span_us
            if segment != self._segment:
                self._powers += _powers(self._open)
                self._seen |= self._open.any(axis=-1)
                self._open[:] = 0
                self._closed += 1
                self._segment = segment
            start_us = self._first_us + segment * span_us
            stop = int(np.searchsorted(events.t_us, start_us + span_us))
            mine = events[done:stop]
            _count(mine.t_us, mine.x, mine.y, mine.p, start_us, rows * _PARTS, columns, self._open)
            done = stop
        self._last_ms = (int(events.t_us[-1]) - self._first_us) // 1000

    def line(self) -> FlickerLine | None:
        """Return the strongest line; None of less than 0.5 s."""
        if self._closed:
            return _line(self._powers, self._closed, self._seen)
        return flicker_line(self._open[..., : self._last_ms + 1]) if self._last_ms >= 500 else None


Auto = Literal["auto"]
_BY_CHANCE = 0.1


@dataclass(frozen=True)
class CleanOptions:
    """What is left out of a recording.

    Args:
        hot_pixel_factor: Times the median of the pixels around above which a pixel is hot, above 1; None keeps
            all.
        flicker_hz: Frequency of the flickering light, hertz; "auto" finds it between 90 and 132 Hz, and removes
            nothing where there is none; None keeps all.
        background_us: Longest time to the events of pixels beside, microseconds; "auto" takes the time in
            which noise as dense as that of the median pixel finds them for every tenth event; None keeps all.
        background_sides: How many of the 4 pixels beside must have sent an event of that polarity, 1 to 4.

    Raises:
        ConfigError: A value outside its range.
    """

    hot_pixel_factor: float | None = 10.0
    flicker_hz: float | Auto | None = "auto"
    background_us: int | Auto | None = None
    background_sides: int = 2

    def __post_init__(self) -> None:
        if self.hot_pixel_factor is not None and not 1 < self.hot_pixel_factor < np.inf:
            raise ConfigError(f"the factor of hot pixels is {self.hot_pixel_factor}; give more than 1, or none")
        if isinstance(self.flicker_hz, float | int) and not 1 <= self.flicker_hz <= 5000:
            raise ConfigError(f"the frequency of the light is {self.flicker_hz:g} Hz; give 1 to 5000 Hz")
        if isinstance(self.background_us, float | int) and not 1 <= self.background_us <= 1e9:
            raise ConfigError(f"the background's window is {self.background_us} us; give 1 us to 1000 s")
        if not 1 <= self.background_sides <= 4:
            raise ConfigError(f"{self.background_sides} sides must support an event; give 1 to 4")


@dataclass
class CleanReport:
    """What a cleaning found and left out.

    Args:
        events: Events of the recording.
        kept: Events that stayed.
        hot_pixels: Number of hot pixels.
        hot_events: Their events.
        flicker_hz: Frequency of the flicker that was removed, hertz; None where none was.
        flicker_events: Events of it.
        background_us: Longest time to the events of pixels beside, microseconds; None where any event counts.
        background_events: Events without so much support.
    """

    events: int = 0
    kept: int = 0
    hot_pixels: int = 0
    hot_events: int = 0
    flicker_hz: float | None = None
    flicker_events: int = 0
    background_us: int | None = None
    background_events: int = 0

    def __str__(self) -> str:
        """What was left out, in words."""
        parts = []
        if self.hot_pixels:
            parts.append(f"{self.hot_events:,} events of {self.hot_pixels:,} hot pixels")
        if self.flicker_hz is not None:
            parts.append(f"{self.flicker_events:,} of flicker at {self.flicker_hz:.2f} Hz")
        if self.background_us is not None:
            parts.append(f"{self.background_events:,} without support within {self.background_us / 1e3:.3g} ms")
        return ", ".join(parts) or "nothing"


class Cleaner:
    """Cleans a recording of any length in two passes: `look` at all of it, then `clean`.

    Args:
        options: What is left out.

    Example:
        >>> events = Events([1, 5, 6, 7], [0, 1, 2, 9], [0] * 4, [1] * 4, width=10, height=1)
        >>> cleaner = Cleaner(CleanOptions(background_us=4))
        >>> cleaner.look([events])
        >>> [piece.x.tolist() for piece in cleaner.clean([events])], cleaner.report.background_events
        ([[1]], 3)
    """

    def __init__(self, options: CleanOptions | None = None) -> None:
        self.options = options or CleanOptions()
        self.report = CleanReport()
        self.hot: NDArray[np.bool_] | None = None
        """The hot pixels, bool [H, W]; None before the look, and where none are looked for."""

    def look(self, pieces: Iterable[Events]) -> None:
        """Find hot pixels, the frequency of the light, and the rate of the background.

        Raises:
            DataError: A sensor of more pixels than any has, or a background whose rate can't be told.
        """
        counts, rates, first, last = None, _Rates(), 0, 0
        for events in pieces:
            if not len(events):
                continue
            if counts is None:
                if events.width * events.height > MOST_SENSOR_PIXELS:
                    raise DataError(
                        f"a sensor of {events.width} x {events.height} pixels is more than any has; "
                        "give the true --width and --height"
                    )
                counts, first = np.zeros(events.shape, np.int64), int(events.t_us[0])
            counts += counts_of(events)
            rates.add(events)
            last = int(events.t_us[-1])
        if counts is None:
            return
        options, found = self.options, self.report
        if options.hot_pixel_factor is not None:
            self.hot = hot_by_counts(counts, options.hot_pixel_factor)
            found.hot_pixels = int(self.hot.sum())
        line = rates.line() if options.flicker_hz == "auto" else None
        if line is not None and line.is_there:
            found.flicker_hz = line.frequency_hz
        elif not isinstance(options.flicker_hz, str):
            found.flicker_hz = options.flicker_hz
        if options.background_us == "auto":
            found.background_us = _window_us(counts, last - first, options.background_sides)
        else:
            found.background_us = options.background_us

    def clean(self, pieces: Iterable[Events]) -> Iterator[Events]:
        """Yield what stays, in the order of time; the pieces are those that were looked at."""
        found = self.report
        lamps = None if found.flicker_hz is None else comb_filter(found.flicker_hz)
        support = (
            None
            if found.background_us is None
            else support_filter(found.background_us, self.options.background_sides)
        )
        filters = [one for one in (lamps, support) if one is not None]
        for piece in pieces:
            found.events += len(piece)
            events = piece if self.hot is None else without_pixels(piece, self.hot)
            found.hot_events += len(piece) - len(events)
            for one in filters:
                events = one.push(events)
            if len(events):
                found.kept += len(events)
                yield events
        for i, one in enumerate(filters):
            events = one.rest()
            for later in filters[i + 1 :]:
                if len(events):
                    events = later.push(events)
            if len(events):
                found.kept += len(events)
                yield events
        found.flicker_events = lamps.dropped if lamps else 0
        found.background_events = support.dropped if support else 0


def clean_events(events: Events, options: CleanOptions | None = None) -> tuple[Events, CleanReport]:
    """Return the events that stay, and what was found and left out; see `Cleaner` for files of any length.

    Args:
        events: The stream; it is not changed.
        options: What is left out; by default hot pixels, and the flicker of lamps where there is any.
    """
    cleaner = Cleaner(options)
    cleaner.look([events])
    kept = list(cleaner.clean([events]))
    columns = join([piece.columns() for piece in kept]) if kept else events[:0].columns()
    return trusted_events(columns, events.width, events.height), cleaner.report


@njit(cache=True)
def _turns(t_us, x, y, p, newest, gap_us):
    """Count the events of turns: a pixel's next event has the other polarity; within `gap_us`, and as far on.

    newest: -1 for each pixel, int64 [H, W]; the second count is of turns after 2 to 3 times `gap_us`: chance.
    """
    soon, late = np.zeros(len(t_us), np.bool_), np.zeros(len(t_us), np.bool_)
    for i in range(len(t_us)):
        k = newest[y[i], x[i]]
        newest[y[i], x[i]] = i
        if k >= 0 and p[k] != p[i]:
            gap = t_us[i] - t_us[k]
            if gap <= gap_us:
                soon[i] = soon[k] = True
            elif 2 * gap_us < gap <= 3 * gap_us:
                late[i] = late[k] = True
    return soon.sum(), late.sum()


def share_of_lamps(events: Events, frequency_hz: float) -> tuple[float, float]:
    """Return what share of the events lamps made, and what share its filter takes away.

    Where a ripple passes the thresholds, pixels turn from ON to OFF or back within a period; the share of such
    events, less what chance makes, is the lamps' own. A weaker ripple times the events of other light alone.

    Args:
        events: The stream, one event or more.
        frequency_hz: Frequency of the light, 1 to 5000 Hz.

    Raises:
        ConfigError: A frequency outside its range.
    """
    taken = clean_events(events, CleanOptions(None, frequency_hz))[1].flicker_events / len(events)
    newest = np.full(events.shape, -1, np.int64)
    soon, late = _turns(events.t_us, events.x, events.y, events.p, newest, round(1e6 / frequency_hz))
    return max(taken, (soon - late) / len(events)), taken


def _window_us(counts: NDArray[np.int64], duration_us: int, sides: int) -> int:
    """Return the window w in which chance supports every tenth event of noise at the median pixel's rate r.

    A side supports with q = 1 - exp(-r w) (half of its events have the polarity, before or after), and at
    least n of 4 do with a binomial probability, which grows with q.
    """
    rate = float(np.median(counts)) / max(duration_us, 1)
    if rate == 0:
        raise DataError(
            "most pixels sent no event, so the rate of the background can't be told from them; give a window "
            "in milliseconds (--background-ms 10)"
        )
    chances = np.linspace(0, 1, 10_001)[:-1]
    at_least = sum(comb(4, n) * chances**n * (1 - chances) ** (4 - n) for n in range(sides, 5))
    chance = float(np.interp(_BY_CHANCE, at_least, chances))
    return max(1, round(-np.log1p(-chance) / rate))
