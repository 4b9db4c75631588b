"""Random numbers that are functions of (seed, stream, pixel, counter): no state, so no order of drawing.

The generator is the finaliser of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014; constants of Stafford's
variant 13), chained over the four keys.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from evnlos.errors import ConfigError
from evnlos.sensor._fast_math import cos_turns, fast_log

STREAM_THRESHOLD_ON, STREAM_THRESHOLD_OFF, STREAM_LEAK_RATE, STREAM_LEAK_PHASE = 1, 2, 3, 4
STREAM_LEAK_JITTER, STREAM_SHOT_GAP, STREAM_SHOT_CHOICE = 5, 6, 7
STREAM_HOT, STREAM_TIME_JITTER = 8, 9
STREAM_PHOTONS, STREAM_FEW_PHOTONS = 10, 11
STREAM_WALK, STREAM_BARRIER, STREAM_PASSAGE, STREAM_PENDING = 12, 13, 14, 15
STREAM_READOUT_HOT, STREAM_READOUT_GAP, STREAM_READOUT_CHOICE, STREAM_READOUT_JITTER = 16, 17, 18, 19
STREAM_DEAD, STREAM_RATE_CONTROL = 20, 21
STREAM_CIRCUIT, STREAM_CIRCUIT_START, STREAM_CIRCUIT_BRIDGE = 22, 23, 24

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
def normal_field(seed, stream, count):
    """Return one normal number a pixel, float64 [count]."""
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


@cache
def jitter_table() -> NDArray[np.float32]:
    """Return the table of 1 - 0.1 n, n normal, of which each block of pixels reads a random stretch a step."""
    normal = normal_field(0, STREAM_LEAK_JITTER, JITTER_SIZE)
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
