"""Kernels of the continuous-time pixel (`mode="exact"`).

A branch-free pass over a tile advances every pixel by one step in closed form and finds those that may have
sent something; only these are solved piece by piece for the instants of their events.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from evnlos.sensor._exact_pass import (
    copy_light,
    fall,
    flag_direct,
    flag_filtered,
    gain_of,
    log_row,
    respond,
)
from evnlos.sensor._exact_send import send_events
from evnlos.sensor._order import grown


@njit(cache=True, error_model="numpy")
def _run_tile(
    out, count, frames, origin, times, first, last, light, filtered, base, last_event, candidate, drawn, sent,
    on, off, leak, rate_on, rate_off, rate_hot, rate, curve, refractory, jitter, window, seed,
):  # fmt: skip
    """Run the pixels first..last - 1 through all steps of a block; see `run_tiles`."""
    out_time, out_pixel, out_on = out
    size = last - first
    flag_words = np.zeros((size + 7) // 8, np.uint64)
    flags = flag_words.view(np.uint8)
    now = np.empty((4, size))
    then = np.empty((4, size))
    now[0], now[2], now[3] = light[first:last], filtered[first:last], base[first:last]
    log_row(now[0], now[1])
    gain = np.empty(size)
    twice = 2.0 * curve.floor
    my_on, my_off, my_leak = on[first:last], off[first:last], leak[first:last]
    state = np.empty(3)
    soonest = np.inf
    if len(candidate) > 0:
        soonest = candidate[first:last].min()
    for k in range(len(frames)):
        start, stop = times[k], times[k + 1]
        copy_light(frames[k, first - origin : last - origin], curve, then[0])
        log_row(then[0], then[1])
        fall(now[3], my_leak, stop - start, then[3])
        if rate > 0.0:
            half = 0.5 * rate * (stop - start)
            gain_of(now[0], then[0], half, twice, gain)
            respond(now[0], then[0], now[1], then[1], gain, now[2], half, twice, then[2])
            flag_filtered(now, then, my_leak, half, twice, stop - start, my_on, my_off, flags[:size])
        else:
            then[2] = then[1]
            flag_direct(now, then, my_leak, stop - start, my_on, my_off, flags[:size])
        if soonest < stop:
            for i in range(size):
                flags[i] |= candidate[first + i] < stop
        at = 0
        while at < size:
            count, at = send_events(
                out_time, out_pixel, out_on, count, at, flag_words, flags, now, then, start, stop, first,
                last_event, candidate, drawn, sent, on, off, leak, rate_on, rate_off, rate_hot, rate, curve,
                refractory, jitter, window, seed, state,
            )  # fmt: skip
            if at < size:
                out_time, out_pixel, out_on = grown(out_time), grown(out_pixel), grown(out_on)
        if soonest < stop:
            soonest = candidate[first:last].min()
        now, then = then, now
    light[first:last], filtered[first:last], base[first:last] = now[0], now[2], now[3]
    return (out_time, out_pixel, out_on), count


@njit(cache=True, error_model="numpy", nogil=True)
def run_tiles(
    frames, origin, times, first, last, tile_px, light, filtered, base, last_event, candidate, drawn, sent,
    on, off, leak, rate_on, rate_off, rate_hot, rate, curve, refractory, jitter, window, seed,
):  # fmt: skip
    """Run the pixels first..last - 1 through all steps of a block, tile by tile, and return what they sent.

    `frames` [T, M] light in DN of the pixels origin..origin + M - 1 at times[1:]; `times` [T + 1] seconds;
    then [N] state (`light` on the scale of `curve`, `filtered`, `base`, `last_event` s, next shot-noise
    `candidate` s, counters `drawn`, `sent`) and constants of the pixels (thresholds, `leak` in log units/s,
    noise rates in hertz). `rate` is the filter's speed per unit of the kernels' light, 0 = no filter; `curve`
    is a `Curve`. Returns three columns: time stamp in microseconds, pixel, polarity.
    """
    out = np.empty(1024, np.int64), np.empty(1024, np.int32), np.empty(1024, np.bool_)
    count = 0
    for start in range(first, last, tile_px):
        out, count = _run_tile(
            out, count, frames, origin, times, start, min(start + tile_px, last), light, filtered, base,
            last_event, candidate, drawn, sent, on, off, leak, rate_on, rate_off, rate_hot, rate, curve,
            refractory, jitter, window, seed,
        )  # fmt: skip
    return out[0][:count], out[1][:count], out[2][:count]
