"""Slow, obvious pixels: the model written out pixel by pixel, against which the kernels are tested."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from evnlos.cameras import EventPixel
from evnlos.cameras.pixels.arrays import pixel_thresholds
from evnlos.cameras.random_numbers import (
    BLOCK,
    STREAM_LEAK_PHASE,
    STREAM_LEAK_RATE,
    STREAM_SHOT_CHOICE,
    STREAM_SHOT_GAP,
    jitter_offset,
    jitter_table,
    random_exponential,
    random_normal,
    random_uniform,
)

Event = tuple[float, int, int]
"""Time in seconds, flat pixel index, polarity +1 or -1."""
DIM_MAX = 1.0 - 0.75 * 20.0 / 275.0  # v2e's factor of the shot noise at black, its largest value


def _log(intensity: float) -> float:
    return intensity * math.log(20.0) / 20.0 if intensity <= 20.0 else math.log(intensity)


def reference_v2e(
    frames: NDArray, times_s: NDArray, pixel: EventPixel, seed: int = 0, thresholds: object = None
) -> list[Event]:
    """Return the events of `mode="v2e"`, one plain step after the other; float64 state, so cutoff_hz > 0."""
    steps, height, width = frames.shape
    light = frames.reshape(steps, -1).astype(np.float64)  # [T, N]
    count = height * width
    on, off = pixel_thresholds(pixel, (height, width), seed, thresholds)
    on32, off32 = on.astype(np.float32), off.astype(np.float32)
    if thresholds is not None or pixel.threshold_sigma > 0:
        on, off = on32.astype(np.float64), off32.astype(np.float64)
    key = np.uint64(seed)
    filtered = [float(np.float32(np.rint(_log(v) * 1e8) / 1e8)) for v in light[0]]
    base: list[float] = [*filtered]
    factor = [
        np.float32(10 ** (0.1 * random_normal(key, STREAM_LEAK_RATE, n, 0)) * on[n]) for n in range(count)
    ]
    most = float((pixel.threshold_on / on + pixel.threshold_off / off).max())
    hazard: list[float] = [random_exponential(key, STREAM_SHOT_GAP, n, 0) for n in range(count)]
    drawn, spent = [0] * count, 0.0
    last = [float(np.float32(-pixel.refractory_s))] * count
    events: list[Event] = []
    for k in range(1, steps):
        delta = times_s[k] - times_s[k - 1]
        crossings = [0] * count
        for n in range(count):
            weight = min((light[k, n] + 20.0) / 275.0 * (delta / (1 / (math.pi * 2.0 * pixel.cutoff_hz))), 1.0)
            target = float(np.float32(np.rint(_log(light[k, n]) * 1e8) / 1e8))
            filtered[n] = (1.0 - weight) * filtered[n] + weight * target
            if pixel.leak_rate_hz > 0:
                jitter = jitter_table()[jitter_offset(key, n // BLOCK, k - 1) + n % BLOCK]
                base[n] -= pixel.leak_rate_hz * delta * factor[n] * jitter
            change = filtered[n] - base[n]
            crossings[n] = int(change // on[n]) if change > 0 else -int(-change // off[n])
        peak = max(1, max(abs(c) for c in crossings))
        subs = torch.linspace(times_s[k - 1] + delta / peak, times_s[k], peak, dtype=torch.float32).numpy()
        chance = 0.5 * pixel.shot_noise_rate_hz * delta
        top = min(chance * most * DIM_MAX, 1.0 - 1e-9)
        spent = spent - math.log1p(-top)
        for n in range(count):
            kept = 0
            for j in range(abs(crossings[n])):
                if pixel.refractory_s > delta / peak:
                    if np.float32(subs[j] - np.float32(last[n])) <= np.float32(pixel.refractory_s):
                        continue
                    last[n] = float(subs[j])
                kept += 1
                events.append((float(subs[j]), n, 1 if crossings[n] > 0 else -1))
            size = on32[n] if crossings[n] > 0 else -off32[n]
            base[n] = base[n] + float(np.float32(kept) * size)
            if top > 0 and hazard[n] <= spent:
                dim = 1.0 - 0.75 * (light[k, n] + 20.0) / 275.0
                uniform = random_uniform(key, STREAM_SHOT_CHOICE, n, drawn[n]) * top
                drawn[n] += 1
                hazard[n] = spent + random_exponential(key, STREAM_SHOT_GAP, n, drawn[n])
                sign = 0
                if uniform < chance * dim * pixel.threshold_on / on[n]:
                    sign = 1
                elif uniform > top - chance * dim * pixel.threshold_off / off[n]:
                    sign = -1
                if sign:
                    events.append((float(subs[-1]), n, sign))
                    base[n] = filtered[n]
    return events


def reference_exact(
    frames: NDArray,
    times_s: NDArray,
    pixel: EventPixel,
    seed: int = 0,
    thresholds: object = None,
    fine: int = 400,
) -> list[Event]:
    """Return the events of a continuous pixel without shot noise, hot pixels and jitter, by brute force.

    Each step is cut into `fine` pieces on which the light is constant at its middle value; the filter's output
    is the exponential response, and an event's instant is interpolated linearly inside its piece.
    """
    steps, height, width = frames.shape
    light = frames.reshape(steps, -1).astype(np.float64)  # [T, N]
    on, off = pixel_thresholds(pixel, (height, width), seed, thresholds)
    floor = pixel.cutoff_floor_dn
    light = pixel.exposure * light

    def log(value: float) -> float:
        return _log(value) if pixel.logarithm == "lin-log" else math.log(value + pixel.dark_dn)

    events: list[Event] = []
    for n in range(height * width):
        filtered = base = log(light[0, n])
        leak = 0.0
        if pixel.initial_phase == "random":
            base -= on[n] * random_uniform(np.uint64(seed), STREAM_LEAK_PHASE, n, 0)
        if pixel.leak_rate_hz > 0:
            leak = (
                pixel.leak_rate_hz
                * 10 ** (0.1 * random_normal(np.uint64(seed), STREAM_LEAK_RATE, n, 0))
                * on[n]
            )
        last = -math.inf
        for k in range(1, steps):
            piece = (times_s[k] - times_s[k - 1]) / fine
            for j in range(fine):
                start = times_s[k - 1] + j * piece
                share = (j + 0.5) / fine if pixel.cutoff_hz > 0 else (j + 1.0) / fine
                value = light[k - 1, n] + share * (light[k, n] - light[k - 1, n])
                before, lift = filtered - base, leak * piece
                if pixel.cutoff_hz > 0:
                    decay = math.exp(-2 * math.pi * pixel.cutoff_hz * (value + floor) / (255.0 + floor) * piece)
                    filtered = log(value) + (filtered - log(value)) * decay
                else:
                    filtered = log(value)
                base -= lift
                while True:
                    after = filtered - base
                    sign = 1 if after >= on[n] else -1 if after <= -off[n] else 0
                    if sign == 0:
                        break
                    level = on[n] if sign > 0 else -off[n]
                    reached = (level - before) / (after - before) if after != before else 0.0
                    moment = start + min(max(reached, 0.0), 1.0) * piece
                    moment = max(moment, last + pixel.refractory_s)
                    if moment > start + piece:
                        break
                    events.append((moment, n, sign))
                    last = moment
                    base += level
                    before -= level
    return events
