"""What the scene did not cause, found in a recording and left out: hot pixels, flicker, background activity.

- Hot pixels send far more events than those around them, over the whole recording.
- Lamps on the mains make a pixel brighter and darker once a period: events that come again a period later,
  with events of the other polarity between.
- Background activity comes alone, edges do not: an event counts where a neighbour sent one at nearly that time.

The last two look at what comes after an event as well as at what came before, so neither the first event of an
edge is lost nor the first period of a lamp is kept; a stream is held back by that time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import ConfigError, DataError
from evnlos.events.files.columns import Columns, join, trusted_events
from evnlos.types import Events
from evnlos.untrusted import MOST_SENSOR_PIXELS


def keep_known_polarity(events: Events) -> Events:
    """Return the events whose polarity is known.

    A CeleX-V sends intensities: a pixel's polarity is the sign of the change since its last event, so it is
    unknown for a pixel's first event and where nothing changed. Off-pixel recordings have no polarity at all.

    Args:
        events: The stream; it is not changed, and returned as it is without the column `polarity_known`.

    Returns:
        The events with a polarity, without the column `polarity_known`; `adc` stays.

    Example:
        >>> events = Events([1, 2], [0, 0], [0, 0], [False, True], 1, 1, polarity_known=[False, True])
        >>> keep_known_polarity(events)
        Events(1 events, 1 x 1, 2..2 us, 100 % ON)
    """
    if events.polarity_known is None:
        return events
    known = events[events.polarity_known]
    return Events(known.t_us, known.x, known.y, known.p, known.width, known.height, adc=known.adc)


def crop_events(events: Events, x: int, y: int, width: int, height: int) -> Events:
    """Return the events inside a rectangle of the sensor, with coordinates from its corner.

    Args:
        events: The stream; it is not changed.
        x: First column, pixels.
        y: First row, pixels.
        width: Columns, pixels, at least 1.
        height: Rows, pixels, at least 1.

    Raises:
        ConfigError: The rectangle leaves the sensor.
    """
    check_box(events.shape, x, y, width, height)
    # Coordinates are unsigned: left of the corner they wrap around to more than the rectangle is wide.
    column, row = events.x - np.uint16(x), events.y - np.uint16(y)
    inside = (column < width) & (row < height)
    columns = {**events.columns(), "x": column, "y": row}
    return trusted_events({name: values[inside] for name, values in columns.items()}, width, height)


def check_box(shape: tuple[int, int], x: int, y: int, width: int, height: int) -> None:
    """Raise `ConfigError` unless the rectangle lies on a sensor of `shape` (rows, columns)."""
    if min(x, y) < 0 or min(width, height) < 1 or x + width > shape[1] or y + height > shape[0]:
        raise ConfigError(
            f"the box {x} {y} {width} {height} (X Y WIDTH HEIGHT) leaves the sensor of {shape[1]} x {shape[0]} "
            "pixels"
        )


@njit(cache=True)
def _hot(counts, factor, floor):
    """Mark pixels with more than `floor` events and `factor` times the median of the 24 around.

    counts: events of each pixel [H, W]; around: those of the neighbours, sorted as they come.
    """
    height, width = counts.shape
    hot = np.zeros((height, width), np.bool_)
    around = np.empty(24, np.int64)
    for row in range(height):
        for column in range(width):
            if counts[row, column] <= floor:
                continue
            size = 0
            for v in range(max(0, row - 2), min(height, row + 3)):
                for u in range(max(0, column - 2), min(width, column + 3)):
                    if v != row or u != column:
                        place = size
                        while place > 0 and around[place - 1] > counts[v, u]:
                            around[place] = around[place - 1]
                            place -= 1
                        around[place] = counts[v, u]
                        size += 1
            middle = (around[(size - 1) // 2] + around[size // 2]) / 2 if size else 0.0
            hot[row, column] = counts[row, column] > factor * max(middle, 1.0)
    return hot


def find_hot_pixels(events: Events, factor: float = 10.0, floor: int = 20) -> NDArray[np.bool_]:
    """Return which pixels send far more events than those around them.

    Args:
        events: The stream.
        factor: Times the median of the 24 pixels around (at least 1 event) above which a pixel is hot; above 1.
        floor: Events up to which a pixel is never hot.

    Returns:
        bool [H, W].

    Raises:
        DataError: A factor of 1 or less, or a negative floor.
    """
    if not factor > 1 or floor < 0:
        raise DataError(f"factor {factor} and floor {floor}; give a factor above 1 and a floor of 0 or more")
    return hot_by_counts(_counts_of(events), factor, floor)


def hot_by_counts(counts: NDArray[np.int64], factor: float = 10.0, floor: int = 20) -> NDArray[np.bool_]:
    """Return which pixels sent far more events than those around them, of their counts [H, W]."""
    return _hot(counts, float(factor), floor)


def without_pixels(events: Events, pixels: NDArray[np.bool_]) -> Events:
    """Return the events of the pixels that are not marked; `pixels` is bool [H, W]."""
    return events[~pixels[events.y, events.x]]


def _counts_of(events: Events) -> NDArray[np.int64]:
    where = events.y.astype(np.int64) * events.width + events.x
    return np.bincount(where, minlength=events.width * events.height).reshape(events.shape)


class _Chains(NamedTuple):
    """The events that are held back, and the chain of each pixel's events from the newest to older ones.

    Args:
        t_us: Times, int64 [N], microseconds, ascending.
        x: Columns, uint16 [N].
        y: Rows, uint16 [N].
        p: Whether brighter, bool [N].
        before: Number of the same pixel's event before, int64 [N]; events are numbered from the first of the
            stream, -1 = none.
        marked: What the filter found, bool [N].
        walked: Whether the chain was followed from this event on, bool [N].
        base: Number of the first event that is held.
    """

    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.bool_]
    before: NDArray[np.int64]
    marked: NDArray[np.bool_]
    walked: NDArray[np.bool_]
    base: int


@njit(cache=True)
def _mark_supported(held, start, newest, window, _):
    """Mark each event that one of the 8 pixels around supports: |t - t'| <= window.

    held: `_Chains`; start: place of the first new event; newest: number of each pixel's newest event with a
    margin of one pixel, [H + 2, W + 2]; window: microseconds.
    """
    t_us, before, marked, walked, base = held.t_us, held.before, held.marked, held.walked, held.base
    for i in range(start, len(t_us)):
        row, column, time = np.int64(held.y[i]) + 1, np.int64(held.x[i]) + 1, t_us[i]
        for v in range(row - 1, row + 2):
            for u in range(column - 1, column + 2):
                k = newest[v, u] - base
                if k < 0 or time - t_us[k] > window or (v == row and u == column):
                    continue
                marked[i] = True
                while k >= 0 and time - t_us[k] <= window:  # an earlier walk from here saw all that is older
                    marked[k] = True
                    if walked[k]:
                        break
                    walked[k] = True
                    k = before[k] - base
        before[i] = newest[row, column]
        newest[row, column] = base + i


_MOST_STEPS = 512  # back along the events of one pixel, of which one period holds far fewer


@njit(cache=True)
def _mark_repeated(held, start, newest, period, slack):
    """Mark events of one pixel and polarity a period apart, |t - t' - period| <= slack, the other between.

    held: `_Chains`; start: place of the first new event; newest: as of `_mark_supported`; period, slack:
    microseconds.
    """
    t_us, p, before, marked, base = held.t_us, held.p, held.before, held.marked, held.base
    for i in range(start, len(t_us)):
        row, column, time = np.int64(held.y[i]) + 1, np.int64(held.x[i]) + 1, t_us[i]
        before[i] = newest[row, column]
        newest[row, column] = base + i
        k, turned, steps = before[i] - base, False, 0
        while k >= 0 and time - t_us[k] <= period + slack and steps < _MOST_STEPS:
            if p[k] != p[i]:
                turned = True
            elif turned and time - t_us[k] >= period - slack:
                marked[i] = True
                marked[k] = True
            k = before[k] - base
            steps += 1


class _Held:
    """A filter that holds events back until all that can mark them are there."""

    def __init__(self, kernel: Callable, keeps_marked: bool, first_us: int, second_us: int = 0) -> None:
        self._kernel, self._keeps_marked = kernel, keeps_marked
        self._span = first_us, second_us
        self._columns: Columns | None = None
        self._before = np.empty(0, np.int64)
        self._marked = self._walked = np.empty(0, np.bool_)
        self._newest = np.empty((0, 0), np.int64)
        self._base, self._shape = 0, (0, 0)
        self.dropped = 0

    def push(self, events: Events) -> Events:
        """Take a piece, and return the earlier events that are decided and stay."""
        if self._columns is None:
            self._shape = events.shape
            self._newest = np.full((events.height + 2, events.width + 2), -1, np.int64)
        blocks = [events.columns()] if self._columns is None else [self._columns, events.columns()]
        columns, new = join(blocks), len(events)
        before = np.concatenate([self._before, np.full(new, -1, np.int64)])
        marked, walked = (
            np.concatenate([old, np.zeros(new, np.bool_)]) for old in (self._marked, self._walked)
        )
        t_us = columns["t_us"]
        held = _Chains(t_us, columns["x"], columns["y"], columns["p"], before, marked, walked, self._base)
        self._kernel(held, len(t_us) - new, self._newest, *self._span)
        decided = int(np.searchsorted(t_us, t_us[-1] - sum(self._span))) if len(t_us) else 0
        self._columns = {name: values[decided:].copy() for name, values in columns.items()}
        self._before, self._marked, self._walked = before[decided:], marked[decided:], walked[decided:]
        self._base += decided
        return self._kept({name: values[:decided] for name, values in columns.items()}, marked[:decided])

    def rest(self) -> Events:
        """Return what is still held and stays, at the end of the stream."""
        if self._columns is None:
            return Events.empty(1, 1)
        columns, self._columns = self._columns, None
        return self._kept(columns, self._marked)

    def _kept(self, columns: Columns, marked: NDArray[np.bool_]) -> Events:
        kept = marked if self._keeps_marked else ~marked
        self.dropped += len(kept) - int(np.count_nonzero(kept))
        height, width = self._shape
        return trusted_events({name: values[kept] for name, values in columns.items()}, width, height)


def keep_supported(events: Events, window_us: int) -> Events:
    """Return the events that one of the eight pixels around supports: it sent one at most `window_us` apart.

    Noise comes alone, edges do not (Delbruck, "Frame-free dynamic digital vision", 2008). Support counts from
    before and from after: what has only the past loses the first event of every edge.

    Args:
        events: The stream; it is not changed.
        window_us: Longest time to the supporting event, microseconds, at least 1.

    Raises:
        DataError: A window below 1.

    Example:
        >>> events = Events([1, 5, 6], [0, 1, 9], [0, 0, 0], [1, 1, 1], width=10, height=1)
        >>> keep_supported(events, 4).x.tolist()
        [0, 1]
    """
    if window_us < 1:
        raise DataError(f"window_us is {window_us}; give at least 1 us")
    return _all_of(_Held(_mark_supported, True, int(window_us)), events)


_SLACK = 0.1  # of a period: how far noise moves an event


def remove_flicker(events: Events, frequency_hz: float) -> Events:
    """Return the events without those that a flickering lamp made: a comb filter on events.

    An event goes where its pixel sent one of its polarity a period earlier or later (to a tenth of a period)
    and one of the other polarity between: the light went up and down and up again. The idea of a comb filter is
    that of Wang et al., "A linear comb filter for event flicker removal" (2022), which makes new events; here
    those that stay are the camera's own.

    Args:
        events: The stream; it is not changed.
        frequency_hz: Frequency of the light, 1 to 5000 Hz: twice that of the mains.

    Raises:
        DataError: A frequency outside its range.

    Example:
        >>> lamp = Events([0, 5000, 10000, 15000, 18000], [0] * 5, [0] * 5, [1, 0, 1, 0, 0], 1, 1)
        >>> remove_flicker(lamp, 100.0).t_us.tolist()
        [18000]
    """
    return _all_of(_comb(frequency_hz), events)


def _comb(frequency_hz: float) -> _Held:
    if not 1 <= frequency_hz <= 5000:
        raise DataError(f"the frequency of the light is {frequency_hz:g} Hz; give 1 to 5000 Hz")
    period_us = 1e6 / frequency_hz
    return _Held(_mark_repeated, False, round(period_us), round(_SLACK * period_us))


def _all_of(held: _Held, events: Events) -> Events:
    first = held.push(events)
    rest = held.rest()
    columns = join([first.columns(), rest.columns()])
    return trusted_events(columns, events.width, events.height)


_MAINS_HZ = (90.0, 132.0)  # twice 50 and 60 Hz, and what generators make of it
_AROUND_HZ = (80.0, 140.0)
_SEGMENT_MS = 4096
_NO_NOISE = 30.0  # times its surroundings: a chance of 2^-30 a line


@dataclass(frozen=True)
class FlickerLine:
    """The strongest line of the events' rate near twice the mains' frequency.

    Args:
        frequency_hz: Its frequency, hertz.
        strength: Its power over the median of its surroundings.
    """

    frequency_hz: float
    strength: float

    @property
    def is_there(self) -> bool:
        """Whether it is more than noise: 30 times its surroundings."""
        return self.strength >= _NO_NOISE


def flicker_line(signed: NDArray) -> FlickerLine:
    """Return the strongest line between 90 and 132 Hz of ON minus OFF events a millisecond.

    The power spectra of Hann windows of 4.1 s (or of what there is) are summed over windows and parts of the
    sensor, whose lamps may hang on other phases; a parabola through the logarithms gives the peak.

    Args:
        signed: ON minus OFF events in each millisecond, [..., N], N at least 500.

    Raises:
        DataError: Fewer than 500 milliseconds.
    """
    if signed.shape[-1] < 500:
        raise DataError(
            f"{signed.shape[-1]} ms are too short to find a frequency in; at least 500 ms are needed"
        )
    rows = signed.reshape(-1, signed.shape[-1])
    length = min(rows.shape[1], _SEGMENT_MS)
    power = np.zeros(2 * _SEGMENT_MS + 1)
    for start in range(0, rows.shape[1] - length + 1, length):
        power += _power(rows[:, start : start + length])
    return _line(power)


def _power(rows: NDArray) -> NDArray[np.float64]:
    """Return the summed power spectrum of rows [R, N] in milliseconds, padded to a step of 0.061 Hz."""
    window = np.hanning(rows.shape[1])
    tapered = (rows - rows.mean(axis=1, keepdims=True)) * window
    return (np.abs(np.fft.rfft(tapered, 4 * _SEGMENT_MS, axis=1)) ** 2).sum(axis=0)


def _line(power: NDArray[np.float64]) -> FlickerLine:
    frequency = np.fft.rfftfreq(4 * _SEGMENT_MS, 1e-3)
    around = float(np.median(power[(frequency > _AROUND_HZ[0]) & (frequency < _AROUND_HZ[1])]))
    lines = np.flatnonzero((frequency >= _MAINS_HZ[0]) & (frequency <= _MAINS_HZ[1]))
    peak = int(lines[np.argmax(power[lines])])
    strength = float(power[peak] / max(around, 1e-12))
    low, middle, high = np.log(np.maximum(power[peak - 1 : peak + 2], 1e-12))
    bend = low - 2 * middle + high
    shift = 0.5 * (low - high) / bend if bend < 0 else 0.0
    return FlickerLine(float(frequency[peak] + shift * (frequency[1] - frequency[0])), strength)


_PARTS = 4  # rows and columns of the parts of the sensor


def find_flicker(events: Events) -> FlickerLine | None:
    """Return the strongest line near twice the mains' frequency; None of a recording of less than 0.5 s."""
    rates = _Rates()
    if len(events):
        rates.add(events)
    return rates.line()


class _Rates:
    """ON minus OFF events a millisecond in 4 x 4 parts of the sensor; a spectrum for each 4.1 s of them."""

    def __init__(self) -> None:
        self._power = np.zeros(2 * _SEGMENT_MS + 1)
        self._open = np.zeros((_PARTS**2, _SEGMENT_MS))
        self._segment, self._first_us, self._last_ms, self._closed = 0, 0, -1, 0

    def add(self, events: Events) -> None:
        if self._last_ms < 0:
            self._first_us = int(events.t_us[0])
        in_ms = (events.t_us - self._first_us) // 1000
        part = (events.y.astype(np.int64) * _PARTS // events.height) * _PARTS
        part += events.x.astype(np.int64) * _PARTS // events.width
        sign = np.where(events.p, 1.0, -1.0)
        self._last_ms = int(in_ms[-1])
        for segment in np.unique(in_ms // _SEGMENT_MS):
            if segment != self._segment:
                self._power += _power(self._open)
                self._open[:] = 0
                self._closed += 1
                self._segment = int(segment)
            mine = slice(*np.searchsorted(in_ms, [segment * _SEGMENT_MS, (segment + 1) * _SEGMENT_MS]))
            place = part[mine] * _SEGMENT_MS + in_ms[mine] % _SEGMENT_MS
            self._open += np.bincount(place, sign[mine], self._open.size).reshape(self._open.shape)

    def line(self) -> FlickerLine | None:
        """Return the strongest line; None of less than 0.5 s."""
        if self._closed:
            return _line(self._power)
        return flicker_line(self._open[:, : self._last_ms + 1]) if self._last_ms >= 500 else None


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
        background_us: Longest time to the event of a neighbour, microseconds; "auto" takes the time in which
            noise as dense as that of the median pixel finds one for every tenth event; None keeps all.

    Raises:
        ConfigError: A value outside its range.
    """

    hot_pixel_factor: float | None = 10.0
    flicker_hz: float | Auto | None = "auto"
    background_us: int | Auto | None = None

    def __post_init__(self) -> None:
        if self.hot_pixel_factor is not None and not 1 < self.hot_pixel_factor < np.inf:
            raise ConfigError(f"the factor of hot pixels is {self.hot_pixel_factor}; give more than 1, or none")
        if isinstance(self.flicker_hz, float | int) and not 1 <= self.flicker_hz <= 5000:
            raise ConfigError(f"the frequency of the light is {self.flicker_hz:g} Hz; give 1 to 5000 Hz")
        if isinstance(self.background_us, float | int) and not 1 <= self.background_us <= 1e9:
            raise ConfigError(f"the background's window is {self.background_us} us; give 1 us to 1000 s")


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
        background_us: Longest time to a neighbour's event, microseconds; None where any event counts.
        background_events: Events without such a neighbour.
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
            parts.append(
                f"{self.background_events:,} that no neighbour is nearer than {self.background_us / 1e3:.3g} ms"
            )
        return ", ".join(parts) or "nothing"


class Cleaner:
    """Cleans a recording of any length in two passes: `look` at all of it, then `clean`.

    Args:
        options: What is left out.

    Example:
        >>> events = Events([1, 5, 6], [0, 1, 9], [0, 0, 0], [1, 1, 1], width=10, height=1)
        >>> cleaner = Cleaner(CleanOptions(background_us=4))
        >>> cleaner.look([events])
        >>> [piece.x.tolist() for piece in cleaner.clean([events])], cleaner.report.background_events
        ([[0, 1]], 1)
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
            counts += _counts_of(events)
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
            found.background_us = _window_us(counts, last - first)
        else:
            found.background_us = options.background_us

    def clean(self, pieces: Iterable[Events]) -> Iterator[Events]:
        """Yield what stays, in the order of time; the pieces are those that were looked at."""
        found = self.report
        comb = None if found.flicker_hz is None else _comb(found.flicker_hz)
        support = None if found.background_us is None else _Held(_mark_supported, True, found.background_us)
        filters = [one for one in (comb, support) if one is not None]
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
        found.flicker_events = comb.dropped if comb else 0
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


def _window_us(counts: NDArray[np.int64], duration_us: int) -> int:
    """Return the window in which noise at the median pixel's rate r meets one of 8 neighbours by chance.

    Before or after: 1 - exp(-16 r w) = 0.1.
    """
    rate = float(np.median(counts)) / max(duration_us, 1)
    if rate == 0:
        raise DataError(
            "most pixels sent no event, so the rate of the background can't be told from them; give a window "
            "in milliseconds (--background-ms 10)"
        )
    return max(1, round(-np.log1p(-_BY_CHANCE) / (16 * rate)))
