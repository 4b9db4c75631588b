"""Kernels of the frame-stepped pixel (`mode="v2e"`): one fused pass over a tile of pixels and a block of steps.

A tile keeps its state in the cache while time runs, the arithmetic of a step is branch-free over the tile, and
only pixels that crossed a threshold are visited one by one. Nothing depends on the tiling.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.cameras.pixels.continuous_math import log_light
from evnlos.cameras.random_numbers import (
    BLOCK,
    STREAM_SHOT_CHOICE,
    STREAM_SHOT_GAP,
    jitter_offset,
    random_exponential,
    random_uniform,
)


class State(NamedTuple):
    """What changes: one value per pixel, [N]; single precision without a filter, double with one."""

    low_pass: NDArray  # y, log units
    base: NDArray  # b, log units: what the next event is counted from
    hazard: NDArray[np.float64]  # H at which the next candidate of shot noise is due; empty without shot noise
    drawn: NDArray[np.uint32]  # candidates so far


class Pixels(NamedTuple):
    """What stays: one value per pixel, [N]."""

    on: NDArray  # theta_on, log units
    off: NDArray  # theta_off, log units
    step_on: NDArray[np.float32]  # theta_on as v2e adds it to b
    step_off: NDArray[np.float32]
    leak: NDArray[np.float32]  # theta_on times a factor of the pixel, log units; empty without leak
    ratio_on: NDArray[np.float64]  # nominal threshold / theta_on
    ratio_off: NDArray[np.float64]


class Steps(NamedTuple):
    """One value per step of the block, [T]."""

    rate: NDArray[np.float64]  # 2 pi f_c d: filter's speed times the step's length; 0 = no filter
    leaked: NDArray[np.float64]  # r d, leak events per step
    hazard_sum: NDArray[np.float64]  # H at the end of the step
    chance: NDArray[np.float64]  # [T, 2]: nominal chance of one polarity, and of a candidate
    peak: NDArray[np.int32]  # takes the largest number of crossings of a pixel


class Law(NamedTuple):
    """What holds for the whole recording."""

    table: NDArray[np.float32]  # logarithms of 8-bit light [256]; empty for other light
    jitter: NDArray[np.float32]  # factors of the leak, of which each step and block takes a run
    seed: np.uint64
    defer: bool  # b stays where it is at a crossing: the caller decides which events pass


@njit(cache=True, error_model="numpy", inline="always")
def lin_log(intensity):
    """Return the logarithm of the light in DN, linear up to 20 DN, with v2e's rounding to 1e-8 and float32.

    A product with 1e-8 stands for the division by 1e8: no k / 1e8 lies within 7e-14 of itself from the middle
    of two float32 numbers, so both give the same one.
    """
    return np.float32(np.rint(log_light(intensity) * 1e8) * 1e-8)


@njit(cache=True, error_model="numpy", inline="always")
def brightness(intensity):
    """Return the factor (I + 20) / 275 that scales bandwidth and shot noise with the light."""
    return (intensity + 20.0) / 275.0


@njit(cache=True, error_model="numpy", inline="always")
def floor_divide(value, threshold):
    """Return floor(value / threshold) for positive numbers by way of fmod, as tensor libraries round it."""
    rest = np.fmod(value, threshold)
    ratio = (value - rest) / threshold
    floor = np.floor(ratio)
    if ratio - floor > 0.5:
        floor += 1.0
    return np.int64(floor)


@njit(cache=True, error_model="numpy", inline="always")
def shot_choice(seed, pixel, counter, chance_on, chance_off, chance_max):
    """Return +1, -1 or 0: what a candidate that came with probability `chance_max` becomes."""
    uniform = random_uniform(seed, STREAM_SHOT_CHOICE, pixel, counter) * chance_max
    if uniform < chance_on:
        return 1
    if uniform > chance_max - chance_off:
        return -1
    return 0


# Each of the following loops writes one array: with more, a compiler gives up proving that they do not overlap.


@njit(cache=True, error_model="numpy")
def log_row(row, log_out):
    """Fill the logarithms of a row of light."""
    for i in range(len(row)):
        log_out[i] = lin_log(np.float64(row[i]))


@njit(cache=True, error_model="numpy")
def _look_up(row, table, log_out):
    """Fill the logarithms of a row of 8-bit light from the table of its 256 values."""
    for i in range(len(row)):
        log_out[i] = table[np.uint8(row[i])]


@njit(cache=True, error_model="numpy")
def _filter(row, log_in, rate, lp):
    """Move the filter towards the new logarithms, by a weight of (I + 20) / 275 d 2 pi fc, at most 1."""
    for i in range(len(lp)):
        weight = min(brightness(np.float64(row[i])) * rate, 1.0)
        lp[i] = (1.0 - weight) * lp[i] + weight * np.float64(log_in[i])


@njit(cache=True, error_model="numpy")
def _flag(lp, base, on, off, flags):
    """Flag the pixels beyond a threshold."""
    for i in range(len(lp)):
        change = lp[i] - base[i]
        flags[i] = (change >= on[i]) | (-change >= off[i])


@njit(cache=True, error_model="numpy")
def _leak(base, leak, scale, jitter, seed, first, step):
    """Lower the references of the pixels from `first` on by one step of leak, jittered block by block.

    Indices are unsigned: an index that can't be negative needs no test, and the loop becomes vectors.
    """
    for start in range(0, len(base), BLOCK):
        offset = np.uint64(jitter_offset(seed, (first + start) // BLOCK, step))
        begin = np.uint64(start)
        for i in range(np.uint64(min(BLOCK, len(base) - start))):
            base[begin + i] -= (scale * leak[begin + i]) * jitter[offset + i]


@njit(cache=True, error_model="numpy")
def _grown(column):
    """Return a copy of a column with twice its length."""
    longer = np.empty(2 * len(column), column.dtype)
    longer[: len(column)] = column
    return longer


@njit(cache=True, error_model="numpy")
def _run_tile(out, count, frames, origin, first, last, first_step, state, pixels, time, law):
    """Run the pixels first..last - 1 through all steps of a block; see `run_tiles`."""
    hazard, drawn, step_on, step_off = state.hazard, state.drawn, pixels.step_on, pixels.step_off
    rate, hazard_sum, chance, table, seed = time.rate, time.hazard_sum, time.chance, law.table, law.seed
    size = last - first
    steps = len(rate)
    my_lp, my_base = state.low_pass[first:last], state.base[first:last]
    my_on, my_off, my_leak = pixels.on[first:last], pixels.off[first:last], pixels.leak[first:last]
    words = (size + 7) // 8
    flag_words = np.zeros(words, np.uint64)
    flags = flag_words.view(np.uint8)
    logs = np.empty(size, np.float32)
    head = np.full(steps, -1, np.int64)
    chain = np.empty(size, np.int64)
    has_shot = len(hazard) > 0
    if has_shot:
        for i in range(size):
            if hazard[first + i] <= hazard_sum[-1]:
                due = np.searchsorted(hazard_sum, hazard[first + i])
                chain[i] = head[due]
                head[due] = i
    out_step, out_pixel, out_crossings, out_shot = out
    filtered = rate[0] > 0.0
    for k in range(steps):
        row = frames[k, first - origin : last - origin]
        if time.leaked[k] > 0.0:
            _leak(my_base, my_leak, np.float32(time.leaked[k]), law.jitter, seed, first, first_step + k)
        if len(table) > 0:
            _look_up(row, table, logs)
        else:
            log_row(row, logs)
        if filtered:
            _filter(row, logs, rate[k], my_lp)
        else:
            my_lp[:] = logs
        _flag(my_lp, my_base, my_on, my_off, flags[:size])
        if has_shot:
            i = head[k]
            while i >= 0:
                flags[i] |= 2
                i = chain[i]
        for w in range(words):
            if flag_words[w] == 0:
                continue
            for i in range(8 * w, min(8 * w + 8, size)):
                if flags[i] == 0:
                    continue
                pixel = first + i
                crossings = 0
                if flags[i] & 1:
                    change = my_lp[i] - my_base[i]
                    if change > 0:
                        crossings = floor_divide(change, my_on[i])
                        if not law.defer:
                            my_base[i] += np.float32(crossings) * step_on[pixel]
                    else:
                        crossings = -floor_divide(-change, my_off[i])
                        if not law.defer:
                            my_base[i] -= np.float32(-crossings) * step_off[pixel]
                    time.peak[k] = max(time.peak[k], abs(crossings))
                shot = 0
                if flags[i] & 2:
                    dim = 1.0 - 0.75 * brightness(np.float64(row[i]))
                    shot = shot_choice(
                        seed, pixel, drawn[pixel], chance[k, 0] * dim * pixels.ratio_on[pixel],
                        chance[k, 0] * dim * pixels.ratio_off[pixel], chance[k, 1],
                    )  # fmt: skip
                    drawn[pixel] += 1
                    hazard[pixel] = hazard_sum[k] + random_exponential(
                        seed, STREAM_SHOT_GAP, pixel, drawn[pixel]
                    )
                    due = np.searchsorted(hazard_sum, hazard[pixel])
                    if due <= k:
                        due = k + 1
                    if due < steps:
                        chain[i] = head[due]
                        head[due] = i
                    if shot != 0:
                        my_base[i] = my_lp[i]
                if crossings != 0 or shot != 0:
                    if count == len(out_step):
                        out_step, out_pixel = _grown(out_step), _grown(out_pixel)
                        out_crossings, out_shot = _grown(out_crossings), _grown(out_shot)
                    out_step[count] = k
                    out_pixel[count] = pixel
                    out_crossings[count] = crossings
                    out_shot[count] = shot
                    count += 1
    return (out_step, out_pixel, out_crossings, out_shot), count


@njit(cache=True, error_model="numpy", nogil=True)
def run_tiles(frames, origin, first, last, tile_px, first_step, state, pixels, time, law):
    """Run the pixels first..last - 1 through all steps of a block, tile by tile, and return what they sent.

    In each step of length d, with I the light in DN and L = log I (linear below 20 DN):

        y <- (1 - w) y + w L,  w = min((I + 20) / 275 * 2 pi f_c d, 1)
        b <- b - r d leak * jitter
        n = floor((y - b) / theta_on) ON events, or floor((b - y) / theta_off) OFF events;  b <- b +- n theta
        a candidate of shot noise is due when the sum H of -log(1 - chance) reaches its hazard; as event: b <- y

    frames      light, DN [T, M], of the pixels origin..origin + M - 1
    tile_px     pixels that are run together, a multiple of `BLOCK`
    first_step  number of the block's first step since the start
    state       `State`, changed;  pixels  `Pixels`;  time  `Steps`, its peak changed;  law  `Law`
    Returns four columns: step, pixel, signed number of threshold crossings, sign of a shot-noise event.
    """
    out = np.empty(1024, np.int32), np.empty(1024, np.int32), np.empty(1024, np.int32), np.empty(1024, np.int8)
    count = np.int64(0)
    for start in range(first, last, tile_px):
        out, count = _run_tile(
            out, count, frames, origin, start, min(start + tile_px, last), first_step, state, pixels, time, law
        )
    return out[0][:count], out[1][:count], out[2][:count], out[3][:count]


@njit(cache=True, error_model="numpy")
def settle(record, sub_times, period, last_event, state, pixels):
    """Let the events of one step that keep the refractory period pass: those with t - last > period.

    record      columns of `run_tiles`: step, pixel, signed crossings, sign of a shot-noise event
    sub_times   times of a pixel's first, second, ... event, float32 seconds [M]
    period      refractory period, seconds; 0 = all pass
    last_event  time of each pixel's last event, float32 seconds [N], changed
    state       `State`: only events that pass move b, others are deferred;  pixels  `Pixels`
    Returns three columns: index into `sub_times`, pixel, polarity.
    """
    step, pixel, crossings, shot = record
    base, step_on, step_off = state.base, pixels.step_on, pixels.step_off
    total = 0
    for i in range(len(step)):
        total += abs(crossings[i]) + 1
    out_sub = np.empty(total, np.int64)
    out_pixel = np.empty(total, np.int32)
    out_on = np.empty(total, np.bool_)
    count = 0
    for i in range(len(step)):
        where = pixel[i]
        kept = 0
        for j in range(abs(crossings[i])):
            if period > 0.0:
                if sub_times[j] - last_event[where] <= period:
                    continue
                last_event[where] = sub_times[j]
            kept += 1
            out_sub[count], out_pixel[count], out_on[count] = j, where, crossings[i] > 0
            count += 1
        if shot[i] != 0:
            out_sub[count], out_pixel[count], out_on[count] = len(sub_times) - 1, where, shot[i] > 0
            count += 1
        elif crossings[i] > 0:
            base[where] += np.float32(kept) * step_on[where]
        else:
            base[where] -= np.float32(kept) * step_off[where]
    return out_sub[:count], out_pixel[:count], out_on[:count]
