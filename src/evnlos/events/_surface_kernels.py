"""Compiled loops of the time surfaces; `surface_reference` says the same slowly."""

from __future__ import annotations

import numpy as np
from numba import njit

SUM, LAST, MAX = 0, 1, 2


@njit(cache=True)
def _decay_map(newest, end, tau_us, never, surface):
    """Fill `surface` with exp(-(end - newest) / tau), 0 where no event ever was."""
    scale = -1.0 / tau_us
    for sign in range(newest.shape[0]):
        for row in range(newest.shape[1]):
            for column in range(newest.shape[2]):
                time = newest[sign, row, column]
                if time == never:
                    surface[sign, row, column] = 0.0
                else:
                    surface[sign, row, column] = np.exp(np.float64(end - np.int64(time)) * scale)


@njit(cache=True)
def sae(t_us, x, y, p, edges, starts, tau_us, carry, newest, never, origin, surfaces):
    """Fill [grids, 2, H, W]; `newest` [2, H, W] holds times since `origin`, `never` where there is none."""
    first = 0 if carry else starts[0]
    for grid in range(len(edges) - 1):
        if not carry:
            newest[:] = never
            first = starts[grid]
        for index in range(first, starts[grid + 1]):
            newest[1 - np.int64(p[index]), y[index], x[index]] = t_us[index] - origin
        first = starts[grid + 1]
        _decay_map(newest, edges[grid + 1] - origin, tau_us, never, surfaces[grid])


@njit(cache=True)
def context(
    t_us, x, y, p, edges, starts, tau_us, carry, projection, include_self, spans, newest, never, origin, out
):
    """Fill [grids, 2, H, W] with the projection of each event's context.

    `newest` holds, for each pixel and sign, the latest time at which an event had that pixel in its
    neighbourhood: times ascend, so overwriting the neighbourhood is the maximum, and t* is one read.
    `spans` [2 radius + 1] is the neighbourhood's half width in each of its rows.
    """
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
            before = newest[sign, row, column]
            if index >= starts[grid]:
                if include_self:
                    value = np.float32(1.0)
                elif before == never:
                    value = np.float32(0.0)
                else:
                    value = np.float32(np.exp(np.float64(time - np.int64(before)) * scale))
                if projection == SUM:
                    surface[sign, row, column] += value
                elif projection == LAST or value > surface[sign, row, column]:
                    surface[sign, row, column] = value
            for step in range(max(0, row - radius), min(height, row + radius + 1)):
                span = spans[step - row + radius]
                for at in range(max(0, column - span), min(width, column + span + 1)):
                    newest[sign, step, at] = time
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
