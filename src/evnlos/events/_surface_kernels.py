"""Compiled loops of the time surfaces; `surface_reference` says the same slowly."""

from __future__ import annotations

import numpy as np
from numba import njit

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


# Places in flat maps are counted without a sign, or every access would be checked for a negative index.


@njit(cache=True)
def sae(t_us, x, y, p, edges, starts, tau_us, carry, newest, never, origin, surfaces):
    """Fill [grids, 2, H, W]; `newest` [2, H, W] holds times since `origin`, `never` where there is none."""
    height, width = newest.shape[1], newest.shape[2]
    flat = newest.reshape(-1)
    lines = newest.reshape(2 * height, width)
    off = np.uint32(height * width)
    first = 0 if carry else starts[0]
    for grid in range(len(edges) - 1):
        if not carry:
            newest[:] = never
            first = starts[grid]
        for index in range(first, starts[grid + 1]):
            pixel = np.uint32(y[index]) * np.uint32(width) + np.uint32(x[index])
            flat[pixel + (np.uint32(0) if p[index] else off)] = t_us[index] - origin
        first = starts[grid + 1]
        _decay_map(lines, edges[grid + 1] - origin, tau_us, never, surfaces[grid].reshape(2 * height, width))


@njit(cache=True)
def _put(surface, row, column, value, projection):
    held = surface[row, column]
    if projection == SUM:
        value += held
    elif projection == MAX:
        value = max(value, held)
    surface[row, column] = value


@njit(cache=True)
def context(
    t_us,
    x,
    y,
    p,
    edges,
    starts,
    tau_us,
    carry,
    projection,
    include_self,
    spans,
    is_box,
    newest,
    never,
    origin,
    out,
):
    """Fill [grids, 2, H, W] with the projection of each event's context.

    Times ascend, so that overwriting is the maximum. For a box an event overwrites the 2 radius + 1 pixels of
    its own row that have it in reach, and t* is the maximum over the rows in reach: (2 radius + 1) writes and
    reads. For a disc, whose rows have half widths `spans` [2 radius + 1], it overwrites all pixels that have it
    in reach, and t* is one read. `newest` [2, H + 2 radius, W + 2 radius] has margins, so that no loop is cut
    at a border; they are never read for a pixel of the sensor that has no event in reach.
    """
    radius = len(spans) // 2
    reach = np.uint64(len(spans))
    middle = np.uint64(radius)
    scale = -1.0 / tau_us
    first = 0 if carry else starts[0]
    for grid in range(len(edges) - 1):
        if not carry:
            newest[:] = never
            first = starts[grid]
        for index in range(first, starts[grid + 1]):
            sign, row, column = np.uint64(0 if p[index] else 1), np.uint64(y[index]), np.uint64(x[index])
            times = newest[sign]
            time = t_us[index] - origin
            if index >= starts[grid]:
                before = np.int64(times[row + middle, column + middle])
                if is_box:
                    for step in range(reach):
                        before = max(before, np.int64(times[row + step, column + middle]))
                value = np.float32(1.0)
                if not include_self and before != time:
                    value = np.float32(0.0) if before == never else np.float32(np.exp((time - before) * scale))
                _put(out[grid, sign], row, column, value, projection)
            if is_box:
                line = times[row + middle]
                for step in range(reach):
                    line[column + step] = time
            else:
                for step in range(reach):
                    span = np.uint64(spans[step])
                    line = times[row + step]
                    for at in range(column + middle - span, column + middle + span + np.uint64(1)):
                        line[at] = time
        first = starts[grid + 1]


@njit(cache=True)
def hots(
    t_us,
    x,
    y,
    p,
    edges,
    starts,
    tau_us,
    carry,
    projection,
    include_self,
    spans,
    whole_area,
    newest,
    never,
    origin,
    out,
):
    """Fill [grids, 2, H, W] with the projection of each event's mean decay over its neighbourhood."""
    height, width = newest.shape[1], newest.shape[2]
    radius = len(spans) // 2
    scale = -1.0 / tau_us
    first = 0 if carry else starts[0]
    for grid in range(len(edges) - 1):
        surface = out[grid]
        if not carry:
            newest[:] = never
            first = starts[grid]
        for index in range(first, starts[grid + 1]):
            sign, row, column = 1 - np.int64(p[index]), np.int64(y[index]), np.int64(x[index])
            time = t_us[index] - origin
            if include_self:
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
