"""The kernels of the Brownian pixel: exact first passages of a drifting Brownian motion, one tile at a time."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.sensor._fast_math import fast_log
from evnlos.sensor._order import grown
from evnlos.sensor._random import (
    STREAM_BARRIER,
    STREAM_LEAK_PHASE,
    STREAM_PASSAGE,
    STREAM_PENDING,
    STREAM_WALK,
    random_normal,
    random_normals,
    random_uniform,
)

_SAFE = 8.0
_STRIDE = 0.2


class Law(NamedTuple):
    """The equation's constants; symbols as in the module's first lines."""

    dark: float  # k, DN
    leak: float  # theta_on r, log units per s
    leak_light: float  # theta_on s, log units per s and DN
    photon: float  # a, log units sqrt(DN / s)
    floor: float  # b, log units per sqrt(s)
    exposure: float
    linear: bool  # whether changes of light are taken relative to their mean
    seed: np.uint64


class State(NamedTuple):
    """The pixels, [N] each: x is normal around `mean` with `variance` while it cannot have met a threshold."""

    light: NDArray[np.float64]  # DN
    mean: NDArray[np.float64]  # log units since the last event
    low: NDArray[np.float64]  # least mean since x was last drawn
    high: NDArray[np.float64]  # greatest mean since then
    variance: NDArray[np.float64]  # of what was not drawn yet, log units squared
    drawn: NDArray[np.uint32]  # sub-steps of the walk so far
    pending: NDArray[np.uint32]  # draws of what was pending so far


@njit(cache=True, error_model="numpy", inline="always")
def passage(d0, d1, spread, normal, uniform):
    """Return at which share of a step a walk meets a barrier, given that it does.

    d0, d1    distance to the barrier at the start and at the end of the step, log units; d1 < 0 beyond it
    spread    sigma^2 h, variance of the step
    The time is h s / (1 + s) with s inverse Gaussian of mean d0 / |d1| and shape d0^2 / spread (a Brownian
    bridge: the drift cancels), drawn as Michael, Schucany and Haas do (The American Statistician 30, 1976).
    """
    mean = d0 / max(abs(d1), 1e-12 * d0)
    w = 0.5 * mean * normal * normal * spread / (d0 * d0)
    root = 1.0 + w + math.sqrt(w * (w + 2.0))
    s = mean / root
    if uniform * (mean + s) > mean:
        s = mean * root
    return s / (1.0 + s)


@njit(cache=True, error_model="numpy")
def walk(out, count, pixel, start, length, x, drift, noise, on, off, seed, drawn):
    """Send a pixel's events of one step; return the fill of the columns, x at its end, and the draws so far.

    x       log units since the last event, at `start`
    drift   mu, log units per s;  noise  sigma, log units per sqrt(s)
    on, off thresholds, log units
    In sub-steps h with sigma sqrt(h) <= 0.2 thresholds: x' = x + mu h + sigma sqrt(h) n; a threshold at the
    distances d0 and d1 is met if x' lies beyond it, else with probability exp(-2 d0 d1 / (sigma^2 h)).
    """
    times, pixels, polarity = out
    longest = length
    if noise > 0.0:
        longest = (_STRIDE * min(on, off) / noise) ** 2
    at = 0.0
    while at < length:
        h = min(longest, length - at)
        spread = noise * noise * h
        x1 = x + drift * h
        up, down = on - x, x + off
        share, sign = 2.0, 0
        if spread > 0.0:
            x1 += math.sqrt(spread) * random_normal(seed, STREAM_WALK, pixel, drawn)
            up1, down1 = on - x1, x1 + off
            base = 4 * np.int64(drawn)
            met_on = up1 <= 0.0 or random_uniform(seed, STREAM_BARRIER, pixel, base) < math.exp(
                -2.0 * up * up1 / spread
            )
            met_off = down1 <= 0.0 or random_uniform(seed, STREAM_BARRIER, pixel, base + 1) < math.exp(
                -2.0 * down * down1 / spread
            )
            if met_on or met_off:
                one, other = random_normals(seed, STREAM_PASSAGE, pixel, drawn)
                if met_on:
                    uniform = random_uniform(seed, STREAM_BARRIER, pixel, base + 2)
                    share, sign = passage(up, up1, spread, one, uniform), 1
                if met_off:
                    uniform = random_uniform(seed, STREAM_BARRIER, pixel, base + 3)
                    when = passage(down, down1, spread, other, uniform)
                    if when < share:
                        share, sign = when, -1
            drawn += 1
        elif x1 >= on:
            share, sign = up / (x1 - x), 1
        elif x1 <= -off:
            share, sign = down / (x - x1), -1
        if sign == 0:
            x = x1
            at = at + h if h < length - at else length
            continue
        at = min(at + share * h, length)
        x = 0.0
        if count < len(times):
            times[count] = np.int64(np.rint((start + at) * 1e6))
            pixels[count] = pixel
            polarity[count] = sign > 0
        count += 1
    return count, x, drawn


# Each of the following loops writes one array: with more, a compiler gives up proving that they do not overlap.


@njit(cache=True, error_model="numpy")
def log_row(light, dark, logs):
    """Fill the logarithm of the light and the dark current."""
    for i in range(len(light)):
        logs[i] = fast_log(light[i] + dark)


@njit(cache=True, error_model="numpy")
def change_row(light, light_1, logs, logs_1, law, length, change):
    """Fill what the mean moves in a step: the change of log light, and the leak."""
    for i in range(len(light)):
        middle = 0.5 * (light[i] + light_1[i])
        step = logs_1[i] - logs[i]
        if law.linear:
            step = (light_1[i] - light[i]) / (middle + law.dark)
        change[i] = step + (law.leak + law.leak_light * middle) * length


@njit(cache=True, error_model="numpy")
def variance_row(light, light_1, variance, law, length, variance_1):
    """Fill the variance of what is not drawn yet at the end of a step."""
    for i in range(len(light)):
        middle = 0.5 * (light[i] + light_1[i])
        noise = law.photon * math.sqrt(middle) / (middle + law.dark) + law.floor
        variance_1[i] = variance[i] + noise * noise * length


@njit(cache=True, error_model="numpy")
def mean_row(mean, change, mean_1):
    """Fill the mean at the end of a step."""
    for i in range(len(mean)):
        mean_1[i] = mean[i] + change[i]


@njit(cache=True, error_model="numpy")
def lowest_row(low, mean_1, low_1):
    """Fill the lowest mean so far."""
    for i in range(len(low)):
        low_1[i] = min(low[i], mean_1[i])


@njit(cache=True, error_model="numpy")
def highest_row(high, mean_1, high_1):
    """Fill the highest mean so far."""
    for i in range(len(high)):
        high_1[i] = max(high[i], mean_1[i])


@njit(cache=True, error_model="numpy")
def flag_row(low, high, variance, on, off, flags):
    """Flag the pixels that may have met a threshold: fewer than eight standard deviations from one."""
    for i in range(len(flags)):
        up, down = on[i] - high[i], off[i] + low[i]
        reach = _SAFE * _SAFE * variance[i]
        flags[i] = (up <= 0.0) | (down <= 0.0) | (up * up <= reach) | (down * down <= reach)


@njit(cache=True, error_model="numpy")
def run_tile(out, count, frames, origin, times, first, last, state, on, off, law):
    """Run the pixels first..last - 1 through all steps; return the columns and their fill."""
    size = last - first
    now, then = np.empty((6, size)), np.empty((6, size))  # light, log light, mean, low, high, variance
    change, flags = np.empty(size), np.empty(size, np.bool_)
    on, off = on[first:last], off[first:last]
    now[0], now[2], now[3] = state.light[first:last], state.mean[first:last], state.low[first:last]
    now[4], now[5] = state.high[first:last], state.variance[first:last]
    log_row(now[0], law.dark, now[1])
    for k in range(len(frames)):
        start, length = times[k], times[k + 1] - times[k]
        row = frames[k, first - origin : last - origin]
        light = then[0]
        for i in range(size):
            light[i] = law.exposure * np.float64(row[i])
        log_row(then[0], law.dark, then[1])
        change_row(now[0], then[0], now[1], then[1], law, length, change)
        mean_row(now[2], change, then[2])
        lowest_row(now[3], then[2], then[3])
        highest_row(now[4], then[2], then[4])
        variance_row(now[0], then[0], now[5], law, length, then[5])
        flag_row(then[3], then[4], then[5], on, off, flags)
        for i in range(size):
            if not flags[i]:
                continue
            pixel = first + i
            x, step_variance = now[2, i], then[5, i] - now[5, i]
            if now[5, i] > 0.0:
                x += math.sqrt(now[5, i]) * random_normal(law.seed, STREAM_PENDING, pixel, state.pending[pixel])
                x = min(max(x, -off[i]), on[i])
                state.pending[pixel] += np.uint32(1)
            end = x + change[i]
            low, high = min(x, end), max(x, end)
            gap = min(on[i] - high, off[i] + low)
            if gap > 0.0 and gap * gap > _SAFE * _SAFE * step_variance:
                then[2, i], then[3, i], then[4, i], then[5, i] = end, low, high, step_variance
                continue
            noise, drift = math.sqrt(step_variance / length), change[i] / length
            while True:
                filled, end, drawn = walk(
                    out, count, pixel, start, length, x, drift, noise, on[i], off[i], law.seed,
                    state.drawn[pixel],
                )  # fmt: skip
                if filled <= len(out[0]):
                    break
                out = grown(out[0]), grown(out[1]), grown(out[2])
            count, state.drawn[pixel] = filled, drawn
            then[2, i] = then[3, i] = then[4, i] = end
            then[5, i] = 0.0
        now, then = then, now
    state.light[first:last], state.mean[first:last], state.low[first:last] = now[0], now[2], now[3]
    state.high[first:last], state.variance[first:last] = now[4], now[5]
    return out, count


@njit(cache=True, error_model="numpy", nogil=True)
def run_tiles(frames, origin, times, first, last, tile_px, state, on, off, law):
    """Run the pixels first..last - 1 through a block of light, tile by tile, and return what they sent.

    frames   light, DN [T, M], of the pixels origin..origin + M - 1 at times[1:], seconds [T + 1]
    state    `State`, changed;  on, off  thresholds, log units [N];  law  `Law`
    Returns three columns: time stamp in microseconds, pixel, polarity.
    """
    out = np.empty(1024, np.int64), np.empty(1024, np.int32), np.empty(1024, np.bool_)
    count = 0
    for start in range(first, last, tile_px):
        out, count = run_tile(
            out, count, frames, origin, times, start, min(start + tile_px, last), state, on, off, law
        )
    return out[0][:count], out[1][:count], out[2][:count]


@njit(cache=True, error_model="numpy")
def settled(light, on, off, law):
    """Return states x of pixels that have long seen constant light, drawn from their density.

    With c = 2 mu / sigma^2 the density is 1 - exp(-c (on - x)) above 0 and, below,
    (1 - exp(-c on)) (exp(c x) - exp(-c off)) / (1 - exp(-c off)); its integral is inverted by bisection.
    """
    x = np.zeros(len(light))
    for i in range(len(light)):
        noise = law.photon * math.sqrt(light[i]) / (light[i] + law.dark) + law.floor
        drift = law.leak + law.leak_light * light[i]
        uniform = random_uniform(law.seed, STREAM_LEAK_PHASE, i, 0)
        if drift == 0.0 and noise == 0.0:
            continue
        c = 2.0 * drift / (noise * noise) if noise > 0.0 else np.inf
        if c * on[i] > 1e8:
            x[i] = uniform * on[i]
            continue
        low, high = -off[i], on[i]
        total = mass_below(on[i], c, on[i], off[i])
        for _ in range(60):
            middle = 0.5 * (low + high)
            if mass_below(middle, c, on[i], off[i]) < uniform * total:
                low = middle
            else:
                high = middle
        x[i] = 0.5 * (low + high)
    return x


@njit(cache=True, error_model="numpy")
def mass_below(x, c, on, off):
    """Return the integral of the settled density, up to a factor, from -off to x."""
    if c * (on + off) < 1e-5:  # a tent
        left = 0.5 * on / off * (min(x, 0.0) + off) ** 2
        return left if x <= 0.0 else left + on * x - 0.5 * x * x
    below = min(x, 0.0)
    factor = math.expm1(-c * on) / math.expm1(-c * off)
    left = factor * ((math.exp(c * below) - math.exp(-c * off)) / c - (below + off) * math.exp(-c * off))
    if x <= 0.0:
        return left
    return left + x + (math.exp(-c * on) - math.exp(-c * (on - x))) / c
