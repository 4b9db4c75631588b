"""The branch-free pass of the continuous-time pixel: one step of a tile, and which pixels are to be solved."""

from __future__ import annotations

import numpy as np
from numba import njit

from evnlos.sensor._exact_math import KNEE, bend_response, log_light
from evnlos.sensor._fast_math import fast_exp

STRIDE = 0.1
"""Largest change of the log light in a step that is taken in one piece."""
PIECE = 0.04
"""Largest change of the log light in a piece on which crossings are solved: 4e-4 log units off a line."""

# Each of the following loops writes one array: with more, a compiler gives up proving that they do not overlap.


@njit(cache=True, error_model="numpy")
def log_row(row, logs):
    """Fill the log light of a row of light in DN."""
    for i in range(len(row)):
        logs[i] = log_light(row[i])


@njit(cache=True, error_model="numpy")
def copy_light(row, curve, light):
    """Take over a row of light in double precision, on the pixel's own scale."""
    for i in range(len(row)):
        light[i] = curve.scale * np.float64(row[i]) + curve.offset


@njit(cache=True, error_model="numpy")
def fall(base, leak, length, base_1):
    """Lower the references by the leak of one step."""
    for i in range(len(base)):
        base_1[i] = base[i] - leak[i] * length


@njit(cache=True, error_model="numpy")
def gain_of(light_0, light_1, half, twice, gain):
    """Fill 1 - exp(-tau), tau being the step in the filter's own time; `twice` is twice the curve's floor."""
    for i in range(len(gain)):
        gain[i] = 1.0 - fast_exp(-half * (light_0[i] + light_1[i] + twice))


@njit(cache=True, error_model="numpy")
def respond(light_0, light_1, logs_0, logs_1, gain, filtered_0, half, twice, filtered_1):
    """Fill the filter's output after one step on which the log light is a line in the filter's own time."""
    for i in range(len(gain)):
        tau = half * (light_0[i] + light_1[i] + twice)
        before = filtered_0[i]
        change = logs_1[i] - logs_0[i]
        inverse = 1.0 / tau
        bend = bend_response(light_0[i], light_1[i], change, tau, inverse, gain[i], 2.0 * half)
        filtered_1[i] = before + gain[i] * (logs_0[i] - before) + change * (1.0 - gain[i] * inverse) + bend


@njit(cache=True, error_model="numpy")
def flag_filtered(now, then, leak, half, twice, length, on, off, flags):
    """Flag the pixels that may have met a threshold, or whose light bent too much for one line."""
    light_0, logs_0, filtered_0, base = now[0], now[1], now[2], now[3]
    light_1, logs_1, filtered_1 = then[0], then[1], then[2]
    for i in range(len(leak)):
        tau = half * (light_0[i] + light_1[i] + twice)
        drift = leak[i] * length
        slope_0 = tau * (logs_0[i] - filtered_0[i]) + drift
        slope_1 = tau * (logs_1[i] - filtered_1[i]) + drift
        turn = max(abs(slope_0), abs(slope_1)) if slope_0 * slope_1 < 0.0 else 0.0
        lift_0 = filtered_0[i] - base[i]
        lift_1 = filtered_1[i] - base[i] + drift
        flags[i] = (
            (max(lift_0, lift_1) + turn >= on[i])
            | (min(lift_0, lift_1) - turn <= -off[i])
            | (abs(logs_1[i] - logs_0[i]) > STRIDE)
            | ((light_0[i] < KNEE) != (light_1[i] < KNEE))
        )


@njit(cache=True, error_model="numpy")
def flag_direct(now, then, leak, length, on, off, flags):
    """Flag the pixels that may have met a threshold on the light itself."""
    logs_0, base, logs_1 = now[1], now[3], then[1]
    for i in range(len(leak)):
        low = min(logs_0[i], logs_1[i]) - base[i]
        high = max(logs_0[i], logs_1[i]) - base[i] + leak[i] * length
        flags[i] = (high >= on[i]) | (low <= -off[i])
