"""The exact pixel's mathematics: log light, its low-pass response, and when that response meets a threshold.

Between two frames the light I(t) is a line. In the filter's own time tau, d tau = w(I(t)) dt with
w = 2 pi fc (I + 20) / 275, the response P obeys dP/d tau = L(tau) - P whatever the light does. On a short piece
L is a line in tau, so P(tau) = a + b tau + c exp(-tau), which has at most one extremum.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

KNEE = 20.0
LOG_KNEE = math.log(KNEE)
KNEE_SLOPE = LOG_KNEE / KNEE

LOW_PASS, LOG_LINE, LINE = 0, 1, 2
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10


@njit(cache=True, error_model="numpy", inline="always")
def fast_log(x):
    """Return ln x for a normal positive number, within 3 ulp, in a form that compilers vectorise.

    x = 2^e m with sqrt(1/2) <= m < sqrt(2), s = (m - 1) / (m + 1): ln m = 2 (s + s^3 / 3 + s^5 / 5 + ...).
    """
    bits = np.float64(x).view(np.int64)
    exponent = (bits - np.int64(0x3FE6A09E667F3BCD)) >> 52
    f = np.int64(bits - (exponent << 52)).view(np.float64) - 1.0
    s = f / (2.0 + f)
    z = s * s
    series = 2.0 / 21.0
    series = series * z + 2.0 / 19.0
    series = series * z + 2.0 / 17.0
    series = series * z + 2.0 / 15.0
    series = series * z + 2.0 / 13.0
    series = series * z + 2.0 / 11.0
    series = series * z + 2.0 / 9.0
    series = series * z + 2.0 / 7.0
    series = series * z + 2.0 / 5.0
    series = series * z + 2.0 / 3.0
    e = np.float64(exponent)
    return e * _LN2_HIGH + (2.0 * s + (s * z * series + e * _LN2_LOW))


@njit(cache=True, error_model="numpy", inline="always")
def fast_exp(x):
    """Return exp x for x <= 0 (clamped at -700), within 2 ulp, in a form that compilers vectorise."""
    x = max(x, -700.0)
    n = np.rint(x * 1.4426950408889634)
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    p = 1.0 / 479001600.0
    p = p * r + 1.0 / 39916800.0
    p = p * r + 1.0 / 3628800.0
    p = p * r + 1.0 / 362880.0
    p = p * r + 1.0 / 40320.0
    p = p * r + 1.0 / 5040.0
    p = p * r + 1.0 / 720.0
    p = p * r + 1.0 / 120.0
    p = p * r + 1.0 / 24.0
    p = p * r + 1.0 / 6.0
    p = p * r + 0.5
    p = p * r + 1.0
    p = p * r + 1.0
    return p * np.int64((np.int64(n) + 1023) << 52).view(np.float64)


@njit(cache=True, error_model="numpy", inline="always")
def log_light(intensity):
    """Return the log of the light in DN, linear up to 20 DN and continuous there."""
    logarithm = fast_log(max(intensity, KNEE))
    return intensity * KNEE_SLOPE if intensity <= KNEE else logarithm


@njit(cache=True, error_model="numpy", inline="always")
def light_of(log_value):
    """Return the light in DN whose `log_light` this is."""
    return log_value / KNEE_SLOPE if log_value <= LOG_KNEE else math.exp(log_value)


@njit(cache=True, error_model="numpy", inline="always")
def response(kind, a, b, c, x):
    """Return the response of a piece at its own time x.

    LOW_PASS: a + b x + c exp(-x). LOG_LINE: ln(a + b x) + c x. LINE: a + b x.
    """
    if kind == LOW_PASS:
        return a + b * x + c * math.exp(-x)
    if kind == LOG_LINE:
        return math.log(a + b * x) + c * x
    return a + b * x


@njit(cache=True, error_model="numpy", inline="always")
def slope(kind, a, b, c, x):
    """Return the derivative of `response` with respect to x."""
    if kind == LOW_PASS:
        return b - c * math.exp(-x)
    if kind == LOG_LINE:
        return b / (a + b * x) + c
    return b


@njit(cache=True, error_model="numpy", inline="always")
def extremum(kind, a, b, c):
    """Return where the response of a piece turns, or infinity."""
    if kind == LOW_PASS and b * c > 0.0:
        return math.log(c / b)
    if kind == LOG_LINE and b * c < 0.0:
        return -1.0 / c - a / b
    return math.inf


@njit(cache=True, error_model="numpy")
def solve(kind, a, b, c, level, low, high):
    """Return the x in [low, high] where a response that is monotone there meets `level`: bracketed Newton."""
    if kind == LINE:
        return min(max((level - a) / b, low), high)
    rising = response(kind, a, b, c, high) >= response(kind, a, b, c, low)
    x = low + 0.5 * (high - low)
    for _ in range(60):
        error = response(kind, a, b, c, x) - level
        if (error > 0.0) == rising:
            high = x
        else:
            low = x
        gradient = slope(kind, a, b, c, x)
        following = x - error / gradient if gradient != 0.0 else low
        if not low < following < high:
            following = low + 0.5 * (high - low)
        if abs(following - x) <= 1e-13 * (abs(x) + high - low) or error == 0.0:
            return following if error != 0.0 else x
        x = following
    return x


@njit(cache=True, error_model="numpy")
def first_crossing(kind, a, b, c, low, high, level_on, level_off):
    """Return (x, +1 or -1) of the first time in (low, high] that the response reaches a level, or (high, 0).

    The response at `low` must lie between the levels.
    """
    turn = extremum(kind, a, b, c)
    left = low
    for _ in range(2):
        right = min(high, turn) if left < turn else high
        value = response(kind, a, b, c, right)
        if value >= level_on:
            return solve(kind, a, b, c, level_on, left, right), 1
        if value <= level_off:
            return solve(kind, a, b, c, level_off, left, right), -1
        if right >= high:
            break
        left = right
    return high, 0
