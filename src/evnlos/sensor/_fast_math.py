"""Elementary functions without branches or calls, so that a compiler runs them on whole vectors."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

# ln 2 in two parts: the first has so few digits that whole multiples of it are exact
_LN2_HIGH = 0.6931471803691238
_LN2_LOW = 1.9082149292705877e-10
_ROUNDER = 1.5 * 2.0**52

# g(z) = (2 atanh(s) / s - 2) / z, z = s^2, on 0 <= z <= 0.0295 to 3e-16: `mpmath.chebyfit` with 7 terms
G0, G1, G2, G3 = 0.666666666666667, 0.3999999999989889, 0.28571428626253836, 0.22222211089379496
G4, G5, G6 = 0.1818289243253687, 0.15331611722055008, 0.14617807153417325


@njit(cache=True, error_model="numpy", inline="always")
def fast_log(x):
    """Return ln x for a normal positive number, within 3 ulp, in a form that compilers vectorise.

    x = 2^e m with sqrt(1/2) <= m < sqrt(2), s = (m - 1) / (m + 1): ln m = 2 s + s^3 g(s^2), summed in pairs
    (Estrin's order), so that few sums wait for each other.
    """
    bits = np.float64(x).view(np.int64)
    exponent = (bits - np.int64(0x3FE6A09E667F3BCD)) >> 52
    f = np.int64(bits - (exponent << 52)).view(np.float64) - 1.0
    s = f / (2.0 + f)
    z = s * s
    z2 = z * z
    low = (G0 + z * G1) + z2 * (G2 + z * G3)
    high = (G4 + z * G5) + z2 * G6
    series = low + (z2 * z2) * high
    e = np.float64(exponent)
    return e * _LN2_HIGH + (2.0 * s + (s * z * series + e * _LN2_LOW))


@njit(cache=True, error_model="numpy", inline="always")
def fast_exp(x):
    """Return exp x for x <= 0 (clamped at -700), within 3 ulp, in a form that compilers vectorise.

    x = n ln 2 + r with |r| <= ln 2 / 2: exp x = 2^n (1 + r + r^2 / 2 + ...), summed in pairs. Adding 1.5 * 2^52
    rounds to a whole number and leaves it in the last bits.
    """
    x = max(x, -700.0)
    rounded = x * 1.4426950408889634 + _ROUNDER
    n = rounded - _ROUNDER
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    r2 = r * r
    r4 = r2 * r2
    low = (1.0 + r) + r2 * (0.5 + r * (1.0 / 6.0))
    middle = (1.0 / 24.0 + r * (1.0 / 120.0)) + r2 * (1.0 / 720.0 + r * (1.0 / 5040.0))
    high = (1.0 / 40320.0 + r * (1.0 / 362880.0)) + r2 * (1.0 / 3628800.0 + r * (1.0 / 39916800.0))
    series = low + r4 * (middle + r4 * (high + r4 * (1.0 / 479001600.0)))
    return series * np.int64((np.float64(rounded).view(np.int64) + 1023) << 52).view(np.float64)


@njit(cache=True, error_model="numpy", inline="always")
def cos_turns(turns):
    """Return cos(2 pi turns) for 0 <= turns <= 1, within 1e-14: the sine series of |turns - 1/2| - 1/4."""
    x = 2.0 * math.pi * (0.25 - abs(turns - 0.5))
    z = x * x
    series = 1.0
    for n in (20, 18, 16, 14, 12, 10, 8, 6, 4, 2):
        series = 1.0 - series * z / (n * (n + 1.0))
    return -x * series
