"""Crossings on a step that needs no pieces: the filter's output there is a cubic, known by its two ends.

The output's values at both ends come from the closed form of the step, its slopes there from the filter's
equation dP/dt = w(I) (L - P). The cubic with these (Hermite's) misses the output by at most h^4 / 384 times its
fourth derivative, which is tau^3 / 384 of what the output would move in the step at its steepest slope; tau is
the step in the filter's own time. So up to tau = 1 an event is off by less than 0.3 % of the step, unless the
output all but turns at the threshold, on short steps by far less, and takes no exponentials.
"""

from __future__ import annotations

from numba import njit

from evnlos.sensor._exact_math import KNEE
from evnlos.sensor._exact_pass import STRIDE

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
def meet(rise, slope_0, slope_1, level, low):
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
