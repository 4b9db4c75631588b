"""The mathematics of the continuous-time pixel: its response to light, and when it crosses a level.

The exact pixel's mathematics: log light, its low-pass response, and when that response meets a threshold.

Between two frames the light I(t) is a line. In the filter's own time tau, d tau = w(I(t)) dt with
w = 2 pi fc (I + 20) / 275, the response P obeys dP/d tau = L(tau) - P whatever the light does. On a short piece
L is nearly a line in tau, so P(tau) = a + b tau + c exp(-tau), which has at most one extremum; at the end of a
piece the bend of L is added to second order.

- The branch-free pass of the continuous-time pixel: one step of a tile, and which pixels are to be solved.

Crossings on a step that needs no pieces: the filter's output there is a cubic, known by its two ends.

The output's values at both ends come from the closed form of the step, its slopes there from the filter's
equation dP/dt = w(I) (L - P). The cubic with these (Hermite's) misses the output by at most h^4 / 384 times its
fourth derivative, which is tau^3 / 384 of what the output would move in the step at its steepest slope; tau is
the step in the filter's own time. So up to tau = 1 an event is off by less than 0.3 % of the step, unless the
output all but turns at the threshold, on short steps by far less, and takes no exponentials.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.cameras.event_model import KNEE_DN, KNEE_SLOPE
from evnlos.cameras.random_numbers import fast_exp, fast_log


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


class State(NamedTuple):
    """What changes: one value per pixel, [N]."""

    light: NDArray[np.float64]  # I on the scale of `Curve`
    filtered: NDArray[np.float64]  # y, log units
    base: NDArray[np.float64]  # b, log units: what the next event is counted from
    last_event: NDArray[np.float64]  # seconds; -inf = none yet
    candidate: NDArray[np.float64]  # next candidate of shot noise, seconds; empty without noise
    drawn: NDArray[np.uint32]  # candidates so far
    sent: NDArray[np.uint32]  # events so far


class Pixels(NamedTuple):
    """What stays: one value per pixel, [N]."""

    on: NDArray[np.float64]  # theta_on, log units
    off: NDArray[np.float64]  # theta_off, log units
    leak: NDArray[np.float64]  # lambda, log units per second
    rate_on: NDArray[np.float64]  # shot noise at black, ON, hertz
    rate_off: NDArray[np.float64]  # shot noise at black, OFF, hertz
    rate_hot: NDArray[np.float64]  # of a hot pixel, both polarities, hertz


class Pixel(NamedTuple):
    """One pixel's `Pixels`."""

    on: float
    off: float
    leak: float
    rate_on: float
    rate_off: float
    rate_hot: float


class Law(NamedTuple):
    """What holds for all pixels."""

    rate: float  # g, speed of the filter per unit of light, hertz; 0 = no filter
    curve: Curve
    refractory: float  # seconds
    jitter: float  # standard deviation of time stamps, seconds
    window: tuple[float, float]  # in which jittered time stamps stay, seconds
    seed: np.uint64


class Line(NamedTuple):
    """Light that is linear in time: at a piece's start and end, and its logarithms."""

    light_a: float
    light_b: float
    log_a: float
    log_b: float


KNEE = KNEE_DN
LOG_KNEE = math.log(KNEE)

LOW_PASS, LOG_LINEAR, LINEAR = 0, 1, 2


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
def curvature_correction(light_a, light_b, change, tau, inverse, gain, span):
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

    LOW_PASS: a + b x + c exp(-x). LOG_LINEAR: ln(a + b x) + c x. LINEAR: a + b x.
    """
    if kind == LOW_PASS:
        decay = c * fast_exp(-x)
        return a + b * x + decay, b - decay, decay
    if kind == LOG_LINEAR:
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
def apply_leak(base, leak, length, base_1):
    """Lower the references by the leak of one step."""
    for i in range(len(base)):
        base_1[i] = base[i] - leak[i] * length


@njit(cache=True, error_model="numpy")
def gain_of(light_0, light_1, half, twice, gain):
    """Fill 1 - exp(-tau), tau being the step in the filter's own time; `twice` is twice the curve's floor."""
    for i in range(len(gain)):
        gain[i] = 1.0 - fast_exp(-half * (light_0[i] + light_1[i] + twice))


@njit(cache=True, error_model="numpy")
def lowpass_step(light_0, light_1, logs_0, logs_1, gain, filtered_0, half, twice, filtered_1):
    """Fill the filter's output after one step on which the log light is a line in the filter's own time."""
    for i in range(len(gain)):
        tau = half * (light_0[i] + light_1[i] + twice)
        before = filtered_0[i]
        change = logs_1[i] - logs_0[i]
        inverse = 1.0 / tau
        bend = curvature_correction(light_0[i], light_1[i], change, tau, inverse, gain[i], 2.0 * half)
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


LONGEST_TAU = 1.0
"""Longest step in the filter's own time on which its output counts as a cubic."""


@njit(cache=True, error_model="numpy", inline="always")
def is_smooth(light_0, light_1, log_0, log_1, half, twice):
    """Return whether the light of a step bends so little, and the step is so short, that a cubic will do."""
    tau = half * (light_0 + light_1 + twice)
    return abs(log_1 - log_0) <= STRIDE and tau <= LONGEST_TAU and (light_0 < KNEE) == (light_1 < KNEE)


@njit(cache=True, error_model="numpy", inline="always")
def is_monotone(rise, slope_0, slope_1):
    """Return whether the cubic from 0 to `rise` on [0, 1] with these slopes has no turn: both 0 to 3 chords."""
    first, second = slope_0 * rise, slope_1 * rise
    most = 3.0 * rise * rise
    return rise != 0.0 and 0.0 <= first <= most and 0.0 <= second <= most


@njit(cache=True, error_model="numpy", inline="always")
def crossing_time(rise, slope_0, slope_1, level, low):
    """Return the s in [low, 1] where a monotone cubic from 0 to `rise` on [0, 1] meets `level`.

    Halley's steps converge cubically; where one leads out of the bracket, the bracket is halved. The last step
    is from where the tangent meets the level within 1e-4.
    """
    bend, twist = 3.0 * rise - 2.0 * slope_0 - slope_1, slope_0 + slope_1 - 2.0 * rise
    high, s = 1.0, min(max(level / rise, low), 1.0)
    for _ in range(60):
        miss = s * (slope_0 + s * (bend + s * twist)) - level
        if (miss > 0.0) == (rise > 0.0):
            high = s
        else:
            low = s
        slope, curve = slope_0 + s * (2.0 * bend + 3.0 * s * twist), 2.0 * bend + 6.0 * s * twist
        following = s - 2.0 * miss * slope / (2.0 * slope * slope - miss * curve)
        if not low <= following <= high:
            following = low + 0.5 * (high - low)
            if high - low <= 1e-12:
                return following
        elif abs(miss) <= 1e-4 * abs(slope):
            return following
        s = following
    return s
