"""Kernels of the continuous-time pixel (`mode="exact"`), and what a pixel sends in one step.

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
    Line,
    Pixel,
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
def _emit(out, count, time_s, pixel, on, law, sent):
    """Append an event to the columns and return their fill; where they are full it is only counted."""
    out_time, out_pixel, out_on = out
    if law.jitter > 0.0:
        time_s += law.jitter * random_normal(law.seed, STREAM_TIME_JITTER, pixel, sent[pixel])
        time_s = min(max(time_s, law.window[0]), law.window[1])
    sent[pixel] += 1
    if count < len(out_time):
        out_time[count] = np.int64(np.rint(time_s * 1e6))
        out_pixel[count] = pixel
        out_on[count] = on
    return count + 1


@njit(cache=True, error_model="numpy")
def _shot(seed, pixel, counter, intensity, one):
    """Return +1, -1 or 0: what a candidate of the dominating Poisson process becomes at this light, DN."""
    rate_on, rate_off, rate_hot = one.rate_on, one.rate_off, one.rate_hot
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
def _piece(out, count, pixel, start, length, line, filtered, own, one, law, drawn, sent):
    """Send the events of one pixel on one piece of its light, from `start` for `length` seconds.

    In filter time x, with dx = g (I + floor) dt, the distance from y to b is a + b x + c exp(-x); without a
    filter it is log(a + b t) + c t above the knee of the logarithm and a + b t below it, t in seconds.

    line      `Line`;  filtered  y at the start, log units
    own       reference b, last event, next candidate of shot noise: changed
    one       `Pixel`;  law  `Law`
    drawn, sent  counters of `State`, changed
    Returns the fill of the columns and the filter's output at the end of the piece.
    """
    light_a, light_b, log_a, log_b = line
    on, off, leak, rate, curve, refractory = one.on, one.off, one.leak, law.rate, law.curve, law.refractory
    seed = law.seed
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
        ready, candidate = own[1] + refractory - start, own[2] - start
        shot_due = candidate < length
        above, below = max(value, arrived) - own[0], min(value, arrived) - own[0]
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
            if value - own[0] >= on:
                x, sign = now, 1
            elif value - own[0] <= -off:
                x, sign = now, -1
            else:
                final = arrived, slope_end
                if limit != end:
                    final = response(kind, a, b, c, limit)[:2]
                x, sign = first_crossing(
                    kind, a, b, c, now, limit, (value, slope), final, own[0] + on, own[0] - off
                )
        if sign != 0:
            moment = x
            if kind == LOW_PASS:
                moment = 2.0 * x / (speed + math.sqrt(max(speed * speed + 4.0 * growth * x, 0.0)))
            moment = min(moment, length)
            own[0] += on if sign > 0 else -off
            if x > now:
                now, value, stale = x, own[0], True
            own[1] = start + moment
            count = _emit(out, count, start + moment, pixel, sign > 0, law, sent)
        elif shot_due:
            light = (light_a + gradient * candidate) / curve.stretch - curve.dark
            choice = _shot(seed, pixel, drawn[pixel], light, one)
            drawn[pixel] += 1
            total = (one.rate_on + one.rate_off) * DIM_MAX + one.rate_hot
            when = own[2]
            own[2] += random_exponential(seed, STREAM_SHOT_GAP, pixel, drawn[pixel]) / total
            if choice != 0 and when - own[1] >= refractory:
                own[0] = response(kind, a, b, c, limit)[0]
                own[1] = when
                count = _emit(out, count, when, pixel, choice > 0, law, sent)
            now = max(now, limit)
            value, stale = response(kind, a, b, c, now)[0], True
        else:
            break
    own[0] -= leak * length
    return count, arrival


@_owns_nothing
def _step(out, count, pixel, start, stop, line, filtered, own, one, law, drawn, sent):
    """Send the events of one pixel in one step, split at the knee of the log and into short log changes.

    Arguments and result are those of `_piece`; `line` is the light of the step from `start` to `stop`, seconds.
    """
    light_a, light_b, log_a, log_b = line
    length, change = stop - start, light_b - light_a
    knee = min(light_a, light_b) < KNEE < max(light_a, light_b)
    at, at_light, at_log = 0.0, light_a, log_a
    for part in range(2 if knee else 1):
        goal, log_goal = (KNEE, LOG_KNEE) if knee and part == 0 else (light_b, log_b)
        log_from, pieces = at_log, 1
        if law.rate > 0.0:
            pieces = max(1, math.ceil(abs(log_goal - log_from) / PIECE))
        for n in range(1, pieces + 1):
            next_light, next_log, following = goal, log_goal, length
            if n < pieces:
                next_log = log_from + (log_goal - log_from) * n / pieces
                next_light = light_of(next_log)
            if next_light != light_b:
                following = min((next_light - light_a) / change, 1.0) * length
            if following > at:
                part_of = Line(at_light, next_light, at_log, next_log)
                count, filtered = _piece(
                    out, count, pixel, start + at, following - at, part_of, filtered, own, one, law, drawn, sent
                )
            at, at_light, at_log = following, next_light, next_log
    return count, filtered


@_owns_nothing
def _cubic(out, count, pixel, start, length, filtered, rise, slope_0, slope_1, own, one, law, sent):
    """Send the events of one pixel in a step on which its output is a monotone cubic.

    Hermite's: y(u) = filtered + rise (3 - 2 u) u^2 + slope_0 u (1 - u)^2 - slope_1 u^2 (1 - u), u = t / length.

    filtered  output at the start;  rise  its change, the leak among it: log units
    slope_0, slope_1  slopes at both ends, log units per step
    own       reference and last event, changed;  one  `Pixel`;  law  `Law`
    Returns the fill of the columns.
    """
    on, off, leak = one.on, one.off, one.leak
    rising = rise > 0.0
    size = on if rising else -off
    done, level = 0.0, own[0] + size - filtered
    while (rise >= level) if rising else (rise <= level):
        done = crossing_time(rise, slope_0, slope_1, level, done)
        own[0] += size
        own[1] = start + done * length
        level += size
        count = _emit(out, count, own[1], pixel, rising, law, sent)
    own[0] -= leak * length
    return count


@_owns_nothing
def send_events(
    out, count, begin, flag_words, flags, now, then, start, stop, first, state, pixels, law, own
):  # fmt: skip
    """Send the events of a tile's flagged pixels in one step, from pixel `begin` of the tile on.

    begin       pixel of the tile;  first  the tile's first pixel;  start, stop  seconds
    flag_words  flags of eight pixels each, uint64;  flags  the same memory, uint8 [n]
    now, then   light, its logarithm, y and b at both ends of the step [4, n]; `then` is completed
    state       `State`, changed;  pixels  `Pixels`;  law  `Law`;  own  room for one pixel's state [3]
    Returns the fill of the columns, and the pixel that they had no room for (the tile's size: all had).
    """
    last_event, candidate, drawn, sent = state.last_event, state.candidate, state.drawn, state.sent
    on, off, leak, curve = pixels.on, pixels.off, pixels.leak, law.curve
    size, has_shot = now.shape[1], len(candidate) > 0
    length, plain = stop - start, law.rate > 0.0 and law.refractory == 0.0
    pace = law.rate * length
    for w in range(begin // 8, len(flag_words)):
        if flag_words[w] == 0:
            continue
        for i in range(max(8 * w, begin), min(8 * w + 8, size)):
            if flags[i] == 0:
                continue
            pixel = first + i
            drawn_0, sent_0 = drawn[pixel], sent[pixel]
            own[0], own[1] = now[3, i], last_event[pixel]
            own[2] = candidate[pixel] if has_shot else np.inf
            light_0, light_1, filtered_0, arrival = now[0, i], then[0, i], now[2, i], then[2, i]
            leaked = leak[pixel] * length
            rise = arrival - filtered_0 + leaked
            slope_0 = pace * (light_0 + curve.floor) * (now[1, i] - filtered_0) + leaked
            slope_1 = pace * (light_1 + curve.floor) * (then[1, i] - arrival) + leaked
            one = Pixel(
                on[pixel], off[pixel], leak[pixel],
                pixels.rate_on[pixel], pixels.rate_off[pixel], pixels.rate_hot[pixel],
            )  # fmt: skip
            if (
                plain
                and own[2] >= stop
                and is_smooth(light_0, light_1, now[1, i], then[1, i], 0.5 * pace, 2.0 * curve.floor)
                and is_monotone(rise, slope_0, slope_1)
            ):
                filled = _cubic(
                    out, count, pixel, start, length, filtered_0, rise, slope_0, slope_1, own, one, law, sent
                )
            else:
                line = Line(light_0, light_1, now[1, i], then[1, i])
                filled, arrival = _step(
                    out, count, pixel, start, stop, line, filtered_0, own, one, law, drawn, sent
                )
            if filled > len(out[0]):
                drawn[pixel], sent[pixel] = drawn_0, sent_0
                return count, i
            count, then[2, i], then[3, i] = filled, arrival, own[0]
            last_event[pixel] = own[1]
            if has_shot:
                candidate[pixel] = own[2]
    return count, size


@njit(cache=True, error_model="numpy")
def _run_tile(out, count, frames, origin, times, first, last, state, pixels, law):
    """Run the pixels first..last - 1 through all steps of a block; see `run_tiles`."""
    candidate, rate, curve = state.candidate, law.rate, law.curve
    size = last - first
    flag_words = np.zeros((size + 7) // 8, np.uint64)
    flags = flag_words.view(np.uint8)
    now = np.empty((4, size))
    then = np.empty((4, size))
    now[0], now[2], now[3] = state.light[first:last], state.filtered[first:last], state.base[first:last]
    log_row(now[0], now[1])
    gain = np.empty(size)
    twice = 2.0 * curve.floor
    my_on, my_off, my_leak = pixels.on[first:last], pixels.off[first:last], pixels.leak[first:last]
    own = np.empty(3)
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
                out, count, at, flag_words, flags, now, then, start, stop, first, state, pixels, law, own
            )
            if at < size:
                out = grown(out[0]), grown(out[1]), grown(out[2])
        if soonest < stop:
            soonest = candidate[first:last].min()
        now, then = then, now
    state.light[first:last], state.filtered[first:last], state.base[first:last] = now[0], now[2], now[3]
    return out, count


@njit(cache=True, error_model="numpy", nogil=True)
def run_tiles(frames, origin, times, first, last, tile_px, state, pixels, law):
    """Run the pixels first..last - 1 through all steps of a block, tile by tile, and return what they sent.

    Light I is linear in time between frames. With L = log I (linear below the knee) of `Curve`,

        dy/dt = g (I + floor) (L - y),  db/dt = -lambda;  b <- b +- theta at y - b = theta_on or -theta_off

    and a candidate of the shot noise's Poisson process that becomes an event sets b <- y.

    frames    light, DN [T, M], of the pixels origin..origin + M - 1 at times[1:], seconds [T + 1]
    tile_px   pixels that are run together
    state     `State`, changed;  pixels  `Pixels`;  law  `Law`
    Returns three columns: time stamp in microseconds, pixel, polarity.
    """
    out = np.empty(1024, np.int64), np.empty(1024, np.int32), np.empty(1024, np.bool_)
    count = np.int64(0)
    for start in range(first, last, tile_px):
        out, count = _run_tile(
            out, count, frames, origin, times, start, min(start + tile_px, last), state, pixels, law
        )
    return out[0][:count], out[1][:count], out[2][:count]
