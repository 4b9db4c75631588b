"""Random numbers as functions of seed, stream, pixel and counter, and the electrons of a frame made of them.

- Elementary functions without branches or calls, so that a compiler runs them on whole vectors.

Random numbers that are functions of (seed, stream, pixel, counter): no state, so no order of drawing.

The generator is the finaliser of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014; constants of Stafford's
variant 13), chained over the four keys.

- Noise with a memory: the covariance that a linear process settles at, its factor, for numbers of that, and
  where the reference of a pixel that sees it stands after long constant light.
- Electrons of a frame: shot noise and read noise of every pixel from numbers that depend on its keys only.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import ConfigError

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


STREAM_THRESHOLD_ON, STREAM_THRESHOLD_OFF, STREAM_LEAK_RATE, STREAM_LEAK_PHASE = 1, 2, 3, 4
STREAM_LEAK_JITTER, STREAM_SHOT_GAP, STREAM_SHOT_CHOICE = 5, 6, 7
STREAM_HOT, STREAM_TIME_JITTER = 8, 9
STREAM_PHOTONS, STREAM_FEW_PHOTONS = 10, 11
STREAM_WALK, STREAM_BARRIER, STREAM_PASSAGE, STREAM_PENDING = 12, 13, 14, 15
STREAM_READOUT_HOT, STREAM_READOUT_GAP, STREAM_READOUT_CHOICE, STREAM_READOUT_JITTER = 16, 17, 18, 19
STREAM_DEAD, STREAM_RATE_CONTROL = 20, 21
STREAM_CIRCUIT, STREAM_CIRCUIT_START = 22, 23
STREAM_CELEX = 25

JITTER_SIZE = 4096
BLOCK = 256


@njit(cache=True, inline="always")
def _mix(value):
    """Return the SplitMix64 finaliser of a 64-bit word."""
    value = np.uint64(value)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@njit(cache=True, inline="always")
def random_word(seed, stream, pixel, counter):
    """Return 64 random bits that depend on the four keys only."""
    golden = np.uint64(0x9E3779B97F4A7C15)
    word = _mix(np.uint64(seed) + golden * np.uint64(stream))
    word = _mix(word + golden * (np.uint64(pixel) + np.uint64(1)))
    return _mix(word + golden * (np.uint64(counter) + np.uint64(1)))


@njit(cache=True, inline="always")
def random_uniform(seed, stream, pixel, counter):
    """Return a uniform number in the open interval (0, 1)."""
    word = random_word(seed, stream, pixel, counter)
    return (np.float64(word >> np.uint64(12)) + 0.5) * 2.0**-52


@njit(cache=True, error_model="numpy", inline="always")
def random_exponential(seed, stream, pixel, counter):
    """Return an exponential number of mean 1."""
    return -fast_log(random_uniform(seed, stream, pixel, counter))


@njit(cache=True, error_model="numpy", inline="always")
def random_normals(seed, stream, pixel, counter):
    """Return two independent normal numbers of mean 0 and variance 1 (Box and Muller)."""
    first = random_uniform(seed, stream, pixel, 2 * counter)
    second = random_uniform(seed, stream, pixel, 2 * counter + 1)
    length = math.sqrt(-2.0 * fast_log(first))
    quarter = second - 0.25 if second >= 0.25 else second + 0.75  # its cosine is the sine of `second`
    return length * cos_turns(second), length * cos_turns(quarter)


@njit(cache=True, error_model="numpy", inline="always")
def random_normal(seed, stream, pixel, counter):
    """Return a normal number of mean 0 and variance 1."""
    return random_normals(seed, stream, pixel, counter)[0]


@njit(cache=True, error_model="numpy")
def random_triple(seed, stream, pixel, counter, factor, out):
    """Fill `out` [3] with normal numbers of the covariance factor factor^T, factor lower triangular."""
    a, b = random_normals(seed, stream, pixel, counter)
    c, _ = random_normals(seed, stream, pixel, counter + 1)
    out[0] = factor[0, 0] * a
    out[1] = factor[1, 0] * a + factor[1, 1] * b
    out[2] = factor[2, 0] * a + factor[2, 1] * b + factor[2, 2] * c


@njit(cache=True, error_model="numpy")
def normal_row(seed, stream, first, counter, normal):
    """Fill two normal numbers of each of N pixels from `first` on, [2 N]."""
    for i in range(len(normal) // 2):
        normal[2 * i], normal[2 * i + 1] = random_normals(seed, stream, first + i, counter)


@njit(cache=True, error_model="numpy")
def normal_field(seed, stream, count):
    """Return one normal number per pixel, float64 [count]."""
    field = np.empty(count)
    for pixel in range(count):
        field[pixel] = random_normal(seed, stream, pixel, 0)
    return field


@njit(cache=True, error_model="numpy")
def uniform_field(seed, stream, count):
    """Return one uniform number in (0, 1) a pixel, float64 [count]."""
    field = np.empty(count)
    for pixel in range(count):
        field[pixel] = random_uniform(seed, stream, pixel, 0)
    return field


@njit(cache=True, error_model="numpy")
def exponential_field(seed, stream, count):
    """Return one exponential number of mean 1 a pixel, float64 [count]."""
    field = np.empty(count)
    for pixel in range(count):
        field[pixel] = random_exponential(seed, stream, pixel, 0)
    return field


def stationary(m: NDArray, noise: NDArray) -> NDArray[np.float64]:
    """Return P of M P + P M^T + noise = 0, [L, 3, 3]: the covariance that x' = M x + noise settles at."""
    one = np.eye(3)
    system = np.einsum("lij,kn->likjn", m, one) + np.einsum("ij,lkn->likjn", one, m)
    return np.linalg.solve(system.reshape(-1, 9, 9), -noise.reshape(-1, 9, 1)).reshape(-1, 3, 3)


def factor_of(covariance: NDArray) -> NDArray[np.float64]:
    """Return lower-triangular factors of covariances, zero where they are."""
    if not covariance.any():
        return np.zeros_like(covariance)
    scale = np.sqrt(np.einsum("lii->li", covariance))
    correlation = covariance / scale[:, :, None] / scale[:, None, :]
    return scale[:, :, None] * np.linalg.cholesky(correlation + 1e-12 * np.eye(3))


@cache
def jitter_table() -> NDArray[np.float32]:
    """Return the table of 1 - 0.1 n, n normal, of which each block of pixels reads a random stretch a step."""
    normal = normal_field(np.uint64(0), STREAM_LEAK_JITTER, JITTER_SIZE)
    normal = (normal - normal.mean()) / normal.std()
    table = 1.0 - 0.1 * normal
    ring = np.concatenate([table, table[:BLOCK]]).astype(np.float32)
    ring.flags.writeable = False
    return ring


@njit(cache=True, inline="always")
def jitter_offset(seed, block, step):
    """Return where in the jitter table a block of 256 pixels reads in one step."""
    return np.int64(random_word(seed, STREAM_LEAK_JITTER, block, step) & np.uint64(JITTER_SIZE - 1))


def check_seed(seed: int) -> int:
    """Return the seed as an int in 0..2**64 - 1, refusing anything else."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or not 0 <= int(seed) < 2**64:
        raise ConfigError(f"seed is {seed!r}; give an integer from 0 to 2**64 - 1")
    return int(seed)


FEW = 64.0
"""Mean number of electrons below which the Poisson number is drawn by inverting its distribution."""


@njit(cache=True, error_model="numpy", inline="always")
def many_electrons(mean, z):
    """Return the Poisson number of a large mean that belongs to the normal number z.

    The Cornish-Fisher expansion of its quantile to the order 1 / sqrt(mean), rounded: its distribution function
    is that of the Poisson number within 2e-4 from a mean of 64 on. After Cornish and Fisher, Rev. Inst. Int.
    Stat. 5, 307 (1937).
    """
    root = math.sqrt(mean)
    return np.rint(mean + root * z + (z * z - 1.0) / 6.0 + (z - z * z * z) / (72.0 * root))


@njit(cache=True, error_model="numpy")
def few_electrons(mean, uniform):
    """Return the Poisson number of a mean up to some hundred that belongs to the uniform number."""
    share = math.exp(-mean)
    total, count = share, 0.0
    while total < uniform and count < 2000.0:
        count += 1.0
        share *= mean / count
        total += share
    return count


@njit(cache=True, error_model="numpy", nogil=True)
def fill_electrons(mean, offset, read_noise, seed, number, out):
    """Fill the electrons of frame `number`, [N]: a Poisson number of `mean`, `offset`, and read noise.

    `mean` and `offset` are electrons [N], `read_noise` the standard deviation in electrons.
    """
    for i in range(len(out)):
        shot, read = random_normals(seed, STREAM_PHOTONS, i, number)
        count = max(many_electrons(max(mean[i], FEW), shot), 0.0)
        out[i] = count + offset[i] + read_noise * read
    for i in range(len(out)):
        if mean[i] < FEW:
            read = random_normals(seed, STREAM_PHOTONS, i, number)[1]
            count = few_electrons(mean[i], random_uniform(seed, STREAM_FEW_PHOTONS, i, number))
            out[i] = count + offset[i] + read_noise * read


_PHASES = 32
"""Places of the reference, between two events of one sign, for which its law is worked out."""
_FAR, _PER_RMS = 30.0, 32
"""Table of passage times: how far it goes, rms of the noise, and entries per rms."""
_SELDOM = 8.0
"""Swings of the noise, rms, that are too rare to move a reference."""
_FORGETS_HZ = 1e-6
"""Rate at which a reference forgets where it stood where neither leak nor noise ever moves it."""


class Passage(NamedTuple):
    """Times of a noise of rms 1 and correlation time 1, at -30 ... 30 rms."""

    climb: NDArray[np.float64]  # mean time from the left end up to here
    inverse: NDArray[np.float64]  # crossings of 0 per crossing of here, 1 below 0


@cache
def passage_times() -> Passage:
    """Return the table: from a up to b, an Ornstein-Uhlenbeck noise needs climb(b) - climb(a) on average.

    climb' = sqrt(2 pi) exp(x^2 / 2) Phi(x), Phi the normal distribution.
    """
    x = np.linspace(-_FAR, _FAR, int(2 * _FAR) * _PER_RMS + 1)
    slope = np.array([math.sqrt(math.pi / 2) * math.exp(z * z / 2) * math.erfc(-z / math.sqrt(2)) for z in x])
    climb = np.concatenate([[0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]))]) / _PER_RMS
    return Passage(climb, np.exp(np.maximum(x, 0.0) ** 2 / 2))


@njit(cache=True, error_model="numpy", inline="always")
def _at(table, x):
    """Return a table's value at x rms, a line between two entries."""
    place = (min(max(x, -_FAR), _FAR - 1e-9) + _FAR) * _PER_RMS
    k = int(place)
    return table[k] + (place - k) * (table[k + 1] - table[k])


@njit(cache=True, error_model="numpy", inline="always")
def _rate(a, b, slowest, table):
    """Return the rate, per correlation time, at which noise that has been at `a` rms first comes up to `b`.

    slowest  crossings of the middle per correlation time: noise that is smooth, or seen in steps, has few
    """
    if b >= _FAR:
        return 1.0 / table.climb[-1]
    return 1.0 / (_at(table.climb, b) - _at(table.climb, a) + _at(table.inverse, b) / slowest + 0.01)


@njit(cache=True, error_model="numpy", nogil=True)
def settled_reference(on, off, leak, pause, noise, rms, memory, middle, seed, table, out):
    """Draw how far references stand above the settled level after long constant light, log units; fill `out`.

    Two references a threshold apart share a phase. The noise takes a pixel from one to the other and back, a
    pair of events, which moves the phase by what the thresholds differ, or by what the noise does in a
    refractory period; the leak moves it evenly. The phase follows the stationary law of such steps, and the
    pixel stands at the one of the two references that the noise met last.

    on, off   thresholds, log units [N];  leak  log units per s;  pause  refractory period, s
    noise     where the noise stands, log units [N]
    rms, memory  its standard deviation, log units, and correlation time, s [N]
    middle    its upward crossings of zero per s [N];  seed, table  of the draws, and `passage_times()`
    """
    fall, rise = np.empty(_PHASES), np.empty(_PHASES)  # rates from a phase to the next lower, next higher
    back, skip = np.empty(_PHASES), np.empty(_PHASES)
    upper, share = np.empty(_PHASES), np.empty(_PHASES)
    for i in range(len(out)):
        scale = max(rms[i], 1e-3 * on[i])
        width, p, m = on[i] / _PHASES, on[i] / scale, off[i] / scale
        drift, q, slowest = leak / width, 0.0, max(middle[i] * memory[i], 1e-9)
        step = (p - m) * _PHASES / p
        loose = -math.expm1(-2.0 * pause / memory[i]) * (scale / width) ** 2
        for j in range(_PHASES):
            low = -(j + 0.5) * p / _PHASES
            high = low + p
            up = _rate(low, high, slowest, table) / memory[i]
            down = _rate(-high, m - high, slowest, table) / memory[i]
            q = (q * drift + up) / (drift + up + down)
            upper[j] = q
            # and what comes of the lower one's swings below it, the upper one's above
            pairs = down * q
            if m - low < _SELDOM:
                pairs += _rate(-low, m - low, slowest, table) / memory[i] * (1.0 - q)
            if high + p < _SELDOM:
                pairs += _rate(high, high + p, slowest, table) / memory[i] * q
            spread = 0.5 * pairs * max(step * step, abs(step))
            fall[j], rise[j] = drift + spread - 0.5 * pairs * step, spread + 0.5 * pairs * step
            share[j] = pairs * loose + _FORGETS_HZ * _PHASES**2
        for j in range(_PHASES):  # steps that refractory noise or forgetting takes lead to the noise's own law
            n = (j + 1) % _PHASES
            here, there = min(j + 0.5, _PHASES - j - 0.5), min(n + 0.5, _PHASES - n - 0.5)
            gain = 0.5 * (here * here - there * there) * (p / _PHASES) ** 2
            fall[j] += share[j] * math.exp(min(gain, 0.0))
            rise[n] += share[n] * math.exp(min(-gain, 0.0))
        # the stationary law of steps around a ring: one phase after another is taken out, and put back
        back[_PHASES - 1], skip[_PHASES - 1] = fall[_PHASES - 1], rise[0]
        for j in range(_PHASES - 1, 0, -1):  # back: from j to 0, skip: from 0 to j
            leave = rise[j] + back[j]
            if j > 1:
                back[j - 1], skip[j - 1] = fall[j - 1] * back[j] / leave, skip[j] * rise[j] / leave
            share[j] = leave
        total = share[0] = 1.0
        skip[1] += fall[0]
        for j in range(1, _PHASES):
            share[j] = (skip[j] + (share[j - 1] * fall[j - 1] if j > 1 else 0.0)) / share[j]
            total += share[j]
        left, j = random_uniform(seed, STREAM_LEAK_PHASE, i, 0) * total, 0
        while j < _PHASES - 1 and left >= share[j]:
            left -= share[j]
            j += 1
        low = -width * (j + min(left / share[j], 1.0))
        # which of the two the noise met last, from where it stands; as in balance, but for what the leak leaves
        met = _at(table.climb, noise[i] / scale) - _at(table.climb, -noise[i] / scale)
        a, b = low / scale, low / scale + p
        below = max(met - _at(table.climb, a) + _at(table.climb, -a), 0.0)
        above = max(_at(table.climb, b) - _at(table.climb, -b) - met, 0.0)
        below *= upper[j] * _rate(-b, -a, slowest, table)
        above *= (1.0 - upper[j]) * _rate(a, b, slowest, table)
        stand = low
        if random_uniform(seed, STREAM_LEAK_PHASE, i, 1) * (below + above) < below:
            stand += on[i]
        stand += on[i] * max(math.floor((noise[i] - stand) / on[i]), 0.0)
        out[i] = stand - off[i] * max(math.floor((stand - noise[i]) / off[i]), 0.0)
