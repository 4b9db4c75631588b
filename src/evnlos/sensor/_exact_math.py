"""The exact pixel's mathematics: log light, its low-pass response, and when that response meets a threshold.

Between two frames the light I(t) is a line. In the filter's own time tau, d tau = w(I(t)) dt with
w = 2 pi fc (I + 20) / 275, the response P obeys dP/d tau = L(tau) - P whatever the light does. On a short piece
L is a line in tau, so P(tau) = a + b tau + c exp(-tau), which has at most one extremum.
"""

from __future__ import annotations

import math

from numba import njit

from evnlos.sensor._fast_math import fast_log

KNEE = 20.0
LOG_KNEE = math.log(KNEE)
KNEE_SLOPE = LOG_KNEE / KNEE

LOW_PASS, LOG_LINE, LINE = 0, 1, 2


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
