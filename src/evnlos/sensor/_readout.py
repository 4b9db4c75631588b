"""The kernels of the readout: arbitration, loss, events without cause, jitter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.sensor._random import (
    STREAM_RATE_CONTROL,
    STREAM_READOUT_CHOICE,
    STREAM_READOUT_GAP,
    STREAM_READOUT_JITTER,
    random_exponential,
    random_normal,
    random_uniform,
)

_WINDOW_US = 1000


class Bus(NamedTuple):
    """The arbiter's constants, microseconds."""

    rows: bool
    setup: float
    event: float
    queue: int
    width: int
    height: int


class Waiting(NamedTuple):
    """Who waits, by row: a chain of events from `head` to `tail` through `after`; -1 = none."""

    head: NDArray[np.int64]  # [rows]
    tail: NDArray[np.int64]  # [rows]
    after: NDArray[np.int64]  # [events]
    deaf: NDArray[np.bool_]  # [pixels]


@njit(cache=True, error_model="numpy")
def arbitrate(times, pixels, on, admitted, stop, free, last_row, bus, waiting, out_times, out_order):
    """Grant the bus to the events of a block until `stop`; return their number, who is lost, and the bus.

    times     when the events ask, microseconds [N], ascending; the first `admitted` wait from before
    free      when the bus is free, microseconds;  last_row  the row that was read last
    out_*     time of the grant and index of each event that was read [N]
    Returns (events read, events lost, free, last row). Events that still wait are in the chains.
    """
    count, lost, waiting_now, i, size = 0, 0, 0, 0, len(times)
    while True:
        now = free
        if waiting_now == 0:
            if i == size:
                break
            now = max(free, times[i])
        if now > stop:
            break
        while i < size and times[i] <= now:
            taken = admit(i, i < admitted, pixels, waiting_now, bus, waiting)
            waiting_now += taken
            lost += 1 - taken
            i += 1
        if waiting_now == 0:
            continue
        row, read = 0, 0
        if bus.rows:
            row = (last_row + 1) % bus.height
            while waiting.head[row] < 0:
                row = (row + 1) % bus.height
            last_row = row
        while waiting.head[row] >= 0 and (bus.rows or read == 0):
            event = waiting.head[row]
            waiting.head[row] = waiting.after[event]
            waiting.deaf[pixels[event]] = False
            out_times[count], out_order[count] = now, event
            count, read = count + 1, read + 1
        waiting_now -= read
        free = now + bus.setup + read * bus.event
    while i < size:
        taken = admit(i, i < admitted, pixels, waiting_now, bus, waiting)
        waiting_now += taken
        lost += 1 - taken
        i += 1
    return count, lost, free, last_row


@njit(cache=True, error_model="numpy")
def admit(event, before, pixels, waiting_now, bus, waiting):
    """Return 1 where an event joins those that wait, 0 where its pixel is deaf or the queue full."""
    pixel = pixels[event]
    if not before and (waiting.deaf[pixel] or (bus.queue > 0 and waiting_now >= bus.queue)):
        return 0
    row = pixel // bus.width if bus.rows else 0
    waiting.deaf[pixel] = True
    waiting.after[event] = -1
    if waiting.head[row] < 0:
        waiting.head[row] = event
    else:
        waiting.after[waiting.tail[row]] = event
    waiting.tail[row] = event
    return 1


@njit(cache=True, error_model="numpy")
def ask_without_cause(hot, rate, stop, candidate, drawn, seed, out):
    """Add what hot pixels send until `stop` seconds; return how many, also where `out` has no room for them."""
    times, pixels, on = out
    count = 0
    for n in range(len(hot)):
        pixel = hot[n]
        while candidate[n] <= stop:
            if count < len(times):
                times[count] = np.int64(np.rint(candidate[n] * 1e6))
                pixels[count] = pixel
                on[count] = random_uniform(seed, STREAM_READOUT_CHOICE, pixel, drawn[n]) < 0.5
            count += 1
            drawn[n] += 1
            candidate[n] += random_exponential(seed, STREAM_READOUT_GAP, pixel, drawn[n]) / rate
    return count


@njit(cache=True, error_model="numpy")
def thin(times, most, window, before, count, serial, seed, keep):
    """Mark which events pass the rate controller: all, or `most` of those of the window before.

    Returns the window, the counts of the one before and of this one, and the number of events so far.
    """
    for i in range(len(times)):
        this = times[i] // _WINDOW_US
        if this != window:
            before = count if this == window + 1 else 0
            window, count = this, 0
        count += 1
        keep[i] = before <= most or random_uniform(seed, STREAM_RATE_CONTROL, 0, serial) * before < most
        serial += 1
    return window, before, count, serial


@njit(cache=True, error_model="numpy")
def jittered(times, spread, first, last, serial, seed):
    """Add normal noise to time stamps, microseconds, within the recording."""
    for i in range(len(times)):
        moved = times[i] + spread * random_normal(seed, STREAM_READOUT_JITTER, 0, serial + i)
        times[i] = np.int64(np.rint(min(max(moved, first), last)))
