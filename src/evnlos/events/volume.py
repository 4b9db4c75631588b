"""Maps of events: counts in histograms, frames and voxel grids, and intensities that a camera sends along.

- Asking the processor for memory before it is needed, which numba has no name for.
- The intensities that some cameras send with their events, as an image.
- Counts of events: histograms, frames, voxel grids, and the threshold-ordinal surface.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import DataError
from evnlos.types import Events

# Told apart with every common kind of colour blindness, and in grey print: fully opaque, ON is lighter than OFF
# by 50 of 255 or more. Each stands out from white and from the dark grounds that are drawn on.
ON_RGB = (226, 120, 0)
"""Colour of events that are brighter: orange."""
OFF_RGB = (32, 87, 228)
"""Colour of events that are darker: blue."""
ON_HEX, OFF_HEX = ("#{:02x}{:02x}{:02x}".format(*colour) for colour in (ON_RGB, OFF_RGB))
WORDS = "orange brighter, blue darker"
"""What a caption says of them."""


def as_edges(edges_us: ArrayLike) -> NDArray[np.int64]:
    """Return edges as int64 [grids + 1], microseconds.

    Raises:
        DataError: Fewer than two edges, edges that are not whole microseconds, or that do not ascend.
    """
    given = np.asarray(edges_us)
    if given.ndim != 1 or len(given) < 2:
        raise DataError(f"edges_us has shape {given.shape}; give at least two edges in one row")
    if given.dtype.kind == "f":
        if not np.isfinite(given).all() or (given != np.round(given)).any():
            raise DataError("edges_us holds fractions or NaN; give whole microseconds")
    elif given.dtype.kind not in "iu":
        raise DataError(f"edges_us has dtype {given.dtype}; give whole microseconds")
    edges = given.astype(np.int64)
    backwards = np.flatnonzero(edges[1:] <= edges[:-1])
    if len(backwards):
        at = int(backwards[0])
        raise DataError(f"edges_us goes from {edges[at]} to {edges[at + 1]} us; edges must ascend")
    return edges


def edges_from_rate(start_us: int, stop_us: int, rate_hz: float) -> NDArray[np.int64]:
    """Return edges every 1 / `rate_hz` seconds from `start_us` to the last that does not pass `stop_us`.

    Args:
        start_us: First edge, microseconds.
        stop_us: End, microseconds, after the start.
        rate_hz: Grids a second, above 0 and at most 1e6.

    Raises:
        DataError: The rate is out of its range or not one grid fits.

    Example:
        >>> edges_from_rate(0, 1_000_000, 3.0)
        array([      0,  333333,  666667, 1000000])
    """
    if not 0 < rate_hz <= 1e6:
        raise DataError(f"rate_hz is {rate_hz}; give more than 0 and at most 1e6 grids a second")
    grids = int((stop_us - start_us) * rate_hz / 1e6 + 1e-9)
    if grids < 1:
        raise DataError(f"no grid of {1e6 / rate_hz:.0f} us fits {start_us}..{stop_us} us; raise the rate")
    return start_us + np.round(np.arange(grids + 1) * (1e6 / rate_hz)).astype(np.int64)


def edges_from_count(events: Events, count: int) -> NDArray[np.int64]:
    """Return edges between which `count` events lie each; events of one time stay in one grid.

    Args:
        events: The stream, not empty.
        count: Events a grid, at least 1; the last grid may hold fewer.

    Raises:
        DataError: No events, or a count below 1.
    """
    if count < 1:
        raise DataError(f"count is {count}; give at least one event a grid")
    if not len(events):
        raise DataError("no events to divide into grids; give explicit edges")
    last_of_grid = events.t_us[count - 1 :: count]
    return np.unique(np.concatenate([[events.t_us[0] - 1], last_of_grid, events.t_us[-1:]]))


def suggest_tau_us(stroke_width_m: float, speed_m_s: float) -> float:
    """Return the time constant, microseconds, in which the target moves by the width of its stroke.

    A shorter one forgets the stroke's leading edge before its trailing edge arrives; a longer one blurs
    neighbouring positions.

    Args:
        stroke_width_m: Width of the strokes of the hidden target, metres, above 0.
        speed_m_s: Its speed, metres per second, above 0.

    Raises:
        DataError: A width or speed that is not positive.

    Example:
        >>> suggest_tau_us(0.008, 0.02)
        400000.0
    """
    if not (stroke_width_m > 0 and speed_m_s > 0):
        raise DataError(f"stroke {stroke_width_m} m at {speed_m_s} m/s; both must be positive")
    return stroke_width_m / speed_m_s * 1e6


def _prefetch(typing_context, array, index):
    """Begin to fetch the cache line of `array[index]`, contiguous and of one dimension, and go on at once.

    A load would hold up the instructions behind it until its line has come.
    """
    signature = types.void(array, types.uint64)

    def generate(context, builder, _, arguments):
        data = context.make_array(array)(context, builder, arguments[0]).data
        place = builder.bitcast(builder.gep(data, [arguments[1]]), cgutils.voidptr_t)
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [place, number(1), number(3), number(1)])  # to write, keep near, data
        return context.get_dummy_value()

    return signature, generate


prefetch: Any = intrinsic(_prefetch)  # (array, index)


@njit(cache=True)
def _hold(x, y, adc, starts, peak, carry, empty, out):
    first = 0 if carry else starts[0]
    for grid in range(len(out)):
        if grid and carry:
            out[grid] = out[grid - 1]
        else:
            out[grid] = empty
        if not carry:
            first = starts[grid]
        for index in range(first, starts[grid + 1]):
            out[grid, y[index], x[index]] = np.float32(adc[index]) / peak
        first = starts[grid + 1]


def intensity_map(
    events: Events,
    edges_us: ArrayLike | None = None,
    *,
    peak: int = 4095,
    carry: bool = True,
    empty: float = 0.0,
) -> NDArray[np.float32]:
    """Return the last intensity of each pixel: the image that a CeleX-V in EI mode sends along with its
    events.

    Args:
        events: A stream with the column `adc`; it is not changed.
        edges_us: Edges of the grids, [grids + 1], microseconds; one grid of all events without them.
        peak: Digital number that becomes 1: 4095 for 12 bits, 255 for event format 0.
        carry: Whether a pixel keeps its value from grid to grid, and that of events before the first edge.
        empty: Value of a pixel that has sent none yet; NaN tells it from black.

    Returns:
        float32 [grids, H, W], 0..1, at the instants edges_us[g + 1].

    Raises:
        DataError: The events have no intensities, the edges do not ascend, or the peak is not positive.

    Example:
        >>> events = Events([5, 6, 9], [0, 0, 1], [0, 0, 0], [0, 1, 0], 2, 1, adc=[819, 4095, 0])
        >>> intensity_map(events, [0, 5, 9], empty=0.5).tolist()
        [[[0.20000000298023224, 0.5]], [[1.0, 0.0]]]
    """
    if events.adc is None:
        raise DataError("these events have no intensities (adc); record in the mode EI, or use time_surface")
    if peak < 1:
        raise DataError(f"peak is {peak}; give the largest digital number, such as 4095")
    if edges_us is None:
        starts = np.array([0, len(events)], np.int64)
    else:
        starts = np.searchsorted(events.t_us, as_edges(edges_us), side="right")
    out = np.empty((len(starts) - 1, events.height, events.width), np.float32)
    _hold(events.x, events.y, events.adc, starts, np.float32(peak), carry, np.float32(empty), out)
    return out


_AHEAD = 64  # events between asking for a pixel and using it: a map is larger than the caches


def _starts(events: Events, edges_us: ArrayLike | None) -> NDArray[np.int64]:
    """Return the index of each grid's first event; without edges all events are one grid."""
    if edges_us is None:
        return np.array([0, len(events)], np.int64)
    return np.searchsorted(events.t_us, as_edges(edges_us), side="right")


@njit(cache=True, inline="always")
def _pixel(x, y, index, width):
    """Return the place of an event; without a sign, or every access would be checked for a negative index."""
    return np.uint32(y[index]) * np.uint32(width) + np.uint32(x[index])


@njit(cache=True)
def _count(x, y, p, starts, height, width, out):
    off, one = np.uint32(height * width), out.dtype.type(1)
    for grid in range(len(starts) - 1):
        counts = out[grid].reshape(-1)
        for index in range(starts[grid], starts[grid + 1]):
            later = min(index + _AHEAD, len(x) - 1)
            prefetch(counts, np.uint64(_pixel(x, y, later, width) + (np.uint32(0) if p[later] else off)))
            counts[_pixel(x, y, index, width) + (np.uint32(0) if p[index] else off)] += one


def event_histogram(events: Events, edges_us: ArrayLike | None = None) -> NDArray[np.float32]:
    """Return the number of events per pixel and polarity.

    Args:
        events: The stream; it is not changed.
        edges_us: Edges of the grids, [grids + 1], microseconds; one grid of all events without them.

    Returns:
        float32 [grids, 2, H, W], channel 0 brighter (ON), channel 1 darker (OFF).

    Raises:
        DataError: The edges do not ascend.

    Example:
        >>> events = Events([5, 6, 7], [0, 0, 1], [0, 0, 0], [True, True, False], width=2, height=1)
        >>> event_histogram(events).tolist()
        [[[[2.0, 0.0]], [[0.0, 1.0]]]]
    """
    starts = _starts(events, edges_us)
    exact = len(events) < 2**24  # whole numbers that a float32 holds
    out = np.zeros((len(starts) - 1, 2, events.height, events.width), np.float32 if exact else np.uint32)
    _count(events.x, events.y, events.p, starts, events.height, events.width, out)
    return out.astype(np.float32, copy=False)


@njit(cache=True)
def _last(x, y, p, starts, out):
    for grid in range(len(starts) - 1):
        for index in range(starts[grid], starts[grid + 1]):
            out[grid, y[index], x[index]] = 1.0 if p[index] else -1.0


def event_frame(
    events: Events, edges_us: ArrayLike | None = None, mode: Literal["sum", "last"] = "sum"
) -> NDArray[np.float32]:
    """Return signed frames: the sum of the polarities of each pixel (+1, -1), or the sign of its last event.

    Args:
        events: The stream; it is not changed.
        edges_us: Edges of the grids, [grids + 1], microseconds; one grid of all events without them.
        mode: "sum" or "last".

    Returns:
        float32 [grids, H, W], 0 where there was no event.

    Raises:
        DataError: The edges do not ascend or the mode is unknown.
    """
    if mode == "sum":
        counts = event_histogram(events, edges_us)
        return counts[:, 0] - counts[:, 1]
    if mode != "last":
        raise DataError(f"mode is {mode!r}; give sum or last")
    starts = _starts(events, edges_us)
    out = np.zeros((len(starts) - 1, events.height, events.width), np.float32)
    _last(events.x, events.y, events.p, starts, out)
    return out


@njit(cache=True)
def _vote(t_us, x, y, p, first, scale, bins, out):
    """Add the votes; the two bins in use lie side by side in `pair`, so that an event touches one place."""
    height, width = out.shape[1], out.shape[2]
    pair = np.zeros((height * width, 2), np.float32)
    places = pair.reshape(-1)
    bin_now = 0
    for index in range(len(t_us)):
        place = np.float64(t_us[index] - first) * scale
        low = min(np.int64(place), bins - 1)
        while bin_now < low:
            _shift(pair, out[bin_now].reshape(-1))
            bin_now += 1
        prefetch(places, np.uint64(2 * _pixel(x, y, min(index + _AHEAD, len(x) - 1), width)))
        part = np.float32(place - low)
        sign = np.float32(1.0) if p[index] else np.float32(-1.0)
        pixel = _pixel(x, y, index, width)
        pair[pixel, np.uint32(0)] += sign - sign * part
        pair[pixel, np.uint32(1)] += sign * part
    for last in range(bin_now, bins):
        _shift(pair, out[last].reshape(-1))


@njit(cache=True)
def _shift(pair, done):
    """Hand over the finished bin and make the next one the first of the pair."""
    for pixel in range(len(done)):
        done[pixel] = pair[pixel, 0]
        pair[pixel, 0] = pair[pixel, 1]
        pair[pixel, 1] = 0.0


def voxel_grid(
    events: Events, bins: int, start_us: int | None = None, stop_us: int | None = None
) -> NDArray[np.float32]:
    """Return signed votes, shared between the two nearest bins of time (Zhu et al., CVPR 2019, eq. 1-3).

    Bin b collects sign * max(0, 1 - |b - (bins - 1) (t - start) / (stop - start)|).

    Args:
        events: The stream; it is not changed.
        bins: Bins of time, at least 1.
        start_us: Time of the first bin, microseconds, by default the first event's; earlier ones are left out.
        stop_us: Time of the last bin, microseconds, by default the last event's; later ones are left out.

    Returns:
        float32 [bins, H, W].

    Raises:
        DataError: Not a whole number of bins, fewer than one, or an end before the start.

    Example:
        >>> events = Events([0, 25, 100], [0, 1, 0], [0, 0, 0], [True, False, True], width=2, height=1)
        >>> voxel_grid(events, 2).tolist()
        [[[1.0, -0.75]], [[1.0, -0.25]]]
    """
    if not isinstance(bins, int | np.integer) or bins < 1:
        raise DataError(f"bins is {bins}; give a whole number, at least 1")
    out = np.zeros((bins, events.height, events.width), np.float32)
    if not len(events):
        return out
    first = int(events.t_us[0]) if start_us is None else int(start_us)
    last = int(events.t_us[-1]) if stop_us is None else int(stop_us)
    if last < first:
        raise DataError(f"the voxel grid ends at {last} us before it starts at {first} us")
    low, high = np.searchsorted(events.t_us, first, "left"), np.searchsorted(events.t_us, last, "right")
    scale = (bins - 1) / (last - first) if last > first else 0.0
    inside = slice(int(low), int(high))
    _vote(events.t_us[inside], events.x[inside], events.y[inside], events.p[inside], first, scale, bins, out)
    return out


@njit(cache=True)
def _ordinal(x, y, radius, threshold, out):
    height, width = out.shape
    for index in range(len(x)):
        row, column = np.int64(y[index]), np.int64(x[index])
        for v in range(max(0, row - radius), min(height, row + radius + 1)):
            for u in range(max(0, column - radius), min(width, column + radius + 1)):
                value = out[v, u]
                out[v, u] = value - 1 if value > threshold else 0
        out[row, column] = 255


def threshold_ordinal_surface(
    events: Events, radius: int = 3, threshold: int | None = None
) -> NDArray[np.uint8]:
    """Return the threshold-ordinal surface: an event is 255 and takes one from each of its neighbours.

    Neighbours that would fall below the threshold become 0 (Glover, Dinale, De Souza Rosa, Bamford,
    Bartolozzi, "luvHarris", TPAMI 2021).

    Args:
        events: The stream; it is not changed.
        radius: Radius of the square neighbourhood, pixels, 1 to 64.
        threshold: Smallest value kept, 1 to 254; by default 255 - 2 (2 radius + 1), not below 1.

    Returns:
        uint8 [H, W].

    Raises:
        DataError: A radius or threshold outside its range.
    """
    if not 1 <= radius <= 64:
        raise DataError(f"radius is {radius}; give 1 to 64 pixels")
    floor = max(1, 255 - 2 * (2 * radius + 1)) if threshold is None else threshold
    if not 1 <= floor <= 254:
        raise DataError(f"threshold is {floor}; give 1 to 254")
    out = np.zeros((events.height, events.width), np.uint8)
    _ordinal(events.x, events.y, radius, floor, out)
    return out
