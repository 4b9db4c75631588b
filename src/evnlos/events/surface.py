"""Time surfaces of events, and the compiled loops that fill them; `surface_reference` is the slow reference.

- Time surfaces: images of how recently, and in what company, each pixel saw its events.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from evnlos.errors import DataError
from evnlos.events.volume import as_edges
from evnlos.types import Events

SUM, LAST, MAX = 0, 1, 2


@njit(cache=True)
def _exp2(powers, whole, fraction, out):
    """Fill `out` with 2 ** powers, powers in -126..0, to float32 precision, in loops for vector code.

    2 ** f on -1/2..1/2 is a Taylor polynomial, exact at 0, whose first term left out is below 6e-9; the whole
    part is written into the exponent of a float. `whole` and `fraction` are scratch.
    """
    for index in range(len(powers)):
        nearest = np.floor(powers[index] + 0.5)
        whole[index] = np.int32(nearest) + np.int32(127)
        fraction[index] = np.float32((powers[index] - nearest) * 0.6931471805599453)
    for index in range(len(powers)):
        whole[index] = whole[index] << np.int32(23)
    scale = whole.view(np.float32)
    for index in range(len(powers)):
        f = fraction[index]
        value = np.float32(1 / 5040) * f + np.float32(1 / 720)
        value = value * f + np.float32(1 / 120)
        value = value * f + np.float32(1 / 24)
        value = value * f + np.float32(1 / 6)
        value = value * f + np.float32(1 / 2)
        value = value * f + np.float32(1)
        value = value * f + np.float32(1)
        out[index] = value * scale[index]


@njit(cache=True)
def _decay_map(newest, end, tau_us, never, surface):
    """Fill `surface` with exp(-(end - newest) / tau), 0 where no event ever was."""
    scale = -1.4426950408889634 / tau_us
    size = newest.shape[1]
    powers, whole = np.empty(size, np.float64), np.empty(size, np.int32)
    fraction = np.empty(size, np.float32)
    for row in range(newest.shape[0]):
        times, out = newest[row], surface[row]
        for column in range(size):
            powers[column] = max(np.float64(end - np.int64(times[column])) * scale, -126.0)
        _exp2(powers, whole, fraction, out)
        for column in range(size):
            out[column] = np.float32(0.0) if times[column] == never or powers[column] == -126.0 else out[column]


class Grids(NamedTuple):
    """Events [N] of one sensor, and the grids that surfaces are made for.

    Args:
        t_us: Times, microseconds, ascending.
        x: Columns.
        y: Rows.
        p: Whether the light grew.
        edges: Ascending edges [grids + 1], microseconds.
        starts: Index of the first event after each edge [grids + 1].
        tau_us: Time constant, microseconds.
        carry: Whether earlier events count.
    """

    t_us: NDArray[np.int64]
    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    p: NDArray[np.bool_]
    edges: NDArray[np.int64]
    starts: NDArray[np.int64]
    tau_us: float
    carry: bool


class TimeMap(NamedTuple):
    """Times of the newest events of each pixel.

    Args:
        newest: Times since `origin`, microseconds, int32 or int64 [2, H, W], ON first; margins may surround it.
        never: What stands there where there was none.
        origin: Its zero, microseconds.
    """

    newest: NDArray
    never: int
    origin: int


class Near(NamedTuple):
    """The neighbourhood of an event, and what a surface keeps of it.

    Args:
        spans: Half width of each row of the neighbourhood, from its top to its bottom [2 radius + 1], pixels.
        is_box: Whether all rows are as wide.
        whole_area: Pixels to take the mean over; 0 = those on the sensor.
        projection: `SUM`, `LAST` or `MAX` of the events of a pixel.
        include_self: Whether an event finds itself.
    """

    spans: NDArray[np.int64]
    is_box: bool
    whole_area: int
    projection: int
    include_self: bool


# Places in flat maps are counted without a sign, or every access would be checked for a negative index.


@njit(cache=True)
def sae(grids: Grids, times: TimeMap, surfaces: NDArray) -> None:
    """Fill [grids, 2, H, W] with exp(-(end - newest) / tau), 0 where a pixel has no event."""
    t_us, x, y, p, starts, edges = grids.t_us, grids.x, grids.y, grids.p, grids.starts, grids.edges
    newest, never, origin = times
    height, width = newest.shape[1], newest.shape[2]
    flat = newest.reshape(-1)
    lines = newest.reshape(2 * height, width)
    off = np.uint32(height * width)
    first = 0 if grids.carry else starts[0]
    for grid in range(len(edges) - 1):
        if not grids.carry:
            newest[:] = never
            first = starts[grid]
        for index in range(first, starts[grid + 1]):
            pixel = np.uint32(y[index]) * np.uint32(width) + np.uint32(x[index])
            flat[pixel + (np.uint32(0) if p[index] else off)] = t_us[index] - origin
        first = starts[grid + 1]
        _decay_map(
            lines, edges[grid + 1] - origin, grids.tau_us, never, surfaces[grid].reshape(2 * height, width)
        )


@njit(cache=True)
def _put(surface, row, column, value, projection):
    held = surface[row, column]
    if projection == SUM:
        value += held
    elif projection == MAX:
        value = max(value, held)
    surface[row, column] = value


@njit(cache=True)
def context(grids: Grids, near: Near, times: TimeMap, out: NDArray) -> None:
    """Fill [grids, 2, H, W] with the projection of each event's context, exp(-(t - t*) / tau).

    t* is the newest time in the event's neighbourhood before it.

    Times ascend, so that overwriting is the maximum. For a box an event overwrites the 2 radius + 1 pixels of
    its own row that have it in reach, and t* is the maximum over the rows in reach: (2 radius + 1) writes and
    reads. For a disc, whose rows have half widths `spans` [2 radius + 1], it overwrites all pixels that have it
    in reach, and t* is one read. `newest` [2, H + 2 radius, W + 2 radius] has margins, so that no loop is cut
    at a border; they are never read for a pixel of the sensor that has no event in reach.
    """
    t_us, x, y, p, starts, edges = grids.t_us, grids.x, grids.y, grids.p, grids.starts, grids.edges
    newest, never, origin = times
    spans, is_box, include_self = near.spans, near.is_box, near.include_self
    radius = len(spans) // 2
    reach = np.uint64(len(spans))
    middle = np.uint64(radius)
    scale = -1.0 / grids.tau_us
    first = 0 if grids.carry else starts[0]
    for grid in range(len(edges) - 1):
        if not grids.carry:
            newest[:] = never
            first = starts[grid]
        for index in range(first, starts[grid + 1]):
            sign, row, column = np.uint64(0 if p[index] else 1), np.uint64(y[index]), np.uint64(x[index])
            own = newest[sign]
            time = t_us[index] - origin
            if index >= starts[grid]:
                before = np.int64(own[row + middle, column + middle])
                if is_box:
                    for step in range(reach):
                        before = max(before, np.int64(own[row + step, column + middle]))
                value = np.float32(1.0)
                if not include_self and before != time:
                    value = np.float32(0.0) if before == never else np.float32(np.exp((time - before) * scale))
                _put(out[grid, sign], row, column, value, near.projection)
            if is_box:
                line = own[row + middle]
                for step in range(reach):
                    line[column + step] = time
            else:
                for step in range(reach):
                    span = np.uint64(spans[step])
                    line = own[row + step]
                    for at in range(column + middle - span, column + middle + span + np.uint64(1)):
                        line[at] = time
        first = starts[grid + 1]


@njit(cache=True)
def hots(grids: Grids, near: Near, times: TimeMap, out: NDArray) -> None:
    """Fill [grids, 2, H, W] with the projection of each event's mean decay over its neighbourhood.

    The decay of a pixel is exp(-(t - newest) / tau), 0 where there was no event.
    """
    t_us, x, y, p, starts, edges = grids.t_us, grids.x, grids.y, grids.p, grids.starts, grids.edges
    newest, never, origin = times
    spans, whole_area, projection = near.spans, near.whole_area, near.projection
    height, width = newest.shape[1], newest.shape[2]
    radius = len(spans) // 2
    scale = -1.0 / grids.tau_us
    first = 0 if grids.carry else starts[0]
    for grid in range(len(edges) - 1):
        surface = out[grid]
        if not grids.carry:
            newest[:] = never
            first = starts[grid]
        for index in range(first, starts[grid + 1]):
            sign, row, column = 1 - np.int64(p[index]), np.int64(y[index]), np.int64(x[index])
            time = t_us[index] - origin
            if near.include_self:
                newest[sign, row, column] = time
            if index >= starts[grid]:
                total, pixels = 0.0, 0
                for step in range(max(0, row - radius), min(height, row + radius + 1)):
                    span = spans[step - row + radius]
                    for at in range(max(0, column - span), min(width, column + span + 1)):
                        before = newest[sign, step, at]
                        if before != never:
                            total += np.exp(np.float64(time - np.int64(before)) * scale)
                        pixels += 1
                value = np.float32(total / (whole_area if whole_area > 0 else pixels))
                if projection == SUM:
                    surface[sign, row, column] += value
                elif projection == LAST or value > surface[sign, row, column]:
                    surface[sign, row, column] = value
            newest[sign, row, column] = time
        first = starts[grid + 1]


Mode = Literal["sae", "context", "hots"]
Shape = Literal["box", "disc"]
Border = Literal["crop", "zero"]
Projection = Literal["sum", "last", "max"]

_PROJECTIONS = {"sum": SUM, "last": LAST, "max": MAX}


def _choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise DataError(f"{name} is {value!r}; give one of {', '.join(choices)}")


def check_surface(tau_us: float, radius: int, mode: str) -> None:
    """Refuse a time constant, a radius or a kind of surface outside its range."""
    if not (np.isfinite(tau_us) and tau_us > 0):
        raise DataError(f"tau_us is {tau_us}; give a positive number of microseconds")
    if not 0 <= radius <= 64 or int(radius) != radius:
        raise DataError(f"radius is {radius}; give 0 to 64 pixels")
    _choice("mode", mode, ("sae", "context", "hots"))


def _spans(radius: int, shape: str) -> NDArray[np.int64]:
    """Return the half width of each row of the neighbourhood, from its top to its bottom."""
    rows = np.arange(-radius, radius + 1)
    if shape == "box":
        return np.full(len(rows), radius, np.int64)
    return np.array([int(np.sqrt(radius**2 - row**2 + 1e-9)) for row in rows], np.int64)


def _time_map(events: Events, edges: NDArray[np.int64], margin: int) -> TimeMap:
    """Return a map without any event; 32 bits where they suffice."""
    origin = int(min(events.t_us[0], edges[0])) if len(events) else int(edges[0])
    shape = (2, events.height + 2 * margin, events.width + 2 * margin)
    latest = int(max(events.t_us[-1], edges[-1])) if len(events) else int(edges[-1])
    dtype, never = (np.int32, -1) if latest - origin < 2**31 else (np.int64, -1)
    return TimeMap(np.full(shape, never, dtype), never, origin)


def time_surface(
    events: Events,
    edges_us: ArrayLike,
    tau_us: float,
    mode: Mode = "sae",
    *,
    radius: int = 1,
    shape: Shape = "box",
    border: Border = "crop",
    projection: Projection = "sum",
    include_self: bool = False,
    carry: bool = True,
) -> NDArray[np.float32]:
    """Return one surface a grid and polarity.

    Grid g holds the events with edges_us[g] < t_us <= edges_us[g + 1].

    - "sae", surface of active events: exp(-(edges_us[g + 1] - t) / tau) with t the time of the pixel's last
      event of that polarity; 0 where there was none.
    - "context", equations ts1, ts2 and tsmap of the paper: every event has S = exp(-(t_i - t*) / tau) with t*
      the latest time of the same polarity within `radius`, 0 where there is none; `projection` puts the
      events of a pixel together.
    - "hots" (Lagorce et al., TPAMI 2017): S is the mean of exp(-(t_i - t) / tau) over the neighbourhood, with
      t the last time of each of its pixels, 0 where a pixel has none.

    Args:
        events: The stream; it is not changed.
        edges_us: Ascending edges, [grids + 1], microseconds.
        tau_us: Time constant, microseconds, above 0; `suggest_tau_us` has a rule.
        mode: The kind of surface.
        radius: Radius of the neighbourhood, pixels, 0 to 64; not for "sae".
        shape: "box" (2 radius + 1)^2 or "disc" (pixel centres within the radius); not for "sae".
        border: For "hots": "crop" takes the mean over the neighbours on the sensor, "zero" counts those beyond
            as pixels without events. "sae" and "context" meet no border: neighbours beyond it have no events.
        projection: "sum", "last" or "max" of the events of a pixel; not for "sae".
        include_self: Let an event find itself (j <= i as printed in the paper): "context" is then a count.
        carry: Whether earlier events, also those before the first edge, count; else each grid starts blank.

    Returns:
        float32 [grids, 2, H, W], channel 0 brighter (ON), channel 1 darker (OFF).

    Raises:
        DataError: An argument is outside its range.

    Example:
        >>> events = Events([5, 10], [0, 1], [0, 0], [True, False], width=2, height=1)
        >>> time_surface(events, [0, 10], tau_us=5.0).round(3).tolist()
        [[[[0.36800000071525574, 0.0]], [[0.0, 1.0]]]]
    """
    options: dict[str, Any] = {"radius": radius, "shape": shape, "border": border, "projection": projection}
    options |= {"include_self": include_self, "carry": carry}
    return next(iter_time_surfaces(events, edges_us, tau_us, mode, **options))


def iter_time_surfaces(
    events: Events,
    edges_us: ArrayLike,
    tau_us: float,
    mode: Mode = "sae",
    *,
    grids: int | None = None,
    radius: int = 1,
    shape: Shape = "box",
    border: Border = "crop",
    projection: Projection = "sum",
    include_self: bool = False,
    carry: bool = True,
) -> Iterator[NDArray[np.float32]]:
    """Yield what `time_surface` returns, `grids` at a time (None = all): memory does not grow with them.

    The other arguments, and the errors, are those of `time_surface`.

    Args:
        events: Events of one sensor.
        edges_us: Ascending edges, [all grids + 1], microseconds.
        tau_us: Time constant, microseconds, above 0.
        mode: The kind of surface.
        grids: Grids of a block, at least 1; None is all of them.
        radius: Radius of the neighbourhood, pixels, 0 to 64.
        shape: "box" or "disc".
        border: "crop" or "zero", for "hots".
        projection: "sum", "last" or "max" of the events of a pixel.
        include_self: Whether an event finds itself.
        carry: Whether earlier events count; else each grid starts blank.
    """
    edges = as_edges(edges_us)
    check_surface(tau_us, radius, mode)
    _choice("shape", shape, ("box", "disc"))
    _choice("border", border, ("crop", "zero"))
    _choice("projection", projection, tuple(_PROJECTIONS))
    starts = np.searchsorted(events.t_us, edges, side="right")
    times = _time_map(events, edges, int(radius) if mode == "context" else 0)
    spans = _spans(int(radius), shape)
    whole_area = int((2 * spans + 1).sum()) if border == "zero" else 0
    near = Near(spans, shape == "box", whole_area, _PROJECTIONS[projection], include_self)
    step = grids or max(len(edges) - 1, 1)
    for at in range(0, max(len(edges) - 1, 1), step):
        some, ends = edges[at : at + step + 1], starts[at : at + step + 1]
        first = 0 if at == 0 else int(ends[0])  # what came before is in `times`
        part = slice(first, int(ends[-1]))
        columns = events.t_us[part], events.x[part], events.y[part], events.p[part]
        out = np.zeros((len(some) - 1, 2, events.height, events.width), np.float32)
        inputs = Grids(*columns, some, ends - first, float(tau_us), carry)
        if mode == "sae":
            sae(inputs, times, out)
        elif mode == "context":
            context(inputs, near, times, out)
        else:
            hots(inputs, near, times, out)
        yield out
