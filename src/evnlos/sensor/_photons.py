"""Electrons of a frame: shot noise and read noise of every pixel from numbers that depend on its keys only."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from evnlos.sensor._random import STREAM_FEW_PHOTONS, STREAM_PHOTONS, random_normals, random_uniform

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
