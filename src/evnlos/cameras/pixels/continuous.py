"""Kernels of the continuous-time pixel (`mode="exact"`), and what a pixel sends in one step.

- What a flagged pixel sends in one step: its light piece by piece, solved for the instants of events.

Kernels of the continuous-time pixel (`mode="exact"`).

A branch-free pass over a tile advances every pixel by one step in closed form and finds those that may have
sent something; only these are solved piece by piece for the instants of their events.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from evnlos.cameras.pixels.continuous_math import (
    KNEE,
    LINEAR,
    LOG_KNEE,
    LOG_LINEAR,
    LOW_PASS,
    PIECE,
    apply_leak,
    copy_light,
    crossing_time,
    curvature_correction,
    first_crossing,
    flag_direct,
    flag_filtered,
    gain_of,
    is_monotone,
    is_smooth,
    light_of,
    log_row,
    lowpass_step,
    response,
)
from evnlos.cameras.random_numbers import (
    STREAM_SHOT_CHOICE,
    STREAM_SHOT_GAP,
    STREAM_TIME_JITTER,
    fast_exp,
    random_exponential,
    random_normal,
    random_uniform,
)
from evnlos.cameras.streams import grown

DIM_MAX = 1.0 - 0.75 * 20.0 / 275.0
"""The factor 1 - 0.75 (I + 20) / 275 of the shot noise at black, its largest value."""


# What sends events owns no array. Without `_nrt=False` numba would count references to those that it is handed,
# by locked instructions that cost a sixth of all.
_owns_nothing = njit(cache=True, error_model="numpy", _nrt=False)  # type: ignore[call-overload]


@_owns_nothing
def _emit(out_time, out_pixel, out_on, count, time_s, pixel, on, jitter, window, seed, sent):
    """Append an event to the columns and return their fill; where they are full it is only counted."""
    if jitter > 0.0:
        time_s += jitter * random_normal(seed, STREAM_TIME_JITTER, pixel, sent[pixel])
        time_s = min(max(time_s, window[0]), window[1])
    sent[pixel] += 1
    if count < len(out_time):
        out_time[count] = np.int64(np.rint(time_s * 1e6))
        out_pixel[count] = pixel
        out_on[count] = on
    return count + 1


@njit(cache=True, error_model="numpy")
def _shot(seed, pixel, counter, intensity, rate_on, rate_off, rate_hot):
    """Return +1, -1 or 0: what a candidate of the dominating Poisson process becomes at this light."""
    uniform = random_uniform(seed, STREAM_SHOT_CHOICE, pixel, counter)
    uniform *= (rate_on + rate_off) * DIM_MAX + rate_hot
    dim = max(1.0 - 0.75 * (intensity + 20.0) / 275.0, 0.0)
    if uniform < rate_on * dim:
        return 1
    if uniform < (rate_on + rate_off) * dim:
        return -1
    if uniform < (rate_on + rate_off) * dim + 0.5 * rate_hot:
        return 1
    if uniform < (rate_on + rate_off) * dim + rate_hot:
        return -1
    return 0


@_owns_nothing
def _piece(
    out_time, out_pixel, out_on, count, pixel, start, length, light_a, light_b, log_a, log_b, filtered,
    state, constants, jitter, window, drawn, sent,
):  # fmt: skip
    """Send the events of one pixel on one piece of its light, from `start` for `length` seconds.

    `state` (reference, last event, next candidate of shot noise) is updated; returns the fill of the columns
    and the filter's output at the end of the piece.
    """
    on, off, leak, rate_on, rate_off, rate_hot, rate, curve, refractory, seed = constants
    gradient = (light_b - light_a) / length
    speed, growth = rate * (light_a + curve.floor), 0.5 * rate * gradient
    arrival = log_b
    if rate > 0.0:
        kind, end = LOW_PASS, length * (speed + growth * length)
        per_tau = (log_b - log_a) / end
        a, b, c = log_a - per_tau, per_tau + leak * length / end, filtered - log_a + per_tau
        decay = fast_exp(-end)
        arrival = a + per_tau * end + c * decay
        slope_start, slope_end = b - c, b - c * decay
        arrival += curvature_correction(
            light_a, light_b, log_b - log_a, end, 1.0 / end, 1.0 - decay, rate * length
        )
    elif max(light_a, light_b) > KNEE:
        kind, end = LOG_LINEAR, length
        a, b, c = light_a, gradient, leak
        slope_start, slope_end = b / light_a + c, b / light_b + c
    else:
        kind, end = LINEAR, length
        a, b, c = log_a, gradient * LOG_KNEE / KNEE + leak, 0.0
        slope_start = slope_end = b
    monotone = slope_start * slope_end >= 0.0
    arrived = arrival + leak * length
    now, value, slope, stale = 0.0, filtered, slope_start, False
    while True:
        ready, candidate = state[1] + refractory - start, state[2] - start
        shot_due = candidate < length
        above, below = max(value, arrived) - state[0], min(value, arrived) - state[0]
        if monotone and not shot_due and above < on and below > -off:
            break  # as most pieces end after their one event
        limit = end
        if shot_due:
            limit = max(now, candidate * (speed + growth * candidate) if kind == LOW_PASS else candidate)
        if ready >= length:
            now = end
        elif ready > 0.0:
            begin = ready * (speed + growth * ready) if kind == LOW_PASS else ready
            if begin > now:
                now, stale = begin, True
        x, sign = limit, 0
        if now < limit:
            if stale:
                value, slope, _ = response(kind, a, b, c, now)
                stale = False
            if value - state[0] >= on:
                x, sign = now, 1
            elif value - state[0] <= -off:
                x, sign = now, -1
            else:
                final = arrived, slope_end
                if limit != end:
                    final = response(kind, a, b, c, limit)[:2]
                x, sign = first_crossing(
                    kind, a, b, c, now, limit, (value, slope), final, state[0] + on, state[0] - off
                )
        if sign != 0:
            moment = x
            if kind == LOW_PASS:
                moment = 2.0 * x / (speed + math.sqrt(max(speed * speed + 4.0 * growth * x, 0.0)))
            moment = min(moment, length)
            state[0] += on if sign > 0 else -off
            if x > now:
                now, value, stale = x, state[0], True
            state[1] = start + moment
            count = _emit(
                out_time, out_pixel, out_on, count, start + moment, pixel, sign > 0, jitter, window, seed, sent
            )
        elif shot_due:
            light = (light_a + gradient * candidate) / curve.stretch - curve.dark
            choice = _shot(seed, pixel, drawn[pixel], light, rate_on, rate_off, rate_hot)
            drawn[pixel] += 1
            total = (rate_on + rate_off) * DIM_MAX + rate_hot
            when = state[2]
            state[2] += random_exponential(seed, STREAM_SHOT_GAP, pixel, drawn[pixel]) / total
            if choice != 0 and when - state[1] >= refractory:
                state[0] = response(kind, a, b, c, limit)[0]
                state[1] = when
                count = _emit(
                    out_time, out_pixel, out_on, count, when, pixel, choice > 0, jitter, window, seed, sent
                )
            now = max(now, limit)
            value, stale = response(kind, a, b, c, now)[0], True
        else:
            break
    state[0] -= leak * length
    return count, arrival


@_owns_nothing
def _step(
    out_time, out_pixel, out_on, count, pixel, start, stop, light_a, light_b, log_a, log_b, filtered,
    state, constants, jitter, window, drawn, sent,
):  # fmt: skip
    """Send the events of one pixel in one step, split at the knee of the log and into short log changes."""
    length, change = stop - start, light_b - light_a
    knee = min(light_a, light_b) < KNEE < max(light_a, light_b)
    at, at_light, at_log = 0.0, light_a, log_a
    for part in range(2 if knee else 1):
        goal, log_goal = (KNEE, LOG_KNEE) if knee and part == 0 else (light_b, log_b)
        log_from, pieces = at_log, 1
        if constants[6] > 0.0:
            pieces = max(1, math.ceil(abs(log_goal - log_from) / PIECE))
        for n in range(1, pieces + 1):
            next_light, next_log, following = goal, log_goal, length
            if n < pieces:
                next_log = log_from + (log_goal - log_from) * n / pieces
                next_light = light_of(next_log)
            if next_light != light_b:
                following = min((next_light - light_a) / change, 1.0) * length
            if following > at:
                count, filtered = _piece(
                    out_time, out_pixel, out_on, count, pixel, start + at, following - at, at_light,
                    next_light, at_log, next_log, filtered, state, constants, jitter, window, drawn, sent,
                )  # fmt: skip
            at, at_light, at_log = following, next_light, next_log
    return count, filtered


@_owns_nothing
def _cubic(
    out_time, out_pixel, out_on, count, pixel, start, length, filtered, rise, slope_0, slope_1, on, off, leak,
    state, jitter, window, seed, sent,
):  # fmt: skip
    """Send the events of one pixel in a step on which its output is a monotone cubic.

    It goes from `filtered` to `filtered + rise`, the leak among it; `slope_0` and `slope_1` are its slopes at
    both ends, log units per step. `state` (reference, last event) is updated; returns the fill of the columns.
    """
    rising = rise > 0.0
    size = on if rising else -off
    done, level = 0.0, state[0] + size - filtered
    while (rise >= level) if rising else (rise <= level):
        done = crossing_time(rise, slope_0, slope_1, level, done)
        state[0] += size
        state[1] = start + done * length
        level += size
        count = _emit(out_time, out_pixel, out_on, count, state[1], pixel, rising, jitter, window, seed, sent)
    state[0] -= leak * length
    return count


@_owns_nothing
def send_events(
    out_time, out_pixel, out_on, count, begin, flag_words, flags, now, then, start, stop, first, last_event,
    candidate, drawn, sent, on, off, leak, rate_on, rate_off, rate_hot, rate, curve, refractory, jitter, window,
    seed, state,
):  # fmt: skip
    """Send the events of a tile's flagged pixels in one step, from pixel `begin` of the tile on.

    Returns the fill of the columns, and the pixel that they had no room for (the tile's size: all had).
    """
    size, has_shot = now.shape[1], len(candidate) > 0
    length, plain = stop - start, rate > 0.0 and refractory == 0.0
    pace = rate * length
    for w in range(begin // 8, len(flag_words)):
        if flag_words[w] == 0:
            continue
        for i in range(max(8 * w, begin), min(8 * w + 8, size)):
            if flags[i] == 0:
                continue
            pixel = first + i
            drawn_0, sent_0 = drawn[pixel], sent[pixel]
            state[0], state[1] = now[3, i], last_event[pixel]
            state[2] = candidate[pixel] if has_shot else np.inf
            light_0, light_1, filtered_0, arrival = now[0, i], then[0, i], now[2, i], then[2, i]
            leaked = leak[pixel] * length
            rise = arrival - filtered_0 + leaked
            slope_0 = pace * (light_0 + curve.floor) * (now[1, i] - filtered_0) + leaked
            slope_1 = pace * (light_1 + curve.floor) * (then[1, i] - arrival) + leaked
            if (
                plain
                and state[2] >= stop
                and is_smooth(light_0, light_1, now[1, i], then[1, i], 0.5 * pace, 2.0 * curve.floor)
                and is_monotone(rise, slope_0, slope_1)
            ):
                filled = _cubic(
                    out_time, out_pixel, out_on, count, pixel, start, length, filtered_0, rise, slope_0,
                    slope_1, on[pixel], off[pixel], leak[pixel], state, jitter, window, seed, sent,
                )  # fmt: skip
            else:
                constants = (
                    on[pixel], off[pixel], leak[pixel], rate_on[pixel], rate_off[pixel], rate_hot[pixel],
                    rate, curve, refractory, seed,
                )  # fmt: skip
                filled, arrival = _step(
                    out_time, out_pixel, out_on, count, pixel, start, stop, light_0, light_1, now[1, i],
                    then[1, i], filtered_0, state, constants, jitter, window, drawn, sent,
                )  # fmt: skip
            if filled > len(out_time):
                drawn[pixel], sent[pixel] = drawn_0, sent_0
                return count, i
            count, then[2, i], then[3, i] = filled, arrival, state[0]
            last_event[pixel] = state[1]
            if has_shot:
                candidate[pixel] = state[2]
    return count, size


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
        apply_leak(now[3], my_leak, stop - start, then[3])
        if rate > 0.0:
            half = 0.5 * rate * (stop - start)
            gain_of(now[0], then[0], half, twice, gain)
            lowpass_step(now[0], then[0], now[1], then[1], gain, now[2], half, twice, then[2])
            flag_filtered(now, then, my_leak, half, twice, stop - start, my_on, my_off, flags[:size])
        else:
            then[2] = then[1]
            flag_direct(now, then, my_leak, stop - start, my_on, my_off, flags[:size])
        if soonest < stop:
            for i in range(size):
                flags[i] |= candidate[first + i] < stop
        at = np.int64(0)
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
    count = np.int64(0)
    for start in range(first, last, tile_px):
        out, count = _run_tile(
            out, count, frames, origin, times, start, min(start + tile_px, last), light, filtered, base,
            last_event, candidate, drawn, sent, on, off, leak, rate_on, rate_off, rate_hot, rate, curve,
            refractory, jitter, window, seed,
        )  # fmt: skip
    return out[0][:count], out[1][:count], out[2][:count]
