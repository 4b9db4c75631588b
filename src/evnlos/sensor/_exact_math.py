"""The exact pixel's mathematics: log light, its low-pass response, and when that response meets a threshold.

Between two frames the light I(t) is a line. In the filter's own time tau, d tau = w(I(t)) dt with
w = 2 pi fc (I + 20) / 275, the response P obeys dP/d tau = L(tau) - P whatever the light does. On a short piece
L is nearly a line in tau, so P(tau) = a + b tau + c exp(-tau), which has at most one extremum; at the end of a
piece the bend of L is added to second order.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numba import njit

from evnlos.sensor._fast_math import fast_exp, fast_log


class Curve(NamedTuple):
    """How light I in DN becomes the kernels' light J = scale I + offset, and what depends on I itself.

    The log light is ln J above J = 20 and a line below; J never is below 20 for a true logarithm, which is how
    one set of kernels has both. The filter's speed is rate (J + floor), and J = stretch (I' + dark) with I' the
    light at the pixel.
    """

    scale: float
    """J per DN of the light."""
    offset: float
    """J in darkness."""
    floor: float
    """What the filter's speed adds to J."""
    stretch: float
    """J per DN at the pixel."""
    dark: float
    """Light in darkness, DN at the pixel."""


KNEE = 20.0
LOG_KNEE = math.log(KNEE)
KNEE_SLOPE = LOG_KNEE / KNEE

LOW_PASS, LOG_LINE, LINE = 0, 1, 2


@njit(cache=True, error_model="numpy", inline="always")
def log_light(intensity):
    """Return the log of the light in DN, linear up to 20 DN and continuous there."""
    logarithm = fast_log(max(intensity, KNEE))
    return intensity * KNEE_SLOPE if intensity <= KNEE else logarithm


@njit(cache=True, error_model="numpy")
def light_of(log_value):
    """Return the light in DN whose `log_light` this is."""
    return log_value / KNEE_SLOPE if log_value <= LOG_KNEE else math.exp(log_value)


@njit(cache=True, error_model="numpy", inline="always")
def bend_response(light_a, light_b, change, tau, inverse, gain, span):
    """Return what the filter's output at the end of a piece gains from the bend of the log light.

    The log light lies above its chord by 4 e s (1 - s), s = time / tau. With d its change over the piece and I
    the light in the middle, e = d^2 / 8 (1 + I / (I + 20)) above the knee and d dI / (8 (I + 20)) below. The
    filter takes 4 e J of that, J being the integral of exp(-(tau - x)) s (1 - s), at most tau / 6. `inverse` is
    1 / tau, `span` is tau / (I + 20).
    """
    middle = 0.5 * (light_a + light_b)
    lifted = span * inverse
    above = change * change * (1.0 + middle * lifted)
    below = change * (light_b - light_a) * lifted
    rest = (tau - gain) * inverse
    share = rest - 1.0 + 2.0 * rest * inverse
    return 0.5 * (above if middle > KNEE else below) * min(max(share, 0.0), tau / 6.0)


@njit(cache=True, error_model="numpy")
def response(kind, a, b, c, x):
    """Return the response of a piece at its own time x, and its first two derivatives there.

    LOW_PASS: a + b x + c exp(-x). LOG_LINE: ln(a + b x) + c x. LINE: a + b x.
    """
    if kind == LOW_PASS:
        decay = c * fast_exp(-x)
        return a + b * x + decay, b - decay, decay
    if kind == LOG_LINE:
        light = a + b * x
        growth = b / light
        return fast_log(light) + c * x, growth + c, -growth * growth
    return a + b * x, b, 0.0


@njit(cache=True, error_model="numpy")
def _extremum(kind, a, b, c):
    """Return where the response of a piece turns; it does so once, where its slope has two signs."""
    return math.log(c / b) if kind == LOW_PASS else -1.0 / c - a / b


@njit(cache=True, error_model="numpy")
def _solve(kind, a, b, c, level, low, high, value_low, value_high):
    """Return the x in [low, high] where a response that is monotone there meets `level`: bracketed Halley.

    The first guess lies on the chord. Halley's steps converge cubically: after one below 1e-4 of the bracket
    the rest is near 1e-12 of it, far below a microsecond.
    """
    rising = value_high > value_low
    enough = 1e-4 * (high - low)
    x = low + (high - low) * (level - value_low) / (value_high - value_low)
    for _ in range(60):
        value, slope, bend = response(kind, a, b, c, x)
        miss = value - level
        if (miss > 0.0) == rising:
            high = x
        else:
            low = x
        following = x - 2.0 * miss * slope / (2.0 * slope * slope - miss * bend)
        if not low <= following <= high:
            following = low + 0.5 * (high - low)
        elif abs(following - x) <= enough:
            return following
        if high - low <= 1e-11 * abs(high):
            return following
        x = following
    return x


@njit(cache=True, error_model="numpy")
def first_crossing(kind, a, b, c, low, high, start, end, level_on, level_off):
    """Return (x, +1 or -1) of the first time in (low, high] that the response reaches a level, or (high, 0).

    `start` and `end` are (value, slope) of the response at `low`, where it lies between the levels, and at
    `high`.
    """
    value_low, value_high = start[0], end[0]
    if start[1] * end[1] < 0.0:
        turn = _extremum(kind, a, b, c)
        if low < turn < high:
            value = response(kind, a, b, c, turn)[0]
            if value >= level_on:
                return _solve(kind, a, b, c, level_on, low, turn, value_low, value), 1
            if value <= level_off:
                return _solve(kind, a, b, c, level_off, low, turn, value_low, value), -1
            low, value_low = turn, value
    if value_high >= level_on:
        return _solve(kind, a, b, c, level_on, low, high, value_low, value_high), 1
    if value_high <= level_off:
        return _solve(kind, a, b, c, level_off, low, high, value_low, value_high), -1
    return high, 0
